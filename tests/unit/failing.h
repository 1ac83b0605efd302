/* failing.h: an allocator that fails on demand. For tests linked with --wrap for each of these
 * functions. */
#ifndef MORPHO_TESTS_FAILING_H
#define MORPHO_TESTS_FAILING_H

#include "check.h"

#include <morpho/error.h>

#include <stdatomic.h>
#include <stdbool.h>

void *__real_malloc(size_t size);
void *__real_calloc(size_t count, size_t size);
void *__real_realloc(void *old, size_t size);
void *__real_aligned_alloc(size_t alignment, size_t size);
char *__real_strdup(const char *text);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t count, size_t size);
void *__wrap_realloc(void *old, size_t size);
void *__wrap_aligned_alloc(size_t alignment, size_t size);
char *__wrap_strdup(const char *text);

static atomic_long left = -1; /* allocations until one fails; negative = never */
static bool fails_for_good;   /* all allocations from there on fail, and `left` stays 0 */

static int fails(void)
{
  long now = left;
  while ((now > 0 || (now == 0 && !fails_for_good)) &&
         !atomic_compare_exchange_weak(&left, &now, now - 1))
    ;
  return now == 0;
}

void *__wrap_malloc(size_t size)
{
  return fails() ? NULL : __real_malloc(size);
}

void *__wrap_calloc(size_t count, size_t size)
{
  return fails() ? NULL : __real_calloc(count, size);
}

void *__wrap_realloc(void *old, size_t size)
{
  return fails() ? NULL : __real_realloc(old, size);
}

void *__wrap_aligned_alloc(size_t alignment, size_t size)
{
  return fails() ? NULL : __real_aligned_alloc(alignment, size);
}

char *__wrap_strdup(const char *text)
{
  return fails() ? NULL : __real_strdup(text);
}

/* Runs `work` with the first, the second, … allocation failing, until no allocation is left to
 * fail. At least `least` allocations must occur. */
static inline void each_fails(int (*work)(void), int least)
{
  for (int failed = 0; failed < 10000; failed++) {
    left = failed;
    const int r = work();
    const bool reached = left < 0;
    left = -1;
    CHECK_INT(r, reached ? MO_ERR_NO_MEMORY : MO_OK);
    if (!reached) {
      printf("# %d allocations failed in turn\n", failed);
      CHECK(failed >= least);
      return;
    }
  }
  CHECK(0); /* it does not end */
}

#endif
