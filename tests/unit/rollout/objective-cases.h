/* objective-cases.h: environments for the objectives `efficient` and `jump`, and for sums. */
#ifndef MORPHO_TESTS_OBJECTIVE_CASES_H
#define MORPHO_TESTS_OBJECTIVE_CASES_H

#include <morpho/rollout.h>
#include <morpho/world.h>

#define OBJECTIVE_CASES 12
#define SMOOTH_CASES    11 /* the first of them have a gradient */

#define OF(measure) (MO_TERM_MEASURE + MO_MEASURE_##measure)

/* Returns whether a task is, or has as a term, `efficient`. */
static inline bool is_efficient(const struct mo_task *task)
{
  bool is = task->objective == MO_OBJECTIVE_EFFICIENT;
  for (uint32_t i = 0; i < task->n_terms; i++)
    is = is || task->terms[i] == MO_OBJECTIVE_EFFICIENT;
  return is;
}

/* Lets bodies slide down their ground if the task is `efficient`, so that they are soon farther
 * from their start than its floor. */
static inline void make_slippery(const struct mo_environment *environment,
                                 struct mo_physics *physics)
{
  if (!is_efficient(&environment->task))
    return;
  physics->constants.friction = 0.5;
  physics->constants.drag_per_s = 6;
}

/* Gives an environment task number k, and ground that falls along x. */
static inline void set_objective(struct mo_environment *environment, uint32_t k)
{
  static const struct mo_guide fixed = {.kind = MO_GUIDE_FIXED};
  static const struct mo_guide line = {.kind = MO_GUIDE_MOVING, .velocity_m_per_s = {0.3, -0.2}};
  static const struct mo_guide circle = {
      .kind = MO_GUIDE_MOVING, .turn_rad_per_s = 1.3, .center_m = {2.6, 2.4}};
  static const struct mo_guide ahead = {
      .kind = MO_GUIDE_AHEAD, .heading_rad = 0.7, .distance_m = 1.5};
  static const struct mo_guide turning = {
      .kind = MO_GUIDE_TURNING, .heading_rad = -2, .turn_rad_per_s = 1.57, .distance_m = 0.8};
  static const struct mo_guide path = {
      .kind = MO_GUIDE_PATH, .n_points = 2, .points_m = {{2.9, 2.6}, {4, 4}}, .distance_m = 0.5};
  static const struct {
    const struct mo_guide *guide;
    enum mo_objective objective;
    uint32_t n, terms[MO_TERMS_MAX];
    double weights[MO_TERMS_MAX];
  } cases[OBJECTIVE_CASES] = {
      {&ahead, MO_OBJECTIVE_JUMP, 0, {0}, {0}},
      {&fixed, MO_OBJECTIVE_JUMP, 0, {0}, {0}},
      {&turning, MO_OBJECTIVE_EFFICIENT, 0, {0}, {0}},
      {&path, MO_OBJECTIVE_EFFICIENT, 0, {0}, {0}},
      {&circle,
       MO_OBJECTIVE_SUM,
       5,
       {MO_OBJECTIVE_REACH, MO_OBJECTIVE_PURSUE, MO_OBJECTIVE_JUMP, OF(MEAN_SPEED),
        OF(STRAIGHTNESS)},
       {-0.5, 1, 1, 0.2, 0.7}},
      {&ahead, MO_OBJECTIVE_SUM, 2, {MO_OBJECTIVE_TRAVEL, OF(WORK)}, {1, -1e-4}},
      {&fixed,
       MO_OBJECTIVE_SUM,
       4,
       {MO_OBJECTIVE_REACH, MO_OBJECTIVE_APPROACH, MO_OBJECTIVE_CLIMB, OF(DISPLACEMENT)},
       {1, 0.5, 2, -0.3}},
      {&path,
       MO_OBJECTIVE_SUM,
       4,
       {MO_OBJECTIVE_FOLLOW, MO_OBJECTIVE_EFFICIENT, OF(PATH_LENGTH), OF(MEAN_HEIGHT)},
       {1, 0.2, -0.4, 3}},
      {&line, MO_OBJECTIVE_EFFICIENT, 0, {0}, {0}},
      {&turning,
       MO_OBJECTIVE_SUM,
       4,
       {MO_OBJECTIVE_TRAVEL, MO_OBJECTIVE_JUMP, OF(MEAN_HEIGHT), OF(WORK)},
       {1, 0.5, -1, 2e-5}},
      {&ahead, MO_OBJECTIVE_SUM, 1, {OF(STRAIGHTNESS)}, {0.5}},
      {&ahead,
       MO_OBJECTIVE_SUM,
       8,
       {MO_OBJECTIVE_TRAVEL, OF(PEAK_HEIGHT), OF(TILT), OF(YAW_RATE), OF(AIR_SHARE),
        OF(CONTACT_FRONT), OF(PEAK_STRAIN), OF(INVERTED_VOXELS)},
       {1, 2, -0.2, 0.1, 1, 0.3, -0.5, -0.05}},
  };
  environment->task = (struct mo_task){
      .guide = *cases[k].guide, .objective = cases[k].objective, .n_terms = cases[k].n};
  for (uint32_t i = 0; i < MO_TERMS_MAX; i++) {
    environment->task.terms[i] = cases[k].terms[i];
    environment->task.weights[i] = cases[k].weights[i];
  }
  for (int i = 0; i < MO_TERRAIN_HEIGHTS && environment->n_profile == 0; i++)
    environment->terrain_heights_m[i] -=
        (is_efficient(&environment->task) ? 0.6 : 0.1) * (i % MO_TERRAIN_SIDE);
}

#endif
