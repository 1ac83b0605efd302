/* labels.c: labels of jobs, accounting of their usage, and deletion: what is deleted, what stays,
 * and which jobs protect others. */
#include <pthread.h>

#include "base/clock.h"
#include "by_hand.h"
#include "campaign_fixture.h"
#include "one_store.h"
#include "store/credible.h"
#include "store/deletion.h"
#include "training_fixture.h"

static struct mo_message message;
static struct mo_deleted deleted;

static int delete_job(int64_t id)
{
  return mo_store_delete_job(store, id, &deleted, &message);
}

/* Waits until the background thread has deleted the rows of a job. */
static bool is_gone(int64_t id)
{
  char sql[64];
  snprintf(sql, sizeof(sql), "SELECT count(*) FROM jobs WHERE id=%lld", (long long)id);
  for (int i = 0; i < 500 && outside_integer(sql) != 0; i++)
    usleep(10000);
  return outside_integer(sql) == 0;
}

/* Returns whether a query finds exactly these jobs, in order. The list ends with −1. */
static bool finds(struct mo_job_query query, const int64_t *ids)
{
  struct mo_job page[8];
  int64_t n = 0;
  while (ids[n] >= 0)
    n++;
  bool good = mo_store_jobs(store, &query, page, 8) == n;
  for (int64_t i = 0; i < n && good; i++)
    good = page[i].id == ids[i];
  return good;
}
#define FINDS(query, ...) CHECK(finds((struct mo_job_query)query, (const int64_t[]){__VA_ARGS__}))
#define Q(...)                                                                                     \
  {                                                                                                \
    .state = -1, .kind = -1, __VA_ARGS__                                                           \
  }

static void finds_what_is_labeled(void)
{
  struct mo_evaluation_request submission = draw_evaluation(1, 1);
  struct mo_training_request training = submission_of(5);
  int64_t ids[5];
  const char *const labels[] = {"gait a", "gait b", "gait", "gai"};
  for (int i = 0; i < 4; i++) {
    submission.job.label = labels[i];
    submission.job.experiment = i < 2 ? "x" : NULL;
    ids[i] = submit_evaluation(&submission);
  }
  training.job.label = "gait c";
  training.job.experiment = "x";
  ids[4] = submit_training(&training);
  FINDS(Q(.label = "gait", .label_is_prefix = true), ids[4], ids[2], ids[1], ids[0], -1);
  FINDS(Q(.label = "gait "), -1);
  FINDS(Q(.label = "gait"), ids[2], -1);
  FINDS(Q(.search = "AIT"), ids[4], ids[2], ids[1], ids[0], -1);
  FINDS(Q(.search = "t b"), ids[1], -1);
  FINDS(Q(.search = "t", .experiment = "x", .before = ids[4]), ids[1], ids[0], -1);
  FINDS(Q(.search = "ga_t"), -1);
  FINDS(Q(.search = "%"), -1);
  FINDS(Q(.experiment = "x"), ids[4], ids[1], ids[0], -1);
  FINDS(Q(.experiment = "x", .before = ids[4]), ids[1], ids[0], -1);
  FINDS(Q(.experiment = "x", .label = "gait b"), ids[1], -1);
  FINDS(Q(.experiment = "y"), -1);
  struct mo_job_query query = Q(.experiment = "x");
  query.kind = MO_JOB_TRAINING;
  CHECK(finds(query, (const int64_t[]){ids[4], -1}));
  /* A change keeps the fields that it omits. */
  CHECK_OK(mo_store_edit_job(
      store, ids[1],
      &(struct mo_job_edit){
          .has_note = true, .note = "good", .has_archived = true, .archived = true}));
  struct mo_job job = job_of(ids[1]);
  CHECK_TEXT(job.note, "good");
  CHECK_TEXT(job.label, "gait b");
  CHECK(job.archived_us > 0 && job.version == 2);
  CHECK_TEXT(last_event(ids[1]).type, "job.changed");
  FINDS(Q(.experiment = "x"), ids[4], ids[0], -1);
  FINDS(Q(.experiment = "x", .archived = 1), ids[1], -1);
  FINDS(Q(.archived = 1), ids[1], -1);
  FINDS(Q(.archived = -1, .label = "gait", .label_is_prefix = true), ids[4], ids[2], ids[1], ids[0],
        -1);
  query = (struct mo_job_query){.state = MO_JOB_QUEUED, .kind = -1};
  CHECK(finds(query, (const int64_t[]){ids[4], ids[3], ids[2], ids[0], -1}));
  CHECK_OK(mo_store_edit_job(
      store, ids[1],
      &(struct mo_job_edit){
          .has_label = true, .has_experiment = true, .experiment = "z", .has_archived = true}));
  job = job_of(ids[1]);
  CHECK(!job.has_label && job.archived_us == 0 && strcmp(job.experiment, "z") == 0);
  CHECK_TEXT(job.note, "good");
  CHECK_INT(mo_store_edit_job(store, 99, &(struct mo_job_edit){.has_label = true}),
            MO_ERR_NOT_FOUND);
}

/* Returns a meter of one job. */
static int64_t metered;
static double metered_s = 1.5;

static bool meter(void *context, int64_t job, double *worker_s, double *device_s)
{
  (void)context;
  *worker_s = metered_s;
  *device_s = 2 * metered_s;
  return job == metered;
}

static void counts_what_jobs_use(void)
{
  struct mo_evaluation_request submission = draw_evaluation(1, 1);
  struct mo_usage_row rows[4];
  int64_t ids[3];
  mo_store_meter(store, meter, NULL);
  for (int i = 0; i < 3; i++) {
    submission.job.label = i < 2 ? "a" : NULL;
    ids[i] = submit_evaluation(&submission);
    metered = ids[i];
    metered_s = 1.5 + i;
    CHECK_OK(change(ids[i], MO_CHANGE_CANCEL)); /* written together with its event */
    CHECK(job_of(ids[i]).worker_s == metered_s && job_of(ids[i]).device_s == 2 * metered_s);
  }
  mo_store_meter(store, NULL, NULL);
  for (int round = 0; round < 2; round++) {
    REQUIRE(mo_store_usage(store, MO_USAGE_LABEL, rows, 4) == 2);
    CHECK(strcmp(rows[0].name, "a") == 0 && rows[0].jobs == 2 && rows[0].worker_s == 4);
    CHECK(rows[1].name[0] == '\0' && rows[1].jobs == 1 && rows[1].device_s == 7);
    CHECK_INT(mo_store_usage(store, MO_USAGE_KIND, rows, 4), 1);
    CHECK(strcmp(rows[0].name, "0") == 0 && rows[0].jobs == 3);
    for (int i = 0; i < 3 && round == 0; i++) /* deleted jobs still count */
      CHECK_OK(delete_job(ids[i]));
    CHECK(is_gone(ids[2]));
  }
}

/* Checks that the sums equal those over the jobs. */
static void usage_follows_changes(void)
{
  static const char sums[] =
      "SELECT (SELECT count(*) FROM (SELECT kind,coalesce(label,''),coalesce(experiment,''),"
      "coalesce(submitted_by,''),count(*),sum(CAST(round(worker_s*1e6) AS INTEGER)),"
      "sum(CAST(round(device_s*1e6) AS INTEGER)) FROM jobs GROUP BY 1,2,3,4"
      " EXCEPT SELECT * FROM usage))"
      " + (SELECT count(*) FROM (SELECT kind,label,experiment,submitted_by,jobs,worker_us,device_us"
      " FROM usage EXCEPT SELECT kind,coalesce(label,''),coalesce(experiment,''),"
      "coalesce(submitted_by,''),count(*),sum(CAST(round(worker_s*1e6) AS INTEGER)),"
      "sum(CAST(round(device_s*1e6) AS INTEGER)) FROM jobs GROUP BY 1,2,3,4))";
  struct mo_evaluation_request submission = draw_evaluation(1, 1);
  struct mo_usage_row rows[4];
  int64_t ids[4];
  mo_store_meter(store, meter, NULL);
  for (int i = 0; i < 4; i++) {
    submission.job.label = i % 2 == 0 ? "even" : NULL;
    ids[i] = metered = submit_evaluation(&submission);
    metered_s = 0.1 + i / 3.0;
    CHECK_OK(change(ids[i], MO_CHANGE_PAUSE));
    metered_s *= 1.7;
    CHECK_OK(change(ids[i], MO_CHANGE_RESUME));
  }
  mo_store_meter(store, NULL, NULL);
  for (int i = 0; i < 4; i++) {
    const struct mo_job_edit edit = {.has_label = true,
                                     .has_experiment = true,
                                     .label = i == 0 ? "odd" : NULL,
                                     .experiment = "one"};
    CHECK_OK(mo_store_edit_job(store, ids[i], &edit));
  }
  REQUIRE(mo_store_usage(store, MO_USAGE_LABEL, rows, 4) == 2);
  CHECK(rows[0].name[0] == '\0' && rows[0].jobs == 3);
  CHECK(strcmp(rows[1].name, "odd") == 0 && rows[1].jobs == 1);
  REQUIRE(mo_store_usage(store, MO_USAGE_EXPERIMENT, rows, 4) == 1);
  CHECK(strcmp(rows[0].name, "one") == 0 && rows[0].jobs == 4);
  close_store();
  CHECK_INT(outside_integer(sums), 0);
  REQUIRE_OK(reopen());
}

static void deletes_an_evaluation(void)
{
  struct mo_evaluation_request submission = draw_evaluation(4, 2);
  struct mo_trajectory *trajectory = NULL;
  struct mo_evaluation_results *results = NULL;
  double com[9] = {1};
  struct mo_saved_trajectory saved = {
      .frames = 3, .n_masses = 2, .recording = {.stride = 500, .com_m = com}};
  struct mo_save save = {.trajectories = &saved, .n_trajectories = 1};
  submission.record = MO_RECORD_COM;
  submission.job.key.text = "once";
  const int64_t id = saved.job = submit_evaluation(&submission);
  CHECK_OK(save_and_wait(&save));
  CHECK_INT(delete_job(id), MO_ERR_CONFLICT);
  CHECK_TEXT(message.text, "");
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  CHECK_OK(delete_job(id));
  CHECK_INT(deleted.recorded_bytes, sizeof(com));
  CHECK_TEXT(last_event(id).type, "job.deleted");
  CHECK(strstr(last_event(id).data, "\"reason\":\"request\"") != NULL);
  CHECK_INT(delete_job(id), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_results(store, id, &results), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_trajectory(store, id, 0, 0, &trajectory), MO_ERR_NOT_FOUND);
  FINDS(Q(.archived = -1), -1);
  CHECK_OK(save_and_wait(&save)); /* a block in flight */
  CHECK(is_gone(id));
  CHECK_OK(save_and_wait(&save));
  CHECK_INT(outside_integer("SELECT count(*) FROM trajectories"), 0);
  CHECK_INT(outside_integer("SELECT value FROM meta WHERE key='recorded bytes'"), 0);
  CHECK_INT(outside_integer("SELECT count(*) FROM genotypes"), 2);
  CHECK(submit_evaluation(&submission) > id); /* the key can be used again */
  CHECK_OK(check_whole());
}

/* Commits a generation of a campaign, with a checkpoint of its learning. */
static void commit_one(struct made *made)
{
  static const uint8_t state[] = "state";
  REQUIRE_OK(mo_store_run_start(store, made->id));
  made_next(made);
  CHECK_OK(mo_store_campaign_commit(store, made->id, &made->commit));
  made_apply(made);
  CHECK_OK(mo_store_campaign_checkpoint(store, made->id, 1, 1, state, sizeof(state), NULL, 0));
}

/* A job that others were bred from stays until they are deleted; so does the first job of a
 * group. */
static void keeps_what_others_need(void)
{
  struct mo_campaign_request submission = campaign_submission(MO_FEW_SHOT, MADE_POPULATION, 30);
  struct mo_training_request training = submission_of(5);
  submission.record.replicates = 2;
  const int64_t id = submit_campaign(&submission);
  struct made made = made_start(id, MO_FEW_SHOT, 3);
  commit_one(&made);
  submission.record.replicates = 1;
  submission.record.initial_campaign = id;
  const int64_t bred = submit_campaign(&submission);
  training.record.population = id;
  const int64_t taught = submit_training(&training);
  REQUIRE(bred > 0 && taught > 0);
  for (int64_t one = id; one <= taught; one++)
    CHECK_OK(change(one, MO_CHANGE_CANCEL));
  const int64_t needing[] = {taught, bred, id + 1};
  const char *const words[] = {"training %lld learns on its designs",
                               "campaign %lld was bred from its population",
                               "campaign %lld, a replicate, shares its environments"};
  CHECK_INT(files_of("campaigns", id), 1);
  for (int i = 0; i < 3; i++) {
    char expected[128];
    snprintf(expected, sizeof(expected), words[i], (long long)needing[i]);
    CHECK_INT(delete_job(id), MO_ERR_CONFLICT);
    CHECK_TEXT(message.text, expected);
    CHECK_OK(delete_job(needing[i]));
  }
  CHECK_OK(delete_job(id));
  CHECK(deleted.n_checkpoints == 1 && deleted.checkpoint_bytes == 6);
  CHECK_INT(files_of("campaigns", id), -1);
  CHECK(is_gone(id) && is_gone(bred) && is_gone(taught));
  CHECK_INT(outside_integer("SELECT (SELECT count(*) FROM campaign_designs)+(SELECT count(*) FROM "
                            "campaign_populations)+(SELECT count(*) FROM campaign_steps)+(SELECT "
                            "count(*) FROM campaign_generations)+(SELECT count(*) FROM runs)"),
            0);
  CHECK_OK(check_whole());
}

/* If the process stops after the first transaction, the next one deletes the remaining rows and the
 * files. */
static void goes_on_after_an_end(void)
{
  struct mo_campaign_request submission = campaign_submission(MO_FEW_SHOT, MADE_POPULATION, 30);
  const int64_t id = submit_campaign(&submission);
  struct made made = made_start(id, MO_FEW_SHOT, 3);
  commit_one(&made);
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  REQUIRE_OK(reopen_after("UPDATE jobs SET state=6"));
  CHECK(is_gone(id));
  CHECK_INT(files_of("campaigns", id), -1);
  CHECK_OK(check_whole());
}

static void forgets_by_age(void)
{
  static const char old[] = "UPDATE jobs SET finished_us=1 WHERE finished_us>0; INSERT INTO "
                            "imports SELECT population,1,1,"
                            "zeroblob(32),unixepoch()*1000000 FROM trainings";
  struct mo_evaluation_request submission = draw_evaluation(4, 2);
  struct mo_training_request training = submission_of(5);
  double com[9] = {1};
  struct mo_saved_trajectory saved = {
      .frames = 3, .n_masses = 2, .recording = {.stride = 500, .com_m = com}};
  struct mo_save save = {.trajectories = &saved, .n_trajectories = 1};
  int64_t ids[5];
  submission.record = MO_RECORD_COM;
  for (int i = 0; i < 5; i++) {
    ids[i] = saved.job = submit_evaluation(&submission);
    CHECK_OK(save_and_wait(&save));
    if (i < 4)
      CHECK_OK(change(ids[i], MO_CHANGE_CANCEL));
  }
  CHECK_OK(mo_store_edit_job(store, ids[0], &(struct mo_job_edit){.has_note = true, .note = "!"}));
  CHECK_OK(mo_store_edit_job(store, ids[1],
                             &(struct mo_job_edit){.has_archived = true, .archived = true}));
  training.record.population = ids[2];
  CHECK(submit_training(&training) > 0);
  close_store();
  CHECK_OK(outside(old));
  REQUIRE_OK(reopen_with((struct mo_store_config){.keep_recordings_s = 60}));
  for (int i = 0; i < 500 && job_of(ids[3]).recorded_bytes > 0; i++)
    usleep(10000);
  CHECK(strstr(last_event(ids[3]).data, "\"reason\":\"age\"") != NULL);
  for (int i = 0; i < 5; i++)
    CHECK_INT(job_of(ids[i]).recorded_bytes,
              i == 3 ? 0 : sizeof(com)); /* ids[2] was imported here */
  REQUIRE_OK(reopen_with((struct mo_store_config){.keep_jobs_s = {60}}));
  CHECK(is_gone(ids[3]));
  FINDS(Q(.archived = -1), ids[4] + 1, ids[4], ids[2], ids[1], ids[0], -1);
  CHECK_TEXT(last_event(ids[3]).type, "job.deleted");
  CHECK_OK(check_whole());
}

/* Campaigns and training runs are deleted with their files, each kind by its own rule. Jobs with a
 * note and jobs that are needed stay; an imported campaign stays until its import is old enough. */
static void forgets_runs_by_age(void)
{
#define KEEPS(kind) ((struct mo_store_config){.keep_jobs_s = {[MO_JOB_##kind] = 60}})
  static const char old[] =
      "UPDATE jobs SET finished_us=1; INSERT OR REPLACE INTO imports SELECT max(job),1,1,"
      "zeroblob(32),unixepoch()*1000000 FROM campaigns";
  struct mo_campaign_request submission = campaign_submission(MO_FEW_SHOT, MADE_POPULATION, 30);
  struct mo_training_request training = submission_of(5);
  const int64_t trained = submit_training(&training);
  submission.record.replicates = 2;
  const int64_t id = submit_campaign(&submission);
  struct made made = made_start(id, MO_FEW_SHOT, 3);
  commit_one(&made);
  submission.record.replicates = 1;
  submission.record.initial_campaign = id;
  const int64_t bred = submit_campaign(&submission);
  submission.record.initial_campaign = 0;
  const int64_t entered = submit_campaign(&submission);
  for (int64_t one = trained; one <= entered; one++)
    CHECK_OK(change(one, MO_CHANGE_CANCEL));
  CHECK_OK(mo_store_edit_job(store, bred, &(struct mo_job_edit){.has_note = true, .note = "!"}));
  close_store();
  CHECK_OK(outside(old));
  REQUIRE_OK(reopen_with(KEEPS(CAMPAIGN)));
  CHECK(is_gone(id + 1));
  FINDS(Q(.archived = -1), entered, bred, id, trained, -1);
  CHECK_INT(files_of("campaigns", id), 1);
  CHECK_OK(mo_store_edit_job(store, bred, &(struct mo_job_edit){.has_note = true, .note = NULL}));
  close_store();
  CHECK_OK(outside("UPDATE imports SET imported_us=1"));
  REQUIRE_OK(reopen_with(KEEPS(CAMPAIGN)));
  CHECK(is_gone(id) && is_gone(bred) && is_gone(entered));
  CHECK_INT(files_of("campaigns", id), -1);
  FINDS(Q(.archived = -1), trained, -1);
  REQUIRE_OK(reopen_with(KEEPS(TRAINING)));
  CHECK(is_gone(trained));
  CHECK_TEXT(last_event(trained).type, "job.deleted");
  CHECK_OK(check_whole());
#undef KEEPS
}

#define DAY_S 86400
#define SHIFT(days)                                                                                \
  "UPDATE jobs SET finished_us=finished_us-" #days "*86400000000 WHERE finished_us>0;"             \
  "UPDATE events SET time_us=time_us-" #days "*86400000000;"                                       \
  "UPDATE meta SET value=value-" #days "*86400000000 WHERE key='credible time'"

/* A clock that is far ahead of all stored times, perhaps set wrong, deletes nothing until a person
 * confirms it. After a pause that is short compared with the retention time, the clock is
 * trusted. */
static void doubts_the_clock(void)
{
  const struct mo_store_config keeps = {.keep_jobs_s = {90 * DAY_S}, .keep_recordings_s = DAY_S};
  static const char *const ahead[] = {SHIFT(400),
                                      SHIFT(400) "; DELETE FROM meta WHERE "
                                                 "key='credible time'",
                                      SHIFT(10)};
  struct mo_evaluation_request submission = draw_evaluation(1, 1);
  struct mo_store_stats stats;
  for (int i = 0; i < 3; i++) {
    const int64_t id = submit_evaluation(&submission);
    CHECK_OK(change(id, MO_CHANGE_CANCEL));
    REQUIRE_OK(reopen_with(keeps));
    REQUIRE_OK(reopen_with(keeps)); /* the first one recorded a credible time */
    close_store();
    CHECK_OK(outside(ahead[i]));
    if (i == 2) /* older than 90 days anyway */
      CHECK_OK(outside("UPDATE jobs SET finished_us=1"));
    for (int life = 0; life < 2; life++) { /* nor after another start with new events */
      REQUIRE_OK(reopen_with(keeps));
      for (int k = 0; k < 500; k++, usleep(10000)) {
        mo_store_get_stats(store, &stats);
        if (stats.clock_ahead_us > 0)
          break;
      }
      CHECK_NEAR((double)stats.clock_ahead_us / 86400e6, i < 2 ? 400 : 10, 0.1);
      CHECK_INT(state_of(id), MO_JOB_CANCELLED);
      CHECK_INT(stats.jobs_expired, 0);
      CHECK_OK(change(submit_evaluation(&submission), MO_CHANGE_CANCEL));
    }
    CHECK_OK(mo_store_accept_clock(store));
    REQUIRE_OK(reopen_with(keeps));
    CHECK(is_gone(id));
    mo_store_get_stats(store, &stats);
    CHECK_INT(stats.clock_ahead_us, 0);
  }
  const int64_t id = submit_evaluation(&submission);
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  close_store();
  CHECK_OK(outside(SHIFT(8)));
  CHECK_OK(outside("UPDATE jobs SET finished_us=1"));
  REQUIRE_OK(reopen_with((struct mo_store_config){
      .keep_jobs_s = {90 * DAY_S}})); /* off for a week: the clock is trusted */
  CHECK(is_gone(id));
}

/* On the writer's thread. The computer sleeps for 8 hours in each of 20 nights; then someone sets
 * the clock ahead by 400 days, and the service runs for two more hours. */
static int sleep_and_jump(struct mo_store *of, void *context)
{
  const int64_t hour_us = INT64_C(3600) * 1000000;
  int *n_doubts = context, error = MO_OK;
  for (int night = 0; night < 20 && error == MO_OK; night++) {
    of->credible_us -= 8 * hour_us;
    error = mo_clock_check(of);
    *n_doubts += !mo_clock_is_credible(of);
  }
  of->credible_us -= 400 * 24 * hour_us;
  of->credible_at_us -= 2 * hour_us;
  return error == MO_OK ? mo_clock_check(of) : error;
}

static void believes_a_clock_that_slept(void)
{
  const struct mo_store_config keeps = {.keep_jobs_s = {[MO_JOB_TRAINING] = DAY_S}};
  struct mo_store_stats stats;
  int n_doubts = 0;
  REQUIRE_OK(reopen_with(keeps));
  CHECK_OK(mo_write(store, sleep_and_jump, &n_doubts));
  CHECK_INT(n_doubts, 0);
  mo_store_get_stats(store, &stats);
  CHECK_NEAR((double)stats.clock_ahead_us / 86400e6, 400 - 2.0 / 24, 0.01);
  /* The hours that the service ran count at the next start. */
  const int64_t kept_us = outside_integer("SELECT value FROM meta WHERE key='credible time'");
  CHECK_NEAR((double)(mo_clock_wall_us() - kept_us) / 86400e6, 400 - 2.0 / 24, 0.01);
}

/* The shortest retention time decides for all rules: a clock that is 8 days ahead deletes
 * nothing. */
static void decides_once_for_all_rules(void)
{
  struct mo_evaluation_request submission = draw_evaluation(1, 1);
  struct mo_store_stats stats = {0};
  const int64_t id = submit_evaluation(&submission);
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  REQUIRE_OK(reopen_with((struct mo_store_config){.keep_jobs_s = {90 * DAY_S}}));
  close_store();
  CHECK_OK(outside(SHIFT(8)));
  CHECK_OK(outside("UPDATE jobs SET finished_us=1"));
  REQUIRE_OK(reopen_with((struct mo_store_config){.keep_jobs_s = {90 * DAY_S, DAY_S}}));
  for (int k = 0; k < 500 && stats.clock_ahead_us == 0; k++, usleep(10000))
    mo_store_get_stats(store, &stats);
  usleep(100000);
  CHECK_NEAR((double)stats.clock_ahead_us / 86400e6, 8, 0.1);
  CHECK_INT(state_of(id), MO_JOB_CANCELLED);
}

/* Each round deletes a bounded number and counts it; the next round comes a minute later. */
static void forgets_some_at_a_time(void)
{
  struct mo_evaluation_request submission = draw_evaluation(1, 1);
  struct mo_store_stats stats;
  for (int i = 0; i < 130; i++)
    CHECK_OK(change(submit_evaluation(&submission), MO_CHANGE_CANCEL));
  close_store();
  CHECK_OK(outside("UPDATE jobs SET finished_us=1"));
  REQUIRE_OK(reopen_with((struct mo_store_config){.keep_jobs_s = {60}}));
  for (int i = 0; i < 500 && outside_integer("SELECT count(*) FROM jobs") > 30; i++)
    usleep(10000);
  usleep(100000);
  CHECK_INT(outside_integer("SELECT count(*) FROM jobs"), 30);
  mo_store_get_stats(store, &stats);
  CHECK_INT(stats.jobs_expired, 100);
  REQUIRE_OK(reopen_with((struct mo_store_config){.keep_jobs_s = {60}}));
  for (int i = 0; i < 500 && outside_integer("SELECT count(*) FROM jobs") > 0; i++)
    usleep(10000);
  CHECK_INT(outside_integer("SELECT count(*) FROM jobs"), 0);
}

static const struct check_case cases[] = {
    {"finds jobs by label", finds_what_is_labeled},
    {"counts the usage of jobs", counts_what_jobs_use},
    {"usage follows changes", usage_follows_changes},
    {"deletes an evaluation", deletes_an_evaluation},
    {"keeps jobs that others need", keeps_what_others_need},
    {"continues a deletion after a stop", goes_on_after_an_end},
    {"deletes evaluations by age", forgets_by_age},
    {"deletes trainings and campaigns by age", forgets_runs_by_age},
    {"distrusts a clock far ahead", doubts_the_clock},
    {"trusts the clock after a sleep", believes_a_clock_that_slept},
    {"decides once for all rules", decides_once_for_all_rules},
    {"deletes a bounded number at a time", forgets_some_at_a_time},
};
CHECK_MAIN_AROUND(cases, with_a_store)
