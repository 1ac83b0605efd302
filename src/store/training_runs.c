/* training_runs.c: what the runner of a training writes: its steps and its end; its checkpoints are in training_checkpoints.c.
 *
 * Writes are fenced by the epoch: the training must have been started under this opening of the store and must not be over. One
 * that was paused, or resumed at once, takes rows and checkpoints still: its thread saves what it has applied. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/internal.h"
#include "store/trainings.h"

static int count_changed(struct mo_connection *writer, sqlite3_stmt *statement)
{
  int error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error == MO_OK && sqlite3_changes(writer->db) == 0 ? MO_ERR_CONFLICT : error;
}

int mo_training_touch(struct mo_store *store, int64_t id)
{
  static const char sql[] = "UPDATE jobs SET version=version+1 WHERE id=?1 AND kind=1 AND state<=2 AND epoch=?2";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(&store->writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  return count_changed(&store->writer, statement);
}

static int announce(struct mo_store *store, int64_t id, const char *type, enum mo_job_state state, const char *more)
{
  char data[400];
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"kind\":\"training\",\"state\":\"%s\"%s}", (long long)id,
           mo_job_state_name(state), more);
  return mo_writer_event(store, id, type, data);
}

/* A JSON number, null when it is not finite. */
static const char *number(double value, char text[32])
{
  snprintf(text, 32, isfinite(value) ? "%.17g" : "null", value);
  return text;
}

/* ---- the queue ---- */

int64_t mo_store_queued_trainings(struct mo_store *store, int64_t *ids, size_t limit)
{
  static const char sql[] = "SELECT id FROM jobs WHERE state=0 AND kind=1 ORDER BY id LIMIT ?1";
  struct mo_connection *reader;
  sqlite3_stmt *statement;
  int error = MO_OK;
  int64_t n = 0;
  if (limit > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  reader = mo_reader_acquire(store);
  statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, (sqlite3_int64)limit);
    while ((error = mo_sql_step(reader, statement)) > 0)
      ids[n++] = sqlite3_column_int64(statement, 0);
  }
  mo_reader_release(store, reader);
  return error < 0 ? error : n;
}

static int start(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE jobs SET state=1,epoch=?2,version=version+1,"
                            "started_us=CASE started_us WHEN 0 THEN ?3 ELSE started_us END"
                            " WHERE id=?1 AND kind=1 AND state=0";
  const int64_t *id = arguments;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(&store->writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, *id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  sqlite3_bind_int64(statement, 3, mo_store_now_us());
  error = count_changed(&store->writer, statement);
  return error == MO_OK ? announce(store, *id, "job.started", MO_JOB_RUNNING, "") : error;
}

int mo_store_training_start(struct mo_store *store, int64_t id)
{
  return mo_write(store, start, &id);
}

/* ---- progress ---- */

struct progress_arguments {
  int64_t id;
  const struct mo_training_step_row *steps;
  size_t n_steps;
  const struct mo_training_validation_row *validation;
  const char *event_data;
};

static int write_step(struct mo_connection *writer, int64_t id, const struct mo_training_step_row *row)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO training_steps(job,step,mean_loss,rate,gradient_norm,clipped_share,clipped_robots_share,"
      "diverged,zeroed,skipped,bounded,seconds) VALUES(?1,?2,?3,?4,?5,?6,?7,?8,?9,?10,?11,?12)";
  const struct mo_training_report *report = &row->report;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, report->step);
  sqlite3_bind_double(statement, 3, report->mean_loss);
  sqlite3_bind_double(statement, 4, report->rate);
  sqlite3_bind_double(statement, 5, report->gradient_norm);
  sqlite3_bind_double(statement, 6, report->clipped_share);
  sqlite3_bind_double(statement, 7, report->clipped_robots_share);
  sqlite3_bind_int64(statement, 8, report->diverged);
  sqlite3_bind_int64(statement, 9, report->zeroed);
  sqlite3_bind_int64(statement, 10, report->skipped);
  sqlite3_bind_int64(statement, 11, report->bounded);
  sqlite3_bind_double(statement, 12, row->seconds);
  return mo_sql_run(writer, statement);
}

static int write_validation(struct mo_store *store, int64_t id, const struct mo_training_validation_row *row)
{
  static const char sql[] = "INSERT OR REPLACE INTO training_validations(job,step,rollouts,diverged,mean_score,"
                            "standard_error) VALUES(?1,?2,?3,?4,?5,?6)";
  struct mo_connection *writer = &store->writer;
  char data[256], mean[32], deviation[32];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, row->step);
  sqlite3_bind_int64(statement, 3, row->rollouts);
  sqlite3_bind_int64(statement, 4, row->diverged);
  sqlite3_bind_double(statement, 5, row->mean_score);
  sqlite3_bind_double(statement, 6, row->standard_error);
  error = mo_sql_run(writer, statement);
  if (error != MO_OK)
    return error;
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"step\":%u,\"mean_score\":%s,\"standard_error\":%s,\"rollouts\":%u,\"diverged\":%u}",
           (long long)id, (unsigned)row->step, number(row->mean_score, mean), number(row->standard_error, deviation),
           (unsigned)row->rollouts, (unsigned)row->diverged);
  return mo_writer_event(store, id, "training.validation", data);
}

static int progress(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE trainings SET step=max(step,?2) WHERE job=?1";
  const struct progress_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  sqlite3_stmt *statement;
  int error = mo_training_touch(store, call->id);
  for (size_t i = 0; i < call->n_steps && error == MO_OK; i++)
    error = write_step(writer, call->id, &call->steps[i]);
  if (error == MO_OK && call->n_steps > 0 && (statement = mo_sql(writer, sql, &error)) != NULL) {
    sqlite3_bind_int64(statement, 1, call->id);
    sqlite3_bind_int64(statement, 2, call->steps[call->n_steps - 1].report.step);
    error = mo_sql_run(writer, statement);
  }
  if (error == MO_OK && call->n_steps > 0 && call->event_data != NULL)
    error = mo_writer_event(store, call->id, "training.progress", call->event_data);
  if (error == MO_OK && call->validation != NULL)
    error = write_validation(store, call->id, call->validation);
  return error;
}

int mo_store_training_progress(struct mo_store *store, int64_t id, const struct mo_training_step_row *steps,
                               size_t n_steps, const struct mo_training_validation_row *validation,
                               const char *event_data)
{
  struct progress_arguments call = {id, steps, n_steps, validation, event_data};
  return mo_write(store, progress, &call);
}

/* ---- ends ---- */

struct finish_arguments {
  int64_t id;
  struct mo_controller_put put;
};

static int finish(struct mo_store *store, void *arguments)
{
  static const char job_sql[] = "UPDATE jobs SET state=3,version=version+1,finished_us=?3,error=0,error_text=NULL"
                                " WHERE id=?1 AND kind=1 AND state=1 AND epoch=?2";
  static const char sql[] = "UPDATE trainings SET result=?2 WHERE job=?1";
  struct finish_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char more[192], digits[MO_SHA256_DIGITS + 1];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, job_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  sqlite3_bind_int64(statement, 3, mo_store_now_us());
  error = count_changed(writer, statement);
  if (error == MO_OK)
    error = mo_controller_put_row(store, &call->put);
  statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, call->put.row);
  error = mo_sql_run(writer, statement);
  if (error != MO_OK)
    return error;
  mo_sha256_to_hex(&call->put.sha256, digits);
  snprintf(more, sizeof(more), ",\"controller\":\"%s\",\"sha256\":\"%s\"", call->put.name, digits);
  return announce(store, call->id, "job.finished", MO_JOB_SUCCEEDED, more);
}

int mo_store_training_finish(struct mo_store *store, int64_t id, const char *name, const uint8_t *bytes, size_t size,
                             const struct mo_controller *controller)
{
  struct finish_arguments call = {.id = id};
  int error = mo_controller_put_begin(store, name, bytes, size, controller, &call.put);
  if (error == MO_OK)
    error = mo_write(store, finish, &call);
  mo_controller_put_end(&call.put);
  return error;
}

struct park_arguments {
  int64_t id;
  int error;
  const char *text;
  uint32_t max_attempts;
  enum mo_job_state after;
};

static int park(struct mo_store *store, void *arguments)
{
  static const char park_sql[] =
      "UPDATE jobs SET state=0,version=version+1 WHERE id=?1 AND kind=1 AND state=1 AND epoch=?2";
  static const char retry_sql[] = "UPDATE jobs SET attempts=attempts+1,version=version+1,error=?4,error_text=?5,"
                                  "state=CASE WHEN attempts+1>=?6 THEN 4 ELSE 0 END,"
                                  "finished_us=CASE WHEN attempts+1>=?6 THEN ?3 ELSE 0 END"
                                  " WHERE id=?1 AND kind=1 AND state=1 AND epoch=?2";
  struct park_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_kind kind;
  int error = MO_OK;
  bool applied;
  sqlite3_stmt *statement = mo_sql(writer, call->error == MO_OK ? park_sql : retry_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  if (call->error != MO_OK) {
    sqlite3_bind_int64(statement, 3, mo_store_now_us());
    sqlite3_bind_int64(statement, 4, call->error);
    sqlite3_bind_text(statement, 5, call->text, -1, SQLITE_STATIC);
    sqlite3_bind_int64(statement, 6, call->max_attempts);
  }
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  applied = error == MO_OK && sqlite3_changes(writer->db) > 0;
  if (error == MO_OK)
    error = mo_job_state_get(writer, call->id, &call->after, &kind);
  if (error != MO_OK || !applied)
    return error;
  return announce(store, call->id, call->after == MO_JOB_FAILED ? "job.finished" : "job.requeued", call->after, "");
}

int mo_store_training_park(struct mo_store *store, int64_t id, int error, const char *error_text, uint32_t max_attempts,
                           enum mo_job_state *after)
{
  struct park_arguments call = {id, error, error_text, max_attempts, MO_JOB_QUEUED};
  int status = mo_write(store, park, &call);
  if (status == MO_OK && after != NULL)
    *after = call.after;
  return status;
}
