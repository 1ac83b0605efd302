/* training_run.c: runs one training to its end or until a request.
 *
 * A step draws robots, waits for their gradient and applies it. Rows of steps are written about
 * once a second and before every checkpoint. A checkpoint is written when it is due, at a pause, at
 * a stop, and at the end, before the controller; on devices, during the next gradient. A crash
 * loses the time since the last checkpoint: the steps from there are run again with the same
 * results.
 *
 * A run that lacks space tries again every second (retry_ms) until it succeeds or a request
 * arrives. A stop request does not wait: the next process continues from the last checkpoint. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "jobs/internal.h"

#include "base/clock.h"

#define ROWS_MAX      256
#define RATES         16 /* steps over which the speed is averaged */
#define ROWS_EVERY_US INT64_C(1000000)

struct run {
  struct mo_attempt attempt;
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_training_status status; /* from the time of the claim */
  struct mo_learner learner;
  struct mo_compute_share *share;
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
  bool code_noted; /* the lineage has this run's code, for the back end `noted` */
  enum mo_back_end noted;
};

static int set_phase(struct mo_runner *runner, int phase, const char *reason)
{
  struct mo_training_live *live = &runner->live.training;
  enum mo_training_phase before;
  pthread_mutex_lock(&runner->runners->mutex);
  before = live->phase;
  live->phase = (enum mo_training_phase)phase;
  snprintf(live->reason, sizeof(live->reason), "%s", reason);
  pthread_mutex_unlock(&runner->runners->mutex);
  return (int)before;
}

static int enter(struct run *run, enum mo_training_phase phase)
{
  struct mo_runner *runner = run->attempt.runner;
  pthread_mutex_lock(&runner->runners->mutex);
  runner->live.training.step =
      run->learner.training != NULL ? mo_training_step(run->learner.training) : 0;
  pthread_mutex_unlock(&runner->runners->mutex);
  return set_phase(runner, (int)phase, "");
}

/* ---- writes that wait for space ---- */

static const char *number(double value, char text[32])
{
  snprintf(text, 32, isfinite(value) ? "%.9g" : "null", value);
  return text;
}

static int write_rows(void *context)
{
  struct run *run = context;
  const struct mo_training_report *report = &run->rows[run->n_rows - 1].report;
  const struct mo_training_live *live =
      &run->attempt.runner->live.training; /* only this thread changes it */
  char data[480], loss[32], norm[32], rate[32], clipped[32], speed[32], left[32];
  int error;
  snprintf(
      data, sizeof(data),
      "{\"id\":\"%lld\",\"step\":%u,\"steps\":%u,\"mean_loss\":%s,\"gradient_norm\":%s,\"rate\":%s,"
      "\"clipped_share\":%s,\"bodies_per_s\":%s,\"seconds_left\":%s}",
      (long long)run->id, (unsigned)report->step, (unsigned)run->status.record.settings.n_steps,
      number(report->mean_loss, loss), number(report->gradient_norm, norm),
      number(report->rate, rate), number(report->clipped_share, clipped),
      number(live->robots_per_s, speed), number(live->seconds_left, left));
  error = mo_store_training_progress(run->jobs->store, run->id, run->rows, run->n_rows, NULL, data);
  if (error == MO_OK) {
    run->n_rows = 0;
    run->rows_us = mo_clock_us();
  }
  return error;
}

static int flush(struct run *run)
{
  return run->n_rows > 0 ? mo_attempt_persist(&run->attempt, write_rows, run, "the learning curve")
                         : MO_OK;
}

static int write_checkpoint(void *context)
{
  struct run *run = context;
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t step = mo_training_step(run->learner.training);
  int error = mo_training_encode(run->learner.training, &bytes, &size);
  if (error == MO_OK)
    error = mo_store_training_checkpoint(run->jobs->store, run->id, step, bytes, size,
                                         run->status.record.checkpoints_kept);
  free(bytes);
  if (error == MO_OK) {
    run->checkpoint_step = step;
    run->checkpoint_us = mo_clock_us();
    atomic_fetch_add(&run->jobs->training_checkpoints, 1);
    mo_memory_prove(run->jobs, run->id);
  }
  return error;
}

/* Writes the rows, then a checkpoint, so that the curve has no gaps before a checkpoint. */
static int save(struct run *run)
{
  char what[64];
  int phase, error = flush(run);
  if (error != MO_OK || mo_training_step(run->learner.training) == run->checkpoint_step)
    return error;
  phase = enter(run, MO_TRAINING_SAVE);
  snprintf(what, sizeof(what), "the checkpoint of step %u",
           (unsigned)mo_training_step(run->learner.training));
  error = mo_attempt_persist(&run->attempt, write_checkpoint, run, what);
  (void)set_phase(run->attempt.runner, phase, "");
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
    struct mo_message message = {.text = "its bytes are not those that were written"};
    uint8_t *bytes = NULL;
    size_t size = 0;
    char text[256];
    int error =
        mo_store_training_checkpoint_bytes(run->jobs->store, run->id, rows[i].step, &bytes, &size);
    if (error == MO_OK)
      error = mo_training_decode(bytes, size, &run->learner.training, &message);
    free(bytes);
    if (error == MO_OK)
      run->checkpoint_step = mo_training_step(run->learner.training);
    if (error != MO_ERR_CORRUPT && error != MO_ERR_FORMAT && error != MO_ERR_IO)
      return error;
    snprintf(text, sizeof(text), "the checkpoint of step %u cannot be used (%.120s): %s",
             (unsigned)rows[i].step, error == MO_ERR_IO ? "it cannot be read" : message.text,
             i + 1 < n ? "the one before it is taken" : "the training begins anew");
    mo_attempt_warn(&run->attempt, error, text);
  }
  return MO_ERR_NOT_FOUND;
}

static int begin_anew(struct run *run)
{
  const struct mo_training_record *record = &run->status.record;
  struct mo_message message = {.text = ""};
  struct mo_controller *parent = NULL;
  struct mo_bits *genotypes = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t n = 0;
  int error = MO_OK;
  if (record->has_parent) {
    error = mo_store_controller_bytes(run->jobs->store, &record->parent_sha256, &bytes, &size);
    if (error == MO_OK)
      error = mo_controller_decode(bytes, size, &parent, NULL);
    free(bytes);
    if (error == MO_ERR_CORRUPT || error == MO_ERR_IO || error == MO_ERR_FORMAT)
      return mo_attempt_fail_controller(&run->attempt, error, &record->parent_sha256);
  }
  if (error == MO_OK && record->n_designs > 0)
    error = mo_store_training_designs(run->jobs->store, run->id, &genotypes, &n);
  if (error == MO_OK)
    error =
        mo_training_create(&record->settings, parent, genotypes != NULL ? genotypes[0].words : NULL,
                           n, &run->learner.training, &message);
  if (error != MO_OK && run->attempt.text[0] == '\0' && message.text[0] != '\0')
    snprintf(run->attempt.text, sizeof(run->attempt.text),
             "the training cannot be prepared: %.200s", message.text);
  free(genotypes);
  mo_controller_free(parent);
  return error;
}

static int prepare(struct run *run)
{
  int error = mo_store_training(run->jobs->store, run->id, &run->status);
  if (error != MO_OK)
    return mo_attempt_fail_unreadable(&run->attempt, error);
  run->validated = run->status.has_validation ? (int64_t)run->status.validation.step : -1;
  error = mo_back_end_check(run->jobs, run->status.job.back_end);
  if (error != MO_OK)
    return error;
  error = load_checkpoint(run);
  if (error == MO_ERR_NOT_FOUND)
    error = begin_anew(run);
  if (error != MO_OK)
    return error;
  run->checkpoint_us = mo_clock_us();
  error = mo_learner_prepare(run->jobs, run->status.job.back_end, &run->learner);
  if (error == MO_OK)
    error = mo_share_open(run->jobs, run->id, MO_JOB_TRAINING, &run->share);
  if (error == MO_OK && run->status.record.validate_every_steps > 0)
    error = mo_held_out_load(run->jobs->store, &run->status, &run->held_out);
  return error;
}

/* ---- steps ---- */

static void note_speed(struct run *run, double seconds)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  uint32_t left = settings->n_steps - mo_training_step(run->learner.training);
  uint64_t n = run->n_rates < RATES ? run->n_rates + 1 : RATES;
  int64_t now = mo_clock_us(), oldest = now;
  double sum = 0;
  run->rates[run->n_rates % RATES].seconds = seconds;
  run->rates[run->n_rates % RATES].end_us = now;
  run->n_rates++;
  for (uint64_t i = 0; i < n; i++) {
    sum += run->rates[i].seconds;
    if (run->rates[i].end_us < oldest)
      oldest = run->rates[i].end_us;
  }
  pthread_mutex_lock(&run->attempt.runner->runners->mutex);
  run->attempt.runner->live.training.step = mo_training_step(run->learner.training);
  run->attempt.runner->live.training.robots_per_s =
      sum > 0 ? (double)settings->batch * (double)n / sum : 0;
  /* Includes the time between steps: validations, checkpoints. */
  run->attempt.runner->live.training.seconds_left =
      left * (n > 1 ? (double)(now - oldest) * 1e-6 / (double)(n - 1) : seconds);
  pthread_mutex_unlock(&run->attempt.runner->runners->mutex);
}

static int draw(struct run *run, const struct mo_robot **robots)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  bool replays = settings->kind == MO_TRAINING_PRETRAIN && run->n_rates == 0 &&
                 mo_training_step(run->learner.training) > 0;
  int error;
  if (replays) {
    pthread_mutex_lock(&run->attempt.runner->runners->mutex);
    run->attempt.runner->live.training.replay_total =
        (uint64_t)mo_training_step(run->learner.training) * settings->batch;
    pthread_mutex_unlock(&run->attempt.runner->runners->mutex);
    (void)enter(run, MO_TRAINING_REPLAY);
  }
  error = mo_training_draw(run->learner.training, &run->attempt.runner->interrupt,
                           &run->attempt.runner->replayed, robots);
  if (replays)
    (void)enter(run, MO_TRAINING_LEARN);
  if (error == MO_ERR_CORRUPT)
    return mo_attempt_fail(
        &run->attempt, error,
        "its bodies were drawn by another version of the program: they cannot be drawn again");
  if (error == MO_ERR_EXHAUSTED)
    return mo_attempt_fail(&run->attempt, error, "no new bodies are left to learn from");
  return error;
}

static int write_code(void *context)
{
  struct run *run = context;
  const struct mo_compute *compute = run->jobs->compute;
  const char *fingerprint = run->learner.batch.computed_on == MO_ON_DEVICE
                                ? mo_compute_device_gradient_fingerprint(compute)
                                : mo_compute_gradient_fingerprint(compute);
  return mo_store_training_code(run->jobs->store, run->id, mo_training_step(run->learner.training),
                                fingerprint, &run->status.code);
}

/* Records in the lineage, before the step is applied, which code computed the gradient, because
 * other code gives other bits. This includes workers that compute what a device does not support.
 */
static int note_code(struct run *run)
{
  int error;
  if (run->code_noted && run->noted == run->learner.batch.computed_on)
    return MO_OK;
  error = mo_attempt_persist(&run->attempt, write_code, run, "the lineage");
  run->code_noted = error == MO_OK;
  run->noted = run->learner.batch.computed_on;
  return error;
}

static bool checkpoint_is_due(const struct run *run)
{
  const struct mo_training_record *record = &run->status.record;
  uint32_t here = mo_training_step(run->learner.training);
  if (here == run->checkpoint_step || here == 0)
    return false;
  return (record->checkpoint_every_steps > 0 && here % record->checkpoint_every_steps == 0) ||
         (record->checkpoint_every_s > 0 &&
          mo_clock_us() - run->checkpoint_us >= (int64_t)record->checkpoint_every_s * 1000000);
}

/* Writes what is due of the steps applied so far. */
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
  const struct mo_learner_turn turn = {.urgency = run->status.job.priority,
                                       .tag = run->id,
                                       .share = run->share,
                                       .cancel = &run->attempt.runner->interrupt,
                                       .write = write_what_is_due,
                                       .context = run};
  struct mo_training_step_row *row;
  int error = draw(run, &robots);
  if (error == MO_OK)
    error = mo_learner_gradient(&run->learner, robots, &turn);
  if (error == MO_OK)
    error = note_code(run);
  row = &run->rows[run->n_rows];
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

static int write_validation(void *context)
{
  struct run *run = context;
  return mo_store_training_progress(run->jobs->store, run->id, NULL, 0, &run->status.validation,
                                    NULL);
}

static int validate(struct run *run)
{
  uint32_t every = run->status.record.validate_every_steps,
           here = mo_training_step(run->learner.training);
  int error;
  if (every == 0 || (here % every != 0 && here != run->status.record.settings.n_steps) ||
      here <= run->validated)
    return MO_OK;
  error = flush(run);
  if (error != MO_OK)
    return error;
  (void)enter(run, MO_TRAINING_VALIDATE);
  run->status.validation.step = here;
  error =
      mo_held_out_score(run->jobs, &run->held_out, mo_training_controller(run->learner.training),
                        &run->status.record.settings.physics, run->status.job.back_end, run->id,
                        run->share, &run->attempt.runner->interrupt, &run->status.validation);
  if (error == MO_OK)
    error = mo_attempt_persist(&run->attempt, write_validation, run, "a validation");
  (void)enter(run, MO_TRAINING_LEARN);
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
  struct mo_controller *controller = NULL;
  char digits[MO_SHA256_DIGITS + 1], name[MO_NAME_BYTES_MAX + 1];
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error;
  mo_sha256_to_hex(&record->parent_sha256, digits);
  if (record->name[0] != '\0')
    snprintf(name, sizeof(name), "%s", record->name);
  else
    snprintf(name, sizeof(name), "training-%lld", (long long)run->id);
  error = mo_training_export(run->learner.training, record->has_parent ? digits : NULL,
                             run->jobs->code_versions[run->status.job.back_end], &run->status.code,
                             &controller);
  if (error == MO_OK)
    error = mo_controller_encode(controller, &bytes, &size);
  if (error == MO_OK)
    error = mo_store_training_finish(run->jobs->store, run->id, name, bytes, size, controller);
  free(bytes);
  mo_controller_free(controller);
  return error;
}

static int learn(struct run *run)
{
  int error = MO_OK;
  (void)enter(run, MO_TRAINING_LEARN);
  while (error == MO_OK) {
    if (mo_runner_is_interrupted(run->attempt.runner))
      return MO_ERR_CANCELLED;
    error = validate(run);
    if (error != MO_OK ||
        mo_training_step(run->learner.training) == run->status.record.settings.n_steps)
      break;
    error = step(run);
  }
  if (error == MO_OK)
    error = save(run);
  if (error == MO_OK) {
    (void)enter(run, MO_TRAINING_SAVE);
    error = mo_attempt_persist(&run->attempt, write_result, run, "the trained controller");
  }
  return error;
}

/* Saves what a stopped run has computed. */
static int save_rest(void *context)
{
  struct run *run = context;
  return run->learner.training != NULL ? save(run) : MO_OK;
}

static bool run_training(struct mo_runner *runner, int64_t id)
{
  struct run *run = calloc(1, sizeof(*run));
  bool failed;
  int error;
  if (run == NULL) {
    runner->is_short = true;
    return false;
  }
  run->attempt = (struct mo_attempt){.jobs = runner->jobs, .runner = runner, .id = id};
  run->jobs = runner->jobs;
  run->id = id;
  error = prepare(run);
  if (error == MO_OK)
    error = learn(run);
  failed = mo_attempt_settle(&run->attempt, error, save_rest, run);
  mo_learner_free(&run->learner);
  mo_share_close(run->jobs, id);
  mo_held_out_free(&run->held_out);
  free(run);
  return failed;
}

static int need(struct mo_jobs *jobs, int64_t id, struct mo_need *need)
{
  struct mo_training_status status;
  const int error = mo_store_training(jobs->store, id, &status);
  *need = (struct mo_need){0};
  if (error == MO_OK)
    *need = mo_need_of_training(jobs, &status.record, status.job.back_end);
  return mo_is_shortage(error) ? error : MO_OK;
}

static void begin(struct mo_runner *runner)
{
  runner->live.training = (struct mo_training_live){.phase = MO_TRAINING_LEARN, .seconds_left = -1};
}

const struct mo_runner_kind mo_training_runners = {.noun = "training",
                                                   .queued = mo_store_queued_trainings,
                                                   .need = need,
                                                   .start = mo_store_training_start,
                                                   .park = mo_store_training_park,
                                                   .run = run_training,
                                                   .begin = begin,
                                                   .set_phase = set_phase,
                                                   .waiting = MO_TRAINING_WAIT,
                                                   .busy = MO_TRAINING_LEARN};
