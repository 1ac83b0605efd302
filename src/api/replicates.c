/* replicates.c: see replicates.h. */
#include "api/replicates.h"

#include <math.h>

#include "store/campaigns.h"

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
    spread->mean /= row->n[i]; /* NaN without values */
    if (row->n[i] == 0)
      spread->least = spread->most = NAN;
  }
}
