/* credible.c: see credible.h.
 *
 * If the clock were a year ahead, the service would at once delete everything that must be kept for
 * a year. Therefore, the database stores the newest time at which the clock was credible. The clock
 * may be ahead of that time by the time that the process has run since, plus a day, or plus a tenth
 * of the shortest retention time if that is longer: the service may have been off, or the computer
 * may have slept, while mo_clock_us stood still. If it is further ahead, an operator must confirm
 * it (mo_store_accept_clock). The times of events and jobs are not used, because a wrong clock
 * makes them wrong; only a database without a credible time starts from the newest of these
 * times. */
#include "store/credible.h"

#include "base/clock.h"

#define DAY_US  (INT64_C(86400) * 1000000)
#define HOUR_US (INT64_C(3600) * 1000000)

static int store_time(struct mo_store *store, int64_t time_us)
{
  static const char sql[] = "INSERT OR REPLACE INTO meta(key,value) VALUES('credible time',?1)";
  const int error = mo_sql_do(&store->writer, sql, mo_int(time_us));
  if (error == MO_OK) {
    store->credible_us = time_us;
    store->credible_at_us = mo_clock_us();
  }
  return error;
}

static int read_time(struct mo_store *store)
{
  static const char kept_sql[] = "SELECT value FROM meta WHERE key='credible time'";
  static const char newest_sql[] = "SELECT max(coalesce((SELECT max(time_us) FROM events),0),"
                                   "coalesce((SELECT max(finished_us) FROM jobs),0))";
  int64_t time_us = 0;
  int error = mo_sql_find(&store->writer, &time_us, kept_sql);
  if (error == MO_OK) {
    store->credible_us = time_us;
    store->credible_at_us = mo_clock_us();
  }
  if (error != MO_ERR_NOT_FOUND)
    return error;
  error = mo_sql_find(&store->writer, &time_us, newest_sql);
  if (time_us == 0) /* the database is empty */
    time_us = mo_clock_wall_us();
  return error == MO_OK ? store_time(store, time_us) : error;
}

/* Returns the shortest retention time of all rules; 0: no rule. */
static int64_t shortest_us(const struct mo_store *store)
{
  int64_t shortest = store->keep_recordings_us;
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    if (store->keep_jobs_us[kind] > 0 && (shortest == 0 || store->keep_jobs_us[kind] < shortest))
      shortest = store->keep_jobs_us[kind];
  return shortest;
}

int mo_clock_check(struct mo_store *store)
{
  const int64_t shortest = shortest_us(store);
  if (shortest == 0)
    return MO_OK;
  const int error = store->credible_at_us == 0 ? read_time(store) : MO_OK;
  if (error != MO_OK)
    return error;
  const int64_t now = mo_clock_wall_us();
  const int64_t expected = store->credible_us + (mo_clock_us() - store->credible_at_us);
  const bool is_credible = now - expected <= (shortest / 10 > DAY_US ? shortest / 10 : DAY_US);
  const int64_t time_us = is_credible ? now : expected;
  atomic_store(&store->clock_ahead_us, is_credible ? 0 : now - expected);
  return time_us >= store->credible_us + HOUR_US ? store_time(store, time_us) : MO_OK;
}

bool mo_clock_is_credible(struct mo_store *store)
{
  return store->credible_at_us != 0 && atomic_load(&store->clock_ahead_us) == 0;
}

static int accept_clock(struct mo_store *store, void *arguments)
{
  (void)arguments;
  return store_time(store, mo_clock_wall_us());
}

int mo_store_accept_clock(struct mo_store *store)
{
  return mo_write(store, accept_clock, NULL);
}
