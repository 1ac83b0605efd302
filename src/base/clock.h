/* clock.h: the monotonic clock, in nanoseconds. */
#ifndef MORPHO_BASE_CLOCK_H
#define MORPHO_BASE_CLOCK_H

#include <stdint.h>

/* Nanoseconds since an arbitrary start; never goes back, not touched by changes of the wall clock.
 */
uint64_t mo_clock_ns(void);

#endif
