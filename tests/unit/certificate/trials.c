/* trials.c: which trials a base has, and what each of them changes. */
#include "fixture.h"

#include "certificate/held_out.h"
#include "world/environment.h"
#include "world/factors.h"

static const struct mo_factors *factors_at(const struct mo_environment *environment)
{
  static const struct mo_factors ones = {1, 1, 1, 1, 1, 1, 1};
  return environment->factors.given != 0 ? &environment->factors : &ones;
}

static bool is_same(const struct mo_environment *a, const struct mo_environment *b)
{
  return mo_fields_equal(&mo_environment_fields, a, b) && a->grid == b->grid;
}

/* Returns whether two worlds differ in nothing but factors. */
static bool is_same_place(const struct mo_environment *a, const struct mo_environment *b)
{
  struct mo_environment one = *a;
  one.factors = b->factors;
  return is_same(&one, b);
}

static bool are_same(const struct mo_environment *a, const struct mo_environment *b, uint32_t n)
{
  for (uint32_t k = 0; k < n; k++)
    if (!is_same(&a[k], &b[k]))
      return false;
  return true;
}

static bool is_same_factors(const struct mo_factors *a, const struct mo_factors *b)
{
  return a->given == b->given && mo_fields_equal(&mo_factor_fields, a, b);
}

static void all_axes(void)
{
  static const struct {
    enum mo_axis axis;
    double level;
    uint32_t n;
  } expected[] = {
      {MO_AXIS_BASE, NAN, 10},      {MO_AXIS_PRECISION, 64, 10},  {MO_AXIS_STEP, 2, 10},
      {MO_AXIS_STEP, 4, 10},        {MO_AXIS_HELD_OUT, NAN, 256}, {MO_AXIS_CHANCE, NAN, 160},
      {MO_AXIS_STIFFNESS, 0.7, 10}, {MO_AXIS_STIFFNESS, 0.9, 10}, {MO_AXIS_STIFFNESS, 1.1, 10},
      {MO_AXIS_STIFFNESS, 1.3, 10}, {MO_AXIS_MASS, 0.7, 10},      {MO_AXIS_MASS, 0.9, 10},
      {MO_AXIS_MASS, 1.1, 10},      {MO_AXIS_MASS, 1.3, 10},      {MO_AXIS_DRAG, 0.7, 10},
      {MO_AXIS_DRAG, 0.9, 10},      {MO_AXIS_DRAG, 1.1, 10},      {MO_AXIS_DRAG, 1.3, 10},
      {MO_AXIS_GRAVITY, 0.7, 10},   {MO_AXIS_GRAVITY, 0.9, 10},   {MO_AXIS_GRAVITY, 1.1, 10},
      {MO_AXIS_GRAVITY, 1.3, 10},   {MO_AXIS_ACTUATION, 0.7, 10}, {MO_AXIS_ACTUATION, 0.9, 10},
      {MO_AXIS_ACTUATION, 1.1, 10}, {MO_AXIS_ACTUATION, 1.3, 10}, {MO_AXIS_FRICTION, 0.7, 10},
      {MO_AXIS_FRICTION, 0.9, 10},  {MO_AXIS_FRICTION, 1.1, 10},  {MO_AXIS_FRICTION, 1.3, 10},
      {MO_AXIS_DROP, 0.05, 10},     {MO_AXIS_DROP, 0.2, 10},      {MO_AXIS_WORLDS, NAN, 64},
  };
  const struct mo_certificate_settings settings = mo_certificate_defaults();
  const struct mo_certificate_base base = base_of("paper-test", 0);
  uint32_t n = 0;
  const struct mo_trial *trials = trials_of(&settings, &base, &n);
  REQUIRE(n == COUNT(expected));
  for (uint32_t t = 0; t < n; t++) {
    const bool is_double = trials[t].axis == MO_AXIS_PRECISION || trials[t].axis == MO_AXIS_STEP;
    CHECK_INT(trials[t].axis, expected[t].axis);
    CHECK(trials[t].level == expected[t].level ||
          (isnan(trials[t].level) && isnan(expected[t].level)));
    CHECK_INT(trials[t].n_environments, expected[t].n);
    CHECK_INT(trials[t].precision, is_double ? MO_FLOAT64 : MO_FLOAT32);
    CHECK_INT(trials[t].is_paired, trials[t].axis != MO_AXIS_HELD_OUT);
    CHECK_INT(trials[t].measures, t == 0);
  }
}

static void chosen_axes(void)
{
  struct mo_certificate_settings settings = mo_certificate_defaults();
  const struct mo_certificate_base base = base_of("paper-test", 0);
  uint32_t n = 0;
  settings.axes = 1 << MO_AXIS_BASE;
  CHECK(trials_of(&settings, &base, &n)->measures && n == 1);
  settings.axes |= 1 << MO_AXIS_FRICTION;
  settings.n_levels = 1;
  settings.levels[0] = 0.5;
  const struct mo_trial *trials = trials_of(&settings, &base, &n);
  CHECK(n == 2 && trials[1].axis == MO_AXIS_FRICTION && trials[1].level == 0.5);
}

/* ---- physics ---- */

static void steps(void)
{
  const struct mo_certificate_settings settings = mo_certificate_defaults();
  struct mo_certificate_base base = base_of("paper-test", 0);
  for (int has_period = 0; has_period < 2; has_period++) {
    uint32_t n = 0;
    base.physics.scheme.control_period_s = has_period ? 0.016 : 0;
    const struct mo_trial *trials = trials_of(&settings, &base, &n);
    for (uint32_t k = 0; k < 2; k++) {
      struct mo_physics by_hand = base.physics;
      by_hand.scheme.dt_s = k == 0 ? 0.001 : 0.0005;
      by_hand.scheme.n_steps = k == 0 ? 4000 : 8000;
      by_hand.scheme.control_period_s = has_period ? 0.016 : 0.002;
      CHECK(SAME(&find_trial(trials, n, MO_AXIS_STEP, k)->physics, &by_hand, 1));
      CHECK_OK(mo_physics_check(&by_hand, NULL));
    }
    struct mo_physics higher = base.physics;
    higher.drop_height_m = 0.2;
    CHECK(SAME(&find_trial(trials, n, MO_AXIS_DROP, 1)->physics, &higher, 1));
    for (uint32_t t = 0; t < n; t++)
      if (trials[t].axis != MO_AXIS_STEP && trials[t].axis != MO_AXIS_DROP)
        CHECK(SAME(&trials[t].physics, &base.physics, 1));
  }
}

/* Every factor axis multiplies its own constant, and no other, of worlds that have factors, too. */
static void factors(void)
{
  const struct mo_certificate_settings settings = mo_certificate_defaults();
  const struct mo_certificate_base base = base_of("paper-test", 0);
  uint32_t n = 0;
  worlds_of(&base)[3].factors = (struct mo_factors){1, 2, 1, 1, 1, 1, 0.5};
  worlds_of(&base)[4].factors = (struct mo_factors){1, 1, 1, 1, 1, 1, 1 / 0.7};
  const struct mo_trial *trials = trials_of(&settings, &base, &n);
  for (uint32_t t = 0; t < n; t++) {
    if (trials[t].axis < MO_AXIS_STIFFNESS || trials[t].axis > MO_AXIS_FRICTION)
      continue;
    const struct mo_environment *worlds = environments_of(&settings, &base, &trials[t]);
    for (uint32_t k = 0; k < 10; k++) {
      struct mo_factors by_hand = *factors_at(&base.environments[k]);
      double *const of_axis[] = {&by_hand.stiffness, &by_hand.mass,      &by_hand.drag,
                                 &by_hand.gravity,   &by_hand.actuation, &by_hand.friction};
      *of_axis[trials[t].axis - MO_AXIS_STIFFNESS] *= trials[t].level;
      CHECK(is_same_factors(factors_at(&worlds[k]), &by_hand));
      CHECK(is_same_place(&worlds[k], &base.environments[k]));
      CHECK_OK(mo_environment_check(&worlds[k], NULL)); /* also for the product 1 */
    }
  }
}

static void chance(void)
{
  const struct mo_certificate_settings settings = mo_certificate_defaults();
  const struct mo_certificate_base base = base_of("paper-test", 0);
  const struct mo_trial *trial = trial_of(&settings, &base, MO_AXIS_CHANCE);
  const struct mo_environment *worlds = environments_of(&settings, &base, trial);
  double least = INFINITY, most = 0;
  for (uint32_t k = 0; k < trial->n_environments; k++) {
    const struct mo_factors *f = factors_at(&worlds[k]);
    const double of[] = {f->stiffness, f->mass, f->drag, f->gravity, f->actuation, f->friction};
    CHECK(is_same_place(&worlds[k], &base.environments[k % 10]));
    CHECK(is_same_factors(f, factors_at(&worlds[k - k % 10]))); /* one set of factors in a copy */
    CHECK(k < 10 || !is_same_factors(f, factors_at(&worlds[k - 10])));
    for (size_t i = 0; i < COUNT(of); i++) {
      CHECK(of[i] != 1 && fabs(of[i] - 1) <= 1e-4);
      least = fmin(least, of[i]);
      most = fmax(most, of[i]);
    }
  }
  CHECK(least < 1 - 0.9e-4 && most > 1 + 0.9e-4);
}

static void worlds(void)
{
  struct mo_certificate_settings settings = mo_certificate_defaults();
  const struct mo_certificate_base base = base_of("paper-test", 0);
  uint32_t low_friction = 0;
  const struct mo_trial *trial = trial_of(&settings, &base, MO_AXIS_WORLDS);
  const struct mo_environment *drawn = environments_of(&settings, &base, trial);
  for (uint32_t k = 0; k < trial->n_environments; k++) {
    const struct mo_factors *f = factors_at(&drawn[k]);
    CHECK(is_same_place(&drawn[k], &base.environments[k % 10]));
    CHECK(f->mass >= 0.7 && f->mass <= 1.3 && f->friction >= 1.0 / 3 && f->friction <= 4.0 / 3);
    low_friction += f->friction < 1.0 / 3 + 0.5;
  }
  CHECK_INT(low_friction, 32); /* half of a Latin hypercube, exactly */
  /* The draws of stored certificates, and not those of a training run or request with this seed. */
  struct mo_factors expected[64], others[64];
  REQUIRE_OK(mo_factors_draw(&settings.ranges, 1, UINT32_MAX - 1, 64, expected));
  REQUIRE_OK(mo_factors_draw(&settings.ranges, 1, 0, 64, others));
  CHECK(is_same_factors(factors_at(&drawn[5]), &expected[5]));
  CHECK(!is_same_factors(factors_at(&drawn[5]), &others[5]));
  const struct mo_environment *again = environments_of(&settings, &base, trial);
  CHECK(are_same(drawn, again, trial->n_environments));
  settings.seed = 2;
  CHECK(!are_same(drawn, environments_of(&settings, &base, trial), trial->n_environments));
}

/* A level through an environment's factors computes what its physics, edited by hand, computes. */
static void levels_have_their_effect(void)
{
  const struct mo_certificate_settings settings = mo_certificate_defaults();
  struct mo_certificate_base base = base_of("paper-test", 0);
  const struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  const struct mo_controller *controller = make_shipped_controller("phototaxis");
  const struct mo_robot *robots = make_robots(lattice, 5, 1, 1);
  uint32_t n = 0;
  base.physics.scheme.n_steps = 200;
  const struct mo_trial *trials = trials_of(&settings, &base, &n);
  struct mo_outcome before;
  REQUIRE_OK(mo_rollout_reference(robots[0].body, controller, base.environments, &base.physics,
                                  NULL, NULL, &before));
  for (uint32_t t = 1; t < n; t++) {
    struct mo_physics by_hand = base.physics;
    struct mo_constants *c = &by_hand.constants;
    double *const of_axis[] = {&c->stiffness_n_per_m, &c->mass_kg,   &c->drag_per_s,
                               &c->gravity_m_per_s2,  &c->actuation, &c->friction};
    const enum mo_axis axis = trials[t].axis;
    if (axis == MO_AXIS_STEP) {
      by_hand.scheme.control_period_s = 0.002;
      by_hand.scheme.dt_s = 0.002 / trials[t].level;
      by_hand.scheme.n_steps = (uint32_t)(200 * trials[t].level);
    } else if (axis == MO_AXIS_DROP) {
      by_hand.drop_height_m = trials[t].level;
    } else if (axis >= MO_AXIS_STIFFNESS && axis <= MO_AXIS_FRICTION) {
      *of_axis[axis - MO_AXIS_STIFFNESS] *= trials[t].level;
    } else {
      continue;
    }
    const struct mo_environment *worlds = environments_of(&settings, &base, &trials[t]);
    struct mo_outcome here, expected;
    CHECK_OK(mo_rollout_reference(robots[0].body, controller, &worlds[0], &trials[t].physics, NULL,
                                  NULL, &here));
    CHECK_OK(mo_rollout_reference(robots[0].body, controller, &base.environments[0], &by_hand, NULL,
                                  NULL, &expected));
    CHECK(here.loss == expected.loss);
    CHECK(here.loss != before.loss);
  }
}

/* ---- fresh worlds ---- */

static void held_out_of_sets(void)
{
  struct mo_certificate_settings settings = mo_certificate_defaults();
  struct mo_environment expected[MO_SET_ENVIRONMENTS_MAX];
  struct mo_message note;
  settings.axes = 1 << MO_AXIS_BASE | 1 << MO_AXIS_HELD_OUT;
  for (int i = 0; mo_set_words[i] != NULL; i++) {
    const struct mo_certificate_base base = base_of(mo_set_words[i], 0);
    const struct mo_trial *trial = trial_of(&settings, &base, MO_AXIS_HELD_OUT);
    if (i > 0 && i % 2 == 0) {
      CHECK(trial == NULL);
      CHECK_HAS(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT), "already a held-out set");
      CHECK(!mo_certificate_note(&settings, &base, MO_AXIS_HELD_OUT, &note));
      continue;
    }
    REQUIRE(trial != NULL);
    CHECK(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT) == NULL);
    CHECK(mo_certificate_note(&settings, &base, MO_AXIS_HELD_OUT, &note));
    const struct mo_environment *fresh = environments_of(&settings, &base, trial);
    if (i == 0) {
      CHECK_INT(trial->n_environments, 256);
      CHECK_SAYS(note, "as training draws them");
      for (uint32_t k = 0; k < 256; k++) {
        mo_environment_held_out(1, k, &expected[0]);
        CHECK(is_same(&fresh[k], &expected[0]));
      }
    } else {
      CHECK_INT(trial->n_environments, 64);
      CHECK_SAYS(note, "64 worlds instead of 256");
      CHECK(mo_environment_set(i + 1, expected) == 64 && are_same(fresh, expected, 64));
    }
  }
  settings.held_out = 20;
  const struct mo_certificate_base base = base_of("morpho-12-walk", 0);
  CHECK_INT(trial_of(&settings, &base, MO_AXIS_HELD_OUT)->n_environments, 20);
  CHECK(!mo_certificate_note(&settings, &base, MO_AXIS_HELD_OUT, &note));
}

static void held_out_of_lists(void)
{
  struct mo_certificate_settings settings = mo_certificate_defaults();
  const struct mo_certificate_base base = base_of(NULL, 5);
  struct mo_environment *own = worlds_of(&base), kept = own[2];
  struct mo_message note;
  own[1].damage = (struct mo_damage){3, 1.5};
  own[3].factors = (struct mo_factors){1, 1, 1, 1, 1, 1, 0.5};
  own[4].task.guide = (struct mo_guide){.kind = MO_GUIDE_AHEAD, .distance_m = 1.5};
  own[4].task.objective = MO_OBJECTIVE_TRAVEL;
  own[4].light_xy_m[0] = own[4].light_xy_m[1] = 0;
  CHECK_OK(mo_environment_check(&own[4], NULL));
  const struct mo_trial *trial = trial_of(&settings, &base, MO_AXIS_HELD_OUT);
  REQUIRE(trial != NULL);
  CHECK(mo_certificate_note(&settings, &base, MO_AXIS_HELD_OUT, &note));
  CHECK_SAYS(note, "of the list in turn");
  CHECK(strstr(note.text, "only") == NULL);
  settings.held_out = 3; /* two of the five tasks have no world */
  CHECK(mo_certificate_note(&settings, &base, MO_AXIS_HELD_OUT, &note));
  CHECK_SAYS(note, "in turn; only those of the first 3 of the list's 5 worlds");
  settings.held_out = 256;
  const struct mo_environment *fresh = environments_of(&settings, &base, trial);
  for (uint32_t k = 0; k < trial->n_environments; k++) {
    struct mo_environment drawn;
    mo_environment_held_out(1, k, &drawn);
    CHECK(SAME(fresh[k].terrain_heights_m, drawn.terrain_heights_m, MO_TERRAIN_HEIGHTS));
    CHECK(SAME(&fresh[k].task, &own[k % 5].task, 1) &&
          SAME(&fresh[k].damage, &own[k % 5].damage, 1) &&
          SAME(&fresh[k].factors, &own[k % 5].factors, 1));
    CHECK(k % 5 == 4 || SAME(fresh[k].light_xy_m, drawn.light_xy_m, 2));
    CHECK_OK(mo_environment_check(&fresh[k], NULL));
  }

  set_profile(&own[2], 0, 0.05);
  CHECK_HAS(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT), "lists with 8 x 8 heights");
  CHECK(trial_of(&settings, &base, MO_AXIS_HELD_OUT) == NULL);
  own[2] = kept;
  set_grid(&own[2], 0, 0.05);
  CHECK_HAS(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT), "lists with 8 x 8 heights");
  own[2] = kept;
  for (int i = 0; i < MO_TERRAIN_HEIGHTS; i++)
    own[2].terrain_heights_m[i] = MO_TERRAIN_FLOOR_M; /* level */
  CHECK_HAS(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT),
            "not of the kind that training");
  mo_terrain_random(1, 0, 0, 0.3, own[2].terrain_heights_m);
  CHECK_HAS(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT),
            "not of the kind that training");
  own[2] = kept;
  for (int i = 0; i < MO_TERRAIN_HEIGHTS; i++)
    own[2].terrain_heights_m[i] += 0.01;
  CHECK_HAS(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT),
            "not of the kind that training");
  own[2] = kept;
  own[2].light_xy_m[0] = 6;
  CHECK_HAS(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT), "lights");
  own[2] = kept;
  CHECK(mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT) == NULL);
}

/* The test of roughness accepts every world that training draws. */
static void training_worlds_are_accepted(void)
{
  struct mo_certificate_base base = base_of(NULL, 1);
  const struct mo_certificate_settings settings = mo_certificate_defaults();
  uint32_t refused = 0;
  for (uint32_t k = 0; k < 20000; k++) {
    mo_environment_training(3, k, 0, worlds_of(&base));
    refused += mo_certificate_omits(&settings, &base, MO_AXIS_HELD_OUT) != NULL;
  }
  CHECK_INT(refused, 0);
}

/* ---- what does not apply ---- */

/* Checks that an axis has `levels` trials and, if none, this reason; else a note (NULL: none). */
static void expect(const struct mo_certificate_base *base, enum mo_axis axis, uint32_t levels,
                   const char *says)
{
  const struct mo_certificate_settings settings = mo_certificate_defaults();
  struct mo_message note = {""};
  uint32_t n = 0, found = 0;
  const struct mo_trial *trials = trials_of(&settings, base, &n);
  for (uint32_t t = 0; t < n; t++)
    found += trials[t].axis == axis;
  CHECK_INT(found, levels);
  if (levels == 0) {
    CHECK_HAS(mo_certificate_omits(&settings, base, axis), says);
    return;
  }
  CHECK(mo_certificate_omits(&settings, base, axis) == NULL);
  CHECK_INT(mo_certificate_note(&settings, base, axis, &note), says != NULL);
  CHECK_SAYS(note, says != NULL ? says : "");
  for (uint32_t t = 0; t < n; t++) {
    struct mo_environment *worlds = environments_of(&settings, base, &trials[t]);
    for (uint32_t k = 0; k < trials[t].n_environments; k++)
      CHECK_OK(mo_physics_check_in(&trials[t].physics, &worlds[k], NULL, NULL));
  }
}

static void omitted(void)
{
  const struct mo_certificate_base usual = base_of("paper-test", 0);
  struct mo_certificate_base base = usual;
  for (enum mo_axis axis = MO_AXIS_STEP; axis < MO_AXES; axis++)
    if (axis != MO_AXIS_HELD_OUT)
      expect(&base, axis,
             axis == MO_AXIS_STEP || axis == MO_AXIS_DROP       ? 2
             : axis >= MO_AXIS_STIFFNESS && axis < MO_AXIS_DROP ? 4
                                                                : 1,
             NULL);
  base.precision = MO_FLOAT64;
  expect(&base, MO_AXIS_PRECISION, 0, "already computed in float64");
  expect(&base, MO_AXIS_STEP, 2, NULL);
  base = usual;
  base.physics.scheme.n_steps = 500000;
  expect(&base, MO_AXIS_STEP, 1, "levels left out: 4, out of range");
  base.physics.scheme.n_steps = 500001;
  expect(&base, MO_AXIS_STEP, 0, "more than 1000000");
  base = usual;
  base.physics.scheme.impact = MO_IMPACT_BISECTION;
  expect(&base, MO_AXIS_STEP, 2, NULL);
  base = usual;
  base.physics.constants.friction = 0;
  expect(&base, MO_AXIS_FRICTION, 0, "0 in all worlds");
  base = usual;
  base.physics.constants.actuation = 0.8;
  expect(&base, MO_AXIS_ACTUATION, 3, "levels left out: 1.3, out of range");
  expect(&base, MO_AXIS_WORLDS, 0, "use narrower ranges");
  base = usual;
  base.physics.drop_height_m = 999.9;
  expect(&base, MO_AXIS_DROP, 1, "levels left out: 0.2, out of range");
  base.physics.drop_height_m = 1000;
  expect(&base, MO_AXIS_DROP, 0, "drop height");
  base = usual;
  base.physics.constants.gravity_m_per_s2 = 1000;
  expect(&base, MO_AXIS_CHANCE, 0, "at a bound");
  base = usual;
  base.physics.scheme.dt_s = 0.00395; /* the paper's stiffness at twice the step: near the bound */
  expect(&base, MO_AXIS_MASS, 4, "at 0.7, the springs of some bodies are unstable");
  expect(&base, MO_AXIS_WORLDS, 1, "in some of the worlds, the springs");
  expect(&base, MO_AXIS_STEP, 2, NULL);
}

static void omitted_by_worlds(void)
{
  const struct mo_certificate_base base = base_of("paper-test", 0);
  worlds_of(&base)[9].factors = (struct mo_factors){1, 1, 100, 1, 1, 1, 1};
  expect(&base, MO_AXIS_MASS, 2, "levels left out: 1.1 1.3, out of range");
  for (int k = 0; k < 10; k++)
    worlds_of(&base)[k].factors = (struct mo_factors){1, 1, 1, 0, 1, 1, 1};
  expect(&base, MO_AXIS_DRAG, 0, "0 in all worlds");
  struct mo_certificate_settings settings = mo_certificate_defaults();
  settings.ranges = mo_factors_constant();
  CHECK_HAS(mo_certificate_omits(&settings, &base, MO_AXIS_WORLDS), "no constant varies");
  settings.worlds = 3;
  settings.ranges = mo_certificate_defaults().ranges;
  struct mo_message note;
  CHECK(mo_certificate_note(&settings, &base, MO_AXIS_WORLDS, &note));
  CHECK_SAYS(note, "only in the first 3 of the base's 10 worlds");
  settings.axes = 1 << MO_AXIS_BASE;
  CHECK(mo_certificate_omits(&settings, &base, MO_AXIS_DRAG) == NULL); /* not requested */
}

/* The settings of an imported campaign may ask for worlds that nobody checked. */
static void held_out_that_do_not_exist(void)
{
  static struct mo_environment environments[1024];
  struct mo_certificate_base base = {.set = "morpho-12-walk"};
  CHECK_OK(mo_fresh_worlds(&base, 1, 64, environments));
  CHECK_INT(mo_fresh_worlds(&base, 1, 65, environments), MO_ERR_RANGE);
  base.set = "morpho-12-walk-held-out";
  CHECK_INT(mo_fresh_worlds(&base, 1, 2, environments), MO_ERR_RANGE);
  base.set = "paper-test";
  CHECK_OK(mo_fresh_worlds(&base, 1, 1024, environments));
}

static const struct check_case cases[] = {
    {"all axes and levels, in order", all_axes},
    {"only the axes that are requested", chosen_axes},
    {"finer steps keep duration and control times", steps},
    {"a factor axis multiplies one constant", factors},
    {"chance: copies with nearly the same constants", chance},
    {"worlds: constants by Latin hypercube", worlds},
    {"a level computes what physics edited by hand does", levels_have_their_effect},
    {"held out: sets", held_out_of_sets},
    {"held out: lists", held_out_of_lists},
    {"held out: worlds that do not exist", held_out_that_do_not_exist},
    {"held out: every world of trainings is accepted", training_worlds_are_accepted},
    {"axes that do not apply", omitted},
    {"axes that do not apply to the worlds", omitted_by_worlds},
};
CHECK_MAIN(cases)
