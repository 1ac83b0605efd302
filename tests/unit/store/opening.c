/* opening.c: which databases the store opens, and how it notices damage. */
#include "by_hand.h"
#include "one_store.h"
#include "store/internal.h"

#define NEWEST 15 /* schema */

static void opens_and_locks(void)
{
  struct mo_store_config config = {.path = fixture.path};
  struct mo_store *second = NULL;
  CHECK_INT(store->epoch, 1);
  CHECK_INT(mo_store_open(&config, &second, &fixture.message), MO_ERR_BUSY);
  CHECK_SAYS(fixture.message, "another process");
  CHECK_OK(check_whole());
  REQUIRE_OK(reopen());
  CHECK_INT(store->epoch, 2);
  close_store();
  CHECK_INT(outside_integer("PRAGMA application_id"), 0x6D727068);
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
  CHECK_INT(outside_integer("SELECT value FROM meta WHERE key='clean'"), 1);
  CHECK_INT(outside_integer(
                "SELECT count(*) FROM sqlite_schema WHERE type='table' AND name NOT LIKE 'sqlite%'"
                " AND sql NOT LIKE '%STRICT%'"),
            0);
  config.path = "/nonexistent/folder";
  CHECK_INT(mo_store_open(&config, &second, &fixture.message), MO_ERR_NOT_FOUND);
}

/* Writes noise over n bytes of the database from `at` on. */
static void scribble(long at, size_t n)
{
  void *noise = make_zeros(n, 1);
  memset(noise, 0x5a, n);
  CHECK_OK(overwrite(path_of("morphod.db"), at, noise, n));
}

static void refuses_what_is_not_ours(void)
{
  CHECK_INT(reopen_after("PRAGMA user_version=99"), MO_ERR_UNSUPPORTED);
  CHECK_SAYS(fixture.message, "99"); /* written by a newer program */
  CHECK_INT(reopen_after("PRAGMA user_version=15; PRAGMA application_id=7"), MO_ERR_FORMAT);
  CHECK_OK(reopen_after("PRAGMA application_id=1836216424"));
  close_store();
  scribble(0, 8192); /* no database, whatever its name says */
  CHECK_INT(reopen(), MO_ERR_FORMAT);
}

/* The folder is refused, says so, and is left as it was. */
static void refuses_version_0_1(void)
{
  for (int version = 1; version <= 8; version++) {
    char sql[64];
    snprintf(sql, sizeof(sql), "PRAGMA user_version=%d", version);
    CHECK_INT(reopen_after(sql), MO_ERR_UNSUPPORTED);
    CHECK_SAYS(fixture.message, "was written by morphod 0.1");
    CHECK_SAYS(fixture.message, fixture.path);
    CHECK_INT(outside_integer("PRAGMA user_version"), version);
    CHECK_INT(outside_integer("SELECT value FROM meta WHERE key='epoch'"), 1);
  }
  CHECK_OK(reopen_after("PRAGMA user_version=15"));
}

/* A database of version 9: what later ones added is not there. */
static const char version_9[] =
    "DROP TABLE imports; DROP TABLE device_class; ALTER TABLE campaign_losses "
    "DROP COLUMN origins;"
    "ALTER TABLE campaign_designs DROP COLUMN is_cut; ALTER TABLE campaigns DROP COLUMN race_pays;"
    "ALTER TABLE campaign_generations DROP COLUMN children_cut;"
    "DROP INDEX trajectories_path; ALTER TABLE trajectories DROP COLUMN path_m;"
    "DROP TABLE design_notes; ALTER TABLE evaluations DROP COLUMN n_skipped;"
    "ALTER TABLE evaluations DROP COLUMN best; ALTER TABLE evaluations DROP COLUMN cut;"
    "ALTER TABLE job_designs DROP COLUMN counted;"
    "DROP INDEX evaluations_waiting; ALTER TABLE evaluations DROP COLUMN random_seed;"
    "ALTER TABLE evaluations DROP COLUMN random_first; DROP TABLE waiting_designs;"
    "ALTER TABLE evaluations DROP COLUMN n_waiting;"
    "DROP TABLE study_words; DROP TABLE studies;"
    "ALTER TABLE campaign_designs DROP COLUMN measures;"
    "DROP INDEX jobs_by_experiment; DROP INDEX jobs_archived; DROP INDEX jobs_by_end;"
    "DROP INDEX idempotency_keys_of_job; DROP INDEX trainings_of_population;"
    "DROP INDEX campaigns_of_initial; DROP INDEX runs_of_controller;"
    "DROP TRIGGER usage_of_new; DROP TRIGGER usage_of_changed; DROP TABLE usage;"
    "ALTER TABLE jobs DROP COLUMN experiment; ALTER TABLE jobs DROP COLUMN note;"
    "ALTER TABLE jobs DROP COLUMN archived_us; ALTER TABLE jobs DROP COLUMN worker_s;"
    "ALTER TABLE jobs DROP COLUMN device_s;"
    "DROP INDEX jobs_of_user; DROP INDEX jobs_of_user_by_state; DROP INDEX jobs_of_user_by_kind;"
    "DROP INDEX jobs_of_user_by_kind_and_state; DROP INDEX jobs_of_user_by_label;"
    "DROP INDEX jobs_of_user_by_label_and_state; DROP INDEX jobs_of_user_by_label_and_kind;"
    "DROP INDEX jobs_of_user_by_label_kind_and_state;"
    "ALTER TABLE jobs DROP COLUMN submitted_by;"
    "ALTER TABLE trajectories DROP COLUMN actuation;"
    "ALTER TABLE trajectories DROP COLUMN contacts;"
    "DROP INDEX evaluations_recorded;"
    "DELETE FROM meta WHERE key='recorded bytes';"
    "ALTER TABLE evaluations DROP COLUMN recorded_bytes;"
    "ALTER TABLE evaluations DROP COLUMN recordings_removed_us; PRAGMA user_version=9";

/* The store is whole, and was made one of the newest version. Closes it. */
static void check_newest(void)
{
  CHECK_OK(check_whole());
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
}

/* Recordings of version 9 are read as before; new ones have the channels of version 10. */
static void keeps_recordings_of_version_9(void)
{
  struct mo_evaluation_request submission = draw_evaluation(3, 1);
  struct mo_trajectory *trajectory = NULL;
  double com_m[9] = {1, 2, 3};
  int8_t actuation[6] = {0, 0, -127, 127};
  struct mo_saved_trajectory saved = {
      .frames = 3, .n_masses = 8, .n_springs = 2, .recording = {.stride = 10, .com_m = com_m}};
  struct mo_save save = {.trajectories = &saved, .n_trajectories = 1};
  submission.record = MO_RECORD_COM | MO_RECORD_ACTUATION;
  saved.job = submit_evaluation(&submission);
  CHECK_OK(save_and_wait(&save));
  REQUIRE_OK(reopen_after(version_9));
  const struct mo_job job = job_of(saved.job);
  CHECK(job.recorded_bytes == sizeof(com_m) && job.recordings_removed_us == 0);
  saved.design_position = 1;
  saved.recording.actuation = actuation;
  CHECK_OK(save_and_wait(&save));
  for (uint32_t n = 0; n < 2; n++) {
    REQUIRE_OK(mo_store_trajectory(store, saved.job, n, 0, &trajectory));
    CHECK(SAME(trajectory->recording.com_m, com_m, 9));
    CHECK((trajectory->recording.actuation != NULL) == (n == 1));
    CHECK(n == 0 || SAME(trajectory->recording.actuation, actuation, 6));
    mo_trajectory_free(trajectory);
  }
  check_newest();
}

/* Jobs of version 9 are read and found as before; new ones say who submitted them. */
static void keeps_jobs_of_version_9(void)
{
  struct mo_evaluation_request submission = draw_evaluation(2, 3);
  const struct mo_job_query query = {.state = -1, .kind = -1, .submitted_by = "anna"};
  struct mo_job jobs[3];
  submission.job.label = "old";
  submission.job.submitted_by = "anna";
  const int64_t old = submit_evaluation(&submission);
  REQUIRE(old > 0);
  REQUIRE_OK(reopen_after(version_9));
  jobs[0] = job_of(old);
  CHECK_TEXT(jobs[0].label, "old");
  CHECK_TEXT(jobs[0].submitted_by, "");
  CHECK_INT(mo_store_jobs(store, &query, jobs, 3), 0);
  const int64_t new = submit_evaluation(&submission);
  CHECK_INT(mo_store_jobs(store, &query, jobs, 3), 1);
  CHECK_INT(jobs[0].id, new);
  CHECK_TEXT(jobs[0].submitted_by, "anna");
  check_newest();
}

/* The root page of a table or an index becomes noise; the header and the schema stay. */
static void names_damaged_pages(void)
{
  static const char *const damaged[] = {"environments", "jobs_by_state"};
  for (size_t i = 0; i < COUNT(damaged); i++) {
    char sql[128];
    CHECK_OK(reopen_after("UPDATE meta SET value=0 WHERE key='clean'")); /* unclean, but whole */
    close_store();
    REQUIRE(outside("UPDATE meta SET value=0 WHERE key='clean'; PRAGMA wal_checkpoint(TRUNCATE)") ==
            SQLITE_OK);
    snprintf(sql, sizeof(sql), "SELECT rootpage FROM sqlite_schema WHERE name='%s'", damaged[i]);
    long page = (long)outside_integer(sql);
    REQUIRE(page > 1);
    scribble(4096L * (page - 1), 4096);
    CHECK_INT(reopen(), MO_ERR_CORRUPT);
    snprintf(sql, sizeof(sql), "Page %ld: ", page);
    CHECK(strstr(fixture.message.text, "the database is damaged") != NULL &&
          strstr(fixture.message.text, sql) != NULL);
    start_over();
  }
}

/* Rows that the schema does not allow count as damage, too. */
/* After each, the numbers of events jump; those that are kept stay, however often that happens. */
static void keeps_events_after_unclean_stops(void)
{
  static const char oldest_sql[] = "SELECT min(sequence) FROM events",
                    newest_sql[] = "SELECT max(sequence) FROM events";
  const struct mo_store_config config = {.path = fixture.path, .events_kept = 2000};
  close_store();
  const int64_t oldest = outside_integer(oldest_sql);
  for (int i = 0; i < 10; i++) {
    const int64_t newest = outside_integer(newest_sql);
    REQUIRE_OK(outside("UPDATE meta SET value=0 WHERE key='clean'"));
    REQUIRE_OK(mo_store_open(&config, &store, &fixture.message));
    for (int k = 0; k < (i < 9 ? 1 : 1001); k++) /* after so many, older ones are pruned */
      CHECK_OK(mo_store_event(store, "test.started", "{}"));
    close_store();
    CHECK(outside_integer(newest_sql) > newest + 250);
  }
  CHECK_INT(outside_integer(oldest_sql), oldest);
  CHECK_INT(outside_integer("SELECT count(*) FROM events WHERE type='test.started'"), 1010);
}

static void checks_rows_after_an_unclean_stop(void)
{
  CHECK_INT(reopen_after("PRAGMA ignore_check_constraints=ON; UPDATE environments SET data=x'02'"
                         " WHERE id=3; UPDATE meta SET value=0 WHERE key='clean'"),
            MO_ERR_CORRUPT);
  CHECK_SAYS(fixture.message, "CHECK constraint failed in environments");
}

/* A set of this name that the folder has already is left alone; one that is missing is made. */
static void makes_the_paper_test_once(void)
{
  static const char members[] = "SELECT count(*) FROM environment_set_members";
  CHECK_OK(reopen_after("DELETE FROM environment_set_members WHERE position=1"));
  CHECK_INT(outside_integer(members), MO_PAPER_TEST_COUNT - 1);
  CHECK_OK(reopen_after("DELETE FROM environment_set_members; DELETE FROM environment_sets"));
  CHECK_INT(outside_integer(members), MO_PAPER_TEST_COUNT);
  CHECK_INT(outside_integer("SELECT count(*) FROM environments"), MO_PAPER_TEST_COUNT);
}

static void reports_what_contradicts_itself(void)
{
  struct mo_evaluation_results *results = NULL;
  struct mo_work *work = NULL;
  struct mo_job job;
  int64_t id;
  static const char *const damage[] = {
      "PRAGMA ignore_check_constraints=ON; UPDATE scores SET losses=x'0102'",
      "PRAGMA ignore_check_constraints=ON; UPDATE genotypes SET bits=x'01' WHERE id=1",
      "DELETE FROM job_designs WHERE position=1",
      "DELETE FROM job_environments WHERE position=3",
      "UPDATE jobs SET state=42",
      "UPDATE physics SET encoding=x'02'",
      "UPDATE evaluations SET n_designs=1000000",
      "UPDATE jobs SET kind=3",
      "DELETE FROM evaluations",
  };
  for (size_t i = 0; i < COUNT(damage); i++) {
    uint64_t counts[MO_JOB_STATES];
    const struct mo_evaluation_request submission = draw_evaluation(7, 4);
    id = submit_evaluation(&submission);
    REQUIRE_OK(run_by_hand(id, made_up_loss));
    REQUIRE_OK(reopen_after(damage[i]));
    int job_error = mo_store_job(store, id, &job);
    int list_error = (int)mo_store_jobs(store, &any_job, &job, 1);
    CHECK_INT(list_error, job_error == MO_OK ? 1 : job_error);
    CHECK_OK(mo_store_job_counts(store, counts));
    int results_error = mo_store_results(store, id, &results);
    if (results_error == MO_OK)
      mo_evaluation_results_free(results);
    int work_error = mo_store_load_work(store, id, fixture_classes(1), &work);
    if (work_error == MO_OK)
      mo_work_free(work);
    CHECK(job_error == MO_ERR_CORRUPT || results_error == MO_ERR_CORRUPT ||
          work_error == MO_ERR_CORRUPT);
    CHECK(job_error == MO_OK || job_error == MO_ERR_CORRUPT);
    CHECK(results_error == MO_OK || results_error == MO_ERR_CORRUPT ||
          results_error == MO_ERR_NOT_FOUND);
    CHECK(work_error == MO_OK || work_error == MO_ERR_CORRUPT || work_error == MO_ERR_NOT_FOUND);
    start_over();
  }
}

static const struct check_case cases[] = {
    {"opens, counts its openings, and keeps others out", opens_and_locks},
    {"refuses newer schemas and files that are not its own", refuses_what_is_not_ours},
    {"checks rows after one", checks_rows_after_an_unclean_stop},
    {"keeps events after many unclean stops", keeps_events_after_unclean_stops},
    {"makes the paper's test set once", makes_the_paper_test_once},
    {"names damaged pages after an unclean stop", names_damaged_pages},
    {"refuses a folder of version 0.1", refuses_version_0_1},
    {"keeps recordings of version 9", keeps_recordings_of_version_9},
    {"keeps jobs of version 9", keeps_jobs_of_version_9},
    {"reports what contradicts itself", reports_what_contradicts_itself},
};
CHECK_MAIN_AROUND(cases, with_a_store)
