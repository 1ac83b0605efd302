/* campaign_resume.c: reads a campaign in the state of its last committed generation. */
#include <stdlib.h>

#include "jobs/campaign_run.h"
#include "store/worlds.h"

#define HISTORY_ROWS 64

/* ---- the rows of candidates ---- */

/* Allocates the rows of two generations. */
static int allocate(struct mo_campaign_run *run)
{
  const size_t n = run->settings->population, words = mo_workspace_words(run->settings->workspace);
  const size_t e = run->n_environments;
  bool is_whole = true;
  for (int i = 0; i < 2; i++) {
    struct mo_campaign_rows *rows = &run->all_rows[i];
#define MO_COLUMN(type, name, length)                                                              \
  rows->name = calloc(length, sizeof(type));                                                       \
  is_whole = is_whole && rows->name != NULL;
    MO_CAMPAIGN_COLUMNS(MO_COLUMN)
#undef MO_COLUMN
  }
  run->words = words;
  run->rows = &run->all_rows[0];
  run->other_rows = &run->all_rows[1];
  return is_whole ? MO_OK : MO_ERR_NO_MEMORY;
}

static void free_rows(struct mo_campaign_rows *rows)
{
#define MO_COLUMN(type, name, length) free(rows->name);
  MO_CAMPAIGN_COLUMNS(MO_COLUMN)
#undef MO_COLUMN
}

void mo_campaign_free_rows(struct mo_campaign_run *run)
{
  free_rows(&run->all_rows[0]);
  free_rows(&run->all_rows[1]);
}

/* ---- the store ---- */

/* Reads the maximum diversity, whether its collapse was reported, and the wall time of the newest
 * generation. */
static int read_history(struct mo_campaign_run *run)
{
  struct mo_campaign_generation *rows = calloc(HISTORY_ROWS, sizeof(*rows));
  int64_t after = -1, n = HISTORY_ROWS;
  if (rows == NULL)
    return MO_ERR_NO_MEMORY;
  while (n == HISTORY_ROWS) {
    n = mo_store_campaign_generations(run->jobs->store, run->id, after, 1, rows, HISTORY_ROWS);
    for (int64_t i = 0; i < n; i++) {
      after = rows[i].generation;
      if (rows[i].stats.diversity > run->diversity.max) {
        run->diversity.max = rows[i].stats.diversity;
        run->diversity.is_warned = false;
      }
      run->diversity.is_warned = run->diversity.is_warned || rows[i].collapse;
      run->times.generation_rollouts = rows[i].rollouts;
      if (rows[i].generation > 0) /* the time of generation 0 includes the preparation */
        run->times.generation_s = rows[i].seconds;
    }
  }
  free(rows);
  return n < 0 ? (int)n : MO_OK;
}

static int read_population(struct mo_campaign_run *run)
{
  struct mo_campaign_state *state = NULL;
  int error = mo_store_campaign_state(run->jobs->store, run->id, &state);
  if (error == MO_ERR_NOT_FOUND) /* nothing is committed yet */
    return MO_OK;
  if (error == MO_OK && state->n > run->settings->population)
    error = MO_ERR_CORRUPT;
  for (uint32_t i = 0; error == MO_OK && i < state->n; i++) {
    run->rows->bits[i] = state->genotypes[i];
    run->rows->numbers[i] = state->numbers[i];
    run->rows->born[i] = state->born[i];
    run->rows->scores[i] = state->scores[i];
    error = mo_genotype_move(run->jobs->lattice->workspace, state->genotypes[i].words,
                             run->settings->workspace, run->rows->genotypes + run->words * i);
    if (error == MO_OK)
      error = mo_design_size(run->jobs->lattice, run->rows->bits[i].words, &run->rows->sizes[i]);
  }
  if (error == MO_OK) {
    run->n_parents = state->n;
    run->generation = state->generation + 1;
    run->n_designs = state->n_designs;
    run->race.pays = state->race_pays;
    error = read_history(run);
  }
  mo_campaign_state_free(state);
  return error;
}

int mo_campaign_resume(struct mo_campaign_run *run)
{
  int error = mo_store_campaign(run->jobs->store, run->id, &run->status);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  run->mode = &mo_modes[run->settings->mode];
  run->generation = (uint32_t)(run->status.generation + 1);
  mo_campaign_enter(run, MO_PHASE_PREPARE, 0);
  error = mo_back_end_check(run->jobs, run->status.job.back_end);
  if (error == MO_OK && run->status.job.has_controller)
    error = mo_runner_load(run->runner, &run->status.job.controller_sha256, &run->controller);
  if (error == MO_OK)
    error = mo_store_job_environments(run->jobs->store, run->id, MO_JOB_CAMPAIGN,
                                      &run->environments, &run->n_environments);
  if (error == MO_OK)
    error = allocate(run);
  if (error == MO_OK)
    error = read_population(run);
  if (error == MO_OK)
    error = mo_race_read(run);
  return error;
}
