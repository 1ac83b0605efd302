/* fields.c: see fields.h. */
#include "fields.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#define N_OF(array) (sizeof(array) / sizeof((array)[0]))

static int fill_field(const struct ctl *ctl, json_t *request, const struct field *field)
{
  const char *text = option_text(ctl, field->option, NULL);
  if (text == NULL)
    return STATUS_OK;
  json_t *value = NULL;
  char *end = NULL;
  errno = 0;
  if (field->kind == FIELD_WHOLE) {
    long long number = strtoll(text, &end, 10);
    if (*text != 0 && *end == 0 && errno == 0)
      value = json_integer(number);
  } else if (field->kind == FIELD_REAL) {
    double number = strtod(text, &end);
    if (*text != 0 && *end == 0)
      value = json_real(number); /* NULL if it is not finite */
  } else {
    value = json_string(text);
  }
  if (value == NULL)
    return complain(STATUS_USAGE, "--%s: \"%s\" is not a %s", field->option, text,
                    field->kind == FIELD_WHOLE  ? "whole number"
                    : field->kind == FIELD_REAL ? "number"
                                                : "text in UTF-8");
  const char *place = field->place, *dot;
  json_t *object = request;
  while ((dot = strchr(place, '.')) != NULL) {
    char group[32];
    snprintf(group, sizeof(group), "%.*s", (int)(dot - place), place);
    json_t *inner = json_object_get(object, group);
    if (inner == NULL) {
      inner = json_object();
      json_object_set_new(object, group, inner);
    }
    object = inner;
    place = dot + 1;
  }
  json_object_set_new(object, place, value);
  return STATUS_OK;
}

int fill_fields(const struct ctl *ctl, json_t *request, const struct field *fields, size_t n)
{
  int status = STATUS_OK;
  for (size_t i = 0; i < n && status == STATUS_OK; i++)
    status = fill_field(ctl, request, &fields[i]);
  return status;
}

int fill_schedule(const struct ctl *ctl, json_t *object)
{
  static const char *const kinds[] = {"restarts", "cosine", "constant"};
  static const struct field details[] = {
      {"peak", "schedule.peak", FIELD_REAL},
      {"floor", "schedule.floor", FIELD_REAL},
      {"decay", "schedule.decay", FIELD_REAL},
      {"cycle-steps", "schedule.cycle_steps", FIELD_WHOLE},
      {"cycle-growth", "schedule.cycle_growth", FIELD_WHOLE},
      {"warmup-steps", "schedule.warmup_steps", FIELD_WHOLE},
  };
  const char *name = option_text(ctl, "schedule", NULL), *detail = NULL;
  bool kind = false;
  for (size_t i = 0; i < N_OF(kinds) && name != NULL; i++)
    kind |= strcmp(kinds[i], name) == 0;
  for (size_t i = 0; i < N_OF(details); i++)
    if (option_is_set(ctl, details[i].option))
      detail = details[i].option;
  if (detail != NULL && !kind)
    return complain(STATUS_USAGE, "--%s needs --schedule restarts, cosine or constant%s", detail,
                    name != NULL ? ": the schedule that is named has its own" : "");
  if (name != NULL && !kind)
    json_object_set_new(object, "schedule", json_string(name));
  else if (name != NULL)
    json_object_set_new(object, "schedule", json_pack("{s:s}", "kind", name));
  return fill_fields(ctl, object, details, N_OF(details));
}

int fill_optimizer(const struct ctl *ctl, json_t *object)
{
  static const struct field fields[] = {
      {"beta1", "adam.beta1", FIELD_REAL},
      {"beta2", "adam.beta2", FIELD_REAL},
      {"epsilon", "adam.epsilon", FIELD_REAL},
      {"gradient-norm-limit", "gradient_norm_limit", FIELD_REAL},
      {"adjoint-bound", "adjoint_bound", FIELD_REAL},
      {"adjoint-rule", "adjoint_rule", FIELD_WORD},
      {"restart-weight", "restart_weight", FIELD_REAL},
  };
  return fill_fields(ctl, object, fields, N_OF(fields));
}
