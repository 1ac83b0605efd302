/* cmd_train.c: train start, export. */
#include <inttypes.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "live.h"

/* ---- start ---- */

/* Makes {"campaign": id} or {"evaluation": id}, depending on the kind of the job. */
static json_t *name_population(struct ctl *ctl, const char *id)
{
  const json_t *job = get_json(ctl, "/v1/jobs/%s", job_id(id));
  return json_pack("{s:s}",
                   strcmp(text_of(job, "kind"), "campaign") == 0 ? "campaign" : "evaluation", id);
}

/* Makes the population of an atlas, or NULL. */
static json_t *name_atlas(struct ctl *ctl)
{
  const char *atlas = option_text(ctl, "atlas", NULL);
  const int64_t count = option_number(ctl, "count", 1, DESIGNS_MAX, 0);
  const int64_t seed = option_number(ctl, "atlas-seed", 0, INT64_C(9007199254740991), -1);
  if (atlas == NULL && (count > 0 || seed >= 0))
    fail(STATUS_USAGE, "--count and --atlas-seed are for --atlas");
  if (atlas != NULL && count == 0)
    fail(STATUS_USAGE, "--atlas needs --count, the number of bodies");
  if (atlas == NULL)
    return NULL;
  json_t *object = json_pack("{s:s,s:I}", "atlas", atlas, "count", (json_int_t)count);
  if (seed >= 0)
    json_object_set_new(object, "seed", json_integer(seed));
  return object;
}

/* Adds the designs of a finetuning run: designs in operands, random designs, a population, or
 * bodies of an atlas. */
static void fill_designs(struct ctl *ctl, bool finetune, json_t *request)
{
  const json_t *random = random_of(ctl, "random-seed", DESIGNS_MAX);
  const int64_t best = option_number(ctl, "best", 1, DESIGNS_MAX, 0);
  const char *population = option_text(ctl, "population", NULL);
  json_t *atlas = name_atlas(ctl);
  const bool listed = ctl->n_operands > 1 || random != NULL;
  const int n_sources = listed + (population != NULL) + (atlas != NULL);
  if (!finetune && n_sources > 0)
    fail(STATUS_USAGE, "pretrain draws its own bodies: designs, --random, --population and "
                       "--atlas are for train start finetune");
  if (finetune && n_sources != 1)
    fail(STATUS_USAGE, "finetune learns on designs (files, --random N), on a --population, or on "
                       "bodies from an --atlas: give one of the three");
  if (best > 0 && population == NULL)
    fail(STATUS_USAGE, "--best needs --population");
  if (population != NULL) {
    json_t *object = name_population(ctl, population);
    json_object_set_new(request, "population", object);
    if (best > 0)
      json_object_set_new(object, "best", json_integer(best));
  }
  if (atlas != NULL)
    json_object_set_new(request, "population", atlas);
  if (listed)
    json_object_set(request, "designs", given_designs(ctl, 1, random).list);
}

/* Adds the tasks of a list with commas; the service knows their names. */
static void fill_tasks(const struct ctl *ctl, json_t *request)
{
  const char *word = option_text(ctl, "tasks", NULL);
  if (word == NULL)
    return;
  json_t *tasks = json_array();
  for (bool is_last = false; !is_last;) {
    const size_t size = strcspn(word, ",");
    json_array_append_new(tasks, json_stringn(word, size));
    is_last = word[size] == '\0';
    word += size + 1;
  }
  json_object_set_new(request, "tasks", tasks);
}

void run_train_start(struct ctl *ctl)
{
  const char *kind = ctl->operands[0];
  bool finetune = strcmp(kind, "finetune") == 0;
  if (!finetune && strcmp(kind, "pretrain") != 0)
    fail(STATUS_USAGE, "\"%s\" is not pretrain or finetune", kind);
  json_t *request = keep(json_pack("{s:s}", "kind", kind));
  fill_designs(ctl, finetune, request);
  if (option_is_set(ctl, "each"))
    json_object_set_new(request, "each", json_true());
  fill_schedule(ctl, request, "schedule");
  fill_tasks(ctl, request);
  request_fill(ctl, request);
  live_start(ctl, request);
}

/* ---- export ---- */

static void export_controller(struct ctl *ctl, const char *id)
{
  const char *output = option_text(ctl, "output", NULL);
  const int64_t step = option_number(ctl, "step", 1, 1000000, 0);
  if (output != NULL && strcmp(output, "-") == 0 && isatty(STDOUT_FILENO))
    fail(STATUS_USAGE, "a controller cannot be written to a terminal: give --output FILE");
  const char *path =
      path_to("/v1/trainings/%s/controller%s", id, step > 0 ? path_to("?step=%" PRId64, step) : "");
  struct reply reply;
  transport_get(ctl, path, "application/octet-stream", &reply);
  if (strspn(reply.step, "0123456789") != strlen(reply.step))
    fail(STATUS_ERROR, "the server's reply has no step");
  if (output == NULL)
    output = path_to("training-%s-step-%.20s.safetensors", id, reply.step);
  save_output(output, "", 0, reply.body, reply.body_bytes);
  if (!ctl->quiet && strcmp(output, "-") != 0)
    print_plain_line(stderr, "%s: the controller after %s steps, %zu bytes", output, reply.step,
                     reply.body_bytes);
  reply_free(&reply);
}

void run_train_export(struct ctl *ctl)
{
  static const char *const curves[][2] = {{"curve", "steps"}, {"validations", "validations"}};
  const char *id = job_id(ctl->operands[0]);
  if (option_is_set(ctl, "output") || option_is_set(ctl, "step") ||
      !(option_is_set(ctl, "curve") || option_is_set(ctl, "validations")))
    export_controller(ctl, id);
  for (size_t i = 0; i < 2; i++) {
    const char *output = option_text(ctl, curves[i][0], NULL);
    if (output != NULL)
      save_reply(ctl, path_to("/v1/trainings/%s/%s", id, curves[i][1]), "text/csv", output);
  }
}
