/* pace.c: the remaining time of jobs, with a simulated clock. */
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>

#include <morpho/random.h>

#include "../check.h"
#include "jobs/pace.h"

#define JOBS_MAX 8
#define WORKERS  4
#define BLOCK    16

/* A job of `total` rollouts that is claimed at time 0 and computes from `begins_us` on. */
struct job {
  int64_t begins_us, guess_us, end_us; /* guess: the end as estimated after a tenth of the work */
  uint64_t total, submitted, done;
  struct mo_pace pace;
};

static struct mo_random dice;

/* Durations of blocks differ widely, as those of bodies do. */
static int64_t duration_us(void)
{
  return 20000 + (int64_t)(mo_random_below(&dice, 400) * mo_random_below(&dice, 400));
}

/* Runs the jobs: a free worker takes a block of the job that has received the fewest. */
static void run(struct job *jobs, unsigned n)
{
  struct {
    int64_t until_us;
    struct job *job;
  } workers[WORKERS] = {{0}};
  for (int64_t now_us = 0;;) {
    unsigned first = 0;
    for (unsigned w = 0; w < WORKERS; w++)
      if (workers[w].until_us < workers[first].until_us)
        first = w;
    now_us = workers[first].until_us;
    struct job *job = workers[first].job;
    if (job != NULL) {
      job->done += BLOCK;
      mo_pace_add(&job->pace, 1 + now_us, job->done);
      const double rate = mo_pace_rate(&job->pace, 1 + now_us);
      if (job->guess_us == 0 && job->done * 10 >= job->total)
        job->guess_us = now_us + (int64_t)(1e6 * (double)(job->total - job->done) / rate);
      if (job->done >= job->total)
        job->end_us = now_us;
    }
    struct job *next = NULL;
    int64_t soonest_us = INT64_MAX;
    for (unsigned i = 0; i < n; i++) {
      if (jobs[i].submitted >= jobs[i].total)
        continue;
      if (jobs[i].begins_us > now_us)
        soonest_us = jobs[i].begins_us < soonest_us ? jobs[i].begins_us : soonest_us;
      else if (next == NULL || jobs[i].submitted < next->submitted)
        next = &jobs[i];
    }
    workers[first].job = next;
    workers[first].until_us = next != NULL ? now_us + duration_us() : soonest_us;
    if (next != NULL)
      next->submitted += BLOCK;
    bool any = false;
    for (unsigned w = 0; w < WORKERS; w++)
      any = any || workers[w].until_us < INT64_MAX;
    if (!any)
      return;
  }
}

static bool is_near(const struct job *job)
{
  const int64_t now_us = job->guess_us, end_us = job->end_us;
  return llabs(now_us - end_us) < end_us * 27 / 100; /* 0.3 of the remaining nine tenths */
}

static void begin(void)
{
  mo_random_init(&dice, 1, MO_PURPOSE_BODY, 0, 0);
}

static void alone(void)
{
  begin();
  struct job job = {.total = 16000};
  run(&job, 1);
  CHECK(is_near(&job));
}

static void eight_at_a_time(void)
{
  begin();
  struct job jobs[JOBS_MAX] = {{0}};
  for (unsigned i = 0; i < JOBS_MAX; i++)
    jobs[i].total = 8000;
  run(jobs, JOBS_MAX);
  for (unsigned i = 0; i < JOBS_MAX; i++)
    CHECK(is_near(&jobs[i]));
}

/* The time before a job's first results does not count in its rate. */
static void after_a_wait(void)
{
  begin();
  struct job job = {.total = 16000, .begins_us = INT64_C(600) * 1000000};
  run(&job, 1);
  CHECK(llabs(job.guess_us - job.end_us) < (job.end_us - job.begins_us) * 27 / 100);
}

/* A rate covers the last seconds, and is unknown at first. */
static void follows(void)
{
  struct mo_pace pace = {0};
  uint64_t done = 0;
  int64_t now_us = 1;
  CHECK(mo_pace_rate(&pace, now_us) == 0);
  for (; now_us < 30000000; now_us += 100000) {
    mo_pace_add(&pace, now_us, done += 10);
    CHECK(now_us < 500000 ? mo_pace_rate(&pace, now_us) == 0
                          : fabs(mo_pace_rate(&pace, now_us) - 100) < 1e-9);
  }
  for (; now_us < 60000000; now_us += 100000)
    mo_pace_add(&pace, now_us, done += 80);
  CHECK(fabs(mo_pace_rate(&pace, now_us) - 800) < 1e-9);
  /* It drops when no results arrive any more. */
  CHECK(mo_pace_rate(&pace, now_us + 1000000000) < 20);
}

static const struct check_case cases[] = {
    {"one job alone", alone},
    {"eight jobs at a time", eight_at_a_time},
    {"a job without results yet", after_a_wait},
    {"a rate covers the last seconds", follows},
};
CHECK_MAIN(cases)
