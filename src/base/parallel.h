/* parallel.h: one loop on several threads. */
#ifndef MORPHO_BASE_PARALLEL_H
#define MORPHO_BASE_PARALLEL_H

#include <stddef.h>
#include <stdint.h>

#define MO_PARALLEL_THREADS_MAX 64

/* Calls part(context, first, end) for consecutive ranges that together are 0 … n − 1, each once, on
 * up to n_threads threads (the caller's among them; 0 counts as 1), and returns when all have
 * returned. What a range does must not depend on the others, nor on how the numbers are cut into
 * ranges. A thread that cannot be had is done without. Signals stay with the threads that were
 * there. */
void mo_parallel(uint32_t n_threads, size_t n,
                 void (*part)(void *context, size_t first, size_t end), void *context);

#endif
