/* campaign_told.c: the generations of a study, whose children its client makes, and whose survivors
 * it may choose. */
#include <stdlib.h>

#include "jobs/campaign_run.h"

int mo_campaign_read_told(struct mo_campaign_run *run)
{
  const uint32_t most = run->settings->population;
  int error = MO_OK;
  if (run->told == NULL)
    error = mo_store_study_batch(run->jobs->store, run->id, &run->told);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  struct mo_study_batch *batch = run->told;
  if (batch->number != run->generation || batch->n_children > most)
    return MO_ERR_CORRUPT;
  for (uint32_t i = 0; i < batch->n_children && error == MO_OK; i++) {
    const struct mo_descent *descent = &batch->children[i].descent;
    run->rows->births[i] = (struct mo_birth){.op = (enum mo_operator)descent->op,
                                             .parents = {descent->parents[0], descent->parents[1]},
                                             .attempts = 1};
    run->variation.mutants += descent->op == MO_BORN_MUTATION;
    run->variation.recombinants += descent->op == MO_BORN_CROSSOVER;
    error = mo_genotype_move(MO_DEFAULT_WORKSPACE, batch->children[i].genotype.words,
                             run->settings->workspace,
                             run->rows->genotypes + run->words * (run->n_parents + i));
  }
  run->variation.mutation_attempts = run->variation.mutants;
  run->variation.crossover_attempts = run->variation.recombinants;
  return error;
}

static int by_number(const void *a, const void *b)
{
  const uint32_t x = *(const uint32_t *)a, y = *(const uint32_t *)b;
  return x < y ? -1 : x > y;
}

int mo_campaign_select_told(struct mo_campaign_run *run)
{
  const struct mo_study_batch *batch = run->told;
  const uint32_t n = run->n_parents + run->n_children;
  struct mo_campaign_settings settings = *run->settings;
  struct mo_candidate *candidates = calloc((size_t)n + 1, sizeof(*candidates));
  uint32_t *places = calloc((size_t)n + 1, sizeof(*places)), n_kept = 0;
  int error = candidates == NULL || places == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  qsort(batch->survivors, batch->n_survivors, sizeof(*batch->survivors), by_number);
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    if (i < run->n_parents && bsearch(&run->rows->numbers[i], batch->survivors, batch->n_survivors,
                                      sizeof(*batch->survivors), by_number) == NULL)
      continue;
    candidates[n_kept] =
        (struct mo_candidate){run->rows->scores[i], run->rows->numbers[i], run->rows->born[i]};
    places[n_kept++] = i;
  }
  settings.selection.kind = MO_SELECT_TRUNCATION; /* of all: it only ranks them */
  settings.population = n_kept;
  if (error == MO_OK)
    error = mo_select(&settings, run->generation, NULL, candidates, n_kept, run->rows->survivors,
                      &run->n_survivors);
  for (uint32_t i = 0; i < run->n_survivors && error == MO_OK; i++)
    run->rows->survivors[i] = places[run->rows->survivors[i]];
  free(candidates);
  free(places);
  return error;
}
