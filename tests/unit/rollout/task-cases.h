/* task-cases.h: tasks of every guide with every objective that fits it. */
#ifndef MORPHO_TESTS_TASK_CASES_H
#define MORPHO_TESTS_TASK_CASES_H

#include <morpho/world.h>

#define TASK_CASES 13

/* Returns task number k. Paths are short enough that bodies at the center reach waypoints within
 * 200 steps; the long one lies to the side of the body. */
static inline struct mo_task task_case(uint32_t k)
{
  static const struct mo_guide fixed = {.kind = MO_GUIDE_FIXED};
  static const struct mo_guide line = {.kind = MO_GUIDE_MOVING, .velocity_m_per_s = {0.3, -0.2}};
  static const struct mo_guide circle = {
      .kind = MO_GUIDE_MOVING, .turn_rad_per_s = 1.3, .center_m = {2.6, 2.4}};
  static const struct mo_guide cycloid = {.kind = MO_GUIDE_MOVING,
                                          .turn_rad_per_s = -2,
                                          .velocity_m_per_s = {-0.4, 0.1},
                                          .center_m = {2.2, 2.9}};
  static const struct mo_guide ahead = {
      .kind = MO_GUIDE_AHEAD, .heading_rad = 0.7, .distance_m = 1.5};
  static const struct mo_guide turning = {
      .kind = MO_GUIDE_TURNING, .heading_rad = -2, .turn_rad_per_s = 1.57, .distance_m = 0.8};
  static const struct mo_guide winding = {
      .kind = MO_GUIDE_PATH,
      .n_points = 4,
      .points_m = {{2.6, 2.55}, {2.6, 2.55}, {2.7, 2.4}, {4, 4}},
      .distance_m = 0.5};
  static const struct mo_guide straight = {
      .kind = MO_GUIDE_PATH, .n_points = 1, .points_m = {{6, 4}}, .distance_m = 1.5};
  const struct {
    const struct mo_guide *guide;
    enum mo_objective objective;
  } tasks[TASK_CASES] = {
      {&fixed, MO_OBJECTIVE_APPROACH}, {&fixed, MO_OBJECTIVE_CLIMB},
      {&line, MO_OBJECTIVE_REACH},     {&circle, MO_OBJECTIVE_APPROACH},
      {&cycloid, MO_OBJECTIVE_PURSUE}, {&circle, MO_OBJECTIVE_CLIMB},
      {&ahead, MO_OBJECTIVE_TRAVEL},   {&ahead, MO_OBJECTIVE_CLIMB},
      {&turning, MO_OBJECTIVE_TRAVEL}, {&turning, MO_OBJECTIVE_CLIMB},
      {&winding, MO_OBJECTIVE_FOLLOW}, {&straight, MO_OBJECTIVE_FOLLOW},
      {&straight, MO_OBJECTIVE_CLIMB},
  };
  return (struct mo_task){*tasks[k].guide, tasks[k].objective};
}

#endif
