/* events.c: the durable sequence of events. */
#include <stdlib.h>
#include <string.h>

#include "store/internal.h"

static int add(struct mo_store *store, void *arguments)
{
  const struct mo_event *event = arguments;
  return mo_writer_event(store, 0, event->type, "%s", event->data);
}

static void free_event(void *arguments, int status)
{
  (void)status;
  free(arguments);
}

int mo_store_event(struct mo_store *store, const char *type, const char *data)
{
  struct mo_event *event = calloc(1, sizeof(*event));
  if (event == NULL)
    return MO_ERR_NO_MEMORY;
  const size_t type_size = strlen(type), data_size = strlen(data);
  int error =
      type_size < sizeof(event->type) && data_size < sizeof(event->data) ? MO_OK : MO_ERR_LIMIT;
  if (error == MO_OK) {
    memcpy(event->type, type, type_size + 1);
    memcpy(event->data, data, data_size + 1);
    error = mo_write_later(store, add, event, free_event);
  }
  if (error != MO_OK)
    free(event);
  return error;
}

int mo_store_event_before(struct mo_store *store, int64_t after, int64_t *sequence)
{
  static const char sql[] = "SELECT coalesce(max(sequence),0) FROM events WHERE sequence<=?1";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return mo_sql_find(reader, sequence, sql, mo_int(after));
}

int64_t mo_store_events(struct mo_store *store, int64_t after, int64_t job, struct mo_event *events,
                        size_t limit, int64_t *oldest, int64_t *newest)
{
  static const char oldest_sql[] = "SELECT coalesce(min(sequence),0) FROM events";
  static const char newest_sql[] = "SELECT coalesce(max(sequence),0) FROM events";
#define EVENTS "SELECT sequence,time_us,job,type,data FROM events WHERE sequence>?1"
  static const char all_sql[] = EVENTS " ORDER BY sequence LIMIT ?2";
  static const char job_sql[] = EVENTS " AND job=?3 ORDER BY sequence LIMIT ?2";
#undef EVENTS
  int64_t first = 0, last = 0, n = 0;
  if (limit > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int error = mo_sql_find(reader, &first, oldest_sql);
  if (error == MO_OK)
    error = mo_sql_find(reader, &last, newest_sql);
  sqlite3_stmt *row = mo_sql_rows(reader, &error, job != 0 ? job_sql : all_sql, mo_int(after),
                                  mo_int((int64_t)limit), mo_int(job));
  while (mo_sql_next(reader, row, &error)) {
    struct mo_event *event = &events[n++];
    event->sequence = sqlite3_column_int64(row, 0);
    event->time_us = sqlite3_column_int64(row, 1);
    event->job = sqlite3_column_int64(row, 2);
    mo_column_text(row, 3, event->type, sizeof(event->type));
    mo_column_text(row, 4, event->data, sizeof(event->data));
  }
  if (error != MO_OK)
    return error;
  if (oldest != NULL)
    *oldest = first;
  if (newest != NULL)
    *newest = last;
  return n;
}
