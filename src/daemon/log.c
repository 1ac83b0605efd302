/* log.c: see log.h. A line is built in a fixed buffer on the stack: logging allocates nothing and
 * returns no errors.
 *
 * Lines go into a ring of bounded size, and one thread writes them, so that no other thread waits
 * for a slow reader of the log. If standard error is not read, that thread blocks and the ring
 * fills up. Lines that do not fit are dropped and counted; once half of the ring is free again, one
 * line reports their number. Standard error keeps its inherited mode, because other processes may
 * share it. */
#include "log.h"

#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <poll.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "base/clock.h"
#include "base/text.h"
#include "base/thread.h"

#define RING_BYTES        ((size_t)1 << 20)
#define LAST_WORDS_ROUNDS 100 /* number of rounds, of one millisecond each */

static const char *const level_names[] = {"error", "warning", "info", "debug"};
static const int level_priorities[] = {3, 4, 6, 7};

static struct {
  enum log_format format;
  bool journal;
  atomic_int level;
} logger = {.format = LOG_FORMAT_TEXT, .level = LOG_LEVEL_INFO};

/* ---- lines ---- */

static bool is_bare(const char *text)
{
  if (*text == 0)
    return false;
  for (const unsigned char *c = (const unsigned char *)text; *c != 0; c++)
    if (*c <= ' ' || *c == '"' || *c == '=' || *c == '\\' || *c >= 0x7f)
      return false;
  return true;
}

/* All formats use the escapes of JSON strings: a quoted value contains no raw control character, so
 * it can break neither the line nor the terminal that shows it. */
static void put_value(struct mo_text *line, enum log_format format, const struct log_field *field)
{
  const char *text = field->value.text;
  switch (field->kind) {
  case LOG_KIND_TEXT:
    if (text == NULL || (format != LOG_FORMAT_JSON && is_bare(text)))
      mo_text_add(line, text != NULL ? text : "null");
    else
      mo_text_shown_string(line, text, strlen(text));
    break;
  case LOG_KIND_INT: mo_text_format(line, "%" PRId64, field->value.integer); break;
  case LOG_KIND_REAL:
    if (isfinite(field->value.real))
      mo_text_format(line, "%.6g", field->value.real);
    else
      mo_text_add(line, format == LOG_FORMAT_JSON ? "null" : "nan");
    break;
  }
}

static void put_time(struct mo_text *line, int64_t time_us)
{
  time_t seconds = (time_t)(time_us / 1000000);
  struct tm utc;
  char text[40];
  if (gmtime_r(&seconds, &utc) != NULL &&
      strftime(text, sizeof(text), "%Y-%m-%dT%H:%M:%S", &utc) > 0)
    mo_text_format(line, "%s.%06dZ", text, (int)(time_us % 1000000));
}

size_t log_format_line(char *text, size_t capacity, enum log_format format, bool priority,
                       int64_t time_us, enum log_level level, const char *message,
                       const struct log_field *fields, size_t n_fields)
{
  /* The last two bytes are for a closing brace and the newline. */
  struct mo_text line = {.data = text, .capacity = capacity - 2, .is_fixed = true};
  const bool json = format == LOG_FORMAT_JSON, plain = format == LOG_FORMAT_TEXT;
  if (priority)
    mo_text_format(&line, "<%d>", level_priorities[level]);
  mo_text_add(&line, json ? "{" : "");
  if (time_us > 0) {
    mo_text_add(&line, json ? "\"time\":\"" : plain ? "" : "time=");
    put_time(&line, time_us);
    mo_text_add(&line, json ? "\"," : " ");
  }
  mo_text_format(&line,
                 json    ? "\"level\":\"%s\",\"msg\":"
                 : plain ? "%s: "
                         : "level=%s msg=",
                 level_names[level]);
  if (plain)
    mo_text_add(&line, message);
  else
    mo_text_shown_string(&line, message, strlen(message));
  for (size_t i = 0; i < n_fields && !line.failed; i++) {
    const size_t before = line.size;
    mo_text_format(&line, json ? ",\"%s\":" : " %s=", fields[i].name);
    put_value(&line, format, &fields[i]);
    if (line.failed) /* it does not fit: the line ends before it */
      line.size = before;
  }
  /* Messages come from the program, but a newline in a message must not produce a second line. */
  for (size_t i = 0; i < line.size; i++)
    if (text[i] == '\n')
      text[i] = ' ';
  return line.size + (size_t)sprintf(text + line.size, json ? "}\n" : "\n");
}

static size_t format_now(char line[LOG_LINE_BYTES], enum log_level level, const char *message,
                         const struct log_field *fields, size_t n_fields)
{
  int64_t time_us = logger.journal ? 0 : mo_clock_wall_us();
  return log_format_line(line, LOG_LINE_BYTES, logger.format, logger.journal, time_us, level,
                         message, fields, n_fields);
}

static size_t format_notice(char line[LOG_LINE_BYTES], uint64_t n)
{
  const struct log_field fields[] = {LOG_INT("lines", n)};
  return format_now(line, LOG_LEVEL_WARNING,
                    "log lines were dropped: they could not be written to standard error", fields,
                    1);
}

/* ---- the thread that writes ---- */

static struct {
  pthread_mutex_t lock;
  pthread_cond_t filled, empty;
  pthread_t thread;
  bool quit;
  size_t begin, size;  /* of the pending bytes in the ring */
  uint64_t unreported; /* lines dropped since the last notice */
  atomic_bool running;
  atomic_size_t pending; /* bytes in the ring and those being written; changed under the lock */
  _Atomic uint64_t dropped;
  char ring[RING_BYTES];
} writer = {.lock = PTHREAD_MUTEX_INITIALIZER,
            .filled = PTHREAD_COND_INITIALIZER,
            .empty = PTHREAD_COND_INITIALIZER};

/* Appends to the ring, under the lock. Returns false if there is no space. */
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
static void report_dropped(void)
{
  char line[LOG_LINE_BYTES];
  if (writer.unreported > 0 && writer.size <= RING_BYTES / 2 &&
      push(line, format_notice(line, writer.unreported)))
    writer.unreported = 0;
}

static void drop(const char *lines, size_t n)
{
  for (size_t i = 0; i < n; i++)
    if (lines[i] == '\n') {
      writer.unreported++;
      atomic_fetch_add(&writer.dropped, 1);
    }
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
      report_dropped(); /* after a failed write, the next line retries: a notice of its own loss
                         * would repeat endlessly */
    else
      drop(text + done, n - done);
    atomic_fetch_sub(&writer.pending, n);
    if (atomic_load(&writer.pending) == 0)
      pthread_cond_broadcast(&writer.empty);
  }
  pthread_mutex_unlock(&writer.lock);
  return NULL;
}

int log_start(void)
{
  if (atomic_load(&writer.running))
    return 0;
  if (pthread_create(&writer.thread, NULL, write_lines, NULL) != 0)
    return -1;
  atomic_store(&writer.running, true);
  return 0;
}

/* Writes a whole line. Never blocks once the thread runs. */
static void put_line(const char *line, size_t n)
{
  if (!atomic_load(&writer.running)) {
    (void)write_all(line, n);
    return;
  }
  MO_GUARD(&writer.lock);
  report_dropped();
  /* Drop lines until their number can be reported, so that the notice appears where they are
   * missing. */
  if (writer.unreported > 0 || !push(line, n))
    drop(line, n);
}

void log_stop(int timeout_ms)
{
  const int64_t until_us = mo_clock_us() + (int64_t)timeout_ms * 1000;
  bool in_time = true;
  if (!atomic_load(&writer.running))
    return;
  pthread_mutex_lock(&writer.lock);
  while (atomic_load(&writer.pending) > 0 && in_time)
    in_time = mo_wait_until(&writer.empty, &writer.lock, until_us);
  writer.quit = true;
  pthread_cond_signal(&writer.filled);
  pthread_mutex_unlock(&writer.lock);
  if (in_time)
    pthread_join(writer.thread, NULL);
  else
    pthread_detach(writer.thread); /* the thread may never return; the process ends without it */
}

void log_last_words(const char *text, size_t n)
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

/* ---- the logger ---- */

/* systemd sets JOURNAL_STREAM to "device:inode" of the stream that it connected. */
static bool stderr_is_journal(void)
{
  const char *stream = getenv("JOURNAL_STREAM");
  struct stat status;
  char text[64];
  if (stream == NULL || fstat(STDERR_FILENO, &status) != 0)
    return false;
  snprintf(text, sizeof(text), "%ju:%ju", (uintmax_t)status.st_dev, (uintmax_t)status.st_ino);
  return strcmp(stream, text) == 0;
}

void log_open(enum log_format format, enum log_level level)
{
  logger.format = format;
  logger.journal = stderr_is_journal();
  log_set_level(level);
}

void log_set_level(enum log_level level)
{
  atomic_store_explicit(&logger.level, (int)level, memory_order_relaxed);
}

bool log_enabled(enum log_level level)
{
  return (int)level <= atomic_load_explicit(&logger.level, memory_order_relaxed);
}

void log_write(enum log_level level, const char *message, const struct log_field *fields,
               size_t n_fields)
{
  char line[LOG_LINE_BYTES];
  if (log_enabled(level))
    put_line(line, format_now(line, level, message, fields, n_fields));
}
