/* request_parts.c: see request_parts.h. Every fault names its place: a cell out of bounds is at
 * /designs/3/cells/7/0. */
#include "api/request_parts.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/number.h"
#include "http/field.h"
#include "jobs/evaluations.h"
#include "store/store.h"

#define SIGMA_MAX_M 10.0

void mo_read_unknown(struct mo_json *json, const char *expected)
{
  mo_json_fault(json, "unknown field; expected are %s", expected);
  mo_json_skip(json);
}

int mo_find_words(struct mo_json *json, const char *text, size_t size, const char *const *keys,
                  char (*words)[MO_WORD_BYTES], size_t n)
{
  struct mo_faults *faults = calloc(1, sizeof(*faults)); /* the second pass reports them */
  struct mo_json_slice key, word;
  for (size_t i = 0; i < n; i++)
    words[i][0] = '\0';
  if (faults == NULL)
    return MO_ERR_NO_MEMORY;
  mo_json_start(json, text, size, faults);
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      size_t i = 0;
      while (i < n && !mo_json_is(key, keys[i]))
        i++;
      if (i == n || mo_json_peek(json) != MO_JSON_STRING) {
        mo_json_skip(json);
      } else if (mo_json_string(json, &word) && word.size < MO_WORD_BYTES) {
        memcpy(words[i], word.bytes, word.size);
        words[i][word.size] = '\0';
      }
    }
  free(faults);
  return MO_OK;
}

/* ---- numbers ---- */

bool mo_read_count(struct mo_json *json, uint32_t min, uint32_t max, uint32_t *count)
{
  int64_t number;
  if (!mo_json_integer(json, min, max, &number))
    return false;
  *count = (uint32_t)number;
  return true;
}

/* ---- designs ---- */

static void cell_fault(struct mo_json *json, unsigned depth, int code,
                       const struct mo_cell_fault *fault)
{
  static const char *const sides[] = {"x, 0 to 5", "y, 0 to 5", "z, 0 to 3"};
  char below[48];
  snprintf(below, sizeof(below), "/%zu", fault->cell);
  switch (code) {
  case MO_ERR_EMPTY:
    mo_json_fault_at(json, depth, "", "the body has no voxels; at least one cell is expected");
    break;
  case MO_ERR_RANGE:
    snprintf(below, sizeof(below), "/%zu/%d", fault->cell, fault->axis);
    mo_json_fault_at(json, depth, below, "outside the workspace; a coordinate along %s is expected",
                     sides[fault->axis]);
    break;
  case MO_ERR_DUPLICATE:
    mo_json_fault_at(json, depth, below, "the cell is given twice: it equals cell %zu",
                     fault->other);
    break;
  case MO_ERR_NOT_CONTIGUOUS:
    mo_json_fault_at(
        json, depth, below,
        "the cell is not connected to cell 0; a body in one piece (through faces) is expected");
    break;
  default: mo_json_fault_at(json, depth, "", "%s", mo_error_text(code)); break;
  }
}

static bool read_cells(struct mo_json *json, uint64_t *bits)
{
  int64_t cells[MO_DEFAULT_VOXELS][3];
  size_t n = 0;
  unsigned depth = json->depth, before = json->faults->n;
  if (!mo_json_array(json))
    return false;
  while (mo_json_item(json)) {
    if (n == MO_DEFAULT_VOXELS) {
      mo_json_fault_at(json, depth, "", "more than %d cells are given; the workspace has %d",
                       MO_DEFAULT_VOXELS, MO_DEFAULT_VOXELS);
      mo_json_skip(json);
      while (mo_json_item(json))
        mo_json_skip(json);
      return false;
    }
    unsigned cell = json->depth;
    int axis = 0;
    if (!mo_json_array(json))
      continue;
    while (mo_json_item(json)) {
      if (axis < 3) {
        mo_json_integer(json, INT32_MIN, INT32_MAX, &cells[n][axis]);
      } else {
        mo_json_skip(json);
      }
      axis += axis < 4;
    }
    if (axis != 3)
      mo_json_fault_at(json, cell, "", "a cell has exactly three coordinates: [x, y, z]");
    n++;
  }
  if (json->stop || json->faults->n > before)
    return false;
  struct mo_cell_fault fault;
  int code =
      mo_genotype_from_cells(MO_DEFAULT_WORKSPACE, (const int64_t(*)[3])cells, n, bits, &fault);
  if (code != MO_OK)
    cell_fault(json, depth, code, &fault);
  return code == MO_OK;
}

/* Skips the letter in front of an id (d) or a genotype (g): CSV files have these letters, and their
 * values may be sent back unchanged. */
static void without_letter(struct mo_json_slice *text, char letter)
{
  if (text->size > 0 && text->bytes[0] == letter && text->size != MO_DEFAULT_ID_DIGITS) {
    text->bytes++;
    text->size--;
  }
}

static bool read_voxels(struct mo_json *json, uint64_t *bits)
{
  unsigned depth = json->depth;
  struct mo_json_slice text;
  struct mo_cell_fault fault;
  if (!mo_json_string(json, &text))
    return false;
  without_letter(&text, 'g');
  int code = mo_genotype_from_text(MO_DEFAULT_WORKSPACE, text.bytes, text.size, bits, &fault);
  switch (code) {
  case MO_OK: break;
  case MO_ERR_RANGE:
    mo_json_fault_at(json, depth, "", "%zu characters are given; exactly %d are expected",
                     text.size, MO_DEFAULT_VOXELS);
    break;
  case MO_ERR_FORMAT:
    mo_json_fault_at(json, depth, "", "character %zu (from 0) is neither 0 nor 1", fault.cell);
    break;
  case MO_ERR_EMPTY:
    mo_json_fault_at(json, depth, "", "the body has no voxels; at least one 1 is expected");
    break;
  case MO_ERR_NOT_CONTIGUOUS:
    mo_json_fault_at(json, depth, "",
                     "voxel %zu (from 0) is not connected to the first one; a body in one piece "
                     "(through faces) is expected",
                     fault.cell);
    break;
  default: mo_json_fault_at(json, depth, "", "%s", mo_error_text(code)); break;
  }
  return code == MO_OK;
}

static bool read_id(struct mo_json *json, uint64_t *bits)
{
  unsigned depth = json->depth;
  struct mo_json_slice text;
  if (!mo_json_string(json, &text))
    return false;
  without_letter(&text, 'd');
  int code = mo_genotype_from_id(MO_DEFAULT_WORKSPACE, text.bytes, text.size, bits);
  if (code == MO_ERR_EMPTY || code == MO_ERR_NOT_CONTIGUOUS)
    mo_json_fault_at(json, depth, "", "the id spells a body that is empty or in several pieces");
  else if (code != MO_OK)
    mo_json_fault_at(json, depth, "",
                     "not a design's id; %d hexadecimal digits of a canonical form are expected",
                     MO_DEFAULT_ID_DIGITS);
  return code == MO_OK;
}

static void read_design(struct mo_json *json, struct mo_bits *bits)
{
  unsigned depth = json->depth, forms = 0;
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "cells"))
      read_cells(json, bits->words);
    else if (mo_json_is(key, "voxels"))
      read_voxels(json, bits->words);
    else if (mo_json_is(key, "id"))
      read_id(json, bits->words);
    else {
      mo_read_unknown(json, "cells, voxels or id");
      continue;
    }
    forms++;
  }
  if (forms != 1)
    mo_json_fault_at(json, depth, "", "a design is given by exactly one of cells, voxels and id");
}

int mo_read_designs(struct mo_json *json, struct mo_bits **genotypes, uint32_t *n_designs)
{
  unsigned depth = json->depth;
  uint32_t n = 0, capacity = 0;
  if (!mo_json_array(json))
    return MO_OK;
  while (mo_json_item(json)) {
    if (n == MO_DESIGNS_MAX) {
      mo_json_fault_at(json, depth, "", "more than %d designs are given; at most %d are expected",
                       MO_DESIGNS_MAX, MO_DESIGNS_MAX);
      mo_json_skip(json);
      while (mo_json_item(json))
        mo_json_skip(json);
      break;
    }
    if (n == capacity) {
      capacity = capacity == 0 ? 64 : capacity * 2;
      struct mo_bits *grown = realloc(*genotypes, capacity * sizeof(*grown));
      if (grown == NULL)
        return MO_ERR_NO_MEMORY;
      *genotypes = grown;
    }
    (*genotypes)[n] = (struct mo_bits){{0}};
    read_design(json, &(*genotypes)[n]);
    n++;
  }
  if (n == 0)
    mo_json_fault_at(json, depth, "", "no designs are given; 1 to %d are expected", MO_DESIGNS_MAX);
  *n_designs = n;
  return MO_OK;
}

/* ---- environments ---- */

/* Reads an array of exactly n numbers within ±limit. */
static bool read_numbers(struct mo_json *json, double limit, size_t n, double *numbers)
{
  unsigned depth = json->depth, before = json->faults->n;
  size_t given = 0;
  if (!mo_json_array(json))
    return false;
  while (mo_json_item(json)) {
    if (given < n)
      mo_json_bounded(json, -limit, limit, &numbers[given]);
    else
      mo_json_skip(json);
    given++;
  }
  if (!json->stop && given != n)
    mo_json_fault_at(json, depth, "", "%zu numbers are given; exactly %zu are expected", given, n);
  return !json->stop && json->faults->n == before;
}

static void read_environment(struct mo_json *json, struct mo_environment *environment)
{
  unsigned depth = json->depth;
  bool light = false, heights = false, has_sigma = false, has_seed = false;
  double sigma_m = 0;
  int64_t seed = 0;
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "light_xy_m")) {
      light = true;
      read_numbers(json, MO_LIGHT_LIMIT_M, 2, environment->light_xy_m);
    } else if (mo_json_is(key, "terrain_heights_m")) {
      heights = true;
      read_numbers(json, MO_HEIGHT_LIMIT_M, MO_TERRAIN_HEIGHTS, environment->terrain_heights_m);
    } else if (mo_json_is(key, "terrain_sigma_m")) {
      has_sigma = true;
      mo_json_bounded(json, 0, SIGMA_MAX_M, &sigma_m);
    } else if (mo_json_is(key, "seed")) {
      has_seed = true;
      mo_json_integer(json, 0, MO_SEED_MAX, &seed);
    } else {
      mo_read_unknown(json, "light_xy_m, and terrain_heights_m or terrain_sigma_m with seed");
    }
  }
  if (!light)
    mo_json_fault_at(json, depth, "", "light_xy_m is missing: [x, y] of the light in metres");
  if (heights ? has_sigma || has_seed : !has_sigma || !has_seed)
    mo_json_fault_at(
        json, depth, "",
        "the terrain is given either by terrain_heights_m, or by terrain_sigma_m and seed");
  else if (!heights)
    mo_terrain_random((uint64_t)seed, 0, 0, sigma_m, environment->terrain_heights_m);
}

int mo_read_environments(struct mo_json *json, struct mo_environment **environments,
                         uint32_t *n_environments)
{
  unsigned depth = json->depth;
  enum mo_json_kind kind = mo_json_peek(json);
  struct mo_json_slice name;
  if (kind == MO_JSON_STRING) {
    if (!mo_json_string(json, &name))
      return MO_OK;
    if (!mo_json_is(name, "paper-test"))
      mo_json_fault_at(json, depth, "",
                       "there is no such set of environments; \"paper-test\" is expected");
    return MO_OK;
  }
  if (kind != MO_JSON_ARRAY) {
    if (kind != MO_JSON_NONE) {
      mo_json_fault(json, "\"paper-test\" or an array of 1 to %d environments is expected",
                    MO_ENVIRONMENTS_MAX);
      mo_json_skip(json);
    }
    return MO_OK;
  }
  *environments = calloc(MO_ENVIRONMENTS_MAX, sizeof(**environments));
  if (*environments == NULL)
    return MO_ERR_NO_MEMORY;
  uint32_t n = 0;
  mo_json_array(json);
  while (mo_json_item(json)) {
    if (n < MO_ENVIRONMENTS_MAX) {
      read_environment(json, &(*environments)[n]);
    } else {
      mo_json_skip(json);
    }
    n += n <= MO_ENVIRONMENTS_MAX;
  }
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    mo_json_fault_at(json, depth, "", "%s environments are given; 1 to %d are expected",
                     n == 0 ? "no" : "too many", MO_ENVIRONMENTS_MAX);
  *n_environments = n;
  return MO_OK;
}

/* ---- settings ---- */

void mo_read_controller(struct mo_json *json, char controller[MO_NAME_BYTES_MAX + 8])
{
  struct mo_json_slice name;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &name))
    return;
  char text[MO_NAME_BYTES_MAX + 8];
  struct mo_sha256 hash;
  bool good = name.size < sizeof(text) && memchr(name.bytes, '\0', name.size) == NULL;
  if (good) {
    memcpy(text, name.bytes, name.size);
    text[name.size] = '\0';
    good = strncmp(text, "sha256:", 7) == 0
               ? mo_sha256_from_hex(text + 7, strlen(text + 7), &hash) == MO_OK
               : mo_controller_name_check(text) == MO_OK;
  }
  if (!good)
    mo_json_fault_at(json, depth, "",
                     "a controller's name, or sha256: and 64 hexadecimal digits, is expected");
  else
    memcpy(controller, text, strlen(text) + 1);
}

void mo_read_name(struct mo_json *json, char name[MO_NAME_BYTES_MAX + 1])
{
  struct mo_json_slice words;
  unsigned depth = json->depth;
  char text[MO_NAME_BYTES_MAX + 1] = "";
  if (!mo_json_string(json, &words))
    return;
  bool good = words.size <= MO_NAME_BYTES_MAX && memchr(words.bytes, '\0', words.size) == NULL;
  if (good) {
    memcpy(text, words.bytes, words.size);
    text[words.size] = '\0';
    good = mo_controller_name_check(text) == MO_OK;
  }
  if (good)
    memcpy(name, text, sizeof(text));
  else
    mo_json_fault_at(json, depth, "",
                     "a controller's name is expected: 1 to %d of a-z, 0-9, '.', '_' and '-', "
                     "beginning with a letter "
                     "or digit",
                     MO_NAME_BYTES_MAX);
}

bool mo_read_job_id(struct mo_json *json, const char *what, int64_t *id)
{
  struct mo_json_slice digits;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &digits))
    return false;
  if (digits.size > 0 && digits.bytes[0] != '0' &&
      mo_decimal(digits.bytes, digits.size, 1, INT64_MAX, id))
    return true;
  mo_json_fault_at(json, depth, "",
                   "the id of %s, a positive integer in decimal digits, is expected", what);
  return false;
}

bool mo_read_label(struct mo_json *json, char label[MO_LABEL_BYTES_MAX + 1])
{
  struct mo_json_slice words;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &words))
    return false;
  size_t characters = 0;
  for (size_t i = 0; i < words.size; i++)
    characters += ((unsigned char)words.bytes[i] & 0xC0) != 0x80;
  if (characters > 200) {
    mo_json_fault_at(json, depth, "", "%zu characters are given; at most 200 are expected",
                     characters);
    return false;
  }
  memcpy(label, words.bytes, words.size);
  label[words.size] = '\0';
  return true;
}

bool mo_read_weight(struct mo_json *json, double *weight)
{
  return mo_json_bounded(json, MO_WEIGHT_MIN, MO_WEIGHT_MAX, weight);
}

void mo_read_device(struct mo_json *json, int *back_end)
{
  struct mo_json_slice word;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &word))
    return;
  if (mo_json_is(word, "auto"))
    *back_end = MO_BACK_END_AUTO;
  else if (mo_json_is(word, "cpu"))
    *back_end = MO_ON_CPU;
  else if (mo_json_is(word, "cuda"))
    *back_end = MO_ON_DEVICE;
  else
    mo_json_fault_at(json, depth, "", "\"auto\", \"cpu\" or \"cuda\" is expected");
}

bool mo_read_choice(struct mo_json *json, const char *first, const char *second, int *choice)
{
  struct mo_json_slice word;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &word))
    return false;
  if (!mo_json_is(word, first) && !mo_json_is(word, second)) {
    mo_json_fault_at(json, depth, "", "\"%s\" or \"%s\" is expected", first, second);
    return false;
  }
  *choice = mo_json_is(word, second);
  return true;
}

bool mo_read_word(struct mo_json *json, int (*find)(const char *word, int *value),
                  const char *expected, int *value)
{
  struct mo_json_slice slice;
  unsigned depth = json->depth;
  char word[MO_WORD_BYTES] = "";
  if (!mo_json_string(json, &slice))
    return false;
  if (slice.size < sizeof(word))
    memcpy(word, slice.bytes, slice.size);
  if (word[0] != '\0' && find(word, value) == MO_OK)
    return true;
  mo_json_fault_at(json, depth, "", "%s is expected", expected);
  return false;
}
