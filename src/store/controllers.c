/* controllers.c: weights, stored by content, and the names that point to them.
 *
 * A file is written under a temporary name, synced and renamed, and its folder is synced, before
 * its row is committed. A row therefore never refers to missing bytes. A file without a row is
 * harmless: the next upload of the same content uses it. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/controller_rows.h"
#include "store/folder.h"

#include "base/clock.h"
#include "base/text.h"

int mo_controller_name_check(const char *name)
{
  static const char first[] = "abcdefghijklmnopqrstuvwxyz0123456789";
  static const char others[] = "abcdefghijklmnopqrstuvwxyz0123456789._-";
  size_t length = strlen(name);
  if (length < 1 || length > MO_NAME_BYTES_MAX || strchr(first, name[0]) == NULL)
    return MO_ERR_FORMAT;
  return strspn(name, others) == length ? MO_OK : MO_ERR_FORMAT;
}

char *mo_controller_path(const struct mo_store *store, const struct mo_sha256 *sha256)
{
  char *path;
  return asprintf(&path, "%s/%s.safetensors", store->controllers_path, MO_SHA256_HEX(sha256)) >= 0
             ? path
             : NULL;
}

int mo_controller_write_file(struct mo_store *store, const struct mo_sha256 *sha256,
                             const uint8_t *bytes, size_t size)
{
  char *path = mo_controller_path(store, sha256);
  const int error = path != NULL ? mo_file_write(store, store->controllers_path, path, bytes, size)
                                 : MO_ERR_NO_MEMORY;
  free(path);
  return error;
}

/* Returns the metadata as a JSON object (malloc). */
static char *metadata_json(const struct mo_controller *controller)
{
  struct mo_text text = {0};
  mo_text_add(&text, "{");
  for (size_t i = 0; i < controller->n_metadata; i++) {
    const char *key = controller->metadata[i].key, *value = controller->metadata[i].value;
    mo_text_add(&text, i > 0 ? "," : "");
    mo_text_json_string(&text, key, strlen(key));
    mo_text_add(&text, ":");
    mo_text_json_string(&text, value, strlen(value));
  }
  mo_text_add(&text, "}");
  if (text.failed)
    mo_text_free(&text);
  return text.data;
}

int mo_controller_content_row(struct mo_connection *writer, const struct mo_controller *controller,
                              const struct mo_sha256 *sha256, size_t size, int64_t now_us,
                              int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM controllers WHERE sha256=?1";
  static const char insert_sql[] =
      "INSERT INTO controllers(sha256,size,sensor,nx,ny,nz,n_parameters,metadata,stored_us,"
      "control_period_s) VALUES(?1,?2,?3,?4,?5,?6,?7,?8,?9,?10)";
  int error = mo_sql_find(writer, row, find_sql, mo_hash(sha256));
  if (error != MO_ERR_NOT_FOUND)
    return error;
  char *metadata = metadata_json(controller);
  error = metadata == NULL
              ? MO_ERR_NO_MEMORY
              : mo_sql_insert(writer, row, insert_sql, mo_hash(sha256), mo_int((int64_t)size),
                              mo_int(controller->sensor), mo_int(controller->workspace.nx),
                              mo_int(controller->workspace.ny), mo_int(controller->workspace.nz),
                              mo_int((int64_t)controller->n_parameters), mo_string(metadata),
                              mo_int(now_us), mo_real(controller->control_period_s));
  free(metadata);
  return error;
}

int mo_controller_put_row(struct mo_store *store, struct mo_controller_put *call)
{
  static const char find_sql[] =
      "SELECT controller,version,stored_us FROM controller_names WHERE name=?1";
  static const char set_sql[] =
      "INSERT INTO controller_names(name,controller,version,stored_us) VALUES(?1,?2,?3,?4)"
      " ON CONFLICT(name) DO UPDATE SET controller=?2,version=?3,stored_us=?4";
  struct mo_connection *writer = &store->writer;
  int64_t known = 0;
  sqlite3_stmt *name;
  call->stored_us = mo_clock_wall_us();
  call->version = 0;
  int error = mo_controller_content_row(writer, call->controller, &call->sha256, call->size,
                                        call->stored_us, &call->row);
  if (error == MO_OK)
    error = mo_sql_row(writer, &name, find_sql, mo_string(call->name));
  call->created = error == MO_ERR_NOT_FOUND;
  if (error == MO_OK) {
    known = sqlite3_column_int64(name, 0);
    call->version = sqlite3_column_int64(name, 1);
    if (known == call->row)
      call->stored_us = sqlite3_column_int64(name, 2);
  }
  if ((error != MO_OK && error != MO_ERR_NOT_FOUND) || known == call->row)
    return error;
  call->version++;
  error = mo_sql_do(writer, set_sql, mo_string(call->name), mo_int(call->row),
                    mo_int(call->version), mo_int(call->stored_us));
  if (error != MO_OK)
    return error;
  return mo_writer_event(store, 0, "controller.stored", "{\"name\":\"%s\",\"sha256\":\"%s\"}",
                         call->name, MO_SHA256_HEX(&call->sha256));
}

static int put(struct mo_store *store, void *arguments)
{
  return mo_controller_put_row(store, arguments);
}

int mo_controller_put_begin(struct mo_store *store, const char *name, const uint8_t *bytes,
                            size_t size, const struct mo_controller *controller,
                            struct mo_controller_put *call)
{
  int error = mo_controller_name_check(name);
  *call = (struct mo_controller_put){.name = name, .controller = controller, .size = size};
  if (error != MO_OK)
    return error;
  mo_sha256_of(bytes, size, &call->sha256);
  pthread_rwlock_rdlock(&store->controllers_lock);
  call->is_locked = true;
  return mo_controller_write_file(store, &call->sha256, bytes, size);
}

void mo_controller_put_end(struct mo_store *store, struct mo_controller_put *call)
{
  if (call->is_locked)
    pthread_rwlock_unlock(&store->controllers_lock);
}

int mo_store_controller_put(struct mo_store *store, const char *name, const uint8_t *bytes,
                            size_t size, const struct mo_controller *controller,
                            struct mo_controller_record *record, bool *created)
{
  struct mo_controller_put call;
  int error = mo_controller_put_begin(store, name, bytes, size, controller, &call);
  if (error == MO_OK)
    error = mo_write(store, put, &call);
  mo_controller_put_end(store, &call);
  if (error != MO_OK)
    return error;
  *record = (struct mo_controller_record){.version = call.version,
                                          .sha256 = call.sha256,
                                          .size = size,
                                          .sensor = controller->sensor,
                                          .workspace = controller->workspace,
                                          .n_parameters = controller->n_parameters,
                                          .control_period_s = controller->control_period_s,
                                          .stored_us = call.stored_us};
  snprintf(record->name, sizeof(record->name), "%s", name);
  *created = call.created;
  return MO_OK;
}

static int remove_name(struct mo_store *store, void *arguments)
{
  static const char sql[] = "DELETE FROM controller_names WHERE name=?1";
  const char *name = arguments;
  const int error = mo_sql_change(&store->writer, sql, mo_string(name));
  if (error != MO_OK)
    return error == MO_ERR_CONFLICT ? MO_ERR_NOT_FOUND : error;
  return mo_writer_event(store, 0, "controller.removed", "{\"name\":\"%s\"}", name);
}

int mo_store_controller_remove(struct mo_store *store, const char *name)
{
  if (mo_controller_name_check(name) != MO_OK)
    return MO_ERR_NOT_FOUND;
  return mo_write_urgent(store, remove_name, (void *)name);
}

/* ---- reading ---- */

/* Without a name (n: no row), the version is 1, and the time is the time of the content. */
#define COLUMNS                                                                                    \
  "SELECT c.sha256,c.size,c.sensor,c.nx,c.ny,c.nz,c.n_parameters,n.name,coalesce(n.version,1),"    \
  "coalesce(n.stored_us,c.stored_us),c.id,c.control_period_s"

static int read_record(sqlite3_stmt *row, void *any)
{
  struct mo_controller_record *record = any;
  *record = (struct mo_controller_record){.size = (uint64_t)sqlite3_column_int64(row, 1),
                                          .sensor = (enum mo_sensor)sqlite3_column_int(row, 2),
                                          .workspace = {(uint16_t)sqlite3_column_int(row, 3),
                                                        (uint16_t)sqlite3_column_int(row, 4),
                                                        (uint16_t)sqlite3_column_int(row, 5)},
                                          .n_parameters = (uint64_t)sqlite3_column_int64(row, 6),
                                          .version = sqlite3_column_int64(row, 8),
                                          .stored_us = sqlite3_column_int64(row, 9),
                                          .control_period_s = sqlite3_column_double(row, 11)};
  mo_column_text(row, 7, record->name, sizeof(record->name));
  return mo_column_hash(row, 0, &record->sha256);
}

int64_t mo_store_controllers(struct mo_store *store, const char *after_name,
                             struct mo_controller_record *records, size_t limit)
{
  static const char sql[] = COLUMNS " FROM controller_names n JOIN controllers c ON"
                                    " c.id=n.controller WHERE n.name>?1 ORDER BY n.name LIMIT ?2";
  return mo_read_page(
      store, sql,
      MO_VALUES(mo_string(after_name != NULL ? after_name : ""), mo_int((int64_t)limit)),
      read_record, records, sizeof(*records));
}

/* Finds the row and record of a name or "sha256:…". MO_ERR_NOT_FOUND. */
static int find_record(struct mo_connection *connection, const char *name, int64_t *id,
                       struct mo_controller_record *record)
{
  static const char by_name[] = COLUMNS " FROM controller_names n JOIN controllers c ON"
                                        " c.id=n.controller WHERE n.name=?1";
  static const char by_hash[] = COLUMNS " FROM controllers c LEFT JOIN controller_names n ON FALSE"
                                        " WHERE c.sha256=?1";
  struct mo_sha256 sha256;
  sqlite3_stmt *row;
  int error = MO_ERR_NOT_FOUND;
  if (strncmp(name, "sha256:", 7) != 0)
    error = mo_sql_row(connection, &row, by_name, mo_string(name));
  else if (mo_sha256_from_hex(name + 7, strlen(name + 7), &sha256) == MO_OK)
    error = mo_sql_row(connection, &row, by_hash, mo_hash(&sha256));
  if (error != MO_OK)
    return error;
  *id = sqlite3_column_int64(row, 10);
  return read_record(row, record);
}

int mo_controller_find(struct mo_connection *connection, const char *name, int64_t *row,
                       enum mo_sensor *sensor, struct mo_physics *physics)
{
  struct mo_controller_record record;
  const int error = find_record(connection, name, row, &record);
  if (error != MO_OK)
    return error;
  *sensor = record.sensor;
  if (!mo_workspace_equal(record.workspace, MO_STORE_WORKSPACE))
    return MO_ERR_UNSUPPORTED;
  return physics != NULL ? mo_physics_complete(physics, record.control_period_s) : MO_OK;
}

int mo_store_controller(struct mo_store *store, const char *name,
                        struct mo_controller_record *record)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int64_t row;
  return find_record(reader, name, &row, record);
}

int mo_store_controller_bytes(struct mo_store *store, const struct mo_sha256 *sha256,
                              uint8_t **bytes, size_t *size)
{
  static const char sql[] = "SELECT size FROM controllers WHERE sha256=?1";
  char *path = mo_controller_path(store, sha256);
  int64_t stored = 0;
  int error = path != NULL ? mo_read_integers(store, sql, MO_VALUES(mo_hash(sha256)), 1, &stored)
                           : MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = mo_file_read_checked(path, (size_t)stored, sha256, bytes);
  free(path);
  *size = (size_t)stored;
  return error;
}

static int take_metadata(sqlite3_stmt *row, void *json)
{
  const char *text = (const char *)sqlite3_column_text(row, 0);
  *(char **)json = text != NULL ? strdup(text) : NULL;
  return *(char **)json != NULL ? MO_OK : MO_ERR_NO_MEMORY;
}

int mo_store_controller_metadata(struct mo_store *store, const struct mo_sha256 *sha256,
                                 char **json)
{
  static const char sql[] = "SELECT metadata FROM controllers WHERE sha256=?1";
  return mo_read_one(store, sql, MO_VALUES(mo_hash(sha256)), take_metadata, json);
}

/* ---- deletion of content that no name, job or score refers to (scores refer through conditions)
 * ---- */

/* Describes the first reference to a controller. MO_ERR_NOT_FOUND: no reference. */
static int find_user(struct mo_connection *reader, int64_t id, char words[128])
{
  static const char sql[] =
      "SELECT 'the name '||name FROM controller_names WHERE controller=?1 UNION ALL"
      " SELECT 'evaluation '||job FROM evaluations WHERE controller=?1 UNION ALL"
      " SELECT iif(j.kind=1,'training ','campaign ')||j.id FROM runs r JOIN jobs j ON j.id=r.job"
      " WHERE ?1 IN (r.controller,r.result) UNION ALL"
      " SELECT 'atlas job '||job FROM atlases WHERE controller=?1 UNION ALL"
      " SELECT 'certificate '||job FROM certificates WHERE controller=?1 UNION ALL"
      " SELECT 'a stored mean score' FROM rankings WHERE controller=?1 UNION ALL"
      " SELECT 'a stored score' FROM conditions WHERE controller=?1 LIMIT 1";
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_int(id));
  if (error == MO_OK)
    mo_column_text(row, 0, words, 128);
  return error;
}

/* Deletes a controller's row. MO_ERR_CONFLICT: a reference was added after the search. */
static int remove_content(struct mo_store *store, void *id)
{
  static const char sql[] = "DELETE FROM controllers WHERE id=?1";
  struct mo_connection *writer = &store->writer;
  const int error = mo_sql_do(writer, sql, mo_int(*(const int64_t *)id));
  if (error == MO_OK)
    return sqlite3_changes(writer->db) > 0 ? MO_OK : MO_ERR_NOT_FOUND;
  return sqlite3_extended_errcode(writer->db) == SQLITE_CONSTRAINT_FOREIGNKEY ? MO_ERR_CONFLICT
                                                                              : error;
}

/* Deletes the row, then the file. The lock keeps other threads from storing the same content in
 * between. */
static int remove_row_and_file(struct mo_store *store, int64_t id, const struct mo_sha256 *sha256)
{
  char *path = mo_controller_path(store, sha256);
  if (path == NULL)
    return MO_ERR_NO_MEMORY;
  pthread_rwlock_wrlock(&store->controllers_lock);
  int error = mo_write_urgent(store, remove_content, &id);
  if (error == MO_OK)
    (void)store->files->unlink(path); /* if this fails, the next start reports the file */
  pthread_rwlock_unlock(&store->controllers_lock);
  free(path);
  return error;
}

int mo_store_controller_delete(struct mo_store *store, const char *reference,
                               struct mo_message *message)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_controller_record record;
  char words[128] = "something new";
  int64_t id = 0;
  int error = find_record(reader, reference, &id, &record);
  if (error == MO_OK) {
    error = find_user(reader, id, words);
    error = error == MO_OK ? MO_ERR_CONFLICT : error == MO_ERR_NOT_FOUND ? MO_OK : error;
  }
  mo_reader_release(store, reader);
  if (error == MO_OK)
    error = remove_row_and_file(store, id, &record.sha256);
  return error == MO_ERR_CONFLICT ? mo_fail(message, error, "%s refers to it", words) : error;
}

int mo_controllers_clean(struct mo_store *store,
                         void (*report)(void *context, const char *name, uint64_t bytes),
                         void *context)
{
  static const char sql[] =
      "SELECT id,sha256,size FROM controllers WHERE id NOT IN ("
      "SELECT controller FROM controller_names UNION SELECT controller FROM evaluations"
      " UNION SELECT controller FROM atlases UNION SELECT controller FROM certificates"
      " UNION SELECT controller FROM runs WHERE controller IS NOT NULL"
      " UNION SELECT result FROM runs WHERE result IS NOT NULL"
      " UNION SELECT controller FROM rankings UNION SELECT controller FROM conditions) ORDER BY id";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  char name[128];
  struct mo_sha256 sha256;
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql);
  while (mo_sql_next(reader, row, &error)) {
    error = mo_column_hash(row, 1, &sha256);
    if (error == MO_OK && report != NULL) {
      snprintf(name, sizeof(name), "controllers/%s.safetensors", MO_SHA256_HEX(&sha256));
      report(context, name, (uint64_t)sqlite3_column_int64(row, 2));
    } else if (error == MO_OK) {
      error = remove_row_and_file(store, sqlite3_column_int64(row, 0), &sha256);
    }
  }
  return error;
}
