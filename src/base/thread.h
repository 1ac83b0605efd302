/* thread.h: threads that block signals, and parallel loops. */
#ifndef MORPHO_BASE_THREAD_H
#define MORPHO_BASE_THREAD_H

#include <pthread.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Identifies the work that this thread does, for example by a job's id; −1: none. mo_parallel
 * passes it on to its threads. Signal handlers may read it. It is __thread, not _Thread_local,
 * because C++ supports __thread as well. */
extern __thread volatile int64_t mo_thread_tag;

/* Starts a thread like pthread_create. The thread blocks all signals except those that its own
 * faults raise, because a blocked fault would kill the process before a handler can record the
 * work. name: up to 15 characters, or NULL. */
int mo_thread_create(pthread_t *thread, const char *name, void *(*run)(void *context),
                     void *context);

/* Reads a caller's cancellation flag; NULL: never cancelled. */
static inline bool mo_is_cancelled(const volatile int *cancel)
{
  return cancel != NULL && __atomic_load_n(cancel, __ATOMIC_RELAXED) != 0;
}

static inline pthread_mutex_t *mo_lock(pthread_mutex_t *mutex)
{
  pthread_mutex_lock(mutex);
  return mutex;
}
static inline void mo_unlock(pthread_mutex_t *const *mutex)
{
  pthread_mutex_unlock(*mutex);
}
/* Locks a mutex until the block is left in any way. */
#define MO_GUARD(mutex)                                                                            \
  pthread_mutex_t *const mo_guard __attribute__((cleanup(mo_unlock))) = mo_lock(mutex)

/* Waits on a condition until a time of mo_clock_us. Returns false if that time has passed. */
bool mo_wait_until(pthread_cond_t *condition, pthread_mutex_t *mutex, int64_t until_us);

#define MO_PARALLEL_THREADS_MAX 64

/* Calls part(context, first, end) for consecutive ranges that together cover 0 … n − 1, each once.
 * Uses up to n_threads threads, including the caller's (0 counts as 1), and returns when all calls
 * have returned. The threads exist only for the loop; starting one costs about 20 µs, so a range
 * should take much longer. The result of a range must not depend on other ranges, or on how the
 * ranges are cut. If a thread cannot be started, the loop runs on fewer. The new threads block
 * signals. */
void mo_parallel(uint32_t n_threads, size_t n,
                 void (*part)(void *context, size_t first, size_t end), void *context);

#endif
