/* settings.h: all settings of morphod, in one table.
 *
 * A row of the table drives the parsing of the file, the environment and the flags, `--help`,
 * `--print-config`, `--check-config`, the table in docs/configuration.md and the list in
 * morphod(8). A setting that is not in the table does not exist. Precedence: flag, environment
 * variable, file, default.
 *
 * The name `max_body` gives the flag `--max-body` and the variable `MORPHOD_MAX_BODY`. The file has
 * `name = value` lines and `#` comments. Lists are separated by commas or white space; repeating a
 * flag adds to its list. Sizes take K, M, G (powers of 1024), durations ms, s, min, h, d. */
#ifndef MORPHO_DAEMON_SETTINGS_H
#define MORPHO_DAEMON_SETTINGS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#include <morpho/error.h>

#include "daemon/settings_faults.h"

enum setting_type {
  SETTING_PATH,     /* char *, NULL when empty */
  SETTING_LIST,     /* struct setting_list */
  SETTING_NUMBER,   /* uint64_t */
  SETTING_BYTES,    /* uint64_t */
  SETTING_DURATION, /* uint64_t milliseconds */
  SETTING_CHOICE    /* int: position in `choices` */
};

enum setting_source { SOURCE_DEFAULT = 0, SOURCE_FILE, SOURCE_ENVIRONMENT, SOURCE_FLAG };

struct setting_list {
  char **items;
  size_t n;
};

#define SETTINGS_MAX 48

struct settings {
  char *state_dir;
  struct setting_list listen;
  uint64_t workers;
  int isa; /* 0: auto, else enum mo_isa + 1 */
  uint64_t worker_nice;
  struct setting_list devices;
  char *compute_module, *default_controller, *token_file;
  struct setting_list fleet_listen;
  char *fleet_certificate, *fleet_key;
  int compute;           /* enum fleet_compute */
  int token_on_loopback; /* 0: no, 1: yes */
  int dashboard;         /* enum mo_dashboard */
  struct setting_list allowed_hosts, unix_groups;
  uint64_t max_connections;
  uint64_t max_streams;
  uint64_t max_body_bytes;
  uint64_t max_controller_bytes, max_bundle_bytes;
  uint64_t header_timeout_ms, body_timeout_ms, idle_timeout_ms;
  uint64_t max_open_jobs, max_open_rollouts, max_trainings, max_campaigns;
  uint64_t max_in_flight;
  uint64_t max_recorded_bytes, max_recordings_bytes; /* of one evaluation, of all; 0: no limit */
  uint64_t max_excluded_bytes;
  uint64_t keep_evaluations_ms, keep_trainings_ms, keep_campaigns_ms, keep_recordings_ms;
  uint64_t max_memory; /* 0: memory_limit() */
  uint64_t client_rate_per_s;
  uint64_t events_kept;
  uint64_t drain_timeout_ms;
  int log_level, log_format;
  char *port_file;
  /* The source of each value, for messages and --print-config. */
  uint8_t source[SETTINGS_MAX];
};

struct setting {
  const char *name;
  enum setting_type type;
  bool reloads;              /* SIGHUP applies a new value */
  size_t offset;             /* of the value in struct settings */
  uint64_t min, max;         /* numbers, sizes, durations (milliseconds) */
  const char *initial;       /* default, as written in the file */
  const char *initial_words; /* default in words if `initial` cannot express it; else NULL */
  const char *choices;       /* SETTING_CHOICE: words separated by '|' */
  const char *help;          /* one or two sentences for people */
};

extern const struct setting settings_table[];
extern const size_t settings_count;

/* What the command line requests, apart from settings. */
enum settings_action {
  ACTION_RUN = 0,
  ACTION_HELP,
  ACTION_VERSION,
  ACTION_CHECK,
  ACTION_PRINT,
  ACTION_TABLE
};
struct settings_request {
  enum settings_action action;
  const char *config; /* --config or MORPHOD_CONFIG; NULL: the usual places */
  char *config_found; /* the file that was read, or NULL (malloc) */
  bool usage_fault;   /* the command line itself is invalid (unknown flag, missing value) */
};

/* Sets all values to their defaults. */
void settings_init(struct settings *settings);
void settings_free(struct settings *settings);

/* Reads flags, then file and environment, and applies them in order of precedence. Continues after
 * a fault. */
void settings_load(struct settings *settings, int argc, const char *const *argv,
                   const char *const *environment, struct settings_request *request,
                   struct settings_faults *faults);
void settings_request_free(struct settings_request *request);

/* Reads the text of a file. `name` is for messages. */
void settings_read_text(struct settings *settings, const char *name, const char *text,
                        size_t length, struct settings_faults *faults);

/* Sets one value from its text. `append`: adds to a list. MO_ERR_INVALID, MO_ERR_RANGE with a
 * message. */
int settings_set(struct settings *settings, const struct setting *setting, const char *text,
                 enum setting_source source, bool append, struct mo_message *message);

/* Derives values from the environment: state_dir, token_file from a credential. */
void settings_complete(struct settings *settings, const char *const *environment);

/* Checks the folders, files and addresses that the values refer to, and contradictions. Reads only,
 * never writes. `state_dir`: also checks the state folder. (A start does not need this check: it
 * reports a broken folder separately from a broken configuration.) */
void settings_check(const struct settings *settings, bool state_dir,
                    struct settings_faults *faults);

void settings_print_help(FILE *file);
void settings_print(const struct settings *settings,
                    FILE *file);       /* prints a file with these values */
void settings_print_table(FILE *file); /* Markdown */

/* Returns the value of a setting as text (malloc). */
char *settings_value_text(const struct settings *settings, const struct setting *setting);
/* Writes a number of a type of settings: the shortest text that reads back as the same value. */
void settings_number_text(enum setting_type type, uint64_t value, char *text, size_t capacity);
void settings_flag_name(const struct setting *setting, char *text,
                        size_t capacity); /* "--state-dir" */
void settings_variable_name(const char *prefix, const struct setting *setting, char *text,
                            size_t capacity); /* of "MORPHOD": "MORPHOD_STATE_DIR" */

#endif
