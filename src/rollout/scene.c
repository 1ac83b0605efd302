/* scene.c: start positions, light, center of mass, loss. */
#include "rollout/scene.h"

#include "rollout/objective.inc"
#include "world/environment.h"
#include "world/factors.h"

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
    position_m[3 * (size_t)i + 2] += lift + mo_scene_drop_m(environment, physics);
}

struct mo_constants mo_scene_constants(const struct mo_environment *environment,
                                       const struct mo_physics *physics)
{
  const struct mo_factors *by = &environment->factors;
  struct mo_constants constants = physics->constants;
  if (by->given == 0)
    return constants;
  constants.stiffness_n_per_m *= by->stiffness;
  constants.mass_kg *= by->mass;
  constants.drag_per_s *= by->drag;
  constants.gravity_m_per_s2 *= by->gravity;
  constants.actuation *= by->actuation;
  constants.friction *= by->friction;
  return constants;
}

int mo_physics_check_in(const struct mo_physics *physics, const struct mo_environment *environment,
                        const struct mo_factor_ranges *vary, struct mo_message *message)
{
  const struct mo_factor_ranges constant = mo_factors_constant();
  struct mo_environment here = mo_environment_defaults;
  struct mo_factors ends[2];
  int error = MO_OK;
  mo_factors_ends(vary != NULL ? vary : &constant, ends);
  for (int i = 0; i < 2 && error == MO_OK; i++) {
    struct mo_physics end = *physics;
    here.factors =
        environment != NULL ? mo_factors_times(&environment->factors, &ends[i]) : ends[i];
    end.constants = mo_scene_constants(&here, physics);
    error = mo_factors_check(&here.factors);
    error = error != MO_OK ? mo_fail(message, error, "the product of two factors must be %g to %g",
                                     MO_FACTOR_MIN, MO_FACTOR_MAX)
                           : mo_physics_check(&end, message);
  }
  return error;
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
