/* gradient_physics.h: the physics of one robot in float32, forwards and backwards: what
 * gradient_physics.inc defines, as static functions, for the instruction set that it is compiled
 * for.
 *
 * Vectors run along the masses of one robot. The lattice points of its bounding box are its
 * `sites`: layer by layer from the ground, each layer a dense grid, so that all springs of one
 * direction join sites that are a constant apart and a vector of springs is two contiguous loads:
 * no gathers. Sites without a mass stay where the lattice puts them, at rest, and are masked.
 *
 * The network sees none of that: sensors and activations come packed, without gaps, in an order of
 * the robot's own: sensors  [n_sensor_reals]  sensor k is that of body mass sensor_mass[k], k <
 * n_masses; the rest are 0 slots    [n_slot_reals]    slot k is body spring slot_spring[k], k <
 * n_springs; what comes after is ignored on the way in and 0 on the way out
 *
 * A state, n_state_reals: positions (3, sites), then velocities (3, sites). An adjoint, as large:
 * ∂loss/∂ a state.
 *
 * A step's record, n_record_reals, is what the way back needs of it besides the slots, in as few
 * bytes as it can be, because it goes to memory and back: positions at its start, (3,
 * n_sensor_reals) in the order of the sensors; which masses struck; and their velocities after
 * springs, drag and gravity but before contact. Positions x, y count from the world's centre, where
 * float32 is finest.
 *
 * All arrays of reals are 64-byte aligned. n_sensor_reals, n_slot_reals, n_sites, n_state_reals,
 * n_record_reals are multiples of 16. */
#ifndef MORPHO_ROLLOUT_GRADIENT_PHYSICS_H
#define MORPHO_ROLLOUT_GRADIENT_PHYSICS_H

#include "rollout/fast.h"
#include "rollout/vector.h"

#include <morpho/gradient.h>

#define PHYS_DIRECTIONS 9

/* Some lanes of a vector, whose numbers lie side by side where there are no gaps. */
struct phys_lanes {
  uint32_t mask;      /* bit l: lane l is one of them; 0: there are none */
  uint32_t first;     /* place of the first of them */
  uint8_t spread[16]; /* lane l's number is the spread[l]-th from there; any of them for a lane that
                         is not one of them */
  uint8_t collect[16]; /* the k-th number from there is that of lane collect[k]; any of them beyond
                          the last */
};

struct phys_robot {
  const struct mo_body *body;
  const struct mo_environment *environment;
  const struct mo_physics *physics;
  enum mo_sensor sensor;
  uint32_t n_masses, n_springs, n_sites, n_vectors; /* n_sites = n_vectors · MO_VL, at least */
  uint32_t n_sensor_reals, n_slot_reals;
  size_t n_state_reals, n_record_reals, n_velocity_reals, n_scratch_reals;
  const uint32_t *sensor_mass; /* (n_masses) */
  const uint32_t *slot_spring; /* (n_springs) */

  /* Its own. */
  uint32_t offset[PHYS_DIRECTIONS]; /* sites from the lower end of a spring to the upper */
  uint32_t halo;                    /* ≥ the largest offset, a multiple of MO_VL */
  const uint32_t *mass_site;        /* (n_masses) */
  const struct phys_lanes *present; /* (n_vectors) sites with a mass, and their sensors */
  const struct phys_lanes *tiles; /* (n_vectors, PHYS_DIRECTIONS) sites that are the lower end of a
                                     spring, and their slots */
  const uint32_t *
      arrivals; /* (n_vectors, PHYS_DIRECTIONS) bit l: lane l's site is the upper end of a spring */
  const REAL *cells;    /* (MO_CELLS, 4) the terrain, as in fast.h */
  const REAL *cell_top; /* (MO_CELLS) nothing of the cell is above */
  const REAL *start;    /* (3, n_sites) start positions */
  REAL light[3];        /* from the world's centre */
  REAL dt, keep, fall;  /* step; exp(−drag · dt); gravity · dt */
  REAL pull, actuation; /* dt · stiffness / mass; share of the rest length */
  REAL friction, friction_cap;
  REAL near[2], far[2], top; /* the robot was last seen between these cell coordinates; no terrain
                                there is above top */
  double guarded_start_m;    /* distance to the light at the start + MO_LOSS_GUARD_M */
  double com_start_m[3];
};

/* Bytes that phys_prepare needs for a body: a multiple of 64. */
static size_t phys_bytes(const struct mo_body *body);
/* Everything static about one robot. memory: phys_bytes, 64-byte aligned, the robot's until it is
 * done. Borrows the rest. The first fields of *robot then say how large its arrays are. */
static void phys_prepare(struct phys_robot *robot, const struct mo_body *body,
                         const struct mo_environment *environment, const struct mo_physics *physics,
                         enum mo_sensor sensor, void *memory);

/* Asks the memory for what a step, either way, will read of the robot itself. */
static void phys_fetch(const struct phys_robot *robot);

/* ---- forwards ---- */

/* The start; the outcome's com_start_m, the rest of it 0. */
static void phys_start(const struct phys_robot *robot, REAL *state, struct mo_outcome *outcome);
/* Begins the record of the step that starts from a state. */
static void phys_keep(const struct phys_robot *robot, const REAL *state, REAL *record);
/* Light at each mass less the mean over all, at the start of the step of `record`. */
static void phys_sense(const struct phys_robot *robot, const REAL *record, REAL *sensors);
/* One step with the activations `slots` (tanh's results). Completes the record that phys_keep has
 * begun and replaces the state. False: the rollout diverged, as in mo_rollout_reference, and the
 * state's positions are those before the step. scratch: n_scratch_reals, may be shared by robots
 * (of the largest need); nothing is kept there between calls. */
static bool phys_step(struct phys_robot *robot, REAL *record, const REAL *slots, REAL *state,
                      REAL *scratch);
/* The outcome of a rollout that ended with `state`: com_end_m and loss; outcome->diverged_step is
 * set before. */
static void phys_finish(const struct phys_robot *robot, const REAL *state,
                        struct mo_outcome *outcome);

/* ---- backwards ---- */

/* ∂loss/∂ the final state, with its centre of mass there, of which x and y count; times `weight`.
 */
static void phys_back_start(const struct phys_robot *robot, const double *com_m, double weight,
                            REAL *adjoint);
/* Measures the adjoint of the state after the step of `record` (*m: mo_gradient_counts.largest) and
 * takes it back into the bound by the rule; *clipped says whether it had to be. False: it is not
 * finite. */
static bool phys_limit(const struct phys_robot *robot, const struct mo_gradient_options *options,
                       const REAL *record, REAL *adjoint, double *m, bool *clipped);
/* From the adjoint of the state after the step of `record` to that of the state before it, but for
 * what goes through the activations: that is in d_slots then. */
static void phys_step_back(const struct phys_robot *robot, const REAL *record, const REAL *slots,
                           REAL *adjoint, REAL *d_slots, REAL *scratch);
/* Adds what goes through the sensors at the start of the step; d_sensors from n_masses on is
 * ignored. */
static void phys_sense_back(const struct phys_robot *robot, const REAL *record,
                            const REAL *d_sensors, REAL *adjoint);

#endif
