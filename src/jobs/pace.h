/* pace.h: how fast results of a job come, lately. Only arithmetic: the caller has the clock.
 *
 * Counts from the first results on, so that neither waiting for the first blocks nor starting them
 * is part of a rate, and from 10 to 20 seconds back at most, so that a rate follows when jobs that
 * share the cores start or end. */
#ifndef MORPHO_JOBS_PACE_H
#define MORPHO_JOBS_PACE_H

#include <stdint.h>

struct mo_pace {
  struct mo_pace_mark {
    int64_t at_us;
    uint64_t done;
  } from, next, last;      /* last: the newest results; from: begin of the rate; next: after that */
  uint32_t n_from, n_next; /* how often results came after these; 0 at first */
};

/* Notes that results have come: `done` in all. */
void mo_pace_add(struct mo_pace *pace, int64_t now_us, uint64_t done);
/* Returns results per second; 0: unknown. */
double mo_pace_rate(const struct mo_pace *pace, int64_t now_us);

#endif
