/* submit.h: what the submissions of every kind of job share. Only for this room. */
#ifndef MORPHO_STORE_SUBMIT_H
#define MORPHO_STORE_SUBMIT_H

#include "store/internal.h"

/* Stores a job in one transaction: `insert` stores all of it but the key. A known key gives its job
 * (*replayed). Errors as mo_store_submit. */
int mo_submit(struct mo_store *store, const struct mo_request_key *key,
              int (*insert)(struct mo_store *store, const void *request, int64_t *id),
              const void *request, int64_t *id, bool *replayed);
/* Inserts the row that every job has. */
int mo_job_insert(struct mo_connection *writer, const struct mo_submission *request,
                  enum mo_job_kind kind, int64_t *id);
/* Finds the job of an idempotency key. MO_ERR_NOT_FOUND: it is unknown, or there is none;
 * MO_ERR_CONFLICT: it was used with another request. */
int mo_key_find(struct mo_connection *connection, const struct mo_request_key *key, int64_t *id);
int mo_key_insert(struct mo_connection *writer, const struct mo_request_key *key, int64_t id);

#endif
