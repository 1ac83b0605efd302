/* settings.c: the settings of a certificate, their defaults and bounds. */
#include <math.h>
#include <string.h>

#include "certificate/fields.h"
#include "world/factors.h"

const char *const mo_axis_words[] = {"base",      "precision", "step",   "held_out", "chance",
                                     "stiffness", "mass",      "drag",   "gravity",  "actuation",
                                     "friction",  "drop",      "worlds", NULL};
_Static_assert(sizeof(mo_axis_words) / sizeof(*mo_axis_words) == MO_AXES + 1,
               "every axis has a word");

struct mo_certificate_settings mo_certificate_defaults(void)
{
  return (struct mo_certificate_settings){
      .seed = 1,
      .axes = MO_AXES_ALL,
      .held_out = 256,
      .worlds = 64,
      .chance = 16,
      .n_levels = 4,
      .levels = {0.7, 0.9, 1.1, 1.3},
      .ranges =
          {true, {0.7, 1.3}, {0.7, 1.3}, {0.7, 1.3}, {0.7, 1.3}, {0.7, 1.3}, {1.0 / 3, 4.0 / 3}},
  };
}

/* ---- axes: an array of words ---- */

static void read_axes(struct mo_json *json, void *value)
{
  uint32_t *axes = value, read = 1U << MO_AXIS_BASE;
  const unsigned depth = json->depth, before = json->faults->n;
  char list[MO_WORDS_BYTES];
  bool any = false;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    struct mo_json_slice name;
    any = true;
    if (!mo_json_string(json, &name))
      continue;
    int axis = 0;
    while (mo_axis_words[axis] != NULL && !mo_json_is(name, mo_axis_words[axis]))
      axis++;
    if (axis == MO_AXES)
      mo_json_fault(json, "must be %s", mo_words_list(mo_axis_words, list));
    else
      read |= 1U << axis;
  }
  if (!any && !json->stop)
    mo_json_fault_at(json, depth, "",
                     "must have at least one axis, or be left out for all of them");
  if (json->faults->n == before)
    *axes = read;
}

static void write_axes(struct mo_text *text, const void *value)
{
  const uint32_t axes = *(const uint32_t *)value;
  mo_text_add(text, "[");
  for (unsigned axis = 0; axis < MO_AXES; axis++)
    if (axes >> axis & 1)
      mo_text_format(text, axes & ((1U << axis) - 1) ? ",\"%s\"" : "\"%s\"", mo_axis_words[axis]);
  mo_text_add(text, "]");
}

static int check_axes(const char *name, const void *value, struct mo_message *message)
{
  const uint32_t axes = *(const uint32_t *)value;
  if ((axes & ~MO_AXES_ALL) != 0)
    return mo_fail(message, MO_ERR_INVALID,
                   "%s has a bit that is not an axis: %#x; use bits 0 to %d", name, (unsigned)axes,
                   MO_AXES - 1);
  if ((axes & 1U << MO_AXIS_BASE) == 0)
    return mo_fail(message, MO_ERR_INVALID, "%s must have the bit of the base", name);
  return MO_OK;
}

/* ---- levels: an array of numbers ---- */

#define LEVELS_AT offsetof(struct mo_certificate_settings, n_levels)
/* value: n_levels of the settings, which the levels follow. */
static const struct mo_certificate_settings *around(const void *value)
{
  return (const struct mo_certificate_settings *)(const void *)((const char *)value - LEVELS_AT);
}

static int check_levels(const char *name, const void *value, struct mo_message *message)
{
  const struct mo_certificate_settings *settings = around(value);
  if (settings->n_levels < 1 || settings->n_levels > MO_CERTIFICATE_LEVELS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "%s must have 1 to %d numbers, got %u", name,
                   MO_CERTIFICATE_LEVELS_MAX, (unsigned)settings->n_levels);
  for (uint32_t k = 0; k < settings->n_levels; k++) {
    const double level = settings->levels[k];
    if (!isfinite(level))
      return mo_fail(message, MO_ERR_INVALID, "%s must have finite numbers", name);
    if (!(level >= MO_FACTOR_MIN && level <= MO_FACTOR_MAX))
      return mo_fail(message, MO_ERR_RANGE, "%s must have numbers from %g to %g, got %s", name,
                     MO_FACTOR_MIN, MO_FACTOR_MAX, MO_NUMBER(level));
    if (level == 1)
      return mo_fail(message, MO_ERR_INVALID, "%s must not have 1, which is the base", name);
    if (k > 0 && !(level > settings->levels[k - 1]))
      return mo_fail(message, MO_ERR_INVALID, "%s must be ascending, got %s after %s", name,
                     MO_NUMBER(level), MO_NUMBER(settings->levels[k - 1]));
  }
  return MO_OK;
}

static void read_levels(struct mo_json *json, void *value)
{
  struct mo_certificate_settings read = {0};
  struct mo_certificate_settings *settings = (void *)((char *)value - LEVELS_AT);
  struct mo_message message;
  const unsigned depth = json->depth, before = json->faults->n;
  double level;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json))
    if (mo_json_number(json, &level) && read.n_levels++ < MO_CERTIFICATE_LEVELS_MAX)
      read.levels[read.n_levels - 1] = level;
  if (json->stop || json->faults->n != before)
    return;
  if (check_levels("", &read.n_levels, &message) != MO_OK) {
    /* The message after its first space. */
    mo_json_fault_at(json, depth, "", "%s", message.text + 1);
    return;
  }
  settings->n_levels = read.n_levels;
  memcpy(settings->levels, read.levels, sizeof(read.levels));
}

static void write_levels(struct mo_text *text, const void *value)
{
  const struct mo_certificate_settings *settings = around(value);
  mo_text_add(text, "[");
  for (uint32_t k = 0; k < settings->n_levels; k++) {
    mo_text_next(text);
    mo_text_json_number(text, settings->levels[k]);
  }
  mo_text_add(text, "]");
}

/* ---- all settings ---- */

static int check_ranges(const char *name, const void *value, struct mo_message *message)
{
  return mo_factor_ranges_check(name, value, message);
}

static void read_ranges(struct mo_json *json, void *value)
{
  struct mo_factor_ranges *ranges = value;
  mo_fields_read(json, &mo_factor_range_fields, ranges);
  ranges->given = mo_factors_vary(ranges);
}

static void write_ranges(struct mo_text *text, const void *value)
{
  mo_fields_write_object(text, &mo_factor_range_fields, value);
}

#define AT(member) offsetof(struct mo_certificate_settings, member)
static const struct mo_field_own axes = {read_axes, write_axes, check_axes};
static const struct mo_field_own levels = {read_levels, write_levels, check_levels};
static const struct mo_field_own ranges = {read_ranges, write_ranges, check_ranges};
static const struct mo_field rows[] = {
    {"seed", MO_FIELD_SEED, 0, AT(seed), .unit = "",
     .help = "of worlds and constants that are drawn"},
    {"axes", MO_FIELD_OWN, 0, AT(axes), .own = &axes, .unit = "",
     .help = "what is changed: words of mo_axis_words"},
    {"held_out", MO_FIELD_COUNT, 0, AT(held_out), .min = 2, .max = MO_CERTIFICATE_HELD_OUT_MAX,
     .unit = "", .help = "held_out: number of fresh worlds"},
    {"worlds", MO_FIELD_COUNT, 0, AT(worlds), .min = 2, .max = MO_CERTIFICATE_WORLDS_MAX,
     .unit = "", .help = "worlds: number of worlds with constants drawn from the ranges"},
    {"chance", MO_FIELD_COUNT, 0, AT(chance), .min = 2, .max = MO_CERTIFICATE_CHANCE_MAX,
     .unit = "", .help = "chance: copies of the worlds with constants changed by at most 0.01 %"},
    {"levels", MO_FIELD_OWN, 0, AT(n_levels), .own = &levels, .unit = "",
     .help = "factors of each constant, ascending, without 1"},
    {"ranges", MO_FIELD_OWN, 0, AT(ranges), .own = &ranges, .group = &mo_factor_range_fields,
     .unit = "", .help = "worlds: lowest and highest factor of each constant"},
    {"top", MO_FIELD_COUNT, 0, AT(top), .min = 0, .max = MO_CERTIFICATE_DESIGNS_MAX, .unit = "",
     .help = "number of best designs that the regret is for; 0: a tenth of them, at least 1"},
};
#undef AT
const struct mo_fields mo_certificate_fields = MO_FIELDS(rows);

int mo_certificate_check(const struct mo_certificate_settings *settings, struct mo_message *message)
{
  return mo_fields_check(&mo_certificate_fields, "", settings, message);
}
