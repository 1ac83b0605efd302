/* select_by.c: see select_by.h. */
#include "store/select_by.h"

#include <math.h>
#include <stdio.h>

double mo_select_by_score(const struct mo_select_by *by, double mean)
{
  if (isnan(mean))
    return (double)INFINITY;
  return (by->direction == MO_DIRECTION_MAX ? -mean : mean) + 0.0; /* not −0: equal scores have
                                                                    * equal bits */
}

void mo_select_by_name(const struct mo_select_by *by, struct mo_own_score *own)
{
  *own = (struct mo_own_score){.name = ""};
  if (!by->is_set)
    return;
  const struct mo_measure_info *info = &mo_measure_info[by->measure];
  snprintf(own->name, sizeof(own->name), "%s%s", by->direction == MO_DIRECTION_MAX ? "-" : "",
           info->name);
  snprintf(own->unit, sizeof(own->unit), "%s", info->unit);
}

uint32_t mo_measures_mean(uint32_t set, const double (*values)[MO_MEASURES], uint32_t n,
                          double *means)
{
  uint32_t n_means = 0;
  for (unsigned m = 0; m < MO_MEASURES; m++) {
    double sum = 0;
    if ((set >> m & 1) == 0)
      continue;
    for (uint32_t k = 0; k < n; k++)
      sum += values[k][m];
    means[n_means++] = sum / n;
  }
  return n_means;
}

/* ---- measures as JSON ---- */

/* names: (MO_MEASURES + 1), ends with NULL. */
static void list_names(const char *names[MO_MEASURES + 1])
{
  for (unsigned m = 0; m < MO_MEASURES; m++)
    names[m] = mo_measure_info[m].name;
  names[MO_MEASURES] = NULL;
}

/* Reads the name of a measure. Returns −1 after a fault. */
static int read_name(struct mo_json *json)
{
  const char *names[MO_MEASURES + 1];
  char list[MO_WORDS_BYTES];
  struct mo_json_slice name;
  int m = 0;
  if (!mo_json_string(json, &name))
    return -1;
  list_names(names);
  while (m < MO_MEASURES && !mo_json_is(name, names[m]))
    m++;
  if (m < MO_MEASURES)
    return m;
  mo_json_fault(json, "must be %s", mo_words_list(names, list));
  return -1;
}

static void read_measures(struct mo_json *json, void *value)
{
  uint32_t *set = value;
  const enum mo_json_kind kind = mo_json_peek(json);
  bool all = false;
  *set = 0;
  if (kind == MO_JSON_TRUE || kind == MO_JSON_FALSE) {
    if (mo_json_bool(json, &all) && all)
      *set = MO_MEASURES_ALL;
    return;
  }
  const unsigned depth = json->depth, before = json->faults->n;
  if (kind != MO_JSON_ARRAY) {
    const char *names[MO_MEASURES + 1];
    char list[MO_WORDS_BYTES];
    list_names(names);
    mo_json_skip(json);
    mo_json_fault_at(json, depth, "", "must be true, for all measures, or an array of names: %s",
                     mo_words_list(names, list));
    return;
  }
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    const int m = read_name(json);
    if (m >= 0 && (*set >> m & 1) != 0)
      mo_json_fault(json, "duplicate measure; list it once");
    else if (m >= 0)
      *set |= UINT32_C(1) << m;
  }
  if (*set == 0 && json->faults->n == before)
    mo_json_fault_at(json, depth, "", "must name at least one measure; leave it out for none");
}

static void write_measures(struct mo_text *text, const void *value)
{
  const uint32_t set = *(const uint32_t *)value;
  bool any = false;
  mo_text_add(text, "[");
  for (unsigned m = 0; m < MO_MEASURES; m++)
    if (set >> m & 1) {
      mo_text_format(text, any ? ",\"%s\"" : "\"%s\"", mo_measure_info[m].name);
      any = true;
    }
  mo_text_add(text, "]");
}

const struct mo_field_own mo_measures_field = {.read = read_measures, .write = write_measures};

/* ---- the measure to select by ---- */

static void read_measure(struct mo_json *json, void *value)
{
  *(int *)value = read_name(json);
}

static void write_measure(struct mo_text *text, const void *value)
{
  mo_text_format(text, "\"%s\"", mo_measure_info[*(const int *)value].name);
}

static const struct mo_field_own measure = {.read = read_measure, .write = write_measure};
static const char *const directions[] = {"max", "min", NULL};
#define AT(member) offsetof(struct mo_select_by, member)
static const struct mo_field rows[] = {
    {"measure", MO_FIELD_OWN, 0, AT(measure), .own = &measure, .unit = "",
     .help = "the measure whose mean is the score"},
    {"direction", MO_FIELD_WORD, 0, AT(direction), .words = directions, .unit = "",
     .help = "whether larger or smaller values are better"},
};
#undef AT
const struct mo_fields mo_select_by_fields = MO_FIELDS(rows);

static void read_select_by(struct mo_json *json, void *value)
{
  const unsigned depth = json->depth, before = json->faults->n;
  struct mo_select_by by = {.is_set = true, .measure = -1, .direction = -1};
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    *(struct mo_select_by *)value = (struct mo_select_by){.is_set = false};
    return;
  }
  mo_fields_read(json, &mo_select_by_fields, &by);
  if (json->stop || json->faults->n > before)
    return;
  if (by.measure < 0)
    mo_json_fault_at(json, depth, "",
                     "measure is missing; name the one to select by, such as \"displacement_m\"");
  else if (by.direction < 0)
    mo_json_fault_at(json, depth, "",
                     "direction is missing; it must be \"max\" if larger values are better, or "
                     "\"min\"");
  else
    *(struct mo_select_by *)value = by;
}

static void write_select_by(struct mo_text *text, const void *value)
{
  if (((const struct mo_select_by *)value)->is_set)
    mo_fields_write_object(text, &mo_select_by_fields, value);
  else
    mo_text_add(text, "null");
}

const struct mo_field_own mo_select_by_field = {.read = read_select_by, .write = write_select_by};
