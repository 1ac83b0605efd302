/* memory.h: aligned allocation, checked against overflow. */
#ifndef MORPHO_BASE_MEMORY_H
#define MORPHO_BASE_MEMORY_H

#include <stddef.h>

#define MO_CACHE_LINE_BYTES 64

/* Allocates count × size bytes, zeroed and aligned to MO_CACHE_LINE_BYTES. Returns NULL on overflow
 * or if out of memory; never NULL for a product of 0. Release it with free(). */
void *mo_alloc_aligned(size_t count, size_t size);

#endif
