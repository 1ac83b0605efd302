/* fields.h: the settings of campaigns as tables of fields. */
#ifndef MORPHO_EVOLUTION_FIELDS_H
#define MORPHO_EVOLUTION_FIELDS_H

#include <morpho/evolution.h>

#include "base/fields.h"

/* For struct mo_campaign_settings: population, variation, selection, physics. */
extern const struct mo_fields mo_campaign_fields;
/* For the same struct: `aggregate` alone. It is not stored with campaigns that score by the mean.
 */
extern const struct mo_fields mo_campaign_aggregate_fields;
/* For the same struct: the settings that only campaigns with learning have, including the members
 * of `learning`. */
extern const struct mo_fields mo_campaign_learning_fields;
/* For enum mo_campaign_mode. */
extern const char *const mo_campaign_mode_words[];

#endif
