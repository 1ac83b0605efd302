/* fields.c: see fields.h. */
#include "fields.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

json_t *field_value(enum field_kind kind, const char *text)
{
  char *end = NULL;
  errno = 0;
  if (kind == FIELD_WHOLE) {
    const long long number = strtoll(text, &end, 10);
    return *text != 0 && *end == 0 && errno == 0 ? json_integer(number) : NULL;
  }
  if (kind == FIELD_REAL) {
    const double number = strtod(text, &end);
    return *text != 0 && *end == 0 ? json_real(number) : NULL; /* NULL if it is not finite */
  }
  return json_string(text);
}

const char *field_kind_name(enum field_kind kind)
{
  return kind == FIELD_WHOLE ? "whole number" : kind == FIELD_REAL ? "number" : "text in UTF-8";
}

void fill_place(json_t *request, const char *place, json_t *value)
{
  const char *dot;
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
}

int fill_fields(const struct ctl *ctl, json_t *request)
{
  for (const struct option_spec *spec = ctl->command->options; spec->name != NULL; spec++) {
    const char *text = spec->place != NULL ? option_text(ctl, spec->name, NULL) : NULL;
    if (text == NULL)
      continue;
    json_t *value = field_value(spec->kind, text);
    if (value == NULL)
      return complain(STATUS_USAGE, "--%s: \"%s\" is not a %s", spec->name, text,
                      field_kind_name(spec->kind));
    fill_place(request, spec->place, value);
  }
  return STATUS_OK;
}

int fill_schedule(const struct ctl *ctl, json_t *request, const char *place)
{
  static const char *const kinds[] = {"restarts", "cosine", "constant"};
  const char *name = option_text(ctl, "schedule", NULL);
  const size_t length = strlen(place);
  bool kind = false;
  for (size_t i = 0; i < 3 && name != NULL; i++)
    kind |= strcmp(kinds[i], name) == 0;
  for (const struct option_spec *spec = ctl->command->options; spec->name != NULL && !kind; spec++)
    if (spec->place != NULL && strncmp(spec->place, place, length) == 0 &&
        spec->place[length] == '.' && option_is_set(ctl, spec->name))
      return complain(STATUS_USAGE, "--%s needs --schedule restarts, cosine or constant%s",
                      spec->name, name != NULL ? ": the schedule that is named has its own" : "");
  if (name != NULL)
    fill_place(request, place, kind ? json_pack("{s:s}", "kind", name) : json_string(name));
  return STATUS_OK;
}
