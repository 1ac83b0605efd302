/* trouble.c: the scheduler with a fake back end: what becomes of evaluations when something
 * breaks. */
#include <fcntl.h>
#include <signal.h>

#include "../store/fault_vfs.h"
#include "fakes.h"

SERVICE_CASE(parks_after_three_errors, 0)
{
  const struct mo_bits *genotypes;
  struct mo_jobs_stats stats;
  struct mo_job job;
  int64_t id;
  genotypes = bodies(service, 10, 10);
  fake_plan.fail_word = genotypes[5].words[0];
  fake_plan.fail_times = 1;
  fake_plan.fail_status = MO_ERR_NO_MEMORY;
  id = evaluate(service, genotypes, 10);
  CHECK(succeeds(service, id, &job)); /* once is forgiven */
  CHECK_INT(job.attempts, 1);
  CHECK(right(service, id, genotypes));
  genotypes = bodies(service, 11, 10);
  fake_plan.fail_word = genotypes[5].words[0];
  fake_plan.fail_times = 1000;
  id = evaluate(service, genotypes, 10);
  job = end_of(service, id);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.attempts, 3);
  CHECK_INT(job.error, MO_ERR_NO_MEMORY);
  CHECK(strstr(job.error_text, "out of memory") != NULL);
  stats = idle_stats(service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.jobs_failed, 1);
}

SERVICE_CASE(refuses_nan, 0)
{
  const struct mo_bits *genotypes;
  genotypes = bodies(service, 23, 4);
  for (int recorded = 0; recorded < 2; recorded++) {
    struct mo_evaluation_request request = service_request(genotypes, 4);
    struct mo_evaluation_results *results = NULL;
    struct mo_job job;
    int64_t id;
    request.record = recorded != 0 ? MO_RECORD_COM : 0;
    fake_plan.poison = true;
    id = service_submit(service, &request);
    job = end_of(service, id);
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK(strstr(job.error_text, "not a number") != NULL);
    CHECK_INT(job.rollouts_done, 0);
    REQUIRE(mo_store_results(service->fixture.store, id, &results) == MO_OK);
    CHECK(isnan(results->losses[0])); /* nothing there */
    mo_evaluation_results_free(results);
    fake_plan.poison = false;
  }
  CHECK_INT(computed(service), 0);
  CHECK_INT(mo_store_check(service->fixture.store, &service->fixture.message), MO_OK);
}

SERVICE_CASE(names_a_damaged_controller, 0)
{
  const struct mo_bits *genotypes;
  const char *digits = default_digits();
  struct mo_controller_record record;
  struct mo_job job;
  char path[512];
  genotypes = bodies(service, 24, 2);
  snprintf(path, sizeof(path), "%s/controllers/%s.safetensors", service->fixture.path, digits);
  CHECK_INT(truncate(path, 100), 0);
  job = end_of(service, evaluate(service, genotypes, 2));
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.error, MO_ERR_CORRUPT);
  CHECK(strstr(job.error_text, digits) != NULL && strstr(job.error_text, "PUT") != NULL);
  CHECK(strstr(job.error_text, "submit again") != NULL); /* to its end */
  CHECK_INT(warnings, 3);
  CHECK(has_warned(".safetensors"));
  /* As it says: */
  REQUIRE(fixture_controller(service->fixture.store, "again", 1, &record) == MO_OK);
  CHECK(succeeds(service, evaluate(service, genotypes, 2), NULL));
}

/* The save that fails holds the start of the job, or one of its errors, or neither. */
static void parks_what_cannot_be_saved(void)
{
  for (int round = 0; round < 3; round++) {
    struct service service;
    const struct mo_bits *genotypes;
    struct mo_evaluation_request request;
    struct mo_job job;
    int64_t id, fingerprint;
    REQUIRE(service_start(&service, 0) == MO_OK);
    genotypes = bodies(&service, 21, 4);
    fingerprint = service.jobs->classes.cpu[MO_FLOAT32];
    service.jobs->classes.cpu[MO_FLOAT32] = 999; /* no such row: the store refuses the losses */
    fake_plan.delay_us = round == 0 ? 0 : 250000;
    fake_plan.fail_word = genotypes[1].words[0];
    fake_plan.fail_times = 1000;
    fake_plan.fail_status = round == 1 ? MO_ERR_NO_MEMORY : 0;
    request = service_request(genotypes, 4);
    request.priority = round == 0 ? MO_INTERACTIVE : MO_BATCH;
    job = end_of(&service, service_submit(&service, &request));
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK_INT(job.attempts, 3);
    CHECK_INT(idle_stats(&service).open_jobs, 0);
    /* The others go on. */
    service.jobs->classes.cpu[MO_FLOAT32] = fingerprint;
    fake_plan.fail_status = 0;
    fake_plan.delay_us = 0;
    genotypes = bodies(&service, 19, 5);
    id = evaluate(&service, genotypes, 5);
    CHECK(succeeds(&service, id, NULL));
    CHECK(right(&service, id, genotypes));
    service_end(&service);
  }
}

SERVICE_CASE(blames_crashes_on_their_job, 0)
{
  const struct mo_bits *genotypes;
  struct mo_job job;
  char marker[512];
  int64_t id, other;
  int fd;
  genotypes = bodies(service, 12, 20);
  snprintf(marker, sizeof(marker), "%s/crash", service->fixture.path);
  service->config.crash_marker = marker;
  fake_plan.delay_us = 60000000;
  id = evaluate(service, genotypes, 10);
  other = evaluate(service, genotypes + 10, 10);
  for (int round = 1; round <= 3; round++) {
    CHECK(await_state(service, id, MO_JOB_RUNNING));
    /* A thread that is in no block writes nothing. */
    fd = open(marker, O_WRONLY | O_CREAT | O_APPEND, 0600);
    REQUIRE(fd >= 0);
    mo_jobs_crash_note(fd, SIGSEGV);
    CHECK_INT(lseek(fd, 0, SEEK_END), 0);
    dprintf(fd, "%lld %d\n", (long long)id, SIGSEGV); /* what a worker's handler writes */
    close(fd);
    service_close(service);
    /* Running in the file, or still queued: the start of a job is written some time after it. */
    service_set_states(service, id, other, round == 2 ? MO_JOB_QUEUED : MO_JOB_RUNNING);
    REQUIRE(service_open(service) == MO_OK);
    job = job_of(service, id);
    CHECK_INT(job.attempts, round);
  }
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK(strstr(job.error_text, "signal 11") != NULL);
  fake_plan.delay_us = 0;
  REQUIRE(service_reopen(service) == MO_OK); /* the marker was emptied: nobody is blamed */
  CHECK(succeeds(service, other, &job));
  CHECK_INT(job.attempts, 0);
}

static void waits_for_room(void)
{
  struct service service;
  const struct mo_bits *genotypes;
  int64_t id;
  REQUIRE(fault_vfs_register() == SQLITE_OK);
  REQUIRE(service_begin(&service) == MO_OK);
  service.vfs = "faults";
  REQUIRE(service_open(&service) == MO_OK);
  genotypes = bodies(&service, 13, 60);
  fake_plan.delay_us = 10000;
  id = evaluate(&service, genotypes, 50);
  CHECK(await_state(&service, id, MO_JOB_RUNNING));
  atomic_store(&fault_plan.writes_left, 0);
  atomic_store(&fault_plan.write_error, SQLITE_FULL);
  CHECK(AWAIT(stats_of(&service).no_space));
  CHECK_INT(evaluate(&service, genotypes + 50, 10), MO_ERR_NO_SPACE);
  CHECK_INT(state_of(&service, id), MO_JOB_RUNNING); /* reading goes on */
  usleep(300000);
  CHECK_INT(stats_of(&service).blocks_in_flight, 0); /* nothing is computed that cannot be kept */
  atomic_store(&fault_plan.write_error, 0);
  CHECK(succeeds(&service, id, NULL));
  CHECK(right(&service, id, genotypes));
  CHECK_INT(computed(&service), 500);
  CHECK(!stats_of(&service).no_space);
  CHECK(succeeds(&service, evaluate(&service, genotypes + 50, 10), NULL));
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  service_end(&service);
}

SERVICE_CASE(answers_from_its_cache_of_controllers, 0)
{
  enum { CONTROLLERS = 12 }; /* more than are kept ready */
  const struct mo_bits *genotypes;
  struct mo_evaluation_request request;
  struct mo_controller_record record;
  char name[32];
  int64_t ids[CONTROLLERS];
  genotypes = bodies(service, 14, 10);
  request = service_request(genotypes, 10);
  request.controller = name;
  request.precision = MO_FLOAT64;
  for (int i = 0; i < CONTROLLERS; i++) {
    snprintf(name, sizeof(name), "seed-%d", i);
    REQUIRE(fixture_controller(service->fixture.store, name, (uint64_t)(100 + i), &record) ==
            MO_OK);
    ids[i] = service_submit(service, &request);
  }
  for (int i = 0; i < CONTROLLERS; i++) {
    struct mo_controller *controller = weights_of((uint64_t)(100 + i));
    CHECK(succeeds(service, ids[i], NULL));
    CHECK(results_right(service, ids[i], genotypes, MO_FLOAT64, controller));
    mo_controller_free(controller);
  }
  CHECK_INT(computed(service), 100 * CONTROLLERS);
}

/* ---- many clients at once ---- */

struct client {
  struct service *service;
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
    request.priority = (int)(i % 2);
    if (mo_jobs_submit_evaluation(client->service->jobs, &request, &id, &replayed, NULL) != MO_OK) {
      client->failures++;
      continue;
    }
    if (i % 5 == 4) {
      (void)mo_jobs_cancel(client->service->jobs, id);
      continue;
    }
    for (uint32_t k = 0; k < i % 3; k++) { /* perhaps before its start is written */
      (void)mo_jobs_pause(client->service->jobs, id);
      (void)mo_jobs_resume(client->service->jobs, id);
    }
    if (!succeeds(client->service, id, NULL) || !right(client->service, id, request.genotypes))
      client->failures++;
  }
  return NULL;
}

SERVICE_CASE(serves_many_clients, 0)
{
  const struct mo_bits *genotypes;
  struct client clients[8];
  pthread_t threads[8];
  struct mo_jobs_stats stats;
  (void)default_weights();
  genotypes = bodies(service, 15, 90);
  fake_plan.delay_us = 400;
  for (uint32_t i = 0; i < 8; i++) {
    clients[i] = (struct client){service, genotypes, i, 0};
    REQUIRE(pthread_create(&threads[i], NULL, be_a_client, &clients[i]) == 0);
  }
  for (uint32_t i = 0; i < 8; i++) {
    pthread_join(threads[i], NULL);
    CHECK_INT(clients[i].failures, 0);
  }
  stats = idle_stats(service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK(stats.rollouts_computed <= 900);
  CHECK_INT(mo_store_check(service->fixture.store, &service->fixture.message), MO_OK);
}

static const struct check_case cases[] = {
    {"parks a job after three errors", parks_after_three_errors},
    {"names a damaged controller", names_a_damaged_controller},
    {"refuses losses that are not numbers", refuses_nan},
    {"parks a job whose losses cannot be saved", parks_what_cannot_be_saved},
    {"blames crashes on their job", blames_crashes_on_their_job},
    {"waits for room on the disk", waits_for_room},
    {"keeps few controllers ready", answers_from_its_cache_of_controllers},
    {"serves many clients at once", serves_many_clients},
};
CHECK_MAIN(cases)
