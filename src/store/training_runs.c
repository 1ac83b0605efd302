/* training_runs.c: what the runner of a training writes: its steps, its checkpoints, its end.
 *
 * Writes are fenced by the epoch: the training must have been started under this opening of the store and must not be over. One
 * that was paused, or resumed at once, takes rows and checkpoints still: its thread saves what it has applied. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "store/internal.h"
#include "store/trainings.h"

#define DROPPED_MAX 128

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

/* ---- checkpoints ---- */

/* "trainings/<job>" or "trainings/<job>/<step>.checkpoint" (malloc). */
static char *path_of(const struct mo_store *store, int64_t id, int64_t step)
{
  size_t size = strlen(store->trainings_path) + 64;
  char *path = malloc(size);
  if (path == NULL)
    return NULL;
  if (step < 0)
    snprintf(path, size, "%s/%lld", store->trainings_path, (long long)id);
  else
    snprintf(path, size, "%s/%lld/%lld.checkpoint", store->trainings_path, (long long)id, (long long)step);
  return path;
}

static void remove_file(const struct mo_store *store, int64_t id, int64_t step)
{
  char *path = path_of(store, id, step);
  if (path != NULL)
    (void)store->files->unlink(store->files->context, path); /* one that stays is removed at the next start */
  free(path);
}

struct checkpoint_arguments {
  int64_t id;
  uint32_t step, keep;
  uint64_t size;
  struct mo_sha256 sha256;
  int64_t dropped[DROPPED_MAX];
  size_t n_dropped;
};

/* The rows after this step, which it makes false (they were damaged, or the run that wrote them is not this one), and those that
 * are too many. */
static int drop_rows(struct mo_connection *writer, struct checkpoint_arguments *call)
{
  static const char list_sql[] =
      "SELECT step FROM training_checkpoints WHERE job=?1 AND (step>?2 OR step NOT IN (SELECT step FROM"
      " training_checkpoints WHERE job=?1 AND step<=?2 ORDER BY step DESC LIMIT ?3)) LIMIT ?4";
  static const char delete_sql[] = "DELETE FROM training_checkpoints WHERE job=?1 AND step=?2";
  int error = MO_OK;
  int step = 0;
  sqlite3_stmt *statement = mo_sql(writer, list_sql, &error);
  call->n_dropped = 0;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, call->step);
  sqlite3_bind_int64(statement, 3, call->keep);
  sqlite3_bind_int64(statement, 4, DROPPED_MAX);
  while ((step = mo_sql_step(writer, statement)) > 0)
    call->dropped[call->n_dropped++] = sqlite3_column_int64(statement, 0);
  error = step;
  for (size_t i = 0; i < call->n_dropped && error == MO_OK; i++) {
    statement = mo_sql(writer, delete_sql, &error);
    if (statement == NULL)
      return error;
    sqlite3_bind_int64(statement, 1, call->id);
    sqlite3_bind_int64(statement, 2, call->dropped[i]);
    error = mo_sql_run(writer, statement);
  }
  return error;
}

/* A checkpoint beyond all before it is progress: what went wrong on the way there is forgiven. An error that comes back at the same
 * step lets none be written, and still ends the training at the third. */
static int forgive(struct mo_connection *writer, int64_t id, uint32_t step)
{
  static const char sql[] = "UPDATE jobs SET attempts=0 WHERE id=?1 AND attempts>0 AND"
                            " ?2>(SELECT coalesce(max(step),0) FROM training_checkpoints WHERE job=?1)";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, step);
  return mo_sql_run(writer, statement);
}

static int checkpoint(struct mo_store *store, void *arguments)
{
  static const char sql[] = "INSERT OR REPLACE INTO training_checkpoints(job,step,sha256,size,stored_us)"
                            " VALUES(?1,?2,?3,?4,?5)";
  struct checkpoint_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char data[256], digits[MO_SHA256_DIGITS + 1];
  sqlite3_stmt *statement;
  int error = mo_training_touch(store, call->id);
  if (error == MO_OK)
    error = forgive(writer, call->id, call->step);
  statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, call->step);
  mo_bind_hash(statement, 3, &call->sha256);
  sqlite3_bind_int64(statement, 4, (sqlite3_int64)call->size);
  sqlite3_bind_int64(statement, 5, mo_store_now_us());
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  if (error == MO_OK)
    error = drop_rows(writer, call);
  if (error != MO_OK)
    return error;
  mo_sha256_to_hex(&call->sha256, digits);
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"step\":%u,\"sha256\":\"%s\",\"size\":%llu}", (long long)call->id,
           (unsigned)call->step, digits, (unsigned long long)call->size);
  return mo_writer_event(store, call->id, "training.checkpoint", data);
}

/* Hash and size of a checkpoint; step 0: the newest, whose step is filled in. */
static int find_checkpoint(struct mo_store *store, int64_t id, struct mo_training_checkpoint_row *row)
{
  static const char sql[] = "SELECT step,sha256,size FROM training_checkpoints WHERE job=?1 AND (?2=0 OR step=?2)"
                            " ORDER BY step DESC LIMIT 1";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    int step;
    sqlite3_bind_int64(statement, 1, id);
    sqlite3_bind_int64(statement, 2, row->step);
    step = mo_sql_step(reader, statement);
    error = step > 0 ? mo_column_hash(statement, 1, &row->sha256) : step < 0 ? step : MO_ERR_NOT_FOUND;
    if (step > 0) {
      row->step = (uint32_t)sqlite3_column_int64(statement, 0);
      row->size = (uint64_t)sqlite3_column_int64(statement, 2);
    }
  }
  mo_reader_release(store, reader);
  return error;
}

int mo_store_training_checkpoint(struct mo_store *store, int64_t id, uint32_t step, const uint8_t *bytes, size_t size,
                                 uint32_t keep)
{
  struct checkpoint_arguments call = {.id = id, .step = step, .keep = keep > 0 ? keep : 1, .size = size};
  struct mo_training_checkpoint_row known = {.step = step};
  char *folder = path_of(store, id, -1), *path = path_of(store, id, step);
  bool is_known = false;
  int error = MO_OK;
  if (folder == NULL || path == NULL)
    error = MO_ERR_NO_MEMORY;
  else if (step == 0)
    error = MO_ERR_RANGE;
  if (error == MO_OK) {
    error = find_checkpoint(store, id, &known);
    is_known = error == MO_OK;
    error = error == MO_ERR_NOT_FOUND ? MO_OK : error;
  }
  mo_sha256_of(bytes, size, &call.sha256);
  if (error == MO_OK)
    error = mo_folder_make(store, store->trainings_path, folder);
  if (error == MO_OK)
    error = mo_file_write(store, folder, path, bytes, size);
  if (error == MO_OK) {
    error = mo_write(store, checkpoint, &call);
    if (error != MO_OK && error != MO_ERR_IO && !is_known)
      (void)store->files->unlink(store->files->context, path);
  }
  for (size_t i = 0; i < call.n_dropped && error == MO_OK; i++)
    remove_file(store, id, call.dropped[i]);
  free(folder);
  free(path);
  return error;
}

/* The bytes that a row speaks of. MO_ERR_CORRUPT: the file is not there, or it is another. */
static int read_checkpoint(const struct mo_store *store, int64_t id, const struct mo_training_checkpoint_row *row,
                           uint8_t **ret)
{
  struct mo_sha256 found;
  char *path = path_of(store, id, row->step);
  int error = path == NULL ? MO_ERR_NO_MEMORY : mo_file_read(path, (size_t)row->size, ret);
  free(path);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  mo_sha256_of(*ret, (size_t)row->size, &found);
  if (mo_sha256_equal(&found, &row->sha256))
    return MO_OK;
  free(*ret);
  *ret = NULL;
  return MO_ERR_CORRUPT;
}

int mo_store_training_checkpoint_bytes(struct mo_store *store, int64_t id, uint32_t step, uint8_t **ret,
                                       size_t *ret_size)
{
  struct mo_training_checkpoint_row row = {.step = step}, again = {.step = 0};
  uint8_t *bytes = NULL;
  int error = find_checkpoint(store, id, &row);
  while (error == MO_OK) {
    error = read_checkpoint(store, id, &row, &bytes);
    if (error != MO_ERR_CORRUPT)
      break;
    /* Damaged, unless newer ones have made it go meanwhile: its row goes before its file. */
    again = (struct mo_training_checkpoint_row){.step = step};
    error = find_checkpoint(store, id, &again);
    if (error == MO_OK && again.step == row.step && mo_sha256_equal(&again.sha256, &row.sha256))
      error = MO_ERR_CORRUPT;
    row = again;
  }
  if (error != MO_OK)
    return error;
  *ret = bytes;
  *ret_size = (size_t)row.size;
  return MO_OK;
}

/* ---- files without rows ---- */

static bool has_row(void *context, const char *name)
{
  static const char sql[] = "SELECT 1 FROM training_checkpoints WHERE job=?1 AND step=?2";
  struct mo_cleaning *cleaning = context;
  sqlite3_stmt *statement;
  int64_t found;
  int error = MO_OK;
  char *end;
  long long step = strtoll(name, &end, 10);
  if (end == name || strcmp(end, ".checkpoint") != 0)
    return true; /* not ours */
  statement = mo_sql(cleaning->connection, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, cleaning->job);
    sqlite3_bind_int64(statement, 2, step);
    error = mo_sql_integer(cleaning->connection, statement, &found);
  }
  if (error != MO_OK && error != MO_ERR_NOT_FOUND)
    cleaning->error = error;
  return error != MO_ERR_NOT_FOUND;
}

int mo_trainings_clean(struct mo_store *store)
{
  struct mo_cleaning cleaning = {.connection = &store->writer};
  return mo_job_folders_clean(store, store->trainings_path, has_row, &cleaning);
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
