/* training_json.h: writes trainings as JSON and CSV, as in the contract. */
#ifndef MORPHO_API_TRAINING_JSON_H
#define MORPHO_API_TRAINING_JSON_H

#include "base/text.h"
#include "jobs/trainings.h"

/* Writes a training. live: its current live state. population_kind: the kind of the job
 * record.population, if there is one. */
void mo_training_json_write(struct mo_text *text, const struct mo_training_status *status,
                            enum mo_job_kind population_kind, const struct mo_live *live);
/* Writes a training as an item of the list of jobs. status: struct mo_training_status. */
void mo_training_json_job(struct mo_text *text, const void *status, const struct mo_live *live);

#endif
