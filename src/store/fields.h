/* fields.h: tables of fields for the settings of training runs and campaigns. */
#ifndef MORPHO_STORE_FIELDS_H
#define MORPHO_STORE_FIELDS_H

#include "base/fields.h"
#include "store/records.h"

/* struct mo_training_record: the settings, and when to validate and to write checkpoints. */
extern const struct mo_fields mo_training_record_fields;
/* struct mo_campaign_record: the settings without `learning`. */
extern const struct mo_fields mo_campaign_record_fields;
/* struct mo_campaign_record: the members of `learning`. */
extern const struct mo_fields mo_campaign_record_learning_fields;

/* Writes the settings of a training run (struct mo_training_record) or a campaign (struct
 * mo_campaign_record) as the database stores them: a JSON object that preserves every number bit
 * for bit. */
void mo_settings_write(enum mo_job_kind kind, const void *record, struct mo_text *text);
/* Reads the settings into their record and leaves its other members unchanged. MO_ERR_CORRUPT. */
int mo_settings_read(enum mo_job_kind kind, const char *json, void *record);

#endif
