/* campaign_commit.c: describes and commits a generation while the next one runs.
 *
 * A commit of thousands of designs takes some tenths of a second, and a device would be idle during
 * that time. A separate thread therefore writes the commit, and the campaign continues with its
 * other rows. At most one commit is in progress, and all other writes of the campaign wait for it:
 * losses, checkpoints, the next commit, the end and a pause. A crash loses at most one uncommitted
 * generation, which is recomputed with the same result. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/campaign_run.h"

struct mo_campaign_writing {
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_campaign_commit commit; /* points to rows of the run, and to the members below */
  struct mo_campaign_loss *losses;  /* moved here from the run */
  double (*measures)[MO_MEASURES];  /* the losses' measures, moved too */
  double *means, *parent_means;     /* means of the measures, then the measures of a study */
  struct mo_re_evaluated held_out[MO_ELITE_MAX];
  struct mo_campaign_step *steps;
  uint8_t *checkpoint;
  char generation_data[480], collapse_data[256];
  pthread_t thread;
  bool is_pending; /* started, and not yet known to be committed */
  bool has_thread;
  atomic_bool ended; /* the thread has set its status */
  int status;        /* of the latest attempt; MO_ERR_BUSY: no attempt has ended yet */
};

/* ---- statistics of a generation ---- */

static double mean_of(const double *scores, uint32_t n)
{
  double sum = 0;
  uint32_t sound = 0;
  for (uint32_t i = 0; i < n; i++)
    if (isfinite(scores[i])) {
      sum += scores[i];
      sound++;
    }
  return sound > 0 ? sum / sound : NAN;
}

static void count_survivors(const struct mo_campaign_run *run, struct mo_campaign_generation *row)
{
  uint32_t young = 0;
  for (uint32_t i = 0; i < run->n_survivors; i++) {
    if (run->rows->survivors[i] < run->n_parents)
      continue;
    const enum mo_operator op = run->rows->births[run->rows->survivors[i] - run->n_parents].op;
    row->survived_mutants += op == MO_BORN_MUTATION;
    row->survived_recombinants += op == MO_BORN_CROSSOVER;
    young++;
  }
  row->turnover = run->n_survivors > 0 ? (double)young / run->n_survivors : 0;
}

static void count_rollouts(const struct mo_campaign_run *run, struct mo_campaign_generation *row)
{
  const struct mo_campaign_scores *scores = &run->scores;
  row->rollouts_cached = scores->n_cached;
  for (uint32_t i = 0; i < scores->n; i++)
    for (uint32_t k = 0; k < run->n_environments; k++) {
      row->rollouts += !isnan(scores->losses[i].losses[k]);
      row->rollouts_diverged += scores->losses[i].diverged_steps[k] != 0;
    }
  for (uint32_t i = 0; i < run->n_children; i++)
    row->children_cut += run->rows->cut[run->n_parents + i];
}

/* Warns once each time that diversity falls below its share of the maximum so far. */
static void watch_diversity(struct mo_campaign_run *run, struct mo_campaign_generation *row)
{
  const double share = run->settings->collapse_share;
  if (row->stats.diversity > run->diversity.max) {
    run->diversity.max = row->stats.diversity;
    run->diversity.is_warned = false;
  }
  row->collapse =
      share > 0 && !run->diversity.is_warned && row->stats.diversity < share * run->diversity.max;
  run->diversity.is_warned = run->diversity.is_warned || row->collapse;
}

/* Describes the generation. The survivors are in the other rows. */
static int describe_generation(struct mo_campaign_run *run, struct mo_campaign_generation *row)
{
  const bool learns = run->mode->learns;
  const struct mo_campaign_rows *survivors = run->other_rows;
  *row = (struct mo_campaign_generation){
      .generation = run->generation,
      .born_before = run->n_designs,
      .n_children = run->n_children,
      .mean_parents = mean_of(run->rows->scores, run->n_parents),
      .mean_children = mean_of(run->rows->scores + run->n_parents, run->n_children),
      .variation = run->variation,
      .learning_steps = learns ? run->learning.step : 0,
      .first_loss = learns ? run->learning.first_loss : NAN,
      .last_loss = learns ? run->learning.last_loss : NAN};
  int error = mo_population_stats(run->settings->workspace, survivors->genotypes, survivors->scores,
                                  survivors->sizes, run->n_survivors, &row->stats);
  if (error != MO_OK)
    return error;
  row->held_out =
      mo_held_out_summary(&run->status.record.re_evaluate, run->held_out, run->n_held_out,
                          survivors->numbers, survivors->scores, run->n_survivors);
  count_survivors(run, row);
  count_rollouts(run, row);
  watch_diversity(run, row);
  row->seconds = run->times.prepared_s + (double)(mo_clock_us() - run->times.begin_us) * 1e-6;
  return MO_OK;
}

static void format_generation(const struct mo_campaign_run *run,
                              const struct mo_campaign_generation *row, char text[480])
{
  const double left = run->runner->live.seconds_left; /* only this thread changes it */
  snprintf(text, 480,
           "{\"id\":\"%lld\",\"generation\":%u,\"generations\":%u,\"mean\":%s,\"best\":%s,"
           "\"diversity\":%s,"
           "\"turnover\":%s,\"seconds_left\":%s}",
           (long long)run->id, (unsigned)row->generation, (unsigned)run->settings->generations,
           MO_FIGURE(row->stats.mean_score), MO_FIGURE(row->stats.quantiles[0]),
           MO_FIGURE(row->stats.diversity), MO_FIGURE(row->turnover),
           MO_FIGURE(left < 0 ? NAN : left));
}

/* ---- the contents of a commit ---- */

/* Frees everything that belongs to this generation only. */
static void drop(struct mo_campaign_writing *writing)
{
  free(writing->losses);
  free(writing->measures);
  free(writing->means);
  free(writing->parent_means);
  free(writing->steps);
  free(writing->checkpoint);
  writing->losses = NULL;
  writing->measures = NULL;
  writing->means = writing->parent_means = NULL;
  writing->steps = NULL;
  writing->checkpoint = NULL;
  writing->is_pending = false;
}

void mo_campaign_writing_free(struct mo_campaign_run *run)
{
  struct mo_campaign_writing *writing = run->writing;
  if (writing == NULL)
    return;
  mo_campaign_writing_join(run);
  drop(writing);
  free(writing);
  run->writing = NULL;
}

static int take_learning(const struct mo_campaign_run *run, struct mo_campaign_writing *writing)
{
  const struct mo_campaign_learning *learning = &run->learning;
  const uint32_t n = learning->step - learning->steps_saved;
  writing->steps = calloc((size_t)n + 1, sizeof(*writing->steps));
  if (writing->steps == NULL)
    return MO_ERR_NO_MEMORY;
  memcpy(writing->steps, learning->steps + learning->steps_saved, n * sizeof(*writing->steps));
  writing->commit.steps = writing->steps;
  writing->commit.n_steps = n;
  writing->commit.checkpoint_step = learning->step;
  const int error = mo_training_encode(learning->learner.training, &writing->checkpoint,
                                       &writing->commit.checkpoint_size);
  writing->commit.checkpoint = writing->checkpoint;
  return error;
}

/* Returns a copy of `n` rows of `width` numbers. NULL: no memory. */
static double *copy_rows(const double *from, uint32_t n, uint32_t width)
{
  const size_t bytes = (size_t)n * width * sizeof(*from);
  double *rows = malloc(bytes + 1);
  return rows != NULL ? memcpy(rows, from, bytes) : NULL;
}

/* Copies the means of the measures that the campaign names, followed by the measures that a study's
 * client sent. */
static int take_measures(struct mo_campaign_run *run, struct mo_campaign_writing *writing)
{
  const struct mo_study_batch *batch = run->batch;
  const uint32_t n_means = mo_campaign_n_means(run), n_sent = batch != NULL ? batch->n_measures : 0;
  const uint32_t n = n_means + n_sent;
  writing->commit.n_measures = n;
  writing->commit.measures = n_sent > 0 ? batch->measures : NULL;
  if (n_means == 0)
    return MO_OK;
  const double *means = run->scores.means + (size_t)n_means * (run->n_parents - run->scores.first);
  writing->means = malloc(((size_t)run->n_children * n + 1) * sizeof(double));
  if (writing->means == NULL)
    return MO_ERR_NO_MEMORY;
  for (size_t i = 0; i < run->n_children; i++) {
    memcpy(writing->means + n * i, means + n_means * i, n_means * sizeof(double));
    if (n_sent > 0)
      memcpy(writing->means + n * i + n_means, batch->measures + n_sent * i,
             n_sent * sizeof(double));
  }
  writing->commit.measures = writing->means;
  if (run->scores.first > 0 || run->n_parents == 0)
    return MO_OK; /* the parents keep theirs */
  writing->parent_means = copy_rows(run->scores.means, run->n_parents, n_means);
  writing->commit.parent_measures = writing->parent_means;
  return writing->parent_means != NULL ? MO_OK : MO_ERR_NO_MEMORY;
}

/* Describes the generation for the store. Only the losses are taken from the run. */
static int take(struct mo_campaign_run *run, struct mo_campaign_writing *writing)
{
  const bool learns = run->mode->learns;
  const struct mo_campaign_rows *rows = run->rows;
  writing->commit = (struct mo_campaign_commit){
      .births = rows->births,
      .forms = rows->forms,
      .genotypes = rows->bits + run->n_parents,
      .sizes = rows->sizes + run->n_parents,
      .child_scores = rows->scores + run->n_parents,
      .children_cut = rows->cut + run->n_parents,
      .is_study = run->batch != NULL,
      .parent_numbers = rows->numbers,
      .parent_scores = rows->scores,
      .n_parents = run->n_parents,
      .survivors = rows->survivors,
      .n_survivors = run->n_survivors,
      .race_pays = mo_race_pays(run),
      .held_out = writing->held_out,
      .n_held_out = run->n_held_out,
      .fingerprint = mo_back_end_fingerprint(run->jobs, run->status.job.back_end),
      .workers_fingerprint = mo_back_end_fingerprint(run->jobs, MO_ON_CPU),
      .event_data = writing->generation_data,
  };
  memcpy(writing->held_out, run->held_out, run->n_held_out * sizeof(*run->held_out));
  int error = describe_generation(run, &writing->commit.row);
  if (error == MO_OK)
    error = take_measures(run, writing);
  if (error == MO_OK && learns)
    error = take_learning(run, writing);
  if (error != MO_OK)
    return error;
  const struct mo_campaign_generation *row = &writing->commit.row;
  run->times.generation_s = row->seconds - run->times.prepared_s;
  run->times.generation_rollouts = row->rollouts;
  mo_campaign_advance(run, 0, 0);
  format_generation(run, row, writing->generation_data);
  if (row->collapse) {
    snprintf(writing->collapse_data, sizeof(writing->collapse_data),
             "{\"id\":\"%lld\",\"generation\":%u,\"diversity\":%s,\"maximum\":%s}",
             (long long)run->id, (unsigned)row->generation, MO_FIGURE(row->stats.diversity),
             MO_FIGURE(run->diversity.max));
    writing->commit.collapse_data = writing->collapse_data;
  }
  if (!learns) {
    writing->losses = run->scores.losses;
    writing->commit.losses = writing->losses;
    writing->commit.n_losses = run->scores.n;
    writing->measures = run->scores.measures;
    run->scores.losses = NULL;
    run->scores.measures = NULL;
  }
  return MO_OK;
}

/* ---- writing ---- */

static int write_generation(void *context)
{
  struct mo_campaign_writing *writing = context;
  struct mo_jobs *jobs = writing->jobs;
  const struct mo_campaign_generation *row = &writing->commit.row;
  const int error = mo_store_campaign_commit(jobs->store, writing->id, &writing->commit);
  if (error == MO_OK) {
    mo_memory_prove(jobs, writing->id);
    atomic_fetch_add(&jobs->campaign_generations, 1);
    atomic_fetch_add(&jobs->campaign_designs, row->n_children);
    atomic_fetch_add(&jobs->campaign_cached, row->rollouts_cached);
    atomic_fetch_add(&jobs->campaign_diverged, row->rollouts_diverged);
  }
  return error;
}

static void *write_beside(void *context)
{
  struct mo_campaign_writing *writing = context;
  mo_thread_tag = writing->id;
  writing->status = write_generation(writing);
  atomic_store(&writing->ended, true);
  return NULL;
}

int mo_campaign_commit(struct mo_campaign_run *run)
{
  struct mo_campaign_writing *writing = run->writing;
  if (writing == NULL)
    writing = run->writing = calloc(1, sizeof(*writing));
  if (writing == NULL)
    return MO_ERR_NO_MEMORY;
  writing->jobs = run->jobs;
  writing->id = run->id;
  int error = take(run, writing);
  if (error != MO_OK) {
    drop(writing);
    return error;
  }
  run->learning.steps_saved = run->learning.step;
  run->race.pays = writing->commit.race_pays;
  run->scores.n_unsaved = 0; /* losses are in the commit */
  writing->is_pending = true;
  writing->status = MO_ERR_BUSY;
  atomic_store(&writing->ended, false);
  writing->has_thread = mo_thread_create(&writing->thread, NULL, write_beside, writing) == 0;
  return writing->has_thread ? MO_OK : mo_campaign_wait_for_commit(run);
}

bool mo_campaign_is_writing(const struct mo_campaign_run *run)
{
  const struct mo_campaign_writing *writing = run->writing;
  return writing != NULL && writing->is_pending && writing->has_thread &&
         !atomic_load(&writing->ended);
}

void mo_campaign_writing_join(struct mo_campaign_run *run)
{
  struct mo_campaign_writing *writing = run->writing;
  if (writing == NULL || !writing->has_thread)
    return;
  pthread_join(writing->thread, NULL);
  writing->has_thread = false;
}

int mo_campaign_wait_for_commit(struct mo_campaign_run *run)
{
  struct mo_campaign_writing *writing = run->writing;
  if (writing == NULL || !writing->is_pending)
    return MO_OK;
  mo_campaign_writing_join(run);
  int error = writing->status;
  if (mo_is_shortage(error))
    error = mo_runner_persist(run->runner, write_generation, writing, "a generation");
  if (error != MO_ERR_CANCELLED) /* a cancelled commit is still pending and precedes other writes */
    drop(writing);
  return error;
}

int mo_campaign_persist(struct mo_campaign_run *run, int (*write)(void *context), void *context,
                        const char *what)
{
  const int error = mo_campaign_wait_for_commit(run);
  return error == MO_OK ? mo_runner_persist(run->runner, write, context, what) : error;
}

int mo_campaign_report(struct mo_campaign_run *run)
{
  char text[256];
  const char *progress = mo_campaign_progress(run, text);
  if (progress == NULL || mo_campaign_is_writing(run))
    return MO_OK;
  const int error = mo_campaign_wait_for_commit(run);
  if (error == MO_OK)
    (void)mo_store_campaign_progress(run->jobs->store, run->id, progress);
  run->times.progress_us = mo_clock_us();
  return error;
}
