/* evaluation_request.c: the body of POST /v1/evaluations. Every fault has its JSON pointer: a cell
 * out of bounds is at /designs/3/cells/7/0. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/states.h"
#include "base/words.h"
#include "rollout/physics.h"

static void read_channels(struct mo_json *json, void *value)
{
  char list[MO_WORDS_BYTES];
  struct mo_json_slice what;
  unsigned read = 0;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    unsigned i = 0;
    if (!mo_json_string(json, &what))
      continue;
    while (i < MO_CHANNELS && !mo_json_is(what, mo_channel_words[i]))
      i++;
    if (i == MO_CHANNELS)
      mo_json_fault(json, "must be %s", mo_words_list(mo_channel_words, list));
    else if (read >> i & 1)
      mo_json_fault(json, "duplicate array; list it once");
    else
      read |= 1U << i;
  }
  *(unsigned *)value = read;
}

const struct mo_field_own mo_channels_field = {.read = read_channels};

#define AT(member) offsetof(struct mo_random_bodies, member)
static const struct mo_field random_rows[] = {
    {"count", MO_FIELD_COUNT, 0, AT(count), .min = 1, .max = MO_RANDOM_BODIES_MAX,
     .unit = "bodies"},
    {"seed", MO_FIELD_SEED, 0, AT(seed), .min = 0, .unit = ""},
    {"first", MO_FIELD_COUNT, 0, AT(first), .min = 0, .max = MO_RANDOM_BODIES_MAX - 1,
     .unit = "bodies"},
};
#undef AT
static const struct mo_fields random_fields = MO_FIELDS(random_rows);

static void read_random(struct mo_json *json, void *value)
{
  struct mo_parts *parts = value;
  struct mo_random_bodies *random = &parts->random;
  const unsigned depth = json->depth, before = json->faults->n;
  parts->has_random = true;
  mo_fields_read(json, &random_fields, random);
  if (random->count == 0 && json->faults->n == before)
    mo_json_fault_at(json, depth, "", "count is missing; it must be the number of bodies, 1 to %d",
                     MO_RANDOM_BODIES_MAX);
}

static const struct mo_field_own random_field = {.read = read_random};

#define AT(member) offsetof(struct mo_parsed_evaluation, member)
static const char *const precision_words[] = {"float32", "float64", NULL};
static const struct mo_field rollout_rows[] = {
    {"designs", MO_FIELD_OWN, 0, AT(parts), .own = &mo_designs_field},
    {"environments", MO_FIELD_OWN, 0, AT(parts), .own = &mo_environments_field},
    {"record", MO_FIELD_OWN, 0, AT(request.record), .own = &mo_channels_field},
    {"record_stride", MO_FIELD_COUNT, 0, AT(request.record_stride), .min = 1, .max = MO_STEPS_MAX,
     .unit = "steps", .help = "steps between frames"},
    {"physics", MO_FIELD_GROUP, 0, AT(request.physics), .group = &mo_physics_fields},
    {"precision", MO_FIELD_WORD, 0, AT(request.precision), .words = precision_words},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_repair_fields},
    {"controller", MO_FIELD_OWN, 0, AT(parts), .own = &mo_controller_field},
};
static const struct mo_fields rolled = MO_FIELDS(rollout_rows);
static const struct mo_field window_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, offsetof(struct mo_parsed_rollouts, evaluation), .group = &rolled},
    {NULL, MO_FIELD_INLINE, 0, offsetof(struct mo_parsed_rollouts, states),
     .group = &mo_states_fields},
};
const struct mo_fields mo_rollouts_request_fields = MO_FIELDS(window_rows);
/* An evaluation has the same fields, except for the controller, which is one of the parts of every
 * job. */
static const struct mo_fields scored = {rollout_rows,
                                        sizeof(rollout_rows) / sizeof(rollout_rows[0]) - 1};
static const struct mo_field rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &scored},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_on_fault_fields},
    {"random", MO_FIELD_OWN, 0, AT(parts), .own = &random_field},
    {"verify", MO_FIELD_FLAG, 0, AT(request.verify)},
    {"error", MO_FIELD_FLAG, 0, AT(parts.estimates_error)},
    {"measures", MO_FIELD_OWN, 0, AT(request.measures), .own = &mo_measures_field},
    {"tolerance", MO_FIELD_NUMBER, 0, AT(request.tolerance), .min = MO_TOLERANCE_MIN,
     .max = MO_TOLERANCE_MAX, .unit = "",
     .help = "largest estimated error of each score, in the unit of the loss"},
    {"best", MO_FIELD_COUNT, 0, AT(request.best), .min = 1, .max = MO_LARGE_MAX, .unit = "designs",
     .help = "number of the best designs that get complete scores"},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_parts_fields},
};
#undef AT
const struct mo_fields mo_evaluation_request_fields = MO_FIELDS(rows);
_Static_assert(MO_FLOAT32 == 0 && MO_FLOAT64 == 1, "the words are in the order of their values");

/* Returns the number of a suite; −1: none was requested. */
static int suite_of(const struct mo_parts *parts)
{
  return parts->environments == NULL ? mo_word_index(mo_suite_words, mo_parts_set(parts)) : -1;
}

/* Returns the number of environments, listed or of a set or suite. *highest_m: the highest ground
 * in them, plus the drop. */
static uint32_t survey_worlds(struct mo_json *json, struct mo_parts *parts, double *highest_m)
{
  struct mo_environment *of_set = NULL;
  uint32_t n = parts->n_environments;
  *highest_m = 0;
  if (suite_of(parts) >= 0)
    return mo_suite_environments(suite_of(parts)); /* a suite is rejected where heights matter */
  if (parts->environments == NULL) {
    of_set = malloc(MO_SET_ENVIRONMENTS_MAX * sizeof(*of_set));
    n = of_set != NULL
            ? mo_environment_set(mo_word_index(mo_set_words, mo_parts_set(parts)), of_set)
            : 0;
  }
  if (parts->environments == NULL && of_set == NULL) {
    parts->error = MO_ERR_NO_MEMORY;
    json->stop = true;
  }
  for (uint32_t i = 0; i < n; i++) {
    const struct mo_environment *at = of_set != NULL ? &of_set[i] : &parts->environments[i];
    *highest_m = fmax(*highest_m, mo_terrain_highest(at) + at->drop_m);
  }
  free(of_set);
  return n;
}

/* Random bodies are drawn, and long lists are stored, only after the submission, so the size of a
 * recording is not known yet. */
static void check_large(struct mo_json *json, const struct mo_parsed_evaluation *parsed,
                        uint64_t n_environments)
{
  const struct mo_random_bodies *random = &parsed->parts.random;
  const char *const place = random->count > 0 ? "/random" : "/designs";
  const uint32_t n = random->count > 0 ? random->count : parsed->parts.n_designs;
  const uint64_t n_rollouts =
      n * n_environments * mo_ladder_runs(parsed->request.n_displaced, parsed->request.tolerance);
  if (parsed->request.tolerance > 0 && n_rollouts > MO_LARGE_ROLLOUTS_MAX)
    mo_json_fault_at(json, 0, "/tolerance",
                     "the rungs of all designs have %llu rollouts, and at most %d are allowed; use "
                     "fewer designs or fewer environments",
                     (unsigned long long)n_rollouts, MO_LARGE_ROLLOUTS_MAX);
  if (random->count == 0 && n <= MO_DESIGNS_MAX)
    return;
  if (random->count > 0 && random->first + random->count > MO_RANDOM_BODIES_MAX)
    mo_json_fault_at(
        json, 0, "/random/first",
        "bodies %u to %u are out of range; a seed has bodies 0 to %d, so use another seed",
        random->first, random->first + random->count - 1, MO_RANDOM_BODIES_MAX - 1);
  if (n_rollouts > MO_LARGE_ROLLOUTS_MAX && parsed->request.tolerance == 0)
    mo_json_fault_at(json, 0, random->count > 0 ? "/random/count" : place,
                     "the request has %llu rollouts, and at most %d are allowed; use fewer bodies "
                     "or fewer environments",
                     (unsigned long long)n_rollouts, MO_LARGE_ROLLOUTS_MAX);
  if (parsed->request.verify || parsed->request.record != 0)
    mo_json_fault_at(json, 0, place,
                     "cannot be combined with %s, which supports at most %d listed designs",
                     parsed->request.verify ? "verify" : "record", MO_DESIGNS_MAX);
}

/* The settings of every run must be within the bounds. */
static void check_error(struct mo_json *json, const struct mo_parsed_evaluation *parsed,
                        double highest_m)
{
  const struct mo_evaluation_request *request = &parsed->request;
  const bool climbs = request->tolerance > 0;
  const char *const place = climbs ? "/tolerance" : "/error";
  const struct mo_setting first = {request->physics, request->precision};
  const uint32_t n_runs = mo_ladder_runs(request->n_displaced, request->tolerance);
  struct mo_message message;
  int error = MO_OK;
  if (request->verify || request->record != 0 || request->best > 0)
    mo_json_fault_at(json, 0, place, "cannot be combined with %s; give only one of them",
                     request->verify        ? "verify"
                     : request->record != 0 ? "record"
                                            : "best");
  if (parsed->parts.job.back_end == MO_ON_DEVICE)
    mo_json_fault_at(json, 0, place, "is supported only on CPUs; request \"cpu\" or \"auto\"");
  if (request->precision == MO_FLOAT32 &&
      request->physics.drop_height_m + highest_m > MO_ERROR_FLOAT32_MAX_M)
    mo_json_fault_at(
        json, 0, place,
        "displaces starts by %g m, which float32 cannot represent at heights above %g m; request "
        "\"precision\": \"float64\"",
        MO_ERROR_DISPLACEMENT_M, MO_ERROR_FLOAT32_MAX_M);
  for (uint32_t run = 1; run < n_runs && error == MO_OK; run++) {
    const struct mo_setting setting = mo_ladder_run(&first, request->n_displaced, run);
    error = mo_physics_check(&setting.physics, &message);
  }
  if (error == MO_ERR_RANGE && climbs)
    mo_json_fault_at(
        json, 0, place,
        "may need time steps down to 1/%u of dt_s, and starts from a greater height: %s; "
        "request a larger dt_s or fewer steps",
        1U << MO_LADDER_RUNGS, message.text);
  else if (error == MO_ERR_RANGE)
    mo_json_fault_at(json, 0, "/error",
                     "needs rollouts with half the time step and with higher starts: %s",
                     message.text);
}

static void check_measures(struct mo_json *json, const struct mo_parsed_evaluation *parsed)
{
  if (parsed->request.tolerance > 0)
    mo_json_fault_at(json, 0, "/measures",
                     "cannot be combined with tolerance; request measures with the time step and "
                     "precision that it chose");
  if (parsed->request.verify)
    mo_json_fault_at(json, 0, "/measures",
                     "cannot be combined with verify, which only compares losses; give only one of "
                     "them");
}

/* Rejects what works only on one set, because a suite has several. */
static void check_suite(struct mo_json *json, const struct mo_parsed_evaluation *parsed)
{
  const struct mo_evaluation_request *request = &parsed->request;
  const struct {
    const char *name;
    bool is_given;
  } others[] = {{"best", request->best > 0},
                {"record", request->record != 0},
                {"verify", request->verify},
                {"error", parsed->parts.estimates_error},
                {"tolerance", request->tolerance > 0}};
  for (size_t i = 0; i < sizeof(others) / sizeof(*others); i++)
    if (others[i].is_given) {
      char place[32];
      snprintf(place, sizeof(place), "/%s", others[i].name);
      mo_json_fault_at(json, 0, place,
                       "cannot be combined with a suite; give the set of one of its tasks, such "
                       "as %s",
                       mo_suite_set(suite_of(&parsed->parts), 2));
    }
}

static int check(struct mo_json *json, void *any)
{
  struct mo_parsed_evaluation *parsed = any;
  struct mo_evaluation_request *request = &parsed->request;
  const uint32_t steps = request->physics.scheme.n_steps;
  const struct mo_random_bodies *random = &parsed->parts.random;
  const uint32_t n_designs = random->count + parsed->parts.n_designs + parsed->parts.n_skipped;
  struct mo_message message;
  if (mo_physics_check(&request->physics, &message) == MO_ERR_RANGE)
    mo_json_fault_at(json, 0, "/physics", "%s", message.text);
  else
    mo_parts_check_factors(json, &parsed->parts, &request->physics, NULL);
  if (!parsed->parts.has_designs && !parsed->parts.has_random)
    mo_json_fault_at(json, 0, "",
                     "designs is missing; give an array of 1 to %d designs, or random with the "
                     "count of random bodies",
                     MO_LARGE_MAX);
  if (parsed->parts.has_designs && parsed->parts.has_random)
    mo_json_fault_at(json, 0, "/random", "cannot be combined with designs; give only one of them");
  const bool estimates = parsed->parts.estimates_error || request->tolerance > 0;
  const bool is_large = random->count > 0 || parsed->parts.n_designs > MO_DESIGNS_MAX;
  double highest_m = 0;
  request->n_displaced = estimates ? MO_ERROR_DISPLACED : 0;
  /* This draws the worlds of a set, so call it only if they matter. */
  check_large(json, parsed,
              estimates || is_large ? survey_worlds(json, &parsed->parts, &highest_m) : 0);
  if (suite_of(&parsed->parts) >= 0)
    check_suite(json, parsed);
  else if (estimates)
    check_error(json, parsed, highest_m);
  if (request->measures != 0)
    check_measures(json, parsed);
  if (parsed->parts.no_controller)
    mo_json_fault_at(json, 0, "/controller", "must be a controller's name, got null");
  if (request->record_stride > steps)
    mo_json_fault_at(json, 0, "/record_stride", "must be at most n_steps, which is %u, got %u",
                     steps, request->record_stride);
  if (n_designs > 0 && request->best > n_designs)
    mo_json_fault_at(json, 0, "/best", "must be at most the number of designs, which is %u, got %u",
                     n_designs, request->best);
  if (request->best > 0 && (request->verify || request->record != 0))
    mo_json_fault_at(json, 0, "/best", "cannot be combined with %s; give only one of them",
                     request->verify ? "verify" : "record");
  if (request->record_stride == 0)
    request->record_stride = steps < 10 ? steps : 10;
  return MO_OK;
}

static int check_rollouts(struct mo_json *json, void *any)
{
  struct mo_parsed_rollouts *parsed = any;
  mo_states_check(json, &parsed->evaluation.request.physics, &parsed->states);
  return check(json, &parsed->evaluation);
}

/* whole: the struct with `parsed` as its first member. */
static int parse(const char *text, size_t size, const struct mo_fields *fields,
                 uint32_t most_designs, struct mo_parsed_evaluation *parsed, void *whole,
                 int (*check_whole)(struct mo_json *json, void *whole), struct mo_faults *faults)
{
  struct mo_evaluation_request *request = &parsed->request;
  *parsed = (struct mo_parsed_evaluation){
      .request = {.physics = mo_default_physics(), .precision = MO_FLOAT32},
      .parts = {.job = {.priority = -1, .weight = 1},
                .random = {.seed = 1},
                .controller = "default",
                .takes_suites = fields == &mo_evaluation_request_fields,
                .most_designs = most_designs}};
  mo_read_words(text, size, &mo_design_rules_fields, &parsed->parts, NULL);
  int error = mo_read_body(text, size, fields, whole, &parsed->parts, check_whole, faults);
  if (error != MO_OK)
    return error;
  const struct mo_parts *parts = &parsed->parts;
  request->job = parts->job;
  request->controller = parts->controller;
  request->genotypes = parts->genotypes;
  request->random = parts->random;
  request->n_designs = parts->random.count > 0 ? parts->random.count : parts->n_designs;
  request->notes = parts->notes;
  request->n_notes = parts->n_notes;
  request->n_skipped = parts->n_skipped;
  request->environments = parts->environments;
  request->n_environments = parts->n_environments;
  request->environment_set = mo_parts_set(parts);
  return MO_OK;
}

int mo_evaluation_parse(const char *text, size_t size, struct mo_parsed_evaluation *parsed,
                        struct mo_faults *faults)
{
  return parse(text, size, &mo_evaluation_request_fields, MO_LARGE_MAX, parsed, parsed, check,
               faults);
}

int mo_rollouts_parse(const char *text, size_t size, struct mo_parsed_rollouts *parsed,
                      struct mo_faults *faults)
{
  parsed->states = (struct mo_parsed_states){0};
  const int error = parse(text, size, &mo_rollouts_request_fields, MO_DESIGNS_MAX,
                          &parsed->evaluation, parsed, check_rollouts, faults);
  return parsed->states.error != MO_OK ? parsed->states.error : error;
}
