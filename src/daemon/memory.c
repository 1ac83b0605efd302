/* memory.c: see memory.h. */
#include "memory.h"

#include <stdarg.h>
#include <stdio.h>
#include <sys/resource.h>
#include <unistd.h>

#include "base/processors.h"
#include "daemon/log.h"
#include "daemon/service.h"

#define MARGIN   (UINT64_C(64) << 20)
#define LEAST    (UINT64_C(128) << 20) /* the service itself takes half of this */
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

void *enough(void *memory)
{
  static const char text[] = "morphod: out of memory\n";
  if (memory != NULL)
    return memory;
  log_last_words(text, sizeof(text) - 1);
  _exit(EXIT_SYSTEM);
}

char *format_text(const char *format, ...)
{
  char *text = NULL;
  va_list arguments;
  va_start(arguments, format);
  const int n = vasprintf(&text, format, arguments);
  va_end(arguments);
  return enough(n < 0 ? NULL : text);
}
