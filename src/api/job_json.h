/* job_json.h: writes jobs and evaluations as JSON, as in the contract. */
#ifndef MORPHO_API_JOB_JSON_H
#define MORPHO_API_JOB_JSON_H

#include "base/text.h"
#include "store/store.h"

void mo_bits_write(struct mo_text *text, const struct mo_bits *bits); /* the genotype in quotes */
void mo_bits_write_id(struct mo_text *text, const struct mo_bits *form); /* the id in quotes */
void mo_bits_write_bare(struct mo_text *text,
                        const struct mo_bits *bits); /* the genotype without quotes */
void mo_bits_write_id_bare(struct mo_text *text, const struct mo_bits *form);
void mo_hash_write(struct mo_text *text, const struct mo_sha256 *hash); /* in quotes */
/* Writes a controller as an object of name ("": null) and hash. */
void mo_reference_write(struct mo_text *text, const char *name, const struct mo_sha256 *sha256);
/* True for a job that is paused because no device is available to compute it. */
bool mo_job_lacks_device(const struct mo_job *job);

/* Writes the members that jobs of every kind have, from state to error. state: the one to show. */
void mo_job_write_common(struct mo_text *text, const struct mo_job *job, enum mo_job_state state);
/* Writes an evaluation. results nullable: without them. */
void mo_job_write(struct mo_text *text, const struct mo_job *job,
                  const struct mo_evaluation_results *results);
/* Writes a loss or score: null when it is not finite. */
void mo_loss_write(struct mo_text *text, double loss);

#endif
