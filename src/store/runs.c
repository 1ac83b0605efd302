/* runs.c: see runs.h. */
#include "store/runs.h"

#include <stdio.h>
#include <string.h>

#include "base/clock.h"
#include "store/controller_rows.h"
#include "store/fields.h"
#include "store/jobs.h"

int mo_job_state_get(struct mo_connection *connection, int64_t id, enum mo_job_state *state,
                     enum mo_job_kind *kind)
{
  static const char sql[] = "SELECT state,kind FROM jobs WHERE id=?1";
  int64_t found, found_kind;
  sqlite3_stmt *row;
  const int error = mo_sql_row(connection, &row, sql, mo_int(id));
  if (error != MO_OK)
    return error;
  found = sqlite3_column_int64(row, 0);
  found_kind = sqlite3_column_int64(row, 1);
  (void)sqlite3_reset(row);
  if (found < 0 || found >= MO_JOB_STATES || found_kind < 0 || found_kind >= MO_JOB_KINDS)
    return MO_ERR_CORRUPT;
  *kind = (enum mo_job_kind)found_kind;
  *state = (enum mo_job_state)found;
  return MO_OK;
}

int mo_run_insert(struct mo_connection *writer, int64_t id, enum mo_job_kind kind,
                  const void *record, const char *name, int64_t controller, const char *reference)
{
  static const char sql[] = "INSERT INTO runs(job,settings,name,controller,controller_name)"
                            " VALUES(?1,?2,?3,nullif(?4,0),?5)";
  const bool is_named = reference != NULL && strncmp(reference, "sha256:", 7) != 0;
  struct mo_text settings = {0};
  int error = MO_ERR_NO_MEMORY;
  mo_settings_write(kind, record, &settings);
  if (!settings.failed)
    error = mo_sql_do(writer, sql, mo_int(id), mo_string(settings.data), mo_string(name),
                      mo_int(controller), mo_string(is_named ? reference : ""));
  mo_text_free(&settings);
  return error;
}

int mo_run_touch(struct mo_store *store, int64_t id, enum mo_job_kind kind)
{
  static const char sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1 AND kind=?3 AND state<=2 AND epoch=?2";
  return mo_sql_change(&store->writer, sql, mo_int(id), mo_int(store->epoch), mo_int(kind));
}

int mo_run_announce(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *type,
                    enum mo_job_state state, const char *more)
{
  char data[400];
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"kind\":\"%s\",\"state\":\"%s\"%s}",
           (long long)id, mo_job_kind_name(kind), mo_job_state_name(state), more);
  return mo_writer_event(store, id, type, data);
}

/* ---- the queue and the attempt ---- */

static int take_id(sqlite3_stmt *statement, void *id)
{
  *(int64_t *)id = sqlite3_column_int64(statement, 0);
  return MO_OK;
}

int64_t mo_run_queued(struct mo_store *store, enum mo_job_kind kind, int64_t *ids, size_t limit)
{
  static const char sql[] =
      "SELECT id FROM jobs WHERE state=0 AND kind=?1 ORDER BY priority DESC,id LIMIT ?2";
  return mo_read_page(store, sql, MO_VALUES(mo_int(kind), mo_int((int64_t)limit)), take_id, ids,
                      sizeof(*ids));
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
  const int error = mo_sql_change(&store->writer, sql, mo_int(call->id), mo_int(store->epoch),
                                  mo_int(mo_clock_wall_us()), mo_int(call->kind));
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
#define RUNS " WHERE id=?1 AND kind=?3 AND state=1 AND epoch=?2"
  static const char park_sql[] = "UPDATE jobs SET state=0," MO_NEXT_VERSION RUNS;
  static const char halt_sql[] =
      "UPDATE jobs SET state=2," MO_NEXT_VERSION ",error=?4,error_text=?5" RUNS;
  static const char retry_sql[] =
      "UPDATE jobs SET attempts=" MO_NEXT_ATTEMPT "," MO_NEXT_VERSION ",error=?4,error_text=?5,"
      "state=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN 4 ELSE 0 END,"
      "finished_us=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN ?7 ELSE 0 END" RUNS;
#undef RUNS
  struct park_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  const struct mo_value id = mo_int(call->id), epoch = mo_int(store->epoch),
                        is_kind = mo_int(call->kind), code = mo_int(call->error),
                        text = mo_string(call->text);
  enum mo_job_kind kind;
  int error = call->error == MO_OK ? mo_sql_do(writer, park_sql, id, epoch, is_kind)
              : call->error == MO_ERR_DEVICE
                  ? mo_sql_do(writer, halt_sql, id, epoch, is_kind, code, text)
                  : mo_sql_do(writer, retry_sql, id, epoch, is_kind, code, text,
                              mo_int(call->max_attempts), mo_int(mo_clock_wall_us()));
  const bool applied = error == MO_OK && sqlite3_changes(writer->db) > 0;
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
  const int result = mo_write(store, park, &call);
  if (result == MO_OK && after != NULL)
    *after = call.after;
  return result;
}

/* ---- the end ---- */

struct finish_arguments {
  int64_t id;
  enum mo_job_kind kind;
  struct mo_controller_put *put; /* NULL: no result */
  const char *more;
  int (*end)(struct mo_connection *writer, int64_t id, const void *context);
  const void *context;
};

static int finish(struct mo_store *store, void *arguments)
{
  static const char job_sql[] =
      "UPDATE jobs SET state=3," MO_NEXT_VERSION ",finished_us=?3,error=0,error_text=NULL"
      " WHERE id=?1 AND kind=?4 AND state=1 AND epoch=?2";
  static const char sql[] = "UPDATE runs SET result=?2 WHERE job=?1";
  const struct finish_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char more[256], digits[MO_SHA256_DIGITS + 1];
  int error = mo_sql_change(writer, job_sql, mo_int(call->id), mo_int(store->epoch),
                            mo_int(mo_clock_wall_us()), mo_int(call->kind));
  if (error == MO_OK && call->end != NULL)
    error = call->end(writer, call->id, call->context);
  snprintf(more, sizeof(more), "%s", call->more);
  if (error == MO_OK && call->put != NULL) {
    error = mo_controller_put_row(store, call->put);
    if (error == MO_OK)
      error = mo_sql_do(writer, sql, mo_int(call->id), mo_int(call->put->row));
    mo_sha256_to_hex(&call->put->sha256, digits);
    snprintf(more, sizeof(more), "%s,\"controller\":\"%s\",\"sha256\":\"%s\"", call->more,
             call->put->name, digits);
  }
  return error == MO_OK
             ? mo_run_announce(store, call->id, call->kind, "job.finished", MO_JOB_SUCCEEDED, more)
             : error;
}

int mo_run_finish(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                  const struct mo_run_result *result, const char *more,
                  int (*end)(struct mo_connection *writer, int64_t id, const void *context),
                  const void *context)
{
  const bool has_result = result->controller != NULL;
  struct mo_controller_put put = {.name = result->name};
  struct finish_arguments call = {id, kind, has_result ? &put : NULL, more, end, context};
  int error = MO_OK;
  if (has_result)
    error = mo_controller_put_begin(store, result->name, result->bytes, result->size,
                                    result->controller, &put);
  if (error == MO_OK)
    error = mo_write(store, finish, &call);
  if (has_result)
    mo_controller_put_end(store, &put);
  return error;
}

int mo_run_result_read(sqlite3_stmt *row, bool *has_result, struct mo_sha256 *sha256)
{
  *has_result = sqlite3_column_type(row, MO_COLUMN_RESULT) != SQLITE_NULL;
  return *has_result ? mo_column_hash(row, MO_COLUMN_RESULT, sha256) : MO_OK;
}
