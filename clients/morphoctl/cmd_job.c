/* cmd_job.c: job list, show, cancel, pause, resume, weight; prunes checkpoints for other
 * commands. */
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

static void add_job(struct table *table, const json_t *job)
{
  char designs[32], count[32], work[48], done[16], time[32];
  const json_t *training = json_object_get(job, "training"),
               *campaign = json_object_get(job, "campaign");
  int64_t total, so_far,
      n_designs =
          campaign != NULL ? number_of(campaign, "population") : number_of(job, "n_designs");
  const char *unit = training != NULL ? "steps" : campaign != NULL ? "generations" : "rollouts";
  if (training != NULL) {
    total = number_of(training, "steps");
    so_far = number_of(training, "step");
  } else if (campaign != NULL) {
    total = number_of(campaign, "generations");
    so_far = number_of(campaign, "generation");
  } else {
    total = number_of(job, "rollouts_total");
    so_far = number_of(job, "rollouts_done");
  }
  snprintf(done, sizeof(done), "%d %%", total > 0 ? (int)(100 * so_far / total) : 0);
  snprintf(work, sizeof(work), "%s %s", count_text(total, count), unit);
  const char *cells[] = {text_of(job, "id"),
                         training != NULL   ? text_of(training, "kind")
                         : campaign != NULL ? text_of(campaign, "mode")
                                            : text_of(job, "kind"),
                         text_of(job, "state"),
                         text_of(job, "priority"),
                         training != NULL ? "" : count_text(n_designs, designs),
                         work,
                         done,
                         time_text(json_object_get(job, "created_at"), time),
                         text_of(job, "label")};
  table_add(table, cells);
}

int run_job_list(struct ctl *ctl)
{
  json_t *items = NULL;
  int status = collect_states(ctl, "/v1/jobs", &items);
  return print_list(ctl, status, items,
                    ">job|kind|state|priority|>designs|>work|>done|created|label", add_job);
}

int run_job_show(struct ctl *ctl)
{
  const char *id = ctl->operands[0];
  bool results = option_is_set(ctl, "results");
  char path[64];
  if (!check_job_id(id))
    return STATUS_USAGE;
  snprintf(path, sizeof(path), "/v1/%s/%s", results ? "evaluations" : "jobs", id);
  if (ctl->json)
    return show_json(ctl, path);
  json_t *job;
  int status = transport_get_json(ctl, path, 0, &job);
  if (status == STATUS_OK) {
    print_job_facts(ctl, job);
    if (json_object_get(job, "results") != NULL) {
      putchar('\n');
      print_results(ctl, job, NULL, false, 0);
    }
  }
  json_decref(job);
  return status;
}

/* Sends a request to /v1/, noun + s, / + id + behind for each job that the operands name, and
 * reports on each. */
static int each_job(struct ctl *ctl, struct request request, const char *noun, const char *behind,
                    void (*report)(const char *noun, const char *id, const json_t *value,
                                   const struct reply *reply))
{
  int worst = STATUS_OK;
  for (size_t i = 0; i < ctl->n_operands; i++) {
    const char *id = ctl->operands[i];
    char path[96];
    if (!check_job_id(id))
      return STATUS_USAGE;
    snprintf(path, sizeof(path), "/v1/%ss/%s%s", noun, id, behind);
    request.path = path;
    struct reply reply;
    int status = transport_send(ctl, &request, &reply);
    json_t *value = status == STATUS_OK ? reply_json(&reply) : NULL;
    if (value != NULL && ctl->json)
      print_json(value);
    else if (value != NULL && !ctl->quiet)
      report(noun, id, value, &reply);
    json_decref(value);
    reply_free(&reply);
    if (status != STATUS_OK)
      worst = status;
    if (status == STATUS_CONNECTION || status == STATUS_INTERRUPTED)
      break;
  }
  return worst;
}

static void report_state(const char *noun, const char *id, const json_t *job,
                         const struct reply *reply)
{
  print_plain_line(stdout, "%s %s is %s%s", noun, id, text_of(job, "state"),
                   reply->status == 202 ? ", its running work is being stopped" : "");
}

/* verb: may be repeated, since a job that is in the state already stays in it. */
static int change(struct ctl *ctl, const char *verb)
{
  return each_job(ctl, (struct request){.method = "POST", .repeatable = true}, "job", verb,
                  report_state);
}

int run_job_cancel(struct ctl *ctl)
{
  return change(ctl, "/cancel");
}

int run_job_pause(struct ctl *ctl)
{
  return change(ctl, "/pause");
}

int run_job_resume(struct ctl *ctl)
{
  return change(ctl, "/resume");
}

int run_job_weight(struct ctl *ctl)
{
  const char *id = ctl->operands[0], *words = ctl->operands[1];
  char *end, path[64], body[64];
  double weight = strtod(words, &end);
  if (!check_job_id(id))
    return STATUS_USAGE;
  if (end == words || *end != 0 || !isfinite(weight))
    return complain(STATUS_USAGE, "\"%s\" is not a number", words);
  snprintf(path, sizeof(path), "/v1/jobs/%s/weight", id);
  int n = snprintf(body, sizeof(body), "{\"weight\":%.17g}", weight);
  struct request request = {.method = "POST",
                            .path = path,
                            .body = body,
                            .body_bytes = (size_t)n,
                            .content_type = "application/json"};
  struct reply reply;
  int status = transport_send(ctl, &request, &reply);
  json_t *job = status == STATUS_OK ? reply_json(&reply) : NULL;
  if (job != NULL && ctl->json)
    print_json(job);
  else if (job != NULL && !ctl->quiet)
    print_plain_line(stdout, "job %s has the weight %g", id,
                     json_number_value(json_object_get(job, "weight")));
  json_decref(job);
  reply_free(&reply);
  return status;
}

static void report_pruned(const char *noun, const char *id, const json_t *value,
                          const struct reply *reply)
{
  char count[32];
  const size_t n = json_array_size(json_object_get(value, "items"));
  (void)reply;
  print_plain_line(stdout, "%s %s: %s checkpoint%s deleted, %.1f MB", noun, id,
                   count_text((int64_t)n, count), n == 1 ? "" : "s",
                   (double)number_of(value, "bytes") * 1e-6);
}

int prune_checkpoints(struct ctl *ctl, const char *kind, const char *below)
{
  char behind[64];
  snprintf(behind, sizeof(behind), "/checkpoints%s", below);
  return each_job(ctl, (struct request){.method = "DELETE"}, kind, behind, report_pruned);
}
