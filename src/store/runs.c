/* runs.c: what trainings and campaigns share as jobs that run on a thread of their own: queue,
 * start, fence, end of an attempt.
 *
 * Writes are fenced by the epoch: the job must have been started under this opening of the store
 * and must not be final. */
#include <stdio.h>

#include "store/internal.h"

#include "base/clock.h"

int mo_run_changed(struct mo_connection *writer, sqlite3_stmt *statement)
{
  int error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error == MO_OK && sqlite3_changes(writer->db) == 0 ? MO_ERR_CONFLICT : error;
}

int mo_run_touch(struct mo_store *store, int64_t id, enum mo_job_kind kind)
{
  static const char sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1 AND kind=?3 AND state<=2 AND epoch=?2";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(&store->writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  sqlite3_bind_int64(statement, 3, kind);
  return mo_run_changed(&store->writer, statement);
}

int mo_run_announce(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *type,
                    enum mo_job_state state, const char *more)
{
  char data[400];
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"kind\":\"%s\",\"state\":\"%s\"%s}",
           (long long)id, mo_job_kind_name(kind), mo_job_state_name(state), more);
  return mo_writer_event(store, id, type, data);
}

static int take_id(sqlite3_stmt *statement, void *id)
{
  *(int64_t *)id = sqlite3_column_int64(statement, 0);
  return MO_OK;
}

int64_t mo_run_queued(struct mo_store *store, enum mo_job_kind kind, int64_t *ids, size_t limit)
{
  static const char sql[] =
      "SELECT id FROM jobs WHERE state=0 AND kind=?1 ORDER BY priority DESC,id LIMIT ?2";
  const int64_t value = kind;
  return mo_read_rows(store, sql, &value, 1, limit, take_id, ids, sizeof(*ids));
}

struct start_arguments {
  int64_t id;
  enum mo_job_kind kind;
};

static int start(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE jobs SET state=1,epoch=?2," MO_NEXT_VERSION ","
                            "started_us=CASE started_us WHEN 0 THEN ?3 ELSE started_us END"
                            " WHERE id=?1 AND kind=?4 AND state=0";
  const struct start_arguments *call = arguments;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(&store->writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  sqlite3_bind_int64(statement, 3, mo_clock_wall_us());
  sqlite3_bind_int64(statement, 4, call->kind);
  error = mo_run_changed(&store->writer, statement);
  return error == MO_OK
             ? mo_run_announce(store, call->id, call->kind, "job.started", MO_JOB_RUNNING, "")
             : error;
}

int mo_run_start(struct mo_store *store, int64_t id, enum mo_job_kind kind)
{
  struct start_arguments call = {id, kind};
  return mo_write(store, start, &call);
}

struct park_arguments {
  int64_t id;
  enum mo_job_kind kind;
  int error;
  const char *text;
  uint32_t max_attempts;
  enum mo_job_state after;
};

static int park(struct mo_store *store, void *arguments)
{
  static const char park_sql[] = "UPDATE jobs SET state=0," MO_NEXT_VERSION
                                 " WHERE id=?1 AND kind=?7 AND state=1 AND epoch=?2";
  static const char retry_sql[] =
      "UPDATE jobs SET attempts=" MO_NEXT_ATTEMPT "," MO_NEXT_VERSION ",error=?4,error_text=?5,"
      "state=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN 4 ELSE 0 END,"
      "finished_us=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN ?3 ELSE 0 END"
      " WHERE id=?1 AND kind=?7 AND state=1 AND epoch=?2";
  static const char halt_sql[] =
      "UPDATE jobs SET state=2," MO_NEXT_VERSION ",error=?4,error_text=?5"
      " WHERE id=?1 AND kind=?7 AND state=1 AND epoch=?2";
  struct park_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  const bool halts = call->error == MO_ERR_DEVICE;
  enum mo_job_kind kind;
  int error = MO_OK;
  bool applied;
  sqlite3_stmt *statement = mo_sql(writer,
                                   call->error == MO_OK ? park_sql
                                   : halts              ? halt_sql
                                                        : retry_sql,
                                   &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  sqlite3_bind_int64(statement, 7, call->kind);
  if (call->error != MO_OK) {
    sqlite3_bind_int64(statement, 4, call->error);
    sqlite3_bind_text(statement, 5, call->text, -1, SQLITE_STATIC);
  }
  if (call->error != MO_OK && !halts) {
    sqlite3_bind_int64(statement, 3, mo_clock_wall_us());
    sqlite3_bind_int64(statement, 6, call->max_attempts);
  }
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  applied = error == MO_OK && sqlite3_changes(writer->db) > 0;
  if (error == MO_OK)
    error = mo_job_state_get(writer, call->id, &call->after, &kind);
  if (error != MO_OK || !applied)
    return error;
  return mo_run_announce(store, call->id, call->kind,
                         call->after == MO_JOB_FAILED   ? "job.finished"
                         : call->after == MO_JOB_PAUSED ? "job.paused"
                                                        : "job.requeued",
                         call->after, "");
}

int mo_run_park(struct mo_store *store, int64_t id, enum mo_job_kind kind, int error,
                const char *error_text, uint32_t max_attempts, enum mo_job_state *after)
{
  struct park_arguments call = {id, kind, error, error_text, max_attempts, MO_JOB_QUEUED};
  int status = mo_write(store, park, &call);
  if (status == MO_OK && after != NULL)
    *after = call.after;
  return status;
}
