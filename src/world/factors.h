/* factors.h: factors of an environment, and ranges of variations, as tables of fields. */
#ifndef MORPHO_WORLD_FACTORS_H
#define MORPHO_WORLD_FACTORS_H

#include <morpho/world.h>

#include "base/fields.h"

/* For struct mo_factors that are given. */
extern const struct mo_fields mo_factor_fields;
/* For struct mo_factor_ranges: the factors; and all ranges. */
extern const struct mo_fields mo_factor_range_fields, mo_vary_fields;
/* "vary" of learning: null, or an object, in which replies leave out drop and slope if these do not
 * vary. */
extern const struct mo_field_own mo_vary_own;

/* Also rejects factors that are given but all 1: such an environment would have a different hash
 * from the same one without factors. MO_ERR_INVALID, MO_ERR_RANGE. */
int mo_factors_check(const struct mo_factors *factors);
/* Returns the factors, or factors that are not given if all are 1. */
struct mo_factors mo_factors_simplest(const struct mo_factors *factors);
/* Returns whether anything varies. */
bool mo_factors_vary(const struct mo_factor_ranges *ranges);
/* The ends of the ranges of factors: all lowest, all highest. */
void mo_factors_ends(const struct mo_factor_ranges *ranges, struct mo_factors ends[2]);

#endif
