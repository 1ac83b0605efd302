/* design_request.c: reads the designs in request bodies. Every fault has its JSON pointer: a cell
 * out of bounds is at /designs/3/cells/7/0. If the request says so, an invalid design is skipped,
 * and a body in several pieces is reduced to its largest piece. A note records this. */
#include "api/requests.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/text.h"

#define REPAIR_HINT "; requests that accept \"repair\": \"largest\" keep the largest piece"

/* Skips the next item and all later ones. */
static void skip_rest(struct mo_json *json)
{
  do
    mo_json_skip(json);
  while (mo_json_item(json));
}

/* A design that is being read. */
struct shape {
  struct mo_bits *bits;
  bool repairs;
  uint32_t dropped; /* voxels */
  enum mo_orientation orientation;
};

/* Drops all but the largest piece of a body in several pieces, if the request says so. Returns the
 * error that remains. */
static int repaired(int code, struct shape *shape)
{
  uint64_t *bits = shape->bits->words;
  if (code != MO_ERR_NOT_CONTIGUOUS)
    return code;
  const uint32_t before = mo_genotype_count(MO_STORE_WORKSPACE, bits);
  if (shape->repairs) {
    code = mo_genotype_keep_largest(MO_STORE_WORKSPACE, bits);
    shape->dropped = before - mo_genotype_count(MO_STORE_WORKSPACE, bits);
  } else {
    *shape->bits = (struct mo_bits){{0}};
  }
  return code;
}

static void cell_fault(struct mo_json *json, unsigned depth, int code,
                       const struct mo_cell_fault *fault)
{
  static const char *const sides[] = {"x from 0 to 5", "y from 0 to 5", "z from 0 to 3"};
  char below[48];
  snprintf(below, sizeof(below), "/%zu", fault->cell);
  switch (code) {
  case MO_ERR_EMPTY:
    mo_json_fault_at(json, depth, "", "the body has no voxels; it needs at least one cell");
    break;
  case MO_ERR_RANGE:
    snprintf(below, sizeof(below), "/%zu/%d", fault->cell, fault->axis);
    mo_json_fault_at(json, depth, below, "outside the workspace; use %s", sides[fault->axis]);
    break;
  case MO_ERR_DUPLICATE:
    mo_json_fault_at(json, depth, below, "duplicate cell: it equals cell %zu", fault->other);
    break;
  case MO_ERR_NOT_CONTIGUOUS:
    mo_json_fault_at(
        json, depth, below,
        "the cell is not connected to cell 0; a body must be one piece, connected through "
        "faces" REPAIR_HINT);
    break;
  default: mo_json_fault_at(json, depth, "", "%s", mo_error_text(code)); break;
  }
}

static bool read_cells(struct mo_json *json, struct shape *shape)
{
  int64_t cells[MO_DEFAULT_VOXELS][3];
  size_t n = 0;
  unsigned depth = json->depth, before = json->faults->n;
  if (!mo_json_array(json))
    return false;
  while (mo_json_item(json)) {
    if (n == MO_DEFAULT_VOXELS) {
      mo_json_fault_at(json, depth, "", "there are more than %d cells; the workspace has %d",
                       MO_DEFAULT_VOXELS, MO_DEFAULT_VOXELS);
      skip_rest(json);
      return false;
    }
    unsigned cell = json->depth;
    int axis = 0;
    cells[n][0] = cells[n][1] = cells[n][2] = -1;
    if (!mo_json_array(json))
      continue;
    while (mo_json_item(json)) {
      if (axis < 3)
        mo_json_integer(json, INT32_MIN, INT32_MAX, &cells[n][axis]);
      else
        mo_json_skip(json);
      axis += axis < 4;
    }
    if (axis != 3)
      mo_json_fault_at(json, cell, "", "a cell must have exactly three coordinates: [x, y, z]");
    n++;
  }
  if (json->stop || json->faults->n > before)
    return false;
  struct mo_cell_fault fault;
  int code = repaired(mo_genotype_from_cells(MO_STORE_WORKSPACE, (const int64_t(*)[3])cells, n,
                                             shape->bits->words, &fault),
                      shape);
  if (code != MO_OK)
    cell_fault(json, depth, code, &fault);
  return code == MO_OK;
}

/* Expands a genotype in hexadecimal digits to four voxels per digit, the highest bit first. Returns
 * whether the text has this form. */
static bool spread(struct mo_json_slice text, char digits[MO_DEFAULT_VOXELS])
{
  bool is_packed = text.size == MO_DEFAULT_ID_DIGITS;
  for (size_t i = 0; i < text.size && is_packed; i++) {
    const int value = mo_hex_digit(text.bytes[i]);
    is_packed = value >= 0;
    for (int k = 0; k < 4; k++)
      digits[4 * i + (size_t)k] = value >> (3 - k) & 1 ? '1' : '0';
  }
  return is_packed;
}

static bool read_voxels(struct mo_json *json, struct shape *shape)
{
  unsigned depth = json->depth;
  struct mo_json_slice text;
  struct mo_cell_fault fault;
  if (!mo_json_string(json, &text))
    return false;
  /* CSV files have this letter, and clients may send it back unchanged. */
  if (text.size > 0 && text.bytes[0] == 'g') {
    text.bytes++;
    text.size--;
  }
  char digits[MO_DEFAULT_VOXELS];
  if (spread(text, digits))
    text = (struct mo_json_slice){digits, sizeof(digits)};
  int code = repaired(
      mo_genotype_from_text(MO_STORE_WORKSPACE, text.bytes, text.size, shape->bits->words, &fault),
      shape);
  switch (code) {
  case MO_OK: break;
  case MO_ERR_RANGE:
    mo_json_fault_at(json, depth, "",
                     "must have exactly %d characters, or %d hexadecimal digits, got %zu",
                     MO_DEFAULT_VOXELS, MO_DEFAULT_ID_DIGITS, text.size);
    break;
  case MO_ERR_FORMAT:
    mo_json_fault_at(json, depth, "", "character %zu (counting from 0) must be 0 or 1", fault.cell);
    break;
  case MO_ERR_EMPTY:
    mo_json_fault_at(json, depth, "", "the body has no voxels; it needs at least one 1");
    break;
  case MO_ERR_NOT_CONTIGUOUS:
    mo_json_fault_at(json, depth, "",
                     "voxel %zu (counting from 0) is not connected to the first one; a body must "
                     "be one piece, connected through faces" REPAIR_HINT,
                     fault.cell);
    break;
  default: mo_json_fault_at(json, depth, "", "%s", mo_error_text(code)); break;
  }
  return code == MO_OK;
}

int mo_robot_read(const char *text, size_t size, struct mo_genotype *genotype, int *orientation)
{
  const char *at = memchr(text, '@', size);
  const size_t digits = at != NULL ? (size_t)(at - text) : size;
  const size_t letter = digits == MO_DEFAULT_ID_DIGITS + 1 && text[0] == 'd' ? 1 : 0;
  return mo_genotype_from_robot(genotype->workspace, text + letter, size - letter, genotype->words,
                                orientation);
}

static bool read_id(struct mo_json *json, struct shape *shape)
{
  unsigned depth = json->depth;
  struct mo_json_slice text;
  struct mo_genotype read = {.workspace = MO_STORE_WORKSPACE};
  int orientation = -1;
  if (!mo_json_string(json, &text))
    return false;
  int code = mo_robot_read(text.bytes, text.size, &read, &orientation);
  memcpy(shape->bits->words, read.words, sizeof(read.words));
  if (code == MO_ERR_EMPTY || code == MO_ERR_NOT_CONTIGUOUS)
    mo_json_fault_at(json, depth, "", "the id encodes a body that is empty or in several pieces");
  else if (code != MO_OK)
    mo_json_fault_at(json, depth, "",
                     "not a design id; it must be the %d hexadecimal digits of a canonical form, "
                     "optionally with an orientation, @0 to @7",
                     MO_DEFAULT_ID_DIGITS);
  if (orientation < 0)
    shape->orientation = MO_ORIENTATION_CANONICAL;
  return code == MO_OK;
}

static void read_design(struct mo_json *json, struct shape *shape)
{
  unsigned depth = json->depth, forms = 0;
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "cells"))
      read_cells(json, shape);
    else if (mo_json_is(key, "voxels"))
      read_voxels(json, shape);
    else if (mo_json_is(key, "id"))
      read_id(json, shape);
    else {
      mo_fields_unknown(json, "cells, voxels or id", NULL);
      continue;
    }
    forms++;
  }
  if (forms != 1)
    mo_json_fault_at(json, depth, "", "a design must have exactly one of cells, voxels and id");
}

/* ---- lists of designs ---- */

void *mo_next_item(void **items, size_t n, size_t size)
{
  if ((n & (n - 1)) == 0) { /* n is 0, 1, 2, 4, …: the array is full */
    void *grown = realloc(*items, (n > 0 ? 2 * n : 1) * size);
    if (grown == NULL)
      return NULL;
    *items = grown;
  }
  return (char *)*items + n * size;
}

bool mo_parts_note(struct mo_parts *parts, const struct mo_design_note *note)
{
  struct mo_design_note *next =
      mo_next_item((void **)&parts->notes, parts->n_notes, sizeof(*parts->notes));
  if (next == NULL)
    return false;
  *next = *note;
  parts->n_notes++;
  parts->n_skipped += mo_is_skipped(note);
  return true;
}

bool mo_parts_design(struct mo_json *json, struct mo_parts *parts, uint32_t place)
{
  struct mo_faults own, *all = json->faults; /* not cleared as a whole, because it is large */
  struct shape shape = {
      .bits = mo_next_item((void **)&parts->genotypes, parts->n_designs, sizeof(*parts->genotypes)),
      .repairs = parts->repair == MO_REPAIR_LARGEST};
  if (shape.bits == NULL)
    return false;
  *shape.bits = (struct mo_bits){{0}};
  own.n = 0;
  own.malformed = false;
  own.first_only = true;
  json->faults = parts->on_fault == MO_FAULT_SKIP ? &own : all;
  read_design(json, &shape);
  json->faults = all;
  if (own.malformed) {
    all->malformed = true;
    all->items[0] = own.items[0];
    all->n = 1;
  } else if (own.n > 0) {
    if (!mo_parts_note(parts, &(struct mo_design_note){.place = place, .fault = own.items[0]}))
      return false;
  } else if (shape.dropped > 0 || shape.orientation != MO_ORIENTATION_GIVEN) {
    const struct mo_design_note note = {
        .place = place, .dropped = shape.dropped, .orientation = shape.orientation};
    if (!mo_parts_note(parts, &note))
      return false;
  }
  parts->n_designs += own.n == 0;
  return true;
}

/* Refuses the first design that would need a note, because there are too many designs for notes. */
static void refuse_note(struct mo_json *json, unsigned depth, const struct mo_design_note *note)
{
  char below[24];
  snprintf(below, sizeof(below), "/%u", note->place);
  mo_json_fault_at(json, depth, below,
                   "a list of more than %d designs cannot have a design that %s; give %s",
                   MO_DESIGNS_MAX,
                   mo_is_skipped(note) ? "is not valid"
                   : note->dropped > 0 ? "is in several pieces"
                                       : "is an id without an orientation",
                   note->orientation != MO_ORIENTATION_GIVEN && !mo_is_skipped(note)
                       ? "its orientation, @0 to @7"
                       : "only valid ones, or fewer at a time");
}

static void read_designs(struct mo_json *json, void *value)
{
  struct mo_parts *parts = value;
  unsigned depth = json->depth;
  const uint32_t most = parts->most_designs > 0 ? parts->most_designs : MO_DESIGNS_MAX;
  uint32_t n = 0;
  parts->has_designs = true;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); n++) {
    if (n == most) {
      mo_json_fault_at(json, depth, "", "there are more than %u designs; at most %u are allowed",
                       most, most);
      skip_rest(json);
      break;
    }
    if (!mo_parts_design(json, parts, n)) {
      parts->error = MO_ERR_NO_MEMORY;
      json->stop = true;
      return;
    }
    if (n >= MO_DESIGNS_MAX && parts->n_notes > 0) {
      refuse_note(json, depth, &parts->notes[0]);
      while (mo_json_item(json))
        mo_json_skip(json);
      break;
    }
  }
  if (n == 0)
    mo_json_fault_at(json, depth, "", "the list is empty; it must have 1 to %u designs", most);
}
const struct mo_field_own mo_designs_field = {.read = read_designs};

/* ---- the designs of another job, or of an atlas ---- */

/* The source of a population. */
struct population {
  enum mo_job_kind kind;
  int64_t id;
  uint32_t best; /* 0: not given */
  unsigned sources;
  bool is_drawn; /* it has members that describe a sample, in addition to the atlas */
};

static void check_population(struct mo_json *json, unsigned depth,
                             const struct population *population,
                             const struct mo_atlas_sample *sample)
{
  const bool has_atlas = sample != NULL && sample->atlas[0] != '\0';
  if (population->sources != 1)
    mo_json_fault_at(json, depth, "",
                     "must have exactly one of evaluation (its designs)%s campaign (its newest "
                     "population)%s",
                     sample != NULL ? "," : " and",
                     sample != NULL ? " and atlas (bodies from its whole ranking)" : "");
  else if (has_atlas && population->best > 0)
    mo_json_fault_at(json, depth, "/best",
                     "cannot be combined with atlas, which takes count bodies from its whole "
                     "ranking");
  else if (has_atlas && sample->count == 0)
    mo_json_fault_at(json, depth, "", "count is missing; it must be the number of bodies, 1 to %d",
                     MO_ATLAS_SAMPLE_MAX);
  else if (!has_atlas && population->is_drawn)
    mo_json_fault_at(json, depth, "", "count, seed and sha256 are only for an atlas");
  if (has_atlas && sample->sha256[0] != '\0' &&
      strspn(sample->sha256, "0123456789abcdef") != MO_SHA256_DIGITS)
    mo_json_fault_at(json, depth, "/sha256", "must be %d hexadecimal digits in lower case",
                     MO_SHA256_DIGITS);
}

void mo_read_population(struct mo_json *json, uint32_t most, enum mo_job_kind *kind, int64_t *id,
                        uint32_t *best, struct mo_atlas_sample *sample)
{
  const unsigned depth = json->depth, before = json->faults->n;
  struct population population = {.kind = *kind};
  struct mo_json_slice key;
  int64_t number;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    const bool campaign = mo_json_is(key, "campaign"), atlas = mo_json_is(key, "atlas");
    if (campaign || mo_json_is(key, "evaluation")) {
      population.sources++;
      population.kind = campaign ? MO_JOB_CAMPAIGN : MO_JOB_EVALUATION;
      mo_read_job_id(json, campaign ? "a campaign" : "an evaluation", &population.id);
    } else if (mo_json_is(key, "best")) {
      if (mo_json_integer(json, 1, most, &number))
        population.best = (uint32_t)number;
    } else if (sample != NULL && mo_fields_read_member(json, key, &mo_atlas_asked_fields, sample)) {
      population.sources += atlas;
      population.is_drawn |= !atlas;
    } else {
      mo_fields_unknown(json, "evaluation or campaign, best",
                        sample != NULL ? &mo_atlas_asked_fields : NULL);
    }
  }
  if (!json->stop && json->faults->n == before)
    check_population(json, depth, &population, sample);
  *kind = population.kind;
  *id = population.id;
  if (population.best > 0)
    *best = population.best;
}

/* ---- the rules ---- */

static const char *const on_fault_words[] = {"refuse", "skip", NULL}; /* enum mo_on_fault */
static const char *const repair_words[] = {"none", "largest", NULL};  /* enum mo_repair */
static const struct mo_field rules[] = {
    {"on_fault", MO_FIELD_WORD, 0, offsetof(struct mo_parts, on_fault), .words = on_fault_words,
     .unit = "", .help = "how to treat an invalid design"},
    {"repair", MO_FIELD_WORD, 0, offsetof(struct mo_parts, repair), .words = repair_words,
     .unit = "", .help = "how to treat a body in several pieces"},
};
const struct mo_fields mo_design_rules_fields = MO_FIELDS(rules);
const struct mo_fields mo_on_fault_fields = {&rules[0], 1}, mo_repair_fields = {&rules[1], 1};
