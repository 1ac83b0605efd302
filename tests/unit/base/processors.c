/* processors.c: CPU quotas of cgroups, read from trees of files like the kernel's. */
#include "../check.h"

#include "base/processors.h"

#include <ftw.h>
#include <sys/stat.h>
#include <unistd.h>

static char root[] = "/tmp/morpho-processors-XXXXXX";

/* Writes a file below the root, and creates its folders. */
static void put(const char *name, const char *text)
{
  char path[256];
  snprintf(path, sizeof(path), "%s/%s", root, name);
  for (char *slash = path + sizeof(root); (slash = strchr(slash, '/')) != NULL; *slash++ = '/') {
    *slash = '\0';
    (void)mkdir(path, 0700);
  }
  FILE *file = fopen(path, "w");
  if (file == NULL || fputs(text, file) < 0 || fclose(file) != 0)
    check_failures++;
}

static int erase(const char *path, const struct stat *status, int type, struct FTW *position)
{
  (void)status, (void)type, (void)position;
  return remove(path);
}

static void end(void)
{
  if (nftw(root, erase, 8, FTW_DEPTH | FTW_PHYS) != 0)
    check_failures++;
}

/* Each case starts with an empty tree. */
static void begin(void)
{
  if (access(root, F_OK) == 0)
    end();
  snprintf(root, sizeof(root), "/tmp/morpho-processors-XXXXXX");
  if (mkdtemp(root) == NULL)
    check_failures++;
}

static void none(void)
{
  begin();
  CHECK_INT(mo_quota_processors(root), UINT32_MAX); /* no /proc */
  put("proc/self/cgroup", "0::/a/b\n");
  CHECK_INT(mo_quota_processors(root), UINT32_MAX); /* no files of the cgroup */
  put("sys/fs/cgroup/a/b/cpu.max", "max 100000\n");
  put("sys/fs/cgroup/a/cpu.max", "max 100000\n");
  CHECK_INT(mo_quota_processors(root), UINT32_MAX);
  put("sys/fs/cgroup/a/b/cpu.max", "");
  put("sys/fs/cgroup/a/cpu.max", "150000\n"); /* no period given */
  CHECK_INT(mo_quota_processors(root), UINT32_MAX);
  put("proc/self/cgroup", "nonsense\n0:\n0::\n0::a\n");
  put("sys/fs/cgroup/cpu.max", "100000 100000\n");
  CHECK_INT(mo_quota_processors(root), UINT32_MAX);
}

static void rounded_up(void)
{
  static const struct {
    const char *text;
    uint32_t processors;
  } quotas[] = {{"1000 100000\n", 1},
                {"100000 100000\n", 1},
                {"100001 100000\n", 2},
                {"250000 100000\n", 3},
                {"300000 100000\n", 3},
                {"12800000 50000\n", 256},
                {"900000000000000000 1\n", UINT32_MAX}};
  begin();
  put("proc/self/cgroup", "0::/job\n");
  for (size_t i = 0; i < sizeof(quotas) / sizeof(quotas[0]); i++) {
    put("sys/fs/cgroup/job/cpu.max", quotas[i].text);
    CHECK_INT(mo_quota_processors(root), quotas[i].processors);
  }
}

static void ancestors(void)
{
  begin();
  put("proc/self/cgroup", "0::/slice/user/job.scope\n");
  put("sys/fs/cgroup/slice/user/job.scope/cpu.max", "700000 100000\n");
  put("sys/fs/cgroup/slice/user/cpu.max", "max 100000\n");
  put("sys/fs/cgroup/slice/cpu.max", "800000 100000\n");
  put("sys/fs/cgroup/slice/neighbor/cpu.max", "100000 100000\n"); /* not an ancestor */
  CHECK_INT(mo_quota_processors(root), 7);
  put("sys/fs/cgroup/slice/user/cpu.max", "600000 100000\n");
  CHECK_INT(mo_quota_processors(root), 6);
  put("sys/fs/cgroup/slice/cpu.max", "500000 100000\n");
  CHECK_INT(mo_quota_processors(root), 5);
  put("sys/fs/cgroup/cpu.max",
      "350000 100000\n"); /* a container's own cgroup, at the top of its mount */
  CHECK_INT(mo_quota_processors(root), 4);
  put("proc/self/cgroup", "0::/\n");
  CHECK_INT(mo_quota_processors(root), 4);
  put("proc/self/cgroup", "0::/../beside\n"); /* outside the cgroup namespace */
  CHECK_INT(mo_quota_processors(root), 4);
}

static void version_1(void)
{
  begin();
  put("proc/self/cgroup", "5:memory:/batch/job\n4:cpu,cpuacct:/batch/job\n3:cpuset:/\n0::/\n");
  put("sys/fs/cgroup/cpu/batch/job/cpu.cfs_quota_us", "-1\n");
  put("sys/fs/cgroup/cpu/batch/job/cpu.cfs_period_us", "100000\n");
  CHECK_INT(mo_quota_processors(root), UINT32_MAX);
  put("sys/fs/cgroup/cpu/batch/job/cpu.cfs_quota_us", "450000\n");
  CHECK_INT(mo_quota_processors(root), 5);
  put("sys/fs/cgroup/cpu/batch/cpu.cfs_quota_us", "100000\n");
  CHECK_INT(mo_quota_processors(root), 5); /* no period, no quota */
  put("sys/fs/cgroup/cpu/batch/cpu.cfs_period_us", "50000\n");
  CHECK_INT(mo_quota_processors(root), 2);
  put("proc/self/cgroup", "5:memory:/batch/job\n3:cpuset,cpuacct:/batch/job\n");
  CHECK_INT(mo_quota_processors(root), UINT32_MAX);
}

static void this_process(void)
{
  const uint32_t n = mo_processors();
  CHECK(n >= 1 && n <= 1024 && n <= mo_quota_processors(""));
  end();
}

static const struct check_case cases[] = {
    {"no quota", none},
    {"a quota is rounded up", rounded_up},
    {"the smallest quota of all ancestors counts", ancestors},
    {"cgroup version 1", version_1},
    {"this process", this_process},
};
CHECK_MAIN(cases)
