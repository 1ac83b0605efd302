/* trouble.c: the scheduler with a fake back end: what it refuses, and what becomes of jobs when
 * something breaks. */
#include <fcntl.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <sqlite3.h>

#include "../check.h"
#include "../store/fault_vfs.h"
#include "jobs/state.h"
#include "service.h"
#include "watch.h"

static void refuses(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes, apart = {{0}};
  struct mo_evaluation_request request, bad;
  struct mo_environment environment;
  int64_t id = 0, again = 0;
  bool replayed = false;
  REQUIRE(service_start(&service) == MO_OK);
  service_close(&service);
  service.config.max_open_jobs = 2;
  service.config.max_open_rollouts = 300;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(9, 40, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 20000;
  request = service_request(genotypes, 20);
  request.idempotency_key = "k";
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, NULL), MO_OK);
  bad = service_request(genotypes + 20, 20);
  CHECK_INT(
      mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, &service.fixture.message),
      MO_ERR_BUSY);
  bad.n_designs = 1;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_OK);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_BUSY);
  /* A known key is answered even now. */
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &again, &replayed, NULL), MO_OK);
  CHECK(replayed && again == id);
  mo_sha256_of("x", 1, &request.body_sha256);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &again, &replayed, NULL),
            MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  bad = service_request(genotypes, 1);
  bad.controller = "nobody";
  CHECK_INT(
      mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, &service.fixture.message),
      MO_ERR_NOT_FOUND);
  CHECK(strstr(service.fixture.message.text, "nobody") != NULL);
  bad = service_request(genotypes, 1);
  bad.environment_set = "elsewhere";
  CHECK_INT(
      mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, &service.fixture.message),
      MO_ERR_NOT_FOUND);
  bad = service_request(genotypes, 0);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_RANGE);
  bad = service_request(&apart, 1);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_INVALID);
  apart.words[0] = 0x8001;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_INVALID);
  bad = service_request(genotypes, 1);
  bad.environment_set = NULL;
  bad.environments = &environment;
  bad.n_environments = 1;
  mo_environment_training(1, 0, 0, &environment);
  environment.terrain_heights_m[5] = NAN;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_INVALID);
  bad = service_request(genotypes, 1);
  bad.physics.dt_s = -1;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_RANGE);
  bad = service_request(genotypes, 1);
  bad.record_com = true;
  bad.record_stride = 0;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_RANGE);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void parks_after_three_errors(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_jobs_stats stats;
  struct mo_job job;
  int64_t id;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(10, 10, &forms, &genotypes) == MO_OK);
  fake_plan.fail_word = genotypes[5].words[0];
  fake_plan.fail_times = 1;
  fake_plan.fail_status = MO_ERR_NO_MEMORY;
  request = service_request(genotypes, 10);
  id = service_submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED); /* once is forgiven */
  CHECK_INT(job.attempts, 1);
  CHECK(right(&service, id, genotypes));
  free(forms);
  free(genotypes);
  REQUIRE(fixture_bodies(11, 10, &forms, &genotypes) == MO_OK);
  fake_plan.fail_word = genotypes[5].words[0];
  fake_plan.fail_times = 1000;
  request = service_request(genotypes, 10);
  id = service_submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.attempts, 3);
  CHECK_INT(job.error, MO_ERR_NO_MEMORY);
  CHECK(strstr(job.error_text, "out of memory") != NULL);
  stats = idle_stats(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.jobs_failed, 1);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void refuses_nan(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(23, 4, &forms, &genotypes) == MO_OK);
  for (int recorded = 0; recorded < 2; recorded++) {
    struct mo_evaluation_request request = service_request(genotypes, 4);
    struct mo_evaluation_results *results = NULL;
    struct mo_job job;
    int64_t id;
    request.record_com = recorded != 0;
    fake_plan.poison = true;
    id = service_submit(&service, &request);
    REQUIRE(await_end(service.jobs, id, 15000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK(strstr(job.error_text, "not a number") != NULL);
    CHECK_INT(job.rollouts_done, 0);
    REQUIRE(mo_store_results(service.fixture.store, id, &results) == MO_OK);
    CHECK(isnan(results->losses[0])); /* nothing there */
    mo_evaluation_results_free(results);
    fake_plan.poison = false;
  }
  CHECK_INT(computed(&service), 0);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static atomic_int damaged_controllers;

static void keep_warning_text(void *context, int64_t job, int error, const char *text)
{
  (void)context;
  (void)job;
  if (error == MO_ERR_CORRUPT && strstr(text, ".safetensors") != NULL)
    atomic_fetch_add(&damaged_controllers, 1);
}

static void names_a_damaged_controller(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_controller_record record;
  struct mo_job job;
  char digits[MO_SHA256_DIGITS + 1], path[512];
  int64_t id;
  REQUIRE(service_start(&service) == MO_OK);
  service_close(&service);
  service.config.warn = keep_warning_text;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(24, 2, &forms, &genotypes) == MO_OK);
  REQUIRE(mo_store_controller(service.fixture.store, "default", &record) == MO_OK);
  mo_sha256_to_hex(&record.sha256, digits);
  snprintf(path, sizeof(path), "%s/controllers/%s.safetensors", service.fixture.path, digits);
  CHECK_INT(truncate(path, 100), 0);
  atomic_store(&damaged_controllers, 0);
  request = service_request(genotypes, 2);
  id = service_submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 15000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.error, MO_ERR_CORRUPT);
  CHECK(strstr(job.error_text, digits) != NULL && strstr(job.error_text, "PUT") != NULL);
  CHECK(strstr(job.error_text, "submit again") != NULL); /* to its end */
  CHECK_INT(atomic_load(&damaged_controllers), 3);
  /* As it says: */
  REQUIRE(fixture_controller(service.fixture.store, "again", 1, &record) == MO_OK);
  id = service_submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 15000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  free(forms);
  free(genotypes);
  service_end(&service);
}

/* The save that fails holds the start of the job, or one of its errors, or neither. */
static void parks_what_cannot_be_saved(void)
{
  for (int round = 0; round < 3; round++) {
    struct service service;
    struct mo_bits *forms, *genotypes;
    struct mo_evaluation_request request;
    struct mo_jobs_stats stats;
    struct mo_job job;
    int64_t id, fingerprint;
    REQUIRE(service_start(&service) == MO_OK);
    REQUIRE(fixture_bodies(21, 4, &forms, &genotypes) == MO_OK);
    fingerprint = service.jobs->classes.cpu[MO_FLOAT32];
    service.jobs->classes.cpu[MO_FLOAT32] = 999; /* no such row: the store refuses the losses */
    fake_plan.delay_us = round == 0 ? 0 : 250000;
    fake_plan.fail_word = genotypes[1].words[0];
    fake_plan.fail_times = 1000;
    fake_plan.fail_status = round == 1 ? MO_ERR_NO_MEMORY : 0;
    request = service_request(genotypes, 4);
    request.priority = round == 0 ? MO_INTERACTIVE : MO_BATCH;
    id = service_submit(&service, &request);
    REQUIRE(await_end(service.jobs, id, 15000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK_INT(job.attempts, 3);
    stats = idle_stats(&service);
    CHECK_INT(stats.open_jobs, 0);
    /* The others go on. */
    service.jobs->classes.cpu[MO_FLOAT32] = fingerprint;
    fake_plan.fail_status = 0;
    fake_plan.delay_us = 0;
    free(forms);
    free(genotypes);
    REQUIRE(fixture_bodies(19, 5, &forms, &genotypes) == MO_OK);
    request = service_request(genotypes, 5);
    id = service_submit(&service, &request);
    REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_SUCCEEDED);
    CHECK(right(&service, id, genotypes));
    free(forms);
    free(genotypes);
    service_end(&service);
  }
}

static void blames_crashes_on_their_job(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  char marker[512];
  int64_t id, other;
  int fd;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(12, 20, &forms, &genotypes) == MO_OK);
  snprintf(marker, sizeof(marker), "%s/crash", service.fixture.path);
  service.config.crash_marker = marker;
  fake_plan.delay_us = 60000000;
  request = service_request(genotypes, 10);
  id = service_submit(&service, &request);
  request = service_request(genotypes + 10, 10);
  other = service_submit(&service, &request);
  for (int round = 1; round <= 3; round++) {
    CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
    /* A thread that is in no block writes nothing. */
    fd = open(marker, O_WRONLY | O_CREAT | O_APPEND, 0600);
    REQUIRE(fd >= 0);
    mo_jobs_crash_note(fd, SIGSEGV);
    CHECK_INT(lseek(fd, 0, SEEK_END), 0);
    dprintf(fd, "%lld %d\n", (long long)id, SIGSEGV); /* what a worker's handler writes */
    close(fd);
    service_close(&service);
    {
      /* As if it had been killed: running in the file, or still queued: the start of a job is
       * written some time after it. */
      char path[512], sql[128];
      sqlite3 *db = NULL;
      snprintf(path, sizeof(path), "%s/morphod.db", service.fixture.path);
      snprintf(sql, sizeof(sql), "UPDATE jobs SET state=%d WHERE id IN (%lld,%lld)",
               round == 2 ? 0 : 1, (long long)id, (long long)other);
      REQUIRE(sqlite3_open(path, &db) == SQLITE_OK);
      CHECK_INT(sqlite3_exec(db, sql, NULL, NULL, NULL), SQLITE_OK);
      sqlite3_close(db);
    }
    REQUIRE(service_open(&service) == MO_OK);
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.attempts, round);
  }
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK(strstr(job.error_text, "signal 11") != NULL);
  fake_plan.delay_us = 0;
  service_close(&service);
  REQUIRE(service_open(&service) == MO_OK); /* the marker was emptied: nobody is blamed */
  REQUIRE(await_end(service.jobs, other, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.attempts, 0);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void waits_for_room(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_jobs_stats stats;
  struct mo_job job;
  int64_t id, other;
  bool replayed;
  REQUIRE(fault_vfs_register() == SQLITE_OK);
  REQUIRE(service_start(&service) == MO_OK);
  service_close(&service);
  service.vfs = "faults";
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(13, 60, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 10000;
  request = service_request(genotypes, 50);
  id = service_submit(&service, &request);
  CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
  atomic_store(&fault_plan.writes_left, 0);
  atomic_store(&fault_plan.write_error, SQLITE_FULL);
  for (int i = 0; i < 2000; i++) {
    mo_jobs_get_stats(service.jobs, &stats);
    if (stats.no_space)
      break;
    usleep(1000);
  }
  CHECK(stats.no_space);
  request = service_request(genotypes + 50, 10);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &other, &replayed,
                                      &service.fixture.message),
            MO_ERR_NO_SPACE);
  CHECK_INT(state_of(&service, id), MO_JOB_RUNNING); /* reading goes on */
  usleep(300000);
  mo_jobs_get_stats(service.jobs, &stats);
  CHECK_INT(stats.blocks_in_flight, 0); /* nothing is computed that cannot be kept */
  atomic_store(&fault_plan.write_error, 0);
  REQUIRE(await_end(service.jobs, id, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK(right(&service, id, genotypes));
  CHECK_INT(computed(&service), 500);
  mo_jobs_get_stats(service.jobs, &stats);
  CHECK(!stats.no_space);
  other = service_submit(&service, &request);
  REQUIRE(await_end(service.jobs, other, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void answers_from_its_cache_of_controllers(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_controller_record record;
  struct mo_job job;
  char names[5][32];
  int64_t ids[5];
  REQUIRE(service_start(&service) == MO_OK);
  service_close(&service);
  service.config.controllers_kept = 2;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(14, 10, &forms, &genotypes) == MO_OK);
  for (int i = 0; i < 5; i++) {
    snprintf(names[i], sizeof(names[i]), "seed-%d", i);
    REQUIRE(fixture_controller(service.fixture.store, names[i], (uint64_t)(100 + i), &record) ==
            MO_OK);
  }
  for (int i = 0; i < 5; i++) {
    request = service_request(genotypes, 10);
    request.controller = names[i];
    request.precision = MO_FLOAT64;
    ids[i] = service_submit(&service, &request);
    REQUIRE(ids[i] > 0);
  }
  for (int i = 0; i < 5; i++) {
    struct mo_controller *controller = NULL;
    struct mo_physics physics = mo_default_physics();
    REQUIRE(await_end(service.jobs, ids[i], 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
    REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) ==
            MO_OK);
    mo_controller_randomize(controller, (uint64_t)(100 + i));
    CHECK(service_results_right(&service, ids[i], genotypes, &physics, MO_FLOAT64, controller));
    mo_controller_free(controller);
  }
  CHECK_INT(computed(&service), 500);
  free(forms);
  free(genotypes);
  service_end(&service);
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
    struct mo_job job;
    int64_t id = 0;
    bool replayed = false;
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
    if (await_end(client->service->jobs, id, 20000, &job) != MO_OK ||
        job.state != MO_JOB_SUCCEEDED || !right(client->service, id, request.genotypes))
      client->failures++;
  }
  return NULL;
}

static void serves_many_clients(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct client clients[8];
  pthread_t threads[8];
  struct mo_jobs_stats stats;
  (void)default_weights();
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(15, 90, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 400;
  for (uint32_t i = 0; i < 8; i++) {
    clients[i] = (struct client){&service, genotypes, i, 0};
    REQUIRE(pthread_create(&threads[i], NULL, be_a_client, &clients[i]) == 0);
  }
  for (uint32_t i = 0; i < 8; i++) {
    pthread_join(threads[i], NULL);
    CHECK_INT(clients[i].failures, 0);
  }
  stats = idle_stats(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK(stats.rollouts_computed <= 900);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static const struct check_case cases[] = {
    {"refuses what it must", refuses},
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
