/* fields.h: the settings of campaigns as tables of fields. */
#ifndef MORPHO_EVOLUTION_FIELDS_H
#define MORPHO_EVOLUTION_FIELDS_H

#include <morpho/evolution.h>

#include "base/fields.h"

/* Of struct mo_campaign_settings: population, variation, selection, physics. */
extern const struct mo_fields mo_campaign_fields;
/* Of the same struct: what campaigns that learn add, with the members of `learning`. */
extern const struct mo_fields mo_campaign_learning_fields;
/* Of enum mo_campaign_mode. */
extern const char *const mo_campaign_mode_words[];

#endif
