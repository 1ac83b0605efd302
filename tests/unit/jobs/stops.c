/* stops.c: no matter how clients or stops of the process interrupt a training run or campaign, it
 * ends as it would have without them. */
#include <fcntl.h>
#include <signal.h>
#include <sys/wait.h>

#include "fakes.h"

/* Slow enough that every phase can be observed. */
static void slow_down(int mode)
{
  fake_plan.delay_us = mode == TRAINING ? 0 : 2500;
  fake_plan.gradient_delay_us = mode == TRAINING ? 20000 : 5000;
}

/* A pause and a stop save everything that was computed, except for the first waves of racing
 * children. */
static void check_counts(int mode, const struct fake_count *count)
{
  uint64_t rollouts = 0, robots = 0;
  if (mode == TRAINING) {
    CHECK_INT(atomic_load(&count->robots), STEPS * BATCH);
    return;
  }
  struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
  struct origin origin = origin_of(&request);
  needs(&origin, &rollouts, &robots);
  CHECK(atomic_load(&count->rollouts) >= rollouts);
  CHECK(atomic_load(&count->rollouts) <= rollouts + 3 * 2 * POPULATION);
  CHECK_INT(atomic_load(&count->robots), robots);
}

/* Waits for a certain moment inside the job: the phases of a campaign take turns. */
static bool await_round(int64_t id, int mode, uint32_t round, bool learns)
{
  return mode == TRAINING
             ? await_step(id, 4 * (round + 1))
             : await_place(id, round,
                           learns && mode != MO_ZERO_SHOT ? MO_PHASE_LEARN : MO_PHASE_SCORE);
}

/* A checkpoint holds the newest step of an interrupted training. */
static void check_checkpoint(int64_t id, int mode)
{
  if (mode != TRAINING)
    return;
  struct mo_training_status status = training_of(id);
  CHECK(status.checkpoint_step >= 4 && status.checkpoint_step == status.step);
}

static void check_pauses(int mode)
{
  struct fake_count count = {0};
  REQUIRE_OK(service_start(1));
  slow_down(mode);
  fake_count = &count;
  int64_t id = submit_one(mode);
  for (uint32_t round = 0; round < 3; round++) {
    REQUIRE(await_round(id, mode, round, round % 2 == 1));
    usleep(5000 * round);
    double begin = now_s();
    CHECK_OK(mo_jobs_pause(service.jobs, id));
    CHECK(await_phase(id, MO_PHASE_IDLE));
    CHECK(is_soon_after(begin));
    CHECK_OK(mo_jobs_pause(service.jobs, id));
    usleep(30000);
    CHECK_INT(state_of(id), MO_JOB_PAUSED);
    check_checkpoint(id, mode);
    CHECK_OK(mo_jobs_resume(service.jobs, id));
  }
  for (int i = 0; i < 4; i++) { /* at once */
    (void)mo_jobs_pause(service.jobs, id);
    (void)mo_jobs_resume(service.jobs, id);
    usleep(4000 * i);
  }
  CHECK(ends_right(id, mode));
  fake_count = NULL;
  check_counts(mode, &count);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(warnings, 0);
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

/* A stop, and then a different number of workers. */
static void stops_and_goes_on(void)
{
  static const uint32_t workers[] = {1, 7, 2};
#ifdef __SANITIZE_THREAD__ /* slow there: one that only learns, and one that also scores */
  const int stride = 2;
#else
  const int stride = 1;
#endif
  for (int mode = TRAINING; mode <= MO_SIMULTANEOUS; mode += stride) {
    struct fake_count count = {0};
    REQUIRE_OK(service_start(1));
    slow_down(mode);
    fake_count = &count;
    int64_t id = submit_one(mode);
    for (uint32_t round = 0; round < 3; round++) {
      REQUIRE(await_round(id, mode, round, round % 2 == 0));
      double begin = now_s();
      CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
      CHECK(is_soon_after(begin));
      CHECK_INT(state_of(id), MO_JOB_QUEUED);
      check_checkpoint(id, mode);
      service.n_workers = workers[round];
      REQUIRE_OK(service_reopen());
    }
    CHECK(ends_right(id, mode));
    fake_count = NULL;
    check_counts(mode, &count);
    CHECK_INT(warnings, 0);
  }
}

/* Stopped under one code version and continued under another, at any step: it continues, and the
 * lineage reports every change. */
SERVICE_CASE(reports_other_code, 1)
{
  static const char *const codes[] = {"fake gradient", "fake gradient-2", "fake gradient"};
  struct mo_training_request request = pretraining("");
  struct mo_training_lineage lineage = {0};
  struct mo_training_status status;
  request.record.checkpoint_every_steps = 0;
  fake_plan.gradient_delay_us = 20000;
  int64_t id = submit_training(&request);
  for (uint32_t round = 0; round < 3; round++) {
    REQUIRE(await_step(id, 4 * (round + 1)));
    CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
    status = training_of(id);
    CHECK_INT(status.code.n, round + 1);
    CHECK_TEXT(status.code.codes[status.code.n - 1].fingerprint, codes[round]);
    lineage = status.code;
    service_close();
    atomic_store(&fake_plan.gradient_fingerprint, codes[round < 2 ? round + 1 : 2]);
    REQUIRE_OK(service_open());
    if (round < 2) {
      REQUIRE(await_step(id, status.checkpoint_step + 1));
      lineage = training_of(id).code;
      CHECK_INT(lineage.codes[lineage.n - 1].from_step, status.checkpoint_step);
    }
  }
  CHECK(succeeds(id, NULL));
  struct mo_sha256 expected = expect(&request, NULL, NULL, NULL, 0, &lineage);
  CHECK(learns_to(id, &expected));
  CHECK_INT(count_events(id, "training.code_changed"), 2);
}

/* Inside a gradient, inside a block (of a campaign), and before the start. */
static void cancels(void)
{
  for (int mode = TRAINING; mode <= MO_FEW_SHOT; mode += 2) {
    struct mo_training_request training = pretraining("never");
    struct mo_campaign_request campaigns = campaign(MO_FEW_SHOT);
    struct mo_controller_record record;
    int64_t ids[3];
    snprintf(campaigns.record.name, sizeof(campaigns.record.name), "never");
    REQUIRE_OK(service_start(1));
    fake_plan.gradient_delay_us = LONG_US;
    for (int i = 0; i < 3; i++)
      ids[i] = mode == TRAINING ? submit_training(&training) : submit_campaign(&campaigns);
    CHECK_OK(mo_jobs_cancel(service.jobs, ids[2]));
    REQUIRE(await_phase(ids[0], MO_PHASE_LEARN));
    CHECK_INT(state_of(ids[1]), MO_JOB_QUEUED); /* one at a time */
    fake_plan.delay_us = LONG_US;
    double begin = now_s();
    CHECK_OK(mo_jobs_cancel(service.jobs, ids[0]));
    CHECK(await_phase(ids[0], MO_PHASE_IDLE));
    CHECK(is_soon_after(begin));
    fake_plan.gradient_delay_us = 0;
    REQUIRE(await_phase(ids[1], mode == TRAINING ? MO_PHASE_VALIDATE : MO_PHASE_SCORE));
    CHECK_OK(mo_jobs_cancel(service.jobs, ids[1]));
    CHECK(await_phase(ids[1], MO_PHASE_IDLE));
    CHECK_INT(mo_jobs_cancel(service.jobs, ids[1]), MO_ERR_CONFLICT);
    if (mode != TRAINING)
      CHECK_INT(extend(ids[1], 1), MO_ERR_CONFLICT);
    CHECK_INT(state_of(ids[1]), MO_JOB_CANCELLED);
    CHECK_INT(mo_store_controller(store, "never", &record), MO_ERR_NOT_FOUND);
    struct mo_jobs_stats stats = idle_stats();
    CHECK_INT(stats.open_jobs, 0);
    CHECK_INT(stats.jobs_cancelled, 3);
  }
}

/* Extended while waiting, running, paused, and finished: each time as if the final length had been
 * requested at once. */
__attribute__((unused)) static void extends(void)
{
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++) {
    struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
    const struct mo_request_key key = {.text = "more"};
    request.record.settings.generations = 1;
    struct origin origin = origin_of(&request);
    origin.settings.generations = 5;
    REQUIRE_OK(service_start(1));
    slow_down(mode);
    fake_plan.delay_us = LONG_US; /* it is still running when this thread gets a processor */
    int64_t id = submit_campaign(&request);
    REQUIRE(await_phase(id, MO_PHASE_SCORE));
    CHECK_OK(extend(id, 1)); /* running */
    CHECK_OK(mo_jobs_pause(service.jobs, id));
    CHECK(await_phase(id, MO_PHASE_IDLE));
    slow_down(mode);
    CHECK_OK(extend(id, 1)); /* paused */
    CHECK_OK(mo_jobs_resume(service.jobs, id));
    CHECK(succeeds(id, NULL));
    CHECK_INT(idle_stats().open_jobs, 0);
    CHECK_INT(status_of(id).generation, 3);
    for (int i = 0; i < 2; i++) /* finished; the same key again */
      CHECK_OK(mo_jobs_extend_campaign(service.jobs, id, 1, &key, NULL));
    CHECK_OK(extend(id, 1));
    CHECK(AWAIT(status_of(id).generation == 5)); /* one may finish before the next extension */
    CHECK(ends_as_plain(id, &origin));
    CHECK_INT(idle_stats().open_jobs, 0);
    CHECK_INT(extend(id, MO_GENERATIONS_MAX), MO_ERR_RANGE);
    CHECK_INT(extend(99, 1), MO_ERR_NOT_FOUND);
  }
}

SERVICE_CASE(does_not_extend_one_cosine, 1)
{
  struct mo_campaign_request request = campaign(MO_SIMULTANEOUS);
  request.record.settings.learning.schedule = mo_schedule_presets[MO_SCHEDULE_ONE_COSINE];
  request.record.settings.learning.schedule.warmup_steps = 2;
  request.record.settings.generations = 2;
  struct origin origin = origin_of(&request);
  int64_t id = submit_campaign(&request);
  CHECK_INT(extend(id, 1), MO_ERR_UNSUPPORTED);
  CHECK_SAYS(fixture.message, "cosine");
  CHECK(ends_as_plain(id, &origin));
}

/* Several jobs at once, one of them with a larger weight, and an evaluation along with them. */
SERVICE_CASE(runs_side_by_side, 3)
{
  struct mo_campaign_request requests[3];
  struct origin origins[3];
  int64_t ids[3], other;
  const struct mo_bits *genotypes = bodies(77, 20);
  fake_plan.delay_us = 50000; /* so that the first does not finish before its weight is set */
  for (int i = 0; i < 3; i++) {
    requests[i] = campaign((enum mo_campaign_mode)i);
    requests[i].record.settings.seed = 100 + (uint64_t)i;
    requests[i].job.weight = i + 1;
    origins[i] = origin_of(&requests[i]);
    ids[i] = submit_campaign(&requests[i]);
    REQUIRE(ids[i] > 0);
  }
  struct mo_evaluation_request evaluation = service_request(genotypes, 20);
  other = submit_evaluation(&evaluation);
  CHECK_OK(mo_jobs_set_weight(service.jobs, ids[0], 500));
  fake_plan.delay_us = 1000;
  CHECK(right(other, genotypes));
  for (int i = 0; i < 3; i++)
    CHECK(ends_as_plain(ids[i], &origins[i]));
}

static int crash_fd;

static void on_fault(int number)
{
  mo_jobs_crash_note(crash_fd, number);
  _exit(99);
}

/* The process crashes repeatedly in the thread of a learning job: the job is blamed, and fails. */
__attribute__((unused)) static void blames_crashes_on_their_job(void)
{
  for (int mode = TRAINING; mode <= MO_FEW_SHOT; mode += 2) {
    struct mo_job job = {.id = 0};
    char marker[512];
    int status;
    REQUIRE_OK(service_begin());
    snprintf(marker, sizeof(marker), "%s/crash", fixture.path);
    service.config.crash_marker = marker;
    fake_plan.gradient_delay_us = 60000000;
    REQUIRE_OK(service_open());
    int64_t id = submit_one(mode);
    for (int round = 1; round <= 3; round++) {
      service_close();
      pid_t child = fork();
      REQUIRE(child >= 0);
      if (child == 0) {
        crash_fd = open(marker, O_WRONLY | O_CREAT | O_APPEND, 0600);
        signal(SIGSEGV, on_fault);
        fake_plan.gradient_delay_us = 0;
        fake_plan.gradient_crash = true;
        if (service_open() == MO_OK)
          sleep(20);
        _exit(0);
      }
      REQUIRE(waitpid(child, &status, 0) == child);
      CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 99);
      REQUIRE_OK(service_open());
      job = job_of(id);
      CHECK_INT(job.attempts, round);
    }
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK_HAS(job.error_text, "signal 11");
  }
}

static const struct check_case cases[] = {
    {"pauses and resumes", pauses_and_resumes},
    {"stops and continues", stops_and_goes_on},
    {"reports other code", reports_other_code},
    {"cancels", cancels},
    {"runs side by side", runs_side_by_side},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"extends", extends},
    {"does not extend a one-cosine schedule", does_not_extend_one_cosine},
    {"blames crashes on their job", blames_crashes_on_their_job},
#endif
};
CHECK_MAIN(cases)
