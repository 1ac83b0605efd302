/* atlas.h: the atlas: all bodies of at most ten voxels, and files with the scores of all of them.
 *
 * A class of bodies is a workspace and a largest number of voxels. Its bodies are the canonical
 * forms of those sizes that fit the workspace, each once, in a fixed order: by size, and then by
 * id, the largest first. A body's place in this order, from 0, is its position. In the workspace of
 * 6 × 6 × 4 voxels there are 1, 2, 5, 21, 95, 530, 3168, 20313, 133961 and 899126 bodies of 1 to 10
 * voxels. docs/atlas.md has the file format and the definitions of all queries.
 *
 * Forms are words of the class's workspace (morphospace.h). Scores are mean losses: lower is
 * better. */
#ifndef MORPHO_ATLAS_H
#define MORPHO_ATLAS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>
#include <morpho/morphospace.h>
#include <morpho/world.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_ATLAS_VOXELS_MAX       10
#define MO_ATLAS_WORKSPACE_MAX    (64 * MO_DEFAULT_WORDS) /* voxels of a workspace */
#define MO_ATLAS_ENVIRONMENTS_MAX 64
#define MO_ATLAS_FINGERPRINT      64 /* bytes, with the NUL */

struct mo_atlas_class {
  struct mo_workspace workspace; /* at most MO_ATLAS_WORKSPACE_MAX voxels */
  uint32_t voxels_max;           /* 1 … MO_ATLAS_VOXELS_MAX */
};
/* MO_ERR_RANGE or MO_ERR_LIMIT; message (nullable) says what to do. */
int mo_atlas_class_check(const struct mo_atlas_class *class, struct mo_message *message);

/* ---- all bodies ---- */

/* A stream of all bodies of a class, in order. It holds the keys of one size at a time, 8 bytes per
 * body: 7 MB for ten voxels, and three times as much while it finds them. It finds the bodies of a
 * size when the first of them is needed; all ten sizes take a few seconds. Not for concurrent
 * use. */
struct mo_atlas_bodies;
int mo_atlas_bodies_create(const struct mo_atlas_class *class, struct mo_atlas_bodies **bodies);
void mo_atlas_bodies_free(struct mo_atlas_bodies *bodies); /* NULL-safe */
/* Writes the next form. MO_ERR_EXHAUSTED after the last; MO_ERR_NO_MEMORY. */
int mo_atlas_bodies_next(struct mo_atlas_bodies *bodies, uint64_t *form);
/* Continues at a position; that after the last body is allowed. MO_ERR_RANGE: beyond that;
 * MO_ERR_NO_MEMORY: the stream is where it was. */
int mo_atlas_bodies_seek(struct mo_atlas_bodies *bodies, uint64_t position);
/* Counts the bodies of 1, 2, … voxels; 0 for sizes above the class's. Finds all of them if they
 * were not found before. MO_ERR_NO_MEMORY. */
int mo_atlas_bodies_count(struct mo_atlas_bodies *bodies, uint64_t counts[MO_ATLAS_VOXELS_MAX]);

// PART2
#ifdef __cplusplus
}
#endif
#endif
