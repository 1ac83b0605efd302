/* store.c: every operation of the store, on a real database in a folder of its own. */
#include <math.h>
#include <pthread.h>
#include <sqlite3.h>

#include "../check.h"
#include "fixture.h"

static const struct mo_job_query any_job = {.state = -1, .kind = -1};

/* Runs SQL on the database behind the store's back: between closing and opening it. */
static int outside(const struct fixture *fixture, const char *sql)
{
  char path[512];
  sqlite3 *db = NULL;
  int result;
  snprintf(path, sizeof(path), "%s/morphod.db", fixture->path);
  result = sqlite3_open(path, &db);
  if (result == SQLITE_OK)
    result = sqlite3_exec(db, sql, NULL, NULL, NULL);
  sqlite3_close(db);
  return result;
}

static int64_t outside_integer(const struct fixture *fixture, const char *sql)
{
  char path[512];
  sqlite3 *db = NULL;
  sqlite3_stmt *statement = NULL;
  int64_t value = -1;
  snprintf(path, sizeof(path), "%s/morphod.db", fixture->path);
  if (sqlite3_open_v2(path, &db, SQLITE_OPEN_READONLY, NULL) == SQLITE_OK &&
      sqlite3_prepare_v2(db, sql, -1, &statement, NULL) == SQLITE_OK && sqlite3_step(statement) == SQLITE_ROW)
    value = sqlite3_column_int64(statement, 0);
  sqlite3_finalize(statement);
  sqlite3_close(db);
  return value;
}

/* ---- saving, synchronously ---- */

struct waiter {
  pthread_mutex_t mutex;
  pthread_cond_t changed;
  int status;
  bool done;
};

static void save_done(struct mo_save *save, int status)
{
  struct waiter *waiter = save->context;
  pthread_mutex_lock(&waiter->mutex);
  waiter->status = status;
  waiter->done = true;
  pthread_cond_signal(&waiter->changed);
  pthread_mutex_unlock(&waiter->mutex);
}

static int save_and_wait(struct mo_store *store, struct mo_save *save)
{
  struct waiter waiter = {.mutex = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER};
  int error;
  save->done = save_done;
  save->context = &waiter;
  error = mo_store_save(store, save);
  if (error != MO_OK)
    return error;
  pthread_mutex_lock(&waiter.mutex);
  while (!waiter.done)
    pthread_cond_wait(&waiter.changed, &waiter.mutex);
  pthread_mutex_unlock(&waiter.mutex);
  return waiter.status;
}

static double made_up_loss(uint32_t n, uint32_t k)
{
  return 0.1 * (n + 1) + 0.001 * k + 1e-17 * n;
}

/* Runs a whole job by hand: starts it, saves made-up losses, ends it. */
static int run_by_hand(struct mo_store *store, int64_t id, double (*loss)(uint32_t n, uint32_t k))
{
  struct mo_work *work = NULL;
  struct mo_job_update updates[2] = {{.job = id, .step = MO_STEP_START}, {.job = id, .step = MO_STEP_SUCCEED}};
  struct mo_saved_score *scores;
  struct mo_saved_design *designs;
  struct mo_save save = {.updates = updates, .n_updates = 2};
  int64_t fingerprint = 0;
  int error = mo_store_fingerprint(store, "by hand", &fingerprint);
  if (error == MO_OK)
    error = mo_store_load_work(store, id, &work);
  if (error != MO_OK)
    return error;
  scores = calloc((size_t)work->n_designs * work->n_environments, sizeof(*scores));
  designs = calloc(work->n_designs, sizeof(*designs));
  for (uint32_t n = 0; n < work->n_designs; n++) {
    for (uint32_t k = 0; k < work->n_environments; k++) {
      double value = loss(n, k);
      scores[save.n_scores++] = (struct mo_saved_score){.genotype = work->genotype_rows[n],
                                                        .controller = work->controller,
                                                        .physics = work->physics,
                                                        .environment = work->environment_rows[k],
                                                        .fingerprint = fingerprint,
                                                        .loss = value,
                                                        .diverged_step = isinf(value) ? 17 : 0,
                                                        .verify_job = work->job.verify ? id : 0,
                                                        .design_position = n,
                                                        .environment_position = k};
    }
    designs[n] =
        (struct mo_saved_design){work->genotype_rows[n], work->controller, work->physics, work->environment_set};
  }
  save.scores = scores;
  save.designs = designs;
  save.n_designs = work->environment_set != 0 ? work->n_designs : 0;
  updates[1].done = updates[1].total = save.n_scores;
  error = save_and_wait(store, &save);
  if (error == MO_OK && (!updates[0].applied || !updates[1].applied))
    error = MO_ERR_CONFLICT;
  free(scores);
  free(designs);
  mo_work_free(work);
  return error;
}

/* ---- cases ---- */

static void opens_and_locks(void)
{
  struct fixture fixture;
  struct mo_store_config config;
  struct mo_store *second = NULL;
  REQUIRE(fixture_start(&fixture) == 0);
  CHECK_INT(mo_store_epoch(fixture.store), 1);
  config = (struct mo_store_config){.path = fixture.path};
  CHECK_INT(mo_store_open(&config, &second, &fixture.message), MO_ERR_BUSY);
  CHECK(strstr(fixture.message.text, "another process") != NULL);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  CHECK_INT(mo_store_epoch(fixture.store), 2);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  CHECK_INT(outside_integer(&fixture, "PRAGMA application_id"), 0x6D727068);
  CHECK_INT(outside_integer(&fixture, "PRAGMA user_version"), 4);
  CHECK_INT(outside_integer(&fixture, "SELECT value FROM meta WHERE key='clean'"), 1);
  CHECK_INT(outside_integer(&fixture,
                            "SELECT count(*) FROM sqlite_schema WHERE type='table' AND name NOT LIKE 'sqlite%'"
                            " AND sql NOT LIKE '%STRICT%'"),
            0);
  config.path = "/nonexistent/folder";
  CHECK_INT(mo_store_open(&config, &second, &fixture.message), MO_ERR_NOT_FOUND);
  fixture_end(&fixture);
}

static void refuses_what_is_not_ours(void)
{
  struct fixture fixture;
  char path[512];
  FILE *file;
  REQUIRE(fixture_start(&fixture) == 0);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  /* Written by a newer program. */
  REQUIRE(outside(&fixture, "PRAGMA user_version=99") == SQLITE_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_ERR_UNSUPPORTED);
  CHECK(strstr(fixture.message.text, "99") != NULL);
  REQUIRE(outside(&fixture, "PRAGMA user_version=4; PRAGMA application_id=7") == SQLITE_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_ERR_FORMAT);
  REQUIRE(outside(&fixture, "PRAGMA application_id=1836216424") == SQLITE_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  snprintf(path, sizeof(path), "%s/morphod.db", fixture.path);
  file = fopen(path, "w");
  REQUIRE(file != NULL);
  for (int i = 0; i < 200; i++)
    fputs("this is no database, whatever its name says\n", file);
  fclose(file);
  CHECK_INT(fixture_reopen(&fixture), MO_ERR_FORMAT);
  fixture_end(&fixture);
}

static void notices_damage_after_an_unclean_stop(void)
{
  struct fixture fixture;
  char path[512];
  FILE *file;
  REQUIRE(fixture_start(&fixture) == 0);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(outside(&fixture, "UPDATE meta SET value=0 WHERE key='clean'") == SQLITE_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_OK); /* unclean, but whole */
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(outside(&fixture, "UPDATE meta SET value=0 WHERE key='clean'; PRAGMA wal_checkpoint(TRUNCATE)") == SQLITE_OK);
  snprintf(path, sizeof(path), "%s/morphod.db", fixture.path);
  file = fopen(path, "r+");
  REQUIRE(file != NULL);
  /* The root page of some index becomes noise; the header and the schema stay. */
  fseek(file,
        4096L * (long)(outside_integer(&fixture, "SELECT rootpage FROM sqlite_schema WHERE name='jobs_by_state'") - 1),
        SEEK_SET);
  for (int i = 0; i < 4096; i++)
    fputc(0x5a, file);
  fclose(file);
  CHECK_INT(fixture_reopen(&fixture), MO_ERR_CORRUPT);
  fixture_end(&fixture);
}

static void submits_and_reads_back(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_controller_record record;
  struct mo_job job;
  struct mo_work *work = NULL;
  struct mo_environment paper[MO_PAPER_TEST_COUNT];
  int64_t id = 0, queued[4];
  bool replayed = true;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(1, 5, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 5);
  submission.label = "first \xc3\xa9vidence";
  submission.precision = MO_FLOAT64;
  submission.physics.drop_height_m = 0.25;
  CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_OK);
  CHECK(!replayed);
  CHECK_INT(id, 1);
  REQUIRE(mo_store_job(fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_QUEUED);
  CHECK_INT(job.version, 1);
  CHECK_TEXT(job.label, "first \xc3\xa9vidence");
  CHECK(job.has_label);
  CHECK_TEXT(job.environment_set, "paper-test");
  CHECK_TEXT(job.controller_name, "default");
  CHECK_INT(job.precision, MO_FLOAT64);
  CHECK(job.physics.drop_height_m == 0.25 && job.physics.dt_s == 0.004 && job.physics.n_steps == 1000);
  CHECK_INT(job.rollouts_total, 50);
  CHECK(job.created_us > 0 && job.started_us == 0 && job.finished_us == 0);
  CHECK_INT(mo_store_controller(fixture.store, "default", &record), MO_OK);
  CHECK(mo_sha256_equal(&record.sha256, &job.controller_sha256));
  CHECK_INT(mo_store_job(fixture.store, 2, &job), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_queued(fixture.store, MO_BATCH, 0, queued, 4), 1);
  CHECK_INT(queued[0], id);
  CHECK_INT(mo_store_queued(fixture.store, MO_INTERACTIVE, 0, queued, 4), 0);
  REQUIRE(mo_store_load_work(fixture.store, id, &work) == MO_OK);
  mo_environment_paper_test(paper);
  CHECK(memcmp(work->environments, paper, sizeof(paper)) == 0);
  CHECK(memcmp(work->genotypes, genotypes, 5 * sizeof(*genotypes)) == 0);
  mo_work_free(work);
  submission.controller = "nobody";
  CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_ERR_NOT_FOUND);
  submission.controller = "default";
  submission.environment_set = "no such set";
  CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_jobs(fixture.store, &any_job, &job, 1), 1);
  CHECK_INT(job.id, 1); /* the refused ones left nothing */
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void shares_designs_between_orientations(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes, images[2], same_forms[2];
  struct mo_submission submission;
  struct mo_design *design = NULL;
  uint64_t n = 0;
  int64_t id;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(5, 40, &forms, &genotypes) == MO_OK);
  images[0] = genotypes[0];
  for (unsigned i = 0; i < 40; i++) { /* a body that is not its own mirror image */
    REQUIRE(mo_genotype_image(MO_DEFAULT_WORKSPACE, genotypes[i].words, 4, images[1].words) == MO_OK);
    mo_genotype_place(MO_DEFAULT_WORKSPACE, images[1].words);
    images[0] = genotypes[i];
    same_forms[0] = same_forms[1] = forms[i];
    if (memcmp(&images[0], &images[1], sizeof(images[0])) != 0)
      break;
  }
  REQUIRE(memcmp(&images[0], &images[1], sizeof(images[0])) != 0);
  submission = fixture_submission(same_forms, images, 2);
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  REQUIRE(run_by_hand(fixture.store, id, made_up_loss) == MO_OK);
  CHECK_INT(mo_store_design_count(fixture.store, &n), MO_OK);
  CHECK_INT(n, 1);
  REQUIRE(mo_store_design(fixture.store, &same_forms[0], &design) == MO_OK);
  CHECK_INT(design->n_orientations, 2);
  CHECK(memcmp(&design->orientations[1].genotype, &images[1], sizeof(images[1])) == 0);
  REQUIRE(design->orientations[1].n_scores == 1);
  CHECK_TEXT(design->orientations[1].scores[0].environment_set, "paper-test");
  CHECK_INT(design->orientations[1].scores[0].n_losses, 10);
  CHECK(design->orientations[1].scores[0].losses[3] == made_up_loss(1, 3));
  CHECK_TEXT(design->orientations[1].scores[0].fingerprint, "by hand");
  CHECK_NEAR(design->orientations[1].scores[0].score, 0.2045, 1e-12);
  mo_design_free(design);
  CHECK_INT(mo_store_design(fixture.store, &genotypes[39], &design), MO_ERR_NOT_FOUND);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static double odd_loss(uint32_t n, uint32_t k)
{
  static const double values[] = {-0.0, 0.0, 4.9e-324, 1.0 / 3.0, INFINITY, 1.7976931348623157e308};
  return values[(n + k) % 6];
}

static double other_loss(uint32_t n, uint32_t k)
{
  return n == 1 && k == 2 ? nextafter(odd_loss(n, k), 2.0) : odd_loss(n, k);
}

static void keeps_every_bit(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_evaluation_results *results = NULL;
  struct mo_environment environments[6];
  int64_t id, again;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(2, 3, &forms, &genotypes) == MO_OK);
  for (unsigned k = 0; k < 6; k++)
    mo_environment_training(9, 0, k, &environments[k]);
  environments[2].light_xy_m[0] = -0.0;
  submission = fixture_submission(forms, genotypes, 3);
  submission.environment_set = NULL;
  submission.environments = environments;
  submission.n_environments = 6;
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  REQUIRE(run_by_hand(fixture.store, id, odd_loss) == MO_OK);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  REQUIRE(mo_store_results(fixture.store, id, &results) == MO_OK);
  for (uint32_t n = 0; n < 3; n++)
    for (uint32_t k = 0; k < 6; k++) {
      double expected = odd_loss(n, k);
      CHECK(memcmp(&results->losses[n * 6 + k], &expected, 8) == 0);
      CHECK_INT(results->diverged_steps[n * 6 + k], isinf(expected) ? 17 : 0);
    }
  CHECK(isinf(results->scores[0]));
  CHECK(memcmp(results->forms, forms, 3 * sizeof(*forms)) == 0);
  mo_evaluation_results_free(results);
  /* A second writer of the same scores changes nothing; a verify job reports both. */
  submission.verify = true;
  REQUIRE(mo_store_submit(fixture.store, &submission, &again, &replayed) == MO_OK);
  REQUIRE(run_by_hand(fixture.store, again, other_loss) == MO_OK);
  REQUIRE(mo_store_results(fixture.store, again, &results) == MO_OK);
  REQUIRE(results->agrees != NULL && results->stored_losses != NULL);
  CHECK(results->agrees[0] == 1 && results->agrees[1] == 0 && results->agrees[2] == 1);
  CHECK(results->losses[8] == other_loss(1, 2) && results->stored_losses[8] == odd_loss(1, 2));
  mo_evaluation_results_free(results);
  REQUIRE(mo_store_results(fixture.store, id, &results) == MO_OK);
  CHECK(results->losses[8] == odd_loss(1, 2));
  CHECK(results->agrees == NULL);
  mo_evaluation_results_free(results);
  CHECK_INT(mo_store_results(fixture.store, 77, &results), MO_ERR_NOT_FOUND);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void answers_a_repeated_key(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_store_config config;
  int64_t id = 0, again = 0;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(3, 1, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 1);
  submission.idempotency_key = "key-1";
  mo_sha256_of("body", 4, &submission.body_sha256);
  CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_OK);
  CHECK(!replayed);
  CHECK_INT(mo_store_submit(fixture.store, &submission, &again, &replayed), MO_OK);
  CHECK(replayed && again == id);
  CHECK_INT(mo_store_replay(fixture.store, "key-1", &submission.body_sha256, &again), MO_OK);
  CHECK_INT(mo_store_replay(fixture.store, "key-2", &submission.body_sha256, &again), MO_ERR_NOT_FOUND);
  mo_sha256_of("other", 5, &submission.body_sha256);
  CHECK_INT(mo_store_submit(fixture.store, &submission, &again, &replayed), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_replay(fixture.store, "key-1", &submission.body_sha256, &again), MO_ERR_CONFLICT);
  /* Keys older than their time are forgotten. */
  mo_store_close(fixture.store);
  REQUIRE(outside(&fixture, "UPDATE idempotency_keys SET created_us=created_us-90000000000") == SQLITE_OK);
  config = (struct mo_store_config){.path = fixture.path};
  REQUIRE(mo_store_open(&config, &fixture.store, NULL) == MO_OK);
  for (int i = 0; i < 1200; i++) { /* enough events to make a round of pruning due */
    enum mo_job_state before;
    CHECK_INT(mo_store_change_job(fixture.store, id, i % 2 == 0 ? MO_CHANGE_PAUSE : MO_CHANGE_RESUME, &before), MO_OK);
  }
  usleep(50000);
  CHECK_INT(mo_store_replay(fixture.store, "key-1", &submission.body_sha256, &again), MO_ERR_NOT_FOUND);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void pages_through_jobs(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_job *page = calloc(10, sizeof(*page));
  struct mo_job_query query = any_job;
  uint64_t counts[MO_JOB_STATES];
  int64_t id, expected = 25;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(4, 1, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 1);
  for (int i = 0; i < 25; i++)
    REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  CHECK_INT(mo_store_change_job(fixture.store, 10, MO_CHANGE_CANCEL, NULL), MO_OK);
  CHECK_INT(mo_store_change_job(fixture.store, 20, MO_CHANGE_CANCEL, NULL), MO_OK);
  for (;;) {
    int64_t n = mo_store_jobs(fixture.store, &query, page, 10);
    REQUIRE(n >= 0);
    for (int64_t i = 0; i < n; i++)
      CHECK_INT(page[i].id, expected--);
    if (n == 0)
      break;
    query.before = page[n - 1].id;
  }
  CHECK_INT(expected, 0);
  query = any_job;
  query.state = MO_JOB_CANCELLED;
  CHECK_INT(mo_store_jobs(fixture.store, &query, page, 10), 2);
  CHECK_INT(page[0].id, 20);
  CHECK_INT(page[1].id, 10);
  query.before = 20;
  CHECK_INT(mo_store_jobs(fixture.store, &query, page, 10), 1);
  CHECK_INT(mo_store_jobs(fixture.store, &query, page, MO_PAGE_MAX + 1), MO_ERR_LIMIT);
  CHECK_INT(mo_store_job_counts(fixture.store, counts), MO_OK);
  CHECK_INT(counts[MO_JOB_QUEUED], 23);
  CHECK_INT(counts[MO_JOB_CANCELLED], 2);
  free(page);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void changes_states(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_job job;
  enum mo_job_state before;
  struct mo_job_update update = {.step = MO_STEP_START};
  struct mo_save save = {.updates = &update, .n_updates = 1};
  int64_t id;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(4, 1, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 1);
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  update.job = id;
  CHECK_INT(mo_store_change_job(fixture.store, 99, MO_CHANGE_PAUSE, &before), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RESUME, &before), MO_OK);
  CHECK_INT(before, MO_JOB_QUEUED);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, &before), MO_OK);
  CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
  CHECK(!update.applied); /* a paused job does not start */
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, &before), MO_OK);
  CHECK_INT(before, MO_JOB_PAUSED);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_RESUME, &before), MO_OK);
  CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
  CHECK(update.applied);
  REQUIRE(mo_store_job(fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_RUNNING);
  CHECK(job.started_us > 0);
  /* Errors of the runner: twice again, then parked. */
  update.step = MO_STEP_RETRY;
  update.error = MO_ERR_NO_MEMORY;
  update.max_attempts = 2;
  snprintf(update.error_text, sizeof(update.error_text), "ran out");
  CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
  CHECK_INT(update.state, MO_JOB_QUEUED);
  update.step = MO_STEP_START;
  CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
  update.step = MO_STEP_RETRY;
  CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
  CHECK_INT(update.state, MO_JOB_FAILED);
  REQUIRE(mo_store_job(fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.attempts, 2);
  CHECK_INT(job.error, MO_ERR_NO_MEMORY);
  CHECK_TEXT(job.error_text, "ran out");
  CHECK(job.finished_us > 0);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_CANCEL, &before), MO_ERR_CONFLICT);
  /* Fenced: what another opening of the store started is not ours to end. */
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  update = (struct mo_job_update){.job = id, .step = MO_STEP_START};
  CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  update.step = MO_STEP_SUCCEED;
  CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
  CHECK(!update.applied);
  /* Restart after a crash that the marker blames on the job. */
  CHECK_INT(mo_store_requeue(fixture.store, id, 3, "signal 11"), MO_OK);
  REQUIRE(mo_store_job(fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_QUEUED);
  CHECK_INT(job.attempts, 1);
  for (int i = 0; i < 2; i++) {
    update.step = MO_STEP_START;
    CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
    CHECK(update.applied);
    CHECK_INT(mo_store_requeue(fixture.store, i == 0 ? 0 : id, 2, "signal 11"), MO_OK);
  }
  REQUIRE(mo_store_job(fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_TEXT(job.error_text, "signal 11");
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

/* ---- events ---- */

struct heard {
  int64_t sequences[64];
  size_t n;
};

static void hear(void *context, const struct mo_event *events, size_t n)
{
  struct heard *heard = context;
  for (size_t i = 0; i < n && heard->n < 64; i++)
    heard->sequences[heard->n++] = events[i].sequence;
}

static void tells_of_changes(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct heard heard = {.n = 0};
  struct mo_event events[32];
  struct mo_store_config config;
  int64_t id, oldest, newest, n;
  bool replayed;
  int handle;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(4, 1, &forms, &genotypes) == MO_OK);
  CHECK_INT(mo_store_subscribe(fixture.store, hear, &heard, &handle), MO_OK);
  submission = fixture_submission(forms, genotypes, 1);
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  REQUIRE(run_by_hand(fixture.store, id, made_up_loss) == MO_OK);
  mo_store_unsubscribe(fixture.store, handle);
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  CHECK_INT(heard.n, 3);
  n = mo_store_events(fixture.store, 0, 0, events, 32, &oldest, &newest);
  REQUIRE(n == 5); /* the controller, then created, started, finished, created */
  CHECK_TEXT(events[0].type, "controller.stored");
  CHECK_TEXT(events[1].type, "job.created");
  CHECK_TEXT(events[2].type, "job.started");
  CHECK_TEXT(events[3].type, "job.finished");
  CHECK(strstr(events[3].data, "\"succeeded\"") != NULL);
  for (size_t i = 0; i < 3; i++)
    CHECK_INT(heard.sequences[i], events[i + 1].sequence);
  CHECK_INT(oldest, events[0].sequence);
  CHECK_INT(newest, events[4].sequence);
  CHECK_INT(mo_store_events(fixture.store, events[1].sequence, 1, events, 32, NULL, NULL), 2);
  CHECK_INT(mo_store_events(fixture.store, newest, 0, events, 32, NULL, NULL), 0);
  /* Pruned: the oldest that is kept tells. */
  mo_store_close(fixture.store);
  config = (struct mo_store_config){.path = fixture.path, .events_kept = 100};
  REQUIRE(mo_store_open(&config, &fixture.store, NULL) == MO_OK);
  for (int i = 0; i < 1200; i++)
    CHECK_INT(mo_store_change_job(fixture.store, id, i % 2 == 0 ? MO_CHANGE_PAUSE : MO_CHANGE_RESUME, NULL), MO_OK);
  usleep(50000);
  n = mo_store_events(fixture.store, 0, 0, events, 32, &oldest, &newest);
  CHECK(n == 32 && oldest > 900 && newest == 1205);
  CHECK_INT(events[0].sequence, oldest);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

/* ---- designs, controllers, trajectories, backup ---- */

static void ranks_designs(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_controller_record record;
  struct mo_design_query query = {
      .sort = MO_DESIGNS_BY_SCORE, .environment_set = "paper-test", .precision = MO_FLOAT32};
  struct mo_design_row rows[8];
  int64_t id, seen = 0;
  double last = -1;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(6, 20, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 20);
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  REQUIRE(mo_store_controller(fixture.store, "default", &record) == MO_OK);
  query.controller_sha256 = record.sha256;
  query.physics = mo_default_physics();
  CHECK_INT(mo_store_designs(fixture.store, &query, rows, 8), 0);
  REQUIRE(run_by_hand(fixture.store, id, made_up_loss) == MO_OK);
  for (;;) {
    int64_t n = mo_store_designs(fixture.store, &query, rows, 8);
    REQUIRE(n >= 0);
    for (int64_t i = 0; i < n; i++) {
      CHECK(rows[i].score > last);
      last = rows[i].score;
      CHECK(memcmp(&rows[i].form, &forms[seen], sizeof(forms[0])) == 0);
      seen++;
    }
    if (n == 0)
      break;
    query.after_row = rows[n - 1].genotype_row;
    query.after_score = rows[n - 1].score;
  }
  CHECK_INT(seen, 20);
  query = (struct mo_design_query){.sort = MO_DESIGNS_BY_ID};
  CHECK_INT(mo_store_designs(fixture.store, &query, rows, 8), 8);
  CHECK(memcmp(&rows[7].form, &forms[7], sizeof(forms[0])) == 0);
  query.after_row = rows[7].row;
  CHECK_INT(mo_store_designs(fixture.store, &query, rows, 8), 8);
  CHECK(memcmp(&rows[0].form, &forms[8], sizeof(forms[0])) == 0);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void keeps_controllers(void)
{
  struct fixture fixture;
  struct mo_controller_record first, second, listed[4];
  char path[512], digits[65], reference[80], *metadata = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  FILE *file;
  REQUIRE(fixture_start(&fixture) == 0);
  CHECK_INT(mo_store_controller(fixture.store, "default", &first), MO_OK);
  CHECK_INT(first.version, 1);
  CHECK_INT(first.n_parameters, 620912);
  CHECK_INT(mo_store_controller_bytes(fixture.store, &first.sha256, &bytes, &size), MO_OK);
  CHECK_INT(size, first.size);
  free(bytes);
  CHECK_INT(mo_store_controller_metadata(fixture.store, &first.sha256, &metadata), MO_OK);
  CHECK(metadata != NULL && strstr(metadata, "\"sensor\":\"inverse_sqrt\"") != NULL);
  CHECK(metadata != NULL && strstr(metadata, "\"note\":\"a \\\"quoted\\\"\\u000a\\\\ \xc3\xa9 note\"") != NULL);
  free(metadata);
  /* The same content under the same name changes nothing; other content moves the name. */
  CHECK_INT(fixture_controller(fixture.store, "default", 1, &second), MO_OK);
  CHECK(second.version == 1 && second.stored_us == first.stored_us);
  CHECK_INT(fixture_controller(fixture.store, "default", 2, &second), MO_OK);
  CHECK(second.version == 2 && !mo_sha256_equal(&first.sha256, &second.sha256));
  CHECK_INT(fixture_controller(fixture.store, "another-one", 1, &second), MO_OK);
  CHECK_INT(mo_store_controllers(fixture.store, NULL, listed, 4), 2);
  CHECK_TEXT(listed[0].name, "another-one");
  CHECK_INT(mo_store_controllers(fixture.store, "another-one", listed, 4), 1);
  CHECK_TEXT(listed[0].name, "default");
  mo_sha256_to_hex(&first.sha256, digits);
  snprintf(reference, sizeof(reference), "sha256:%s", digits);
  CHECK_INT(mo_store_controller(fixture.store, reference, &second), MO_OK);
  CHECK(mo_sha256_equal(&first.sha256, &second.sha256) && second.name[0] == '\0');
  CHECK_INT(mo_store_controller(fixture.store, "sha256:12", &second), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_controller_remove(fixture.store, "another-one"), MO_OK);
  CHECK_INT(mo_store_controller_remove(fixture.store, "another-one"), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_controller(fixture.store, "another-one", &second), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_controller_name_check("bootstrap"), MO_OK);
  CHECK_INT(mo_controller_name_check("a.b_c-0"), MO_OK);
  CHECK_INT(mo_controller_name_check(""), MO_ERR_FORMAT);
  CHECK_INT(mo_controller_name_check("../x"), MO_ERR_FORMAT);
  CHECK_INT(mo_controller_name_check("Upper"), MO_ERR_FORMAT);
  CHECK_INT(mo_controller_name_check("a/b"), MO_ERR_FORMAT);
  CHECK_INT(mo_controller_name_check("0123456789012345678901234567890123456789012345678901234567890123x"),
            MO_ERR_FORMAT);
  /* A damaged file is found out, and healed by the next upload. */
  snprintf(path, sizeof(path), "%s/controllers/%s.safetensors", fixture.path, digits);
  file = fopen(path, "r+");
  REQUIRE(file != NULL);
  fseek(file, 5000, SEEK_SET);
  fputs("scratched", file);
  fclose(file);
  CHECK_INT(mo_store_controller_bytes(fixture.store, &first.sha256, &bytes, &size), MO_ERR_CORRUPT);
  CHECK_INT(fixture_controller(fixture.store, "default", 1, &second), MO_OK);
  CHECK_INT(mo_store_controller_bytes(fixture.store, &first.sha256, &bytes, &size), MO_OK);
  free(bytes);
  unlink(path);
  CHECK_INT(mo_store_controller_bytes(fixture.store, &first.sha256, &bytes, &size), MO_ERR_CORRUPT);
  fixture_end(&fixture);
}

static void keeps_trajectories(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_trajectory *trajectory = NULL;
  double com[9] = {1, -0.0, NAN, 4, 5, 6, 7, 8, 9};
  float mass[18] = {0.1F, -0.0F, NAN};
  struct mo_saved_trajectory saved = {.design_position = 1,
                                      .environment_position = 4,
                                      .stride = 500,
                                      .frames = 3,
                                      .n_masses = 2,
                                      .com_m = com,
                                      .mass_m = mass};
  struct mo_save save = {.trajectories = &saved, .n_trajectories = 1};
  int64_t id;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(4, 2, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 2);
  submission.record_com = submission.record_masses = true;
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  saved.job = id;
  CHECK_INT(save_and_wait(fixture.store, &save), MO_OK);
  CHECK_INT(mo_store_trajectory(fixture.store, id, 1, 3, &trajectory), MO_ERR_NOT_FOUND);
  REQUIRE(mo_store_trajectory(fixture.store, id, 1, 4, &trajectory) == MO_OK);
  CHECK(memcmp(trajectory->com_m, com, sizeof(com)) == 0);
  CHECK(memcmp(trajectory->mass_m, mass, sizeof(mass)) == 0);
  CHECK(trajectory->stride == 500 && trajectory->n_frames == 3 && trajectory->n_masses == 2 &&
        trajectory->dt_s == 0.004);
  mo_trajectory_free(trajectory);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void backs_up(void)
{
  struct fixture fixture, copy;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_evaluation_results *results = NULL;
  char path[512];
  int64_t id;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_folder(&copy) == 0);
  REQUIRE(fixture_bodies(7, 4, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 4);
  REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
  REQUIRE(run_by_hand(fixture.store, id, made_up_loss) == MO_OK);
  snprintf(path, sizeof(path), "%s/morphod.db", copy.path);
  CHECK_INT(mo_store_backup(fixture.store, path, &fixture.message), MO_OK);
  CHECK_INT(mo_store_backup(fixture.store, path, &fixture.message), MO_ERR_CONFLICT);
  CHECK_INT(fixture_reopen(&copy), MO_OK);
  REQUIRE(mo_store_results(copy.store, id, &results) == MO_OK);
  CHECK(results->losses[13] == made_up_loss(1, 3));
  mo_evaluation_results_free(results);
  CHECK_INT(mo_store_backup(fixture.store, "/nonexistent/folder/copy.db", &fixture.message), MO_ERR_IO);
  free(forms);
  free(genotypes);
  fixture_end(&copy);
  fixture_end(&fixture);
}

static void reports_what_contradicts_itself(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_evaluation_results *results = NULL;
  struct mo_work *work = NULL;
  struct mo_job job;
  int64_t id;
  bool replayed;
  static const char *const damage[] = {
      "PRAGMA ignore_check_constraints=ON; UPDATE scores SET loss=x'0102'",
      "PRAGMA ignore_check_constraints=ON; UPDATE genotypes SET bits=x'01' WHERE id=1",
      "DELETE FROM evaluation_designs WHERE position=1",
      "DELETE FROM evaluation_environments WHERE position=3",
      "UPDATE jobs SET state=42",
      "UPDATE physics SET encoding=x'02'",
      "UPDATE evaluations SET n_designs=1000000",
  };
  for (size_t i = 0; i < sizeof(damage) / sizeof(damage[0]); i++) {
    int job_error, results_error, work_error;
    REQUIRE(fixture_start(&fixture) == 0);
    REQUIRE(fixture_bodies(7, 4, &forms, &genotypes) == MO_OK);
    submission = fixture_submission(forms, genotypes, 4);
    REQUIRE(mo_store_submit(fixture.store, &submission, &id, &replayed) == MO_OK);
    REQUIRE(run_by_hand(fixture.store, id, made_up_loss) == MO_OK);
    mo_store_close(fixture.store);
    fixture.store = NULL;
    REQUIRE(outside(&fixture, damage[i]) == SQLITE_OK);
    REQUIRE(fixture_reopen(&fixture) == MO_OK);
    job_error = mo_store_job(fixture.store, id, &job);
    results_error = mo_store_results(fixture.store, id, &results);
    if (results_error == MO_OK)
      mo_evaluation_results_free(results);
    work_error = mo_store_load_work(fixture.store, id, &work);
    if (work_error == MO_OK)
      mo_work_free(work);
    CHECK(job_error == MO_ERR_CORRUPT || results_error == MO_ERR_CORRUPT || work_error == MO_ERR_CORRUPT);
    CHECK(job_error == MO_OK || job_error == MO_ERR_CORRUPT);
    CHECK(results_error == MO_OK || results_error == MO_ERR_CORRUPT);
    CHECK(work_error == MO_OK || work_error == MO_ERR_CORRUPT);
    free(forms);
    free(genotypes);
    fixture_end(&fixture);
  }
}

static const struct check_case cases[] = {
    {"opens, counts its openings, and keeps others out", opens_and_locks},
    {"refuses newer schemas and files that are not its own", refuses_what_is_not_ours},
    {"notices damage after an unclean stop", notices_damage_after_an_unclean_stop},
    {"submits a job and reads it back", submits_and_reads_back},
    {"shares a design between its orientations", shares_designs_between_orientations},
    {"keeps every bit of a loss", keeps_every_bit},
    {"answers a repeated key with the same job", answers_a_repeated_key},
    {"pages through jobs", pages_through_jobs},
    {"changes states only as the machine allows", changes_states},
    {"tells of changes, in order, and prunes", tells_of_changes},
    {"ranks designs by score", ranks_designs},
    {"keeps controllers by content and by name", keeps_controllers},
    {"keeps trajectories", keeps_trajectories},
    {"backs up", backs_up},
    {"reports what contradicts itself", reports_what_contradicts_itself},
};
CHECK_MAIN(cases)
