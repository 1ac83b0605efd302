/* atlas.h: the atlas: all bodies of at most ten voxels, and files with the scores of all of them.
 *
 * A scope is a workspace and a largest number of voxels. Its bodies are the canonical forms of at
 * most that many voxels that fit the workspace, each once, in a fixed order: by size, and then by
 * id, largest first. A body's place in this order, from 0, is its position. In the workspace of 6 ×
 * 6 × 4 voxels there are 1, 2, 5, 21, 95, 530, 3168, 20313, 133961 and 899126 bodies of 1 to 10
 * voxels. docs/atlas.md describes the file format and defines all queries.
 *
 * Forms are words of the scope's workspace (morphospace.h). Scores are mean losses: lower is
 * better. */
#ifndef MORPHO_ATLAS_H
#define MORPHO_ATLAS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>
#include <morpho/measure.h>
#include <morpho/morphospace.h>
#include <morpho/world.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_ATLAS_VOXELS_MAX       10
#define MO_ATLAS_WORKSPACE_MAX    (64 * MO_DEFAULT_WORDS) /* voxels of a workspace */
#define MO_ATLAS_ENVIRONMENTS_MAX 64
#define MO_ATLAS_FINGERPRINT      64 /* bytes, with the NUL */

struct mo_atlas_scope {
  struct mo_workspace workspace; /* at most MO_ATLAS_WORKSPACE_MAX voxels */
  uint32_t voxels_max;           /* 1 … MO_ATLAS_VOXELS_MAX */
};
/* MO_ERR_RANGE or MO_ERR_LIMIT; message (nullable) says what to change. */
int mo_atlas_scope_check(const struct mo_atlas_scope *scope, struct mo_message *message);

/* ---- all bodies ---- */

/* A stream of all bodies of a scope, in order. It holds the keys of one size at a time, 8 bytes per
 * body: 7 MB for ten voxels, and three times as much while it finds them. It finds the bodies of a
 * size when the first of them is needed; all ten sizes take a few seconds. Not for concurrent
 * use. */
struct mo_atlas_bodies;
int mo_atlas_bodies_create(const struct mo_atlas_scope *scope, struct mo_atlas_bodies **bodies);
void mo_atlas_bodies_free(struct mo_atlas_bodies *bodies); /* NULL-safe */
/* Writes the next form. MO_ERR_EXHAUSTED after the last; MO_ERR_NO_MEMORY. */
int mo_atlas_bodies_next(struct mo_atlas_bodies *bodies, uint64_t *form);
/* Moves to a position, which may be the one after the last body. MO_ERR_RANGE: beyond that;
 * MO_ERR_NO_MEMORY: the stream has not moved. */
int mo_atlas_bodies_seek(struct mo_atlas_bodies *bodies, uint64_t position);
/* Counts the bodies of 1, 2, … voxels; 0 for sizes above the scope's. Finds all of them if they
 * were not found before. MO_ERR_NO_MEMORY. */
int mo_atlas_bodies_count(struct mo_atlas_bodies *bodies, uint64_t counts[MO_ATLAS_VOXELS_MAX]);

/* ---- files ---- */

enum mo_atlas_orientations {
  MO_ATLAS_CANONICAL = 0, /* a body has the score of its canonical form */
  MO_ATLAS_IMAGES = 1     /* the mean over its distinct images that fit the workspace */
};
extern const char *const mo_atlas_orientation_words[]; /* "canonical", "images", NULL */

/* Writes the placed designs that are scored for a body: one, or its distinct images in the order of
 * their orientations (mo_genotype_robot). Returns their number, at most 8. */
uint32_t mo_atlas_designs(const struct mo_atlas_scope *scope, const uint64_t *form,
                          enum mo_atlas_orientations orientations,
                          struct mo_bits designs[MO_ORIENTATIONS]);

/* What the losses and measures of a file depend on, in addition to the environments. */
struct mo_atlas_source {
  struct mo_atlas_scope scope;
  enum mo_atlas_orientations orientations;
  uint8_t controller_sha256[32];
  uint8_t physics_sha256[32];
  uint32_t measures; /* stored besides the losses: bit k for measure k; 0: none, and the file has
                        version 1 */
  char fingerprint[MO_ATLAS_FINGERPRINT]; /* of the code that computed the losses: printable ASCII;
                                             "": unknown */
};

/* Writes a file, body by body in order. Until the file is complete, its name is PATH.part. If the
 * process or the machine stops, a new writer of the same path continues after the last whole block,
 * or after the last body that mo_atlas_writer_save has saved, which are durable. The same source,
 * environments and losses give the same bytes. Not for concurrent use. */
struct mo_atlas_writer;
/* environments: (n). Finds all bodies of the scope first, to count them. MO_ERR_CONFLICT: PATH
 * exists, or PATH.part belongs to a different atlas; MO_ERR_BUSY: another writer has it open;
 * MO_ERR_RANGE, MO_ERR_INVALID, MO_ERR_LIMIT, MO_ERR_NO_SPACE, MO_ERR_NO_MEMORY, MO_ERR_IO. */
int mo_atlas_writer_create(const char *path, const struct mo_atlas_source *source,
                           const struct mo_environment *environments, uint32_t n,
                           struct mo_atlas_writer **writer, struct mo_message *message);
/* Closes the files; NULL-safe. An unfinished PATH.part stays. */
void mo_atlas_writer_free(struct mo_atlas_writer *writer);
uint64_t mo_atlas_writer_position(const struct mo_atlas_writer *writer); /* the next body */
uint64_t mo_atlas_writer_bodies(const struct mo_atlas_writer *writer);   /* in all */
/* Adds the next body. form: its form, as a check (MO_ERR_CONFLICT: the next body is a different
 * one, and nothing was added). losses: (n environments), with `images`, the means over the images;
 * finite or +infinity (MO_ERR_INVALID: nothing was added). measures: those of the source, in the
 * order of enum mo_measure, as means over the environments; finite as float32, or NaN without a
 * value (MO_ERR_INVALID); not read if the source has none. MO_ERR_NO_SPACE, MO_ERR_NO_MEMORY:
 * nothing was added; try again later. After MO_ERR_IO, free the writer; a new one continues. */
int mo_atlas_writer_add(struct mo_atlas_writer *writer, const uint64_t *form, const double *losses,
                        const double *measures);
/* Makes all added bodies durable now, instead of block by block. Overwrites the saved part of the
 * last block: if the write is torn, or fails with MO_ERR_NO_SPACE, that part is lost from the file.
 * MO_ERR_NO_SPACE, MO_ERR_NO_MEMORY: try again. MO_ERR_IO: as for mo_atlas_writer_add. */
int mo_atlas_writer_save(struct mo_atlas_writer *writer);
/* Completes the file durably. MO_ERR_INVALID: bodies are missing; MO_ERR_CONFLICT: PATH now exists,
 * and was not touched; remove it and call again. Otherwise as for mo_atlas_writer_add: after such
 * an error, PATH may be the complete file, but its name may not survive a power failure. */
int mo_atlas_writer_finish(struct mo_atlas_writer *writer, struct mo_message *message);

/* A file, mapped read-only. Const after it is opened: any number of threads may use it. The file
 * must not be changed as long as it is open, unless a copy is mapped. */
struct mo_atlas;
/* Reads the whole file once, to check it. MO_ERR_NOT_FOUND; MO_ERR_FORMAT: not an atlas;
 * MO_ERR_UNSUPPORTED: a different version or byte order; MO_ERR_CORRUPT: truncated, altered or
 * unsorted; MO_ERR_IO: it cannot be read, or is not a file; MO_ERR_NO_MEMORY. */
int mo_atlas_open(const char *path, struct mo_atlas **atlas, struct mo_message *message);
/* The same, but maps a copy of the file without a name, in a folder: the file may then be changed
 * or truncated, which otherwise ends the process (SIGBUS). If the copy cannot be made, for example
 * for lack of space, or if the folder is NULL, the file itself is mapped. */
int mo_atlas_open_copy(const char *path, const char *folder, struct mo_atlas **atlas,
                       struct mo_message *message);
void mo_atlas_close(struct mo_atlas *atlas); /* NULL-safe */

const struct mo_atlas_source *mo_atlas_source_of(const struct mo_atlas *atlas);
/* Returns the environments; *n: their number. */
const struct mo_environment *mo_atlas_environments(const struct mo_atlas *atlas, uint32_t *n);
uint64_t mo_atlas_bodies_of(const struct mo_atlas *atlas); /* in all */
/* Computes the SHA-256 of the whole file. */
void mo_atlas_hash(const struct mo_atlas *atlas, uint8_t sha256[32]);
/* Returns the number of bodies of n_voxels voxels; *first (nullable): the position of the first. */
uint64_t mo_atlas_size(const struct mo_atlas *atlas, uint32_t n_voxels, uint64_t *first);

/* Finds a body in any place and orientation. MO_ERR_NOT_FOUND: it is not in the scope. */
int mo_atlas_find(const struct mo_atlas *atlas, const uint64_t *bits, uint64_t *position);
/* For positions below mo_atlas_bodies_of. form: words of the workspace. Returns the voxels. */
uint32_t mo_atlas_form(const struct mo_atlas *atlas, uint64_t position, uint64_t *form);
/* Returns the mean loss over the environments: that of float64, rounded to float32. */
float mo_atlas_score(const struct mo_atlas *atlas, uint64_t position);
/* losses: (n environments), with 11 significant bits each; finite ones are at most 65504. */
void mo_atlas_losses(const struct mo_atlas *atlas, uint64_t position, float *losses);
/* Returns the mean of a measure over the environments: that of float64, rounded to float32. NaN: a
 * rollout has no value, for example because it diverged, or the file does not have the measure. */
float mo_atlas_measure(const struct mo_atlas *atlas, uint64_t position, enum mo_measure measure);
/* Returns the percentage of the other bodies of the same size that have a lower measure; bodies
 * without a value are left out, and equal ones count half. 100 if there are no others, NaN if the
 * body has no value. Reads the measure of every body of that size: 0.2 ms for 899,126 bodies. */
double mo_atlas_measure_percentile(const struct mo_atlas *atlas, uint64_t position,
                                   enum mo_measure measure);

/* ---- neighbors ---- */

/* Bodies that differ by one voxel. A move takes a voxel from a body that stays in one piece without
 * it, and adds it elsewhere. */
enum mo_atlas_step { MO_ATLAS_ADD = 1, MO_ATLAS_REMOVE = 2, MO_ATLAS_MOVE = 4 };
#define MO_ATLAS_GROW_SHRINK   (MO_ATLAS_ADD | MO_ATLAS_REMOVE)
#define MO_ATLAS_NEIGHBORS_MAX 512

struct mo_atlas_neighbor {
  uint64_t position;
  float score;
  enum mo_atlas_step step; /* from the body to its neighbor */
};
/* Writes the distinct neighbors that a body reaches by these steps (of enum mo_atlas_step),
 * excluding the body itself: best score first, ties by lowest position. Neighbors outside the scope
 * are left out. Returns their number. */
uint32_t mo_atlas_neighbors(const struct mo_atlas *atlas, uint64_t position, unsigned steps,
                            struct mo_atlas_neighbor neighbors[MO_ATLAS_NEIGHBORS_MAX]);
/* Finds the neighbor to which the score improves most: the first of these neighbors, if its score
 * is lower than the body's. MO_ERR_NOT_FOUND: the body is a local optimum. */
int mo_atlas_best_step(const struct mo_atlas *atlas, uint64_t position, unsigned steps,
                       struct mo_atlas_neighbor *neighbor);
/* Follows the best steps from a body to a local optimum: steepest ascent. path: (max) receives the
 * first bodies of the path, which begins with `position`. Returns the number of bodies on the whole
 * path; *optimum: the last. */
uint64_t mo_atlas_ascend(const struct mo_atlas *atlas, uint64_t position, unsigned steps,
                         uint64_t *path, uint64_t max, uint64_t *optimum);

/* ---- ranks ---- */

/* All positions sorted by score, ties by lowest position, over all sizes and for each size. Takes 8
 * bytes of memory per body. Const after it is made; does not outlive the atlas. */
struct mo_atlas_index;
int mo_atlas_index_create(const struct mo_atlas *atlas, struct mo_atlas_index **index);
/* The same, but sorted by a measure in the file, lowest first, or by its negative value, so that
 * the highest comes first. All functions of an index then use that number instead of the score.
 * Bodies without a value come last, are in no bin of a histogram, and must not be ranked.
 * MO_ERR_NOT_FOUND: the file does not have the measure; MO_ERR_NO_MEMORY. */
int mo_atlas_index_create_by(const struct mo_atlas *atlas, enum mo_measure measure,
                             bool is_negative, struct mo_atlas_index **index);
void mo_atlas_index_free(struct mo_atlas_index *index); /* NULL-safe */

/* In the functions below, n_voxels 0 stands for all sizes. */

struct mo_atlas_rank {
  uint64_t better, equal, worse; /* bodies with lower, equal (excluding itself) and higher scores */
  double percentile; /* percentage of the other bodies that are worse, with equal ones counted half;
                        100 if there are no others */
};
/* Ranks a body among all bodies or, with `within_size`, among those of the same size. Its rank is
 * `better` + 1. */
struct mo_atlas_rank mo_atlas_rank_of(const struct mo_atlas_index *index, uint64_t position,
                                      bool within_size);
/* Returns the position of the body at place i of the ranking; i is below the number of bodies, and
 * place 0 is the optimum. */
uint64_t mo_atlas_nth(const struct mo_atlas_index *index, uint32_t n_voxels, uint64_t i);
/* Writes the best bodies. Returns their number: `max`, or as many as there are. */
uint64_t mo_atlas_best(const struct mo_atlas_index *index, uint32_t n_voxels, uint64_t max,
                       uint64_t *positions);
/* Counts the bodies with edges[i] ≤ score < edges[i + 1]. edges: (n + 1), ascending. */
void mo_atlas_histogram(const struct mo_atlas_index *index, uint32_t n_voxels, const float *edges,
                        uint32_t n, uint64_t *counts);

/* The best body of each footprint: the number of voxel columns (x, y) with at least one voxel, as
 * in struct mo_design_size. Reads all bodies, in about a second. */
struct mo_atlas_footprint {
  uint64_t bodies;  /* with this footprint */
  uint64_t optimum; /* the best, if there are any */
};
void mo_atlas_footprints(const struct mo_atlas *atlas,
                         struct mo_atlas_footprint footprints[MO_ATLAS_VOXELS_MAX + 1]);

/* ---- basins ---- */

/* The local optimum at which steepest ascent by adding and removing voxels ends, for each body:
 * computed once, in a few seconds. Takes 8 bytes of memory per body. Const after it is made. */
struct mo_atlas_basins;
/* cancel (nullable): set to stop (MO_ERR_CANCELLED). MO_ERR_NO_MEMORY. */
int mo_atlas_basins_create(const struct mo_atlas *atlas, const struct mo_atlas_index *index,
                           const volatile int *cancel, struct mo_atlas_basins **basins);
void mo_atlas_basins_free(struct mo_atlas_basins *basins);      /* NULL-safe */
uint64_t mo_atlas_optima(const struct mo_atlas_basins *basins); /* total number of local optima */
/* Returns the local optimum that a body's ascent ends at. */
uint64_t mo_atlas_optimum_of(const struct mo_atlas_basins *basins, uint64_t position);
/* Returns the number of bodies whose ascent ends at this one, including itself; 0: no local
 * optimum. */
uint64_t mo_atlas_basin_of(const struct mo_atlas_basins *basins, uint64_t position);

#ifdef __cplusplus
}
#endif
#endif
