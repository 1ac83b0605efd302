/* runs.h: submission and state changes of all jobs; queue, fence, end of an attempt and result of
 *training runs and campaigns, which are jobs with their own thread. Only for this room.
 *
 * Writes are fenced by the epoch: the job must have been started under this opening of the store
 * and must not be final. A job that was paused, or paused and resumed at once, still accepts
 * writes, because its thread saves its results. */
#ifndef MORPHO_STORE_RUNS_H
#define MORPHO_STORE_RUNS_H

#include "store/internal.h"
#include "store/trainings.h"

/* Part of every UPDATE of a job. */
#define MO_NEXT_VERSION "version=version+1"
#define MO_NEXT_ATTEMPT "(attempts+1)"

/* ---- submission (submit.c) ---- */

/* Stores a job in one transaction: `insert` stores everything except the key. For a known key,
 * returns its job (*replayed). Errors as in mo_store_submit. */
int mo_submit(struct mo_store *store, const struct mo_request_key *key,
              int (*insert)(struct mo_store *store, const void *request, int64_t *id),
              const void *request, int64_t *id, bool *replayed);
/* Inserts the row common to all jobs. */
int mo_job_insert(struct mo_connection *writer, const struct mo_submission *request,
                  enum mo_job_kind kind, int64_t *id);
/* Finds the job of an idempotency key. MO_ERR_NOT_FOUND: unknown, or no key; MO_ERR_CONFLICT: it
 * was used with a different request. */
int mo_key_find(struct mo_connection *connection, const struct mo_request_key *key, int64_t *id);
int mo_key_insert(struct mo_connection *writer, const struct mo_request_key *key, int64_t id);

/* ---- inside an operation ---- */

int mo_job_state_get(struct mo_connection *connection, int64_t id, enum mo_job_state *state,
                     enum mo_job_kind *kind); /* MO_ERR_NOT_FOUND */
/* Deletes the listed designs of an evaluation that ended before they were stored: at most 24 MB,
 * which takes 40 ms for a million designs. */
int mo_waiting_delete(struct mo_connection *writer, int64_t id);
/* Applies the step of an update to the job's state, and sets update->state. MO_ERR_CONFLICT: the
 * step cannot start in the job's state, or the job was not started under this opening. */
int mo_job_step(struct mo_store *store, struct mo_job_update *update, enum mo_job_kind *kind);
/* Inserts the row of its kind for a job from mo_job_insert. record: struct mo_training_record or
 * mo_campaign_record. controller: its row, 0: none; reference: its name or "sha256:…", nullable. */
int mo_run_insert(struct mo_connection *writer, int64_t id, enum mo_job_kind kind,
                  const void *record, const char *name, int64_t controller, const char *reference);
/* Increases the version of a job that still accepts writes. MO_ERR_CONFLICT: the job is final, or
 * was not started under this opening. */
int mo_run_touch(struct mo_store *store, int64_t id);
/* Adds an event with a job's state. more: further members of the JSON object, each with a leading
 * comma. */
int mo_run_announce(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *type,
                    enum mo_job_state state, const char *more);

/* Adds an event for each warning of a job; if the job is not new, only for warnings that its
 * request did not cause. */
int mo_run_announce_warnings(struct mo_store *store, int64_t id, bool is_new);

int mo_training_code_load(struct mo_connection *connection, int64_t id,
                          struct mo_training_lineage *lineage);

/* ---- complete operations ---- */

/* A controller's file, to be stored under a name. */
struct mo_run_result {
  const char *name;
  const uint8_t *bytes;
  size_t size;
  const struct mo_controller *controller; /* NULL: none */
};
/* running → succeeded. Stores the result, then calls `end` (nullable) in the same transaction.
 * more: as for mo_run_announce. */
int mo_run_finish(struct mo_store *store, int64_t id, const struct mo_run_result *result,
                  const char *more,
                  int (*end)(struct mo_connection *writer, int64_t id, const void *context),
                  const void *context);

#endif
