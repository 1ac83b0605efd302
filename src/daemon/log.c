/* log.c: see log.h. A line is built in a fixed buffer on the stack: logging allocates nothing and
 * returns no errors. */
#include "log.h"

#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "log_writer.h"

static const char *const level_names[] = {"error", "warning", "info", "debug"};
static const int level_priorities[] = {3, 4, 6, 7};

/* The one piece of process-wide state that a logger needs. */
static struct {
  enum log_format format;
  bool journal;
  atomic_int level;
} logger = {.format = LOG_FORMAT_TEXT, .level = LOG_LEVEL_INFO};

struct line {
  char *text;
  size_t capacity, length; /* space for the newline and the NUL is reserved */
};

static void put(struct line *line, const char *bytes, size_t n)
{
  size_t room = line->capacity - 2 - line->length;
  if (n > room)
    n = room;
  memcpy(line->text + line->length, bytes, n);
  line->length += n;
}

static void put_text(struct line *line, const char *text)
{
  put(line, text, strlen(text));
}

__attribute__((format(printf, 2, 3))) static void put_format(struct line *line, const char *format,
                                                             ...)
{
  char text[64];
  va_list arguments;
  va_start(arguments, format);
  int n = vsnprintf(text, sizeof(text), format, arguments);
  va_end(arguments);
  if (n > 0)
    put(line, text, n < (int)sizeof(text) ? (size_t)n : sizeof(text) - 1);
}

/* JSON string escapes serve all formats: a quoted value holds no raw control byte, so it cannot
 * break the line. Bytes above 0x7f pass: names and labels are already checked as UTF-8. */
static void put_quoted(struct line *line, const char *text)
{
  put_text(line, "\"");
  for (const unsigned char *c = (const unsigned char *)text; *c != 0; c++) {
    if (line->capacity - line->length < 16)
      break;
    if (*c == '"' || *c == '\\')
      put_format(line, "\\%c", *c);
    else if (*c == '\n')
      put_text(line, "\\n");
    else if (*c < 0x20 || *c == 0x7f)
      put_format(line, "\\u%04x", *c);
    else
      put(line, (const char *)c, 1);
  }
  put_text(line, "\"");
}

static bool is_bare(const char *text)
{
  if (*text == 0)
    return false;
  for (const unsigned char *c = (const unsigned char *)text; *c != 0; c++)
    if (*c <= ' ' || *c == '"' || *c == '=' || *c == '\\' || *c >= 0x7f)
      return false;
  return true;
}

static void put_value(struct line *line, enum log_format format, const struct log_field *field)
{
  switch (field->kind) {
  case LOG_KIND_TEXT:
    if (field->value.text == NULL)
      put_text(line, "null");
    else if (format != LOG_FORMAT_JSON && is_bare(field->value.text))
      put_text(line, field->value.text);
    else
      put_quoted(line, field->value.text);
    break;
  case LOG_KIND_INT: put_format(line, "%" PRId64, field->value.integer); break;
  case LOG_KIND_REAL:
    if (isfinite(field->value.real))
      put_format(line, "%.6g", field->value.real);
    else
      put_text(line, format == LOG_FORMAT_JSON ? "null" : "nan");
    break;
  case LOG_KIND_BOOL: put_text(line, field->value.boolean ? "true" : "false"); break;
  }
}

static void put_time(struct line *line, int64_t time_us)
{
  time_t seconds = (time_t)(time_us / 1000000);
  struct tm utc;
  char text[40];
  if (gmtime_r(&seconds, &utc) == NULL)
    return;
  size_t n = strftime(text, sizeof(text), "%Y-%m-%dT%H:%M:%S", &utc);
  put(line, text, n);
  put_format(line, ".%06dZ", (int)(time_us % 1000000));
}

size_t log_format_line(char *text, size_t capacity, enum log_format format, bool priority,
                       int64_t time_us, enum log_level level, const char *message,
                       const struct log_field *fields, size_t n_fields)
{
  struct line line = {.text = text, .capacity = capacity};
  if (priority)
    put_format(&line, "<%d>", level_priorities[level]);
  switch (format) {
  case LOG_FORMAT_TEXT:
    if (time_us > 0) {
      put_time(&line, time_us);
      put_text(&line, " ");
    }
    put_format(&line, "%s: ", level_names[level]);
    put_text(&line, message);
    for (size_t i = 0; i < n_fields; i++) {
      put_format(&line, " %s=", fields[i].name);
      put_value(&line, format, &fields[i]);
    }
    break;
  case LOG_FORMAT_LOGFMT:
    if (time_us > 0) {
      put_text(&line, "time=");
      put_time(&line, time_us);
      put_text(&line, " ");
    }
    put_format(&line, "level=%s msg=", level_names[level]);
    put_quoted(&line, message);
    for (size_t i = 0; i < n_fields; i++) {
      put_format(&line, " %s=", fields[i].name);
      put_value(&line, format, &fields[i]);
    }
    break;
  case LOG_FORMAT_JSON:
    put_text(&line, "{");
    if (time_us > 0) {
      put_text(&line, "\"time\":\"");
      put_time(&line, time_us);
      put_text(&line, "\",");
    }
    put_format(&line, "\"level\":\"%s\",\"msg\":", level_names[level]);
    put_quoted(&line, message);
    for (size_t i = 0; i < n_fields; i++) {
      if (line.capacity - line.length < 128)
        break; /* so that the closing brace always fits */
      put_format(&line, ",\"%s\":", fields[i].name);
      /* Leave space for the closing quote and brace, and for the limit of the field itself. */
      struct line part = {.text = line.text, .capacity = line.capacity - 2, .length = line.length};
      put_value(&part, format, &fields[i]);
      line.length = part.length;
    }
    put_text(&line, "}");
    break;
  }
  /* Messages come from the program, but a newline in one must not forge a second line. */
  for (size_t i = 0; i < line.length; i++)
    if (line.text[i] == '\n')
      line.text[i] = ' ';
  line.text[line.length++] = '\n';
  line.text[line.length] = 0;
  return line.length;
}

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

int log_level_from_name(const char *name, enum log_level *level)
{
  for (size_t i = 0; i < sizeof(level_names) / sizeof(level_names[0]); i++)
    if (strcmp(name, level_names[i]) == 0) {
      *level = (enum log_level)i;
      return 0;
    }
  return -1;
}

int log_format_from_name(const char *name, enum log_format *format)
{
  static const char *const names[] = {"text", "logfmt", "json"};
  for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++)
    if (strcmp(name, names[i]) == 0) {
      *format = (enum log_format)i;
      return 0;
    }
  return -1;
}

static size_t format_now(char line[LOG_LINE_BYTES], enum log_level level, const char *message,
                         const struct log_field *fields, size_t n_fields)
{
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  int64_t time_us = logger.journal ? 0 : (int64_t)now.tv_sec * 1000000 + now.tv_nsec / 1000;
  return log_format_line(line, LOG_LINE_BYTES, logger.format, logger.journal, time_us, level,
                         message, fields, n_fields);
}

static size_t format_notice(char line[LOG_LINE_BYTES], uint64_t n)
{
  const struct log_field fields[] = {LOG_INT("lines", n)};
  return format_now(line, LOG_LEVEL_WARNING,
                    "log lines were dropped: standard error did not take them", fields, 1);
}

int log_start(void)
{
  return log_writer_start(format_notice);
}

void log_write(enum log_level level, const char *message, const struct log_field *fields,
               size_t n_fields)
{
  char line[LOG_LINE_BYTES];
  if (log_enabled(level))
    log_writer_put(line, format_now(line, level, message, fields, n_fields));
}
