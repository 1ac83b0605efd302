/* bodies.c: makes random bodies, mutants, crossovers and canonical forms, as campaigns do, for
 * searches that run elsewhere. Nothing is stored; the same request returns the same bodies. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <morpho/evolution.h>

#include "api/job_json.h"
#include "api/submission.h"

#define W MO_DEFAULT_WORDS

/* ---- requests ---- */

/* Two designs of the request, by their places. */
struct pair {
  uint32_t first, second;
};

struct parsed {
  struct mo_parts parts;
  uint32_t first, count, children, n_pairs;
  uint64_t seed;
  double rate;
  struct pair *pairs;
};

/* Reads [[first, second], …]; check_pairs checks that these designs exist. */
static void read_pairs(struct mo_json *json, void *value)
{
  struct parsed *parsed = value;
  const unsigned depth = json->depth;
  if (!mo_json_array(json))
    return;
  if (parsed->pairs == NULL)
    parsed->pairs = calloc(MO_DESIGNS_MAX, sizeof(*parsed->pairs));
  if (parsed->pairs == NULL) {
    parsed->parts.error = MO_ERR_NO_MEMORY;
    json->stop = true;
    return;
  }
  uint32_t n = 0;
  for (; mo_json_item(json); n += n <= MO_DESIGNS_MAX) {
    int64_t places[2] = {0, 0};
    unsigned pair = json->depth, given = 0;
    if (!mo_json_array(json))
      continue;
    for (; mo_json_item(json); given += given < 3)
      if (given < 2)
        mo_json_integer(json, 0, MO_DESIGNS_MAX - 1, &places[given]);
      else
        mo_json_skip(json);
    if (given != 2)
      mo_json_fault_at(json, pair, "", "a pair must have exactly two places: [first, second]");
    if (n < MO_DESIGNS_MAX)
      parsed->pairs[n] = (struct pair){(uint32_t)places[0], (uint32_t)places[1]};
  }
  if (n < 1 || n > MO_DESIGNS_MAX)
    mo_json_fault_at(json, depth, "", "must have 1 to %d pairs, got %s", MO_DESIGNS_MAX,
                     n == 0 ? "none" : "too many");
  parsed->n_pairs = n;
}

#define AT(member) offsetof(struct parsed, member)
static const struct mo_field_own pairs = {.read = read_pairs};
static const struct mo_field random_rows[] = {
    {"first", MO_FIELD_COUNT, 0, AT(first), .min = 0, .max = MO_RANDOM_BODIES_MAX - 1,
     .unit = "bodies"},
    {"count", MO_FIELD_COUNT, 0, AT(count), .min = 1, .max = MO_DESIGNS_MAX, .unit = "bodies"},
    {"seed", MO_FIELD_SEED, 0, AT(seed), .min = 0, .unit = ""},
};
static const struct mo_field given_rows[] = {
    {"designs", MO_FIELD_OWN, 0, AT(parts), .own = &mo_designs_field},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_design_rules_fields},
};
static const struct mo_fields given = MO_FIELDS(given_rows);
static const struct mo_field mutation_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &given},
    {"seed", MO_FIELD_SEED, 0, AT(seed), .min = 0, .unit = ""},
    {"rate", MO_FIELD_NUMBER, 0, AT(rate), .min = 0.001, .max = 0.5, .unit = ""},
    {"children", MO_FIELD_COUNT, 0, AT(children), .min = 1, .max = MO_DESIGNS_MAX,
     .unit = "bodies"},
};
static const struct mo_field crossing_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &given},
    {"pairs", MO_FIELD_OWN, 0, 0, .own = &pairs},
};
#undef AT
const struct mo_fields mo_random_request_fields = MO_FIELDS(random_rows),
                       mo_mutation_request_fields = MO_FIELDS(mutation_rows),
                       mo_crossing_request_fields = MO_FIELDS(crossing_rows),
                       mo_canonical_request_fields = MO_FIELDS(given_rows);

/* Returns the number of designs in the request, including those that are skipped. */
static uint32_t n_given(const struct parsed *parsed)
{
  return parsed->parts.n_designs + parsed->parts.n_skipped;
}

static int check_designs(struct mo_json *json, void *any)
{
  struct parsed *parsed = any;
  if (!parsed->parts.has_designs)
    mo_json_fault_at(json, 0, "", "designs is missing; it must be an array of 1 to %d designs",
                     MO_DESIGNS_MAX);
  if ((uint64_t)n_given(parsed) * parsed->children > MO_DESIGNS_MAX)
    mo_json_fault_at(json, 0, "/children",
                     "%u children of each of %u designs are too many; request at most %d in total",
                     parsed->children, n_given(parsed), MO_DESIGNS_MAX);
  return MO_OK;
}

static int check_pairs(struct mo_json *json, void *any)
{
  struct parsed *parsed = any;
  const int error = check_designs(json, any);
  if (parsed->n_pairs == 0 && json->faults->n == 0)
    mo_json_fault_at(json, 0, "",
                     "pairs is missing; it must be an array of 1 to %d pairs of designs",
                     MO_DESIGNS_MAX);
  for (uint32_t i = 0; i < parsed->n_pairs && i < MO_DESIGNS_MAX; i++) {
    const uint32_t first = parsed->pairs[i].first, second = parsed->pairs[i].second;
    char below[48];
    snprintf(below, sizeof(below), "/pairs/%u/%d", i, first < n_given(parsed));
    if (first >= n_given(parsed) || second >= n_given(parsed))
      mo_json_fault_at(json, 0, below, "design %u does not exist; the request has designs 0 to %u",
                       first >= n_given(parsed) ? first : second, n_given(parsed) - 1);
  }
  return error;
}

/* ---- replies ---- */

/* A design of the request. */
struct place {
  struct mo_genotype genotype;       /* placed; empty: skipped */
  const struct mo_design_note *note; /* nullable */
};

/* A reply that is being made. */
struct bodies {
  struct parsed parsed;
  struct place *places; /* (n_given) */
  const struct mo_lattice *lattice;
  struct mo_random_stream *random_stream;
  struct mo_text text; /* its items */
  int error;
};

static bool is_empty(const struct place *place)
{
  return place->note != NULL && mo_is_skipped(place->note);
}

/* Returns the designs of the request (malloc); NULL: no memory. */
static struct place *places_of(const struct parsed *parsed, struct mo_workspace workspace)
{
  const struct mo_parts *parts = &parsed->parts;
  struct place *places = calloc(n_given(parsed) + 1, sizeof(*places));
  for (uint32_t i = 0; places != NULL && i < parts->n_notes; i++)
    places[parts->notes[i].place].note = &parts->notes[i];
  for (uint32_t i = 0, n = 0; places != NULL && i < n_given(parsed); i++)
    if (!is_empty(&places[i])) {
      places[i].genotype = mo_genotype_of(workspace, &parts->genotypes[n++]);
      mo_genotype_place(workspace, places[i].genotype.words);
    }
  return places;
}

/* Adds a body. parents: (n_parents) places; genotype empty: `note` gives the reason. */
static void add(struct bodies *bodies, const struct mo_genotype *genotype, const uint32_t *parents,
                unsigned n_parents, const struct mo_design_note *note)
{
  struct mo_text *text = &bodies->text;
  if (bodies->error != MO_OK)
    return;
  const struct mo_genotype form = mo_genotype_form(genotype);
  mo_text_object(text);
  bodies->error = mo_members_design(text, bodies->lattice, &form, genotype, note);
  mo_text_name(text, "parents");
  mo_text_counts(text, parents, n_parents);
  mo_text_add(text, "}");
}

/* Adds an item without a body, with the reason. */
static void add_none(struct bodies *bodies, const uint32_t *parents, unsigned n_parents,
                     const char *pointer, const char *detail)
{
  struct mo_design_note note = {0};
  const struct mo_genotype none = {.words = {0}};
  snprintf(note.fault.where, sizeof(note.fault.where), "%s", pointer);
  snprintf(note.fault.detail, sizeof(note.fault.detail), "%s", detail);
  add(bodies, &none, parents, n_parents, &note);
}

/* Reads a request, and replies with the bodies that `make` adds. */
static void reply_bodies(struct mo_request *request, const struct mo_fields *fields,
                         int (*check)(struct mo_json *json, void *parsed),
                         void (*make)(struct bodies *bodies))
{
  struct bodies bodies = {
      .parsed = {.count = 1, .children = 1, .rate = 1.0 / MO_DEFAULT_VOXELS, .seed = 1},
      .lattice = mo_api_of(request)->lattice,
      .random_stream = &mo_api_of(request)->random_stream};
  struct mo_parts *parts = &bodies.parsed.parts;
  mo_read_words(request->body, request->body_size, &mo_design_rules_fields, parts, NULL);
  if (mo_read_request(request, fields, &bodies.parsed, parts, check, "body")) {
    bodies.places = places_of(&bodies.parsed, bodies.lattice->workspace);
    mo_text_add(&bodies.text, "{\"items\":[");
    if (bodies.places != NULL)
      make(&bodies);
    else
      bodies.error = MO_ERR_NO_MEMORY;
    mo_text_add(&bodies.text, "]}");
    mo_reply_text(request, bodies.error, &bodies.text, "body");
    free(bodies.places);
  }
  mo_parts_free(parts);
  free(bodies.parsed.pairs);
}

/* ---- random ---- */

static int check_random(struct mo_json *json, void *any)
{
  const struct parsed *parsed = any;
  if (parsed->first + parsed->count > MO_RANDOM_BODIES_MAX)
    mo_json_fault_at(
        json, 0, "/first",
        "bodies %u to %u are out of range; a seed has bodies 0 to %d, so use another seed",
        parsed->first, parsed->first + parsed->count - 1, MO_RANDOM_BODIES_MAX - 1);
  return MO_OK;
}

/* Takes the kept stream if it is at the request's first body or before it. Otherwise opens a new
 * one. Whether a body is new depends on all earlier ones, so those are drawn as well, which takes
 * about 6 µs each. */
static int take_stream(struct mo_random_stream *kept, const struct parsed *parsed,
                       struct mo_workspace workspace, struct mo_body_stream **stream)
{
  struct mo_bits passed;
  uint32_t next = 0;
  int error = MO_OK;
  *stream = NULL;
  pthread_mutex_lock(&kept->mutex);
  if (kept->stream != NULL && kept->seed == parsed->seed && kept->next <= parsed->first) {
    *stream = kept->stream;
    next = kept->next;
    kept->stream = NULL;
  }
  pthread_mutex_unlock(&kept->mutex);
  if (*stream == NULL)
    error = mo_body_stream_create(workspace, parsed->seed, stream);
  for (; next < parsed->first && error == MO_OK; next++)
    error = mo_body_stream_next(*stream, passed.words, NULL);
  return error;
}

/* Keeps the stream, which is now after the request's last body, instead of the previous one. */
static void keep_stream(struct mo_random_stream *kept, const struct parsed *parsed,
                        struct mo_body_stream *stream)
{
  pthread_mutex_lock(&kept->mutex);
  struct mo_body_stream *before = kept->stream;
  kept->stream = stream;
  kept->seed = parsed->seed;
  kept->next = parsed->first + parsed->count;
  pthread_mutex_unlock(&kept->mutex);
  mo_body_stream_free(before);
}

static void make_random(struct bodies *bodies)
{
  const struct mo_workspace workspace = bodies->lattice->workspace;
  struct mo_body_stream *stream;
  bodies->error = take_stream(bodies->random_stream, &bodies->parsed, workspace, &stream);
  for (uint32_t i = 0; i < bodies->parsed.count && bodies->error == MO_OK; i++) {
    struct mo_genotype genotype = {.workspace = workspace};
    bodies->error = mo_body_stream_next(stream, genotype.words, NULL);
    add(bodies, &genotype, NULL, 0, NULL);
  }
  if (bodies->error == MO_OK)
    keep_stream(bodies->random_stream, &bodies->parsed, stream);
  else
    mo_body_stream_free(stream);
}

void mo_api_post_random_bodies(struct mo_request *request)
{
  reply_bodies(request, &mo_random_request_fields, check_random, make_random);
}

/* ---- mutation ---- */

/* The parents that were not skipped, one round of their children, and all children made so far. */
struct brood {
  struct mo_campaign_settings settings;
  struct mo_seen *seen;
  uint32_t n;
  uint64_t *parents, *children; /* (n, W) */
  struct mo_birth *births;      /* (n) */
  struct mo_bits *made;         /* (rounds, n); empty: no new body was found */
};

static void brood_free(struct brood *brood)
{
  mo_seen_free(brood->seen);
  free(brood->parents);
  free(brood->children);
  free(brood->births);
  free(brood->made);
}

static int brood_create(struct brood *brood, const struct parsed *parsed,
                        struct mo_workspace workspace, const struct place *places)
{
  const size_t n = parsed->parts.n_designs;
  *brood = (struct brood){.settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO),
                          .parents = malloc((n + 1) * W * sizeof(uint64_t)),
                          .children = malloc((n + 1) * W * sizeof(uint64_t)),
                          .births = malloc((n + 1) * sizeof(*brood->births)),
                          .made = calloc(n * parsed->children + 1, sizeof(*brood->made))};
  brood->settings.workspace = workspace;
  brood->settings.seed = parsed->seed;
  brood->settings.population = (uint32_t)n;
  brood->settings.mutation_share = 1;
  brood->settings.mutation_rate = parsed->rate;
  if (brood->parents == NULL || brood->children == NULL || brood->births == NULL ||
      brood->made == NULL)
    return MO_ERR_NO_MEMORY;
  int error = mo_seen_create(workspace, NULL, &brood->seen);
  for (uint32_t i = 0; i < n_given(parsed) && error >= 0; i++)
    if (!is_empty(&places[i])) {
      memcpy(brood->parents + W * brood->n++, places[i].genotype.words, W * sizeof(uint64_t));
      error = mo_seen_add(brood->seen, places[i].genotype.words);
    }
  return error < 0 ? error : MO_OK;
}

/* Makes one child of each parent that differs from all parents and from all other children. */
static int brood_bear(struct brood *brood, uint32_t round)
{
  struct mo_variation_counts counts;
  uint32_t n = 0;
  const int error = mo_variation(&brood->settings, round + 1, brood->parents, brood->n, brood->seen,
                                 brood->children, brood->births, &n, &counts, NULL);
  for (uint32_t i = 0; i < n; i++)
    memcpy(brood->made[(size_t)round * brood->n + brood->births[i].parents[0]].words,
           brood->children + (size_t)W * i, W * sizeof(uint64_t));
  return error;
}

static void write_children(struct bodies *bodies, const struct brood *brood)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < n_given(&bodies->parsed); i++) {
    const struct place *place = &bodies->places[i];
    for (uint32_t round = 0; round < bodies->parsed.children; round++) {
      const struct mo_genotype child =
          mo_genotype_of(bodies->lattice->workspace, &brood->made[(size_t)round * brood->n + n]);
      if (is_empty(place))
        add(bodies, &place->genotype, &i, 1, place->note);
      else if (mo_genotype_count(child.workspace, child.words) == 0)
        add_none(bodies, &i, 1, "/children", "no more bodies were found");
      else
        add(bodies, &child, &i, 1, place->note);
    }
    n += !is_empty(place);
  }
}

static void make_children(struct bodies *bodies)
{
  struct brood brood;
  bodies->error = brood_create(&brood, &bodies->parsed, bodies->lattice->workspace, bodies->places);
  for (uint32_t round = 0; round < bodies->parsed.children && bodies->error == MO_OK; round++)
    bodies->error = brood_bear(&brood, round);
  if (bodies->error == MO_OK)
    write_children(bodies, &brood);
  brood_free(&brood);
}

void mo_api_post_mutated_bodies(struct mo_request *request)
{
  reply_bodies(request, &mo_mutation_request_fields, check_designs, make_children);
}

/* ---- crossing ---- */

static void make_crossed(struct bodies *bodies)
{
  for (uint32_t i = 0; i < bodies->parsed.n_pairs && bodies->error == MO_OK; i++) {
    const struct pair pair = bodies->parsed.pairs[i];
    const uint32_t parents[2] = {pair.first, pair.second};
    const struct place *first = &bodies->places[pair.first], *second = &bodies->places[pair.second];
    struct mo_genotype child = {.workspace = bodies->lattice->workspace};
    char pointer[32];
    snprintf(pointer, sizeof(pointer), "/pairs/%u", i);
    if (is_empty(first) || is_empty(second)) {
      add(bodies, &(struct mo_genotype){.words = {0}}, parents, 2,
          is_empty(first) ? first->note : second->note);
      continue;
    }
    const int error = mo_genotype_crossover(child.workspace, first->genotype.words,
                                            second->genotype.words, child.words);
    if (error == MO_ERR_EMPTY)
      add_none(bodies, parents, 2, pointer,
               "the parents are equal, so their child would be empty: a child has only the voxels "
               "that exactly one parent has");
    else if (error == MO_OK)
      add(bodies, &child, parents, 2, NULL);
    else
      bodies->error = error;
  }
}

void mo_api_post_crossed_bodies(struct mo_request *request)
{
  reply_bodies(request, &mo_crossing_request_fields, check_pairs, make_crossed);
}

/* ---- canonical forms ---- */

static void make_canonical(struct bodies *bodies)
{
  for (uint32_t i = 0; i < n_given(&bodies->parsed); i++) {
    const struct place *place = &bodies->places[i];
    const struct mo_genotype form = mo_genotype_form(&place->genotype);
    add(bodies, &form, NULL, 0, place->note);
  }
}

void mo_api_post_canonical_bodies(struct mo_request *request)
{
  reply_bodies(request, &mo_canonical_request_fields, check_designs, make_canonical);
}
