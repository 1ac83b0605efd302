/* training_json.h: trainings as the contract writes them. */
#ifndef MORPHO_HTTP_TRAINING_JSON_H
#define MORPHO_HTTP_TRAINING_JSON_H

#include "http/text.h"
#include "jobs/trainings.h"

/* The state as it is shown: a running training that waits for room on the disk is paused. */
enum mo_job_state mo_training_state(const struct mo_training_status *status,
                                    const struct mo_training_live *live);

/* The training. live: of this moment. population_kind: of the job record.population, if there is
 * one. */
void mo_training_json_write(struct mo_text *text, const struct mo_training_status *status,
                            enum mo_job_kind population_kind, const struct mo_training_live *live);
/* The same as an item of the list of jobs. */
void mo_training_json_job(struct mo_text *text, const struct mo_training_status *status,
                          const struct mo_training_live *live);

/* Rows of the curves as objects, or as lines of CSV (numbers that are not finite: nothing) under
 * their heading. */
void mo_training_json_step(struct mo_text *text, const struct mo_training_step_row *row);
void mo_training_json_validation(struct mo_text *text,
                                 const struct mo_training_validation_row *row);
void mo_training_json_checkpoint(struct mo_text *text,
                                 const struct mo_training_checkpoint_row *row);
extern const char mo_training_csv_steps[], mo_training_csv_validations[];
void mo_training_csv_step(struct mo_text *text, const struct mo_training_step_row *row);
void mo_training_csv_validation(struct mo_text *text, const struct mo_training_validation_row *row);

/* Designs and environments as a request for an evaluation; physics nullable: the default.
 * genotypes: (n_designs), placed. */
void mo_held_out_write(struct mo_text *text, const struct mo_bits *genotypes, uint32_t n_designs,
                       const struct mo_environment *environments, uint32_t n_environments,
                       const struct mo_physics *physics);

#endif
