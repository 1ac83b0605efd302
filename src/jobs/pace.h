/* pace.h: the recent rate of a job's results. Pure arithmetic: the caller provides the time.
 *
 * The rate counts from the first results, so that it does not include the time to start the first
 * blocks and to wait for them. It covers the last 10 to 20 seconds at most, so that it adapts when
 * jobs that share the cores start or end. */
#ifndef MORPHO_JOBS_PACE_H
#define MORPHO_JOBS_PACE_H

#include <stdint.h>

struct mo_pace {
  struct mo_pace_mark {
    int64_t at_us;
    uint64_t done;
  } from, next, last;      /* last: the newest results; from: start of the measured period; next:
                            * start of the next period */
  uint32_t n_from, n_next; /* number of arrivals since these; 0 at first */
};

/* Records that results have arrived: `done` in total. */
void mo_pace_add(struct mo_pace *pace, int64_t now_us, uint64_t done);
/* Returns results per second, or 0 if unknown. */
double mo_pace_rate(const struct mo_pace *pace, int64_t now_us);

#endif
