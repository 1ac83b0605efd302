/* thread.c: see thread.h. The program decides which threads handle other signals. */
#include "base/thread.h"

#include <errno.h>
#include <signal.h>
#include <time.h>

__thread volatile int64_t mo_thread_tag = -1;

int mo_thread_create(pthread_t *thread, const char *name, void *(*run)(void *context),
                     void *context)
{
  static const int faults[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGTRAP, SIGSYS};
  sigset_t blocked, before;
  sigfillset(&blocked);
  for (size_t i = 0; i < sizeof(faults) / sizeof(faults[0]); i++)
    sigdelset(&blocked, faults[i]);
  pthread_sigmask(SIG_SETMASK, &blocked, &before);
  const int error = pthread_create(thread, NULL, run, context);
  pthread_sigmask(SIG_SETMASK, &before, NULL);
  if (error == 0 && name != NULL)
    (void)pthread_setname_np(*thread, name);
  return error;
}

bool mo_wait_until(pthread_cond_t *condition, pthread_mutex_t *mutex, int64_t until_us)
{
  const struct timespec until = {.tv_sec = until_us / 1000000,
                                 .tv_nsec = until_us % 1000000 * 1000};
  return pthread_cond_clockwait(condition, mutex, CLOCK_MONOTONIC, &until) != ETIMEDOUT;
}

/* ---- loops ---- */

struct range {
  void (*part)(void *context, size_t first, size_t end);
  void *context;
  size_t first, end;
  int64_t tag;
  pthread_t thread;
  bool started;
};

static void *run(void *argument)
{
  const struct range *range = argument;
  mo_thread_tag = range->tag;
  range->part(range->context, range->first, range->end);
  return NULL;
}

void mo_parallel(uint32_t n_threads, size_t n,
                 void (*part)(void *context, size_t first, size_t end), void *context)
{
  struct range ranges[MO_PARALLEL_THREADS_MAX];
  size_t n_ranges = n_threads < MO_PARALLEL_THREADS_MAX ? n_threads : MO_PARALLEL_THREADS_MAX;
  if (n_ranges > n)
    n_ranges = n;
  if (n_ranges <= 1) {
    if (n > 0)
      part(context, 0, n);
    return;
  }
  for (size_t i = 0; i < n_ranges; i++) {
    const size_t rest = n % n_ranges; /* the first ranges have one more item */
    ranges[i] = (struct range){.part = part,
                               .context = context,
                               .tag = mo_thread_tag,
                               .first = n / n_ranges * i + (i < rest ? i : rest)};
    ranges[i].end = ranges[i].first + n / n_ranges + (i < rest);
    ranges[i].started = i > 0 && mo_thread_create(&ranges[i].thread, NULL, run, &ranges[i]) == 0;
  }
  for (size_t i = 0; i < n_ranges; i++)
    if (!ranges[i].started)
      run(&ranges[i]);
  for (size_t i = 0; i < n_ranges; i++)
    if (ranges[i].started)
      pthread_join(ranges[i].thread, NULL);
}
