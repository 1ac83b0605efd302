/* kick.h: the coefficients of a step's kick, for the reference and all kernels:
 *
 *   v' = keep · v + push · J/m − (0, 0, fall),   J: the impulse of the springs */
#ifndef MORPHO_ROLLOUT_KICK_H
#define MORPHO_ROLLOUT_KICK_H

#include <morpho/rollout.h>

struct mo_kick {
  double keep, push, fall;
};

/* decay: exp(−drag · dt), which kernels compute on their own. */
static inline struct mo_kick mo_kick_of(const struct mo_scheme *scheme,
                                        const struct mo_constants *constants, double decay)
{
  const struct mo_kick kick = {decay, 1, constants->gravity_m_per_s2 * scheme->dt_s};
  return kick;
}

#endif
