/* runs.c: see runs.h. */
#include "store/runs.h"

#include <stdio.h>
#include <string.h>

#include "base/clock.h"
#include "store/atlases.h"
#include "store/campaigns.h"
#include "store/certificates.h"
#include "store/controller_rows.h"
#include "store/fields.h"
#include "store/jobs.h"
#include "store/warnings.h"

int mo_job_state_get(struct mo_connection *connection, int64_t id, enum mo_job_state *state,
                     enum mo_job_kind *kind)
{
  static const char sql[] = "SELECT state,kind FROM jobs WHERE id=?1";
  sqlite3_stmt *row;
  const int error = mo_sql_row(connection, &row, sql, mo_int(id));
  if (error != MO_OK)
    return error;
  *state = (enum mo_job_state)sqlite3_column_int(row, 0);
  *kind = (enum mo_job_kind)sqlite3_column_int(row, 1);
  return MO_OK;
}

/* The start of an evaluation may be written after its first block, or together with its end. */
#define SET     "UPDATE jobs SET " MO_NEXT_VERSION
#define RUNNING " WHERE id=?1 AND state=1 AND epoch=?2 RETURNING state,kind"
#define STARTED " WHERE id=?1 AND (state=1 AND epoch=?2 OR state=0 AND kind=0) RETURNING state,kind"
static const char *const step_sql[] = {
    [MO_STEP_START] = SET ",state=1,epoch=?2,"
                          "started_us=CASE started_us WHEN 0 THEN ?3 ELSE started_us END"
                          " WHERE id=?1 AND (state=0 OR state=1 AND epoch=?2 AND kind=0)"
                          " RETURNING state,kind",
    [MO_STEP_PROGRESS] = SET RUNNING,
    [MO_STEP_SUCCEED] = SET ",state=3,finished_us=?3,error=0,error_text=NULL" RUNNING,
    [MO_STEP_RETRY] =
        SET ",attempts=" MO_NEXT_ATTEMPT ",error=?4,error_text=?5,"
            "state=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN 4 ELSE 0 END,"
            "finished_us=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN ?3 ELSE 0 END" STARTED,
    [MO_STEP_PARK] = SET ",state=0" RUNNING,
    [MO_STEP_HALT] = SET ",state=2,error=?4,error_text=?5" STARTED};
#undef STARTED
#undef RUNNING
#undef SET

int mo_job_step(struct mo_store *store, struct mo_job_update *update, enum mo_job_kind *kind)
{
  const bool is_known = update->step == MO_STEP_START && update->started_us != 0;
  const int64_t now_us = is_known ? update->started_us : mo_clock_wall_us();
  sqlite3_stmt *row;
  const int error = mo_sql_row(&store->writer, &row, step_sql[update->step], mo_int(update->job),
                               mo_int(store->epoch), mo_int(now_us), mo_int(update->error),
                               mo_string(update->error_text), mo_int(update->max_attempts));
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CONFLICT : error;
  update->state = (enum mo_job_state)sqlite3_column_int(row, 0);
  *kind = (enum mo_job_kind)sqlite3_column_int(row, 1);
  (void)sqlite3_reset(row); /* ends the statement that changed rows */
  return MO_OK;
}

int mo_waiting_delete(struct mo_connection *writer, int64_t id)
{
  return mo_sql_do(writer, "DELETE FROM waiting_designs WHERE job=?1", mo_int(id));
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

int mo_run_touch(struct mo_store *store, int64_t id)
{
  static const char sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1 AND state<=2 AND epoch=?2";
  return mo_sql_change(&store->writer, sql, mo_int(id), mo_int(store->epoch));
}

int mo_run_announce(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *type,
                    enum mo_job_state state, const char *more)
{
  return mo_writer_event(store, id, type, "{\"id\":\"%lld\",\"kind\":\"%s\",\"state\":\"%s\"%s}",
                         (long long)id, mo_job_kind_name(kind), mo_job_state_name(state), more);
}

static int announce_warning(struct mo_store *store, const struct mo_job *job,
                            const struct mo_warning *warning)
{
  struct mo_text detail = {0};
  mo_text_json_string(&detail, warning->detail, strlen(warning->detail));
  const int error =
      detail.failed
          ? MO_ERR_NO_MEMORY
          : mo_writer_event(store, job->id, "job.warning",
                            "{\"id\":\"%lld\",\"kind\":\"%s\",\"state\":\"%s\",\"code\":\"%s\","
                            "\"detail\":%s}",
                            (long long)job->id, mo_job_kind_name(job->kind),
                            mo_job_state_name(job->state), warning->code, detail.data);
  mo_text_free(&detail);
  return error;
}

int mo_run_announce_warnings(struct mo_store *store, int64_t id, bool is_new)
{
  union {
    struct mo_training_record training;
    struct mo_campaign_record campaign;
    struct mo_atlas_record atlas;
    struct mo_certificate_record certificate;
  } record;
  struct mo_job job;
  sqlite3_stmt *row;
  int error = mo_job_row(&store->writer, id, -1, &row);
  if (error == MO_OK)
    error = mo_job_read(row, &job, &record);
  if (error == MO_OK)
    error = mo_job_warn(&store->writer, &job, &record);
  for (uint32_t i = 0; error == MO_OK && i < job.n_warnings; i++)
    if (is_new || !job.warnings[i].of_request)
      error = announce_warning(store, &job, &job.warnings[i]);
  return error;
}

/* ---- the queue and the attempt ---- */

static int take_id(sqlite3_stmt *statement, void *id)
{
  *(int64_t *)id = sqlite3_column_int64(statement, 0);
  return MO_OK;
}

int64_t mo_store_queued_runs(struct mo_store *store, enum mo_job_kind kind, int64_t *ids,
                             size_t limit)
{
  /* A study without a pending batch waits for its client. */
  static const char sql[] =
      "SELECT id FROM jobs WHERE state=0 AND kind=?1 AND NOT EXISTS(SELECT 1 FROM studies s JOIN"
      " campaigns m ON m.job=s.job WHERE s.job=jobs.id AND s.batch<=m.generation)"
      " ORDER BY priority DESC,id LIMIT ?2";
  return mo_read_page(store, sql, MO_VALUES(mo_int(kind), mo_int((int64_t)limit)), take_id, ids,
                      sizeof(*ids));
}

static int run_step(struct mo_store *store, void *arguments)
{
  struct mo_job_update *update = arguments;
  enum mo_job_kind kind;
  int error = mo_job_step(store, update, &kind);
  if (error == MO_ERR_CONFLICT && update->step != MO_STEP_START)
    return mo_job_state_get(&store->writer, update->job, &update->state, &kind);
  if (error == MO_OK && update->state == MO_JOB_FAILED && kind == MO_JOB_EVALUATION)
    error = mo_waiting_delete(&store->writer, update->job);
  return error != MO_OK ? error
                        : mo_run_announce(store, update->job, kind,
                                          update->state == MO_JOB_RUNNING  ? "job.started"
                                          : update->state == MO_JOB_FAILED ? "job.finished"
                                          : update->state == MO_JOB_PAUSED ? "job.paused"
                                                                           : "job.requeued",
                                          update->state, "");
}

int mo_store_run_start(struct mo_store *store, int64_t id)
{
  return mo_write(store, run_step, &(struct mo_job_update){.job = id, .step = MO_STEP_START});
}

int mo_store_run_park(struct mo_store *store, int64_t id, int error, const char *error_text,
                      uint32_t max_attempts, enum mo_job_state *after)
{
  struct mo_job_update update = {.job = id,
                                 .step = error == MO_OK           ? MO_STEP_PARK
                                         : error == MO_ERR_DEVICE ? MO_STEP_HALT
                                                                  : MO_STEP_RETRY,
                                 .error = error,
                                 .max_attempts = max_attempts};
  snprintf(update.error_text, sizeof(update.error_text), "%s",
           error_text != NULL ? error_text : "");
  int result = mo_write(store, run_step, &update);
  if (result == MO_OK && after != NULL)
    *after = update.state;
  return result;
}

/* ---- the end ---- */

struct finish_arguments {
  struct mo_job_update update;
  struct mo_controller_put *put; /* NULL: no result */
  const char *more;
  int (*end)(struct mo_connection *writer, int64_t id, const void *context);
  const void *context;
};

static int finish(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE runs SET result=?2 WHERE job=?1";
  struct finish_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  const int64_t id = call->update.job;
  enum mo_job_kind kind;
  char more[256];
  int error = mo_job_step(store, &call->update, &kind);
  if (error == MO_OK && call->end != NULL)
    error = call->end(writer, id, call->context);
  snprintf(more, sizeof(more), "%s", call->more);
  if (error == MO_OK && call->put != NULL) {
    error = mo_controller_put_row(store, call->put);
    if (error == MO_OK)
      error = mo_sql_do(writer, sql, mo_int(id), mo_int(call->put->row));
    snprintf(more, sizeof(more), "%s,\"controller\":\"%s\",\"sha256\":\"%s\"", call->more,
             call->put->name, MO_SHA256_HEX(&call->put->sha256));
  }
  if (error == MO_OK)
    error = mo_run_announce_warnings(store, id, false);
  return error == MO_OK ? mo_run_announce(store, id, kind, "job.finished", MO_JOB_SUCCEEDED, more)
                        : error;
}

int mo_run_finish(struct mo_store *store, int64_t id, const struct mo_run_result *result,
                  const char *more,
                  int (*end)(struct mo_connection *writer, int64_t id, const void *context),
                  const void *context)
{
  const bool has_result = result->controller != NULL;
  struct mo_controller_put put = {.name = result->name};
  struct finish_arguments call = {
      {.job = id, .step = MO_STEP_SUCCEED}, has_result ? &put : NULL, more, end, context};
  int error = MO_OK;
  if (has_result)
    error = mo_controller_put_begin(store, result->name, result->bytes, result->size,
                                    result->controller, &put);
  if (error == MO_OK)
    error = mo_write(store, finish, &call);
  mo_controller_put_end(store, &put);
  return error;
}
