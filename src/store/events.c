/* events.c: reads the durable sequence of events. */
#include "store/internal.h"

static int range(struct mo_connection *reader, int64_t *oldest, int64_t *newest)
{
  static const char oldest_sql[] = "SELECT coalesce(min(sequence),0) FROM events";
  static const char newest_sql[] = "SELECT coalesce(max(sequence),0) FROM events";
  const int error = mo_sql_find_with(reader, oldest, oldest_sql, (struct mo_values){NULL, 0});
  return error == MO_OK ? mo_sql_find_with(reader, newest, newest_sql, (struct mo_values){NULL, 0})
                        : error;
}

static int take(sqlite3_stmt *row, void *any)
{
  struct mo_event **next = any, *event = (*next)++;
  event->sequence = sqlite3_column_int64(row, 0);
  event->time_us = sqlite3_column_int64(row, 1);
  event->job = sqlite3_column_int64(row, 2);
  mo_column_text(row, 3, event->type, sizeof(event->type));
  mo_column_text(row, 4, event->data, sizeof(event->data));
  /* Half of it would be no JSON. */
  return (size_t)sqlite3_column_bytes(row, 4) < sizeof(event->data) ? MO_OK : MO_ERR_CORRUPT;
}

static int64_t read_events(struct mo_connection *reader, int64_t after, int64_t job,
                           struct mo_event *events, size_t limit)
{
  static const char all_sql[] = "SELECT sequence,time_us,job,type,data FROM events WHERE "
                                "sequence>?1 ORDER BY sequence LIMIT ?2";
  static const char job_sql[] = "SELECT sequence,time_us,job,type,data FROM events WHERE job=?3 "
                                "AND sequence>?1 ORDER BY sequence LIMIT ?2";
  return mo_sql_each(reader, take, &events, job != 0 ? job_sql : all_sql, mo_int(after),
                     mo_int((int64_t)limit), mo_int(job));
}

int64_t mo_store_events(struct mo_store *store, int64_t after, int64_t job, struct mo_event *events,
                        size_t limit, int64_t *oldest, int64_t *newest)
{
  struct mo_connection *reader;
  int64_t first = 0, last = 0, n = 0;
  int error;
  if (limit > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  reader = mo_reader_acquire(store);
  error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = range(reader, &first, &last);
  if (error == MO_OK)
    n = read_events(reader, after, job, events, limit);
  mo_reader_release(store, reader);
  if (error != MO_OK)
    return error;
  if (n >= 0 && oldest != NULL)
    *oldest = first;
  if (n >= 0 && newest != NULL)
    *newest = last;
  return n;
}
