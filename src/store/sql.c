/* sql.c: a thin layer over SQLite: cached statements, error codes, checked columns.
 *
 * Statements are string literals at their point of use. The cache looks them up by address, so each
 * is prepared once per connection. */
#include <errno.h>
#include <math.h>
#include <string.h>

#include "store/internal.h"

void mo_store_limit_memory(uint64_t bytes)
{
  (void)sqlite3_soft_heap_limit64(bytes < INT64_MAX ? (sqlite3_int64)bytes : INT64_MAX);
}

int mo_sql_error(sqlite3 *db, int code)
{
  int system_error;
  switch (code & 0xff) {
  case SQLITE_OK:
  case SQLITE_ROW:
  case SQLITE_DONE: return MO_OK;
  case SQLITE_FULL: return MO_ERR_NO_SPACE;
  case SQLITE_NOMEM: return MO_ERR_NO_MEMORY;
  case SQLITE_CORRUPT:
  case SQLITE_NOTADB:
  case SQLITE_CONSTRAINT:
  case SQLITE_MISMATCH: return MO_ERR_CORRUPT;
  case SQLITE_BUSY:
  case SQLITE_LOCKED: return MO_ERR_BUSY;
  case SQLITE_TOOBIG: return MO_ERR_LIMIT;
  case SQLITE_IOERR:
    if (code == SQLITE_IOERR_NOMEM)
      return MO_ERR_NO_MEMORY;
    if (code == SQLITE_IOERR_SHMSIZE) /* the log's index, which need not be durable, could not grow;
                                       * errno has changed since then */
      return MO_ERR_NO_SPACE;
    if (code == SQLITE_IOERR_SHMMAP)
      return mo_mapping_error();
    system_error = db != NULL ? sqlite3_system_errno(db) : 0;
    /* A failed fsync is never "no space", because the data that the kernel dropped is unknown. */
    if (code != SQLITE_IOERR_FSYNC && code != SQLITE_IOERR_DIR_FSYNC &&
        (system_error == ENOSPC || system_error == EDQUOT || system_error == EFBIG))
      return MO_ERR_NO_SPACE;
    return MO_ERR_IO;
  case SQLITE_CANTOPEN:
    system_error = db != NULL ? sqlite3_system_errno(db) : 0;
    return system_error == EMFILE || system_error == ENFILE ? MO_ERR_NO_MEMORY
                                                            : MO_ERR_IO; /* as for any file */
  default: return MO_ERR_IO;
  }
}

static int configure(sqlite3 *db, bool writable)
{
  static const char common[] =
      "PRAGMA trusted_schema=OFF; PRAGMA cell_size_check=ON; PRAGMA mmap_size=0;"
      "PRAGMA temp_store=MEMORY; PRAGMA foreign_keys=ON;";
  static const char reading[] = "PRAGMA query_only=ON; PRAGMA cache_size=-8192;";
  static const char writing[] =
      "PRAGMA synchronous=FULL; PRAGMA cache_size=-65536; PRAGMA wal_autocheckpoint=0;"
      /* Debian's SQLite overwrites deleted content by default, and would log every page of a
       * recording. */
      "PRAGMA journal_size_limit=67108864; PRAGMA secure_delete=FAST;";
  int result = sqlite3_exec(db, common, NULL, NULL, NULL);
  if (result == SQLITE_OK)
    result = sqlite3_exec(db, writable ? writing : reading, NULL, NULL, NULL);
  return result;
}

int mo_connection_open(const struct mo_store *store, bool writable,
                       struct mo_connection *connection)
{
  int flags = (writable ? SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE : SQLITE_OPEN_READONLY) |
              SQLITE_OPEN_NOMUTEX | SQLITE_OPEN_EXRESCODE | SQLITE_OPEN_NOFOLLOW;
  int error;
  memset(connection, 0, sizeof(*connection));
  int result = sqlite3_open_v2(store->database_path, &connection->db, flags, store->vfs);
  if (result == SQLITE_OK) {
    sqlite3_busy_timeout(connection->db, MO_BUSY_MS);
    (void)sqlite3_db_config(connection->db, SQLITE_DBCONFIG_DEFENSIVE, 1, NULL);
    result = configure(connection->db, writable);
  }
  if (result != SQLITE_OK) {
    error = mo_sql_error(connection->db, result);
    mo_connection_close(connection);
    return error;
  }
  return MO_OK;
}

void mo_connection_close(struct mo_connection *connection)
{
  for (unsigned i = 0; i < connection->n_cached; i++)
    sqlite3_finalize(connection->cache[i].statement);
  connection->n_cached = 0;
  (void)sqlite3_close(connection->db);
  connection->db = NULL;
}

int mo_sql_exec(struct mo_connection *connection, const char *sql)
{
  return mo_sql_error(connection->db, sqlite3_exec(connection->db, sql, NULL, NULL, NULL));
}

void mo_sql_reset(struct mo_connection *connection)
{
  for (unsigned i = 0; i < connection->n_cached; i++)
    if (sqlite3_stmt_busy(connection->cache[i].statement))
      (void)sqlite3_reset(connection->cache[i].statement);
}

/* ---- statements with their values ---- */

struct mo_value mo_null(void)
{
  return (struct mo_value){.type = SQLITE_NULL};
}

struct mo_value mo_int(int64_t value)
{
  return (struct mo_value){.type = SQLITE_INTEGER, .integer = value};
}

struct mo_value mo_real(double value)
{
  return (struct mo_value){.type = SQLITE_FLOAT, .real = value};
}

struct mo_value mo_string(const char *text)
{
  return (struct mo_value){.type = text != NULL ? SQLITE_TEXT : SQLITE_NULL, .bytes = text};
}

struct mo_value mo_blob(const void *bytes, size_t size)
{
  return (struct mo_value){.type = SQLITE_BLOB, .bytes = bytes, .size = size};
}

struct mo_value mo_hash(const struct mo_sha256 *hash)
{
  return mo_blob(hash->bytes, sizeof(hash->bytes));
}

/* Returns the cached statement of a string literal, reset. */
static sqlite3_stmt *prepared(struct mo_connection *connection, const char *sql, int *error)
{
  sqlite3_stmt *statement;
  for (unsigned i = 0; i < connection->n_cached; i++)
    if (connection->cache[i].sql == sql) {
      (void)sqlite3_reset(connection->cache[i].statement);
      return connection->cache[i].statement;
    }
  if (connection->n_cached == MO_STATEMENTS_MAX) {
    *error = MO_ERR_LIMIT;
    return NULL;
  }
  int result =
      sqlite3_prepare_v3(connection->db, sql, -1, SQLITE_PREPARE_PERSISTENT, &statement, NULL);
  if (result != SQLITE_OK) {
    /* If a statement does not fit the schema, the schema is not that of its version. */
    *error =
        (result & 0xff) == SQLITE_ERROR ? MO_ERR_CORRUPT : mo_sql_error(connection->db, result);
    return NULL;
  }
  connection->cache[connection->n_cached].sql = sql;
  connection->cache[connection->n_cached].statement = statement;
  connection->n_cached++;
  return statement;
}

sqlite3_stmt *mo_sql_rows_with(struct mo_connection *connection, int *error, const char *sql,
                               struct mo_values values)
{
  if (*error == MO_OK)
    *error = connection->error;
  sqlite3_stmt *statement = *error == MO_OK ? prepared(connection, sql, error) : NULL;
  /* A statement that lacks a parameter rejects its value; this is not an error. */
  for (int i = 0; i < values.n && statement != NULL; i++) {
    const struct mo_value *value = &values.at[i];
    switch (value->type) {
    case SQLITE_INTEGER: sqlite3_bind_int64(statement, i + 1, value->integer); break;
    case SQLITE_FLOAT: sqlite3_bind_double(statement, i + 1, value->real); break;
    case SQLITE_TEXT: sqlite3_bind_text(statement, i + 1, value->bytes, -1, SQLITE_STATIC); break;
    case SQLITE_BLOB:
      sqlite3_bind_blob64(statement, i + 1, value->bytes, value->size, SQLITE_STATIC);
      break;
    default: sqlite3_bind_null(statement, i + 1);
    }
  }
  return statement;
}

bool mo_sql_next(struct mo_connection *connection, sqlite3_stmt *row, int *error)
{
  const int result = *error == MO_OK ? sqlite3_step(row) : SQLITE_DONE;
  if (result == SQLITE_ROW)
    return true;
  if (*error == MO_OK)
    *error = mo_sql_error(connection->db, result);
  if (row != NULL)
    (void)sqlite3_reset(row);
  return false;
}

int mo_sql_row_with(struct mo_connection *connection, sqlite3_stmt **row, const char *sql,
                    struct mo_values values)
{
  int error = MO_OK;
  *row = mo_sql_rows_with(connection, &error, sql, values);
  return mo_sql_next(connection, *row, &error) || error != MO_OK ? error : MO_ERR_NOT_FOUND;
}

int mo_sql_do_with(struct mo_connection *connection, const char *sql, struct mo_values values)
{
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql_rows_with(connection, &error, sql, values);
  if (mo_sql_next(connection, statement, &error))
    (void)sqlite3_reset(statement);
  return error;
}

int mo_sql_change_with(struct mo_connection *connection, const char *sql, struct mo_values values)
{
  const int error = mo_sql_do_with(connection, sql, values);
  return error == MO_OK && sqlite3_changes(connection->db) == 0 ? MO_ERR_CONFLICT : error;
}

int mo_sql_insert_with(struct mo_connection *connection, int64_t *row, const char *sql,
                       struct mo_values values)
{
  const int error = mo_sql_do_with(connection, sql, values);
  *row = sqlite3_last_insert_rowid(connection->db);
  return error;
}

int mo_sql_find_with(struct mo_connection *connection, int64_t *value, const char *sql,
                     struct mo_values values)
{
  sqlite3_stmt *row;
  const int error = mo_sql_row_with(connection, &row, sql, values);
  if (error != MO_OK)
    return error;
  *value = sqlite3_column_int64(row, 0);
  (void)sqlite3_reset(row);
  return MO_OK;
}

/* ---- columns ---- */

int mo_column_missing(sqlite3_stmt *statement)
{
  return sqlite3_errcode(sqlite3_db_handle(statement)) == SQLITE_NOMEM ? MO_ERR_NO_MEMORY
                                                                       : MO_ERR_CORRUPT;
}

int mo_column_hash(sqlite3_stmt *statement, int column, struct mo_sha256 *hash)
{
  const void *blob = sqlite3_column_blob(statement, column);
  if (blob == NULL || sqlite3_column_bytes(statement, column) != (int)sizeof(hash->bytes))
    return mo_column_missing(statement);
  memcpy(hash->bytes, blob, sizeof(hash->bytes));
  return MO_OK;
}

int mo_column_genotype(sqlite3_stmt *statement, int column, struct mo_genotype *genotype)
{
  const void *blob = sqlite3_column_blob(statement, column);
  return mo_decode_genotype(blob, (size_t)sqlite3_column_bytes(statement, column), genotype);
}

int mo_column_design(sqlite3_stmt *statement, int genotype_column, int form_column,
                     struct mo_genotype *genotype, struct mo_genotype *form)
{
  int error = mo_column_genotype(statement, genotype_column, genotype);
  if (error == MO_OK)
    error = mo_column_genotype(statement, form_column, form);
  if (error != MO_OK)
    return error;
  const struct mo_genotype canonical = mo_genotype_form(genotype);
  return mo_genotype_equal(&canonical, form) ? MO_OK : MO_ERR_CORRUPT;
}

int mo_column_listed(sqlite3_stmt *statement, int genotype_column, int form_column,
                     struct mo_bits *genotype, struct mo_bits *form)
{
  struct mo_genotype read, canonical;
  const int error = mo_column_design(statement, genotype_column, form_column, &read, &canonical);
  if (error != MO_OK)
    return error;
  memcpy(genotype->words, read.words, sizeof(genotype->words));
  if (form != NULL)
    memcpy(form->words, canonical.words, sizeof(form->words));
  return MO_OK;
}

int mo_column_environment(sqlite3_stmt *statement, int data, int sha256,
                          struct mo_environment *environment)
{
  const void *bytes = sqlite3_column_blob(statement, data);
  const size_t size = (size_t)sqlite3_column_bytes(statement, data);
  struct mo_sha256 hash, found;
  int error = mo_decode_environment(bytes, size, environment);
  if (error == MO_OK)
    error = mo_column_hash(statement, sha256, &hash);
  if (error == MO_OK) {
    mo_sha256_of(bytes, size, &found);
    error = mo_sha256_equal(&hash, &found) ? MO_OK : MO_ERR_CORRUPT;
  }
  if (error != MO_OK)
    mo_environments_drop(environment, 1);
  return error == MO_OK || error == MO_ERR_NO_MEMORY ? error : MO_ERR_CORRUPT;
}

int mo_environment_get(struct mo_connection *connection, int64_t id,
                       struct mo_environment *environment, struct mo_sha256 *sha256)
{
  static const char sql[] = "SELECT data,sha256 FROM environments WHERE id=?1";
  sqlite3_stmt *row;
  int error = mo_sql_row(connection, &row, sql, mo_int(id));
  if (error == MO_OK)
    error = mo_column_environment(row, 0, 1, environment);
  if (error == MO_OK && sha256 != NULL)
    error = mo_column_hash(row, 1, sha256);
  return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
}

int mo_column_physics(sqlite3_stmt *statement, int column, struct mo_physics *physics,
                      enum mo_precision *precision, enum mo_sensor *sensor)
{
  const void *encoding = sqlite3_column_blob(statement, column);
  return mo_decode_physics(encoding, (size_t)sqlite3_column_bytes(statement, column), physics,
                           precision, sensor);
}

int mo_column_double(sqlite3_stmt *statement, int column, double *value)
{
  const void *blob = sqlite3_column_blob(statement, column);
  if (blob == NULL || sqlite3_column_bytes(statement, column) != 8)
    return mo_column_missing(statement);
  memcpy(value, blob, sizeof(*value));
  return MO_OK;
}

double mo_column_number(sqlite3_stmt *statement, int column)
{
  return sqlite3_column_type(statement, column) == SQLITE_NULL
             ? NAN
             : sqlite3_column_double(statement, column);
}

uint32_t mo_column_u32(sqlite3_stmt *statement, int column)
{
  return (uint32_t)sqlite3_column_int64(statement, column);
}

void mo_column_text(sqlite3_stmt *statement, int column, char *text, size_t size)
{
  const unsigned char *found = sqlite3_column_text(statement, column);
  size_t length = found != NULL ? strlen((const char *)found) : 0;
  if (length >= size)
    length = size - 1;
  if (found != NULL)
    memcpy(text, found, length);
  text[length] = '\0';
}
