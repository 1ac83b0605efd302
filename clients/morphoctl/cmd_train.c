/* cmd_train.c: train start, list, export. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "training.h"
#include "transport.h"

/* ---- start ---- */

/* Makes {"campaign": id} or {"evaluation": id}, depending on the kind of the job. */
static int name_population(struct ctl *ctl, const char *id, json_t **object)
{
  json_t *job;
  if (!check_job_id(id))
    return STATUS_USAGE;
  int status = get_json(ctl, &job, "/v1/jobs/%s", id);
  if (status == STATUS_OK)
    *object = json_pack(
        "{s:s}", strcmp(text_of(job, "kind"), "campaign") == 0 ? "campaign" : "evaluation", id);
  json_decref(job);
  return status;
}

/* Adds what finetuning learns on: designs of operands, random designs, or a population. */
static int fill_designs(struct ctl *ctl, bool finetune, json_t *request)
{
  int64_t n_random = 0, seed = 1, best = 0;
  const char *population = option_text(ctl, "population", NULL);
  if (!option_number(ctl, "random", 1, DESIGNS_MAX, &n_random) ||
      !option_number(ctl, "random-seed", 0, INT64_MAX, &seed) ||
      !option_number(ctl, "best", 1, DESIGNS_MAX, &best))
    return STATUS_USAGE;
  bool listed = ctl->n_operands > 1 || n_random > 0;
  if (!finetune && (listed || population != NULL))
    return complain(STATUS_USAGE, "a pretraining draws bodies of its own: designs, --random and "
                                  "--population are for train start finetune");
  if (finetune && listed == (population != NULL))
    return complain(STATUS_USAGE, "a finetuning learns on designs (files, --random N) or on a "
                                  "--population: give one of the two");
  if (best > 0 && population == NULL)
    return complain(STATUS_USAGE, "--best is for --population");
  if (population != NULL) {
    json_t *object = NULL;
    int status = name_population(ctl, population, &object);
    if (status != STATUS_OK)
      return status;
    if (best > 0)
      json_object_set_new(object, "best", json_integer(best));
    json_object_set_new(request, "population", object);
  }
  struct designs designs = {0};
  int status = add_designs(ctl, 1, n_random, seed, &designs);
  if (status == STATUS_OK && listed)
    json_object_set(request, "designs", designs.list);
  designs_free(&designs);
  return status;
}

int run_train_start(struct ctl *ctl)
{
  const char *kind = ctl->operands[0];
  bool finetune = strcmp(kind, "finetune") == 0;
  if (!finetune && strcmp(kind, "pretrain") != 0)
    return complain(STATUS_USAGE, "\"%s\" is not pretrain or finetune", kind);
  json_t *request = json_pack("{s:s}", "kind", kind);
  int status = fill_designs(ctl, finetune, request);
  if (status == STATUS_OK)
    status = fill_schedule(ctl, request, "schedule");
  if (status == STATUS_OK)
    status = fill_fields(ctl, request);
  if (status == STATUS_OK)
    status = request_fill_physics(ctl, request);
  if (status == STATUS_OK)
    status = live_start(ctl, request);
  json_decref(request);
  return status;
}

int run_train_list(struct ctl *ctl)
{
  return list_items(ctl, "/v1/trainings", 50,
                    ">training={id}|kind={kind}|name={name}|state={state}|>step={progress.step:,}"
                    "|>of={progress.steps:,}|>loss={progress.mean_loss:.4f}"
                    "|>validation={validation.mean_score:.4f}|created={created_at:time}"
                    "|label={label}");
}

/* ---- export ---- */

static int export_controller(struct ctl *ctl, const char *id)
{
  const char *output = option_text(ctl, "output", NULL);
  int64_t step = 0;
  if (!option_number(ctl, "step", 1, 1000000, &step))
    return STATUS_USAGE;
  if (output != NULL && strcmp(output, "-") == 0 && isatty(STDOUT_FILENO))
    return complain(STATUS_USAGE, "a controller is not for a terminal: give --output FILE");
  const char *path =
      path_to("/v1/trainings/%s/controller%s", id, step > 0 ? path_to("?step=%" PRId64, step) : "");
  struct reply reply;
  int status = transport_get(ctl, path, "application/octet-stream", &reply);
  char *made = NULL;
  if (status == STATUS_OK && output == NULL)
    output = made = format_text("training-%s-step-%.20s.safetensors", id, reply.step);
  if (status == STATUS_OK && strspn(reply.step, "0123456789") != strlen(reply.step))
    status = complain(STATUS_ERROR, "the server's reply has no step");
  if (status == STATUS_OK)
    status = save_output(output, "", 0, reply.body, reply.body_bytes);
  if (status == STATUS_OK && !ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: the controller after %s steps, %zu bytes", output, reply.step,
                     reply.body_bytes);
  free(made);
  reply_free(&reply);
  return status;
}

int run_train_export(struct ctl *ctl)
{
  static const char *const curves[][2] = {{"curve", "steps"}, {"validations", "validations"}};
  const char *id = ctl->operands[0];
  bool controller = option_is_set(ctl, "output") || option_is_set(ctl, "step") ||
                    !(option_is_set(ctl, "curve") || option_is_set(ctl, "validations"));
  if (!check_job_id(id))
    return STATUS_USAGE;
  int status = controller ? export_controller(ctl, id) : STATUS_OK;
  for (size_t i = 0; i < 2 && status == STATUS_OK; i++) {
    const char *output = option_text(ctl, curves[i][0], NULL);
    if (output != NULL)
      status =
          save_reply(ctl, path_to("/v1/trainings/%s/%s", id, curves[i][1]), "text/csv", output);
  }
  return status;
}
