/* processors.c: see processors.h.
 *
 * A cgroup whose files are not found counts as one without a quota. Inside a container /proc often
 * names a path of the host, while the files of the container's own cgroup are at the top of the
 * mount. The walk up the path ends there and finds them. */
#include "base/processors.h"

#include <limits.h>
#include <sched.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

/* Reads up to two numbers from the start of a file; returns how many it found. */
static int read_numbers(const char *folder, const char *name, long long numbers[2])
{
  char path[PATH_MAX + 32], text[64] = "", *at = text, *end = NULL;
  int n = 0;
  snprintf(path, sizeof(path), "%s/%s", folder, name);
  FILE *file = fopen(path, "re");
  if (file == NULL)
    return 0;
  if (fgets(text, sizeof(text), file) == NULL)
    text[0] = '\0';
  fclose(file);
  for (; n < 2; n++, at = end) {
    numbers[n] = strtoll(at, &end, 10);
    if (end == at)
      break;
  }
  return n;
}

static uint32_t quota_of(const char *folder, bool is_unified)
{
  long long quota_us[2], period_us[2];
  if (is_unified) {
    if (read_numbers(folder, "cpu.max", quota_us) != 2) /* "max 100000": no quota */
      return UINT32_MAX;
    period_us[0] = quota_us[1];
  } else if (read_numbers(folder, "cpu.cfs_quota_us", quota_us) != 1 ||
             read_numbers(folder, "cpu.cfs_period_us", period_us) != 1) {
    return UINT32_MAX;
  }
  if (quota_us[0] <= 0 || period_us[0] <= 0)
    return UINT32_MAX;
  const long long processors = (quota_us[0] - 1) / period_us[0] + 1;
  return processors < UINT32_MAX ? (uint32_t)processors : UINT32_MAX;
}

/* Returns the smallest quota of a cgroup and those above it. */
static uint32_t least_quota(const char *mount, const char *group, bool is_unified)
{
  char folder[PATH_MAX];
  uint32_t least = UINT32_MAX;
  const int length = snprintf(folder, sizeof(folder), "%s%s", mount, group);
  if (group[0] != '/' || length < 0 || length >= (int)sizeof(folder))
    return least;
  for (;;) {
    const uint32_t quota = quota_of(folder, is_unified);
    least = quota < least ? quota : least;
    if (strlen(folder) <= strlen(mount))
      return least;
    *strrchr(folder, '/') = '\0';
  }
}

static bool has_cpu(char *controllers)
{
  char *rest = NULL;
  for (char *name = strtok_r(controllers, ",", &rest); name != NULL;
       name = strtok_r(NULL, ",", &rest))
    if (strcmp(name, "cpu") == 0)
      return true;
  return false;
}

uint32_t mo_quota_processors(const char *root)
{
  char path[PATH_MAX], *line = NULL;
  size_t room = 0;
  uint32_t least = UINT32_MAX;
  snprintf(path, sizeof(path), "%s/proc/self/cgroup", root);
  FILE *groups = fopen(path, "re");
  if (groups == NULL)
    return least;
  while (getline(&line, &room, groups) >
         0) { /* "0::/path" of version 2, "3:cpu,cpuacct:/path" of version 1 */
    char *controllers = strchr(line, ':');
    char *group = controllers != NULL ? strchr(++controllers, ':') : NULL;
    if (group == NULL)
      continue;
    *group++ = '\0';
    group[strcspn(group, "\n")] = '\0';
    const bool is_unified = *controllers == '\0';
    if (!is_unified && !has_cpu(controllers))
      continue;
    snprintf(path, sizeof(path), "%s/sys/fs/cgroup%s", root, is_unified ? "" : "/cpu");
    const uint32_t quota = least_quota(path, group, is_unified);
    least = quota < least ? quota : least;
  }
  free(line);
  fclose(groups);
  return least;
}

uint32_t mo_processors(void)
{
  cpu_set_t set;
  const bool has_mask = sched_getaffinity(0, sizeof(set), &set) == 0;
  const long n = has_mask ? CPU_COUNT(&set) : sysconf(_SC_NPROCESSORS_ONLN);
  const uint32_t processors = n > 0 ? (uint32_t)n : 1, quota = mo_quota_processors("");
  return quota < processors ? quota : processors;
}
