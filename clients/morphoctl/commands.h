/* commands.h: what the commands share. Each command is a function of its own in a cmd_*.c file;
 * main.c lists them. */
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
/* A job that was just started: with --json the API's events, one per line, else `watch`. */
int watch_started(struct ctl *ctl, const char *id, int (*watch)(struct ctl *ctl, const char *id));
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

/* Options that describe a score: controller, environments, physics, precision. request.c */
#define SCORE_OPTIONS                                                                              \
  {"controller", 'c', "NAME", "Controller: a name or sha256:<64 digits> (default: default)."},     \
      {"environments", 'e', "FILE",                                                                \
       "paper-test (default), or a JSON file with a list of environments; - is standard input."},  \
      {"physics", 'p', "KEY=VALUE",                                                                \
       "One physics setting, e.g. dt_s=0.002 or impact=bisection8; may be given again."},          \
  {                                                                                                \
    "precision", 0, "float32|float64", "Precision of the simulation (default: float32)."           \
  }

/* Fills in the body of POST /v1/evaluations but for its designs. */
int request_fill(const struct ctl *ctl, json_t *request);
/* One "key=value" of --physics into `physics`. */
int request_physics(json_t *physics, const char *text);

/* The --physics options into "physics" of a request. */
int request_fill_physics(const struct ctl *ctl, json_t *request);
/* Posts a job under the key of --idempotency-key, or a new one, so that it is safe to repeat. *job:
 * what the server says of it. */
int post_job(struct ctl *ctl, const char *path, const json_t *request, unsigned wait_s,
             json_t **job);

/* Posts an evaluation. With `wait`, waits to its end with progress; *evaluation is then the final
 * one with results. */
int evaluate(struct ctl *ctl, const json_t *request, bool wait, json_t **evaluation);
/* Waits for the end of one that was posted already, as above. */
int evaluation_wait(struct ctl *ctl, const char *id, json_t **evaluation);
/* What an evaluation recorded, as NumPy files, and evaluation.json in a folder, which is made. */
int save_trajectories(struct ctl *ctl, const json_t *evaluation, const char *folder);
/* STATUS_OK if it succeeded, else STATUS_NEGATIVE and a complaint. */
int evaluation_outcome(const json_t *evaluation);

/* The results of a finished evaluation as a table. names: (n) or NULL. */
void print_results(const struct ctl *ctl, const json_t *evaluation, char *const *names,
                   bool by_score, size_t top);
/* A fact per line: "controller   default (sha256 …)". */
void print_fact(const struct ctl *ctl, const char *name, const char *format, ...)
    __attribute__((format(printf, 3, 4)));
void print_job_facts(const struct ctl *ctl, const json_t *job);
void print_job_times(const struct ctl *ctl, const json_t *job); /* created, started, finished */

/* A job's state, in its colour. */
void print_state(const struct ctl *ctl, const char *state);
/* Writes the bytes of a reply to a file, or to standard output ("-"). */
int save_output(const char *path, const void *bytes, size_t n);

/* JSON as it came from the API, indented on a terminal. */
void print_json(const json_t *json);
/* GET and print; for --json of commands that show one thing. */
int show_json(struct ctl *ctl, const char *path);

/* Collects the items of a paged list up to `limit` (0: all). *items is an array of what came, in
 * order; tells of jobs that cannot be read. */
int collect(struct ctl *ctl, const char *path, size_t limit, json_t **items);
/* The same by the options --state, --limit and --all, which it checks. */
int collect_states(struct ctl *ctl, const char *list, json_t **items);
/* The items as one page, if JSON is asked for; false: nothing is printed. */
bool print_page(const struct ctl *ctl, json_t *items);

bool is_final(const char *state);
bool is_state(const char *word); /* "queued", "running", … */
/* Whether an operand is the decimal id of a job; complains if not. */
bool check_job_id(const char *text);
/* Deletes checkpoints of the jobs of this kind ("training", "campaign") that the operands name, and
 * tells of each; below: "", or the path of one. */
int prune_checkpoints(struct ctl *ctl, const char *kind, const char *below);

const char *text_of(const json_t *object, const char *key); /* "" if there is none */
int64_t number_of(const json_t *object, const char *key);

#endif
