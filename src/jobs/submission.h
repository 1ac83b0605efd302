/* submission.h: the common parts of all submissions. */
#ifndef MORPHO_JOBS_SUBMISSION_H
#define MORPHO_JOBS_SUBMISSION_H

#include "jobs/state.h"
#include "store/designs.h"
#include "store/runner.h"

/* A submission in progress. */
struct mo_submitting {
  enum mo_job_kind kind;
  const struct mo_submission *request;
  const char *controller; /* name, for messages; nullable */
  uint32_t n_jobs;        /* number of jobs that the submission creates */
  uint64_t rollouts;
};
/* Checks whether the key is known. Known keys are answered even if the queue is full or no device
 * works any longer. *replayed: *id is the earlier job, and nothing is left to do. */
int mo_submitting_begin(struct mo_jobs *jobs, const struct mo_submitting *submitting, int64_t *id,
                        bool *replayed, struct mo_message *message);
/* Ends a submission that mo_jobs_admit has admitted, after the store has returned `error`. */
int mo_submitting_end(struct mo_jobs *jobs, const struct mo_submitting *submitting, int error,
                      bool replayed, struct mo_message *message);

/* Designs as they are stored; free both arrays with mo_placed_free. */
struct mo_placed {
  struct mo_bits *forms;     /* (n) canonical */
  struct mo_bits *genotypes; /* (n) placed */
};
/* Places every genotype, each of which is a body, and finds its canonical form.
 * MO_ERR_NO_MEMORY. */
int mo_placed_create(struct mo_workspace workspace, const struct mo_bits *asked, uint32_t n,
                     struct mo_placed *placed);
void mo_placed_free(struct mo_placed *placed);
/* Orients designs that came as an id only, like mo_store_orient, and completes their notes. The
 * class in `under` is the class of the back end. */
int mo_placed_orient(struct mo_jobs *jobs, const struct mo_orienting *under,
                     enum mo_back_end back_end, struct mo_placed *placed, uint32_t n,
                     struct mo_design_note *notes, uint32_t n_notes, struct mo_message *message);

/* Same, for the designs of an evaluation. Its back end must already be chosen. */
int mo_evaluation_orient(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                         struct mo_placed *placed, struct mo_message *message);

/* Reads the size of a named set or suite. MO_ERR_NOT_FOUND, with a message. */
int mo_environments_count(struct mo_jobs *jobs, const char *set, uint32_t *n,
                          struct mo_message *message);
/* Returns whether rollouts take at most about a second of one core, as interactive ones must.
 * springs: total over all designs. */
bool mo_is_short(uint32_t n_designs, uint64_t springs, uint32_t n_environments,
                 const struct mo_physics *physics, enum mo_precision precision);

/* ---- admission.c: the open jobs of all kinds ---- */
/* Returns the rollouts that a job was admitted with: those with half the step count twice. */
uint64_t mo_job_admitted(const struct mo_job *job);
int mo_jobs_admit(struct mo_jobs *jobs, uint32_t n_jobs, uint64_t rollouts,
                  struct mo_message *message); /* MO_ERR_BUSY */
/* Subtracts jobs that are no longer open. */
void mo_jobs_closed(struct mo_jobs *jobs, uint32_t n_jobs, uint64_t rollouts);
int mo_jobs_recount(struct mo_jobs *jobs); /* counts open jobs and rollouts in the store */

#endif
