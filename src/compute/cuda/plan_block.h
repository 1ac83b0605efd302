/* plan_block.h: the block of memory that the device reads the rows of a call from, as laid out by
 * plan.c. Plain C.
 *
 * Within a group the rows of one body are adjacent: they form a *part*. The output layer is
 * multiplied only for the springs of the group's bodies, eight pairs at a time: a *tile*. Each tile
 * records which of the group's columns (eight rows each) have any of its springs.
 *
 * A row's result does not depend on its group or its neighbors: the numbering of a body's masses,
 * and the order in which a mass adds up its springs, depend only on the body. */
#ifndef MORPHO_COMPUTE_CUDA_PLAN_BLOCK_H
#define MORPHO_COMPUTE_CUDA_PLAN_BLOCK_H

#include <stddef.h>
#include <stdint.h>

#include <morpho/gradient.h>

#include "compute/cuda/lane.cuh"

#define MO_PLAN_COLUMN      8 /* rows of a column: the width of a matrix instruction */
#define MO_PLAN_COLUMNS_MAX 10
#define MO_PLAN_ROWS_MAX    (MO_PLAN_COLUMN * MO_PLAN_COLUMNS_MAX)
#define MO_PLAN_TILE        8   /* pairs of springs per tile */
#define MO_PLAN_PAIRS       824 /* pairs of the lattice's 1648 springs */
#define MO_PLAN_PAIR_WORDS  26  /* words of 32 pairs */
#define MO_PLAN_EDGES       616 /* slots of edges; the slots of diagonals follow */
#define MO_PLAN_TILES_MAX   103 /* 824 / 8 */
#define MO_PLAN_INPUTS      256 /* places of inputs of the first layer, 11 of them unused */
#define MO_PLAN_LINKS       4   /* links that are read together */
#define MO_PLAN_DEGREES_MAX 18  /* springs of one mass */
#define MO_PLAN_NO_PAIR     0xffff

/* Springs are paired, so that one load fetches the weights of two: the two diagonals of a face (a
 * body has both or neither), and adjacent edges. Spring i of pair p has slot 2p + i. */

/* A body's masses are numbered in descending order of their number of springs, then as in mo_body.
 * A mass's links (a link is a spring seen from one end) are adjacent, in the order of the body's
 * springs, in sets of MO_PLAN_LINKS; the last set is padded with links to the mass itself. */
struct mo_plan_body {
  uint32_t n_masses, n_springs;
  uint32_t first_quad;       /* into links, in units of MO_PLAN_LINKS */
  uint32_t first_mass;       /* into masses and ranks */
  uint32_t n_slots, n_edges; /* the body's own slots, two for each pair with a spring of the body;
                                n_edges: slots of edges, which come first */
};
/* The pairs of a body, and their number before each word: the body's own slots of pair p are 2n and
 * 2n + 1, where n is the number of its pairs before p. */
struct mo_plan_pairs {
  uint32_t has[MO_PLAN_PAIR_WORDS];
  uint16_t before[MO_PLAN_PAIR_WORDS];
};
/* A link: the mass at the other end, and the spring's slot among the body's own. If a row of the
 * call has damage, also 1 + the spring's octant (rollout/damage.h), and only MO_PLAN_LINK_SLOT_OF
 * holds. */
#define MO_PLAN_LINK(slot, mass)   ((uint32_t)(slot) << 8 | (uint32_t)(mass))
#define MO_PLAN_LINK_MASS(link)    ((link)&0xffu)
#define MO_PLAN_LINK_SLOT(link)    ((link) >> 8)
#define MO_PLAN_LINK_SLOT_OF(link) ((link) >> 8 & 0xfffu)
#define MO_PLAN_LINK_PART(octant)  ((uint32_t)(1 + (octant)) << 20)
#define MO_PLAN_LINK_PART_OF(link) ((link) >> 20)

/* A mass: lattice coordinates; its number of links in units of MO_PLAN_LINKS, and their start. */
#define MO_PLAN_MASS(x, y, z, quads, quad)                                                         \
  ((uint32_t)(x) | (uint32_t)(y) << 4 | (uint32_t)(z) << 8 | (uint32_t)(quads) << 12 |             \
   (uint32_t)(quad) << 16)
#define MO_PLAN_MASS_X(mass)     ((mass)&15u)
#define MO_PLAN_MASS_Y(mass)     ((mass) >> 4 & 15u)
#define MO_PLAN_MASS_Z(mass)     ((mass) >> 8 & 15u)
#define MO_PLAN_MASS_QUADS(mass) ((mass) >> 12 & 15u)
#define MO_PLAN_MASS_QUAD(mass)  ((mass) >> 16)

struct mo_plan_row {
  uint32_t row;         /* its number in the call */
  uint32_t environment; /* index into the block's environments */
};

/* Rows of one body within a group. */
struct mo_plan_part {
  uint32_t body;
  uint16_t first_row, n_rows; /* among the group's rows */
  uint32_t first_place;       /* among the group's places: one per mass and row */
  uint32_t first_length;      /* among the group's lengths: one per own slot and row */
};

struct mo_plan_group {
  uint32_t first_row, n_rows, first_part, n_parts;
  uint32_t first_tile, n_tiles;
  uint32_t input_tiles; /* bit i: a mass of the group has its place in inputs 16 i … 16 i + 15 */
  uint32_t n_places;
  uint32_t n_lengths;
};

/* A tile of pairs; the group's last tile is padded with MO_PLAN_NO_PAIR. */
struct mo_plan_tile {
  uint16_t pair[MO_PLAN_TILE];
};

/* An environment as lanes read it; x, y from the world's center. */
struct mo_plan_scene {
  float light[3];
  float highest; /* slightly above the terrain, so that rounding in its polynomials never matters */
  float heights[MO_TERRAIN_HEIGHTS];
  struct lane_constants constants;
};
/* Additional constants for the integrator `split`, read where a mass strikes and in the first
 * step. */
struct mo_plan_split {
  struct lane_split_constants constants;
  float first_pull, first_fall, first_per_push; /* the first step's */
};
/* What only the kernels for special rows read (mo_environment_is_special). */
struct mo_plan_special {
  struct lane_cells cells;
  uint32_t cut;      /* as mo_damage.cut */
  uint32_t cut_step; /* the first step without these springs, or UINT32_MAX */
};
/* An environment with its heights and its drop in float64, for the start. */
struct mo_plan_environment {
  double heights_m[MO_TERRAIN_HEIGHTS];
  struct mo_plan_scene scene;
  struct mo_plan_split split;
  struct mo_plan_special special;
  double drop_m; /* mo_scene_drop_m */
};

/* The index of the device's mass m in a body's list of inputs: sixteen lanes sense a row, and the
 * masses l, l + 16, … of lane l are adjacent. */
#define MO_PLAN_INPUT_OF(m) ((m) % 16 * 16 + (m) / 16)

#endif
