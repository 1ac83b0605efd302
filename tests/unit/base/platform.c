/* platform.c: allocation, clock, error texts. */
#include "../check.h"

#include "base/clock.h"
#include "base/memory.h"
#include "base/thread.h"

#include <morpho/error.h>
#include <stdint.h>

static void allocation(void)
{
  for (size_t n = 0; n < 300; n += 7) {
    unsigned char *memory = mo_alloc_aligned(n, 3);
    REQUIRE(memory != NULL);
    CHECK((uintptr_t)memory % MO_CACHE_LINE_BYTES == 0);
    int sum = 0;
    for (size_t i = 0; i < 3 * n; i++) {
      sum += memory[i];
      memory[i] = 0xff;
    }
    CHECK_INT(sum, 0);
    free(memory);
  }
  volatile size_t huge =
      SIZE_MAX; /* volatile, because otherwise the compiler would warn about what is tested here */
  CHECK(mo_alloc_aligned(huge / 2, 3) == NULL);
  CHECK(mo_alloc_aligned(huge, 1) == NULL);
  CHECK(mo_alloc_aligned(huge - 10, 1) == NULL);
}

struct tally {
  unsigned char seen[1000];
};

static void tick(void *context, size_t first, size_t end)
{
  struct tally *tally = context;
  for (size_t i = first; i < end; i++)
    tally->seen[i] = (unsigned char)(tally->seen[i] + (mo_thread_tag == 77 ? 1 : 2));
}

static void parallel_loops(void)
{
  static const size_t sizes[] = {0, 1, 2, 5, 63, 64, 65, 999, 1000};
  static const uint32_t threads[] = {
      0, 1, 2, 3, 7, MO_PARALLEL_THREADS_MAX, MO_PARALLEL_THREADS_MAX + 9, UINT32_MAX};
  int wrong = 0;
  CHECK_INT(mo_thread_tag, -1);
  mo_thread_tag = 77; /* all threads inherit the tag */
  for (size_t s = 0; s < sizeof(sizes) / sizeof(sizes[0]); s++)
    for (size_t t = 0; t < sizeof(threads) / sizeof(threads[0]); t++) {
      struct tally tally = {{0}};
      mo_parallel(threads[t], sizes[s], tick, &tally);
      for (size_t i = 0; i < sizeof(tally.seen); i++)
        wrong += tally.seen[i] != (i < sizes[s]);
    }
  CHECK_INT(wrong, 0);
  CHECK_INT(mo_thread_tag, 77);
  mo_thread_tag = -1;
}

static void clock_goes_on(void)
{
  uint64_t before = mo_clock_ns();
  uint64_t now = before;
  for (int i = 0; i < 1000000 && now < before + 1000; i++) {
    uint64_t next = mo_clock_ns();
    CHECK(next >= now);
    now = next;
  }
  CHECK(now >= before + 1000);
}

static void texts(void)
{
  for (int code = MO_ERR_DEVICE; code <= MO_OK; code++) {
    for (int other = MO_ERR_DEVICE; other < code; other++)
      CHECK(strcmp(mo_error_text(code), mo_error_text(other)) != 0);
    CHECK(strcmp(mo_error_text(code), "unknown error") != 0);
  }
  CHECK_TEXT(mo_error_text(1), "unknown error");
  CHECK_TEXT(mo_error_text(-1000), "unknown error");
  struct mo_message message;
  CHECK_INT(mo_fail(&message, MO_ERR_RANGE, "%d is above %s", 7, "six"), MO_ERR_RANGE);
  CHECK_TEXT(message.text, "7 is above six");
  CHECK_INT(mo_fail(&message, MO_ERR_LIMIT, "%0500d", 1), MO_ERR_LIMIT);
  CHECK_INT(strlen(message.text), sizeof(message.text) - 1);
  CHECK_INT(mo_fail(NULL, MO_ERR_IO, "nobody listens"), MO_ERR_IO);
}

static const struct check_case cases[] = {
    {"memory is aligned, zeroed, and checked against overflow", allocation},
    {"the clock advances", clock_goes_on},
    {"a loop on several threads", parallel_loops},
    {"each code has its own words", texts},
};
CHECK_MAIN(cases)
