/* training.c: the kind "training": stores a submission, runs one training to its end or until a
 * request.
 *
 * A step draws robots, waits for their gradient and applies it. Rows of steps are written about
 * once a second and before every checkpoint. A checkpoint is written when it is due, at a pause, at
 * a stop, and at the end, before the controller; on devices, during the next gradient. A crash
 * loses the time since the last checkpoint: the steps after it are repeated with the same
 * results. */
#include "jobs/trainings.h"

#include <stdlib.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/held_out.h"
#include "jobs/learner.h"
#include "jobs/submission.h"
#include "store/worlds.h"

#define ROWS_MAX      256
#define RATES         16 /* steps over which the speed is averaged */
#define ROWS_EVERY_US INT64_C(1000000)
/* If the first steps fail, this many of them, the later ones will fail as well. */
#define STEPS_WITHOUT_GRADIENT_MAX 10
/* Memory of a robot in a pretraining: random body, environment, outcome. */
#define DRAWN_BYTES ((uint64_t)5 << 10)

struct run {
  struct mo_runner *runner;
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_training_status status; /* from the time of the claim */
  struct mo_learner learner;
  struct mo_held_out held_out;
  struct mo_training_step_row rows[ROWS_MAX]; /* not written yet */
  size_t n_rows;
  int64_t rows_us, checkpoint_us; /* times of the last writes */
  uint32_t checkpoint_step;       /* of the newest usable checkpoint; 0: none */
  int64_t validated;              /* newest validated step; −1: none */
  struct {
    double seconds;
    int64_t end_us;
  } rates[RATES];
  uint64_t n_rates;
  bool code_noted; /* the lineage has the code of this run, for the back end `noted` */
  enum mo_back_end noted;
};

/* Returns the steps applied so far. */
static uint32_t step_of(const struct run *run)
{
  return run->learner.training != NULL ? mo_training_step(run->learner.training) : 0;
}

static enum mo_phase enter(struct run *run, enum mo_phase phase)
{
  struct mo_runner *runner = run->runner;
  pthread_mutex_lock(&runner->runners->mutex);
  runner->live.position = step_of(run);
  runner->live.last = run->status.record.settings.n_steps;
  pthread_mutex_unlock(&runner->runners->mutex);
  return mo_runner_enter(runner, phase);
}

/* ---- writes that wait for space ---- */

static int write_rows(void *context)
{
  struct run *run = context;
  const struct mo_training_report *report = &run->rows[run->n_rows - 1].report;
  const struct mo_live *live = &run->runner->live; /* only this thread changes it */
  char data[480];
  snprintf(
      data, sizeof(data),
      "{\"id\":\"%lld\",\"step\":%u,\"steps\":%u,\"mean_loss\":%s,\"gradient_norm\":%s,\"rate\":%s,"
      "\"clipped_share\":%s,\"bodies_per_s\":%s,\"seconds_left\":%s}",
      (long long)run->id, (unsigned)report->step, (unsigned)run->status.record.settings.n_steps,
      MO_FIGURE(report->mean_loss), MO_FIGURE(report->gradient_norm), MO_FIGURE(report->rate),
      MO_FIGURE(report->clipped_share), MO_FIGURE(live->rate), MO_FIGURE(live->seconds_left));
  int error =
      mo_store_training_progress(run->jobs->store, run->id, run->rows, run->n_rows, NULL, data);
  if (error == MO_OK) {
    run->n_rows = 0;
    run->rows_us = mo_clock_us();
  }
  return error;
}

static int flush(struct run *run)
{
  return run->n_rows > 0 ? mo_runner_persist(run->runner, write_rows, run, "the learning curve")
                         : MO_OK;
}

static int write_checkpoint(void *context)
{
  struct run *run = context;
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t step = step_of(run);
  int error = mo_training_encode(run->learner.training, &bytes, &size);
  if (error == MO_OK)
    error = mo_store_training_checkpoint(run->jobs->store, run->id, step, bytes, size,
                                         run->status.record.checkpoints_kept);
  free(bytes);
  if (error == MO_OK) {
    run->checkpoint_step = step;
    run->checkpoint_us = mo_clock_us();
    run->status.job.attempts = 0;
    atomic_fetch_add(&run->jobs->training_checkpoints, 1);
    mo_memory_prove(run->jobs, run->id);
  }
  return error;
}

/* Writes the rows, then a checkpoint, so that the curve has no gaps before a checkpoint. */
static int save(struct run *run)
{
  char what[64];
  int error = flush(run);
  if (error != MO_OK || step_of(run) == run->checkpoint_step)
    return error;
  enum mo_phase phase = enter(run, MO_PHASE_SAVE);
  snprintf(what, sizeof(what), "the checkpoint of step %u", (unsigned)step_of(run));
  error = mo_runner_persist(run->runner, write_checkpoint, run, what);
  (void)mo_runner_enter(run->runner, phase);
  return error;
}

/* ---- resumption ---- */

/* Loads the newest undamaged checkpoint. MO_ERR_NOT_FOUND: there is none. */
static int load_checkpoint(struct run *run)
{
  struct mo_checkpoint_row rows[MO_CHECKPOINTS_KEPT_MAX];
  int64_t n = mo_store_checkpoints(run->jobs->store, run->id, rows, MO_CHECKPOINTS_KEPT_MAX);
  if (n < 0)
    return (int)n;
  for (int64_t i = 0; i < n; i++) {
    struct mo_message message = {.text = "its bytes have changed"};
    uint8_t *bytes = NULL;
    size_t size = 0;
    char text[256];
    int error =
        mo_store_training_checkpoint_bytes(run->jobs->store, run->id, rows[i].step, &bytes, &size);
    if (error == MO_OK)
      error = mo_training_decode(bytes, size, &run->learner.training, &message);
    free(bytes);
    if (error == MO_OK)
      run->checkpoint_step = step_of(run);
    if (error != MO_ERR_CORRUPT && error != MO_ERR_FORMAT && error != MO_ERR_IO)
      return error;
    snprintf(text, sizeof(text), "the checkpoint of step %u cannot be used (%.120s): %s",
             (unsigned)rows[i].step, error == MO_ERR_IO ? "it cannot be read" : message.text,
             i + 1 < n ? "using the previous one" : "restarting the training");
    mo_runner_warn(run->runner, error, text);
  }
  return MO_ERR_NOT_FOUND;
}

static int set_environments(struct run *run)
{
  struct mo_environment *environments = NULL;
  uint32_t n = 0;
  int error =
      mo_store_job_environments(run->jobs->store, run->id, MO_JOB_TRAINING, &environments, &n);
  if (error == MO_OK)
    error = run->status.record.draws_worlds
                ? mo_training_set_tasks(run->learner.training, environments, n)
                : mo_training_set_environments(run->learner.training, environments, n);
  mo_environments_free(environments, n);
  return error;
}

static int start_over(struct run *run)
{
  const struct mo_training_record *record = &run->status.record;
  struct mo_controller *parent = NULL;
  struct mo_bits *genotypes = NULL;
  uint32_t n = 0;
  int error = run->status.job.has_controller
                  ? mo_runner_load(run->runner, &run->status.job.controller_sha256, &parent)
                  : MO_OK;
  if (error == MO_OK && record->n_designs > 0)
    error = mo_store_job_designs(run->jobs->store, run->id, &genotypes, &n);
  if (error == MO_OK)
    error =
        mo_training_create(&record->settings, parent, genotypes != NULL ? genotypes[0].words : NULL,
                           n, &run->learner.training);
  if (error == MO_OK && record->n_environments > 0)
    error = set_environments(run);
  free(genotypes);
  mo_controller_free(parent);
  return error;
}

/* ---- steps ---- */

static void note_speed(struct run *run, double seconds)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  uint32_t left = settings->n_steps - step_of(run);
  uint64_t n = run->n_rates < RATES ? run->n_rates + 1 : RATES;
  int64_t now = mo_clock_us();
  double sum = 0;
  run->rates[run->n_rates % RATES].seconds = seconds;
  run->rates[run->n_rates % RATES].end_us = now;
  run->n_rates++;
  for (uint64_t i = 0; i < n; i++)
    sum += run->rates[i].seconds;
  const int64_t oldest = run->rates[n < RATES ? 0 : run->n_rates % RATES].end_us;
  MO_GUARD(&run->runner->runners->mutex);
  run->runner->live.position = step_of(run);
  run->runner->live.rate = sum > 0 ? (double)settings->batch * (double)n / sum : 0;
  /* Includes the time between steps: validations, checkpoints. */
  run->runner->live.seconds_left =
      left * (n > 1 ? (double)(now - oldest) * 1e-6 / (double)(n - 1) : seconds);
}

static int draw(struct run *run, const struct mo_robot **robots)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  bool replays = settings->kind == MO_TRAINING_PRETRAIN && run->n_rates == 0 && step_of(run) > 0;
  if (replays) {
    pthread_mutex_lock(&run->runner->runners->mutex);
    run->runner->live.total = (uint64_t)step_of(run) * settings->batch;
    pthread_mutex_unlock(&run->runner->runners->mutex);
    (void)enter(run, MO_PHASE_REPLAY);
  }
  int error = mo_training_draw(run->learner.training, &run->runner->interrupt,
                               &run->runner->replayed, robots);
  if (replays)
    (void)enter(run, MO_PHASE_LEARN);
  if (error == MO_ERR_CORRUPT)
    return mo_runner_fail(
        run->runner, error,
        "its bodies were drawn by another version of the program and cannot be redrawn");
  if (error == MO_ERR_EXHAUSTED)
    return mo_runner_fail(run->runner, error, "no new bodies are left to learn from");
  return error;
}

static int write_code(void *context)
{
  struct run *run = context;
  const struct mo_compute *compute = run->jobs->compute;
  const char *fingerprint = run->learner.batch.computed_on == MO_ON_DEVICE
                                ? mo_compute_device_gradient_fingerprint(compute)
                                : mo_compute_gradient_fingerprint(compute);
  return mo_store_training_code(run->jobs->store, run->id, step_of(run), fingerprint,
                                &run->status.code);
}

/* Records in the lineage which code computed the gradient, before the step is applied, because
 * other code produces other bits. This includes workers that compute bodies that a device does not
 * support. */
static int note_code(struct run *run)
{
  if (run->code_noted && run->noted == run->learner.batch.computed_on)
    return MO_OK;
  int error = mo_runner_persist(run->runner, write_code, run, "the lineage");
  run->code_noted = error == MO_OK;
  run->noted = run->learner.batch.computed_on;
  return error;
}

static bool checkpoint_is_due(const struct run *run)
{
  const struct mo_training_record *record = &run->status.record;
  const uint32_t here = step_of(run);
  if (here == run->checkpoint_step || here == 0)
    return false;
  return (record->checkpoint_every_steps > 0 && here % record->checkpoint_every_steps == 0) ||
         mo_checkpoint_is_due(&run->status.job, run->checkpoint_us, record->checkpoint_every_s);
}

/* Writes the due data of the steps applied so far. */
static int write_what_is_due(void *context)
{
  struct run *run = context;
  if (checkpoint_is_due(run))
    return save(run);
  if (run->n_rows == ROWS_MAX || mo_clock_us() - run->rows_us >= ROWS_EVERY_US)
    return flush(run);
  return MO_OK;
}

static int step(struct run *run)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  const struct mo_robot *robots = NULL;
  int error = draw(run, &robots);
  if (error == MO_OK)
    error = mo_learner_gradient(&run->learner, robots);
  if (error == MO_OK)
    error = note_code(run);
  struct mo_training_step_row *row = &run->rows[run->n_rows];
  if (error == MO_OK)
    error = mo_learner_apply(&run->learner, &row->report, &row->seconds);
  if (error != MO_OK)
    return error;
  run->n_rows++;
  note_speed(run, row->seconds);
  atomic_fetch_add(&run->jobs->training_steps, 1);
  atomic_fetch_add(&run->jobs->training_robots, settings->batch);
  atomic_fetch_add(&run->jobs->training_diverged, row->report.diverged);
  atomic_fetch_add(&run->jobs->training_zeroed, row->report.zeroed);
  atomic_fetch_add(&run->jobs->training_ns, (uint64_t)(row->seconds * 1e9));
  return MO_OK;
}

/* Ends a training if no step has changed the controller. */
static int check_learned(struct run *run)
{
  const struct mo_training *training = run->learner.training;
  const uint32_t here = step_of(run), n_steps = run->status.record.settings.n_steps;
  char text[256];
  if (here == 0 || mo_training_skipped(training) < here ||
      (here < STEPS_WITHOUT_GRADIENT_MAX && here < n_steps))
    return MO_OK;
  const int error = flush(run);
  if (error != MO_OK)
    return error;
  snprintf(text, sizeof(text),
           "every robot of the first %u step%s diverged or had no finite gradient, so nothing was "
           "learned; choose a smaller dt_s or stiffness_n_per_m",
           (unsigned)here, here > 1 ? "s" : "");
  return mo_runner_give_up(run->runner, MO_ERR_RANGE, text);
}

static int write_validation(void *context)
{
  struct run *run = context;
  return mo_store_training_progress(run->jobs->store, run->id, NULL, 0, &run->status.validation,
                                    NULL);
}

static int validate(struct run *run)
{
  uint32_t every = run->status.record.validate_every_steps, here = step_of(run);
  if (every == 0 || (here % every != 0 && here != run->status.record.settings.n_steps) ||
      here <= run->validated)
    return MO_OK;
  int error = flush(run);
  if (error != MO_OK)
    return error;
  (void)enter(run, MO_PHASE_VALIDATE);
  run->status.validation.step = here;
  error =
      mo_held_out_score(run->runner, &run->held_out, mo_training_controller(run->learner.training),
                        &run->status, &run->status.validation);
  if (error == MO_OK)
    error = mo_runner_persist(run->runner, write_validation, run, "a validation");
  (void)enter(run, MO_PHASE_LEARN);
  if (error == MO_OK) {
    run->validated = here;
    atomic_fetch_add(&run->jobs->training_validations, 1);
  }
  return error;
}

/* ---- the end ---- */

static int write_result(void *context)
{
  struct run *run = context;
  const struct mo_training_record *record = &run->status.record;
  struct mo_learned learned;
  char made[MO_MADE_BYTES];
  int error = mo_learned_create(run->jobs, &run->status.job, run->learner.training,
                                &run->status.code, &learned);
  if (error == MO_OK)
    error = mo_store_training_finish(run->jobs->store, run->id,
                                     mo_result_name(&run->status.job, record->name, made),
                                     learned.bytes, learned.size, learned.controller);
  mo_learned_free(&learned);
  return error;
}

static int prepare(struct run *run)
{
  int error = mo_store_training(run->jobs->store, run->id, &run->status);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  run->validated = run->status.has_validation ? (int64_t)run->status.validation.step : -1;
  error = mo_back_end_check(run->jobs, run->status.job.back_end);
  if (error != MO_OK)
    return error;
  error = load_checkpoint(run);
  if (error == MO_ERR_NOT_FOUND)
    error = start_over(run);
  if (error != MO_OK)
    return error;
  run->checkpoint_us = mo_clock_us();
  error = mo_learner_prepare(&run->learner, run->runner, &run->status.job, write_what_is_due, run);
  if (error == MO_OK && run->status.record.validate_every_steps > 0)
    error = mo_held_out_load(run->jobs->store, &run->status, &run->held_out);
  return error;
}

static int learn(struct run *run)
{
  int error = MO_OK;
  (void)enter(run, MO_PHASE_LEARN);
  while (error == MO_OK) {
    if (mo_runner_is_interrupted(run->runner))
      return MO_ERR_CANCELLED;
    error = check_learned(run);
    if (error == MO_OK)
      error = validate(run);
    if (error != MO_OK || step_of(run) == run->status.record.settings.n_steps)
      break;
    error = step(run);
  }
  if (error == MO_OK)
    error = save(run);
  if (error == MO_OK) {
    (void)enter(run, MO_PHASE_SAVE);
    error = mo_runner_persist(run->runner, write_result, run, "the trained controller");
  }
  return error;
}

/* Saves the results of a stopped run. */
static int save_rest(void *context)
{
  struct run *run = context;
  return run->learner.training != NULL ? save(run) : MO_OK;
}

static void clean_up(void *context)
{
  struct run *run = context;
  mo_learner_free(&run->learner);
  mo_held_out_free(&run->held_out);
}

static int run_training(struct mo_runner *runner, void *context)
{
  struct run *run = context;
  run->runner = runner;
  run->jobs = runner->jobs;
  run->id = runner->id;
  int error = prepare(run);
  return error == MO_OK ? learn(run) : error;
}

/* ---- submission ---- */

static struct mo_need estimate(const struct mo_jobs *jobs, const struct mo_training_record *record,
                               enum mo_back_end back_end)
{
  const struct mo_training_settings *settings = &record->settings;
  const uint64_t hands = back_end == MO_ON_DEVICE ? 2 : 1,
                 drawn = (uint64_t)settings->n_steps * settings->batch;
  struct mo_need need = {0};
  mo_memory_add_learning(jobs, settings->batch, &settings->physics, back_end, &need);
  if (settings->kind == MO_TRAINING_PRETRAIN)
    need.own +=
        hands * settings->batch * DRAWN_BYTES +
        mo_form_set_estimate(jobs->lattice->workspace, drawn + drawn / (MO_HELD_OUT_ONE_IN - 1));
  else
    need.own += record->n_designs * MO_DESIGN_BYTES + hands * settings->batch * MO_ROBOT_BYTES;
  return need;
}

static int load_population(struct mo_jobs *jobs, const struct mo_training_request *request,
                           struct mo_bits **genotypes, uint32_t *n, struct mo_message *message)
{
  const long long population = (long long)request->record.population;
  int error = mo_store_population(jobs->store, request->record.population, request->population_best,
                                  genotypes, n);
  switch (error) {
  case MO_OK: break;
  case MO_ERR_NOT_FOUND:
    return mo_fail(message, error,
                   "population %lld does not exist; it must be an evaluation or a campaign",
                   population);
  case MO_ERR_CONFLICT:
    return mo_fail(message, error, "population %lld has not succeeded, or has no generation yet",
                   population);
  default:
    return mo_fail(message, error, "the population cannot be read: %s", mo_error_text(error));
  }
  if (*n == 0)
    return mo_fail(message, MO_ERR_CONFLICT, "every design of population %lld has diverged",
                   population);
  if (*n > MO_TRAINING_DESIGNS_MAX) /* the population of a campaign */
    return mo_fail(message, MO_ERR_RANGE,
                   "a finetuning must have 1 to %d designs, got %u; select the best ones",
                   MO_TRAINING_DESIGNS_MAX, (unsigned)*n);
  return MO_OK;
}

/* Chooses the back end and the designs; checks the memory. */
static int complete(struct mo_jobs *jobs, struct mo_training_request *request,
                    struct mo_placed *placed, struct mo_message *message)
{
  struct mo_training_record *record = &request->record;
  /* For drawn worlds, the scores of the test set say which orientation is best. */
  const bool is_listed = request->environments != NULL && !record->draws_worlds;
  const char *const set = record->environment_set[0] != '\0' ? record->environment_set
                          : is_listed                        ? NULL
                                                             : "paper-test";
  const struct mo_orienting under = {.controller = request->parent,
                                     .environment_set = set,
                                     .environments = request->environments,
                                     .n_environments = record->n_environments,
                                     .physics = &record->settings.physics,
                                     .precision = MO_FLOAT32,
                                     .workspace = jobs->lattice->workspace};
  struct mo_bits *population = NULL;
  struct mo_need need;
  int error = mo_back_end_choose(
      jobs, &request->job, mo_back_end_unsuited(request->environments, record->n_environments),
      true, message);
  if (error == MO_OK && record->population != 0)
    error = load_population(jobs, request, &population, &record->n_designs, message);
  if (error == MO_OK) {
    need = estimate(jobs, record, (enum mo_back_end)request->job.back_end);
    error = mo_memory_check(jobs, &need, message);
  }
  if (error == MO_OK)
    error = mo_placed_create(jobs->lattice->workspace,
                             population != NULL ? population : request->genotypes,
                             record->n_designs, placed);
  free(population);
  if (error == MO_OK)
    error = mo_placed_orient(jobs, &under, (enum mo_back_end)request->job.back_end, placed,
                             record->n_designs, request->notes, request->n_notes, message);
  request->forms = placed->forms;
  request->genotypes = placed->genotypes;
  return error;
}

int mo_jobs_submit_training(struct mo_jobs *jobs, const struct mo_training_request *asked,
                            int64_t *id, bool *replayed, struct mo_message *message)
{
  struct mo_training_request request = *asked;
  struct mo_placed placed = {NULL, NULL};
  if (asked->parent == NULL && asked->record.settings.kind == MO_TRAINING_FINETUNE)
    request.parent = "default";
  const struct mo_submitting submitting = {MO_JOB_TRAINING, &asked->job, request.parent, 1, 0};
  int error = mo_submitting_begin(jobs, &submitting, id, replayed, message);
  if (error != MO_OK || *replayed)
    return error;
  error = complete(jobs, &request, &placed, message);
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, 1, 0, message);
  if (error == MO_OK)
    error = mo_submitting_end(jobs, &submitting,
                              mo_store_submit_training(jobs->store, &request, id, replayed),
                              *replayed, message);
  mo_placed_free(&placed);
  return error;
}

/* ---- the kind ---- */

static int need(struct mo_jobs *jobs, int64_t id, struct mo_need *need)
{
  struct mo_training_status status;
  const int error = mo_store_training(jobs->store, id, &status);
  if (error == MO_OK)
    *need = estimate(jobs, &status.record, status.job.back_end);
  return error;
}

const struct mo_kind mo_training_kind = {.kind = MO_JOB_TRAINING,
                                         .need = need,
                                         .first = MO_PHASE_LEARN,
                                         .run_bytes = sizeof(struct run),
                                         .run = run_training,
                                         .save = save_rest,
                                         .clean_up = clean_up};
