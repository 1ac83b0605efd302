/* credible.c: see credible.h.
 *
 * A clock that is wrong by a year would delete at once what is to be kept for a year. So the
 * database has the newest time at which the clock was credible. The clock may be ahead of that by
 * the time for which the process has run, and a day, or a tenth of the time to keep if that is
 * longer: a service that was off for a while. Beyond that a person must look
 * (mo_store_accept_clock). The times of events and jobs are not asked: a wrong clock makes wrong
 * ones. Only a database that has no such time yet begins with the newest of them. */
#include "store/credible.h"

#include "base/clock.h"

#define DAY_US  (INT64_C(86400) * 1000000)
#define HOUR_US (INT64_C(3600) * 1000000)

static int store_time(struct mo_store *store, int64_t time_us)
{
  static const char sql[] = "INSERT OR REPLACE INTO meta(key,value) VALUES('credible time',?1)";
  return mo_sql_do(&store->writer, sql, mo_int(time_us));
}

static int64_t ahead_us(const struct mo_store *store)
{
  return mo_clock_wall_us() - store->credible_us - (mo_clock_us() - store->credible_at_us);
}

int mo_clock_look(struct mo_store *store)
{
  static const char kept_sql[] = "SELECT value FROM meta WHERE key='credible time'";
  static const char newest_sql[] = "SELECT max(coalesce((SELECT max(time_us) FROM events),0),"
                                   "coalesce((SELECT max(finished_us) FROM jobs),0))";
  int error = MO_OK;
  if (store->credible_at_us == 0) {
    int64_t time_us = 0;
    error = mo_sql_find(&store->writer, &time_us, kept_sql);
    if (error == MO_ERR_NOT_FOUND) {
      error = mo_sql_find(&store->writer, &time_us, newest_sql);
      if (time_us == 0) /* there is nothing yet */
        time_us = mo_clock_wall_us();
      if (error == MO_OK)
        error = store_time(store, time_us);
    }
    if (error != MO_OK)
      return error;
    store->credible_us = time_us;
    store->credible_at_us = mo_clock_us();
  }
  const int64_t now = mo_clock_wall_us();
  if (ahead_us(store) > DAY_US)
    return MO_OK;
  atomic_store(&store->clock_ahead_us, 0);
  if (now < store->credible_kept_us + HOUR_US)
    return MO_OK;
  error = store_time(store, now > store->credible_us ? now : store->credible_us);
  if (error == MO_OK)
    store->credible_kept_us = now;
  return error;
}

bool mo_clock_is_credible(struct mo_store *store, int64_t keep_us)
{
  const int64_t ahead = ahead_us(store);
  const bool is_credible = ahead <= (keep_us / 10 > DAY_US ? keep_us / 10 : DAY_US);
  if (!is_credible)
    atomic_store(&store->clock_ahead_us, ahead);
  return is_credible;
}

static int accept_clock(struct mo_store *store, void *arguments)
{
  (void)arguments;
  store->credible_us = mo_clock_wall_us();
  store->credible_at_us = mo_clock_us();
  return store_time(store, store->credible_us);
}

int mo_store_accept_clock(struct mo_store *store)
{
  return mo_write(store, accept_clock, NULL);
}
