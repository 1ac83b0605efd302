/* trials.c: the trials of a certificate: what each axis and level changes, and which of them do not
 * apply to a base.
 *
 * Random numbers: the constants of `chance` and `worlds` are those of mo_factors_draw with the seed
 * of the settings, in steps that no training run and no request reaches. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "certificate/held_out.h"
#include "rollout/scene.h"
#include "world/factors.h"

#define STEP_CHANCE UINT32_MAX
#define STEP_WORLDS (UINT32_MAX - 1)
#define LEVELS_MAX  MO_CERTIFICATE_LEVELS_MAX

/* ---- levels ---- */

static bool is_of_factors(enum mo_axis axis)
{
  return axis >= MO_AXIS_STIFFNESS && axis <= MO_AXIS_FRICTION;
}

/* Writes the levels of an axis; an axis without levels has the single level NaN. Returns their
 * number. */
static uint32_t levels_of(const struct mo_certificate_settings *settings, enum mo_axis axis,
                          double levels[LEVELS_MAX])
{
  levels[0] = NAN;
  switch (axis) {
  case MO_AXIS_PRECISION: levels[0] = 64; return 1;
  case MO_AXIS_STEP:
    levels[0] = 2;
    levels[1] = 4;
    return 2;
  case MO_AXIS_DROP:
    levels[0] = 0.05;
    levels[1] = 0.2;
    return 2;
  default:
    if (!is_of_factors(axis))
      return 1;
    memcpy(levels, settings->levels, settings->n_levels * sizeof(*levels));
    return settings->n_levels;
  }
}

/* Returns the factors of a level: one constant is changed. */
static struct mo_factors level_factors(enum mo_axis axis, double level)
{
  struct mo_factors factors = mo_factors_ones();
  switch (axis) {
  case MO_AXIS_STIFFNESS: factors.stiffness = level; break;
  case MO_AXIS_MASS: factors.mass = level; break;
  case MO_AXIS_DRAG: factors.drag = level; break;
  case MO_AXIS_GRAVITY: factors.gravity = level; break;
  case MO_AXIS_ACTUATION: factors.actuation = level; break;
  case MO_AXIS_FRICTION: factors.friction = level; break;
  default: break;
  }
  return mo_factors_simplest(&factors);
}

/* Returns the physics of a level. */
static struct mo_physics level_physics(const struct mo_certificate_base *base, enum mo_axis axis,
                                       double level)
{
  struct mo_physics physics = base->physics;
  if (axis == MO_AXIS_DROP)
    physics.drop_height_m += level;
  if (axis == MO_AXIS_STEP) {
    struct mo_scheme *scheme = &physics.scheme;
    if (scheme->control_period_s == 0)
      scheme->control_period_s = scheme->dt_s;
    scheme->dt_s /= level;
    scheme->n_steps *= (uint32_t)level;
  }
  return physics;
}

/* Returns the factors that an axis can give the worlds, as ranges. */
static struct mo_factor_ranges level_ranges(const struct mo_certificate_settings *settings,
                                            enum mo_axis axis, double level)
{
  const double low = 1 - MO_CERTIFICATE_CHANCE, high = 1 + MO_CERTIFICATE_CHANCE;
  if (axis == MO_AXIS_WORLDS)
    return settings->ranges;
  if (axis == MO_AXIS_CHANCE)
    return (struct mo_factor_ranges){true,        {low, high}, {low, high}, {low, high},
                                     {low, high}, {low, high}, {low, high}};
  struct mo_factor_ranges ranges = mo_factors_constant();
  const struct mo_factors by = level_factors(axis, level);
  if (by.given != 0)
    ranges = (struct mo_factor_ranges){true,
                                       {by.stiffness, by.stiffness},
                                       {by.mass, by.mass},
                                       {by.drag, by.drag},
                                       {by.gravity, by.gravity},
                                       {by.actuation, by.actuation},
                                       {by.friction, by.friction}};
  return ranges;
}

/* ---- what does not apply ---- */

/* Returns whether the constant that an axis multiplies is 0 in all worlds. */
static bool is_without_effect(const struct mo_certificate_base *base, enum mo_axis axis)
{
  for (uint32_t k = 0; k < base->n_environments; k++) {
    const struct mo_constants here = mo_scene_constants(&base->environments[k], &base->physics);
    const double of_axis[] = {here.stiffness_n_per_m, here.mass_kg,   here.drag_per_s,
                              here.gravity_m_per_s2,  here.actuation, here.friction};
    if (of_axis[axis - MO_AXIS_STIFFNESS] != 0)
      return false;
  }
  return true;
}

/* Returns whether the physics of a level is within its bounds in all worlds. */
static bool is_in_range(const struct mo_certificate_settings *settings,
                        const struct mo_certificate_base *base, enum mo_axis axis, double level)
{
  const struct mo_physics physics = level_physics(base, axis, level);
  const struct mo_factor_ranges ranges = level_ranges(settings, axis, level);
  if (mo_physics_check(&physics, NULL) != MO_OK)
    return false;
  for (uint32_t k = 0; k < base->n_environments; k++)
    if (mo_physics_check_in(&physics, &base->environments[k], &ranges, NULL) != MO_OK)
      return false;
  return true;
}

static const char *out_of_range(enum mo_axis axis)
{
  switch (axis) {
  case MO_AXIS_STEP:
    return "finer steps would be shorter than 1e-7 s, or a rollout would have more than 1000000";
  case MO_AXIS_DROP: return "the drop height would be out of range";
  case MO_AXIS_CHANCE:
    return "a constant or a factor is at a bound, so it cannot be changed in both directions";
  case MO_AXIS_WORLDS:
    return "a constant, or its factor in a world, would be out of range; use narrower ranges";
  default:
    return "the constant, or its factor in a world, would be out of range; use levels nearer to 1";
  }
}
_Static_assert(MO_STEPS_MAX == 1000000, "the sentence about finer steps has this number");

const char *mo_certificate_omits(const struct mo_certificate_settings *settings,
                                 const struct mo_certificate_base *base, enum mo_axis axis)
{
  double levels[LEVELS_MAX];
  if ((settings->axes >> axis & 1) == 0 || axis == MO_AXIS_BASE)
    return NULL;
  if (axis == MO_AXIS_PRECISION && base->precision == MO_FLOAT64)
    return "the base is already computed in float64";
  if (axis == MO_AXIS_HELD_OUT)
    return mo_fresh_refuses(base);
  if (axis == MO_AXIS_WORLDS && !mo_factors_vary(&settings->ranges))
    return "no constant varies, because all ranges are [1, 1]; use other ranges";
  if (is_of_factors(axis) && is_without_effect(base, axis))
    return "the constant is 0 in all worlds, so a factor changes nothing";
  const uint32_t n = levels_of(settings, axis, levels);
  for (uint32_t k = 0; k < n; k++)
    if (is_in_range(settings, base, axis, levels[k]))
      return NULL;
  return out_of_range(axis);
}

/* ---- notes ---- */

/* Returns whether the springs of every body are stable, linearly, in all worlds. */
static bool is_stable(const struct mo_certificate_base *base, const struct mo_physics *physics,
                      const struct mo_factor_ranges *ranges)
{
  for (uint32_t k = 0; k < base->n_environments; k++)
    for (int end = 0; end < 2; end++) {
      /* The stiffest and lightest, with the lowest or highest drag. */
      struct mo_physics worst = *physics;
      worst.constants = mo_scene_constants(&base->environments[k], physics);
      worst.constants.stiffness_n_per_m *= ranges->stiffness[1];
      worst.constants.mass_kg *= ranges->mass[0];
      worst.constants.drag_per_s *= ranges->drag[end];
      if (!mo_step_is_stable(&worst, MO_EIGENVALUE_MAX))
        return false;
    }
  return true;
}

/* Appends a sentence, after "; " if there already is one. */
static void append(struct mo_message *note, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
static void append(struct mo_message *note, const char *format, ...)
{
  size_t size = strlen(note->text);
  va_list arguments;
  if (size > 0)
    size += (size_t)snprintf(note->text + size, sizeof(note->text) - size, "; ");
  va_start(arguments, format);
  if (size < sizeof(note->text))
    vsnprintf(note->text + size, sizeof(note->text) - size, format, arguments);
  va_end(arguments);
}

static void note_levels(const struct mo_certificate_settings *settings,
                        const struct mo_certificate_base *base, enum mo_axis axis,
                        struct mo_message *note)
{
  const struct mo_factor_ranges constant = mo_factors_constant();
  const bool base_is_stable = is_stable(base, &base->physics, &constant);
  double levels[LEVELS_MAX];
  const uint32_t n = levels_of(settings, axis, levels);
  char left[128] = "", unstable[128] = "";
  for (uint32_t k = 0; k < n; k++) {
    char *list = NULL;
    const struct mo_physics physics = level_physics(base, axis, levels[k]);
    const struct mo_factor_ranges ranges = level_ranges(settings, axis, levels[k]);
    if (!is_in_range(settings, base, axis, levels[k]))
      list = left;
    else if (base_is_stable && axis != MO_AXIS_CHANCE && !is_stable(base, &physics, &ranges))
      list = unstable;
    if (list != NULL)
      snprintf(list + strlen(list), sizeof(left) - strlen(list), isnan(levels[k]) ? "" : " %.6g",
               levels[k]);
    if (list != NULL && isnan(levels[k]))
      snprintf(list, sizeof(left), " ");
  }
  if (left[0] != '\0')
    append(note, "levels left out:%s, out of range", left);
  if (unstable[0] != '\0' && axis == MO_AXIS_WORLDS)
    append(note, "in some of the worlds, the springs of some bodies are unstable with this dt_s; "
                 "there, a divergence may be due to the step");
  else if (unstable[0] != '\0')
    append(note,
           "at%s, the springs of some bodies are unstable with this dt_s; there, a "
           "divergence may be due to the step",
           unstable);
}

bool mo_certificate_note(const struct mo_certificate_settings *settings,
                         const struct mo_certificate_base *base, enum mo_axis axis,
                         struct mo_message *note)
{
  note->text[0] = '\0';
  if ((settings->axes >> axis & 1) == 0 || axis == MO_AXIS_BASE ||
      mo_certificate_omits(settings, base, axis) != NULL)
    return false;
  if (axis == MO_AXIS_HELD_OUT) {
    const uint32_t n = mo_fresh_count(base, settings->held_out);
    if (n < settings->held_out)
      append(note, "%u worlds instead of %u, because the held-out set has no more", (unsigned)n,
             (unsigned)settings->held_out);
    if (mo_fresh_kind(base) != NULL)
      append(note, "%s", mo_fresh_kind(base));
    if (base->set == NULL && n < base->n_environments)
      append(note, "only those of the first %u of the list's %u worlds", (unsigned)n,
             (unsigned)base->n_environments);
    return note->text[0] != '\0';
  }
  note_levels(settings, base, axis, note);
  if (axis == MO_AXIS_WORLDS && settings->worlds < base->n_environments)
    append(note, "only in the first %u of the base's %u worlds", (unsigned)settings->worlds,
           (unsigned)base->n_environments);
  return note->text[0] != '\0';
}

/* ---- trials ---- */

static uint32_t environments_of(const struct mo_certificate_settings *settings,
                                const struct mo_certificate_base *base, enum mo_axis axis)
{
  switch (axis) {
  case MO_AXIS_HELD_OUT: return mo_fresh_count(base, settings->held_out);
  case MO_AXIS_CHANCE: return settings->chance * base->n_environments;
  case MO_AXIS_WORLDS: return settings->worlds;
  default: return base->n_environments;
  }
}

int mo_certificate_trials(const struct mo_certificate_settings *settings,
                          const struct mo_certificate_base *base, struct mo_trial **trials,
                          uint32_t *n)
{
  struct mo_trial *made = calloc((size_t)MO_AXES * LEVELS_MAX, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  *n = 0;
  for (enum mo_axis axis = MO_AXIS_BASE; axis < MO_AXES; axis++) {
    double levels[LEVELS_MAX];
    const bool is_base = axis == MO_AXIS_BASE;
    const bool is_double = axis == MO_AXIS_PRECISION || axis == MO_AXIS_STEP;
    if (!is_base &&
        ((settings->axes >> axis & 1) == 0 || mo_certificate_omits(settings, base, axis) != NULL))
      continue;
    const uint32_t n_levels = levels_of(settings, axis, levels);
    for (uint32_t k = 0; k < n_levels; k++)
      if (is_base || axis == MO_AXIS_HELD_OUT || is_in_range(settings, base, axis, levels[k]))
        made[(*n)++] = (struct mo_trial){
            .axis = axis,
            .level = levels[k],
            .precision = is_double ? MO_FLOAT64 : base->precision,
            .physics = level_physics(base, axis, levels[k]),
            .n_environments = environments_of(settings, base, axis),
            .is_paired = axis != MO_AXIS_HELD_OUT,
            .measures = is_base,
        };
  }
  *trials = made;
  return MO_OK;
}

/* Multiplies the factors of n worlds. factors: (n / repeat), each for `repeat` consecutive
 * worlds. */
static void multiply(const struct mo_factors *factors, uint32_t repeat, uint32_t n,
                     struct mo_environment *environments)
{
  for (uint32_t k = 0; k < n; k++)
    environments[k].factors = mo_factors_times(&environments[k].factors, &factors[k / repeat]);
}

int mo_certificate_environments(const struct mo_certificate_settings *settings,
                                const struct mo_certificate_base *base,
                                const struct mo_trial *trial, struct mo_environment *environments)
{
  const uint32_t n = trial->n_environments;
  const bool is_chance = trial->axis == MO_AXIS_CHANCE;
  const uint32_t repeat = is_chance ? base->n_environments : 1;
  if (trial->axis == MO_AXIS_HELD_OUT)
    return mo_fresh_worlds(base, settings->seed, n, environments);
  struct mo_factors *factors = calloc(n / repeat + 1, sizeof(*factors));
  int error = factors != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (error == MO_OK && (is_chance || trial->axis == MO_AXIS_WORLDS)) {
    const struct mo_factor_ranges ranges = level_ranges(settings, trial->axis, trial->level);
    error = mo_factors_draw(&ranges, settings->seed, is_chance ? STEP_CHANCE : STEP_WORLDS,
                            n / repeat, factors);
  } else if (error == MO_OK) {
    for (uint32_t k = 0; k < n; k++)
      factors[k] = level_factors(trial->axis, trial->level);
  }
  if (error == MO_OK) {
    for (uint32_t k = 0; k < n; k++)
      environments[k] = base->environments[k % base->n_environments];
    multiply(factors, repeat, n, environments);
  }
  free(factors);
  return error;
}
