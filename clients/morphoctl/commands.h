/* commands.h: what the commands share. Each command is a function in a cmd_*.c file;
 * table_of_commands.c lists them. */
#ifndef MORPHOCTL_COMMANDS_H
#define MORPHOCTL_COMMANDS_H

#include <jansson.h>

#include "ctl.h"
#include "designs.h"

int run_eval(struct ctl *ctl);
int run_verify(struct ctl *ctl);
int run_design_show(struct ctl *ctl);
int run_design_list(struct ctl *ctl);
int run_design_draw(struct ctl *ctl);
int run_design_random(struct ctl *ctl);
int run_job_list(struct ctl *ctl);
int run_job_show(struct ctl *ctl);
int run_job_cancel(struct ctl *ctl);
int run_job_pause(struct ctl *ctl);
int run_job_resume(struct ctl *ctl);
int run_job_weight(struct ctl *ctl);
int run_watch(struct ctl *ctl);
/* Follows a job that was just started: prints the API's events one per line with --json, else calls
 * `watch`. */
int watch_started(struct ctl *ctl, const char *id, int (*watch)(struct ctl *ctl, const char *id));
/* Follows the job that the first operand names in the same way. */
int watch_operand(struct ctl *ctl, int (*watch)(struct ctl *ctl, const char *id));
int run_train_start(struct ctl *ctl);
int run_train_list(struct ctl *ctl);
int run_train_show(struct ctl *ctl);
int run_train_watch(struct ctl *ctl);
int run_train_export(struct ctl *ctl);
int run_train_prune(struct ctl *ctl);
int run_train_compare(struct ctl *ctl);
int run_campaign_start(struct ctl *ctl);
int run_campaign_list(struct ctl *ctl);
int run_campaign_show(struct ctl *ctl);
int run_campaign_watch(struct ctl *ctl);
int run_campaign_extend(struct ctl *ctl);
int run_campaign_prune(struct ctl *ctl);
int run_campaign_champions(struct ctl *ctl);
int run_campaign_export(struct ctl *ctl);
int run_controller_list(struct ctl *ctl);
int run_controller_info(struct ctl *ctl);
int run_controller_get(struct ctl *ctl);
int run_controller_put(struct ctl *ctl);
int run_controller_delete(struct ctl *ctl);
int run_status(struct ctl *ctl);
int run_devices(struct ctl *ctl);
int run_version(struct ctl *ctl);
int run_completion(struct ctl *ctl);

/* Options that say how designs are scored: controller, environments, physics, precision. See
 * request.c. */
#define SCORE_OPTIONS                                                                              \
  {"controller", 'c', "NAME", "Controller: a name or sha256:<64 digits> (default: default)."},     \
      {"environments", 'e', "FILE",                                                                \
       "paper-test (default), or a JSON file with a list of environments; - is standard input."},  \
      {"physics", 'p', "KEY=VALUE",                                                                \
       "One physics setting, e.g. dt_s=0.002 or impact=bisection8; may be given again."},          \
  {                                                                                                \
    "precision", 0, "float32|float64", "Precision of the simulation (default: float32)."           \
  }

/* Fills in the body of POST /v1/evaluations, except for its designs. */
int request_fill(const struct ctl *ctl, json_t *request);
/* Adds one "key=value" of --physics to `physics`. */
int request_physics(json_t *physics, const char *text);

/* Adds the --physics options to a request as "physics". */
int request_fill_physics(const struct ctl *ctl, json_t *request);
/* Posts a job with the key of --idempotency-key or a new key, so that repeating is safe. *job: the
 * server's reply. */
int post_job(struct ctl *ctl, const char *path, const json_t *request, unsigned wait_s,
             json_t **job);

/* Posts an evaluation. wait: waits for its end and shows progress; *evaluation is then final, with
 * results. */
int evaluate(struct ctl *ctl, const json_t *request, bool wait, json_t **evaluation);
/* Waits in the same way for the end of an evaluation that was posted earlier. */
int evaluation_wait(struct ctl *ctl, const char *id, json_t **evaluation);
/* Saves the recorded trajectories of an evaluation as NumPy files, with evaluation.json, in a
 * folder, which is created. */
int save_trajectories(struct ctl *ctl, const json_t *evaluation, const char *folder);
/* Returns STATUS_OK if the job succeeded, else complains and returns STATUS_NEGATIVE. noun: what
 * the complaint calls it. */
int job_outcome(const char *noun, const json_t *job);

/* Prints the results of a finished evaluation as a table. names: (n) or NULL. */
void print_results(const struct ctl *ctl, const json_t *evaluation, char *const *names,
                   bool by_score, size_t top);
/* Prints a fact on a line: "controller   default (sha256 …)". */
void print_fact(const struct ctl *ctl, const char *name, const char *format, ...)
    __attribute__((format(printf, 3, 4)));
void print_job_facts(const struct ctl *ctl, const json_t *job);
void print_job_times(const struct ctl *ctl, const json_t *job); /* created, started, finished */
/* Prints state, reason (without one the phase, if it is not ""), weight, device, label, error and
 * attempts. */
void print_job_state(const struct ctl *ctl, const json_t *job, const char *phase);
/* Prints "NAME, sha256:…"; without a controller, the random weights of this sensor. */
void print_controller_fact(const struct ctl *ctl, const char *fact, const json_t *controller,
                           const char *sensor);

/* Prints a job's state, in its color. */
void print_state(const struct ctl *ctl, const char *state);
/* Writes the bytes of a reply to a file, or to standard output ("-"). */
int save_output(const char *path, const void *bytes, size_t n);
/* Saves the reply to a GET in the same way, and reports its size. */
int save_reply(struct ctl *ctl, const char *path, const char *accept, const char *output);

/* ---- dump.c ---- */

/* Writes JSON as text; numbers have the fewest digits that read back (malloc; NULL: no memory).
 * flags: jansson's. */
char *dump_json(const json_t *json, size_t flags);
/* Prints JSON on one line of standard output. */
void put_json(const json_t *json, size_t flags);
/* Prints JSON from the API, indented on a terminal. */
void print_json(const json_t *json);
/* Prints the reply to a GET: --json of commands that show one thing. */
int show_json(struct ctl *ctl, const char *path);
/* Collects the items of a paged list up to `limit` (0: all) in the array *items, in order. */
int collect(struct ctl *ctl, const char *path, size_t limit, json_t **items);
/* Fetches the rows of a numbered list behind `after` (−1: from the first), page by page. path: with
 * its query. take: false: no memory. */
int walk_rows(struct ctl *ctl, const char *path, int64_t after,
              bool (*take)(void *context, const json_t *row), void *context);
/* Checks the options --state, --limit and --all, and collects items by them. */
int collect_states(struct ctl *ctl, const char *list, json_t **items);
/* Prints the items as one page if JSON was requested; else prints nothing and returns false. */
bool print_page(const struct ctl *ctl, json_t *items);
/* Prints the items that a `collect` with this status gave, as a page or as a table of which `add`
 * adds the row of an item, and frees them. Returns the status. */
struct table;
int print_list(const struct ctl *ctl, int status, json_t *items, const char *heads,
               void (*add)(struct table *table, const json_t *item));

bool is_final(const char *state);
bool is_state(const char *word); /* "queued", "running", … */
/* Checks that an operand is the decimal id of a job; complains if not. */
bool check_job_id(const char *text);
/* Deletes checkpoints of the jobs that the operands name, all of one kind ("training", "campaign"),
 * and reports on each. below: "", or the path of one checkpoint. */
int prune_checkpoints(struct ctl *ctl, const char *kind, const char *below);

const char *text_of(const json_t *object, const char *key); /* "" if absent */
int64_t number_of(const json_t *object, const char *key);

#endif
