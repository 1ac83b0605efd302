/* evaluations.h: evaluations as jobs: submission. A score that is in the store, or that another
 * evaluation is computing, is not recomputed. A crash loses only the blocks in flight
 * (evaluation.c). */
#ifndef MORPHO_JOBS_EVALUATIONS_H
#define MORPHO_JOBS_EVALUATIONS_H

#include "jobs/jobs.h"

/* MO_BACK_END_AUTO chooses devices for a float32 batch job of at least this many rollouts that
 * neither records nor verifies. */
#define MO_DEVICE_ROLLOUTS_MIN 1000

/* Submits an evaluation and returns after the commit. *id: the job. *replayed: the key was known
 * with the same body, and *id is the earlier job. `message` describes the invalid value. controller
 * NULL: "default". priority −1: interactive if there are at most 64 rollouts, and they are not for
 * devices. back_end: MO_BACK_END_AUTO is also allowed.
 * - MO_ERR_INVALID, MO_ERR_RANGE: a value breaks this contract
 * - MO_ERR_NOT_FOUND: no such controller or set
 * - MO_ERR_CONFLICT: the key was used with a different body
 * - MO_ERR_BUSY: the queue is full; try again later
 * - MO_ERR_LIMIT: the job would record more than max_recorded_bytes
 * - MO_ERR_NO_SPACE: the disk is full; try again later
 * - MO_ERR_CANCELLED: `jobs` is stopping
 * - MO_ERR_UNSUPPORTED: the controller is for a different workspace
 * - MO_ERR_DEVICE: no device works, or devices cannot do this (float64, recordings, interactive) */
int mo_jobs_submit_evaluation(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                              int64_t *id, bool *replayed, struct mo_message *message);

#endif
