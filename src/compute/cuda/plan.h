/* plan.h: lays out rows (a robot in an environment each) for the device. Plain C, no CUDA.
 *
 * Rows are divided into groups of at most MO_PLAN_ROWS_MAX; a group is simulated entirely in one
 * thread block. Each body and each environment of the rows is laid out once. The device reads one
 * block of memory (struct mo_plan_block has the offsets). */
#ifndef MORPHO_COMPUTE_CUDA_PLAN_H
#define MORPHO_COMPUTE_CUDA_PLAN_H

#include "compute/cuda/observe.h"
#include "compute/cuda/plan_block.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Offsets in the block in bytes, each a multiple of 256. */
struct mo_plan_block {
  size_t environments; /* struct mo_plan_environment (n_environments) */
  size_t bodies;       /* struct mo_plan_body (n_bodies) */
  size_t pairs;        /* struct mo_plan_pairs (n_bodies) */
  size_t links;        /* uint32_t (…, MO_PLAN_LINKS) */
  size_t masses;       /* uint32_t (all bodies' masses) */
  size_t ranks;        /* uint8_t (all bodies' masses): the device's number of the body's mass i */
  size_t inputs;       /* uint8_t (n_bodies, MO_PLAN_INPUTS): at MO_PLAN_INPUT_OF, the place of the
                          mass's sensor in the first layer's inputs */
  size_t groups;       /* struct mo_plan_group (n_groups) */
  size_t parts;        /* struct mo_plan_part */
  size_t rows;         /* struct mo_plan_row (n) */
  size_t tiles;        /* struct mo_plan_tile (n_groups, MO_PLAN_TILES_MAX) */
  size_t columns; /* uint16_t (n_groups, MO_PLAN_TILES_MAX): bit c: column c has one of the tile's
                     springs */
  size_t tasks;   /* struct mo_environment (n_environments), as course.cuh reads them; none if no
                     row is special */
  /* None if rows are not observed (observe.h). */
  size_t rest;    /* struct mo_plan_rest (all bodies' masses) */
  size_t voxels;  /* struct mo_plan_voxels (n_bodies) */
  size_t corners; /* struct mo_plan_corners (all bodies' voxels) */
  size_t bytes;
};

struct mo_plan_options {
  uint32_t rows;       /* desired rows per group, 1 … MO_PLAN_ROWS_MAX */
  size_t group_bytes;  /* memory of a group, which the sizes below, times their counts, must not
                          exceed */
  size_t column_bytes; /* of the activations of eight rows */
  size_t part_bytes;
  size_t place_bytes;  /* of one mass in one row */
  size_t length_bytes; /* of one of a body's own slots in one row */
};

struct mo_plan {
  uint32_t n, n_bodies, n_environments, n_groups, n_parts;
  bool is_special; /* some environment is, or rows are observed */
  bool observes;   /* the block has the tables of observe.h */
  bool has_tally;  /* some environment's task has one (course.cuh) */
  bool has_damage; /* some environment cuts springs */
  struct mo_plan_block block;
  /* The plan's own memory, one allocation. */
  void *memory;
  const struct mo_robot *robots;
  const struct mo_physics *physics;
  const struct mo_body **bodies;              /* (n_bodies), in the order of their rows */
  const struct mo_environment **environments; /* (n_environments) */
  struct mo_plan_body *headers;               /* (n_bodies) */
  struct mo_plan_pairs *pairs;                /* (n_bodies) */
  uint16_t *slots;                            /* (1648) of each spring of the lattice */
  struct mo_plan_group *groups;
  struct mo_plan_part *parts;
  struct mo_plan_row *rows;
  /* Passed from one function to the next: bodies in the order of appearance, and their numbers by
   * row. */
  const struct mo_body **found;
  struct mo_plan_body *measured;
  struct mo_plan_pairs *measured_pairs;
  uint32_t *body_of, *environment_of; /* (n) */
  uint32_t *rows_of_body, *number;
  uint64_t *keys; /* (n_bodies): sort keys of bodies */
};

/* Call in this order: mo_plan_create, mo_plan_measure, mo_plan_cut, mo_plan_fill. `robots`,
 * everything they point to and `physics` must stay valid until the plan is freed. It may also be
 * freed after an error. */

/* Finds the distinct bodies and environments (by address). observes: rows are observed even if no
 * task needs it. MO_ERR_UNSUPPORTED: a body of a
 * workspace other than the default; MO_ERR_NO_MEMORY. */
int mo_plan_create(struct mo_plan *plan, const struct mo_robot *robots, uint32_t n,
                   const struct mo_physics *physics, bool observes);
void mo_plan_free(struct mo_plan *plan);

/* Measures the bodies, on up to n_threads threads. */
void mo_plan_measure(struct mo_plan *plan, uint32_t n_threads);

/* Cuts the rows into groups. MO_ERR_UNSUPPORTED: a single body does not fit in group_bytes;
 * MO_ERR_NO_MEMORY. */
int mo_plan_cut(struct mo_plan *plan, const struct mo_plan_options *options);

/* Writes the block, 8-byte aligned and plan->block.bytes long, on up to n_threads threads. */
void mo_plan_fill(const struct mo_plan *plan, void *block, uint32_t n_threads);

/* Returns the lattice mass with its sensor at place `input` of the first layer's inputs, or −1.
 * Every sixteen places hold masses that tend to be used together. The masses in the middle of the
 * lattice's floor come first. */
int mo_plan_input_mass(uint32_t input);

struct mo_plan_scene mo_plan_scene_of(const struct mo_environment *environment,
                                      const struct mo_physics *physics);
struct mo_plan_split mo_plan_split_of(const struct mo_environment *environment,
                                      const struct mo_physics *physics);
struct mo_plan_special mo_plan_special_of(const struct mo_environment *environment,
                                          const struct mo_physics *physics);

/* Returns whether an environment needs the kernels for special rows: it has a task that is not
 * plain, a profile, or damage. All others compute only grids with a light that stands still. */
bool mo_environment_is_special(const struct mo_environment *environment);

/* Writes the slots of the lattice's springs (1648). MO_ERR_NO_MEMORY. */
int mo_plan_slots(uint16_t *slots);

#ifdef __cplusplus
}
#endif
#endif
