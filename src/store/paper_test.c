/* paper_test.c: the paper's test set, a constant of the code with rows of its own, so that scores
 * can refer to it.
 *
 * Each opening compares these rows with the constant, and writes again what is not as it must be:
 * the numbers of rows stay, because scores refer to them. A set of which less than half is the
 * constant's is one of another version of the code, and is left alone: what a folder has once
 * called by a name keeps that meaning there. */
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "store/internal.h"

#define NAME "paper-test"

struct member {
  int64_t row; /* of its environment; 0: there is none at this position */
  bool is_known;
};

struct putting_right {
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  uint8_t data[MO_PAPER_TEST_COUNT][MO_ENVIRONMENT_BYTES];
  struct mo_sha256 sha256[MO_PAPER_TEST_COUNT];
  struct member members[MO_PAPER_TEST_COUNT];
  bool is_there;   /* the set */
  char words[256]; /* what was written again */
};

static void tell(struct putting_right *call, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
static void tell(struct putting_right *call, const char *format, ...)
{
  size_t used = strlen(call->words);
  va_list arguments;
  va_start(arguments, format);
  if (used > 0 && used + 2 < sizeof(call->words))
    used += (size_t)snprintf(call->words + used, sizeof(call->words) - used, ", ");
  vsnprintf(call->words + used, sizeof(call->words) - used, format, arguments);
  va_end(arguments);
}

/* Runs a statement with these values as ?1, ?2 and ?3. *changed: rows. */
static int change(struct mo_connection *writer, const char *sql, int64_t first, int64_t second,
                  int64_t third, int *changed)
{
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  for (int i = 0; i < sqlite3_bind_parameter_count(statement); i++)
    sqlite3_bind_int64(statement, i + 1, i == 0 ? first : i == 1 ? second : third);
  error = mo_sql_run(writer, statement);
  *changed = sqlite3_changes(writer->db);
  return error;
}

/* ---- its members ---- */

/* What the set has. *n: rows; *n_known: those with the constant's environment, by hash or by data.
 */
static int read_members(struct mo_connection *writer, struct putting_right *call, int64_t set,
                        unsigned *n, unsigned *n_known)
{
  static const char sql[] =
      "SELECT m.position,m.environment,e.sha256,e.data FROM environment_set_members m LEFT JOIN"
      " environments e ON e.id=m.environment WHERE m.environment_set=?1 ORDER BY m.position";
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  *n = *n_known = 0;
  memset(call->members, 0, sizeof(call->members));
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, set);
  for (; (step = mo_sql_step(writer, statement)) > 0; (*n)++) {
    const int64_t k = sqlite3_column_int64(statement, 0);
    const void *data = sqlite3_column_blob(statement, 3);
    struct mo_sha256 sha256, of_data;
    if (k < 0 || k >= MO_PAPER_TEST_COUNT || sqlite3_column_type(statement, 3) == SQLITE_NULL)
      continue;
    const bool hashed = mo_column_hash(statement, 2, &sha256) == MO_OK;
    const bool known_hash = hashed && mo_sha256_equal(&sha256, &call->sha256[k]);
    const bool known_data = data != NULL &&
                            sqlite3_column_bytes(statement, 3) == MO_ENVIRONMENT_BYTES &&
                            memcmp(data, call->data[k], MO_ENVIRONMENT_BYTES) == 0;
    mo_sha256_of(data, (size_t)sqlite3_column_bytes(statement, 3), &of_data);
    call->members[k].is_known = known_hash || known_data;
    /* One that is whole and another is somebody else's: only the reference can be wrong. */
    if (call->members[k].is_known || !hashed || !mo_sha256_equal(&sha256, &of_data))
      call->members[k].row = sqlite3_column_int64(statement, 1);
    *n_known += call->members[k].is_known;
  }
  return step;
}

/* Gives the environment at a position its hash and data. row: where it is, or the row that it had;
 * 0: none, it is made. */
static int put_environment(struct mo_connection *writer, struct putting_right *call, unsigned k,
                           int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM environments WHERE sha256=?1";
  static const char hash_sql[] = "UPDATE environments SET sha256=?2 WHERE id=?1";
  static const char data_sql[] = "UPDATE environments SET data=?2 WHERE id=?1 AND data<>?2";
  const int64_t before = *row;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, find_sql, &error);
  if (statement == NULL)
    return error;
  mo_bind_hash(statement, 1, &call->sha256[k]);
  error = mo_sql_integer(writer, statement, row);
  if (error == MO_ERR_NOT_FOUND && before == 0)
    return mo_environment_row(writer, &call->environments[k], row);
  if (error == MO_ERR_NOT_FOUND) {
    statement = mo_sql(writer, hash_sql, &error);
    if (statement == NULL)
      return error;
    *row = before;
    sqlite3_bind_int64(statement, 1, *row);
    mo_bind_hash(statement, 2, &call->sha256[k]);
    error = mo_sql_run(writer, statement);
    (void)sqlite3_clear_bindings(statement);
    tell(call, "environments.sha256 of row %lld", (long long)*row);
  }
  statement = error == MO_OK ? mo_sql(writer, data_sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, *row);
  sqlite3_bind_blob(statement, 2, call->data[k], MO_ENVIRONMENT_BYTES, SQLITE_STATIC);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  if (error == MO_OK && sqlite3_changes(writer->db) > 0)
    tell(call, "environments.data of row %lld", (long long)*row);
  return error;
}

static int put_member(struct mo_connection *writer, struct putting_right *call, int64_t set,
                      unsigned k)
{
  static const char sql[] =
      "INSERT INTO environment_set_members(environment_set,position,environment) VALUES(?1,?2,?3)"
      " ON CONFLICT DO UPDATE SET environment=excluded.environment WHERE"
      " environment<>excluded.environment";
  int64_t row = call->members[k].row;
  int changed = 0;
  int error = put_environment(writer, call, k, &row);
  if (error == MO_OK)
    error = change(writer, sql, set, k, row, &changed);
  if (error == MO_OK && changed > 0 && call->is_there)
    tell(call, "environment_set_members.environment of set %lld and position %u", (long long)set,
         k);
  return error;
}

/* ---- the set ---- */

static int make_set(struct mo_connection *writer, int64_t *set)
{
  static const char sql[] = "INSERT INTO environment_sets(name,n) VALUES('" NAME "',?1)";
  int changed = 0;
  int error = change(writer, sql, MO_PAPER_TEST_COUNT, 0, 0, &changed);
  *set = sqlite3_last_insert_rowid(writer->db);
  return error;
}

/* The set whose name is damaged, if there is one: it gets its name back. MO_ERR_NOT_FOUND. */
static int find_named_otherwise(struct mo_connection *writer, struct putting_right *call,
                                int64_t *set)
{
  static const char find_sql[] =
      "SELECT id FROM environment_sets ORDER BY id LIMIT 1"; /* no other is ever made */
  static const char name_sql[] = "UPDATE environment_sets SET name='" NAME "' WHERE id=?1";
  unsigned n = 0, n_known = 0;
  int changed = 0;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, find_sql, &error);
  if (statement == NULL)
    return error;
  error = mo_sql_integer(writer, statement, set);
  if (error == MO_OK)
    error = read_members(writer, call, *set, &n, &n_known);
  if (error == MO_OK && (n_known == 0 || n_known * 2 < n))
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK)
    error = change(writer, name_sql, *set, 0, 0, &changed);
  if (error == MO_OK)
    tell(call, "environment_sets.name of row %lld", (long long)*set);
  return error;
}

/* Members whose set is lost: a row has its number by which they name it. 0: there are none. */
static int find_lost(struct mo_connection *writer, int64_t *set)
{
  static const char sql[] =
      "SELECT environment_set FROM environment_set_members WHERE environment_set NOT IN (SELECT id"
      " FROM environment_sets) LIMIT 1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement != NULL)
    error = mo_sql_integer(writer, statement, set);
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

/* Its number, its size, and no members beyond that, nor of sets that there are not: no reply could
 * say whose they are. */
static int put_set(struct mo_connection *writer, struct putting_right *call, int64_t found,
                   int64_t set)
{
  static const char row_sql[] = "UPDATE environment_sets SET id=?2 WHERE id=?1 AND id<>?2";
  static const char n_sql[] = "UPDATE environment_sets SET n=?2 WHERE id=?1 AND n<>?2";
  static const char others_sql[] =
      "DELETE FROM environment_set_members WHERE environment_set=?1 AND position NOT"
      " BETWEEN 0 AND ?2-1";
  static const char strays_sql[] =
      "DELETE FROM environment_set_members WHERE environment_set NOT IN (SELECT id FROM"
      " environment_sets)";
  int changed = 0;
  int error = change(writer, row_sql, found, set, 0, &changed);
  if (error == MO_OK && changed > 0)
    tell(call, "environment_sets.id of row %lld", (long long)set);
  if (error == MO_OK)
    error = change(writer, n_sql, set, MO_PAPER_TEST_COUNT, 0, &changed);
  if (error == MO_OK && changed > 0)
    tell(call, "environment_sets.n of row %lld", (long long)set);
  if (error == MO_OK)
    error = change(writer, others_sql, set, MO_PAPER_TEST_COUNT, 0, &changed);
  if (error == MO_OK && changed > 0)
    tell(call, "environment_set_members.position of set %lld", (long long)set);
  if (error == MO_OK)
    error = change(writer, strays_sql, 0, 0, 0, &changed);
  if (error == MO_OK && changed > 0)
    tell(call, "environment_set_members.environment_set of %d rows", changed);
  return error;
}

static int put_right(struct mo_store *store, void *arguments)
{
  struct putting_right *call = arguments;
  struct mo_connection *writer = &store->writer;
  unsigned n = 0, n_known = 0;
  int64_t found = 0, set = 0, lost = 0, size = 0;
  call->words[0] = '\0';
  int error = mo_environment_set_find(writer, NAME, &found, &size);
  if (error == MO_ERR_NOT_FOUND)
    error = find_named_otherwise(writer, call, &found);
  call->is_there = error == MO_OK;
  if (error == MO_ERR_NOT_FOUND)
    error = make_set(writer, &found);
  set = found;
  if (error == MO_OK)
    error = read_members(writer, call, set, &n, &n_known);
  if (error == MO_OK && n == 0 && call->is_there)
    error = find_lost(writer, &lost);
  if (error == MO_OK && lost != 0)
    error = read_members(writer, call, set = lost, &n, &n_known);
  if (error != MO_OK || n_known * 2 < n)
    return error;
  if (!call->is_there && n > 0) { /* made again: its members had outlived it */
    call->is_there = true;
    tell(call, "environment_sets.name of row %lld", (long long)set);
  }
  error = put_set(writer, call, found, set);
  for (unsigned k = 0; k < MO_PAPER_TEST_COUNT && error == MO_OK; k++)
    error = put_member(writer, call, set, k);
  return error;
}

int mo_put_paper_test_right(struct mo_store *store)
{
  struct putting_right call = {.words = ""};
  int error;
  mo_environment_paper_test(call.environments);
  for (unsigned k = 0; k < MO_PAPER_TEST_COUNT; k++) {
    mo_encode_environment(&call.environments[k], call.data[k]);
    mo_sha256_of(call.data[k], MO_ENVIRONMENT_BYTES, &call.sha256[k]);
  }
  error = mo_write(store, put_right, &call);
  /* What damaged rows keep from being computed is no reason to keep the rest from being served. */
  if (error == MO_ERR_NO_SPACE && call.is_there)
    error = MO_OK;
  else
    snprintf(store->repairs, sizeof(store->repairs), "%s", call.words);
  return error;
}
