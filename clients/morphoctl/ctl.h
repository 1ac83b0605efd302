/* ctl.h: what every part of morphoctl shares: exit statuses, options, the surroundings of a run. */
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
      3, /* not found, or the answer is no: failed, cancelled, bits differ, not ready */
  STATUS_CONNECTION = 4, /* no server there */
  STATUS_DENIED = 5,     /* no valid token, or not from here */
  STATUS_REJECTED = 6,   /* the server finds the request wrong */
  STATUS_BUSY = 7,       /* the server asked to try again later, and later did not help */
  STATUS_INTERRUPTED = 130
};

struct option_spec {
  const char *name;  /* without dashes; NULL ends a list */
  char letter;       /* 0: none */
  const char *value; /* what the value is called; NULL: a switch */
  const char *help;
};

struct given {
  const char *name;
  const char *value;
};

struct ctl;

struct command {
  const char *name;                  /* "job list" */
  const char *operands;              /* "[DESIGN]…", or "" */
  const char *summary;               /* one line */
  const char *details;               /* further text, or NULL */
  const struct option_spec *options; /* NULL: the common ones alone */
  size_t min_operands, max_operands;
  int (*run)(struct ctl *ctl);
};

/* One run of the program. */
struct ctl {
  const struct command *command;
  struct given *given; /* in order of appearance */
  size_t n_given;
  const char **operands;
  size_t n_operands;

  const char *server; /* "http://…" or "unix:/…" */
  char *token;        /* NULL: none */
  bool json;          /* plain JSON of the API on standard output */
  bool quiet;         /* no progress, no remarks */
  bool colour;        /* on standard output */
  bool progress;      /* standard error is a terminal */
  bool utf8;          /* the locale draws boxes */
  double retry_s;     /* how long a failing connection is tried again; < 0: the default */
  struct transport *transport;
  struct json_t *
      unreadable; /* of the list that was collected: jobs that the server cannot read; NULL: none */
};

extern const struct command commands[];
extern const size_t n_commands;
extern const struct option_spec common_options[];

/* ---- options.c ---- */

/* Finds the command and reads its options. Returns −1 to go on, or an exit status (help was
 * printed, usage is wrong). */
int options_parse(struct ctl *ctl, int argc, const char *const *argv);
void options_free(struct ctl *ctl);
void options_print_help(FILE *file, const struct command *command); /* NULL: of the whole program */
void options_print_completion(FILE *file);                          /* bash */

bool option_is_set(const struct ctl *ctl, const char *name);
const char *option_text(const struct ctl *ctl, const char *name,
                        const char *otherwise); /* the last one given */
/* A whole number within bounds; false (and a message) if it is not. Leaves *number if the option
 * was not given. */
bool option_number(const struct ctl *ctl, const char *name, int64_t min, int64_t max,
                   int64_t *number);

/* ---- plain.c: what others wrote, shown without obeying it ---- */

/* Control characters (C0, DEL, C1) become question marks, in place. */
void make_plain(char *text);
/* Prints so; the format has no control characters of its own either. */
void print_plain(FILE *file, const char *format, ...) __attribute__((format(printf, 2, 3)));
void print_plain_line(FILE *file, const char *format, ...)
    __attribute__((format(printf, 2, 3))); /* and a newline */
void print_plain_list(FILE *file, const char *format, va_list arguments)
    __attribute__((format(printf, 2, 0)));

/* "morphoctl: …" on standard error, plain; returns `status`. */
int complain(int status, const char *format, ...) __attribute__((format(printf, 2, 3)));
/* The name in `names` (n of them) that is nearest to a mistyped one, or NULL. */
const char *nearest_name(const char *name, const char *const *names, size_t n);

/* Set by SIGINT and SIGTERM once the program waits for something that can be left alone. */
bool interrupted(void);
void catch_interrupts(void);

#endif
