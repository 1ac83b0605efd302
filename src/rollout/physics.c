/* physics.c: the constants of a simulated life, and the bounds within which they are accepted. */
#include <morpho/rollout.h>

#include "base/number.h"

struct mo_physics mo_default_physics(void)
{
  return (struct mo_physics){
      .dt_s = 0.004,
      .n_steps = 1000,
      .stiffness_n_per_m = 15000.0,
      .mass_kg = 1.0,
      .drag_per_s = 15.0,
      .gravity_m_per_s2 = 9.8,
      .actuation = 0.2,
      .friction = 0.9,
      .friction_cap = 0.95,
      .drop_height_m = 0.0,
      .impact = MO_IMPACT_EXACT,
      .bisections = 8,
  };
}

int mo_physics_check(const struct mo_physics *physics, struct mo_message *message)
{
  const struct mo_bounded numbers[] = {
      {"dt_s", physics->dt_s, 1e-7, 0.1, false, false},
      {"stiffness_n_per_m", physics->stiffness_n_per_m, 0, 1e9, false, false},
      {"mass_kg", physics->mass_kg, 1e-6, 1e6, false, false},
      {"drag_per_s", physics->drag_per_s, 0, 1e4, false, false},
      {"gravity_m_per_s2", physics->gravity_m_per_s2, 0, 1000, false, false},
      {"actuation", physics->actuation, 0, 0.9, false, false},
      {"friction", physics->friction, 0, 1000, false, false},
      {"friction_cap", physics->friction_cap, 0, 1, false, false},
      {"drop_height_m", physics->drop_height_m, 0, 1000, false, false},
  };
  int r = mo_bounded_check(numbers, sizeof(numbers) / sizeof(numbers[0]), message);
  if (r != MO_OK)
    return r;
  if (physics->n_steps < 1 || physics->n_steps > MO_STEPS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "n_steps is %u; it must be 1 to %d", physics->n_steps,
                   MO_STEPS_MAX);
  if (physics->impact != MO_IMPACT_EXACT && physics->impact != MO_IMPACT_BISECTION)
    return mo_fail(message, MO_ERR_INVALID, "impact is %d; it must be %d (exact) or %d (bisection)",
                   (int)physics->impact, (int)MO_IMPACT_EXACT, (int)MO_IMPACT_BISECTION);
  if (physics->bisections < 1 || physics->bisections > 52)
    return mo_fail(message, MO_ERR_RANGE, "bisections is %u; it must be 1 to 52",
                   physics->bisections);
  return MO_OK;
}

uint32_t mo_recording_frames(const struct mo_physics *physics, uint32_t stride)
{
  return stride > 0 ? physics->n_steps / stride + 1 : 0;
}
