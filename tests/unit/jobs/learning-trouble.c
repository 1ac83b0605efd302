/* learning-trouble.c: errors, damage and lack of space: training runs and campaigns wait, retry,
 * and end as if nothing had happened. */
#include <fcntl.h>
#include <signal.h>
#include <sys/resource.h>

#include "../store/fault_vfs.h"
#include "fakes.h"

/* ---- training runs and campaigns ---- */

/* Limits the size of files: the database fits, checkpoints do not. */
static void limit_files(rlim_t bytes)
{
  struct rlimit limit;
  signal(SIGXFSZ, SIG_IGN);
  getrlimit(RLIMIT_FSIZE, &limit);
  limit.rlim_cur = bytes;
  setrlimit(RLIMIT_FSIZE, &limit);
}

#ifdef __SANITIZE_THREAD__ /* slow there */
enum { LAST_MODE = TRAINING };
#else
enum { LAST_MODE = MO_FEW_SHOT };
#endif

/* Returns whether only this job is shown as waiting. */
static bool only_waits(int64_t id)
{
  int64_t waiting[MO_WAITING_MAX] = {0};
  return mo_jobs_waiting(service.jobs, waiting) == 1 && waiting[0] == id;
}

/* Tests a job that waits for a resource: it can be paused, resumed and cancelled, and the process
 * can stop in the meantime. `shorten` takes the resource away, or gives it back. stopped: the
 * expected result of mo_jobs_stop. */
static void check_waiting(int mode, int64_t id, void (*shorten)(int mode, bool is_short),
                          int stopped)
{
  CHECK(only_waits(id));
  CHECK_INT(warnings, 1);
  CHECK_OK(mo_jobs_pause(service.jobs, id));
  CHECK_OK(mo_jobs_resume(service.jobs, id));
  shorten(mode, false);
  CHECK(ends_right(id, mode));
  shorten(mode, true); /* cancelled while it waits */
  id = submit_one(mode);
  REQUIRE(await_phase(id, MO_PHASE_WAIT));
  double begin = now_s();
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
  CHECK(await_phase(id, MO_PHASE_IDLE));
  CHECK(is_soon_after(begin));
  id = submit_one(mode); /* stopped while it waits: unsaved work is repeated */
  REQUIRE(await_phase(id, MO_PHASE_WAIT));
  begin = now_s();
  CHECK_INT(mo_jobs_stop(service.jobs, STOP_MS), stopped);
  CHECK(is_soon_after(begin));
  CHECK_INT(stats_of().active_trainings, 0);
  service_close();
  shorten(mode, false);
  REQUIRE_OK(service_open());
  CHECK(ends_right(id, mode));
}

static void shorten_disk(int mode, bool is_short)
{
  (void)mode;
  limit_files(is_short ? 8 << 20 : RLIM_INFINITY);
}

static void waits_for_room(void)
{
  for (int mode = TRAINING; mode <= LAST_MODE; mode += 2) {
    REQUIRE_OK(service_start(1));
    shorten_disk(mode, true);
    int64_t id = submit_one(mode);
    CHECK(await_reason(id, "no space"));
    CHECK(
        await_reason(id, mode == TRAINING ? "checkpoint of step 6" : "checkpoint of generation 0"));
    CHECK(await_reason(id, "will continue"));
    CHECK_INT(live_of(id).position, mode == TRAINING ? 6 : 0);
    usleep(350000); /* it has tried again */
    CHECK_INT(live_of(id).phase, MO_PHASE_WAIT);
    check_waiting(mode, id, shorten_disk, MO_ERR_BUSY);
  }
}

/* Makes a number of gradients fail, or of blocks if the campaign does not learn. */
static void break_down(int mode, int times, int status)
{
  const bool blocks = mode == MO_ZERO_SHOT || mode == MO_FEW_SHOT;
  atomic_store(blocks ? &fake_plan.fail_times : &fake_plan.gradient_fails, times);
  atomic_store(blocks ? &fake_plan.fail_status : &fake_plan.gradient_status, status);
}

static void shorten_memory(int mode, bool is_short)
{
  break_down(mode, is_short ? 1000 : 0, MO_ERR_NO_MEMORY);
}

/* Lack of memory is not the job's fault: it waits as often as necessary, and loses nothing. */
static void waits_for_memory(void)
{
  for (int mode = TRAINING; mode <= MO_FEW_SHOT; mode += 2) {
    const int often = mode == TRAINING ? 995 : 980; /* more often than the number of attempts */
    REQUIRE_OK(service_start(1));
    shorten_memory(mode, true);
    int64_t id = submit_one(mode);
    CHECK(AWAIT(fake_plan.fail_times + fake_plan.gradient_fails <= often));
    CHECK(await_reason(id, "no memory"));
    CHECK(await_reason(id, "will continue"));
    check_waiting(mode, id, shorten_memory, MO_OK);
  }
}

__attribute__((unused)) static void tries_three_times(void)
{
  static const int modes[] = {TRAINING, MO_ZERO_SHOT, MO_SIMULTANEOUS};
  for (int i = 0; i < 3; i++) {
    REQUIRE_OK(service_start(1));
    break_down(modes[i], 1000, MO_ERR_IO);
    int64_t id = submit_one(modes[i]);
    check_failed(id, 3, MO_ERR_IO, "input or output failed");
    CHECK_INT(warnings, 3);
    CHECK(has_warned("input or output failed"));
    CHECK_INT(idle_stats().jobs_failed, 1);
    if (modes[i] != TRAINING)
      CHECK_INT(extend(id, 1), MO_ERR_CONFLICT);
    /* Nothing is lost: the job continues once the cause is gone. An error is forgiven when
     * something is saved after it. */
    break_down(modes[i], 1, MO_ERR_IO);
    CHECK_OK(mo_jobs_resume(service.jobs, id));
    CHECK(ends_right(id, modes[i]));
    CHECK_OK(job_of(id).error);
    CHECK_INT(warnings, 4);
    CHECK_INT(idle_stats().open_jobs, 0);
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_ERR_CONFLICT);
  }
}

/* Repairs the damage at the second call. */
static bool damage(const char *path)
{
  uint8_t bytes[6];
  bool is_done = false;
  const int fd = open(path, O_RDWR);
  if (fd >= 0 && pread(fd, bytes, 6, 5000) == 6) {
    for (int i = 0; i < 6; i++)
      bytes[i] ^= 0x55;
    is_done = pwrite(fd, bytes, 6, 5000) == 6;
    close(fd);
  }
  return is_done;
}

/* ---- training runs ---- */

SERVICE_CASE(waits_for_descriptors, 1)
{
  struct rlimit before, none;
  fake_plan.gradient_delay_us = 20000;
  int64_t id = submit_one(TRAINING);
  REQUIRE(await_step(id, 1));
  REQUIRE(getrlimit(RLIMIT_NOFILE, &before) == 0);
  none = before;
  none.rlim_cur = 3;
  REQUIRE(setrlimit(RLIMIT_NOFILE, &none) == 0);
  CHECK(await_reason(id, "file descriptor"));
  CHECK(await_reason(id, "will continue"));
  usleep(500000); /* it has tried again */
  CHECK_INT(state_of(id), MO_JOB_RUNNING);
  REQUIRE(setrlimit(RLIMIT_NOFILE, &before) == 0);
  CHECK(ends_right(id, TRAINING));
}

static bool damage_checkpoint(int64_t id, uint32_t step)
{
  return damage(path_of("trainings/%lld/%u.checkpoint", (long long)id, step));
}

SERVICE_CASE(passes_over_damaged_checkpoints, 1)
{
  struct mo_checkpoint_row rows[5];
  fake_plan.gradient_delay_us = 20000;
  int64_t id = submit_one(TRAINING);
  /* The newest checkpoint, then all of them. */
  for (int round = 1; round <= 2; round++) {
    REQUIRE(await_step(id, 12));
    CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
    REQUIRE(mo_store_checkpoints(store, id, rows, 5) == 2);
    service_close();
    for (int i = 0; i < round; i++)
      REQUIRE(damage_checkpoint(id, rows[i].step));
    warnings = 0;
    REQUIRE_OK(service_open());
    REQUIRE(await_step(id, 2));
    CHECK_INT(warnings, round);
    CHECK(has_warned(round == 1 ? "using the previous one" : "restarting the training run"));
  }
  CHECK(ends_right(id, TRAINING));
}

static int start_with_faults(void)
{
  int error = fault_vfs_register() == SQLITE_OK ? service_begin() : -1;
  memset(&fault_plan, 0, sizeof(fault_plan));
  service.vfs = "faults";
  return error == MO_OK ? service_open() : error;
}

__attribute__((unused)) static void waits_for_the_database(void)
{
  REQUIRE_OK(start_with_faults());
  fake_plan.gradient_delay_us = 20000;
  int64_t id = submit_one(TRAINING);
  REQUIRE(await_step(id, 2));
  for (int i = 0; i < 2; i++) {
    fault_plan.writes_left = 0;
    fault_plan.write_error = i == 0 ? SQLITE_FULL : SQLITE_BUSY;
    CHECK(await_reason(id, i == 0 ? "no space" : "locked"));
    fault_plan.write_error = 0;
    REQUIRE(await_phase(id, MO_PHASE_LEARN));
  }
  CHECK(ends_right(id, TRAINING));
}

/* There is no memory, not even to store the failure: it is stored once there is memory. */
__attribute__((unused)) static void notes_a_failure_when_it_can(void)
{
  struct mo_training_request request = pretraining("");
  request.record.validate_every_steps = 0;
  REQUIRE_OK(start_with_faults());
  fake_plan.gradient_delay_us = 300000;
  break_down(TRAINING, 1, MO_ERR_NO_MEMORY);
  int64_t id = submit_training(&request);
  REQUIRE(await_state(id, MO_JOB_RUNNING));
  fault_plan.writes_left = 0;
  fault_plan.write_error = SQLITE_NOMEM;
  CHECK(await_reason(id, "no memory"));
  CHECK_INT(state_of(id), MO_JOB_RUNNING);
  fake_plan.gradient_delay_us = 0;
  fault_plan.write_error = 0;
  CHECK(ends_right(id, TRAINING));
}

/* ---- campaigns ---- */

/* A workspace with room for one or two distinct bodies: they are scored, and the campaign ends. */
SERVICE_CASE(exhausts_small_spaces, 2)
{
  static const struct {
    struct mo_workspace workspace;
    uint32_t population, n_designs;
  } spaces[] = {{{1, 1, 1}, POPULATION, 1},
                {{2, 1, 1}, POPULATION, 2},
                {{2, 2, 1}, 3, 4}}; /* sizes 1 and 2, the L and the square */
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++)
    for (int i = 0; i < 3; i++) {
      struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
      request.record.settings.workspace = spaces[i].workspace;
      request.record.settings.population = spaces[i].population;
      request.record.settings.generations = 20;
      struct origin origin = origin_of(&request);
      int64_t id = submit_campaign(&request);
      CHECK(ends_as_plain(id, &origin));
      struct mo_campaign_status status = status_of(id);
      CHECK_INT(status.end, MO_CAMPAIGN_EXHAUSTED);
      CHECK(status.generation >= 0 && status.generation < 20);
      CHECK_INT(status.n_designs, spaces[i].n_designs);
      CHECK_INT(status.job.has_result, mode != MO_ZERO_SHOT);
      CHECK_INT(extend(id, 1), MO_ERR_CONFLICT);
    }
}

SERVICE_CASE(refuses_nan, 1)
{
  fake_plan.poison = true;
  struct mo_job job = end_of(submit_one(MO_SIMULTANEOUS));
  CHECK(job.state == MO_JOB_FAILED && strstr(job.error_text, "not a number") != NULL);
  /* A design that fails on every worker does not end a campaign as exhausted either. */
  fake_plan.poison = false;
  fake_plan.fail_status = MO_ERR_EXHAUSTED;
  fake_plan.fail_times = 1000;
  job = end_of(submit_one(MO_ZERO_SHOT));
  CHECK(job.state == MO_JOB_FAILED && strstr(job.error_text, "compute design ") != NULL);
}

/* Damages the checkpoint at the end of a generation's learning. */
static bool damage_generation(int64_t id, uint32_t generation)
{
  return damage(path_of("campaigns/%lld/%u-%u.checkpoint", (long long)id, generation,
                        PARENT_STEPS + CHILD_STEPS));
}

/* Learning inside a generation is repeated; the final state of a generation cannot be
 * recomputed. */
SERVICE_CASE(reports_damaged_checkpoints, 1)
{
  struct mo_job job;
  int64_t id;
  for (int round = 0; round < 2; round++) {
    uint32_t generation;
    fake_plan.delay_us = 20000;
    id = submit_one(MO_SIMULTANEOUS);
    REQUIRE(await_place(id, 2, MO_PHASE_SCORE));
    CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
    generation = (uint32_t)status_of(id).generation + 1;
    service_close();
    REQUIRE(damage_generation(id, generation));
    if (round == 1)
      REQUIRE(damage_generation(id, generation - 1));
    warnings = 0;
    fake_plan.delay_us = 0;
    REQUIRE_OK(service_open());
    if (round == 1) {
      job = end_of(id);
      CHECK(job.state == MO_JOB_FAILED && job.error == MO_ERR_CORRUPT);
      CHECK(strstr(job.error_text, "cannot be used (it is missing, or its bytes") != NULL &&
            strstr(job.error_text, "backup") != NULL);
      REQUIRE(damage_generation(id, generation - 1));
      CHECK_OK(mo_jobs_resume(service.jobs, id));
    }
    CHECK(ends_right(id, MO_SIMULTANEOUS));
    if (round == 0) {
      CHECK_INT(warnings, 1);
      CHECK(has_warned("generation's learning is repeated"));
    }
  }
}

SERVICE_CASE(needs_its_controller, 1)
{
  char path[512];
  snprintf(path, sizeof(path), "%s/controllers/%s.safetensors", fixture.path, default_digits());
  REQUIRE(truncate(path, 1000) == 0);
  struct mo_job job = end_of(submit_one(MO_ZERO_SHOT));
  CHECK(job.state == MO_JOB_FAILED && strstr(job.error_text, "store the same file again") != NULL);
}

static const struct check_case cases[] = {
    {"waits for room", waits_for_room},
    {"waits for memory", waits_for_memory},
    {"waits for descriptors", waits_for_descriptors},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"tries three times", tries_three_times},
    {"skips damaged checkpoints", passes_over_damaged_checkpoints},
    {"waits for the database", waits_for_the_database},
    {"records a failure when it can", notes_a_failure_when_it_can},
    {"exhausts small spaces", exhausts_small_spaces},
    {"refuses losses that are not numbers", refuses_nan},
    {"reports damaged checkpoints", reports_damaged_checkpoints},
    {"needs its controller", needs_its_controller},
#endif
};
CHECK_MAIN(cases)
