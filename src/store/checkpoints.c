/* checkpoints.c: see checkpoints.h and checkpoint_files.h. */
#include "store/checkpoint_files.h"

#include <stdio.h>
#include <stdlib.h>

#include "base/clock.h"
#include "base/thread.h"
#include "store/folder.h"
#include "store/runs.h"

/* Returns the path of a checkpoint, or of a job's folder (place NULL) (malloc). */
static char *path_of(const struct mo_store *store, int64_t id, enum mo_job_kind kind,
                     const struct mo_checkpoint_place *place)
{
  const char *above = kind == MO_JOB_TRAINING ? store->trainings_path : store->campaigns_path;
  char file[64] = "", *path;
  if (place != NULL && kind == MO_JOB_TRAINING)
    snprintf(file, sizeof(file), "/%u.checkpoint", (unsigned)place->step);
  else if (place != NULL)
    snprintf(file, sizeof(file), "/%u-%u.checkpoint", (unsigned)place->generation,
             (unsigned)place->step);
  return asprintf(&path, "%s/%lld%s", above, (long long)id, file) >= 0 ? path : NULL;
}

static int take_row(sqlite3_stmt *statement, void *any)
{
  struct mo_checkpoint_row *row = any;
  row->generation = mo_column_u32(statement, 0);
  row->step = mo_column_u32(statement, 1);
  row->size = (uint64_t)sqlite3_column_int64(statement, 3);
  row->stored_us = sqlite3_column_int64(statement, 4);
  return mo_column_hash(statement, 2, &row->sha256);
}

/* Finds the newest checkpoint of a generation and step; −1 matches any. */
static int find(struct mo_store *store, int64_t id, int64_t generation, int64_t step,
                struct mo_checkpoint_row *found)
{
  static const char sql[] =
      "SELECT generation,step,sha256,size,stored_us FROM checkpoints WHERE job=?1"
      " AND (?2<0 OR generation=?2) AND (?3<0 OR step=?3) ORDER BY generation DESC,step DESC"
      " LIMIT 1";
  return mo_read_one(store, sql, MO_VALUES(mo_int(id), mo_int(generation), mo_int(step)), take_row,
                     found);
}

/* ---- writing ---- */

/* Writes the file. */
static int begin(struct mo_store *store, const uint8_t *bytes, struct mo_checkpoint *checkpoint)
{
  const bool is_training = checkpoint->kind == MO_JOB_TRAINING;
  char *folder = path_of(store, checkpoint->id, checkpoint->kind, NULL);
  struct mo_checkpoint_row known;
  int error = MO_OK;
  checkpoint->path = path_of(store, checkpoint->id, checkpoint->kind, &checkpoint->place);
  if (folder == NULL || checkpoint->path == NULL) {
    free(folder);
    return MO_ERR_NO_MEMORY;
  }
  mo_sha256_of(bytes, checkpoint->size, &checkpoint->sha256);
  error = find(store, checkpoint->id, checkpoint->place.generation, checkpoint->place.step, &known);
  checkpoint->was_there = error == MO_OK;
  if (error == MO_ERR_NOT_FOUND)
    error = MO_OK;
  if (error == MO_OK)
    error =
        mo_folder_make(store, is_training ? store->trainings_path : store->campaigns_path, folder);
  if (error == MO_OK)
    error = mo_file_write(store, folder, checkpoint->path, bytes, checkpoint->size);
  free(folder);
  return error;
}

int mo_checkpoint_row_write(struct mo_store *store, const struct mo_checkpoint *checkpoint)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO checkpoints(job,generation,step,sha256,size,stored_us)"
      " VALUES(?1,?2,?3,?4,?5,?6)";
  return mo_sql_do(&store->writer, sql, mo_int(checkpoint->id),
                   mo_int(checkpoint->place.generation), mo_int(checkpoint->place.step),
                   mo_hash(&checkpoint->sha256), mo_int((int64_t)checkpoint->size),
                   mo_int(mo_clock_wall_us()));
}

static const char drop_sql[] = "DELETE FROM checkpoints WHERE job=?1 AND generation=?2 AND step=?3";

int mo_checkpoint_drop(struct mo_store *store, const char *list_sql, int64_t fourth,
                       struct mo_checkpoint *checkpoint)
{
  struct mo_checkpoints_removed *dropped = &checkpoint->dropped;
  struct mo_connection *writer = &store->writer;
  const struct mo_value id = mo_int(checkpoint->id);
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(writer, &error, list_sql, id, mo_int(checkpoint->place.generation),
                  mo_int(checkpoint->place.step), mo_int(fourth));
  dropped->n = 0;
  dropped->bytes = 0;
  /* The next checkpoint drops any rows that remain. */
  while (dropped->n < MO_CHECKPOINTS_MAX && mo_sql_next(writer, row, &error)) {
    dropped->places[dropped->n++] =
        (struct mo_checkpoint_place){mo_column_u32(row, 0), mo_column_u32(row, 1)};
    dropped->bytes += (uint64_t)sqlite3_column_int64(row, 2);
  }
  for (size_t i = 0; i < dropped->n && error == MO_OK; i++)
    error = mo_sql_do(writer, drop_sql, id, mo_int(dropped->places[i].generation),
                      mo_int(dropped->places[i].step));
  return error;
}

int mo_checkpoints_forget(struct mo_store *store, uint64_t *n)
{
  static const char sql[] = "SELECT c.job,j.kind,c.generation,c.step FROM jobs j"
                            " JOIN checkpoints c ON c.job=j.id WHERE j.state=6 LIMIT 16";
  struct {
    int64_t id;
    enum mo_job_kind kind;
    struct mo_checkpoint_place place;
  } found[16];
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(&store->writer, &error, sql);
  *n = 0;
  while (mo_sql_next(&store->writer, row, &error)) {
    found[*n].id = sqlite3_column_int64(row, 0);
    found[*n].kind = (enum mo_job_kind)sqlite3_column_int(row, 1);
    found[(*n)++].place =
        (struct mo_checkpoint_place){mo_column_u32(row, 2), mo_column_u32(row, 3)};
  }
  for (uint64_t i = 0; i < *n && error == MO_OK; i++) {
    char *path = path_of(store, found[i].id, found[i].kind, &found[i].place);
    char *folder = path_of(store, found[i].id, found[i].kind, NULL);
    if (path != NULL && folder != NULL) {
      (void)store->files->unlink(path);  /* if this fails, the next start reports the file */
      (void)store->files->rmdir(folder); /* if it is empty */
      error = mo_sql_do(&store->writer, drop_sql, mo_int(found[i].id),
                        mo_int(found[i].place.generation), mo_int(found[i].place.step));
    } else {
      error = MO_ERR_NO_MEMORY;
    }
    free(path);
    free(folder);
  }
  return error;
}

/* Deletes the files of dropped rows or, after an error, the new file. */
static void end(struct mo_store *store, struct mo_checkpoint *checkpoint, int error)
{
  const struct mo_file_operations *files = store->files;
  /* After an I/O error it is unknown whether the row exists, so the file is kept. */
  const bool drops_new =
      error != MO_OK && error != MO_ERR_IO && checkpoint->path != NULL && !checkpoint->was_there;
  char *folder = path_of(store, checkpoint->id, checkpoint->kind, NULL);
  if (drops_new)
    (void)files->unlink(checkpoint->path);
  for (size_t i = 0; i < checkpoint->dropped.n && error == MO_OK; i++) {
    char *path = path_of(store, checkpoint->id, checkpoint->kind, &checkpoint->dropped.places[i]);
    if (path != NULL)
      (void)files->unlink(path); /* if this fails, the next start removes it */
    free(path);
  }
  if (folder != NULL && (drops_new || checkpoint->dropped.n > 0))
    (void)files->rmdir(folder); /* if it is empty */
  free(folder);
  free(checkpoint->path);
}

int mo_checkpoint_write(struct mo_store *store, const uint8_t *bytes,
                        struct mo_checkpoint *checkpoint,
                        int (*run)(struct mo_store *store, void *arguments), void *arguments)
{
  MO_GUARD(&store->checkpoints_mutex);
  int error = checkpoint->check != NULL ? checkpoint->check(store, arguments) : MO_OK;
  if (error == MO_OK && bytes != NULL)
    error = begin(store, bytes, checkpoint);
  if (error == MO_OK)
    error = checkpoint->is_urgent ? mo_write_urgent(store, run, arguments)
                                  : mo_write(store, run, arguments);
  end(store, checkpoint, error);
  return error;
}

/* ---- reading ---- */

int mo_checkpoint_read(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                       int64_t generation, int64_t step, struct mo_checkpoint_place *place,
                       uint8_t **bytes, size_t *size)
{
  struct mo_checkpoint_row row, again;
  uint8_t *found = NULL;
  int error = find(store, id, generation, step, &row);
  while (error == MO_OK) {
    *place = (struct mo_checkpoint_place){row.generation, row.step};
    char *path = path_of(store, id, kind, place);
    error = path == NULL ? MO_ERR_NO_MEMORY
                         : mo_file_read_checked(path, (size_t)row.size, &row.sha256, &found);
    free(path);
    if (error != MO_ERR_CORRUPT)
      break;
    /* The file is damaged, unless newer checkpoints have replaced it in the meantime; then its row
     * was deleted first. */
    error = find(store, id, generation, step, &again);
    if (error == MO_OK && again.generation == row.generation && again.step == row.step &&
        mo_sha256_equal(&again.sha256, &row.sha256))
      error = MO_ERR_CORRUPT;
    row = again;
  }
  if (error != MO_OK)
    return error;
  *bytes = found;
  *size = (size_t)row.size;
  return MO_OK;
}

int64_t mo_store_checkpoints(struct mo_store *store, int64_t id, struct mo_checkpoint_row *rows,
                             size_t limit)
{
  static const char sql[] =
      "SELECT generation,step,sha256,size,stored_us FROM checkpoints WHERE job=?1"
      " ORDER BY generation DESC,step DESC LIMIT ?2";
  return mo_read_page(store, sql, MO_VALUES(mo_int(id), mo_int((int64_t)limit)), take_row, rows,
                      sizeof(*rows));
}

/* ---- on request ---- */

static int remove_rows(struct mo_store *store, void *arguments)
{
#define LISTED                                                                                     \
  "SELECT generation,step,size FROM checkpoints WHERE job=?1 AND ?2=0 AND (?3=0 OR step=?3)"       \
  " AND ?4=0"
#define NEWEST_FIRST " ORDER BY generation DESC,step DESC"
  static const char all_sql[] = LISTED NEWEST_FIRST;
  static const char older_sql[] =
      LISTED " AND step<(SELECT max(step) FROM checkpoints WHERE job=?1)" NEWEST_FIRST;
#undef NEWEST_FIRST
#undef LISTED
  static const char find_sql[] = "SELECT count(*) FROM checkpoints WHERE job=?1 AND step=?2";
  static const char version_sql[] = "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1";
  struct mo_checkpoint *call = arguments;
  struct mo_connection *writer = &store->writer;
  enum mo_job_state state;
  enum mo_job_kind kind;
  int64_t n = 0;
  int error = mo_job_state_get(writer, call->id, &state, &kind);
  call->dropped.n = 0;
  if (error == MO_OK && kind != call->kind)
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK && kind == MO_JOB_CAMPAIGN && !mo_job_state_is_final(state))
    return MO_OK;
  if (error == MO_OK)
    error = mo_checkpoint_drop(store, mo_job_state_is_final(state) ? all_sql : older_sql, 0, call);
  if (error == MO_OK && call->dropped.n > 0)
    return mo_sql_do(writer, version_sql, mo_int(call->id));
  if (error != MO_OK || call->place.step == 0)
    return error;
  error = mo_sql_find(writer, &n, find_sql, mo_int(call->id), mo_int(call->place.step));
  return error != MO_OK ? error : n > 0 ? MO_ERR_CONFLICT : MO_ERR_NOT_FOUND;
}

int mo_store_checkpoints_remove(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                                uint32_t step, struct mo_checkpoints_removed *removed)
{
  struct mo_checkpoint call = {.id = id, .kind = kind, .place.step = step, .is_urgent = true};
  const int error = mo_checkpoint_write(store, NULL, &call, remove_rows, &call);
  if (error == MO_OK)
    *removed = call.dropped;
  return error;
}
