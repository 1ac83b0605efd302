/* columns.c: see columns.h. */
#include "api/columns.h"

#include <inttypes.h>
#include <math.h>
#include <string.h>

#include "store/campaigns.h"

/* ---- writing ---- */

static void write_value(struct mo_text *text, const struct mo_column *column, const void *row)
{
  const void *value = (const char *)row + column->offset;
  switch (column->type) {
  case MO_COLUMN_COUNT: mo_text_format(text, "%" PRIu32, *(const uint32_t *)value); break;
  case MO_COLUMN_LONG: mo_text_format(text, "%" PRIu64, *(const uint64_t *)value); break;
  case MO_COLUMN_NUMBER: mo_text_json_number(text, *(const double *)value); break;
  case MO_COLUMN_FLAG: mo_text_add(text, *(const bool *)value ? "true" : "false"); break;
  case MO_COLUMN_WORD: mo_text_format(text, "\"%s\"", column->words[*(const bool *)value]); break;
  case MO_COLUMN_TIME: break; /* is not shown */
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

void mo_columns_members(struct mo_text *text, const struct mo_columns *columns, const void *row)
{
  const char *open = "";
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
    write_value(text, &columns->items[i], row);
    open = columns->items[i].path;
  }
  close_objects(text, open);
}

void mo_columns_json(struct mo_text *text, const struct mo_columns *columns, const void *row)
{
  if (row == NULL) {
    mo_text_add(text, "null");
    return;
  }
  mo_text_object(text);
  mo_columns_members(text, columns, row);
  mo_text_add(text, "}");
}

/* ---- replicates ---- */

#define AT(member) offsetof(struct mo_replicate_row, member)
static const struct mo_column replicate_columns[] = {
    {"generation", MO_COLUMN_COUNT, AT(generation)}, {"campaigns", MO_COLUMN_COUNT, AT(campaigns)},
    MO_SPREAD_COLUMNS("mean_score", AT(spread[0])),  MO_SPREAD_COLUMNS("best_score", AT(spread[1])),
    MO_SPREAD_COLUMNS("diversity", AT(spread[2])),
};
#undef AT
const struct mo_columns mo_replicate_columns = MO_COLUMNS(replicate_columns, 0);

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
