/* figures.c: computes figures from losses: scores of designs, and how a list of designs changes. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "certificate/statistics.h"

/* The inputs of a certificate's figures, and memory for computing them. */
struct work {
  const struct mo_trial *trials;
  const float *const *losses;
  uint32_t n_designs, n_base, n_top;
  double *values, *differences, *scratch; /* (worlds of a trial) */
  double *base, *here, *without;          /* (n_designs) */
  uint32_t *order;                        /* (n_designs) the base's, best first */
};

uint32_t mo_certificate_top(const struct mo_certificate_settings *settings, uint32_t n_designs)
{
  const uint32_t tenth = n_designs >= 20 ? n_designs / 10 : 1;
  const uint32_t top = settings->top > 0 ? settings->top : tenth;
  return top < n_designs ? top : n_designs;
}

/* ---- designs ---- */

/* Returns how many copies of the base's list of worlds a trial has; more than one only on the axis
 * `chance`. */
static uint32_t lists_of(const struct work *work, const struct mo_trial *trial)
{
  return trial->axis == MO_AXIS_CHANCE ? trial->n_environments / work->n_base : 1;
}

static const float *losses_of(const struct work *work, uint32_t t, uint32_t design)
{
  return work->losses[t] + (size_t)design * work->trials[t].n_environments;
}

static uint32_t count_diverged(const float *losses, uint32_t n)
{
  uint32_t diverged = 0;
  for (uint32_t k = 0; k < n; k++)
    diverged += !isfinite(losses[k]);
  return diverged;
}

/* Returns the mean loss over the worlds of the base's list number `list`. */
static double list_score(const struct work *work, uint32_t t, uint32_t design, uint32_t list)
{
  const struct mo_trial *trial = &work->trials[t];
  const uint32_t n = trial->n_environments / lists_of(work, trial);
  const float *losses = losses_of(work, t, design) + (size_t)list * n;
  for (uint32_t k = 0; k < n; k++)
    work->values[k] = (double)losses[k];
  return mo_pairwise_sum(work->values, n) / n;
}

/* Scores a design by its scores in all copies of the base's worlds. */
static void score_copies(const struct work *work, uint32_t t, uint32_t design, double base_score,
                         struct mo_trial_score *score)
{
  const uint32_t copies = lists_of(work, &work->trials[t]);
  for (uint32_t c = 0; c < copies; c++)
    work->differences[c] = list_score(work, t, design, c);
  struct mo_mean mean = mo_mean_of_units(work->differences, copies, copies, work->scratch);
  score->score = mean.mean;
  score->interval = mo_mean_interval(&mean, copies + 1.0); /* the variance of one more copy, plus
                                                              that of the mean */
  mean.mean -= base_score;
  score->change = mean.mean;
  score->of_change = mo_mean_interval(&mean, copies + 1.0);
}

/* Scores a design by its losses in the worlds. base: finite. */
static void score_worlds(const struct work *work, uint32_t t, uint32_t design,
                         struct mo_trial_score *score)
{
  const struct mo_trial *trial = &work->trials[t];
  const float *losses = losses_of(work, t, design), *base = losses_of(work, 0, design);
  const uint32_t n = trial->n_environments;
  /* The independent worlds: those of the base, if a trial repeats them. If the base has a single
   * world, every world of the trial counts as independent. */
  const uint32_t units = trial->is_paired && work->n_base > 1 ? work->n_base : n;
  for (uint32_t k = 0; k < n; k++) {
    work->values[k] = (double)losses[k];
    work->differences[k] = (double)losses[k] - (double)base[k % work->n_base];
  }
  const struct mo_mean mean = mo_mean_of_units(work->values, n, units, work->scratch);
  score->score = mean.mean;
  score->interval = mo_mean_interval(&mean, 1);
  if (t == 0 || count_diverged(base, work->n_base) > 0)
    return;
  if (trial->is_paired) {
    const struct mo_mean change = mo_mean_of_units(work->differences, n, units, work->scratch);
    score->change = change.mean;
    score->of_change = mo_mean_interval(&change, 1);
    return;
  }
  for (uint32_t k = 0; k < work->n_base; k++)
    work->values[k] = (double)base[k];
  const struct mo_mean of_base =
      mo_mean_of_units(work->values, work->n_base, work->n_base, work->scratch);
  score->change = mean.mean - of_base.mean;
  score->of_change = mo_welch_interval(&mean, &of_base);
}

static void score_design(const struct work *work, uint32_t t, uint32_t design,
                         const struct mo_trial_score *base, struct mo_trial_score *score)
{
  const struct mo_trial *trial = &work->trials[t];
  *score =
      (struct mo_trial_score){NAN, MO_UNKNOWN_INTERVAL, NAN, MO_UNKNOWN_INTERVAL, .diverged = 0};
  score->diverged = count_diverged(losses_of(work, t, design), trial->n_environments);
  if (score->diverged > 0)
    return;
  if (trial->axis == MO_AXIS_CHANCE)
    score_copies(work, t, design, base->score, score);
  else
    score_worlds(work, t, design, score);
}

static void rank_designs(uint32_t n, struct mo_trial_score *scores)
{
  for (uint32_t i = 0; i < n; i++) {
    scores[i].rank = 1;
    for (uint32_t k = 0; k < n; k++)
      scores[i].rank +=
          isnan(scores[i].score) ? !isnan(scores[k].score) : scores[k].score < scores[i].score;
  }
}

/* ---- lists ---- */

/* Sorts designs by their scores, best first, diverged ones last, ties in their original order.
 * Returns how many have a score. */
static uint32_t sort_designs(const struct mo_trial_score *scores, uint32_t n, uint32_t *order)
{
  uint32_t sound = 0;
  for (uint32_t i = 0; i < n; i++) {
    uint32_t at = i;
    sound += !isnan(scores[i].score);
    while (at > 0 && scores[order[at - 1]].rank > scores[i].rank) {
      order[at] = order[at - 1];
      at--;
    }
    order[at] = i;
  }
  return sound;
}

/* Adds the figures of the top designs by one list of scores, which are finite for all designs in
 * `list`. */
static void add_top(const struct work *work, const double *of_design, struct mo_trial_list *list)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < work->n_top; i++)
    work->scratch[i] = of_design[work->order[i]];
  const double top = mo_pairwise_sum(work->scratch, work->n_top) / work->n_top;
  for (uint32_t i = 0; i < work->n_designs; i++) { /* keeps the lowest scores, in ascending order */
    uint32_t at = n;
    if (isnan(of_design[i]) || (n == work->n_top && of_design[i] >= work->scratch[n - 1]))
      continue;
    if (n < work->n_top)
      n++;
    else
      at--;
    while (at > 0 && work->scratch[at - 1] > of_design[i]) {
      work->scratch[at] = work->scratch[at - 1];
      at--;
    }
    work->scratch[at] = of_design[i];
  }
  list->top_score += top;
  list->regret += top - mo_pairwise_sum(work->scratch, n) / n;
}

static void compare_list(const struct work *work, uint32_t t, const struct mo_trial_score *base,
                         const struct mo_trial_score *scores, struct mo_trial_list *list)
{
  const uint32_t lists = lists_of(work, &work->trials[t]), n = work->n_designs;
  struct mo_kendall kendall = {.without = work->without};
  memset(work->without, 0, n * sizeof(*work->without));
  for (uint32_t i = 0; i < n; i++)
    kendall.n_designs += !isnan(base[i].score) && !isnan(scores[i].score);
  list->top_score = list->regret = 0;
  for (uint32_t c = 0; c < lists; c++) {
    uint32_t both = 0;
    double *of_design = work->differences;
    for (uint32_t i = 0; i < n; i++) {
      of_design[i] = isnan(scores[i].score) ? (double)NAN : list_score(work, t, i, c);
      if (isnan(base[i].score) || isnan(of_design[i]))
        continue;
      work->base[both] = base[i].score;
      work->here[both++] = of_design[i];
    }
    if (both > 0)
      mo_kendall_add(&kendall, work->base, work->here);
    add_top(work, of_design, list);
  }
  list->top_score /= lists;
  list->regret = t == 0 ? (double)NAN : list->regret / lists;
  list->tau = t == 0 ? (double)NAN : mo_kendall_tau(&kendall);
  list->of_tau = isnan(list->tau) ? MO_UNKNOWN_INTERVAL : mo_kendall_interval(&kendall);
}

static void sum_up(const struct work *work, const struct mo_trial_score *scores,
                   struct mo_trial_list *list)
{
  uint32_t n = 0;
  *list = (struct mo_trial_list){0};
  for (uint32_t i = 0; i < work->n_designs; i++) {
    list->n_diverged_designs += scores[i].diverged > 0;
    if (!isnan(scores[i].score))
      work->here[n++] = scores[i].score;
  }
  list->mean_score = n > 0 ? mo_pairwise_sum(work->here, n) / n : (double)NAN;
}

/* ---- all of it ---- */

static int begin(struct work *work, uint32_t n_trials)
{
  size_t most = work->n_designs;
  for (uint32_t t = 0; t < n_trials; t++)
    most = work->trials[t].n_environments > most ? work->trials[t].n_environments : most;
  double *numbers = calloc(3 * most + (size_t)3 * work->n_designs, sizeof(*numbers));
  work->order = calloc((size_t)work->n_designs + 1, sizeof(*work->order));
  work->values = numbers;
  if (numbers == NULL || work->order == NULL)
    return MO_ERR_NO_MEMORY;
  work->differences = numbers + most;
  work->scratch = work->differences + most;
  work->base = work->scratch + most;
  work->here = work->base + work->n_designs;
  work->without = work->here + work->n_designs;
  return MO_OK;
}

int mo_certificate_figures(const struct mo_certificate_settings *settings,
                           const struct mo_trial *trials, uint32_t n_trials,
                           const float *const *losses, uint32_t n_designs,
                           struct mo_trial_score *scores, struct mo_trial_list *lists)
{
  struct work work = {trials, losses, n_designs, n_trials > 0 ? trials[0].n_environments : 0, 0};
  const int error = begin(&work, n_trials);
  for (uint32_t t = 0; t < n_trials && error == MO_OK; t++) {
    struct mo_trial_score *here = scores + (size_t)t * n_designs;
    for (uint32_t i = 0; i < n_designs; i++)
      score_design(&work, t, i, &scores[i], &here[i]);
    rank_designs(n_designs, here);
    if (t == 0) {
      const uint32_t sound = sort_designs(scores, n_designs, work.order);
      work.n_top = mo_certificate_top(settings, n_designs);
      work.n_top = work.n_top < sound ? work.n_top : sound;
    }
    sum_up(&work, here, &lists[t]);
    if (work.n_top > 0)
      compare_list(&work, t, scores, here, &lists[t]);
    else
      lists[t].tau = lists[t].of_tau.lo = lists[t].of_tau.hi = lists[t].regret =
          lists[t].top_score = NAN;
  }
  free(work.values);
  free(work.order);
  return error;
}
