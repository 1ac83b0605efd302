/* trainings.c: what the store records about training runs: settings, curves, code, states and
 * results. Whether requests are read back unchanged is tested over HTTP. */
#include "by_hand.h"
#include "one_store.h"
#include "rollout/physics.h"
#include "store/internal.h"
#include "training_fixture.h"

/* Returns the number of steps that SQLite's virtual machine has executed for readers: the cost of a
 * query, no matter how busy the computer is. */
static int64_t steps_of_readers(void)
{
  int64_t sum = 0;
  for (uint32_t i = 0; i < store->n_readers; i++)
    for (sqlite3_stmt *statement = sqlite3_next_stmt(store->readers[i].db, NULL); statement != NULL;
         statement = sqlite3_next_stmt(store->readers[i].db, statement))
      sum += sqlite3_stmt_status(statement, SQLITE_STMTSTATUS_VM_STEP, 0);
  return sum;
}

static void encodes_every_setting(void)
{
  const struct mo_training_record record = submission_of(10).record;
  struct mo_training_record back = {.name = "walker"};
  struct mo_text text = {0};
  mo_settings_write(MO_JOB_TRAINING, &record, &text);
  REQUIRE(text.data != NULL);
  CHECK_OK(mo_settings_read(MO_JOB_TRAINING, text.data, &back));
  CHECK(same_settings(MO_JOB_TRAINING, &back, &record));
  CHECK(back.validate_every_steps == 11 && back.checkpoint_every_steps == 12 &&
        back.checkpoint_every_s == 13 && back.checkpoints_kept == 2);
  CHECK(strcmp(back.name, "walker") == 0);
  text.data[text.size - 1] = '\0';
  CHECK_INT(mo_settings_read(MO_JOB_TRAINING, text.data, &back), MO_ERR_CORRUPT);
  CHECK_INT(mo_settings_read(MO_JOB_TRAINING, "{\"adjoint_rule\":\"none\"}", &back),
            MO_ERR_CORRUPT);
  CHECK_INT(mo_settings_read(MO_JOB_TRAINING, "{\"batch\":0}", &back), MO_ERR_CORRUPT);
  mo_text_free(&text);
}

/* An older program stored no settings that it did not have. They were the paper's. */
static void keeps_the_physics_of_older_jobs(void)
{
  struct mo_physics paper = mo_paper_physics();
  struct mo_training_record back = {.name = "walker"};
  CHECK_OK(mo_settings_read(MO_JOB_TRAINING, "{\"kind\":\"finetune\",\"seed\":3}", &back));
  CHECK(back.settings.seed == 3 && mo_physics_equal(&back.settings.physics, &paper));
  CHECK_OK(mo_settings_read(MO_JOB_TRAINING,
                            "{\"kind\":\"pretrain\",\"physics\":{\"n_steps\":30,\"friction\":0.5}}",
                            &back));
  paper.scheme.n_steps = 30;
  paper.constants.friction = 0.5;
  CHECK(mo_physics_equal(&back.settings.physics, &paper));
}

static void keeps_the_queues_apart(void)
{
  struct mo_evaluation_request evaluation = draw_evaluation(5, 3);
  struct mo_training_request training = submission_of(10);
  struct mo_evaluation_results *results = NULL;
  struct mo_work *work = NULL;
  int64_t ids[5] = {0}, first, second, id = 0;
  uint64_t jobs = 0, rollouts = 0;
  first = submit_training(&training);
  id = submit_evaluation(&evaluation);
  second = submit_training(&training);
  CHECK_INT(mo_store_queued(store, MO_BATCH, 0, true, ids, 5), 1);
  CHECK_INT(ids[0], id);
  CHECK_INT(mo_store_queued_runs(store, MO_JOB_TRAINING, ids, 5), 2);
  CHECK(ids[0] == first && ids[1] == second);
  CHECK_OK(mo_store_open_work(store, &jobs, &rollouts));
  CHECK_INT(jobs, 3);
  CHECK_INT(rollouts, 30);
  CHECK_INT(mo_store_load_work(store, first, fixture_classes(1), &work), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_results(store, first, &results), MO_ERR_NOT_FOUND);
}

static void keeps_the_curve(void)
{
  struct mo_training_request submission = submission_of(100);
  struct mo_training_step_row rows[10], found[10];
  struct mo_training_validation_row validation = {5, 80, 2, 0.75, 0.01}, validations[5];
  struct mo_event events[20];
  int progress = 0;
  int64_t id = submit_training(&submission);
  for (uint32_t i = 0; i < 10; i++)
    rows[i] = row_of(i + 1);
  CHECK_INT(mo_store_training_progress(store, id, rows, 10, NULL, NULL),
            MO_ERR_CONFLICT); /* not started */
  CHECK_OK(mo_store_run_start(store, id));
  CHECK_INT(mo_store_run_start(store, id), MO_ERR_CONFLICT);
  CHECK_OK(mo_store_training_progress(store, id, rows, 10, NULL, "{\"id\":\"1\"}"));
  CHECK_OK(mo_store_training_progress(store, id, NULL, 0, &validation, NULL));
  /* Steps 5 to 7 are repeated: nothing changes except their times. */
  rows[4].seconds = 7;
  CHECK_OK(mo_store_training_progress(store, id, rows + 4, 3, NULL, NULL));
  CHECK_INT(mo_store_training_steps(store, id, 0, 1, found, 10), 10);
  for (uint32_t i = 0; i < 10; i++) {
    CHECK(memcmp(&found[i].report.mean_loss, &rows[i].report.mean_loss, sizeof(double)) == 0 ||
          (isnan(found[i].report.mean_loss) && isnan(rows[i].report.mean_loss)));
    CHECK(found[i].report.rate == rows[i].report.rate &&
          found[i].report.gradient_norm == rows[i].report.gradient_norm &&
          found[i].seconds == rows[i].seconds &&
          found[i].report.diverged == rows[i].report.diverged &&
          found[i].report.zeroed == rows[i].report.zeroed &&
          found[i].report.skipped == rows[i].report.skipped &&
          found[i].report.bounded == rows[i].report.bounded);
  }
  CHECK_INT(mo_store_training_steps(store, id, 3, 2, found, 2), 2);
  CHECK(found[0].report.step == 4 && found[1].report.step == 6);
  CHECK_INT(mo_store_training_validations(store, id, -1, validations, 5), 1);
  CHECK_INT(mo_store_training_validations(store, id, 5, validations, 5), 0);
  CHECK(memcmp(&validations[0].mean_score, &validation.mean_score, sizeof(double)) == 0);
  struct mo_training_status status = training_of(id);
  CHECK_INT(status.step, 10);
  CHECK_INT(status.last.report.step, 10);
  CHECK(status.has_validation && status.validation.rollouts == 80 &&
        status.validation.diverged == 2);
  int64_t n = mo_store_events(store, 0, id, events, 20, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    progress += strcmp(events[i].type, "training.progress") == 0;
  CHECK_INT(progress, 1);
  CHECK(n > 0 && strcmp(events[n - 1].type, "training.validation") == 0);
  CHECK_TEXT(events[n - 1].data,
             "{\"id\":\"1\",\"step\":5,\"mean_score\":0.75,\"standard_error\":0.01,"
             "\"rollouts\":80,\"diverged\":2}");
  /* While paused, steps in flight are still accepted; after a cancellation, they are not. */
  CHECK_OK(change(id, MO_CHANGE_PAUSE));
  CHECK_OK(mo_store_training_progress(store, id, rows, 1, NULL, NULL));
  CHECK_OK(mo_store_training_checkpoint(store, id, 10, (const uint8_t *)"ten", 3, 2));
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  CHECK_INT(mo_store_training_progress(store, id, rows, 1, NULL, NULL), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_training_checkpoint(store, id, 11, (const uint8_t *)"eleven", 6, 2),
            MO_ERR_CONFLICT);
}

/* A page of every nth step does not read the steps in between. */
static void finds_steps_in_a_long_curve(void)
{
  static const char fill[] =
      "WITH RECURSIVE s(x) AS (SELECT 1 UNION ALL SELECT x+1 FROM s WHERE x<100000) INSERT INTO "
      "training_steps SELECT 1,x,0.5,0.001,1,0,0,0,0,0,0,0.25 FROM s";
  struct mo_training_request submission = submission_of(100000);
  struct mo_training_step_row *rows = calloc(MO_PAGE_MAX, sizeof(*rows));
  int64_t n = MO_PAGE_MAX, begin, middle, end;
  REQUIRE(rows != NULL);
  REQUIRE(submit_training(&submission) == 1);
  REQUIRE_OK(reopen_after(fill));
  begin = steps_of_readers();
  for (uint32_t after = 0; after < 100000 && n == MO_PAGE_MAX; after += MO_PAGE_MAX)
    n = mo_store_training_steps(store, 1, after, 1, rows, MO_PAGE_MAX);
  CHECK(n == MO_PAGE_MAX && rows[MO_PAGE_MAX - 1].report.step == 100000);
  middle = steps_of_readers();
  CHECK_INT(mo_store_training_steps(store, 1, 0, 30000, rows, MO_PAGE_MAX), 3);
  end = steps_of_readers();
  CHECK(rows[0].report.step == 30000 && rows[1].report.step == 60000 &&
        rows[2].report.step == 90000);
  printf("# steps of SQLite's machine: %lld for three rows, %lld for all\n",
         (long long)(end - middle), (long long)(middle - begin));
  CHECK(middle - begin >= 100000);
  CHECK(end - middle > 0 && end - middle < 1000);
  CHECK_INT(mo_store_training_steps(store, 1, 30000, 30000, rows, 1), 1);
  CHECK_INT(rows[0].report.step, 60000);
  CHECK_INT(mo_store_training_steps(store, 1, 29999, 7, rows, 2), 2);
  CHECK(rows[0].report.step == 30002 && rows[1].report.step == 30009);
  CHECK_INT(mo_store_training_steps(store, 1, 99998, 99999, rows, 5), 1);
  CHECK_INT(mo_store_training_steps(store, 1, 99999, 99999, rows, 5), 0);
  CHECK_INT(mo_store_training_steps(store, 1, UINT32_MAX, MO_TRAINING_STEPS_MAX, rows, 5), 0);
  CHECK_INT(mo_store_training_steps(store, 2, 0, 2, rows, 5), 0);
  free(rows);
}

/* The lineage covers only steps that count: the record of a run is dropped for steps that another
 * run repeats. */
static void names_the_code(void)
{
  struct mo_training_request submission = submission_of(100);
  struct mo_training_lineage lineage;
  struct mo_event events[80];
  char name[32];
  int changes = 0;
  int64_t id = submit_training(&submission);
  CHECK_INT(mo_store_training_code(store, id, 0, "one", &lineage), MO_ERR_CONFLICT);
  REQUIRE_OK(mo_store_run_start(store, id));
  CHECK_OK(mo_store_training_code(store, id, 0, "none", &lineage)); /* it completed no step */
  CHECK_OK(mo_store_training_code(store, id, 0, "one", &lineage));
  CHECK(lineage.n == 1 && lineage.codes[0].from_step == 0 &&
        strcmp(lineage.codes[0].fingerprint, "one") == 0);
  CHECK_OK(mo_store_training_code(store, id, 20, "one", &lineage));
  CHECK_INT(lineage.n, 1);
  CHECK_OK(mo_store_training_code(store, id, 30, "two", &lineage));
  CHECK_INT(lineage.n, 2);
  CHECK_OK(mo_store_training_code(store, id, 30, "one", &lineage)); /* "two" stored no checkpoint */
  CHECK_INT(lineage.n, 1);
  CHECK_OK(mo_store_training_code(store, id, 30, "two", &lineage));
  CHECK_OK(
      mo_store_training_code(store, id, 25, "three", &lineage)); /* from an earlier checkpoint */
  CHECK_OK(reopen());
  struct mo_training_status status = training_of(id);
  CHECK_INT(status.code.n, 2);
  CHECK_INT(status.code.codes[1].from_step, 25);
  CHECK_TEXT(status.code.codes[1].fingerprint, "three");
  int64_t n = mo_store_events(store, 0, id, events, 80, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    changes += strcmp(events[i].type, "training.code_changed") == 0;
  CHECK_INT(changes, 3);
  CHECK(n > 0 && strstr(events[n - 1].data,
                        "\"from_step\":25,\"before\":\"one\",\"fingerprint\":\"three\"") != NULL);
  CHECK_INT(mo_store_training_code(store, id, 40, "four", &lineage),
            MO_ERR_CONFLICT); /* started by an earlier process */
  CHECK_OK(mo_store_requeue(store, 0, 3, ""));
  REQUIRE_OK(mo_store_run_start(store, id));
  for (uint32_t step = 40; step < 40 + MO_LINEAGE_MAX; step++) {
    snprintf(name, sizeof(name), "code %u", (unsigned)step);
    CHECK_OK(mo_store_training_code(store, id, step, name, &lineage));
  }
  CHECK_INT(lineage.n, MO_LINEAGE_MAX);
  CHECK_TEXT(lineage.codes[MO_LINEAGE_MAX - 2].fingerprint, "code 68");
  CHECK_TEXT(lineage.codes[MO_LINEAGE_MAX - 1].fingerprint, "various");
  CHECK_INT(lineage.codes[MO_LINEAGE_MAX - 1].from_step, 69);
  CHECK_OK(check_whole());
}

static void finishes_with_its_controller(void)
{
  const struct mo_training_request submission = submission_of(100);
  struct mo_controller *controller = make_random_controller(MO_SENSOR_INVERSE_SQRT, 77);
  struct mo_controller_record record;
  const int64_t id = submit_training(&submission);
  uint8_t *bytes = NULL;
  size_t size = 0;
  REQUIRE_OK(mo_controller_encode(controller, &bytes, &size));
  check_keep(bytes, free);
  for (int paused = 0; paused < 2; paused++) {
    printf("# %s\n", paused ? "paused" : "queued");
    CHECK_INT(mo_store_training_finish(store, id, "walker", bytes, size, controller),
              MO_ERR_CONFLICT);
    CHECK_INT(mo_store_controller(store, "walker", &record), MO_ERR_NOT_FOUND);
    if (paused)
      CHECK_OK(change(id, MO_CHANGE_RESUME));
    REQUIRE_OK(mo_store_run_start(store, id));
    if (!paused)
      CHECK_OK(change(id, MO_CHANGE_PAUSE));
  }
  CHECK_OK(mo_store_training_finish(store, id, "walker", bytes, size, controller));
  const struct mo_training_status status = training_of(id);
  CHECK_INT(status.job.state, MO_JOB_SUCCEEDED);
  CHECK(status.job.finished_us > 0);
  CHECK_OK(mo_store_controller(store, "walker", &record));
  CHECK(status.job.has_result && mo_sha256_equal(&status.job.result_sha256, &record.sha256));
  CHECK_TEXT(last_event(id).type, "job.finished");
  CHECK_HAS(last_event(id).data,
            "\"kind\":\"training\",\"state\":\"succeeded\",\"controller\":\"walker\"");
  CHECK_OK(mo_store_controller_remove(store, "walker")); /* its content stays */
  CHECK_OK(check_whole());
}

/* Errors with progress in between are forgiven; repeated errors at one step are not, whichever
 * checkpoint is rewritten. Behavior common to all runs is tested with campaigns. */
static void forgives_progress(void)
{
  const struct mo_training_request submission = submission_of(100);
  const int64_t id = submit_training(&submission);
  for (uint32_t round = 1; round <= 7; round++) {
    const uint32_t step = round < 5 ? 10 * round : 50, attempts = round < 5 ? 1 : round - 4;
    printf("# round %u\n", round);
    REQUIRE_OK(mo_store_run_start(store, id));
    CHECK_OK(mo_store_training_checkpoint(store, id, step, (const uint8_t *)"x", 1, 2));
    CHECK_INT(park(id, MO_ERR_NO_MEMORY), attempts < 3 ? MO_JOB_QUEUED : MO_JOB_FAILED);
    CHECK_INT(job_of(id).attempts, attempts);
  }
}

static const struct check_case cases[] = {
    {"encodes every setting", encodes_every_setting},
    {"keeps the physics of older jobs", keeps_the_physics_of_older_jobs},
    {"keeps the queues apart", keeps_the_queues_apart},
    {"keeps the learning curve", keeps_the_curve},
    {"finds steps in a long curve", finds_steps_in_a_long_curve},
    {"records the code", names_the_code},
    {"finishes with its controller", finishes_with_its_controller},
    {"forgives errors with progress between them", forgives_progress},
};
CHECK_MAIN_AROUND(cases, with_a_store)
