/* scene.c: start positions, light, center of mass, loss. */
#include "rollout/scene.h"

#include "rollout/objective.inc"

#include <math.h>

void mo_scene_start(const struct mo_body *body, const struct mo_environment *environment,
                    const struct mo_physics *physics, double *position_m)
{
  const double left = MO_WORLD_CENTER_M - 0.5 * MO_VOXEL_M * body->workspace.nx;
  const double front = MO_WORLD_CENTER_M - 0.5 * MO_VOXEL_M * body->workspace.ny;
  uint16_t lowest = UINT16_MAX;
  for (uint32_t i = 0; i < body->n_masses; i++)
    if (body->mass_xyz[3 * i + 2] < lowest)
      lowest = body->mass_xyz[3 * i + 2];
  double lift = -INFINITY;
  for (uint32_t i = 0; i < body->n_masses; i++) {
    double *p = position_m + 3 * (size_t)i;
    const uint16_t *cell = body->mass_xyz + 3 * (size_t)i;
    p[0] = left + MO_VOXEL_M * cell[0];
    p[1] = front + MO_VOXEL_M * cell[1];
    p[2] = MO_VOXEL_M * (cell[2] - lowest); /* 0 in the lowest layer: its height is exact */
    lift = fmax(lift, mo_terrain_height(environment, p[0], p[1]) - p[2]);
  }
  for (uint32_t i = 0; i < body->n_masses; i++)
    position_m[3 * (size_t)i + 2] += lift + physics->drop_height_m;
}

struct mo_constants mo_scene_constants(const struct mo_environment *environment,
                                       const struct mo_physics *physics)
{
  (void)environment;
  return physics->constants;
}

void mo_scene_light(const struct mo_environment *environment, double light_m[3])
{
  light_m[0] = environment->light_xy_m[0];
  light_m[1] = environment->light_xy_m[1];
  light_m[2] = mo_terrain_height(environment, light_m[0], light_m[1]);
}

void mo_scene_com(const double *position_m, uint32_t n, double com_m[3])
{
  double sum[3] = {0, 0, 0};
  for (uint32_t i = 0; i < n; i++)
    for (int axis = 0; axis < 3; axis++)
      sum[axis] += position_m[3 * (size_t)i + axis];
  for (int axis = 0; axis < 3; axis++)
    com_m[axis] = sum[axis] / n;
}

void mo_scene_finish(struct mo_outcome *outcome, const struct mo_environment *environment)
{
  const struct mo_goal goal = mo_goal_of(environment, outcome->com_start_m);
  const struct mo_away end = mo_away_of(environment->light_xy_m, outcome->com_end_m);
  outcome->loss = outcome->diverged_step != 0 ? (double)INFINITY : mo_goal_loss(&goal, end);
  outcome->value = 1 - outcome->loss;
}
