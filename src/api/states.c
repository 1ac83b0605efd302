/* states.c: see states.h. Numbers are written so that they read back bit for bit: positions as
 * float64, since they are sums of float32 or float64 numbers, and everything else in the precision
 * of the rollout. */
#include "api/states.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"
#include "base/sha256.h"
#include "exchange/values.h"

/* Masses and springs of the whole workspace. */
#define MASSES_MAX  MO_DEFAULT_MASSES
#define SPRINGS_MAX MO_DEFAULT_SPRINGS
#define VOXELS_MAX  MO_DEFAULT_VOXELS
#define COUNT_MAX   9007199254740991.0

/* ---- the tally ---- */

/* Only these members are numbers that a table can describe; begun_s is a step. */
#define AT(member) offsetof(struct mo_state_tally, member)
#define NUMBER(name, member)                                                                       \
  {                                                                                                \
    name, MO_FIELD_NUMBER, 0, AT(member), .min = -MO_STATE_SUM_MAX, .max = MO_STATE_SUM_MAX,       \
                                          .unit = ""                                               \
  }
#define NUMBERS(name, member, count)                                                               \
  {                                                                                                \
    name, MO_FIELD_NUMBERS, 0, AT(member), .min = -MO_STATE_SUM_MAX, .max = MO_STATE_SUM_MAX,      \
                                           .n = (count), .unit = ""                                \
  }
#define COUNTER(name, member)                                                                      \
  {                                                                                                \
    name, MO_FIELD_SEED, 0, AT(member), .min = 0, .unit = ""                                       \
  }
#define PLACE(name, member)                                                                        \
  {                                                                                                \
    name, MO_FIELD_COUNT, 0, AT(member), .min = 0, .max = UINT32_MAX, .unit = ""                   \
  }
static const struct mo_field task_rows[] = {
    NUMBERS("com_m", com_m, 3),   NUMBER("sum", sum),        NUMBERS("sums", sums, 5),
    NUMBERS("facing", facing, 2), NUMBER("leg_m", length_m), NUMBER("before_m", before_m),
    NUMBER("along_m", along_m),   PLACE("leg", leg),         PLACE("heights", n_heights),
    NUMBER("peak_m", peak_m),     NUMBER("soft", soft),
};
static const struct mo_field measure_rows[] = {
    PLACE("observed", observed),
    NUMBERS("com_m", seen_com_m, 3),
    NUMBERS("start_turn", start_turn, 2),
    NUMBERS("turn", turn, 2),
    NUMBER("turns", turns),
    NUMBER("path_m", path_m),
    NUMBER("height_sum_m", height_sum_m),
    NUMBER("peak_height_m", peak_height_m),
    COUNTER("air_steps", air_steps),
    COUNTER("hops", hops),
    COUNTER("contacts", contacts),
    COUNTER("front_2", front_2),
    COUNTER("left_2", left_2),
    PLACE("inverted", inverted_max),
    NUMBER("pull_m2", pull_m2),
    NUMBER("strain_square", strain_square),
};
static const struct mo_fields task_fields = MO_FIELDS(task_rows);
static const struct mo_fields measure_fields = MO_FIELDS(measure_rows);
#undef AT
#undef NUMBER
#undef NUMBERS
#undef COUNTER
#undef PLACE

/* ---- reading ---- */

/* An array that grows. */
struct list {
  double *numbers;
  uint32_t n, room;
};

static bool add(struct mo_parsed_states *states, struct mo_json *json, struct list *list,
                double number)
{
  if (list->n == list->room) {
    const uint32_t room = list->room > 0 ? 2 * list->room : 256;
    double *larger = realloc(list->numbers, room * sizeof(*larger));
    if (larger == NULL) {
      states->error = MO_ERR_NO_MEMORY;
      json->stop = true;
      return false;
    }
    list->numbers = larger;
    list->room = room;
  }
  list->numbers[list->n++] = number;
  return true;
}

/* A state that is being read. */
struct reading {
  struct mo_parsed_states *states;
  struct list positions, remainders, velocities, outputs, contacts, cut, inverted;
  struct mo_state state;
  struct mo_genotype robot;
  double time_s, begun_s;
  bool has_robot, has_tally, has_precision;
  unsigned has_keys;
};

/* Reads numbers within ±limit, or whole numbers from 0 to limit. */
static void read_list(struct mo_json *json, struct reading *r, struct list *list, uint32_t most,
                      double limit, bool whole)
{
  const unsigned depth = json->depth;
  bool fits = true;
  list->n = 0;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    double number = 0;
    int64_t count = 0;
    fits = list->n < most;
    if (!fits) {
      mo_json_skip(json);
      continue;
    }
    if (whole && mo_json_integer(json, 0, (int64_t)limit, &count))
      number = (double)count;
    else if (!whole)
      mo_json_bounded(json, -limit, limit, &number);
    if (!add(r->states, json, list, number))
      return;
  }
  if (!fits)
    mo_json_fault_at(json, depth, "", "must have at most %u numbers", most);
}

/* Reads [[x, y, z], …]. */
static void read_vectors(struct mo_json *json, struct reading *r, struct list *list, double limit)
{
  const unsigned whole = json->depth;
  bool fits = true;
  list->n = 0;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    const unsigned depth = json->depth;
    uint32_t n = 0;
    fits = list->n < 3 * MASSES_MAX;
    if (!fits) {
      mo_json_skip(json);
      continue;
    }
    if (!mo_json_array(json))
      continue;
    for (; mo_json_item(json); n += n < 4) {
      double number = 0;
      if (n > 2) {
        mo_json_skip(json);
        continue;
      }
      mo_json_bounded(json, -limit, limit, &number);
      if (!add(r->states, json, list, number))
        return;
    }
    if (n != 3)
      mo_json_fault_at(json, depth, "", "must have three numbers: [x, y, z]");
  }
  if (!fits)
    mo_json_fault_at(json, whole, "", "must have at most %d vectors", MASSES_MAX);
}

static void read_key(struct mo_json *json, struct reading *r, unsigned bit,
                     uint8_t key[MO_STATE_KEY_BYTES])
{
  struct mo_json_slice text;
  if (!mo_json_string(json, &text))
    return;
  bool good = text.size == (size_t)2 * MO_STATE_KEY_BYTES;
  for (size_t i = 0; good && i < text.size; i++)
    good = mo_hex_digit(text.bytes[i]) >= 0;
  if (!good) {
    mo_json_fault(json, "must have %d hexadecimal digits; send the state back unchanged",
                  2 * MO_STATE_KEY_BYTES);
    return;
  }
  for (size_t i = 0; i < MO_STATE_KEY_BYTES; i++)
    key[i] = (uint8_t)(mo_hex_digit(text.bytes[2 * i]) * 16 + mo_hex_digit(text.bytes[2 * i + 1]));
  r->has_keys |= bit;
}

static void read_robot(struct mo_json *json, struct reading *r)
{
  struct mo_json_slice text;
  int orientation = -1;
  if (!mo_json_string(json, &text))
    return;
  r->robot = (struct mo_genotype){.workspace = MO_STORE_WORKSPACE};
  if (mo_robot_read(text.bytes, text.size, &r->robot, &orientation) != MO_OK || orientation < 0)
    mo_json_fault(json, "must be a robot, such as the id of a design with @0 to @7");
  else
    r->has_robot = true;
}

static void read_precision(struct mo_json *json, struct reading *r)
{
  struct mo_json_slice word;
  if (!mo_json_string(json, &word))
    return;
  r->has_precision = mo_json_is(word, "float32") || mo_json_is(word, "float64");
  r->state.precision = mo_json_is(word, "float64") ? MO_FLOAT64 : MO_FLOAT32;
  if (!r->has_precision)
    mo_json_fault(json, "must be float32 or float64");
}

static void read_com(struct mo_json *json, double com_m[3])
{
  const unsigned depth = json->depth;
  uint32_t n = 0;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); n += n < 4)
    if (n < 3)
      mo_json_bounded(json, -MO_STATE_POSITION_MAX_M, MO_STATE_POSITION_MAX_M, &com_m[n]);
    else
      mo_json_skip(json);
  if (n != 3)
    mo_json_fault_at(json, depth, "", "must have three numbers: [x, y, z]");
}

static void read_tally(struct mo_json *json, struct reading *r)
{
  const unsigned depth = json->depth;
  struct mo_json_slice key;
  bool has_start = false;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "begun_s"))
      mo_json_bounded(json, 0, MO_STATE_TIME_MAX_S, &r->begun_s);
    else if (mo_json_is(key, "com_start_m")) {
      read_com(json, r->state.tally.com_start_m);
      has_start = true;
    } else if (mo_json_is(key, "task"))
      mo_fields_read(json, &task_fields, &r->state.tally);
    else if (mo_json_is(key, "measures"))
      mo_fields_read(json, &measure_fields, &r->state.tally);
    else
      mo_fields_unknown(json, "begun_s, com_start_m, task or measures", NULL);
  }
  if (!has_start)
    mo_json_fault_at(json, depth, "", "com_start_m is missing; send the state back unchanged");
  r->has_tally = true;
}

static void read_members(struct mo_json *json, struct reading *r)
{
  struct mo_json_slice key;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "time_s"))
      mo_json_bounded(json, 0, MO_STATE_TIME_MAX_S, &r->time_s);
    else if (mo_json_is(key, "robot"))
      read_robot(json, r);
    else if (mo_json_is(key, "precision"))
      read_precision(json, r);
    else if (mo_json_is(key, "physics_key"))
      read_key(json, r, 1, r->state.physics_key);
    else if (mo_json_is(key, "terrain_key"))
      read_key(json, r, 2, r->state.terrain_key);
    else if (mo_json_is(key, "task_key"))
      read_key(json, r, 4, r->state.task_key);
    else if (mo_json_is(key, "positions_m"))
      read_vectors(json, r, &r->positions, MO_STATE_POSITION_MAX_M);
    else if (mo_json_is(key, "position_remainders_m"))
      read_vectors(json, r, &r->remainders, 1e-6);
    else if (mo_json_is(key, "velocities_m_per_s"))
      read_vectors(json, r, &r->velocities, MO_DIVERGED_SPEED_M_PER_S);
    else if (mo_json_is(key, "outputs"))
      read_list(json, r, &r->outputs, SPRINGS_MAX, 1.0001, false);
    else if (mo_json_is(key, "contacts"))
      read_list(json, r, &r->contacts, MASSES_MAX, 1, true);
    else if (mo_json_is(key, "cut_springs"))
      read_list(json, r, &r->cut, SPRINGS_MAX, SPRINGS_MAX - 1, true);
    else if (mo_json_is(key, "inverted_voxels"))
      read_list(json, r, &r->inverted, VOXELS_MAX, VOXELS_MAX - 1, true);
    else if (mo_json_is(key, "tally"))
      read_tally(json, r);
    else
      mo_fields_unknown(
          json,
          "time_s, robot, precision, physics_key, terrain_key, task_key, positions_m, "
          "position_remainders_m, velocities_m_per_s, outputs, contacts, cut_springs, "
          "inverted_voxels or tally",
          NULL);
  }
}

/* Returns the first member that is missing, or whose length is wrong. */
static const char *gap_of(const struct reading *r)
{
  return !r->has_robot                       ? "robot"
         : !r->has_precision                 ? "precision"
         : r->has_keys != 7                  ? "physics_key, terrain_key or task_key"
         : r->positions.n == 0               ? "positions_m"
         : r->velocities.n != r->positions.n ? "velocities_m_per_s"
         : r->remainders.n != 0 && r->remainders.n != r->positions.n ? "position_remainders_m"
         : 3 * (uint64_t)r->contacts.n != r->positions.n             ? "contacts"
         : r->outputs.n == 0                                         ? "outputs"
         : !r->has_tally                                             ? "tally"
                                                                     : NULL;
}

/* Copies a list whose length gap_of has checked: n, or 0. */
static void copy(double *to, size_t n, const struct list *from)
{
  if (from->n == n)
    memcpy(to, from->numbers, n * sizeof(*to));
}

/* Marks the places of a list. Returns false if one is outside the n bytes. */
static bool mark(uint8_t *bytes, uint32_t n, const struct list *places)
{
  for (uint32_t i = 0; i < places->n; i++) {
    if (places->numbers[i] >= n)
      return false;
    bytes[(uint32_t)places->numbers[i]] = 1;
  }
  return true;
}

/* Returns the number of the robot's voxels. */
static uint32_t voxels_of(const struct mo_genotype *robot)
{
  uint32_t n = 0;
  for (size_t w = 0; w < MO_DEFAULT_WORDS; w++)
    n += (uint32_t)__builtin_popcountll(robot->words[w]);
  return n;
}

/* Fills in the arrays of the state. */
static void assemble(struct mo_json *json, unsigned depth, struct reading *r)
{
  struct mo_state *s = &r->state;
  const char *gap = gap_of(r);
  if (gap != NULL) {
    mo_json_fault_at(json, depth, "",
                     "%s is missing, or its length does not match the other arrays; send the state "
                     "back unchanged",
                     gap);
    return;
  }
  if (mo_state_create(s, r->positions.n / 3, r->outputs.n, voxels_of(&r->robot)) != MO_OK) {
    r->states->error = MO_ERR_NO_MEMORY;
    json->stop = true;
    return;
  }
  copy(s->position_m, r->positions.n, &r->positions);
  copy(s->position_rest_m, r->positions.n, &r->remainders);
  copy(s->velocity_m_per_s, r->positions.n, &r->velocities);
  copy(s->output, r->outputs.n, &r->outputs);
  for (uint32_t m = 0; m < s->n_masses; m++)
    s->contacts[m] = r->contacts.numbers[m] != 0;
  if (!mark(s->cut, s->n_springs, &r->cut))
    mo_json_fault_at(json, depth, "/cut_springs", "springs must be from 0 to %u", s->n_springs - 1);
  if (!mark(s->inverted, s->n_voxels, &r->inverted))
    mo_json_fault_at(json, depth, "/inverted_voxels", "voxels must be from 0 to %u",
                     s->n_voxels - 1);
}

static void read_state(struct mo_json *json, struct mo_parsed_states *states)
{
  const unsigned depth = json->depth, before = json->faults->n;
  struct mo_start *started = &states->list[states->n];
  struct reading r = {.states = states};
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    mo_json_fault(json, "is null, because that rollout diverged; start it again without states");
    return;
  }
  if (!mo_json_object(json))
    return;
  read_members(json, &r);
  if (json->faults->n == before && !json->stop)
    assemble(json, depth, &r);
  free(r.positions.numbers);
  free(r.remainders.numbers);
  free(r.velocities.numbers);
  free(r.outputs.numbers);
  free(r.contacts.numbers);
  free(r.cut.numbers);
  free(r.inverted.numbers);
  *started = (struct mo_start){r.state, r.robot};
  states->times_s[2 * states->n] = r.time_s;
  states->times_s[2 * states->n + 1] = r.begun_s;
  states->n++;
}

static void read_states(struct mo_json *json, void *value)
{
  struct mo_parsed_states *states = value;
  const unsigned depth = json->depth;
  uint32_t n = 0;
  if (!mo_json_array(json))
    return;
  states->is_given = true;
  states->list = calloc(MO_ROLLOUTS_MAX, sizeof(*states->list));
  states->times_s = calloc(MO_ROLLOUTS_MAX, 2 * sizeof(*states->times_s));
  if (states->list == NULL || states->times_s == NULL) {
    states->error = MO_ERR_NO_MEMORY;
    json->stop = true;
    return;
  }
  for (; mo_json_item(json); n += n <= MO_ROLLOUTS_MAX)
    if (n < MO_ROLLOUTS_MAX)
      read_state(json, states);
    else
      mo_json_skip(json);
  if (n < 1 || n > MO_ROLLOUTS_MAX)
    mo_json_fault_at(json, depth, "", "must have one state for each rollout, 1 to %d",
                     MO_ROLLOUTS_MAX);
}

static const struct mo_field_own states_field = {.read = read_states};
#define AT(member) offsetof(struct mo_parsed_states, member)
static const struct mo_field rows[] = {
    {"states", MO_FIELD_OWN, 0, 0, .own = &states_field},
    {"final_states", MO_FIELD_FLAG, 0, AT(wants_final)},
    {"masses_int16", MO_FIELD_FLAG, 0, AT(int16_masses)},
};
#undef AT
const struct mo_fields mo_states_fields = MO_FIELDS(rows);

/* Returns the step that ends at a time; UINT32_MAX if no step ends then. */
static uint32_t step_at(double time_s, double dt_s)
{
  const double step = rint(time_s / dt_s);
  return step < 4.2e9 && fabs(step * dt_s - time_s) <= 1e-6 * dt_s ? (uint32_t)step : UINT32_MAX;
}

void mo_states_check(struct mo_json *json, const struct mo_physics *physics,
                     struct mo_parsed_states *states)
{
  const double dt_s = physics->scheme.dt_s;
  for (uint32_t i = 0; i < states->n; i++) {
    const double *times_s = states->times_s + 2 * i;
    struct mo_state *state = &states->list[i].state;
    char place[48];
    state->step = step_at(times_s[0], dt_s);
    state->tally.begun_step = step_at(times_s[1], dt_s);
    snprintf(place, sizeof(place), "/states/%u/time_s", i);
    if (state->step == 0 || state->step == UINT32_MAX)
      mo_json_fault_at(json, 0, place,
                       "must be a whole number of steps of %s s, at least one, got %s s; send "
                       "the state back unchanged",
                       MO_NUMBER(dt_s), MO_NUMBER(times_s[0]));
    snprintf(place, sizeof(place), "/states/%u/tally/begun_s", i);
    if (state->tally.begun_step >= state->step)
      mo_json_fault_at(json, 0, place,
                       "must be a whole number of steps of %s s, and before time_s, got %s s",
                       MO_NUMBER(dt_s), MO_NUMBER(times_s[1]));
  }
}

void mo_states_free(struct mo_parsed_states *states)
{
  for (uint32_t i = 0; i < states->n; i++)
    mo_state_free(&states->list[i].state);
  free(states->list);
  free(states->times_s);
  *states = (struct mo_parsed_states){0};
}

/* ---- writing ---- */

/* Writes a number of a float32 or float64 rollout. A decimal number with fewer than nine digits can
 * be so far from the float32 that a reader who rounds it to float64 first gets a neighboring
 * float32. In this case, nine digits are written. */
static void write_number(struct mo_text *text, enum mo_precision precision, double number)
{
  if (precision == MO_FLOAT64) {
    mo_text_json_number(text, number);
    return;
  }
  const size_t before = text->size;
  mo_text_json_float(text, (float)number);
  if (text->failed || (float)strtod(text->data + before, NULL) == (float)number)
    return;
  text->size = before;
  mo_text_format(text, "%.9g", number);
}

static void write_vectors(struct mo_text *text, const char *name, enum mo_precision precision,
                          const double *vectors, uint32_t n)
{
  mo_text_open(text, name, "[");
  for (uint32_t i = 0; i < n; i++)
    for (int axis = 0; axis < 3; axis++) {
      mo_text_add(text, axis > 0 ? "," : i > 0 ? ",[" : "[");
      write_number(text, precision, vectors[3 * (size_t)i + (size_t)axis]);
      mo_text_add(text, axis == 2 ? "]" : "");
    }
  mo_text_add(text, "]");
}

/* Writes the bytes themselves, or the indices of those that are not 0. */
static void write_bytes(struct mo_text *text, const char *name, const uint8_t *bytes, uint32_t n,
                        bool places)
{
  const char *comma = "";
  mo_text_open(text, name, "[");
  for (uint32_t i = 0; i < n; i++)
    if (!places || bytes[i] != 0) {
      mo_text_format(text, "%s%u", comma, places ? i : bytes[i]);
      comma = ",";
    }
  mo_text_add(text, "]");
}

static void write_key(struct mo_text *text, const char *name, const uint8_t *key)
{
  mo_text_name(text, name);
  mo_text_add(text, "\"");
  for (size_t i = 0; i < MO_STATE_KEY_BYTES; i++)
    mo_text_format(text, "%02x", key[i]);
  mo_text_add(text, "\"");
}

static bool has_any(const double *numbers, size_t n)
{
  for (size_t i = 0; i < n; i++)
    if (numbers[i] != 0)
      return true;
  return false;
}

static void write_tally(struct mo_text *text, const struct mo_state_tally *tally,
                        const struct mo_task *task, double dt_s)
{
  mo_text_open(text, "tally", "{");
  mo_text_member_number(text, "begun_s", tally->begun_step * dt_s);
  mo_member_numbers(text, "com_start_m", tally->com_start_m, 3);
  if (!mo_task_is_plain(task)) {
    mo_text_name(text, "task");
    mo_fields_write_object(text, &task_fields, tally);
  }
  if (tally->observed != 0) {
    mo_text_name(text, "measures");
    mo_fields_write_object(text, &measure_fields, tally);
  }
  mo_text_add(text, "}");
}

void mo_member_state(struct mo_text *text, const struct mo_state *state,
                     const struct mo_genotype *robot, const struct mo_task *task,
                     const struct mo_physics *physics)
{
  const struct mo_state *s = state;
  const enum mo_precision precision = s->precision;
  if (s->step == 0) {
    mo_text_member(text, "state", NULL);
    return;
  }
  mo_text_open(text, "state", "{");
  mo_text_member_number(text, "time_s", s->step * physics->scheme.dt_s);
  mo_member_robot(text, robot);
  mo_text_member(text, "precision", precision == MO_FLOAT64 ? "float64" : "float32");
  write_key(text, "physics_key", s->physics_key);
  write_key(text, "terrain_key", s->terrain_key);
  write_key(text, "task_key", s->task_key);
  write_vectors(text, "positions_m", MO_FLOAT64, s->position_m, s->n_masses);
  if (has_any(s->position_rest_m, 3 * (size_t)s->n_masses))
    write_vectors(text, "position_remainders_m", MO_FLOAT64, s->position_rest_m, s->n_masses);
  write_vectors(text, "velocities_m_per_s", precision, s->velocity_m_per_s, s->n_masses);
  mo_text_open(text, "outputs", "[");
  for (uint32_t i = 0; i < s->n_springs; i++) {
    mo_text_add(text, i > 0 ? "," : "");
    write_number(text, precision, s->output[i]);
  }
  mo_text_add(text, "]");
  write_bytes(text, "contacts", s->contacts, s->n_masses, false);
  if (memchr(s->cut, 1, s->n_springs) != NULL)
    write_bytes(text, "cut_springs", s->cut, s->n_springs, true);
  if (memchr(s->inverted, 1, s->n_voxels) != NULL)
    write_bytes(text, "inverted_voxels", s->inverted, s->n_voxels, true);
  write_tally(text, &s->tally, task, physics->scheme.dt_s);
  mo_text_add(text, "}");
}
