/* readers.c: the pool of connections that read, and pages of rows. */
#include "store/internal.h"

int mo_readers_open(struct mo_store *store)
{
  int error = mo_connection_open(store, false, &store->runner);
  for (uint32_t i = 0; i < store->n_readers && error == MO_OK; i++)
    error = mo_connection_open(store, false, &store->readers[i]);
  return error;
}

struct mo_connection *mo_reader_acquire(struct mo_store *store)
{
  struct mo_connection *found = NULL;
  pthread_mutex_lock(&store->readers_mutex);
  while (found == NULL) {
    for (uint32_t i = 0; i < store->n_readers && found == NULL; i++)
      if (!store->readers[i].busy)
        found = &store->readers[i];
    if (found == NULL)
      pthread_cond_wait(&store->reader_free, &store->readers_mutex);
  }
  found->busy = true;
  pthread_mutex_unlock(&store->readers_mutex);
  return found;
}

void mo_reader_release(struct mo_store *store, struct mo_connection *connection)
{
  /* A statement that was not reset would hold back checkpoints. */
  for (unsigned i = 0; i < connection->n_cached; i++)
    (void)sqlite3_reset(connection->cache[i].statement);
  if (!sqlite3_get_autocommit(connection->db))
    (void)mo_sql_exec(connection, "COMMIT");
  pthread_mutex_lock(&store->readers_mutex);
  connection->busy = false;
  pthread_cond_signal(&store->reader_free);
  pthread_mutex_unlock(&store->readers_mutex);
}

int64_t mo_read_each(struct mo_store *store, const char *sql, struct mo_values values,
                     int (*take)(sqlite3_stmt *statement, void *context), void *context)
{
  struct mo_connection *reader;
  int64_t n;
  if (values.at[values.n - 1].integer > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  reader = mo_reader_acquire(store);
  n = mo_sql_each_with(reader, take, context, sql, values);
  mo_reader_release(store, reader);
  return n;
}

struct page {
  int (*take)(sqlite3_stmt *statement, void *row);
  char *row;
  size_t row_size;
};

static int take_row(sqlite3_stmt *statement, void *any)
{
  struct page *page = any;
  const int error = page->take(statement, page->row);
  page->row += page->row_size;
  return error;
}

int64_t mo_read_page(struct mo_store *store, const char *sql, struct mo_values values,
                     int (*take)(sqlite3_stmt *statement, void *row), void *rows, size_t row_size)
{
  return mo_read_each(store, sql, values, take_row, &(struct page){take, rows, row_size});
}
