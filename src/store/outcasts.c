/* outcasts.c: see outcasts.h. They are few and change rarely: each change writes all. */
#include "store/outcasts.h"

#include "store/internal.h"

int64_t mo_store_outcasts(struct mo_store *store, struct mo_outcast *items, size_t limit)
{
  static const char sql[] =
      "SELECT user,name,host,why,since_us FROM outcasts ORDER BY since_us,user,name";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  int64_t n = 0;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql);
  while (n < (int64_t)limit && mo_sql_next(reader, row, &error)) {
    struct mo_outcast *item = &items[n++];
    mo_column_text(row, 0, item->user, sizeof(item->user));
    mo_column_text(row, 1, item->name, sizeof(item->name));
    mo_column_text(row, 2, item->host, sizeof(item->host));
    mo_column_text(row, 3, item->why, sizeof(item->why));
    item->since_us = sqlite3_column_int64(row, 4);
  }
  return error != MO_OK ? error : n;
}

struct replacing {
  const struct mo_outcast *items;
  size_t n;
};

static int replace(struct mo_store *store, void *arguments)
{
  static const char sql[] = "INSERT INTO outcasts VALUES(?1,?2,?3,?4,?5)";
  const struct replacing *call = arguments;
  int error = mo_sql_do(&store->writer, "DELETE FROM outcasts");
  for (size_t i = 0; i < call->n && error == MO_OK; i++) {
    const struct mo_outcast *item = &call->items[i];
    error = mo_sql_do(&store->writer, sql, mo_string(item->user), mo_string(item->name),
                      mo_string(item->host), mo_string(item->why), mo_int(item->since_us));
  }
  return error;
}

int mo_store_set_outcasts(struct mo_store *store, const struct mo_outcast *items, size_t n)
{
  return mo_write_urgent(store, replace, &(struct replacing){items, n});
}
