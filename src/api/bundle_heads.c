/* bundle_heads.c: the lines of a bundle that a campaign, or an evaluation with recordings, begins
 * with. See bundle_lines.c. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/bundle_line.h"
#include "api/job_json.h"
#include "base/words.h"
#include "store/fields.h"
#include "store/store.h"

/* ---- writing ---- */

static void write_source(struct mo_text *text, const char *kind,
                         const struct mo_import_source *source)
{
  mo_text_name(text, "source");
  mo_text_format(text, "{\"store\":\"%016llx\"", (unsigned long long)source->store);
  mo_text_member_id(text, kind, source->job);
  mo_text_add(text, "}");
}

/* experiment, note: "": none. */
static void write_texts(struct mo_text *text, const char *label, const char *experiment,
                        const char *note)
{
  mo_text_member(text, "label", label);
  mo_text_member(text, "experiment", experiment[0] != '\0' ? experiment : NULL);
  mo_text_member(text, "note", note[0] != '\0' ? note : NULL);
}

void mo_bundle_write_campaign(struct mo_text *text, const struct mo_imported_campaign *campaign)
{
  const struct mo_campaign_record *record = &campaign->record;
  struct mo_sha256 physics;
  mo_physics_hash(&record->settings.physics, MO_FLOAT32, record->settings.sensor, &physics);
  mo_text_add(text, "{");
  write_source(text, "campaign", &campaign->source);
  mo_text_member_id(text, "group", record->group);
  mo_line_whole(text, "replicate", record->replicate);
  mo_line_whole(text, "replicates", record->replicates);
  mo_text_member(text, "state", mo_job_state_name(campaign->state));
  mo_line_whole(text, "end", campaign->end);
  write_texts(text, campaign->has_label ? campaign->label : NULL, campaign->experiment,
              campaign->note);
  mo_text_member_number(text, "weight", campaign->weight);
  mo_line_whole(text, "back_end", campaign->back_end);
  mo_line_whole(text, "created_us", campaign->created_us);
  mo_line_whole(text, "started_us", campaign->started_us);
  mo_line_whole(text, "finished_us", campaign->finished_us);
  mo_text_member(text, "preset", record->preset);
  mo_text_member(text, "name", record->name);
  mo_member_controller(text, "controller", campaign->has_controller, campaign->controller_name,
                       &campaign->controller_sha256);
  mo_member_controller(text, "result", campaign->has_result, "", &campaign->result_sha256);
  mo_text_member(text, "environment_set", record->environment_set);
  mo_line_whole(text, "environments", record->n_environments);
  mo_line_whole(text, "listed", record->n_listed);
  mo_line_whole(text, "generation", campaign->generation);
  mo_line_whole(text, "designs", (int64_t)campaign->n_designs);
  mo_text_member_number(text, "diversity_max", campaign->diversity_max);
  mo_member_hash(text, "physics_sha256", &physics);
  mo_text_name(text, "settings");
  mo_settings_write(MO_JOB_CAMPAIGN, record, text);
  mo_text_add(text, "}");
}

void mo_bundle_write_evaluation(struct mo_text *text,
                                const struct mo_imported_evaluation *evaluation)
{
  mo_text_add(text, "{");
  write_source(text, "evaluation", &evaluation->source);
  write_texts(text, evaluation->has_label ? evaluation->label : NULL, evaluation->experiment,
              evaluation->note);
  mo_line_whole(text, "back_end", evaluation->back_end);
  mo_line_whole(text, "created_us", evaluation->created_us);
  mo_line_whole(text, "started_us", evaluation->started_us);
  mo_line_whole(text, "finished_us", evaluation->finished_us);
  mo_text_member(text, "controller", evaluation->controller_name);
  mo_text_member(text, "environment_set", evaluation->environment_set);
  mo_text_member(text, "class", evaluation->fingerprint);
  mo_text_member(text, "workers_class", evaluation->workers);
  mo_line_whole(text, "record", evaluation->record);
  mo_line_whole(text, "stride", evaluation->stride);
  mo_line_counts(text, "environments", evaluation->environments, evaluation->n_environments);
  mo_line_counts(text, "numbers", evaluation->numbers, evaluation->n_designs);
  mo_text_add(text, "}");
}

/* ---- reading ---- */

static void read_id(struct mo_json *json, int64_t *id)
{
  char digits[24] = "";
  char *end = NULL;
  mo_line_text(json, digits, sizeof(digits));
  *id = strtoll(digits, &end, 10);
  if (*id < 1 || *end != '\0')
    mo_line_refuse(json, "an id is expected");
}

/* Reads what a person wrote: a text of up to a quarter as many characters as there are bytes. */
static void read_words(struct mo_json *json, char *text, size_t size)
{
  mo_line_text(json, text, size);
  if (mo_utf8_length(text, strlen(text)) > size / 4)
    mo_line_refuse(json, "the text is too long");
}

static void read_source(struct mo_json *json, struct mo_import_source *source)
{
  struct mo_json_slice key;
  char digits[24] = "";
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "store")) {
        mo_line_text(json, digits, sizeof(digits));
        source->store = strtoull(digits, NULL, 16);
      } else if (mo_json_is(key, "campaign") || mo_json_is(key, "evaluation")) {
        read_id(json, &source->job);
      } else {
        mo_json_skip(json);
      }
    }
}

/* Reads {"name", "sha256"}, or null. */
static void read_controller(struct mo_json *json, bool *known, char *name, size_t size,
                            struct mo_sha256 *sha256)
{
  struct mo_json_slice key;
  *known = mo_json_peek(json) == MO_JSON_OBJECT;
  if (!*known) {
    mo_json_skip(json);
    return;
  }
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "sha256"))
        mo_line_hash(json, sha256);
      else if (mo_json_is(key, "name") && name != NULL && mo_json_peek(json) == MO_JSON_STRING)
        mo_line_text(json, name, size);
      else
        mo_json_skip(json);
    }
}

static void read_settings(struct mo_json *json, struct mo_campaign_record *record)
{
  struct mo_message words = {""};
  mo_json_peek(json);
  const size_t from = json->at;
  mo_json_skip(json);
  char *text = strndup(json->text + from, json->at - from);
  if (text == NULL || mo_settings_read(MO_JOB_CAMPAIGN, text, record) != MO_OK)
    mo_line_refuse(json, "these are no settings of a campaign");
  else if (mo_campaign_settings_check(&record->settings, &words) != MO_OK)
    mo_line_refuse(json, words.text);
  free(text);
}

static void read_campaign_member(struct mo_json *json, struct mo_json_slice key,
                                 struct mo_imported_campaign *campaign)
{
  struct mo_campaign_record *record = &campaign->record;
  const struct {
    const char *name;
    int64_t max, *whole;
    uint32_t *count;
  } numbers[] = {{"replicate", MO_REPLICATES_MAX, NULL, &record->replicate},
                 {"replicates", MO_REPLICATES_MAX, NULL, &record->replicates},
                 {"created_us", INT64_MAX, &campaign->created_us, NULL},
                 {"started_us", INT64_MAX, &campaign->started_us, NULL},
                 {"finished_us", INT64_MAX, &campaign->finished_us, NULL},
                 {"environments", MO_ENVIRONMENTS_MAX, NULL, &record->n_environments},
                 {"listed", MO_POPULATION_MAX, NULL, &record->n_listed},
                 {"generation", MO_GENERATIONS_MAX, &campaign->generation, NULL},
                 {"designs", MO_CAMPAIGN_DESIGNS_MAX, (int64_t *)&campaign->n_designs, NULL}};
  const struct {
    const char *name;
    char *text;
    size_t size;
  } texts[] = {{"preset", record->preset, sizeof(record->preset)},
               {"name", record->name, sizeof(record->name)},
               {"environment_set", record->environment_set, sizeof(record->environment_set)}};
  for (size_t i = 0; i < sizeof(numbers) / sizeof(numbers[0]); i++)
    if (mo_json_is(key, numbers[i].name)) {
      if (numbers[i].whole != NULL)
        mo_json_integer(json, numbers[i].whole == (int64_t *)&campaign->n_designs ? 0 : -1,
                        numbers[i].max, numbers[i].whole);
      else
        mo_line_u32(json, numbers[i].max, numbers[i].count);
      return;
    }
  for (size_t i = 0; i < sizeof(texts) / sizeof(texts[0]); i++)
    if (mo_json_is(key, texts[i].name)) {
      mo_line_text(json, texts[i].text, texts[i].size);
      return;
    }
  int word = 0;
  uint32_t number = 0;
  if (mo_json_is(key, "source")) {
    read_source(json, &campaign->source);
  } else if (mo_json_is(key, "group")) {
    read_id(json, &record->group);
  } else if (mo_json_is(key, "state")) {
    mo_line_word(json, mo_job_state_words, &word);
    campaign->state = (enum mo_job_state)word;
  } else if (mo_json_is(key, "end")) {
    mo_line_u32(json, MO_CAMPAIGN_EXHAUSTED, &number);
    campaign->end = (enum mo_campaign_end)number;
  } else if (mo_json_is(key, "back_end")) {
    mo_line_u32(json, MO_ON_DEVICE, &number);
    campaign->back_end = (enum mo_back_end)number;
  } else if (mo_json_is(key, "label") && mo_json_peek(json) == MO_JSON_STRING) {
    read_words(json, campaign->label, sizeof(campaign->label));
    campaign->has_label = true;
  } else if (mo_json_is(key, "experiment") && mo_json_peek(json) == MO_JSON_STRING) {
    read_words(json, campaign->experiment, sizeof(campaign->experiment));
  } else if (mo_json_is(key, "note") && mo_json_peek(json) == MO_JSON_STRING) {
    read_words(json, campaign->note, sizeof(campaign->note));
  } else if (mo_json_is(key, "weight")) {
    mo_json_bounded(json, MO_WEIGHT_MIN, MO_WEIGHT_MAX, &campaign->weight);
  } else if (mo_json_is(key, "controller")) {
    read_controller(json, &campaign->has_controller, campaign->controller_name,
                    sizeof(campaign->controller_name), &campaign->controller_sha256);
  } else if (mo_json_is(key, "result")) {
    read_controller(json, &campaign->has_result, NULL, 0, &campaign->result_sha256);
  } else if (mo_json_is(key, "diversity_max")) {
    mo_json_bounded(json, 0, 1, &campaign->diversity_max);
  } else if (mo_json_is(key, "settings")) {
    read_settings(json, record);
  } else {
    mo_json_skip(json); /* the hash of the physics is compared below */
  }
}

static int check_campaign(const struct mo_imported_campaign *campaign, struct mo_message *message)
{
  const struct mo_campaign_record *record = &campaign->record;
  const uint32_t generations = record->settings.generations;
  if (campaign->state != MO_JOB_SUCCEEDED && campaign->state != MO_JOB_CANCELLED)
    return mo_fail(message, MO_ERR_FORMAT, "/state: a campaign that has ended is expected");
  if ((campaign->state == MO_JOB_SUCCEEDED) != (campaign->end != MO_CAMPAIGN_OPEN))
    return mo_fail(message, MO_ERR_FORMAT, "/end: disagrees with the state");
  if (record->replicates < 1 || record->replicate >= record->replicates)
    return mo_fail(message, MO_ERR_FORMAT, "/replicate: must be below the number of replicates");
  if (record->n_environments < 1 || record->n_listed > record->settings.population)
    return mo_fail(message, MO_ERR_FORMAT, "/environments, /listed: too few or too many");
  if (campaign->generation > generations ||
      (campaign->generation < 0) != (campaign->n_designs == 0))
    return mo_fail(message, MO_ERR_FORMAT, "/generation: disagrees with settings or designs");
  if (mo_word_index(mo_preset_words, record->preset) < 0 && record->preset[0] != '\0')
    return mo_fail(message, MO_ERR_FORMAT, "/preset: no such preset");
  if ((record->name[0] != '\0' && mo_controller_name_check(record->name) != MO_OK) ||
      (campaign->controller_name[0] != '\0' &&
       mo_controller_name_check(campaign->controller_name) != MO_OK))
    return mo_fail(message, MO_ERR_FORMAT, "/name: not a name of a controller");
  if (record->settings.mode == MO_STUDY)
    return mo_fail(message, MO_ERR_FORMAT, "/settings/mode: studies are not in bundles");
  if (!campaign->has_controller && record->settings.mode != MO_SIMULTANEOUS)
    return mo_fail(message, MO_ERR_FORMAT, "/controller: this mode has one");
  if (campaign->created_us < 0 || campaign->started_us < 0 || campaign->finished_us < 0)
    return mo_fail(message, MO_ERR_FORMAT, "a time is out of bounds");
  return MO_OK;
}

int mo_bundle_read_campaign(struct mo_bundle_lines *lines, const char *line, size_t size,
                            struct mo_imported_campaign *campaign, struct mo_message *message)
{
  struct mo_json *json = mo_line_begin(lines, line, size);
  struct mo_json_slice key;
  memset(campaign, 0, sizeof(*campaign));
  if (mo_json_object(json))
    while (mo_json_member(json, &key))
      read_campaign_member(json, key, campaign);
  int error = mo_line_end(lines, message);
  if (error == MO_OK)
    error = check_campaign(campaign, message);
  if (error != MO_OK)
    return error;
  mo_bundle_write_campaign(&lines->again, campaign);
  return mo_line_compare(lines, line, size, message);
}

/* ---- evaluations with recordings ---- */

static void read_evaluation_member(struct mo_json *json, struct mo_json_slice key,
                                   struct mo_imported_evaluation *evaluation)
{
  const bool is_text = mo_json_peek(json) == MO_JSON_STRING;
  uint32_t number = 0;
  if (mo_json_is(key, "source"))
    read_source(json, &evaluation->source);
  else if (mo_json_is(key, "label") && is_text)
    read_words(json, evaluation->label, sizeof(evaluation->label));
  else if (mo_json_is(key, "experiment") && is_text)
    read_words(json, evaluation->experiment, sizeof(evaluation->experiment));
  else if (mo_json_is(key, "note") && is_text)
    read_words(json, evaluation->note, sizeof(evaluation->note));
  else if (mo_json_is(key, "back_end"))
    mo_line_u32(json, MO_ON_DEVICE, &number);
  else if (mo_json_is(key, "created_us"))
    mo_json_integer(json, 0, INT64_MAX, &evaluation->created_us);
  else if (mo_json_is(key, "started_us"))
    mo_json_integer(json, 0, INT64_MAX, &evaluation->started_us);
  else if (mo_json_is(key, "finished_us"))
    mo_json_integer(json, 0, INT64_MAX, &evaluation->finished_us);
  else if (mo_json_is(key, "controller"))
    mo_line_text(json, evaluation->controller_name, sizeof(evaluation->controller_name));
  else if (mo_json_is(key, "environment_set"))
    mo_line_text(json, evaluation->environment_set, sizeof(evaluation->environment_set));
  else if (mo_json_is(key, "class"))
    mo_line_text(json, evaluation->fingerprint, sizeof(evaluation->fingerprint));
  else if (mo_json_is(key, "workers_class"))
    mo_line_text(json, evaluation->workers, sizeof(evaluation->workers));
  else if (mo_json_is(key, "record"))
    mo_line_u32(json, (1 << MO_CHANNELS) - 1, &evaluation->record);
  else if (mo_json_is(key, "stride"))
    mo_line_u32(json, UINT32_MAX, &evaluation->stride);
  else if (mo_json_is(key, "environments"))
    mo_line_u32s(json, MO_ENVIRONMENTS_MAX - 1, evaluation->environments, MO_ENVIRONMENTS_MAX,
                 &evaluation->n_environments);
  else if (mo_json_is(key, "numbers"))
    mo_line_u32s(json, UINT32_MAX - 1, evaluation->numbers, MO_DESIGNS_MAX, &evaluation->n_designs);
  else
    mo_json_skip(json);
  if (mo_json_is(key, "label"))
    evaluation->has_label = is_text;
  if (mo_json_is(key, "back_end"))
    evaluation->back_end = (enum mo_back_end)number;
}

static int check_evaluation(const struct mo_imported_evaluation *evaluation,
                            struct mo_message *message)
{
  if (evaluation->n_designs < 1 || evaluation->n_designs > MO_DESIGNS_MAX ||
      evaluation->n_environments < 1 || evaluation->n_environments > MO_ENVIRONMENTS_MAX)
    return mo_fail(message, MO_ERR_FORMAT, "/numbers, /environments: too few or too many");
  if (evaluation->record == 0 || evaluation->stride == 0)
    return mo_fail(message, MO_ERR_FORMAT, "/record, /stride: nothing was recorded");
  if (evaluation->fingerprint[0] == '\0' || !mo_line_is_printable(evaluation->fingerprint) ||
      !mo_line_is_printable(evaluation->workers))
    return mo_fail(message, MO_ERR_FORMAT, "the classes must be printable");
  if (evaluation->controller_name[0] != '\0' &&
      mo_controller_name_check(evaluation->controller_name) != MO_OK)
    return mo_fail(message, MO_ERR_FORMAT, "/controller: not a name of a controller");
  return MO_OK;
}

int mo_bundle_read_evaluation(struct mo_bundle_lines *lines, const char *line, size_t size,
                              struct mo_imported_evaluation *evaluation, struct mo_message *message)
{
  struct mo_json *json = mo_line_begin(lines, line, size);
  struct mo_json_slice key;
  char source[64];
  memset(evaluation, 0, sizeof(*evaluation));
  if (mo_json_object(json))
    while (mo_json_member(json, &key))
      read_evaluation_member(json, key, evaluation);
  int error = mo_line_end(lines, message);
  if (error == MO_OK)
    error = check_evaluation(evaluation, message);
  if (error != MO_OK)
    return error;
  snprintf(source, sizeof(source), "evaluation %016llx %lld",
           (unsigned long long)evaluation->source.store, (long long)evaluation->source.job);
  mo_sha256_of(source, strlen(source), &evaluation->source.digest);
  mo_bundle_write_evaluation(&lines->again, evaluation);
  return mo_line_compare(lines, line, size, message);
}

/* ---- controllers ---- */

int mo_bundle_read_weights(const struct mo_archive_member *member,
                           struct mo_controller **controller, struct mo_message *message)
{
  struct mo_message words = {""};
  char name[MO_ARCHIVE_NAME_BYTES];
  mo_bundle_weights_name(&member->sha256, name);
  if (strcmp(name, member->name) != 0)
    return mo_archive_refuse(member, 0, "the name is not the hash of the file", message);
  const int error =
      mo_controller_decode((const uint8_t *)member->bytes, member->size, controller, &words);
  return error == MO_OK || error == MO_ERR_NO_MEMORY
             ? error
             : mo_archive_refuse(member, 0, words.text, message);
}

void mo_bundle_weights_name(const struct mo_sha256 *sha256, char name[MO_ARCHIVE_NAME_BYTES])
{
  char digits[MO_SHA256_DIGITS + 1];
  mo_sha256_to_hex(sha256, digits);
  snprintf(name, MO_ARCHIVE_NAME_BYTES, "controllers/%s.safetensors", digits);
}
