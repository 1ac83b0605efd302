/* campaign_live.c: the live figures of a campaign, and its progress events. */
#include <math.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/campaign_run.h"

#define PROGRESS_EVERY_US INT64_C(1000000)

void mo_campaign_enter(struct mo_campaign_run *run, enum mo_phase phase, uint64_t total)
{
  struct mo_runner *runner = run->runner;
  const uint32_t last = run->settings->generations;
  pthread_mutex_lock(&runner->runners->mutex);
  runner->live.position =
      run->generation < last ? run->generation : last; /* at the end, none is current */
  runner->live.last = last;
  runner->live.best_score = isfinite(run->status.best_score) ? run->status.best_score : 0;
  runner->live.done = 0;
  runner->live.total = total;
  pthread_mutex_unlock(&runner->runners->mutex);
  (void)mo_runner_enter(runner, phase);
}

/* Estimates the remaining time of the campaign: from the remaining rollouts if only scoring takes
 * time, otherwise from the last whole generation. Returns a negative number if it is unknown. */
static double seconds_left(const struct mo_campaign_run *run, const struct mo_live *live)
{
  const struct mo_campaign_settings *settings = run->settings;
  const double after =
      run->generation < settings->generations ? settings->generations - run->generation : 0;
  const double passed = (double)(mo_clock_us() - run->times.begin_us) * 1e-6;
  if (!mo_modes[settings->mode].learns && live->rate > 0 && run->generation > 0) {
    const double left = after + (run->scores.n - run->scores.n_done) / (double)settings->population;
    return left * (double)run->times.generation_rollouts / live->rate;
  }
  if (run->times.generation_s <= 0)
    return -1;
  return after * run->times.generation_s +
         (passed < run->times.generation_s ? run->times.generation_s - passed : 0);
}

void mo_campaign_advance(struct mo_campaign_run *run, uint64_t done, double rollouts_per_s)
{
  struct mo_runner *runner = run->runner;
  MO_GUARD(&runner->runners->mutex);
  runner->live.done = done;
  if (rollouts_per_s > 0)
    runner->live.rate = rollouts_per_s;
  runner->live.seconds_left = seconds_left(run, &runner->live);
}

const char *mo_campaign_progress(const struct mo_campaign_run *run, char text[256])
{
  const struct mo_live *live = &run->runner->live; /* only this thread changes it */
  if (mo_clock_us() - run->times.progress_us < PROGRESS_EVERY_US)
    return NULL;
  snprintf(text, 256,
           "{\"id\":\"%lld\",\"generation\":%u,\"phase\":\"%s\",\"done\":%llu,\"total\":%llu}",
           (long long)run->id, (unsigned)run->generation, mo_phase_name(live->phase),
           (unsigned long long)live->done, (unsigned long long)live->total);
  return text;
}
