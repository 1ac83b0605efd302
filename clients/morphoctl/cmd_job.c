/* cmd_job.c: job show, cancel, pause, resume, weight; the same and prune for training runs and
 * campaigns; job label, experiment, note, archive, restore, delete; usage. */
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "results.h"

/* Returns a copy of a job with the names of its measures as one text. */
static const json_t *with_measures(const json_t *job, const json_t *measures)
{
  json_t *copy = keep(json_copy((json_t *)job));
  json_object_set_new(copy, "measured", json_string(words_of(measures)));
  return copy;
}

static void print_job(const struct ctl *ctl, const json_t *job)
{
  static const struct fact first[] = {
      {"job", "{id} ({kind}, {priority})"},
      JOB_STATE_FACTS(""),
      {"name", "{training.name}"},
      {"atlas", "{atlas.name}"},
      {"mode", "{campaign.mode}"},
      {"progress",
       "[step {training.step:,} of {training.steps:,}; see morphoctl train show {id}"
       "|generation [{campaign.generation:,}|0] of {campaign.generations:,}; see morphoctl "
       "campaign show {id}|{atlas.bodies_done:,}[ of {atlas.bodies_total:,}] bodies"
       "[  {atlas.progress.rollouts_per_s:.0f} rollouts/s]"
       "[  {atlas.progress.seconds_left:duration} left]"
       "|{certificate.rollouts_done:,} of {certificate.rollouts:,} rollouts"
       "[  {certificate.progress.rollouts_per_s:.0f} rollouts/s]"
       "[  {certificate.progress.seconds_left:duration} left]; see morphoctl certificate {id}]"},
      {"scope", "[at most {atlas.voxels} voxel{atlas.voxels:s}, {atlas.orientations}[, {measured}]"
                "|{certificate.designs} design{certificate.designs:s} in "
                "{certificate.trials} trial{certificate.trials:s}]"},
      {NULL, NULL}};
  static const struct fact evaluation[] = {
      {"controller", CONTROLLER_WORDS("controller", "")},
      {"environments", "[{environments}|{environments.count} from the request]"},
      {"precision", "{precision}"},
      {"physics",
       "{physics.n_steps} steps of {physics.dt_s:g} s, integrator {physics.integrator}, impact "
       "{physics.impact}[, outputs held for {physics.control_period_s>0:g} s]"},
      {"designs", "{n_designs:,}[, the {best:,} best of them]"},
      {"errors", "[estimated with {displaced_starts} displaced starts]"},
      {"measures", "[{measured}]"},
      {"tolerance", "[{tolerance:g}; physics and precision are those of the first rung]"},
      {"rollouts", "{rollouts_done:,} of {rollouts_total:,}[  {progress.rollouts_per_s:.0f} "
                   "rollouts/s][  {progress.seconds_left:duration} left]"},
      {"from store", "[{rollouts_cached>0:,}]"},
      {"not needed", "[{rollouts_cut>0:,}]"},
      {"diverged", "[{rollouts_diverged>0:,}]"},
      {NULL, NULL}};
  static const struct fact times[] = {JOB_TIME_FACTS, {NULL, NULL}};
  const json_t *measures = json_object_get(job, "measures");
  if (measures == NULL)
    measures = json_object_get(json_object_get(job, "atlas"), "measures");
  if (measures != NULL)
    job = with_measures(job, measures);
  print_facts(ctl, job, first);
  if (json_object_get(job, "training") == NULL && json_object_get(job, "campaign") == NULL &&
      json_object_get(job, "atlas") == NULL && json_object_get(job, "certificate") == NULL)
    print_facts(ctl, job, evaluation);
  print_facts(ctl, job, times);
  if (json_object_get(job, "results") != NULL) {
    putchar('\n');
    print_results(ctl, job, NULL, false, 0);
  }
}

void run_job_show(struct ctl *ctl)
{
  const char *id = job_id(ctl->operands[0]);
  const char *list = option_is_set(ctl, "results") ? "evaluations" : "jobs";
  show(ctl, path_to("/v1/%s/%s", list, id), print_job);
}

/* Sends a request to /v1/, noun + s, / + id + behind for each job in the operands, and reports each
 * reply: `accepted` if the work continues for now (202), otherwise `words`. */
static void each_job(struct ctl *ctl, struct request request, const char *noun, const char *behind,
                     const char *words, const char *accepted)
{
  int worst = STATUS_OK;
  for (size_t i = 0; i < ctl->n_operands; i++) {
    const char *id = job_id(ctl->operands[i]);
    json_t *value;
    long code;
    request.path = path_to("/v1/%ss/%s%s", noun, id, behind);
    int status = try_json(ctl, &request, &code, &value);
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
  if (worst != STATUS_OK)
    leave(worst);
}

void run_job_change(struct ctl *ctl)
{
  const char *verb = keep(format_text("/%s", strchr(ctl->command->name, ' ') + 1));
  each_job(ctl, (struct request){.method = "POST"}, "job", verb, " is {state}",
           " is {state}; its running work is being stopped");
}

void run_job_prune(struct ctl *ctl)
{
  const char *command = ctl->command->name;
  const char *words = ": {items:#} checkpoint{items:s} deleted, {bytes:MB} MB",
             *recordings = ": recordings deleted, {bytes:MB} MB";
  const int64_t step = option_number(ctl, "step", 1, 1000000, 0);
  char behind[48] = "/checkpoints";
  if (step > 0)
    snprintf(behind, sizeof(behind), "/checkpoints/%" PRId64, step);
  if (strncmp(command, "job", 3) == 0)
    each_job(ctl, (struct request){.method = "DELETE"}, "evaluation", "/trajectories", recordings,
             recordings);
  else
    each_job(ctl, (struct request){.method = "DELETE"},
             strncmp(command, "train", 5) == 0 ? "training" : "campaign", behind, words, words);
}

void run_job_weight(struct ctl *ctl)
{
  const char *id = job_id(ctl->operands[0]), *words = ctl->operands[1];
  char *end;
  double weight = strtod(words, &end);
  if (end == words || *end != 0 || !isfinite(weight))
    fail(STATUS_USAGE, "\"%s\" is not a number", words);
  const json_t *request = keep(json_pack("{s:f}", "weight", weight));
  tell(ctl, post_again(ctl, path_to("/v1/jobs/%s/weight", id), request),
       "job {id} now has weight {weight:g}");
}

/* ---- labels, notes, archive ---- */

static void edit_jobs(struct ctl *ctl, json_t *edit, const char *words)
{
  if (edit == NULL)
    fail(STATUS_USAGE, "the text is not UTF-8");
  each_job(ctl, json_request("PATCH", NULL, keep(edit)), "job", "", words, words);
}

/* Runs job label, experiment and note: prints it, sets it to TEXT, or removes it. */
void run_job_text(struct ctl *ctl)
{
  const char *member = strchr(ctl->command->name, ' ') + 1,
             *text = ctl->n_operands > 1 ? ctl->operands[1] : NULL;
  const bool removes = option_is_set(ctl, "remove");
  if (removes && text != NULL)
    fail(STATUS_USAGE, "--remove deletes the %s; do not give TEXT with it", member);
  ctl->n_operands = 1;
  const char *words =
      keep(format_text("[ has the %s \"{%s}\"| has no %s]", member, member, member));
  if (text == NULL && !removes)
    tell(ctl, get_json(ctl, "/v1/jobs/%s", job_id(ctl->operands[0])),
         keep(format_text("[{%s}|job {id} has no %s]", member, member)));
  else
    edit_jobs(ctl, json_pack("{s:s?}", member, text != NULL && *text != 0 ? text : NULL), words);
}

void run_job_archive(struct ctl *ctl)
{
  const bool archives = strcmp(ctl->command->name, "job archive") == 0;
  edit_jobs(ctl, json_pack("{s:b}", "archived", archives),
            archives ? " is archived" : " is shown in lists again");
}

static bool asks(struct ctl *ctl)
{
  char answer[16] = "";
  for (size_t i = 0; i < ctl->n_operands; i++)
    print_from(stderr, get_json(ctl, "/v1/jobs/%s", job_id(ctl->operands[i])),
               "{kind} {id}[ \"{label}\"], {state}[, {recorded_bytes>0:MB} MB of recordings]"
               "[, {campaign.generations:,} generation{campaign.generations:s}"
               "|, {training.steps:,} step{training.steps:s}|, {n_designs:,} design{n_designs:s}]");
  if (!isatty(STDIN_FILENO))
    fail(STATUS_USAGE, "standard input is not a terminal: use --yes to confirm");
  fputs("Results, recordings, curves and phylogeny are deleted permanently; designs, scores and "
        "controllers are kept.\nDelete? [y/N] ",
        stderr);
  return fgets(answer, sizeof(answer), stdin) != NULL &&
         (strcmp(answer, "y\n") == 0 || strcmp(answer, "yes\n") == 0);
}

void run_job_delete(struct ctl *ctl)
{
  static const char words[] = " is deleted[, {recorded_bytes>0:MB} MB of recordings]"
                              "[, {checkpoint_bytes>0:MB} MB of checkpoints]";
  if (!option_is_set(ctl, "yes") && !asks(ctl))
    leave(STATUS_NEGATIVE);
  each_job(ctl, (struct request){.method = "DELETE"}, "job", "", words, words);
}

void run_usage(struct ctl *ctl)
{
  static const char *const names[] = {"label", "experiment", "submitted_by", "kind", NULL};
  const char *by = option_word(ctl, "by", names, "label");
  print_items(ctl, get_json(ctl, "/v1/usage?by=%s&limit=1000", by),
              "name=[{name}|–]|>jobs={jobs:,}|>core time={core_seconds:duration}"
              "|>device time={device_seconds:duration}");
}
