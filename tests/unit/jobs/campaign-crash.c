/* campaign-crash.c: a process that runs a campaign is killed with SIGKILL at random moments, again
 * and again, with another number of workers in every life, until the campaign has ended. Three of
 * four moments come after work that the life has done, counted in rollouts and robots, so that they
 * hit a campaign at work on any machine; the fourth is soon after the submission, by the clock: in
 * every mode its designs, scores, phylogeny, populations and controller are those of plain loops,
 * and each kill cost a block per worker and what waited for its commit, no more.
 *
 * MORPHO_CRASH_KILLS: kills in each mode, at least (default 10). */
#include <signal.h>
#include <sys/mman.h>
#include <sys/wait.h>

#include "campaigns.h"

#define LONG_GENERATIONS 8
#define BLOCK_US         3000
#define STEP_US          3000

/* In memory that the processes share. */
struct shared {
  struct fake_count count;
  atomic_bool runs; /* this life is at work */
};

static struct shared *shared;

static struct mo_campaign_request long_campaign(int mode)
{
  struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
  request.record.settings.generations = LONG_GENERATIONS;
  request.record.checkpoint_every_s = 0; /* at the end of each generation's learning alone */
  request.idempotency_key = "one campaign";
  return request;
}

/* Never returns: killed from outside, or done. */
static void live(const char *path, int mode, uint32_t n_workers)
{
  struct mo_campaign_request request = long_campaign(mode);
  struct service service;
  struct mo_job job;
  int64_t id;
  memset(&service, 0, sizeof(service));
  snprintf(service.fixture.path, sizeof(service.fixture.path), "%s", path);
  service.n_workers = n_workers;
  fake_plan.delay_us = BLOCK_US;
  fake_plan.gradient_delay_us = STEP_US;
  if (service_open(&service) != MO_OK) {
    fprintf(stderr, "# child: %s\n", service.fixture.message.text);
    _exit(3);
  }
  id = submit(&service, &request);
  atomic_store(&shared->runs, true);
  if (id < 1 || await_end(service.jobs, id, 60000, &job) != MO_OK || job.state != MO_JOB_SUCCEEDED)
    _exit(4);
  service_close(&service);
  _exit(0);
}

static void check_end(const char *path, int mode, int kills, const struct fake_count *count)
{
  struct mo_campaign_request request = long_campaign(mode);
  struct origin origin = origin_of(&request);
  struct service service;
  struct history *stored, *expected = plain_history(&fake_plain, &origin);
  struct mo_campaign_status status;
  uint64_t rollouts = 0, robots = 0;
  memset(&service, 0, sizeof(service));
  snprintf(service.fixture.path, sizeof(service.fixture.path), "%s", path);
  REQUIRE(service_open(&service) == MO_OK);
  stored = stored_history(service.fixture.store, 1);
  CHECK(same_history(stored, expected));
  status = status_of(&service, 1);
  CHECK_INT(status.job.attempts, 0);
  CHECK_INT(status.end, MO_CAMPAIGN_COMPLETED);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  needs(&origin, &rollouts, &robots);
  rollouts = atomic_load(&count->rollouts) - rollouts;
  robots = atomic_load(&count->robots) - robots;
  printf("# %s: %d kills; %.1f blocks and %.1f learning steps were computed again per kill\n",
         mo_campaign_mode_name((enum mo_campaign_mode)mode), kills,
         (double)rollouts / MO_PAPER_TEST_COUNT / kills,
         (double)robots / request.record.settings.population / kills);
  /* Two blocks per worker are in flight or wait for their commit; a generation's learning starts
   * over. */
  CHECK(rollouts <= (uint64_t)kills * 2 * 7 * MO_PAPER_TEST_COUNT);
  CHECK(robots <=
        (uint64_t)kills * (PARENT_STEPS + CHILD_STEPS) * request.record.settings.population);
  free(stored);
  free(expected);
  service_close(&service);
}

static uint64_t work_done(void)
{
  return atomic_load(&fake_count->rollouts) + atomic_load(&fake_count->robots);
}

/* Soon after the submission, whatever the child does then. */
static void await_start(unsigned random)
{
  for (int i = 0; i < 60000 && !atomic_load(&shared->runs); i++)
    usleep(1000);
  usleep(random % 20000);
}

/* Until the child has done that much work, and up to a block longer. False: it has ended, or does
 * not get on. */
static bool await_work(pid_t child, uint64_t before, uint64_t work, unsigned random)
{
  siginfo_t ended = {0};
  for (int i = 0; work_done() < before + work; i++) {
    if (i == 600000 || waitid(P_PID, (id_t)child, &ended, WEXITED | WNOHANG | WNOWAIT) != 0 ||
        ended.si_pid == child)
      return false;
    usleep(100);
  }
  usleep(random % BLOCK_US);
  return true;
}

static void loses_nothing(void)
{
  static const uint32_t workers[] = {1, 2, 7};
  const char *text = getenv("MORPHO_CRASH_KILLS");
  int wanted = text != NULL ? atoi(text) : 10;
  unsigned random = 4321;
  shared = mmap(NULL, sizeof(*shared), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  REQUIRE(shared != MAP_FAILED);
  fake_count = &shared->count;
  (void)default_digits(); /* before the first fork */
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++) {
    const struct mo_campaign_request request = long_campaign(mode);
    const struct origin origin = origin_of(&request);
    uint64_t rollouts = 0, robots = 0;
    int all = 0, at_work = 0;
    needs(&origin, &rollouts, &robots);
    while (all < wanted) { /* campaigns, until there are so many */
      struct fixture fixture;
      int kills = 0, status = -1;
      REQUIRE(fixture_folder(&fixture) == 0);
      memset(shared, 0, sizeof(*shared));
      for (;;) {
        const uint64_t before = work_done();
        bool awaited = false;
        pid_t child;
        atomic_store(&shared->runs, false);
        fflush(stdout);
        child = fork();
        random = random * 1103515245U + 12345U;
        if (child == 0)
          live(fixture.path, mode, workers[(random >> 16) % 3]);
        REQUIRE(child > 0);
        if (all + kills < wanted) {
          if ((all + kills) % 4 == 3)
            await_start(random >> 8);
          else
            awaited = await_work(child, before, 1 + (random >> 8) % ((rollouts + robots) / 4),
                                 random >> 4);
          kill(child, SIGKILL);
        }
        REQUIRE(waitpid(child, &status, 0) == child);
        if (WIFEXITED(status))
          break;
        kills++;
        at_work += awaited;
      }
      CHECK_INT(WEXITSTATUS(status), 0);
      check_end(fixture.path, mode, kills > 0 ? kills : 1, &shared->count);
      fixture_remove(fixture.path);
      all += kills;
    }
    CHECK(at_work >= all - all / 4);
  }
  fake_count = NULL;
  munmap(shared, sizeof(*shared));
}

static const struct check_case cases[] = {{"loses nothing", loses_nothing}};
CHECK_MAIN(cases)
