/* trouble.c: the scheduler with a fake back end: how evaluations end if something breaks. */
#include <fcntl.h>
#include <signal.h>

#include "../store/fault_vfs.h"
#include "fakes.h"

SERVICE_CASE(parks_after_three_errors, 0)
{
  struct mo_job job;
  const struct mo_bits *genotypes = bodies(10, 10);
  fake_plan.fail_word = genotypes[5].words[0];
  fake_plan.fail_times = 1;
  fake_plan.fail_status = MO_ERR_NO_MEMORY;
  int64_t id = evaluate(genotypes, 10);
  CHECK(succeeds(id, &job)); /* one error is forgiven */
  CHECK_INT(job.attempts, 1);
  CHECK(right(id, genotypes));
  genotypes = bodies(11, 10);
  fake_plan.fail_word = genotypes[5].words[0];
  fake_plan.fail_times = 1000;
  id = evaluate(genotypes, 10);
  check_failed(id, 3, MO_ERR_NO_MEMORY, "out of memory");
  struct mo_jobs_stats stats = idle_stats();
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.jobs_failed, 1);
}

SERVICE_CASE(refuses_nan, 0)
{
  const struct mo_bits *genotypes = bodies(23, 4);
  for (int recorded = 0; recorded < 2; recorded++) {
    struct mo_evaluation_request request = service_request(genotypes, 4);
    struct mo_evaluation_results *results = NULL;
    request.record = recorded != 0 ? MO_RECORD_COM : 0;
    fake_plan.poison = true;
    int64_t id = submit_evaluation(&request);
    struct mo_job job = end_of(id);
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK_HAS(job.error_text, "not a number");
    CHECK_INT(job.rollouts_done, 0);
    REQUIRE_OK(mo_store_results(store, id, &results));
    CHECK(isnan(results->losses[0])); /* nothing there */
    mo_evaluation_results_free(results);
    fake_plan.poison = false;
  }
  CHECK_INT(computed(), 0);
  CHECK_OK(check_whole());
}

SERVICE_CASE(names_a_damaged_controller, 0)
{
  const char *digits = default_digits();
  char path[512];
  const struct mo_bits *genotypes = bodies(24, 2);
  snprintf(path, sizeof(path), "%s/controllers/%s.safetensors", fixture.path, digits);
  CHECK_INT(truncate(path, 100), 0);
  struct mo_job job = end_of(evaluate(genotypes, 2));
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.error, MO_ERR_CORRUPT);
  CHECK(strstr(job.error_text, digits) != NULL && strstr(job.error_text, "PUT") != NULL);
  CHECK_HAS(job.error_text, "submit the job again"); /* to its end */
  CHECK_INT(warnings, 3);
  CHECK(has_warned(".safetensors"));
  /* As the message says: */
  REQUIRE_OK(put_weights("again", 1, NULL));
  CHECK(succeeds(evaluate(genotypes, 2), NULL));
}

/* The failed save contained the start of the job, or one of its errors, or neither. */
static void parks_what_cannot_be_saved(void)
{
  for (int round = 0; round < 3; round++) {
    REQUIRE_OK(service_start(0));
    const struct mo_bits *genotypes = bodies(21, 4);
    int64_t fingerprint = service.jobs->classes.cpu[MO_FLOAT32];
    service.jobs->classes.cpu[MO_FLOAT32] = 999; /* no such row: the store refuses the losses */
    fake_plan.delay_us = round == 0 ? 0 : 250000;
    fake_plan.fail_word = genotypes[1].words[0];
    fake_plan.fail_times = 1000;
    fake_plan.fail_status = round == 1 ? MO_ERR_NO_MEMORY : 0;
    struct mo_evaluation_request request = service_request(genotypes, 4);
    request.job.priority = round == 0 ? MO_INTERACTIVE : MO_BATCH;
    struct mo_job job = end_of(submit_evaluation(&request));
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK_INT(job.attempts, 3);
    CHECK_INT(idle_stats().open_jobs, 0);
    /* The other jobs continue. */
    service.jobs->classes.cpu[MO_FLOAT32] = fingerprint;
    fake_plan.fail_status = 0;
    fake_plan.delay_us = 0;
    genotypes = bodies(19, 5);
    int64_t id = evaluate(genotypes, 5);
    CHECK(right(id, genotypes));
  }
}

SERVICE_CASE(blames_crashes_on_their_job, 0)
{
  struct mo_job job;
  char marker[512];
  int fd;
  const struct mo_bits *genotypes = bodies(12, 20);
  snprintf(marker, sizeof(marker), "%s/crash", fixture.path);
  service.config.crash_marker = marker;
  fake_plan.delay_us = 60000000;
  int64_t id = evaluate(genotypes, 10);
  int64_t other = evaluate(genotypes + 10, 10);
  for (int round = 1; round <= 3; round++) {
    CHECK(await_state(id, MO_JOB_RUNNING));
    /* A thread that is not inside a block writes nothing. */
    fd = open(marker, O_WRONLY | O_CREAT | O_APPEND, 0600);
    REQUIRE(fd >= 0);
    mo_jobs_crash_note(fd, SIGSEGV);
    CHECK_INT(lseek(fd, 0, SEEK_END), 0);
    /* The line that a worker's handler writes, and a second line that was cut off. */
    dprintf(fd, "%lld %d\n%lld", (long long)id, SIGSEGV, (long long)other);
    close(fd);
    service_close();
    /* Running in the file, or still queued: the start of a job is written some time later. */
    service_set_states(id, other, round == 2 ? MO_JOB_QUEUED : MO_JOB_RUNNING);
    REQUIRE_OK(service_open());
    job = job_of(id);
    CHECK_INT(job.attempts, round);
  }
  check_failed(id, 3, job.error, "signal 11");
  fake_plan.delay_us = 0;
  REQUIRE_OK(service_reopen()); /* the marker was emptied: no job is blamed */
  CHECK(succeeds(other, &job));
  CHECK_INT(job.attempts, 0);
}

static void waits_for_room(void)
{
  REQUIRE(fault_vfs_register() == SQLITE_OK);
  REQUIRE_OK(service_begin());
  service.vfs = "faults";
  REQUIRE_OK(service_open());
  const struct mo_bits *genotypes = bodies(13, 60);
  fake_plan.delay_us = 10000;
  int64_t id = evaluate(genotypes, 50);
  CHECK(await_state(id, MO_JOB_RUNNING));
  atomic_store(&fault_plan.writes_left, 0);
  atomic_store(&fault_plan.write_error, SQLITE_FULL);
  CHECK(AWAIT(stats_of().no_space));
  CHECK_INT(evaluate(genotypes + 50, 10), MO_ERR_NO_SPACE);
  CHECK_INT(state_of(id), MO_JOB_RUNNING); /* reading still works */
  usleep(300000);
  CHECK_INT(stats_of().blocks_in_flight, 0); /* nothing is computed that cannot be stored */
  atomic_store(&fault_plan.write_error, 0);
  CHECK(right(id, genotypes));
  CHECK_INT(computed(), 500);
  CHECK(!stats_of().no_space);
  CHECK(succeeds(evaluate(genotypes + 50, 10), NULL));
  CHECK_OK(check_whole());
}

SERVICE_CASE(answers_from_its_cache_of_controllers, 0)
{
  enum { CONTROLLERS = 12 }; /* more than are kept in memory */
  char name[32];
  int64_t ids[CONTROLLERS];
  const struct mo_bits *genotypes = bodies(14, 10);
  struct mo_evaluation_request request = service_request(genotypes, 10);
  request.controller = name;
  request.precision = MO_FLOAT64;
  for (int i = 0; i < CONTROLLERS; i++) {
    snprintf(name, sizeof(name), "seed-%d", i);
    REQUIRE_OK(put_weights(name, (uint64_t)(100 + i), NULL));
    ids[i] = submit_evaluation(&request);
  }
  for (int i = 0; i < CONTROLLERS; i++) {
    struct mo_controller *controller = weights_of((uint64_t)(100 + i));
    CHECK(succeeds(ids[i], NULL));
    CHECK(results_right(ids[i], genotypes, MO_FLOAT64, controller));
    mo_controller_free(controller);
  }
  CHECK_INT(computed(), 100 * CONTROLLERS);
}

/* ---- many clients at once ---- */

struct client {
  const struct mo_bits *genotypes;
  uint32_t seed;
  int failures;
};

static void *be_a_client(void *context)
{
  struct client *client = context;
  for (uint32_t i = 0; i < 12; i++) {
    struct mo_evaluation_request request =
        service_request(client->genotypes + (client->seed * 7 + i * 3) % 80, 10);
    int64_t id = 0;
    bool replayed;
    request.job.priority = (int)(i % 2);
    if (mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, NULL) != MO_OK) {
      client->failures++;
      continue;
    }
    if (i % 5 == 4) {
      (void)mo_jobs_cancel(service.jobs, id);
      continue;
    }
    for (uint32_t k = 0; k < i % 3; k++) { /* possibly before its start is written */
      (void)mo_jobs_pause(service.jobs, id);
      (void)mo_jobs_resume(service.jobs, id);
    }
    if (!right(id, request.genotypes))
      client->failures++;
  }
  return NULL;
}

SERVICE_CASE(serves_many_clients, 0)
{
  struct client clients[8];
  pthread_t threads[8];
  (void)default_weights();
  const struct mo_bits *genotypes = bodies(15, 90);
  fake_plan.delay_us = 400;
  for (uint32_t i = 0; i < 8; i++) {
    clients[i] = (struct client){genotypes, i, 0};
    REQUIRE(pthread_create(&threads[i], NULL, be_a_client, &clients[i]) == 0);
  }
  for (uint32_t i = 0; i < 8; i++) {
    pthread_join(threads[i], NULL);
    CHECK_INT(clients[i].failures, 0);
  }
  struct mo_jobs_stats stats = idle_stats();
  CHECK_INT(stats.open_jobs, 0);
  CHECK(stats.rollouts_computed <= 900);
  CHECK_OK(check_whole());
}

static const struct check_case cases[] = {
    {"parks a job after three errors", parks_after_three_errors},
    {"reports a damaged controller", names_a_damaged_controller},
    {"refuses losses that are not numbers", refuses_nan},
    {"parks a job whose losses cannot be saved", parks_what_cannot_be_saved},
    {"blames crashes on their job", blames_crashes_on_their_job},
    {"waits for room on the disk", waits_for_room},
    {"keeps only a few controllers loaded", answers_from_its_cache_of_controllers},
    {"serves many clients at once", serves_many_clients},
};
CHECK_MAIN(cases)
