/* evaluation_request.c: the body of POST /v1/evaluations. Every fault names its place: a cell out
 * of bounds is at /designs/3/cells/7/0. */
#include <string.h>

#include "api/requests.h"
#include "base/words.h"
#include "rollout/physics.h"

static void read_channels(struct mo_json *json, void *value)
{
  char list[MO_WORDS_BYTES];
  struct mo_json_slice what;
  unsigned read = 0;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    unsigned i = 0;
    if (!mo_json_string(json, &what))
      continue;
    while (i < MO_CHANNELS && !mo_json_is(what, mo_channel_words[i]))
      i++;
    if (i == MO_CHANNELS)
      mo_json_fault(json, "%s is expected", mo_words_list(mo_channel_words, list));
    else if (read >> i & 1)
      mo_json_fault(json, "this is given twice");
    else
      read |= 1U << i;
  }
  *(unsigned *)value = read;
}

const struct mo_field_own mo_channels_field = {.read = read_channels};

#define AT(member) offsetof(struct mo_parsed_evaluation, member)
static const char *const precision_words[] = {"float32", "float64", NULL};
static const struct mo_field rollout_rows[] = {
    {"designs", MO_FIELD_OWN, 0, AT(parts), .own = &mo_designs_field},
    {"environments", MO_FIELD_OWN, 0, AT(parts), .own = &mo_environments_field},
    {"record", MO_FIELD_OWN, 0, AT(request.record), .own = &mo_channels_field},
    {"record_stride", MO_FIELD_COUNT, 0, AT(request.record_stride), .min = 1, .max = MO_STEPS_MAX,
     .unit = "steps", .help = "steps between frames"},
    {"physics", MO_FIELD_GROUP, 0, AT(request.physics), .group = &mo_physics_fields},
    {"precision", MO_FIELD_WORD, 0, AT(request.precision), .words = precision_words},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_repair_fields},
    {"controller", MO_FIELD_OWN, 0, AT(parts), .own = &mo_controller_field},
};
const struct mo_fields mo_rollouts_request_fields = MO_FIELDS(rollout_rows);
/* An evaluation's has the same but for the controller, which is one of the parts of every job. */
static const struct mo_fields scored = {rollout_rows,
                                        sizeof(rollout_rows) / sizeof(rollout_rows[0]) - 1};
static const struct mo_field rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &scored},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_on_fault_fields},
    {"verify", MO_FIELD_FLAG, 0, AT(request.verify)},
    {"best", MO_FIELD_COUNT, 0, AT(request.best), .min = 1, .max = MO_DESIGNS_MAX,
     .unit = "designs", .help = "how many of the best get whole scores"},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_parts_fields},
};
#undef AT
const struct mo_fields mo_evaluation_request_fields = MO_FIELDS(rows);
_Static_assert(MO_FLOAT32 == 0 && MO_FLOAT64 == 1, "the words stand in the order of their values");

static int check(struct mo_json *json, void *any)
{
  struct mo_parsed_evaluation *parsed = any;
  struct mo_evaluation_request *request = &parsed->request;
  const uint32_t steps = request->physics.n_steps;
  if (!parsed->parts.has_designs)
    mo_json_fault_at(json, 0, "", "designs is missing: an array of 1 to %d designs",
                     MO_DESIGNS_MAX);
  if (parsed->parts.no_controller)
    mo_json_fault_at(json, 0, "/controller", "null is given; a controller's name is expected");
  if (request->record_stride > steps)
    mo_json_fault_at(json, 0, "/record_stride",
                     "%u is given; at most n_steps, which is %u, is expected",
                     request->record_stride, steps);
  if (parsed->parts.has_designs &&
      request->best > parsed->parts.n_designs + parsed->parts.n_skipped)
    mo_json_fault_at(json, 0, "/best",
                     "%u is given; at most the number of designs, which is %u, is expected",
                     request->best, parsed->parts.n_designs + parsed->parts.n_skipped);
  if (request->best > 0 && (request->verify || request->record != 0))
    mo_json_fault_at(json, 0, "/best", "this is given with %s; only one of them is expected",
                     request->verify ? "verify" : "record");
  if (request->record_stride == 0)
    request->record_stride = steps < 10 ? steps : 10;
  return MO_OK;
}

static int parse(const char *text, size_t size, const struct mo_fields *fields,
                 struct mo_parsed_evaluation *parsed, struct mo_faults *faults)
{
  struct mo_evaluation_request *request = &parsed->request;
  *parsed = (struct mo_parsed_evaluation){
      .request = {.physics = mo_default_physics(), .precision = MO_FLOAT32},
      .parts = {.job = {.priority = -1, .weight = 1}, .controller = "default"}};
  mo_read_words(text, size, &mo_design_rules_fields, &parsed->parts, NULL);
  int error = mo_read_body(text, size, fields, parsed, &parsed->parts, check, faults);
  if (error != MO_OK)
    return error;
  const struct mo_parts *parts = &parsed->parts;
  request->job = parts->job;
  request->controller = parts->controller;
  request->genotypes = parts->genotypes;
  request->n_designs = parts->n_designs;
  request->notes = parts->notes;
  request->n_notes = parts->n_notes;
  request->n_skipped = parts->n_skipped;
  request->environments = parts->environments;
  request->n_environments = parts->n_environments;
  request->environment_set = parts->environments == NULL ? "paper-test" : NULL;
  return MO_OK;
}

int mo_evaluation_parse(const char *text, size_t size, struct mo_parsed_evaluation *parsed,
                        struct mo_faults *faults)
{
  return parse(text, size, &mo_evaluation_request_fields, parsed, faults);
}

int mo_rollouts_parse(const char *text, size_t size, struct mo_parsed_evaluation *parsed,
                      struct mo_faults *faults)
{
  return parse(text, size, &mo_rollouts_request_fields, parsed, faults);
}
