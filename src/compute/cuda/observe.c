/* observe.c: see observe.h. */
#include "compute/cuda/observe.h"

#include "rollout/course.h"
#include "rollout/measuring.h"
#include "rollout/window.h"

#include <string.h>

void mo_observe_tables(const struct mo_body *body, const uint8_t *ranks, struct mo_plan_rest *rest,
                       struct mo_plan_corners *corners)
{
  double rows[MO_DEFAULT_MASSES][3];
  uint8_t halves[MO_DEFAULT_MASSES][2];
  mo_measuring_frame(body, rows);
  mo_measuring_halves(body, halves);
  for (uint32_t m = 0; m < body->n_masses; m++) {
    struct mo_plan_rest *to = rest + ranks[m];
    for (int axis = 0; axis < 3; axis++)
      to->row[axis] = (float)rows[m][axis];
    to->halves = halves[m][0] | (uint32_t)halves[m][1] << 2;
  }
  for (uint32_t v = 0; v < body->n_voxels; v++)
    for (uint32_t k = 0; k < 8; k++)
      corners[v].mass[k] = ranks[body->voxel_mass[8 * (size_t)v + k]];
}

void mo_observe_measures(const struct mo_observed_row *row, const struct mo_robot *robot,
                         const struct mo_physics *physics, const struct mo_outcome *outcome,
                         double observed[MO_MEASURES])
{
  struct mo_observer observer;
  const struct mo_window window = mo_window_of(&physics->scheme, NULL);
  mo_window_observer(&window, NULL, 0, robot->body, robot->environment, physics,
                     outcome->com_start_m, &observer);
  memcpy(observer.last.com_m, row->com_m, sizeof(row->com_m));
  memcpy(observer.last.turn, row->turn, sizeof(row->turn));
  observer.path_m = row->path_m;
  observer.height_sum_m = row->height_sum_m;
  observer.peak_height_m = row->peak_height_m;
  observer.turns = row->turns;
  observer.air_steps = row->air_steps;
  observer.hops = row->hops;
  observer.contacts = row->contacts;
  observer.front_2 = row->front_2;
  observer.left_2 = row->left_2;
  observer.work_j = 0.5 * observer.constants.stiffness_n_per_m * row->energy_m2;
  observer.strain = (double)row->strain;
  observer.inverted = row->inverted;
  mo_observer_finish(&observer, outcome->diverged_step != 0, row->up, observed);
}

void mo_observe_finish(const struct mo_track *track, const double *observed,
                       const struct mo_robot *robot, const struct mo_physics *physics,
                       struct mo_outcome *outcome)
{
  const struct mo_observed known = {.work_j = observed != NULL ? observed[MO_MEASURE_WORK] : 0,
                                    .measures = observed};
  struct mo_course course;
  struct mo_track start;
  mo_course_begin(&course, robot->environment, &physics->scheme, outcome->com_start_m, &start);
  mo_course_finish(&course, track, &known, outcome);
}
