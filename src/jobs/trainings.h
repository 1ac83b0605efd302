/* trainings.h: training runs as jobs: submission. By default one runs at a time
 * (max_active_trainings); the others wait in the order of their submission. After a crash a run
 * continues from its newest checkpoint and ends with the same weights, bit for bit (training.c). */
#ifndef MORPHO_JOBS_TRAININGS_H
#define MORPHO_JOBS_TRAININGS_H

#include "jobs/live.h"
#include "store/trainings.h"

/* Submits a training run, like mo_jobs_submit_evaluation; `message` has the details.
 * record.population: a succeeded evaluation, or a campaign for its newest population.
 * record.sample: bodies of an atlas.
 * - MO_ERR_NOT_FOUND: no such controller, population or atlas
 * - MO_ERR_CONFLICT: the key was used with a different body, the population has not succeeded, or
 *   the atlas is not complete or not the requested one
 * - MO_ERR_RANGE: there are too many designs, for the atlas or for a training run
 * - MO_ERR_UNSUPPORTED: the controller is for a different workspace */
int mo_jobs_submit_training(struct mo_jobs *jobs, const struct mo_training_request *request,
                            int64_t *id, bool *replayed, struct mo_message *message);

/* Returns the "morphod.version" that trained controllers record: the version in the configuration
 * with the fingerprint of the gradients. Lives as long as `jobs`. */
const char *mo_jobs_code_version(const struct mo_jobs *jobs, enum mo_back_end back_end);

/* The controller that a training run has made, and its file. */
struct mo_learned {
  struct mo_controller *controller;
  uint8_t *bytes;
  size_t size;
};
/* job: the training run's id. code: nullable. */
int mo_learned_create(const struct mo_jobs *jobs, const struct mo_job *job,
                      const struct mo_training *training, const struct mo_training_lineage *code,
                      struct mo_learned *learned);
void mo_learned_free(struct mo_learned *learned);

#endif
