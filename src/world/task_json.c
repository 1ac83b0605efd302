/* task_json.c: see task_json.h. */
#include "world/task_json.h"

#include <morpho/measure.h>

#include <math.h>
#include <string.h>

#include "world/environment.h"
#include "world/factors.h"
#include "world/terrain_json.h"

#define KIND(kind) (1U << MO_GUIDE_##kind)

/* ---- named tasks ---- */

const char *const mo_task_words[] = {"photo", "photo-auc", "walk",   "climb", "circle",
                                     "path",  "shuttle",   "pursue", NULL};

static const struct mo_environment named[] = {
    {.task = {{.kind = MO_GUIDE_FIXED}, MO_OBJECTIVE_REACH}},
    {.task = {{.kind = MO_GUIDE_FIXED}, MO_OBJECTIVE_APPROACH}},
    {.task = {{.kind = MO_GUIDE_AHEAD, .distance_m = MO_GUIDE_DISTANCE_M}, MO_OBJECTIVE_TRAVEL}},
    {.task = {{.kind = MO_GUIDE_AHEAD, .distance_m = MO_GUIDE_DISTANCE_M}, MO_OBJECTIVE_CLIMB}},
    /* once around in 4 s */
    {.task = {{.kind = MO_GUIDE_TURNING,
               .turn_rad_per_s = M_PI / 2,
               .distance_m = MO_GUIDE_DISTANCE_M},
              MO_OBJECTIVE_TRAVEL}},
    {.task = {{.kind = MO_GUIDE_PATH,
               .n_points = 3,
               .distance_m = MO_GUIDE_DISTANCE_M,
               .points_m = {{3.5, 2.5}, {3.5, 3.5}, {2.5, 3.5}}},
              MO_OBJECTIVE_FOLLOW}},
    {.task = {{.kind = MO_GUIDE_PATH,
               .n_points = 4,
               .distance_m = MO_GUIDE_DISTANCE_M,
               .points_m = {{3.25, 2.5}, {2.5, 2.5}, {3.25, 2.5}, {2.5, 2.5}}},
              MO_OBJECTIVE_FOLLOW}},
    {.light_xy_m = {4, 2.5},
     .task = {{.kind = MO_GUIDE_MOVING, .velocity_m_per_s = {0.3, 0}}, MO_OBJECTIVE_PURSUE}},
};
_Static_assert(sizeof(named) / sizeof(*named) + 1 == sizeof(mo_task_words) / sizeof(*mo_task_words),
               "every word has a task");

void mo_task_named(int i, struct mo_environment *environment)
{
  environment->task = named[i].task;
  if (named[i].task.guide.kind != MO_GUIDE_FIXED)
    memcpy(environment->light_xy_m, named[i].light_xy_m, sizeof(environment->light_xy_m));
}

/* ---- the members of a guide ---- */

static void read_points(struct mo_json *json, void *value);
static const struct mo_field_own points = {.read = read_points};

/* Offsets are in struct mo_environment. The offset of the points is that of the guide. */
#define AT(member) offsetof(struct mo_environment, member)
static const struct mo_field rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(task.guide.kind), .words = mo_guide_words, .unit = "",
     .help = "how the light moves"},
    {"heading_rad", MO_FIELD_NUMBER, 0, AT(task.guide.heading_rad),
     .min = -MO_GUIDE_HEADING_MAX_RAD, .max = MO_GUIDE_HEADING_MAX_RAD, .unit = "rad",
     .help = "from the x axis toward the y axis"},
    {"turn_rad_per_s", MO_FIELD_NUMBER, 0, AT(task.guide.turn_rad_per_s),
     .min = -MO_GUIDE_TURN_MAX_RAD_PER_S, .max = MO_GUIDE_TURN_MAX_RAD_PER_S, .unit = "rad/s",
     .help = "how fast the heading, or the light around center_m, turns"},
    {"distance_m", MO_FIELD_NUMBER, 0, AT(task.guide.distance_m), .min = MO_GUIDE_DISTANCE_MIN_M,
     .max = MO_GUIDE_DISTANCE_MAX_M, .unit = "m", .help = "how far ahead the light is"},
    {"points_m", MO_FIELD_OWN, 0, AT(task.guide), .own = &points, .unit = "m",
     .help = "the waypoints of the path"},
    {"light_xy_m", MO_FIELD_NUMBERS, 0, AT(light_xy_m), .n = 2, .min = -MO_LIGHT_LIMIT_M,
     .max = MO_LIGHT_LIMIT_M, .unit = "m", .help = "where the light is at the start"},
    {"velocity_m_per_s", MO_FIELD_NUMBERS, 0, AT(task.guide.velocity_m_per_s), .n = 2,
     .min = -MO_GUIDE_SPEED_MAX_M_PER_S, .max = MO_GUIDE_SPEED_MAX_M_PER_S, .unit = "m/s",
     .help = "of the light, or of center_m"},
    {"center_m", MO_FIELD_NUMBERS, 0, AT(task.guide.center_m), .n = 2, .min = -MO_LIGHT_LIMIT_M,
     .max = MO_LIGHT_LIMIT_M, .unit = "m", .help = "center of the light's circle, at the start"},
};
#undef AT
static const struct mo_fields guide_fields = MO_FIELDS(rows);

enum { IS_KIND, HEADING, TURN, DISTANCE, POINTS, LIGHT, VELOCITY, CENTER, MEMBERS };
_Static_assert(sizeof(rows) / sizeof(*rows) == MEMBERS, "the members are in the order of the rows");

/* Which kinds have a member, and which of them must have it. */
static const struct {
  unsigned has, needs;
} uses[] = {
    [IS_KIND] = {~0U, ~0U},
    [HEADING] = {KIND(AHEAD) | KIND(TURNING), 0},
    [TURN] = {KIND(TURNING) | KIND(MOVING), KIND(TURNING)},
    [DISTANCE] = {KIND(AHEAD) | KIND(TURNING) | KIND(PATH), 0},
    [POINTS] = {KIND(PATH), KIND(PATH)},
    [LIGHT] = {KIND(MOVING), KIND(MOVING)},
    [VELOCITY] = {KIND(MOVING), 0},
    [CENTER] = {KIND(MOVING), 0},
};

static void read_points(struct mo_json *json, void *value)
{
  struct mo_guide *guide = value;
  const unsigned depth = json->depth;
  uint32_t n = 0;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); n++) {
    const struct mo_field pair = {.type = MO_FIELD_NUMBERS,
                                  .name = "",
                                  .n = 2,
                                  .min = -MO_LIGHT_LIMIT_M,
                                  .max = MO_LIGHT_LIMIT_M};
    const struct mo_fields one = {&pair, 1};
    if (n < MO_GUIDE_POINTS_MAX)
      mo_fields_read_member(json, (struct mo_json_slice){"", 0}, &one, guide->points_m[n]);
    else
      mo_json_skip(json);
  }
  if (!json->stop && (n < 1 || n > MO_GUIDE_POINTS_MAX))
    mo_json_fault_at(json, depth, "", "must have 1 to %d waypoints, [x, y] each, got %u",
                     MO_GUIDE_POINTS_MAX, n);
  guide->n_points = n;
}

/* Reads the guide into the environment. *given: the members that were present, as bits. */
static void read_guide(struct mo_json *json, struct mo_environment *environment, unsigned *given)
{
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    for (unsigned i = 0; i < MEMBERS; i++)
      if (mo_json_is(key, rows[i].name))
        *given |= 1U << i;
    if (!mo_fields_read_member(json, key, &guide_fields, environment))
      mo_fields_unknown(json, NULL, &guide_fields);
  }
}

/* Adds a fault for a member that the guide needs but lacks, or has but does not use. */
static void check_members(struct mo_json *json, unsigned depth, const struct mo_guide *guide,
                          unsigned given)
{
  char list[MO_WORDS_BYTES];
  for (unsigned i = 0; i < MEMBERS && (i == 0 || (given & 1) != 0); i++) {
    const char *word = mo_word(mo_guide_words, (unsigned)guide->kind);
    if (i == IS_KIND && (given & 1) == 0)
      mo_json_fault_at(json, depth, "/guide", "kind is missing; it must be %s",
                       mo_words_list(mo_guide_words, list));
    else if ((uses[i].needs >> guide->kind & 1) != 0 && (given >> i & 1) == 0)
      mo_json_fault_at(json, depth, "/guide", "%s is missing; a guide of kind \"%s\" needs it",
                       rows[i].name, word);
    else if ((uses[i].has >> guide->kind & 1) == 0 && (given >> i & 1) != 0)
      mo_json_fault_at(json, depth, "/guide", "a guide of kind \"%s\" has no %s; remove it", word,
                       rows[i].name);
  }
  if (guide->kind == MO_GUIDE_MOVING && guide->turn_rad_per_s == 0 && (given >> CENTER & 1) != 0)
    mo_json_fault_at(json, depth, "/guide",
                     "center_m needs a turn_rad_per_s other than 0; remove it");
}

/* Sets what was not given. */
static void complete_guide(struct mo_environment *environment, unsigned given)
{
  struct mo_guide *guide = &environment->task.guide;
  if ((uses[DISTANCE].has >> guide->kind & 1) != 0 && (given >> DISTANCE & 1) == 0)
    guide->distance_m = MO_GUIDE_DISTANCE_M;
  for (int axis = 0; axis < 2; axis++)
    if (guide->kind == MO_GUIDE_MOVING && guide->turn_rad_per_s != 0 && (given >> CENTER & 1) == 0)
      guide->center_m[axis] = MO_WORLD_CENTER_M;
}

/* ---- reading ---- */

/* Adds a term in its place. Returns its index, or −1 if it is already present. If the sum is full,
 * its last term is dropped; the caller detects this by the number of terms. */
static int add_term(struct mo_task *task, uint32_t term, double weight)
{
  uint32_t at = 0;
  while (at < task->n_terms && task->terms[at] < term)
    at++;
  if (at < task->n_terms && task->terms[at] == term)
    return -1;
  for (uint32_t i = task->n_terms < MO_TERMS_MAX ? task->n_terms : MO_TERMS_MAX - 1; i > at; i--) {
    task->terms[i] = task->terms[i - 1];
    task->weights[i] = task->weights[i - 1];
  }
  task->n_terms += task->n_terms < MO_TERMS_MAX;
  if (at < MO_TERMS_MAX) {
    task->terms[at] = term;
    task->weights[at] = weight;
  }
  return (int)at;
}

/* Reads the weight of the term `key`. */
static void read_term(struct mo_json *json, struct mo_json_slice key, struct mo_task *task)
{
  struct mo_text text = {0};
  double weight = 0;
  for (uint32_t term = 0; term < MO_TERM_MEASURE + MO_MEASURES; term++) {
    const char *name = mo_term_name(term);
    if (name == NULL || !mo_json_is(key, name)) {
      if (name != NULL)
        mo_text_format(&text, "%s%s", text.size > 0 ? ", " : "", name);
      continue;
    }
    mo_text_free(&text);
    if (!mo_json_bounded(json, -MO_TERM_WEIGHT_MAX, MO_TERM_WEIGHT_MAX, &weight))
      return;
    if (weight == 0)
      mo_json_fault(json, "must not be 0; leave the term out");
    else if (add_term(task, term, weight) < 0)
      mo_json_fault(json, "is given twice");
    return;
  }
  bool is_measure = false;
  for (int m = 0; m < MO_MEASURES; m++)
    is_measure = is_measure || mo_json_is(key, mo_measure_info[m].name);
  mo_json_fault(
      json, "%s; the terms are %s",
      is_measure
          ? "cannot be weighted, because it may have no value, or neither larger nor smaller "
            "values are better"
          : "neither an objective nor a measure",
      text.failed ? "others" : text.data);
  mo_text_free(&text);
  mo_json_skip(json);
}

/* Reads a word, or the weights of a sum. */
static void read_objective(struct mo_json *json, void *value)
{
  struct mo_task *task = value, sum = *task;
  const unsigned depth = json->depth, faults = json->faults->n;
  struct mo_json_slice key;
  uint32_t n = 0;
  if (mo_json_peek(json) == MO_JSON_STRING) {
    char list[MO_WORDS_BYTES];
    if (!mo_json_string(json, &key))
      return;
    for (int i = 0; mo_objective_words[i] != NULL; i++)
      if (mo_json_is(key, mo_objective_words[i])) {
        task->objective = (enum mo_objective)i;
        return;
      }
    mo_json_fault_at(json, depth, "", "must be an object with weights or %s, got \"%.*s\"",
                     mo_words_list(mo_objective_words, list), key.size > 64 ? 64 : (int)key.size,
                     key.bytes);
    return;
  }
  if (!mo_json_object(json))
    return;
  sum.objective = MO_OBJECTIVE_SUM;
  for (; mo_json_member(json, &key); n++)
    read_term(json, key, &sum);
  if (json->stop || json->faults->n > faults)
    return;
  if (n < 1 || n > MO_TERMS_MAX)
    mo_json_fault_at(json, depth, "", "must have 1 to %d weights, got %u", MO_TERMS_MAX, n);
  else
    *task = sum;
}

static void write_objective(struct mo_text *text, const void *value)
{
  const struct mo_task *task = value;
  if (task->objective != MO_OBJECTIVE_SUM) {
    mo_text_format(text, "\"%s\"", mo_word(mo_objective_words, (unsigned)task->objective));
    return;
  }
  mo_text_object(text);
  for (uint32_t i = 0; i < task->n_terms; i++)
    mo_text_member_number(text, mo_term_name(task->terms[i]), task->weights[i]);
  mo_text_add(text, "}");
}

static const struct mo_field_own objective_own = {.read = read_objective, .write = write_objective};
static const struct mo_field objective_row = {"objective",
                                              MO_FIELD_OWN,
                                              0,
                                              0,
                                              .unit = "",
                                              .own = &objective_own,
                                              .help = "what the score is"};
static const struct mo_fields objective_field = {&objective_row, 1};

static const enum mo_objective usual[] = {[MO_GUIDE_FIXED] = MO_OBJECTIVE_REACH,
                                          [MO_GUIDE_AHEAD] = MO_OBJECTIVE_TRAVEL,
                                          [MO_GUIDE_TURNING] = MO_OBJECTIVE_TRAVEL,
                                          [MO_GUIDE_PATH] = MO_OBJECTIVE_FOLLOW,
                                          [MO_GUIDE_MOVING] = MO_OBJECTIVE_PURSUE};

static void read_word(struct mo_json *json, struct mo_environment *environment)
{
  const unsigned depth = json->depth;
  struct mo_json_slice word;
  char list[MO_WORDS_BYTES];
  if (!mo_json_string(json, &word))
    return;
  for (int i = 0; mo_task_words[i] != NULL; i++)
    if (mo_json_is(word, mo_task_words[i])) {
      mo_task_named(i, environment);
      return;
    }
  mo_json_fault_at(json, depth, "", "must be an object or %s, got \"%.*s\"",
                   mo_words_list(mo_task_words, list), word.size > 64 ? 64 : (int)word.size,
                   word.bytes);
}

void mo_task_read(struct mo_json *json, struct mo_environment *environment)
{
  const unsigned depth = json->depth, faults = json->faults->n;
  struct mo_environment read = *environment;
  struct mo_message message = {""};
  struct mo_json_slice key;
  unsigned given = 0;
  bool has_guide = false, has_objective = false;
  if (mo_json_peek(json) == MO_JSON_STRING) {
    read_word(json, environment);
    return;
  }
  read.task = (struct mo_task){0};
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "guide")) {
      has_guide = true;
      read_guide(json, &read, &given);
    } else if (mo_fields_read_member(json, key, &objective_field, &read.task)) {
      has_objective = true;
    } else {
      mo_fields_unknown(json, "guide, ", &objective_field);
    }
  }
  if (json->stop || json->faults->n > faults)
    return;
  if (has_guide)
    check_members(json, depth, &read.task.guide, given);
  complete_guide(&read, given);
  if (!has_objective)
    read.task.objective = usual[read.task.guide.kind];
  if (json->faults->n == faults && mo_task_check(&read.task, &message) != MO_OK)
    mo_json_fault_at(json, depth, "", "%s", message.text);
  if (json->faults->n > faults)
    return;
  environment->task = read.task;
  if (read.task.guide.kind == MO_GUIDE_MOVING)
    memcpy(environment->light_xy_m, read.light_xy_m, sizeof(read.light_xy_m));
}

/* ---- damage ---- */

/* Damage in JSON; in the environment, it is 1 + octant. */
struct damage {
  uint32_t octant;
  double time_s;
};
static const struct mo_field damage_rows[] = {
    {"octant", MO_FIELD_COUNT, 0, offsetof(struct damage, octant), .max = MO_OCTANTS - 1,
     .unit = "", .help = "1: larger x, + 2: larger y, + 4: larger z"},
    {"time_s", MO_FIELD_NUMBER, 0, offsetof(struct damage, time_s), .max = MO_DAMAGE_TIME_MAX_S,
     .unit = "s", .help = "when its springs break"},
};
static const struct mo_fields damage_fields = MO_FIELDS(damage_rows);

static void read_damage(struct mo_json *json, struct mo_environment *environment)
{
  const unsigned depth = json->depth, faults = json->faults->n;
  struct damage damage = {UINT32_MAX, -1};
  mo_fields_read(json, &damage_fields, &damage);
  if (json->stop || json->faults->n > faults)
    return;
  if (damage.octant == UINT32_MAX || damage.time_s < 0)
    mo_json_fault_at(json, depth, "", "%s is missing",
                     damage_rows[damage.octant != UINT32_MAX].name);
  else
    environment->damage = (struct mo_damage){1 + damage.octant, damage.time_s};
}

/* ---- factors ---- */

/* Reads factors: those that are not given are 1, and an object in which all are 1 is the same as no
 * object. */
static void read_factors(struct mo_json *json, struct mo_environment *environment)
{
  const unsigned faults = json->faults->n;
  struct mo_factors factors = mo_factors_ones();
  mo_fields_read(json, &mo_factor_fields, &factors);
  if (!json->stop && json->faults->n == faults)
    environment->factors = mo_factors_simplest(&factors);
}

/* Writes the factors that are not 1. */
static void write_factors(struct mo_text *text, const struct mo_factors *factors)
{
  mo_text_open(text, "factors", "{");
  for (size_t i = 0; i < mo_factor_fields.n; i++) {
    const struct mo_field *row = &mo_factor_fields.rows[i];
    const struct mo_fields one = {row, 1};
    if (*(const double *)(const void *)((const char *)factors + row->offset) != 1)
      mo_fields_write(text, &one, factors);
  }
  mo_text_add(text, "}");
}

bool mo_environment_read_member(struct mo_json *json, struct mo_json_slice key,
                                struct mo_environment *environment)
{
  if (mo_json_is(key, "task")) {
    mo_task_read(json, environment);
    return true;
  }
  if (mo_json_is(key, "terrain")) {
    mo_terrain_read(json, environment);
    return true;
  }
  if (mo_json_is(key, "damage")) {
    read_damage(json, environment);
    return true;
  }
  if (mo_json_is(key, "factors")) {
    read_factors(json, environment);
    return true;
  }
  return mo_fields_read_member(json, key, &mo_drop_fields, environment) ||
         mo_fields_read_member(json, key, &mo_place_fields, environment);
}

/* ---- writing ---- */

static void write_points(struct mo_text *text, const struct mo_guide *guide)
{
  mo_text_open(text, "points_m", "[");
  for (uint32_t i = 0; i < guide->n_points; i++) {
    mo_text_next(text);
    mo_text_add(text, "[");
    mo_text_json_number(text, guide->points_m[i][0]);
    mo_text_add(text, ",");
    mo_text_json_number(text, guide->points_m[i][1]);
    mo_text_add(text, "]");
  }
  mo_text_add(text, "]");
}

static void write_guide(struct mo_text *text, const struct mo_environment *environment)
{
  const struct mo_guide *guide = &environment->task.guide;
  for (unsigned i = 0; i < MEMBERS; i++) {
    const struct mo_fields one = {&rows[i], 1};
    const bool is_circle = guide->turn_rad_per_s != 0;
    if ((uses[i].has >> guide->kind & 1) == 0 ||
        (guide->kind == MO_GUIDE_MOVING && (i == TURN || i == CENTER) && !is_circle))
      continue;
    if (i == POINTS)
      write_points(text, guide);
    else
      mo_fields_write(text, &one, environment);
  }
}

void mo_task_write(struct mo_text *text, const struct mo_environment *environment)
{
  mo_text_add(text, "{\"guide\":{");
  write_guide(text, environment);
  mo_text_add(text, "}");
  mo_fields_write(text, &objective_field, &environment->task);
  mo_text_add(text, "}");
}

void mo_environment_write_members(struct mo_text *text, const struct mo_environment *environment)
{
  for (size_t i = 0; i < mo_place_fields.n; i++) {
    const struct mo_fields one = {&mo_place_fields.rows[i], 1};
    if (mo_place_has(environment, i))
      mo_fields_write(text, &one, environment);
  }
  mo_environment_write_tasks(text, environment);
}

void mo_environment_write_tasks(struct mo_text *text, const struct mo_environment *environment)
{
  if (environment->n_profile != 0 || environment->grid != NULL) {
    mo_text_name(text, "terrain");
    mo_terrain_write(text, environment);
  }
  if (!mo_task_is_plain(&environment->task)) {
    mo_text_name(text, "task");
    mo_task_write(text, environment);
  }
  if (environment->damage.cut != 0) {
    const struct damage damage = {environment->damage.cut - 1, environment->damage.time_s};
    mo_text_name(text, "damage");
    mo_fields_write_object(text, &damage_fields, &damage);
  }
  if (environment->factors.given != 0)
    write_factors(text, &environment->factors);
  if (environment->drop_m != 0)
    mo_fields_write(text, &mo_drop_fields, environment);
}
