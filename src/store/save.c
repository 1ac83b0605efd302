/* save.c: what the scheduler writes, in one transaction: losses, trajectories, steps of jobs.
 *
 * Updates of a job are fenced: they apply only to a job that runs under this opening of the store
 * (its epoch). So a job that a client has cancelled or paused meanwhile keeps that state. Scores
 * are stored in any case, because they are true. So are the counts of a job that is not final;
 * otherwise blocks that finish after a pause would seem to be another job's work. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/runs.h"
#include "store/scores.h"

#include "base/clock.h"

static int save_trajectory(struct mo_connection *writer,
                           const struct mo_saved_trajectory *trajectory)
{
  static const char sql[] =
      "INSERT OR IGNORE INTO "
      "trajectories(job,position,environment,stride,frames,n_masses,com,masses,diverged_step)"
      " VALUES(?1,?2,?3,?4,?5,?6,?7,?8,?9)";
  size_t n_com = trajectory->com_m != NULL ? (size_t)trajectory->frames * 3 : 0;
  size_t n_mass =
      trajectory->mass_m != NULL ? (size_t)trajectory->frames * trajectory->n_masses * 3 : 0;
  uint8_t *bytes = malloc(n_com * 8 + n_mass * 4 + 1);
  sqlite3_stmt *statement;
  int error = MO_OK;
  if (bytes == NULL)
    return MO_ERR_NO_MEMORY;
  mo_encode_doubles(trajectory->com_m, n_com, bytes);
  mo_encode_floats(trajectory->mass_m, n_mass, bytes + n_com * 8);
  statement = mo_sql(writer, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, trajectory->job);
    sqlite3_bind_int64(statement, 2, trajectory->design_position);
    sqlite3_bind_int64(statement, 3, trajectory->environment_position);
    sqlite3_bind_int64(statement, 4, trajectory->stride);
    sqlite3_bind_int64(statement, 5, trajectory->frames);
    sqlite3_bind_int64(statement, 6, trajectory->n_masses);
    if (n_com > 0)
      sqlite3_bind_blob64(statement, 7, bytes, n_com * 8, SQLITE_STATIC);
    if (n_mass > 0)
      sqlite3_bind_blob64(statement, 8, bytes + n_com * 8, n_mass * 4, SQLITE_STATIC);
    sqlite3_bind_int64(statement, 9, trajectory->diverged_step);
    error = mo_sql_run(writer, statement);
    (void)sqlite3_clear_bindings(statement);
  }
  free(bytes);
  return error;
}

/* ---- steps of jobs ---- */

static const char start_sql[] = "UPDATE jobs SET state=1,epoch=?2," MO_NEXT_VERSION
                                ",started_us=CASE started_us WHEN 0 THEN ?3 ELSE started_us END"
                                " WHERE id=?1 AND (state=0 OR (state=1 AND epoch=?2))";
static const char progress_sql[] =
    "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1 AND state=1 AND epoch=?2";
static const char succeed_sql[] =
    "UPDATE jobs SET state=3," MO_NEXT_VERSION ",finished_us=?3,error=0,error_text=NULL"
    " WHERE id=?1 AND state=1 AND epoch=?2";
static const char retry_sql[] =
    "UPDATE jobs SET attempts=" MO_NEXT_ATTEMPT "," MO_NEXT_VERSION ",error=?4,error_text=?5,"
    "state=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN 4 ELSE 0 END,"
    "finished_us=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN ?3 ELSE 0 END"
    " WHERE id=?1 AND (state=0 OR (state=1 AND epoch=?2))";
static const char park_sql[] =
    "UPDATE jobs SET state=0," MO_NEXT_VERSION " WHERE id=?1 AND state=1 AND epoch=?2";

static const char halt_sql[] = "UPDATE jobs SET state=2," MO_NEXT_VERSION ",error=?4,error_text=?5"
                               " WHERE id=?1 AND (state=0 OR (state=1 AND epoch=?2))";

static int apply_counts(struct mo_connection *writer, const struct mo_job_update *update)
{
  static const char sql[] = "UPDATE evaluations SET done=?2,cached=?3,diverged=?4 WHERE job=?1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, update->job);
  sqlite3_bind_int64(statement, 2, (sqlite3_int64)update->done);
  sqlite3_bind_int64(statement, 3, (sqlite3_int64)update->cached);
  sqlite3_bind_int64(statement, 4, (sqlite3_int64)update->diverged);
  return mo_sql_run(writer, statement);
}

static int read_state(struct mo_connection *writer, struct mo_job_update *update)
{
  static const char sql[] = "SELECT state FROM jobs WHERE id=?1";
  int64_t state;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, update->job);
  error = mo_sql_integer(writer, statement, &state);
  if (error == MO_OK && (state < 0 || state >= MO_JOB_STATES))
    error = MO_ERR_CORRUPT;
  if (error == MO_OK)
    update->state = (enum mo_job_state)state;
  return error;
}

static int announce(struct mo_store *store, const struct mo_job_update *update)
{
  const char *type = update->step == MO_STEP_START          ? "job.started"
                     : update->step == MO_STEP_PROGRESS     ? "job.progress"
                     : update->step == MO_STEP_HALT         ? "job.paused"
                     : mo_job_state_is_final(update->state) ? "job.finished"
                                                            : "job.requeued";
  char data[320];
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"kind\":\"evaluation\",\"state\":\"%s\",\"rollouts_total\":%llu,"
           "\"rollouts_done\":%llu,"
           "\"rollouts_cached\":%llu,\"rollouts_diverged\":%llu}",
           (long long)update->job, mo_job_state_name(update->state),
           (unsigned long long)update->total, (unsigned long long)update->done,
           (unsigned long long)update->cached, (unsigned long long)update->diverged);
  return mo_writer_event(store, update->job, type, data);
}

/* Stores the class of a job that starts. If the process that ran it before had another one, the job
 * goes on in the new class from its beginning: what was recorded and recomputed is deleted. */
static int set_class(struct mo_store *store, const struct mo_job_update *update)
{
  static const char before_sql[] =
      "SELECT a.text,b.text FROM evaluations e JOIN fingerprints a ON a.id=e.fingerprint"
      " JOIN fingerprints b ON b.id=?2 WHERE e.job=?1 AND e.fingerprint<>?2";
  static const char class_sql[] = "UPDATE evaluations SET fingerprint=?2,workers=?3 WHERE job=?1";
  static const char trajectories_sql[] = "DELETE FROM trajectories WHERE job=?1";
  static const char recomputed_sql[] = "DELETE FROM recomputed WHERE job=?1";
  struct mo_connection *writer = &store->writer;
  const struct mo_value job = mo_int(update->job), now = mo_int(update->fingerprint);
  char data[320];
  sqlite3_stmt *row;
  int error = mo_sql_row(writer, &row, before_sql, job, now);
  if (error == MO_OK) {
    snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"before\":\"%s\",\"fingerprint\":\"%s\"}",
             (long long)update->job, (const char *)sqlite3_column_text(row, 0),
             (const char *)sqlite3_column_text(row, 1));
    (void)sqlite3_reset(row);
    error = mo_writer_event(store, update->job, "evaluation.code_changed", data);
    if (error == MO_OK)
      error = mo_sql_do(writer, trajectories_sql, job);
    if (error == MO_OK)
      error = mo_sql_do(writer, recomputed_sql, job);
  }
  return error == MO_OK || error == MO_ERR_NOT_FOUND
             ? mo_sql_do(writer, class_sql, job, now, mo_int(update->workers))
             : error;
}

/* Stores only the counts of a step that came after the job left its state, and for a start the
 * class, to which the results of its blocks in flight belong. */
static int apply_late_counts(struct mo_store *store, const struct mo_job_update *update)
{
  static const char sql[] = "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1 AND state IN (0,2)";
  struct mo_connection *writer = &store->writer;
  int error = MO_OK;
  sqlite3_stmt *statement;
  if (update->total == 0)
    return MO_OK;
  statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, update->job);
  error = mo_sql_run(writer, statement);
  if (error != MO_OK || sqlite3_changes(writer->db) == 0)
    return error;
  if (update->step == MO_STEP_START && update->fingerprint != 0)
    error = set_class(store, update);
  return error == MO_OK ? apply_counts(writer, update) : error;
}

static int apply_update(struct mo_store *store, struct mo_job_update *update)
{
  static const char *const sql[] = {start_sql, progress_sql, succeed_sql,
                                    retry_sql, park_sql,     halt_sql};
  struct mo_connection *writer = &store->writer;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql[update->step], &error);
  update->applied = false;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, update->job);
  sqlite3_bind_int64(statement, 2, store->epoch);
  if (update->step == MO_STEP_START)
    sqlite3_bind_int64(statement, 3,
                       update->started_us != 0 ? update->started_us : mo_clock_wall_us());
  if (update->step == MO_STEP_SUCCEED || update->step == MO_STEP_RETRY)
    sqlite3_bind_int64(statement, 3, mo_clock_wall_us());
  if (update->step == MO_STEP_RETRY || update->step == MO_STEP_HALT) {
    sqlite3_bind_int64(statement, 4, update->error);
    sqlite3_bind_text(statement, 5, update->error_text, -1, SQLITE_STATIC);
  }
  if (update->step == MO_STEP_RETRY)
    sqlite3_bind_int64(statement, 6, update->max_attempts);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  if (error != MO_OK)
    return error;
  if (sqlite3_changes(writer->db) == 0)
    return apply_late_counts(store, update);
  update->applied = true;
  if (update->step == MO_STEP_START && update->fingerprint != 0)
    error = set_class(store, update);
  if (error != MO_OK)
    return error;
  if (update->total > 0)
    error = apply_counts(writer, update);
  if (error == MO_OK)
    error = read_state(writer, update);
  return error == MO_OK && !update->quiet ? announce(store, update) : error;
}

static int save(struct mo_store *store, void *arguments)
{
  struct mo_save *call = arguments;
  struct mo_connection *writer = &store->writer;
  int64_t ranking = 0;
  int error = mo_scores_insert(store, call->scores, call->n_scores, mo_clock_wall_us());
  for (size_t i = 0; i < call->n_trajectories && error == MO_OK; i++)
    error = save_trajectory(writer, &call->trajectories[i]);
  for (size_t i = 0; i < call->n_designs && error == MO_OK; i++) {
    error = mo_ranking_row(writer, &call->designs[i], &ranking);
    if (error == MO_OK)
      error = mo_set_score_insert(writer, &call->designs[i], ranking);
  }
  for (size_t i = 0; i < call->n_updates && error == MO_OK; i++)
    error = apply_update(store, &call->updates[i]);
  return error;
}

static void saved(void *arguments, int status)
{
  struct mo_save *call = arguments;
  call->done(call, status);
}

int mo_store_save(struct mo_store *store, struct mo_save *call)
{
  return mo_write_later(store, save, call, saved);
}
