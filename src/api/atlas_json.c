/* atlas_json.c: see atlas_json.h. */
#include "api/atlas_json.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"
#include "base/words.h"
#include "exchange/values.h"

/* ---- requests ---- */

void mo_atlas_refuse(struct mo_request *request, const char *name, int error,
                     const struct mo_message *message)
{
  if (error == MO_ERR_FORMAT || error == MO_ERR_UNSUPPORTED || error == MO_ERR_CORRUPT)
    mo_reply_problem(request, 500, NULL,
                     "The file atlases/%s.atlas in the service's state folder cannot be used: "
                     "%s. DELETE removes it; a PUT of a good file replaces it.",
                     name, message->text);
  else if (error == MO_ERR_IO)
    mo_reply_problem(request, 500, NULL,
                     "atlases/%s.atlas in the state folder of the service cannot be used: %s.",
                     name, message->text);
  else if (error == MO_ERR_NOT_FOUND)
    mo_reply_missing(request, "atlas", name);
  else
    mo_reply_error(request, error, "atlas");
}

bool mo_atlas_begin_named(struct mo_request *request, const char *name, enum mo_atlas_need need,
                          struct mo_atlas_use *use)
{
  struct mo_message message = {""};
  const int error = mo_atlas_use(&mo_api_of(request)->atlases, name, need, use, &message);
  if (error != MO_OK)
    mo_atlas_refuse(request, name, error, &message);
  return error == MO_OK;
}

bool mo_atlas_begin(struct mo_request *request, enum mo_atlas_need need, struct mo_atlas_use *use)
{
  return mo_atlas_begin_named(request, request->parameters[0], need, use);
}

void mo_atlas_done(struct mo_request *request, struct mo_atlas_use *use)
{
  mo_atlas_release(&mo_api_of(request)->atlases, use);
}

static bool read_position(struct mo_request *request, const struct mo_atlas_use *use,
                          uint64_t *position)
{
  int64_t number = 0;
  if (!mo_query_number(request, "position", 0, (int64_t)mo_atlas_bodies_of(use->atlas) - 1,
                       &number))
    return false;
  *position = (uint64_t)number;
  return true;
}

static bool read_design(struct mo_request *request, const char *text, struct mo_genotype *genotype)
{
  const size_t size = strlen(text);
  int orientation;
  const int error =
      size == mo_workspace_voxels(genotype->workspace)
          ? mo_genotype_from_text(genotype->workspace, text, size, genotype->words, NULL)
          : mo_robot_read(text, size, genotype, &orientation);
  if (error == MO_OK)
    return true;
  mo_reply_bad_parameter(request, "design",
                         error == MO_ERR_EMPTY || error == MO_ERR_NOT_CONTIGUOUS
                             ? "the body is empty or in several pieces"
                             : "must be an id of 36 digits, optionally with an orientation (ID@K), "
                               "or a genotype of 144 digits 0 or 1");
  return false;
}

bool mo_atlas_query_body(struct mo_request *request, const struct mo_atlas_use *use,
                         uint64_t *position)
{
  const char *design = mo_query(request, "design");
  struct mo_genotype genotype = {.workspace = mo_api_of(request)->lattice->workspace};
  if ((design != NULL) == (mo_query(request, "position") != NULL)) {
    mo_reply_bad_parameter(request, "design", "give either a design or a position, not both");
    return false;
  }
  if (design == NULL)
    return read_position(request, use, position);
  if (!read_design(request, design, &genotype))
    return false;
  if (mo_atlas_find(use->atlas, genotype.words, position) == MO_OK)
    return true;
  mo_reply_problem(request, 404, NULL,
                   "The body has %u voxels; this atlas has bodies of at most %u.",
                   mo_genotype_count(genotype.workspace, genotype.words),
                   mo_atlas_source_of(use->atlas)->scope.voxels_max);
  return false;
}

const char *const mo_atlas_step_words[] = {"add", "remove", "move", NULL}; /* bits of a step */

const char *mo_atlas_step_word(enum mo_atlas_step step)
{
  return mo_atlas_step_words[__builtin_ctz((unsigned)step)];
}

/* Finds a word of n characters among the steps. Returns its bit, or 0. */
static unsigned step_of(const char *word, size_t n)
{
  for (unsigned i = 0; mo_atlas_step_words[i] != NULL; i++)
    if (strlen(mo_atlas_step_words[i]) == n && strncmp(mo_atlas_step_words[i], word, n) == 0)
      return 1U << i;
  return 0;
}

bool mo_atlas_query_steps(struct mo_request *request, unsigned *steps)
{
  const char *at = mo_query(request, "steps");
  *steps = MO_ATLAS_GROW_SHRINK;
  if (at == NULL)
    return true;
  *steps = 0;
  for (bool has_more = true; has_more;) {
    const size_t n = strcspn(at, ",");
    const unsigned step = step_of(at, n);
    if (step == 0) {
      mo_reply_bad_parameter(request, "steps",
                             "must be one or more of add, remove and move, separated by commas");
      return false;
    }
    *steps |= step;
    has_more = at[n] != '\0';
    at += n + 1;
  }
  return true;
}

bool mo_atlas_query_voxels(struct mo_request *request, const struct mo_atlas_use *use,
                           uint32_t *n_voxels)
{
  int64_t number = 0;
  if (!mo_query_number(request, "voxels", 1, mo_atlas_source_of(use->atlas)->scope.voxels_max,
                       &number))
    return false;
  *n_voxels = (uint32_t)number;
  return true;
}

/* Reads a number in decimal digits. */
static bool read_real(struct mo_request *request, const char *name, float *value)
{
  const char *text = mo_query(request, name);
  char *end = NULL;
  if (text == NULL)
    return true;
  const bool is_plain = text[0] != '\0' && strspn(text, "0123456789+-.eE") == strlen(text);
  const float number = is_plain ? strtof(text, &end) : 0;
  if (is_plain && *end == '\0' && isfinite(number)) {
    *value = number;
    return true;
  }
  mo_reply_bad_parameter(request, name, "must be a number, such as 0.25");
  return false;
}

bool mo_atlas_query_range(struct mo_request *request, float *lo, float *hi)
{
  return mo_atlas_query_interval(request, "lo", "hi", lo, hi);
}

bool mo_atlas_query_interval(struct mo_request *request, const char *low, const char *high,
                             float *lo, float *hi)
{
  char words[160];
  if (!read_real(request, low, lo) || !read_real(request, high, hi))
    return false;
  if (*lo < *hi)
    return true;
  snprintf(words, sizeof(words),
           "%s must be below %s; without one of them, the other must be within the range of the "
           "scores or values",
           low, high);
  mo_reply_bad_parameter(request, mo_query(request, low) != NULL ? low : high, words);
  return false;
}

bool mo_atlas_query_measure(struct mo_request *request, const struct mo_atlas_use *use,
                            int *measure)
{
  const uint32_t set = mo_atlas_source_of(use->atlas)->measures;
  const char *name = mo_query(request, "measure"), *names[MO_MEASURES + 1] = {NULL};
  char list[MO_WORDS_BYTES], words[MO_WORDS_BYTES + 64];
  uint32_t n = 0;
  *measure = -1;
  if (name == NULL)
    return true;
  for (int m = 0; m < MO_MEASURES; m++) {
    if ((set >> m & 1) == 0)
      continue;
    names[n++] = mo_measure_info[m].name;
    if (strcmp(name, mo_measure_info[m].name) == 0)
      *measure = m;
  }
  if (*measure >= 0)
    return true;
  snprintf(words, sizeof(words), "%s%s",
           n > 0 ? "must be a measure of the atlas: " : "the atlas has no measures",
           n > 0 ? mo_words_list(names, list) : "");
  mo_reply_bad_parameter(request, "measure", words);
  return false;
}

bool mo_atlas_sort_by(struct mo_request *request, const struct mo_atlas_use *use, int measure,
                      bool is_negative, struct mo_atlas_index **index)
{
  /* As large as the index of scores; parts of other atlases are freed for it if necessary. */
  mo_atlas_make_room(&mo_api_of(request)->atlases,
                     sizeof(uint64_t) * mo_atlas_bodies_of(use->atlas));
  const int error =
      mo_atlas_index_create_by(use->atlas, (enum mo_measure)measure, is_negative, index);
  if (error != MO_OK)
    mo_reply_error(request, error, "atlas");
  return error == MO_OK;
}

/* ---- replies ---- */

static void member_score(struct mo_text *text, const char *name, float score)
{
  mo_text_name(text, name);
  mo_text_json_float(text, score);
}

void mo_atlas_member_measures(struct mo_text *text, const struct mo_atlas_use *use,
                              uint64_t position, bool as_percentiles)
{
  const uint32_t set = mo_atlas_source_of(use->atlas)->measures;
  if (set == 0)
    return;
  mo_text_open(text, "measures", "{");
  for (int m = 0; m < MO_MEASURES; m++) {
    const enum mo_measure measure = (enum mo_measure)m;
    if ((set >> m & 1) == 0)
      continue;
    if (as_percentiles)
      mo_text_member_number(text, mo_measure_info[m].name,
                            mo_atlas_measure_percentile(use->atlas, position, measure));
    else
      member_score(text, mo_measure_info[m].name, mo_atlas_measure(use->atlas, position, measure));
  }
  mo_text_add(text, "}");
}

void mo_atlas_write_body(struct mo_text *text, const struct mo_atlas_use *use, uint64_t position)
{
  struct mo_genotype form = {.workspace = mo_atlas_source_of(use->atlas)->scope.workspace};
  const uint32_t n_voxels = mo_atlas_form(use->atlas, position, form.words);
  const float score = mo_atlas_score(use->atlas, position);
  const struct mo_atlas_rank rank = mo_atlas_rank_of(use->index, position, false);
  mo_member_form(text, "id", &form);
  mo_text_member_count(text, "voxels", n_voxels);
  mo_member_genotype(text, "genotype", &form);
  mo_text_member_count(text, "position", position);
  member_score(text, "score", score);
  mo_text_member_bool(text, "diverged", !isfinite(score));
  mo_text_member_count(text, "rank", rank.better + 1);
  mo_text_member_number(text, "percentile", rank.percentile);
  mo_atlas_member_measures(text, use, position, false);
}

void mo_atlas_member_body(struct mo_text *text, const char *name, const struct mo_atlas_use *use,
                          uint64_t position)
{
  mo_text_open(text, name, "{");
  mo_atlas_write_body(text, use, position);
  mo_text_add(text, "}");
}

void mo_atlas_item_body(struct mo_text *text, const struct mo_atlas_use *use, uint64_t position)
{
  mo_text_object(text);
  mo_atlas_write_body(text, use, position);
  mo_text_add(text, "}");
}

void mo_atlas_member_floats(struct mo_text *text, const char *name, const float *values, size_t n)
{
  mo_text_open(text, name, "[");
  for (size_t i = 0; i < n; i++) {
    mo_text_next(text);
    mo_text_json_float(text, values[i]);
  }
  mo_text_add(text, "]");
}

/* ---- the description ---- */

static void write_size(struct mo_text *text, const struct mo_atlas_use *use, uint32_t n_voxels)
{
  const uint64_t n = mo_atlas_size(use->atlas, n_voxels, NULL);
  mo_text_object(text);
  mo_text_member_count(text, "voxels", n_voxels);
  mo_text_member_count(text, "bodies", n);
  if (n > 0) {
    const uint64_t lower = mo_atlas_nth(use->index, n_voxels, (n - 1) / 2),
                   upper = mo_atlas_nth(use->index, n_voxels, n / 2);
    mo_atlas_member_body(text, "best", use, mo_atlas_nth(use->index, n_voxels, 0));
    mo_text_member_number(
        text, "median",
        ((double)mo_atlas_score(use->atlas, lower) + (double)mo_atlas_score(use->atlas, upper)) /
            2);
  } else {
    mo_text_member(text, "best", NULL);
    mo_text_member(text, "median", NULL);
  }
  mo_text_add(text, "}");
}

static void member_bytes(struct mo_text *text, const char *name, const uint8_t bytes[32])
{
  struct mo_sha256 hash;
  memcpy(hash.bytes, bytes, sizeof(hash.bytes));
  mo_member_hash(text, name, &hash);
}

int mo_atlas_write_description(const struct mo_atlas_use *use, const struct mo_atlas_facts *facts,
                               struct mo_text *text)
{
  const struct mo_atlas_source *source = mo_atlas_source_of(use->atlas);
  const struct mo_workspace workspace = source->scope.workspace;
  uint32_t n = 0;
  const struct mo_environment *environments = mo_atlas_environments(use->atlas, &n);
  mo_text_object(text);
  mo_text_member(text, "name", facts->name);
  mo_text_member_count(text, "bytes", facts->bytes);
  mo_text_member_time(text, "modified_at", facts->modified_us);
  mo_text_format(text, ",\"workspace\":[%u,%u,%u]", workspace.nx, workspace.ny, workspace.nz);
  mo_text_member_count(text, "voxels_max", source->scope.voxels_max);
  mo_text_member(text, "orientations", mo_atlas_orientation_words[source->orientations]);
  member_bytes(text, "controller", source->controller_sha256);
  member_bytes(text, "physics", source->physics_sha256);
  mo_text_member(text, "fingerprint", source->fingerprint);
  mo_text_open(text, "environments", "[");
  for (uint32_t i = 0; i < n; i++)
    mo_environment_write(text, &environments[i]);
  mo_text_add(text, "]");
  mo_member_measures(text, "measures", source->measures);
  mo_text_member_count(text, "bodies", mo_atlas_bodies_of(use->atlas));
  mo_atlas_member_body(text, "best", use, mo_atlas_nth(use->index, 0, 0));
  mo_text_open(text, "sizes", "[");
  for (uint32_t size = 1; size <= source->scope.voxels_max; size++)
    write_size(text, use, size);
  mo_text_add(text, "]");
  return MO_OK;
}
