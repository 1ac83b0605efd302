/* processors.h: how many processors this process can keep busy. */
#ifndef MORPHO_BASE_PROCESSORS_H
#define MORPHO_BASE_PROCESSORS_H

#include <stdint.h>

/* Returns the smaller of the processors in the affinity mask and those that the CPU quotas of the
 * process's cgroups pay for; at least 1. */
uint32_t mo_processors(void);
/* Returns the smallest quota divided by its period, rounded up, of the process's cgroup and all
 * cgroups above it (`cpu.max` of version 2, `cpu.cfs_quota_us` of version 1). UINT32_MAX: no quota.
 * root: prefix of /proc and /sys; "" except in tests. */
uint32_t mo_quota_processors(const char *root);

#endif
