/* memory.c: see memory.h. */
#include "memory.h"

#include <sys/resource.h>
#include <unistd.h>

#include "base/processors.h"

#define MARGIN   (UINT64_C(64) << 20)
#define LEAST    (UINT64_C(128) << 20) /* the service itself takes half of it */
#define RESERVED (UINT64_C(1) << 30)   /* address space of stacks and heaps that is never used */

static uint64_t lesser(uint64_t a, uint64_t b)
{
  return a < b ? a : b;
}

static uint64_t limit_of(const char *folder, bool is_unified)
{
  long long bytes[2];
  const char *name = is_unified ? "memory.max" : "memory.limit_in_bytes"; /* "max": no limit */
  return mo_read_numbers(folder, name, bytes) > 0 ? (uint64_t)bytes[0] : UINT64_MAX;
}

uint64_t memory_limit(void)
{
  const long pages = sysconf(_SC_PHYS_PAGES), size = sysconf(_SC_PAGESIZE);
  struct rlimit space;
  uint64_t limit = pages > 0 && size > 0 ? (uint64_t)pages * (uint64_t)size : UINT64_MAX;
  limit = lesser(limit, mo_cgroups_limit("", "memory", limit_of));
  if (getrlimit(RLIMIT_AS, &space) == 0 && space.rlim_cur != RLIM_INFINITY)
    limit = lesser(limit, space.rlim_cur > RESERVED ? space.rlim_cur - RESERVED : 0);
  limit -= lesser(limit / 2, limit / 8 > MARGIN ? limit / 8 : MARGIN);
  return limit > LEAST ? limit : LEAST;
}
