/* campaign_score.c: the scores of a generation.
 *
 * The candidates' losses are saved at once, or after a second if devices or other machines compute
 * them (scoring.c). If losses arrive faster than the disk can write them, one transaction saves
 * several candidates. Losses that an earlier process saved are not recomputed. In a zero-shot
 * campaign or a study, losses of a body under this controller that are in the table `scores` are
 * not recomputed either. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/campaign_run.h"

#define SAVED_AT_ONCE           1024
#define LOOK_UP_THREADS         4 /* leaves a few of the store's connections for other uses */
#define LOOK_UPS_WORTH_A_THREAD 1024

/* ---- known losses ---- */

void mo_campaign_free_scores(struct mo_campaign_scores *scores)
{
  mo_grid_free(&scores->scoring.grid);
  free(scores->losses);
  free(scores->measures);
  free(scores->means);
  free(scores->unsaved);
  scores->losses = NULL;
  scores->measures = NULL;
  scores->means = NULL;
  scores->unsaved = NULL;
  scores->n = scores->n_unsaved = scores->n_done = 0;
  scores->n_cached = 0;
}

/* The measures of rollouts that are not computed stay NaN. */
static int allocate_measures(struct mo_campaign_run *run)
{
  struct mo_campaign_scores *scores = &run->scores;
  const size_t cells = (size_t)scores->n * run->n_environments;
  if (run->status.record.measures == 0)
    return MO_OK;
  scores->measures = malloc((cells + 1) * sizeof(*scores->measures));
  scores->means =
      calloc((size_t)scores->n + 1, (size_t)mo_campaign_n_means(run) * sizeof(*scores->means));
  if (scores->measures == NULL || scores->means == NULL)
    return MO_ERR_NO_MEMORY;
  for (size_t i = 0; i < cells; i++)
    for (unsigned m = 0; m < MO_MEASURES; m++)
      scores->measures[i][m] = NAN;
  for (uint32_t i = 0; i < scores->n; i++)
    scores->losses[i].measures = scores->measures + (size_t)i * run->n_environments;
  return MO_OK;
}

static int allocate(struct mo_campaign_run *run)
{
  struct mo_campaign_scores *scores = &run->scores;
  struct mo_grid *grid = &scores->scoring.grid;
  mo_campaign_free_scores(scores);
  scores->first = run->mode->learns ? 0 : run->n_parents;
  scores->n = run->n_parents + run->n_children - scores->first;
  scores->losses = calloc((size_t)scores->n + 1, sizeof(*scores->losses));
  scores->unsaved = calloc((size_t)scores->n + 1, sizeof(*scores->unsaved));
  *grid = (struct mo_grid){.block = mo_block_of(run->jobs, &run->status.job),
                           .genotypes = run->rows->bits + scores->first,
                           .environments = run->environments,
                           .n_designs = scores->n,
                           .n_environments = run->n_environments};
  if (scores->losses == NULL || scores->unsaved == NULL || mo_grid_create(grid) != MO_OK)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < scores->n; i++) {
    scores->losses[i].place = i;
    for (uint32_t k = 0; k < run->n_environments; k++)
      scores->losses[i].losses[k] = NAN;
  }
  const int error = allocate_measures(run);
  return error == MO_OK ? mo_race_close(run) : error;
}

/* Takes the saved losses of a candidate, including losses that an earlier process found stored. */
static void take_saved(struct mo_campaign_scores *scores, uint32_t place,
                       const struct mo_campaign_loss *loss)
{
  if (place >= scores->n || scores->scoring.grid.left[place] == 0)
    return;
  double(*measures)[MO_MEASURES] = scores->losses[place].measures;
  if (measures != NULL)
    memcpy(measures, loss->measures, scores->scoring.grid.n_environments * sizeof(*measures));
  scores->losses[place] = *loss;
  scores->losses[place].place = place;
  scores->losses[place].measures = measures;
  scores->n_cached += (uint64_t)__builtin_popcountll(loss->stored);
  mo_grid_finish_design(&scores->scoring.grid, place);
  scores->n_done++;
}

/* Takes the stored losses of a candidate, which may be incomplete. */
static void take_stored(struct mo_campaign_scores *scores, uint32_t place,
                        const struct mo_campaign_loss *known)
{
  struct mo_campaign_loss *loss = &scores->losses[place];
  loss->stored = known->stored;
  for (uint32_t k = 0; k < scores->scoring.grid.n_environments; k++)
    if (known->stored >> k & 1) {
      loss->losses[k] = known->losses[k];
      loss->diverged_steps[k] = known->diverged_steps[k];
      if (loss->measures != NULL)
        memcpy(loss->measures[k], known->measures[k], sizeof(loss->measures[k]));
      scores->n_cached++;
      scores->n_done += mo_grid_finish(&scores->scoring.grid, place, k);
    }
}

static int read_saved(struct mo_campaign_run *run)
{
  struct mo_campaign_loss *saved = NULL;
  size_t n = 0;
  int error = mo_store_campaign_losses(run->jobs->store, run->id, run->generation, &saved, &n);
  for (size_t i = 0; i < n && error == MO_OK; i++)
    take_saved(&run->scores, saved[i].place, &saved[i]);
  free(saved);
  return error;
}

/* A look-up of thousands of bodies takes some tens of milliseconds, so several connections of the
 * store share the work. */
struct looking {
  struct mo_campaign_run *run;
  const struct mo_bits *asked; /* (n) */
  const uint32_t *places;      /* (n) */
  pthread_mutex_t mutex;       /* guards the run's known losses, and the error */
  int error;
};

static void look_up(void *context, size_t first, size_t end)
{
  struct looking *looking = context;
  struct mo_campaign_run *run = looking->run;
  const size_t measured = run->scores.measures != NULL ? run->n_environments : 0;
  struct mo_campaign_loss *known =
      calloc(end - first, sizeof(*known) + measured * sizeof(*known->measures));
  for (size_t i = 0; known != NULL && measured > 0 && i < end - first; i++)
    known[i].measures = (double(*)[MO_MEASURES])(known + (end - first)) + i * measured;
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
    take_stored(&run->scores, looking->places[first + known[i].place], &known[i]);
  pthread_mutex_unlock(&looking->mutex);
  free(known);
}

/* Finds bodies that an evaluation or another campaign has scored. Frozen controllers only. */
static int read_known(struct mo_campaign_run *run)
{
  const struct mo_campaign_scores *scores = &run->scores;
  struct mo_bits *asked = calloc((size_t)scores->n + 1, sizeof(*asked));
  uint32_t *places = calloc((size_t)scores->n + 1, sizeof(*places)), n = 0;
  struct looking looking = {
      .run = run, .asked = asked, .places = places, .mutex = PTHREAD_MUTEX_INITIALIZER};
  if (asked == NULL || places == NULL)
    looking.error = MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < scores->n && looking.error == MO_OK; i++)
    if (scores->scoring.grid.left[i] > 0) { /* nothing of this candidate is saved */
      asked[n] = run->rows->bits[scores->first + i];
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
  struct mo_campaign_scores *scores = &run->scores;
  char progress[256];
  struct save save = {.run = run};
  int error = MO_OK;
  if (scores->n_unsaved == 0 || (!run->runner->winding_down && mo_campaign_is_writing(run)))
    return MO_OK; /* saving waits for the commit of the previous generation */
  save.losses = calloc(scores->n_unsaved < SAVED_AT_ONCE ? scores->n_unsaved : SAVED_AT_ONCE,
                       sizeof(*save.losses));
  if (save.losses == NULL)
    return MO_ERR_NO_MEMORY;
  while (scores->n_unsaved > 0 && error == MO_OK) {
    save.n = scores->n_unsaved < SAVED_AT_ONCE ? scores->n_unsaved : SAVED_AT_ONCE;
    for (uint32_t i = 0; i < save.n; i++)
      save.losses[i] = scores->losses[scores->unsaved[i]];
    save.progress = run->runner->winding_down ? NULL : mo_campaign_progress(run, progress);
    error = mo_campaign_persist(run, write_losses, &save, "the scores of a generation");
    if (error == MO_OK) {
      mo_memory_prove(run->jobs, run->id);
      scores->n_unsaved -= save.n;
      memmove(scores->unsaved, scores->unsaved + save.n,
              scores->n_unsaved * sizeof(*scores->unsaved));
      if (save.progress != NULL)
        run->times.progress_us = mo_clock_us();
    }
  }
  free(save.losses);
  return error;
}

/* ---- scoring ---- */

static void take(void *context, const struct mo_flight *flight, bool is_done)
{
  struct mo_campaign_run *run = context;
  struct mo_campaign_scores *scores = &run->scores;
  const struct mo_block *block = &flight->block;
  struct mo_campaign_loss *loss = &scores->losses[flight->design];
  for (uint32_t i = 0; i < block->n_environments; i++) {
    const uint32_t k = flight->places[i];
    loss->losses[k] = block->outcomes[i].loss;
    loss->diverged_steps[k] = block->outcomes[i].diverged_step;
    loss->origins[k] = block->origin;
    if (loss->measures != NULL)
      memcpy(loss->measures[k], block->measuring->values[i], sizeof(loss->measures[k]));
    if (block->computed_on != block->back_end)
      loss->by_workers |= UINT64_C(1) << k;
  }
  atomic_fetch_add(&run->jobs->campaign_rollouts, block->n_environments);
  if (mo_race_take(run, flight->design, is_done)) {
    scores->unsaved[scores->n_unsaved++] = flight->design;
    scores->n_done++;
  }
}

static void show(void *context, double rollouts_per_s)
{
  struct mo_campaign_run *run = context;
  mo_campaign_advance(run, run->scores.n_done, rollouts_per_s);
}

/* Computes the open cells with the weights of this generation. In modes that do not learn, the
 * weights are prepared for the back end only once, because devices keep copies of them. */
static int compute(struct mo_campaign_run *run)
{
  struct mo_campaign_scores *scores = &run->scores;
  const struct mo_training *training = run->learning.learner.training;
  int error = MO_OK;
  if (scores->weights == NULL)
    error = mo_compute_controller_create(
        run->jobs->compute, training != NULL ? mo_training_controller(training) : run->controller,
        &scores->weights);
  scores->scoring.runner = run->runner;
  scores->scoring.context = run;
  scores->scoring.take = take;
  scores->scoring.save = mo_campaign_save_losses;
  scores->scoring.n_unsaved = &scores->n_unsaved;
  scores->scoring.show = show;
  scores->scoring.measures = run->status.record.measures != 0;
  scores->scoring.grid.block.controller = scores->weights;
  return error == MO_OK ? mo_score(&scores->scoring) : error;
}

/* Computes the means of the measures, one of which is the score if the campaign selects by it. */
static void read_measures(struct mo_campaign_run *run)
{
  const struct mo_campaign_scores *scores = &run->scores;
  const struct mo_campaign_record *record = &run->status.record;
  const struct mo_select_by *by = &record->select_by;
  const uint32_t n = mo_campaign_n_means(run);
  const uint32_t before = (UINT32_C(1) << by->measure) - 1; /* the measures before this one */
  for (uint32_t i = 0; i < scores->n; i++) {
    double *means = scores->means + (size_t)n * i;
    (void)mo_measures_mean(record->measures,
                           (const double(*)[MO_MEASURES])scores->losses[i].measures,
                           run->n_environments, means);
    if (by->is_set)
      run->rows->scores[scores->first + i] =
          mo_select_by_score(by, means[__builtin_popcount(record->measures & before)]);
  }
}

/* Computes each score from the losses over the environments; it is infinity if a rollout diverged.
 * For a child that was cut short, the score is a lower bound. A study may have its own score: its
 * client has sent it, and the losses are only stored. */
static void read_scores(struct mo_campaign_run *run)
{
  const struct mo_campaign_scores *scores = &run->scores;
  if (scores->measures != NULL)
    read_measures(run);
  if (run->status.record.select_by.is_set) {
    memset(run->rows->cut + scores->first, 0, scores->n * sizeof(*run->rows->cut));
    return;
  }
  if (run->batch != NULL && run->batch->scores != NULL) {
    memcpy(run->rows->scores + scores->first, run->batch->scores,
           scores->n * sizeof(*run->rows->scores));
    memset(run->rows->cut + scores->first, 0, scores->n * sizeof(*run->rows->cut));
    return;
  }
  for (uint32_t i = 0; i < scores->n; i++) {
    const struct mo_campaign_loss *loss = &scores->losses[i];
    const double score =
        mo_aggregate_score(&run->settings->aggregate, loss->losses, run->n_environments);
    bool is_whole = true;
    for (uint32_t k = 0; k < run->n_environments; k++)
      is_whole = is_whole && !isnan(loss->losses[k]);
    run->rows->scores[scores->first + i] = score;
    run->rows->cut[scores->first + i] = !is_whole && isfinite(score);
  }
}

int mo_campaign_look_up(struct mo_campaign_run *run)
{
  int error = allocate(run);
  if (error == MO_OK)
    error = read_saved(run);
  if (error == MO_OK && !run->mode->learns)
    error = read_known(run);
  if (error == MO_OK)
    mo_race_begin(run);
  return error;
}

uint64_t mo_campaign_n_scores(const struct mo_campaign_run *run)
{
  return run->scores.n;
}

int mo_campaign_score(struct mo_campaign_run *run)
{
  mo_campaign_advance(run, run->scores.n_done, 0);
  const int error = compute(run);
  if (error == MO_OK)
    read_scores(run);
  return error;
}
