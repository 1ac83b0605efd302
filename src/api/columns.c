/* columns.c: see columns.h. */
#include "api/columns.h"

#include <inttypes.h>
#include <math.h>
#include <string.h>

#include "store/campaigns.h"
#include "store/trainings.h"

/* ---- writing ---- */

/* Writes a value. csv: a flag is a digit, a word has no quotes, and no number is no text. */
static void write_value(struct mo_text *text, const struct mo_column *column, const void *row,
                        bool csv)
{
  const void *value = (const char *)row + column->offset;
  switch (column->type) {
  case MO_COLUMN_COUNT: mo_text_format(text, "%" PRIu32, *(const uint32_t *)value); break;
  case MO_COLUMN_LONG: mo_text_format(text, "%" PRIu64, *(const uint64_t *)value); break;
  case MO_COLUMN_NUMBER:
    if (!csv || isfinite(*(const double *)value))
      mo_text_json_number(text, *(const double *)value);
    break;
  case MO_COLUMN_FLAG:
    mo_text_add(text, csv ? (*(const bool *)value ? "1" : "0")
                          : (*(const bool *)value ? "true" : "false"));
    break;
  case MO_COLUMN_WORD:
    mo_text_format(text, csv ? "%s" : "\"%s\"", column->words[*(const bool *)value]);
    break;
  }
}

/* Returns the length of the objects' part that two paths share, up to and with a dot. */
static size_t shared_part(const char *one, const char *other)
{
  size_t shared = 0;
  for (size_t i = 0; one[i] != '\0' && one[i] == other[i]; i++)
    if (one[i] == '.')
      shared = i + 1;
  return shared;
}

static void close_objects(struct mo_text *text, const char *path)
{
  for (; *path != '\0'; path++)
    if (*path == '.')
      mo_text_add(text, "}");
}

void mo_columns_json(struct mo_text *text, const struct mo_columns *columns, const void *row)
{
  const char *open = "";
  if (row == NULL) {
    mo_text_add(text, "null");
    return;
  }
  mo_text_object(text);
  for (size_t i = 0; i < columns->n; i++) {
    const char *path = columns->items[i].path;
    size_t shared = shared_part(open, path);
    close_objects(text, open + shared);
    path += shared;
    for (size_t n; path[n = strcspn(path, ".")] == '.'; path += n + 1) {
      mo_text_next(text);
      mo_text_format(text, "\"%.*s\":{", (int)n, path);
    }
    mo_text_name(text, path);
    write_value(text, &columns->items[i], row, false);
    open = columns->items[i].path;
  }
  close_objects(text, open);
  mo_text_add(text, "}");
}

void mo_columns_csv(struct mo_text *text, const struct mo_columns *columns, const void *row)
{
  for (size_t i = 0; i < columns->n; i++) {
    mo_text_add(text, i > 0 ? "," : "");
    write_value(text, &columns->items[i], row, true);
  }
  mo_text_add(text, "\n");
}

void mo_columns_heading(struct mo_text *text, const struct mo_columns *columns)
{
  for (size_t i = 0; i < columns->n; i++) {
    const struct mo_column *column = &columns->items[i];
    mo_text_format(text, "%s%s", i > 0 ? "," : "",
                   column->csv != NULL ? column->csv : column->path);
  }
  mo_text_bytes(text, "\n", 1);
}

/* ---- steps of learning ---- */

#define COUNT  MO_COLUMN_COUNT
#define LONG   MO_COLUMN_LONG
#define NUMBER MO_COLUMN_NUMBER
#define FLAG   MO_COLUMN_FLAG
#define COLUMNS(list)                                                                              \
  {                                                                                                \
    list, sizeof(list) / sizeof((list)[0])                                                         \
  }

/* What a step of learning did, in the rows of trainings and campaigns. */
#define REPORT(row)                                                                                \
  {"mean_loss", NUMBER, offsetof(row, report.mean_loss)},                                          \
      {"rate", NUMBER, offsetof(row, report.rate)},                                                \
      {"gradient_norm", NUMBER, offsetof(row, report.gradient_norm)},                              \
      {"clipped_share", NUMBER, offsetof(row, report.clipped_share)},                              \
      {"clipped_robots_share", NUMBER, offsetof(row, report.clipped_robots_share)},                \
      {"diverged", COUNT, offsetof(row, report.diverged)},                                         \
      {"zeroed", COUNT, offsetof(row, report.zeroed)},                                             \
      {"skipped", FLAG, offsetof(row, report.skipped)},                                            \
      {"bounded", COUNT, offsetof(row, report.bounded)},                                           \
  {                                                                                                \
    "seconds", NUMBER, offsetof(row, seconds)                                                      \
  }

static const struct mo_column step_columns[] = {
    {"step", COUNT, offsetof(struct mo_training_step_row, report.step)},
    REPORT(struct mo_training_step_row),
};
const struct mo_columns mo_step_columns = COLUMNS(step_columns);

static const struct mo_column campaign_step_columns[] = {
    {"generation", COUNT, offsetof(struct mo_campaign_step, generation)},
    {"step", COUNT, offsetof(struct mo_campaign_step, step)},
    {"on", MO_COLUMN_WORD, offsetof(struct mo_campaign_step, on_children),
     .words = {"parents", "children"}},
    REPORT(struct mo_campaign_step),
};
const struct mo_columns mo_campaign_step_columns = COLUMNS(campaign_step_columns);

#define AT(member) offsetof(struct mo_training_validation_row, member)
static const struct mo_column validation_columns[] = {
    {"step", COUNT, AT(step)},
    {"mean_score", NUMBER, AT(mean_score)},
    {"standard_error", NUMBER, AT(standard_error)},
    {"rollouts", COUNT, AT(rollouts)},
    {"diverged", COUNT, AT(diverged)},
};
#undef AT
const struct mo_columns mo_validation_columns = COLUMNS(validation_columns);

/* ---- generations ---- */

/* The least, mean and most of a number; `at` is the offset of its struct mo_spread. */
#define SPREAD(name, at)                                                                           \
  {name ".least", NUMBER, (at) + offsetof(struct mo_spread, least), name "_least"},                \
      {name ".mean", NUMBER, (at) + offsetof(struct mo_spread, mean), name "_mean"},               \
  {                                                                                                \
    name ".most", NUMBER, (at) + offsetof(struct mo_spread, most), name "_most"                    \
  }

#define AT(member) offsetof(struct mo_campaign_generation, member)
static const struct mo_column generation_columns[] = {
    {"generation", COUNT, AT(generation)},
    {"population", COUNT, AT(stats.n)},
    {"born", COUNT, AT(n_children)},
    {"first_number", LONG, AT(born_before)},
    {"score.mean", NUMBER, AT(stats.mean_score), "mean"},
    {"score.quantiles.p0", NUMBER, AT(stats.quantiles[0]), "p0"},
    {"score.quantiles.p5", NUMBER, AT(stats.quantiles[1]), "p5"},
    {"score.quantiles.p25", NUMBER, AT(stats.quantiles[2]), "p25"},
    {"score.quantiles.p50", NUMBER, AT(stats.quantiles[3]), "p50"},
    {"score.quantiles.p75", NUMBER, AT(stats.quantiles[4]), "p75"},
    {"score.quantiles.p95", NUMBER, AT(stats.quantiles[5]), "p95"},
    {"score.quantiles.p100", NUMBER, AT(stats.quantiles[6]), "p100"},
    {"score.diverged", COUNT, AT(stats.n_diverged), "diverged"},
    {"diversity", NUMBER, AT(stats.diversity)},
    {"species", COUNT, AT(stats.species)},
    {"turnover", NUMBER, AT(turnover)},
    {"operators.mutation.born", COUNT, AT(variation.mutants), "mutation_born"},
    {"operators.mutation.survived", COUNT, AT(survived_mutants), "mutation_survived"},
    {"operators.mutation.attempts", LONG, AT(variation.mutation_attempts), "mutation_attempts"},
    {"operators.crossover.born", COUNT, AT(variation.recombinants), "crossover_born"},
    {"operators.crossover.survived", COUNT, AT(survived_recombinants), "crossover_survived"},
    {"operators.crossover.attempts", LONG, AT(variation.crossover_attempts), "crossover_attempts"},
    {"operators.fallbacks", COUNT, AT(variation.fallbacks), "fallbacks"},
    SPREAD("voxels", AT(stats.voxels)),
    SPREAD("footprint", AT(stats.footprint)),
    SPREAD("masses", AT(stats.masses)),
    SPREAD("springs", AT(stats.springs)),
    {"parents_mean", NUMBER, AT(mean_parents)},
    {"children_mean", NUMBER, AT(mean_children)},
    {"learning.steps", COUNT, AT(learning_steps), "learning_steps"},
    {"learning.first_loss", NUMBER, AT(first_loss), "first_loss"},
    {"learning.last_loss", NUMBER, AT(last_loss), "last_loss"},
    {"rollouts", LONG, AT(rollouts)},
    {"cached", LONG, AT(rollouts_cached)},
    {"rollouts_diverged", LONG, AT(rollouts_diverged)},
    {"exhausted", FLAG, AT(variation.exhausted)},
    {"collapse", FLAG, AT(collapse)},
    {"seconds", NUMBER, AT(seconds)},
};
#undef AT
const struct mo_columns mo_generation_columns = COLUMNS(generation_columns);
_Static_assert(MO_QUANTILES == 7, "one column for each quantile");

/* ---- replicates ---- */

#define AT(member) offsetof(struct mo_replicate_row, member)
static const struct mo_column replicate_columns[] = {
    {"generation", COUNT, AT(generation)}, {"campaigns", COUNT, AT(campaigns)},
    SPREAD("mean_score", AT(spread[0])),   SPREAD("best_score", AT(spread[1])),
    SPREAD("diversity", AT(spread[2])),
};
#undef AT
const struct mo_columns mo_replicate_columns = COLUMNS(replicate_columns);

void mo_replicate_add(struct mo_replicate_row *row, const struct mo_campaign_generation *of_one)
{
  const double numbers[MO_REPLICATE_NUMBERS] = {
      of_one->stats.mean_score, of_one->stats.quantiles[0], of_one->stats.diversity};
  row->generation = of_one->generation;
  row->campaigns++;
  for (int i = 0; i < MO_REPLICATE_NUMBERS; i++) {
    struct mo_spread *spread = &row->spread[i];
    if (!isfinite(numbers[i]))
      continue;
    if (row->n[i] == 0 || numbers[i] < spread->least)
      spread->least = numbers[i];
    if (row->n[i] == 0 || numbers[i] > spread->most)
      spread->most = numbers[i];
    spread->mean += numbers[i];
    row->n[i]++;
  }
}

void mo_replicate_finish(struct mo_replicate_row *row)
{
  for (int i = 0; i < MO_REPLICATE_NUMBERS; i++) {
    struct mo_spread *spread = &row->spread[i];
    spread->mean /= row->n[i]; /* of none: NaN */
    if (row->n[i] == 0)
      spread->least = spread->most = NAN;
  }
}
