/* plain.h: all bodies of a scope by a plain program, which shares nothing with the library: bodies
 * are lists of cells, made by adding a cell to every smaller body. */
#ifndef MORPHO_TESTS_ATLAS_PLAIN_H
#define MORPHO_TESTS_ATLAS_PLAIN_H

#include "../make.h"

#include <morpho/atlas.h>

#define PLAIN_CELLS  10
#define PLAIN_BODIES 8192

/* Its canonical form: cells from the origin on, sorted; cells after the first n are 0. */
struct plain_body {
  int n, side[3];
  int cells[PLAIN_CELLS][3];
};

static int plain_compare_cells(const void *a, const void *b)
{
  const int *p = a, *q = b;
  for (int axis = 0; axis < 3; axis++)
    if (p[axis] != q[axis])
      return p[axis] < q[axis] ? -1 : 1;
  return 0;
}

/* Of two images of one body: by sides, then the one whose first differing voxel is empty. A sorted
 * list of cells has its voxel earlier where it is smaller. */
static int plain_compare(const struct plain_body *a, const struct plain_body *b)
{
  if (a->n != b->n)
    return a->n < b->n ? -1 : 1;
  for (int axis = 0; axis < 3; axis++)
    if (a->side[axis] != b->side[axis])
      return a->side[axis] < b->side[axis] ? -1 : 1;
  for (int i = 0; i < a->n; i++) {
    const int order = plain_compare_cells(a->cells[i], b->cells[i]);
    if (order != 0)
      return -order;
  }
  return 0;
}

/* In the order of the atlas: by size, then by sorted cells. */
static int plain_order(const void *a, const void *b)
{
  const struct plain_body *p = a, *q = b;
  if (p->n != q->n)
    return p->n < q->n ? -1 : 1;
  for (int i = 0; i < p->n; i++) {
    const int order = plain_compare_cells(p->cells[i], q->cells[i]);
    if (order != 0)
      return order;
  }
  return 0;
}

static struct plain_body plain_image(const struct plain_body *body, int k)
{
  struct plain_body image = {.n = body->n};
  int low[3] = {1000, 1000, 1000}, high[3] = {-1000, -1000, -1000};
  for (int i = 0; i < body->n; i++) {
    const int *from = body->cells[i];
    int *to = image.cells[i];
    to[0] = (k & 4 ? from[1] : from[0]) * (k & 1 ? -1 : 1);
    to[1] = (k & 4 ? from[0] : from[1]) * (k & 2 ? -1 : 1);
    to[2] = from[2];
    for (int axis = 0; axis < 3; axis++) {
      low[axis] = to[axis] < low[axis] ? to[axis] : low[axis];
      high[axis] = to[axis] > high[axis] ? to[axis] : high[axis];
    }
  }
  for (int axis = 0; axis < 3; axis++) {
    image.side[axis] = high[axis] - low[axis] + 1;
    for (int i = 0; i < body->n; i++)
      image.cells[i][axis] -= low[axis];
  }
  qsort(image.cells, (size_t)image.n, sizeof(image.cells[0]), plain_compare_cells);
  return image;
}

/* Returns whether any image fits; the canonical form is the smallest that does. */
static bool plain_canonical(struct mo_workspace workspace, const struct plain_body *body,
                            struct plain_body *form)
{
  bool found = false;
  for (int k = 0; k < 8; k++) {
    const struct plain_body image = plain_image(body, k);
    if (image.side[0] > workspace.nx || image.side[1] > workspace.ny ||
        image.side[2] > workspace.nz)
      continue;
    if (!found || plain_compare(&image, form) < 0)
      *form = image;
    found = true;
  }
  return found;
}

static bool plain_has(const struct plain_body *body, const int cell[3])
{
  for (int i = 0; i < body->n; i++)
    if (plain_compare_cells(body->cells[i], cell) == 0)
      return true;
  return false;
}

static void plain_add(struct mo_workspace workspace, const struct plain_body *body,
                      const int cell[3], struct plain_body *bodies, size_t *n)
{
  struct plain_body larger = *body, form = {0};
  memcpy(larger.cells[larger.n++], cell, sizeof(larger.cells[0]));
  if (!plain_canonical(workspace, &larger, &form))
    return;
  for (size_t i = *n; i-- > 0 && bodies[i].n == form.n;)
    if (plain_order(&bodies[i], &form) == 0)
      return;
  if (*n == PLAIN_BODIES) {
    printf("Bail out! more than %d bodies\n", PLAIN_BODIES);
    exit(1);
  }
  bodies[(*n)++] = form;
}

/* Makes all bodies of a scope, in order. Returns their number. bodies: (PLAIN_BODIES). */
static size_t plain_bodies(const struct mo_atlas_scope *scope, struct plain_body *bodies)
{
  size_t n = 1, first = 0;
  bodies[0] = (struct plain_body){.n = 1, .side = {1, 1, 1}};
  for (uint32_t size = 2; size <= scope->voxels_max; size++) {
    const size_t end = n;
    for (size_t i = first; i < end; i++)
      for (int c = 0; c < bodies[i].n; c++)
        for (int step = 0; step < 6; step++) {
          int cell[3];
          memcpy(cell, bodies[i].cells[c], sizeof(cell));
          cell[step / 2] += step % 2 ? 1 : -1;
          if (!plain_has(&bodies[i], cell))
            plain_add(scope->workspace, &bodies[i], cell, bodies, &n);
        }
    first = end;
  }
  qsort(bodies, n, sizeof(*bodies), plain_order);
  return n;
}

static void plain_bits(struct mo_workspace workspace, const struct plain_body *body,
                       uint64_t bits[MO_DEFAULT_WORDS])
{
  memset(bits, 0, MO_DEFAULT_WORDS * sizeof(*bits));
  for (int i = 0; i < body->n; i++) {
    const int *at = body->cells[i];
    const int voxel = (at[0] * workspace.ny + at[1]) * workspace.nz + at[2];
    bits[voxel / 64] |= UINT64_C(1) << voxel % 64;
  }
}

#endif
