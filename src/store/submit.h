/* submit.h: what the submissions of every kind of job share. Only for this room. */
#ifndef MORPHO_STORE_SUBMIT_H
#define MORPHO_STORE_SUBMIT_H

#include "store/internal.h"

/* The members that submissions of every kind have. */
struct mo_job_request {
  enum mo_urgency priority;
  enum mo_back_end back_end;
  double weight;               /* 0: 1 */
  const char *label;           /* nullable */
  const char *submitted_by;    /* nullable */
  const char *idempotency_key; /* nullable */
  struct mo_sha256 body_sha256;
};
#define MO_JOB_REQUEST(submission)                                                                 \
  {                                                                                                \
    (submission)->priority, (submission)->back_end, (submission)->weight, (submission)->label,     \
        (submission)->submitted_by, (submission)->idempotency_key, (submission)->body_sha256       \
  }

/* Stores a job in one transaction: `insert` stores all of it but the key. A known key gives its job
 * (*replayed). Errors as mo_store_submit. */
int mo_submit(struct mo_store *store, const struct mo_job_request *request,
              int (*insert)(struct mo_store *store, const struct mo_job_request *request,
                            const void *submission, int64_t *id),
              const void *submission, int64_t *id, bool *replayed);
/* Inserts the row that every job has. */
int mo_job_insert(struct mo_connection *writer, const struct mo_job_request *request,
                  enum mo_job_kind kind, int64_t *id);
/* Finds the job of an idempotency key. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: the key has another body.
 */
int mo_key_find(struct mo_connection *connection, const char *key, const struct mo_sha256 *body,
                int64_t *id);
int mo_key_insert(struct mo_connection *writer, const char *key, const struct mo_sha256 *body,
                  int64_t id);

#endif
