/* neighbors.c: the bodies that differ from a body by one voxel.
 *
 * A body is at most ten cells with small coordinates. Masks of ten bits show whether it stays in
 * one piece without a voxel, and only bodies that do are turned into genotypes, to look up their
 * canonical forms. A changed body may stick out of the workspace on any side and still fit when
 * moved or turned. */
#include "atlas/neighbors.h"

#include <stdlib.h>
#include <string.h>

#define CELLS_MAX (MO_ATLAS_VOXELS_MAX + 1)
#define ROOM_MAX  (6 * MO_ATLAS_VOXELS_MAX) /* free cells next to a body */

struct cells {
  uint32_t n;
  int32_t at[CELLS_MAX][3];
};

struct finding {
  const struct mo_atlas *atlas;
  struct mo_workspace workspace;
  uint64_t own_key; /* the body itself, which is not its own neighbor */
  uint32_t own_voxels;
  struct mo_atlas_change *changes;
  uint32_t n;
};

static bool is_next_to(const int32_t a[3], const int32_t b[3])
{
  return abs(a[0] - b[0]) + abs(a[1] - b[1]) + abs(a[2] - b[2]) == 1;
}

/* ---- one changed body ---- */

/* Writes the genotype of cells at the origin, turned if they fit only that way. Returns whether
 * they fit. */
static bool place(struct mo_workspace workspace, const struct cells *cells,
                  uint64_t bits[MO_DEFAULT_WORDS])
{
  int32_t low[3], high[3];
  memcpy(low, cells->at[0], sizeof(low));
  memcpy(high, cells->at[0], sizeof(high));
  for (uint32_t i = 1; i < cells->n; i++)
    for (int axis = 0; axis < 3; axis++) {
      low[axis] = cells->at[i][axis] < low[axis] ? cells->at[i][axis] : low[axis];
      high[axis] = cells->at[i][axis] > high[axis] ? cells->at[i][axis] : high[axis];
    }
  const int32_t dx = high[0] - low[0], dy = high[1] - low[1];
  const bool is_upright = dx < workspace.nx && dy < workspace.ny;
  if (high[2] - low[2] >= workspace.nz ||
      (!is_upright && (dy >= workspace.nx || dx >= workspace.ny)))
    return false;
  memset(bits, 0, MO_DEFAULT_WORDS * sizeof(*bits));
  for (uint32_t i = 0; i < cells->n; i++) {
    const int32_t x = cells->at[i][0] - low[0], y = cells->at[i][1] - low[1];
    const int32_t column = is_upright ? x * workspace.ny + y : y * workspace.ny + x;
    const uint32_t voxel = (uint32_t)(column * workspace.nz + cells->at[i][2] - low[2]);
    bits[voxel >> 6] |= UINT64_C(1) << (voxel & 63);
  }
  return true;
}

/* Adds a changed body, unless it does not fit, is the body itself or was found before. */
static void find(struct finding *finding, const struct cells *cells, enum mo_atlas_step step)
{
  uint64_t bits[MO_DEFAULT_WORDS], form[MO_DEFAULT_WORDS];
  uint32_t voxels[MO_ATLAS_VOXELS_MAX];
  if (cells->n > MO_ATLAS_VOXELS_MAX || !place(finding->workspace, cells, bits))
    return;
  mo_genotype_canonical(finding->workspace, bits, form);
  (void)mo_atlas_voxels_of(finding->workspace, form, voxels);
  const uint64_t key = mo_atlas_key_of(&finding->atlas->sets, voxels, cells->n);
  if (key == finding->own_key && cells->n == finding->own_voxels)
    return;
  for (uint32_t i = 0; i < finding->n; i++)
    if (finding->changes[i].key == key && finding->changes[i].n_voxels == cells->n)
      return;
  if (finding->n < MO_ATLAS_NEIGHBORS_MAX)
    finding->changes[finding->n++] =
        (struct mo_atlas_change){.key = key, .n_voxels = cells->n, .step = step};
}

/* ---- all changed bodies ---- */

/* Adds each free cell next to the cells in turn, except `never` (nullable). */
static void find_larger(struct finding *finding, const struct cells *cells, const int32_t *never,
                        enum mo_atlas_step step)
{
  int32_t room[ROOM_MAX][3];
  uint32_t n_room = 0;
  for (uint32_t i = 0; i < cells->n; i++)
    for (int direction = 0; direction < 6; direction++) {
      int32_t at[3];
      bool is_new = true;
      memcpy(at, cells->at[i], sizeof(at));
      at[direction / 2] += direction % 2 != 0 ? 1 : -1;
      for (uint32_t k = 0; k < cells->n && is_new; k++)
        is_new = memcmp(at, cells->at[k], sizeof(at)) != 0;
      for (uint32_t k = 0; k < n_room && is_new; k++)
        is_new = memcmp(at, room[k], sizeof(at)) != 0;
      if (is_new && (never == NULL || memcmp(at, never, sizeof(at)) != 0))
        memcpy(room[n_room++], at, sizeof(at));
    }
  struct cells larger = *cells;
  larger.n++;
  for (uint32_t i = 0; i < n_room; i++) {
    memcpy(larger.at[cells->n], room[i], sizeof(room[i]));
    find(finding, &larger, step);
  }
}

/* Returns whether the cells without cell `gone` are one piece. next_to[i]: the cells next to i, as
 * bits. */
static bool stays_whole(const uint32_t *next_to, uint32_t n, uint32_t gone)
{
  const uint32_t rest = ((UINT32_C(1) << n) - 1) & ~(UINT32_C(1) << gone);
  uint32_t reached = rest & -rest, before = 0;
  while (reached != before) {
    before = reached;
    for (uint32_t i = 0; i < n; i++)
      if (before >> i & 1)
        reached |= next_to[i] & rest;
  }
  return rest != 0 && reached == rest;
}

static void cells_of(const struct mo_atlas *atlas, uint64_t position, uint64_t *key,
                     struct cells *cells)
{
  const struct mo_workspace workspace = atlas->source.scope.workspace;
  uint32_t voxels[MO_ATLAS_VOXELS_MAX];
  cells->n = mo_atlas_key_at(atlas, position, key);
  mo_atlas_key_voxels(&atlas->sets, *key, cells->n, voxels);
  for (uint32_t i = 0; i < cells->n; i++) {
    cells->at[i][0] = (int32_t)(voxels[i] / workspace.nz / workspace.ny);
    cells->at[i][1] = (int32_t)(voxels[i] / workspace.nz % workspace.ny);
    cells->at[i][2] = (int32_t)(voxels[i] % workspace.nz);
  }
}

uint32_t mo_atlas_changes(const struct mo_atlas *atlas, uint64_t position, unsigned steps,
                          struct mo_atlas_change changes[MO_ATLAS_NEIGHBORS_MAX])
{
  struct finding finding = {
      .atlas = atlas, .workspace = atlas->source.scope.workspace, .changes = changes};
  uint32_t next_to[MO_ATLAS_VOXELS_MAX] = {0};
  struct cells cells = {0};
  cells_of(atlas, position, &finding.own_key, &cells);
  finding.own_voxels = cells.n;
  if (steps & MO_ATLAS_ADD)
    find_larger(&finding, &cells, NULL, MO_ATLAS_ADD);
  if ((steps & (MO_ATLAS_REMOVE | MO_ATLAS_MOVE)) == 0)
    return finding.n;
  for (uint32_t i = 0; i < cells.n; i++)
    for (uint32_t k = 0; k < cells.n; k++)
      next_to[i] |= (uint32_t)is_next_to(cells.at[i], cells.at[k]) << k;
  for (uint32_t gone = 0; gone < cells.n; gone++) {
    if (!stays_whole(next_to, cells.n, gone))
      continue;
    struct cells rest = cells;
    memcpy(rest.at[gone], cells.at[--rest.n], sizeof(rest.at[gone]));
    if (steps & MO_ATLAS_REMOVE)
      find(&finding, &rest, MO_ATLAS_REMOVE);
    if (steps & MO_ATLAS_MOVE)
      find_larger(&finding, &rest, cells.at[gone], MO_ATLAS_MOVE);
  }
  return finding.n;
}

/* ---- with scores ---- */

static int compare(const void *a, const void *b)
{
  const struct mo_atlas_neighbor *p = a, *q = b;
  return mo_atlas_is_before(p->score, p->position, q->score, q->position) ? -1 : 1;
}

uint32_t mo_atlas_neighbors(const struct mo_atlas *atlas, uint64_t position, unsigned steps,
                            struct mo_atlas_neighbor neighbors[MO_ATLAS_NEIGHBORS_MAX])
{
  struct mo_atlas_change changes[MO_ATLAS_NEIGHBORS_MAX];
  const uint32_t n_changes = mo_atlas_changes(atlas, position, steps, changes);
  uint32_t n = 0;
  for (uint32_t i = 0; i < n_changes; i++) {
    struct mo_atlas_neighbor *neighbor = &neighbors[n];
    if (mo_atlas_find_key(atlas, changes[i].n_voxels, changes[i].key, &neighbor->position) != MO_OK)
      continue;
    neighbor->score = mo_atlas_score(atlas, neighbor->position);
    neighbor->step = changes[i].step;
    n++;
  }
  qsort(neighbors, n, sizeof(*neighbors), compare);
  return n;
}

int mo_atlas_best_step(const struct mo_atlas *atlas, uint64_t position, unsigned steps,
                       struct mo_atlas_neighbor *neighbor)
{
  struct mo_atlas_neighbor neighbors[MO_ATLAS_NEIGHBORS_MAX];
  if (mo_atlas_neighbors(atlas, position, steps, neighbors) == 0 ||
      neighbors[0].score >= mo_atlas_score(atlas, position))
    return MO_ERR_NOT_FOUND;
  *neighbor = neighbors[0];
  return MO_OK;
}

uint64_t mo_atlas_ascend(const struct mo_atlas *atlas, uint64_t position, unsigned steps,
                         uint64_t *path, uint64_t max, uint64_t *optimum)
{
  struct mo_atlas_neighbor next = {.position = position};
  uint64_t n = 0;
  do {
    position = next.position;
    if (n < max)
      path[n] = position;
    n++;
  } while (mo_atlas_best_step(atlas, position, steps, &next) == MO_OK);
  *optimum = position;
  return n;
}
