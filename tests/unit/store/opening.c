/* opening.c: which databases the store opens, and how it detects damage. */
#include "by_hand.h"
#include "one_store.h"
#include "store/atlases.h"
#include "store/certificates.h"
#include "store/internal.h"
#include "store/training_bodies.h"
#include "store/worlds.h"
#include "training_fixture.h"

#define NEWEST 25 /* schema */
/* Takes back what versions 18 to 25 added. */
#define DROP_COLUMN(name) "ALTER TABLE campaign_generations DROP COLUMN held_out_" name ";"
#define WITHOUT_25                                                                                 \
  "DROP TABLE training_bodies; ALTER TABLE atlases DROP COLUMN measures; DROP TABLE "              \
  "certificate_verdicts; DROP TABLE "                                                              \
  "campaign_held_out;" DROP_COLUMN("designs") DROP_COLUMN("worlds") DROP_COLUMN("rollouts")        \
      DROP_COLUMN("diverged") DROP_COLUMN("mean") DROP_COLUMN("standard_error") DROP_COLUMN("low") \
          DROP_COLUMN("high") DROP_COLUMN("top_mean") DROP_COLUMN("top_score")
#define WITHOUT_24 WITHOUT_25 "DROP TABLE certificate_losses; DROP TABLE certificates;"
#define WITHOUT_23 WITHOUT_24 "DROP TABLE atlases;"
#define WITHOUT_22 "ALTER TABLE measures DROP COLUMN origin;" WITHOUT_23
#define WITHOUT_21 "ALTER TABLE evaluations DROP COLUMN suite;" WITHOUT_22
#define WITHOUT_20 "ALTER TABLE campaign_losses DROP COLUMN measures;" WITHOUT_21
#define WITHOUT_19 "ALTER TABLE evaluations DROP COLUMN tolerance;" WITHOUT_20
#define WITHOUT_18 "ALTER TABLE evaluations DROP COLUMN measures;" WITHOUT_19 "DROP TABLE measures;"

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

/* Writes noise over n bytes of the database, from offset `at`. */
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
  CHECK_INT(reopen_after("PRAGMA user_version=25; PRAGMA application_id=7"), MO_ERR_FORMAT);
  CHECK_OK(reopen_after("PRAGMA application_id=1836216424"));
  close_store();
  scribble(0, 8192); /* not a database, despite its name */
  CHECK_INT(reopen(), MO_ERR_FORMAT);
}

/* The folder is refused with a message, and left unchanged. */
static void refuses_older_versions(void)
{
  for (int version = 1; version <= 13; version++) {
    char sql[64];
    snprintf(sql, sizeof(sql), "PRAGMA user_version=%d", version);
    CHECK_INT(reopen_after(sql), MO_ERR_UNSUPPORTED);
    CHECK_SAYS(fixture.message, version <= 8
                                    ? "was written by morphod 0.1"
                                    : "of an unreleased program; this version reads 14 to 25");
    CHECK_SAYS(fixture.message, "an empty folder");
    CHECK_SAYS(fixture.message, fixture.path);
    CHECK_INT(outside_integer("PRAGMA user_version"), version);
    CHECK_INT(outside_integer("SELECT value FROM meta WHERE key='epoch'"), 1);
  }
  CHECK_OK(reopen_after("PRAGMA user_version=25"));
}

/* Jobs of version 14 are read as before; tables that are no longer used are dropped. */
static void opens_version_14(void)
{
  struct mo_evaluation_request submission = draw_evaluation(2, 3);
  submission.job.label = "old";
  const int64_t old = submit_evaluation(&submission);
  REQUIRE(old > 0);
  REQUIRE_OK(reopen_after("CREATE TABLE outcasts(user TEXT, name TEXT) STRICT;"
                          "INSERT INTO outcasts VALUES('','liar');"
                          "ALTER TABLE controllers DROP COLUMN control_period_s;"
                          "ALTER TABLE evaluations DROP COLUMN n_displaced;" WITHOUT_18
                          "PRAGMA user_version=14"));
  CHECK_TEXT(job_of(old).label, "old");
  CHECK_OK(check_whole());
  CHECK_INT(outside_integer("SELECT count(*) FROM controllers WHERE control_period_s=0"),
            outside_integer("SELECT count(*) FROM controllers"));
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
  CHECK_INT(outside_integer("SELECT count(*) FROM sqlite_schema WHERE name='outcasts'"), 0);
}

/* Jobs of version 15 estimate no errors; lists of jobs that have ended are deleted. */
static void opens_version_15(void)
{
  struct mo_evaluation_request submission = draw_evaluation(2, 3);
  const int64_t old = submit_evaluation(&submission), open = submit_evaluation(&submission);
  char sql[2048];
  REQUIRE(old > 0 && open > old);
  snprintf(sql, sizeof(sql),
           "INSERT INTO waiting_designs(job,first,bits,checksum) VALUES(%lld,0,x'00',0),"
           "(%lld,0,x'00',0);"
           "UPDATE jobs SET state=5 WHERE id=%lld;"
           "ALTER TABLE evaluations DROP COLUMN n_displaced;" WITHOUT_18 "PRAGMA user_version=15",
           (long long)old, (long long)open, (long long)old);
  REQUIRE_OK(reopen_after(sql));
  CHECK_INT(job_of(open).n_displaced, 0);
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
  snprintf(sql, sizeof(sql), "SELECT job FROM waiting_designs");
  CHECK_INT(outside_integer(sql), open);
  CHECK_INT(outside_integer("SELECT count(*) FROM waiting_designs"), 1);
}

/* The data of environments had a fixed length. */
static void opens_version_16(void)
{
  static const char old[] = "SELECT count(*) FROM sqlite_schema WHERE name='environments' AND sql"
                            " LIKE '%length(data) = 528%'";
  close_store();
  CHECK_INT(outside_integer(old), 0);
  REQUIRE(outside(WITHOUT_18) == SQLITE_OK);
  REQUIRE(outside("PRAGMA writable_schema=ON;"
                  "UPDATE sqlite_schema SET sql=replace(sql,'>= 528','= 528') WHERE"
                  " name='environments'; PRAGMA user_version=16") == SQLITE_OK);
  CHECK_INT(outside_integer(old), 1);
  REQUIRE_OK(reopen());
  struct mo_evaluation_request submission = draw_evaluation(2, 3);
  struct mo_environment tasked;
  mo_environment_training(1, 0, 0, &tasked);
  tasked.task.objective = MO_OBJECTIVE_APPROACH;
  submission.environment_set = NULL;
  submission.environments = &tasked;
  submission.n_environments = 1;
  CHECK(submit_evaluation(&submission) > 0);
  CHECK_OK(check_whole());
  close_store();
  CHECK_INT(outside_integer(old), 0);
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
}

/* Evaluations of version 17 have no measures. */
static void opens_version_17(void)
{
  struct mo_evaluation_request submission = draw_evaluation(2, 3);
  const int64_t old = submit_evaluation(&submission);
  REQUIRE(old > 0);
  REQUIRE_OK(reopen_after(WITHOUT_18 "PRAGMA user_version=17"));
  CHECK_INT(job_of(old).measures, 0);
  submission.measures = MO_MEASURES_ALL;
  const int64_t new = submit_evaluation(&submission);
  CHECK_INT(job_of(new).measures, MO_MEASURES_ALL);
  CHECK_OK(check_whole());
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
  CHECK_INT(outside_integer("SELECT count(*) FROM measures"), 0);
}

/* Those of version 18 have no tolerance. */
static void opens_version_18(void)
{
  struct mo_evaluation_request submission = draw_evaluation(2, 3);
  submission.n_displaced = MO_ERROR_DISPLACED;
  const int64_t old = submit_evaluation(&submission);
  REQUIRE(old > 0);
  REQUIRE_OK(reopen_after(WITHOUT_19 "PRAGMA user_version=18"));
  CHECK_NEAR(job_of(old).tolerance, 0, 0);
  CHECK_INT(job_of(old).n_displaced, MO_ERROR_DISPLACED);
  submission.tolerance = 0.01;
  const int64_t next = submit_evaluation(&submission);
  REQUIRE(next > 0);
  CHECK_NEAR(job_of(next).tolerance, 0.01, 0);
  CHECK_INT(job_of(next).rollouts_total, job_of(old).rollouts_total * MO_LADDER_RUNGS);
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
}

/* Saved losses of version 19 have no measures. */
static void opens_version_19(void)
{
  static const char column[] =
      "SELECT count(*) FROM pragma_table_info('campaign_losses') WHERE name='measures'";
  REQUIRE_OK(reopen_after(WITHOUT_20 "PRAGMA user_version=19"));
  CHECK_OK(check_whole());
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
  CHECK_INT(outside_integer(column), 1);
}

/* Those before version 21 are in one set; afterwards, they can be in a suite, whose work has each
 * design once per set, with the environments of that set. */
static void opens_version_before_suites(void)
{
  struct mo_evaluation_request submission = draw_evaluation(2, 3);
  const struct mo_classes classes = {.cpu = {1, 1}, .device = 1};
  struct mo_work *work = NULL;
  submission.environment_set = "morpho-12-walk";
  const int64_t old = submit_evaluation(&submission);
  REQUIRE(old > 0);
  REQUIRE_OK(reopen_after(WITHOUT_21 "PRAGMA user_version=20"));
  CHECK_TEXT(job_of(old).environment_set, "morpho-12-walk");
  CHECK_INT(job_of(old).rollouts_total, 3 * 10);
  submission.environment_set = "morpho-12-held-out";
  const int64_t next = submit_evaluation(&submission);
  REQUIRE(next > 0);
  CHECK_TEXT(job_of(next).environment_set, "morpho-12-held-out");
  CHECK_INT(job_of(next).rollouts_total, 3 * 12 * 64);
  REQUIRE_OK(mo_store_load_work(store, next, &classes, &work));
  CHECK_INT(work->n_sets, MO_SUITE_TASKS);
  CHECK_INT(work->n_environments, 64);
  CHECK_INT(work->n_designs, 3 * MO_SUITE_TASKS);
  for (uint32_t set = 0; set < MO_SUITE_TASKS; set++) {
    struct mo_environment *expected = NULL;
    uint32_t n = 0;
    REQUIRE_OK(mo_store_environment_set(store, mo_suite_set(1, set), &expected, &n));
    CHECK_INT(n, 64);
    CHECK(memcmp(&work->environments[set * n], expected, n * sizeof(*expected)) == 0);
    CHECK(work->genotype_rows[3 * set] == work->genotype_rows[0]);
    CHECK(set == 0 || work->sets[set] != work->sets[set - 1]);
    free(expected);
  }
  mo_work_free(work);
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
  CHECK_INT(outside_integer("SELECT count(*) FROM job_environments"), 10 + 768);
}

/* Noise replaces the root page of a table or an index; the header and the schema stay. */
static void names_damaged_pages(void)
{
  static const char *const damaged[] = {"environments", "jobs_by_state"};
  for (size_t i = 0; i < COUNT(damaged); i++) {
    char sql[128];
    CHECK_OK(reopen_after("UPDATE meta SET value=0 WHERE key='clean'")); /* unclean, but intact */
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

/* Rows that violate the schema also count as damage. */
/* After each unclean stop, event numbers jump. Recent events stay, no matter how often that
 * happens. */
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
    for (int k = 0; k < (i < 9 ? 1 : 1001);
         k++) /* older events are pruned once there are this many */
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

/* An existing set with this name is left unchanged; a missing one is created. */
static void makes_each_set_once(void)
{
  static const char members[] = "SELECT count(*) FROM environment_set_members";
  const int64_t n = MO_PAPER_TEST_COUNT + 12 * (10 + 64);
  CHECK_OK(reopen_after("DELETE FROM environment_set_members WHERE position=1"));
  CHECK_INT(outside_integer("SELECT count(*) FROM environment_sets"), 25);
  CHECK_INT(outside_integer(members), n - 25);
  CHECK_OK(reopen_after("DELETE FROM environment_set_members; DELETE FROM environment_sets"));
  CHECK_INT(outside_integer(members), n);
  CHECK_INT(outside_integer("SELECT count(*) FROM environments"), n);
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

/* Jobs of version 22 are read as before, and atlases can be built. */
static void opens_version_before_atlases(void)
{
  const struct mo_evaluation_request evaluation = draw_evaluation(2, 3);
  const int64_t old = submit_evaluation(&evaluation);
  struct mo_atlas_request request = {.base = "walk-4",
                                     .voxels = 4,
                                     .orientations = MO_ATLAS_IMAGES,
                                     .physics = evaluation.physics,
                                     .controller = evaluation.controller,
                                     .environment_set = "morpho-12-walk"};
  struct mo_message message = {.text = ""};
  struct mo_atlas_status status;
  int64_t id[2] = {0, 0}, taken = 0;
  bool replayed;
  REQUIRE(old > 0);
  REQUIRE_OK(reopen_after(WITHOUT_23 "PRAGMA user_version=22"));
  CHECK_INT(job_of(old).kind, MO_JOB_EVALUATION);
  for (int i = 0; i < 2; i++)
    REQUIRE_OK(mo_store_submit_atlas(store, &request, &id[i], &replayed, &message));
  REQUIRE_OK(mo_store_atlas(store, id[1], &status));
  CHECK_TEXT(status.record.name, "walk-4-2");
  CHECK_INT(status.record.voxels, 4);
  CHECK_INT(status.record.orientations, MO_ATLAS_IMAGES);
  CHECK_TEXT(status.job.environment_set, "morpho-12-walk");
  CHECK_INT(status.job.n_environments, 10);
  const struct mo_job known = job_of(old);
  CHECK(memcmp(&status.job.physics, &known.physics, sizeof(known.physics)) == 0);
  snprintf(request.name, sizeof(request.name), "walk-4");
  CHECK_INT(mo_store_submit_atlas(store, &request, &taken, &replayed, &message), MO_ERR_DUPLICATE);
  CHECK_SAYS(message, "choose another name, or cancel or delete that job");
  CHECK_OK(mo_store_change_job(store, id[0], MO_CHANGE_CANCEL, NULL));
  CHECK_OK(mo_store_submit_atlas(store, &request, &taken, &replayed, &message));
  CHECK_OK(check_whole());
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
}

/* Jobs of version 23 are read as before, and designs can be certified. */
static void opens_version_before_certificates(void)
{
  const struct mo_evaluation_request evaluation = draw_evaluation(2, 3);
  const int64_t old = submit_evaluation(&evaluation);
  const struct mo_certificate_request request = {
      .record = {.settings = mo_certificate_defaults(), .n_trials = 1, .n_rollouts = 30},
      .physics = evaluation.physics,
      .controller = evaluation.controller,
      .genotypes = evaluation.genotypes,
      .forms = evaluation.forms,
      .n_designs = 3,
      .environment_set = "paper-test"};
  struct mo_certificate_status status;
  int64_t id = 0;
  bool replayed;
  REQUIRE(old > 0);
  REQUIRE_OK(reopen_after(WITHOUT_24 "PRAGMA user_version=23"));
  CHECK_INT(job_of(old).kind, MO_JOB_EVALUATION);
  REQUIRE_OK(mo_store_submit_certificate(store, &request, &id, &replayed));
  REQUIRE_OK(mo_store_certificate(store, id, &status));
  CHECK_INT(status.record.n_rollouts, 30);
  CHECK_OK(check_whole());
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
}

/* Generations of version 24 have no results of re-evaluations, and later ones can have some. The
 * designs of a certificate are known, but not what it says of them. */
static void opens_version_before_re_evaluations(void)
{
  const struct mo_evaluation_request evaluation = draw_evaluation(2, 3);
  const struct mo_certificate_request request = {
      .record = {.settings = mo_certificate_defaults(), .n_trials = 1, .n_rollouts = 30},
      .physics = evaluation.physics,
      .controller = evaluation.controller,
      .genotypes = evaluation.genotypes,
      .forms = evaluation.forms,
      .n_designs = 3,
      .environment_set = "paper-test"};
  static const uint8_t verdicts[3] = {MO_CLASS_HOLDS, MO_CLASS_HOLDS, MO_CLASS_HOLDS};
  struct mo_certified found = {.id = 0};
  int64_t id = 0;
  bool replayed;
  REQUIRE_OK(mo_store_submit_certificate(store, &request, &id, &replayed));
  REQUIRE_OK(mo_store_run_start(store, id));
  REQUIRE_OK(mo_store_certificate_finish(store, id, verdicts, 3));
  close_store();
  REQUIRE_OK(reopen_after(WITHOUT_25 "PRAGMA user_version=24"));
  const struct mo_genotype genotype = mo_genotype_of(MO_STORE_WORKSPACE, &evaluation.genotypes[1]);
  CHECK_OK(mo_store_certified(store, NULL, &genotype, &found));
  CHECK_INT(found.id, id);
  CHECK_INT(found.verdict, -1);
  CHECK_OK(check_whole());
  close_store();
  CHECK_INT(outside_integer("SELECT count(*) FROM pragma_table_info('campaign_generations')"
                            " WHERE name GLOB 'held_out_*'"),
            10);
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
}

/* Training runs of version 24 are read as before, and designs can be finetuned individually. */
static void opens_version_before_bodies(void)
{
  const struct mo_evaluation_request drawn = draw_evaluation(2, 3);
  struct mo_training_request request = submission_of(4);
  request.record.settings.kind = MO_TRAINING_FINETUNE;
  request.record.n_designs = 3;
  request.genotypes = drawn.genotypes;
  request.forms = drawn.forms;
  const struct mo_training_body body = {.zero_shot = 0.5, .finetuned = NAN};
  struct mo_training_body found;
  const int64_t old = submit_training(&request);
  REQUIRE(old > 0);
  REQUIRE_OK(reopen_after(WITHOUT_25 "PRAGMA user_version=24"));
  struct mo_training_status status = training_of(old);
  CHECK(!status.record.each && status.bodies_done == 0 && status.job.steps_total == 4);
  request.record.each = true;
  request.record.keep_best = 2;
  const int64_t id = submit_training(&request);
  REQUIRE(id > old);
  status = training_of(id);
  CHECK(status.record.each && status.record.keep_best == 2 && status.record.keep == MO_KEEP_NONE &&
        status.job.steps_total == 12);
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_OK(mo_store_training_body(store, id, &status.record, &body, "t", NULL, 0, NULL));
  REQUIRE(mo_store_training_bodies(store, id, -1, &found, 1) == 1);
  CHECK(found.zero_shot == 0.5 && isnan(found.finetuned) && !found.is_kept);
  CHECK_INT(training_of(id).bodies_done, 1);
  CHECK_OK(check_whole());
  close_store();
  CHECK_INT(outside_integer("PRAGMA user_version"), NEWEST);
}

static void names_of_atlases(void)
{
  static const char *const good[] = {"a", "walk-10", "0", "a--b"}, *const bad[] = {
                                                                       "",    "-a",  "a-", "A",
                                                                       "a.b", "a/b", "ä",  "a b"};
  char long_name[MO_ATLAS_NAME_MAX + 2];
  for (size_t i = 0; i < COUNT(good); i++)
    CHECK(mo_atlas_name_is_valid(good[i]));
  for (size_t i = 0; i < COUNT(bad); i++)
    CHECK(!mo_atlas_name_is_valid(bad[i]));
  memset(long_name, 'a', sizeof(long_name));
  long_name[MO_ATLAS_NAME_MAX + 1] = '\0';
  CHECK(!mo_atlas_name_is_valid(long_name));
  long_name[MO_ATLAS_NAME_MAX] = '\0';
  CHECK(mo_atlas_name_is_valid(long_name));
}

static const struct check_case cases[] = {
    {"opens, counts its openings, and keeps others out", opens_and_locks},
    {"refuses newer schemas and files that are not its own", refuses_what_is_not_ours},
    {"checks rows after an unclean stop", checks_rows_after_an_unclean_stop},
    {"keeps events after many unclean stops", keeps_events_after_unclean_stops},
    {"makes each named set once", makes_each_set_once},
    {"reports damaged pages after an unclean stop", names_damaged_pages},
    {"refuses folders of older versions", refuses_older_versions},
    {"opens a folder of version 14", opens_version_14},
    {"opens a folder of version 15", opens_version_15},
    {"opens a folder of version 16", opens_version_16},
    {"opens a folder of version 17", opens_version_17},
    {"opens a folder of version 18", opens_version_18},
    {"opens a folder of version 19", opens_version_19},
    {"opens a folder from before suites", opens_version_before_suites},
    {"opens a folder from before atlases", opens_version_before_atlases},
    {"opens a folder from before certificates", opens_version_before_certificates},
    {"opens a folder from before re-evaluations", opens_version_before_re_evaluations},
    {"opens a folder from before finetunings of each design", opens_version_before_bodies},
    {"checks the names of atlases", names_of_atlases},
    {"reports contradictions", reports_what_contradicts_itself},
};
CHECK_MAIN_AROUND(cases, with_a_store)
