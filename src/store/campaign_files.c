/* campaign_files.c: checkpoints of a campaign's learning: files
 * campaigns/<job>/<generation>-<step>.checkpoint and their rows.
 *
 * Two are kept: the state after the newest committed generation, which scored its population, and
 * the newest state inside the current generation. As for trainings, one lock is held from the write
 * of a file to the deletion of those that it replaces. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"

#include "base/clock.h"

/* Returns "campaigns/<job>" (malloc). */
static char *folder_of(const struct mo_store *store, int64_t id)
{
  size_t size = strlen(store->campaigns_path) + 32;
  char *path = malloc(size);
  if (path != NULL)
    snprintf(path, size, "%s/%lld", store->campaigns_path, (long long)id);
  return path;
}

/* Returns "campaigns/<job>/<generation>-<step>.checkpoint" (malloc). */
static char *path_of(const struct mo_store *store, int64_t id, uint32_t generation, uint32_t step)
{
  size_t size = strlen(store->campaigns_path) + 80;
  char *path = malloc(size);
  if (path != NULL)
    snprintf(path, size, "%s/%lld/%u-%u.checkpoint", store->campaigns_path, (long long)id,
             (unsigned)generation, (unsigned)step);
  return path;
}

struct found {
  uint32_t step;
  uint64_t size;
  struct mo_sha256 sha256;
};

/* Finds the newest checkpoint of a generation; step UINT32_MAX: of any step. */
static int find_checkpoint(struct mo_store *store, int64_t id, uint32_t generation, uint32_t step,
                           struct found *found)
{
  static const char sql[] =
      "SELECT step,sha256,size FROM campaign_checkpoints WHERE job=?1 AND generation=?2"
      " AND (?3<0 OR step=?3) ORDER BY step DESC LIMIT 1";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    int result;
    sqlite3_bind_int64(statement, 1, id);
    sqlite3_bind_int64(statement, 2, generation);
    sqlite3_bind_int64(statement, 3, step == UINT32_MAX ? -1 : (int64_t)step);
    result = mo_sql_step(reader, statement);
    error = result > 0   ? mo_column_hash(statement, 1, &found->sha256)
            : result < 0 ? result
                         : MO_ERR_NOT_FOUND;
    if (result > 0) {
      found->step = (uint32_t)sqlite3_column_int64(statement, 0);
      found->size = (uint64_t)sqlite3_column_int64(statement, 2);
    }
  }
  mo_reader_release(store, reader);
  return error;
}

/* ---- writing ---- */

int mo_campaign_checkpoint_begin(struct mo_store *store, const uint8_t *bytes,
                                 struct mo_campaign_checkpoint *checkpoint)
{
  char *folder = folder_of(store, checkpoint->id);
  struct found known = {0};
  uint8_t *there = NULL;
  int error = MO_OK;
  checkpoint->path = path_of(store, checkpoint->id, checkpoint->generation, checkpoint->step);
  if (folder == NULL || checkpoint->path == NULL) {
    free(folder);
    return MO_ERR_NO_MEMORY;
  }
  mo_sha256_of(bytes, checkpoint->size, &checkpoint->sha256);
  error = find_checkpoint(store, checkpoint->id, checkpoint->generation, checkpoint->step, &known);
  checkpoint->was_there = error == MO_OK;
  if (error == MO_ERR_NOT_FOUND)
    error = MO_OK;
  if (error == MO_OK)
    error = mo_folder_make(store, store->campaigns_path, folder);
  /* The checkpoint at the end of the learning may have been stored before as one inside it. */
  if (error == MO_OK && checkpoint->was_there &&
      mo_sha256_equal(&known.sha256, &checkpoint->sha256) &&
      mo_file_read(checkpoint->path, checkpoint->size, &there) == MO_OK &&
      memcmp(there, bytes, checkpoint->size) == 0)
    error = mo_folder_sync(store, folder);
  else if (error == MO_OK)
    error = mo_file_write(store, folder, checkpoint->path, bytes, checkpoint->size);
  free(there);
  free(folder);
  return error;
}

/* Deletes the rows that a query (?1 job, ?2 generation, ?3 step) selects, and notes their files. */
static int drop_rows(struct mo_connection *writer, const char *list_sql,
                     struct mo_campaign_checkpoint *checkpoint)
{
  static const char delete_sql[] =
      "DELETE FROM campaign_checkpoints WHERE job=?1 AND generation=?2 AND step=?3";
  int error = MO_OK;
  int step = 0;
  sqlite3_stmt *statement = mo_sql(writer, list_sql, &error);
  checkpoint->n_dropped = 0;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, checkpoint->id);
  sqlite3_bind_int64(statement, 2, checkpoint->generation);
  sqlite3_bind_int64(statement, 3, checkpoint->step);
  while (checkpoint->n_dropped < MO_CAMPAIGN_CHECKPOINTS_MAX &&
         (step = mo_sql_step(writer, statement)) > 0) {
    checkpoint->dropped[checkpoint->n_dropped][0] = (uint32_t)sqlite3_column_int64(statement, 0);
    checkpoint->dropped[checkpoint->n_dropped++][1] = (uint32_t)sqlite3_column_int64(statement, 1);
  }
  (void)sqlite3_reset(statement);
  if (step < 0)
    return step;
  for (size_t i = 0; i < checkpoint->n_dropped && error == MO_OK; i++) {
    statement = mo_sql(writer, delete_sql, &error);
    if (statement == NULL)
      return error;
    sqlite3_bind_int64(statement, 1, checkpoint->id);
    sqlite3_bind_int64(statement, 2, checkpoint->dropped[i][0]);
    sqlite3_bind_int64(statement, 3, checkpoint->dropped[i][1]);
    error = mo_sql_run(writer, statement);
  }
  return error;
}

int mo_campaign_checkpoint_drop(struct mo_store *store, struct mo_campaign_checkpoint *checkpoint)
{
  static const char sql[] =
      "SELECT generation,step FROM campaign_checkpoints WHERE job=?1 AND generation<?2 AND ?3>=0";
  return drop_rows(&store->writer, sql, checkpoint);
}

int mo_campaign_checkpoint_row(struct mo_store *store, struct mo_campaign_checkpoint *checkpoint)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO campaign_checkpoints(job,generation,step,sha256,size,stored_us)"
      " VALUES(?1,?2,?3,?4,?5,?6)";
  /* The next generation needs only the state after this one. A checkpoint inside a generation keeps
   * the state before that generation. */
  static const char committed_sql[] =
      "SELECT generation,step FROM campaign_checkpoints WHERE job=?1"
      " AND NOT (generation=?2 AND step=?3)";
  static const char inside_sql[] = "SELECT generation,step FROM campaign_checkpoints WHERE job=?1"
                                   " AND NOT (generation=?2 AND step=?3) AND generation<>?2-1";
  struct mo_connection *writer = &store->writer;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, checkpoint->id);
  sqlite3_bind_int64(statement, 2, checkpoint->generation);
  sqlite3_bind_int64(statement, 3, checkpoint->step);
  mo_bind_hash(statement, 4, &checkpoint->sha256);
  sqlite3_bind_int64(statement, 5, (sqlite3_int64)checkpoint->size);
  sqlite3_bind_int64(statement, 6, mo_clock_wall_us());
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error == MO_OK
             ? drop_rows(writer, checkpoint->committed ? committed_sql : inside_sql, checkpoint)
             : error;
}

void mo_campaign_checkpoint_end(struct mo_store *store, struct mo_campaign_checkpoint *checkpoint,
                                int error)
{
  /* After an I/O error it is unknown whether the row exists, so the file stays. */
  if (error != MO_OK && error != MO_ERR_IO && checkpoint->path != NULL && !checkpoint->was_there) {
    char *folder = folder_of(store, checkpoint->id);
    (void)store->files->unlink(store->files->context, checkpoint->path);
    if (folder != NULL)
      (void)store->files->rmdir(store->files->context, folder); /* if it was made for this one */
    free(folder);
  }
  for (size_t i = 0; i < checkpoint->n_dropped && error == MO_OK; i++) {
    char *path =
        path_of(store, checkpoint->id, checkpoint->dropped[i][0], checkpoint->dropped[i][1]);
    if (path != NULL)
      (void)store->files->unlink(store->files->context,
                                 path); /* if this fails, the next start removes it */
    free(path);
  }
  free(checkpoint->path);
  checkpoint->path = NULL;
}

struct inside_arguments {
  struct mo_campaign_checkpoint *checkpoint;
  const struct mo_campaign_step *steps;
  size_t n_steps;
};

static int save_inside(struct mo_store *store, void *arguments)
{
  struct inside_arguments *call = arguments;
  struct mo_campaign_head head = {0};
  int64_t id = call->checkpoint->id;
  int error = mo_run_touch(store, id, MO_JOB_CAMPAIGN);
  if (error == MO_OK)
    error = mo_campaign_head_get(&store->writer, id, &head);
  if (error == MO_OK && head.generation + 1 != call->checkpoint->generation)
    error = MO_ERR_CONFLICT;
  for (size_t i = 0; i < call->n_steps && error == MO_OK; i++)
    error = mo_campaign_step_write(&store->writer, id, &call->steps[i]);
  return error == MO_OK ? mo_campaign_checkpoint_row(store, call->checkpoint) : error;
}

int mo_store_campaign_checkpoint(struct mo_store *store, int64_t id, uint32_t generation,
                                 uint32_t step, const uint8_t *bytes, size_t size,
                                 const struct mo_campaign_step *steps, size_t n_steps)
{
  struct mo_campaign_checkpoint checkpoint = {
      .id = id, .generation = generation, .step = step, .size = size};
  struct inside_arguments call = {&checkpoint, steps, n_steps};
  int error;
  pthread_mutex_lock(&store->checkpoints_mutex);
  error = mo_campaign_checkpoint_begin(store, bytes, &checkpoint);
  if (error == MO_OK)
    error = mo_write(store, save_inside, &call);
  mo_campaign_checkpoint_end(store, &checkpoint, error);
  pthread_mutex_unlock(&store->checkpoints_mutex);
  return error;
}

/* ---- reading ---- */

/* Reads the bytes that a row refers to. MO_ERR_CORRUPT: the file is missing, or is another one. */
static int read_checkpoint(const struct mo_store *store, int64_t id, uint32_t generation,
                           const struct found *row, uint8_t **ret)
{
  char *path = path_of(store, id, generation, row->step);
  int error = path == NULL ? MO_ERR_NO_MEMORY
                           : mo_file_read_checked(path, (size_t)row->size, &row->sha256, ret);
  free(path);
  return error;
}

int mo_store_campaign_checkpoint_of(struct mo_store *store, int64_t id, uint32_t generation,
                                    uint32_t *step, uint8_t **bytes, size_t *size)
{
  struct found row = {0}, again = {0};
  uint8_t *found = NULL;
  int error = find_checkpoint(store, id, generation, UINT32_MAX, &row);
  while (error == MO_OK) {
    error = read_checkpoint(store, id, generation, &row, &found);
    if (error != MO_ERR_CORRUPT)
      break;
    /* The file is damaged, unless a newer checkpoint has replaced it meanwhile: then its row went
     * first. */
    error = find_checkpoint(store, id, generation, UINT32_MAX, &again);
    if (error == MO_OK && again.step == row.step && mo_sha256_equal(&again.sha256, &row.sha256))
      error = MO_ERR_CORRUPT;
    row = again;
  }
  if (error != MO_OK)
    return error;
  *step = row.step;
  *bytes = found;
  *size = (size_t)row.size;
  return MO_OK;
}

static int take_checkpoint(sqlite3_stmt *statement, void *any)
{
  struct mo_campaign_checkpoint_row *row = any;
  row->generation = (uint32_t)sqlite3_column_int64(statement, 0);
  row->step = (uint32_t)sqlite3_column_int64(statement, 1);
  row->size = (uint64_t)sqlite3_column_int64(statement, 3);
  row->stored_us = sqlite3_column_int64(statement, 4);
  return mo_column_hash(statement, 2, &row->sha256);
}

int64_t mo_store_campaign_checkpoints(struct mo_store *store, int64_t id,
                                      struct mo_campaign_checkpoint_row *rows, size_t limit)
{
  static const char sql[] =
      "SELECT generation,step,sha256,size,stored_us FROM campaign_checkpoints WHERE job=?1"
      " ORDER BY generation DESC,step DESC LIMIT ?2";
  return mo_read_rows(store, sql, &id, 1, limit, take_checkpoint, rows, sizeof(*rows));
}

/* ---- on request ---- */

struct removal_arguments {
  struct mo_campaign_checkpoint checkpoint;
  int64_t bytes;
};

static int remove_rows(struct mo_store *store, void *arguments)
{
  static const char size_sql[] =
      "SELECT coalesce(sum(size),0) FROM campaign_checkpoints WHERE job=?1";
  static const char list_sql[] =
      "SELECT generation,step FROM campaign_checkpoints WHERE job=?1 AND ?2>=0 AND ?3>=0"
      " ORDER BY generation DESC,step DESC";
  struct removal_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  enum mo_job_state state = MO_JOB_QUEUED;
  sqlite3_stmt *statement;
  int error = mo_job_state_get(writer, call->checkpoint.id, &state, &kind);
  call->checkpoint.n_dropped = 0;
  call->bytes = 0;
  if (error == MO_OK && kind != MO_JOB_CAMPAIGN)
    error = MO_ERR_NOT_FOUND;
  if (error != MO_OK || !mo_job_state_is_final(state))
    return error;
  statement = mo_sql(writer, size_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->checkpoint.id);
  error = mo_sql_integer(writer, statement, &call->bytes);
  return error == MO_OK ? drop_rows(writer, list_sql, &call->checkpoint) : error;
}

int mo_store_campaign_checkpoints_remove(struct mo_store *store, int64_t id,
                                         struct mo_campaign_checkpoints_removed *removed)
{
  struct removal_arguments call = {.checkpoint = {.id = id}};
  char *folder = folder_of(store, id);
  int error;
  if (folder == NULL)
    return MO_ERR_NO_MEMORY;
  pthread_mutex_lock(&store->checkpoints_mutex);
  error = mo_write_urgent(store, remove_rows, &call);
  mo_campaign_checkpoint_end(store, &call.checkpoint, error);
  if (error == MO_OK)
    (void)store->files->rmdir(store->files->context, folder); /* if it is empty */
  pthread_mutex_unlock(&store->checkpoints_mutex);
  free(folder);
  if (error != MO_OK)
    return error;
  memcpy(removed->places, call.checkpoint.dropped, sizeof(removed->places));
  removed->n = call.checkpoint.n_dropped;
  removed->bytes = (uint64_t)call.bytes;
  return MO_OK;
}
