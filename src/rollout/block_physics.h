/* block_physics.h: the physics of a block, as block_physics.inc is compiled for each instruction
 * set and width of vectors. Internal to this room. */
#ifndef MORPHO_ROLLOUT_BLOCK_PHYSICS_H
#define MORPHO_ROLLOUT_BLOCK_PHYSICS_H

#include "rollout/fast.h"

/* Data about the springs of a panel that measures need at the start of a control period. */
struct mo_observed_springs {
  const void *inverse_rests; /* (n) 1 / rest length */
  const void *means;         /* (n, lanes) mean of the new and the previous activations */
  const void *news;          /* (n, lanes) the new activations */
  void *squares;             /* (lanes) squares of the largest strains so far */
  void *pulls; /* (lanes) the sum over the springs of L0 (mean − new) (L − L0 (1 + actuation ·
                  mean)), where that is positive; times 2 · stiffness · actuation, it is the energy
                  that these springs gain */
};

/* intact: (n, lanes) 1, or 0 for a spring that exerts no force. */
typedef void mo_pull_function(const void *constants, uint32_t first_lane, uint32_t n,
                              const uint32_t *ends, const void *rests, const void *activations,
                              const void *positions, void *velocities,
                              const struct mo_observed_springs *observed, const void *intact);

/* The physics for one vector of lanes of a block. Positions, velocities and all other data with
 * lanes are arrays of the run's reals, starting at the first of these lanes. `constants`,
 * `terrain`: structs lane_block and lane_block_terrain of all lanes. */
struct mo_block_physics {
  uint32_t n_lanes;
  /* Computes the light at the masses, minus the body's mean. lights: (3, lanes). */
  void (*sense_light)(enum mo_sensor kind, uint32_t n_masses, const void *positions,
                      const void *lights, void *sensors);
  /* Computes n springs. activations: (n, lanes). `observed` and `intact` are unused. */
  mo_pull_function *pull_springs;
  /* Does the same, and observes the springs for the measures. */
  mo_pull_function *pull_observed_springs;
  /* Does the same for springs of which some may be cut; observed->squares NULL: observes
   * nothing. */
  mo_pull_function *pull_intact_springs;
  /* Moves all masses by one step. Returns the lanes whose state is no longer finite or valid.
   * used_lanes: the lanes in use. */
  uint32_t (*move)(const struct mo_fast_run *run, const void *constants, const void *terrain,
                   uint32_t first_lane, uint32_t used_lanes, const void *positions,
                   void *next_positions, void *velocities);
};
extern const struct mo_block_physics mo_physics_baseline_float_16, mo_physics_baseline_double_16;
extern const struct mo_block_physics mo_physics_avx2_float_16, mo_physics_avx2_double_16;
extern const struct mo_block_physics mo_physics_avx2_float_32, mo_physics_avx2_double_32;
extern const struct mo_block_physics mo_physics_avx512_float_16, mo_physics_avx512_double_16;
extern const struct mo_block_physics mo_physics_avx512_float_32, mo_physics_avx512_double_32;
extern const struct mo_block_physics mo_physics_avx512_float_64, mo_physics_avx512_double_64;

/* Returns the physics for the narrowest vectors that have n lanes, or for the widest ones. */
const struct mo_block_physics *mo_block_physics_find(enum mo_isa isa, enum mo_precision precision,
                                                     uint32_t n);

#endif
