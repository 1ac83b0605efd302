/* study_request.c: the bodies of POST …/tell and …/ask. Every fault has its JSON pointer: a voxel
 * out of bounds is at /children/3/body/cells/7/0. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"
#include "base/base64.h"
#include "store/designs.h"

/* ---- words ---- */

/* Finds a word in the batch's list, or adds it. Returns its place, or −1 after adding a fault. */
static int place_word(struct mo_json *json, struct mo_json_slice word, unsigned depth,
                      char words[][MO_STUDY_WORD_MAX + 1], uint32_t *n, uint32_t most)
{
  static const char letters[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_.-";
  char text[MO_STUDY_WORD_MAX + 1] = "";
  uint32_t i = 0;
  if (word.size <= MO_STUDY_WORD_MAX)
    memcpy(text, word.bytes, word.size);
  if (text[0] == '\0' || strspn(text, letters) != word.size) {
    mo_json_fault_at(json, depth, "",
                     "must be a word of 1 to %d of A-Z, a-z, 0-9, '_', '.' and '-'",
                     MO_STUDY_WORD_MAX);
    return -1;
  }
  while (i < *n && strcmp(words[i], text) != 0)
    i++;
  if (i == most) {
    mo_json_fault_at(json, depth, "", "there may be at most %u different words of this kind",
                     (unsigned)most);
    return -1;
  }
  if (i == *n)
    memcpy(words[(*n)++], text, sizeof(text));
  return (int)i;
}

/* ---- children ---- */

static void read_operator(struct mo_json *json, struct mo_study_words *words, uint8_t *op)
{
  const unsigned depth = json->depth;
  struct mo_json_slice word;
  if (!mo_json_string(json, &word))
    return;
  for (int i = 0; i < MO_OPERATORS; i++)
    if (mo_json_is(word, mo_operator_words[i])) {
      *op = (uint8_t)i;
      return;
    }
  int place =
      place_word(json, word, depth, words->operators, &words->n_operators, MO_STUDY_OPERATORS_MAX);
  if (place >= 0)
    *op = (uint8_t)(MO_OPERATORS + place);
}

static void read_parents(struct mo_json *json, uint32_t parents[2])
{
  const unsigned depth = json->depth;
  uint32_t n = 0;
  mo_json_counts(json, MO_NO_PARENT - 1, parents, 2, &n);
  if (n > 2)
    mo_json_fault_at(json, depth, "", "must be at most 2 parents, got %u", n);
}

/* Returns whether a measure of the set has this name. */
static bool is_taken(struct mo_json_slice name, uint32_t set)
{
  for (unsigned m = 0; m < MO_MEASURES; m++)
    if ((set >> m & 1) != 0 && mo_json_is(name, mo_measure_info[m].name))
      return true;
  return false;
}

/* taken: the measures that the service computes. measures: (MO_STUDY_MEASURES_MAX) */
static void read_measures(struct mo_json *json, uint32_t taken, struct mo_study_words *words,
                          double *measures)
{
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (is_taken(key, taken)) {
      mo_json_fault(json, "the service computes this measure in this study; leave it out, or give "
                          "your number another name");
      mo_json_skip(json);
      continue;
    }
    const int place = place_word(json, key, json->depth, words->measures, &words->n_measures,
                                 MO_STUDY_MEASURES_MAX);
    if (place < 0 || mo_json_peek(json) == MO_JSON_NULL)
      mo_json_skip(json);
    else
      mo_json_number(json, &measures[place]);
  }
}

/* Reads the client's own score of a child. Null leaves it missing, for a child that is skipped. */
static void read_score(struct mo_json *json, bool has_scores, double *score)
{
  double number = 0; /* kept if there is a fault, so that the score causes no second fault */
  if (!has_scores) {
    mo_json_fault(json, "this study has no own_score, so children cannot have a score");
    mo_json_skip(json);
  } else if (mo_json_peek(json) == MO_JSON_NULL)
    mo_json_skip(json);
  else {
    mo_json_bounded(json, -MO_OWN_SCORE_MAX, MO_OWN_SCORE_MAX, &number);
    *score = number + 0.0; /* not −0, so that equal scores have equal bits */
  }
}

/* Skips or refuses the child that was read last if its body does not fit the workspace. Returns
 * false if memory runs out. */
static bool fit(struct mo_json *json, struct mo_parsed_telling *parsed, uint32_t place)
{
  const struct mo_workspace w = parsed->workspace;
  struct mo_parts *parts = &parsed->parts;
  struct mo_bits *body = &parts->genotypes[parts->n_designs - 1];
  struct mo_design_note note = {.place = place};
  if (mo_genotype_count(MO_STORE_WORKSPACE, body->words) == 0)
    return true; /* it already has a fault */
  mo_genotype_place(MO_STORE_WORKSPACE, body->words);
  const struct mo_genotype placed = mo_genotype_of(MO_STORE_WORKSPACE, body);
  if (mo_fits_as_it_is(w, &placed))
    return true;
  snprintf(note.fault.where, sizeof(note.fault.where), "/children/%u/body", place);
  snprintf(note.fault.detail, sizeof(note.fault.detail),
           "the body does not fit the study's workspace, which has %u × %u × %u voxels; bodies are "
           "not rotated to fit",
           w.nx, w.ny, w.nz);
  if (parts->on_fault != MO_FAULT_SKIP) {
    mo_json_fault(json, "%s", note.fault.detail);
    return true;
  }
  if (parts->n_notes > 0 && parts->notes[parts->n_notes - 1].place == place)
    parts->n_notes--; /* discard its note: it was repaired, or given by its id */
  parts->n_designs--;
  return mo_parts_note(parts, &note);
}

/* Reads a child. *is_kept: it was not skipped. Returns false if memory runs out. */
static bool read_child(struct mo_json *json, struct mo_parsed_telling *parsed,
                       struct mo_study_child *child, double *measures, double *score, bool *is_kept)
{
  struct mo_study_words *words = &parsed->telling.words;
  const unsigned depth = json->depth;
  const uint32_t before = parsed->parts.n_designs;
  struct mo_json_slice key;
  bool has_body = false, memory = true;
  *is_kept = true;
  if (!mo_json_object(json))
    return true;
  while (memory && mo_json_member(json, &key)) {
    if (mo_json_is(key, "body")) {
      has_body = true;
      memory = mo_parts_design(json, &parsed->parts, child->place);
      if (memory && parsed->parts.n_designs > before)
        memory = fit(json, parsed, child->place);
    } else if (mo_json_is(key, "parents"))
      read_parents(json, child->descent.parents);
    else if (mo_json_is(key, "operator"))
      read_operator(json, words, &child->descent.op);
    else if (mo_json_is(key, "measures"))
      read_measures(json, parsed->measures, words, measures);
    else if (mo_json_is(key, "score"))
      read_score(json, parsed->has_scores, score);
    else
      mo_fields_unknown(json, "body, parents, operator, measures or score", NULL);
  }
  if (!json->stop && !has_body)
    mo_json_fault_at(json, depth, "", "body is missing; it must be a design");
  *is_kept = parsed->parts.n_designs > before;
  if (!json->stop && parsed->has_scores && *is_kept && isnan(*score))
    mo_json_fault_at(json, depth, "/score",
                     "score is missing; this study ranks by its own_score, so each child needs a "
                     "number");
  if (*is_kept)
    child->genotype = mo_genotype_of(MO_STORE_WORKSPACE, &parsed->parts.genotypes[before]);
  return memory;
}

static void read_children(struct mo_json *json, void *value)
{
  struct mo_parsed_telling *parsed = value;
  struct mo_study_batch *batch = &parsed->telling.batch;
  const unsigned depth = json->depth;
  uint32_t n = 0;
  parsed->has_children = true;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); n++) {
    if (n >= MO_DESIGNS_MAX) {
      mo_json_skip(json);
      continue;
    }
    struct mo_study_child *child =
        mo_next_item((void **)&batch->children, batch->n_children, sizeof(*child));
    double *measures = mo_next_item((void **)&batch->measures, batch->n_children,
                                    MO_STUDY_MEASURES_MAX * sizeof(*measures));
    double *score = mo_next_item((void **)&batch->scores, batch->n_children, sizeof(*score));
    bool memory = child != NULL && measures != NULL && score != NULL, is_kept = false;
    if (memory) {
      *child = (struct mo_study_child){.place = n,
                                       .descent = {{MO_NO_PARENT, MO_NO_PARENT}, MO_BORN_LISTED}};
      for (int m = 0; m < MO_STUDY_MEASURES_MAX; m++)
        measures[m] = NAN;
      *score = NAN;
      memory = read_child(json, parsed, child, measures, score, &is_kept);
    }
    if (!memory) {
      parsed->parts.error = MO_ERR_NO_MEMORY;
      json->stop = true;
      return;
    }
    batch->n_children += is_kept;
  }
  if (n > MO_DESIGNS_MAX)
    mo_json_fault_at(json, depth, "", "must be at most %d children, got %u", MO_DESIGNS_MAX, n);
}

/* Drops the space for scores if the study has no own score. In a study with one, even a batch
 * without children has scores. */
static int pack_scores(struct mo_study_batch *batch, bool has_scores)
{
  if (has_scores && batch->scores == NULL)
    batch->scores = calloc(1, sizeof(*batch->scores));
  if (has_scores)
    return batch->scores != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  free(batch->scores);
  batch->scores = NULL;
  return MO_OK;
}

/* Packs the measures: while they are read, each child has room for the largest number of measures.
 */
static void pack_measures(struct mo_study_batch *batch, uint32_t n_measures)
{
  batch->n_measures = n_measures;
  for (size_t i = 0; i < batch->n_children && n_measures > 0; i++)
    memmove(batch->measures + n_measures * i, batch->measures + MO_STUDY_MEASURES_MAX * i,
            n_measures * sizeof(*batch->measures));
}

/* ---- the other members ---- */

/* Reads numbers of designs (malloc). Returns false if memory runs out. */
static bool read_numbers(struct mo_json *json, uint32_t most, uint32_t **numbers, uint32_t *ret_n)
{
  const unsigned depth = json->depth;
  uint32_t n = 0;
  bool memory = true;
  if (!mo_json_array(json))
    return true;
  for (; mo_json_item(json); n++) {
    int64_t number = 0;
    uint32_t *item = n < most && memory ? mo_next_item((void **)numbers, n, sizeof(*item)) : NULL;
    memory = memory && (n >= most || item != NULL);
    if (item == NULL) {
      mo_json_skip(json);
    } else {
      mo_json_integer(json, 0, MO_NO_PARENT - 1, &number);
      *item = (uint32_t)number;
    }
  }
  if (n > most)
    mo_json_fault_at(json, depth, "", "must be at most %u numbers, got %u", most, n);
  *ret_n = n < most ? n : most;
  return memory;
}

static void read_survivors(struct mo_json *json, void *value)
{
  struct mo_parsed_telling *parsed = value;
  struct mo_study_batch *batch = &parsed->telling.batch;
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    return;
  }
  batch->selects = true;
  if (!read_numbers(json, MO_POPULATION_MAX, &batch->survivors, &batch->n_survivors))
    parsed->parts.error = MO_ERR_NO_MEMORY;
}

static void read_sampler(struct mo_json *json, void *value)
{
  struct mo_parsed_telling *parsed = value;
  const unsigned depth = json->depth;
  struct mo_json_slice text;
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    return;
  }
  if (!mo_json_text(json, &text))
    return;
  if (text.size / 4 * 3 > MO_SAMPLER_BYTES_MAX + 2) {
    mo_json_fault_at(json, depth, "", "must be at most %zu bytes", MO_SAMPLER_BYTES_MAX);
    return;
  }
  uint8_t *bytes = malloc(text.size / 4 * 3 + 1);
  if (bytes == NULL)
    parsed->parts.error = MO_ERR_NO_MEMORY;
  else if (!mo_base64_decode(text.bytes, text.size, bytes, &parsed->telling.sampler_size) ||
           parsed->telling.sampler_size == 0 || parsed->telling.sampler_size > MO_SAMPLER_BYTES_MAX)
    mo_json_fault_at(json, depth, "", "must be 1 to %zu bytes in Base64 with padding",
                     MO_SAMPLER_BYTES_MAX);
  parsed->telling.sampler = bytes;
}

#define AT(member) offsetof(struct mo_parsed_telling, member)
static const struct mo_field_own children = {.read = read_children},
                                 survivors = {.read = read_survivors},
                                 sampler = {.read = read_sampler};
static const struct mo_field rows[] = {
    {"batch", MO_FIELD_COUNT, 0, AT(telling.batch.number), .min = 0, .max = MO_GENERATIONS_MAX,
     .unit = "", .help = "number of the batch: 0, 1, …"},
    {"children", MO_FIELD_OWN, 0, 0, .own = &children},
    {"survivors", MO_FIELD_OWN, 0, 0, .own = &survivors},
    {"sampler_state", MO_FIELD_OWN, 0, 0, .own = &sampler},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_design_rules_fields},
};
#undef AT
const struct mo_fields mo_tell_fields = MO_FIELDS(rows);

static int check(struct mo_json *json, void *any)
{
  const struct mo_parsed_telling *parsed = any;
  if (parsed->telling.batch.number == UINT32_MAX)
    mo_json_fault_at(json, 0, "", "batch is missing; it must be the number of the next batch");
  if (!parsed->has_children)
    mo_json_fault_at(json, 0, "", "children is missing; it must be an array of at most %d children",
                     MO_DESIGNS_MAX);
  return MO_OK;
}

int mo_tell_parse(const char *text, size_t size, const struct mo_campaign_record *study,
                  struct mo_parsed_telling *parsed, struct mo_faults *faults)
{
  *parsed = (struct mo_parsed_telling){.telling.batch.number = UINT32_MAX,
                                       .workspace = study->settings.workspace,
                                       .measures = study->measures,
                                       .has_scores = mo_campaign_takes_scores(study)};
  mo_read_words(text, size, &mo_design_rules_fields, &parsed->parts, NULL);
  int error = mo_read_body(text, size, &mo_tell_fields, parsed, &parsed->parts, check, faults);
  parsed->telling.notes = parsed->parts.notes;
  parsed->telling.n_notes = parsed->parts.n_notes;
  pack_measures(&parsed->telling.batch, parsed->telling.words.n_measures);
  if (error == MO_OK)
    error = pack_scores(&parsed->telling.batch, parsed->has_scores);
  mo_sha256_of(text, size, &parsed->telling.sha256);
  return error;
}

void mo_tell_free(struct mo_parsed_telling *parsed)
{
  free(parsed->telling.batch.children);
  free(parsed->telling.batch.measures);
  free(parsed->telling.batch.scores);
  free(parsed->telling.batch.survivors);
  free((void *)parsed->telling.sampler);
  mo_parts_free(&parsed->parts);
}

/* ---- asking ---- */

static void read_asked_parents(struct mo_json *json, void *value)
{
  struct mo_parsed_ask *parsed = value;
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    return;
  }
  if (!read_numbers(json, MO_POPULATION_MAX, &parsed->parents, &parsed->ask.n_parents))
    parsed->error = MO_ERR_NO_MEMORY;
  parsed->ask.parents = parsed->parents;
}

static const char *const ways[] = {"variation", "random", NULL};
static const struct mo_field_own asked_parents = {.read = read_asked_parents};
static const struct mo_field ask_rows[] = {
    {"n", MO_FIELD_COUNT, 0, offsetof(struct mo_parsed_ask, ask.n), .min = 1, .max = MO_DESIGNS_MAX,
     .unit = "bodies", .help = "bodies to make"},
    {"by", MO_FIELD_WORD, 0, offsetof(struct mo_parsed_ask, way), .words = ways, .unit = "",
     .help = "how they are made"},
    {"parents", MO_FIELD_OWN, 0, 0, .own = &asked_parents},
};
const struct mo_fields mo_ask_fields = MO_FIELDS(ask_rows);

static int check_ask(struct mo_json *json, void *any)
{
  const struct mo_parsed_ask *parsed = any;
  if (parsed->ask.n == 0 && json->faults->n == 0)
    mo_json_fault_at(json, 0, "", "n is missing; it must be the number of bodies");
  return parsed->error;
}

int mo_ask_parse(const char *text, size_t size, struct mo_parsed_ask *parsed,
                 struct mo_faults *faults)
{
  *parsed = (struct mo_parsed_ask){.way = 0};
  const int error = mo_read_body(text, size, &mo_ask_fields, parsed, NULL, check_ask, faults);
  parsed->ask.is_random = parsed->way == 1;
  return error;
}
