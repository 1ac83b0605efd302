/* kick.h: the coefficients of a step's kick, for the reference and all kernels:
 *
 *   v' = keep · v + push · J/m − (0, 0, fall),   J: the impulse of the springs
 *
 * The paper's integrator first slows the velocity by drag, and then adds the effect of the forces
 * in the step. `split` is leapfrog with drag in closed form: v is the velocity in the middle of a
 * step, and the kick solves v' = −drag v + F/m over the time between two middles with F constant.
 * The first kick starts from rest and covers half a step. */
#ifndef MORPHO_ROLLOUT_KICK_H
#define MORPHO_ROLLOUT_KICK_H

#include <math.h>

#include <morpho/rollout.h>

struct mo_kick {
  double keep, push, fall;
};

/* Returns (1 − exp(−x)) / x, given exp(−x), without the cancellation near 0. */
static inline double mo_kick_mean(double x, double decay)
{
  return fabs(x) > 1e-3 ? (1 - decay) / x : 1 - x / 2 * (1 - x / 3 * (1 - x / 4));
}

/* Returns the coefficient of contact's drag (contact.c). decay: exp(−drag · dt). */
static inline double mo_kick_bend(const struct mo_scheme *scheme,
                                  const struct mo_constants *constants, double decay)
{
  const double x = 0.5 * constants->drag_per_s * scheme->dt_s;
  return (mo_kick_mean(-x, 1 / sqrt(decay)) - 1) * 2 / scheme->dt_s;
}

/* decay: exp(−drag · dt), which kernels compute themselves. */
static inline struct mo_kick mo_kick_of(const struct mo_scheme *scheme,
                                        const struct mo_constants *constants, double decay)
{
  const double fall = constants->gravity_m_per_s2 * scheme->dt_s;
  struct mo_kick kick = {decay, 1, fall};
  if (scheme->integrator == MO_INTEGRATOR_SPLIT) {
    kick.push = mo_kick_mean(constants->drag_per_s * scheme->dt_s, decay);
    kick.fall = kick.push * fall;
  }
  return kick;
}

/* Returns the kick of the first step. */
static inline struct mo_kick mo_kick_first(const struct mo_scheme *scheme,
                                           const struct mo_constants *constants, double decay)
{
  const double fall = constants->gravity_m_per_s2 * scheme->dt_s;
  struct mo_kick kick = mo_kick_of(scheme, constants, decay);
  if (scheme->integrator == MO_INTEGRATOR_SPLIT) {
    kick.push = mo_kick_mean(0.5 * constants->drag_per_s * scheme->dt_s, sqrt(decay)) / 2;
    kick.fall = kick.push * fall;
  }
  return kick;
}

#endif
