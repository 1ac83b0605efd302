/* worlds.c: see worlds.h. */
#include "store/worlds.h"

#include <stdlib.h>

#include "store/internal.h"

static int take_environment(sqlite3_stmt *row, void *environment)
{
  return mo_column_environment(row, 0, 1, environment);
}

int mo_store_environment(struct mo_store *store, const struct mo_sha256 *sha256,
                         struct mo_environment *environment)
{
  static const char sql[] = "SELECT data,sha256 FROM environments WHERE sha256=?1";
  return mo_read_one(store, sql, MO_VALUES(mo_hash(sha256)), take_environment, environment);
}

int mo_store_physics(struct mo_store *store, const struct mo_sha256 *sha256,
                     struct mo_physics *physics, enum mo_precision *precision,
                     enum mo_sensor *sensor)
{
  static const char sql[] = "SELECT encoding FROM physics WHERE sha256=?1";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_hash(sha256));
  return error == MO_OK ? mo_column_physics(row, 0, physics, precision, sensor) : error;
}

/* Reads all rows of a query with the columns data and hash. */
static int read_all(struct mo_store *store, const char *sql, struct mo_values values,
                    struct mo_environment **environments, uint32_t *ret_n)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_environment *all = calloc(MO_SUITE_ENVIRONMENTS_MAX, sizeof(*all));
  uint32_t n = 0;
  int error = all != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  sqlite3_stmt *row = mo_sql_rows_with(reader, &error, sql, values);
  while (mo_sql_next(reader, row, &error))
    error = n < MO_SUITE_ENVIRONMENTS_MAX ? mo_column_environment(row, 0, 1, &all[n++])
                                          : MO_ERR_CORRUPT;
  if (error == MO_OK && n == 0)
    error = MO_ERR_NOT_FOUND;
  if (error != MO_OK) {
    mo_environments_free(all, n);
    return error;
  }
  *environments = all;
  *ret_n = n;
  return MO_OK;
}

int mo_store_environment_set(struct mo_store *store, const char *name,
                             struct mo_environment **environments, uint32_t *n)
{
  static const char sql[] =
      "SELECT e.data,e.sha256 FROM environment_sets s JOIN environment_set_members m"
      " ON m.environment_set=s.id JOIN environments e ON e.id=m.environment"
      " WHERE s.name=?1 ORDER BY m.position";
  return read_all(store, sql, MO_VALUES(mo_string(name)), environments, n);
}

int mo_store_job_environments(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                              struct mo_environment **environments, uint32_t *n)
{
  /* Replicates share the environments of the first of them. */
  static const char sql[] =
      "SELECT e.data,e.sha256 FROM jobs j LEFT JOIN campaigns c ON c.job=j.id"
      " JOIN job_environments x ON x.job=coalesce(c.replicates_of,j.id)"
      " JOIN environments e ON e.id=x.environment WHERE j.id=?1 AND j.kind=?2 AND j.state<>6"
      " ORDER BY x.position";
  return read_all(store, sql, MO_VALUES(mo_int(id), mo_int(kind)), environments, n);
}
