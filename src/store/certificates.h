/* certificates.h: jobs that certify designs: settings, progress, and the losses of their trials
 * (morpho/certificate.h).
 *
 * A certificate is a job of kind MO_JOB_CERTIFICATE. Its settings never change. Its designs are
 * those of the job. Its losses have their own rows, because most of its worlds belong to no other
 * job. They are computed and stored in one order: trial by trial; within a trial, by parts of
 * MO_CERTIFICATE_PART environments; within a part, design by design. A job continues after the
 * stored losses.
 *
 * Threads and errors as in store.h. */
#ifndef MORPHO_STORE_CERTIFICATES_H
#define MORPHO_STORE_CERTIFICATES_H

#include "certificate/fields.h"
#include "store/store.h"

#define MO_CERTIFICATE_PART         64       /* environments; the last part may have fewer */
#define MO_CERTIFICATE_ROLLOUTS_MAX 10000000 /* of all trials */

/* What was taken from the job with the designs, because the request did not specify it. */
enum mo_certificate_taken {
  MO_TAKEN_CONTROLLER = 1,
  MO_TAKEN_ENVIRONMENTS = 2,
  MO_TAKEN_PHYSICS = 4
};

/* The settings of a certificate, and its progress. Environments, controller, physics and the number
 * of designs are members of the job. */
struct mo_certificate_record {
  struct mo_certificate_settings settings;
  int64_t population; /* the evaluation or campaign with the designs; 0: listed in the request */
  uint32_t taken;     /* enum mo_certificate_taken, as bits */
  uint32_t n_trials, trials_done;
  uint64_t n_rollouts, rollouts_done;
};
struct mo_certificate_status {
  struct mo_job job;
  struct mo_certificate_record record;
};

/* ---- submission (by jobs) ---- */

/* Like struct mo_evaluation_request: as requested and as stored. */
struct mo_certificate_request {
  struct mo_submission job;
  struct mo_certificate_record record;
  struct mo_physics physics;
  const char *controller; /* name or "sha256:<hex>"; NULL: of the population, or the default */
  const struct mo_bits *genotypes; /* (n_designs) */
  const struct mo_bits *forms;     /* (n_designs) canonical; as stored */
  struct mo_design_note *notes;    /* (n_notes) */
  uint32_t n_designs, n_notes;
  const char *environment_set;               /* NULL: listed */
  const struct mo_environment *environments; /* (n_environments) */
  uint32_t n_environments;
  uint32_t best; /* number of best designs of record.population to certify */
  /* If false, those of record.population are used, if there is one. */
  bool has_environments, has_physics;
};
/* Errors as in mo_store_submit. */
int mo_store_submit_certificate(struct mo_store *store,
                                const struct mo_certificate_request *request, int64_t *id,
                                bool *replayed);

/* ---- reading ---- */

/* MO_ERR_NOT_FOUND. */
int mo_store_certificate(struct mo_store *store, int64_t id, struct mo_certificate_status *status);
/* Like mo_store_jobs, but only certificates; ignores the query's kind. */
int64_t mo_store_certificates(struct mo_store *store, const struct mo_job_query *query,
                              void *statuses /* struct mo_certificate_status */, size_t limit);
/* Reads the data from which the trials are built. *environments: the base's, which
 * base->environments borrows; the caller frees them with mo_environments_free
 * (base->n_environments, 0 after an error). */
int mo_store_certificate_base(struct mo_store *store, const struct mo_certificate_status *status,
                              struct mo_environment **environments,
                              struct mo_certificate_base *base);
/* Reads all losses of a trial: losses (n_designs, n_environments), and measures (n_designs,
 * n_environments), nullable, both filled in. MO_ERR_NOT_FOUND: some are not stored yet. */
int mo_store_certificate_losses(struct mo_store *store, int64_t id, uint32_t trial,
                                uint32_t n_designs, uint32_t n_environments, float *losses,
                                double (*measures)[MO_MEASURES]);
/* The classes that the losses belong to, of float32 and float64; "": none yet. */
struct mo_certificate_classes {
  char fingerprint[2][MO_FINGERPRINT_BYTES];
};
int mo_store_certificate_classes(struct mo_store *store, int64_t id,
                                 struct mo_certificate_classes *classes);

/* ---- the runner's writes ---- */

/* Consecutive losses of a trial, in the order of storing. */
struct mo_certificate_losses {
  uint32_t trial, n;
  uint64_t place;                        /* of the first, within the trial */
  const float *losses;                   /* (n) */
  const double (*measures)[MO_MEASURES]; /* (n) nullable */
};
/* All return MO_ERR_CONFLICT if the job has ended, or was not started under this opening. */
/* Stores where an attempt begins, and the classes of the losses that it computes. If the stored
 * losses belong to different classes, deletes them, and *restarts: the job begins again. */
int mo_store_certificate_start(struct mo_store *store, int64_t id,
                               const struct mo_certificate_classes *classes, bool *restarts);
/* Adds losses and stores the progress, with the event "certificate.progress". Resets the job's
 * attempts. */
int mo_store_certificate_save(struct mo_store *store, int64_t id,
                              const struct mo_certificate_losses *losses, size_t n,
                              const struct mo_certificate_record *progress);
/* running → succeeded. verdicts: (n_designs) enum mo_verdict_class, in the order of the designs. */
int mo_store_certificate_finish(struct mo_store *store, int64_t id, const uint8_t *verdicts,
                                uint32_t n_designs);

#endif
