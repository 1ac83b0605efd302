/* clock.c: see clock.h. */
#include "base/clock.h"

#include <time.h>

static int64_t read_ns(clockid_t clock)
{
  struct timespec now;
  clock_gettime(clock, &now);
  return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

uint64_t mo_clock_ns(void)
{
  return (uint64_t)read_ns(CLOCK_MONOTONIC);
}

uint64_t mo_clock_thread_ns(void)
{
  return (uint64_t)read_ns(CLOCK_THREAD_CPUTIME_ID);
}

int64_t mo_clock_us(void)
{
  return read_ns(CLOCK_MONOTONIC) / 1000;
}

int64_t mo_clock_wall_us(void)
{
  return read_ns(CLOCK_REALTIME) / 1000;
}
