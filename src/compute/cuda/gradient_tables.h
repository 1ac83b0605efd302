/* gradient_tables.h: the tables that the device reads a batch of robots from, for their gradient. C
 * and CUDA.
 *
 * The batch is divided into shards of consecutive robots, and a shard into groups of 32 or 16 rows
 * (a row is a robot in its environment), larger bodies first; if sixteen large bodies exceed a
 * block's shared memory, some rows stay empty. A group belongs to one thread block of sixteen
 * warps. Warp w simulates rows w and w + 16 of its group, as one body: a *pair*. A lane takes a
 * mass and adds up its springs, each of which is computed from both ends, so that no two lanes
 * write the same number. Masses are taken in descending order of their number of springs, 32 at a
 * time. The springs of 32 masses form *chunks*: chunk n has the n-th spring of each mass.
 *
 * If a device has enough multiprocessors, two blocks can compute a group of 32 rows: each has half
 * of the pairs, with two warps per pair. Sums that the kernels take over rows are always formed by
 * *halves*, pairs 0 … 7 and 8 … 15, so that the bits are the same in both cases.
 *
 * The last layer is multiplied only for the *tiles* of sixteen springs that some row of the group
 * has; the first layer for all inputs, because groups lack too few to be worth skipping. The layout
 * of a shard depends only on its robots. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_TABLES_H
#define MORPHO_COMPUTE_CUDA_GRADIENT_TABLES_H

#include <stddef.h>
#include <stdint.h>

#include "compute/cuda/course.cuh"
#include "compute/cuda/plan_block.h"
#include "rollout/objective.inc"

enum {
  MO_GP_WARPS = 16,
  MO_GP_LANES = 32,
  MO_GP_ROWS_MAX = 32,
  MO_GP_HALF_ROWS = 16,
  MO_GP_NORM_FLOATS = MO_HIDDEN_LAYERS * 2 * MO_HIDDEN, /* sums of a half over its rows */
  MO_GP_TILE = 16,
  MO_GP_INPUTS = 256,       /* 245 masses, 5 generators, 6 unused places */
  MO_GP_OUTPUT_TILES = 103, /* 1648 springs */
  MO_GP_NONE = 0xff
};
#define MO_GP_NO_ROBOT UINT32_MAX

/* A spring of one of a pair's masses: that mass and the mass at the other end, the index among the
 * group's outputs, the row, whether it is a diagonal, and whether it is in the last chunk of these
 * 32 masses. A mass with fewer springs than the first of the 32 is padded with springs to itself,
 * which have no effect; lanes without a mass have MO_GP_NO_MASS. */
#define MO_GP_SPRING(own, other, output, row, diagonal)                                            \
  ((uint32_t)(diagonal) << 30 | (uint32_t)(row) << 29 | (uint32_t)(output) << 18 |                 \
   (uint32_t)(other) << 9 | (uint32_t)(own))
#define MO_GP_SPRING_LAST        (UINT32_C(1) << 31)
#define MO_GP_SPRING_OWN(s)      ((s)&0x1ffu)
#define MO_GP_SPRING_OTHER(s)    ((s) >> 9 & 0x1ffu)
#define MO_GP_SPRING_OUTPUT(s)   ((s) >> 18 & 0x7ffu)
#define MO_GP_SPRING_ROW(s)      ((s) >> 29 & 1u)
#define MO_GP_SPRING_DIAGONAL(s) ((s) >> 30 & 1u)
#define MO_GP_NO_MASS            0x1ffu

struct mo_gp_pair {
  uint32_t first_mass;            /* index among the group's masses */
  uint32_t n_masses[2];           /* of row w and of row w + 16 */
  uint32_t first_chunk, n_chunks; /* indices among the group's chunks */
  uint32_t split;                 /* how many of them belong to the first of two warps */
};

struct mo_gp_group {
  uint32_t n_rows;    /* 32 or 16 */
  uint32_t first_row; /* among all rows */
  uint32_t shard;
  uint32_t n_masses, n_chunks;
  uint32_t n_outputs;               /* tiles */
  uint64_t first_mass, first_chunk; /* among the masses of all groups */
  uint64_t tape_at,
      sum_at; /* bytes from the start of the tape; floats from the start of the sums */
  uint8_t output_tile[MO_GP_OUTPUT_TILES + 1], output_place[MO_GP_OUTPUT_TILES + 1];
  struct mo_gp_pair pair[MO_GP_WARPS];
};

struct mo_gp_row {
  double light_m[2]; /* from the world's center */
  struct mo_goal goal;
  struct mo_plan_scene scene;
  struct mo_plan_split split;
  uint32_t robot; /* index in the batch; MO_GP_NO_ROBOT: an empty row */
  uint32_t n_masses;
};

/* What rows of a batch have if some of them are special (plan.h). With a task, the row's own light
 * and distances do not apply, but goal.scale_m is that of the course. */
struct mo_gp_course {
  struct mo_plan_special special;
  bool is_plain; /* the task is; nothing else is set */
  struct mo_environment environment;
  struct mo_course course; /* its environment is not set: it is the one above */
  struct mo_track start;   /* at the start of the rollout */
  bool works;              /* the task needs the work of the springs */
  double stiffness_n_per_m;
};

#endif
