/* runner.c: reads by the scheduler, and state changes requested by clients and restarts. */
#include "store/runner.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/atlases.h"
#include "store/contents.h"
#include "store/jobs.h"
#include "store/recordings.h"
#include "store/runs.h"

/* ---- changes ---- */

struct change_arguments {
  int64_t id;
  enum mo_job_change change;
  enum mo_job_state before;
};

/* Checks whether a change is a no-op (*is_idle) or impossible (MO_ERR_CONFLICT). */
static int check_change(const struct change_arguments *call, enum mo_job_kind kind, bool *is_idle)
{
  const bool is_retry = call->change == MO_CHANGE_RETRY;
  *is_idle = (call->change == MO_CHANGE_PAUSE && call->before == MO_JOB_PAUSED) ||
             (call->change == MO_CHANGE_RESUME && call->before != MO_JOB_PAUSED) ||
             (is_retry && call->before != MO_JOB_FAILED);
  if (mo_job_state_is_final(call->before) &&
      !(is_retry && call->before == MO_JOB_FAILED && kind != MO_JOB_EVALUATION))
    return MO_ERR_CONFLICT;
  return MO_OK;
}

static int change_job(struct mo_store *store, void *arguments)
{
  /* A change clears MO_ERR_DEVICE, which is shown only while the job waits for a device; a retry
   * clears any error. */
  static const char sql[] =
      "UPDATE jobs SET state=?2," MO_NEXT_VERSION ",finished_us=?3,attempts=iif(?5,0,attempts),"
      "error=iif(?5 OR error=?4,0,error),error_text=iif(?5 OR error=?4,NULL,error_text)"
      " WHERE id=?1";
  static const char *const types[] = {"job.finished", "job.paused", "job.resumed", "job.resumed"};
  static const enum mo_job_state targets[] = {MO_JOB_CANCELLED, MO_JOB_PAUSED, MO_JOB_QUEUED,
                                              MO_JOB_QUEUED};
  struct change_arguments *call = arguments;
  const enum mo_job_state target = targets[call->change];
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  bool is_idle = false;
  int error = mo_job_state_get(&store->writer, call->id, &call->before, &kind);
  if (error == MO_OK)
    error = check_change(call, kind, &is_idle);
  if (error != MO_OK || is_idle)
    return error;
  error = mo_sql_do(&store->writer, sql, mo_int(call->id), mo_int(target),
                    mo_int(target == MO_JOB_CANCELLED ? mo_clock_wall_us() : 0),
                    mo_int(MO_ERR_DEVICE), mo_int(call->change == MO_CHANGE_RETRY));
  if (error == MO_OK && target == MO_JOB_CANCELLED && kind == MO_JOB_EVALUATION)
    error = mo_waiting_delete(&store->writer, call->id);
  return error == MO_OK ? mo_run_announce(store, call->id, kind, types[call->change], target, "")
                        : error;
}

int mo_store_change_job(struct mo_store *store, int64_t id, enum mo_job_change change,
                        enum mo_job_state *before)
{
  struct change_arguments call = {.id = id, .change = change};
  /* Resuming and retrying do not help on a full disk, and clients could repeat them endlessly. */
  const bool is_urgent = change == MO_CHANGE_CANCEL || change == MO_CHANGE_PAUSE;
  int error =
      is_urgent ? mo_write_urgent(store, change_job, &call) : mo_write(store, change_job, &call);
  if (error == MO_OK && change == MO_CHANGE_CANCEL && mo_recordings_are_many(store))
    mo_recordings_check(store);
  if (error == MO_OK && change == MO_CHANGE_CANCEL)
    mo_store_atlas_drop(store, id);
  if (error == MO_OK && before != NULL)
    *before = call.before;
  return error;
}

struct weight_arguments {
  int64_t id;
  double weight;
};

static int set_weight(struct mo_store *store, void *arguments)
{
  static const char sql[] =
      "UPDATE jobs SET weight=?2," MO_NEXT_VERSION " WHERE id=?1 AND weight<>?2";
  const struct weight_arguments *call = arguments;
  enum mo_job_state state = MO_JOB_QUEUED;
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  char more[48];
  int error = mo_job_state_get(&store->writer, call->id, &state, &kind);
  if (error != MO_OK)
    return error;
  if (mo_job_state_is_final(state))
    return MO_ERR_CONFLICT;
  error = mo_sql_change(&store->writer, sql, mo_int(call->id), mo_real(call->weight));
  if (error != MO_OK)
    return error == MO_ERR_CONFLICT ? MO_OK : error;
  snprintf(more, sizeof(more), ",\"weight\":%.9g", call->weight);
  return mo_run_announce(store, call->id, kind, "job.weight", state, more);
}

int mo_store_set_weight(struct mo_store *store, int64_t id, double weight)
{
  return mo_write(store, set_weight, &(struct weight_arguments){id, weight});
}

/* ---- start ---- */

struct requeue_arguments {
  int64_t crashed;
  uint32_t max_attempts;
  const char *text;
};

/* Requeues running jobs, and counts the crash. A job that crashes the process in its first block is
 * still queued in the database, because its start was not written. */
static int requeue(struct mo_store *store, void *arguments)
{
  static const char crash_sql[] =
      "UPDATE jobs SET attempts=" MO_NEXT_ATTEMPT ",error=?2,error_text=?3," MO_NEXT_VERSION ","
      "state=CASE WHEN " MO_NEXT_ATTEMPT ">=?4 THEN 4 ELSE 0 END,"
      "finished_us=CASE WHEN " MO_NEXT_ATTEMPT ">=?4 THEN ?5 ELSE 0 END WHERE id=?1 AND state<=1";
  static const char sql[] = "UPDATE jobs SET state=0," MO_NEXT_VERSION " WHERE state=?1";
  const struct requeue_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_state state = MO_JOB_QUEUED;
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  int error = MO_OK;
  if (call->crashed > 0)
    error = mo_sql_change(writer, crash_sql, mo_int(call->crashed), mo_int(MO_ERR_CANCELLED),
                          mo_string(call->text), mo_int(call->max_attempts),
                          mo_int(mo_clock_wall_us()));
  if (call->crashed > 0 && error == MO_OK &&
      mo_job_state_get(writer, call->crashed, &state, &kind) == MO_OK && state == MO_JOB_FAILED)
    error = mo_run_announce(store, call->crashed, kind, "job.finished", MO_JOB_FAILED, "");
  return error == MO_OK || error == MO_ERR_CONFLICT ? mo_sql_do(writer, sql, mo_int(MO_JOB_RUNNING))
                                                    : error;
}

int mo_store_requeue(struct mo_store *store, int64_t crashed, uint32_t max_attempts,
                     const char *text)
{
  return mo_write_urgent(store, requeue, &(struct requeue_arguments){crashed, max_attempts, text});
}

int mo_store_running(struct mo_store *store, int64_t since_us, int64_t *id, uint32_t *n_idle,
                     uint32_t *n)
{
  static const char sql[] =
      "SELECT count(*),count(idle),coalesce(max(idle),0) FROM (SELECT iif("
      "EXISTS(SELECT 1 FROM checkpoints WHERE job=j.id AND stored_us>?1) OR "
      "EXISTS(SELECT 1 FROM campaign_generations WHERE job=j.id AND stored_us>?1) OR "
      "EXISTS(SELECT 1 FROM training_bodies WHERE job=j.id AND stored_us>?1) OR "
      /* Losses have no timestamp; this event is committed together with some of them. */
      "EXISTS(SELECT 1 FROM events WHERE job=j.id AND time_us>?1 AND type='campaign.progress'"
      " AND data LIKE '%\"phase\":\"scoring\"%') OR "
      "EXISTS(SELECT 1 FROM events WHERE job=j.id AND time_us>?1 AND type='atlas.progress'),"
      "NULL,j.id) idle"
      " FROM jobs j WHERE j.state=1 AND j.kind<>0)";
  int64_t found[3] = {0, 0, 0};
  const int error = mo_read_integers(store, sql, MO_VALUES(mo_int(since_us)), 3, found);
  *n = (uint32_t)found[0];
  *n_idle = (uint32_t)found[1];
  *id = found[2];
  return error;
}

struct text_arguments {
  enum mo_texts table;
  const char *text;
  int64_t *id;
};

static int find_text(struct mo_store *store, void *arguments)
{
  const struct text_arguments *call = arguments;
  return mo_text_row(&store->writer, call->table, call->text, call->id);
}

int mo_store_fingerprint(struct mo_store *store, const char *text, int64_t *id)
{
  return mo_write_urgent(store, find_text, &(struct text_arguments){MO_FINGERPRINTS, text, id});
}

static int read_memory(sqlite3_stmt *row, void *ret)
{
  struct mo_device_memory *memory = ret;
  memory->open_jobs = (uint64_t)sqlite3_column_int64(row, 0);
  mo_column_text(row, 1, memory->scores, sizeof(memory->scores));
  mo_column_text(row, 2, memory->gradients, sizeof(memory->gradients));
  return MO_OK;
}

int mo_store_device_memory(struct mo_store *store, struct mo_device_memory *memory)
{
  static const char sql[] =
      "SELECT (SELECT count(*) FROM jobs WHERE back_end=?1 AND state<=?2),d.scores,d.gradients"
      " FROM (SELECT 1) LEFT JOIN device_class d ON d.id=1";
  return mo_read_one(store, sql, MO_VALUES(mo_int(MO_ON_DEVICE), mo_int(MO_JOB_PAUSED)),
                     read_memory, memory);
}

static int keep_class(struct mo_store *store, void *arguments)
{
  const struct mo_device_memory *memory = arguments;
  return mo_sql_do(&store->writer,
                   "INSERT OR REPLACE INTO device_class(id,scores,gradients) VALUES(1,?1,?2)",
                   mo_string(memory->scores), mo_string(memory->gradients));
}

int mo_store_keep_device_class(struct mo_store *store, const char *scores, const char *gradients)
{
  struct mo_device_memory memory;
  if (strlen(scores) >= sizeof(memory.scores) || strlen(gradients) >= sizeof(memory.gradients))
    return MO_ERR_LIMIT;
  snprintf(memory.scores, sizeof(memory.scores), "%s", scores);
  snprintf(memory.gradients, sizeof(memory.gradients), "%s", gradients);
  return mo_write_urgent(store, keep_class, &memory);
}

int mo_store_origin(struct mo_store *store, const char *text, int64_t *id)
{
  return mo_write_urgent(store, find_text, &(struct text_arguments){MO_ORIGINS, text, id});
}

int mo_store_open_work(struct mo_store *store, uint64_t *jobs, uint64_t *rollouts)
{
  /* The factor is mo_ladder_cost, which is 31 for all rungs. */
  static const char sql[] =
      "SELECT count(*),coalesce(sum((e.n_designs-e.n_skipped)*e.n_environments"
      "*iif(e.n_displaced>0,e.n_displaced+3,1)*iif(e.tolerance>0,31,1)),0) FROM jobs j"
      " LEFT JOIN evaluations e ON e.job=j.id WHERE j.state<=?1";
  int64_t found[2] = {0, 0};
  const int error = mo_read_integers(store, sql, MO_VALUES(mo_int(MO_JOB_PAUSED)), 2, found);
  *jobs = (uint64_t)found[0];
  *rollouts = (uint64_t)found[1];
  return error;
}

/* ---- the scheduler's reads ---- */

int64_t mo_store_queued(struct mo_store *store, enum mo_urgency priority, int64_t after, bool large,
                        int64_t *ids, size_t limit)
{
  static const char sql[] =
      "SELECT id FROM jobs INDEXED BY jobs_queued WHERE state=0 AND "
      "priority=?1 AND id>?2 AND kind=0 AND NOT EXISTS(SELECT 1 FROM "
      "evaluations e WHERE e.job=jobs.id AND (e.n_designs>?4 OR e.n_waiting>0))"
      " ORDER BY id LIMIT ?3";
  MO_SCOPED struct mo_connection *reader = mo_runner_acquire(store);
  int64_t n = 0;
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(reader, &error, sql, mo_int(priority), mo_int(after), mo_int((int64_t)limit),
                  mo_int(large ? MO_LARGE_MAX : MO_DESIGNS_MAX));
  while (mo_sql_next(reader, row, &error))
    ids[n++] = sqlite3_column_int64(row, 0);
  return error != MO_OK ? error : n;
}

/* *before: the class that computed the job's stored results; 0: none. */
static int load_head(struct mo_connection *reader, int64_t id, struct mo_work *work,
                     int64_t *before)
{
  static const char sql[] =
      "SELECT controller,physics,coalesce(environment_set,0),coalesce(fingerprint,0),suite FROM "
      "evaluations WHERE job=?1";
  int64_t n_environments = 0;
  sqlite3_stmt *row;
  int error = mo_job_row(reader, id, MO_JOB_EVALUATION, &row);
  if (error == MO_OK)
    error = mo_job_read(row, &work->job, NULL);
  if (error == MO_OK)
    error = mo_sql_row(reader, &row, sql, mo_int(id));
  if (error != MO_OK)
    return error;
  work->controller = sqlite3_column_int64(row, 0);
  work->physics_rows[0] = sqlite3_column_int64(row, 1);
  work->sets[0] = sqlite3_column_int64(row, 2);
  work->n_sets = 1;
  *before = sqlite3_column_int64(row, 3);
  const bool is_suite = sqlite3_column_type(row, 4) != SQLITE_NULL;
  if (is_suite)
    error = mo_suite_find(reader, work->job.environment_set, work->sets, &work->n_sets,
                          &n_environments);
  if (error != MO_OK || (is_suite && n_environments != work->job.n_environments))
    return error == MO_OK || error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  work->n_designs = work->job.n_designs - work->job.n_skipped;
  work->n_environments = work->job.n_environments / work->n_sets;
  const struct mo_setting first = {work->job.physics, work->job.precision};
  work->n_runs = mo_ladder_runs(work->job.n_displaced, work->job.tolerance);
  return mo_physics_runs(reader, &first, work->job.sensor, work->job.n_displaced,
                         work->job.tolerance, work->physics_rows);
}

static int load_designs(struct mo_connection *reader, int64_t id, struct mo_work *work)
{
  struct mo_designs designs;
  const int error = mo_designs_read(reader, id, &designs);
  work->genotypes = designs.genotypes;
  work->genotype_rows = designs.rows;
  work->positions = designs.positions;
  return error == MO_OK && designs.n != work->n_designs ? MO_ERR_CORRUPT : error;
}

/* Repeats an array for each run or set. */
static void *repeat(void *array, size_t n, size_t size, uint32_t times)
{
  uint8_t *all = realloc(array, (n * times + 1) * size);
  for (uint32_t i = 1; i < times && all != NULL; i++)
    memcpy(all + i * n * size, all, n * size);
  if (all == NULL)
    free(array);
  return all;
}

/* Repeats the designs for each run that estimates errors, or for each set of a suite. */
static int repeat_designs(struct mo_work *work)
{
  const uint32_t n = work->n_designs, times = work->n_runs * work->n_sets;
  work->genotypes = repeat(work->genotypes, n, sizeof(*work->genotypes), times);
  work->genotype_rows = repeat(work->genotype_rows, n, sizeof(*work->genotype_rows), times);
  work->positions = repeat(work->positions, n, sizeof(*work->positions), times);
  work->n_designs = n * times;
  return work->genotypes != NULL && work->genotype_rows != NULL && work->positions != NULL
             ? MO_OK
             : MO_ERR_NO_MEMORY;
}

/* Marks the rollouts that earlier attempts of a verify or recording job have finished. */
static int load_finished(struct mo_connection *reader, int64_t id, struct mo_work *work)
{
  static const char verify_sql[] =
      "SELECT position,environment,diverged_step FROM recomputed WHERE job=?1 ORDER BY position";
  static const char record_sql[] =
      "SELECT position,environment,diverged_step FROM trajectories WHERE job=?1 ORDER BY position";
  uint32_t n = 0;
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(reader, &error, work->job.verify ? verify_sql : record_sql, mo_int(id));
  while (mo_sql_next(reader, row, &error)) { /* ascending */
    const uint32_t position = mo_column_u32(row, 0), k = mo_column_u32(row, 1);
    while (n < work->n_designs && work->positions[n] < position)
      n++;
    if (n == work->n_designs || work->positions[n] != position || k >= work->n_environments)
      return MO_ERR_CORRUPT;
    work->finished[(size_t)n * work->n_environments + k] = 1;
    work->n_finished++;
    work->n_finished_diverged += sqlite3_column_int(row, 2) != 0;
  }
  return error;
}

static int load_work(struct mo_connection *reader, int64_t id, const struct mo_classes *classes,
                     struct mo_work *work)
{
  int64_t before = 0;
  int error = load_head(reader, id, work, &before);
  if (error != MO_OK)
    return error;
  const int64_t cpu = classes->cpu[work->job.precision];
  work->workers = work->job.tolerance > 0 ? classes->cpu[MO_FLOAT64] : cpu;
  work->fingerprint = work->job.back_end == MO_ON_DEVICE ? classes->device : cpu;
  bool reruns = work->job.verify || work->job.record != 0;
  const uint32_t n = work->n_sets * work->n_environments;
  work->environment_rows = calloc(n, sizeof(*work->environment_rows));
  work->environments = calloc(n, sizeof(*work->environments));
  if (reruns)
    work->finished = calloc((size_t)work->n_designs * work->n_environments, 1);
  if (work->environment_rows == NULL || work->environments == NULL ||
      (reruns && work->finished == NULL))
    return MO_ERR_NO_MEMORY;
  error = mo_environments_read(reader, id, n, work->environments, work->environment_rows);
  if (error == MO_OK)
    error = load_designs(reader, id, work);
  if (error == MO_OK && work->n_runs * work->n_sets > 1)
    error = repeat_designs(work);
  if (error == MO_OK && reruns && before == work->fingerprint)
    error = load_finished(reader, id, work);
  return error;
}

void mo_work_free(struct mo_work *work)
{
  if (work == NULL)
    return;
  free(work->environment_rows);
  mo_environments_free(work->environments, (size_t)work->n_sets * work->n_environments);
  free(work->genotype_rows);
  free(work->positions);
  free(work->genotypes);
  free(work->finished);
  free(work);
}

int mo_store_load_work(struct mo_store *store, int64_t id, const struct mo_classes *classes,
                       struct mo_work **ret)
{
  struct mo_work *work = calloc(1, sizeof(*work));
  if (work == NULL)
    return MO_ERR_NO_MEMORY;
  MO_SCOPED struct mo_connection *reader = mo_runner_acquire(store);
  int error = load_work(reader, id, classes, work);
  if (error != MO_OK) {
    mo_work_free(work);
    return error;
  }
  *ret = work;
  return MO_OK;
}
