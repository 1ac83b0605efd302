/* check.h: a small TAP producer. A test program lists its cases and ends with `CHECK_MAIN(cases)`:
 *
 *   static void adds(void) { CHECK(1 + 1 == 2); CHECK_NEAR(0.1 + 0.2, 0.3, 1e-15); }
 *   static const struct check_case cases[] = {{"adds", adds}};
 *   CHECK_MAIN(cases)
 *
 * After a failed check, which prints a diagnostic, the case continues; a case with a failed check
 * is "not ok". REQUIRE leaves the case. {"adds 2", WITH(adds_number, 2)} calls `adds_number(2)`.
 * CHECK_MAIN_WITH(setup, cases) calls `setup` before the first case. */
#ifndef MORPHO_TESTS_CHECK_H
#define MORPHO_TESTS_CHECK_H

/* In builds with the address or thread sanitizer, which slow computations down eight to thirty
 * times: a test can see the same code there in fewer runs. */
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define CHECK_SANITIZED 1
#else
#define CHECK_SANITIZED 0
#endif

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct check_case {
  const char *name;
  void (*run)(void);
  void (*run_with)(int); /* instead of `run`; see WITH */
  int number;
};
#define WITH(function, number) NULL, function, number

static const struct check_case *check_now;

static inline void check_run_with(void)
{
  check_now->run_with(check_now->number);
}

static int check_failures;
/* Runs a case with the setup and cleanup that all cases of a program need; NULL: none. */
static void (*check_around)(void (*run)(void));

#define CHECK(condition)                                                                           \
  do {                                                                                             \
    if (!(condition)) {                                                                            \
      check_failures++;                                                                            \
      printf("# %s:%d: failed: %s\n", __FILE__, __LINE__, #condition);                             \
    }                                                                                              \
  } while (0)

#define REQUIRE(condition)                                                                         \
  do {                                                                                             \
    if (!(condition)) {                                                                            \
      check_failures++;                                                                            \
      printf("# %s:%d: required: %s\n", __FILE__, __LINE__, #condition);                           \
      return;                                                                                      \
    }                                                                                              \
  } while (0)

#define CHECK_NEAR(actual, expected, tolerance)                                                    \
  do {                                                                                             \
    double check_a = (actual), check_e = (expected), check_t = (tolerance);                        \
    if (!(fabs(check_a - check_e) <= check_t)) {                                                   \
      check_failures++;                                                                            \
      printf("# %s:%d: %s = %.17g, expected %.17g within %g\n", __FILE__, __LINE__, #actual,       \
             check_a, check_e, check_t);                                                           \
    }                                                                                              \
  } while (0)

#define CHECK_INT(actual, expected)                                                                \
  do {                                                                                             \
    long long check_a = (long long)(actual), check_e = (long long)(expected);                      \
    if (check_a != check_e) {                                                                      \
      check_failures++;                                                                            \
      printf("# %s:%d: %s = %lld, expected %lld\n", __FILE__, __LINE__, #actual, check_a,          \
             check_e);                                                                             \
    }                                                                                              \
  } while (0)

#define CHECK_TEXT(actual, expected)                                                               \
  do {                                                                                             \
    const char *check_a = (actual), *check_e = (expected);                                         \
    if (check_a == NULL || strcmp(check_a, check_e) != 0) {                                        \
      check_failures++;                                                                            \
      printf("# %s:%d: %s = \"%s\", expected \"%s\"\n", __FILE__, __LINE__, #actual,               \
             check_a ? check_a : "(null)", check_e ? check_e : "(null)");                          \
    }                                                                                              \
  } while (0)

#define CHECK_OK(status)   CHECK_INT(status, 0)
#define REQUIRE_OK(status) REQUIRE((status) == 0)

/* Checks that a text contains these words. */
#define CHECK_HAS(actual, words)                                                                   \
  do {                                                                                             \
    const char *check_a = (actual), *check_w = (words);                                            \
    if (check_a == NULL || strstr(check_a, check_w) == NULL) {                                     \
      check_failures++;                                                                            \
      printf("# %s:%d: %s = \"%s\" lacks \"%s\"\n", __FILE__, __LINE__, #actual,                   \
             check_a ? check_a : "(null)", check_w);                                               \
    }                                                                                              \
  } while (0)

/* The same for a struct mo_message. */
#define CHECK_SAYS(message, words) CHECK_HAS((message).text, words)

/* Checks that the first n elements of two arrays have the same bytes. */
#define SAME(a, b, n) (memcmp((a), (b), (size_t)(n) * sizeof(*(a))) == 0)

#define COUNT(array) (sizeof(array) / sizeof((array)[0]))

/* ---- automatic cleanup: at the end of the case or, for things that `setup` made, of the program
 * ---- */

static struct check_kept {
  void (*drop)(void *thing);
  void *thing;
} check_kept[16384];
static size_t check_n_kept;

static inline void *check_keep(void *thing, void (*drop)(void *thing))
{
  if (check_n_kept == COUNT(check_kept)) {
    printf("Bail out! a case keeps too much\n");
    exit(1);
  }
  check_kept[check_n_kept++] = (struct check_kept){drop, thing};
  return thing;
}

/* Frees all but the oldest n things, the newest first. */
static inline void check_drop_to(size_t n)
{
  while (check_n_kept > n) {
    check_n_kept--;
    check_kept[check_n_kept].drop(check_kept[check_n_kept].thing);
  }
}

static inline size_t check_place_of(const void *thing)
{
  size_t place = 0;
  while (place < check_n_kept && check_kept[place].thing != thing)
    place++;
  return place;
}

/* Frees `thing` and everything that was kept after it. */
static inline void check_drop_from(const void *thing)
{
  check_drop_to(check_place_of(thing));
}

/* Returns a kept thing to the caller, who then owns it. */
static inline void *check_take(void *thing)
{
  const size_t place = check_place_of(thing);
  check_n_kept--;
  for (size_t i = place; i < check_n_kept; i++)
    check_kept[i] = check_kept[i + 1];
  return thing;
}

/* argv[1], if given: only the cases whose name contains it. */
static inline int check_run(const struct check_case *cases, size_t n, int argc, char **argv)
{
  const char *wanted = argc > 1 ? argv[1] : "";
  const size_t kept = check_n_kept;
  int planned = 0, number = 0, failed = 0;
  setvbuf(stdout, NULL, _IOLBF, 0);
  for (size_t i = 0; i < n; i++)
    planned += strstr(cases[i].name, wanted) != NULL;
  printf("1..%d\n", planned);
  for (size_t i = 0; i < n; i++) {
    if (strstr(cases[i].name, wanted) == NULL)
      continue;
    check_failures = 0;
    check_now = &cases[i];
    void (*run)(void) = cases[i].run_with != NULL ? check_run_with : cases[i].run;
    if (check_around != NULL)
      check_around(run);
    else
      run();
    check_drop_to(kept);
    printf("%s %d - %s\n", check_failures ? "not ok" : "ok", ++number, cases[i].name);
    failed += check_failures != 0;
  }
  if (planned == 0)
    printf("Bail out! no case is called \"%s\"\n", wanted);
  check_drop_to(0);
  return failed != 0 || planned == 0;
}

#define CHECK_MAIN(cases)                                                                          \
  int main(int argc, char **argv)                                                                  \
  {                                                                                                \
    return check_run(cases, COUNT(cases), argc, argv);                                             \
  }

#define CHECK_MAIN_AROUND(cases, around)                                                           \
  int main(int argc, char **argv)                                                                  \
  {                                                                                                \
    check_around = around;                                                                         \
    return check_run(cases, COUNT(cases), argc, argv);                                             \
  }

#define CHECK_MAIN_WITH(setup, cases)                                                              \
  int main(int argc, char **argv)                                                                  \
  {                                                                                                \
    setup();                                                                                       \
    return check_run(cases, COUNT(cases), argc, argv);                                             \
  }

#endif
