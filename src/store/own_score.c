/* own_score.c: see own_score.h. */
#include "store/own_score.h"

#include <string.h>

#define AT(member) offsetof(struct mo_own_score, member)
static const struct mo_field rows[] = {
    {"name", MO_FIELD_TEXT, 0, AT(name), .min = 1, .max = MO_OWN_SCORE_NAME_MAX, .unit = "",
     .help = "name of the score that the client sends"},
    {"unit", MO_FIELD_TEXT, MO_FIELD_UTF8, AT(unit), .min = 0, .max = MO_OWN_SCORE_UNIT_MAX,
     .unit = "", .help = "its unit; empty: a pure number"},
};
#undef AT
const struct mo_fields mo_own_score_fields = MO_FIELDS(rows);

bool mo_own_score_is_set(const struct mo_own_score *own)
{
  return own->name[0] != '\0';
}

bool mo_own_score_equal(const struct mo_own_score *one, const struct mo_own_score *other)
{
  return strcmp(one->name, other->name) == 0 && strcmp(one->unit, other->unit) == 0;
}

static void read_own_score(struct mo_json *json, void *value)
{
  static const char letters[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_.-";
  const unsigned depth = json->depth, before = json->faults->n;
  struct mo_own_score own = {.name = ""};
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    *(struct mo_own_score *)value = own;
    return;
  }
  mo_fields_read(json, &mo_own_score_fields, &own);
  if (json->stop || json->faults->n > before)
    return;
  if (!mo_own_score_is_set(&own))
    mo_json_fault_at(
        json, depth, "",
        "name is missing; name the score that you will send, such as \"work_per_meter\"");
  else if (own.name[strspn(own.name, letters)] != '\0')
    mo_json_fault_at(json, depth, "/name",
                     "must be 1 to %d characters: A-Z, a-z, 0-9, '_', '.' or '-'",
                     MO_OWN_SCORE_NAME_MAX);
  else
    *(struct mo_own_score *)value = own;
}

static void write_own_score(struct mo_text *text, const void *value)
{
  if (mo_own_score_is_set(value))
    mo_fields_write_object(text, &mo_own_score_fields, value);
  else
    mo_text_add(text, "null");
}

const struct mo_field_own mo_own_score_field = {.read = read_own_score, .write = write_own_score};
