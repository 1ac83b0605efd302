/* job_json.h: writes jobs and evaluations as JSON, as in the contract. */
#ifndef MORPHO_API_JOB_JSON_H
#define MORPHO_API_JOB_JSON_H

#include "base/text.h"
#include "jobs/live.h"
#include "store/store.h"

void mo_bits_write(struct mo_text *text, const struct mo_bits *bits); /* the genotype in quotes */
void mo_bits_write_id(struct mo_text *text, const struct mo_bits *form); /* the id in quotes */
void mo_bits_write_bare(struct mo_text *text,
                        const struct mo_bits *bits); /* the genotype without quotes */
void mo_bits_write_id_bare(struct mo_text *text, const struct mo_bits *form);
void mo_hash_write(struct mo_text *text, const struct mo_sha256 *hash); /* in quotes */
/* Write further members of an object; null where the value is not known. */
void mo_member_text(struct mo_text *text, const char *name, const char *words); /* NULL: null */
void mo_member_count_if(struct mo_text *text, const char *name, bool known, uint64_t count);
void mo_member_number_if(struct mo_text *text, const char *name, bool known, double number);
/* Write a controller as an object of name ("": null) and hash, or as a further member. */
void mo_controller_write(struct mo_text *text, const char *name, const struct mo_sha256 *sha256);
void mo_reference_write(struct mo_text *text, const char *member, bool known, const char *name,
                        const struct mo_sha256 *sha256);

/* Returns the state to show: a running job that waits for disk space is shown as paused. */
enum mo_job_state mo_job_state_shown(const struct mo_job *job, const struct mo_live *live);
/* Writes the members that jobs of every kind have, from state to error, and why a training or
 * campaign makes no progress. */
void mo_job_write_head(struct mo_text *text, const struct mo_job *job, const struct mo_live *live);
/* Returns the name that the resulting controller has or will have. */
#define MO_MADE_BYTES 40
const char *mo_result_name(const struct mo_job *job, const char *asked, char made[MO_MADE_BYTES]);
/* Writes the paths of what belongs to a job. below: pairs of member and path, then NULL. */
void mo_links_write(struct mo_text *text, const struct mo_job *job, const char *const *below);
/* Writes an evaluation. results nullable: without them. */
void mo_job_write(struct mo_text *text, const struct mo_job *job,
                  const struct mo_evaluation_results *results);
/* Writes a loss or score: null when it is not finite. */
void mo_loss_write(struct mo_text *text, double loss);

#endif
