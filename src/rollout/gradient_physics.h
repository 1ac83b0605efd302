/* gradient_physics.h: the physics of one robot in float32, forward and backward: the static
 * functions that gradient_physics.inc defines for the instruction set it is compiled for.
 *
 * Vectors run along the masses of one robot. The lattice points of its bounding box are its
 * `sites`: layer by layer from the ground, each layer a dense grid. So all springs of one direction
 * join sites at a constant distance, and a vector of springs is two contiguous loads: no gathers.
 * Sites without a mass stay at rest at their lattice position and are masked.
 *
 * The network uses other arrays: sensors and activations are packed without gaps, in the robot's
 * own order.
 *   sensors  [n_sensor_reals]  sensor k is that of body mass sensor_mass[k], k < n_masses;
 *                              the rest are 0
 *   slots    [n_slot_reals]    slot k is body spring slot_spring[k], k < n_springs; the rest are
 *                              ignored as input and 0 as output
 *
 * A state, n_state_reals: positions (3, sites), then velocities (3, sites). An adjoint, of the same
 * size: ∂loss/∂ a state.
 *
 * A step's record, n_record_reals, is what its backward step needs besides the slots. It is as
 * small as possible, because it goes to memory and back: positions at the start, (3,
 * n_sensor_reals) in the order of the sensors; which masses struck; and their velocities after
 * springs, drag and gravity but before contact. Positions x, y count from the world's center, where
 * float32 is finest.
 *
 * All arrays of reals are 64-byte aligned. n_sensor_reals, n_slot_reals, n_sites, n_state_reals,
 * n_record_reals are multiples of 16. */
#ifndef MORPHO_ROLLOUT_GRADIENT_PHYSICS_H
#define MORPHO_ROLLOUT_GRADIENT_PHYSICS_H

#include "rollout/vector.inc"

#include "rollout/lane_adjoint.inc"

#include <morpho/gradient.h>

#define PHYS_DIRECTIONS 9

/* A subset of the lanes of a vector, whose numbers are stored side by side without gaps. */
struct phys_lanes {
  uint32_t mask;       /* bit l: lane l is in the subset; 0: empty */
  uint32_t first;      /* index of the first number */
  uint8_t spread[16];  /* lane l's number is at first + spread[l]; for other lanes any number of the
                          subset */
  uint8_t collect[16]; /* number first + k belongs to lane collect[k]; beyond the last any lane */
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

  /* Private. */
  uint32_t offset[PHYS_DIRECTIONS]; /* sites from the lower end of a spring to the upper */
  uint32_t halo;                    /* ≥ the largest offset, a multiple of MO_VL */
  const uint32_t *mass_site;        /* (n_masses) */
  const struct phys_lanes *present; /* (n_vectors) sites with a mass, and their sensors */
  const struct phys_lanes *tiles; /* (n_vectors, PHYS_DIRECTIONS) sites that are the lower end of a
                                     spring, and their slots */
  const uint32_t *
      arrivals; /* (n_vectors, PHYS_DIRECTIONS) bit l: lane l's site is the upper end of a spring */
  const REAL *cells;        /* (MO_CELLS, 4) the terrain, as in fast.h */
  const REAL *cell_top;     /* (MO_CELLS) upper bound of the height in a cell */
  const REAL *start;        /* (3, n_sites) start positions */
  REAL light[3];            /* from the world's center */
  struct lane_physics lane; /* `physics` */
  REAL near[2], far[2],
      top; /* cell coordinates that last enclosed the robot; no terrain there is above top */
  double guarded_start_m; /* distance to the light at the start + MO_LOSS_GUARD_M */
  double com_start_m[3];
};

/* Bytes that phys_prepare needs for a body: a multiple of 64. */
static size_t phys_bytes(const struct mo_body *body);
/* Prepares everything static about one robot. memory: phys_bytes, 64-byte aligned, in use as long
 * as the robot. Borrows the rest. The first fields of *robot then give the sizes of its arrays. */
static void phys_prepare(struct phys_robot *robot, const struct mo_body *body,
                         const struct mo_environment *environment, const struct mo_physics *physics,
                         enum mo_sensor sensor, void *memory);

/* Prefetches the robot's own data that a step reads, forward or backward. */
static void phys_fetch(const struct phys_robot *robot);

/* ---- forwards ---- */

/* Sets the initial state and the outcome's com_start_m; the rest of the outcome is 0. */
static void phys_start(const struct phys_robot *robot, REAL *state, struct mo_outcome *outcome);
/* Begins the record of the step that starts from a state. */
static void phys_keep(const struct phys_robot *robot, const REAL *state, REAL *record);
/* Computes the light at each mass, minus the mean over all, at the start of the step of
 * `record`. */
static void phys_sense(const struct phys_robot *robot, const REAL *record, REAL *sensors);
/* Runs one step with the activations `slots` (tanh's results). Completes the record that phys_keep
 * began and replaces the state. False: the rollout diverged, as in mo_rollout_reference, and the
 * state's positions are those before the step. scratch: n_scratch_reals of the largest robot, may
 * be shared; holds nothing between calls. */
static bool phys_step(struct phys_robot *robot, REAL *record, const REAL *slots, REAL *state,
                      REAL *scratch);
/* Completes the outcome of a rollout that ended with `state`: com_end_m and loss;
 * outcome->diverged_step is already set. */
static void phys_finish(const struct phys_robot *robot, const REAL *state,
                        struct mo_outcome *outcome);

/* ---- backwards ---- */

/* Computes ∂loss/∂ the final state, whose center of mass is com_m, of which only x and y count;
 * times `weight`. */
static void phys_back_start(const struct phys_robot *robot, const double *com_m, double weight,
                            REAL *adjoint);
/* Measures the adjoint of the state after the step of `record` (*m: mo_gradient_counts.largest) and
 * limits it to the bound by the rule; *clipped: it was above. False: it is not finite. */
static bool phys_limit(const struct phys_robot *robot, const struct mo_gradient_options *options,
                       const REAL *record, REAL *adjoint, double *m, bool *clipped);
/* Turns the adjoint of the state after the step of `record` into that of the state before it,
 * without the part through the activations, which goes to d_slots. */
static void phys_step_back(const struct phys_robot *robot, const REAL *record, const REAL *slots,
                           REAL *adjoint, REAL *d_slots, REAL *scratch);
/* Adds the part through the sensors at the start of the step; ignores d_sensors from n_masses
 * on. */
static void phys_sense_back(const struct phys_robot *robot, const REAL *record,
                            const REAL *d_sensors, REAL *adjoint);

#endif
