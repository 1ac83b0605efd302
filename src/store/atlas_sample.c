/* atlas_sample.c: see atlas_sample.h. */
#include "store/atlas_sample.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <morpho/atlas.h>
#include <morpho/random.h>

#include "store/atlas_files.h"
#include "store/atlas_rows.h"
#include "store/hash.h"

#define AT(member) offsetof(struct mo_atlas_sample, member)
static const struct mo_field rows[] = {
    {"atlas", MO_FIELD_TEXT, 0, AT(atlas), .min = 1, .max = MO_ATLAS_NAME_MAX, .unit = "",
     .help = "name of an atlas"},
    {"count", MO_FIELD_COUNT, 0, AT(count), .min = 1, .max = MO_ATLAS_SAMPLE_MAX, .unit = "bodies",
     .help = "number of bodies to draw"},
    {"seed", MO_FIELD_SEED, 0, AT(seed), .min = 0, .unit = "", .help = "seed of the draw"},
    {"sha256", MO_FIELD_TEXT, 0, AT(sha256), .min = MO_SHA256_DIGITS, .max = MO_SHA256_DIGITS,
     .unit = "", .help = "hash of the file of the atlas"},
    {"bodies", MO_FIELD_COUNT, 0, AT(bodies), .min = 1, .max = UINT32_MAX, .unit = "bodies",
     .help = "bodies that are ranked"},
    {"diverged", MO_FIELD_COUNT, 0, AT(diverged), .min = 0, .max = UINT32_MAX, .unit = "bodies",
     .help = "bodies without a finite score, which are left out"},
    {"orientations", MO_FIELD_WORD, 0, AT(orientations), .words = mo_atlas_orientation_words,
     .unit = "", .help = "whether a score is the mean over a body's images"},
    {"environments", MO_FIELD_TEXT, MO_FIELD_NULL, AT(environments), .min = 1,
     .max = MO_NAME_BYTES_MAX, .unit = "", .help = "the set of the atlas; null: no set"},
    {"controller", MO_FIELD_TEXT, 0, AT(controller), .min = MO_SHA256_DIGITS,
     .max = MO_SHA256_DIGITS, .unit = "", .help = "hash of the controller of all scores"},
};
#undef AT
#define N_ASKED 4
const struct mo_fields mo_atlas_sample_fields = MO_FIELDS(rows),
                       mo_atlas_asked_fields = {rows, N_ASKED, NULL},
                       mo_atlas_drawn_fields = {&rows[N_ASKED],
                                                sizeof(rows) / sizeof(rows[0]) - N_ASKED, NULL};

uint32_t mo_atlas_sample_place(const struct mo_atlas_sample *sample, uint32_t i)
{
  const uint64_t bodies = sample->bodies, first = i * bodies / sample->count,
                 end = (i + 1) * bodies / sample->count;
  struct mo_random random;
  mo_random_init(&random, sample->seed, MO_PURPOSE_ATLAS_SAMPLE, 0, i);
  return (uint32_t)first + mo_random_below(&random, (uint32_t)(end - first));
}

/* ---- the atlas ---- */

/* Returns why there is no file: MO_ERR_NOT_FOUND, or MO_ERR_CONFLICT if it is not complete yet. */
static int explain(struct mo_store *store, const char *name, struct mo_message *message)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int64_t job = 0;
  const int error = mo_atlas_builder(reader, name, &job);
  if (error != MO_OK)
    return error;
  if (job != 0)
    return mo_fail(message, MO_ERR_CONFLICT,
                   "the atlas \"%.64s\" is not complete yet: job %lld builds it; try again when "
                   "that job has succeeded",
                   name, (long long)job);
  return mo_fail(message, MO_ERR_NOT_FOUND,
                 "atlas \"%.64s\" does not exist; GET /v1/atlases lists all atlases", name);
}

static int open_named(struct mo_store *store, const char *name, struct mo_atlas **atlas,
                      struct mo_message *message)
{
  struct mo_message reason = {""};
  const bool is_name = mo_atlas_name_is_valid(name);
  char *path = is_name ? mo_store_atlas_path(store, name) : NULL;
  if (is_name && path == NULL)
    return MO_ERR_NO_MEMORY;
  const int error = is_name ? mo_store_atlas_open(store, path, atlas, &reason) : MO_ERR_NOT_FOUND;
  free(path);
  switch (error) {
  case MO_ERR_NOT_FOUND: return explain(store, name, message);
  case MO_ERR_FORMAT:
  case MO_ERR_UNSUPPORTED:
  case MO_ERR_CORRUPT:
  case MO_ERR_IO:
    return mo_fail(message, MO_ERR_CONFLICT, "the atlas \"%.64s\" cannot be used: %s", name,
                   reason.text);
  default: return error;
  }
}

/* Finds the named set that has exactly the environments of an atlas. */
static int name_environments(const struct mo_atlas *atlas, char *name)
{
  struct mo_environment *of_set = malloc(MO_SET_ENVIRONMENTS_MAX * sizeof(*of_set));
  uint32_t n = 0;
  const struct mo_environment *own = mo_atlas_environments(atlas, &n);
  if (of_set == NULL)
    return MO_ERR_NO_MEMORY;
  name[0] = '\0';
  for (int i = 0; mo_set_words[i] != NULL && name[0] == '\0'; i++) {
    bool is_same = mo_environment_set(i, of_set) == n;
    for (uint32_t k = 0; k < n && is_same; k++) {
      struct mo_sha256 first, second;
      mo_environment_hash(&own[k], &first);
      mo_environment_hash(&of_set[k], &second);
      is_same = memcmp(&first, &second, sizeof(first)) == 0;
    }
    if (is_same)
      snprintf(name, MO_NAME_BYTES_MAX + 1, "%s", mo_set_words[i]);
  }
  free(of_set);
  return MO_OK;
}

/* Fills in the members that come from the file. */
static int describe(const struct mo_atlas *atlas, struct mo_atlas_sample *sample,
                    struct mo_message *message)
{
  const struct mo_atlas_source *source = mo_atlas_source_of(atlas);
  struct mo_sha256 hash;
  mo_atlas_hash(atlas, hash.bytes);
  if (sample->sha256[0] != '\0' && strcmp(sample->sha256, MO_SHA256_HEX(&hash)) != 0)
    return mo_fail(message, MO_ERR_CONFLICT,
                   "the atlas \"%.64s\" is now another file, with the hash %s; leave sha256 out to "
                   "draw from it",
                   sample->atlas, MO_SHA256_HEX(&hash));
  snprintf(sample->sha256, sizeof(sample->sha256), "%s", MO_SHA256_HEX(&hash));
  memcpy(hash.bytes, source->controller_sha256, sizeof(hash.bytes));
  snprintf(sample->controller, sizeof(sample->controller), "%s", MO_SHA256_HEX(&hash));
  sample->orientations = (int)source->orientations;
  return name_environments(atlas, sample->environments);
}

/* ---- the bodies ---- */

static int draw(const struct mo_atlas *atlas, const struct mo_atlas_index *index,
                struct mo_atlas_sample *sample, struct mo_bits **ret, struct mo_message *message)
{
  const float all[] = {-INFINITY, INFINITY};
  uint64_t n = 0;
  mo_atlas_histogram(index, 0, all, 1, &n);
  sample->bodies = (uint32_t)n;
  sample->diverged = (uint32_t)(mo_atlas_bodies_of(atlas) - n);
  if (sample->count > n)
    return mo_fail(message, MO_ERR_RANGE,
                   "must be at most the number of bodies of the atlas with a finite score, which "
                   "is %llu, got %u",
                   (unsigned long long)n, (unsigned)sample->count);
  struct mo_bits *bodies = calloc(sample->count, sizeof(*bodies));
  if (bodies == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < sample->count; i++)
    mo_atlas_form(atlas, mo_atlas_nth(index, 0, mo_atlas_sample_place(sample, i)), bodies[i].words);
  *ret = bodies;
  return MO_OK;
}

int mo_store_atlas_sample(struct mo_store *store, struct mo_atlas_sample *sample,
                          struct mo_bits **bodies, struct mo_message *message)
{
  struct mo_atlas *atlas = NULL;
  struct mo_atlas_index *index = NULL;
  int error = open_named(store, sample->atlas, &atlas, message);
  if (error == MO_OK)
    error = describe(atlas, sample, message);
  if (error == MO_OK)
    error = mo_atlas_index_create(atlas, &index);
  if (error == MO_OK)
    error = draw(atlas, index, sample, bodies, message);
  mo_atlas_index_free(index);
  mo_atlas_close(atlas);
  return error;
}
