/* bodies.c: scopes, the stream of all bodies of a scope, and the designs of a body. */
#include "atlas/bodies.h"

#include "atlas/keys.h"
#include "morphospace/grid.h"

#include <stdlib.h>
#include <string.h>

int mo_atlas_scope_check(const struct mo_atlas_scope *scope, struct mo_message *message)
{
  const int error = mo_workspace_check(scope->workspace);
  if (error == MO_ERR_RANGE)
    return mo_fail(message, error, "each side of the workspace must be at least 1");
  if (error != MO_OK || mo_workspace_voxels(scope->workspace) > MO_ATLAS_WORKSPACE_MAX)
    return mo_fail(message, MO_ERR_LIMIT, "the workspace must have at most %d voxels",
                   MO_ATLAS_WORKSPACE_MAX);
  if (scope->voxels_max < 1 || scope->voxels_max > MO_ATLAS_VOXELS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "voxels_max must be at least 1 and at most %d, got %u",
                   MO_ATLAS_VOXELS_MAX, scope->voxels_max);
  return MO_OK;
}

struct mo_atlas_bodies {
  struct mo_atlas_scope scope;
  struct mo_atlas_sets sets;
  uint32_t n_voxels;                    /* the size whose keys are held; 0: none yet */
  uint32_t n_counted;                   /* sizes 1 … n_counted were counted */
  uint64_t counts[MO_ATLAS_VOXELS_MAX]; /* of those sizes */
  uint64_t *keys;                       /* (counts[n_voxels − 1]) */
  uint64_t at;                          /* the next key */
};

int mo_atlas_bodies_create(const struct mo_atlas_scope *scope, struct mo_atlas_bodies **bodies)
{
  const int error = mo_atlas_scope_check(scope, NULL);
  if (error != MO_OK)
    return error;
  struct mo_atlas_bodies *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->scope = *scope;
  mo_atlas_sets_fill(scope->workspace, &made->sets);
  *bodies = made;
  return MO_OK;
}

void mo_atlas_bodies_free(struct mo_atlas_bodies *bodies)
{
  if (bodies == NULL)
    return;
  free(bodies->keys);
  free(bodies);
}

/* Switches to the keys of a different size. */
static int turn_to(struct mo_atlas_bodies *bodies, uint32_t n_voxels)
{
  uint64_t *keys = NULL;
  uint64_t n = 0;
  const int error = mo_atlas_keys_find(bodies->scope.workspace, &bodies->sets, n_voxels, &keys, &n);
  if (error != MO_OK)
    return error;
  free(bodies->keys);
  bodies->keys = keys;
  bodies->n_voxels = n_voxels;
  bodies->counts[n_voxels - 1] = n;
  if (bodies->n_counted < n_voxels)
    bodies->n_counted = n_voxels;
  bodies->at = 0;
  return MO_OK;
}

int mo_atlas_bodies_next_key(struct mo_atlas_bodies *bodies, uint32_t *n_voxels, uint64_t *key)
{
  while (bodies->n_voxels == 0 || bodies->at == bodies->counts[bodies->n_voxels - 1]) {
    if (bodies->n_voxels == bodies->scope.voxels_max)
      return MO_ERR_EXHAUSTED;
    const int error = turn_to(bodies, bodies->n_voxels + 1);
    if (error != MO_OK)
      return error;
  }
  *n_voxels = bodies->n_voxels;
  *key = bodies->keys[bodies->at++];
  return MO_OK;
}

int mo_atlas_bodies_next(struct mo_atlas_bodies *bodies, uint64_t *form)
{
  uint32_t n_voxels = 0, voxels[MO_ATLAS_VOXELS_MAX];
  uint64_t key = 0;
  const int error = mo_atlas_bodies_next_key(bodies, &n_voxels, &key);
  if (error != MO_OK)
    return error;
  mo_atlas_key_voxels(&bodies->sets, key, n_voxels, voxels);
  mo_atlas_bits_of(bodies->scope.workspace, voxels, n_voxels, form);
  return MO_OK;
}

/* Counts size n. Its keys replace those that the stream holds only if the caller needs them. */
static int count(struct mo_atlas_bodies *bodies, uint32_t n)
{
  uint64_t *keys = NULL;
  if (n <= bodies->n_counted)
    return MO_OK;
  const int error =
      mo_atlas_keys_find(bodies->scope.workspace, &bodies->sets, n, &keys, &bodies->counts[n - 1]);
  if (error != MO_OK)
    return error;
  free(keys);
  bodies->n_counted = n;
  return MO_OK;
}

int mo_atlas_bodies_seek(struct mo_atlas_bodies *bodies, uint64_t position)
{
  uint64_t before = 0; /* bodies of smaller sizes */
  for (uint32_t n = 1; n <= bodies->scope.voxels_max; n++) {
    int error = count(bodies, n);
    const uint64_t its = bodies->counts[n - 1];
    if (error == MO_OK && (position < before + its || n == bodies->scope.voxels_max)) {
      if (position > before + its)
        return MO_ERR_RANGE;
      if (n != bodies->n_voxels)
        error = turn_to(bodies, n);
      if (error == MO_OK)
        bodies->at = position - before;
      return error;
    }
    if (error != MO_OK)
      return error;
    before += its;
  }
  return MO_ERR_RANGE;
}

int mo_atlas_bodies_count(struct mo_atlas_bodies *bodies, uint64_t counts[MO_ATLAS_VOXELS_MAX])
{
  for (uint32_t n = 1; n <= bodies->scope.voxels_max; n++) {
    const int error = count(bodies, n);
    if (error != MO_OK)
      return error;
  }
  memset(counts, 0, MO_ATLAS_VOXELS_MAX * sizeof(*counts));
  memcpy(counts, bodies->counts, bodies->scope.voxels_max * sizeof(*counts));
  return MO_OK;
}

uint32_t mo_atlas_designs(const struct mo_atlas_scope *scope, const uint64_t *form,
                          enum mo_atlas_orientations orientations,
                          struct mo_bits designs[MO_ORIENTATIONS])
{
  const uint32_t words = mo_workspace_words(scope->workspace);
  const unsigned images = orientations == MO_ATLAS_IMAGES ? MO_ORIENTATIONS : 1;
  uint32_t n = 0;
  for (unsigned k = 0; k < images; k++) {
    struct mo_bits *design = &designs[n];
    uint32_t same = 0;
    memset(design, 0, sizeof(*design));
    if (mo_shape_image(scope->workspace, form, k, design->words) != MO_OK)
      continue;
    mo_genotype_place(scope->workspace, design->words);
    while (same < n && memcmp(designs[same].words, design->words, words * sizeof(uint64_t)) != 0)
      same++;
    n += same == n;
  }
  return n;
}
