/* cmd_watch.c: watch: follows the event stream, reconnects when it breaks, and ends when the
 * watched job ends; wait: waits for the end of jobs. */
#include <errno.h>
#include <spawn.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>

#include "commands.h"
#include "follow.h"
#include "live.h"

/* ---- texts of events ---- */

static const struct {
  const char *type, *words;
} events[] = {
    {"training.progress", "  " STEP_WORDS("data.") "  " NUMBER_WORDS("data.") PACE_WORDS("data.")},
    {"training.validation", "  " VALIDATION_WORDS("data.")},
    {"training.checkpoint", "  of step {data.step:,}"},
    {"training.code_changed",
     "  after step {data.from_step:,}: {data.fingerprint}, before [{data.before}|unknown]"},
    {"evaluation.recordings_removed", "  {data.bytes:MB} MB, by {data.reason}"},
    {"campaign.generation",
     "  " GENERATION_WORDS("data.") "  mean {data.mean:.4f}  best {data.best:.4f}  diversity "
                                    "{data.diversity:.4f}"},
    {"campaign.progress",
     "  generation {data.generation}  {data.phase} {data.done:,} of {data.total:,}"},
    {"atlas.progress", "  {data.bodies_done:,} of {data.bodies_total:,} bodies"},
    {"certificate.progress", "  {data.rollouts_done:,} of {data.rollouts:,} rollouts"},
    {"campaign.imported", "  campaign {data.campaign} of store {data.store}"},
    {"scores.imported", "  {data.new:,} rollout{data.new:s} of store {data.store} on {data.host}"},
    {"scores.differ",
     "  {data.different:,} rollout{data.different:s} of store {data.store} on {data.host}"},
    {"campaign.extended", "  to {data.generations:,} generation{data.generations:s}"},
    {"campaign.diversity_collapse", "  generation {data.generation}: diversity "
                                    "{data.diversity:.4f}, it was {data.maximum:.4f}"},
    {"job.warning", "  {data.detail}"},
    {"campaign.lineage_unreadable",
     "  {data.field:.40} of controller {data.controller:.12}: {data.detail:.160}"},
};

const char *event_words(const char *type)
{
  for (size_t i = 0; i < sizeof(events) / sizeof(events[0]); i++)
    if (strcmp(events[i].type, type) == 0)
      return events[i].words;
  return "[  {data.rollouts_done:,} of {data.rollouts_total>0:,} rollouts]";
}

/* ---- watch ---- */

struct watch {
  struct ctl *ctl;
  const char *job; /* NULL means all jobs */
  bool finished, failed, reset;
};

static void print_event(const char *type, const json_t *event)
{
  fill_template(stdout, event, "{at:time}");
  print_plain(stdout, "  %-15s ", type);
  fill_template(stdout, event, "[job {job}[  {data.state}]|{data.name}]");
  print_from(stdout, event, *text_of(event, "job") != 0 ? event_words(type) : "");
}

static int show_event(void *context, const char *type, const char *data)
{
  struct watch *watch = context;
  struct ctl *ctl = watch->ctl;
  if (strcmp(type, "reset") == 0) {
    watch->reset = true;
    if (!ctl->quiet)
      complain(0, "some events were missed, because the server no longer keeps them");
    return 0;
  }
  json_t *event = json_loads(data, 0, NULL);
  if (event == NULL)
    return 0;
  const json_t *details = json_object_get(event, "data");
  if (ctl->json) {
    put_json(event, JSON_COMPACT);
  } else if (strcmp(type, "job.progress") == 0 && watch->job != NULL && ctl->progress) {
    progress_show(ctl, "running", number_of(details, "rollouts_done"),
                  number_of(details, "rollouts_total"), "rollouts");
  } else {
    progress_end();
    print_event(type, event);
  }
  fflush(stdout);
  if (watch->job != NULL && strcmp(type, "job.finished") == 0) {
    watch->finished = true;
    watch->failed = strcmp(text_of(details, "state"), "succeeded") != 0;
  }
  json_decref(event);
  return watch->finished;
}

static void ask(struct watch *watch)
{
  const struct request request = {.method = "GET", .path = path_to("/v1/jobs/%s", watch->job)};
  json_t *job = send_json(watch->ctl, &request, NULL);
  if (is_final(text_of(job, "state"))) {
    watch->finished = true;
    watch->failed = strcmp(text_of(job, "state"), "succeeded") != 0;
  }
  json_decref(job);
}

/* Checks after a reconnection whether the job has ended: its event may no longer be kept. */
static bool look_again(void *context)
{
  struct watch *watch = context;
  if (watch->job != NULL && watch->reset)
    ask(watch);
  return watch->finished;
}

void run_watch(struct ctl *ctl)
{
  struct watch watch = {.ctl = ctl, .job = ctl->n_operands > 0 ? job_id(ctl->operands[0]) : NULL};
  struct follow follow = {.ctl = ctl,
                          .job = watch.job,
                          .after =
                              option_number(ctl, "after", 0, INT64_MAX, watch.job != NULL ? 0 : -1),
                          .event = show_event,
                          .broken = look_again,
                          .context = &watch};
  if (watch.job != NULL)
    ask(&watch);          /* checks that the job exists */
  watch.finished = false; /* show the events of a finished job as well */
  catch_interrupts(NULL);
  follow_events(&follow);
  if (watch.failed)
    leave(STATUS_NEGATIVE);
}

/* ---- wait ---- */

/* Waits for the end of a job, even if the server restarts. state: as in its reply. */
static void wait_for_end(struct ctl *ctl, const char *id, char state[16])
{
  const struct request request = {
      .method = "GET", .path = path_to("/v1/jobs/%s", id), .wait_s = 30};
  while (!is_final(state)) {
    json_t *job = send_json(ctl, &request, NULL);
    snprintf(state, 16, "%s", text_of(job, "state"));
    if (is_final(state))
      complain_of_warnings("job", job);
    json_decref(job);
    if (ctl->retry_s < 0)
      ctl->retry_s = 3600; /* the server replied */
  }
}

/* Runs a command with sh; it must succeed. */
static void run_then(const char *command, const struct ctl *ctl, const char *state)
{
  char shell[] = "sh", option[] = "-c", *copy = keep(strdup(command));
  char *const arguments[] = {shell, option, copy, NULL};
  const char *ids = ctl->operands[0];
  int end = 0;
  pid_t process = 0;
  for (size_t i = 1; i < ctl->n_operands; i++)
    ids = keep(format_text("%s %s", ids, ctl->operands[i]));
  const bool is_set = setenv("MORPHOD_JOBS", ids, 1) == 0 && setenv("MORPHOD_STATE", state, 1) == 0;
  const int error =
      is_set ? posix_spawn(&process, "/bin/sh", NULL, NULL, arguments, environ) : errno;
  if (error != 0)
    fail(STATUS_ERROR, "sh: %s", strerror(error));
  while (waitpid(process, &end, 0) < 0)
    if (errno != EINTR)
      fail(STATUS_ERROR, "sh: %s", strerror(errno));
  if (!WIFEXITED(end) || WEXITSTATUS(end) != 0)
    fail(STATUS_ERROR, "\"%s\" failed", command);
}

void run_wait(struct ctl *ctl)
{
  const char *command = option_text(ctl, "run", NULL);
  char ended[16] = "succeeded";
  for (size_t i = 0; i < ctl->n_operands; i++)
    job_id(ctl->operands[i]);
  catch_interrupts(NULL);
  for (size_t i = 0; i < ctl->n_operands; i++) {
    char state[16] = "";
    wait_for_end(ctl, ctl->operands[i], state);
    if (!ctl->quiet)
      print_plain_line(stdout, "job %s has %s%s", ctl->operands[i],
                       strcmp(state, "cancelled") == 0 ? "been " : "", state);
    fflush(stdout);
    if (strcmp(ended, "succeeded") == 0)
      memcpy(ended, state, sizeof(ended));
  }
  if (command != NULL)
    run_then(command, ctl, ended);
  if (strcmp(ended, "succeeded") != 0)
    leave(STATUS_NEGATIVE);
}
