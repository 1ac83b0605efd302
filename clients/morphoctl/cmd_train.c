/* cmd_train.c: train start, list, show, export. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "fields.h"
#include "table.h"
#include "training.h"
#include "transport.h"

/* ---- start ---- */

/* Makes {"campaign": id} or {"evaluation": id}, depending on the kind of the job. */
static int name_population(struct ctl *ctl, const char *id, json_t **object)
{
  char path[64];
  json_t *job;
  if (!check_job_id(id))
    return STATUS_USAGE;
  snprintf(path, sizeof(path), "/v1/jobs/%s", id);
  int status = transport_get_json(ctl, path, 0, &job);
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
  int status = STATUS_OK;
  for (size_t i = 1; i < ctl->n_operands && status == STATUS_OK; i++)
    status = designs_add_operand(&designs, ctl->operands[i]);
  if (status == STATUS_OK && n_random > 0)
    status = designs_add_random(&designs, (uint64_t)seed, (size_t)n_random);
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
  json_t *request = json_pack("{s:s}", "kind", kind), *training = NULL;
  int status = request != NULL ? fill_designs(ctl, finetune, request)
                               : complain(STATUS_ERROR, "out of memory");
  if (status == STATUS_OK)
    status = fill_schedule(ctl, request, "schedule");
  if (status == STATUS_OK)
    status = fill_fields(ctl, request);
  if (status == STATUS_OK)
    status = request_fill_physics(ctl, request);
  if (status == STATUS_OK)
    status = post_job(ctl, "/v1/trainings", request, 0, &training);
  json_decref(request);
  bool watch = option_is_set(ctl, "watch");
  if (status == STATUS_OK && ctl->json && !watch) {
    print_json(training);
  } else if (status == STATUS_OK) {
    const char *id = text_of(training, "id");
    const json_t *settings = json_object_get(training, "settings");
    char steps[32], batch[32];
    if (!watch)
      print_plain_line(stdout, "%s", id);
    if (!ctl->quiet && !ctl->json)
      print_plain_line(stderr, "training %s is accepted: %s steps of %s robots%s%s", id,
                       count_text(number_of(settings, "steps"), steps),
                       count_text(number_of(settings, "batch"), batch),
                       watch ? "" : "; morphoctl train watch ", watch ? "" : id);
    if (watch)
      status = watch_started(ctl, id, watch_training);
  }
  json_decref(training);
  return status;
}

/* ---- list, show ---- */

static void add_training(struct table *table, const json_t *item)
{
  const json_t *progress = json_object_get(item, "progress");
  char step[32], steps[32], loss[32], score[32], time[32];
  const char *cells[] = {
      text_of(item, "id"),
      text_of(item, "kind"),
      text_of(item, "name"),
      text_of(item, "state"),
      count_text(number_of(progress, "step"), step),
      count_text(number_of(progress, "steps"), steps),
      score_text(json_object_get(progress, "mean_loss"), loss),
      score_text(json_object_get(json_object_get(item, "validation"), "mean_score"), score),
      time_text(json_object_get(item, "created_at"), time),
      text_of(item, "label")};
  table_add(table, cells);
}

int run_train_list(struct ctl *ctl)
{
  json_t *items = NULL;
  int status = collect_states(ctl, "/v1/trainings", &items);
  return print_list(ctl, status, items,
                    ">training|kind|name|state|>step|>of|>loss|>validation|created|label",
                    add_training);
}

static void print_settings(const struct ctl *ctl, const json_t *settings)
{
  char a[32], b[32], c[32];
  const json_t *schedule = json_object_get(settings, "schedule"),
               *adam = json_object_get(settings, "adam");
  const json_t *validation = json_object_get(settings, "validation"),
               *physics = json_object_get(settings, "physics");
  const json_t *checkpoint = json_object_get(settings, "checkpoint");
  print_fact(ctl, "batch", "%s robots, seed %" PRId64, count_text(number_of(settings, "batch"), a),
             number_of(settings, "seed"));
  if (json_is_integer(json_object_get(settings, "n_designs"))) {
    const json_t *population = json_object_get(settings, "population");
    const char *evaluation = text_of(population, "evaluation"),
               *campaign = text_of(population, "campaign");
    print_fact(ctl, "designs", "%s%s%s", count_text(number_of(settings, "n_designs"), a),
               *evaluation != 0 ? " of evaluation "
               : *campaign != 0 ? " of campaign "
                                : "",
               *evaluation != 0 ? evaluation : campaign);
  }
  print_fact(ctl, "schedule", "%s, %s down to %s", text_of(schedule, "kind"),
             real_text(json_object_get(schedule, "peak"), a),
             real_text(json_object_get(schedule, "floor"), b));
  print_fact(ctl, "adam", "%s, %s, %s", real_text(json_object_get(adam, "beta1"), a),
             real_text(json_object_get(adam, "beta2"), b),
             real_text(json_object_get(adam, "epsilon"), c));
  const bool restarts = strcmp(text_of(settings, "adjoint_rule"), "restart") == 0;
  print_fact(ctl, "limits", "gradient %s, adjoint %s (%s%s%s)",
             real_text(json_object_get(settings, "gradient_norm_limit"), a),
             real_text(json_object_get(settings, "adjoint_bound"), b),
             text_of(settings, "adjoint_rule"), restarts ? ", weight " : "",
             restarts ? real_text(json_object_get(settings, "restart_weight"), c) : "");
  print_fact(ctl, "physics", "%" PRId64 " steps of %s s, impact %s", number_of(physics, "n_steps"),
             real_text(json_object_get(physics, "dt_s"), a), text_of(physics, "impact"));
  if (number_of(validation, "every_steps") > 0)
    print_fact(ctl, "validates",
               "every %" PRId64 " steps on %" PRId64 " designs in %" PRId64 " environments",
               number_of(validation, "every_steps"), number_of(validation, "designs"),
               number_of(validation, "environments"));
  int64_t steps = number_of(checkpoint, "every_steps"), seconds = number_of(checkpoint, "every_s");
  int n = steps > 0 ? snprintf(a, sizeof(a), "every %" PRId64 " steps", steps) : 0;
  a[n] = 0;
  if (seconds > 0)
    snprintf(b, sizeof(b), "%severy %" PRId64 " s", n > 0 ? " or " : "", seconds);
  print_fact(ctl, "checkpoints", "%s%s, the newest %" PRId64 " kept",
             n + seconds > 0 ? a : "at pauses, stops and the end", seconds > 0 ? b : "",
             number_of(checkpoint, "keep"));
}

/* Prints the versions of the code: usually one line, more if other code continued the training. */
static void print_code(const struct ctl *ctl, const json_t *code)
{
  size_t i;
  const json_t *entry;
  json_array_foreach(code, i, entry)
  {
    const char *fingerprint = text_of(entry, "fingerprint");
    if (i == 0)
      print_fact(ctl, "code", "%s", fingerprint);
    else
      print_fact(ctl, "", "%s after step %" PRId64, fingerprint, number_of(entry, "from_step"));
  }
}

static void print_training(const struct ctl *ctl, const json_t *training)
{
  char text[256];
  const json_t *settings = json_object_get(training, "settings"),
               *progress = json_object_get(training, "progress");
  print_fact(ctl, "training", "%s (%s)", text_of(training, "id"), text_of(training, "kind"));
  print_fact(ctl, "name", "%s", text_of(training, "name"));
  const char *phase = text_of(training, "phase");
  print_job_state(ctl, training, strcmp(phase, "idle") != 0 ? phase : "");
  print_controller_fact(ctl, "from", json_object_get(training, "parent"),
                        text_of(settings, "sensor"));
  print_settings(ctl, settings);
  training_step_text(number_of(progress, "step"), number_of(progress, "steps"), text, sizeof(text));
  print_fact(ctl, "progress", "%s", text);
  if (number_of(progress, "step") > 0) {
    training_progress_text(progress, text, sizeof(text));
    print_fact(ctl, "last step", "%s", text);
  }
  if (number_of(progress, "diverged") + number_of(progress, "zeroed") > 0)
    print_fact(ctl, "", "%" PRId64 " robots diverged, %" PRId64 " gave no finite gradient",
               number_of(progress, "diverged"), number_of(progress, "zeroed"));
  training_validation_text(json_object_get(training, "validation"), text, sizeof(text));
  print_fact(ctl, "validation", "%s", text);
  if (json_is_integer(json_object_get(training, "checkpoint_step")))
    print_fact(ctl, "checkpoint", "of step %" PRId64, number_of(training, "checkpoint_step"));
  print_code(ctl, json_object_get(training, "code"));
  const json_t *controller = json_object_get(training, "controller");
  if (json_is_object(controller))
    print_controller_fact(ctl, "controller", controller, "");
  print_job_times(ctl, training);
}

int run_train_show(struct ctl *ctl)
{
  struct training training = {.json = NULL};
  const char *id = ctl->operands[0];
  char path[64];
  if (!check_job_id(id))
    return STATUS_USAGE;
  snprintf(training.id, sizeof(training.id), "%s", id);
  snprintf(path, sizeof(path), "/v1/trainings/%s", id);
  if (ctl->json)
    return show_json(ctl, path);
  int status = training_load(ctl, &training);
  if (status == STATUS_OK) {
    print_training(ctl, training.json);
    char *plot = training_plot(ctl, &training, 78, 14);
    if (plot != NULL)
      printf("\n%s", plot);
    free(plot);
  }
  training_free(&training);
  return status;
}

/* ---- export ---- */

static int export_controller(struct ctl *ctl, const char *id)
{
  const char *output = option_text(ctl, "output", NULL);
  int64_t step = 0;
  char path[96];
  if (!option_number(ctl, "step", 1, 1000000, &step))
    return STATUS_USAGE;
  if (output != NULL && strcmp(output, "-") == 0 && isatty(STDOUT_FILENO))
    return complain(STATUS_USAGE, "a controller is not for a terminal: give --output FILE");
  int n = snprintf(path, sizeof(path), "/v1/trainings/%s/controller", id);
  if (step > 0)
    snprintf(path + n, sizeof(path) - (size_t)n, "?step=%" PRId64, step);
  struct reply reply;
  int status = transport_send(
      ctl, &(struct request){.method = "GET", .path = path, .accept = "application/octet-stream"},
      &reply);
  char *made = NULL;
  if (status == STATUS_OK && output == NULL) {
    if (asprintf(&made, "training-%s-step-%.20s.safetensors", id, reply.step) < 0)
      status = complain(STATUS_ERROR, "out of memory");
    output = made;
  }
  if (status == STATUS_OK && strspn(reply.step, "0123456789") != strlen(reply.step))
    status = complain(STATUS_ERROR, "the server's reply has no step");
  if (status == STATUS_OK)
    status = save_output(output, reply.body != NULL ? reply.body : "", reply.body_bytes);
  if (status == STATUS_OK && !ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: the controller after %s steps, %zu bytes", output, reply.step,
                     reply.body_bytes);
  free(made);
  reply_free(&reply);
  return status;
}

/* Exports a curve as CSV. */
static int export_curve(struct ctl *ctl, const char *id, const char *what, const char *output)
{
  char path[96];
  snprintf(path, sizeof(path), "/v1/trainings/%s/%s", id, what);
  return save_reply(ctl, path, "text/csv", output);
}

int run_train_export(struct ctl *ctl)
{
  const char *id = ctl->operands[0];
  const char *curve = option_text(ctl, "curve", NULL),
             *validations = option_text(ctl, "validations", NULL);
  bool controller = option_is_set(ctl, "output") || option_is_set(ctl, "step") ||
                    (curve == NULL && validations == NULL);
  if (!check_job_id(id))
    return STATUS_USAGE;
  int status = controller ? export_controller(ctl, id) : STATUS_OK;
  if (status == STATUS_OK && curve != NULL)
    status = export_curve(ctl, id, "steps", curve);
  if (status == STATUS_OK && validations != NULL)
    status = export_curve(ctl, id, "validations", validations);
  return status;
}

/* ---- prune ---- */

int run_train_prune(struct ctl *ctl)
{
  int64_t step = 0;
  char below[32] = "";
  if (!option_number(ctl, "step", 1, 1000000, &step))
    return STATUS_USAGE;
  if (step > 0)
    snprintf(below, sizeof(below), "/%" PRId64, step);
  return prune_checkpoints(ctl, "training", below);
}
