/* memory.c: see memory.h. */
#include "base/memory.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

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

void *mo_pages_alloc(size_t count, size_t size)
{
  size_t bytes;
  if (__builtin_mul_overflow(count, size, &bytes))
    return NULL;
  void *memory =
      mmap(NULL, bytes > 0 ? bytes : 1, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  return memory != MAP_FAILED ? memory : NULL;
}

void mo_pages_free(void *memory, size_t count, size_t size)
{
  if (memory != NULL)
    (void)munmap(memory, count * size > 0 ? count * size : 1);
}
