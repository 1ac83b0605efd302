/* campaign_request.c: the body of POST /v1/campaigns.
 *
 * The defaults depend on mode and preset. A first pass over the text finds these two; a second pass
 * reads all members over their defaults. Checks that involve several fields come last. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"
#include "base/words.h"
#include "certificate/held_out.h"
#include "store/fields.h"
#include "world/environment.h"
#include "world/factors.h"

/* ---- members with their own readers ---- */

static void read_learning(struct mo_json *json, void *value)
{
  struct mo_parsed_campaign *parsed = value;
  parsed->has_learning = true;
  mo_fields_read(json, &mo_campaign_record_learning_fields, &parsed->request.record);
}

static void read_initial(struct mo_json *json, void *value)
{
  static const char words[] = "must be \"random\", or an object with designs or campaign";
  struct mo_parsed_campaign *parsed = value;
  enum mo_json_kind next = mo_json_peek(json);
  unsigned depth = json->depth, ways = 0;
  struct mo_json_slice key;
  if (next == MO_JSON_STRING) {
    if (mo_json_string(json, &key) && !mo_json_is(key, "random"))
      mo_json_fault_at(json, depth, "", "%s", words);
    return;
  }
  if (next != MO_JSON_OBJECT) {
    if (next != MO_JSON_NONE) {
      mo_json_fault(json, "%s", words);
      mo_json_skip(json);
    }
    return;
  }
  mo_read_ahead(json, &mo_design_rules_fields, &parsed->parts, NULL);
  mo_json_object(json);
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "designs")) {
      mo_designs_field.read(json, &parsed->parts);
    } else if (mo_json_is(key, "campaign")) {
      mo_read_job_id(json, "a campaign", &parsed->request.record.initial_campaign);
    } else {
      if (!mo_fields_read_member(json, key, &mo_design_rules_fields, &parsed->parts))
        mo_fields_unknown(json, "designs, campaign", &mo_design_rules_fields);
      continue;
    }
    ways++;
  }
  if (!json->stop && ways != 1)
    mo_json_fault_at(json, depth, "",
                     "must be \"random\", or have exactly one of designs and campaign; random "
                     "bodies fill up the population");
}

/* Finds the size of the body in voxels along x, y, z; zeros for an empty body. */
static void extent(const struct mo_bits *bits, uint32_t size[3])
{
  const struct mo_workspace ours = MO_STORE_WORKSPACE;
  uint32_t low[3] = {ours.nx, ours.ny, ours.nz}, high[3] = {0};
  for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++) {
    if (!(bits->words[v >> 6] >> (v & 63) & 1))
      continue;
    const uint32_t at[3] = {v / (ours.ny * ours.nz), v / ours.nz % ours.ny, v % ours.nz};
    for (int axis = 0; axis < 3; axis++) {
      low[axis] = at[axis] < low[axis] ? at[axis] : low[axis];
      high[axis] = at[axis] + 1 > high[axis] ? at[axis] + 1 : high[axis];
    }
  }
  for (int axis = 0; axis < 3; axis++)
    size[axis] = high[axis] > low[axis] ? high[axis] - low[axis] : 0;
}

struct listed {
  struct mo_bits form;
  uint32_t place;
};

static int by_form(const void *a, const void *b)
{
  const struct listed *x = a, *y = b;
  int order = memcmp(&x->form, &y->form, sizeof(x->form));
  return order != 0 ? order : x->place < y->place ? -1 : x->place > y->place;
}

static int by_place(const void *a, const void *b)
{
  const struct mo_design_note *x = a, *y = b;
  return x->place < y->place ? -1 : x->place > y->place;
}

/* The listed designs while they are checked. */
struct founders {
  struct mo_json *json;
  struct mo_parts *parts;
  struct listed *listed; /* (n_designs) those that fit */
  uint32_t n_listed;
  uint32_t *places; /* (n_designs) indices in the request */
  uint32_t n_noted; /* notes from reading the request */
};

/* Refuses or skips a design, depending on the request. */
static void leave_out(struct founders *founders, uint32_t i, const char *format, ...)
    __attribute__((format(printf, 3, 4)));
static void leave_out(struct founders *founders, uint32_t i, const char *format, ...)
{
  struct mo_parts *parts = founders->parts;
  struct mo_design_note key = {.place = founders->places[i]}, *known = NULL;
  va_list arguments;
  snprintf(key.fault.where, sizeof(key.fault.where), "/initial/designs/%u", key.place);
  va_start(arguments, format);
  vsnprintf(key.fault.detail, sizeof(key.fault.detail), format, arguments);
  va_end(arguments);
  if (parts->on_fault != MO_FAULT_SKIP) {
    mo_json_fault_at(founders->json, 0, key.fault.where, "%s", key.fault.detail);
    return;
  }
  parts->genotypes[i] = (struct mo_bits){{0}};
  if (founders->n_noted > 0)
    known = bsearch(&key, parts->notes, founders->n_noted, sizeof(key), by_place);
  if (known != NULL) { /* the design already has a note: it was repaired, or given by its id */
    *known = key;
    parts->n_skipped++;
  } else if (!mo_parts_note(parts, &key)) {
    parts->error = MO_ERR_NO_MEMORY;
  }
}

/* Leaves out designs that are larger than the campaign's workspace. Designs that were found invalid
 * before are empty. */
static void check_sizes(struct founders *founders, struct mo_workspace workspace)
{
  const struct mo_bits *genotypes = founders->parts->genotypes;
  for (uint32_t i = 0; i < founders->parts->n_designs; i++) {
    uint32_t size[3];
    extent(&genotypes[i], size);
    if (size[0] > workspace.nx || size[1] > workspace.ny || size[2] > workspace.nz) {
      leave_out(founders, i,
                "the body takes %u × %u × %u voxels and does not fit the campaign's workspace, "
                "which has %u × %u × %u",
                size[0], size[1], size[2], workspace.nx, workspace.ny, workspace.nz);
    } else if (size[0] > 0) {
      struct listed *listed = &founders->listed[founders->n_listed++];
      mo_genotype_canonical(MO_STORE_WORKSPACE, genotypes[i].words, listed->form.words);
      listed->place = i;
    }
  }
}

/* Leaves out duplicates of earlier designs, in the order of the request. */
static void check_repeats(struct founders *founders, uint32_t *first)
{
  const struct listed *listed = founders->listed;
  qsort(founders->listed, founders->n_listed, sizeof(*listed), by_form);
  for (uint32_t i = 0; i < founders->parts->n_designs; i++)
    first[i] = i;
  for (uint32_t i = 1; i < founders->n_listed; i++)
    if (memcmp(&listed[i].form, &listed[i - 1].form, sizeof(listed[i].form)) == 0)
      first[listed[i].place] = first[listed[i - 1].place];
  for (uint32_t i = 0; i < founders->parts->n_designs; i++)
    if (first[i] != i)
      leave_out(founders, i,
                "duplicate design: it has the same form as design %u; list each design once",
                founders->places[first[i]]);
}

/* Closes the gaps left by designs that these checks removed. */
static void close_gaps(struct mo_parts *parts)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < parts->n_designs; i++)
    if (mo_genotype_count(MO_STORE_WORKSPACE, parts->genotypes[i].words) > 0)
      parts->genotypes[n++] = parts->genotypes[i];
  parts->n_designs = n;
  if (parts->n_notes > 0)
    qsort(parts->notes, parts->n_notes, sizeof(*parts->notes), by_place);
}

static int check_listed(struct mo_json *json, struct mo_parsed_campaign *parsed)
{
  struct mo_parts *parts = &parsed->parts;
  const uint32_t n = parts->n_designs;
  struct founders founders = {.json = json,
                              .parts = parts,
                              .listed = malloc((n + 1) * sizeof(*founders.listed)),
                              .places = malloc((n + 1) * sizeof(*founders.places)),
                              .n_noted = parts->n_notes};
  uint32_t *first = malloc((n + 1) * sizeof(*first)); /* the first design with the same form */
  if (founders.listed == NULL || founders.places == NULL || first == NULL)
    parts->error = MO_ERR_NO_MEMORY;
  if (parts->error == MO_OK) {
    mo_notes_places(parts->notes, parts->n_notes, founders.places, n);
    check_sizes(&founders, parsed->request.record.settings.workspace);
    check_repeats(&founders, first);
  }
  if (parts->on_fault == MO_FAULT_SKIP)
    close_gaps(parts);
  if (parts->n_designs == 0 && parts->n_skipped > 0)
    mo_json_fault_at(json, 0, "/initial/designs",
                     "all %u designs are skipped: %s; give at least one valid body",
                     parts->n_skipped, parts->notes[0].fault.detail);
  free(founders.listed);
  free(founders.places);
  free(first);
  return parts->error;
}

/* ---- the whole body ---- */

#define AT(member) offsetof(struct mo_parsed_campaign, member)
static const char *const if_exists_words[] = {"create", "return", NULL};
static const struct mo_field_own initial = {.read = read_initial};
static const struct mo_field_own learning = {.read = read_learning};
static const struct mo_field rows[] = {
    {"mode", MO_FIELD_WORD, 0, AT(mode), .words = mo_campaign_mode_words},
    {"preset", MO_FIELD_WORD, 0, AT(preset), .words = mo_preset_words},
    {"replicates", MO_FIELD_COUNT, 0, AT(request.record.replicates), .min = 1,
     .max = MO_REPLICATES_MAX, .unit = "campaigns", .help = "campaigns that differ in their seeds"},
    {"name", MO_FIELD_OWN, 0, AT(request.record.name), .own = &mo_name_field},
    {"if_exists", MO_FIELD_WORD, 0, AT(if_exists), .words = if_exists_words, .unit = "",
     .help = "create another study, or return the open one of this label"},
    {"own_score", MO_FIELD_OWN, 0, AT(request.record.own_score), .group = &mo_own_score_fields,
     .own = &mo_own_score_field, .unit = "",
     .help = "name and unit of the score that the study's client sends"},
    {"environments", MO_FIELD_OWN, 0, AT(parts), .own = &mo_environments_field},
    {"initial", MO_FIELD_OWN, 0, 0, .own = &initial},
    {"learning", MO_FIELD_OWN, 0, 0, .own = &learning},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_parts_fields},
    {NULL, MO_FIELD_INLINE, 0, AT(request.record), .group = &mo_campaign_record_fields},
};
#undef AT
const struct mo_fields mo_campaign_request_fields = MO_FIELDS(rows);

/* Checks what depends on the mode. */
static void check_mode(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  enum mo_campaign_mode mode = parsed->request.record.settings.mode;
  const struct mo_parts *parts = &parsed->parts;
  bool random = mo_modes[mode].starts_untrained && (!parts->has_controller || parts->no_controller);
  if (!mo_modes[mode].starts_untrained && parts->no_controller)
    mo_json_fault_at(json, 0, "/controller",
                     "must not be null, because a %s campaign needs a controller; give its name, "
                     "or sha256: and 64 hexadecimal digits",
                     mo_campaign_mode_words[mode]);
  if (!mo_modes[mode].learns && parsed->has_learning)
    mo_json_fault_at(json, 0, "/learning",
                     "a %s campaign does not learn; only few-shot and simultaneous campaigns have "
                     "learning settings",
                     mo_campaign_mode_words[mode]);
  else if (parsed->has_sensor && !random)
    mo_json_fault_at(
        json, 0, "/learning/sensor",
        "the campaign starts from a controller, which determines the sensor; omit it here");
  if (!mo_modes[mode].learns && parsed->request.record.name[0] != '\0')
    mo_json_fault_at(json, 0, "/name",
                     "a %s campaign does not create a controller; only few-shot and simultaneous "
                     "campaigns can name one",
                     mo_campaign_mode_words[mode]);
}

/* Checks that the request for a study has no settings of work that its client does. */
static void check_study(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  static const char words[] =
      "a study does not support this: its client makes the designs, batch by batch";
  const struct mo_campaign_record *record = &parsed->request.record;
  if (record->settings.generations > 0)
    mo_json_fault_at(json, 0, "/generations", "%s", words);
  if (record->replicates > 1)
    mo_json_fault_at(json, 0, "/replicates", "%s", words);
  if (parsed->parts.n_designs > 0 || record->initial_campaign > 0)
    mo_json_fault_at(json, 0, "/initial", "%s", words);
  if (record->settings.exclude_pretraining)
    mo_json_fault_at(json, 0, "/exclude_pretraining", "%s", words);
}

/* Checks the measures, and the one to select by. `racing` is negative if the request omits it. */
static void check_measures(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  const struct mo_campaign_record *record = &parsed->request.record;
  const bool selects = record->select_by.is_set;
  if (selects && mo_own_score_is_set(&record->own_score))
    mo_json_fault_at(json, 0, "/select_by",
                     "cannot be combined with own_score; give only one of them");
  if (selects && (int)record->settings.racing == MO_RACING_LOSSLESS)
    mo_json_fault_at(json, 0, "/racing",
                     "a race stops rollouts by their loss, so a campaign with select_by cannot "
                     "race; request \"off\", or leave it out");
}

/* Checks how losses become scores. `racing` is negative if the request omits it. */
static void check_aggregate(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  const struct mo_campaign_record *record = &parsed->request.record;
  const struct mo_aggregate *aggregate = &record->settings.aggregate;
  const char *word = mo_aggregate_words[aggregate->kind];
  if (aggregate->kind == MO_AGGREGATE_MEAN)
    return;
  if (record->select_by.is_set)
    mo_json_fault_at(json, 0, "/aggregate",
                     "with select_by, the score is the mean of a measure, which supports only "
                     "\"mean\", got \"%s\"; give only one of them",
                     word);
  if (mo_own_score_is_set(&record->own_score))
    mo_json_fault_at(json, 0, "/aggregate",
                     "with own_score, the client computes the scores, so \"%s\" has no losses to "
                     "apply to; give only one of them",
                     word);
  if (!mo_aggregate_is_monotone(aggregate) && (int)record->settings.racing == MO_RACING_LOSSLESS)
    mo_json_fault_at(json, 0, "/racing",
                     "a race needs lower bounds on scores, and \"%s\" has none, so the campaign "
                     "cannot race; request \"off\", or leave it out",
                     word);
  if (aggregate->kind == MO_AGGREGATE_MEAN_SD && parsed->parts.environments != NULL &&
      parsed->parts.n_environments == 1)
    mo_json_fault_at(json, 0, "/aggregate",
                     "one environment has no standard deviation; give at least two environments "
                     "or another aggregate");
}

/* Checks that there are fresh worlds of the same kind as the campaign's. */
static void check_re_evaluation(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  const struct mo_campaign_record *record = &parsed->request.record;
  const struct mo_parts *parts = &parsed->parts;
  const uint32_t wanted = record->re_evaluate.environments;
  const bool is_listed = parts->environments != NULL;
  const int set = is_listed ? -1 : mo_word_index(mo_set_words, mo_parts_set(parts));
  const struct mo_certificate_base base = {.environments = parts->environments,
                                           .n_environments = parts->n_environments,
                                           .set = set >= 0 ? mo_set_words[set] : NULL};
  if (record->re_evaluate.every == 0)
    return;
  if (!mo_modes[record->settings.mode].makes_children)
    mo_json_fault_at(json, 0, "/re_evaluate",
                     "a study does not support this: its client decides which designs to score "
                     "again; evaluate or certify them");
  if (!is_listed && set < 0)
    return; /* there is no such set, which is rejected elsewhere */
  const char *reason = mo_fresh_refuses(&base);
  if (reason != NULL)
    mo_json_fault_at(json, 0, "/re_evaluate", "no fresh worlds can be drawn: %s", reason);
  else if (mo_fresh_count(&base, wanted) < wanted)
    mo_json_fault_at(json, 0, "/re_evaluate/environments",
                     "must be at most %u, because the held-out set of %s has no more, got %u",
                     (unsigned)mo_fresh_count(&base, wanted), base.set, (unsigned)wanted);
}

/* Checks that if_exists is for a study, and that there is a label to find it by. */
static void check_if_exists(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  if (parsed->if_exists == 0)
    return;
  if (mo_modes[parsed->request.record.settings.mode].makes_children)
    mo_json_fault_at(json, 0, "/if_exists", "only studies support \"return\"; use \"create\"");
  else if (parsed->parts.label[0] == '\0')
    mo_json_fault_at(json, 0, "/if_exists",
                     "a study to return is found by its label; give a label");
}

/* Checks the sizes of a campaign that learns. */
static void check_learning(struct mo_json *json, const struct mo_campaign_settings *settings)
{
  const uint64_t of_both = (uint64_t)settings->parent_steps + settings->child_steps;
  const uint64_t steps = settings->child_steps + of_both * settings->generations;
  if (settings->population > MO_TRAINING_DESIGNS_MAX)
    mo_json_fault_at(json, 0, "/population", "must be at most %d in a campaign that learns, got %u",
                     MO_TRAINING_DESIGNS_MAX, settings->population);
  if (of_both == 0)
    mo_json_fault_at(json, 0, "/learning",
                     "parent_steps and child_steps are both 0; a campaign that learns needs a step "
                     "in each generation");
  if (mo_modes[settings->mode].inherits_learning && steps > MO_TRAINING_STEPS_MAX)
    mo_json_fault_at(json, 0, "/learning",
                     "all generations together have %llu learning steps; at most %d are allowed",
                     (unsigned long long)steps, MO_TRAINING_STEPS_MAX);
}

/* Returns where robots learn by default: in the environments of the campaign if one of them has a
 * task, damage, factors, a drop, or a terrain other than rough or flat, which random environments
 * do not have. */
static enum mo_worlds usual_worlds(struct mo_parts *parts)
{
  const struct mo_environment *environments = parts->environments;
  struct mo_environment *of_set = NULL;
  uint32_t n = parts->n_environments;
  bool are_random = true;
  if (environments == NULL) {
    of_set = malloc(MO_SET_ENVIRONMENTS_MAX * sizeof(*of_set));
    if (of_set == NULL) {
      parts->error = MO_ERR_NO_MEMORY;
      return MO_WORLDS_RANDOM;
    }
    n = mo_environment_set(mo_word_index(mo_set_words, mo_parts_set(parts)), of_set);
    environments = of_set;
  }
  for (uint32_t i = 0; i < n; i++)
    are_random = are_random && mo_environment_version(&environments[i]) == 1;
  free(of_set);
  return are_random ? MO_WORLDS_RANDOM : MO_WORLDS_ENVIRONMENTS;
}

/* Decides where robots learn, unless the request did. */
static void choose_worlds(struct mo_json *json, struct mo_parsed_campaign *parsed)
{
  struct mo_campaign_record *record = &parsed->request.record;
  const bool is_given = (int)record->worlds >= 0;
  if (!mo_modes[record->settings.mode].learns)
    record->worlds = MO_WORLDS_RANDOM;
  else if (!is_given)
    record->worlds = usual_worlds(&parsed->parts);
  if (record->worlds != MO_WORLDS_RANDOM)
    mo_parts_check_gradients(json, &parsed->parts,
                             "; to select by this task but learn in random environments, set "
                             "{\"learning\": {\"worlds\": \"random\"}}");
}

/* Checks what depends on several fields. The sensor is negative unless it was given. */
static int check(struct mo_json *json, void *any)
{
  struct mo_parsed_campaign *parsed = any;
  const struct mo_campaign_record *record = &parsed->request.record;
  const struct mo_campaign_settings *settings = &record->settings;
  uint64_t designs = (uint64_t)settings->population * ((uint64_t)settings->generations + 1);
  parsed->has_sensor = (int)settings->sensor >= 0;
  if (!parsed->has_mode)
    mo_json_fault_at(
        json, 0, "",
        "mode is missing; it must be \"zero-shot\", \"few-shot\", \"simultaneous\" or \"study\"");
  if (parsed->mode >= 0)
    check_mode(json, parsed);
  if (!mo_modes[settings->mode].makes_children)
    check_study(json, parsed);
  else if (mo_own_score_is_set(&record->own_score))
    mo_json_fault_at(json, 0, "/own_score",
                     "only studies support this: the service scores the designs of a %s campaign",
                     mo_campaign_mode_words[settings->mode]);
  check_if_exists(json, parsed);
  check_measures(json, parsed);
  check_aggregate(json, parsed);
  check_re_evaluation(json, parsed);
  if (designs > MO_CAMPAIGN_DESIGNS_MAX)
    mo_json_fault_at(json, 0, "/generations",
                     "%u designs in each of %u generations and in the initial population make "
                     "%llu; at most %llu are allowed",
                     settings->population, settings->generations, (unsigned long long)designs,
                     (unsigned long long)MO_CAMPAIGN_DESIGNS_MAX);
  if (mo_modes[settings->mode].learns)
    check_learning(json, settings);
  choose_worlds(json, parsed);
  const bool learns_there =
      mo_modes[settings->mode].learns && record->worlds == MO_WORLDS_ENVIRONMENTS;
  mo_parts_check_factors(json, &parsed->parts, &settings->physics,
                         learns_there ? &settings->learning.vary : NULL);
  if (settings->seed + record->replicates - 1 > (uint64_t)MO_SEED_MAX)
    mo_json_fault_at(json, 0, "/seed",
                     "the seeds of %u replicates, starting at %llu, exceed %lld; lower the seed",
                     record->replicates, (unsigned long long)settings->seed,
                     (long long)MO_SEED_MAX);
  const int error = check_listed(json, parsed);
  if (parsed->parts.n_designs > settings->population)
    mo_json_fault_at(json, 0, "/initial/designs",
                     "must be at most the population, which is %u, got %u designs",
                     settings->population, parsed->parts.n_designs);
  return error;
}

int mo_campaign_parse(const char *text, size_t size, struct mo_parsed_campaign *parsed,
                      struct mo_faults *faults)
{
  struct mo_campaign_request *request = &parsed->request;
  struct mo_campaign_record *record = &request->record;
  struct mo_parts *parts = &parsed->parts;
  struct mo_message message = {""};
  *parsed = (struct mo_parsed_campaign){.parts.job = {.priority = MO_BATCH, .weight = 1},
                                        .mode = -1,
                                        .preset = MO_PRESET_WORKSTATION};
  mo_read_words(text, size, &(struct mo_fields){rows, 2}, parsed, &parsed->has_mode);
  const enum mo_campaign_mode mode =
      parsed->mode >= 0 ? (enum mo_campaign_mode)parsed->mode : MO_ZERO_SHOT;
  const enum mo_preset preset = (enum mo_preset)parsed->preset;
  *record = (struct mo_campaign_record){
      .settings = mo_campaign_preset(mode, preset), .replicates = 1, .checkpoint_every_s = 60};
  snprintf(record->preset, sizeof(record->preset), "%s", mo_preset_words[preset]);
  const enum mo_sensor sensor = record->settings.sensor;
  record->settings.sensor = (enum mo_sensor) - 1;
  const enum mo_racing racing = record->settings.racing;
  record->settings.racing = (enum mo_racing) - 1;
  record->worlds = (enum mo_worlds) - 1;
  int error = mo_read_body(text, size, &mo_campaign_request_fields, parsed, parts, check, faults);
  record->settings.learning.vary.given = mo_factors_vary(&record->settings.learning.vary);
  if ((int)record->settings.sensor < 0)
    record->settings.sensor = sensor;
  if ((int)record->worlds < 0)
    record->worlds = MO_WORLDS_RANDOM;
  if ((int)record->settings.racing < 0)
    record->settings.racing =
        record->select_by.is_set || !mo_aggregate_is_monotone(&record->settings.aggregate)
            ? MO_RACING_OFF
            : racing;
  if (record->select_by.is_set) {
    record->measures |= UINT32_C(1) << record->select_by.measure;
    mo_select_by_name(&record->select_by, &record->own_score);
  }
  if (!mo_modes[mode].starts_untrained && !parts->has_controller)
    memcpy(parts->controller, "default", sizeof("default"));
  if (error == MO_OK && mo_campaign_settings_check(&record->settings, &message) != MO_OK) {
    mo_faults_add(faults, MO_FAULT_BODY, "", "%s", message.text);
    error = MO_ERR_INVALID;
  }
  request->controller = mo_parts_controller(parts);
  request->reuses = parsed->if_exists == 1;
  request->job = parts->job;
  request->genotypes = parts->genotypes;
  request->notes = parts->notes;
  request->n_notes = parts->n_notes;
  record->n_listed = parts->n_designs;
  request->environments = parts->environments;
  record->n_environments = parts->n_environments;
  if (parts->environments == NULL)
    snprintf(record->environment_set, sizeof(record->environment_set), "%s", mo_parts_set(parts));
  return error;
}
