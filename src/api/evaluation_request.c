/* evaluation_request.c: see evaluation_request.h. Every fault names its place: a cell out of bounds
 * is at /designs/3/cells/7/0. */
#include "api/evaluation_request.h"

#include <stdlib.h>
#include <string.h>

#include "api/request_parts.h"
#include "rollout/physics.h"

static void read_record(struct mo_json *json, struct mo_evaluation_request *request)
{
  struct mo_json_slice what;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    if (!mo_json_string(json, &what))
      continue;
    bool *flag = mo_json_is(what, "com")      ? &request->record_com
                 : mo_json_is(what, "masses") ? &request->record_masses
                                              : NULL;
    if (flag == NULL)
      mo_json_fault(json, "\"com\" or \"masses\" is expected");
    else if (*flag)
      mo_json_fault(json, "this is given twice");
    else
      *flag = true;
  }
}

static int read_request(struct mo_json *json, struct mo_parsed_evaluation *parsed)
{
  struct mo_evaluation_request *request = &parsed->request;
  struct mo_json_slice key;
  bool designs = false, stride_given = false;
  int code = MO_OK, choice;
  int64_t stride = 10;
  if (!mo_json_object(json))
    return MO_OK;
  while (code == MO_OK && mo_json_member(json, &key)) {
    if (mo_json_is(key, "designs")) {
      designs = true;
      code = mo_read_designs(json, &parsed->genotypes, &request->n_designs);
    } else if (mo_json_is(key, "environments")) {
      code = mo_read_environments(json, &parsed->environments, &request->n_environments);
    } else if (mo_json_is(key, "controller")) {
      mo_read_controller(json, parsed->controller);
    } else if (mo_json_is(key, "record")) {
      read_record(json, request);
    } else if (mo_json_is(key, "record_stride")) {
      stride_given = mo_json_integer(json, 1, MO_STEPS_MAX, &stride);
    } else if (mo_json_is(key, "physics")) {
      mo_fields_read(json, &mo_physics_fields, &request->physics);
    } else if (mo_json_is(key, "precision")) {
      if (mo_read_choice(json, "float32", "float64", &choice))
        request->precision = choice ? MO_FLOAT64 : MO_FLOAT32;
    } else if (mo_json_is(key, "priority")) {
      if (mo_read_choice(json, "batch", "interactive", &choice))
        request->priority = choice ? MO_INTERACTIVE : MO_BATCH;
    } else if (mo_json_is(key, "weight")) {
      mo_read_weight(json, &request->weight);
    } else if (mo_json_is(key, "device")) {
      mo_read_device(json, &request->back_end);
    } else if (mo_json_is(key, "label")) {
      if (mo_read_label(json, parsed->label))
        request->label = parsed->label;
    } else if (mo_json_is(key, "verify")) {
      mo_json_bool(json, &request->verify);
    } else {
      mo_read_unknown(
          json,
          "designs, environments, controller, record, record_stride, physics, precision, priority, "
          "weight, device, label, verify");
    }
  }
  if (code != MO_OK || json->stop)
    return code;
  if (!designs)
    mo_json_fault_at(json, 0, "", "designs is missing: an array of 1 to %d designs",
                     MO_DESIGNS_MAX);
  if (stride_given && stride > request->physics.n_steps)
    mo_json_fault_at(json, 0, "/record_stride",
                     "%lld is given; at most n_steps, which is %u, is expected", (long long)stride,
                     request->physics.n_steps);
  request->record_stride =
      stride < request->physics.n_steps ? (uint32_t)stride : request->physics.n_steps;
  return code;
}

int mo_evaluation_parse(const char *text, size_t size, struct mo_parsed_evaluation *parsed,
                        struct mo_faults *faults)
{
  *parsed = (struct mo_parsed_evaluation){.controller = "default", .environment_set = "paper-test"};
  parsed->request.physics = mo_default_physics();
  parsed->request.precision = MO_FLOAT32;
  parsed->request.priority = -1;
  parsed->request.weight = 1;
  parsed->request.back_end = MO_BACK_END_AUTO;
  struct mo_json *json = malloc(sizeof(*json));
  if (json == NULL)
    return MO_ERR_NO_MEMORY;
  mo_json_start(json, text, size, faults);
  int code = read_request(json, parsed);
  if (code == MO_OK)
    mo_json_finish(json);
  free(json);
  if (code != MO_OK)
    return code;
  if (faults->malformed)
    return MO_ERR_FORMAT;
  if (faults->n > 0)
    return MO_ERR_INVALID;
  parsed->request.genotypes = parsed->genotypes;
  parsed->request.controller = parsed->controller;
  if (parsed->environments != NULL)
    parsed->request.environments = parsed->environments;
  else
    parsed->request.environment_set = parsed->environment_set;
  return MO_OK;
}

void mo_evaluation_parsed_free(struct mo_parsed_evaluation *parsed)
{
  free(parsed->genotypes);
  free(parsed->environments);
  *parsed = (struct mo_parsed_evaluation){0};
}
