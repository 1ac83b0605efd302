/* bundle_lines.c: writes and reads the lines of a bundle. Each line that is read is written again
 * and compared, so that every value has only one form and unknown members are rejected. Single
 * lines are checked here; bundle_campaign.c checks that they agree with each other. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/words.h"
#include "exchange/bundle_line.h"
#include "exchange/columns.h"
#include "exchange/values.h"
#include "store/store.h"
#include "world/environment.h"
#include "world/measures.h"
#include "world/task_json.h"

#define PATH_BYTES 128

/* ---- writing ---- */

void mo_bundle_write_design(struct mo_text *text, const struct mo_campaign_design *design)
{
  mo_text_add(text, "{");
  mo_campaign_json_design(text, design, NULL);
  if (design->n_measures > 0)
    mo_member_numbers(text, "measures", design->measures, design->n_measures);
  mo_text_add(text, "}");
}

static void write_held_out(struct mo_text *text, const struct mo_re_evaluated *held_out, uint32_t n)
{
  mo_text_open(text, "held_out", "[");
  for (uint32_t i = 0; i < n; i++) {
    mo_text_object(text);
    mo_text_member_count(text, "number", held_out[i].number);
    mo_text_member_number(text, "mean", held_out[i].mean);
    mo_text_member_number(text, "standard_error", held_out[i].standard_error);
    mo_text_member_count(text, "diverged", held_out[i].diverged);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

void mo_bundle_write_generation(struct mo_text *text, const struct mo_campaign_generation *row,
                                const struct mo_campaign_member *members, uint32_t n,
                                const struct mo_re_evaluated *held_out, uint32_t n_held_out)
{
  mo_text_add(text, "{");
  mo_columns_members(text, &mo_bundle_generation_columns, row);
  mo_text_member_count(text, "stored_us", (uint64_t)row->stored_us);
  mo_text_open(text, "numbers", "[");
  for (uint32_t i = 0; i < n; i++)
    mo_text_format(text, i > 0 ? ",%u" : "%u", members[i].number);
  mo_text_add(text, "]");
  mo_text_open(text, "scores", "[");
  for (uint32_t i = 0; i < n; i++) {
    mo_text_add(text, i > 0 ? "," : "");
    mo_text_json_number(text, members[i].score);
  }
  mo_text_add(text, "]");
  if (n_held_out > 0)
    write_held_out(text, held_out, n_held_out);
  mo_text_add(text, "}");
}

void mo_bundle_write_step(struct mo_text *text, const struct mo_campaign_step *step)
{
  mo_text_add(text, "{");
  mo_columns_members(text, &mo_campaign_step_columns, step);
  mo_text_member_count(text, "training_step", step->report.step);
  mo_text_add(text, "}");
}

/* ---- reading ---- */

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

struct mo_json *mo_line_begin(struct mo_bundle_lines *lines, const char *line, size_t size)
{
  lines->faults = (struct mo_faults){0};
  lines->again.size = 0;
  mo_json_start(&lines->json, line, size, &lines->faults);
  return &lines->json;
}

int mo_line_end(struct mo_bundle_lines *lines, struct mo_message *message)
{
  const struct mo_faults *faults = &lines->faults;
  if (mo_json_finish(&lines->json) && faults->n == 0)
    return MO_OK;
  return mo_fail(message, MO_ERR_FORMAT, "%s%s%s", faults->n > 0 ? faults->items[0].where : "",
                 faults->n > 0 && faults->items[0].where[0] != '\0' ? ": " : "",
                 faults->n > 0 ? faults->items[0].detail
                               : "the line does not match this kind of file");
}

int mo_line_compare(struct mo_bundle_lines *lines, const char *line, size_t size,
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
  return mo_fail(message, MO_ERR_FORMAT, "column %zu: got \"%.20s\", expected \"%.20s\"", same + 1,
                 line + same, same < again->size ? again->data + same : "");
}

int mo_line_read(struct mo_bundle_lines *lines, const char *line, size_t size,
                 const struct mo_fields *fields, void *value,
                 int (*check)(const void *value, struct mo_message *message),
                 struct mo_message *message)
{
  mo_fields_read(mo_line_begin(lines, line, size), fields, value);
  int error = mo_line_end(lines, message);
  if (error == MO_OK && check != NULL)
    error = check(value, message);
  if (error != MO_OK || lines->is_checked)
    return error;
  mo_fields_write_object(&lines->again, fields, value);
  return mo_line_compare(lines, line, size, message);
}

/* ---- members ---- */

void mo_line_skip(struct mo_json *json, void *value)
{
  (void)value;
  mo_json_skip(json);
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

/* Reads up to `room` numbers, with null as `missing`, and counts all of them. */
static void read_doubles(struct mo_json *json, double missing, double *numbers, uint32_t room,
                         uint32_t *n)
{
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json))
    if ((*n)++ < room)
      read_double(json, missing, &numbers[*n - 1]);
    else
      mo_json_skip(json);
}

void mo_line_text(struct mo_json *json, char *text, size_t size)
{
  struct mo_json_slice slice;
  if (!mo_json_string(json, &slice))
    return;
  if (slice.size >= size) {
    mo_json_fault(json, "the text is too long");
    return;
  }
  memcpy(text, slice.bytes, slice.size);
  text[slice.size] = '\0';
}

static void read_word(struct mo_json *json, const char *const *words, int *word)
{
  char text[32] = "";
  mo_line_text(json, text, sizeof(text));
  *word = mo_word_index(words, text);
  if (*word < 0) {
    mo_json_fault(json, "unknown word");
    *word = 0;
  }
}

static void read_store(struct mo_json *json, void *value)
{
  char digits[24] = "";
  mo_line_text(json, digits, sizeof(digits));
  *(uint64_t *)value = strtoull(digits, NULL, 16);
}

static void write_store(struct mo_text *text, const void *value)
{
  mo_text_format(text, "\"%016llx\"", (unsigned long long)*(const uint64_t *)value);
}
const struct mo_field_own mo_line_store = {.read = read_store, .write = write_store};

static void read_genotype(struct mo_json *json, void *value)
{
  struct mo_genotype *genotype = value, placed;
  struct mo_json_slice slice;
  if (!mo_json_string(json, &slice))
    return;
  genotype->workspace = MO_STORE_WORKSPACE;
  if (mo_genotype_from_text(genotype->workspace, slice.bytes, slice.size, genotype->words, NULL) !=
      MO_OK) {
    mo_json_fault(json, "expected 144 digits 0 or 1, of a body in one piece");
    return;
  }
  placed = *genotype;
  mo_genotype_place(placed.workspace, placed.words);
  if (!mo_genotype_equal(&placed, genotype))
    mo_json_fault(json, "the body is not centered on the ground");
}

static void write_genotype(struct mo_text *text, const void *genotype)
{
  mo_text_add(text, "\"");
  mo_genotype_write(text, genotype);
  mo_text_add(text, "\"");
}
const struct mo_field_own mo_line_genotype = {.read = read_genotype, .write = write_genotype};

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

/* Reads the value at a path of the columns, and the values below it. */
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
    mo_json_fault(json, "unknown member");
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

/* Reads the member of `key`. */
static void read_member(struct mo_json *json, struct mo_json_slice key,
                        const struct mo_columns *columns, void *row)
{
  char path[PATH_BYTES];
  if (key.size + 1 > PATH_BYTES) {
    mo_json_fault(json, "unknown member");
    mo_json_skip(json);
    return;
  }
  memcpy(path, key.bytes, key.size);
  read_columns(json, columns, row, path, key.size);
}

int mo_bundle_read_step(struct mo_bundle_lines *lines, const char *line, size_t size,
                        struct mo_campaign_step *step, struct mo_message *message)
{
  struct mo_json *json = mo_line_begin(lines, line, size);
  struct mo_json_slice key;
  memset(step, 0, sizeof(*step));
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "training_step"))
        read_u32(json, UINT32_MAX, &step->report.step);
      else
        read_member(json, key, &mo_campaign_step_columns, step);
    }
  const int error = mo_line_end(lines, message);
  if (error != MO_OK || lines->is_checked)
    return error;
  mo_bundle_write_step(&lines->again, step);
  return mo_line_compare(lines, line, size, message);
}

/* Reads the results of a re-evaluated generation. */
static void read_held_out(struct mo_json *json, struct mo_re_evaluated *held_out, uint32_t *n)
{
  struct mo_json_slice key;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    if (*n == MO_ELITE_MAX) {
      mo_json_fault(json, "too many designs");
      mo_json_skip(json);
      continue;
    }
    struct mo_re_evaluated *one = &held_out[(*n)++];
    *one = (struct mo_re_evaluated){.mean = NAN, .standard_error = NAN};
    if (mo_json_object(json))
      while (mo_json_member(json, &key)) {
        if (mo_json_is(key, "number"))
          read_u32(json, UINT32_MAX - 1, &one->number);
        else if (mo_json_is(key, "mean"))
          read_double(json, (double)NAN, &one->mean);
        else if (mo_json_is(key, "standard_error"))
          read_double(json, (double)NAN, &one->standard_error);
        else if (mo_json_is(key, "diverged"))
          read_u32(json, MO_CERTIFICATE_HELD_OUT_MAX, &one->diverged);
        else
          mo_json_skip(json); /* rejected when the line is compared */
      }
  }
}

int mo_bundle_read_generation(struct mo_bundle_lines *lines, const char *line, size_t size,
                              struct mo_campaign_generation *row,
                              struct mo_campaign_member *members, uint32_t room, uint32_t *n,
                              struct mo_re_evaluated *held_out, uint32_t *n_held_out,
                              struct mo_message *message)
{
  struct mo_json *json = mo_line_begin(lines, line, size);
  struct mo_json_slice key;
  uint32_t n_scores = 0;
  memset(row, 0, sizeof(*row));
  *n = *n_held_out = 0;
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "held_out")) {
        read_held_out(json, held_out, n_held_out);
      } else if (mo_json_is(key, "stored_us")) {
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
        read_member(json, key, &mo_bundle_generation_columns, row);
      }
    }
  const int error = mo_line_end(lines, message);
  if (error == MO_OK && *n != n_scores)
    return mo_fail(message, MO_ERR_FORMAT, "the arrays numbers and scores have different lengths");
  if (error != MO_OK || lines->is_checked)
    return error;
  mo_bundle_write_generation(&lines->again, row, members, *n, held_out, *n_held_out);
  return mo_line_compare(lines, line, size, message);
}

/* ---- environments and designs ---- */

int mo_bundle_read_environment(struct mo_bundle_lines *lines, const char *line, size_t size,
                               struct mo_environment *environment, struct mo_message *message)
{
  struct mo_json *json = mo_line_begin(lines, line, size);
  struct mo_json_slice key;
  *environment = mo_environment_defaults;
  if (mo_json_object(json))
    while (mo_json_member(json, &key))
      if (!mo_environment_read_member(json, key, environment))
        mo_json_skip(json); /* the hash is compared below */
  const int error = mo_line_end(lines, message);
  mo_environment_write(&lines->again, environment);
  return error == MO_OK ? mo_line_compare(lines, line, size, message) : error;
}

int mo_bundle_read_design(struct mo_bundle_lines *lines, const char *line, size_t size,
                          struct mo_campaign_design *design, struct mo_message *message)
{
  struct mo_json *json = mo_line_begin(lines, line, size);
  struct mo_json_slice key;
  uint32_t n_parents = 0;
  int op = 0;
  memset(design, 0, sizeof(*design));
  design->died = -1;
  design->descent.parents[0] = design->descent.parents[1] = MO_NO_PARENT;
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "number"))
        read_u32(json, UINT32_MAX - 1, &design->number);
      else if (mo_json_is(key, "genotype"))
        mo_line_genotype.read(json, &design->genotype);
      else if (mo_json_is(key, "parents"))
        mo_json_counts(json, UINT32_MAX - 1, design->descent.parents, 2, &n_parents);
      else if (mo_json_is(key, "operator"))
        read_word(json, mo_operator_words, &op);
      else if (mo_json_is(key, "born"))
        read_u32(json, MO_GENERATIONS_MAX, &design->born);
      else if (mo_json_is(key, "died") && mo_json_peek(json) == MO_JSON_NUMBER)
        mo_json_integer(json, 0, MO_GENERATIONS_MAX, &design->died);
      else if (mo_json_is(key, "score"))
        read_double(json, (double)INFINITY, &design->score);
      else if (mo_json_is(key, "lower_bound"))
        mo_json_bool(json, &design->is_cut);
      else if (mo_json_is(key, "measures"))
        read_doubles(json, (double)NAN, design->measures, MO_DESIGN_MEASURES_MAX,
                     &design->n_measures);
      else
        mo_json_skip(json); /* follows from the genotype, and is compared below */
    }
  int error = mo_line_end(lines, message);
  design->descent.op = (uint8_t)op;
  if (error == MO_OK)
    error = mo_design_size(lines->lattice, design->genotype.words, &design->size);
  if (error != MO_OK)
    return error;
  if (design->n_measures > MO_DESIGN_MEASURES_MAX)
    return mo_fail(message, MO_ERR_FORMAT, "too many measures");
  design->form = mo_genotype_form(&design->genotype);
  if (lines->is_checked)
    return MO_OK;
  mo_bundle_write_design(&lines->again, design);
  return mo_line_compare(lines, line, size, message);
}

/* ---- scores ---- */

#define AT(member) offsetof(struct mo_campaign_score, member)
static const struct mo_field score_rows[] = {
    {"number", MO_FIELD_COUNT, 0, AT(number), .max = UINT32_MAX - 1},
    {"class", MO_FIELD_TEXT, 0, AT(fingerprint), .min = 1, .max = MO_FINGERPRINT_BYTES - 1},
    {"origin", MO_FIELD_TEXT, 0, AT(origin), .min = 1, .max = MO_ORIGIN_BYTES - 1},
    {"computed_us", MO_FIELD_SEED, 0, AT(computed_us)},
};
#undef AT
static const struct mo_fields score_fields = MO_FIELDS(score_rows);

static void write_measures(struct mo_text *text, const struct mo_campaign_score *score)
{
  mo_text_open(text, "measures", "[");
  for (uint32_t k = 0; k < score->n; k++) {
    mo_text_next(text);
    mo_text_add(text, "[");
    for (unsigned m = 0; m < MO_MEASURES; m++) {
      mo_text_next(text);
      mo_text_json_number(text, score->measures[k][m]);
    }
    mo_text_add(text, "]");
  }
  mo_text_add(text, "]");
}

void mo_bundle_write_score(struct mo_text *text, const struct mo_campaign_score *score)
{
  mo_text_add(text, "{");
  mo_fields_write(text, &score_fields, score);
  mo_text_name(text, "environments");
  mo_text_counts(text, score->environments, score->n);
  mo_member_numbers(text, "losses", score->losses, score->n); /* null: diverged */
  mo_text_name(text, "diverged_steps");
  mo_text_counts(text, score->diverged_steps, score->n);
  if (score->measures != NULL)
    write_measures(text, score);
  mo_text_add(text, "}");
}

/* Reads the measures of up to MO_BLOCK_LANES rollouts, and counts all rollouts. */
static void read_measures(struct mo_json *json, double measures[MO_BLOCK_LANES][MO_MEASURES],
                          uint32_t *n, bool *are_whole)
{
  double ignored[MO_MEASURES];
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    uint32_t n_values = 0;
    read_doubles(json, (double)NAN, *n < MO_BLOCK_LANES ? measures[*n] : ignored, MO_MEASURES,
                 &n_values);
    *are_whole = *are_whole && n_values == MO_MEASURES;
    (*n)++;
  }
}

/* Checks that each measure is a whole number of its steps, and that diverged rollouts have none. */
static int check_measures(const struct mo_campaign_score *score, uint32_t n, bool are_whole,
                          struct mo_message *message)
{
  if (n != score->n || !are_whole)
    return mo_fail(message, MO_ERR_FORMAT, "must have all %d measures of each environment",
                   MO_MEASURES);
  for (uint32_t k = 0; k < n; k++)
    for (unsigned m = 0; m < MO_MEASURES; m++) {
      const double value = score->measures[k][m];
      if (!isnan(value) && (score->diverged_steps[k] > 0 || !mo_measure_is_round(m, value)))
        return mo_fail(message, MO_ERR_FORMAT,
                       "%s of rollout %u is not a multiple of its step, or the rollout diverged",
                       mo_measure_info[m].name, k);
    }
  return MO_OK;
}

static int check_score(const struct mo_campaign_score *score, const uint32_t n[3],
                       struct mo_message *message)
{
  if (n[0] < 1 || n[0] > MO_BLOCK_LANES || n[1] != n[0] || n[2] != n[0])
    return mo_fail(message, MO_ERR_FORMAT,
                   "must have 1 to %d environments, with one loss and step for each",
                   MO_BLOCK_LANES);
  for (uint32_t k = 0; k < n[0]; k++)
    if (score->losses[k] < 0 || isfinite(score->losses[k]) != (score->diverged_steps[k] == 0))
      return mo_fail(message, MO_ERR_FORMAT,
                     "loss %u is invalid, or contradicts its divergence step", k);
  return MO_OK;
}

int mo_bundle_read_score(struct mo_bundle_lines *lines, const char *line, size_t size,
                         struct mo_campaign_score *score, struct mo_message *message)
{
  struct mo_json *json = mo_line_begin(lines, line, size);
  struct mo_json_slice key;
  uint32_t n[3] = {0}, n_measured = 0;
  bool are_whole = true;
  memset(score, 0, sizeof(*score));
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "environments"))
        mo_json_counts(json, UINT32_MAX >> 1, score->environments, MO_BLOCK_LANES, &n[0]);
      else if (mo_json_is(key, "losses"))
        read_doubles(json, (double)INFINITY, score->losses, MO_BLOCK_LANES, &n[1]);
      else if (mo_json_is(key, "diverged_steps"))
        mo_json_counts(json, UINT32_MAX >> 1, score->diverged_steps, MO_BLOCK_LANES, &n[2]);
      else if (mo_json_is(key, "measures"))
        read_measures(json, score->measures = lines->measures, &n_measured, &are_whole);
      else if (!mo_fields_read_member(json, key, &score_fields, score))
        mo_json_skip(json);
    }
  score->n = n[0] < MO_BLOCK_LANES ? n[0] : MO_BLOCK_LANES;
  int error = mo_line_end(lines, message);
  if (error == MO_OK)
    error = check_score(score, n, message);
  if (error == MO_OK && score->measures != NULL)
    error = check_measures(score, n_measured, are_whole, message);
  if (error != MO_OK || lines->is_checked)
    return error;
  mo_bundle_write_score(&lines->again, score);
  return mo_line_compare(lines, line, size, message);
}
