/* atlases.c: see atlases.h. */
#include "store/atlases.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "atlas/writer.h"
#include "base/clock.h"
#include "store/atlas_rows.h"
#include "store/contents.h"
#include "store/controller_rows.h"
#include "store/folder.h"
#include "store/jobs.h"
#include "store/runs.h"
#include "store/warnings.h"

#define MADE_MAX 10000 /* number of names that are tried */

/* ---- submission ---- */

struct submission {
  const struct mo_atlas_request *request;
  struct mo_message *message;
};

/* Finds the first free name: BASE, BASE-2, BASE-3 … */
static int make_name(struct mo_store *store, const char *base, char name[MO_ATLAS_NAME_MAX + 1])
{
  int error = MO_ERR_CONFLICT;
  for (int i = 1; i < MADE_MAX && error == MO_ERR_CONFLICT; i++) {
    if (i == 1)
      snprintf(name, MO_ATLAS_NAME_MAX + 1, "%.58s", base);
    else
      snprintf(name, MO_ATLAS_NAME_MAX + 1, "%.58s-%d", base, i);
    error = mo_atlas_name_find(store, &store->writer, name, NULL);
  }
  return error;
}

static int insert(struct mo_store *store, const void *any, int64_t *id)
{
  static const char sql[] =
      "INSERT INTO atlases(job,name,voxels,orientations,controller,controller_name,physics,"
      "environment_set,n_environments,measures) VALUES(?1,?2,?3,?4,?5,?6,?7,nullif(?8,0),?9,?10)";
  const struct submission *call = any;
  const struct mo_atlas_request *request = call->request;
  const char *by_name = strncmp(request->controller, "sha256:", 7) == 0 ? "" : request->controller;
  struct mo_connection *writer = &store->writer;
  struct mo_physics physics = request->physics;
  enum mo_sensor sensor = MO_SENSOR_INVERSE_SQRT;
  int64_t controller = 0, physics_row = 0, set = 0, n_environments = request->n_environments;
  char name[MO_ATLAS_NAME_MAX + 1];
  snprintf(name, sizeof(name), "%s", request->name);
  int error = mo_controller_find(writer, request->controller, &controller, &sensor, &physics);
  if (error == MO_OK && name[0] == '\0')
    error = make_name(store, request->base, name);
  else if (error == MO_OK)
    error = mo_atlas_name_find(store, writer, name, call->message);
  if (error == MO_ERR_CONFLICT)
    error = MO_ERR_DUPLICATE;
  if (error == MO_OK)
    error = mo_physics_row(writer, &physics, MO_FLOAT32, sensor, &physics_row);
  if (error == MO_OK && request->environment_set != NULL)
    error = mo_environment_set_find(writer, request->environment_set, &set, &n_environments);
  if (error == MO_OK)
    error = mo_job_insert(writer, &request->job, MO_JOB_ATLAS, id);
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, mo_int(*id), mo_string(name), mo_int(request->voxels),
                      mo_int(request->orientations), mo_int(controller), mo_string(by_name),
                      mo_int(physics_row), mo_int(set), mo_int(n_environments),
                      mo_int(request->measures));
  if (error == MO_OK)
    error =
        mo_environments_insert(writer, *id, set, request->environments, (uint32_t)n_environments);
  if (error == MO_OK)
    error = mo_writer_event(store, *id, "job.created",
                            "{\"id\":\"%lld\",\"kind\":\"atlas\",\"state\":\"queued\","
                            "\"atlas\":\"%s\"}",
                            (long long)*id, name);
  return error == MO_OK ? mo_run_announce_warnings(store, *id, true) : error;
}

int mo_store_submit_atlas(struct mo_store *store, const struct mo_atlas_request *request,
                          int64_t *id, bool *replayed, struct mo_message *message)
{
  const struct submission call = {request, message};
  return mo_submit(store, &request->job.key, insert, &call, id, replayed);
}

/* ---- reading ---- */

static int load_status(struct mo_connection *reader, int64_t id, void *any)
{
  struct mo_atlas_status *status = any;
  sqlite3_stmt *row;
  memset(status, 0, sizeof(*status));
  int error = mo_job_row(reader, id, MO_JOB_ATLAS, &row);
  if (error == MO_OK)
    error = mo_job_read(row, &status->job, &status->record);
  return error == MO_OK ? mo_job_warn(reader, &status->job, &status->record) : error;
}

int mo_store_atlas(struct mo_store *store, int64_t id, struct mo_atlas_status *status)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return load_status(reader, id, status);
}

/* ---- the runner's writes ---- */

static char *part_path(const struct mo_store *store, const char *name)
{
  char *path;
  return asprintf(&path, "%s/%s.atlas.part", store->atlases_path, name) >= 0 ? path : NULL;
}

int mo_store_atlas_writer(struct mo_store *store, const char *name,
                          const struct mo_atlas_source *source,
                          const struct mo_environment *environments, uint32_t n,
                          struct mo_atlas_writer **writer, struct mo_message *message)
{
  char *path = mo_store_atlas_path(store, name);
  const int error = path != NULL ? mo_atlas_writer_create_with(store->files, path, source,
                                                               environments, n, writer, message)
                                 : MO_ERR_NO_MEMORY;
  free(path);
  return error;
}

int mo_store_atlas_restart(struct mo_store *store, const char *name)
{
  char *path = part_path(store, name);
  if (path == NULL)
    return MO_ERR_NO_MEMORY;
  const int error = store->files->unlink(path) == 0 || errno == ENOENT ? MO_OK : MO_ERR_IO;
  free(path);
  return error;
}

int mo_store_atlases_sync(struct mo_store *store)
{
  return mo_folder_sync(store, store->atlases_path);
}

bool mo_store_is_short(const struct mo_store *store)
{
  return atomic_load(&store->is_short);
}

struct progress {
  int64_t id;
  const struct mo_atlas_record *record;
  const char *data;
};

static int write_record(struct mo_connection *writer, int64_t id, const void *any)
{
  static const char sql[] =
      "UPDATE atlases SET bodies_total=?2,bodies_done=?3,rollouts_done=?4 WHERE job=?1";
  const struct mo_atlas_record *record = any;
  return mo_sql_do(writer, sql, mo_int(id), mo_int((int64_t)record->bodies_total),
                   mo_int((int64_t)record->bodies_done), mo_int((int64_t)record->rollouts_done));
}

static int progress(struct mo_store *store, void *arguments)
{
  /* Resets the attempts, as checkpoints of training runs do: an error that recurs at the same body
   * prevents progress. */
  static const char forgive_sql[] = "UPDATE jobs SET attempts=0 WHERE id=?1 AND attempts>0 AND"
                                    " ?2>(SELECT bodies_done FROM atlases WHERE job=?1)";
  const struct progress *call = arguments;
  int error = mo_run_touch(store, call->id);
  if (error == MO_OK)
    error = mo_sql_do(&store->writer, forgive_sql, mo_int(call->id),
                      mo_int((int64_t)call->record->bodies_done));
  if (error == MO_OK)
    error = write_record(&store->writer, call->id, call->record);
  return error == MO_OK && call->data != NULL
             ? mo_writer_event(store, call->id, "atlas.progress", "%s", call->data)
             : error;
}

int mo_store_atlas_progress(struct mo_store *store, int64_t id,
                            const struct mo_atlas_record *record, const char *data)
{
  return mo_write(store, progress, &(struct progress){id, record, data});
}

int mo_store_atlas_finish(struct mo_store *store, int64_t id, const struct mo_atlas_record *record)
{
  const struct mo_run_result none = {.controller = NULL};
  char more[MO_ATLAS_NAME_MAX + 32];
  snprintf(more, sizeof(more), ",\"atlas\":\"%s\"", record->name);
  const int error = mo_run_finish(store, id, &none, more, write_record, record);
  struct mo_job job;
  if (error == MO_ERR_CONFLICT && mo_store_job(store, id, &job) == MO_OK &&
      job.state == MO_JOB_CANCELLED) {
    char *path = mo_store_atlas_path(store, record->name);
    if (path != NULL && store->files->unlink(path) == 0)
      (void)mo_store_atlases_sync(store);
    free(path);
  }
  return error;
}

/* ---- files of jobs that are over ---- */

static int take_name(sqlite3_stmt *row, void *name)
{
  mo_column_text(row, 0, name, MO_ATLAS_NAME_MAX + 1);
  return mo_atlas_name_is_valid(name) ? MO_OK : MO_ERR_CORRUPT;
}

void mo_store_atlas_drop(struct mo_store *store, int64_t id)
{
  static const char sql[] = "SELECT a.name FROM atlases a JOIN jobs j ON j.id=a.job WHERE"
                            " a.job=?1 AND j.state IN (5,6) AND NOT EXISTS(SELECT 1 FROM atlases b"
                            " JOIN jobs k ON k.id=b.job WHERE b.name=a.name AND k.state IN"
                            " (0,1,2,4))";
  char name[MO_ATLAS_NAME_MAX + 1];
  if (mo_read_one(store, sql, MO_VALUES(mo_int(id)), take_name, name) == MO_OK)
    (void)mo_store_atlas_restart(store, name);
}
