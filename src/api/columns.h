/* columns.h: rows of numbers as JSON, written from their list of columns (store/columns.h). */
#ifndef MORPHO_API_COLUMNS_H
#define MORPHO_API_COLUMNS_H

#include <morpho/evolution.h>

#include "base/text.h"
#include "store/columns.h"

/* Writes the row as an object; NULL: null. */
void mo_columns_json(struct mo_text *text, const struct mo_columns *columns, const void *row);
/* Writes the members of this object alone. */
void mo_columns_members(struct mo_text *text, const struct mo_columns *columns, const void *row);

extern const struct mo_columns mo_replicate_columns; /* struct mo_replicate_row */

/* One generation over several campaigns: the least, mean and most of each number over the campaigns
 * in which it is finite. Begin with zeros, add the campaigns, and finish. */
#define MO_REPLICATE_NUMBERS 3 /* mean score, best score, diversity */
struct mo_campaign_generation;
struct mo_replicate_row {
  uint32_t generation, campaigns;
  struct mo_spread spread[MO_REPLICATE_NUMBERS]; /* mean: the sum, until the row is finished */
  uint32_t n[MO_REPLICATE_NUMBERS];
};
void mo_replicate_add(struct mo_replicate_row *row, const struct mo_campaign_generation *of_one);
void mo_replicate_finish(struct mo_replicate_row *row);

#endif
