/* training_run.c: one training, from where it stands to its end or until somebody wants something else.
 *
 * A step: draw its robots, wait for their gradient, apply it. Rows of steps are written about once a second and before every
 * checkpoint. A checkpoint is written when it is due, at a pause, at a stop, and at the end, before the controller. What a crash
 * costs is the time since the last checkpoint: the steps from there are run again and give the same numbers.
 *
 * Want of room is waited for: the run tries again every second until it succeeds or a wish comes. A stop does not wait: the next
 * start goes on from the last checkpoint. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "jobs/internal.h"

#define ROWS_MAX       256
#define RATES          16 /* steps that the speed is averaged over */
#define ROWS_EVERY_US  INT64_C(1000000)
#define RETRY_SPACE_MS 1000

struct run {
  struct mo_jobs *jobs;
  struct mo_trainer *trainer;
  int64_t id;
  struct mo_training_status status; /* as it was at the claim */
  struct mo_training *training;
  struct mo_gradient_state *gradients;
  struct mo_held_out held_out;
  double *d_parameters;
  struct mo_outcome *outcomes;
  struct mo_training_step_row rows[ROWS_MAX]; /* not written yet */
  size_t n_rows;
  int64_t rows_us, checkpoint_us; /* when they were written last */
  uint32_t checkpoint_step;       /* of the newest good checkpoint; 0: none */
  int64_t validated;              /* newest step of which there is a validation; −1: none */
  struct {
    double seconds;
    int64_t end_us;
  } rates[RATES];
  uint64_t n_rates;
  bool code_noted;   /* this run's code is in the lineage */
  bool winding_down; /* a wish has come: only what is computed is saved */
  char text[256];    /* of an error */
};

static int fail(struct run *run, int error, const char *text)
{
  snprintf(run->text, sizeof(run->text), "%s", text);
  return error;
}

static void warn(const struct run *run, int error, const char *text)
{
  if (run->jobs->config.warn != NULL)
    run->jobs->config.warn(run->jobs->config.warn_context, run->id, error, text);
}

static bool is_interrupted(const struct run *run)
{
  return __atomic_load_n(&run->trainer->interrupt, __ATOMIC_RELAXED) != 0;
}

static enum mo_training_phase set_phase(struct run *run, enum mo_training_phase phase, const char *reason)
{
  struct mo_training_live *live = &run->trainer->live;
  enum mo_training_phase before;
  pthread_mutex_lock(&run->jobs->trainers_mutex);
  before = live->phase;
  live->phase = phase;
  live->step = run->training != NULL ? mo_training_step(run->training) : 0;
  snprintf(live->reason, sizeof(live->reason), "%s", reason);
  pthread_mutex_unlock(&run->jobs->trainers_mutex);
  return before;
}

/* ---- writes that wait for room ---- */

/* What passes by itself. Want of memory ends an attempt, and so it must not be in the way of the note of that. */
static bool is_passing(const struct run *run, int error)
{
  return error == MO_ERR_NO_SPACE || error == MO_ERR_BUSY || (error == MO_ERR_NO_MEMORY && run->winding_down);
}

static const char *passing_text(int error)
{
  switch (error) {
  case MO_ERR_NO_SPACE: return "no space on the disk of the state folder for %s: make room there; it goes on by itself";
  case MO_ERR_BUSY:
    return "another program holds the database locked, %s cannot be written: end it; it goes on by itself";
  default: return "no memory for %s: it goes on by itself when there is some";
  }
}

/* Runs `write` until it is done or fails for a reason that does not pass. MO_ERR_CANCELLED: a wish came first. */
static int persist(struct run *run, int (*write)(struct run *run), const char *what)
{
  enum mo_trainer_wish least = run->winding_down ? MO_WISH_STOP : MO_WISH_PAUSE;
  enum mo_training_phase phase = MO_TRAINING_LEARN;
  char reason[160];
  bool waits = false;
  int error;
  for (;;) {
    error = write(run);
    if (!is_passing(run, error))
      break;
    if (!waits) {
      snprintf(reason, sizeof(reason), passing_text(error), what);
      phase = set_phase(run, MO_TRAINING_WAIT, reason);
      warn(run, error, reason);
      waits = true;
    }
    if (mo_trainer_wished(run->trainer) >= least) {
      error = MO_ERR_CANCELLED;
      break;
    }
    mo_trainer_sleep(run->trainer, RETRY_SPACE_MS, least);
  }
  if (waits)
    (void)set_phase(run, phase, "");
  return error;
}

static const char *number(double value, char text[32])
{
  snprintf(text, 32, isfinite(value) ? "%.9g" : "null", value);
  return text;
}

static int write_rows(struct run *run)
{
  const struct mo_training_report *report = &run->rows[run->n_rows - 1].report;
  const struct mo_training_live *live = &run->trainer->live; /* which this thread alone changes */
  char data[480], loss[32], norm[32], rate[32], clipped[32], speed[32], left[32];
  int error;
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"step\":%u,\"steps\":%u,\"mean_loss\":%s,\"gradient_norm\":%s,\"rate\":%s,"
           "\"clipped_share\":%s,\"bodies_per_s\":%s,\"seconds_left\":%s}",
           (long long)run->id, (unsigned)report->step, (unsigned)run->status.record.settings.n_steps,
           number(report->mean_loss, loss), number(report->gradient_norm, norm), number(report->rate, rate),
           number(report->clipped_share, clipped), number(live->robots_per_s, speed), number(live->seconds_left, left));
  error = mo_store_training_progress(run->jobs->store, run->id, run->rows, run->n_rows, NULL, data);
  if (error == MO_OK) {
    run->n_rows = 0;
    run->rows_us = mo_jobs_clock_us();
  }
  return error;
}

static int flush(struct run *run)
{
  return run->n_rows > 0 ? persist(run, write_rows, "the learning curve") : MO_OK;
}

static int write_checkpoint(struct run *run)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t step = mo_training_step(run->training);
  int error = mo_training_encode(run->training, &bytes, &size);
  if (error == MO_OK)
    error =
        mo_store_training_checkpoint(run->jobs->store, run->id, step, bytes, size, run->status.record.checkpoints_kept);
  free(bytes);
  if (error == MO_OK) {
    run->checkpoint_step = step;
    run->checkpoint_us = mo_jobs_clock_us();
    atomic_fetch_add(&run->jobs->training_checkpoints, 1);
  }
  return error;
}

/* Rows first: the curve has no holes before a checkpoint. */
static int save(struct run *run)
{
  enum mo_training_phase phase;
  char what[64];
  int error = flush(run);
  if (error != MO_OK || mo_training_step(run->training) == run->checkpoint_step)
    return error;
  phase = set_phase(run, MO_TRAINING_SAVE, "");
  snprintf(what, sizeof(what), "the checkpoint of step %u", (unsigned)mo_training_step(run->training));
  error = persist(run, write_checkpoint, what);
  (void)set_phase(run, phase, "");
  return error;
}

/* ---- where it stands ---- */

/* The newest checkpoint that is whole. MO_ERR_NOT_FOUND: there is none. */
static int load_checkpoint(struct run *run)
{
  struct mo_training_checkpoint_row rows[MO_CHECKPOINTS_KEPT_MAX];
  int64_t n = mo_store_training_checkpoints(run->jobs->store, run->id, rows, MO_CHECKPOINTS_KEPT_MAX);
  if (n < 0)
    return (int)n;
  for (int64_t i = 0; i < n; i++) {
    struct mo_message message = {.text = "its bytes are not those that were written"};
    uint8_t *bytes = NULL;
    size_t size = 0;
    char text[256];
    int error = mo_store_training_checkpoint_bytes(run->jobs->store, run->id, rows[i].step, &bytes, &size);
    if (error == MO_OK)
      error = mo_training_decode(bytes, size, &run->training, &message);
    free(bytes);
    if (error == MO_OK)
      run->checkpoint_step = mo_training_step(run->training);
    if (error != MO_ERR_CORRUPT && error != MO_ERR_FORMAT && error != MO_ERR_IO)
      return error;
    snprintf(text, sizeof(text), "the checkpoint of step %u cannot be used (%.120s): %s", (unsigned)rows[i].step,
             error == MO_ERR_IO ? "it cannot be read" : message.text,
             i + 1 < n ? "the one before it is taken" : "the training begins anew");
    warn(run, error, text);
  }
  return MO_ERR_NOT_FOUND;
}

static int begin_anew(struct run *run)
{
  const struct mo_training_record *record = &run->status.record;
  struct mo_message message = {.text = ""};
  struct mo_controller *parent = NULL;
  struct mo_bits *genotypes = NULL;
  char digits[MO_SHA256_DIGITS + 1];
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t n = 0;
  int error = MO_OK;
  if (record->has_parent) {
    error = mo_store_controller_bytes(run->jobs->store, &record->parent_sha256, &bytes, &size);
    if (error == MO_OK)
      error = mo_controller_decode(bytes, size, &parent, NULL);
    free(bytes);
    if (error == MO_ERR_CORRUPT || error == MO_ERR_IO || error == MO_ERR_FORMAT) {
      mo_sha256_to_hex(&record->parent_sha256, digits);
      snprintf(run->text, sizeof(run->text),
               "the file controllers/%s.safetensors is missing, damaged or unreadable: store the same file again (PUT "
               "/v1/controllers/<name>), then submit again",
               digits);
      return error;
    }
  }
  if (error == MO_OK && record->n_designs > 0)
    error = mo_store_training_designs(run->jobs->store, run->id, &genotypes, &n);
  if (error == MO_OK)
    error = mo_training_create(&record->settings, parent, genotypes != NULL ? genotypes[0].words : NULL, n,
                               &run->training, &message);
  if (error != MO_OK && run->text[0] == '\0')
    snprintf(run->text, sizeof(run->text), "the training cannot be prepared: %.200s",
             message.text[0] != '\0' ? message.text : mo_error_text(error));
  free(genotypes);
  mo_controller_free(parent);
  return error;
}

static int prepare(struct run *run)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  int error = mo_store_training(run->jobs->store, run->id, &run->status);
  if (error != MO_OK)
    return fail(run, error, "the training cannot be read");
  run->validated = run->status.has_validation ? (int64_t)run->status.validation.step : -1;
  error = load_checkpoint(run);
  if (error == MO_ERR_NOT_FOUND)
    error = begin_anew(run);
  if (error != MO_OK)
    return error;
  run->checkpoint_us = mo_jobs_clock_us();
  run->d_parameters = calloc(mo_training_controller(run->training)->n_parameters, sizeof(double));
  run->outcomes = calloc(settings->batch, sizeof(*run->outcomes));
  error = run->d_parameters == NULL || run->outcomes == NULL
              ? MO_ERR_NO_MEMORY
              : mo_gradient_state_create(run->jobs->compute, &run->gradients);
  if (error == MO_OK && run->status.record.validate_every_steps > 0)
    error = mo_held_out_load(run->jobs->store, &run->status, &run->held_out);
  return error;
}

/* ---- steps ---- */

static void note_speed(struct run *run, double seconds)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  uint32_t left = settings->n_steps - mo_training_step(run->training);
  uint64_t n = run->n_rates < RATES ? run->n_rates + 1 : RATES;
  int64_t now = mo_jobs_clock_us(), oldest = now;
  double sum = 0;
  run->rates[run->n_rates % RATES].seconds = seconds;
  run->rates[run->n_rates % RATES].end_us = now;
  run->n_rates++;
  for (uint64_t i = 0; i < n; i++) {
    sum += run->rates[i].seconds;
    if (run->rates[i].end_us < oldest)
      oldest = run->rates[i].end_us;
  }
  pthread_mutex_lock(&run->jobs->trainers_mutex);
  run->trainer->live.step = mo_training_step(run->training);
  run->trainer->live.robots_per_s = sum > 0 ? (double)settings->batch * (double)n / sum : 0;
  /* With what lies between steps: validations, checkpoints. */
  run->trainer->live.seconds_left = left * (n > 1 ? (double)(now - oldest) * 1e-6 / (double)(n - 1) : seconds);
  pthread_mutex_unlock(&run->jobs->trainers_mutex);
}

static int draw(struct run *run, const struct mo_robot **robots)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  bool replays = settings->kind == MO_TRAINING_PRETRAIN && run->n_rates == 0 && mo_training_step(run->training) > 0;
  int error;
  if (replays) {
    pthread_mutex_lock(&run->jobs->trainers_mutex);
    run->trainer->live.replay_total = (uint64_t)mo_training_step(run->training) * settings->batch;
    pthread_mutex_unlock(&run->jobs->trainers_mutex);
    (void)set_phase(run, MO_TRAINING_REPLAY, "");
  }
  error = mo_training_draw(run->training, &run->trainer->interrupt, &run->trainer->replayed, robots);
  if (replays)
    (void)set_phase(run, MO_TRAINING_LEARN, "");
  if (error == MO_ERR_CORRUPT)
    return fail(run, error, "its bodies were drawn by another version of the program: they cannot be drawn again");
  if (error == MO_ERR_EXHAUSTED)
    return fail(run, error, "no new bodies are left to learn from");
  return error;
}

static int write_code(struct run *run)
{
  return mo_store_training_code(run->jobs->store, run->id, mo_training_step(run->training),
                                mo_compute_gradient_fingerprint(run->jobs->compute), &run->status.code);
}

/* Other code gives other bits: it goes on, but says so. */
static int note_code(struct run *run)
{
  int error = run->code_noted ? MO_OK : persist(run, write_code, "the lineage");
  run->code_noted = error == MO_OK;
  return error;
}

static int step(struct run *run)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  const struct mo_robot *robots = NULL;
  struct mo_training_step_row *row = &run->rows[run->n_rows];
  int64_t start_us;
  struct mo_gradient_batch batch = {.controller = mo_training_controller(run->training),
                                    .n = settings->batch,
                                    .physics = settings->physics,
                                    .adjoint_bound = settings->adjoint_bound,
                                    .urgency = run->status.job.priority,
                                    .cancel = &run->trainer->interrupt,
                                    .tag = run->id,
                                    .d_parameters = run->d_parameters,
                                    .outcomes = run->outcomes};
  int error = draw(run, &robots);
  if (error == MO_OK)
    error = note_code(run);
  if (error != MO_OK)
    return error;
  start_us = mo_jobs_clock_us();
  batch.robots = robots;
  error = mo_compute_gradient(run->gradients, &batch);
  if (error == MO_OK)
    error = mo_training_apply(run->training, run->d_parameters, run->outcomes, &batch.counts, &row->report);
  if (error != MO_OK)
    return error;
  row->seconds = (double)(mo_jobs_clock_us() - start_us) * 1e-6;
  run->n_rows++;
  note_speed(run, row->seconds);
  atomic_fetch_add(&run->jobs->training_steps, 1);
  atomic_fetch_add(&run->jobs->training_robots, settings->batch);
  atomic_fetch_add(&run->jobs->training_diverged, row->report.diverged);
  atomic_fetch_add(&run->jobs->training_zeroed, row->report.zeroed);
  atomic_fetch_add(&run->jobs->training_ns, (uint64_t)(row->seconds * 1e9));
  if (run->n_rows == ROWS_MAX || mo_jobs_clock_us() - run->rows_us >= ROWS_EVERY_US)
    error = flush(run);
  return error;
}

static int write_validation(struct run *run)
{
  return mo_store_training_progress(run->jobs->store, run->id, NULL, 0, &run->status.validation, NULL);
}

static int validate(struct run *run)
{
  uint32_t every = run->status.record.validate_every_steps, here = mo_training_step(run->training);
  int error;
  if (every == 0 || (here % every != 0 && here != run->status.record.settings.n_steps) || here <= run->validated)
    return MO_OK;
  error = flush(run);
  if (error != MO_OK)
    return error;
  (void)set_phase(run, MO_TRAINING_VALIDATE, "");
  run->status.validation.step = here;
  error = mo_held_out_score(run->jobs, &run->held_out, mo_training_controller(run->training),
                            &run->status.record.settings.physics, run->id, &run->trainer->interrupt,
                            &run->status.validation);
  if (error == MO_OK)
    error = persist(run, write_validation, "a validation");
  (void)set_phase(run, MO_TRAINING_LEARN, "");
  if (error == MO_OK) {
    run->validated = here;
    atomic_fetch_add(&run->jobs->training_validations, 1);
  }
  return error;
}

static bool checkpoint_is_due(const struct run *run)
{
  const struct mo_training_record *record = &run->status.record;
  uint32_t here = mo_training_step(run->training);
  if (here == run->checkpoint_step || here == 0)
    return false;
  return (record->checkpoint_every_steps > 0 && here % record->checkpoint_every_steps == 0) ||
         (record->checkpoint_every_s > 0 &&
          mo_jobs_clock_us() - run->checkpoint_us >= (int64_t)record->checkpoint_every_s * 1000000);
}

/* ---- the end ---- */

static int write_result(struct run *run)
{
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
  error = mo_training_export(run->training, record->has_parent ? digits : NULL, run->jobs->code_version,
                             &run->status.code, &controller);
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
  (void)set_phase(run, MO_TRAINING_LEARN, "");
  while (error == MO_OK) {
    if (is_interrupted(run))
      return MO_ERR_CANCELLED;
    error = validate(run);
    if (error != MO_OK || mo_training_step(run->training) == run->status.record.settings.n_steps)
      break;
    if (checkpoint_is_due(run))
      error = save(run);
    if (error == MO_OK)
      error = step(run);
  }
  if (error == MO_OK)
    error = save(run);
  if (error == MO_OK) {
    (void)set_phase(run, MO_TRAINING_SAVE, "");
    error = persist(run, write_result, "the trained controller");
  }
  return error;
}

/* Back to the queue, unless somebody has paused or cancelled it. */
static int write_park(struct run *run)
{
  return mo_store_training_park(run->jobs->store, run->id, MO_OK, NULL, 0, NULL);
}

/* A run that somebody has stopped: what it has learned is saved, and the job goes back to the queue if it is to go on. */
static void wind_down(struct run *run)
{
  int error = MO_OK, parked;
  run->winding_down = true;
  if (mo_trainer_wished(run->trainer) == MO_WISH_CANCEL)
    return;
  if (run->training != NULL)
    error = save(run);
  parked = persist(run, write_park, "its place in the queue");
  if (error == MO_OK || error == MO_ERR_CANCELLED)
    error = parked != MO_OK ? parked : error;
  if (error != MO_OK && error != MO_ERR_CONFLICT && mo_trainer_wished(run->trainer) == MO_WISH_STOP)
    atomic_store(&run->jobs->trainers_unsaved, true);
  if (error != MO_OK && error != MO_ERR_CONFLICT && error != MO_ERR_CANCELLED)
    warn(run, error, "what was learned since the last checkpoint could not be saved: it will be learned again");
}

static int write_failure(struct run *run)
{
  enum mo_job_state after = MO_JOB_QUEUED;
  int error = mo_store_training_park(run->jobs->store, run->id, run->status.job.error, run->text,
                                     run->jobs->config.max_attempts, &after);
  if (error == MO_OK && after == MO_JOB_FAILED) {
    atomic_fetch_add(&run->jobs->failed, 1);
    mo_jobs_closed(run->jobs, 0);
  }
  return error;
}

/* There is not even memory for a run: an attempt that is noted as soon as it can be. */
static void give_up(struct mo_trainer *trainer, int64_t id)
{
  struct mo_jobs *jobs = trainer->jobs;
  enum mo_job_state after = MO_JOB_QUEUED;
  int error;
  for (;;) {
    error =
        mo_store_training_park(jobs->store, id, MO_ERR_NO_MEMORY, "out of memory", jobs->config.max_attempts, &after);
    if ((error != MO_ERR_NO_SPACE && error != MO_ERR_BUSY && error != MO_ERR_NO_MEMORY) ||
        mo_trainer_wished(trainer) >= MO_WISH_STOP)
      break;
    mo_trainer_sleep(trainer, RETRY_SPACE_MS, MO_WISH_STOP);
  }
  if (error == MO_OK && after == MO_JOB_FAILED) {
    atomic_fetch_add(&jobs->failed, 1);
    mo_jobs_closed(jobs, 0);
  }
}

/* Returns whether the attempt failed. */
static bool settle(struct run *run, int error)
{
  switch (error) {
  case MO_OK:
    atomic_fetch_add(&run->jobs->succeeded, 1);
    mo_jobs_closed(run->jobs, 0);
    return false;
  case MO_ERR_CANCELLED: wind_down(run); return false;
  case MO_ERR_CONFLICT: return false; /* paused or cancelled while its end was written: the job has that state */
  default: break;
  }
  if (run->text[0] == '\0')
    snprintf(run->text, sizeof(run->text), "the training cannot go on: %s", mo_error_text(error));
  warn(run, error, run->text);
  run->winding_down = true;
  run->status.job.error = error;
  (void)persist(run, write_failure, "the note of an error");
  return true;
}

bool mo_training_run(struct mo_trainer *trainer, int64_t id)
{
  struct run *run = calloc(1, sizeof(*run));
  bool failed;
  int error;
  if (run == NULL) {
    give_up(trainer, id);
    return true;
  }
  run->jobs = trainer->jobs;
  run->trainer = trainer;
  run->id = id;
  error = prepare(run);
  if (error == MO_OK)
    error = learn(run);
  failed = settle(run, error);
  mo_gradient_state_free(run->gradients);
  mo_training_free(run->training);
  mo_held_out_free(&run->held_out);
  free(run->d_parameters);
  free(run->outcomes);
  free(run);
  return failed;
}
