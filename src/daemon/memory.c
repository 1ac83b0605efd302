/* memory.c: see memory.h. */
#include "memory.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <unistd.h>

#define MARGIN   (UINT64_C(64) << 20)
#define LEAST    (UINT64_C(128) << 20) /* the service itself takes half of it */
#define RESERVED (UINT64_C(1) << 30)   /* address space of stacks and heaps that is never used */

static uint64_t lesser(uint64_t a, uint64_t b)
{
  return a < b ? a : b;
}

static uint64_t read_number(const char *path)
{
  char text[32] = "", *end = text;
  FILE *file = fopen(path, "re");
  uint64_t number;
  if (file == NULL)
    return UINT64_MAX;
  number = fgets(text, sizeof(text), file) != NULL ? strtoull(text, &end, 10) : 0;
  fclose(file);
  return end != text ? number : UINT64_MAX; /* "max" */
}

/* Returns the least limit of the process's cgroup and all visible cgroups above it; in a container
 * the visible root is the container's. */
static uint64_t cgroup_limit(const char *root, char *path, const char *name)
{
  uint64_t limit = UINT64_MAX;
  char file[4096];
  for (;;) {
    char *slash = strrchr(path, '/');
    if (snprintf(file, sizeof(file), "%s%s/%s", root, path, name) < (int)sizeof(file))
      limit = lesser(limit, read_number(file));
    if (slash == NULL)
      return limit;
    *slash = '\0';
  }
}

/* Reads the lines of /proc/self/cgroup: "0::/path" in version 2, "4:memory:/path" in version 1. */
static uint64_t cgroups_limit(void)
{
  uint64_t limit = UINT64_MAX;
  char line[2048];
  FILE *file = fopen("/proc/self/cgroup", "re");
  while (file != NULL && fgets(line, sizeof(line), file) != NULL) {
    char *controllers = strchr(line, ':'),
         *path = controllers != NULL ? strchr(controllers + 1, ':') : NULL;
    if (path == NULL)
      continue;
    *path++ = '\0';
    path[strcspn(path, "\n")] = '\0';
    if (controllers[1] == '\0')
      limit = lesser(limit, cgroup_limit("/sys/fs/cgroup", path, "memory.max"));
    else if (strstr(controllers, "memory") != NULL)
      limit = lesser(limit, cgroup_limit("/sys/fs/cgroup/memory", path, "memory.limit_in_bytes"));
  }
  if (file != NULL)
    fclose(file);
  return limit;
}

uint64_t memory_limit(void)
{
  const long pages = sysconf(_SC_PHYS_PAGES), size = sysconf(_SC_PAGESIZE);
  struct rlimit space;
  uint64_t limit = pages > 0 && size > 0 ? (uint64_t)pages * (uint64_t)size : UINT64_MAX;
  limit = lesser(limit, cgroups_limit());
  if (getrlimit(RLIMIT_AS, &space) == 0 && space.rlim_cur != RLIM_INFINITY)
    limit = lesser(limit, space.rlim_cur > RESERVED ? space.rlim_cur - RESERVED : 0);
  limit -= lesser(limit / 2, limit / 8 > MARGIN ? limit / 8 : MARGIN);
  return limit > LEAST ? limit : LEAST;
}
