/* crash.c: the cost of a kill. A process that runs a campaign is repeatedly killed with SIGKILL at
 * random moments until the campaign is done.
 *
 * A child opens the state folder, submits the campaign under a key, and computes with the fake back
 * end, which counts what it computes. The parent kills it and starts the next child. At the end the
 * campaign must equal an undisturbed one, and each kill must have cost only work that was in flight
 * or waiting for its commit. tests/crash does the same to the daemon, and to evaluations.
 *
 * MORPHO_CRASH_KILLS: minimum number of kills in each mode (default 10). */
#include <signal.h>
#include <sys/mman.h>
#include <sys/wait.h>

#include "fakes.h"

#define LONG_GENERATIONS 8
#define BLOCK_US         3000
#define STEP_US          3000

/* In memory that the processes share. */
struct shared {
  struct fake_count count;
  atomic_bool acknowledged; /* by all processes together */
  atomic_bool runs;         /* the current process has started to work */
};

static struct shared *shared;
static unsigned random_bits = 4321;

static unsigned next_random(void)
{
  random_bits = random_bits * 1103515245U + 12345U;
  return random_bits >> 8;
}

static uint64_t work_done(void)
{
  return atomic_load(&shared->count.rollouts) + atomic_load(&shared->count.robots);
}

/* ---- one campaign of each mode ---- */

static struct mo_campaign_request long_campaign(int mode)
{
  struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
  request.record.settings.generations = LONG_GENERATIONS;
  request.record.checkpoint_every_s = 0; /* only at the end of learning in each generation */
  request.job.key.text = "one campaign";
  return request;
}

static bool live_on_campaign(int mode)
{
  const struct mo_campaign_request request = long_campaign(mode);
  int64_t id = 0;
  bool replayed = false;
  fake_plan.delay_us = BLOCK_US;
  fake_plan.gradient_delay_us = STEP_US;
  int error = mo_jobs_submit_campaign(service.jobs, &request, &id, &replayed, NULL);
  /* The submission was refused, returned another job, or was acknowledged before and is now
   * unknown. */
  if (error != MO_OK || id != 1 || (atomic_exchange(&shared->acknowledged, true) && !replayed))
    return false;
  atomic_store(&shared->runs, true);
  return succeeds(id, NULL);
}

static void check_campaign(int mode, int kills)
{
  const struct mo_campaign_request request = long_campaign(mode);
  const struct origin origin = origin_of(&request);
  uint64_t rollouts = 0, robots = 0;
  CHECK(ends_as_plain(1, &origin));
  CHECK_INT(status_of(1).end, MO_CAMPAIGN_COMPLETED);
  needs(&origin, &rollouts, &robots);
  rollouts = atomic_load(&shared->count.rollouts) - rollouts;
  robots = atomic_load(&shared->count.robots) - robots;
  printf("# %s: %d kills; %.1f blocks and %.1f learning steps were recomputed per kill\n",
         mo_campaign_mode_words[mode], kills, (double)rollouts / MO_PAPER_TEST_COUNT / kills,
         (double)robots / POPULATION / kills);
  /* Two blocks per worker are in flight or wait for their commit; learning in the current
   * generation restarts. */
  CHECK(rollouts <= (uint64_t)kills * 2 * 7 * MO_PAPER_TEST_COUNT);
  CHECK(robots <= (uint64_t)kills * (PARENT_STEPS + CHILD_STEPS) * POPULATION);
}

/* ---- processes ---- */

/* Runs in a child process and never returns: the process is killed, or exits when done. */
static void live(int mode, uint32_t n_workers)
{
  service.n_workers = n_workers;
  if (service_open() != MO_OK) {
    fprintf(stderr, "# child: %s\n", fixture.message.text);
    _exit(3);
  }
  if (!live_on_campaign(mode))
    _exit(4);
  service_close();
  _exit(0);
}

/* Waits until the child has done this much work, up to one block more. Returns false if it has
 * ended or makes no progress. A kill therefore hits a job at work on any machine. work 0: soon
 * after a submission. */
static bool await_work(pid_t child, uint64_t work)
{
  const uint64_t before = work_done();
  siginfo_t ended = {0};
  for (int i = 0; work > 0 ? work_done() < before + work : !atomic_load(&shared->runs); i++) {
    if (i == 600000 || waitid(P_PID, (id_t)child, &ended, WEXITED | WNOHANG | WNOWAIT) != 0 ||
        ended.si_pid == child)
      return false;
    usleep(100);
  }
  usleep(next_random() % (work > 0 ? BLOCK_US : 20000));
  return work > 0;
}

/* Starts processes until the work is done, and kills most of them while `kills_left` lasts. Returns
 * the number of kills; *at_work: how many hit a job at work. */
static int run_lives(int mode, int kills_left, uint64_t all_work, int *at_work)
{
  static const uint32_t workers[] = {1, 2, 7};
  int kills = 0, status = -1;
  for (;;) {
    bool hits = false;
    atomic_store(&shared->runs, false);
    fflush(stdout);
    pid_t child = fork();
    if (child == 0)
      live(mode, workers[next_random() % 3]);
    (void)next_random();
    if (child > 0 && kills < kills_left) {
      hits = await_work(child, (kills_left - kills) % 4 == 0 ? 0 : 1 + next_random() % all_work);
      kill(child, SIGKILL);
    }
    if (child <= 0 || waitpid(child, &status, 0) != child || WIFEXITED(status))
      break;
    kills++;
    *at_work += hits;
  }
  CHECK(WIFEXITED(status));
  CHECK_INT(WEXITSTATUS(status), 0);
  return kills;
}

static void check_mode(int mode)
{
  const char *text = getenv("MORPHO_CRASH_KILLS");
  const int wanted = text != NULL ? atoi(text) : 10;
  const struct mo_campaign_request request = long_campaign(mode);
  const struct origin origin = origin_of(&request); /* before the first fork */
  uint64_t rollouts = 0, robots = 0;
  int all = 0, at_work = 0;
  needs(&origin, &rollouts, &robots);
  while (all < wanted) { /* repeated until there were enough kills */
    REQUIRE_OK(service_begin());
    memset(shared, 0, sizeof(*shared));
    int kills = run_lives(mode, wanted - all, (rollouts + robots) / 4, &at_work);
    REQUIRE_OK(service_open());
    check_campaign(mode, kills > 0 ? kills : 1);
    CHECK_OK(check_whole());
    all += kills;
  }
  CHECK(at_work >= all - all / 4 - 1);
}

static void loses_nothing(void)
{
  shared = mmap(NULL, sizeof(*shared), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  REQUIRE(shared != MAP_FAILED);
  fake_count = &shared->count;
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++)
    check_mode(mode);
  fake_count = NULL;
  munmap(shared, sizeof(*shared));
}

static const struct check_case cases[] = {{"loses nothing acknowledged", loses_nothing}};
CHECK_MAIN(cases)
