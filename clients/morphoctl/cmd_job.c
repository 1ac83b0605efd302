/* cmd_job.c: job list, show, cancel, pause, resume, weight; the same and prune for trainings and
 * campaigns. */
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "transport.h"

int run_job_list(struct ctl *ctl)
{
  return list_items(ctl, "/v1/jobs", 50,
                    ">job={id}|kind=[{training.kind}|{campaign.mode}|{kind}]|state={state}"
                    "|priority={priority}|>designs=[{campaign.population:,}|{n_designs:,}]"
                    "|>work=[{training.steps:,} steps|{campaign.generations:,} generations"
                    "|{rollouts_total:,} rollouts]"
                    "|>done=[{training.step/training.steps:%}"
                    "|{campaign.generation/campaign.generations:%}"
                    "|{rollouts_done/rollouts_total:%}|0 %]"
                    "|created={created_at:time}|label={label}");
}

static void print_job(const struct ctl *ctl, const json_t *job)
{
  static const struct fact first[] = {
      {"job", "{id} ({kind}, {priority})"},
      JOB_STATE_FACTS(""),
      {"name", "{training.name}"},
      {"mode", "{campaign.mode}"},
      {"progress",
       "[step {training.step:,} of {training.steps:,}; morphoctl train show {id} tells more"
       "|generation [{campaign.generation:,}|0] of {campaign.generations:,}; morphoctl campaign "
       "show {id} tells more]"},
      {NULL, NULL}};
  static const struct fact evaluation[] = {
      {"controller", CONTROLLER_WORDS("controller", "")},
      {"environments", "[{environments}|{environments.count} of the request]"},
      {"precision", "{precision}"},
      {"physics", "{physics.n_steps} steps of {physics.dt_s:g} s, impact {physics.impact}"},
      {"designs", "{n_designs:,}"},
      {"rollouts", "{rollouts_done:,} of {rollouts_total:,}[  {progress.rollouts_per_s:.0f} "
                   "rollouts/s][  {progress.seconds_left:duration} left]"},
      {"from store", "[{rollouts_cached>0:,}]"},
      {"diverged", "[{rollouts_diverged>0:,}]"},
      {NULL, NULL}};
  static const struct fact times[] = {JOB_TIME_FACTS, {NULL, NULL}};
  print_facts(ctl, job, first);
  if (json_object_get(job, "training") == NULL && json_object_get(job, "campaign") == NULL)
    print_facts(ctl, job, evaluation);
  print_facts(ctl, job, times);
  if (json_object_get(job, "results") != NULL) {
    putchar('\n');
    print_results(ctl, job, NULL, false, 0);
  }
}

int run_job_show(struct ctl *ctl)
{
  const char *id = ctl->operands[0];
  char path[64];
  if (!check_job_id(id))
    return STATUS_USAGE;
  snprintf(path, sizeof(path), "/v1/%s/%s", option_is_set(ctl, "results") ? "evaluations" : "jobs",
           id);
  return show(ctl, path, print_job);
}

/* Sends a request to /v1/, noun + s, / + id + behind for each job that the operands name, and tells
 * of each reply: `accepted`, if the work goes on for now (202), else `words`. */
static int each_job(struct ctl *ctl, struct request request, const char *noun, const char *behind,
                    const char *words, const char *accepted)
{
  int worst = STATUS_OK;
  for (size_t i = 0; i < ctl->n_operands; i++) {
    const char *id = ctl->operands[i];
    char path[96];
    json_t *value;
    long code;
    if (!check_job_id(id))
      return STATUS_USAGE;
    snprintf(path, sizeof(path), "/v1/%ss/%s%s", noun, id, behind);
    request.path = path;
    int status = send_json(ctl, &request, &code, &value);
    if (value != NULL && !ctl->json && !ctl->quiet)
      printf("%s %s", noun, id);
    if (value != NULL)
      tell(ctl, value, code == 202 ? accepted : words);
    json_decref(value);
    if (status != STATUS_OK)
      worst = status;
    if (status == STATUS_CONNECTION || status == STATUS_INTERRUPTED)
      break;
  }
  return worst;
}

int run_job_change(struct ctl *ctl)
{
  char verb[16];
  snprintf(verb, sizeof(verb), "/%s", strchr(ctl->command->name, ' ') + 1);
  /* May be repeated, since a job that is in the state already stays in it. */
  return each_job(ctl, (struct request){.method = "POST", .repeatable = true}, "job", verb,
                  " is {state}", " is {state}, its running work is being stopped");
}

int run_job_prune(struct ctl *ctl)
{
  const char *command = ctl->command->name;
  const char *words = ": {items:#} checkpoint{items:s} deleted, {bytes:MB} MB",
             *recordings = ": recordings deleted, {bytes:MB} MB";
  int64_t step = 0;
  char behind[48] = "/checkpoints";
  if (!option_number(ctl, "step", 1, 1000000, &step))
    return STATUS_USAGE;
  if (step > 0)
    snprintf(behind, sizeof(behind), "/checkpoints/%" PRId64, step);
  if (strncmp(command, "job", 3) == 0)
    return each_job(ctl, (struct request){.method = "DELETE"}, "evaluation", "/trajectories",
                    recordings, recordings);
  return each_job(ctl, (struct request){.method = "DELETE"},
                  strncmp(command, "train", 5) == 0 ? "training" : "campaign", behind, words,
                  words);
}

int run_job_weight(struct ctl *ctl)
{
  const char *id = ctl->operands[0], *words = ctl->operands[1];
  char *end, path[64];
  double weight = strtod(words, &end);
  json_t *job;
  if (!check_job_id(id))
    return STATUS_USAGE;
  if (end == words || *end != 0 || !isfinite(weight))
    return complain(STATUS_USAGE, "\"%s\" is not a number", words);
  snprintf(path, sizeof(path), "/v1/jobs/%s/weight", id);
  json_t *request = json_pack("{s:f}", "weight", weight);
  const int status = post_again(ctl, path, request, &job);
  json_decref(request);
  if (job != NULL)
    tell(ctl, job, "job {id} has the weight {weight:g}");
  json_decref(job);
  return status;
}
