/* lists.c: the cost of a page depends only on what it shows. SQLite counts the steps of its
 * statements, so no clock is needed: a page that scans or sorts the rows that it leaves out takes
 * tens of thousands. */
#include <stdatomic.h>

#include "by_hand.h"
#include "campaign_fixture.h"
#include "one_store.h"
#include "store/scores.h"
#include "training_fixture.h"

#define ROWS      10000 /* of each kind */
#define PAGE      5
#define STEPS_MAX 2000

static _Atomic int64_t steps;

static int count_steps(unsigned event, void *context, void *statement, void *time)
{
  (void)event;
  (void)context;
  (void)time;
  atomic_fetch_add(&steps, sqlite3_stmt_status(statement, SQLITE_STMTSTATUS_VM_STEP, 1));
  return 0;
}

/* The checksum of a row of set_scores: ranking, genotype, score. */
static void checksum(sqlite3_context *context, int n, sqlite3_value **values)
{
  const int64_t key[] = {sqlite3_value_int64(values[0]), sqlite3_value_int64(values[1])};
  const double score = sqlite3_value_double(values[n - 1]);
  sqlite3_result_int64(context, (int64_t)mo_row_checksum(key, 2, &score, sizeof(score)));
}

/* Returns the canonical form of a body. */
static void canonical(sqlite3_context *context, int n, sqlite3_value **values)
{
  struct mo_genotype genotype;
  uint8_t bytes[MO_BITS_BYTES];
  (void)n;
  (void)mo_decode_genotype(sqlite3_value_blob(values[0]), MO_BITS_BYTES, &genotype);
  mo_encode_genotype(mo_genotype_form(&genotype).words, bytes);
  sqlite3_result_blob(context, bytes, sizeof(bytes), SQLITE_TRANSIENT);
}

static int watch(sqlite3 *db, char **message, const struct sqlite3_api_routines *routines)
{
  (void)message;
  (void)routines;
  int result = sqlite3_create_function(db, "checksum", 3, SQLITE_UTF8, NULL, checksum, NULL, NULL);
  if (result == SQLITE_OK)
    result = sqlite3_create_function(db, "canonical", 1, SQLITE_UTF8, NULL, canonical, NULL, NULL);
  return result == SQLITE_OK ? sqlite3_trace_v2(db, SQLITE_TRACE_PROFILE, count_steps, NULL)
                             : result;
}

/* Copies job 1 (an evaluation), job 2 (a training run) and job 3 (a campaign), in this order. The
 * oldest 24 of each kind take all states in turn; all others have the same state. */
static int fill(void)
{
  static const char *const tables[] = {"evaluations", "trainings", "campaigns"};
  static const char *const columns[] = {
      "controller,controller_name,physics,environment_set,n_designs,n_environments,verify,record,"
      "record_stride,done,"
      "cached,"
      "diverged",
      "n_designs,population,step",
      "generations,preset,physics,environment_set,n_environments,n_listed,initial_campaign,"
      "replicates_of,replicate,replicates,generation,n_designs,best_score,diversity_max,ended,"
      "scored_generation,scored"};
  char sql[4096];
  int result = SQLITE_OK;
  close_store();
  for (int kind = 0; kind < 3 && result == SQLITE_OK; kind++) {
    snprintf(sql, sizeof(sql),
             "BEGIN;"
             "WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i+1 FROM n LIMIT %d)"
             " INSERT INTO "
             "jobs(kind,state,priority,weight,back_end,version,epoch,attempts,created_us,started_"
             "us,finished_us,"
             "error,label,submitted_by)"
             " SELECT %d,iif(i<24,i%%6,%d),0,1,0,1,1,0,1,1,1,0,iif(i%%100=0,'rare','usual'),"
             "iif(i%%100=50,'rare','usual') FROM n;"
             "INSERT INTO runs SELECT copy,settings,name,controller,controller_name,result FROM"
             " (SELECT id copy FROM jobs WHERE kind=%d AND id>3),(SELECT * FROM runs WHERE job=%d);"
             "INSERT INTO %s(job,%s) SELECT copy,%s FROM (SELECT id copy FROM jobs WHERE kind=%d "
             "AND id>3),"
             "(SELECT * FROM %s WHERE job=%d);"
             "COMMIT",
             ROWS, kind, 3 + kind, kind, kind + 1, tables[kind], columns[kind], columns[kind], kind,
             tables[kind], kind + 1);
    result = outside(sql);
  }
  if (result == SQLITE_OK)
    result = outside(
        "BEGIN;"
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n LIMIT 10000)"
        " INSERT INTO controller_names SELECT 'copy-'||i,controller,1,stored_us FROM "
        "n,controller_names"
        " WHERE name='default';"
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n LIMIT 10000)"
        " INSERT INTO designs(form,first_seen_us) SELECT canonical(randomblob(18)),1 FROM n;"
        "INSERT INTO genotypes(bits,design) SELECT form,id FROM designs WHERE id NOT IN"
        " (SELECT design FROM genotypes);"
        "INSERT INTO fingerprints(text) VALUES('by hand');"
        "INSERT INTO rankings SELECT 1,controller,physics,1,environment_set FROM evaluations"
        " WHERE job=1;"
        "INSERT INTO set_scores SELECT 1,id,0.5,checksum(1,id,0.5) FROM genotypes;"
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n LIMIT 10000)"
        " INSERT INTO events(time_us,job,type,data) SELECT 1,iif(i<9,4,5),'job.started','{}' FROM "
        "n;"
        "COMMIT");
  return result == SQLITE_OK ? reopen() : MO_ERR_IO;
}

static int start(void)
{
  struct mo_training_request training = submission_of(10);
  struct mo_campaign_request campaign = campaign_submission(MO_ZERO_SHOT, 8, 3);
  struct mo_evaluation_request evaluation = draw_evaluation(1, 1);
  if (sqlite3_auto_extension((void (*)(void))watch) != SQLITE_OK)
    return MO_ERR_IO;
  if (submit_evaluation(&evaluation) != 1 || submit_training(&training) != 2 ||
      submit_campaign(&campaign) != 3)
    return MO_ERR_CONFLICT;
  return fill();
}

static int64_t all_steps(void)
{
  return atomic_exchange(&steps, 0);
}

static void cheap(const char *what, int kind, int state, int64_t before, bool waits)
{
  int64_t n = all_steps();
  CHECK(n <= STEPS_MAX);
  if (n > STEPS_MAX)
    printf("# %s of kind %d, state %d, before %lld%s: %lld steps\n", what, kind, state,
           (long long)before, waits ? ", some waiting" : "", (long long)n);
}

/* Each page of each kind in each state: from the newest job, and from before the oldest matching
 * jobs. */
static void pages_of_jobs(void)
{
  struct mo_job jobs[PAGE];
  struct mo_training_status trainings[PAGE];
  struct mo_campaign_status campaigns[PAGE];
  REQUIRE_OK(start());
  const int64_t places[] = {0, 2 * ROWS + 20, ROWS + 20, 20, 2};
  /* Pages of running training runs and campaigns. */
  const int64_t waiting[] = {ROWS + 5, ROWS + 11, 2 * ROWS + 5};
  for (int state = -1; state < MO_JOB_STATES; state++)
    for (size_t p = 0; p < COUNT(places); p++)
      for (size_t w = 0; w <= 3; w += 3) {
        for (int kind = -1; kind < 3; kind++) {
          struct mo_job_query query = {.before = places[p],
                                       .state = state,
                                       .kind = kind,
                                       .waiting = waiting,
                                       .n_waiting = w};
          (void)all_steps();
          CHECK(mo_store_jobs(store, &query, jobs, PAGE) >= 0);
          cheap("jobs", kind, state, places[p], w > 0);
          for (int usual = 0; usual < 2; usual++) {
            query.label = usual ? "usual" : "rare";
            CHECK(mo_store_jobs(store, &query, jobs, PAGE) >= 0);
            cheap(query.label, kind, state, places[p], w > 0);
          }
          /* By label, by submitter, and by both, even if no job has that combination. */
          for (int which = 0; which < 4; which++) {
            static const char *const labels[] = {NULL, NULL, "usual", "rare"};
            query.label = labels[which];
            query.submitted_by = which == 1 || which == 3 ? "rare" : "usual";
            CHECK(mo_store_jobs(store, &query, jobs, PAGE) >= 0);
            cheap("jobs of a submitter", kind, state, places[p], w > 0);
          }
        }
        struct mo_job_query query = {
            .before = places[p], .state = state, .kind = -1, .waiting = waiting, .n_waiting = w};
        CHECK(mo_store_trainings(store, &query, trainings, PAGE) >= 0);
        cheap("trainings", 1, state, places[p], w > 0);
        struct mo_job_query all = {
            .before = places[p], .state = state, .waiting = waiting, .n_waiting = w, .group = 0};
        CHECK(mo_store_campaigns(store, &all, campaigns, PAGE) >= 0);
        cheap("campaigns", 2, state, places[p], w > 0);
      }
}

/* A page is correct no matter which statement finds it: newest first, only the kind, and jobs that
 * wait for their pause count as paused. */
static void pages_name_the_states_that_are_shown(void)
{
  struct mo_job jobs[40];
  static struct mo_training_status trainings[40];
  static const int64_t none[MO_WAITING_MAX + 1];
  REQUIRE_OK(start());
  const int64_t first = 4 + ROWS; /* training runs: queued, running, paused, … */
  const int64_t waiting[] = {first + 7, first + 1};
  struct mo_job_query query = {
      .state = MO_JOB_PAUSED, .kind = MO_JOB_TRAINING, .waiting = waiting, .n_waiting = 2};
  const int64_t paused[] = {first + 20, first + 14, first + 8, first + 7, first + 2, first + 1};
  REQUIRE(mo_store_jobs(store, &query, jobs, 40) == 6);
  REQUIRE(mo_store_trainings(store, &query, trainings, 40) == 6);
  for (int i = 0; i < 6; i++)
    CHECK(jobs[i].id == paused[i] && trainings[i].job.id == paused[i]);
  CHECK_INT(mo_store_jobs(store, &query, jobs, 4), 4);
  CHECK_INT(jobs[3].id, paused[3]);
  query.before = paused[3];
  CHECK_INT(mo_store_jobs(store, &query, jobs, 40), 2);
  CHECK(jobs[0].id == paused[4] && jobs[1].id == paused[5]);
  query = (struct mo_job_query){
      .state = MO_JOB_RUNNING, .kind = MO_JOB_TRAINING, .waiting = waiting, .n_waiting = 2};
  REQUIRE(mo_store_jobs(store, &query, jobs, 40) == 2);
  CHECK(jobs[0].id == first + 19 && jobs[1].id == first + 13);
  query.kind = MO_JOB_EVALUATION;
  CHECK_INT(mo_store_jobs(store, &query, jobs, 40), 4);
  query.kind = -1;
  CHECK_INT(mo_store_jobs(store, &query, jobs, 40), 10);
  query = (struct mo_job_query){.state = MO_JOB_PAUSED,
                                .kind = MO_JOB_TRAINING,
                                .waiting = waiting,
                                .n_waiting = 2,
                                .label = "usual"};
  REQUIRE(mo_store_jobs(store, &query, jobs, 40) == 6);
  for (int i = 0; i < 6; i++)
    CHECK_INT(jobs[i].id, paused[i]);
  query.submitted_by = "usual";
  REQUIRE(mo_store_jobs(store, &query, jobs, 40) == 6);
  for (int i = 0; i < 6; i++)
    CHECK_INT(jobs[i].id, paused[i]);
  CHECK_TEXT(jobs[0].submitted_by, "usual");
  query.submitted_by = "rare";
  CHECK_INT(mo_store_jobs(store, &query, jobs, 40), 0);
  query.label = NULL;
  query.state = -1;
  CHECK_INT(mo_store_jobs(store, &query, jobs, 40), ROWS / 100 < 40 ? ROWS / 100 : 40);
  query.submitted_by = NULL;
  query.label = "none";
  CHECK_INT(mo_store_jobs(store, &query, jobs, 40), 0);
  query = (struct mo_job_query){.state = MO_JOB_SUCCEEDED, .kind = MO_JOB_CAMPAIGN};
  CHECK_INT(mo_store_jobs(store, &query, jobs, 40), 4);
  CHECK_INT(mo_store_jobs(store, &query, jobs, MO_PAGE_MAX + 1), MO_ERR_LIMIT);
  query = (struct mo_job_query){
      .state = MO_JOB_RUNNING, .waiting = none, .n_waiting = MO_WAITING_MAX + 1};
  CHECK_INT(mo_store_jobs(store, &query, jobs, 40), MO_ERR_LIMIT);
  CHECK_INT(mo_store_trainings(store, &query, trainings, 40), MO_ERR_LIMIT);
}

static void pages_of_everything_else(void)
{
  struct mo_controller_record controllers[PAGE];
  struct mo_design_row designs[PAGE];
  struct mo_event events[PAGE];
  REQUIRE_OK(start());
  REQUIRE_OK(mo_store_controller(store, "default", &controllers[0]));
  struct mo_design_query query = {.controller_sha256 = controllers[0].sha256,
                                  .environment_set = "paper-test",
                                  .physics = mo_paper_physics(),
                                  .precision = MO_FLOAT32,
                                  .fingerprint = "by hand"};
  (void)all_steps();
  CHECK_INT(mo_store_controllers(store, NULL, controllers, PAGE), PAGE);
  CHECK_INT(mo_store_controllers(store, "default", controllers, PAGE), 0);
  cheap("controllers", -1, -1, 0, false);
  query.after_score = 0.5; /* like all others */
  for (int i = 0; i < 4; i++) {
    query.sort = i < 2 ? MO_DESIGNS_BY_ID : MO_DESIGNS_BY_SCORE;
    query.is_descending = i % 2 == 1;
    for (int64_t row = 0; row < ROWS; row += ROWS / 4) {
      query.after_row = query.is_descending && row > 0 ? ROWS - row : row;
      CHECK_INT(mo_store_designs(store, &query, designs, PAGE), PAGE);
      cheap("designs", -1, -1, 0, false);
    }
  }
  for (int64_t job = 0; job <= 6; job++) {
    CHECK(mo_store_events(store, 100, job, events, PAGE, NULL, NULL) >= 0);
    cheap("events", -1, -1, 0, false);
  }
}

static const struct check_case cases[] = {
    {"pages of jobs cost what they show", pages_of_jobs},
    {"pages use the displayed states", pages_name_the_states_that_are_shown},
    {"other pages cost what they show", pages_of_everything_else},
};
CHECK_MAIN_AROUND(cases, with_a_store)
