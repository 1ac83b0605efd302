/* training.c: the kind "training": runs one training run to its end or until a request.
 *
 * A step draws robots, waits for their gradient and applies it. Rows of steps are written about
 * once a second and before every checkpoint. A checkpoint is written when it is due, at a pause, at
 * a stop, and at the end, before the controller; on devices, it is written during the next
 * gradient. A crash loses the time since the last checkpoint: the steps after it are repeated with
 * the same results. Training each design separately is a sequence of such runs, one per design. */
#include "base/clock.h"
#include "base/thread.h"
#include "jobs/training_run.h"

#define ROWS_EVERY_US INT64_C(1000000)
/* If this many of the first steps fail, the later ones will fail as well. */
#define STEPS_WITHOUT_GRADIENT_MAX 10

/* ---- steps ---- */

static void note_speed(struct mo_training_run *run, double seconds)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  const uint32_t position = mo_training_run_before(run) + mo_training_run_step(run);
  const uint32_t left = run->status.job.steps_total - position;
  uint64_t n = run->n_rates < MO_TRAINING_RATES ? run->n_rates + 1 : MO_TRAINING_RATES;
  int64_t now = mo_clock_us();
  double sum = 0;
  run->rates[run->n_rates % MO_TRAINING_RATES].seconds = seconds;
  run->rates[run->n_rates % MO_TRAINING_RATES].end_us = now;
  run->n_rates++;
  for (uint64_t i = 0; i < n; i++)
    sum += run->rates[i].seconds;
  const int64_t oldest =
      run->rates[n < MO_TRAINING_RATES ? 0 : run->n_rates % MO_TRAINING_RATES].end_us;
  MO_GUARD(&run->runner->runners->mutex);
  run->runner->live.position = position;
  run->runner->live.rate = sum > 0 ? (double)settings->batch * (double)n / sum : 0;
  /* Includes the time between steps: validations, checkpoints. */
  run->runner->live.seconds_left =
      left * (n > 1 ? (double)(now - oldest) * 1e-6 / (double)(n - 1) : seconds);
}

static int draw(struct mo_training_run *run, const struct mo_robot **robots)
{
  const struct mo_training_settings *settings = &run->status.record.settings;
  bool replays =
      settings->kind == MO_TRAINING_PRETRAIN && run->n_rates == 0 && mo_training_run_step(run) > 0;
  if (replays) {
    pthread_mutex_lock(&run->runner->runners->mutex);
    run->runner->live.total = (uint64_t)mo_training_run_step(run) * settings->batch;
    pthread_mutex_unlock(&run->runner->runners->mutex);
    (void)mo_training_run_enter(run, MO_PHASE_REPLAY);
  }
  int error = mo_training_draw(run->learner.training, &run->runner->interrupt,
                               &run->runner->replayed, robots);
  if (replays)
    (void)mo_training_run_enter(run, MO_PHASE_LEARN);
  if (error == MO_ERR_CORRUPT)
    return mo_runner_fail(
        run->runner, error,
        "its bodies were drawn by another version of the program and cannot be redrawn");
  if (error == MO_ERR_EXHAUSTED)
    return mo_runner_fail(run->runner, error, "no new bodies are left to learn from");
  return error;
}

/* Returns which code computed the gradient. */
static const char *code_of(const struct mo_training_run *run)
{
  const struct mo_compute *compute = run->jobs->compute;
  return run->learner.batch.computed_on == MO_ON_DEVICE
             ? mo_compute_device_gradient_fingerprint(compute)
             : mo_compute_gradient_fingerprint(compute);
}

static int write_code(void *context)
{
  struct mo_training_run *run = context;
  return mo_store_training_code(run->jobs->store, run->id,
                                mo_training_run_before(run) + mo_training_run_step(run),
                                code_of(run), &run->status.code);
}

/* Records in the lineage which code computed the gradient, before the step is applied, because
 * other code produces other bits. This includes workers that compute bodies that a device does not
 * support. */
static int note_code(struct mo_training_run *run)
{
  if (run->status.record.each)
    mo_each_note_code(run, code_of(run));
  if (run->code_noted && run->noted == run->learner.batch.computed_on)
    return MO_OK;
  int error = mo_runner_persist(run->runner, write_code, run, "the lineage");
  run->code_noted = error == MO_OK;
  run->noted = run->learner.batch.computed_on;
  return error;
}

static bool checkpoint_is_due(const struct mo_training_run *run)
{
  const struct mo_training_record *record = &run->status.record;
  const uint32_t here = mo_training_run_step(run);
  if (here == run->checkpoint_step || here == 0)
    return false;
  return (record->checkpoint_every_steps > 0 && here % record->checkpoint_every_steps == 0) ||
         mo_checkpoint_is_due(&run->status.job, run->checkpoint_us, record->checkpoint_every_s);
}

/* Writes the data of the steps applied so far, if it is due. */
static int write_what_is_due(void *context)
{
  struct mo_training_run *run = context;
  if (checkpoint_is_due(run))
    return mo_training_run_save(run);
  if (run->n_rows == MO_TRAINING_ROWS || mo_clock_us() - run->rows_us >= ROWS_EVERY_US)
    return mo_training_run_flush(run);
  return MO_OK;
}

static int step(struct mo_training_run *run)
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
  row->report.step += mo_training_run_before(run);
  run->n_rows++;
  note_speed(run, row->seconds);
  atomic_fetch_add(&run->jobs->training_steps, 1);
  atomic_fetch_add(&run->jobs->training_robots, settings->batch);
  atomic_fetch_add(&run->jobs->training_diverged, row->report.diverged);
  atomic_fetch_add(&run->jobs->training_zeroed, row->report.zeroed);
  atomic_fetch_add(&run->jobs->training_ns, (uint64_t)(row->seconds * 1e9));
  return MO_OK;
}

/* Ends a training run if no step has changed the controller. */
static int check_learned(struct mo_training_run *run)
{
  const struct mo_training *training = run->learner.training;
  const uint32_t here = mo_training_run_step(run), n_steps = run->status.record.settings.n_steps;
  char steps[32] = "step", text[256];
  if (here == 0 || mo_training_skipped(training) < here ||
      (here < STEPS_WITHOUT_GRADIENT_MAX && here < n_steps))
    return MO_OK;
  const int error = mo_training_run_flush(run);
  if (error != MO_OK)
    return error;
  if (here > 1)
    snprintf(steps, sizeof(steps), "%u steps", (unsigned)here);
  snprintf(text, sizeof(text),
           "in the first %s, every robot diverged or had no finite gradient, so nothing was "
           "learned; choose a smaller dt_s or stiffness_n_per_m",
           steps);
  return mo_runner_give_up(run->runner, MO_ERR_RANGE, text);
}

static int write_validation(void *context)
{
  struct mo_training_run *run = context;
  return mo_store_training_progress(run->jobs->store, run->id, NULL, 0, &run->status.validation,
                                    NULL);
}

static int validate(struct mo_training_run *run)
{
  uint32_t every = run->status.record.validate_every_steps, here = mo_training_run_step(run);
  if (every == 0 || (here % every != 0 && here != run->status.record.settings.n_steps) ||
      here <= run->validated)
    return MO_OK;
  int error = mo_training_run_flush(run);
  if (error != MO_OK)
    return error;
  (void)mo_training_run_enter(run, MO_PHASE_VALIDATE);
  run->status.validation.step = here;
  error =
      mo_held_out_score(run->runner, &run->held_out, mo_training_controller(run->learner.training),
                        &run->status, &run->status.validation);
  if (error == MO_OK)
    error = mo_runner_persist(run->runner, write_validation, run, "a validation");
  (void)mo_training_run_enter(run, MO_PHASE_LEARN);
  if (error == MO_OK) {
    run->validated = here;
    atomic_fetch_add(&run->jobs->training_validations, 1);
  }
  return error;
}

/* ---- the end ---- */

static int write_result(void *context)
{
  struct mo_training_run *run = context;
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

static int prepare(struct mo_training_run *run)
{
  int error = mo_store_training(run->jobs->store, run->id, &run->status);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  run->validated = run->status.has_validation ? (int64_t)run->status.validation.step : -1;
  error = mo_back_end_check(run->jobs, run->status.job.back_end);
  if (error != MO_OK)
    return error;
  run->checkpoint_us = mo_clock_us();
  if (run->status.record.each)
    return mo_each_prepare(run);
  error = mo_training_run_begin(run);
  if (error != MO_OK)
    return error;
  error = mo_learner_prepare(&run->learner, run->runner, &run->status.job, write_what_is_due, run);
  if (error == MO_OK && run->status.record.validate_every_steps > 0)
    error = mo_held_out_load(run->jobs->store, &run->status, &run->held_out);
  return error;
}

static int learn(struct mo_training_run *run)
{
  int error = MO_OK;
  (void)mo_training_run_enter(run, MO_PHASE_LEARN);
  while (error == MO_OK) {
    if (mo_runner_is_interrupted(run->runner))
      return MO_ERR_CANCELLED;
    error = check_learned(run);
    if (error == MO_OK)
      error = validate(run);
    if (error != MO_OK || mo_training_run_step(run) == run->status.record.settings.n_steps)
      break;
    error = step(run);
  }
  if (error == MO_OK)
    error = mo_training_run_save(run);
  if (error == MO_OK) {
    (void)mo_training_run_enter(run, MO_PHASE_SAVE);
    error = mo_runner_persist(run->runner, write_result, run, "the trained controller");
  }
  return error;
}

/* Trains the controller of the current design. */
static int learn_one(struct mo_training_run *run)
{
  int error = mo_each_begin(run);
  if (error == MO_OK)
    error =
        mo_learner_prepare(&run->learner, run->runner, &run->status.job, write_what_is_due, run);
  (void)mo_training_run_enter(run, MO_PHASE_LEARN);
  while (error == MO_OK && mo_training_run_step(run) < run->status.record.settings.n_steps)
    error = mo_runner_is_interrupted(run->runner) ? MO_ERR_CANCELLED : step(run);
  if (error == MO_OK)
    error = mo_training_run_flush(run);
  return error == MO_OK ? mo_each_end(run) : error;
}

static int write_end(void *context)
{
  struct mo_training_run *run = context;
  return mo_store_training_finish(run->jobs->store, run->id, NULL, NULL, 0, NULL);
}

static int learn_each(struct mo_training_run *run)
{
  int error = MO_OK;
  while (error == MO_OK && run->body.position < run->status.record.n_designs)
    error = learn_one(run);
  return error == MO_OK ? mo_runner_persist(run->runner, write_end, run, "the end of the run")
                        : error;
}

/* Saves the results of a stopped run. */
static int save_rest(void *context)
{
  struct mo_training_run *run = context;
  return run->learner.training != NULL ? mo_training_run_save(run) : MO_OK;
}

static void clean_up(void *context)
{
  struct mo_training_run *run = context;
  mo_learner_free(&run->learner);
  mo_held_out_free(&run->held_out);
  mo_controller_free(run->parent);
}

static int run_training(struct mo_runner *runner, void *context)
{
  struct mo_training_run *run = context;
  run->runner = runner;
  run->jobs = runner->jobs;
  run->id = runner->id;
  const int error = prepare(run);
  if (error != MO_OK)
    return error;
  return run->status.record.each ? learn_each(run) : learn(run);
}

/* ---- the kind ---- */

static int need(struct mo_jobs *jobs, int64_t id, struct mo_need *need)
{
  struct mo_training_status status;
  const int error = mo_store_training(jobs->store, id, &status);
  if (error == MO_OK)
    *need = mo_training_need(jobs, &status.record, status.job.back_end);
  return error;
}

const struct mo_kind mo_training_kind = {.kind = MO_JOB_TRAINING,
                                         .need = need,
                                         .first = MO_PHASE_LEARN,
                                         .run_bytes = sizeof(struct mo_training_run),
                                         .run = run_training,
                                         .save = save_rest,
                                         .clean_up = clean_up};
