/* clock.h: the clocks of the service. */
#ifndef MORPHO_BASE_CLOCK_H
#define MORPHO_BASE_CLOCK_H

#include <stdint.h>

/* Read the monotonic clock: time since an arbitrary start, unaffected by changes of the wall
 * clock. */
uint64_t mo_clock_ns(void);
int64_t mo_clock_us(void);
/* Reads the CPU time of the calling thread. */
uint64_t mo_clock_thread_ns(void);
/* Reads the wall clock: microseconds since 1970, UTC. May jump. */
int64_t mo_clock_wall_us(void);

#endif
