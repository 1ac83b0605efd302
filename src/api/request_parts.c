/* request_parts.c: parts that several request bodies share, except designs (design_request.c). */
#include "api/requests.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/text.h"
#include "base/words.h"
#include "http/field.h"
#include "jobs/evaluations.h"
#include "store/store.h"
#include "world/environment.h"
#include "world/factors.h"
#include "world/task_json.h"

#define LABEL_MAX      (MO_LABEL_BYTES_MAX / 4) /* characters */
#define EXPERIMENT_MAX (MO_EXPERIMENT_BYTES_MAX / 4)
#define NOTE_MAX       (MO_NOTE_BYTES_MAX / 4)

/* ---- whole bodies ---- */

int mo_read_body(const char *text, size_t size, const struct mo_fields *fields, void *parsed,
                 struct mo_parts *parts, int (*check)(struct mo_json *json, void *parsed),
                 struct mo_faults *faults)
{
  struct mo_json json;
  mo_json_start(&json, text, size, faults);
  bool object = mo_json_peek(&json) == MO_JSON_OBJECT;
  mo_fields_read(&json, fields, parsed);
  int error = parts != NULL ? parts->error : MO_OK;
  if (parts != NULL)
    parts->job.back_end = parts->device - 1;
  if (error == MO_OK && object && !json.stop && check != NULL)
    error = check(&json, parsed);
  if (error != MO_OK)
    return error;
  mo_json_finish(&json);
  return faults->malformed ? MO_ERR_FORMAT : faults->n > 0 ? MO_ERR_INVALID : MO_OK;
}

void mo_read_words(const char *text, size_t size, const struct mo_fields *fields, void *parsed,
                   bool *given)
{
  struct mo_json json;
  mo_json_start(&json, text, size, NULL);
  mo_read_ahead(&json, fields, parsed, given);
}

void mo_read_ahead(const struct mo_json *json, const struct mo_fields *fields, void *parsed,
                   bool *given)
{
  struct mo_faults faults = {0}; /* the second pass reports them */
  struct mo_json ahead = *json;
  struct mo_json_slice key;
  ahead.faults = &faults;
  if (!mo_json_object(&ahead))
    return;
  while (mo_json_member(&ahead, &key)) {
    if (given != NULL)
      *given |= mo_json_is(key, fields->rows[0].name);
    if (!mo_fields_read_member(&ahead, key, fields, parsed))
      mo_json_skip(&ahead);
  }
}

/* ---- environments ---- */

/* Losses are divided by the distance to the light at the start. */
static void check_light(struct mo_json *json, unsigned depth, const char *below,
                        const double light_xy_m[2])
{
  if (hypot(light_xy_m[0] - MO_WORLD_CENTER_M, light_xy_m[1] - MO_WORLD_CENTER_M) < MO_VOXEL_M)
    mo_json_fault_at(json, depth, below,
                     "must be at least %g m from (2.5, 2.5), where robots start; closer, losses "
                     "would be divided by almost zero",
                     MO_VOXEL_M);
}

/* Which members of an environment were given. */
struct given {
  bool task, light, terrain, heights, sigma, seed;
};

static void check_given_light(struct mo_json *json, unsigned depth,
                              const struct mo_environment *environment, const struct given *given)
{
  const struct mo_guide *guide = &environment->task.guide;
  if (guide->kind != MO_GUIDE_FIXED && given->light)
    mo_json_fault_at(json, depth, "",
                     "light_xy_m is only for a fixed light; remove it, because the guide "
                     "of the task (\"%s\") places the light",
                     mo_guide_words[guide->kind]);
  else if (guide->kind == MO_GUIDE_FIXED && !given->light)
    mo_json_fault_at(json, depth, "",
                     "light_xy_m is missing; it must be [x, y] of the light in meters");
  else if (mo_guide_has_light(guide))
    check_light(json, depth, given->light ? "/light_xy_m" : "/task/guide/light_xy_m",
                environment->light_xy_m);
}

static void read_environment(struct mo_json *json, struct mo_environment *environment)
{
  const unsigned depth = json->depth, before = json->faults->n;
  struct given given = {0};
  double sigma_m = 0;
  int64_t seed = 0;
  struct mo_json_slice key;
  *environment = mo_environment_defaults;
  struct mo_environment tasked = mo_environment_defaults; /* takes only the task and its light */
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    given.light |= mo_json_is(key, "light_xy_m");
    given.terrain |= mo_json_is(key, "terrain");
    given.heights |= mo_json_is(key, "terrain_heights_m");
    if (mo_json_is(key, "task")) {
      given.task = true;
      mo_task_read(json, &tasked);
    } else if (mo_json_is(key, "terrain_sigma_m")) {
      given.sigma = true;
      mo_json_bounded(json, 0, MO_TERRAIN_SIGMA_MAX_M, &sigma_m);
    } else if (mo_json_is(key, "seed")) {
      given.seed = true;
      mo_json_integer(json, 0, MO_SEED_MAX, &seed);
    } else if (!mo_environment_read_member(json, key, environment)) {
      mo_fields_unknown(
          json,
          "task, damage, factors, drop_m, light_xy_m, and terrain, terrain_heights_m or "
          "terrain_sigma_m with seed",
          NULL);
    }
  }
  if (json->stop)
    return;
  environment->task = tasked.task;
  if (json->faults->n == before && tasked.task.guide.kind != MO_GUIDE_FIXED && !given.light)
    memcpy(environment->light_xy_m, tasked.light_xy_m, sizeof(tasked.light_xy_m));
  if (json->faults->n == before)
    check_given_light(json, depth, environment, &given);
  const bool drawn = given.sigma || given.seed;
  const int ways = (int)given.terrain + (int)given.heights + (int)drawn;
  if (ways > 1 || given.sigma != given.seed || (ways == 0 && !given.task))
    mo_json_fault_at(json, depth, "",
                     "give the terrain either as terrain, as terrain_heights_m, or as "
                     "terrain_sigma_m and seed%s",
                     given.task ? ", or leave all of them out for flat ground" : "");
  else if (drawn)
    mo_terrain_random((uint64_t)seed, 0, 0, sigma_m, environment->terrain_heights_m);
  if (json->faults->n == before && mo_environment_check(environment, NULL) != MO_OK)
    mo_json_fault_at(json, depth, "", "a drawn height exceeds %g m; use another seed",
                     MO_HEIGHT_LIMIT_M);
}

/* Returns the matching word, or NULL. */
static const char *find_word(const char *const *words, struct mo_json_slice name)
{
  while (*words != NULL && !mo_json_is(name, *words))
    words++;
  return *words;
}

static void read_set(struct mo_json *json, struct mo_parts *parts)
{
  const unsigned depth = json->depth;
  struct mo_json_slice name;
  if (!mo_json_string(json, &name))
    return;
  const char *suite = find_word(mo_suite_words, name);
  parts->environment_set = suite != NULL ? suite : find_word(mo_set_words, name);
  if (suite != NULL && !parts->takes_suites) {
    mo_json_fault_at(json, depth, "",
                     "%s is a suite of %d sets, which only evaluations accept; give the set of one "
                     "task, such as %s",
                     suite, MO_SUITE_TASKS, mo_suite_set(mo_word_index(mo_suite_words, suite), 2));
    parts->environment_set = NULL;
    return;
  }
  if (parts->environment_set != NULL)
    return;
  mo_json_fault_at(json, depth, "",
                   "unknown set of environments; GET /v1/environment-sets lists them: paper-test, "
                   "morpho-12-walk, morpho-12-walk-held-out and others%s",
                   parts->takes_suites ? "; the suites are morpho-12 and morpho-12-held-out" : "");
}

#define TOO_MANY_HEIGHTS                                                                           \
  "all grids together may have at most %d heights; use smaller or fewer grids"

/* Reads an array of 1 to MO_ENVIRONMENTS_MAX environments, each by `read`. Skips it if the request
 * already contains another list, which a later check reports. */
static void read_list(struct mo_json *json, const char *what,
                      void (*read)(struct mo_json *json, struct mo_environment *environment),
                      struct mo_parts *parts)
{
  const unsigned depth = json->depth;
  size_t n_heights = 0; /* of grids */
  uint32_t n = 0;
  if (parts->environments != NULL) {
    mo_json_skip(json);
    return;
  }
  parts->environments = calloc(MO_ENVIRONMENTS_MAX, sizeof(*parts->environments));
  if (parts->environments == NULL) {
    parts->error = MO_ERR_NO_MEMORY;
    json->stop = true;
    return;
  }
  mo_json_array(json);
  while (mo_json_item(json)) {
    if (n < MO_ENVIRONMENTS_MAX && n_heights <= MO_GRIDS_HEIGHTS_MAX) {
      read(json, &parts->environments[n]);
      const struct mo_terrain_grid *grid = parts->environments[n].grid;
      n_heights += grid != NULL ? (size_t)grid->columns * grid->rows : 0;
    } else {
      mo_json_skip(json);
    }
    n += n <= MO_ENVIRONMENTS_MAX;
  }
  if (n_heights > MO_GRIDS_HEIGHTS_MAX)
    mo_json_fault_at(json, depth, "", TOO_MANY_HEIGHTS, MO_GRIDS_HEIGHTS_MAX);
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    mo_json_fault_at(json, depth, "", "must have 1 to %d %s, got %s", MO_ENVIRONMENTS_MAX, what,
                     n == 0 ? "none" : "too many");
  parts->n_environments = n < MO_ENVIRONMENTS_MAX ? n : MO_ENVIRONMENTS_MAX;
}

/* How the environments of a request are varied. */
struct variation {
  struct mo_factor_ranges ranges;
  int64_t count, seed; /* count 0: as many as there are environments to vary */
};

/* Sets varied (MO_ENVIRONMENTS_MAX, empty) to `count` of the environments in turn, with variations
 * drawn from the ranges, and replaces the environments by them. MO_ERR_LIMIT: their grids have too
 * many heights. MO_ERR_UNSUPPORTED, MO_ERR_RANGE: environment *at cannot be varied in this way;
 * `message` says why. */
static int vary(struct mo_parts *parts, const struct variation *by, struct mo_environment *varied,
                uint32_t *at, struct mo_message *message)
{
  struct mo_variation variations[MO_ENVIRONMENTS_MAX];
  uint32_t n_base = parts->n_environments;
  if (parts->environments != NULL)
    memcpy(varied, parts->environments, n_base * sizeof(*varied));
  else
    n_base = mo_environment_set(mo_word_index(mo_set_words, mo_parts_set(parts)), varied);
  const uint32_t n = by->count > 0 ? (uint32_t)by->count : n_base;
  int error = mo_variations_draw(&by->ranges, (uint64_t)by->seed, 0, n, variations);
  for (*at = 0; *at < n_base && *at < n && error == MO_OK; *at += error == MO_OK)
    error = mo_environment_check_vary(&varied[*at], &by->ranges, message);
  for (uint32_t i = n_base; i < n; i++)
    varied[i] = varied[i - n_base];
  size_t n_heights = 0;
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    const struct mo_terrain_grid *grid = varied[i].grid;
    error = mo_environment_vary(&variations[i], &varied[i]);
    n_heights += grid != NULL ? (size_t)grid->columns * grid->rows : 0;
  }
  if (error != MO_OK)
    return error;
  if (n_heights > MO_GRIDS_HEIGHTS_MAX)
    return MO_ERR_LIMIT;
  if (n < n_base)
    memset(varied + n, 0, (n_base - n) * sizeof(*varied));
  mo_environments_hold(varied, n);
  mo_environments_free(parts->environments, MO_ENVIRONMENTS_MAX);
  parts->environments = varied;
  parts->n_environments = n;
  parts->environment_set = NULL;
  parts->is_varied = true;
  return MO_OK;
}

static void read_environments(struct mo_json *json, void *value);

/* Reads {"of": a set or a list, "vary": ranges, "count", "seed"} */
static void read_variation(struct mo_json *json, struct mo_parts *parts)
{
  const unsigned depth = json->depth, before = json->faults->n;
  struct variation by = {.ranges = mo_factors_constant(), .seed = 1};
  const bool takes_suites = parts->takes_suites;
  struct mo_message message = {""};
  struct mo_json_slice key;
  parts->takes_suites = false;
  mo_json_object(json);
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "of") && mo_json_peek(json) == MO_JSON_OBJECT) {
      mo_json_fault(json, "must be the name of a set or an array of environments");
      mo_json_skip(json);
    } else if (mo_json_is(key, "of")) {
      read_environments(json, parts);
    } else if (mo_json_is(key, "vary")) {
      by.ranges.given = true;
      mo_fields_read(json, &mo_vary_fields, &by.ranges);
    } else if (mo_json_is(key, "count")) {
      mo_json_integer(json, 1, MO_ENVIRONMENTS_MAX, &by.count);
    } else if (mo_json_is(key, "seed")) {
      mo_json_integer(json, 0, MO_SEED_MAX, &by.seed);
    } else {
      mo_fields_unknown(json, "of, vary, count and seed", NULL);
    }
  }
  parts->takes_suites = takes_suites;
  if (json->stop || json->faults->n > before)
    return;
  if (!by.ranges.given)
    mo_json_fault_at(json, depth, "", "vary is missing: {\"friction\": [0.5, 1.2], …}");
  else if (mo_factor_ranges_check("vary", &by.ranges, &message) != MO_OK)
    mo_json_fault_at(json, depth, "/vary", "%s", message.text);
  else {
    struct mo_environment *varied = calloc(MO_ENVIRONMENTS_MAX, sizeof(*varied));
    uint32_t at = 0;
    const int error = varied != NULL ? vary(parts, &by, varied, &at, &message) : MO_ERR_NO_MEMORY;
    if (error == MO_OK)
      return;
    free(varied);
    if (error == MO_ERR_UNSUPPORTED || error == MO_ERR_RANGE) {
      mo_json_fault_at(json, depth, "/vary", "environment %u of those that vary: %s", at,
                       message.text);
      return;
    }
    if (error == MO_ERR_LIMIT) {
      mo_json_fault_at(json, depth, "/count", TOO_MANY_HEIGHTS, MO_GRIDS_HEIGHTS_MAX);
      return;
    }
    parts->error = MO_ERR_NO_MEMORY;
    json->stop = true;
  }
}

static void read_environments(struct mo_json *json, void *value)
{
  struct mo_parts *parts = value;
  enum mo_json_kind kind = mo_json_peek(json);
  parts->has_environments = true;
  if (kind == MO_JSON_STRING) {
    read_set(json, parts);
    return;
  }
  if (kind == MO_JSON_OBJECT && !parts->only_named) {
    read_variation(json, parts);
    return;
  }
  if (parts->only_named || kind != MO_JSON_ARRAY) {
    if (parts->only_named)
      mo_json_fault(json, "must be the name of a set or suite, such as \"morpho-12\"; to score "
                          "designs in listed environments, submit them to POST /v1/evaluations");
    else
      mo_json_fault(json,
                    "must be the name of a set, such as \"paper-test\", an array of 1 to %d "
                    "environments, or an object that varies either: {\"of\", \"vary\", …}",
                    MO_ENVIRONMENTS_MAX);
    mo_json_skip(json);
    return;
  }
  read_list(json, "environments", read_environment, parts);
}
const struct mo_field_own mo_environments_field = {.read = read_environments};

/* Reads a task into an environment that is otherwise empty. */
static void read_task(struct mo_json *json, struct mo_environment *environment)
{
  const unsigned depth = json->depth, before = json->faults->n;
  *environment = mo_environment_defaults;
  mo_task_read(json, environment);
  const struct mo_guide *guide = &environment->task.guide;
  if (!json->stop && json->faults->n == before && guide->kind != MO_GUIDE_FIXED &&
      mo_guide_has_light(guide))
    check_light(json, depth, "/guide/light_xy_m", environment->light_xy_m);
}

static void read_tasks(struct mo_json *json, void *value)
{
  struct mo_parts *parts = value;
  parts->has_tasks = true;
  if (mo_json_peek(json) == MO_JSON_ARRAY) {
    read_list(json, "tasks", read_task, parts);
    return;
  }
  mo_json_fault(json, "must be an array of 1 to %d tasks, such as [\"walk\", \"path\"]",
                MO_ENVIRONMENTS_MAX);
  mo_json_skip(json);
}
const struct mo_field_own mo_tasks_field = {.read = read_tasks};

/* ---- names, labels, ids ---- */

/* Copies a string into `text`. Returns false if it does not fit. */
static bool copy_slice(struct mo_json_slice slice, char *text, size_t capacity)
{
  if (slice.size >= capacity)
    return false;
  memcpy(text, slice.bytes, slice.size);
  text[slice.size] = '\0';
  return true;
}

static void read_controller(struct mo_json *json, void *value)
{
  struct mo_parts *parts = value;
  struct mo_json_slice name;
  struct mo_sha256 hash;
  char text[sizeof(parts->controller)];
  unsigned depth = json->depth;
  parts->has_controller = true;
  parts->no_controller = mo_json_peek(json) == MO_JSON_NULL;
  if (parts->no_controller)
    mo_json_skip(json);
  else if (mo_json_string(json, &name)) {
    bool good = copy_slice(name, text, sizeof(text)) &&
                (strncmp(text, "sha256:", 7) == 0
                     ? mo_sha256_from_hex(text + 7, strlen(text + 7), &hash) == MO_OK
                     : mo_controller_name_check(text) == MO_OK);
    if (good)
      memcpy(parts->controller, text, sizeof(text));
    else
      mo_json_fault_at(json, depth, "",
                       "must be a controller's name, or sha256: and 64 hexadecimal digits");
  }
}

static void read_name(struct mo_json *json, void *value)
{
  struct mo_json_slice name;
  char text[MO_NAME_BYTES_MAX + 1];
  unsigned depth = json->depth;
  if (!mo_json_string(json, &name))
    return;
  if (copy_slice(name, text, sizeof(text)) && mo_controller_name_check(text) == MO_OK)
    memcpy(value, text, strlen(text) + 1);
  else
    mo_json_fault_at(json, depth, "",
                     "must be a controller's name: 1 to %d of a-z, 0-9, '.', '_' and '-', "
                     "beginning with a letter or digit",
                     MO_NAME_BYTES_MAX);
}
const struct mo_field_own mo_name_field = {.read = read_name};

/* Reads a text of `least` to `most` characters, of up to four bytes each. Returns false after
 * adding a fault. */
static bool read_text(struct mo_json *json, size_t least, size_t most, char *text)
{
  struct mo_json_slice words;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &words))
    return false;
  const size_t characters = mo_utf8_length(words.bytes, words.size);
  if (characters < least || characters > most) {
    mo_json_fault_at(json, depth, "", "must have %s%zu characters, got %zu",
                     least > 0 ? "1 to " : "at most ", most, characters);
    return false;
  }
  memcpy(text, words.bytes, words.size);
  text[words.size] = '\0';
  return true;
}

static void read_label(struct mo_json *json, void *value)
{
  struct mo_parts *parts = value;
  if (read_text(json, 0, LABEL_MAX, parts->label))
    parts->job.label = parts->label;
}

static void read_experiment(struct mo_json *json, void *value)
{
  struct mo_parts *parts = value;
  if (read_text(json, 1, EXPERIMENT_MAX, parts->experiment))
    parts->job.experiment = parts->experiment;
}

/* Reads a text, or null, which removes the text. has, words: members of the edit. */
static void read_edit(struct mo_json *json, size_t least, size_t most, char *text, bool *has,
                      const char **words)
{
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    *has = true;
    *words = NULL;
  } else if (read_text(json, least, most, text)) {
    *has = true;
    *words = text;
  }
}

static void edit_label(struct mo_json *json, void *value)
{
  struct mo_parsed_edit *parsed = value;
  struct mo_job_edit *edit = &parsed->edit;
  read_edit(json, 0, LABEL_MAX, parsed->label, &edit->has_label, &edit->label);
}

static void edit_experiment(struct mo_json *json, void *value)
{
  struct mo_parsed_edit *parsed = value;
  struct mo_job_edit *edit = &parsed->edit;
  read_edit(json, 1, EXPERIMENT_MAX, parsed->experiment, &edit->has_experiment, &edit->experiment);
}

static void edit_note(struct mo_json *json, void *value)
{
  struct mo_parsed_edit *parsed = value;
  struct mo_job_edit *edit = &parsed->edit;
  read_edit(json, 1, NOTE_MAX, parsed->note, &edit->has_note, &edit->note);
}

static void edit_archived(struct mo_json *json, void *value)
{
  struct mo_job_edit *edit = &((struct mo_parsed_edit *)value)->edit;
  edit->has_archived = mo_json_bool(json, &edit->archived) || edit->has_archived;
}

static const struct mo_field_own edits[] = {
    {.read = edit_label}, {.read = edit_experiment}, {.read = edit_note}, {.read = edit_archived}};
static const struct mo_field edit_rows[] = {{"label", MO_FIELD_OWN, .own = &edits[0]},
                                            {"experiment", MO_FIELD_OWN, .own = &edits[1]},
                                            {"note", MO_FIELD_OWN, .own = &edits[2]},
                                            {"archived", MO_FIELD_OWN, .own = &edits[3]}};
const struct mo_fields mo_edit_fields = MO_FIELDS(edit_rows);

bool mo_read_job_id(struct mo_json *json, const char *what, int64_t *id)
{
  struct mo_json_slice digits;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &digits))
    return false;
  if (digits.size > 0 && digits.bytes[0] != '0' &&
      mo_decimal(digits.bytes, digits.size, 1, INT64_MAX, id))
    return true;
  mo_json_fault_at(json, depth, "", "must be the id of %s, a positive integer in decimal digits",
                   what);
  return false;
}

/* ---- the tables ---- */

static const char *const priority_words[] = {"batch", "interactive", NULL}; /* enum mo_urgency */
static const char *const device_words[] = {"auto", "cpu", "cuda", NULL};    /* −1 or above */
const struct mo_field_own mo_controller_field = {.read = read_controller};
const struct mo_field_own mo_label_field = {.read = read_label};
static const struct mo_field_own experiment = {read_experiment};
#define AT(member) offsetof(struct mo_parts, member)
static const struct mo_field weight_rows[] = {
    {"weight", MO_FIELD_NUMBER, 0, 0, .min = MO_WEIGHT_MIN, .max = MO_WEIGHT_MAX, .unit = "",
     .help = "the job's share of the cores"},
};
const struct mo_fields mo_weight_fields = {weight_rows, 1};
static const struct mo_field rows[] = {
    {"controller", MO_FIELD_OWN, 0, 0, .own = &mo_controller_field, .unit = "",
     .help = "a controller by name or hash"},
    {"label", MO_FIELD_OWN, 0, 0, .own = &mo_label_field, .unit = "",
     .help = "a text to find the job by"},
    {"experiment", MO_FIELD_OWN, 0, 0, .own = &experiment, .unit = "",
     .help = "the experiment that the job belongs to"},
    {"priority", MO_FIELD_WORD, 0, AT(job.priority), .words = priority_words, .unit = "",
     .help = "among other work"},
    {NULL, MO_FIELD_INLINE, 0, AT(job.weight), .group = &mo_weight_fields},
    {"device", MO_FIELD_WORD, 0, AT(device), .words = device_words, .unit = "",
     .help = "where the job is computed"},
};
#undef AT
const struct mo_fields mo_parts_fields = MO_FIELDS(rows);

const char *mo_parts_set(const struct mo_parts *parts)
{
  if (parts->environments != NULL)
    return NULL;
  return parts->environment_set != NULL ? parts->environment_set : mo_set_words[0];
}

const char *mo_parts_controller(const struct mo_parts *parts)
{
  return parts->controller[0] != '\0' ? parts->controller : NULL;
}

void mo_parts_free(struct mo_parts *parts)
{
  free(parts->genotypes);
  free(parts->notes);
  mo_environments_free(parts->environments, MO_ENVIRONMENTS_MAX);
}
_Static_assert(MO_BACK_END_AUTO + 1 == 0 && (int)MO_ON_DEVICE == 1,
               "the words are in the order of their values");
