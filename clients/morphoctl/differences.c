/* differences.c: the settings in which two runs differ. */
#include "differences.h"

#include <string.h>

#include "commands.h"

/* Appends the members that differ. place: path of both objects, "" or ending with a dot. */
static void find(json_t *found, const char *place, const json_t *a, const json_t *b)
{
  json_t *all = keep(json_copy((json_t *)a));
  const char *name;
  json_t *value;
  json_object_update_missing(all, (json_t *)b);
  json_object_foreach(all, name, value)
  {
    const json_t *one = json_object_get(a, name), *other = json_object_get(b, name);
    const char *setting = keep(format_text("%s%s", place, name));
    if (json_is_object(one) && json_is_object(other))
      find(found, keep(format_text("%s.", setting)), one, other);
    else if (!json_equal(one, other))
      json_array_append_new(
          found, json_pack("{s:s, s:[O?, O?]}", "setting", setting, "values", one, other));
  }
}

json_t *differences_of(const json_t *a, const json_t *b)
{
  json_t *found = keep(json_array());
  find(found, "", a, b);
  return found;
}

void require_distinct(const struct ctl *ctl, const char *noun)
{
  for (size_t i = 1; i < ctl->n_operands; i++)
    for (size_t k = 0; k < i; k++)
      if (strcmp(ctl->operands[i], ctl->operands[k]) == 0)
        fail(STATUS_USAGE, "%s %s is given twice: there is nothing to compare", noun,
             ctl->operands[i]);
}

const char *short_text(const json_t *value)
{
  const char *text =
      value == NULL || json_is_null(value)
          ? "-"
          : keep(json_dumps(value, JSON_COMPACT | JSON_ENCODE_ANY | JSON_REAL_PRECISION(15)));
  return strlen(text) <= 40 ? text : keep(format_text("%.37s...", text));
}

void print_setting_differences(const struct ctl *ctl, const char *subject,
                               const json_t *differences)
{
  const json_t *one;
  size_t i;
  json_array_foreach(differences, i, one)
      print_fact(ctl, "differs", "%s in %s: %s, not %s", subject, text_of(one, "setting"),
                 short_text(value_at(one, "values.1")), short_text(value_at(one, "values.0")));
}
