/* certificates.h: certificates as jobs: submission. One certificate is computed at a time; the
 * others wait in the order of their submission. After a crash, a job continues after its stored
 * losses (certificate.c). */
#ifndef MORPHO_JOBS_CERTIFICATES_H
#define MORPHO_JOBS_CERTIFICATES_H

#include "jobs/live.h"
#include "store/certificates.h"

/* Submits a certificate, like mo_jobs_submit_training. What the request leaves out is taken from
 * the job with its designs, or is the default. MO_ERR_NOT_FOUND: as in mo_store_population;
 * MO_ERR_CONFLICT: as there, or that job uses a whole suite; MO_ERR_EMPTY: it has no controller;
 * MO_ERR_LIMIT: too little memory. */
int mo_jobs_submit_certificate(struct mo_jobs *jobs, const struct mo_certificate_request *request,
                               int64_t *id, bool *replayed, struct mo_message *message);

/* Memory of a running certificate; for the memory check. */
struct mo_need;
struct mo_need mo_certificate_need(const struct mo_jobs *jobs, uint32_t n_designs,
                                   uint64_t n_rollouts, enum mo_back_end back_end);

#endif
