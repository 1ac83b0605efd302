/* factors.h: factors of an environment, and ranges of them, as tables of fields. */
#ifndef MORPHO_WORLD_FACTORS_H
#define MORPHO_WORLD_FACTORS_H

#include <morpho/world.h>

#include "base/fields.h"

/* For struct mo_factors that are given, and for struct mo_factor_ranges. */
extern const struct mo_fields mo_factor_fields, mo_factor_range_fields;

/* Also refuses factors that are all 1 but given: such an environment would have another hash than
 * the same one without factors. MO_ERR_INVALID, MO_ERR_RANGE. */
int mo_factors_check(const struct mo_factors *factors);
/* Returns the factors, or none if all are 1. */
struct mo_factors mo_factors_simplest(const struct mo_factors *factors);
/* Returns whether any factor varies. */
bool mo_factors_vary(const struct mo_factor_ranges *ranges);
/* The ends of the ranges: all lowest, all highest. */
void mo_factors_ends(const struct mo_factor_ranges *ranges, struct mo_factors ends[2]);

#endif
