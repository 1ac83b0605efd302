/* bundle_lines.c: the lines of a bundle, written and read. A line that was read is written again
 * and compared: so there is one form of every value, and no member that is not known. What a line
 * says of itself is checked here; what lines say of each other, in bundle_read.c. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/bundle.h"
#include "api/columns.h"
#include "api/job_json.h"
#include "api/scene.h"
#include "base/json.h"
#include "base/words.h"
#include "store/fields.h"
#include "store/store.h"

#define PATH_BYTES 128

/* ---- writing ---- */

/* Numbers that are not finite are null: of losses and scores, diverged. */
static void write_doubles(struct mo_text *text, const char *name, const double *numbers, uint32_t n)
{
  mo_member_numbers(text, name, numbers, n);
}

static void write_counts(struct mo_text *text, const char *name, const uint32_t *numbers,
                         uint32_t n)
{
  mo_text_name(text, name);
  mo_text_add(text, "[");
  for (uint32_t i = 0; i < n; i++)
    mo_text_format(text, i > 0 ? ",%u" : "%u", numbers[i]);
  mo_text_add(text, "]");
}

static void write_whole(struct mo_text *text, const char *name, int64_t number)
{
  mo_text_name(text, name);
  mo_text_format(text, "%lld", (long long)number);
}

void mo_bundle_write_campaign(struct mo_text *text, const struct mo_imported_campaign *campaign)
{
  const struct mo_campaign_record *record = &campaign->record;
  struct mo_sha256 physics;
  mo_physics_hash(&record->settings.physics, MO_FLOAT32, record->settings.sensor, &physics);
  mo_text_add(text, "{\"source\":{");
  mo_text_name(text, "store");
  mo_text_format(text, "\"%016llx\"", (unsigned long long)campaign->source.store);
  mo_text_member_id(text, "campaign", campaign->source.campaign);
  mo_text_add(text, "}");
  mo_text_member_id(text, "group", record->group);
  write_whole(text, "replicate", record->replicate);
  write_whole(text, "replicates", record->replicates);
  mo_text_member(text, "state", mo_job_state_name(campaign->state));
  write_whole(text, "end", campaign->end);
  mo_text_member(text, "label", campaign->has_label ? campaign->label : NULL);
  mo_text_member_number(text, "weight", campaign->weight);
  write_whole(text, "back_end", campaign->back_end);
  write_whole(text, "created_us", campaign->created_us);
  write_whole(text, "started_us", campaign->started_us);
  write_whole(text, "finished_us", campaign->finished_us);
  mo_text_member(text, "preset", record->preset);
  mo_text_member(text, "name", record->name);
  mo_member_controller(text, "controller", campaign->has_controller, campaign->controller_name,
                       &campaign->controller_sha256);
  mo_member_controller(text, "result", campaign->has_result, "", &campaign->result_sha256);
  mo_text_member(text, "environment_set", record->environment_set);
  write_whole(text, "environments", record->n_environments);
  write_whole(text, "listed", record->n_listed);
  write_whole(text, "generation", campaign->generation);
  write_whole(text, "designs", (int64_t)campaign->n_designs);
  mo_text_member_number(text, "diversity_max", campaign->diversity_max);
  mo_member_hash(text, "physics_sha256", &physics);
  mo_text_name(text, "settings");
  mo_settings_write(MO_JOB_CAMPAIGN, record, text);
  mo_text_add(text, "}");
}

void mo_bundle_write_design(struct mo_text *text, const struct mo_campaign_design *design)
{
  mo_text_add(text, "{");
  mo_campaign_json_design(text, design, NULL);
  mo_text_add(text, "}");
}

void mo_bundle_write_generation(struct mo_text *text, const struct mo_campaign_generation *row,
                                const struct mo_campaign_member *members, uint32_t n)
{
  mo_text_add(text, "{");
  mo_columns_members(text, &mo_generation_columns, row);
  write_whole(text, "stored_us", row->stored_us);
  mo_text_name(text, "numbers");
  mo_text_add(text, "[");
  for (uint32_t i = 0; i < n; i++)
    mo_text_format(text, i > 0 ? ",%u" : "%u", members[i].number);
  mo_text_add(text, "]");
  mo_text_name(text, "scores");
  mo_text_add(text, "[");
  for (uint32_t i = 0; i < n; i++) {
    mo_text_add(text, i > 0 ? "," : "");
    mo_text_json_number(text, members[i].score);
  }
  mo_text_add(text, "]}");
}

void mo_bundle_write_step(struct mo_text *text, const struct mo_campaign_step *step)
{
  mo_text_add(text, "{");
  mo_columns_members(text, &mo_campaign_step_columns, step);
  write_whole(text, "training_step", step->report.step);
  mo_text_add(text, "}");
}

void mo_bundle_write_score(struct mo_text *text, const struct mo_campaign_score *score)
{
  mo_text_add(text, "{");
  write_whole(text, "number", score->number);
  mo_text_member(text, "class", score->fingerprint);
  mo_text_member(text, "origin", score->origin);
  write_whole(text, "computed_us", score->computed_us);
  write_counts(text, "environments", score->environments, score->n);
  write_doubles(text, "losses", score->losses, score->n);
  write_counts(text, "diverged_steps", score->diverged_steps, score->n);
  mo_text_add(text, "}");
}

/* ---- reading ---- */

struct mo_bundle_lines {
  const struct mo_lattice *lattice;
  bool is_checked; /* the lines were read before, and need not be compared */
  struct mo_faults faults;
  struct mo_text again; /* the line, written again */
  struct mo_json json;
};

struct mo_bundle_lines *mo_bundle_lines_create(const struct mo_lattice *lattice, bool is_checked)
{
  struct mo_bundle_lines *lines = calloc(1, sizeof(*lines));
  if (lines != NULL) {
    lines->lattice = lattice;
    lines->is_checked = is_checked;
  }
  return lines;
}

void mo_bundle_lines_free(struct mo_bundle_lines *lines)
{
  if (lines != NULL)
    mo_text_free(&lines->again);
  free(lines);
}

static struct mo_json *begin(struct mo_bundle_lines *lines, const char *line, size_t size)
{
  lines->faults = (struct mo_faults){0};
  lines->again.size = 0;
  mo_json_start(&lines->json, line, size, &lines->faults);
  return &lines->json;
}

/* Tells the first fault of what was read. */
static int check_faults(struct mo_bundle_lines *lines, struct mo_message *message)
{
  const struct mo_faults *faults = &lines->faults;
  if (mo_json_finish(&lines->json) && faults->n == 0)
    return MO_OK;
  return mo_fail(message, MO_ERR_FORMAT, "%s%s%s", faults->n > 0 ? faults->items[0].where : "",
                 faults->n > 0 && faults->items[0].where[0] != '\0' ? ": " : "",
                 faults->n > 0 ? faults->items[0].detail : "not a line of a bundle");
}

/* Compares the line with what was written again. */
static int compare(struct mo_bundle_lines *lines, const char *line, size_t size,
                   struct mo_message *message)
{
  const struct mo_text *again = &lines->again;
  size_t same = 0;
  if (again->failed)
    return MO_ERR_NO_MEMORY;
  if (again->size == size && memcmp(again->data, line, size) == 0)
    return MO_OK;
  while (same < size && same < again->size && again->data[same] == line[same])
    same++;
  return mo_fail(message, MO_ERR_FORMAT,
                 "column %zu: \"%.20s\" is not how a bundle writes this: \"%.20s\"", same + 1,
                 line + same, same < again->size ? again->data + same : "");
}

/* Says what is wrong with the value that was read. */
static void refuse(struct mo_json *json, const char *words)
{
  mo_json_fault(json, "%s", words);
}

static void read_u32(struct mo_json *json, int64_t max, uint32_t *value)
{
  int64_t number = 0;
  if (mo_json_integer(json, 0, max, &number))
    *value = (uint32_t)number;
}

/* Reads a number; null is `missing`. */
static void read_double(struct mo_json *json, double missing, double *value)
{
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    *value = missing;
  } else {
    mo_json_number(json, value);
  }
}

static void read_text(struct mo_json *json, char *text, size_t size)
{
  struct mo_json_slice slice;
  if (!mo_json_string(json, &slice))
    return;
  if (slice.size >= size || memchr(slice.bytes, 0, slice.size) != NULL) {
    refuse(json, "the text is too long, or has a NUL");
    return;
  }
  memcpy(text, slice.bytes, slice.size);
  text[slice.size] = '\0';
}

static void read_hash(struct mo_json *json, struct mo_sha256 *sha256)
{
  struct mo_json_slice slice;
  if (mo_json_string(json, &slice) && mo_sha256_from_hex(slice.bytes, slice.size, sha256) != MO_OK)
    refuse(json, "64 hexadecimal digits are expected");
}

static void read_id(struct mo_json *json, int64_t *id)
{
  char digits[24] = "";
  char *end = NULL;
  read_text(json, digits, sizeof(digits));
  *id = strtoll(digits, &end, 10);
  if (*id < 1 || *end != '\0')
    refuse(json, "an id is expected");
}

static void read_word(struct mo_json *json, const char *const *words, int *word)
{
  char text[32] = "";
  read_text(json, text, sizeof(text));
  *word = mo_word_index(words, text);
  if (*word < 0) {
    refuse(json, "no such word");
    *word = 0;
  }
}

/* ---- rows of numbers ---- */

static void read_cell(struct mo_json *json, const struct mo_column *column, void *row)
{
  void *at = (char *)row + column->offset;
  int64_t number = 0;
  switch (column->type) {
  case MO_COLUMN_COUNT: read_u32(json, UINT32_MAX, at); break;
  case MO_COLUMN_LONG:
    if (mo_json_integer(json, 0, INT64_MAX, &number))
      *(uint64_t *)at = (uint64_t)number;
    break;
  case MO_COLUMN_NUMBER: read_double(json, (double)NAN, at); break;
  case MO_COLUMN_FLAG: mo_json_bool(json, at); break;
  case MO_COLUMN_WORD: {
    const char *const words[] = {column->words[0], column->words[1], NULL};
    int word = 0;
    read_word(json, words, &word);
    *(bool *)at = word == 1;
    break;
  }
  case MO_COLUMN_TIME: mo_json_skip(json); break;
  }
}

/* Reads the value at a path of the columns, and what is below it. */
static void read_columns(struct mo_json *json, const struct mo_columns *columns, void *row,
                         char path[PATH_BYTES], size_t size)
{
  struct mo_json_slice key;
  path[size] = '\0';
  for (size_t i = 0; i < columns->n; i++)
    if (strcmp(columns->items[i].path, path) == 0) {
      read_cell(json, &columns->items[i], row);
      return;
    }
  if (mo_json_peek(json) != MO_JSON_OBJECT) {
    refuse(json, "no such member");
    mo_json_skip(json);
    return;
  }
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (size + key.size + 2 > PATH_BYTES) {
        mo_json_skip(json);
        continue;
      }
      path[size] = '.';
      memcpy(path + size + 1, key.bytes, key.size);
      read_columns(json, columns, row, path, size + 1 + key.size);
    }
}

/* Reads the member whose key was read. */
static void read_member(struct mo_json *json, struct mo_json_slice key,
                        const struct mo_columns *columns, void *row)
{
  char path[PATH_BYTES];
  if (key.size + 1 > PATH_BYTES) {
    refuse(json, "no such member");
    mo_json_skip(json);
    return;
  }
  memcpy(path, key.bytes, key.size);
  read_columns(json, columns, row, path, key.size);
}

int mo_bundle_read_step(struct mo_bundle_lines *lines, const char *line, size_t size,
                        struct mo_campaign_step *step, struct mo_message *message)
{
  struct mo_json *json = begin(lines, line, size);
  struct mo_json_slice key;
  memset(step, 0, sizeof(*step));
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "training_step"))
        read_u32(json, UINT32_MAX, &step->report.step);
      else
        read_member(json, key, &mo_campaign_step_columns, step);
    }
  const int error = check_faults(lines, message);
  if (error != MO_OK || lines->is_checked)
    return error;
  mo_bundle_write_step(&lines->again, step);
  return compare(lines, line, size, message);
}

int mo_bundle_read_generation(struct mo_bundle_lines *lines, const char *line, size_t size,
                              struct mo_campaign_generation *row,
                              struct mo_campaign_member *members, uint32_t room, uint32_t *n,
                              struct mo_message *message)
{
  struct mo_json *json = begin(lines, line, size);
  struct mo_json_slice key;
  uint32_t n_scores = 0;
  memset(row, 0, sizeof(*row));
  *n = 0;
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "stored_us")) {
        mo_json_integer(json, 0, INT64_MAX, &row->stored_us);
      } else if (mo_json_is(key, "numbers") && mo_json_array(json)) {
        while (mo_json_item(json))
          if (*n < room)
            read_u32(json, UINT32_MAX - 1, &members[(*n)++].number);
          else
            mo_json_skip(json);
      } else if (mo_json_is(key, "scores") && mo_json_array(json)) {
        while (mo_json_item(json))
          if (n_scores < room)
            read_double(json, (double)INFINITY, &members[n_scores++].score);
          else
            mo_json_skip(json);
      } else if (!mo_json_is(key, "numbers") && !mo_json_is(key, "scores")) {
        read_member(json, key, &mo_generation_columns, row);
      }
    }
  const int error = check_faults(lines, message);
  if (error == MO_OK && *n != n_scores)
    return mo_fail(message, MO_ERR_FORMAT, "numbers and scores differ in length");
  if (error != MO_OK || lines->is_checked)
    return error;
  mo_bundle_write_generation(&lines->again, row, members, *n);
  return compare(lines, line, size, message);
}

/* ---- environments and designs ---- */

int mo_bundle_read_environment(struct mo_bundle_lines *lines, const char *line, size_t size,
                               struct mo_environment *environment, struct mo_message *message)
{
  struct mo_json *json = begin(lines, line, size);
  struct mo_json_slice key;
  memset(environment, 0, sizeof(*environment));
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      const bool is_light = mo_json_is(key, "light_xy_m");
      double *numbers = is_light ? environment->light_xy_m : environment->terrain_heights_m;
      if ((is_light || mo_json_is(key, "terrain_heights_m")) && mo_json_array(json))
        for (uint32_t i = 0; mo_json_item(json); i++)
          if (i < (is_light ? 2U : MO_TERRAIN_HEIGHTS))
            mo_json_number(json, &numbers[i]);
          else
            mo_json_skip(json);
      else
        mo_json_skip(json); /* the hash is compared below */
    }
  uint32_t where;
  const int error = check_faults(lines, message);
  if (error == MO_OK && mo_environment_check(environment, &where) != MO_OK)
    return mo_fail(message, MO_ERR_FORMAT, "number %u is out of bounds", where);
  mo_scene_write_environment(&lines->again, NULL, environment);
  return error == MO_OK ? compare(lines, line, size, message) : error;
}

static void read_genotype(struct mo_json *json, struct mo_campaign_design *design)
{
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  struct mo_json_slice slice;
  struct mo_bits placed;
  if (!mo_json_string(json, &slice))
    return;
  if (mo_genotype_from_text(workspace, slice.bytes, slice.size, design->genotype.words, NULL) !=
      MO_OK) {
    refuse(json, "144 digits 0 and 1 are expected, of a body in one piece");
    return;
  }
  placed = design->genotype;
  mo_genotype_place(workspace, placed.words);
  if (memcmp(&placed, &design->genotype, sizeof(placed)) != 0)
    refuse(json, "the body is not placed in the middle of the ground");
}

static void read_parents(struct mo_json *json, struct mo_descent *descent)
{
  descent->parents[0] = descent->parents[1] = MO_NO_PARENT;
  if (!mo_json_array(json))
    return;
  for (int i = 0; mo_json_item(json); i++)
    if (i < 2)
      read_u32(json, UINT32_MAX - 1, &descent->parents[i]);
    else
      mo_json_skip(json);
}

int mo_bundle_read_design(struct mo_bundle_lines *lines, const char *line, size_t size,
                          struct mo_campaign_design *design, struct mo_message *message)
{
  struct mo_json *json = begin(lines, line, size);
  struct mo_json_slice key;
  int op = 0;
  memset(design, 0, sizeof(*design));
  design->died = -1;
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "number"))
        read_u32(json, UINT32_MAX - 1, &design->number);
      else if (mo_json_is(key, "genotype"))
        read_genotype(json, design);
      else if (mo_json_is(key, "parents"))
        read_parents(json, &design->descent);
      else if (mo_json_is(key, "operator"))
        read_word(json, mo_operator_words, &op);
      else if (mo_json_is(key, "born"))
        read_u32(json, MO_GENERATIONS_MAX, &design->born);
      else if (mo_json_is(key, "died") && mo_json_peek(json) == MO_JSON_NUMBER)
        mo_json_integer(json, 0, MO_GENERATIONS_MAX, &design->died);
      else if (mo_json_is(key, "score"))
        read_double(json, (double)INFINITY, &design->score);
      else
        mo_json_skip(json); /* follows from the genotype, and is compared below */
    }
  int error = check_faults(lines, message);
  design->descent.op = (uint8_t)op;
  if (error == MO_OK)
    error = mo_design_size(lines->lattice, design->genotype.words, &design->size);
  if (error != MO_OK)
    return error;
  mo_genotype_canonical(MO_DEFAULT_WORKSPACE, design->genotype.words, design->form.words);
  if (lines->is_checked)
    return MO_OK;
  mo_bundle_write_design(&lines->again, design);
  return compare(lines, line, size, message);
}

/* ---- scores ---- */

static bool is_printable(const char *text)
{
  for (; *text != '\0'; text++)
    if (*text < ' ' || *text > '~')
      return false;
  return true;
}

static int check_score(const struct mo_campaign_score *score, const uint32_t n[3],
                       struct mo_message *message)
{
  if (n[0] < 1 || n[0] > MO_BLOCK_LANES || n[1] != n[0] || n[2] != n[0])
    return mo_fail(message, MO_ERR_FORMAT, "1 to %d environments with as many losses and steps",
                   MO_BLOCK_LANES);
  if (score->fingerprint[0] == '\0' || !is_printable(score->fingerprint) ||
      score->origin[0] == '\0' || !is_printable(score->origin))
    return mo_fail(message, MO_ERR_FORMAT, "class and origin must be printable");
  for (uint32_t k = 0; k < n[0]; k++)
    if (score->losses[k] < 0 || isfinite(score->losses[k]) != (score->diverged_steps[k] == 0))
      return mo_fail(message, MO_ERR_FORMAT, "loss %u is none, or disagrees with its step", k);
  return MO_OK;
}

/* Reads up to MO_BLOCK_LANES numbers, and counts all. */
static void read_counts(struct mo_json *json, uint32_t *numbers, uint32_t *n)
{
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json))
    if ((*n)++ < MO_BLOCK_LANES)
      read_u32(json, UINT32_MAX >> 1, &numbers[*n - 1]);
    else
      mo_json_skip(json);
}

int mo_bundle_read_score(struct mo_bundle_lines *lines, const char *line, size_t size,
                         struct mo_campaign_score *score, struct mo_message *message)
{
  struct mo_json *json = begin(lines, line, size);
  struct mo_json_slice key;
  uint32_t n[3] = {0};
  memset(score, 0, sizeof(*score));
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "number")) {
        read_u32(json, UINT32_MAX - 1, &score->number);
      } else if (mo_json_is(key, "class")) {
        read_text(json, score->fingerprint, sizeof(score->fingerprint));
      } else if (mo_json_is(key, "origin")) {
        read_text(json, score->origin, sizeof(score->origin));
      } else if (mo_json_is(key, "computed_us")) {
        mo_json_integer(json, 0, INT64_MAX, &score->computed_us);
      } else if (mo_json_is(key, "losses") && mo_json_array(json)) {
        while (mo_json_item(json))
          if (n[1]++ < MO_BLOCK_LANES)
            read_double(json, (double)INFINITY, &score->losses[n[1] - 1]);
          else
            mo_json_skip(json);
      } else {
        const bool is_place = mo_json_is(key, "environments");
        uint32_t *to = is_place ? score->environments : score->diverged_steps;
        read_counts(json, to, &n[is_place ? 0 : 2]);
      }
    }
  score->n = n[0] < MO_BLOCK_LANES ? n[0] : MO_BLOCK_LANES;
  int error = check_faults(lines, message);
  if (error == MO_OK)
    error = check_score(score, n, message);
  if (error != MO_OK || lines->is_checked)
    return error;
  mo_bundle_write_score(&lines->again, score);
  return compare(lines, line, size, message);
}

/* ---- campaigns ---- */

static void read_source(struct mo_json *json, struct mo_import_source *source)
{
  struct mo_json_slice key;
  char digits[24] = "";
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "store")) {
        read_text(json, digits, sizeof(digits));
        source->store = strtoull(digits, NULL, 16);
      } else if (mo_json_is(key, "campaign")) {
        read_id(json, &source->campaign);
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
        read_hash(json, sha256);
      else if (mo_json_is(key, "name") && name != NULL && mo_json_peek(json) == MO_JSON_STRING)
        read_text(json, name, size);
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
    refuse(json, "these are no settings of a campaign");
  else if (mo_campaign_settings_check(&record->settings, &words) != MO_OK)
    refuse(json, words.text);
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
        read_u32(json, numbers[i].max, numbers[i].count);
      return;
    }
  for (size_t i = 0; i < sizeof(texts) / sizeof(texts[0]); i++)
    if (mo_json_is(key, texts[i].name)) {
      read_text(json, texts[i].text, texts[i].size);
      return;
    }
  int word = 0;
  uint32_t number = 0;
  if (mo_json_is(key, "source")) {
    read_source(json, &campaign->source);
  } else if (mo_json_is(key, "group")) {
    read_id(json, &record->group);
  } else if (mo_json_is(key, "state")) {
    read_word(json, mo_job_state_words, &word);
    campaign->state = (enum mo_job_state)word;
  } else if (mo_json_is(key, "end")) {
    read_u32(json, MO_CAMPAIGN_EXHAUSTED, &number);
    campaign->end = (enum mo_campaign_end)number;
  } else if (mo_json_is(key, "back_end")) {
    read_u32(json, MO_ON_DEVICE, &number);
    campaign->back_end = (enum mo_back_end)number;
  } else if (mo_json_is(key, "label") && mo_json_peek(json) == MO_JSON_STRING) {
    read_text(json, campaign->label, sizeof(campaign->label));
    campaign->has_label = true;
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
  if (mo_utf8_length(campaign->label, strlen(campaign->label)) > 200 || campaign->created_us < 0 ||
      campaign->started_us < 0 || campaign->finished_us < 0)
    return mo_fail(message, MO_ERR_FORMAT, "/label or a time: out of bounds");
  return MO_OK;
}

int mo_bundle_read_campaign(struct mo_bundle_lines *lines, const char *line, size_t size,
                            struct mo_imported_campaign *campaign, struct mo_message *message)
{
  struct mo_json *json = begin(lines, line, size);
  struct mo_json_slice key;
  memset(campaign, 0, sizeof(*campaign));
  if (mo_json_object(json))
    while (mo_json_member(json, &key))
      read_campaign_member(json, key, campaign);
  int error = check_faults(lines, message);
  if (error == MO_OK)
    error = check_campaign(campaign, message);
  if (error != MO_OK)
    return error;
  mo_bundle_write_campaign(&lines->again, campaign);
  return compare(lines, line, size, message);
}
