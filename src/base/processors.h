/* processors.h: the number of CPUs that this process can keep busy, and the limits of its
 * cgroups. */
#ifndef MORPHO_BASE_PROCESSORS_H
#define MORPHO_BASE_PROCESSORS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Returns the number of CPUs in the affinity mask, or fewer if a CPU quota of the process's cgroups
 * allows only that; at least 1. */
uint32_t mo_processors(void);
/* Returns the smallest quota divided by its period, rounded up, among the process's cgroup and all
 * cgroups above it (`cpu.max` of version 2, `cpu.cfs_quota_us` of version 1). Returns UINT32_MAX if
 * there is no quota. root: prefix of /proc and /sys; "" except in tests. */
uint32_t mo_quota_processors(const char *root);

/* Returns the smallest limit that `limit_of` finds in the folders of the process's cgroups and all
 * visible cgroups above them, both of version 2 (unified) and of version 1's `controller`. Returns
 * UINT64_MAX if there is no limit. */
typedef uint64_t mo_cgroup_limit(const char *folder, bool is_unified);
uint64_t mo_cgroups_limit(const char *root, const char *controller, mo_cgroup_limit *limit_of);
/* Reads up to two numbers from the start of a file; returns how many it read. */
size_t mo_read_numbers(const char *folder, const char *name, long long numbers[2]);

#endif
