/* grid.c: operations on genotypes of any workspace, one voxel at a time. */
#include "morphospace/grid.h"

#include "morphospace/bits.h"

/* ---- components ---- */

/* Searches breadth first and returns how many voxels were reached. Every voxel enters the queue
 * once. */
static uint32_t flood(struct mo_workspace workspace, const uint64_t *bits, uint32_t start,
                      uint64_t *reached, uint32_t *queue)
{
  const uint32_t stride_y = workspace.nz;
  const uint32_t stride_x = stride_y * workspace.ny;
  uint32_t head = 0;
  uint32_t tail = 0;
  queue[tail++] = start;
  mo_bits_set(reached, start);
  while (head < tail) {
    uint32_t v = queue[head++];
    uint32_t z = v % stride_y;
    uint32_t y = v / stride_y % workspace.ny;
    uint32_t x = v / stride_x;
    uint32_t next[6];
    int n = 0;
    if (z > 0)
      next[n++] = v - 1;
    if (z + 1 < workspace.nz)
      next[n++] = v + 1;
    if (y > 0)
      next[n++] = v - stride_y;
    if (y + 1 < workspace.ny)
      next[n++] = v + stride_y;
    if (x > 0)
      next[n++] = v - stride_x;
    if (x + 1 < workspace.nx)
      next[n++] = v + stride_x;
    for (int i = 0; i < n; i++) {
      if (mo_bits_get(bits, next[i]) && !mo_bits_get(reached, next[i])) {
        mo_bits_set(reached, next[i]);
        queue[tail++] = next[i];
      }
    }
  }
  return tail;
}

int mo_grid_component(struct mo_workspace workspace, const uint64_t *bits, uint32_t start,
                      uint64_t *reached)
{
  uint32_t *queue = malloc(mo_workspace_voxels(workspace) * sizeof(*queue));
  if (queue == NULL)
    return MO_ERR_NO_MEMORY;
  flood(workspace, bits, start, reached, queue);
  free(queue);
  return MO_OK;
}

int mo_grid_keep_largest(struct mo_workspace workspace, uint64_t *bits)
{
  uint32_t words = mo_workspace_words(workspace);
  uint32_t *queue = malloc(mo_workspace_voxels(workspace) * sizeof(*queue));
  struct mo_scratch reached;
  if (queue == NULL || mo_scratch_open(&reached, words) != MO_OK) {
    free(queue);
    return MO_ERR_NO_MEMORY;
  }
  uint32_t best = 0;
  uint32_t best_start = 0;
  for (uint32_t w = 0; w < words; w++) {
    uint64_t rest;
    while ((rest = bits[w] & ~reached.bits[w]) != 0) {
      uint32_t start = w * 64 + (uint32_t)__builtin_ctzll(rest);
      uint32_t size = flood(workspace, bits, start, reached.bits, queue);
      if (size > best) {
        best = size;
        best_start = start;
      }
    }
  }
  if (best > 0) {
    memset(reached.bits, 0, words * sizeof(uint64_t));
    flood(workspace, bits, best_start, reached.bits, queue);
    memcpy(bits, reached.bits, words * sizeof(uint64_t));
  }
  free(queue);
  mo_scratch_close(&reached);
  return MO_OK;
}

/* ---- extent and placement ---- */

struct extent {
  uint64_t n;
  uint64_t sum[3];
  uint32_t low[3];
  uint32_t high[3];
};

static struct extent measure(struct mo_workspace workspace, const uint64_t *bits)
{
  struct extent extent = {.low = {UINT32_MAX, UINT32_MAX, UINT32_MAX}};
  uint32_t words = mo_workspace_words(workspace);
  for (uint32_t w = 0; w < words; w++) {
    for (uint64_t rest = bits[w]; rest != 0; rest &= rest - 1) {
      uint32_t v = w * 64 + (uint32_t)__builtin_ctzll(rest);
      const uint32_t at[3] = {v / workspace.nz / workspace.ny, v / workspace.nz % workspace.ny,
                              v % workspace.nz};
      extent.n++;
      for (int axis = 0; axis < 3; axis++) {
        extent.sum[axis] += at[axis];
        extent.low[axis] = at[axis] < extent.low[axis] ? at[axis] : extent.low[axis];
        extent.high[axis] = at[axis] > extent.high[axis] ? at[axis] : extent.high[axis];
      }
    }
  }
  return extent;
}

/* Moves every bit by `shift` places toward higher indices (negative: lower); bits shifted out of
 * the array are lost. */
static void shift_bits(uint64_t *bits, uint32_t words, int64_t shift)
{
  if (shift > 0) {
    uint32_t whole = (uint32_t)(shift >> 6);
    unsigned part = (unsigned)(shift & 63);
    for (uint32_t w = words; w-- > 0;) {
      uint64_t high = w >= whole ? bits[w - whole] : 0;
      uint64_t low = w >= whole + 1 ? bits[w - whole - 1] : 0;
      bits[w] = part != 0 ? high << part | low >> (64 - part) : high;
    }
  } else if (shift < 0) {
    uint32_t whole = (uint32_t)(-shift >> 6);
    unsigned part = (unsigned)(-shift & 63);
    for (uint32_t w = 0; w < words; w++) {
      uint64_t low = w + whole < words ? bits[w + whole] : 0;
      uint64_t high = w + whole + 1 < words ? bits[w + whole + 1] : 0;
      bits[w] = part != 0 ? low >> part | high << (64 - part) : low;
    }
  }
}

/* The distance to the middle, times 2n, is |2 sum + 2n shift − n (side − 1)|: an integer that is
 * smallest at one shift or at two neighboring shifts, and monotone on either side of them. */
int32_t mo_place_shift(uint32_t side, uint32_t low, uint32_t high, uint64_t n, uint64_t sum)
{
  int64_t count = (int64_t)n;
  int64_t lacking =
      count * ((int64_t)side - 1) - 2 * (int64_t)sum; /* the ideal shift is lacking / 2n */
  /* ceil(lacking / 2n − ½): the nearest integer; halfway between two, the lower one. */
  int64_t above = lacking - count;
  int64_t shift = above >= 0 ? (above + 2 * count - 1) / (2 * count) : -(-above / (2 * count));
  int64_t least = -(int64_t)low;
  int64_t most = (int64_t)side - 1 - (int64_t)high;
  return (int32_t)(shift < least ? least : shift > most ? most : shift);
}

void mo_grid_place(struct mo_workspace workspace, uint64_t *bits)
{
  struct extent extent = measure(workspace, bits);
  if (extent.n == 0)
    return;
  int64_t dx = mo_place_shift(workspace.nx, extent.low[0], extent.high[0], extent.n, extent.sum[0]);
  int64_t dy = mo_place_shift(workspace.ny, extent.low[1], extent.high[1], extent.n, extent.sum[1]);
  /* The body stays inside the workspace, so one shift of indices moves every voxel. */
  int64_t shift = (dx * workspace.ny + dy) * workspace.nz - (int64_t)extent.low[2];
  shift_bits(bits, mo_workspace_words(workspace), shift);
}

/* ---- moving to a different workspace ---- */

int mo_grid_move(struct mo_workspace from, const uint64_t *bits, struct mo_workspace to,
                 uint64_t *moved)
{
  const struct extent extent = measure(from, bits);
  const uint32_t words = mo_workspace_words(from);
  uint32_t side[3] = {0};
  for (int axis = 0; axis < 3 && extent.n > 0; axis++)
    side[axis] = extent.high[axis] - extent.low[axis] + 1;
  const int upright = side[0] <= to.nx && side[1] <= to.ny;
  if (side[2] > to.nz || (!upright && (side[1] > to.nx || side[0] > to.ny)))
    return MO_ERR_RANGE;
  memset(moved, 0, mo_workspace_words(to) * sizeof(uint64_t));
  for (uint32_t w = 0; w < words; w++) {
    for (uint64_t rest = bits[w]; rest != 0; rest &= rest - 1) {
      const uint32_t v = w * 64 + (uint32_t)__builtin_ctzll(rest);
      const uint32_t x = v / from.nz / from.ny - extent.low[0];
      const uint32_t y = v / from.nz % from.ny - extent.low[1];
      const uint32_t z = v % from.nz - extent.low[2];
      /* Rotated by 90°: (x, y) goes to (−y, x), shifted back into the box. */
      const uint32_t column = upright ? x * to.ny + y : (side[1] - 1 - y) * to.ny + x;
      mo_bits_set(moved, column * to.nz + z);
    }
  }
  return MO_OK;
}

/* ---- images ---- */

int mo_grid_view_image(struct mo_workspace workspace, const uint64_t *bits, unsigned k,
                       struct mo_grid_view *view)
{
  struct extent extent = measure(workspace, bits);
  struct mo_grid_view found = {.k = k};
  if (extent.n > 0) {
    const int swap = (k & 4) != 0;
    for (int axis = 0; axis < 3; axis++) {
      int to = axis < 2 && swap ? 1 - axis : axis;
      found.low[axis] = extent.low[axis];
      found.side[to] = extent.high[axis] - extent.low[axis] + 1;
    }
    if (found.side[0] > workspace.nx || found.side[1] > workspace.ny)
      return MO_ERR_RANGE;
  }
  *view = found;
  return MO_OK;
}

static int get_at(struct mo_workspace workspace, const uint64_t *bits,
                  const struct mo_grid_view *view, const uint32_t at[3])
{
  uint32_t x = view->k & 1 ? view->side[0] - 1 - at[0] : at[0];
  uint32_t y = view->k & 2 ? view->side[1] - 1 - at[1] : at[1];
  if (view->k & 4) {
    uint32_t swapped = x;
    x = y;
    y = swapped;
  }
  uint32_t column = (view->low[0] + x) * workspace.ny + view->low[1] + y;
  return mo_bits_get(bits, column * workspace.nz + view->low[2] + at[2]);
}

/* Returns a negative number, 0 or a positive number if the genotype in view a is smaller than,
 * equal to or larger than that in view b. */
static int compare(struct mo_workspace workspace, const uint64_t *bits,
                   const struct mo_grid_view *a, const struct mo_grid_view *b)
{
  for (int axis = 0; axis < 3; axis++)
    if (a->side[axis] != b->side[axis])
      return a->side[axis] < b->side[axis] ? -1 : 1;
  uint32_t at[3];
  for (at[0] = 0; at[0] < a->side[0]; at[0]++) {
    for (at[1] = 0; at[1] < a->side[1]; at[1]++) {
      for (at[2] = 0; at[2] < a->side[2]; at[2]++) {
        int difference = get_at(workspace, bits, a, at) - get_at(workspace, bits, b, at);
        if (difference != 0)
          return difference;
      }
    }
  }
  return 0;
}

void mo_grid_view_canonical(struct mo_workspace workspace, const uint64_t *bits,
                            struct mo_grid_view *view)
{
  struct mo_grid_view best = {.k = 0};
  mo_grid_view_image(workspace, bits, 0, &best); /* image 0 always fits */
  struct mo_grid_view swapped;
  int fits = mo_grid_view_image(workspace, bits, 4, &swapped) == MO_OK;
  const struct mo_grid_view upright = best;
  for (unsigned k = 1; k < 8; k++) {
    if (k >= 4 && !fits)
      break;
    struct mo_grid_view candidate = k < 4 ? upright : swapped;
    candidate.k = k;
    if (compare(workspace, bits, &candidate, &best) < 0)
      best = candidate;
  }
  *view = best;
}

void mo_grid_view_write(struct mo_workspace workspace, const uint64_t *bits,
                        const struct mo_grid_view *view, uint64_t *image)
{
  memset(image, 0, mo_workspace_words(workspace) * sizeof(uint64_t));
  uint32_t at[3];
  for (at[0] = 0; at[0] < view->side[0]; at[0]++) {
    for (at[1] = 0; at[1] < view->side[1]; at[1]++) {
      for (at[2] = 0; at[2] < view->side[2]; at[2]++)
        if (get_at(workspace, bits, view, at))
          mo_bits_set(image, (at[0] * workspace.ny + at[1]) * workspace.nz + at[2]);
    }
  }
}
