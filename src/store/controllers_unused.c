/* controllers_unused.c: finds and removes content that no name, job or score refers to. Scores
 * refer to it by their conditions, which are few. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/controller_rows.h"

/* Describes the first reference to a controller. MO_ERR_NOT_FOUND: there is none. */
static int find_user(struct mo_connection *reader, int64_t row, char words[128])
{
  static const char sql[] =
      "SELECT 'the name '||name FROM controller_names WHERE controller=?1 UNION ALL"
      " SELECT 'evaluation '||job FROM evaluations WHERE controller=?1 UNION ALL"
      " SELECT iif(j.kind=1,'training ','campaign ')||j.id FROM runs r JOIN jobs j ON j.id=r.job"
      " WHERE ?1 IN (r.controller,r.result) UNION ALL"
      " SELECT 'a stored mean score' FROM rankings WHERE controller=?1 UNION ALL"
      " SELECT 'a stored score' FROM conditions WHERE controller=?1 LIMIT 1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, row);
  error = mo_sql_step(reader, statement);
  if (error > 0)
    mo_column_text(statement, 0, words, 128);
  (void)sqlite3_reset(statement);
  return error > 0 ? MO_OK : error == 0 ? MO_ERR_NOT_FOUND : error;
}

/* Deletes a controller's row. MO_ERR_CONFLICT: a reference was added after the search. */
static int remove_content(struct mo_store *store, void *arguments)
{
  static const char sql[] = "DELETE FROM controllers WHERE id=?1";
  struct mo_connection *writer = &store->writer;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, *(const int64_t *)arguments);
  error = mo_sql_run(writer, statement);
  if (error == MO_OK)
    return sqlite3_changes(writer->db) > 0 ? MO_OK : MO_ERR_NOT_FOUND;
  return sqlite3_extended_errcode(writer->db) == SQLITE_CONSTRAINT_FOREIGNKEY ? MO_ERR_CONFLICT
                                                                              : error;
}

/* Deletes the row, then the file. The lock keeps other threads from storing the same content in
 * between. */
static int remove_row_and_file(struct mo_store *store, int64_t row, const struct mo_sha256 *sha256)
{
  char *path = mo_controller_path(store, sha256);
  int error;
  if (path == NULL)
    return MO_ERR_NO_MEMORY;
  pthread_rwlock_wrlock(&store->controllers_lock);
  error = mo_write_urgent(store, remove_content, &row);
  if (error == MO_OK)
    (void)store->files->unlink(store->files->context,
                               path); /* if this fails, the next start reports the file */
  pthread_rwlock_unlock(&store->controllers_lock);
  free(path);
  return error;
}

int mo_store_controller_delete(struct mo_store *store, const char *reference,
                               struct mo_message *message)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_sha256 sha256 = {.bytes = {0}};
  char words[128] = "something new";
  int64_t row = 0;
  int error = mo_controller_find(reader, reference, &row);
  if (error == MO_OK)
    error = mo_sha256_from_hex(strchr(reference, ':') + 1, MO_SHA256_DIGITS, &sha256);
  if (error == MO_OK) {
    error = find_user(reader, row, words);
    error = error == MO_OK ? MO_ERR_CONFLICT : error == MO_ERR_NOT_FOUND ? MO_OK : error;
  }
  mo_reader_release(store, reader);
  if (error == MO_OK)
    error = remove_row_and_file(store, row, &sha256);
  return error == MO_ERR_CONFLICT ? mo_fail(message, error, "%s refers to it", words) : error;
}

int mo_controllers_clean(struct mo_store *store,
                         void (*tell)(void *context, const char *name, uint64_t bytes),
                         void *context)
{
  static const char sql[] =
      "SELECT id,sha256,size FROM controllers WHERE length(sha256)=32 AND id NOT IN ("
      "SELECT controller FROM controller_names UNION SELECT controller FROM evaluations"
      " UNION SELECT controller FROM runs WHERE controller IS NOT NULL"
      " UNION SELECT result FROM runs WHERE result IS NOT NULL"
      " UNION SELECT controller FROM rankings UNION SELECT controller FROM conditions) ORDER BY id";
  struct mo_connection *reader = mo_reader_acquire(store);
  char digits[MO_SHA256_DIGITS + 1], name[128];
  struct mo_sha256 sha256;
  int error = MO_OK, step = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    error = mo_column_hash(statement, 1, &sha256);
    if (error == MO_OK && tell != NULL) {
      mo_sha256_to_hex(&sha256, digits);
      snprintf(name, sizeof(name), "controllers/%s.safetensors", digits);
      tell(context, name, (uint64_t)sqlite3_column_int64(statement, 2));
    } else if (error == MO_OK) {
      error = remove_row_and_file(store, sqlite3_column_int64(statement, 0), &sha256);
    }
  }
  mo_reader_release(store, reader);
  return error != MO_OK ? error : step;
}
