/* suite_picture.c: the picture of an evaluation in a suite: an axis for each task and a polygon for
 * each design, as SVG. The colors are those of the dashboard's themes
 * (clients/dashboard/style.css).
 */
#include <math.h>
#include <stdio.h>

#include "api/suite.h"

#define WIDE_PX    620 /* at this width or more, the legend is beside the axes */
#define LEGEND_PX  210
#define LABEL_PX   96 /* space for the labels on either side */
#define NARROW_PX  76 /* the same in a narrow picture */
#define RADIUS_MAX 190
#define RINGS      3
#define FILLED_MAX 3 /* more filled polygons would hide each other */
#define TOP_PX     78
#define ROW_PX     40 /* height of a row of the legend */

static const struct {
  const char *light, *dark;
} colors[] = {{"#ffffff", "#1b2027"}, {"#e3e8ee", "#2b333c"}, {"#d5dbe3", "#313a44"},
              {"#181d23", "#e9edf2"}, {"#566270", "#9aa6b4"}, {"#1b62b8", "#5aa6f0"},
              {"#b86200", "#f3a536"}, {"#1c7a4b", "#5cc78f"}, {"#9b3d8f", "#dd86cf"},
              {"#6b7785", "#8d99a7"}, {"#b3261e", "#ff8a80"}};
enum { PANEL, GRID, LINE, TEXT, MUTED, FIRST_POLYGON };
_Static_assert(sizeof(colors) / sizeof(*colors) == FIRST_POLYGON + MO_SUITE_POLYGONS_MAX,
               "each polygon has a color");

struct picture {
  struct mo_text *text;
  bool is_dark;
  double x, y, radius; /* of the center */
};

/* Writes the attribute that paints an element, "fill" or "stroke". */
static void paint(const struct picture *picture, const char *attribute, int color)
{
  mo_text_format(picture->text, " %s=\"%s\"", attribute,
                 picture->is_dark ? colors[color].dark : colors[color].light);
}

/* Writes words, which need no escapes. */
static void write_words(const struct picture *picture, double x, double y, int color, double size,
                        const char *more, const char *words)
{
  mo_text_format(picture->text, "<text x=\"%.1f\" y=\"%.1f\" font-size=\"%g\"%s", x, y, size, more);
  paint(picture, "fill", color);
  mo_text_format(picture->text, ">%s</text>", words);
}

/* The axes go clockwise, the first one up. */
static double at_x(const struct picture *picture, uint32_t t, double share)
{
  return picture->x + picture->radius * share * sin(2 * M_PI * t / MO_SUITE_TASKS);
}

static double at_y(const struct picture *picture, uint32_t t, double share)
{
  return picture->y - picture->radius * share * cos(2 * M_PI * t / MO_SUITE_TASKS);
}

static void draw_ring(const struct picture *picture, double share)
{
  mo_text_add(picture->text, "<polygon fill=\"none\"");
  paint(picture, "stroke", share < 1 ? GRID : LINE);
  mo_text_add(picture->text, " points=\"");
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++)
    mo_text_format(picture->text, "%.1f,%.1f ", at_x(picture, t, share), at_y(picture, t, share));
  mo_text_add(picture->text, "\"/>");
}

static void draw_axis(const struct picture *picture, uint32_t t, const struct mo_suite_axis *axis)
{
  const double side = sin(2 * M_PI * t / MO_SUITE_TASKS), up = cos(2 * M_PI * t / MO_SUITE_TASKS);
  const char *anchor = fabs(side) < 0.1 ? " text-anchor=\"middle\""
                       : side < 0       ? " text-anchor=\"end\""
                                        : "";
  const double x = picture->x + (picture->radius + 10) * side, y = picture->y -
                                                                   (picture->radius + 10) * up +
                                                                   (up > 0.1    ? -12
                                                                    : up < -0.1 ? 12
                                                                                : 0);
  char range[64];
  mo_text_format(picture->text, "<line x1=\"%.1f\" y1=\"%.1f\" x2=\"%.1f\" y2=\"%.1f\"", picture->x,
                 picture->y, at_x(picture, t, 1), at_y(picture, t, 1));
  paint(picture, "stroke", GRID);
  mo_text_add(picture->text, "/>");
  snprintf(range, sizeof(range), "0 to %g%s%s", axis->maximum, axis->unit[0] != '\0' ? " " : "",
           axis->unit);
  write_words(picture, x, y, TEXT, 13, anchor, mo_suite_task_words[t]);
  write_words(picture, x, y + 14, MUTED, 11, anchor, range);
}

/* A value below 0 is drawn at the center, and a missing value leaves a gap. */
static void draw_polygon(const struct picture *picture, const struct mo_suite_polygon *polygon,
                         int color, bool is_filled, const struct mo_suite_axis *axes)
{
  const double *values = polygon->scores.values;
  const bool is_whole = polygon->scores.n_left_out == 0;
  is_filled = is_filled && is_whole;
  mo_text_format(picture->text, "<path stroke-width=\"2\" stroke-linejoin=\"round\"%s",
                 is_filled ? " fill-opacity=\"0.08\"" : " fill=\"none\"");
  if (is_filled)
    paint(picture, "fill", color);
  paint(picture, "stroke", color);
  mo_text_add(picture->text, " d=\"");
  bool is_gap = true;
  for (uint32_t i = 0; i <= MO_SUITE_TASKS; i++) {
    const uint32_t t = i % MO_SUITE_TASKS;
    if (i == MO_SUITE_TASKS && is_whole)
      continue;
    if (isfinite(values[t]))
      mo_text_format(picture->text, "%c%.1f %.1f", is_gap ? 'M' : 'L',
                     at_x(picture, t, fmax(values[t], 0) / axes[t].maximum),
                     at_y(picture, t, fmax(values[t], 0) / axes[t].maximum));
    is_gap = !isfinite(values[t]);
  }
  mo_text_format(picture->text, "%s\"/>", is_whole ? "Z" : "");
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
    if (!isfinite(values[t]))
      continue;
    mo_text_format(picture->text, "<circle r=\"3\" cx=\"%.1f\" cy=\"%.1f\"",
                   at_x(picture, t, fmax(values[t], 0) / axes[t].maximum),
                   at_y(picture, t, fmax(values[t], 0) / axes[t].maximum));
    paint(picture, "fill", color);
    mo_text_format(picture->text, "><title>%s, %s: %.3g%s%s</title></circle>", polygon->name,
                   mo_suite_task_words[t], values[t], axes[t].unit[0] != '\0' ? " " : "",
                   axes[t].unit);
  }
}

static void write_legend(const struct picture *picture, const struct mo_suite_polygon *polygon,
                         int color, double x, double y)
{
  const struct mo_suite_scores *scores = &polygon->scores;
  char mean[64];
  mo_text_format(picture->text, "<rect x=\"%.1f\" y=\"%.1f\" width=\"14\" height=\"14\" rx=\"3\"",
                 x, y - 12);
  paint(picture, "fill", color);
  mo_text_add(picture->text, "/>");
  write_words(picture, x + 22, y, TEXT, 13, "", polygon->name);
  if (!isfinite(scores->mean_loss))
    snprintf(mean, sizeof(mean), "no score");
  else
    snprintf(mean, sizeof(mean),
             scores->n_left_out > 0 ? "mean loss %.3f, %s left out" : "mean loss %.3f",
             scores->mean_loss, MO_COUNTED(scores->n_left_out, "task"));
  write_words(picture, x + 22, y + 15, MUTED, 11, "", mean);
}

void mo_suite_draw(struct mo_text *text, const char *title, const struct mo_suite_polygon *polygons,
                   uint32_t n, const struct mo_suite_axis axes[MO_SUITE_TASKS], uint32_t width_px,
                   bool is_dark)
{
  const bool is_wide = width_px >= WIDE_PX;
  const double beside = is_wide ? LEGEND_PX : 0, across = width_px - beside,
               label = is_wide ? LABEL_PX : NARROW_PX;
  struct picture picture = {.text = text,
                            .is_dark = is_dark,
                            .radius = fmin((across - 2 * label) / 2, RADIUS_MAX),
                            .x = across / 2};
  picture.y = TOP_PX + picture.radius;
  const double below = picture.y + picture.radius + 76, legend = is_wide ? TOP_PX : below + 14,
               height = is_wide ? below + 12 : legend + ROW_PX * n + 24;
  mo_text_format(text,
                 "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%u\" height=\"%.0f\" "
                 "viewBox=\"0 0 %u %.0f\" role=\"img\" aria-label=\"%s\" "
                 "font-family=\"system-ui, 'Segoe UI', 'DejaVu Sans', sans-serif\">",
                 width_px, height, width_px, height, title);
  mo_text_add(text, "<rect width=\"100%\" height=\"100%\"");
  paint(&picture, "fill", PANEL);
  mo_text_add(text, "/>");
  write_words(&picture, 16, 26, TEXT, 15, " font-weight=\"600\"", title);
  for (int ring = 1; ring <= RINGS; ring++)
    draw_ring(&picture, (double)ring / RINGS);
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++)
    draw_axis(&picture, t, &axes[t]);
  for (uint32_t i = 0; i < n; i++) {
    draw_polygon(&picture, &polygons[i], FIRST_POLYGON + (int)i, n <= FILLED_MAX, axes);
    write_legend(&picture, &polygons[i], FIRST_POLYGON + (int)i, is_wide ? across + 8 : 16,
                 legend + ROW_PX * i);
  }
  write_words(&picture, 16, below - 14, MUTED, 11, "",
              "Farther out is better. The center is 0 (standing still) or less.");
  mo_text_add(text, "</svg>");
}
