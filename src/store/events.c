/* events.c: reading the durable sequence of events. */
#include <stdio.h>
#include <string.h>

#include "store/internal.h"

static int range(struct mo_connection *reader, int64_t *oldest, int64_t *newest)
{
  static const char oldest_sql[] = "SELECT coalesce(min(sequence),0) FROM events WHERE sequence>0";
  static const char newest_sql[] =
      "SELECT coalesce(max(sequence),0) FROM events WHERE sequence<=?1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, oldest_sql, &error);
  if (statement != NULL)
    error = mo_sql_integer(reader, statement, oldest);
  statement = error == MO_OK ? mo_sql(reader, newest_sql, &error) : NULL;
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, MO_ID_MAX);
    error = mo_sql_integer(reader, statement, newest);
  }
  return error;
}

static bool is_type(const char *text, size_t length)
{
  static const char *const types[] = {"job.created",
                                      "job.started",
                                      "job.weight",
                                      "job.progress",
                                      "job.paused",
                                      "job.resumed",
                                      "job.requeued",
                                      "job.finished",
                                      "training.progress",
                                      "training.validation",
                                      "training.checkpoint",
                                      "training.code_changed",
                                      "campaign.progress",
                                      "campaign.generation",
                                      "campaign.diversity_collapse",
                                      "campaign.extended",
                                      "campaign.lineage_unreadable",
                                      "controller.stored",
                                      "controller.removed"};
  for (size_t i = 0; i < sizeof(types) / sizeof(types[0]); i++)
    if (strlen(types[i]) == length && memcmp(types[i], text, length) == 0)
      return true;
  return false;
}

static void take(sqlite3_stmt *row, struct mo_event *event)
{
  static const struct mo_column_range ranges[] = {
      {0, "sequence", 1, MO_ID_MAX}, {1, "time_us", 1, MO_TIME_US_MAX}, {2, "job", 0, MO_ID_MAX}};
  const char *type = (const char *)sqlite3_column_text(row, 3);
  event->sequence = sqlite3_column_int64(row, 0);
  event->time_us = sqlite3_column_int64(row, 1);
  event->job = sqlite3_column_int64(row, 2);
  event->damage[0] = '\0';
  if (type == NULL || !is_type(type, (size_t)sqlite3_column_bytes(row, 3)))
    snprintf(event->damage, sizeof(event->damage), "events.type of row %lld is none",
             (long long)event->sequence);
  for (size_t i = 0; i < sizeof(ranges) / sizeof(ranges[0]); i++) {
    const int64_t value = sqlite3_column_int64(row, ranges[i].column);
    if (value < ranges[i].least || value > ranges[i].most)
      snprintf(event->damage, sizeof(event->damage), "events.%s of row %lld is %lld",
               ranges[i].name, (long long)event->sequence, (long long)value);
  }
  mo_column_text(row, 3, event->type, sizeof(event->type));
  mo_column_text(row, 4, event->data, sizeof(event->data));
  if ((size_t)sqlite3_column_bytes(row, 4) >= sizeof(event->data)) /* half of it would be no JSON */
    snprintf(event->data, sizeof(event->data), "{\"unreadable\":\"events.data is too long\"}");
}

static int64_t read_events(struct mo_connection *reader, int64_t after, int64_t job,
                           struct mo_event *events, size_t limit)
{
  static const char all_sql[] = "SELECT sequence,time_us,job,type," MO_JSON_COLUMN(
      "events", "data") " FROM events WHERE sequence>?1 ORDER BY sequence LIMIT ?2";
  static const char job_sql[] = "SELECT sequence,time_us,job,type," MO_JSON_COLUMN(
      "events", "data") " FROM events WHERE job=?3 AND sequence>?1 ORDER BY sequence LIMIT ?2";
  int error = MO_OK;
  int64_t n = 0;
  int step;
  sqlite3_stmt *statement = mo_sql(reader, job != 0 ? job_sql : all_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, after);
  sqlite3_bind_int64(statement, 2, (sqlite3_int64)limit);
  if (job != 0)
    sqlite3_bind_int64(statement, 3, job);
  while ((step = mo_sql_step(reader, statement)) > 0)
    take(statement, &events[n++]);
  return step < 0 ? step : n;
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
