/* commands.h: functions that the commands share, with the headers that almost all of them need. */
#ifndef MORPHOCTL_COMMANDS_H
#define MORPHOCTL_COMMANDS_H

#include <jansson.h>

#include "ctl.h"
#include "designs.h"
#include "runs.h"
#include "table.h"
#include "transport.h"

/* Most of these end the program on an error; what they return is kept (ctl.h). */

/* ---- request.c ---- */

/* Adds --schedule, a name or a kind, at its place. Options of a kind need --schedule. Call it
 * before request_fill. */
void fill_schedule(const struct ctl *ctl, json_t *request, const char *place);
#define SUITE_TASKS 12
extern const char *const suite_tasks[SUITE_TASKS + 1]; /* of morpho-12, NULL after the last */
/* Adds the given options that have a place, --physics, --environments or --task. */
void request_fill(const struct ctl *ctl, json_t *request);
/* Adds as "record" the channels of --record, else `usual` (nullable), and the masses for --film. */
void request_fill_record(const struct ctl *ctl, json_t *request, const char *usual);
/* Adds the measures of --measures; the service rejects unknown names. */
void request_fill_measures(const struct ctl *ctl, json_t *request);
/* Adds the --physics options, "key=value" each, to a request as "physics". */
void request_fill_physics(const struct ctl *ctl, json_t *request);
/* Makes a request with a JSON body, or without a body if NULL. */
struct request json_request(const char *method, const char *path, const json_t *json);
/* Posts a request that has no effect the second time. */
json_t *post_again(struct ctl *ctl, const char *path, const json_t *request);
/* Reports on standard error which robots were used for designs given by an id without an
 * orientation. */
void say_orientations(const struct ctl *ctl, const json_t *designs);
/* Returns the request of --random, --first and the option `seed`, kept; NULL without --random. */
json_t *random_of(const struct ctl *ctl, const char *seed, int64_t most);
/* Returns the designs of the operands, starting with `first`, and those that the server draws for
 * `random` (nullable); those on standard input if there are neither. */
struct designs given_designs(struct ctl *ctl, size_t first, const json_t *random);
/* Posts a job with the key of --idempotency-key or a new one, so that it is safe to repeat. */
json_t *post_job(struct ctl *ctl, const char *path, const json_t *request, unsigned wait_s);

/* Waits for the end of a posted job, and shows its progress. */
void await_job(struct ctl *ctl, const json_t *job, const char *noun);
/* Posts an evaluation. wait: waits for its end and shows progress; the evaluation is then final,
 * with results. */
json_t *evaluate(struct ctl *ctl, const char *path, const json_t *request, bool wait);

/* ---- cmd_atlas.c ---- */
/* Makes the path of the atlas in the first operand. below: "" or a part such as "/file". */
const char *atlas_path(const struct ctl *ctl, const char *below);

/* ---- cmd_suite.c ---- */
void run_suite(struct ctl *ctl);
void run_suite_show(struct ctl *ctl);
void run_suite_picture(struct ctl *ctl);

/* ---- cmd_eval.c ---- */
/* Saves trajectories of an evaluation as NumPy files, with evaluation.json, in a new folder. */
void save_trajectories(struct ctl *ctl, const json_t *evaluation, const char *folder);

/* ---- cmd_film.c ---- */
/* Checks --film and the drawing options before anything is computed. */
void film_check(struct ctl *ctl);
/* With --film, draws the masses that a finished evaluation recorded: of up to 16 designs, the best
 * ones if there are more. */
void film_evaluation(struct ctl *ctl, const json_t *evaluation);

/* ---- common.c ---- */

const char *text_of(const json_t *object, const char *key); /* "" if absent */
int64_t number_of(const json_t *object, const char *key);
void add_number(json_t *sum, const json_t *part, const char *key);
double real_at(const json_t *json, const char *place); /* NaN if absent; see table.h */
json_t *real_or_null(double value);                    /* null if it is not finite */

bool is_final(const char *state);
/* Returns an operand that is the decimal id of a job. */
const char *job_id(const char *text);
/* Prints a job's warnings. The second one ends the program unless the job succeeded. */
void complain_of_warnings(const char *noun, const json_t *job);
void expect_success(const char *noun, const json_t *job);

/* Prints a fact on a line: "controller   default (sha256 …)". */
void print_fact(const struct ctl *ctl, const char *name, const char *format, ...)
    __attribute__((format(printf, 3, 4)));
struct fact {
  const char *name, *words; /* words: a template; the fact is omitted if it is empty */
};
/* Prints the facts up to the one without a name. */
void print_facts(const struct ctl *ctl, const json_t *json, const struct fact *facts);

/* "NAME, sha256:…"; otherwise: "" or another alternative. */
#define CONTROLLER_WORDS(place, otherwise)                                                         \
  "[[{" place ".name}, ]sha256:{" place ".sha256}" otherwise "]"
#define JOB_STATE_FACTS(phase)                                                                     \
  {"state", "{state}"},                                                                            \
      {"warning", "{warnings.0.detail}[; {warnings.1.detail}][; {warnings.2.detail}]"              \
                  "[; {warnings.3.detail}]"},                                                      \
      {"reason", "{reason}"}, {"phase", phase}, {"weight", "{weight:g}"}, {"device", "{device}"},  \
      {"label", "{label}"}, {"experiment", "{experiment}"}, {"note", "{note}"},                    \
      {"archived", "[{archived_at:time}]"}, {"error", "[{error.code}: {error.detail}]"},           \
  {                                                                                                \
    "attempts", "[{attempts>0}]"                                                                   \
  }
#define JOB_TIME_FACTS                                                                             \
  {"core time", "[{core_seconds>0:duration}]"}, {"device time", "[{device_seconds>0:duration}]"},  \
      {"created", "{created_at:time}"}, {"started", "{started_at:time}"},                          \
  {                                                                                                \
    "finished", "{finished_at:time}"                                                               \
  }

/* Prints JSON on one line of standard output. */
void put_json(const json_t *json, size_t flags);
/* Prints JSON from the API, indented on a terminal. */
void print_json(const json_t *json);
/* Prints the reply to a GET: JSON with --json, otherwise the output of `print`. */
void show(struct ctl *ctl, const char *path,
          void (*print)(const struct ctl *ctl, const json_t *json));
/* Prints JSON with --json, otherwise a filled template, unless --quiet. */
void tell(const struct ctl *ctl, const json_t *json, const char *words);
/* Prints a page as JSON with --json, else its items as a table (table.h). */
void print_items(const struct ctl *ctl, const json_t *page, const char *columns);
/* Prints losses that differ as a table, unless --json is given (cmd_fleet.c). */
void print_differences(const struct ctl *ctl, const json_t *different);
/* Sends a request whose reply has no body, and reports the result. */
void act(struct ctl *ctl, struct request request, const char *words);
/* Writes a head and bytes to a file, or to standard output ("-"). */
void save_output(const char *path, const void *head, size_t head_n, const void *bytes, size_t n);
/* Saves the reply to a GET in the same way, and reports its size. CSV files must be named .csv. */
void save_reply(struct ctl *ctl, const char *path, const char *accept, const char *output);

/* Passes the items of a paged list to `take` in order, up to `limit` (0 = all), and after number
 * `after` of a numbered list (−1 = from the first). */
void walk_items(struct ctl *ctl, const char *path, int64_t after, size_t limit,
                void (*take)(void *context, json_t *item), void *context);
/* Returns such items in an array. */
json_t *collect(struct ctl *ctl, const char *path, size_t limit);
/* Adds those of these options (up to NULL) that were given to a path, as parameters. */
const char *path_with(const struct ctl *ctl, const char *path, const char *const *options);

/* ---- plain.c ---- */

/* Writes JSON as text; numbers have the fewest digits that read back (malloc). flags: jansson's.
 * Returns NULL if out of memory. */
char *dump_json(const json_t *json, size_t flags);

#endif
