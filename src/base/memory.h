/* memory.h: aligned allocation, checked against overflow, and memory for short-lived use. */
#ifndef MORPHO_BASE_MEMORY_H
#define MORPHO_BASE_MEMORY_H

#include <stddef.h>

#define MO_CACHE_LINE_BYTES 64

/* Allocates count × size bytes, zeroed and aligned to MO_CACHE_LINE_BYTES. Returns NULL on overflow
 * or if out of memory; never NULL for a product of 0. Release it with free(). */
void *mo_alloc_aligned(size_t count, size_t size);

/* Allocates count × size bytes, zeroed, in separate pages. mo_pages_free (with the same numbers;
 * NULL-safe) returns them to the system at once, whereas malloc may keep megabytes of freed memory.
 * Returns NULL on overflow or if out of memory. */
void *mo_pages_alloc(size_t count, size_t size);
void mo_pages_free(void *memory, size_t count, size_t size);

#endif
