/* memory.c: aligned allocation, checked against overflow. */
#include "base/memory.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

void *mo_alloc_aligned(size_t count, size_t size)
{
  size_t bytes;
  if (__builtin_mul_overflow(count, size, &bytes) || bytes > SIZE_MAX - MO_CACHE_LINE_BYTES)
    return NULL;
  bytes = (bytes / MO_CACHE_LINE_BYTES + 1) * MO_CACHE_LINE_BYTES; /* never 0 */
  void *memory = aligned_alloc(MO_CACHE_LINE_BYTES, bytes);
  if (memory != NULL)
    memset(memory, 0, bytes);
  return memory;
}
