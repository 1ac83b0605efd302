/* own_score.h: a score that is not the mean loss, as the settings name it: the client of a study
 * computes it, or it is a measure (select_by.h). */
#ifndef MORPHO_STORE_OWN_SCORE_H
#define MORPHO_STORE_OWN_SCORE_H

#include "base/fields.h"

/* Limit of |score|: it fits in a float32, and sums do not overflow. */
#define MO_OWN_SCORE_MAX      1e30
#define MO_OWN_SCORE_NAME_MAX 32 /* letters of A-Z, a-z, 0-9, '_', '.' and '-' */
#define MO_OWN_SCORE_UNIT_MAX 16 /* characters, in UTF-8 */

/* The designs of such a study are ranked by what the client sends; the service stores its own
 * losses alongside, and never ranks by them. Lower is better, as for every score. */
struct mo_own_score {
  char name[MO_OWN_SCORE_NAME_MAX + 1];     /* "": the service computes the scores */
  char unit[4 * MO_OWN_SCORE_UNIT_MAX + 1]; /* "": a pure number */
};

bool mo_own_score_is_set(const struct mo_own_score *own);
bool mo_own_score_equal(const struct mo_own_score *one, const struct mo_own_score *other);

/* An object with `name` and `unit`, or null. */
extern const struct mo_fields mo_own_score_fields;
extern const struct mo_field_own mo_own_score_field;

#endif
