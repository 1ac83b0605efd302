/* processors.c: see processors.h.
 *
 * A cgroup without files counts as one without a limit. Inside a container, /proc often shows a
 * path on the host, while the files of the container's own cgroup are at the top of the mount. The
 * walk up the path ends at the top, and so finds these files. */
#include "base/processors.h"

#include <limits.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

size_t mo_read_numbers(const char *folder, const char *name, long long numbers[2])
{
  char path[PATH_MAX + 32], text[64] = "", *at = text, *end = NULL;
  size_t n = 0;
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

static bool has_controller(char *controllers, const char *wanted)
{
  char *rest = NULL;
  for (char *name = strtok_r(controllers, ",", &rest); name != NULL;
       name = strtok_r(NULL, ",", &rest))
    if (strcmp(name, wanted) == 0)
      return true;
  return false;
}

/* Returns the smallest limit among a cgroup and the cgroups above it. */
static uint64_t least_limit(const char *mount, const char *group, bool is_unified,
                            mo_cgroup_limit *limit_of)
{
  char folder[PATH_MAX];
  uint64_t least = UINT64_MAX;
  const int length = snprintf(folder, sizeof(folder), "%s%s", mount, group);
  if (group[0] != '/' || length < 0 || length >= (int)sizeof(folder))
    return least;
  for (;;) {
    const uint64_t limit = limit_of(folder, is_unified);
    least = limit < least ? limit : least;
    if (strlen(folder) <= strlen(mount))
      return least;
    *strrchr(folder, '/') = '\0';
  }
}

uint64_t mo_cgroups_limit(const char *root, const char *controller, mo_cgroup_limit *limit_of)
{
  char path[PATH_MAX], *line = NULL;
  size_t room = 0;
  uint64_t least = UINT64_MAX;
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
    if (!is_unified && !has_controller(controllers, controller))
      continue;
    snprintf(path, sizeof(path), "%s/sys/fs/cgroup%s%s", root, is_unified ? "" : "/",
             is_unified ? "" : controller);
    const uint64_t limit = least_limit(path, group, is_unified, limit_of);
    least = limit < least ? limit : least;
  }
  free(line);
  fclose(groups);
  return least;
}

static uint64_t quota_of(const char *folder, bool is_unified)
{
  long long quota_us[2], period_us[2];
  if (is_unified) {
    if (mo_read_numbers(folder, "cpu.max", quota_us) != 2) /* "max 100000": no quota */
      return UINT64_MAX;
    period_us[0] = quota_us[1];
  } else if (mo_read_numbers(folder, "cpu.cfs_quota_us", quota_us) != 1 ||
             mo_read_numbers(folder, "cpu.cfs_period_us", period_us) != 1) {
    return UINT64_MAX;
  }
  if (quota_us[0] <= 0 || period_us[0] <= 0)
    return UINT64_MAX;
  return (uint64_t)((quota_us[0] - 1) / period_us[0] + 1);
}

uint32_t mo_quota_processors(const char *root)
{
  const uint64_t processors = mo_cgroups_limit(root, "cpu", quota_of);
  return processors < UINT32_MAX ? (uint32_t)processors : UINT32_MAX;
}

uint32_t mo_processors(void)
{
  cpu_set_t set;
  const bool has_mask = sched_getaffinity(0, sizeof(set), &set) == 0;
  const long n = has_mask ? CPU_COUNT(&set) : sysconf(_SC_NPROCESSORS_ONLN);
  const uint32_t processors = n > 0 ? (uint32_t)n : 1, quota = mo_quota_processors("");
  return quota < processors ? quota : processors;
}
