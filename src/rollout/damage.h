/* damage.h: which springs an environment cuts, and when. All implementations share it. */
#ifndef MORPHO_ROLLOUT_DAMAGE_H
#define MORPHO_ROLLOUT_DAMAGE_H

#include <math.h>
#include <stdbool.h>

#include <morpho/rollout.h>

/* Returns the first step in which the cut springs exert no force: the first one that starts at
 * damage.time_s or later. UINT32_MAX: no spring is cut. */
static inline uint32_t mo_damage_step(const struct mo_environment *environment,
                                      const struct mo_scheme *scheme)
{
  if (environment->damage.cut == 0)
    return UINT32_MAX;
  /* A time that is a multiple of the step must count as one despite rounding. */
  const double steps = ceil(environment->damage.time_s / scheme->dt_s - 1e-6);
  return steps < UINT32_MAX ? (uint32_t)steps : UINT32_MAX;
}

/* Returns whether a spring exerts no force in a step, given the first such step. A spring that was
 * cut before the window that is computed has a 2 in `cut`. */
static inline bool mo_damage_lasts(const uint8_t *cut, uint32_t cut_step, uint32_t step,
                                   uint32_t spring)
{
  return cut[spring] == 2 || (step >= cut_step && cut[spring] != 0);
}

/* Sets cut[s] to 1 for the springs of the octant and to 0 for the others: (n_springs). A spring
 * belongs to the octant of the body's bounding box, before the rollout, that its midpoint is in. A
 * midpoint on a middle plane belongs to the side with larger coordinates. */
static inline void mo_damage_mark(const struct mo_environment *environment,
                                  const struct mo_body *body, uint8_t *cut)
{
  uint32_t middle_2[3]; /* twice the middle, in voxels; midpoints are doubled, too */
  for (uint32_t axis = 0; axis < 3; axis++) {
    uint32_t low = UINT16_MAX, high = 0;
    for (uint32_t m = 0; m < body->n_masses; m++) {
      const uint32_t at = body->mass_xyz[3 * (size_t)m + axis];
      low = at < low ? at : low;
      high = at > high ? at : high;
    }
    middle_2[axis] = low + high;
  }
  for (uint32_t s = 0; s < body->n_springs; s++) {
    const uint16_t *a = body->mass_xyz + 3 * (size_t)body->spring_a[s],
                   *b = body->mass_xyz + 3 * (size_t)body->spring_b[s];
    uint32_t octant = 0;
    for (uint32_t axis = 0; axis < 3; axis++)
      octant |= (uint32_t)((uint32_t)a[axis] + b[axis] >= middle_2[axis]) << axis;
    cut[s] = environment->damage.cut == 1 + octant;
  }
}

#endif
