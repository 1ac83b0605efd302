/* trainings.c: what the store keeps of trainings, and the way there from a database without them. */
#include <dirent.h>
#include <fcntl.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <sqlite3.h>
#include <stdatomic.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <time.h>

#include "../check.h"
#include "fixture.h"
#include "store/trainings.h"

static const struct mo_job_query any_job = {.state = -1, .kind = -1};

static struct mo_training_submission submission_of(uint32_t n_steps)
{
  return (struct mo_training_submission){.record = {.settings = {.kind = MO_TRAINING_PRETRAIN,
                                                                 .seed = UINT64_C(0xFEDCBA9876543210),
                                                                 .n_steps = n_steps,
                                                                 .batch = 16,
                                                                 .schedule = {.kind = MO_SCHEDULE_RESTARTS,
                                                                              .peak = 1e-3,
                                                                              .floor = 1e-5,
                                                                              .decay = 0.7,
                                                                              .cycle_steps = 10,
                                                                              .cycle_growth = 2,
                                                                              .warmup_steps = 3},
                                                                 .beta1 = 0.9,
                                                                 .beta2 = 0.999,
                                                                 .epsilon = 1e-8,
                                                                 .norm_limit = 1,
                                                                 .adjoint_bound = 2,
                                                                 .physics = mo_default_physics(),
                                                                 .sensor = MO_SENSOR_INVERSE_SQUARE,
                                                                 .held_out_designs = 5,
                                                                 .held_out_environments = 7},
                                                    .name = "walker",
                                                    .validate_every_steps = 11,
                                                    .checkpoint_every_steps = 12,
                                                    .checkpoint_every_s = 13,
                                                    .checkpoints_kept = 2},
                                         .priority = MO_BATCH,
                                         .label = "a label"};
}

static int64_t submit(struct fixture *fixture, const struct mo_training_submission *submission)
{
  int64_t id = 0;
  bool replayed = true;
  int error = mo_store_submit_training(fixture->store, submission, &id, &replayed);
  return error != MO_OK ? error : id;
}

static enum mo_job_state state_of(struct fixture *fixture, int64_t id)
{
  struct mo_job job = {.state = MO_JOB_FAILED};
  (void)mo_store_job(fixture->store, id, &job);
  return job.state;
}

static bool same_settings(const struct mo_training_settings *a, const struct mo_training_settings *b)
{
  return a->kind == b->kind && a->seed == b->seed && a->n_steps == b->n_steps && a->batch == b->batch &&
         a->schedule.kind == b->schedule.kind && a->schedule.peak == b->schedule.peak &&
         a->schedule.floor == b->schedule.floor && a->schedule.decay == b->schedule.decay &&
         a->schedule.cycle_steps == b->schedule.cycle_steps && a->schedule.cycle_growth == b->schedule.cycle_growth &&
         a->schedule.warmup_steps == b->schedule.warmup_steps && a->beta1 == b->beta1 && a->beta2 == b->beta2 &&
         a->epsilon == b->epsilon && a->norm_limit == b->norm_limit && a->adjoint_bound == b->adjoint_bound &&
         a->physics.n_steps == b->physics.n_steps && a->physics.dt_s == b->physics.dt_s &&
         a->physics.bisections == b->physics.bisections && a->sensor == b->sensor &&
         a->held_out_designs == b->held_out_designs && a->held_out_environments == b->held_out_environments;
}

static struct mo_training_step_row row_of(uint32_t step)
{
  return (struct mo_training_step_row){.report = {.step = step,
                                                  .mean_loss = step == 3 ? NAN : 1.0 / (step + 2),
                                                  .rate = 1e-3 / step,
                                                  .gradient_norm = 0.1 * step,
                                                  .clipped_share = 0.25,
                                                  .clipped_robots_share = 0.5,
                                                  .diverged = step,
                                                  .zeroed = step + 1,
                                                  .skipped = step == 3,
                                                  .bounded = step + 2},
                                       .seconds = 0.125};
}

/* ---- cases ---- */

static char *read_text(const char *path)
{
  FILE *file = fopen(path, "r");
  char *text = calloc(1, 1 << 16);
  if (file == NULL || text == NULL || fread(text, 1, (1 << 16) - 1, file) == 0) {
    free(text);
    text = NULL;
  }
  if (file != NULL)
    fclose(file);
  return text;
}

/* Makes the database one of schema `version` with the same data: the first migrations alone, and of every row what it had then. */
static int downgrade(const struct fixture *fixture, int version)
{
  static const char *const files[] = {"0001_initial", "0002_trainings"};
  char now[512], old[512], migration[512], sql[1024];
  sqlite3 *db = NULL;
  sqlite3_stmt *tables = NULL;
  int result;
  snprintf(now, sizeof(now), "%s/morphod.db", fixture->path);
  snprintf(old, sizeof(old), "%s/old.db", fixture->path);
  result = sqlite3_open(old, &db);
  for (int i = 0; i < version && result == SQLITE_OK; i++) {
    snprintf(migration, sizeof(migration), "%s/schema/migrations/%s.sql", getenv("MORPHO_SOURCE_DIR"), files[i]);
    char *schema = read_text(migration);
    result = schema != NULL ? sqlite3_exec(db, schema, NULL, NULL, NULL) : SQLITE_CANTOPEN;
    free(schema);
  }
  snprintf(sql, sizeof(sql), "PRAGMA application_id=%d; PRAGMA user_version=%d; ATTACH '%s' AS new", 0x6D727068,
           version, now);
  if (result == SQLITE_OK)
    result = sqlite3_exec(db, sql, NULL, NULL, NULL);
  if (result == SQLITE_OK)
    result = sqlite3_prepare_v2(
        db,
        "SELECT t.name,group_concat(c.name) FROM main.sqlite_schema t, pragma_table_info(t.name,'main') c"
        " WHERE t.type='table' AND t.name NOT LIKE 'sqlite%' GROUP BY t.name",
        -1, &tables, NULL);
  while (result == SQLITE_OK && sqlite3_step(tables) == SQLITE_ROW) {
    const char *table = (const char *)sqlite3_column_text(tables, 0);
    const char *columns = (const char *)sqlite3_column_text(tables, 1);
    snprintf(sql, sizeof(sql), "INSERT INTO main.%s(%s) SELECT %s FROM new.%s", table, columns, columns, table);
    result = sqlite3_exec(db, sql, NULL, NULL, NULL);
  }
  sqlite3_finalize(tables);
  sqlite3_close(db);
  return result == SQLITE_OK && rename(old, now) == 0 ? SQLITE_OK : SQLITE_ERROR;
}

static void migrates_an_old_database(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission evaluation;
  struct mo_training_submission training = submission_of(10);
  struct mo_training_status status;
  struct mo_evaluation_results *results = NULL;
  struct mo_job job;
  uint64_t n_designs = 0;
  int64_t id = 0, trained;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(5, 20, &forms, &genotypes) == MO_OK);
  evaluation = fixture_submission(forms, genotypes, 20);
  evaluation.label = "from before";
  REQUIRE(mo_store_submit(fixture.store, &evaluation, &id, &replayed) == MO_OK);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(downgrade(&fixture, 1) == SQLITE_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  CHECK_INT(mo_store_job(fixture.store, id, &job), MO_OK);
  CHECK_TEXT(job.label, "from before");
  CHECK(job.weight == 1);
  CHECK_INT(job.n_designs, 20);
  CHECK_INT(job.kind, MO_JOB_EVALUATION);
  CHECK_INT(mo_store_design_count(fixture.store, &n_designs), MO_OK);
  CHECK_INT(n_designs, 20);
  CHECK_INT(mo_store_results(fixture.store, id, &results), MO_OK);
  CHECK(results != NULL && memcmp(results->genotypes, genotypes, 20 * sizeof(*genotypes)) == 0);
  mo_evaluation_results_free(results);
  trained = submit(&fixture, &training);
  CHECK(trained > id);
  CHECK_INT(mo_store_training(fixture.store, trained, &status), MO_OK);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_ERR_NOT_FOUND);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

/* A training that was begun before fingerprints were kept goes on, and says that it does not know. */
static void migrates_a_training(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100);
  struct mo_training_step_row row = row_of(1);
  struct mo_training_lineage lineage;
  struct mo_training_status status;
  struct mo_event event;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int64_t id, fresh, newest = 0;
  REQUIRE(fixture_start(&fixture) == 0);
  id = submit(&fixture, &submission);
  fresh = submit(&fixture, &submission);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  REQUIRE(mo_store_training_progress(fixture.store, id, &row, 1, NULL, NULL) == MO_OK);
  REQUIRE(mo_store_training_checkpoint(fixture.store, id, 1, (const uint8_t *)"one", 3, 2) == MO_OK);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(downgrade(&fixture, 2) == SQLITE_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  CHECK(size == 3 && memcmp(bytes, "one", 3) == 0);
  free(bytes);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK(status.code.n == 1 && status.code.codes[0].from_step == 0 && status.code.codes[0].fingerprint[0] == '\0');
  CHECK_INT(mo_store_training(fixture.store, fresh, &status), MO_OK);
  CHECK_INT(status.code.n, 0);
  CHECK_INT(mo_store_requeue(fixture.store, 0, 3, ""), MO_OK);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_code(fixture.store, id, 1, "now", &lineage), MO_OK);
  CHECK(lineage.n == 2 && lineage.codes[1].from_step == 1 && strcmp(lineage.codes[1].fingerprint, "now") == 0);
  for (int64_t after = 0; mo_store_events(fixture.store, after, id, &event, 1, NULL, NULL) == 1; after = newest)
    newest = event.sequence;
  CHECK_TEXT(event.type, "training.code_changed");
  CHECK(strstr(event.data, "\"before\":null") != NULL);
  fixture_end(&fixture);
}

static void submits_and_reads_back(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes, *found = NULL;
  struct mo_training_submission submission = submission_of(1000), tune = submission_of(60);
  struct mo_training_status status, page[5];
  struct mo_controller_record record;
  struct mo_controller *small = NULL;
  struct mo_job job, jobs[5];
  uint64_t counts[MO_JOB_STATES];
  uint8_t *bytes = NULL;
  size_t size = 0;
  int64_t id, second, again = 0;
  bool replayed = false, created;
  uint32_t n = 0;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(5, 20, &forms, &genotypes) == MO_OK);
  submission.idempotency_key = "key";
  id = submit(&fixture, &submission);
  REQUIRE(id > 0);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK(same_settings(&status.record.settings, &submission.record.settings));
  CHECK_TEXT(status.record.name, "walker");
  CHECK(!status.record.has_parent && !status.has_validation && !status.has_result);
  CHECK_INT(status.record.validate_every_steps, 11);
  CHECK_INT(status.record.checkpoint_every_steps, 12);
  CHECK_INT(status.record.checkpoint_every_s, 13);
  CHECK_INT(status.record.checkpoints_kept, 2);
  CHECK_INT(status.job.kind, MO_JOB_TRAINING);
  CHECK_TEXT(mo_job_kind_name(status.job.kind), "training");
  CHECK_INT(status.job.state, MO_JOB_QUEUED);
  CHECK_TEXT(status.job.label, "a label");
  CHECK_INT(status.job.steps_total, 1000);
  CHECK_INT(status.job.rollouts_total, 0);
  CHECK_INT(status.step, 0);
  CHECK_INT(status.checkpoint_step, 0);
  /* The same key again. */
  CHECK_INT(mo_store_submit_training(fixture.store, &submission, &again, &replayed), MO_OK);
  CHECK(replayed && again == id);
  mo_sha256_of("x", 1, &submission.body_sha256);
  CHECK_INT(mo_store_submit_training(fixture.store, &submission, &again, &replayed), MO_ERR_CONFLICT);
  /* With a parent and designs. */
  tune.record.settings.kind = MO_TRAINING_FINETUNE;
  tune.record.n_designs = 20;
  tune.record.name[0] = '\0';
  tune.forms = forms;
  tune.genotypes = genotypes;
  tune.parent = "default";
  second = submit(&fixture, &tune);
  REQUIRE(second > id);
  CHECK_INT(mo_store_training(fixture.store, second, &status), MO_OK);
  CHECK_INT(mo_store_controller(fixture.store, "default", &record), MO_OK);
  CHECK(status.record.has_parent && mo_sha256_equal(&status.record.parent_sha256, &record.sha256));
  CHECK_TEXT(status.record.parent_name, "default");
  CHECK_INT(status.record.settings.sensor, MO_SENSOR_INVERSE_SQRT); /* the parent's */
  CHECK_INT(mo_store_training_designs(fixture.store, second, &found, &n), MO_OK);
  CHECK_INT(n, 20);
  CHECK(found != NULL && memcmp(found, genotypes, 20 * sizeof(*found)) == 0);
  free(found);
  CHECK_INT(mo_store_training_designs(fixture.store, second + 1, &found, &n), MO_ERR_NOT_FOUND);
  tune.parent = "nobody";
  CHECK_INT(submit(&fixture, &tune), MO_ERR_NOT_FOUND);
  REQUIRE(mo_controller_create((struct mo_workspace){2, 2, 2}, MO_SENSOR_INVERSE_SQRT, &small) == MO_OK);
  REQUIRE(mo_controller_encode(small, &bytes, &size) == MO_OK);
  REQUIRE(mo_store_controller_put(fixture.store, "small", bytes, size, small, &record, &created) == MO_OK);
  free(bytes);
  mo_controller_free(small);
  tune.parent = "small";
  CHECK_INT(submit(&fixture, &tune), MO_ERR_UNSUPPORTED);
  /* Lists. */
  CHECK_INT(mo_store_trainings(fixture.store, &any_job, page, 5), 2);
  CHECK(page[0].job.id == second && page[1].job.id == id);
  CHECK_INT(
      mo_store_trainings(fixture.store, &(struct mo_job_query){.before = second, .state = MO_JOB_QUEUED}, page, 5), 1);
  CHECK_INT(mo_store_trainings(fixture.store, &(struct mo_job_query){.state = MO_JOB_RUNNING}, page, 5), 0);
  CHECK_INT(mo_store_jobs(fixture.store, &any_job, jobs, 5), 2);
  CHECK_INT(mo_store_jobs(fixture.store, &(struct mo_job_query){.state = -1, .kind = MO_JOB_TRAINING}, jobs, 5), 2);
  CHECK_INT(mo_store_jobs(fixture.store, &(struct mo_job_query){.state = -1, .kind = MO_JOB_EVALUATION}, jobs, 5), 0);
  CHECK_INT(mo_store_job_counts(fixture.store, counts), MO_OK);
  CHECK_INT(counts[MO_JOB_QUEUED], 2);
  CHECK_INT(mo_store_job(fixture.store, second, &job), MO_OK);
  CHECK_TEXT(job.controller_name, "default");
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void keeps_the_queues_apart(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission evaluation;
  struct mo_training_submission training = submission_of(10);
  struct mo_evaluation_results *results = NULL;
  struct mo_work *work = NULL;
  int64_t ids[5] = {0}, first, second, id = 0;
  uint64_t jobs = 0, rollouts = 0;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(5, 3, &forms, &genotypes) == MO_OK);
  evaluation = fixture_submission(forms, genotypes, 3);
  first = submit(&fixture, &training);
  REQUIRE(mo_store_submit(fixture.store, &evaluation, &id, &replayed) == MO_OK);
  second = submit(&fixture, &training);
  CHECK_INT(mo_store_queued(fixture.store, MO_BATCH, 0, ids, 5), 1);
  CHECK_INT(ids[0], id);
  CHECK_INT(mo_store_queued_trainings(fixture.store, ids, 5), 2);
  CHECK(ids[0] == first && ids[1] == second);
  CHECK_INT(mo_store_open_work(fixture.store, &jobs, &rollouts), MO_OK);
  CHECK_INT(jobs, 3);
  CHECK_INT(rollouts, 30);
  CHECK_INT(mo_store_load_work(fixture.store, first, &work), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_results(fixture.store, first, &results), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_training_start(fixture.store, id), MO_ERR_CONFLICT);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void keeps_the_curve(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100);
  struct mo_training_step_row rows[10], found[10];
  struct mo_training_validation_row validation = {5, 80, 2, 0.75, 0.01}, validations[5];
  struct mo_training_status status;
  struct mo_event events[20];
  int64_t id, n;
  int progress = 0;
  REQUIRE(fixture_start(&fixture) == 0);
  id = submit(&fixture, &submission);
  for (uint32_t i = 0; i < 10; i++)
    rows[i] = row_of(i + 1);
  CHECK_INT(mo_store_training_progress(fixture.store, id, rows, 10, NULL, NULL), MO_ERR_CONFLICT); /* not started */
  CHECK_INT(mo_store_training_start(fixture.store, id), MO_OK);
  CHECK_INT(mo_store_training_start(fixture.store, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_training_progress(fixture.store, id, rows, 10, NULL, "{\"id\":\"1\"}"), MO_OK);
  CHECK_INT(mo_store_training_progress(fixture.store, id, NULL, 0, &validation, NULL), MO_OK);
  /* Steps 5 to 7 are run again: nothing changes but their times. */
  rows[4].seconds = 7;
  CHECK_INT(mo_store_training_progress(fixture.store, id, rows + 4, 3, NULL, NULL), MO_OK);
  CHECK_INT(mo_store_training_steps(fixture.store, id, 0, 1, found, 10), 10);
  for (uint32_t i = 0; i < 10; i++) {
    CHECK(memcmp(&found[i].report.mean_loss, &rows[i].report.mean_loss, sizeof(double)) == 0 ||
          (isnan(found[i].report.mean_loss) && isnan(rows[i].report.mean_loss)));
    CHECK(found[i].report.rate == rows[i].report.rate &&
          found[i].report.gradient_norm == rows[i].report.gradient_norm && found[i].seconds == rows[i].seconds &&
          found[i].report.diverged == rows[i].report.diverged && found[i].report.zeroed == rows[i].report.zeroed &&
          found[i].report.skipped == rows[i].report.skipped && found[i].report.bounded == rows[i].report.bounded);
  }
  CHECK_INT(mo_store_training_steps(fixture.store, id, 3, 2, found, 2), 2);
  CHECK(found[0].report.step == 4 && found[1].report.step == 6);
  CHECK_INT(mo_store_training_validations(fixture.store, id, -1, validations, 5), 1);
  CHECK_INT(mo_store_training_validations(fixture.store, id, 5, validations, 5), 0);
  CHECK(memcmp(&validations[0].mean_score, &validation.mean_score, sizeof(double)) == 0);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.step, 10);
  CHECK_INT(status.last.report.step, 10);
  CHECK(status.has_validation && status.validation.rollouts == 80 && status.validation.diverged == 2);
  n = mo_store_events(fixture.store, 0, id, events, 20, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    progress += strcmp(events[i].type, "training.progress") == 0;
  CHECK_INT(progress, 1);
  CHECK(n > 0 && strcmp(events[n - 1].type, "training.validation") == 0);
  CHECK_TEXT(events[n - 1].data, "{\"id\":\"1\",\"step\":5,\"mean_score\":0.75,\"standard_error\":0.01,"
                                 "\"rollouts\":80,\"diverged\":2}");
  /* Paused: what was under way is taken still. Cancelled: nothing any more. */
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, NULL), MO_OK);
  CHECK_INT(mo_store_training_progress(fixture.store, id, rows, 1, NULL, NULL), MO_OK);
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 10, (const uint8_t *)"ten", 3, 2), MO_OK);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_CANCEL, NULL), MO_OK);
  CHECK_INT(mo_store_training_progress(fixture.store, id, rows, 1, NULL, NULL), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 11, (const uint8_t *)"eleven", 6, 2), MO_ERR_CONFLICT);
  fixture_end(&fixture);
}

/* A page of every nth step does not read the steps between. */
static void finds_steps_in_a_long_curve(void)
{
  static const char fill[] = "WITH RECURSIVE s(x) AS (SELECT 1 UNION ALL SELECT x+1 FROM s WHERE x<100000) INSERT INTO "
                             "training_steps SELECT 1,x,0.5,0.001,1,0,0,0,0,0,0,0.25 FROM s";
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100000);
  struct mo_training_step_row *rows = calloc(MO_PAGE_MAX, sizeof(*rows));
  struct timespec begin, middle, end;
  char path[512];
  sqlite3 *db = NULL;
  double whole_s, some_s;
  int64_t n = MO_PAGE_MAX;
  REQUIRE(rows != NULL && fixture_start(&fixture) == 0);
  REQUIRE(submit(&fixture, &submission) == 1);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  snprintf(path, sizeof(path), "%s/morphod.db", fixture.path);
  REQUIRE(sqlite3_open(path, &db) == SQLITE_OK);
  CHECK_INT(sqlite3_exec(db, fill, NULL, NULL, NULL), SQLITE_OK);
  sqlite3_close(db);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  clock_gettime(CLOCK_MONOTONIC, &begin);
  for (uint32_t after = 0; after < 100000 && n == MO_PAGE_MAX; after += MO_PAGE_MAX)
    n = mo_store_training_steps(fixture.store, 1, after, 1, rows, MO_PAGE_MAX);
  CHECK(n == MO_PAGE_MAX && rows[MO_PAGE_MAX - 1].report.step == 100000);
  clock_gettime(CLOCK_MONOTONIC, &middle);
  CHECK_INT(mo_store_training_steps(fixture.store, 1, 0, 30000, rows, MO_PAGE_MAX), 3);
  clock_gettime(CLOCK_MONOTONIC, &end);
  CHECK(rows[0].report.step == 30000 && rows[1].report.step == 60000 && rows[2].report.step == 90000);
  whole_s = (double)(middle.tv_sec - begin.tv_sec) + 1e-9 * (double)(middle.tv_nsec - begin.tv_nsec);
  some_s = (double)(end.tv_sec - middle.tv_sec) + 1e-9 * (double)(end.tv_nsec - middle.tv_nsec);
  printf("# three steps: %.3g s, all: %.3g s\n", some_s, whole_s);
  CHECK(some_s < whole_s / 20);
  CHECK_INT(mo_store_training_steps(fixture.store, 1, 30000, 30000, rows, 1), 1);
  CHECK_INT(rows[0].report.step, 60000);
  CHECK_INT(mo_store_training_steps(fixture.store, 1, 29999, 7, rows, 2), 2);
  CHECK(rows[0].report.step == 30002 && rows[1].report.step == 30009);
  CHECK_INT(mo_store_training_steps(fixture.store, 1, 99998, 99999, rows, 5), 1);
  CHECK_INT(mo_store_training_steps(fixture.store, 1, 99999, 99999, rows, 5), 0);
  CHECK_INT(mo_store_training_steps(fixture.store, 1, UINT32_MAX, MO_TRAINING_STEPS_MAX, rows, 5), 0);
  CHECK_INT(mo_store_training_steps(fixture.store, 2, 0, 2, rows, 5), 0);
  free(rows);
  fixture_end(&fixture);
}

static int files_of(const struct fixture *fixture, int64_t id)
{
  char path[512];
  struct dirent *entry;
  DIR *folder;
  int n = 0;
  snprintf(path, sizeof(path), "%s/trainings/%lld", fixture->path, (long long)id);
  folder = opendir(path);
  while (folder != NULL && (entry = readdir(folder)) != NULL)
    n += entry->d_name[0] != '.' || strncmp(entry->d_name, ".tmp-", 5) == 0;
  if (folder != NULL)
    closedir(folder);
  return n;
}

static int put_file(const struct fixture *fixture, const char *name, const char *text)
{
  char path[512];
  FILE *file;
  snprintf(path, sizeof(path), "%s/trainings/%s", fixture->path, name);
  file = fopen(path, "w");
  if (file == NULL)
    return -1;
  fputs(text, file);
  return fclose(file);
}

static void keeps_checkpoints(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100);
  struct mo_training_checkpoint_row rows[5];
  struct mo_training_status status;
  uint8_t *bytes = NULL;
  size_t size = 0;
  char name[512];
  int64_t id;
  REQUIRE(fixture_start(&fixture) == 0);
  id = submit(&fixture, &submission);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_ERR_NOT_FOUND);
  for (uint32_t step = 10; step <= 40; step += 10) {
    snprintf(name, sizeof(name), "state after %u", (unsigned)step);
    CHECK_INT(mo_store_training_checkpoint(fixture.store, id, step, (const uint8_t *)name, strlen(name), 2), MO_OK);
  }
  CHECK_INT(mo_store_training_checkpoints(fixture.store, id, rows, 5), 2);
  CHECK(rows[0].step == 40 && rows[1].step == 30 && rows[0].size == 14 && rows[0].stored_us > 0);
  CHECK_INT(files_of(&fixture, id), 2);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  CHECK(size == 14 && memcmp(bytes, "state after 40", 14) == 0);
  free(bytes);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 30, &bytes, &size), MO_OK);
  free(bytes);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 20, &bytes, &size), MO_ERR_NOT_FOUND);
  /* Damage is noticed: another byte, another length, no file. */
  snprintf(name, sizeof(name), "%lld/40.checkpoint", (long long)id);
  REQUIRE(put_file(&fixture, name, "state after 41") == 0);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_ERR_CORRUPT);
  REQUIRE(put_file(&fixture, name, "state") == 0);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_ERR_CORRUPT);
  /* The run goes on from 30: its next checkpoint makes the damaged one go, not the good one. */
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 35, (const uint8_t *)"35", 2, 2), MO_OK);
  CHECK_INT(mo_store_training_checkpoints(fixture.store, id, rows, 5), 2);
  CHECK(rows[0].step == 35 && rows[1].step == 30);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.checkpoint_step, 35);
  /* A file that a crash left without its row, an unfinished one, and a folder of nobody. */
  snprintf(name, sizeof(name), "%lld/36.checkpoint", (long long)id);
  REQUIRE(put_file(&fixture, name, "36") == 0);
  snprintf(name, sizeof(name), "%lld/.tmp-7", (long long)id);
  REQUIRE(put_file(&fixture, name, "half") == 0);
  snprintf(name, sizeof(name), "%s/trainings/77", fixture.path);
  REQUIRE(mkdir(name, 0700) == 0 && put_file(&fixture, "77/5.checkpoint", "5") == 0);
  CHECK_INT(files_of(&fixture, id), 4);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(files_of(&fixture, id), 2);
  CHECK(access(name, F_OK) != 0);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 35, &bytes, &size), MO_OK);
  free(bytes);
  /* Of an earlier life of the process: not this one's to write. */
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 50, (const uint8_t *)"50", 2, 2), MO_ERR_CONFLICT);
  CHECK_INT(files_of(&fixture, id), 2);
  fixture_end(&fixture);
}

struct checkpointer {
  struct mo_store *store;
  int64_t id;
  atomic_bool ended;
};

static void *write_checkpoints(void *context)
{
  struct checkpointer *writer = context;
  uint8_t bytes[1000] = {0};
  int error = MO_OK;
  for (uint32_t step = 2; step <= 300 && error == MO_OK; step++) {
    bytes[0] = (uint8_t)step;
    error = mo_store_training_checkpoint(writer->store, writer->id, step, bytes, sizeof(bytes), 1);
  }
  CHECK_INT(error, MO_OK);
  atomic_store(&writer->ended, true);
  return NULL;
}

/* Whoever asks for the newest checkpoint gets one that is whole, however fast they follow each other. */
static void reads_checkpoints_while_they_go(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(1000);
  struct checkpointer writer = {.ended = false};
  uint8_t *bytes = NULL;
  size_t size = 0;
  pthread_t thread;
  int bad = 0;
  REQUIRE(fixture_start(&fixture) == 0);
  writer.store = fixture.store;
  writer.id = submit(&fixture, &submission);
  REQUIRE(mo_store_training_start(fixture.store, writer.id) == MO_OK);
  REQUIRE(mo_store_training_checkpoint(fixture.store, writer.id, 1, (const uint8_t *)"1", 1, 1) == MO_OK);
  REQUIRE(pthread_create(&thread, NULL, write_checkpoints, &writer) == 0);
  while (!atomic_load(&writer.ended)) {
    int error = mo_store_training_checkpoint_bytes(fixture.store, writer.id, 0, &bytes, &size);
    bad += error != MO_OK;
    if (error == MO_OK)
      free(bytes);
  }
  pthread_join(thread, NULL);
  CHECK_INT(bad, 0);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, writer.id, 299, &bytes, &size), MO_ERR_NOT_FOUND);
  fixture_end(&fixture);
}

/* A process that can open no more files has lost no checkpoint: taken for damaged, the training would begin anew. */
static void keeps_apart_damage_and_want_of_descriptors(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100);
  struct rlimit before, small;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int64_t id;
  int next;
  REQUIRE(fixture_start(&fixture) == 0);
  id = submit(&fixture, &submission);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  REQUIRE(mo_store_training_checkpoint(fixture.store, id, 10, (const uint8_t *)"ten", 3, 2) == MO_OK);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  free(bytes);
  next = open("/dev/null", O_RDONLY | O_CLOEXEC);
  REQUIRE(next >= 0 && close(next) == 0 && getrlimit(RLIMIT_NOFILE, &before) == 0);
  small = before;
  small.rlim_cur = (rlim_t)next;
  setrlimit(RLIMIT_NOFILE, &small);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_ERR_NO_MEMORY);
  setrlimit(RLIMIT_NOFILE, &before);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  free(bytes);
  fixture_end(&fixture);
}

/* Files larger than a limit cannot be written: as on a full disk, but for small ones. */
static void survives_a_full_disk(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100);
  struct mo_training_checkpoint_row rows[5];
  struct rlimit before, small;
  size_t size = 4 << 20;
  uint8_t *bytes = calloc(1, size);
  int64_t id;
  REQUIRE(bytes != NULL && fixture_start(&fixture) == 0);
  id = submit(&fixture, &submission);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 1, bytes, 1000, 2), MO_OK);
  signal(SIGXFSZ, SIG_IGN);
  getrlimit(RLIMIT_FSIZE, &before);
  small = before;
  small.rlim_cur = 3 << 20;
  setrlimit(RLIMIT_FSIZE, &small);
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 2, bytes, size, 2), MO_ERR_NO_SPACE);
  CHECK_INT(files_of(&fixture, id), 1);
  CHECK_INT(mo_store_training_checkpoints(fixture.store, id, rows, 5), 1);
  setrlimit(RLIMIT_FSIZE, &before);
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 2, bytes, size, 2), MO_OK);
  CHECK_INT(mo_store_training_checkpoints(fixture.store, id, rows, 5), 2);
  free(bytes);
  fixture_end(&fixture);
}

/* The lineage is that of the steps that count: what a run noted where another goes on anew is forgotten. */
static void names_the_code(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100);
  struct mo_training_lineage lineage;
  struct mo_training_status status;
  struct mo_event events[80];
  char name[32];
  int64_t id, n;
  int changes = 0;
  REQUIRE(fixture_start(&fixture) == 0);
  id = submit(&fixture, &submission);
  CHECK_INT(mo_store_training_code(fixture.store, id, 0, "one", &lineage), MO_ERR_CONFLICT);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_code(fixture.store, id, 0, "none", &lineage), MO_OK); /* it came to no step */
  CHECK_INT(mo_store_training_code(fixture.store, id, 0, "one", &lineage), MO_OK);
  CHECK(lineage.n == 1 && lineage.codes[0].from_step == 0 && strcmp(lineage.codes[0].fingerprint, "one") == 0);
  CHECK_INT(mo_store_training_code(fixture.store, id, 20, "one", &lineage), MO_OK);
  CHECK_INT(lineage.n, 1);
  CHECK_INT(mo_store_training_code(fixture.store, id, 30, "two", &lineage), MO_OK);
  CHECK_INT(lineage.n, 2);
  CHECK_INT(mo_store_training_code(fixture.store, id, 30, "one", &lineage), MO_OK); /* "two" came to no checkpoint */
  CHECK_INT(lineage.n, 1);
  CHECK_INT(mo_store_training_code(fixture.store, id, 30, "two", &lineage), MO_OK);
  CHECK_INT(mo_store_training_code(fixture.store, id, 25, "three", &lineage), MO_OK); /* from an earlier checkpoint */
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.code.n, 2);
  CHECK_INT(status.code.codes[1].from_step, 25);
  CHECK_TEXT(status.code.codes[1].fingerprint, "three");
  n = mo_store_events(fixture.store, 0, id, events, 80, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    changes += strcmp(events[i].type, "training.code_changed") == 0;
  CHECK_INT(changes, 3);
  CHECK(n > 0 && strstr(events[n - 1].data, "\"from_step\":25,\"before\":\"one\",\"fingerprint\":\"three\"") != NULL);
  CHECK_INT(mo_store_training_code(fixture.store, id, 40, "four", &lineage), MO_ERR_CONFLICT); /* of an earlier life */
  CHECK_INT(mo_store_requeue(fixture.store, 0, 3, ""), MO_OK);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  for (uint32_t step = 40; step < 40 + MO_LINEAGE_MAX; step++) {
    snprintf(name, sizeof(name), "code %u", (unsigned)step);
    CHECK_INT(mo_store_training_code(fixture.store, id, step, name, &lineage), MO_OK);
  }
  CHECK_INT(lineage.n, MO_LINEAGE_MAX);
  CHECK_TEXT(lineage.codes[MO_LINEAGE_MAX - 2].fingerprint, "code 68");
  CHECK_TEXT(lineage.codes[MO_LINEAGE_MAX - 1].fingerprint, "various");
  CHECK_INT(lineage.codes[MO_LINEAGE_MAX - 1].from_step, 69);
  CHECK_INT(mo_store_training_code(fixture.store, id, 99, "", &lineage), MO_ERR_RANGE);
  CHECK_INT(mo_store_training_code(fixture.store, id, 99, "a \"quote\"", &lineage), MO_ERR_INVALID);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  fixture_end(&fixture);
}

/* One that waits for room runs in the rows and is shown as paused: the filter goes by what is shown, page by page. */
static void finds_by_the_state_that_is_shown(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(10);
  struct mo_training_status page[8];
  struct mo_job jobs[8];
  int64_t ids[6], waiting[2], none[MO_WAITING_MAX + 1] = {0};
  struct mo_job_query query = {.kind = -1, .waiting = waiting, .n_waiting = 2};
  REQUIRE(fixture_start(&fixture) == 0);
  for (int i = 0; i < 6; i++) {
    ids[i] = submit(&fixture, &submission);
    REQUIRE(i == 5 || mo_store_training_start(fixture.store, ids[i]) == MO_OK);
  }
  waiting[0] = ids[1];
  waiting[1] = ids[3]; /* paused while it waited */
  REQUIRE(mo_store_change_job(fixture.store, ids[3], MO_CHANGE_PAUSE, NULL) == MO_OK);
  REQUIRE(mo_store_change_job(fixture.store, ids[4], MO_CHANGE_PAUSE, NULL) == MO_OK);
  query.state = MO_JOB_RUNNING;
  CHECK_INT(mo_store_trainings(fixture.store, &query, page, 8), 2);
  CHECK(page[0].job.id == ids[2] && page[1].job.id == ids[0]);
  CHECK_INT(mo_store_jobs(fixture.store, &query, jobs, 8), 2);
  CHECK(jobs[0].id == ids[2] && jobs[1].id == ids[0]);
  query.state = MO_JOB_PAUSED;
  CHECK_INT(mo_store_trainings(fixture.store, &query, page, 2), 2);
  CHECK(page[0].job.id == ids[4] && page[1].job.id == ids[3]);
  CHECK_INT(mo_store_jobs(fixture.store, &query, jobs, 2), 2);
  CHECK(jobs[0].id == ids[4] && jobs[1].id == ids[3]);
  query.before = ids[3];
  CHECK_INT(mo_store_trainings(fixture.store, &query, page, 2), 1);
  CHECK(page[0].job.id == ids[1]);
  CHECK_INT(mo_store_jobs(fixture.store, &query, jobs, 2), 1);
  CHECK(jobs[0].id == ids[1]);
  query = (struct mo_job_query){.state = MO_JOB_QUEUED, .kind = -1, .waiting = waiting, .n_waiting = 2};
  CHECK_INT(mo_store_trainings(fixture.store, &query, page, 8), 1);
  query = (struct mo_job_query){.state = MO_JOB_RUNNING, .kind = -1, .waiting = none, .n_waiting = MO_WAITING_MAX};
  CHECK_INT(mo_store_jobs(fixture.store, &query, jobs, 8), 3);
  query.n_waiting++;
  CHECK_INT(mo_store_jobs(fixture.store, &query, jobs, 8), MO_ERR_LIMIT);
  CHECK_INT(mo_store_trainings(fixture.store, &query, page, 8), MO_ERR_LIMIT);
  fixture_end(&fixture);
}

static void finishes_with_its_controller(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100);
  struct mo_training_status status;
  struct mo_controller_record record;
  struct mo_controller *controller = NULL;
  struct mo_event events[10];
  uint8_t *bytes = NULL;
  size_t size = 0;
  int64_t id, n;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) == MO_OK);
  mo_controller_randomize(controller, 77);
  REQUIRE(mo_controller_encode(controller, &bytes, &size) == MO_OK);
  id = submit(&fixture, &submission);
  CHECK_INT(mo_store_training_finish(fixture.store, id, "walker", bytes, size, controller), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_controller(fixture.store, "walker", &record), MO_ERR_NOT_FOUND);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, NULL), MO_OK);
  CHECK_INT(mo_store_training_finish(fixture.store, id, "walker", bytes, size, controller), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_controller(fixture.store, "walker", &record), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RESUME, NULL), MO_OK);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_finish(fixture.store, id, "walker", bytes, size, controller), MO_OK);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.job.state, MO_JOB_SUCCEEDED);
  CHECK(status.job.finished_us > 0);
  CHECK_INT(mo_store_controller(fixture.store, "walker", &record), MO_OK);
  CHECK(status.has_result && mo_sha256_equal(&status.result_sha256, &record.sha256));
  n = mo_store_events(fixture.store, 0, id, events, 10, NULL, NULL);
  CHECK(n > 0 && strcmp(events[n - 1].type, "job.finished") == 0);
  CHECK(n > 0 && strstr(events[n - 1].data, "\"kind\":\"training\",\"state\":\"succeeded\",\"controller\":\"walker\""));
  CHECK_INT(mo_store_controller_remove(fixture.store, "walker"), MO_OK); /* its content stays */
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  free(bytes);
  mo_controller_free(controller);
  fixture_end(&fixture);
}

static void parks_and_requeues(void)
{
  struct fixture fixture;
  struct mo_training_submission submission = submission_of(100);
  struct mo_event events[10];
  enum mo_job_state after = MO_JOB_CANCELLED;
  struct mo_job job;
  int64_t id, n;
  REQUIRE(fixture_start(&fixture) == 0);
  id = submit(&fixture, &submission);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_park(fixture.store, id, MO_OK, NULL, 3, &after), MO_OK);
  CHECK_INT(after, MO_JOB_QUEUED);
  /* A process that dies leaves it running; the next one queues it again. */
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(state_of(&fixture, id), MO_JOB_RUNNING);
  CHECK_INT(mo_store_requeue(fixture.store, 0, 3, ""), MO_OK);
  CHECK_INT(state_of(&fixture, id), MO_JOB_QUEUED);
  /* An error, a crash, an error: the third is the last. */
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_park(fixture.store, id, MO_ERR_NO_MEMORY, "out of memory", 3, &after), MO_OK);
  CHECK_INT(after, MO_JOB_QUEUED);
  CHECK_INT(mo_store_job(fixture.store, id, &job), MO_OK);
  CHECK_INT(job.attempts, 1);
  CHECK_TEXT(job.error_text, "out of memory");
  CHECK_INT(mo_store_requeue(fixture.store, id, 3, "killed"), MO_OK);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_park(fixture.store, id, MO_ERR_NO_MEMORY, "out of memory", 3, &after), MO_OK);
  CHECK_INT(after, MO_JOB_FAILED);
  CHECK_INT(mo_store_training_start(fixture.store, id), MO_ERR_CONFLICT);
  n = mo_store_events(fixture.store, 0, id, events, 10, NULL, NULL);
  CHECK(n > 0 && strcmp(events[n - 1].type, "job.finished") == 0);
  CHECK(n > 0 && strstr(events[n - 1].data, "\"kind\":\"training\",\"state\":\"failed\"") != NULL);
  /* One that is paused stays so. */
  id = submit(&fixture, &submission);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, NULL), MO_OK);
  CHECK_INT(mo_store_training_park(fixture.store, id, MO_OK, NULL, 3, &after), MO_OK);
  CHECK_INT(after, MO_JOB_PAUSED);
  CHECK_INT(mo_store_training_start(fixture.store, id), MO_ERR_CONFLICT);
  /* Errors with progress between them are forgiven; errors at one step are not, whatever checkpoint is written again. */
  id = submit(&fixture, &submission);
  for (uint32_t round = 1; round <= 5; round++) {
    REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
    CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 10 * round, (const uint8_t *)"x", 1, 2), MO_OK);
    CHECK_INT(mo_store_training_park(fixture.store, id, MO_ERR_NO_MEMORY, "out of memory", 3, &after), MO_OK);
    CHECK_INT(after, MO_JOB_QUEUED);
    CHECK_INT(mo_store_job(fixture.store, id, &job), MO_OK);
    CHECK_INT(job.attempts, 1);
  }
  for (uint32_t attempt = 2; attempt <= 3; attempt++) {
    REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
    CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 50, (const uint8_t *)"x", 1, 2), MO_OK);
    CHECK_INT(mo_store_training_park(fixture.store, id, MO_ERR_NO_MEMORY, "out of memory", 3, &after), MO_OK);
    CHECK_INT(after, attempt < 3 ? MO_JOB_QUEUED : MO_JOB_FAILED);
  }
  fixture_end(&fixture);
}

struct waiter {
  pthread_mutex_t mutex;
  pthread_cond_t changed;
  bool done;
};

static void save_done(struct mo_save *save, int status)
{
  struct waiter *waiter = save->context;
  pthread_mutex_lock(&waiter->mutex);
  waiter->done = true;
  CHECK_INT(status, MO_OK);
  pthread_cond_signal(&waiter->changed);
  pthread_mutex_unlock(&waiter->mutex);
}

/* Ends an evaluation of 6 designs with losses of which design i's are losses[i]. */
static int evaluate(struct fixture *fixture, int64_t id, const double losses[6])
{
  struct waiter waiter = {.mutex = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER};
  struct mo_job_update updates[2] = {{.job = id, .step = MO_STEP_START}, {.job = id, .step = MO_STEP_SUCCEED}};
  struct mo_saved_score scores[6 * MO_PAPER_TEST_COUNT];
  struct mo_save save = {.scores = scores, .updates = updates, .n_updates = 2, .done = save_done, .context = &waiter};
  struct mo_work *work = NULL;
  int64_t fingerprint = 0;
  int error = mo_store_fingerprint(fixture->store, "by hand", &fingerprint);
  if (error == MO_OK)
    error = mo_store_load_work(fixture->store, id, &work);
  for (uint32_t n = 0; n < 6 && error == MO_OK; n++)
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++)
      scores[n * MO_PAPER_TEST_COUNT + k] = (struct mo_saved_score){.genotype = work->genotype_rows[n],
                                                                    .controller = work->controller,
                                                                    .physics = work->physics,
                                                                    .environment = work->environment_rows[k],
                                                                    .fingerprint = fingerprint,
                                                                    .loss = losses[n],
                                                                    .diverged_step = isinf(losses[n]) ? 3 : 0};
  save.n_scores = 6 * MO_PAPER_TEST_COUNT;
  if (error == MO_OK)
    error = mo_store_save(fixture->store, &save);
  pthread_mutex_lock(&waiter.mutex);
  while (!waiter.done && error == MO_OK)
    pthread_cond_wait(&waiter.changed, &waiter.mutex);
  pthread_mutex_unlock(&waiter.mutex);
  mo_work_free(work);
  return error;
}

static void ranks_a_population(void)
{
  static const double losses[6] = {0.5, 0.25, INFINITY, 0.75, 0.125, 0.25};
  struct fixture fixture;
  struct mo_bits *forms, *genotypes, *best = NULL;
  struct mo_submission evaluation;
  struct mo_training_submission training = submission_of(10);
  int64_t id = 0;
  uint32_t n = 0;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(5, 6, &forms, &genotypes) == MO_OK);
  forms[5] = forms[1]; /* asked for twice */
  genotypes[5] = genotypes[1];
  evaluation = fixture_submission(forms, genotypes, 6);
  REQUIRE(mo_store_submit(fixture.store, &evaluation, &id, &replayed) == MO_OK);
  CHECK_INT(mo_store_population(fixture.store, id, 0, &best, &n), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_population(fixture.store, id + 1, 0, &best, &n), MO_ERR_NOT_FOUND);
  REQUIRE(evaluate(&fixture, id, losses) == MO_OK);
  CHECK_INT(mo_store_population(fixture.store, id, 0, &best, &n), MO_OK);
  CHECK_INT(n, 4);
  CHECK(n == 4 && memcmp(&best[0], &genotypes[4], sizeof(*best)) == 0 &&
        memcmp(&best[1], &genotypes[1], sizeof(*best)) == 0 && memcmp(&best[2], &genotypes[0], sizeof(*best)) == 0 &&
        memcmp(&best[3], &genotypes[3], sizeof(*best)) == 0);
  free(best);
  CHECK_INT(mo_store_population(fixture.store, id, 2, &best, &n), MO_OK);
  CHECK_INT(n, 2);
  free(best);
  CHECK_INT(mo_store_population(fixture.store, submit(&fixture, &training), 0, &best, &n), MO_ERR_NOT_FOUND);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static const struct check_case cases[] = {
    {"migrates an old database", migrates_an_old_database},
    {"migrates a training", migrates_a_training},
    {"submits and reads back", submits_and_reads_back},
    {"keeps the queues apart", keeps_the_queues_apart},
    {"keeps the learning curve", keeps_the_curve},
    {"finds steps in a long curve", finds_steps_in_a_long_curve},
    {"keeps checkpoints", keeps_checkpoints},
    {"reads checkpoints while they go", reads_checkpoints_while_they_go},
    {"keeps apart damage and want of descriptors", keeps_apart_damage_and_want_of_descriptors},
    {"survives a full disk", survives_a_full_disk},
    {"names the code", names_the_code},
    {"finds by the state that is shown", finds_by_the_state_that_is_shown},
    {"finishes with its controller", finishes_with_its_controller},
    {"parks and requeues", parks_and_requeues},
    {"ranks a population", ranks_a_population},
};
CHECK_MAIN(cases)
