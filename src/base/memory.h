/* memory.h: aligned allocation, checked against overflow. */
#ifndef MORPHO_BASE_MEMORY_H
#define MORPHO_BASE_MEMORY_H

#include <stddef.h>

#define MO_CACHE_LINE_BYTES 64

/* count × size bytes, zeroed, aligned to MO_CACHE_LINE_BYTES; NULL if that overflows or memory is
 * out. Never NULL for a product of 0. Freed with free(). */
void *mo_alloc_aligned(size_t count, size_t size);

#endif
