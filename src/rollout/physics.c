/* physics.c: the constants of a rollout and their bounds. */
#include "rollout/physics.h"

#include <math.h>
#include <string.h>

#include "rollout/kick.h"

#define BISECTIONS_MAX 52 /* number of halvings that exhaust the mantissa of a float64 */

struct mo_physics mo_paper_physics(void)
{
  return (struct mo_physics){
      .scheme = {.dt_s = 0.004, .n_steps = 1000, .impact = MO_IMPACT_EXACT, .bisections = 8},
      .constants = {.stiffness_n_per_m = 15000.0,
                    .mass_kg = 1.0,
                    .drag_per_s = 15.0,
                    .gravity_m_per_s2 = 9.8,
                    .actuation = 0.2,
                    .friction = 0.9,
                    .friction_cap = 0.95},
      .drop_height_m = 0.0,
  };
}

struct mo_physics mo_default_physics(void)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = MO_INTEGRATOR_SPLIT;
  physics.scheme.dt_s = 0.002;
  physics.scheme.n_steps = 2000;
  return physics;
}

/* The quotient of a period and a step that are whole multiples in decimal is off only by
 * rounding. */
uint32_t mo_control_steps(const struct mo_scheme *scheme)
{
  if (scheme->control_period_s == 0)
    return 1;
  const double steps = scheme->control_period_s / scheme->dt_s, whole = round(steps);
  if (!(whole >= 1 && fabs(steps - whole) <= 1e-9 * whole))
    return 0;
  return whole < scheme->n_steps ? (uint32_t)whole : scheme->n_steps;
}

/* A vibration mode follows v' = keep v − push dt λ k/m q, q' = q + dt v'. */
static bool is_stable(const struct mo_physics *physics, double eigenvalue, double dt_s)
{
  const struct mo_constants *constants = &physics->constants;
  struct mo_scheme scheme = physics->scheme;
  scheme.dt_s = dt_s;
  const struct mo_kick kick = mo_kick_of(&scheme, constants, exp(-constants->drag_per_s * dt_s));
  const double rate = eigenvalue * constants->stiffness_n_per_m / constants->mass_kg;
  return kick.push * rate * dt_s * dt_s < 2 * (1 + kick.keep);
}

bool mo_step_is_stable(const struct mo_physics *physics, double eigenvalue)
{
  return is_stable(physics, eigenvalue, physics->scheme.dt_s);
}

double mo_stable_step_s(const struct mo_physics *physics, double eigenvalue)
{
  double low = 0, high = 1;
  if (!(eigenvalue * physics->constants.stiffness_n_per_m > 0))
    return INFINITY;
  while (is_stable(physics, eigenvalue, high)) {
    low = high;
    high *= 2;
  }
  for (double middle; middle = 0.5 * (low + high), low < middle && middle < high;)
    *(is_stable(physics, eigenvalue, middle) ? &low : &high) = middle;
  return low;
}

/* ---- the fields ---- */

static void read_impact(struct mo_json *json, void *value)
{
  struct mo_physics *physics = value;
  struct mo_json_slice name;
  const unsigned depth = json->depth;
  if (!mo_json_string(json, &name))
    return;
  if (mo_json_is(name, "exact")) {
    physics->scheme.impact = MO_IMPACT_EXACT;
    return;
  }
  uint32_t n = 0;
  bool good = name.size > 9 && name.size <= 11 && memcmp(name.bytes, "bisection", 9) == 0 &&
              name.bytes[9] != '0';
  for (size_t i = 9; i < name.size && good; i++) {
    good = name.bytes[i] >= '0' && name.bytes[i] <= '9';
    n = n * 10 + (uint32_t)(name.bytes[i] - '0');
  }
  if (!good || n < 1 || n > BISECTIONS_MAX) {
    mo_json_fault_at(json, depth, "", "must be \"exact\", or \"bisection\" followed by 1 to %d",
                     BISECTIONS_MAX);
    return;
  }
  physics->scheme.impact = MO_IMPACT_BISECTION;
  physics->scheme.bisections = n;
}

static void write_impact(struct mo_text *text, const void *value)
{
  const struct mo_physics *physics = value;
  if (physics->scheme.impact == MO_IMPACT_EXACT)
    mo_text_add(text, "\"exact\"");
  else
    mo_text_format(text, "\"bisection%u\"", physics->scheme.bisections);
}

static int check_impact(const char *name, const void *value, struct mo_message *message)
{
  const struct mo_physics *physics = value;
  if (physics->scheme.impact != MO_IMPACT_EXACT && physics->scheme.impact != MO_IMPACT_BISECTION)
    return mo_fail(message, MO_ERR_INVALID, "%s must be %d (exact) or %d (bisection), got %d", name,
                   (int)MO_IMPACT_EXACT, (int)MO_IMPACT_BISECTION, (int)physics->scheme.impact);
  if (physics->scheme.bisections < 1 || physics->scheme.bisections > BISECTIONS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "bisections must be 1 to %d, got %u", BISECTIONS_MAX,
                   physics->scheme.bisections);
  return MO_OK;
}

#define AT(member) offsetof(struct mo_physics, member)
static const struct mo_field_own impact = {read_impact, write_impact, check_impact};
static const char *const impact_words[] = {"exact", "bisection", NULL};
static const struct mo_field impact_rows[] = {
    {"impact", MO_FIELD_WORD, 0, AT(scheme.impact), .words = impact_words},
    {"bisections", MO_FIELD_COUNT, 0, AT(scheme.bisections), .min = 1, .max = BISECTIONS_MAX},
};
static const struct mo_fields impact_members = MO_FIELDS(impact_rows);
const char *const mo_integrator_words[] = {"paper", "split", NULL};
static const struct mo_field rows[] = {
    {"dt_s", MO_FIELD_NUMBER, 0, AT(scheme.dt_s), .min = 1e-7, .max = 0.1, .unit = "s",
     .help = "time step"},
    {"n_steps", MO_FIELD_COUNT, 0, AT(scheme.n_steps), .min = 1, .max = MO_STEPS_MAX,
     .unit = "steps", .help = "length of a rollout"},
    {"control_period_s", MO_FIELD_NUMBER, 0, AT(scheme.control_period_s), .min = 0,
     .max = MO_CONTROL_PERIOD_MAX_S, .since = 2, .unit = "s",
     .help = "time for which the controller's outputs are held; 0: as in its file"},
    {"stiffness_n_per_m", MO_FIELD_NUMBER, 0, AT(constants.stiffness_n_per_m), .min = 0, .max = 1e9,
     .unit = "N/m", .help = "stiffness of every spring"},
    {"mass_kg", MO_FIELD_NUMBER, 0, AT(constants.mass_kg), .min = 1e-6, .max = 1e6, .unit = "kg",
     .help = "mass of every node"},
    {"drag_per_s", MO_FIELD_NUMBER, 0, AT(constants.drag_per_s), .min = 0, .max = 1e4,
     .unit = "1/s", .help = "rate at which velocities decay"},
    {"gravity_m_per_s2", MO_FIELD_NUMBER, 0, AT(constants.gravity_m_per_s2), .min = 0, .max = 1000,
     .unit = "m/s^2", .help = "acceleration downward"},
    {"actuation", MO_FIELD_NUMBER, 0, AT(constants.actuation), .min = 0, .max = 0.9, .unit = "",
     .help = "largest relative change of a rest length"},
    {"friction", MO_FIELD_NUMBER, 0, AT(constants.friction), .min = 0, .max = 1000, .unit = "",
     .help = "tangential speed lost per unit of normal speed in a contact"},
    {"friction_cap", MO_FIELD_NUMBER, 0, AT(constants.friction_cap), .min = 0, .max = 1, .unit = "",
     .help = "largest share of the tangential speed lost in an impact; paper: in each contact"},
    {"drop_height_m", MO_FIELD_NUMBER, 0, AT(drop_height_m), .min = 0, .max = 1000, .unit = "m",
     .help = "extra height of the body at the start"},
    {"impact", MO_FIELD_OWN, 0, 0, .own = &impact, .group = &impact_members, .unit = "",
     .help = "time of impact: exact, or bisection with 1 to 52 halvings"},
    {"integrator", MO_FIELD_WORD, 0, AT(scheme.integrator), .words = mo_integrator_words,
     .since = 3, .unit = "",
     .help = "paper: first order; split: second order, drag_per_s times dt_s at most 1"},
};
#undef AT

static void set_paper(void *physics, int word)
{
  (void)word;
  *(struct mo_physics *)physics = mo_paper_physics();
}

static const char *const names[] = {"paper", NULL};
static const struct mo_fields_words words = {names, set_paper};
const struct mo_fields mo_physics_fields = {rows, sizeof(rows) / sizeof(rows[0]), &words};

int mo_physics_check(const struct mo_physics *physics, struct mo_message *message)
{
  const int status = mo_fields_check(&mo_physics_fields, "", physics, message);
  if (status == MO_OK && mo_control_steps(&physics->scheme) == 0)
    return mo_fail(message, MO_ERR_RANGE,
                   "control_period_s must be a whole multiple of dt_s, got %.9g s with steps of "
                   "%.9g s",
                   physics->scheme.control_period_s, physics->scheme.dt_s);
  const double drag = physics->constants.drag_per_s * physics->scheme.dt_s;
  if (status == MO_OK && physics->scheme.integrator == MO_INTEGRATOR_SPLIT && !(drag <= 1))
    return mo_fail(message, MO_ERR_RANGE,
                   "with the integrator \"split\", drag_per_s times dt_s must be at most 1, got "
                   "%.9g; use smaller steps, or \"paper\"",
                   drag);
  return status;
}

int mo_physics_complete(struct mo_physics *physics, double controller_period_s)
{
  struct mo_scheme *scheme = &physics->scheme;
  if (scheme->control_period_s == 0)
    scheme->control_period_s = controller_period_s;
  else if (controller_period_s == 0 && scheme->control_period_s == scheme->dt_s)
    scheme->control_period_s = 0;
  return mo_control_steps(scheme) != 0 ? MO_OK : MO_ERR_RANGE;
}

/* ---- packed, compared ---- */

bool mo_physics_equal(const struct mo_physics *a, const struct mo_physics *b)
{
  return mo_fields_equal(&mo_physics_fields, a, b);
}

unsigned mo_physics_version(const struct mo_physics *physics)
{
  const struct mo_physics defaults = mo_paper_physics();
  return mo_fields_version(&mo_physics_fields, physics, &defaults);
}
