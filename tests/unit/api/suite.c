/* suite.c: a rollout that diverged leaves its design out of its task, and nothing else. */
#include <math.h>

#include "api/suite.h"

#include "../check.h"

enum { DESIGNS = 3, EACH = 2, WORLDS = EACH * MO_SUITE_TASKS, TASK = 4, WORLD = EACH * TASK + 1 };

static struct mo_environment environments[WORLDS]; /* reach: the value is 1 − loss */
static double losses[DESIGNS * WORLDS];
static int32_t diverged_steps[DESIGNS * WORLDS];
static const struct mo_evaluation_results results = {.n_designs = DESIGNS,
                                                     .n_environments = WORLDS,
                                                     .losses = losses,
                                                     .diverged_steps = diverged_steps};

static double loss_at(uint32_t d, uint32_t k)
{
  return 0.25 * d + 0.125 * (k % EACH) + k / EACH / 64.0; /* sums of these are exact */
}

/* In design 1 one rollout diverged. */
static void fill(void)
{
  for (uint32_t d = 0; d < DESIGNS; d++)
    for (uint32_t k = 0; k < WORLDS; k++)
      losses[d * WORLDS + k] = loss_at(d, k);
  losses[WORLDS + WORLD] = (double)INFINITY;
  diverged_steps[WORLDS + WORLD] = 17;
}

static double mean_of(uint32_t d, uint32_t task)
{
  return (loss_at(d, EACH * task) + loss_at(d, EACH * task + 1)) / EACH;
}

static void a_divergence_leaves_out_one_task(void)
{
  fill();
  for (uint32_t d = 0; d < DESIGNS; d++) {
    const struct mo_suite_scores scores = mo_suite_scores(&results, d, environments);
    double sum = 0;
    for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
      const bool is_out = d == 1 && t == TASK;
      CHECK_INT(scores.n[t], is_out);
      CHECK(is_out ? isnan(scores.losses[t]) && isnan(scores.values[t])
                   : scores.losses[t] == mean_of(d, t) && scores.values[t] == 1 - mean_of(d, t));
      sum += is_out ? 0 : mean_of(d, t);
    }
    CHECK_INT(scores.n_left_out, d == 1);
    CHECK(scores.mean_loss == sum / (MO_SUITE_TASKS - (d == 1)));
  }
}

static void means_count_the_other_designs(void)
{
  fill();
  const struct mo_suite_scores means = mo_suite_means(&results, environments);
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
    const double all = mean_of(0, t) + (t == TASK ? 0 : mean_of(1, t)) + mean_of(2, t);
    CHECK_INT(means.n[t], t == TASK ? 2 : 3);
    CHECK(means.losses[t] == all / means.n[t]);
  }
  CHECK_INT(means.n_left_out, 0);
}

/* Without any loss, there is no mean. */
static void nothing_is_not_zero(void)
{
  fill();
  for (uint32_t k = 0; k < WORLDS; k++)
    losses[k] = (double)INFINITY;
  const struct mo_suite_scores scores = mo_suite_scores(&results, 0, environments);
  CHECK_INT(scores.n_left_out, MO_SUITE_TASKS);
  CHECK(isnan(scores.mean_loss));
}

static const struct check_case cases[] = {
    {"a divergence leaves out one task", a_divergence_leaves_out_one_task},
    {"means count the other designs", means_count_the_other_designs},
    {"nothing is not zero", nothing_is_not_zero},
};
CHECK_MAIN(cases)
