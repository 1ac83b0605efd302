/* contact.h: contact of one mass with the terrain, float64. */
#ifndef MORPHO_ROLLOUT_CONTACT_H
#define MORPHO_ROLLOUT_CONTACT_H

#include <stdbool.h>

#include <morpho/rollout.h>

/* Return the time in [0, dt] at which a mass that leaves `position` with `velocity` first goes
 * below the terrain. The mass must be below the terrain after dt. */
double mo_impact_exact(const struct mo_environment *environment, const double position_m[3],
                       const double velocity_m_per_s[3], double dt_s);
double mo_impact_bisection(const struct mo_environment *environment, const double position_m[3],
                           const double velocity_m_per_s[3], double dt_s, uint32_t bisections);

/* Moves a mass for one step; `highest_m` is the terrain's largest height. Returns whether it
 * touched the terrain. */
bool mo_contact_move(const struct mo_scheme *scheme, const struct mo_constants *constants,
                     const struct mo_environment *environment, double highest_m,
                     double position_m[3], double velocity_m_per_s[3]);

/* For `split`, a mass that is less than this above the ground counts as lying on it. This height
 * exceeds the rounding errors of float32 on all but extreme terrains, and is about the distance
 * that a mass falls from rest in 0.4 ms. */
#define MO_LIES_M 1e-6

/* Like mo_contact_move, for `split`. velocity: in the middle of the step; acceleration: due to
 * springs and gravity, without drag. */
bool mo_contact_split(const struct mo_scheme *scheme, const struct mo_constants *constants,
                      const struct mo_environment *environment, double highest_m,
                      const double acceleration[3], double position_m[3],
                      double velocity_m_per_s[3]);

/* Differentiates mo_contact_move at the given position and velocity. d_position, d_velocity: in:
 * ∂loss/∂(its results); out: ∂loss/∂(its inputs). With MO_IMPACT_BISECTION the time of impact
 * counts as constant. */
void mo_contact_move_adjoint(const struct mo_scheme *scheme, const struct mo_constants *constants,
                             const struct mo_environment *environment, double highest_m,
                             const double position_m[3], const double velocity_m_per_s[3],
                             double d_position[3], double d_velocity[3]);

/* Differentiates mo_contact_split. d_acceleration: out. */
void mo_contact_split_adjoint(const struct mo_scheme *scheme, const struct mo_constants *constants,
                              const struct mo_environment *environment, double highest_m,
                              const double acceleration[3], const double position_m[3],
                              const double velocity_m_per_s[3], double d_position[3],
                              double d_velocity[3], double d_acceleration[3]);

#endif
