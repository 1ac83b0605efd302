/* crash.c: a process is killed with SIGKILL at random moments, again and again, until all its work
 * is done.
 *
 * A child opens the state folder, submits evaluations, notes each in a file once it is
 * acknowledged, and computes (with the fake back end). The parent kills it, checks the database,
 * and starts the next child. At the end every acknowledged job has succeeded, its losses are those
 * of an undisturbed run, and no row is there twice.
 *
 * MORPHO_CRASH_KILLS: how many times at least (default 20). */
#include <fcntl.h>
#include <signal.h>
#include <sqlite3.h>
#include <sys/wait.h>

#include "../check.h"
#include "service.h"

#define BODIES      400
#define SUBMISSIONS 60

/* What submission number i asks for. */
static struct mo_evaluation_request request_of(int i, const struct mo_bits *genotypes, char *key,
                                               size_t key_size)
{
  uint32_t n = i % 7 == 0 ? 40 : (uint32_t)(1 + i % 9);
  struct mo_evaluation_request request = service_request(genotypes + (i * 37) % (BODIES - 40), n);
  snprintf(key, key_size, "submission-%d", i);
  request.idempotency_key = key;
  request.verify = i % 11 == 10;
  request.record_com = i % 13 == 12;
  return request;
}

/* Never returns: killed from outside, or done. */
static void live(const char *path, const struct mo_bits *genotypes, const char *log_path)
{
  struct service service;
  char key[64];
  int log = open(log_path, O_RDWR | O_CREAT | O_APPEND, 0600);
  int acknowledged = (int)(lseek(log, 0, SEEK_END) / (off_t)sizeof(int64_t));
  memset(&service, 0, sizeof(service));
  snprintf(service.fixture.path, sizeof(service.fixture.path), "%s", path);
  fake_plan.delay_us = 1000;
  if (log < 0 || service_open(&service) != MO_OK) {
    fprintf(stderr, "# child: %s\n", service.fixture.message.text);
    _exit(3);
  }
  for (int i = acknowledged; i < SUBMISSIONS; i++) {
    struct mo_evaluation_request request = request_of(i, genotypes, key, sizeof(key));
    int64_t id = 0;
    bool replayed;
    if (mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, NULL) != MO_OK)
      _exit(4);
    if (write(log, &id, sizeof(id)) != (ssize_t)sizeof(id))
      _exit(5);
    if (i % 4 == 3)
      usleep(10000);
  }
  for (;;) {
    struct mo_jobs_stats stats;
    mo_jobs_get_stats(service.jobs, &stats);
    if (stats.open_jobs == 0)
      break;
    usleep(1000);
  }
  service_close(&service);
  _exit(0);
}

static int64_t query(const char *path, const char *sql)
{
  char name[512];
  sqlite3 *db = NULL;
  sqlite3_stmt *statement = NULL;
  int64_t value = -1;
  snprintf(name, sizeof(name), "%s/morphod.db", path);
  if (sqlite3_open_v2(name, &db, SQLITE_OPEN_READWRITE, NULL) == SQLITE_OK &&
      sqlite3_prepare_v2(db, sql, -1, &statement, NULL) == SQLITE_OK &&
      sqlite3_step(statement) == SQLITE_ROW)
    value = sqlite3_column_type(statement, 0) == SQLITE_TEXT
                ? strcmp((const char *)sqlite3_column_text(statement, 0), "ok") == 0
                : sqlite3_column_int64(statement, 0);
  sqlite3_finalize(statement);
  sqlite3_close(db);
  return value;
}

static void check_end(const char *path, const struct mo_bits *genotypes, const char *log_path)
{
  struct service service;
  struct mo_controller *weights = NULL;
  struct mo_physics physics = mo_default_physics();
  int64_t ids[SUBMISSIONS] = {0};
  char key[64];
  int log = open(log_path, O_RDONLY);
  REQUIRE(read(log, ids, sizeof(ids)) == (ssize_t)sizeof(ids));
  close(log);
  CHECK_INT(query(path, "PRAGMA integrity_check"), 1);
  CHECK_INT(query(path, "SELECT count(*) FROM jobs"),
            SUBMISSIONS); /* a key makes one job, whatever was killed */
  CHECK_INT(query(path, "SELECT count(*) FROM jobs WHERE state=3"), SUBMISSIONS);
  CHECK_INT(query(path, "SELECT count(*) FROM jobs WHERE attempts>0"), 0);
  CHECK_INT(query(path, "SELECT count(*) FROM events WHERE type='job.created'"), SUBMISSIONS);
  CHECK_INT(query(path, "SELECT count(*) FROM events WHERE type='job.finished'"), SUBMISSIONS);
  CHECK_INT(query(path, "SELECT count(*) FROM evaluations WHERE done<>n_designs*n_environments"),
            0);
  CHECK_INT(query(path, "SELECT count(*) FROM (SELECT job,position FROM job_designs GROUP "
                        "BY 1,2 HAVING count(*)>1)"),
            0);
  memset(&service, 0, sizeof(service));
  snprintf(service.fixture.path, sizeof(service.fixture.path), "%s", path);
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &weights) == MO_OK);
  mo_controller_randomize(weights, 1);
  for (int i = 0; i < SUBMISSIONS; i++) {
    struct mo_evaluation_request request = request_of(i, genotypes, key, sizeof(key));
    struct mo_evaluation_results *results = NULL;
    struct mo_trajectory *trajectory = NULL;
    CHECK(
        service_results_right(&service, ids[i], request.genotypes, &physics, MO_FLOAT32, weights));
    if (request.record_com) {
      CHECK_INT(
          mo_store_trajectory(service.fixture.store, ids[i], request.n_designs - 1, 9, &trajectory),
          MO_OK);
      mo_trajectory_free(trajectory);
    }
    if (request.verify && mo_store_results(service.fixture.store, ids[i], &results) == MO_OK) {
      for (uint32_t n = 0; n < results->n_designs; n++)
        CHECK_INT(results->agrees[n], 1);
      mo_evaluation_results_free(results);
    }
  }
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  mo_controller_free(weights);
  service_close(&service);
}

static void loses_nothing(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  const char *text = getenv("MORPHO_CRASH_KILLS");
  int wanted = text != NULL ? atoi(text) : 20;
  int kills = 0, lives = 0;
  unsigned random = 12345;
  char log_path[512];
  REQUIRE(fixture_bodies(21, BODIES, &forms, &genotypes) == MO_OK);
  while (kills < wanted) {
    int status = -1;
    REQUIRE(fixture_folder(&fixture) == 0);
    snprintf(log_path, sizeof(log_path), "%s/acknowledged", fixture.path);
    for (;;) {
      pid_t child = fork();
      if (child == 0)
        live(fixture.path, genotypes, log_path);
      REQUIRE(child > 0);
      lives++;
      random = random * 1103515245U + 12345U;
      usleep(5000 + (random >> 8) %
                        (lives % 3 == 0 ? 300000 : 60000)); /* losses of batch jobs wait 100 ms */
      if (kills < wanted) {
        kill(child, SIGKILL);
        REQUIRE(waitpid(child, &status, 0) == child);
        if (WIFSIGNALED(status))
          kills++;
      } else {
        REQUIRE(waitpid(child, &status, 0) == child);
      }
      if (WIFEXITED(status))
        break;
      CHECK(query(fixture.path, "PRAGMA integrity_check") != 0);
    }
    CHECK_INT(WEXITSTATUS(status), 0);
    check_end(fixture.path, genotypes, log_path);
    fixture_remove(fixture.path);
  }
  printf("# killed %d times in %d lives\n", kills, lives);
  free(forms);
  free(genotypes);
}

static const struct check_case cases[] = {{"loses nothing that it acknowledged", loses_nothing}};
CHECK_MAIN(cases)
