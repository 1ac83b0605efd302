/* job_json.h: jobs and evaluations as the contract writes them. */
#ifndef MORPHO_HTTP_JOB_JSON_H
#define MORPHO_HTTP_JOB_JSON_H

#include "http/text.h"
#include "store/store.h"

void mo_bits_write(struct mo_text *text, const struct mo_bits *bits); /* the genotype in quotes */
void mo_bits_write_id(struct mo_text *text, const struct mo_bits *form); /* the id in quotes */
void mo_bits_write_bare(struct mo_text *text,
                        const struct mo_bits *bits); /* the same without quotes */
void mo_bits_write_id_bare(struct mo_text *text, const struct mo_bits *form);
void mo_hash_write(struct mo_text *text, const struct mo_sha256 *hash); /* in quotes */
/* The members that jobs of every kind have, from state to error. state: as it is shown. */
/* It is paused because no device is there to compute it. */
bool mo_job_lacks_device(const struct mo_job *job);

void mo_job_write_common(struct mo_text *text, const struct mo_job *job, enum mo_job_state state);
/* An evaluation; results nullable: then without them. */
void mo_job_write(struct mo_text *text, const struct mo_job *job,
                  const struct mo_evaluation_results *results);
void mo_physics_write(struct mo_text *text, const struct mo_physics *physics); /* the object */
/* A loss or score: null when it is not finite. */
void mo_loss_write(struct mo_text *text, double loss);

#endif
