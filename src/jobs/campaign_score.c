/* campaign_score.c: the scores of a generation.
 *
 * The candidates' losses are saved at once; those of devices and other machines after a second
 * (scoring.c). If losses arrive faster than the disk writes, one transaction saves several
 * candidates. Losses that an earlier process saved are not computed again; nor, in a zero-shot
 * campaign or a study, those that `scores` holds for a body under this controller. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/campaign_run.h"

#define SAVED_AT_ONCE           1024
#define LOOK_UP_THREADS         4 /* the store has a few more connections, for others */
#define LOOK_UPS_WORTH_A_THREAD 1024

/* ---- what is known ---- */

void mo_campaign_free_scores(struct mo_campaign_run *run)
{
  mo_grid_free(&run->scoring.grid);
  free(run->losses);
  free(run->unsaved);
  run->losses = NULL;
  run->unsaved = NULL;
  run->n_scored = run->n_unsaved = run->n_done = 0;
  run->n_cached = 0;
}

static int allocate(struct mo_campaign_run *run)
{
  struct mo_grid *grid = &run->scoring.grid;
  mo_campaign_free_scores(run);
  run->first_scored = mo_mode_learns(run->settings->mode) ? 0 : run->n_parents;
  run->n_scored = run->n_parents + run->n_children - run->first_scored;
  run->losses = calloc((size_t)run->n_scored + 1, sizeof(*run->losses));
  run->unsaved = calloc((size_t)run->n_scored + 1, sizeof(*run->unsaved));
  *grid =
      (struct mo_grid){.block = mo_block_of(run->jobs, &run->status.job, &run->runner->interrupt),
                       .genotypes = run->rows->bits + run->first_scored,
                       .environments = run->environments,
                       .n_designs = run->n_scored,
                       .n_environments = run->n_environments};
  grid->block.share = run->runner->share;
  if (run->losses == NULL || run->unsaved == NULL || mo_grid_create(grid) != MO_OK)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < run->n_scored; i++) {
    run->losses[i].place = i;
    for (uint32_t k = 0; k < run->n_environments; k++)
      run->losses[i].losses[k] = NAN;
  }
  return mo_race_close(run);
}

/* Takes the saved losses of a candidate, among them those that an earlier process found stored. */
static void know(struct mo_campaign_run *run, uint32_t place, const struct mo_campaign_loss *loss)
{
  if (place >= run->n_scored || run->scoring.grid.left[place] == 0)
    return;
  run->losses[place] = *loss;
  run->losses[place].place = place;
  run->n_cached += (uint64_t)__builtin_popcountll(loss->stored);
  mo_grid_finish_design(&run->scoring.grid, place);
  run->n_done++;
}

/* Takes the stored losses of a candidate, which need not be all. */
static void know_some(struct mo_campaign_run *run, uint32_t place,
                      const struct mo_campaign_loss *known)
{
  struct mo_campaign_loss *loss = &run->losses[place];
  loss->stored = known->stored;
  for (uint32_t k = 0; k < run->n_environments; k++)
    if (known->stored >> k & 1) {
      loss->losses[k] = known->losses[k];
      loss->diverged_steps[k] = known->diverged_steps[k];
      run->n_cached++;
      run->n_done += mo_grid_finish(&run->scoring.grid, place, k);
    }
}

static int read_saved(struct mo_campaign_run *run)
{
  struct mo_campaign_loss *saved = NULL;
  size_t n = 0;
  int error = mo_store_campaign_losses(run->jobs->store, run->id, run->generation, &saved, &n);
  for (size_t i = 0; i < n && error == MO_OK; i++)
    know(run, saved[i].place, &saved[i]);
  free(saved);
  return error;
}

/* A look-up of thousands of bodies takes some tens of milliseconds, so several connections of the
 * store share it. */
struct looking {
  struct mo_campaign_run *run;
  const struct mo_bits *asked; /* (n) */
  const uint32_t *places;      /* (n) */
  pthread_mutex_t mutex;       /* of what the run knows, and of the error */
  int error;
};

static void look_up(void *context, size_t first, size_t end)
{
  struct looking *looking = context;
  struct mo_campaign_run *run = looking->run;
  struct mo_campaign_loss *known = calloc(end - first, sizeof(*known));
  const int64_t found =
      known == NULL
          ? MO_ERR_NO_MEMORY
          : mo_store_campaign_known(run->jobs->store, run->id,
                                    mo_back_end_fingerprint(run->jobs, run->status.job.back_end), 0,
                                    looking->asked + first, (uint32_t)(end - first), known);
  pthread_mutex_lock(&looking->mutex);
  if (found < 0)
    looking->error = (int)found;
  for (int64_t i = 0; i < found; i++)
    know_some(run, looking->places[first + known[i].place], &known[i]);
  pthread_mutex_unlock(&looking->mutex);
  free(known);
}

/* Finds bodies that an evaluation or another campaign has scored. Frozen controllers only. */
static int read_known(struct mo_campaign_run *run)
{
  struct mo_bits *asked = calloc((size_t)run->n_scored + 1, sizeof(*asked));
  uint32_t *places = calloc((size_t)run->n_scored + 1, sizeof(*places)), n = 0;
  struct looking looking = {
      .run = run, .asked = asked, .places = places, .mutex = PTHREAD_MUTEX_INITIALIZER};
  if (asked == NULL || places == NULL)
    looking.error = MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < run->n_scored && looking.error == MO_OK; i++)
    if (run->scoring.grid.left[i] > 0) { /* nothing of it is saved */
      asked[n] = run->rows->bits[run->first_scored + i];
      places[n++] = i;
    }
  mo_parallel(n < LOOK_UPS_WORTH_A_THREAD ? 1 : LOOK_UP_THREADS, n, look_up, &looking);
  free(asked);
  free(places);
  return looking.error;
}

/* ---- saving ---- */

struct save {
  struct mo_campaign_run *run;
  struct mo_campaign_loss *losses;
  uint32_t n;
  const char *progress;
};

static int write_losses(void *context)
{
  const struct save *save = context;
  return mo_store_campaign_save_losses(save->run->jobs->store, save->run->id, save->run->generation,
                                       save->losses, save->n, save->progress);
}

int mo_campaign_save_losses(void *context)
{
  struct mo_campaign_run *run = context;
  char progress[256];
  struct save save = {.run = run};
  int error = MO_OK;
  if (run->n_unsaved == 0 || (!run->runner->winding_down && mo_campaign_is_writing(run)))
    return MO_OK; /* they wait for the commit of the previous generation */
  error = mo_campaign_settle(run);
  if (error != MO_OK)
    return error;
  save.losses =
      calloc(run->n_unsaved < SAVED_AT_ONCE ? run->n_unsaved : SAVED_AT_ONCE, sizeof(*save.losses));
  if (save.losses == NULL)
    return MO_ERR_NO_MEMORY;
  while (run->n_unsaved > 0 && error == MO_OK) {
    save.n = run->n_unsaved < SAVED_AT_ONCE ? run->n_unsaved : SAVED_AT_ONCE;
    for (uint32_t i = 0; i < save.n; i++)
      save.losses[i] = run->losses[run->unsaved[i]];
    save.progress = run->runner->winding_down ? NULL
                                              : mo_campaign_progress(run, "scoring", run->n_done,
                                                                     run->n_scored, progress);
    error = mo_runner_persist(run->runner, write_losses, &save, "the scores of a generation");
    if (error == MO_OK) {
      mo_memory_prove(run->jobs, run->id);
      run->n_unsaved -= save.n;
      memmove(run->unsaved, run->unsaved + save.n, run->n_unsaved * sizeof(*run->unsaved));
      if (save.progress != NULL)
        run->progress_us = mo_clock_us();
    }
  }
  free(save.losses);
  return error;
}

/* ---- scoring ---- */

static void take(void *context, const struct mo_flight *flight, bool is_done)
{
  struct mo_campaign_run *run = context;
  const struct mo_block *block = &flight->block;
  struct mo_campaign_loss *loss = &run->losses[flight->design];
  for (uint32_t i = 0; i < block->n_environments; i++) {
    const uint32_t k = flight->places[i];
    loss->losses[k] = block->outcomes[i].loss;
    loss->diverged_steps[k] = block->outcomes[i].diverged_step;
    loss->origins[k] = block->origin;
    if (block->computed_on != block->back_end)
      loss->by_workers |= UINT64_C(1) << k;
  }
  atomic_fetch_add(&run->jobs->campaign_rollouts, block->n_environments);
  if (mo_race_take(run, flight->design, is_done)) {
    run->unsaved[run->n_unsaved++] = flight->design;
    run->n_done++;
  }
}

static void show(void *context, double rollouts_per_s)
{
  struct mo_campaign_run *run = context;
  mo_campaign_advance(run, run->n_done, rollouts_per_s);
}

static int compute(struct mo_campaign_run *run)
{
  struct mo_compute_controller *own = NULL;
  const bool learns = run->learner.training != NULL;
  int error = MO_OK;
  if (learns)
    error = mo_compute_controller_create(run->jobs->compute,
                                         mo_training_controller(run->learner.training), &own);
  else if (run->frozen == NULL) /* kept while the campaign runs: devices have copies */
    error = mo_compute_controller_create(run->jobs->compute, run->controller, &run->frozen);
  run->scoring.runner = run->runner;
  run->scoring.context = run;
  run->scoring.take = take;
  run->scoring.save = mo_campaign_save_losses;
  run->scoring.n_unsaved = &run->n_unsaved;
  run->scoring.show = show;
  run->scoring.grid.block.controller = learns ? own : run->frozen;
  if (error == MO_OK)
    error = mo_score(&run->scoring);
  mo_compute_controller_free(own);
  return error;
}

/* Computes each score as the mean over the environments; infinity if a rollout diverged. Of a child
 * that was cut short it is a lower bound. */
static void read_scores(struct mo_campaign_run *run)
{
  for (uint32_t i = 0; i < run->n_scored; i++) {
    const struct mo_campaign_loss *loss = &run->losses[i];
    const double score = mo_race_score(loss->losses, run->n_environments);
    bool is_whole = true;
    for (uint32_t k = 0; k < run->n_environments; k++)
      is_whole = is_whole && !isnan(loss->losses[k]);
    run->rows->scores[run->first_scored + i] = score;
    run->rows->cut[run->first_scored + i] = !is_whole && isfinite(score);
  }
}

int mo_campaign_score(struct mo_campaign_run *run)
{
  int error = allocate(run);
  if (error == MO_OK)
    error = read_saved(run);
  if (error == MO_OK && !mo_mode_learns(run->settings->mode))
    error = read_known(run);
  if (error != MO_OK)
    return error;
  mo_race_begin(run);
  mo_campaign_enter(run, MO_PHASE_SCORE, run->n_scored);
  mo_campaign_advance(run, run->n_done, 0);
  error = compute(run);
  if (error == MO_OK)
    read_scores(run);
  return error;
}
