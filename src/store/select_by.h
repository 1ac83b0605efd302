/* select_by.h: which measures the settings of a campaign name, and whether one of them is the
 * score. */
#ifndef MORPHO_STORE_SELECT_BY_H
#define MORPHO_STORE_SELECT_BY_H

#include <morpho/measure.h>

#include "store/own_score.h"

/* The measure that a campaign selects by, instead of the mean loss. The score is then the mean of
 * the measure over the environments, with its sign changed for `max`, because lower is better for
 * every score. A design without this mean has the score +infinity. */
enum mo_direction { MO_DIRECTION_MAX = 0, MO_DIRECTION_MIN = 1 };
struct mo_select_by {
  bool is_set;   /* false: select by the loss */
  int measure;   /* enum mo_measure */
  int direction; /* enum mo_direction */
};
/* Returns the score of a design from the mean of the measure; NaN: there is no mean. */
double mo_select_by_score(const struct mo_select_by *by, double mean);
/* Names this score as the campaign's own score: "-displacement_m" for `max`, with its unit. Sets no
 * name if the campaign selects by the loss. */
void mo_select_by_name(const struct mo_select_by *by, struct mo_own_score *own);

/* An object with `measure` and `direction`, or null. */
extern const struct mo_fields mo_select_by_fields;
extern const struct mo_field_own mo_select_by_field;

/* A set of measures as bits (uint32_t): true for all, or an array of their names. It is written as
 * an array. */
extern const struct mo_field_own mo_measures_field;

/* Computes the means over n environments of the measures of a set, in their order, and returns how
 * many there are. values: (n); means: (measures of the set). A mean is NaN if one of its numbers
 * is. */
uint32_t mo_measures_mean(uint32_t set, const double (*values)[MO_MEASURES], uint32_t n,
                          double *means);

#endif
