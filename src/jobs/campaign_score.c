/* campaign_score.c: the scores of a generation.
 *
 * Candidates are cut, in order, into blocks of one body and up to MO_BLOCK_LANES environments. The
 * back end holds two blocks per worker, or some thousands per device. A candidate is done when all
 * its blocks are. Its losses are saved at once; on devices, when no more blocks arrive, or after a
 * second. If losses arrive faster than the disk writes, one transaction saves several candidates. A
 * crash loses the blocks in flight and the losses that wait for their commit. Losses that an
 * earlier process saved are not computed again; nor, in a zero-shot campaign, those that `scores`
 * holds for a body under this controller. */
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/parallel.h"
#include "jobs/campaign_run.h"
#include "jobs/scoring.h"

#define SAVED_AT_ONCE           1024
#define RATE_AFTER_US           INT64_C(500000)
#define QUIET_US                INT64_C(20000)
#define SAVED_AFTER_US          INT64_C(1000000)
#define LOOK_UP_THREADS         4 /* the store has a few more connections, for others */
#define LOOK_UPS_WORTH_A_THREAD 1024

/* One block in the back end. */
struct flight {
  struct mo_block block;
  struct scoring *scoring;
  uint32_t place, first; /* index of the candidate among those to score; its first environment */
  struct flight *next;   /* in the list of finished or free ones */
};

struct scoring {
  struct mo_campaign_run *run;
  struct mo_compute_controller *controller;
  struct flight *flights, *free;
  uint32_t n_in_flight, window;
  uint32_t place, environment; /* the next to compute */
  int64_t begin_us;
  int64_t unsaved_us; /* time of the oldest unsaved loss; 0: none */
  uint64_t computed;  /* rollouts in this call */
  /* Shared with the workers. */
  pthread_mutex_t mutex;
  pthread_cond_t news;
  struct flight *finished;
};

static uint32_t blocks_per_candidate(const struct mo_campaign_run *run)
{
  return (run->n_environments + MO_BLOCK_LANES - 1) / MO_BLOCK_LANES;
}

/* ---- what is known ---- */

void mo_campaign_free_scores(struct mo_campaign_run *run)
{
  free(run->losses);
  free(run->left);
  free(run->unsaved);
  run->losses = NULL;
  run->left = NULL;
  run->unsaved = NULL;
  run->n_scored = run->n_unsaved = run->n_done = run->n_cached = 0;
}

static int allocate(struct mo_campaign_run *run)
{
  mo_campaign_free_scores(run);
  run->first_scored = run->status.record.settings.mode == MO_ZERO_SHOT ? run->n_parents : 0;
  run->n_scored = run->n_parents + run->n_children - run->first_scored;
  run->losses = calloc((size_t)run->n_scored + 1, sizeof(*run->losses));
  run->left = calloc((size_t)run->n_scored + 1, sizeof(*run->left));
  run->unsaved = calloc((size_t)run->n_scored + 1, sizeof(*run->unsaved));
  if (run->losses == NULL || run->left == NULL || run->unsaved == NULL)
    return MO_ERR_NO_MEMORY;
  memset(run->left, (int)blocks_per_candidate(run), run->n_scored);
  for (uint32_t i = 0; i < run->n_scored; i++)
    run->losses[i].place = i;
  return MO_OK;
}

static void know(struct mo_campaign_run *run, uint32_t place, const struct mo_campaign_loss *loss)
{
  if (place >= run->n_scored || run->left[place] == 0)
    return;
  run->losses[place] = *loss;
  run->losses[place].place = place;
  run->left[place] = 0;
  run->n_done++;
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
  struct mo_campaign_loss
      *known;        /* (n) the known losses of each part, from the first index of the part on */
  uint32_t *n_known; /* (n) their number, at the first index of each part */
  atomic_int error;
};

static void look_up(void *context, size_t first, size_t end)
{
  struct looking *looking = context;
  struct mo_campaign_run *run = looking->run;
  const int64_t found = mo_store_campaign_known(
      run->jobs->store, run->id, mo_back_end_fingerprint(run->jobs, run->status.job.back_end),
      looking->asked + first, (uint32_t)(end - first), looking->known + first);
  if (found < 0)
    atomic_store(&looking->error, (int)found);
  else
    looking->n_known[first] = (uint32_t)found;
  for (int64_t i = 0; i < found; i++)
    looking->known[first + (size_t)i].place += (uint32_t)first;
}

/* Finds bodies that an evaluation or another campaign has scored. Zero-shot only. */
static int read_known(struct mo_campaign_run *run)
{
  struct mo_bits *asked = calloc((size_t)run->n_scored + 1, sizeof(*asked));
  uint32_t *places = calloc((size_t)run->n_scored + 1, sizeof(*places)), n = 0;
  struct mo_campaign_loss *known = calloc((size_t)run->n_scored + 1, sizeof(*known));
  uint32_t *n_known = calloc((size_t)run->n_scored + 1, sizeof(*n_known));
  struct looking looking = {.run = run, .asked = asked, .known = known, .n_known = n_known};
  int error = asked == NULL || places == NULL || known == NULL || n_known == NULL ? MO_ERR_NO_MEMORY
                                                                                  : MO_OK;
  for (uint32_t i = 0; i < run->n_scored && error == MO_OK; i++)
    if (run->left[i] > 0) {
      asked[n] = run->rows->bits[run->first_scored + i];
      places[n++] = i;
    }
  if (error == MO_OK) {
    mo_parallel(n < LOOK_UPS_WORTH_A_THREAD ? 1 : LOOK_UP_THREADS, n, look_up, &looking);
    error = atomic_load(&looking.error);
  }
  for (uint32_t first = 0; first < n && error == MO_OK; first++)
    for (uint32_t i = first; i < first + n_known[first]; i++) {
      know(run, places[known[i].place], &known[i]);
      run->n_cached++;
    }
  free(asked);
  free(places);
  free(known);
  free(n_known);
  return error;
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

int mo_campaign_save_losses(struct mo_campaign_run *run)
{
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
      run->n_unsaved -= save.n;
      memmove(run->unsaved, run->unsaved + save.n, run->n_unsaved * sizeof(*run->unsaved));
      if (save.progress != NULL)
        mo_campaign_told(run);
    }
  }
  free(save.losses);
  return error;
}

/* ---- blocks ---- */

static void finished(struct mo_block *block, void *context)
{
  struct flight *flight = context;
  struct scoring *scoring = flight->scoring;
  (void)block;
  pthread_mutex_lock(&scoring->mutex);
  flight->next = scoring->finished;
  scoring->finished = flight;
  pthread_cond_signal(&scoring->news);
  pthread_mutex_unlock(&scoring->mutex);
}

static int launch(struct scoring *scoring)
{
  struct mo_campaign_run *run = scoring->run;
  struct flight *flight = scoring->free;
  uint32_t left = run->n_environments - scoring->environment;
  int error;
  scoring->free = flight->next;
  flight->place = scoring->place;
  flight->first = scoring->environment;
  flight->block =
      (struct mo_block){.lattice = run->jobs->lattice,
                        .genotype = run->rows->bits[run->first_scored + scoring->place].words,
                        .controller = scoring->controller,
                        .n_environments = left < MO_BLOCK_LANES ? left : MO_BLOCK_LANES,
                        .physics = run->status.record.settings.physics,
                        .precision = MO_FLOAT32,
                        .urgency = run->status.job.priority,
                        .back_end = run->status.job.back_end,
                        .cancel = &run->runner->interrupt,
                        .tag = run->id,
                        .share = scoring->run->share,
                        .done = finished,
                        .context = flight};
  for (uint32_t i = 0; i < flight->block.n_environments; i++)
    flight->block.environments[i] = &run->environments[scoring->environment + i];
  error = mo_compute_submit(run->jobs->compute, &flight->block);
  if (error != MO_OK) {
    flight->next = scoring->free;
    scoring->free = flight;
    return error;
  }
  scoring->n_in_flight++;
  scoring->environment += flight->block.n_environments;
  if (scoring->environment == run->n_environments) {
    scoring->environment = 0;
    scoring->place++;
  }
  return MO_OK;
}

static int fill(struct scoring *scoring)
{
  const struct mo_campaign_run *run = scoring->run;
  int error = MO_OK;
  mo_compute_begin_blocks(run->jobs->compute);
  while (error == MO_OK && scoring->n_in_flight < scoring->window) {
    while (scoring->place < run->n_scored && run->left[scoring->place] == 0)
      scoring->place++;
    if (scoring->place == run->n_scored)
      break;
    error = launch(scoring);
  }
  mo_compute_end_blocks(run->jobs->compute);
  return error;
}

static int land(struct scoring *scoring, struct flight *flight)
{
  struct mo_campaign_run *run = scoring->run;
  struct mo_campaign_loss *loss = &run->losses[flight->place];
  uint32_t n = flight->block.n_environments;
  int error = MO_OK;
  scoring->n_in_flight--;
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    error = mo_block_check(&flight->block, i);
    loss->losses[flight->first + i] = flight->block.outcomes[i].loss;
    loss->diverged_steps[flight->first + i] = flight->block.outcomes[i].diverged_step;
    if (flight->block.computed_on != flight->block.back_end)
      loss->by_workers |= UINT64_C(1) << (flight->first + i);
  }
  if (error == MO_OK) {
    scoring->computed += n;
    atomic_fetch_add(&run->jobs->campaign_rollouts, n);
    if (--run->left[flight->place] == 0) {
      run->unsaved[run->n_unsaved++] = flight->place;
      run->n_done++;
    }
  } else if (error != MO_ERR_CANCELLED) {
    mo_block_describe(error, run->runner->text);
  }
  flight->next = scoring->free;
  scoring->free = flight;
  return error;
}

/* Waits for the next block. Returns whether none arrived within QUIET_US. */
static bool is_quiet(struct scoring *scoring)
{
  const int64_t end_us = mo_clock_us() + QUIET_US;
  const struct timespec deadline = {.tv_sec = end_us / 1000000,
                                    .tv_nsec = (end_us % 1000000) * 1000};
  int status = 0;
  pthread_mutex_lock(&scoring->mutex);
  while (scoring->finished == NULL && status != ETIMEDOUT)
    status = pthread_cond_timedwait(&scoring->news, &scoring->mutex, &deadline);
  const bool quiet = scoring->finished == NULL;
  pthread_mutex_unlock(&scoring->mutex);
  return quiet;
}

/* Saves the losses that arrived. A device returns thousands of candidates within milliseconds, so
 * saving waits until it is quiet; the last ones of a generation are saved by its commit. Workers
 * that compute what the device does not support return one candidate after the other and may never
 * be quiet, so saving waits at most SAVED_AFTER_US. */
static int save_what_came(struct scoring *scoring)
{
  struct mo_campaign_run *run = scoring->run;
  const int64_t now_us = mo_clock_us();
  if (run->n_unsaved == 0)
    return MO_OK;
  if (scoring->unsaved_us == 0)
    scoring->unsaved_us = now_us;
  if (run->status.job.back_end == MO_ON_DEVICE && now_us - scoring->unsaved_us < SAVED_AFTER_US &&
      !is_quiet(scoring))
    return MO_OK;
  scoring->unsaved_us = 0;
  return mo_campaign_save_losses(run);
}

/* Waits for a block and stores the finished ones. A request cancels all blocks soon. */
static int take_in(struct scoring *scoring)
{
  struct flight *flight;
  int error = MO_OK;
  pthread_mutex_lock(&scoring->mutex);
  while (scoring->finished == NULL)
    pthread_cond_wait(&scoring->news, &scoring->mutex);
  flight = scoring->finished;
  scoring->finished = NULL;
  pthread_mutex_unlock(&scoring->mutex);
  while (flight != NULL) {
    struct flight *next = flight->next;
    int landed = land(scoring, flight);
    if (error == MO_OK || error == MO_ERR_CANCELLED)
      error = landed != MO_OK ? landed : error;
    flight = next;
  }
  return error;
}

static void show(const struct scoring *scoring)
{
  struct mo_campaign_run *run = scoring->run;
  int64_t passed = mo_clock_us() - scoring->begin_us;
  if (passed >= RATE_AFTER_US)
    mo_campaign_show_rate(run, (double)scoring->computed / ((double)passed * 1e-6));
  mo_campaign_advance(run, run->n_done);
}

/* Computes all remaining blocks. Returns with no block in flight, even after an error. */
static int compute(struct scoring *scoring)
{
  const struct mo_campaign_run *run = scoring->run;
  int error = MO_OK;
  for (;;) {
    int landed;
    if (error == MO_OK && mo_runner_is_interrupted(run->runner))
      error = MO_ERR_CANCELLED;
    if (error == MO_OK)
      error = fill(scoring);
    if (scoring->n_in_flight == 0) /* unsaved losses are committed with the generation */
      return error;
    if (error == MO_OK)
      error = save_what_came(scoring);
    landed = take_in(scoring);
    if (error == MO_OK)
      error = landed;
    show(scoring);
  }
}

static int open_scoring(struct scoring *scoring, struct mo_campaign_run *run)
{
  const uint32_t window = mo_back_end_window(run->jobs, run->status.job.back_end);
  const uint32_t all = blocks_per_candidate(run) * (run->n_scored > 0 ? run->n_scored : 1);
  *scoring = (struct scoring){
      .run = run, .window = window < all ? window : all, .begin_us = mo_clock_us()};
  pthread_condattr_t monotonic;
  pthread_condattr_init(&monotonic);
  pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
  pthread_mutex_init(&scoring->mutex, NULL);
  pthread_cond_init(&scoring->news, &monotonic);
  pthread_condattr_destroy(&monotonic);
  scoring->flights = calloc(scoring->window, sizeof(*scoring->flights));
  if (scoring->flights == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < scoring->window; i++) {
    scoring->flights[i].scoring = scoring;
    scoring->flights[i].next = scoring->free;
    scoring->free = &scoring->flights[i];
  }
  if (run->learner.training != NULL)
    return mo_compute_controller_create(
        run->jobs->compute, mo_training_controller(run->learner.training), &scoring->controller);
  if (run->frozen == NULL) { /* kept while the campaign runs: devices have copies */
    const int error =
        mo_compute_controller_create(run->jobs->compute, run->controller, &run->frozen);
    if (error != MO_OK)
      return error;
  }
  scoring->controller = run->frozen;
  return MO_OK;
}

static void close_scoring(struct scoring *scoring)
{
  if (scoring->controller != scoring->run->frozen)
    mo_compute_controller_free(scoring->controller);
  free(scoring->flights);
  pthread_mutex_destroy(&scoring->mutex);
  pthread_cond_destroy(&scoring->news);
}

/* Computes each score as the mean over the environments; infinity if a rollout diverged. */
static void read_scores(struct mo_campaign_run *run)
{
  for (uint32_t i = 0; i < run->n_scored; i++) {
    const struct mo_campaign_loss *loss = &run->losses[i];
    double sum = 0;
    for (uint32_t k = 0; k < run->n_environments; k++)
      sum += loss->losses[k];
    run->rows->scores[run->first_scored + i] = sum / run->n_environments;
  }
}

int mo_campaign_score(struct mo_campaign_run *run)
{
  struct scoring scoring;
  int error = allocate(run);
  if (error == MO_OK)
    error = read_saved(run);
  if (error == MO_OK && run->status.record.settings.mode == MO_ZERO_SHOT)
    error = read_known(run);
  if (error != MO_OK)
    return error;
  (void)mo_campaign_enter(run, MO_PHASE_SCORE, run->n_scored);
  mo_campaign_advance(run, run->n_done);
  error = open_scoring(&scoring, run);
  if (error == MO_OK)
    error = compute(&scoring);
  close_scoring(&scoring);
  if (error == MO_OK)
    read_scores(run);
  return error;
}
