/* stops.c: whatever people or ends of the process do to a training or campaign, it ends as it would
 * have without them. */
#include <fcntl.h>
#include <signal.h>
#include <sys/wait.h>

#include "fakes.h"

/* Slow enough to be met in every phase. */
static void slow_down(int mode)
{
  fake_plan.delay_us = mode == TRAINING ? 0 : 2500;
  fake_plan.gradient_delay_us = mode == TRAINING ? 20000 : 5000;
}

/* A pause and a stop save all that is computed. */
static void check_counts(int mode, const struct fake_count *count)
{
  struct mo_campaign_request request;
  struct origin origin;
  uint64_t rollouts = 0, robots = 0;
  if (mode == TRAINING) {
    CHECK_INT(atomic_load(&count->robots), STEPS * BATCH);
    return;
  }
  request = campaign((enum mo_campaign_mode)mode);
  origin = origin_of(&request);
  needs(&origin, &rollouts, &robots);
  CHECK_INT(atomic_load(&count->rollouts), rollouts);
  CHECK_INT(atomic_load(&count->robots), robots);
}

/* Waits for a moment inside the job: the phases of a campaign take turns. */
static bool await_round(struct service *service, int64_t id, int mode, uint32_t round, bool learns)
{
  return mode == TRAINING
             ? await_step(service, id, 4 * (round + 1))
             : await_place(service, id, round,
                           learns && mode != MO_ZERO_SHOT ? MO_PHASE_LEARN : MO_PHASE_SCORE);
}

/* A checkpoint holds the newest step of an interrupted training. */
static void check_checkpoint(struct service *service, int64_t id, int mode)
{
  struct mo_training_status status;
  if (mode != TRAINING)
    return;
  status = training_of(service, id);
  CHECK(status.checkpoint_step >= 4 && status.checkpoint_step == status.step);
}

static void check_pauses(int mode)
{
  struct service service;
  struct fake_count count = {0};
  int64_t id;
  REQUIRE(service_start(&service, 1) == MO_OK);
  slow_down(mode);
  fake_count = &count;
  id = submit_one(&service, mode);
  for (uint32_t round = 0; round < 3; round++) {
    double begin;
    REQUIRE(await_round(&service, id, mode, round, round % 2 == 1));
    usleep(5000 * round);
    begin = now_s();
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    CHECK(await_phase(&service, id, MO_PHASE_IDLE));
    CHECK(now_s() - begin < 5);
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    usleep(30000);
    CHECK_INT(state_of(&service, id), MO_JOB_PAUSED);
    check_checkpoint(&service, id, mode);
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  }
  for (int i = 0; i < 4; i++) { /* at once */
    (void)mo_jobs_pause(service.jobs, id);
    (void)mo_jobs_resume(service.jobs, id);
    usleep(4000 * i);
  }
  CHECK(ends_right(&service, id, mode));
  fake_count = NULL;
  check_counts(mode, &count);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(warnings, 0);
  service_end(&service);
}

static void pauses_and_resumes(void)
{
#ifdef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
  const int last = TRAINING;
#else
  const int last = MO_SIMULTANEOUS;
#endif
  for (int mode = TRAINING; mode <= last; mode++)
    check_pauses(mode);
}

/* A stop, and another number of workers in the next life. */
static void stops_and_goes_on(void)
{
  static const uint32_t workers[] = {1, 7, 2};
  for (int mode = TRAINING; mode <= MO_SIMULTANEOUS; mode++) {
    struct service service;
    struct fake_count count = {0};
    int64_t id;
    REQUIRE(service_start(&service, 1) == MO_OK);
    slow_down(mode);
    fake_count = &count;
    id = submit_one(&service, mode);
    for (uint32_t round = 0; round < 3; round++) {
      double begin;
      REQUIRE(await_round(&service, id, mode, round, round % 2 == 0));
      begin = now_s();
      CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
      CHECK(now_s() - begin < 3);
      CHECK_INT(state_of(&service, id), MO_JOB_QUEUED);
      check_checkpoint(&service, id, mode);
      service.n_workers = workers[round];
      REQUIRE(service_reopen(&service) == MO_OK);
    }
    CHECK(ends_right(&service, id, mode));
    fake_count = NULL;
    check_counts(mode, &count);
    CHECK_INT(warnings, 0);
    service_end(&service);
  }
}

/* Stopped under one code and continued under another, at whatever step: it goes on, and the lineage
 * reports every change. */
SERVICE_CASE(reports_other_code, 1)
{
  static const char *const codes[] = {"fake gradient", "fake gradient-2", "fake gradient"};
  struct mo_training_request request = pretraining("");
  struct mo_training_lineage lineage = {0};
  struct mo_training_status status;
  struct mo_sha256 expected;
  int64_t id;
  request.record.checkpoint_every_steps = 0;
  fake_plan.gradient_delay_us = 20000;
  id = submit_training(service, &request);
  for (uint32_t round = 0; round < 3; round++) {
    REQUIRE(await_step(service, id, 4 * (round + 1)));
    CHECK_INT(mo_jobs_stop(service->jobs, 5000), MO_OK);
    status = training_of(service, id);
    CHECK_INT(status.code.n, round + 1);
    CHECK_TEXT(status.code.codes[status.code.n - 1].fingerprint, codes[round]);
    lineage = status.code;
    service_close(service);
    atomic_store(&fake_plan.gradient_fingerprint, codes[round < 2 ? round + 1 : 2]);
    REQUIRE(service_open(service) == MO_OK);
    if (round < 2) {
      REQUIRE(await_step(service, id, status.checkpoint_step + 1));
      lineage = training_of(service, id).code;
      CHECK_INT(lineage.codes[lineage.n - 1].from_step, status.checkpoint_step);
    }
  }
  CHECK(succeeds(service, id, NULL));
  expected = expect(&request, NULL, NULL, NULL, 0, &lineage);
  CHECK(learns_to(service, id, &expected));
  CHECK_INT(count_events(service, id, "training.code_changed"), 2);
}

/* Inside a gradient, inside a block (of a campaign), and before the start. */
static void cancels(void)
{
  for (int mode = TRAINING; mode <= MO_FEW_SHOT; mode += 2) {
    struct mo_training_request training = pretraining("never");
    struct mo_campaign_request campaigns = campaign(MO_FEW_SHOT);
    struct mo_controller_record record;
    struct mo_jobs_stats stats;
    struct service service;
    double begin;
    int64_t ids[3];
    snprintf(campaigns.record.name, sizeof(campaigns.record.name), "never");
    REQUIRE(service_start(&service, 1) == MO_OK);
    fake_plan.gradient_delay_us = 10000000;
    for (int i = 0; i < 3; i++)
      ids[i] = mode == TRAINING ? submit_training(&service, &training)
                                : submit_campaign(&service, &campaigns);
    CHECK_INT(mo_jobs_cancel(service.jobs, ids[2]), MO_OK);
    REQUIRE(await_phase(&service, ids[0], MO_PHASE_LEARN));
    CHECK_INT(state_of(&service, ids[1]), MO_JOB_QUEUED); /* one at a time */
    fake_plan.delay_us = 10000000;
    begin = now_s();
    CHECK_INT(mo_jobs_cancel(service.jobs, ids[0]), MO_OK);
    CHECK(await_phase(&service, ids[0], MO_PHASE_IDLE));
    CHECK(now_s() - begin < 3);
    fake_plan.gradient_delay_us = 0;
    REQUIRE(await_phase(&service, ids[1], mode == TRAINING ? MO_PHASE_VALIDATE : MO_PHASE_SCORE));
    CHECK_INT(mo_jobs_cancel(service.jobs, ids[1]), MO_OK);
    CHECK(await_phase(&service, ids[1], MO_PHASE_IDLE));
    CHECK_INT(mo_jobs_cancel(service.jobs, ids[1]), MO_ERR_CONFLICT);
    if (mode != TRAINING)
      CHECK_INT(extend(&service, ids[1], 1), MO_ERR_CONFLICT);
    CHECK_INT(state_of(&service, ids[1]), MO_JOB_CANCELLED);
    CHECK_INT(mo_store_controller(service.fixture.store, "never", &record), MO_ERR_NOT_FOUND);
    stats = idle_stats(&service);
    CHECK_INT(stats.open_jobs, 0);
    CHECK_INT(stats.jobs_cancelled, 3);
    service_end(&service);
  }
}

/* Extended while it waits, runs, is paused, and when it is over: each time as if it had been asked
 * for at once. */
__attribute__((unused)) static void extends(void)
{
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++) {
    struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
    const struct mo_request_key key = {.text = "more"};
    struct origin origin;
    struct service service;
    int64_t id;
    request.record.settings.generations = 1;
    origin = origin_of(&request);
    origin.settings.generations = 5;
    REQUIRE(service_start(&service, 1) == MO_OK);
    slow_down(mode);
    id = submit_campaign(&service, &request);
    REQUIRE(await_phase(&service, id, MO_PHASE_SCORE));
    CHECK_INT(extend(&service, id, 1), MO_OK); /* running */
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    CHECK_INT(extend(&service, id, 1), MO_OK); /* paused */
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    CHECK(succeeds(&service, id, NULL));
    CHECK_INT(idle_stats(&service).open_jobs, 0);
    CHECK_INT(status_of(&service, id).generation, 3);
    for (int i = 0; i < 2; i++) /* over; the same again */
      CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, &key, NULL), MO_OK);
    CHECK_INT(extend(&service, id, 1), MO_OK);
    CHECK(AWAIT(status_of(&service, id).generation == 5)); /* one may be over before the next */
    CHECK(ends_as_plain(&service, id, &origin));
    CHECK_INT(idle_stats(&service).open_jobs, 0);
    CHECK_INT(extend(&service, id, 0), MO_ERR_INVALID);
    CHECK_INT(extend(&service, id, MO_GENERATIONS_MAX), MO_ERR_RANGE);
    CHECK_INT(extend(&service, 99, 1), MO_ERR_NOT_FOUND);
    service_end(&service);
  }
}

SERVICE_CASE(does_not_extend_one_cosine, 1)
{
  struct mo_campaign_request request = campaign(MO_SIMULTANEOUS);
  struct origin origin;
  int64_t id;
  request.record.settings.learning.schedule = mo_schedule_presets[MO_SCHEDULE_ONE_COSINE];
  request.record.settings.learning.schedule.warmup_steps = 2;
  request.record.settings.generations = 2;
  origin = origin_of(&request);
  id = submit_campaign(service, &request);
  CHECK_INT(extend(service, id, 1), MO_ERR_UNSUPPORTED);
  CHECK(strstr(service->fixture.message.text, "cosine") != NULL);
  CHECK(ends_as_plain(service, id, &origin));
}

/* Several at once, one of them heavier, and an evaluation beside them. */
SERVICE_CASE(runs_side_by_side, 3)
{
  struct mo_campaign_request requests[3];
  struct origin origins[3];
  struct mo_evaluation_request evaluation;
  const struct mo_bits *genotypes;
  int64_t ids[3], other;
  genotypes = bodies(service, 77, 20);
  fake_plan.delay_us = 50000; /* so that the first is not over before its weight is set */
  for (int i = 0; i < 3; i++) {
    requests[i] = campaign((enum mo_campaign_mode)i);
    requests[i].record.settings.seed = 100 + (uint64_t)i;
    requests[i].weight = i + 1;
    origins[i] = origin_of(&requests[i]);
    ids[i] = submit_campaign(service, &requests[i]);
    REQUIRE(ids[i] > 0);
  }
  evaluation = service_request(genotypes, 20);
  other = service_submit(service, &evaluation);
  CHECK_INT(mo_jobs_set_weight(service->jobs, ids[0], 500), MO_OK);
  fake_plan.delay_us = 1000;
  CHECK(succeeds(service, other, NULL));
  CHECK(right(service, other, genotypes));
  for (int i = 0; i < 3; i++)
    CHECK(ends_as_plain(service, ids[i], &origins[i]));
}

static int crash_fd;

static void on_fault(int number)
{
  mo_jobs_crash_note(crash_fd, number);
  _exit(99);
}

/* A process dies on the own thread of a job that learns, again and again: the job is blamed, and
 * fails. */
__attribute__((unused)) static void blames_crashes_on_their_job(void)
{
  for (int mode = TRAINING; mode <= MO_FEW_SHOT; mode += 2) {
    struct service service;
    struct mo_job job = {.id = 0};
    char marker[512];
    int64_t id;
    int status;
    REQUIRE(service_begin(&service) == MO_OK);
    snprintf(marker, sizeof(marker), "%s/crash", service.fixture.path);
    service.config.crash_marker = marker;
    fake_plan.gradient_delay_us = 60000000;
    REQUIRE(service_open(&service) == MO_OK);
    id = submit_one(&service, mode);
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
      job = job_of(&service, id);
      CHECK_INT(job.attempts, round);
    }
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK(strstr(job.error_text, "signal 11") != NULL);
    service_end(&service);
  }
}

static const struct check_case cases[] = {
    {"pauses and resumes", pauses_and_resumes},
    {"stops and goes on", stops_and_goes_on},
    {"reports other code", reports_other_code},
    {"cancels", cancels},
    {"runs side by side", runs_side_by_side},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"extends", extends},
    {"does not extend one cosine", does_not_extend_one_cosine},
    {"blames crashes on their job", blames_crashes_on_their_job},
#endif
};
CHECK_MAIN(cases)
