/* trainings.c: trainings with a fake back end, whose gradients are a function of robots and weights: whatever interrupts a run, it
 * ends with the same weights. */
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/wait.h>

#include "../store/fault_vfs.h"
#include "watch.h"

#define STEPS 18
#define BATCH 8

static struct mo_training_request pretraining(const char *name)
{
  struct mo_training_request request = {.record = {.settings = mo_training_defaults(MO_TRAINING_PRETRAIN),
                                                   .validate_every_steps = 10,
                                                   .checkpoint_every_steps = 6,
                                                   .checkpoints_kept = 2}};
  request.record.settings.n_steps = STEPS;
  request.record.settings.batch = BATCH;
  request.record.settings.held_out_designs = 3;
  request.record.settings.held_out_environments = 20;
  snprintf(request.record.name, sizeof(request.record.name), "%s", name);
  return request;
}

static int64_t submit(struct service *service, const struct mo_training_request *request)
{
  int64_t id = 0;
  bool replayed = false;
  int error = mo_jobs_submit_training(service->jobs, request, &id, &replayed, &service->fixture.message);
  if (error != MO_OK)
    printf("# submission: %s\n", service->fixture.message.text);
  return error != MO_OK ? error : id;
}

/* The weights of a training that nothing disturbs, as the hash of its file. */
static bool expect(const struct mo_training_request *request, const struct mo_controller *parent,
                   const char *parent_digits, const struct mo_bits *designs, uint32_t n,
                   const struct mo_training_lineage *lineage, struct mo_sha256 *sha256)
{
  struct mo_training *training = NULL;
  struct mo_controller *controller = NULL;
  struct mo_outcome outcomes[BATCH];
  double *gradient = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error = mo_training_create(&request->record.settings, parent, designs != NULL ? designs[0].words : NULL, n,
                                 &training, NULL);
  if (error == MO_OK)
    gradient = calloc(mo_training_controller(training)->n_parameters, sizeof(*gradient));
  while (error == MO_OK && mo_training_step(training) < request->record.settings.n_steps) {
    const struct mo_robot *robots = NULL;
    struct mo_gradient_counts counts;
    error = mo_training_draw(training, NULL, NULL, &robots);
    if (error == MO_OK) {
      fake_gradient(mo_training_controller(training), robots, request->record.settings.batch, gradient, outcomes,
                    &counts);
      error = mo_training_apply(training, gradient, outcomes, &counts, NULL);
    }
  }
  if (error == MO_OK)
    error = mo_training_export(training, parent_digits, "fake gradient", lineage, &controller);
  if (error == MO_OK)
    error = mo_controller_encode(controller, &bytes, &size);
  if (error == MO_OK)
    mo_sha256_of(bytes, size, sha256);
  free(bytes);
  free(gradient);
  mo_controller_free(controller);
  mo_training_free(training);
  return error == MO_OK;
}

static const struct mo_training_lineage one_code = {1, {{0, "fake gradient"}}};

static struct mo_sha256 undisturbed(void)
{
  static struct mo_sha256 sha256;
  static bool known;
  struct mo_training_request request = pretraining("");
  if (!known)
    known = expect(&request, NULL, NULL, NULL, 0, &one_code, &sha256);
  return sha256;
}

static bool has_result(struct service *service, int64_t id, const struct mo_sha256 *expected)
{
  struct mo_training_status status;
  return mo_store_training(service->fixture.store, id, &status) == MO_OK && status.job.state == MO_JOB_SUCCEEDED &&
         status.has_result && mo_sha256_equal(&status.result_sha256, expected);
}

static bool await_step(struct service *service, int64_t id, uint32_t step)
{
  struct mo_training_live live;
  double end = now_s() + 20;
  do {
    usleep(500);
    (void)mo_jobs_training_live(service->jobs, id, &live);
  } while (live.step < step && now_s() < end);
  return live.step >= step;
}

static bool await_phase(struct service *service, int64_t id, enum mo_training_phase phase,
                        struct mo_training_live *live)
{
  double end = now_s() + 20;
  do {
    usleep(500);
    (void)mo_jobs_training_live(service->jobs, id, live);
  } while (live->phase != phase && now_s() < end);
  return live->phase == phase;
}

static char warned[256];
static pthread_mutex_t warned_mutex = PTHREAD_MUTEX_INITIALIZER;
static int warnings;

static void hear(void *context, int64_t job, int error, const char *text)
{
  (void)context;
  (void)job;
  (void)error;
  pthread_mutex_lock(&warned_mutex);
  snprintf(warned, sizeof(warned), "%s", text);
  warnings++;
  pthread_mutex_unlock(&warned_mutex);
}

static int start(struct service *service, uint32_t side_by_side)
{
  int error = service_start(service);
  if (error != MO_OK)
    return error;
  service_close(service);
  pthread_mutex_lock(&warned_mutex);
  warnings = 0;
  pthread_mutex_unlock(&warned_mutex);
  service->config.max_active_trainings = side_by_side;
  service->config.warn = hear;
  return service_open(service);
}

/* ---- cases ---- */

static void learns(void)
{
  struct service service;
  struct mo_training_request request = pretraining("walker");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_status status;
  struct mo_training_step_row rows[STEPS + 1];
  struct mo_training_validation_row validations[10];
  struct mo_training_checkpoint_row checkpoints[10];
  struct mo_controller_record record;
  struct mo_event events[60];
  struct mo_jobs_stats stats;
  struct mo_training_live live;
  struct mo_held_out held_out;
  struct mo_job job;
  char *metadata = NULL;
  int progress = 0;
  int64_t id, n;
  double seconds = -now_s();
  REQUIRE(start(&service, 1) == MO_OK);
  id = submit(&service, &request);
  REQUIRE(id > 0 && mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  seconds += now_s();
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.steps_done, STEPS);
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(mo_store_controller(service.fixture.store, "walker", &record), MO_OK);
  CHECK(mo_sha256_equal(&record.sha256, &expected));
  CHECK_INT(mo_store_controller_metadata(service.fixture.store, &expected, &metadata), MO_OK);
  CHECK(metadata != NULL && strstr(metadata, "\"morphod.version\":\"fake gradient\"") != NULL &&
        strstr(metadata, "\"morphod.parent\":\"random\"") != NULL);
  free(metadata);
  /* The curve has every step, the validations those that were asked for, with the first and the last. */
  CHECK_INT(mo_store_training_steps(service.fixture.store, id, 0, 1, rows, STEPS + 1), STEPS);
  CHECK(rows[0].report.step == 1 && rows[STEPS - 1].report.step == STEPS && rows[0].report.rate > 0 &&
        rows[0].report.mean_loss > 0 && rows[0].report.clipped_share > 0);
  n = mo_store_training_validations(service.fixture.store, id, -1, validations, 10);
  CHECK_INT(n, 3);
  CHECK(validations[0].step == 0 && validations[1].step == 10 && validations[2].step == STEPS);
  for (int64_t i = 0; i < n; i++)
    CHECK(validations[i].rollouts == 60 && validations[i].mean_score > 0 && validations[i].mean_score < 1);
  CHECK_INT(mo_store_training_checkpoints(service.fixture.store, id, checkpoints, 10), 2);
  CHECK(checkpoints[0].step == STEPS && checkpoints[1].step == 12);
  n = mo_store_events(service.fixture.store, 0, id, events, 60, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    progress += strcmp(events[i].type, "training.progress") == 0;
  CHECK(progress >= 5 && progress <= 6 + seconds); /* before each checkpoint and validation, and one per second */
  CHECK_TEXT(events[0].type, "job.created");
  CHECK_TEXT(events[1].type, "job.started");
  CHECK_TEXT(events[n - 1].type, "job.finished");
  stats = settled(&service);
  CHECK_INT(stats.training_steps, STEPS);
  CHECK_INT(stats.training_robots, STEPS * BATCH);
  CHECK_INT(stats.training_checkpoints, 3);
  CHECK_INT(stats.training_validations, 3);
  CHECK_INT(stats.jobs_succeeded, 1);
  CHECK_INT(stats.open_jobs, 0);
  CHECK(await_phase(&service, id, MO_TRAINING_IDLE, &live)); /* its thread follows in a moment */
  /* What it was validated on. */
  CHECK_INT(mo_jobs_training_held_out(service.jobs, id, &held_out), MO_OK);
  CHECK(held_out.n_designs == 3 && held_out.n_environments == 20);
  mo_held_out_free(&held_out);
  CHECK_INT(mo_store_training(service.fixture.store, id, &status), MO_OK);
  CHECK_INT(status.step, STEPS);
  CHECK_INT(warnings, 0);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  service_end(&service);
}

__attribute__((unused)) static void validates_as_an_evaluation_does(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_training_validation_row row;
  struct mo_training_status status;
  struct mo_controller *controller = NULL;
  struct mo_held_out held_out;
  uint8_t *bytes = NULL;
  size_t size = 0;
  double scores[3], mean = 0, deviation = 0;
  uint32_t kept = 0, diverged = 0;
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  id = submit(&service, &request);
  REQUIRE(id > 0 && mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK && status.has_result);
  row = status.validation;
  REQUIRE(mo_store_controller_bytes(service.fixture.store, &status.result_sha256, &bytes, &size) == MO_OK);
  REQUIRE(mo_controller_decode(bytes, size, &controller, NULL) == MO_OK);
  REQUIRE(mo_jobs_training_held_out(service.jobs, id, &held_out) == MO_OK);
  for (uint32_t d = 0; d < 3; d++) {
    uint32_t before = diverged;
    double sum = 0;
    for (uint32_t k = 0; k < 20; k++) {
      struct mo_outcome outcome = fake_outcome(held_out.genotypes[d].words, controller, &held_out.environments[k],
                                               &request.record.settings.physics, MO_FLOAT32);
      diverged += outcome.diverged_step != 0;
      sum += outcome.loss;
    }
    if (diverged == before)
      scores[kept++] = sum / 20;
  }
  for (uint32_t d = 0; d < kept; d++)
    mean += scores[d] / kept;
  for (uint32_t d = 0; d < kept; d++)
    deviation += (scores[d] - mean) * (scores[d] - mean);
  CHECK_INT(row.step, STEPS);
  CHECK_INT(row.rollouts, 60);
  CHECK_INT(row.diverged, diverged);
  if (kept > 0)
    CHECK_NEAR(row.mean_score, mean, 1e-12);
  else
    CHECK(isnan(row.mean_score));
  if (kept > 1)
    CHECK_NEAR(row.standard_error, sqrt(deviation / (kept - 1) / kept), 1e-9);
  free(bytes);
  mo_controller_free(controller);
  mo_held_out_free(&held_out);
  service_end(&service);
}

static void pauses_and_resumes(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_status status;
  struct mo_training_live live;
  struct mo_job job;
  double begin;
  int64_t id;
  request.record.checkpoint_every_steps = 0; /* only the pauses save */
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  for (uint32_t step = 3; step <= 12; step += 3) {
    REQUIRE(await_step(&service, id, step));
    begin = now_s();
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    CHECK(await_phase(&service, id, MO_TRAINING_IDLE, &live));
    CHECK(now_s() - begin < 5);
    REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK);
    CHECK_INT(status.job.state, MO_JOB_PAUSED);
    CHECK(status.checkpoint_step >= step && status.checkpoint_step == status.step);
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    usleep(30000);
    CHECK_INT(state_of(&service, id), MO_JOB_PAUSED);
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  }
  /* Paused and resumed at once: it goes on. */
  for (int i = 0; i < 5; i++) {
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    usleep(5000 * i);
  }
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_ERR_CONFLICT);
  service_end(&service);
}

static void stops_and_goes_on(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_status status;
  struct mo_job job;
  double begin;
  int64_t id;
  request.record.checkpoint_every_steps = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  for (uint32_t step = 4; step <= 12; step += 4) {
    REQUIRE(await_step(&service, id, step));
    begin = now_s();
    CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
    CHECK(now_s() - begin < 3);
    REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK);
    CHECK_INT(status.job.state, MO_JOB_QUEUED);
    CHECK(status.checkpoint_step >= step && status.checkpoint_step == status.step);
    service_close(&service);
    REQUIRE(service_open(&service) == MO_OK);
  }
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(warnings, 0);
  service_end(&service);
}

/* Stopped under one code and continued under another, at whatever step: it goes on, and the lineage tells every change. */
static void tells_of_other_code(void)
{
  static const char *const codes[] = {"fake gradient", "fake gradient-2", "fake gradient"};
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_training_lineage lineage = {0};
  struct mo_training_status status;
  struct mo_sha256 expected;
  struct mo_event events[60];
  struct mo_job job;
  int64_t id, n;
  int changes = 0;
  request.record.checkpoint_every_steps = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  for (uint32_t round = 0; round < 3; round++) {
    REQUIRE(await_step(&service, id, 4 * (round + 1)));
    CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
    REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK);
    CHECK_INT(status.code.n, round + 1);
    CHECK_TEXT(status.code.codes[status.code.n - 1].fingerprint, codes[round]);
    lineage = status.code;
    service_close(&service);
    atomic_store(&fake_plan.gradient_fingerprint, codes[round < 2 ? round + 1 : 2]);
    REQUIRE(service_open(&service) == MO_OK);
    if (round < 2) {
      REQUIRE(await_step(&service, id, status.checkpoint_step + 1));
      REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK);
      CHECK_INT(status.code.codes[status.code.n - 1].from_step, status.checkpoint_step);
    }
  }
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  REQUIRE(expect(&request, NULL, NULL, NULL, 0, &lineage, &expected));
  CHECK(has_result(&service, id, &expected));
  n = mo_store_events(service.fixture.store, 0, id, events, 60, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    changes += strcmp(events[i].type, "training.code_changed") == 0;
  CHECK_INT(changes, 2);
  service_end(&service);
}

static void cancels(void)
{
  struct service service;
  struct mo_training_request request = pretraining("never");
  struct mo_controller_record record;
  struct mo_training_live live;
  struct mo_jobs_stats stats;
  double begin;
  int64_t id, waiting;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 10000000;
  id = submit(&service, &request);
  waiting = submit(&service, &request);
  REQUIRE(await_state(&service, id, MO_JOB_RUNNING, 10));
  REQUIRE(await_phase(&service, id, MO_TRAINING_LEARN, &live));
  CHECK_INT(mo_jobs_cancel(service.jobs, waiting), MO_OK); /* before it starts */
  begin = now_s();
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK); /* inside a gradient */
  CHECK(await_phase(&service, id, MO_TRAINING_IDLE, &live));
  CHECK(now_s() - begin < 3);
  CHECK_INT(state_of(&service, id), MO_JOB_CANCELLED);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_controller(service.fixture.store, "never", &record), MO_ERR_NOT_FOUND);
  stats = settled(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.jobs_cancelled, 2);
  service_end(&service);
}

__attribute__((unused)) static void tries_three_times(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_fails = 1;
  fake_plan.gradient_status = MO_ERR_NO_MEMORY;
  id = submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0); /* one, forgiven by the checkpoint that came after it */
  CHECK_INT(job.error, MO_OK);
  CHECK(has_result(&service, id, &expected));
  fake_plan.gradient_fails = 1000;
  id = submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.attempts, 3);
  CHECK_INT(job.error, MO_ERR_NO_MEMORY);
  CHECK(strstr(job.error_text, "out of memory") != NULL);
  CHECK_INT(warnings, 4);
  CHECK_INT(settled(&service).jobs_failed, 1);
  service_end(&service);
}

static int damage(struct service *service, int64_t id, uint32_t step)
{
  char path[512];
  int fd, error = -1;
  snprintf(path, sizeof(path), "%s/trainings/%lld/%u.checkpoint", service->fixture.path, (long long)id, step);
  fd = open(path, O_WRONLY);
  if (fd >= 0) {
    error = pwrite(fd, "damage", 6, 5000) == 6 ? 0 : -1;
    close(fd);
  }
  return error;
}

__attribute__((unused)) static void passes_over_damaged_checkpoints(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_checkpoint_row rows[5];
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  /* The newest, then all of them. */
  for (int round = 1; round <= 2; round++) {
    REQUIRE(await_step(&service, id, 12));
    CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
    REQUIRE(mo_store_training_checkpoints(service.fixture.store, id, rows, 5) == 2);
    service_close(&service);
    for (int i = 0; i < round; i++)
      REQUIRE(damage(&service, id, rows[i].step) == 0);
    warnings = 0;
    REQUIRE(service_open(&service) == MO_OK);
    REQUIRE(await_step(&service, id, 2));
    pthread_mutex_lock(&warned_mutex);
    CHECK_INT(warnings, round);
    CHECK(strstr(warned, round == 1 ? "the one before it is taken" : "begins anew") != NULL);
    pthread_mutex_unlock(&warned_mutex);
  }
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

/* No file may grow beyond so many bytes: the database can, checkpoints cannot. */
static void limit_files(rlim_t bytes)
{
  struct rlimit limit;
  signal(SIGXFSZ, SIG_IGN);
  getrlimit(RLIMIT_FSIZE, &limit);
  limit.rlim_cur = bytes;
  setrlimit(RLIMIT_FSIZE, &limit);
}

static void waits_for_room(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_live live;
  struct mo_jobs_stats stats;
  struct mo_job job;
  double begin;
  int64_t id, waiting[MO_WAITING_MAX] = {0};
  REQUIRE(start(&service, 1) == MO_OK);
  CHECK_INT(mo_jobs_waiting(service.jobs, waiting), 0);
  limit_files(8 << 20);
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_TRAINING_WAIT, &live));
  CHECK(strstr(live.reason, "no space") != NULL && strstr(live.reason, "checkpoint of step 6") != NULL &&
        strstr(live.reason, "by itself") != NULL);
  CHECK_INT(live.step, 6);
  CHECK_INT(mo_jobs_waiting(service.jobs, waiting), 1);
  CHECK_INT(waiting[0], id);
  usleep(1200000);
  CHECK_INT(mo_jobs_training_live(service.jobs, id, &live), MO_OK);
  CHECK_INT(live.phase, MO_TRAINING_WAIT);
  CHECK_INT(warnings, 1);
  /* Somebody pauses it: it has nowhere to save to, and waits on; resumed, it goes on when there is room. */
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  limit_files(RLIM_INFINITY);
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  /* Cancelled while it waits. */
  limit_files(8 << 20);
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_TRAINING_WAIT, &live));
  begin = now_s();
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  CHECK(await_phase(&service, id, MO_TRAINING_IDLE, &live));
  CHECK(now_s() - begin < 1);
  /* Stopped while it waits: at once, without its last steps, which come again. */
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_TRAINING_WAIT, &live));
  begin = now_s();
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_ERR_BUSY);
  CHECK(now_s() - begin < 2);
  mo_jobs_get_stats(service.jobs, &stats);
  CHECK_INT(stats.active_trainings, 0);
  service_close(&service);
  limit_files(RLIM_INFINITY);
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

__attribute__((unused)) static void waits_for_the_database(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_live live;
  struct mo_job job;
  int64_t id;
  REQUIRE(fault_vfs_register() == SQLITE_OK);
  memset(&fault_plan, 0, sizeof(fault_plan));
  REQUIRE(start(&service, 1) == MO_OK);
  service_close(&service);
  service.vfs = "faults";
  REQUIRE(service_open(&service) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  REQUIRE(await_step(&service, id, 2));
  for (int i = 0; i < 2; i++) {
    fault_plan.writes_left = 0;
    fault_plan.write_error = i == 0 ? SQLITE_FULL : SQLITE_BUSY;
    REQUIRE(await_phase(&service, id, MO_TRAINING_WAIT, &live));
    CHECK(strstr(live.reason, i == 0 ? "no space" : "locked") != NULL);
    fault_plan.write_error = 0;
    REQUIRE(await_phase(&service, id, MO_TRAINING_LEARN, &live));
  }
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

/* No memory, not even for the note that there was none: it is written when there is. */
__attribute__((unused)) static void notes_a_failure_when_it_can(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_live live;
  struct mo_job job;
  int64_t id;
  request.record.validate_every_steps = 0;
  REQUIRE(fault_vfs_register() == SQLITE_OK);
  memset(&fault_plan, 0, sizeof(fault_plan));
  REQUIRE(start(&service, 1) == MO_OK);
  service_close(&service);
  service.vfs = "faults";
  REQUIRE(service_open(&service) == MO_OK);
  fake_plan.gradient_delay_us = 300000;
  fake_plan.gradient_fails = 1;
  fake_plan.gradient_status = MO_ERR_NO_MEMORY;
  id = submit(&service, &request);
  REQUIRE(await_state(&service, id, MO_JOB_RUNNING, 10));
  fault_plan.writes_left = 0;
  fault_plan.write_error = SQLITE_NOMEM;
  CHECK(await_phase(&service, id, MO_TRAINING_WAIT, &live));
  CHECK(strstr(live.reason, "no memory") != NULL);
  CHECK_INT(state_of(&service, id), MO_JOB_RUNNING);
  fake_plan.gradient_delay_us = 0;
  fault_plan.write_error = 0;
  REQUIRE(mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0); /* one, forgiven by the checkpoint that came after it */
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

static void takes_turns(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_job job;
  int64_t ids[4], tags[4 * STEPS + 1], last = 0;
  size_t n;
  int changes = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  request.record.validate_every_steps = request.record.checkpoint_every_steps = 0;
  for (int i = 0; i < 4; i++)
    ids[i] = submit(&service, &request);
  for (int i = 0; i < 4; i++)
    REQUIRE(mo_jobs_wait(service.jobs, ids[i], 30000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  n = fake_history(tags, 4 * STEPS + 1);
  CHECK_INT(n, 4 * STEPS);
  for (size_t i = 0; i < n; i++) {
    CHECK(tags[i] >= last);
    last = tags[i];
  }
  service_close(&service);
  /* Two at a time. */
  service.config.max_active_trainings = 2;
  REQUIRE(service_open(&service) == MO_OK);
  fake_forget();
  fake_plan.gradient_delay_us = 5000;
  for (int i = 0; i < 3; i++)
    ids[i] = submit(&service, &request);
  for (int i = 0; i < 3; i++)
    REQUIRE(mo_jobs_wait(service.jobs, ids[i], 30000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  n = fake_history(tags, 3 * STEPS);
  for (size_t i = 1; i < n; i++) {
    changes += tags[i] != tags[i - 1];
    CHECK(i >= STEPS || tags[i] != ids[2]); /* the third waits for a place */
  }
  CHECK(changes > STEPS / 2);
  service_end(&service);
}

__attribute__((unused)) static void tunes_a_population(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes, *best = NULL;
  struct mo_evaluation_request evaluation;
  struct mo_training_request request = pretraining("tuned");
  struct mo_training_status status;
  struct mo_controller_record record;
  struct mo_held_out held_out;
  struct mo_sha256 expected;
  char digits[MO_SHA256_DIGITS + 1];
  struct mo_job job;
  int64_t scored, id;
  uint32_t n = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  REQUIRE(fixture_bodies(31, 30, &forms, &genotypes) == MO_OK);
  evaluation = service_request(genotypes, 30);
  scored = service_submit(&service, &evaluation);
  REQUIRE(mo_jobs_wait(service.jobs, scored, 30000, &job) == MO_OK);
  request.record.settings.kind = MO_TRAINING_FINETUNE;
  request.population = scored;
  request.population_best = 5;
  id = submit(&service, &request);
  REQUIRE(id > 0 && mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  REQUIRE(mo_store_population(service.fixture.store, scored, 5, &best, &n) == MO_OK && n == 5);
  REQUIRE(mo_store_controller(service.fixture.store, "default", &record) == MO_OK);
  mo_sha256_to_hex(&record.sha256, digits);
  REQUIRE(expect(&request, default_weights(), digits, best, n, &one_code, &expected));
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(mo_store_training(service.fixture.store, id, &status), MO_OK);
  CHECK(status.record.population == scored && status.record.n_designs == 5 && status.record.has_parent);
  CHECK_TEXT(status.record.parent_name, "default");
  CHECK_INT(mo_jobs_training_held_out(service.jobs, id, &held_out), MO_OK);
  CHECK(held_out.n_designs == 3 && memcmp(held_out.genotypes, best, 3 * sizeof(*best)) == 0);
  mo_held_out_free(&held_out);
  /* From the result, on designs that are listed. */
  request.population = 0;
  request.parent = "tuned";
  request.genotypes = genotypes;
  request.record.n_designs = 7;
  snprintf(request.record.name, sizeof(request.record.name), "again");
  id = submit(&service, &request);
  REQUIRE(id > 0 && mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK(mo_sha256_equal(&job.controller_sha256, &expected));
  free(best);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static int crash_fd;

static void on_fault(int number)
{
  mo_jobs_crash_note(crash_fd, number);
  _exit(99);
}

/* A process that dies on the training's own thread, again and again: the training is blamed, and parked. */
__attribute__((unused)) static void blames_crashes_on_the_training(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_job job = {.id = 0};
  char marker[512];
  int64_t id;
  int status;
  REQUIRE(start(&service, 1) == MO_OK);
  snprintf(marker, sizeof(marker), "%s/crash", service.fixture.path);
  service.config.crash_marker = marker;
  fake_plan.gradient_delay_us = 60000000;
  id = submit(&service, &request);
  for (int round = 1; round <= 3; round++) {
    pid_t child;
    service_close(&service);
    child = fork();
    REQUIRE(child >= 0);
    if (child == 0) {
      crash_fd = open(marker, O_WRONLY | O_CREAT | O_APPEND, 0600);
      signal(SIGSEGV, on_fault);
      fake_plan.gradient_delay_us = 0;
      fake_plan.gradient_crash = true;
      if (service_open(&service) == MO_OK)
        sleep(20);
      _exit(0);
    }
    REQUIRE(waitpid(child, &status, 0) == child);
    CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 99);
    REQUIRE(service_open(&service) == MO_OK);
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.attempts, round);
  }
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK(strstr(job.error_text, "signal 11") != NULL);
  service_end(&service);
}

__attribute__((unused)) static void refuses(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes, apart = {{0x8001}};
  struct mo_training_request request = pretraining(""), bad;
  struct mo_message *message = &service.fixture.message;
  int64_t id = 0, again = 0;
  bool replayed = false;
  REQUIRE(start(&service, 1) == MO_OK);
  service_close(&service);
  service.config.max_open_jobs = 1;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(9, 4, &forms, &genotypes) == MO_OK);
  fake_plan.gradient_delay_us = 1000000;
  request.idempotency_key = "k";
  CHECK_INT(mo_jobs_submit_training(service.jobs, &request, &id, &replayed, message), MO_OK);
  CHECK_INT(mo_jobs_submit_training(service.jobs, &request, &again, &replayed, message), MO_OK);
  CHECK(replayed && again == id);
  mo_sha256_of("x", 1, &request.body_sha256);
  CHECK_INT(mo_jobs_submit_training(service.jobs, &request, &again, &replayed, message), MO_ERR_CONFLICT);
  bad = pretraining("");
  CHECK_INT(mo_jobs_submit_training(service.jobs, &bad, &again, &replayed, message), MO_ERR_BUSY);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  bad.record.settings.batch = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_RANGE);
  bad = pretraining("");
  bad.record.settings.n_steps = 1000000000;
  CHECK_INT(submit(&service, &bad), MO_ERR_RANGE);
  bad = pretraining("");
  bad.record.settings.schedule.peak = -1;
  CHECK(submit(&service, &bad) < 0);
  bad = pretraining("No Name");
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  bad = pretraining("");
  bad.record.checkpoints_kept = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_RANGE);
  bad = pretraining("");
  bad.record.settings.held_out_designs = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  bad = pretraining("");
  bad.parent = "nobody";
  CHECK_INT(submit(&service, &bad), MO_ERR_NOT_FOUND);
  CHECK(strstr(message->text, "controller \"nobody\"") != NULL);
  bad = pretraining("");
  bad.genotypes = genotypes;
  bad.record.n_designs = 2;
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  bad.record.settings.kind = MO_TRAINING_FINETUNE;
  bad.population = 77;
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  bad.record.n_designs = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_NOT_FOUND);
  CHECK(strstr(message->text, "population 77") != NULL);
  bad.population = id; /* a training */
  CHECK_INT(submit(&service, &bad), MO_ERR_NOT_FOUND);
  bad.population = 0;
  CHECK_INT(submit(&service, &bad), MO_ERR_RANGE);
  bad.genotypes = &apart;
  bad.record.n_designs = 1;
  CHECK_INT(submit(&service, &bad), MO_ERR_INVALID);
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
  bad = pretraining("");
  CHECK_INT(submit(&service, &bad), MO_ERR_CANCELLED);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static const struct check_case cases[] = {
    {"learns", learns},
    {"pauses and resumes", pauses_and_resumes},
    {"stops and goes on", stops_and_goes_on},
    {"tells of other code", tells_of_other_code},
    {"cancels", cancels},
    {"waits for room", waits_for_room},
    {"takes turns", takes_turns},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"validates as an evaluation does", validates_as_an_evaluation_does},
    {"tries three times", tries_three_times},
    {"passes over damaged checkpoints", passes_over_damaged_checkpoints},
    {"waits for the database", waits_for_the_database},
    {"notes a failure when it can", notes_a_failure_when_it_can},
    {"tunes a population", tunes_a_population},
    {"blames crashes on the training", blames_crashes_on_the_training},
    {"refuses", refuses},
#endif
};
CHECK_MAIN(cases)
