/* runs.h: trainings and campaigns as jobs that run on a thread of their own: queue, start, fence,
 * end of an attempt, result. Only for this room.
 *
 * Writes are fenced by the epoch: the job must have been started under this opening of the store
 * and must not be final. A job that was paused, or paused and resumed at once, still takes writes,
 * because its thread saves what it has computed. */
#ifndef MORPHO_STORE_RUNS_H
#define MORPHO_STORE_RUNS_H

#include "store/internal.h"

/* What each change of a job counts. */
#define MO_NEXT_VERSION "version=version+1"
#define MO_NEXT_ATTEMPT "(attempts+1)"

/* ---- inside an operation ---- */

int mo_job_state_get(struct mo_connection *connection, int64_t id, enum mo_job_state *state,
                     enum mo_job_kind *kind); /* MO_ERR_NOT_FOUND */
/* Inserts the row of a job that mo_job_insert has made. record: struct mo_training_record or
 * mo_campaign_record. controller: its row, 0: none; reference: its name or "sha256:…", nullable. */
int mo_run_insert(struct mo_connection *writer, int64_t id, enum mo_job_kind kind,
                  const void *record, const char *name, int64_t controller, const char *reference);
/* Increases the version of a job that still takes writes. MO_ERR_CONFLICT: the job is final, or was
 * not started under this opening. */
int mo_run_touch(struct mo_store *store, int64_t id, enum mo_job_kind kind);
/* Adds an event with a job's state. more: further members of the JSON object, each with a leading
 * comma. */
int mo_run_announce(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *type,
                    enum mo_job_state state, const char *more);

/* ---- operations of their own ---- */

/* mo_store_queued_trainings, mo_store_training_start and _park for both kinds. MO_ERR_DEVICE pauses
 * the job and counts no attempt. */
int64_t mo_run_queued(struct mo_store *store, enum mo_job_kind kind, int64_t *ids, size_t limit);
int mo_run_start(struct mo_store *store, int64_t id, enum mo_job_kind kind);
int mo_run_park(struct mo_store *store, int64_t id, enum mo_job_kind kind, int error,
                const char *error_text, uint32_t max_attempts, enum mo_job_state *after);

/* A controller's file, to be stored under a name. */
struct mo_run_result {
  const char *name;
  const uint8_t *bytes;
  size_t size;
  const struct mo_controller *controller; /* NULL: there is none */
};
/* running → succeeded. Stores the result, then calls `end` (nullable) in the same transaction.
 * more: of the event, as for mo_run_announce. */
int mo_run_finish(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                  const struct mo_run_result *result, const char *more,
                  int (*end)(struct mo_connection *writer, int64_t id, const void *context),
                  const void *context);
/* Reads the hash of the result, if there is one, from a row of mo_job_row. MO_ERR_CORRUPT. */
int mo_run_result_read(sqlite3_stmt *row, bool *has_result, struct mo_sha256 *sha256);

#endif
