/* rates.h: sums the computing time since the start, by kind of work.
 *
 * Clients estimate from the sums how long more work of the same kind will take. Times do not affect
 * any result. */
#ifndef MORPHO_COMPUTE_RATES_H
#define MORPHO_COMPUTE_RATES_H

#include <morpho/compute.h>

#include <pthread.h>

struct mo_rates {
  pthread_mutex_t mutex;
  uint32_t n;
  uint64_t n_added;                  /* additions so far */
  uint64_t newest[MO_RATES_MAX];     /* number of the newest addition to each row */
  struct mo_rate rows[MO_RATES_MAX]; /* a new kind of work replaces the least recently used row */
};

/* Adds to the row of the same kind: the first members of `work`, up to control_period_s. */
void mo_rates_add(struct mo_rates *rates, const struct mo_rate *work);
/* Returns the kind of a block or batch, without sums. */
struct mo_rate mo_rate_of(bool is_gradient, enum mo_back_end back_end, enum mo_precision precision,
                          const struct mo_scheme *scheme);

#endif
