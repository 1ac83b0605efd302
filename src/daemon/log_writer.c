/* log_writer.c: see log_writer.h. */
#include "log_writer.h"

#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define RING_BYTES        ((size_t)1 << 20)
#define LAST_WORDS_ROUNDS 100 /* of one millisecond each */

static struct {
  pthread_mutex_t lock;
  pthread_cond_t filled, empty;
  pthread_t thread;
  size_t (*notice)(char line[LOG_LINE_BYTES], uint64_t n);
  bool quit;
  size_t begin, size; /* of the pending bytes in the ring */
  uint64_t untold;    /* lines dropped since the last notice */
  atomic_bool running;
  atomic_size_t pending; /* bytes in the ring and those being written; changed under the lock */
  _Atomic uint64_t dropped;
  char ring[RING_BYTES];
} writer = {.lock = PTHREAD_MUTEX_INITIALIZER};

static uint64_t count_lines(const char *text, size_t n)
{
  uint64_t lines = 0;
  for (size_t i = 0; i < n; i++)
    lines += text[i] == '\n';
  return lines;
}

/* Appends to the ring, under the lock. False: no space. */
static bool push(const char *line, size_t n)
{
  if (n > RING_BYTES - writer.size)
    return false;
  size_t at = (writer.begin + writer.size) % RING_BYTES;
  size_t first = n < RING_BYTES - at ? n : RING_BYTES - at;
  memcpy(writer.ring + at, line, first);
  memcpy(writer.ring, line + first, n - first);
  writer.size += n;
  atomic_fetch_add(&writer.pending, n);
  pthread_cond_signal(&writer.filled);
  return true;
}

/* Reports dropped lines, under the lock, once half of the ring is free, so that a slow reader does
 * not get a notice for every few lines. */
static void tell_dropped(void)
{
  char line[LOG_LINE_BYTES];
  if (writer.untold > 0 && writer.size <= RING_BYTES / 2 &&
      push(line, writer.notice(line, writer.untold)))
    writer.untold = 0;
}

static void drop(uint64_t lines)
{
  writer.untold += lines;
  atomic_fetch_add(&writer.dropped, lines);
}

/* Takes, under the lock, as many whole lines as one write to a pipe keeps together. */
static size_t take(char text[LOG_LINE_BYTES])
{
  size_t n = writer.size < LOG_LINE_BYTES ? writer.size : LOG_LINE_BYTES;
  size_t first = n < RING_BYTES - writer.begin ? n : RING_BYTES - writer.begin;
  memcpy(text, writer.ring + writer.begin, first);
  memcpy(text + first, writer.ring, n - first);
  while (n > 0 && text[n - 1] != '\n')
    n--;
  writer.begin = (writer.begin + n) % RING_BYTES;
  writer.size -= n;
  return n;
}

/* Returns how many bytes were written: all, unless standard error fails. */
static size_t write_all(const char *text, size_t n)
{
  size_t done = 0;
  while (done < n) {
    ssize_t written = write(STDERR_FILENO, text + done, n - done);
    if (written >= 0)
      done += (size_t)written;
    else if (errno == EAGAIN) /* another process set O_NONBLOCK */
      (void)poll(&(struct pollfd){.fd = STDERR_FILENO, .events = POLLOUT}, 1, -1);
    else if (errno != EINTR)
      break;
  }
  return done;
}

static void *write_lines(void *context)
{
  (void)context;
  char text[LOG_LINE_BYTES];
  pthread_mutex_lock(&writer.lock);
  while (writer.size > 0 || !writer.quit) {
    if (writer.size == 0) {
      pthread_cond_wait(&writer.filled, &writer.lock);
      continue;
    }
    size_t n = take(text);
    pthread_mutex_unlock(&writer.lock);
    size_t done = write_all(text, n);
    pthread_mutex_lock(&writer.lock);
    if (done == n)
      tell_dropped(); /* after a failed write, the next line tries again: a notice of its own loss
                         would repeat without end */
    else
      drop(count_lines(text + done, n - done));
    atomic_fetch_sub(&writer.pending, n);
    if (atomic_load(&writer.pending) == 0)
      pthread_cond_broadcast(&writer.empty);
  }
  pthread_mutex_unlock(&writer.lock);
  return NULL;
}

int log_writer_start(size_t (*notice)(char line[LOG_LINE_BYTES], uint64_t n))
{
  pthread_condattr_t monotonic;
  if (atomic_load(&writer.running))
    return 0;
  pthread_condattr_init(&monotonic);
  pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
  pthread_cond_init(&writer.filled, NULL);
  pthread_cond_init(&writer.empty, &monotonic);
  pthread_condattr_destroy(&monotonic);
  writer.notice = notice;
  if (pthread_create(&writer.thread, NULL, write_lines, NULL) != 0)
    return -1;
  atomic_store(&writer.running, true);
  return 0;
}

void log_writer_put(const char *line, size_t n)
{
  if (!atomic_load(&writer.running)) {
    (void)write_all(line, n);
    return;
  }
  pthread_mutex_lock(&writer.lock);
  tell_dropped();
  /* Drop lines until their number can be reported, so that the notice stands where they are
   * missing. */
  if (writer.untold > 0 || !push(line, n))
    drop(1);
  pthread_mutex_unlock(&writer.lock);
}

void log_writer_stop(int timeout_ms)
{
  struct timespec until;
  int waited = 0;
  if (!atomic_load(&writer.running))
    return;
  clock_gettime(CLOCK_MONOTONIC, &until);
  until.tv_sec += timeout_ms / 1000;
  until.tv_nsec += timeout_ms % 1000 * 1000000L;
  if (until.tv_nsec >= 1000000000L) {
    until.tv_sec++;
    until.tv_nsec -= 1000000000L;
  }
  pthread_mutex_lock(&writer.lock);
  while (atomic_load(&writer.pending) > 0 && waited == 0)
    waited = pthread_cond_timedwait(&writer.empty, &writer.lock, &until);
  writer.quit = true;
  pthread_cond_signal(&writer.filled);
  pthread_mutex_unlock(&writer.lock);
  if (waited == 0)
    pthread_join(writer.thread, NULL);
  else
    pthread_detach(writer.thread); /* the thread may never return; the process ends without it */
}

void log_writer_last_words(const char *text, size_t n)
{
  struct pollfd room = {.fd = STDERR_FILENO, .events = POLLOUT};
  for (int i = 0; i < LAST_WORDS_ROUNDS && atomic_load(&writer.pending) > 0; i++)
    (void)poll(NULL, 0, 1);
  if (poll(&room, 1, 0) == 1 && (room.revents & POLLOUT) != 0) {
    ssize_t written = write(STDERR_FILENO, text, n);
    (void)written;
  }
}

uint64_t log_dropped(void)
{
  return atomic_load(&writer.dropped);
}
