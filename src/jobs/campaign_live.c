/* campaign_live.c: the live figures of a campaign, and its events of progress. */
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
      run->generation < last ? run->generation : last; /* no generation is current at the end */
  runner->live.last = last;
  runner->live.best_score = isfinite(run->status.best_score) ? run->status.best_score : 0;
  runner->live.done = 0;
  runner->live.total = total;
  pthread_mutex_unlock(&runner->runners->mutex);
  (void)mo_runner_enter(runner, phase);
}

/* Estimates the rest of the campaign: from the remaining rollouts if only scoring takes time, else
 * from the last whole generation. Negative: unknown. */
static double seconds_left(const struct mo_campaign_run *run, const struct mo_live *live)
{
  const struct mo_campaign_settings *settings = run->settings;
  const double after =
      run->generation < settings->generations ? settings->generations - run->generation : 0;
  const double passed = (double)(mo_clock_us() - run->begin_us) * 1e-6;
  if (!mo_mode_learns(settings->mode) && live->rate > 0 && run->generation > 0) {
    double left = after * settings->population + run->n_scored - run->n_done;
    return left * run->n_environments / live->rate;
  }
  if (run->generation_s <= 0)
    return -1;
  return after * run->generation_s + (passed < run->generation_s ? run->generation_s - passed : 0);
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

/* Estimates all remaining generations from the newest one; 0: unknown. */
static double generations_s(const struct mo_campaign_run *run)
{
  const uint32_t generations = run->settings->generations;
  return run->generation <= generations ? (generations - run->generation + 1.0) * run->generation_s
                                        : 0;
}

void mo_campaign_show_drawing(struct mo_campaign_run *run,
                              const struct mo_campaign_drawing *drawing)
{
  struct mo_runner *runner = run->runner;
  struct mo_live *live = &runner->live;
  const double after_s = generations_s(run);
  MO_GUARD(&runner->runners->mutex);
  live->done = drawing != NULL ? drawing->done : 0;
  live->total = drawing != NULL ? drawing->total : 0;
  live->reason[0] = '\0';
  if (drawing == NULL)
    live->seconds_left = after_s > 0 ? after_s : -1;
  else
    live->seconds_left = drawing->seconds_left < 0 ? -1 : drawing->seconds_left + after_s;
  if (drawing != NULL && drawing->drawer != run->id)
    snprintf(live->reason, sizeof(live->reason),
             "campaign %lld draws the bodies again that the controller was pretrained on: this one "
             "waits for the same",
             (long long)drawing->drawer);
}

const char *mo_campaign_progress(struct mo_campaign_run *run, const char *phase, uint64_t done,
                                 uint64_t total, char text[256])
{
  if (mo_clock_us() - run->progress_us < PROGRESS_EVERY_US)
    return NULL;
  snprintf(text, 256,
           "{\"id\":\"%lld\",\"generation\":%u,\"phase\":\"%s\",\"done\":%llu,\"total\":%llu}",
           (long long)run->id, (unsigned)run->generation, phase, (unsigned long long)done,
           (unsigned long long)total);
  return text;
}
