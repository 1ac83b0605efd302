/* plan_block.h: the rows of a call as the device reads them: what plan.c lays out in one block of
 * memory. Plain C.
 *
 * Within a group the rows of one body stand together: they are a *part*. The output layer is
 * multiplied only for the springs of the group's bodies, eight pairs at a time: a *tile*. Each tile
 * says which of the group's columns (eight rows each) have any of its springs.
 *
 * Nothing that a row's result depends on differs with its group or its neighbors: a body's masses
 * and the order in which a mass adds its springs up follow from the body alone. */
#ifndef MORPHO_COMPUTE_CUDA_PLAN_BLOCK_H
#define MORPHO_COMPUTE_CUDA_PLAN_BLOCK_H

#include <stddef.h>
#include <stdint.h>

#include <morpho/gradient.h>

#define MO_PLAN_COLUMN      8 /* rows of a column: the width of a matrix instruction */
#define MO_PLAN_COLUMNS_MAX 10
#define MO_PLAN_ROWS_MAX    (MO_PLAN_COLUMN * MO_PLAN_COLUMNS_MAX)
#define MO_PLAN_TILE        8   /* pairs of springs of a tile */
#define MO_PLAN_PAIRS       824 /* of the lattice's 1648 springs */
#define MO_PLAN_PAIR_WORDS  26  /* of 32 pairs */
#define MO_PLAN_EDGES       616 /* slots of edges; those of diagonals follow */
#define MO_PLAN_TILES_MAX   103 /* 824 / 8 */
#define MO_PLAN_INPUTS                                                                             \
  256 /* places of the first layer's inputs: 245 masses and 11 that stay empty */
#define MO_PLAN_LINKS       4  /* links that are read at once */
#define MO_PLAN_DEGREES_MAX 18 /* springs of one mass */
#define MO_PLAN_NO_PAIR     0xffff

/* Springs go in pairs, so that one load brings weights of two: the two diagonals of a face, which a
 * body has both or neither, and edges that lie side by side. Spring i of pair p has slot 2p + i. */

/* A body's masses are numbered by falling number of springs, then as in mo_body. A mass's links (a
 * spring as one of its ends sees it) stand together, in the order of the body's springs,
 * MO_PLAN_LINKS at a time; what is left of the last ones are links to itself. */
struct mo_plan_body {
  uint32_t n_masses, n_springs;
  uint32_t first_quad,
      first_mass;            /* into links, in units of MO_PLAN_LINKS; into masses and ranks */
  uint32_t n_slots, n_edges; /* slots of its own, two for each pair that it has a spring of; of
                                edges, which come first */
};
/* Which pairs a body has, and how many there are before each word of them: the body's own slots of
 * pair p are 2n and 2n + 1, n the number of its pairs before p. */
struct mo_plan_pairs {
  uint32_t has[MO_PLAN_PAIR_WORDS];
  uint16_t before[MO_PLAN_PAIR_WORDS];
};
/* A link: the mass at the other end, and the spring's slot among the body's own. */
#define MO_PLAN_LINK(slot, mass) ((uint32_t)(slot) << 8 | (uint32_t)(mass))
#define MO_PLAN_LINK_MASS(link)  ((link)&0xffu)
#define MO_PLAN_LINK_SLOT(link)  ((link) >> 8)

/* A mass: lattice coordinates, and where its links start and how many times MO_PLAN_LINKS there
 * are. */
#define MO_PLAN_MASS(x, y, z, quads, quad)                                                         \
  ((uint32_t)(x) | (uint32_t)(y) << 4 | (uint32_t)(z) << 8 | (uint32_t)(quads) << 12 |             \
   (uint32_t)(quad) << 16)
#define MO_PLAN_MASS_X(mass)     ((mass)&15u)
#define MO_PLAN_MASS_Y(mass)     ((mass) >> 4 & 15u)
#define MO_PLAN_MASS_Z(mass)     ((mass) >> 8 & 15u)
#define MO_PLAN_MASS_QUADS(mass) ((mass) >> 12 & 15u)
#define MO_PLAN_MASS_QUAD(mass)  ((mass) >> 16)

struct mo_plan_row {
  uint32_t row;         /* the caller's number of it */
  uint32_t environment; /* into the block's environments */
};

/* Rows of one body within a group. */
struct mo_plan_part {
  uint32_t body;
  uint16_t first_row, n_rows; /* of the group's rows */
  uint32_t first_place;       /* of the group's places: one per mass and row */
  uint32_t first_length;      /* of the group's lengths: one per own slot and row */
};

struct mo_plan_group {
  uint32_t first_row, n_rows, first_part, n_parts;
  uint32_t first_tile, n_tiles;
  uint32_t input_tiles; /* bit i: a mass of the group has its place among inputs 16 i … 16 i + 15 */
  uint32_t n_places;
  uint32_t n_lengths;
};

/* A tile of pairs; the group's last one ends in MO_PLAN_NO_PAIR. */
struct mo_plan_tile {
  uint16_t pair[MO_PLAN_TILE];
};

/* An environment as lanes read it; x, y from the world's center. */
struct mo_plan_scene {
  float light[3];
  float highest; /* a little above the terrain, so that rounding in its polynomials never counts */
  float heights[MO_TERRAIN_HEIGHTS];
};
/* And with its heights in float64, for the start. */
struct mo_plan_environment {
  double heights_m[MO_TERRAIN_HEIGHTS];
  struct mo_plan_scene scene;
};

/* Where what lies in the block: offsets in bytes, each a multiple of 256. */
struct mo_plan_block {
  size_t environments; /* struct mo_plan_environment (n_environments) */
  size_t bodies;       /* struct mo_plan_body (n_bodies) */
  size_t pairs;        /* struct mo_plan_pairs (n_bodies) */
  size_t links;        /* uint32_t (…, MO_PLAN_LINKS) */
  size_t masses;       /* uint32_t (all bodies' masses) */
  size_t ranks;        /* uint8_t (likewise): the device's number of the body's mass i */
  size_t inputs;  /* uint8_t (n_bodies, MO_PLAN_INPUTS): at MO_PLAN_INPUT_OF, place of the mass's
                     sensor among the first layer's inputs */
  size_t groups;  /* struct mo_plan_group (n_groups) */
  size_t parts;   /* struct mo_plan_part */
  size_t rows;    /* struct mo_plan_row (n) */
  size_t tiles;   /* struct mo_plan_tile (n_groups, MO_PLAN_TILES_MAX) */
  size_t columns; /* uint16_t (n_groups, MO_PLAN_TILES_MAX): bit c: column c has one of the tile's
                     springs */
  size_t bytes;
};

/* Where a body's list of inputs has the device's mass m: sixteen lanes sense a row, of which lane l
 * has masses l, l + 16, … side by side. */
#define MO_PLAN_INPUT_OF(m) ((m) % 16 * 16 + (m) / 16)

#endif
