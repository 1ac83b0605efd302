/* fields.h: tables of fields for the settings of trainings and campaigns. */
#ifndef MORPHO_STORE_FIELDS_H
#define MORPHO_STORE_FIELDS_H

#include "base/fields.h"

/* struct mo_training_record: the settings, and when to validate and to write checkpoints. */
extern const struct mo_fields mo_training_record_fields;
/* struct mo_campaign_record: the settings without `learning`. */
extern const struct mo_fields mo_campaign_record_fields;
/* struct mo_campaign_record: the members of `learning`. */
extern const struct mo_fields mo_campaign_record_learning_fields;

#endif
