/* memory.c: every allocation of this room fails once. Each time the function must report the error,
 * leave its outputs unchanged, and leak nothing (checked by the address sanitizer). */
#include "fixture.h"

#include "../failing.h"

static struct mo_certificate_settings settings;
static struct mo_certificate_base base;
static struct mo_environment worlds[MO_SET_ENVIRONMENTS_MAX * 16];
static struct mo_trial trial;

static int make_trials(void)
{
  struct mo_trial *trials = NULL;
  uint32_t n = 99;
  const int r = mo_certificate_trials(&settings, &base, &trials, &n);
  CHECK((trials != NULL) == (r == MO_OK) && (n == 99) == (r != MO_OK));
  free(trials);
  return r;
}

static int make_worlds(void)
{
  worlds[0].light_xy_m[0] = 99;
  const int r = mo_certificate_environments(&settings, &base, &trial, worlds);
  CHECK((worlds[0].light_xy_m[0] == 99) == (r != MO_OK));
  return r;
}

static int make_figures(void)
{
  static const float base_losses[] = {1, 2, 3, 4}, losses[] = {2, 3, 4, 5};
  static const struct mo_trial trials[] = {{.axis = MO_AXIS_BASE, .n_environments = 2},
                                           {.axis = MO_AXIS_HELD_OUT, .n_environments = 2}};
  const float *const of_trials[] = {base_losses, losses};
  struct mo_trial_score scores[4] = {{.score = 99}};
  struct mo_trial_list lists[2];
  const int r = mo_certificate_figures(&settings, trials, 2, of_trials, 2, scores, lists);
  CHECK((scores[0].score == 99) == (r != MO_OK));
  return r;
}

static void setup(void)
{
  settings = mo_certificate_defaults();
  base = base_of("morpho-12-walk", 0);
}

static void trials(void)
{
  each_fails(make_trials, 1);
}

static void environments(void)
{
  static const enum mo_axis axes[] = {MO_AXIS_HELD_OUT, MO_AXIS_CHANCE, MO_AXIS_FRICTION,
                                      MO_AXIS_WORLDS};
  for (size_t i = 0; i < COUNT(axes); i++) {
    trial = *trial_of(&settings, &base, axes[i]);
    each_fails(make_worlds, 1);
  }
}

static void figures(void)
{
  each_fails(make_figures, 2);
}

static const struct check_case cases[] = {
    {"trials", trials},
    {"environments", environments},
    {"figures", figures},
};
CHECK_MAIN_WITH(setup, cases)
