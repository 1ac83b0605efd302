/* measures.h: rounding of measures: their values are whole multiples of a step. */
#ifndef MORPHO_WORLD_MEASURES_H
#define MORPHO_WORLD_MEASURES_H

#include <stdbool.h>

#include <morpho/measure.h>

/* Rounds a value to a whole multiple of the measure's step; never −0. NaN stays NaN. */
double mo_measure_round(unsigned measure, double value);
/* Returns whether a value is finite and such a multiple. */
bool mo_measure_is_round(unsigned measure, double value);

#endif
