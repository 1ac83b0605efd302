/* measuring.h: the measures of one rollout, from what the reference and the CPU kernels observe:
 * sums in float64, and the measures computed from them. docs/model.md defines the measures.
 * Internal to this room.
 *
 * The control periods that start at t_0 = 0, t_1, …, t_{K−1}, and the end, t_K, are the instants.
 */
#ifndef MORPHO_ROLLOUT_MEASURING_H
#define MORPHO_ROLLOUT_MEASURING_H

#include <morpho/rollout.h>

/* What has to be observed for a set of measures, as bits. */
enum {
  MO_OBSERVE_MOTION = 1,   /* struct mo_pose at the instants */
  MO_OBSERVE_AIR = 2,      /* in each step: does the body touch the terrain? */
  MO_OBSERVE_CONTACTS = 4, /* in the first step of each period: the masses that touch it */
  MO_OBSERVE_SPRINGS = 8,  /* lengths and outputs at the start of each period */
  MO_OBSERVE_VOXELS = 16   /* corners at the start of each period */
};
unsigned mo_observations(uint32_t set);
/* The same for a task, and for measures (nullable). */
unsigned mo_observations_for(const struct mo_task *task, const struct mo_measuring *measuring);

/* The part of a body's state at an instant from which its motion is measured. */
struct mo_pose {
  double com_m[3];
  double turn[2]; /* F_xx + F_yy and F_yx − F_xy, where F is the linear map that takes the body at
                     rest nearest to its masses (mo_measuring_frame) */
};

struct mo_observer {
  const struct mo_body *body;
  const struct mo_environment *environment;
  struct mo_constants constants;
  double duration_s;
  uint32_t n_steps, n_periods;
  double light_xy_m[2]; /* at the start */
  double start_m[3];    /* center of mass */
  double start_turn[2]; /* of the pose */
  struct mo_pose last;
  double path_m, height_sum_m, peak_height_m;
  int64_t turns; /* whole turns to the left since the start, counted when the yaw passes π */
  uint64_t air_steps, hops;
  uint64_t contacts;        /* in the first steps of the periods */
  uint64_t front_2, left_2; /* twice the number of them in these halves */
  double work_j;
  double strain;
  uint32_t inverted;
};

/* Begins with the start of the rollout, t_0. Borrows body and environment. */
void mo_observer_begin(struct mo_observer *observer, const struct mo_body *body,
                       const struct mo_environment *environment, const struct mo_physics *physics,
                       const double com_start_m[3], const double light_xy_m[2]);

/* Sets the pose at the start, instead of the assumed pose of a body at rest. */
void mo_observer_pose(struct mo_observer *observer, const struct mo_pose *pose);

/* Continues to an instant after the start. */
void mo_observe(struct mo_observer *observer, const struct mo_pose *pose);

/* Writes all measures, without rounding; those that were not observed are undefined. up: F_xz,
 * F_yz, F_zz at the end. */
void mo_observer_finish(const struct mo_observer *observer, bool diverged, const double up[3],
                        double observed[MO_MEASURES]);
/* Rounds the measures in the set; the others become NaN. */
void mo_measures_round(uint32_t set, const double observed[MO_MEASURES],
                       double values[MO_MEASURES]);

/* Computes each mass's row of the pseudo-inverse of the masses at rest, (n_masses, 3): the sum over
 * the masses of position ⊗ row is F. Rows sum to 0, so the origin of the positions does not
 * matter. */
void mo_measuring_frame(const struct mo_body *body, double (*rows)[3]);

/* Writes for each mass 2, 1 or 0: in the front half of the body at rest, on the line between the
 * halves, in the back half; and the same for left and right. */
void mo_measuring_halves(const struct mo_body *body, uint8_t (*halves)[2]);

#endif
