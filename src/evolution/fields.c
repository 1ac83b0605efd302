/* fields.c: see fields.h. */
#include "evolution/fields.h"

#include "evolution/kinds.h"
#include "learning/fields.h"
#include "rollout/physics.h"

const char *const mo_selection_words[] = {"truncation", "tournament", "novelty", "age-layered",
                                          NULL};
const char *const mo_racing_words[] = {"lossless", "off", NULL};

/* ---- workspace: [nx, ny, nz] ---- */

static void read_workspace(struct mo_json *json, void *value)
{
  const struct mo_workspace most = MO_DEFAULT_WORKSPACE;
  const int64_t limits[3] = {most.nx, most.ny, most.nz};
  int64_t sides[3] = {0};
  const unsigned depth = json->depth, before = json->faults->n;
  size_t given = 0;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json)) {
    if (given < 3)
      mo_json_integer(json, 1, limits[given], &sides[given]);
    else
      mo_json_skip(json);
    given++;
  }
  if (!json->stop && given != 3)
    mo_json_fault_at(json, depth, "", "must be 3 numbers (voxels along x, y and z), got %zu",
                     given);
  if (!json->stop && json->faults->n == before)
    *(struct mo_workspace *)value =
        (struct mo_workspace){(uint16_t)sides[0], (uint16_t)sides[1], (uint16_t)sides[2]};
}

static void write_workspace(struct mo_text *text, const void *value)
{
  const struct mo_workspace *workspace = value;
  mo_text_format(text, "[%u,%u,%u]", workspace->nx, workspace->ny, workspace->nz);
}

static int check_workspace(const char *name, const void *value, struct mo_message *message)
{
  const struct mo_workspace most = MO_DEFAULT_WORKSPACE, *w = value;
  if (w->nx < 1 || w->ny < 1 || w->nz < 1 || w->nx > most.nx || w->ny > most.ny || w->nz > most.nz)
    return mo_fail(message, MO_ERR_RANGE, "%s must be 1x1x1 to %ux%ux%u voxels, got %ux%ux%u", name,
                   most.nx, most.ny, most.nz, w->nx, w->ny, w->nz);
  return MO_OK;
}

static const struct mo_field_own workspace = {read_workspace, write_workspace, check_workspace};

/* ---- selection: a word, or an object with the settings of its kind ---- */

#define AT(member) offsetof(struct mo_selection, member)
static const struct mo_field selection_rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(kind), .words = mo_selection_words, .unit = "",
     .help = "scheme that decides which designs survive"},
    {"size", MO_FIELD_COUNT, 0, AT(tournament_size), .min = 2, .max = 64, .unit = "designs",
     .help = "tournament: number of designs drawn for each place"},
    {"weight", MO_FIELD_NUMBER, 0, AT(novelty_weight), .min = 0, .max = 1, .unit = "",
     .help = "novelty: weight of the novelty rank"},
    {"layers", MO_FIELD_COUNT, 0, AT(n_layers), .min = 2, .max = 16, .unit = "",
     .help = "age-layered: number of age layers"},
    {"age_gap", MO_FIELD_COUNT, 0, AT(age_gap), .min = 1, .max = 1000, .unit = "generations",
     .help = "age-layered: age limit of the youngest layer, in generations"},
};
#undef AT
static const struct mo_kind_rows selection_own[] = {{1, 0}, {1, 1}, {2, 1}, {3, 2}};
static const struct mo_kinds selection_kinds = {mo_selection_words, "selection by",
                                                MO_FIELDS(selection_rows), selection_own};

static void read_selection(struct mo_json *json, void *value)
{
  struct mo_selection read = *(const struct mo_selection *)value;
  if (mo_kinds_read(json, &selection_kinds, &read))
    *(struct mo_selection *)value = read;
}

static void write_selection(struct mo_text *text, const void *value)
{
  mo_kinds_write(text, &selection_kinds, value);
}

static int check_selection(const char *name, const void *value, struct mo_message *message)
{
  return mo_fields_check(&selection_kinds.fields, name, value, message);
}

static const struct mo_field_own selection = {read_selection, write_selection, check_selection};

/* ---- aggregate: a word, or an object with the settings of its kind ---- */

#define AT(member) offsetof(struct mo_aggregate, member)
static const struct mo_field aggregate_rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(kind), .words = mo_aggregate_words, .unit = "",
     .help = "how the losses of a design become its score"},
    {"level", MO_FIELD_NUMBER, 0, AT(level), .min = 0, .max = 1, .unit = "",
     .help = "quantile: its level; cvar: share of the losses that are not among the worst"},
    {"weight", MO_FIELD_NUMBER, 0, AT(weight), .min = 0, .max = 1000, .unit = "",
     .help = "mean-sd: weight of the standard deviation"},
};
#undef AT
static const struct mo_kind_rows aggregate_own[] = {{1, 0}, {1, 1}, {1, 1}, {2, 1}};
static const struct mo_kinds aggregate_kinds = {mo_aggregate_words, "the aggregate",
                                                MO_FIELDS(aggregate_rows), aggregate_own};

static void read_aggregate(struct mo_json *json, void *value)
{
  struct mo_aggregate read = *(const struct mo_aggregate *)value;
  if (mo_kinds_read(json, &aggregate_kinds, &read))
    *(struct mo_aggregate *)value = read;
}

static void write_aggregate(struct mo_text *text, const void *value)
{
  mo_kinds_write(text, &aggregate_kinds, value);
}

static int check_aggregate(const char *name, const void *value, struct mo_message *message)
{
  return mo_fields_check(&aggregate_kinds.fields, name, value, message);
}

static const struct mo_field_own aggregate = {read_aggregate, write_aggregate, check_aggregate};

/* ---- campaigns ---- */

#define AT(member) offsetof(struct mo_campaign_settings, member)
static const struct mo_field mutation_rows[] = {
    {"share", MO_FIELD_NUMBER, 0, AT(mutation_share), .min = 0, .max = 1, .unit = "",
     .help = "share of the population that mutates; the rest recombines"},
    {"rate", MO_FIELD_NUMBER, MO_FIELD_ABOVE_MIN | MO_FIELD_NULL, AT(mutation_rate), .min = 0,
     .max = 0.5, .unit = "",
     .help = "probability that a voxel flips (default: one voxel on average)"},
    {"growth", MO_FIELD_NUMBER, 0, AT(mutation_growth), .min = 1, .max = 2, .unit = "",
     .help = "factor of the rate after an attempt that produced nothing new"},
};
static const struct mo_fields mutation_fields = MO_FIELDS(mutation_rows);
static const struct mo_field campaign_rows[] = {
    {"population", MO_FIELD_COUNT, 0, AT(population), .min = MO_POPULATION_MIN,
     .max = MO_POPULATION_MAX, .unit = "designs", .help = "number of living designs"},
    {"generations", MO_FIELD_COUNT, 0, AT(generations), .min = 0, .max = MO_GENERATIONS_MAX,
     .unit = "generations", .help = "generations after the initial population"},
    {"seed", MO_FIELD_SEED, 0, AT(seed), .unit = "", .help = "seed of every random number"},
    {"workspace", MO_FIELD_OWN, 0, AT(workspace), .own = &workspace, .unit = "voxels",
     .help = "box that bodies must fit: [nx, ny, nz]"},
    {"mutation", MO_FIELD_GROUP, 0, 0, .group = &mutation_fields, .unit = "",
     .help = "how designs mutate"},
    {"selection", MO_FIELD_OWN, 0, AT(selection), .group = &selection_kinds.fields,
     .own = &selection, .unit = "",
     .help = "which designs survive: a kind, or an object with its settings"},
    {"racing", MO_FIELD_WORD, 0, AT(racing), .words = mo_racing_words, .unit = "",
     .help = "whether the scores of children that cannot survive are cut short"},
    {"exclude_pretraining", MO_FIELD_FLAG, 0, AT(exclude_pretraining), .unit = "",
     .help = "bodies that the controller was pretrained on are never born"},
    {"collapse_share", MO_FIELD_NUMBER, 0, AT(collapse_share), .min = 0, .max = 1, .unit = "",
     .help = "warn below this share of the largest diversity so far; 0: never"},
    {"physics", MO_FIELD_GROUP, 0, AT(physics), .group = &mo_physics_fields, .unit = "",
     .help = "constants of the world"},
};
const struct mo_fields mo_campaign_fields = MO_FIELDS(campaign_rows);
static const struct mo_field campaign_aggregate_rows[] = {
    {"aggregate", MO_FIELD_OWN, 0, AT(aggregate), .group = &aggregate_kinds.fields,
     .own = &aggregate, .unit = "",
     .help = "how losses become a score: a kind, or an object with its settings"},
};
const struct mo_fields mo_campaign_aggregate_fields = MO_FIELDS(campaign_aggregate_rows);
static const struct mo_field learning_rows[] = {
    {"parent_steps", MO_FIELD_COUNT, 0, AT(parent_steps), .min = 0, .max = MO_CAMPAIGN_STEPS_MAX,
     .unit = "steps", .help = "steps of learning on the parents in each generation"},
    {"child_steps", MO_FIELD_COUNT, 0, AT(child_steps), .min = 0, .max = MO_CAMPAIGN_STEPS_MAX,
     .unit = "steps", .help = "steps of learning on the children in each generation"},
    {"batch", MO_FIELD_COUNT, MO_FIELD_NULL, AT(batch), .min = 1, .max = MO_TRAINING_BATCH_MAX,
     .unit = "robots", .help = "robots in each step (default: the population)"},
    {NULL, MO_FIELD_INLINE, 0, AT(learning), .group = &mo_learning_fields},
    {"sensor", MO_FIELD_WORD, MO_FIELD_NULL, AT(sensor), .words = mo_sensor_words, .unit = "",
     .help = "sensor of a controller that starts from random weights"},
};
#undef AT
const struct mo_fields mo_campaign_learning_fields = MO_FIELDS(learning_rows);
