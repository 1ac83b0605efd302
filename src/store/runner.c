/* runner.c: reads of the scheduler, and changes of state that clients and restarts request. */
#include "store/runner.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/internal.h"

/* ---- changes ---- */

struct change_arguments {
  int64_t id;
  enum mo_job_change change;
  enum mo_job_state before;
};

int mo_job_state_get(struct mo_connection *connection, int64_t id, enum mo_job_state *state,
                     enum mo_job_kind *kind)
{
  static const char sql[] = "SELECT state,kind FROM jobs WHERE id=?1";
  int64_t found, found_kind;
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(connection, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  step = mo_sql_step(connection, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_NOT_FOUND;
  found = sqlite3_column_int64(statement, 0);
  found_kind = sqlite3_column_int64(statement, 1);
  (void)sqlite3_reset(statement);
  if (found < 0 || found >= MO_JOB_STATES || found_kind < 0 || found_kind >= MO_JOB_KINDS)
    return MO_ERR_CORRUPT;
  *kind = (enum mo_job_kind)found_kind;
  *state = (enum mo_job_state)found;
  return MO_OK;
}

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
  static const char sql[] =
      "UPDATE jobs SET state=?2," MO_NEXT_VERSION ",finished_us=?3,"
      "error=CASE error WHEN ?4 THEN 0 ELSE error END,"
      "error_text=CASE error WHEN ?4 THEN NULL ELSE error_text END WHERE id=?1";
  static const char retry_sql[] =
      "UPDATE jobs SET state=?2," MO_NEXT_VERSION ",finished_us=?3,attempts=0,error=0,"
      "error_text=NULL WHERE id=?1";
  static const char *const types[] = {"job.finished", "job.paused", "job.resumed", "job.resumed"};
  static const enum mo_job_state targets[] = {MO_JOB_CANCELLED, MO_JOB_PAUSED, MO_JOB_QUEUED,
                                              MO_JOB_QUEUED};
  struct change_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_state target = targets[call->change];
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  sqlite3_stmt *statement;
  bool is_idle = false;
  char data[128];
  int error = mo_job_state_get(writer, call->id, &call->before, &kind);
  if (error == MO_OK)
    error = check_change(call, kind, &is_idle);
  if (error != MO_OK || is_idle)
    return error;
  statement = mo_sql(writer, call->change == MO_CHANGE_RETRY ? retry_sql : sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, target);
  sqlite3_bind_int64(statement, 3, target == MO_JOB_CANCELLED ? mo_clock_wall_us() : 0);
  if (call->change != MO_CHANGE_RETRY) /* a change clears MO_ERR_DEVICE, which is shown only while
                                          the job waits for a device */
    sqlite3_bind_int64(statement, 4, MO_ERR_DEVICE);
  error = mo_sql_run(writer, statement);
  if (error != MO_OK)
    return error;
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"kind\":\"%s\",\"state\":\"%s\"}",
           (long long)call->id, mo_job_kind_name(kind), mo_job_state_name(target));
  return mo_writer_event(store, call->id, types[call->change], data);
}

int mo_store_change_job(struct mo_store *store, int64_t id, enum mo_job_change change,
                        enum mo_job_state *before)
{
  struct change_arguments call = {.id = id, .change = change};
  /* Resuming and retrying do not help on a full disk, and clients could repeat them without end. */
  const bool is_urgent = change == MO_CHANGE_CANCEL || change == MO_CHANGE_PAUSE;
  int error =
      is_urgent ? mo_write_urgent(store, change_job, &call) : mo_write(store, change_job, &call);
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
  struct mo_connection *writer = &store->writer;
  enum mo_job_state state = MO_JOB_QUEUED;
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  sqlite3_stmt *statement;
  char data[160];
  int error = mo_job_state_get(writer, call->id, &state, &kind);
  if (error != MO_OK)
    return error;
  if (mo_job_state_is_final(state))
    return MO_ERR_CONFLICT;
  statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_double(statement, 2, call->weight);
  error = mo_sql_run(writer, statement);
  if (error != MO_OK || sqlite3_changes(writer->db) == 0)
    return error;
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"kind\":\"%s\",\"state\":\"%s\",\"weight\":%.9g}",
           (long long)call->id, mo_job_kind_name(kind), mo_job_state_name(state), call->weight);
  return mo_writer_event(store, call->id, "job.weight", data);
}

int mo_store_set_weight(struct mo_store *store, int64_t id, double weight)
{
  struct weight_arguments call = {.id = id, .weight = weight};
  return mo_write(store, set_weight, &call);
}

/* ---- start ---- */

struct requeue_arguments {
  int64_t crashed;
  uint32_t max_attempts;
  const char *text;
};

/* Queues running jobs again, and counts the crash. A job that crashes the process in its first
 * block is still queued in the database, because its start was not written. */
static int requeue(struct mo_store *store, void *arguments)
{
  static const char crash_sql[] =
      "UPDATE jobs SET attempts=" MO_NEXT_ATTEMPT ",error=?2,error_text=?3," MO_NEXT_VERSION ","
      "state=CASE WHEN " MO_NEXT_ATTEMPT ">=?4 THEN 4 ELSE 0 END,"
      "finished_us=CASE WHEN " MO_NEXT_ATTEMPT ">=?4 THEN ?5 ELSE 0 END WHERE id=?1 AND state<=1";
  static const char sql[] = "UPDATE jobs SET state=0," MO_NEXT_VERSION " WHERE state=1";
  struct requeue_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_state state = MO_JOB_QUEUED;
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  sqlite3_stmt *statement;
  char data[128];
  int error = MO_OK;
  if (call->crashed > 0) {
    statement = mo_sql(writer, crash_sql, &error);
    if (statement == NULL)
      return error;
    sqlite3_bind_int64(statement, 1, call->crashed);
    sqlite3_bind_int64(statement, 2, MO_ERR_CANCELLED);
    sqlite3_bind_text(statement, 3, call->text, -1, SQLITE_STATIC);
    sqlite3_bind_int64(statement, 4, call->max_attempts);
    sqlite3_bind_int64(statement, 5, mo_clock_wall_us());
    error = mo_sql_run(writer, statement);
    (void)sqlite3_clear_bindings(statement);
    if (error == MO_OK && sqlite3_changes(writer->db) > 0 &&
        mo_job_state_get(writer, call->crashed, &state, &kind) == MO_OK && state == MO_JOB_FAILED) {
      snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"kind\":\"%s\",\"state\":\"failed\"}",
               (long long)call->crashed, mo_job_kind_name(kind));
      error = mo_writer_event(store, call->crashed, "job.finished", data);
    }
  }
  statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  return statement != NULL ? mo_sql_run(writer, statement) : error;
}

int mo_store_requeue(struct mo_store *store, int64_t crashed, uint32_t max_attempts,
                     const char *text)
{
  struct requeue_arguments call = {crashed, max_attempts, text};
  return mo_write_urgent(store, requeue, &call);
}

int mo_store_running(struct mo_store *store, int64_t since_us, int64_t *id, uint32_t *n_idle,
                     uint32_t *n)
{
  static const char sql[] =
      "SELECT count(*),count(idle),coalesce(max(idle),0) FROM (SELECT iif("
      "EXISTS(SELECT 1 FROM training_checkpoints WHERE job=j.id AND stored_us>?1) OR "
      "EXISTS(SELECT 1 FROM campaign_generations WHERE job=j.id AND stored_us>?1),NULL,j.id) idle"
      " FROM jobs j WHERE j.state=1 AND j.kind<>0)";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, since_us);
    const int step = mo_sql_step(reader, statement);
    error = step < 0 ? step : MO_OK;
    *n = step > 0 ? (uint32_t)sqlite3_column_int64(statement, 0) : 0;
    *n_idle = step > 0 ? (uint32_t)sqlite3_column_int64(statement, 1) : 0;
    *id = step > 0 ? sqlite3_column_int64(statement, 2) : 0;
    (void)sqlite3_reset(statement);
  }
  mo_reader_release(store, reader);
  return error;
}

struct fingerprint_arguments {
  const char *text;
  int64_t id;
};

int mo_fingerprint_row(struct mo_connection *writer, const char *text, int64_t *id)
{
  static const char insert_sql[] = "INSERT OR IGNORE INTO fingerprints(text) VALUES(?1)";
  static const char find_sql[] = "SELECT id FROM fingerprints WHERE text=?1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, insert_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_text(statement, 1, text, -1, SQLITE_STATIC);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  statement = error == MO_OK ? mo_sql(writer, find_sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_text(statement, 1, text, -1, SQLITE_STATIC);
  error = mo_sql_integer(writer, statement, id);
  (void)sqlite3_clear_bindings(statement);
  return error;
}

static int fingerprint(struct mo_store *store, void *arguments)
{
  struct fingerprint_arguments *call = arguments;
  return mo_fingerprint_row(&store->writer, call->text, &call->id);
}

int mo_store_fingerprint(struct mo_store *store, const char *text, int64_t *id)
{
  struct fingerprint_arguments call = {.text = text};
  int error = mo_write_urgent(store, fingerprint, &call);
  if (error == MO_OK)
    *id = call.id;
  return error;
}

int mo_store_open_work(struct mo_store *store, uint64_t *jobs, uint64_t *rollouts)
{
  static const char sql[] =
      "SELECT count(*),coalesce(sum(e.n_designs*e.n_environments),0) FROM jobs j"
      " LEFT JOIN evaluations e ON e.job=j.id WHERE j.state<=2";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    int step = mo_sql_step(reader, statement);
    if (step > 0) {
      *jobs = (uint64_t)sqlite3_column_int64(statement, 0);
      *rollouts = (uint64_t)sqlite3_column_int64(statement, 1);
    } else {
      error = step < 0 ? step : MO_ERR_CORRUPT;
    }
  }
  mo_reader_release(store, reader);
  return error;
}

/* ---- the scheduler's reads ---- */

int64_t mo_store_queued(struct mo_store *store, enum mo_urgency priority, int64_t after,
                        int64_t *ids, size_t limit)
{
  static const char sql[] = "SELECT id FROM jobs INDEXED BY jobs_queued WHERE state=0 AND "
                            "priority=?1 AND id>?2 AND kind=0"
                            " ORDER BY id LIMIT ?3";
  struct mo_connection *reader = &store->runner;
  sqlite3_stmt *statement;
  int error = MO_OK;
  int64_t n = 0;
  int step = 0;
  pthread_mutex_lock(&store->runner_mutex);
  statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, priority);
    sqlite3_bind_int64(statement, 2, after);
    sqlite3_bind_int64(statement, 3, (sqlite3_int64)limit);
    while ((step = mo_sql_step(reader, statement)) > 0)
      ids[n++] = sqlite3_column_int64(statement, 0);
  }
  pthread_mutex_unlock(&store->runner_mutex);
  return step < 0 ? step : error != MO_OK ? error : n;
}

static int load_head(struct mo_connection *reader, int64_t id, struct mo_work *work)
{
  static const char sql[] =
      "SELECT " MO_JOB_COLUMNS ",e.controller,e.physics,coalesce(e.environment_set,0)" MO_JOB_TABLES
      "WHERE j.id=?1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  int step;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  step = mo_sql_step(reader, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_NOT_FOUND;
  error = mo_job_from_row(statement, &work->job);
  if (error == MO_OK && work->job.kind != MO_JOB_EVALUATION)
    error = MO_ERR_NOT_FOUND;
  work->controller = sqlite3_column_int64(statement, MO_JOB_N_COLUMNS);
  work->physics = sqlite3_column_int64(statement, MO_JOB_N_COLUMNS + 1);
  work->environment_set = sqlite3_column_int64(statement, MO_JOB_N_COLUMNS + 2);
  (void)sqlite3_reset(statement);
  work->n_designs = work->job.n_designs;
  work->n_environments = work->job.n_environments;
  return error;
}

static int load_environments(struct mo_connection *reader, int64_t id, struct mo_work *work)
{
  static const char sql[] =
      "SELECT x.position,x.environment,e.data,e.sha256 FROM evaluation_environments x"
      " JOIN environments e ON e.id=x.environment WHERE x.job=?1 ORDER BY x.position";
  int error = MO_OK;
  uint32_t n = 0;
  int step;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  while ((step = mo_sql_step(reader, statement)) > 0) {
    if (n == work->n_environments || sqlite3_column_int64(statement, 0) != n ||
        mo_column_environment(statement, 2, 3, &work->environments[n]) != MO_OK)
      return MO_ERR_CORRUPT;
    work->environment_rows[n] = sqlite3_column_int64(statement, 1);
    n++;
  }
  if (step < 0)
    return step;
  return n == work->n_environments ? MO_OK : MO_ERR_CORRUPT;
}

static int load_genotypes(struct mo_connection *reader, int64_t id, struct mo_work *work)
{
  static const char sql[] =
      "SELECT x.position,x.genotype,g.bits FROM evaluation_designs x"
      " JOIN genotypes g ON g.id=x.genotype WHERE x.job=?1 ORDER BY x.position";
  int error = MO_OK;
  uint32_t n = 0;
  int step = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    if (n == work->n_designs || sqlite3_column_int64(statement, 0) != n)
      return MO_ERR_CORRUPT;
    work->genotype_rows[n] = sqlite3_column_int64(statement, 1);
    error = mo_column_bits(statement, 2, &work->genotypes[n]);
    n++;
  }
  if (step < 0)
    return step;
  return error == MO_OK && n != work->n_designs ? MO_ERR_CORRUPT : error;
}

/* Marks the rollouts that earlier attempts of a verify or recording job have finished. */
static int load_finished(struct mo_connection *reader, int64_t id, struct mo_work *work)
{
  static const char verify_sql[] =
      "SELECT position,environment,diverged_step FROM recomputed WHERE job=?1";
  static const char record_sql[] =
      "SELECT t.position,t.environment,x.diverged_step FROM trajectories t"
      " JOIN evaluations e ON e.job=t.job"
      " JOIN evaluation_designs d ON d.job=t.job AND d.position=t.position"
      " JOIN evaluation_environments v ON v.job=t.job AND v.position=t.environment"
      " JOIN scores x ON x.genotype=d.genotype AND x.controller=e.controller AND "
      "x.physics=e.physics"
      " AND x.environment=v.environment WHERE t.job=?1";
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(reader, work->job.verify ? verify_sql : record_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  while ((step = mo_sql_step(reader, statement)) > 0) {
    int64_t n = sqlite3_column_int64(statement, 0), k = sqlite3_column_int64(statement, 1);
    if (n < 0 || n >= work->n_designs || k < 0 || k >= work->n_environments)
      return MO_ERR_CORRUPT;
    work->finished[(size_t)n * work->n_environments + (size_t)k] = 1;
    work->n_finished++;
    work->n_finished_diverged += sqlite3_column_int(statement, 2) != 0;
  }
  return step;
}

static int load_work(struct mo_connection *reader, int64_t id, struct mo_work *work)
{
  bool reruns;
  int error = load_head(reader, id, work);
  if (error != MO_OK)
    return error;
  if (work->n_designs == 0 || work->n_environments == 0)
    return MO_ERR_CORRUPT;
  reruns = work->job.verify || work->job.record_com || work->job.record_masses;
  work->environment_rows = calloc(work->n_environments, sizeof(*work->environment_rows));
  work->environments = calloc(work->n_environments, sizeof(*work->environments));
  work->genotype_rows = calloc(work->n_designs, sizeof(*work->genotype_rows));
  work->genotypes = calloc(work->n_designs, sizeof(*work->genotypes));
  if (reruns)
    work->finished = calloc((size_t)work->n_designs * work->n_environments, 1);
  if (work->environment_rows == NULL || work->environments == NULL || work->genotype_rows == NULL ||
      work->genotypes == NULL || (reruns && work->finished == NULL))
    return MO_ERR_NO_MEMORY;
  error = load_environments(reader, id, work);
  if (error == MO_OK)
    error = load_genotypes(reader, id, work);
  if (error == MO_OK && reruns)
    error = load_finished(reader, id, work);
  return error;
}

int mo_store_load_work(struct mo_store *store, int64_t id, struct mo_work **ret)
{
  struct mo_work *work = calloc(1, sizeof(*work));
  int error;
  if (work == NULL)
    return MO_ERR_NO_MEMORY;
  pthread_mutex_lock(&store->runner_mutex);
  error = mo_sql_exec(&store->runner, "BEGIN");
  if (error == MO_OK)
    error = load_work(&store->runner, id, work);
  for (unsigned i = 0; i < store->runner.n_cached; i++)
    (void)sqlite3_reset(store->runner.cache[i].statement);
  if (!sqlite3_get_autocommit(store->runner.db))
    (void)mo_sql_exec(&store->runner, "COMMIT");
  pthread_mutex_unlock(&store->runner_mutex);
  if (error != MO_OK) {
    mo_work_free(work);
    return error;
  }
  *ret = work;
  return MO_OK;
}

int mo_store_scores(struct mo_store *store, int64_t genotype, int64_t controller, int64_t physics,
                    const int64_t *environment_rows, uint32_t n, struct mo_score *scores)
{
  static const char sql[] =
      "SELECT environment,loss,diverged_step FROM scores WHERE genotype=?1 AND controller=?2"
      " AND physics=?3 AND environment BETWEEN ?4 AND ?5";
  int64_t lowest = INT64_MAX, highest = INT64_MIN;
  struct mo_connection *reader = &store->runner;
  sqlite3_stmt *statement;
  int error = MO_OK;
  int step = 0;
  for (uint32_t k = 0; k < n; k++) {
    scores[k] = (struct mo_score){0};
    if (environment_rows[k] < lowest)
      lowest = environment_rows[k];
    if (environment_rows[k] > highest)
      highest = environment_rows[k];
  }
  pthread_mutex_lock(&store->runner_mutex);
  statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, genotype);
    sqlite3_bind_int64(statement, 2, controller);
    sqlite3_bind_int64(statement, 3, physics);
    sqlite3_bind_int64(statement, 4, lowest);
    sqlite3_bind_int64(statement, 5, highest);
    while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
      int64_t environment = sqlite3_column_int64(statement, 0);
      struct mo_score score = {.diverged_step = sqlite3_column_int(statement, 2), .known = true};
      error = mo_column_double(statement, 1, &score.loss);
      for (uint32_t k = 0; k < n && error == MO_OK; k++)
        if (environment_rows[k] == environment)
          scores[k] = score;
    }
    (void)sqlite3_reset(statement);
  }
  pthread_mutex_unlock(&store->runner_mutex);
  return step < 0 ? step : error;
}
