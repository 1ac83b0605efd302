/* replicates.h: one generation over several campaigns: the minimum, mean and maximum of each number
 * over the campaigns in which it is finite. Begin with zeros, add the campaigns, and finish. */
#ifndef MORPHO_API_REPLICATES_H
#define MORPHO_API_REPLICATES_H

#include <morpho/evolution.h>

#include "store/columns.h"

#define MO_REPLICATE_NUMBERS 3 /* mean score, best score, diversity */
struct mo_campaign_generation;
struct mo_replicate_row {
  uint32_t generation, campaigns;
  struct mo_spread spread[MO_REPLICATE_NUMBERS]; /* mean: the sum, until the row is finished */
  uint32_t n[MO_REPLICATE_NUMBERS];
};
extern const struct mo_columns mo_replicate_columns; /* struct mo_replicate_row */
void mo_replicate_add(struct mo_replicate_row *row, const struct mo_campaign_generation *of_one);
void mo_replicate_finish(struct mo_replicate_row *row);

#endif
