/* observe.h: what a device observes of a row for its measures (morpho/measure.h) and for tasks that
 * depend on measures, and the tables that it reads for that. Plain C.
 *
 * The device adds up; the host computes the measures from the sums, with rollout/measuring.h.
 * docs/model.md defines the instants and the measures. */
#ifndef MORPHO_COMPUTE_CUDA_OBSERVE_H
#define MORPHO_COMPUTE_CUDA_OBSERVE_H

#include <stdint.h>

#include <morpho/gradient.h> /* struct mo_robot */
#include <morpho/measure.h>

#ifdef __cplusplus
extern "C" {
#endif

/* A mass at rest, in the device's order of a body's masses (plan_block.h). */
struct mo_plan_rest {
  float row[3];    /* of the pseudo-inverse (mo_measuring_frame) */
  uint32_t halves; /* front | left << 2: 2, 1 or 0 each (mo_measuring_halves) */
};

/* The masses at the corners of a voxel, in the device's order, as mo_body.voxel_mass. */
struct mo_plan_corners {
  uint8_t mass[8];
};

/* A body's voxels among the corners of all bodies. */
struct mo_plan_voxels {
  uint32_t first, n;
};

/* Words of one bit per voxel. */
#define MO_PLAN_VOXEL_WORDS ((MO_DEFAULT_VOXELS + 31) / 32)

/* A row's sums, as struct mo_observer has them. */
struct mo_observed_row {
  double com_m[3], turn[2]; /* at the last instant */
  double up[3];             /* at the end */
  double path_m, height_sum_m, peak_height_m;
  double energy_m2; /* sum over instants and springs of max(after² − before², 0), where before and
                       after are the spring's elongations with the old and the new outputs */
  float strain;
  int32_t turns;
  uint32_t air_steps, hops, touches; /* touches: in the last step */
  uint32_t contacts, front_2, left_2;
  uint32_t inverted, unused;
};

struct mo_track; /* rollout/course.h */

/* Fills the tables of a body. ranks: the device's number of each mass; rest (n_masses); corners
 * (n_voxels). */
void mo_observe_tables(const struct mo_body *body, const uint8_t *ranks, struct mo_plan_rest *rest,
                       struct mo_plan_corners *corners);

/* Computes all measures of a row without rounding; NaN if it diverged. outcome: of this row. */
void mo_observe_measures(const struct mo_observed_row *row, const struct mo_robot *robot,
                         const struct mo_physics *physics, const struct mo_outcome *outcome,
                         double observed[MO_MEASURES]);

/* Sets loss and value of a row whose task has a tally, from its track at the end. observed: as
 * above, or NULL if the task needs none of it. */
void mo_observe_finish(const struct mo_track *track, const double *observed,
                       const struct mo_robot *robot, const struct mo_physics *physics,
                       struct mo_outcome *outcome);

#ifdef __cplusplus
}
#endif
#endif
