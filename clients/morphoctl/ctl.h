/* ctl.h: what all parts of morphoctl share: exit statuses, options, and the state of a run. */
#ifndef MORPHOCTL_CTL_H
#define MORPHOCTL_CTL_H

#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

enum status {
  STATUS_OK = 0,
  STATUS_ERROR = 1, /* an error of the server or of this machine */
  STATUS_USAGE = 2, /* the command line or an input file is wrong */
  STATUS_NEGATIVE =
      3, /* not found, or a negative result: failed, cancelled, bits differ, not ready */
  STATUS_CONNECTION = 4, /* no server at this address */
  STATUS_DENIED = 5,     /* no valid token, or not allowed from here */
  STATUS_REJECTED = 6,   /* the server found an error in the request */
  STATUS_BUSY = 7,       /* the server asked to retry later, and retrying did not help */
  STATUS_INTERRUPTED = 130
};

/* Default: a word. FIELD_WORDS, FIELD_REALS: a list, separated by commas. FIELD_RANGES:
 * NAME=LOW:HIGH, can be repeated. */
enum field_kind { FIELD_WORD, FIELD_WHOLE, FIELD_REAL, FIELD_WORDS, FIELD_REALS, FIELD_RANGES };

struct option_spec {
  const char *name;  /* without dashes; NULL ends a list */
  char letter;       /* 0 if none */
  const char *value; /* name of the value in the help; NULL for a switch */
  const char *help;
  const char *place; /* in the request: "group.field"; NULL: the command reads it */
  enum field_kind kind;
};

struct given {
  const char *name;
  const char *value;
};

struct ctl;
struct live_kind;
typedef void command_function(struct ctl *ctl);

struct command {
  const char *name;     /* such as "job list" */
  const char *operands; /* "ID [DESIGN]...", or "": also determines how many there may be */
  const char *summary;  /* one line */
  command_function *run;
  const char *details;               /* further text, or NULL */
  const struct option_spec *options; /* NULL: only the common options */
  const struct live_kind *live; /* for a command that starts, shows or watches a job (live.h) */
};

/* One run of the program. */
struct ctl {
  const struct command *commands; /* (n_commands) all of them */
  size_t n_commands;
  const struct command *command;
  struct given *given; /* in order of appearance */
  size_t n_given;
  const char **operands;
  size_t n_operands;

  const char *server; /* "http://…" or "unix:/…" */
  const char *token;  /* NULL if none */
  bool json;          /* plain JSON of the API on standard output */
  bool quiet;         /* no progress, no notes */
  bool terminal;      /* standard output is a terminal that supports escapes */
  bool color;         /* on standard output */
  bool progress;      /* standard error is a terminal */
  bool utf8;          /* the locale can show box characters */
  double retry_s;     /* how long a failing connection is retried; < 0 = the default */
  struct transport *transport;
};

extern const struct command commands[];
extern const size_t n_commands;
extern const struct option_spec common_options[];

/* ---- memory.c: memory, and exit. The program exits where an error is found: it has no state to
 * lose, and the system frees its memory ---- */

void *need(void *memory); /* returns what was allocated or opened; NULL ends the program */
/* The same for memory that is used until exit. Keeps it reachable, so that it does not count as a
 * leak. */
void *keep(void *memory);
char *format_text(const char *format, ...)
    __attribute__((format(printf, 1, 2))); /* like asprintf: malloc */
void close_text(FILE *file);               /* for open_memstream */

/* Prints "morphoctl: …" on standard error, as plain text; returns `status`. */
int complain(int status, const char *format, ...) __attribute__((format(printf, 2, 3)));
/* Records that a line of progress is on standard error, and returns whether there already was one;
 * erases it. */
bool progress_begin(void);
void progress_end(void);
/* Ends the program with a status, once standard output is written. */
_Noreturn void leave(int status);
/* Prints a message as complain does, and exits. */
_Noreturn void fail(int status, const char *format, ...) __attribute__((format(printf, 2, 3)));

/* Returns true after SIGINT or SIGTERM, once catch_interrupts has been called. Commands call that
 * before they wait for something that continues without them. words: printed at the end in that
 * case; nullable, kept. */
bool interrupted(void);
void catch_interrupts(const char *words);

/* ---- options.c ---- */

/* Finds the command and parses its options. Ends the program if help was printed or the usage is
 * wrong. */
void options_parse(struct ctl *ctl, int argc, const char *const *argv);
/* Prints the help of a command; NULL: of the whole program. */
void options_print_help(FILE *file, const struct ctl *ctl, const struct command *command);
void options_print_completion(FILE *file, const struct ctl *ctl); /* for bash */

bool option_is_set(const struct ctl *ctl, const char *name);
const char *option_text(const struct ctl *ctl, const char *name,
                        const char *otherwise); /* the last value given */
/* Returns the value of an option that must be one of the words (base/words.h), or `otherwise` if
 * the option was not given. */
const char *option_word(const struct ctl *ctl, const char *name, const char *const *words,
                        const char *otherwise);
/* Returns a whole number within bounds, or `otherwise` if the option was not given. */
int64_t option_number(const struct ctl *ctl, const char *name, int64_t min, int64_t max,
                      int64_t otherwise);

/* ---- plain.c: shows text from elsewhere without interpreting its escapes ---- */

/* Replaces control characters (C0, DEL, C1) with question marks, and escapes characters that only
 * change how others are shown, such as bidirectional ones: \u202e (malloc). Returns NULL if out of
 * memory. */
char *plain_text(const char *text);
/* Print text in this way; without memory they print nothing. The format itself must not contain
 * control characters. */
void print_plain(FILE *file, const char *format, ...) __attribute__((format(printf, 2, 3)));
void print_plain_line(FILE *file, const char *format, ...)
    __attribute__((format(printf, 2, 3))); /* and a newline */
void print_plain_list(FILE *file, const char *format, va_list arguments)
    __attribute__((format(printf, 2, 0)));

/* Returns "; did you mean --NAME?" with the nearest of n names to a mistyped one, or "". first,
 * stride: as for mo_word_nearest. Valid until the next call. */
const char *did_you_mean(const char *dashes, const char *name, const char *const *first, size_t n,
                         size_t stride);

#endif
