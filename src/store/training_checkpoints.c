/* training_checkpoints.c: checkpoints of trainings: a row and a file each.
 *
 * A file is written before its row and deleted after it. A crash in between leaves a file without a
 * row, which the next opening removes. One lock is held from the write of a file to the deletion of
 * those that it replaces, and from the deletion of a row to that of its file. Otherwise a new file
 * of an old step could be deleted in place of the old one. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/internal.h"
#include "store/trainings.h"

#define DROPPED_MAX 128

/* Returns "trainings/<job>" (step < 0) or "trainings/<job>/<step>.checkpoint" (malloc). */
static char *path_of(const struct mo_store *store, int64_t id, int64_t step)
{
  size_t size = strlen(store->trainings_path) + 64;
  char *path = malloc(size);
  if (path == NULL)
    return NULL;
  if (step < 0)
    snprintf(path, size, "%s/%lld", store->trainings_path, (long long)id);
  else
    snprintf(path, size, "%s/%lld/%lld.checkpoint", store->trainings_path, (long long)id,
             (long long)step);
  return path;
}

static void remove_file(const struct mo_store *store, int64_t id, int64_t step)
{
  char *path = path_of(store, id, step);
  if (path != NULL)
    (void)store->files->unlink(store->files->context,
                               path); /* if this fails, the next start removes it */
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

/* Deletes the rows of later steps, which this step makes false (they were damaged, or another run
 * wrote them), and those beyond the number to keep. */
static int drop_rows(struct mo_connection *writer, struct checkpoint_arguments *call)
{
  static const char list_sql[] =
      "SELECT step FROM training_checkpoints WHERE job=?1 AND (step>?2 OR step NOT IN (SELECT step "
      "FROM"
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

/* Resets the attempts when a checkpoint goes beyond all earlier ones, because that is progress. An
 * error that recurs at the same step prevents that, so the third attempt still ends the training.
 */
static int forgive(struct mo_connection *writer, int64_t id, uint32_t step)
{
  static const char sql[] =
      "UPDATE jobs SET attempts=0 WHERE id=?1 AND attempts>0 AND"
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
  static const char sql[] =
      "INSERT OR REPLACE INTO training_checkpoints(job,step,sha256,size,stored_us)"
      " VALUES(?1,?2,?3,?4,?5)";
  struct checkpoint_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char data[256], digits[MO_SHA256_DIGITS + 1];
  sqlite3_stmt *statement;
  int error = mo_run_touch(store, call->id, MO_JOB_TRAINING);
  if (error == MO_OK)
    error = forgive(writer, call->id, call->step);
  statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, call->step);
  mo_bind_hash(statement, 3, &call->sha256);
  sqlite3_bind_int64(statement, 4, (sqlite3_int64)call->size);
  sqlite3_bind_int64(statement, 5, mo_clock_wall_us());
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  if (error == MO_OK)
    error = drop_rows(writer, call);
  if (error != MO_OK)
    return error;
  mo_sha256_to_hex(&call->sha256, digits);
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"step\":%u,\"sha256\":\"%s\",\"size\":%llu}",
           (long long)call->id, (unsigned)call->step, digits, (unsigned long long)call->size);
  return mo_writer_event(store, call->id, "training.checkpoint", data);
}

/* Finds the hash and size of a checkpoint; step 0: the newest, whose step is filled in. */
static int find_checkpoint(struct mo_store *store, int64_t id,
                           struct mo_training_checkpoint_row *row)
{
  static const char sql[] =
      "SELECT step,sha256,size FROM training_checkpoints WHERE job=?1 AND (?2=0 OR step=?2)"
      " ORDER BY step DESC LIMIT 1";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    int step;
    sqlite3_bind_int64(statement, 1, id);
    sqlite3_bind_int64(statement, 2, row->step);
    step = mo_sql_step(reader, statement);
    error = step > 0   ? mo_column_hash(statement, 1, &row->sha256)
            : step < 0 ? step
                       : MO_ERR_NOT_FOUND;
    if (step > 0) {
      row->step = (uint32_t)sqlite3_column_int64(statement, 0);
      row->size = (uint64_t)sqlite3_column_int64(statement, 2);
    }
  }
  mo_reader_release(store, reader);
  return error;
}

static int write_checkpoint(struct mo_store *store, const char *folder, const char *path,
                            const uint8_t *bytes, bool is_known, struct checkpoint_arguments *call)
{
  int error = mo_folder_make(store, store->trainings_path, folder);
  if (error == MO_OK)
    error = mo_file_write(store, folder, path, bytes, (size_t)call->size);
  if (error == MO_OK)
    error = mo_write(store, checkpoint, call);
  /* After an I/O error it is unknown whether the row exists, so the file stays. */
  if (error != MO_OK && error != MO_ERR_IO && !is_known) {
    (void)store->files->unlink(store->files->context, path);
    (void)store->files->rmdir(store->files->context, folder); /* if it was made for this one */
  }
  for (size_t i = 0; i < call->n_dropped && error == MO_OK; i++)
    remove_file(store, call->id, call->dropped[i]);
  return error;
}

int mo_store_training_checkpoint(struct mo_store *store, int64_t id, uint32_t step,
                                 const uint8_t *bytes, size_t size, uint32_t keep)
{
  struct checkpoint_arguments call = {
      .id = id, .step = step, .keep = keep > 0 ? keep : 1, .size = size};
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
  if (error == MO_OK) {
    pthread_mutex_lock(&store->checkpoints_mutex);
    error = write_checkpoint(store, folder, path, bytes, is_known, &call);
    pthread_mutex_unlock(&store->checkpoints_mutex);
  }
  free(folder);
  free(path);
  return error;
}

/* Reads the bytes that a row refers to. MO_ERR_CORRUPT: the file is missing, or is another one. */
static int read_checkpoint(const struct mo_store *store, int64_t id,
                           const struct mo_training_checkpoint_row *row, uint8_t **ret)
{
  char *path = path_of(store, id, row->step);
  int error = path == NULL ? MO_ERR_NO_MEMORY
                           : mo_file_read_checked(path, (size_t)row->size, &row->sha256, ret);
  free(path);
  return error;
}

int mo_store_training_checkpoint_bytes(struct mo_store *store, int64_t id, uint32_t step,
                                       uint8_t **ret, size_t *ret_size)
{
  struct mo_training_checkpoint_row row = {.step = step}, again = {.step = 0};
  uint8_t *bytes = NULL;
  int error = find_checkpoint(store, id, &row);
  while (error == MO_OK) {
    error = read_checkpoint(store, id, &row, &bytes);
    if (error != MO_ERR_CORRUPT)
      break;
    /* The file is damaged, unless newer checkpoints have replaced it meanwhile: then its row went
     * first. */
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

/* ---- on request ---- */

struct removal_arguments {
  int64_t id;
  uint32_t step;
  struct mo_checkpoints_removed removed;
};

/* Selects the rows to remove. MO_ERR_CONFLICT: the training resumes from one of them. */
static int choose(struct mo_connection *writer, struct removal_arguments *call, bool has_ended)
{
  static const char sql[] =
      "SELECT step,size FROM training_checkpoints WHERE job=?1 ORDER BY step DESC LIMIT ?2";
  bool newest = true, needed = false;
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, MO_CHECKPOINTS_KEPT_MAX);
  while ((step = mo_sql_step(writer, statement)) > 0) {
    uint32_t at = (uint32_t)sqlite3_column_int64(statement, 0);
    bool goes_on_from_it = newest && !has_ended;
    newest = false;
    if (call->step != 0 ? at != call->step : goes_on_from_it)
      continue;
    needed = needed || goes_on_from_it;
    call->removed.steps[call->removed.n++] = at;
    call->removed.bytes += (uint64_t)sqlite3_column_int64(statement, 1);
  }
  if (step < 0)
    return step;
  if (call->step != 0 && call->removed.n == 0)
    return MO_ERR_NOT_FOUND;
  return needed ? MO_ERR_CONFLICT : MO_OK;
}

static int remove_rows(struct mo_store *store, void *arguments)
{
  static const char delete_sql[] = "DELETE FROM training_checkpoints WHERE job=?1 AND step=?2";
  static const char version_sql[] = "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1";
  struct removal_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_state state;
  enum mo_job_kind kind;
  sqlite3_stmt *statement;
  int error = mo_job_state_get(writer, call->id, &state, &kind);
  memset(&call->removed, 0, sizeof(call->removed));
  if (error == MO_OK)
    error = kind == MO_JOB_TRAINING ? choose(writer, call, mo_job_state_is_final(state))
                                    : MO_ERR_NOT_FOUND;
  for (size_t i = 0; i < call->removed.n && error == MO_OK; i++) {
    statement = mo_sql(writer, delete_sql, &error);
    if (statement == NULL)
      return error;
    sqlite3_bind_int64(statement, 1, call->id);
    sqlite3_bind_int64(statement, 2, call->removed.steps[i]);
    error = mo_sql_run(writer, statement);
  }
  if (error != MO_OK || call->removed.n == 0)
    return error;
  statement = mo_sql(writer, version_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  return mo_sql_run(writer, statement);
}

int mo_store_training_checkpoints_remove(struct mo_store *store, int64_t id, uint32_t step,
                                         struct mo_checkpoints_removed *removed)
{
  struct removal_arguments call = {.id = id, .step = step};
  char *folder = path_of(store, id, -1);
  int error;
  if (folder == NULL)
    return MO_ERR_NO_MEMORY;
  pthread_mutex_lock(&store->checkpoints_mutex);
  error = mo_write_urgent(store, remove_rows, &call);
  for (size_t i = 0; i < call.removed.n && error == MO_OK; i++)
    remove_file(store, id, call.removed.steps[i]);
  if (error == MO_OK)
    (void)store->files->rmdir(store->files->context, folder); /* if it is empty */
  pthread_mutex_unlock(&store->checkpoints_mutex);
  free(folder);
  if (error == MO_OK)
    *removed = call.removed;
  return error;
}
