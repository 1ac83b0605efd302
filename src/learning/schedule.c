/* schedule.c: learning rates: a linear warm-up, then cosine annealing with warm restarts
 * (Loshchilov & Hutter, ICLR 2017); one cosine over the whole training run is the special case of
 * one cycle.
 *
 * Step s of a cycle of n steps has the rate floor + (peak − floor) (1 + cos(π s/n))/2: the first
 * step has the peak rate, and the step after the last one would have the floor. The cosine is
 * computed here with only correctly rounded operations, so that a rate has the same bits on every
 * machine. */
#include "learning/fields.h"

#define PI           3.14159265358979323846
#define COSINE_TERMS 13 /* terms of the series on [0, π/2]: the next one is below 1e-21 */

const char *const mo_schedule_words[] = {"restarts", "cosine", "constant", NULL};

const char *const mo_schedule_preset_words[] = {"paper-pretrain",     "paper-finetune",
                                                "paper-simultaneous", "one-cosine",
                                                "finetune-cosine",    NULL};
const struct mo_schedule mo_schedule_presets[] = {
    [MO_SCHEDULE_PAPER_PRETRAIN] = {MO_SCHEDULE_RESTARTS, .peak = 1e-3, .floor = 1e-5, .decay = 0.7,
                                    .cycle_steps = 10, .cycle_growth = 2},
    [MO_SCHEDULE_PAPER_FINETUNE] = {MO_SCHEDULE_RESTARTS, .peak = 3.5e-4, .floor = 3.5e-5,
                                    .decay = 1.0, .cycle_steps = 100, .cycle_growth = 1},
    [MO_SCHEDULE_PAPER_SIMULTANEOUS] = {MO_SCHEDULE_RESTARTS, .peak = 1e-3, .floor = 1e-5,
                                        .decay = 0.65, .cycle_steps = 10, .cycle_growth = 2},
    [MO_SCHEDULE_ONE_COSINE] = {MO_SCHEDULE_COSINE, .peak = 2e-3, .floor = 1e-5, .decay = 1.0,
                                .cycle_steps = 1, .cycle_growth = 1, .warmup_steps = 10},
    [MO_SCHEDULE_FINETUNE_COSINE] = {MO_SCHEDULE_COSINE, .peak = 3e-4, .floor = 1e-6, .decay = 1.0,
                                     .cycle_steps = 100, .cycle_growth = 1},
};

/* Computes cos(π s/n), 0 ≤ s ≤ n, n > 0. */
static double cosine(uint64_t s, uint64_t n)
{
  const double sign = 2 * s > n ? -1.0 : 1.0;
  const double x = PI * (double)(2 * s > n ? n - s : s) / (double)n;
  const double square = x * x;
  double sum = 1.0; /* Horner's scheme from the last term: 1 − x²/2 (1 − x²/12 (1 − …)) */
  for (int k = 2 * COSINE_TERMS; k > 0; k -= 2)
    sum = 1.0 - square / (double)(k * (k - 1)) * sum;
  return sign * sum;
}

static double annealed(double peak, double floor, uint64_t s, uint64_t n)
{
  return floor + (peak - floor) * (0.5 * (1.0 + cosine(s, n)));
}

static double restarted(const struct mo_schedule *schedule, uint64_t s)
{
  double peak = schedule->peak;
  uint64_t length = schedule->cycle_steps;
  while (s >= length) {
    s -= length;
    length *= schedule->cycle_growth;
    if (peak > schedule->floor)
      peak *= schedule->decay;
  }
  return peak > schedule->floor ? annealed(peak, schedule->floor, s, length) : schedule->floor;
}

double mo_schedule_rate(const struct mo_schedule *schedule, uint32_t step, uint32_t n_steps)
{
  if (step < schedule->warmup_steps)
    return schedule->peak * ((double)(step + UINT64_C(1)) / (double)schedule->warmup_steps);
  const uint64_t s = step - schedule->warmup_steps;
  switch (schedule->kind) {
  case MO_SCHEDULE_RESTARTS: return restarted(schedule, s);
  case MO_SCHEDULE_COSINE:
    return step < n_steps ? annealed(schedule->peak, schedule->floor, s,
                                     (uint64_t)n_steps - schedule->warmup_steps)
                          : schedule->floor;
  case MO_SCHEDULE_CONSTANT: break;
  }
  return schedule->peak;
}
