/* keys.c: finds all bodies of one size.
 *
 * Redelmeier's method (Counting polyominoes, Discrete Mathematics 36, 1981) makes each connected
 * set of n cells once, up to translation, and keeps nothing but the set that it is making. Cells
 * are numbered in the order of x, y, z, and the first cell of a set is its smallest, so no cell
 * before it is ever used. A list has the cells next to the set; each set takes cells from the list
 * in order, and cells that were passed over are never taken later.
 *
 * A set is a body if it is its own canonical form, as exactly one of its at most eight images is.
 * So every body is found exactly once, and only the keys of the bodies are kept, to be sorted. Ten
 * voxels have 8.3 million sets in the default workspace. */
#include "atlas/keys.h"

#include <stdlib.h>
#include <string.h>

#define LIST_MAX   (1 + 6 * MO_ATLAS_VOXELS_MAX)
#define KEYS_FIRST 1024 /* room for this many keys at first */

struct box {
  int32_t low[3], high[3];
};

struct making {
  struct mo_workspace workspace;
  const struct mo_atlas_sets *sets;
  uint32_t n, words;
  int32_t side[3];           /* of the workspace */
  int32_t cells[3];          /* sides of the space of `met`, in which x begins at the first cell,
                                and y and z extend to both sides of it */
  uint8_t *met;              /* whether a cell is in the list, or before the first cell */
  int32_t list[LIST_MAX][3]; /* the first cell, then neighbors of chosen cells */
  uint32_t chosen[MO_ATLAS_VOXELS_MAX]; /* indices of the list, ascending */
  struct box boxes[MO_ATLAS_VOXELS_MAX + 1];
  uint64_t *keys;
  uint64_t n_keys, capacity;
};

static size_t cell_of(const struct making *making, const int32_t at[3])
{
  return ((size_t)at[0] * (size_t)making->cells[1] + (size_t)at[1]) * (size_t)making->cells[2] +
         (size_t)at[2];
}

/* Adds a cell's neighbors that have not been met to the list, and returns its new length. */
static uint32_t meet(struct making *making, const int32_t at[3], uint32_t length)
{
  for (int axis = 0; axis < 3; axis++)
    for (int32_t step = -1; step <= 1; step += 2) {
      int32_t next[3] = {at[0], at[1], at[2]};
      next[axis] += step;
      if (next[axis] < 0 || next[axis] >= making->cells[axis])
        continue;
      uint8_t *met = &making->met[cell_of(making, next)];
      if (*met == 0) {
        *met = 1;
        memcpy(making->list[length++], next, sizeof(next));
      }
    }
  return length;
}

static void forget(struct making *making, uint32_t from, uint32_t end)
{
  for (uint32_t i = from; i < end; i++)
    making->met[cell_of(making, making->list[i])] = 0;
}

/* Extends the box to a cell. Returns whether it still fits the workspace. */
static bool extend(const struct making *making, const struct box *box, const int32_t at[3],
                   struct box *extended)
{
  bool fits = true;
  for (int axis = 0; axis < 3; axis++) {
    extended->low[axis] = at[axis] < box->low[axis] ? at[axis] : box->low[axis];
    extended->high[axis] = at[axis] > box->high[axis] ? at[axis] : box->high[axis];
    fits = fits && extended->high[axis] - extended->low[axis] < making->side[axis];
  }
  return fits;
}

static int keep(struct making *making, uint64_t key)
{
  if (making->n_keys == making->capacity) {
    const uint64_t capacity = making->capacity > 0 ? 2 * making->capacity : KEYS_FIRST;
    uint64_t *larger = realloc(making->keys, capacity * sizeof(*larger));
    if (larger == NULL)
      return MO_ERR_NO_MEMORY;
    making->keys = larger;
    making->capacity = capacity;
  }
  making->keys[making->n_keys++] = key;
  return MO_OK;
}

/* Keeps the chosen set if it is a body. */
static int see(struct making *making)
{
  const struct box *box = &making->boxes[making->n];
  const int32_t dx = box->high[0] - box->low[0], dy = box->high[1] - box->low[1];
  uint64_t bits[MO_DEFAULT_WORDS] = {0}, form[MO_DEFAULT_WORDS];
  uint32_t voxels[MO_ATLAS_VOXELS_MAX];
  /* The image with x and y swapped has the smaller dimensions, and fits. */
  if (dx > dy && dx < making->side[1] && dy < making->side[0])
    return MO_OK;
  for (uint32_t i = 0; i < making->n; i++) {
    const int32_t *at = making->list[making->chosen[i]];
    const int32_t column = (at[0] - box->low[0]) * making->side[1] + at[1] - box->low[1];
    const uint32_t voxel = (uint32_t)(column * making->side[2] + at[2] - box->low[2]);
    bits[voxel >> 6] |= UINT64_C(1) << (voxel & 63);
  }
  mo_genotype_canonical(making->workspace, bits, form);
  if (memcmp(form, bits, making->words * sizeof(uint64_t)) != 0)
    return MO_OK;
  (void)mo_atlas_voxels_of(making->workspace, bits, voxels);
  return keep(making, mo_atlas_key_of(making->sets, voxels, making->n));
}

/* Level d chooses cell d. At each level, next[d] is the index to be tried next, and ends[d] the
 * length of the list that the level chooses from. */
static int make_all(struct making *making, const int32_t first[3])
{
  uint32_t next[MO_ATLAS_VOXELS_MAX + 1] = {0}, ends[MO_ATLAS_VOXELS_MAX + 1] = {1};
  uint32_t d = 0;
  int error = MO_OK;
  memcpy(making->list[0], first, sizeof(making->list[0]));
  memcpy(making->boxes[0].low, first, sizeof(making->list[0]));
  memcpy(making->boxes[0].high, first, sizeof(making->list[0]));
  while (error == MO_OK) {
    if (d == making->n || next[d] == ends[d]) {
      if (d == making->n)
        error = see(making);
      if (d == 0)
        break;
      d--;
      forget(making, ends[d], ends[d + 1]);
      continue;
    }
    const uint32_t i = next[d]++;
    if (!extend(making, &making->boxes[d], making->list[i], &making->boxes[d + 1]))
      continue;
    making->chosen[d] = i;
    ends[d + 1] = d + 1 < making->n ? meet(making, making->list[i], ends[d]) : ends[d];
    next[d + 1] = i + 1;
    d++;
  }
  return error;
}

/* Sorts the keys into an array that has no room for more. */
static int sort_keys(struct making *making)
{
  const uint64_t last = making->sets->of[making->sets->voxels][making->n];
  unsigned bytes = 0;
  if (making->n_keys == 0)
    return MO_OK;
  while (bytes < 8 && last >> 8 * bytes > 0)
    bytes++;
  uint64_t *sorted = malloc(making->n_keys * sizeof(*sorted));
  if (sorted == NULL)
    return MO_ERR_NO_MEMORY;
  memcpy(sorted, making->keys, making->n_keys * sizeof(*sorted));
  mo_atlas_sort(sorted, making->keys, making->n_keys, bytes);
  free(making->keys);
  making->keys = sorted;
  return MO_OK;
}

int mo_atlas_keys_find(struct mo_workspace workspace, const struct mo_atlas_sets *sets, uint32_t n,
                       uint64_t **keys, uint64_t *n_keys)
{
  struct making making = {.workspace = workspace,
                          .sets = sets,
                          .n = n,
                          .words = mo_workspace_words(workspace),
                          .side = {workspace.nx, workspace.ny, workspace.nz}};
  for (int axis = 0; axis < 3; axis++)
    making.cells[axis] = axis == 0 ? making.side[0] : 2 * making.side[axis] - 1;
  const int32_t first[3] = {0, making.side[1] - 1, making.side[2] - 1};
  const int32_t cells[3] = {making.cells[0], making.cells[1], making.cells[2]};
  making.met = calloc((size_t)cells[0] * (size_t)cells[1], (size_t)cells[2]);
  if (making.met == NULL)
    return MO_ERR_NO_MEMORY;
  memset(making.met, 1, cell_of(&making, first) + 1);
  int error = make_all(&making, first);
  free(making.met);
  if (error == MO_OK)
    error = sort_keys(&making);
  if (error != MO_OK) {
    free(making.keys);
    return error;
  }
  *keys = making.keys;
  *n_keys = making.n_keys;
  return MO_OK;
}
