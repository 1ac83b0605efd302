/* campaign_vary.c: the children of a generation, by variation or from the client of a study. */
#include <stdlib.h>

#include "base/thread.h"
#include "jobs/campaign_excluded.h"

#define CHILDREN_PER_THREAD 1024 /* these take about a millisecond */

/* ---- bodies that must not be born ---- */

int mo_campaign_read_seen(struct mo_campaign_run *run)
{
  const struct mo_form_set *excluded = NULL;
  int error = MO_OK;
  if (!run->mode->makes_children || run->seen != NULL)
    return MO_OK;
  if (run->settings->exclude_pretraining)
    error = mo_exclusion_acquire(run, &excluded);
  if (error == MO_OK)
    error = mo_seen_create(run->settings->workspace, excluded, &run->seen);
  if (error == MO_OK)
    error = mo_store_campaign_each(run->jobs->store, run->id, mo_seen_take, run->seen);
  return error;
}

/* ---- children ---- */

static uint64_t *genotype(const struct mo_campaign_run *run, uint32_t place)
{
  return run->rows->genotypes + run->words * place;
}

static int make_first(struct mo_campaign_run *run, uint32_t *n)
{
  const struct mo_campaign_settings *settings = run->settings;
  const uint32_t n_listed = run->status.record.n_listed;
  struct mo_bits *given = NULL;
  uint32_t n_given = 0;
  int error = mo_store_job_designs(run->jobs->store, run->id, &given, &n_given);
  if (error == MO_OK && n_given > settings->population)
    error = MO_ERR_CORRUPT;
  for (uint32_t i = 0; i < n_given && error == MO_OK; i++)
    error = mo_genotype_move(run->jobs->lattice->workspace, given[i].words, settings->workspace,
                             genotype(run, i));
  free(given);
  if (error == MO_OK)
    error = mo_population_initial(settings, run->seen, run->rows->genotypes, n_given, n, NULL,
                                  &run->runner->interrupt);
  for (uint32_t i = 0; i < *n && error == MO_OK; i++)
    run->rows->births[i] = (struct mo_birth){.op = i >= n_given   ? MO_BORN_RANDOM
                                                   : i < n_listed ? MO_BORN_LISTED
                                                                  : MO_BORN_INHERITED,
                                             .parents = {MO_NO_PARENT, MO_NO_PARENT},
                                             .attempts = 1};
  return error;
}

struct describing {
  struct mo_campaign_run *run;
  atomic_int error;
};

static void describe_range(void *context, size_t first, size_t end)
{
  struct describing *describing = context;
  struct mo_campaign_run *run = describing->run;
  const struct mo_workspace home = run->jobs->lattice->workspace;
  for (uint32_t i = (uint32_t)first; i < end; i++) {
    const uint32_t place = run->n_parents + i;
    int error = mo_genotype_move(run->settings->workspace, genotype(run, place), home,
                                 run->rows->bits[place].words);
    if (error != MO_OK) {
      atomic_store(&describing->error, error);
      return;
    }
    mo_genotype_canonical(home, run->rows->bits[place].words, run->rows->forms[i].words);
    error =
        mo_design_size(run->jobs->lattice, run->rows->bits[place].words, &run->rows->sizes[place]);
    run->rows->numbers[place] = (uint32_t)(run->n_designs + i);
    run->rows->born[place] = run->generation;
    if (error != MO_OK)
      atomic_store(&describing->error, error);
  }
}

/* Converts the children for the store and the back end. */
static int describe_children(struct mo_campaign_run *run)
{
  struct describing describing = {.run = run};
  mo_parallel(1 + run->n_children / CHILDREN_PER_THREAD, run->n_children, describe_range,
              &describing);
  return atomic_load(&describing.error);
}

/* Reads the pending batch of a study, whose client makes the children. */
static int read_batch(struct mo_campaign_run *run, uint32_t *n)
{
  int error = mo_store_study_batch(run->jobs->store, run->id, &run->batch);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  const struct mo_study_batch *batch = run->batch;
  if (batch->number != run->generation || batch->n_children > run->settings->population ||
      (batch->scores != NULL) != mo_campaign_takes_scores(&run->status.record))
    return MO_ERR_CORRUPT;
  for (uint32_t i = 0; i < batch->n_children && error == MO_OK; i++) {
    const struct mo_descent *descent = &batch->children[i].descent;
    run->rows->births[i] = (struct mo_birth){.op = (enum mo_operator)descent->op,
                                             .parents = {descent->parents[0], descent->parents[1]},
                                             .attempts = 1};
    run->variation.mutants += descent->op == MO_BORN_MUTATION;
    run->variation.recombinants += descent->op == MO_BORN_CROSSOVER;
    const struct mo_genotype *born = &batch->children[i].genotype;
    error = mo_genotype_move(born->workspace, born->words, run->settings->workspace,
                             genotype(run, run->n_parents + i));
  }
  run->variation.mutation_attempts = run->variation.mutants;
  run->variation.crossover_attempts = run->variation.recombinants;
  *n = batch->n_children;
  return error;
}

int mo_campaign_vary(struct mo_campaign_run *run)
{
  const bool is_study = !run->mode->makes_children;
  uint32_t n = 0;
  int error;
  run->variation = (struct mo_variation_counts){.mutants = 0};
  run->n_children = 0;
  if (is_study)
    error = read_batch(run, &n);
  else if (run->generation == 0)
    error = make_first(run, &n);
  else
    error = mo_variation(run->settings, run->generation, run->rows->genotypes, run->n_parents,
                         run->seen, genotype(run, run->n_parents), run->rows->births, &n,
                         &run->variation, &run->runner->interrupt);
  if (error != MO_OK)
    return error;
  run->n_children = n;
  return n > 0 || is_study ? describe_children(run) : MO_ERR_EXHAUSTED;
}
