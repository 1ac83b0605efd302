/* scene.h: start and end of a rollout in float64. All implementations share it, so that they start
 * from the same state and measure the same loss. */
#ifndef MORPHO_ROLLOUT_SCENE_H
#define MORPHO_ROLLOUT_SCENE_H

#include <math.h>

#include <morpho/rollout.h>

/* Computes start positions (n_masses, 3): the workspace is centered at (2.5, 2.5) m and lifted just
 * enough that no mass is below the terrain, plus the drop. */
void mo_scene_start(const struct mo_body *body, const struct mo_environment *environment,
                    const struct mo_physics *physics, double *position_m);

/* Returns how far above the ground a rollout starts: the drop height of the physics plus the
 * environment's. The reference, the kernels and the devices all use this function. */
static inline double mo_scene_drop_m(const struct mo_environment *environment,
                                     const struct mo_physics *physics)
{
  return physics->drop_height_m + environment->drop_m;
}

/* Returns the constants of a rollout: those of the physics times the environment's factors. The
 * reference, the kernels and the devices all use this function. */
struct mo_constants mo_scene_constants(const struct mo_environment *environment,
                                       const struct mo_physics *physics);

/* Places the light of a plain task, which stands on the terrain. course.h handles other tasks. */
void mo_scene_light(const struct mo_environment *environment, double light_m[3]);

/* Computes the plain mean of n positions (n, 3), summed in order. */
void mo_scene_com(const double *position_m, uint32_t n, double com_m[3]);

/* Returns a controller's output in the form used in recordings. */
static inline int8_t mo_scene_actuation(double output)
{
  return (int8_t)lrint(127 * fmax(-1, fmin(1, output)));
}

/* Sets loss and value of an outcome whose other members are set, for a plain task: the loss in
 * objective.inc, or infinity if the rollout diverged. */
void mo_scene_finish(struct mo_outcome *outcome, const struct mo_environment *environment);

#endif
