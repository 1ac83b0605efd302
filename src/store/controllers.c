/* controllers.c: weights, stored by content, and the names that point to them.
 *
 * A file is written beside its place, synced and renamed, and its folder is synced, before its row
 * commits. So a row never refers to bytes that are missing. A file without a row is harmless: the
 * next upload of the same content uses it. */
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

/* Returns "<folder>/<sha256>.safetensors" (malloc). */
char *mo_controller_path(const struct mo_store *store, const struct mo_sha256 *sha256)
{
  char digits[MO_SHA256_DIGITS + 1];
  size_t size = strlen(store->controllers_path) + MO_SHA256_DIGITS + sizeof("/.safetensors");
  char *path = malloc(size);
  if (path == NULL)
    return NULL;
  mo_sha256_to_hex(sha256, digits);
  snprintf(path, size, "%s/%s.safetensors", store->controllers_path, digits);
  return path;
}

static int write_file(struct mo_store *store, const struct mo_sha256 *sha256, const uint8_t *bytes,
                      size_t size)
{
  char *path = mo_controller_path(store, sha256);
  uint8_t *there = NULL;
  int error;
  if (path == NULL)
    return MO_ERR_NO_MEMORY;
  /* A crash may have left a whole file without its row. */
  if (mo_file_read(path, size, &there) == MO_OK && memcmp(there, bytes, size) == 0)
    error = mo_folder_sync(store, store->controllers_path);
  else
    error = mo_file_write(store, store->controllers_path, path, bytes, size);
  free(there);
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

static int content_row(struct mo_connection *writer, const struct mo_controller_put *call,
                       int64_t now_us, int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM controllers WHERE sha256=?1";
  static const char insert_sql[] =
      "INSERT INTO controllers(sha256,size,sensor,nx,ny,nz,n_parameters,metadata,stored_us) "
      "VALUES(?1,?2,?3,?4,?5,?6,?7,?8,?9)";
  const struct mo_controller *controller = call->controller;
  int error = mo_sql_find(writer, row, find_sql, mo_hash(&call->sha256));
  if (error != MO_ERR_NOT_FOUND)
    return error;
  error = mo_sql_do(writer, insert_sql, mo_hash(&call->sha256), mo_int((int64_t)call->size),
                    mo_int(controller->sensor), mo_int(controller->workspace.nx),
                    mo_int(controller->workspace.ny), mo_int(controller->workspace.nz),
                    mo_int((int64_t)controller->n_parameters), mo_string(call->metadata),
                    mo_int(now_us));
  *row = sqlite3_last_insert_rowid(writer->db);
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
  char digits[MO_SHA256_DIGITS + 1], data[256];
  int64_t row = 0, known = 0, version = 0, now_us = mo_clock_wall_us();
  sqlite3_stmt *name;
  int error = content_row(writer, call, now_us, &row);
  call->row = row;
  if (error == MO_OK)
    error = mo_sql_row(writer, &name, find_sql, mo_string(call->name));
  call->created = error == MO_ERR_NOT_FOUND;
  if (error == MO_OK) {
    known = sqlite3_column_int64(name, 0);
    version = sqlite3_column_int64(name, 1);
    if (known == row)
      now_us = sqlite3_column_int64(name, 2);
    (void)sqlite3_reset(name);
  } else if (error != MO_ERR_NOT_FOUND) {
    return error;
  }
  error = MO_OK;
  if (known != row) {
    version++;
    error = mo_sql_do(writer, set_sql, mo_string(call->name), mo_int(row), mo_int(version),
                      mo_int(now_us));
    if (error != MO_OK)
      return error;
    mo_sha256_to_hex(&call->sha256, digits);
    snprintf(data, sizeof(data), "{\"name\":\"%s\",\"sha256\":\"%s\"}", call->name, digits);
    error = mo_writer_event(store, 0, "controller.stored", data);
  }
  call->record.version = version;
  call->record.stored_us = now_us;
  return error;
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
  call->metadata = metadata_json(controller);
  if (call->metadata == NULL)
    return MO_ERR_NO_MEMORY;
  mo_sha256_of(bytes, size, &call->sha256);
  pthread_rwlock_rdlock(&store->controllers_lock);
  call->is_locked = true;
  return write_file(store, &call->sha256, bytes, size);
}

void mo_controller_put_end(struct mo_store *store, struct mo_controller_put *call)
{
  if (call->is_locked)
    pthread_rwlock_unlock(&store->controllers_lock);
  call->is_locked = false;
  free(call->metadata);
  call->metadata = NULL;
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
  *record = (struct mo_controller_record){.version = call.record.version,
                                          .sha256 = call.sha256,
                                          .size = size,
                                          .sensor = controller->sensor,
                                          .workspace = controller->workspace,
                                          .n_parameters = controller->n_parameters,
                                          .stored_us = call.record.stored_us};
  snprintf(record->name, sizeof(record->name), "%s", name);
  *created = call.created;
  return MO_OK;
}

static int remove_name(struct mo_store *store, void *arguments)
{
  static const char sql[] = "DELETE FROM controller_names WHERE name=?1";
  const char *name = arguments;
  char data[128];
  const int error = mo_sql_change(&store->writer, sql, mo_string(name));
  if (error != MO_OK)
    return error == MO_ERR_CONFLICT ? MO_ERR_NOT_FOUND : error;
  snprintf(data, sizeof(data), "{\"name\":\"%s\"}", name);
  return mo_writer_event(store, 0, "controller.removed", data);
}

int mo_store_controller_remove(struct mo_store *store, const char *name)
{
  if (mo_controller_name_check(name) != MO_OK)
    return MO_ERR_NOT_FOUND;
  return mo_write_urgent(store, remove_name, (void *)name);
}

/* ---- reading ---- */

int mo_controller_sensor(struct mo_connection *connection, int64_t row, enum mo_sensor *sensor)
{
  static const char sql[] = "SELECT sensor,nx,ny,nz FROM controllers WHERE id=?1";
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  sqlite3_stmt *statement;
  const int error = mo_sql_row(connection, &statement, sql, mo_int(row));
  bool fits;
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  *sensor = (enum mo_sensor)sqlite3_column_int(statement, 0);
  fits = sqlite3_column_int64(statement, 1) == workspace.nx &&
         sqlite3_column_int64(statement, 2) == workspace.ny &&
         sqlite3_column_int64(statement, 3) == workspace.nz;
  (void)sqlite3_reset(statement);
  return fits ? MO_OK : MO_ERR_UNSUPPORTED;
}

int mo_controller_find(struct mo_connection *connection, const char *name, int64_t *row)
{
  static const char by_hash[] = "SELECT id FROM controllers WHERE sha256=?1";
  static const char by_name[] = "SELECT controller FROM controller_names WHERE name=?1";
  struct mo_sha256 sha256;
  if (strncmp(name, "sha256:", 7) != 0)
    return mo_sql_find(connection, row, by_name, mo_string(name));
  return mo_sha256_from_hex(name + 7, strlen(name + 7), &sha256) == MO_OK
             ? mo_sql_find(connection, row, by_hash, mo_hash(&sha256))
             : MO_ERR_NOT_FOUND;
}

#define CONTROLLER_COLUMNS "c.sha256,c.size,c.sensor,c.nx,c.ny,c.nz,c.n_parameters"

/* Reads a record. A NULL name means that it was looked up by hash. */
static int record_from_row(sqlite3_stmt *statement, struct mo_controller_record *record)
{
  memset(record, 0, sizeof(*record));
  record->size = (uint64_t)sqlite3_column_int64(statement, 1);
  record->sensor = (enum mo_sensor)sqlite3_column_int(statement, 2);
  record->workspace = (struct mo_workspace){(uint16_t)sqlite3_column_int(statement, 3),
                                            (uint16_t)sqlite3_column_int(statement, 4),
                                            (uint16_t)sqlite3_column_int(statement, 5)};
  record->n_parameters = (uint64_t)sqlite3_column_int64(statement, 6);
  mo_column_text(statement, 8, record->name, sizeof(record->name));
  record->version = sqlite3_column_int64(statement, 9);
  record->stored_us = sqlite3_column_int64(statement, 10);
  return mo_column_hash(statement, 0, &record->sha256);
}

int64_t mo_store_controllers(struct mo_store *store, const char *after_name,
                             struct mo_controller_record *records, size_t limit)
{
  static const char sql[] =
      "SELECT " CONTROLLER_COLUMNS
      ",n.controller,n.name,n.version,n.stored_us FROM controller_names n"
      " LEFT JOIN controllers c ON c.id=n.controller WHERE n.name>?1 ORDER BY n.name";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  size_t n = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    int step = 0;
    sqlite3_bind_text(statement, 1, after_name != NULL ? after_name : "", -1, SQLITE_STATIC);
    while (error == MO_OK && n < limit && (step = mo_sql_step(reader, statement)) > 0)
      error = record_from_row(statement, &records[n++]);
    if (step < 0)
      error = step;
    (void)sqlite3_reset(statement);
    (void)sqlite3_clear_bindings(statement);
  }
  mo_reader_release(store, reader);
  return error != MO_OK ? error : (int64_t)n;
}

int mo_store_controller(struct mo_store *store, const char *name,
                        struct mo_controller_record *record)
{
  static const char by_name[] = "SELECT " CONTROLLER_COLUMNS
                                ",n.controller,n.name,n.version,n.stored_us FROM controller_names n"
                                " LEFT JOIN controllers c ON c.id=n.controller WHERE n.name=?1";
  static const char by_row[] =
      "SELECT " CONTROLLER_COLUMNS ",c.id,NULL,1,c.stored_us FROM controllers c WHERE c.id=?1";
  struct mo_connection *reader = mo_reader_acquire(store);
  bool hashed = strncmp(name, "sha256:", 7) == 0;
  sqlite3_stmt *statement = NULL;
  int64_t row = 0;
  int error = hashed ? mo_controller_find(reader, name, &row) : MO_OK;
  if (error == MO_OK)
    statement = mo_sql(reader, hashed ? by_row : by_name, &error);
  if (statement != NULL) {
    int step;
    if (hashed)
      sqlite3_bind_int64(statement, 1, row);
    else
      sqlite3_bind_text(statement, 1, name, -1, SQLITE_STATIC);
    step = mo_sql_step(reader, statement);
    error = step > 0 ? record_from_row(statement, record) : step < 0 ? step : MO_ERR_NOT_FOUND;
    (void)sqlite3_reset(statement);
    (void)sqlite3_clear_bindings(statement);
  }
  mo_reader_release(store, reader);
  return error;
}

static int content_size(struct mo_store *store, const struct mo_sha256 *sha256, int64_t *size)
{
  static const char sql[] = "SELECT size FROM controllers WHERE sha256=?1";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    mo_bind_hash(statement, 1, sha256);
    error = mo_sql_integer(reader, statement, size);
  }
  mo_reader_release(store, reader);
  return error;
}

int mo_store_controller_bytes(struct mo_store *store, const struct mo_sha256 *sha256, uint8_t **ret,
                              size_t *ret_size)
{
  struct mo_sha256 found;
  uint8_t *bytes = NULL;
  int64_t size = 0;
  char *path;
  int error = content_size(store, sha256, &size);
  if (error != MO_OK)
    return error;
  path = mo_controller_path(store, sha256);
  if (path == NULL)
    return MO_ERR_NO_MEMORY;
  error = size >= 0 ? mo_file_read(path, (size_t)size, &bytes) : MO_ERR_CORRUPT;
  free(path);
  if (error == MO_ERR_NOT_FOUND)
    error = MO_ERR_CORRUPT; /* the row exists, but its file does not */
  if (error == MO_OK) {
    mo_sha256_of(bytes, (size_t)size, &found);
    if (!mo_sha256_equal(&found, sha256)) {
      free(bytes);
      error = MO_ERR_CORRUPT;
    }
  }
  if (error == MO_OK) {
    *ret = bytes;
    *ret_size = (size_t)size;
  }
  return error;
}

int mo_store_controller_metadata(struct mo_store *store, const struct mo_sha256 *sha256,
                                 char **json)
{
  static const char sql[] = "SELECT metadata FROM controllers WHERE sha256=?1";
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    int step;
    mo_bind_hash(statement, 1, sha256);
    step = mo_sql_step(reader, statement);
    error = step < 0 ? step : step == 0 ? MO_ERR_NOT_FOUND : MO_OK;
    if (step > 0) {
      const char *text = (const char *)sqlite3_column_text(statement, 0);
      char *copy = text != NULL ? strdup(text) : NULL;
      if (copy == NULL)
        error = MO_ERR_NO_MEMORY;
      else
        *json = copy;
    }
    (void)sqlite3_reset(statement);
  }
  mo_reader_release(store, reader);
  return error;
}
