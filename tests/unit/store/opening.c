/* opening.c: which databases the store opens, how it notices damage, and the way there from older
 * ones; backups. */
#include "by_hand.h"
#include "campaign_fixture.h"
#include "store/internal.h"
#include "training_fixture.h"

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
  CHECK_INT(outside_integer(&fixture, "PRAGMA user_version"), 8);
  CHECK_INT(outside_integer(&fixture, "SELECT value FROM meta WHERE key='clean'"), 1);
  CHECK_INT(outside_integer(
                &fixture,
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
  REQUIRE(outside(&fixture, "PRAGMA user_version=8; PRAGMA application_id=7") == SQLITE_OK);
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
  REQUIRE(outside(&fixture,
                  "UPDATE meta SET value=0 WHERE key='clean'; PRAGMA wal_checkpoint(TRUNCATE)") ==
          SQLITE_OK);
  snprintf(path, sizeof(path), "%s/morphod.db", fixture.path);
  file = fopen(path, "r+");
  REQUIRE(file != NULL);
  /* The root page of some index becomes noise; the header and the schema stay. */
  fseek(file,
        4096L *
            (long)(outside_integer(
                       &fixture, "SELECT rootpage FROM sqlite_schema WHERE name='jobs_by_state'") -
                   1),
        SEEK_SET);
  for (int i = 0; i < 4096; i++)
    fputc(0x5a, file);
  fclose(file);
  CHECK_INT(fixture_reopen(&fixture), MO_ERR_CORRUPT);
  fixture_end(&fixture);
}

/* Rows that the schema does not allow count as damage, too. */
static void checks_rows_after_an_unclean_stop(void)
{
  struct fixture fixture;
  REQUIRE(fixture_start(&fixture) == 0);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(outside(&fixture,
                  "PRAGMA ignore_check_constraints=ON; UPDATE environments SET data=x'02' WHERE "
                  "id=3; UPDATE meta SET value=0 WHERE key='clean'") == SQLITE_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_ERR_CORRUPT);
  CHECK(strstr(fixture.message.text, "CHECK constraint failed in environments") != NULL);
  fixture_end(&fixture);
}

/* A set of this name that the folder has already is left alone; one that is missing is made. */
static void makes_the_paper_test_once(void)
{
  struct fixture fixture;
  REQUIRE(fixture_start(&fixture) == 0);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(outside(&fixture, "DELETE FROM environment_set_members WHERE position=1") == SQLITE_OK);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  CHECK_INT(outside_integer(&fixture, "SELECT count(*) FROM environment_set_members"),
            MO_PAPER_TEST_COUNT - 1);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(outside(&fixture, "DELETE FROM environment_set_members; DELETE FROM environment_sets") ==
          SQLITE_OK);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  CHECK_INT(outside_integer(&fixture, "SELECT count(*) FROM environment_set_members"),
            MO_PAPER_TEST_COUNT);
  CHECK_INT(outside_integer(&fixture, "SELECT count(*) FROM environments"), MO_PAPER_TEST_COUNT);
  fixture_end(&fixture);
}

static void names_damaged_pages(void)
{
  static const char *const damaged[] = {"environments", "jobs_by_state"}; /* a table, an index */
  for (size_t i = 0; i < sizeof(damaged) / sizeof(damaged[0]); i++) {
    struct fixture fixture;
    char path[512], sql[128];
    FILE *file;
    REQUIRE(fixture_start(&fixture) == 0);
    mo_store_close(fixture.store);
    fixture.store = NULL;
    REQUIRE(outside(&fixture,
                    "UPDATE meta SET value=0 WHERE key='clean'; PRAGMA wal_checkpoint(TRUNCATE)") ==
            SQLITE_OK);
    snprintf(path, sizeof(path), "%s/morphod.db", fixture.path);
    snprintf(sql, sizeof(sql), "SELECT rootpage FROM sqlite_schema WHERE name='%s'", damaged[i]);
    const long page = (long)outside_integer(&fixture, sql);
    file = fopen(path, "r+");
    REQUIRE(file != NULL && page > 1);
    fseek(file, 4096L * (page - 1), SEEK_SET);
    for (int k = 0; k < 4096; k++)
      fputc(0x5a, file);
    fclose(file);
    CHECK_INT(fixture_reopen(&fixture), MO_ERR_CORRUPT);
    snprintf(sql, sizeof(sql), "Page %ld: ", page);
    CHECK(strstr(fixture.message.text, "the database is damaged") != NULL &&
          strstr(fixture.message.text, sql) != NULL);
    fixture_end(&fixture);
  }
}

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

/* Makes the database one of schema `version` with the same data: the first migrations alone, and of
 * every row what it had then. */
static int downgrade(const struct fixture *fixture, int version)
{
  static const char *const files[] = {"0001_initial",       "0002_trainings", "0003_weights",
                                      "0004_training_code", "0005_campaigns", "0006_devices"};
  static const char *const settings_of[] = {"trainings", "campaigns"};
  char now[512], old[512], migration[512], sql[2048];
  sqlite3 *db = NULL;
  sqlite3_stmt *tables = NULL;
  int result;
  snprintf(now, sizeof(now), "%s/morphod.db", fixture->path);
  snprintf(old, sizeof(old), "%s/old.db", fixture->path);
  result = sqlite3_open(old, &db);
  for (int i = 0; i < version && result == SQLITE_OK; i++) {
    snprintf(migration, sizeof(migration), "%s/schema/migrations/%s.sql",
             getenv("MORPHO_SOURCE_DIR"), files[i]);
    char *schema = read_text(migration);
    result = schema != NULL ? sqlite3_exec(db, schema, NULL, NULL, NULL) : SQLITE_CANTOPEN;
    free(schema);
  }
  snprintf(sql, sizeof(sql), "PRAGMA application_id=%d; PRAGMA user_version=%d; ATTACH '%s' AS new",
           0x6D727068, version, now);
  if (result == SQLITE_OK)
    result = sqlite3_exec(db, sql, NULL, NULL, NULL);
  if (result == SQLITE_OK)
    result =
        sqlite3_prepare_v2(db,
                           "SELECT t.name,group_concat(c.name) FROM main.sqlite_schema t, "
                           "pragma_table_info(t.name,'main') c"
                           " WHERE t.type='table' AND t.name NOT LIKE 'sqlite%' GROUP BY t.name",
                           -1, &tables, NULL);
  while (result == SQLITE_OK && sqlite3_step(tables) == SQLITE_ROW) {
    const char *table = (const char *)sqlite3_column_text(tables, 0);
    const char *columns = (const char *)sqlite3_column_text(tables, 1);
    snprintf(sql, sizeof(sql), "INSERT INTO main.%s(%s) SELECT %s FROM new.%s", table, columns,
             columns, table);
    result = sqlite3_exec(db, sql, NULL, NULL, NULL);
  }
  sqlite3_finalize(tables);
  /* Settings of version 1: without the twelve bytes of the rule and its weight at their end. */
  for (int i = 0; i < (version >= 5 ? 2 : version >= 2 ? 1 : 0) && result == SQLITE_OK; i++) {
    snprintf(
        sql, sizeof(sql),
        "UPDATE main.%s SET settings=CAST(x'01'||substr(settings,2,length(settings)-13) AS BLOB)",
        settings_of[i]);
    result = sqlite3_exec(db, sql, NULL, NULL, NULL);
  }
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

/* A training that was begun before fingerprints were kept goes on, and says that it does not know.
 */
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
  REQUIRE(mo_store_training_checkpoint(fixture.store, id, 1, (const uint8_t *)"one", 3, 2) ==
          MO_OK);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(downgrade(&fixture, 2) == SQLITE_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  CHECK(size == 3 && memcmp(bytes, "one", 3) == 0);
  free(bytes);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK(status.code.n == 1 && status.code.codes[0].from_step == 0 &&
        status.code.codes[0].fingerprint[0] == '\0');
  CHECK_INT(mo_store_training(fixture.store, fresh, &status), MO_OK);
  CHECK_INT(status.code.n, 0);
  CHECK_INT(mo_store_requeue(fixture.store, 0, 3, ""), MO_OK);
  REQUIRE(mo_store_training_start(fixture.store, id) == MO_OK);
  CHECK_INT(mo_store_training_code(fixture.store, id, 1, "now", &lineage), MO_OK);
  CHECK(lineage.n == 2 && lineage.codes[1].from_step == 1 &&
        strcmp(lineage.codes[1].fingerprint, "now") == 0);
  for (int64_t after = 0; mo_store_events(fixture.store, after, id, &event, 1, NULL, NULL) == 1;
       after = newest)
    newest = event.sequence;
  CHECK_TEXT(event.type, "training.code_changed");
  CHECK(strstr(event.data, "\"before\":null") != NULL);
  fixture_end(&fixture);
}

/* Settings from before there were rules of the adjoint are read: they clip, with the usual weight.
 * Those that come to them keep theirs. */
static void migrates_settings(void)
{
  struct fixture fixture;
  struct mo_training_submission training = submission_of(100);
  struct mo_campaign_submission campaign = campaign_submission(MO_SIMULTANEOUS, 10, 30);
  struct mo_training_status status;
  struct mo_campaign_status evolved;
  int64_t trained[2], bred[2];
  REQUIRE(fixture_start(&fixture) == 0);
  trained[0] = submit(&fixture, &training);
  bred[0] = campaign_submit(&fixture, &campaign);
  REQUIRE(trained[0] > 0 && bred[0] > 0);
  mo_store_close(fixture.store);
  fixture.store = NULL;
  REQUIRE(downgrade(&fixture, 6) == SQLITE_OK);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  trained[1] = submit(&fixture, &training);
  bred[1] = campaign_submit(&fixture, &campaign);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  CHECK_INT(outside_integer(&fixture, "PRAGMA user_version"), 8);
  CHECK_INT(
      outside_integer(&fixture, "SELECT count(*) FROM trainings WHERE substr(settings,1,1)=x'01'"),
      1);
  for (int i = 0; i < 2; i++) {
    const enum mo_adjoint_rule rule = i == 0 ? MO_ADJOINT_CLIP : MO_ADJOINT_RESTART;
    const double weight = i == 0 ? MO_RESTART_WEIGHT : 2.5;
    CHECK_INT(mo_store_training(fixture.store, trained[i], &status), MO_OK);
    CHECK_INT(status.record.settings.learning.adjoint_rule, rule);
    CHECK(status.record.settings.learning.restart_weight == weight);
    CHECK(status.record.settings.learning.adjoint_bound == 2 &&
          status.record.settings.n_steps == 100);
    CHECK_INT(mo_store_campaign(fixture.store, bred[i], &evolved), MO_OK);
    CHECK_INT(evolved.record.settings.learning.adjoint_rule, rule);
    CHECK(evolved.record.settings.learning.restart_weight == weight);
    CHECK(evolved.record.settings.learning.adjoint_bound == 2 &&
          evolved.record.settings.population == 10);
  }
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
  CHECK_INT(mo_store_backup(fixture.store, "/nonexistent/folder/copy.db", &fixture.message),
            MO_ERR_IO);
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
      "UPDATE jobs SET kind=3",
      "DELETE FROM evaluations",
  };
  for (size_t i = 0; i < sizeof(damage) / sizeof(damage[0]); i++) {
    const struct mo_job_query all = {.state = -1, .kind = -1};
    uint64_t counts[MO_JOB_STATES];
    int job_error, list_error, results_error, work_error;
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
    list_error = (int)mo_store_jobs(fixture.store, &all, &job, 1);
    CHECK_INT(list_error, job_error == MO_OK ? 1 : job_error);
    CHECK_INT(mo_store_job_counts(fixture.store, counts), MO_OK);
    results_error = mo_store_results(fixture.store, id, &results);
    if (results_error == MO_OK)
      mo_evaluation_results_free(results);
    work_error = mo_store_load_work(fixture.store, id, &work);
    if (work_error == MO_OK)
      mo_work_free(work);
    CHECK(job_error == MO_ERR_CORRUPT || results_error == MO_ERR_CORRUPT ||
          work_error == MO_ERR_CORRUPT);
    CHECK(job_error == MO_OK || job_error == MO_ERR_CORRUPT);
    CHECK(results_error == MO_OK || results_error == MO_ERR_CORRUPT ||
          results_error == MO_ERR_NOT_FOUND);
    CHECK(work_error == MO_OK || work_error == MO_ERR_CORRUPT || work_error == MO_ERR_NOT_FOUND);
    free(forms);
    free(genotypes);
    fixture_end(&fixture);
  }
}

static const struct check_case cases[] = {
    {"opens, counts its openings, and keeps others out", opens_and_locks},
    {"refuses newer schemas and files that are not its own", refuses_what_is_not_ours},
    {"notices damage after an unclean stop", notices_damage_after_an_unclean_stop},
    {"checks rows after one", checks_rows_after_an_unclean_stop},
    {"makes the paper's test set once", makes_the_paper_test_once},
    {"names damaged pages", names_damaged_pages},
    {"migrates an old database", migrates_an_old_database},
    {"migrates a training", migrates_a_training},
    {"migrates settings", migrates_settings},
    {"backs up", backs_up},
    {"reports what contradicts itself", reports_what_contradicts_itself},
};
CHECK_MAIN(cases)
