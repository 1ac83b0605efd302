/* readers.c: the pool of connections that read, each in one transaction from its acquisition to its
 * release. The last one is reserved for the scheduler, which therefore never waits for clients. */
#include <stdlib.h>

#include "base/thread.h"
#include "store/internal.h"

static const char commit_sql[] = "COMMIT";

int mo_readers_open(struct mo_store *store)
{
  int error = MO_OK;
  for (uint32_t i = 0; i <= store->n_readers && error == MO_OK; i++) {
    error = mo_connection_open(store, false, &store->readers[i]);
    store->readers[i].store = store;
  }
  return error;
}

static struct mo_connection *acquire(struct mo_store *store, uint32_t first, uint32_t end)
{
  struct mo_connection *found = NULL;
  int error = MO_OK;
  pthread_mutex_lock(&store->readers_mutex);
  while (found == NULL) {
    for (uint32_t i = first; i < end && found == NULL; i++)
      if (!store->readers[i].busy)
        found = &store->readers[i];
    if (found == NULL)
      pthread_cond_wait(&store->reader_free, &store->readers_mutex);
  }
  found->busy = true;
  pthread_mutex_unlock(&store->readers_mutex);
  /* Prepared first, because ending a transaction must not depend on free memory. */
  (void)mo_sql_rows(found, &error, commit_sql);
  found->error = error == MO_OK ? mo_sql_do(found, "BEGIN") : error;
  return found;
}

struct mo_connection *mo_reader_acquire(struct mo_store *store)
{
  return acquire(store, 0, store->n_readers);
}

struct mo_connection *mo_runner_acquire(struct mo_store *store)
{
  return acquire(store, store->n_readers, store->n_readers + 1);
}

void mo_reader_release(struct mo_store *store, struct mo_connection *connection)
{
  mo_sql_reset(connection); /* a statement that is not reset would hold back checkpoints */
  connection->error = MO_OK;
  if (!sqlite3_get_autocommit(connection->db))
    (void)mo_sql_do(connection, commit_sql);
  MO_GUARD(&store->readers_mutex);
  connection->busy = false;
  pthread_cond_broadcast(&store->reader_free);
}

int64_t mo_read_page(struct mo_store *store, const char *sql, struct mo_values values,
                     int (*take)(sqlite3_stmt *statement, void *row), void *rows, size_t row_size)
{
  char *at = rows;
  int64_t n = 0;
  int error = MO_OK;
  if (values.at[values.n - 1].integer > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row = mo_sql_rows_with(reader, &error, sql, values);
  for (; mo_sql_next(reader, row, &error); n++, at += row_size)
    error = take(row, at);
  return error != MO_OK ? error : n;
}

int mo_read_one(struct mo_store *store, const char *sql, struct mo_values values,
                int (*take)(sqlite3_stmt *statement, void *row), void *ret)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row;
  const int error = mo_sql_row_with(reader, &row, sql, values);
  return error == MO_OK ? take(row, ret) : error;
}

int mo_read_integers(struct mo_store *store, const char *sql, struct mo_values values, int n,
                     int64_t *integers)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row;
  const int error = mo_sql_row_with(reader, &row, sql, values);
  for (int i = 0; i < n && error == MO_OK; i++)
    integers[i] = sqlite3_column_int64(row, i);
  return error;
}

void *mo_read_whole(struct mo_store *store, size_t size,
                    int (*load)(struct mo_connection *reader, const void *key, void *ret),
                    const void *key, void (*release)(void *ret), int *error)
{
  void *ret = calloc(1, size);
  if (ret == NULL) {
    *error = MO_ERR_NO_MEMORY;
    return NULL;
  }
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  *error = load(reader, key, ret);
  if (*error == MO_OK)
    return ret;
  release(ret);
  return NULL;
}
