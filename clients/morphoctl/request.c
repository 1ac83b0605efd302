/* request.c: makes request bodies from options, posts jobs, and waits for evaluations. */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "base/text.h"
#include "base/words.h"
#include "commands.h"
#include "settings.inc"

#define SAID_MAX 8 /* designs given by an id about which a line is printed */

/* ---- options that are fields ---- */

/* Parses a value; returns NULL if it is not of this kind. */
static json_t *field_value(enum field_kind kind, const char *text)
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

/* Parses values that are separated by commas. */
static json_t *list_value(enum field_kind kind, const char *text)
{
  json_t *list = json_array();
  char *rest = keep(strdup(text)), *word;
  while ((word = strsep(&rest, ",")) != NULL) {
    json_t *value = field_value(kind, word);
    if (value == NULL) {
      json_decref(list);
      return NULL;
    }
    json_array_append_new(list, value);
  }
  return list;
}

static json_t *value_of(enum field_kind kind, const char *text)
{
  return kind == FIELD_WORDS   ? list_value(FIELD_WORD, text)
         : kind == FIELD_REALS ? list_value(FIELD_REAL, text)
                               : field_value(kind, text);
}

static const char *field_kind_name(enum field_kind kind)
{
  return kind == FIELD_WHOLE   ? "whole number"
         : kind == FIELD_REAL  ? "number"
         : kind == FIELD_REALS ? "list of numbers, separated by commas"
                               : "text in UTF-8";
}

/* Puts a value at its place, and creates the objects around it. Takes the reference. */
static void fill_place(json_t *request, const char *place, json_t *value)
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

/* Reads "NAME=LOW:HIGH". The service checks the name and the bounds. */
static void fill_range(const struct option_spec *spec, const char *text, json_t *ranges)
{
  const char *equals = strchr(text, '='), *colon = equals != NULL ? strchr(equals, ':') : NULL;
  json_t *low, *high;
  if (colon == NULL || equals == text)
    fail(STATUS_USAGE, "--%s: \"%s\" is not %s", spec->name, text, spec->value);
  low = field_value(FIELD_REAL, keep(format_text("%.*s", (int)(colon - equals - 1), equals + 1)));
  high = field_value(FIELD_REAL, colon + 1);
  if (low == NULL || high == NULL)
    fail(STATUS_USAGE, "--%s: \"%s\" is not a range LOW:HIGH of two numbers", spec->name,
         equals + 1);
  const char *name = keep(format_text("%.*s", (int)(equals - text), text));
  if (json_object_get(ranges, name) != NULL)
    fail(STATUS_USAGE, "--%s: %s is given twice", spec->name, name);
  json_object_set_new(ranges, name, json_pack("[o, o]", low, high));
}

static json_t *ranges_of(const struct ctl *ctl, const struct option_spec *spec)
{
  json_t *ranges = json_object();
  for (size_t i = 0; i < ctl->n_given; i++)
    if (strcmp(ctl->given[i].name, spec->name) == 0)
      fill_range(spec, ctl->given[i].value, ranges);
  return ranges;
}

static void fill_fields(const struct ctl *ctl, json_t *request)
{
  for (const struct option_spec *spec = ctl->command->options; spec->name != NULL; spec++) {
    const char *text = spec->place != NULL ? option_text(ctl, spec->name, NULL) : NULL;
    if (text == NULL)
      continue;
    if (spec->kind == FIELD_RANGES) {
      fill_place(request, spec->place, ranges_of(ctl, spec));
      continue;
    }
    json_t *value = value_of(spec->kind, text);
    if (value == NULL)
      fail(STATUS_USAGE, "--%s: \"%s\" is not a %s", spec->name, text, field_kind_name(spec->kind));
    fill_place(request, spec->place, value);
  }
}

void fill_schedule(const struct ctl *ctl, json_t *request, const char *place)
{
  static const char *const kinds[] = {"restarts", "cosine", "constant", NULL};
  const char *name = option_text(ctl, "schedule", NULL);
  const size_t length = strlen(place);
  const bool kind = name != NULL && mo_word_index(kinds, name) >= 0;
  for (const struct option_spec *spec = ctl->command->options; spec->name != NULL && !kind; spec++)
    if (spec->place != NULL && strncmp(spec->place, place, length) == 0 &&
        spec->place[length] == '.' && option_is_set(ctl, spec->name))
      fail(STATUS_USAGE, "--%s needs --schedule restarts, cosine or constant%s", spec->name,
           name != NULL ? ": a named schedule has its own values" : "");
  if (name != NULL)
    fill_place(request, place, kind ? json_pack("{s:s}", "kind", name) : json_string(name));
}

void request_fill_record(const struct ctl *ctl, json_t *request, const char *usual)
{
  static const char *const channels[] = {"com", "masses", "actuation", "contacts", NULL};
  const char *record = option_text(ctl, "record", usual);
  bool films = option_is_set(ctl, "film");
  if (record == NULL && !films)
    return;
  json_t *list = json_array();
  json_object_set_new(request, "record", list);
  char *rest = keep(strdup(record != NULL ? record : "")), *word;
  while ((word = strsep(&rest, ",")) != NULL && (*word != 0 || rest != NULL)) {
    if (mo_word_index(channels, word) < 0)
      fail(STATUS_USAGE,
           "--record must be one or more of com, masses, actuation, contacts, got \"%s\"", record);
    json_array_append_new(list, json_string(word));
    films = films && strcmp(word, "masses") != 0;
  }
  if (films)
    json_array_append_new(list, json_string("masses"));
}

void request_fill_measures(const struct ctl *ctl, json_t *request)
{
  const char *measures = option_text(ctl, "measures", NULL);
  if (measures == NULL)
    return;
  if (strcmp(measures, "all") == 0) {
    json_object_set_new(request, "measures", json_true());
    return;
  }
  json_t *list = json_array();
  json_object_set_new(request, "measures", list);
  char *rest = keep(strdup(measures)), *word;
  while ((word = strsep(&rest, ",")) != NULL)
    json_array_append_new(list, json_string(word));
}

/* Adds one "key=value" of --physics. */
static void fill_setting(json_t *physics, const char *text)
{
  static const struct {
    const char *key;
    enum field_kind kind;
  } fields[] = {PHYSICS_FIELDS};
  enum { N_FIELDS = sizeof(fields) / sizeof(fields[0]) };
  const char *equals = strchr(text, '=');
  char key[64];
  if (equals == NULL || equals == text || (size_t)(equals - text) >= sizeof(key))
    fail(STATUS_USAGE, "--physics: \"%s\" must be paper or KEY=VALUE", text);
  snprintf(key, sizeof(key), "%.*s", (int)(equals - text), text);
  size_t k = 0;
  while (k < N_FIELDS && strcmp(fields[k].key, key) != 0)
    k++;
  if (k == N_FIELDS)
    fail(STATUS_USAGE, "--physics: unknown setting \"%s\"%s", key,
         did_you_mean("", key, &fields->key, N_FIELDS, sizeof(*fields)));
  json_t *json = field_value(fields[k].kind, equals + 1);
  if (json == NULL)
    fail(STATUS_USAGE, "--physics: \"%s\" is not a %s", equals + 1,
         field_kind_name(fields[k].kind));
  json_object_set_new(physics, key, json);
}

void request_fill_physics(const struct ctl *ctl, json_t *request)
{
  json_t *physics = keep(json_object());
  bool is_paper = false;
  for (size_t i = 0; i < ctl->n_given; i++)
    if (strcmp(ctl->given[i].name, "physics") != 0)
      continue;
    else if (strcmp(ctl->given[i].value, "paper") == 0)
      is_paper = true;
    else
      fill_setting(physics, ctl->given[i].value);
  if (is_paper && json_object_size(physics) > 0)
    fail(STATUS_USAGE,
         "--physics paper sets everything; to combine the paper's integrator with other "
         "settings, use --physics integrator=paper and those settings");
  if (is_paper)
    json_object_set_new(request, "physics", json_string("paper"));
  else if (json_object_size(physics) > 0)
    json_object_set(request, "physics", physics);
}

/* ---- designs, environments, whole requests ---- */

struct request json_request(const char *method, const char *path, const json_t *json)
{
  const char *body = json != NULL ? keep(dump_json(json, JSON_COMPACT)) : NULL;
  return (struct request){.method = method,
                          .path = path,
                          .content_type = "application/json",
                          .body = body,
                          .body_bytes = body != NULL ? strlen(body) : 0};
}

json_t *post_again(struct ctl *ctl, const char *path, const json_t *request)
{
  const struct request how = json_request("POST", path, request);
  return keep(send_json(ctl, &how, NULL));
}

void say_orientations(const struct ctl *ctl, const json_t *designs)
{
  const json_t *design;
  size_t n = 0, i;
  json_array_foreach(designs, i, design)
  {
    if (!json_is_string(json_object_get(design, "orientation")) || ctl->quiet)
      continue;
    if (n++ < SAID_MAX)
      print_from(
          stderr, design,
          "using {robot}[{orientation=best}: its best stored score of all orientations|, the "
          "canonical orientation: no stored score]");
  }
  if (n > SAID_MAX)
    fprintf(stderr, "… and %s more given by an id without an orientation\n",
            MO_COUNTED(n - SAID_MAX, "design"));
}

json_t *random_of(const struct ctl *ctl, const char *seed, int64_t most)
{
  const int64_t count = option_number(ctl, "random", 1, most, 0),
                first = option_number(ctl, "first", 0, RANDOM_BODIES_MAX - 1, 0);
  if (count == 0 && option_is_set(ctl, "first"))
    fail(STATUS_USAGE, "--first needs --random N, the number of bodies starting there");
  if (count == 0)
    return NULL;
  json_t *random = keep(json_pack("{s:I, s:I}", "count", (json_int_t)count, "seed",
                                  (json_int_t)option_number(ctl, seed, 0, INT64_MAX, 1)));
  if (first > 0)
    json_object_set_new(random, "first", json_integer(first));
  return random;
}

struct designs given_designs(struct ctl *ctl, size_t first, const json_t *random)
{
  struct designs designs = no_designs();
  for (size_t i = first; i < ctl->n_operands; i++)
    designs_add_operand(&designs, ctl->operands[i]);
  if (ctl->n_operands == 0 && random == NULL)
    designs_add_operand(&designs, "-");
  if (random != NULL)
    designs_add_genotypes(&designs,
                          json_object_get(post_again(ctl, "/v1/bodies/random", random), "items"));
  return designs;
}

const char *const suite_tasks[SUITE_TASKS + 1] = {"photo", "photo-auc", "walk", "rough",  "up",
                                                  "down",  "hurdle",    "gap",  "circle", "shuttle",
                                                  "path",  "damage",    NULL};

static bool is_set(const char *name)
{
  return strcmp(name, "paper-test") == 0 || strcmp(name, "morpho-12") == 0 ||
         strncmp(name, "morpho-12-", 10) == 0;
}

static void fill_environments(const struct ctl *ctl, json_t *request)
{
  const char *name = option_text(ctl, "environments", NULL);
  const char *task = option_word(ctl, "task", suite_tasks, NULL);
  if (name != NULL && task != NULL)
    fail(STATUS_USAGE, "give --task or --environments, not both");
  /* An atlas has a field for it. */
  if (task != NULL && json_object_get(request, "task") == NULL)
    name = keep(format_text("morpho-12-%s", task));
  if (name == NULL)
    return;
  if (is_set(name)) {
    json_object_set_new(request, "environments", json_string(name));
    return;
  }
  size_t length;
  const char *text = read_input(name, INPUT_BYTES_MAX, &length);
  json_error_t error;
  json_t *json = json_loadb(text, length, JSON_REJECT_DUPLICATES, &error);
  if (json == NULL)
    fail(STATUS_USAGE, "%s:%d: %s", name, error.line, error.text);
  keep(json);
  const bool varies = json_object_get(json, "vary") != NULL;
  json_t *list = json_is_object(json) && !varies ? json_object_get(json, "environments") : json;
  if (list == NULL &&
      (json_object_get(json, "light_xy_m") != NULL || json_object_get(json, "task") != NULL))
    list = keep(json_pack("[O]", json));
  if (!json_is_array(list) && !json_is_string(list) && !varies)
    fail(STATUS_USAGE,
         "%s is not a list of environments: [{\"light_xy_m\": [x, y], \"terrain_heights_m\": […]}, "
         "{\"task\": \"walk\"}, …], or {\"of\": …, \"vary\": {\"friction\": [0.5, 1.5]}}",
         name);
  json_object_set(request, "environments", list);
}

void request_fill(const struct ctl *ctl, json_t *request)
{
  static const char *const precisions[] = {"float32", "float64", NULL};
  option_word(ctl, "precision", precisions, NULL);
  fill_fields(ctl, request);
  request_fill_physics(ctl, request);
  fill_environments(ctl, request);
}

/* ---- jobs ---- */

/* Waits until the job is final; each request waits up to a second at the server. */
static void wait_for(struct ctl *ctl, const char *id)
{
  const struct request request = {.method = "GET", .path = path_to("/v1/jobs/%s", id), .wait_s = 1};
  for (bool final = false; !final;) {
    json_t *job = send_json(ctl, &request, NULL);
    const char *state = text_of(job, "state");
    const bool rests = strcmp(state, "paused") == 0;
    final = is_final(state);
    const int64_t waiting = number_of(job, "n_waiting"), designs = number_of(job, "n_designs");
    const json_t *atlas = json_object_get(job, "atlas"),
                 *certificate = json_object_get(job, "certificate");
    if (!final && atlas != NULL)
      progress_show(ctl, state, number_of(atlas, "bodies_done"), number_of(atlas, "bodies_total"),
                    "bodies");
    else if (!final && certificate != NULL)
      progress_show(ctl, state, number_of(certificate, "rollouts_done"),
                    number_of(certificate, "rollouts"), "rollouts");
    else if (!final && waiting > 0)
      progress_show(ctl, state, designs - waiting, designs, "designs stored");
    else if (!final)
      progress_show(ctl, state, number_of(job, "rollouts_done"), number_of(job, "rollouts_total"),
                    "rollouts");
    json_decref(job);
    if (!final && interrupted())
      leave(STATUS_INTERRUPTED);
    if (rests)
      pause_s(1);
  }
  progress_end();
}

json_t *post_job(struct ctl *ctl, const char *path, const json_t *request, unsigned wait_s)
{
  struct request how = json_request("POST", path, request);
  char generated[33];
  random_key(generated);
  how.key = option_text(ctl, "idempotency-key", generated);
  how.wait_s = wait_s;
  return keep(send_json(ctl, &how, NULL));
}

void await_job(struct ctl *ctl, const json_t *job, const char *noun)
{
  const char *id = text_of(job, "id");
  catch_interrupts(ctl->quiet ? NULL
                              : keep(format_text("The %s continues: morphoctl job show %s; to stop "
                                                 "it: morphoctl job cancel %s",
                                                 noun, id, id)));
  wait_for(ctl, id);
}

json_t *evaluate(struct ctl *ctl, const char *path, const json_t *request, bool wait)
{
  json_t *evaluation = post_job(ctl, path, request, wait ? 1 : 0);
  const char *state = text_of(evaluation, "state"), *id = text_of(evaluation, "id");
  if (!wait || json_object_get(evaluation, "results") != NULL ||
      (is_final(state) && strcmp(state, "succeeded") != 0))
    return evaluation;
  await_job(ctl, evaluation, "evaluation");
  return get_json(ctl, "/v1/evaluations/%s", id);
}
