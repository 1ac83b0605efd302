/* suite.c: see suite.h. The environments of a suite are those of its tasks, task after task,
 * the same number of each. */
#include "api/suite.h"

#include <math.h>

#include "base/words.h"

int mo_suite_of(const struct mo_job *job)
{
  return mo_word_index(mo_suite_words, job->environment_set);
}

/* A rollout that diverged makes the loss of its task infinite, and its value minus infinity. */
static void finish(struct mo_suite_scores *scores)
{
  double sum = 0;
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
    if (isfinite(scores->losses[t])) {
      sum += scores->losses[t];
      continue;
    }
    scores->losses[t] = scores->values[t] = NAN;
    scores->n_left_out++;
  }
  scores->mean_loss = sum / (MO_SUITE_TASKS - scores->n_left_out); /* 0 / 0 if there is no task */
}

struct mo_suite_scores mo_suite_scores(const struct mo_evaluation_results *results, uint32_t d,
                                       const struct mo_environment *environments)
{
  const uint32_t each = results->n_environments / MO_SUITE_TASKS;
  struct mo_suite_scores scores = {.n_left_out = 0};
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
    double loss = 0, value = 0;
    for (uint32_t i = 0; i < each; i++) {
      const uint32_t k = t * each + i;
      const size_t cell = (size_t)d * results->n_environments + k;
      loss += results->losses[cell];
      value += mo_objective_value(environments[k].task.objective, results->losses[cell]);
      scores.n[t] += results->diverged_steps[cell] != 0;
    }
    scores.losses[t] = loss / each;
    scores.values[t] = value / each;
  }
  finish(&scores);
  return scores;
}

struct mo_suite_scores mo_suite_means(const struct mo_evaluation_results *results,
                                      const struct mo_environment *environments)
{
  struct mo_suite_scores means = {.n_left_out = 0};
  for (uint32_t d = 0; d < results->n_designs; d++) {
    const struct mo_suite_scores scores = mo_suite_scores(results, d, environments);
    for (uint32_t t = 0; t < MO_SUITE_TASKS; t++)
      if (isfinite(scores.losses[t])) {
        means.losses[t] += scores.losses[t];
        means.values[t] += scores.values[t];
        means.n[t]++;
      }
  }
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) { /* 0 / 0 if there is no design */
    means.losses[t] /= means.n[t];
    means.values[t] /= means.n[t];
  }
  finish(&means);
  return means;
}

enum mo_objective mo_suite_objective(const struct mo_evaluation_results *results, uint32_t task,
                                     const struct mo_environment *environments)
{
  const uint32_t each = results->n_environments / MO_SUITE_TASKS;
  return environments[(size_t)task * each].task.objective;
}

/* Writes the mean over tasks. */
static void write_mean(struct mo_text *text, const struct mo_suite_scores *scores)
{
  mo_text_open(text, "tasks_mean", "{");
  mo_text_member_number(text, "loss", scores->mean_loss);
  mo_text_open(text, "left_out", "[");
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++)
    if (!isfinite(scores->losses[t])) {
      mo_text_next(text);
      mo_text_format(text, "\"%s\"", mo_suite_task_words[t]);
    }
  mo_text_add(text, "]}");
}

void mo_suite_write_design(struct mo_text *text, const struct mo_evaluation_results *results,
                           uint32_t d, const struct mo_environment *environments)
{
  const struct mo_suite_scores scores = mo_suite_scores(results, d, environments);
  mo_text_open(text, "tasks", "{");
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
    mo_text_open(text, mo_suite_task_words[t], "{");
    mo_text_member_number(text, "loss", scores.losses[t]);
    mo_text_member_number(text, "value", scores.values[t]);
    mo_text_member(text, "unit", mo_objective_unit(mo_suite_objective(results, t, environments)));
    mo_text_member_count(text, "diverged", scores.n[t]);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "}");
  write_mean(text, &scores);
}

void mo_suite_write(struct mo_text *text, int suite, const struct mo_evaluation_results *results,
                    const struct mo_environment *environments)
{
  struct mo_suite_scores means = {.n_left_out = 0};
  if (results != NULL)
    means = mo_suite_means(results, environments);
  mo_text_open(text, "suite", "{");
  mo_text_member(text, "name", mo_word(mo_suite_words, suite));
  mo_text_open(text, "tasks", "[");
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
    mo_text_object(text);
    mo_text_member(text, "task", mo_suite_task_words[t]);
    mo_text_member(text, "environments", mo_suite_set(suite, t));
    if (results != NULL) {
      mo_text_member(text, "unit", mo_objective_unit(mo_suite_objective(results, t, environments)));
      mo_text_member_number(text, "mean_loss", means.losses[t]);
      mo_text_member_number(text, "mean_value", means.values[t]);
      mo_text_member_count(text, "left_out", results->n_designs - means.n[t]);
    }
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]}");
}
