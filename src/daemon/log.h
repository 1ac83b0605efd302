/* log.h: structured log lines on standard error.
 *
 * A line is a level, a message and fields. Three formats: `text` for people, `logfmt` and `json`
 * for programs. If standard error is the systemd journal, lines start with their priority ("<6>")
 * and omit the time, which the journal adds. Lines are written whole, so that lines from several
 * threads never mix. Any thread may change the level at any time. */
#ifndef MORPHO_DAEMON_LOG_H
#define MORPHO_DAEMON_LOG_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Longest line; at most PIPE_BUF, so that lines from several processes never mix. */
#define LOG_LINE_BYTES 4096

enum log_level { LOG_LEVEL_ERROR = 0, LOG_LEVEL_WARNING, LOG_LEVEL_INFO, LOG_LEVEL_DEBUG };
enum log_format { LOG_FORMAT_TEXT = 0, LOG_FORMAT_LOGFMT, LOG_FORMAT_JSON };

enum log_kind { LOG_KIND_TEXT, LOG_KIND_INT, LOG_KIND_REAL };

struct log_field {
  const char *name; /* [a-z0-9_]+ */
  enum log_kind kind;
  union {
    const char *text; /* NULL is written as null */
    int64_t integer;
    double real;
  } value;
};

#define LOG_TEXT(field_name, field_value)                                                          \
  ((struct log_field){.name = (field_name), .kind = LOG_KIND_TEXT, .value.text = (field_value)})
#define LOG_INT(field_name, field_value)                                                           \
  ((struct log_field){                                                                             \
      .name = (field_name), .kind = LOG_KIND_INT, .value.integer = (int64_t)(field_value)})
#define LOG_REAL(field_name, field_value)                                                          \
  ((struct log_field){.name = (field_name), .kind = LOG_KIND_REAL, .value.real = (field_value)})

/* log_info("listening", LOG_TEXT("address", a), LOG_INT("port", p)); */
#define LOG_AT(level, message, ...)                                                                \
  do {                                                                                             \
    const struct log_field log_fields[] = {{0}, ##__VA_ARGS__};                                    \
    log_write((level), (message), log_fields + 1, sizeof(log_fields) / sizeof(log_fields[0]) - 1); \
  } while (0)
#define log_error(message, ...)   LOG_AT(LOG_LEVEL_ERROR, message, ##__VA_ARGS__)
#define log_warning(message, ...) LOG_AT(LOG_LEVEL_WARNING, message, ##__VA_ARGS__)
#define log_info(message, ...)    LOG_AT(LOG_LEVEL_INFO, message, ##__VA_ARGS__)
#define log_debug(message, ...)   LOG_AT(LOG_LEVEL_DEBUG, message, ##__VA_ARGS__)

/* Sets format and level, and checks whether standard error is the journal. */
void log_open(enum log_format format, enum log_level level);
/* Starts a thread that writes the lines; until then, they are written immediately. Returns 0, or −1
 * if the thread cannot be created. */
int log_start(void);
/* Waits until everything is written, at most `timeout_ms`. Later lines are queued, but not
 * written. */
void log_stop(int timeout_ms);
/* For signal handlers that end the process: gives the thread a moment to write pending lines, then
 * writes `text` if standard error accepts it. */
void log_last_words(const char *text, size_t n);
/* Returns the number of lines since the start that did not reach standard error. */
uint64_t log_dropped(void);
void log_set_level(enum log_level level);
bool log_enabled(enum log_level level);

void log_write(enum log_level level, const char *message, const struct log_field *fields,
               size_t n_fields);

/* Formats one line with its newline into `line` (capacity bytes, always terminated); returns its
 * length. A field that does not fit is left out, along with all later ones. `time_us`: microseconds
 * since 1970; 0: omit the time. */
size_t log_format_line(char *line, size_t capacity, enum log_format format, bool priority,
                       int64_t time_us, enum log_level level, const char *message,
                       const struct log_field *fields, size_t n_fields);

#endif
