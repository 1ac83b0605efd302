/* parallel.h: runs one loop on several threads. */
#ifndef MORPHO_BASE_PARALLEL_H
#define MORPHO_BASE_PARALLEL_H

#include <stddef.h>
#include <stdint.h>

#define MO_PARALLEL_THREADS_MAX 64

/* Calls part(context, first, end) for consecutive ranges that together cover 0 … n − 1, each once.
 * Uses up to n_threads threads, the caller's included (0 counts as 1), and returns when all calls
 * have returned. The result of a range must not depend on other ranges, or on how the ranges are
 * cut. If a thread cannot be started, the loop runs on fewer. The new threads block signals. */
void mo_parallel(uint32_t n_threads, size_t n,
                 void (*part)(void *context, size_t first, size_t end), void *context);

#endif
