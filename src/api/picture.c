/* picture.c: GET /v1/designs/{id}/picture.svg: the voxels of a design in isometric projection. */
#include <math.h>

#include "api/handlers.h"
#include "api/scene.h"

/* The three sides that the view shows, and their corners; x runs to the lower right. */
static const struct {
  uint8_t step[3], corners[4][3];
  const char *color;
} sides[3] = {
    {{0, 0, 1}, {{0, 0, 1}, {1, 0, 1}, {1, 1, 1}, {0, 1, 1}}, "#a9c0e8"},
    {{0, 1, 0}, {{0, 1, 0}, {1, 1, 0}, {1, 1, 1}, {0, 1, 1}}, "#6f93d0"},
    {{1, 0, 0}, {{1, 0, 0}, {1, 1, 0}, {1, 1, 1}, {1, 0, 1}}, "#4f74b8"},
};

struct frame {
  double low[2], high[2];
};

static void write_side(struct mo_text *text, int side, const int cell[3], struct frame *frame)
{
  mo_text_format(text, "<path fill=\"%s\" d=\"", sides[side].color);
  for (int k = 0; k < 4; k++) {
    const uint8_t *corner = sides[side].corners[k];
    const double x = cell[0] + corner[0], y = cell[1] + corner[1], z = cell[2] + corner[2];
    const double at[2] = {(x - y) * sqrt(0.75), (x + y) * 0.5 - z};
    for (int axis = 0; axis < 2; axis++) {
      frame->low[axis] = fmin(frame->low[axis], at[axis]);
      frame->high[axis] = fmax(frame->high[axis], at[axis]);
    }
    mo_text_format(text, "%s%.3f %.3f", k == 0 ? "M" : "L", at[0], at[1]);
  }
  mo_text_add(text, "Z\"/>");
}

/* Writes the sides of all voxels, those behind first. */
static void write_sides(struct mo_text *text, const struct mo_bits *genotype, struct frame *frame)
{
  const struct mo_workspace w = MO_DEFAULT_WORKSPACE;
  for (int depth = 0; depth <= w.nx + w.ny + w.nz; depth++)
    for (int x = 0; x < w.nx; x++)
      for (int y = 0; y < w.ny; y++) {
        const int cell[3] = {x, y, depth - x - y};
        if (!mo_has_voxel(w, genotype, cell[0], cell[1], cell[2]))
          continue;
        for (int side = 0; side < 3; side++) {
          const uint8_t *step = sides[side].step;
          if (!mo_has_voxel(w, genotype, x + step[0], y + step[1], cell[2] + step[2]))
            write_side(text, side, cell, frame);
        }
      }
}

void mo_api_get_design_picture(struct mo_request *request)
{
  struct mo_text text = {0}, paths = {0};
  struct frame frame = {{INFINITY, INFINITY}, {-INFINITY, -INFINITY}};
  struct mo_bits genotype;
  if (!mo_read_design(request, &genotype))
    return;
  write_sides(&paths, &genotype, &frame);
  const double width = frame.high[0] - frame.low[0], height = frame.high[1] - frame.low[1];
  mo_text_format(&text,
                 "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%.0f\" height=\"%.0f\" "
                 "viewBox=\"%.3f %.3f %.3f %.3f\"><g stroke=\"#1a2740\" stroke-width=\".03\" "
                 "stroke-linejoin=\"round\">",
                 40 * width + 8, 40 * height + 8, frame.low[0] - 0.1, frame.low[1] - 0.1,
                 width + 0.2, height + 0.2);
  if (!paths.failed && paths.size > 0)
    mo_text_bytes(&text, paths.data, paths.size);
  mo_text_add(&text, "</g></svg>\n");
  mo_text_free(&paths);
  if (text.failed) {
    mo_text_free(&text);
    mo_reply_error(request, MO_ERR_NO_MEMORY, "picture");
    return;
  }
  mo_reply_bytes(request, 200, "image/svg+xml", text.data, text.size);
  mo_reply_etag_of_body(request);
  request->reply.keep = true;
}
