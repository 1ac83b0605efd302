/* crash.c: a process is killed with SIGKILL at random moments, again and again, until all its work
 * is done.
 *
 * A child opens the state folder, submits jobs under keys, and computes with the fake back end. The
 * parent kills it and starts the next child. At the end every job has succeeded, its results are
 * those of an undisturbed run, no row is there twice, and a kill cost no more than what was in
 * flight or waited for its commit.
 *
 * MORPHO_CRASH_KILLS: how many times at least, in each case (default: evaluations 20, campaigns of
 * each mode 10). */
#include <signal.h>
#include <sys/mman.h>
#include <sys/wait.h>

#include "fakes.h"

#define BODIES           400
#define SUBMISSIONS      60
#define LONG_GENERATIONS 8
#define BLOCK_US         3000
#define STEP_US          3000

enum { EVALUATIONS = -1 }; /* beside the modes of campaigns */

/* In memory that the processes share. */
struct shared {
  struct fake_count count;
  atomic_int acknowledged; /* submissions, in all lives */
  atomic_bool runs;        /* this life is at work */
};

static struct shared *shared;
static const struct mo_bits *genotypes;
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

/* Notes submission number i. false: it was refused, is another job, or was acknowledged before and
 * is now unknown. */
static bool acknowledge(int i, int error, int64_t id, bool replayed)
{
  if (error != MO_OK || id != i + 1 || (i < atomic_load(&shared->acknowledged) && !replayed))
    return false;
  if (!replayed)
    atomic_store(&shared->acknowledged, i + 1);
  atomic_store(&shared->runs, true);
  return true;
}

/* ---- evaluations: many small ones ---- */

/* What submission number i asks for. */
static struct mo_evaluation_request request_of(int i, char key[64])
{
  const uint32_t n = i % 7 == 0 ? 40 : (uint32_t)(1 + i % 9);
  struct mo_evaluation_request request = service_request(genotypes + (i * 37) % (BODIES - 40), n);
  snprintf(key, 64, "submission-%d", i);
  request.idempotency_key = key;
  request.verify = i % 11 == 10;
  request.record = i % 13 == 12 ? MO_RECORD_COM : 0;
  return request;
}

static bool live_on_evaluations(void)
{
  char key[64];
  fake_plan.delay_us = 1000;
  for (int i = 0; i < SUBMISSIONS; i++) {
    const struct mo_evaluation_request request = request_of(i, key);
    int64_t id = 0;
    bool replayed = false;
    const int error = mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, NULL);
    if (!acknowledge(i, error, id, replayed))
      return false;
    if (i % 4 == 3)
      usleep(10000);
  }
  return AWAIT(stats_of().open_jobs == 0);
}

static void check_evaluations(void)
{
  static const struct {
    const char *sql;
    int64_t expected;
  } rows[] = {
      {"SELECT count(*) FROM jobs", SUBMISSIONS},
      {"SELECT count(*) FROM jobs WHERE state=3 AND attempts=0", SUBMISSIONS},
      {"SELECT count(*) FROM events WHERE type='job.created'", SUBMISSIONS},
      {"SELECT count(*) FROM events WHERE type='job.finished'", SUBMISSIONS},
      {"SELECT count(*) FROM evaluations WHERE done<>n_designs*n_environments", 0},
      {"SELECT count(*) FROM (SELECT job,position FROM job_designs GROUP BY 1,2 HAVING "
       "count(*)>1)",
       0},
  };
  char key[64];
  for (size_t i = 0; i < COUNT(rows); i++)
    CHECK_INT(outside_integer(rows[i].sql), rows[i].expected);
  for (int i = 0; i < SUBMISSIONS; i++) {
    const struct mo_evaluation_request request = request_of(i, key);
    struct mo_evaluation_results *results = NULL;
    struct mo_trajectory *trajectory = NULL;
    CHECK(right(i + 1, request.genotypes));
    if (request.record != 0)
      CHECK_OK(mo_store_trajectory(store, i + 1, request.n_designs - 1, 9, &trajectory));
    mo_trajectory_free(trajectory);
    if (request.verify && mo_store_results(store, i + 1, &results) == MO_OK)
      for (uint32_t n = 0; n < results->n_designs; n++)
        CHECK_INT(results->agrees[n], 1);
    mo_evaluation_results_free(results);
  }
}

/* ---- one campaign of each mode ---- */

static struct mo_campaign_request long_campaign(int mode)
{
  struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
  request.record.settings.generations = LONG_GENERATIONS;
  request.record.checkpoint_every_s = 0; /* only at the end of each generation's learning */
  request.idempotency_key = "one campaign";
  return request;
}

static bool live_on_campaign(int mode)
{
  const struct mo_campaign_request request = long_campaign(mode);
  int64_t id = 0;
  bool replayed = false;
  fake_plan.delay_us = BLOCK_US;
  fake_plan.gradient_delay_us = STEP_US;
  int error = mo_jobs_submit_campaign(service.jobs, &request, &id, &replayed, NULL, NULL);
  return acknowledge(0, error, id, replayed) && succeeds(id, NULL);
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
  printf("# %s: %d kills; %.1f blocks and %.1f learning steps were computed again per kill\n",
         mo_campaign_mode_words[mode], kills, (double)rollouts / MO_PAPER_TEST_COUNT / kills,
         (double)robots / POPULATION / kills);
  /* Two blocks per worker are in flight or wait for their commit; a generation's learning starts
   * over. */
  CHECK(rollouts <= (uint64_t)kills * 2 * 7 * MO_PAPER_TEST_COUNT);
  CHECK(robots <= (uint64_t)kills * (PARENT_STEPS + CHILD_STEPS) * POPULATION);
}

/* ---- lives ---- */

/* Never returns: killed from outside, or done. */
static void live(int mode, uint32_t n_workers)
{
  service.n_workers = n_workers;
  if (service_open() != MO_OK) {
    fprintf(stderr, "# child: %s\n", fixture.message.text);
    _exit(3);
  }
  if (!(mode == EVALUATIONS ? live_on_evaluations() : live_on_campaign(mode)))
    _exit(4);
  service_close();
  _exit(0);
}

/* Waits until the child has done so much work, and up to a block longer; false: it has ended, or
 * makes no progress. So a kill hits a job at work on any machine. work 0: soon after a submission.
 */
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

/* Lives until the work is done, most of which are killed while `kills_left` lasts. Returns the
 * number of kills; *at_work: of those that hit a job at work. */
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
  const int wanted = text != NULL ? atoi(text) : mode == EVALUATIONS ? 20 : 10;
  uint64_t rollouts = SUBMISSIONS * 50, robots = 0;
  int all = 0, at_work = 0;
  if (mode != EVALUATIONS) {
    const struct mo_campaign_request request = long_campaign(mode);
    const struct origin origin = origin_of(&request); /* before the first fork */
    needs(&origin, &rollouts, &robots);
  }
  while (all < wanted) { /* until there are so many kills */
    REQUIRE_OK(service_begin());
    genotypes = bodies(21, BODIES);
    memset(shared, 0, sizeof(*shared));
    int kills = run_lives(mode, wanted - all, (rollouts + robots) / 4, &at_work);
    REQUIRE_OK(service_open());
    if (mode == EVALUATIONS)
      check_evaluations();
    else
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
  for (int mode = EVALUATIONS; mode <= MO_SIMULTANEOUS; mode++)
    check_mode(mode);
  fake_count = NULL;
  munmap(shared, sizeof(*shared));
}

static const struct check_case cases[] = {{"loses nothing that it acknowledged", loses_nothing}};
CHECK_MAIN(cases)
