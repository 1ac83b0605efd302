/* save.c: writes the scheduler's results in one transaction: losses, measures, trajectories, steps
 * of jobs.
 *
 * Updates of a job are fenced: they apply only to a job that runs under this opening of the store
 * (its epoch). A job that a client has cancelled or paused in the meantime therefore keeps that
 * state. Scores are stored in any case, because they are valid. The counts of an unfinished job are
 * also stored in any case; otherwise, blocks that finish after a pause would be attributed to other
 * jobs. */
#include "store/measures.h"
#include "store/recordings.h"
#include "store/runs.h"
#include "store/scores.h"

#include "base/clock.h"

/* ---- steps of jobs ---- */

static int apply_counts(struct mo_connection *writer, const struct mo_job_update *update)
{
  static const char sql[] =
      "UPDATE evaluations SET done=?2,cached=?3,diverged=?4,cut=?5 WHERE job=?1";
  return update->total == 0
             ? MO_OK
             : mo_sql_do(writer, sql, mo_int(update->job), mo_int((int64_t)update->done),
                         mo_int((int64_t)update->cached), mo_int((int64_t)update->diverged),
                         mo_int((int64_t)update->cut));
}

/* For designs that were cut short, stores which losses count. */
static int set_counted(struct mo_connection *writer, const struct mo_job_update *update)
{
  static const char sql[] = "UPDATE job_designs SET counted=?3 WHERE job=?1 AND position=?2";
  const uint64_t all = UINT64_MAX >> (64 - update->n_environments);
  int error = MO_OK;
  for (uint32_t i = 0; i < update->n_designs && error == MO_OK; i++)
    if (update->counted[i] != all)
      error = mo_sql_do(writer, sql, mo_int(update->job), mo_int(update->positions[i]),
                        mo_int((int64_t)update->counted[i]));
  return error;
}

static int announce(struct mo_store *store, const struct mo_job_update *update)
{
  const char *type = update->step == MO_STEP_START          ? "job.started"
                     : update->step == MO_STEP_PROGRESS     ? "job.progress"
                     : update->step == MO_STEP_HALT         ? "job.paused"
                     : mo_job_state_is_final(update->state) ? "job.finished"
                                                            : "job.requeued";
  return mo_writer_event(
      store, update->job, type,
      "{\"id\":\"%lld\",\"kind\":\"evaluation\",\"state\":\"%s\",\"rollouts_total\":%llu,"
      "\"rollouts_done\":%llu,"
      "\"rollouts_cached\":%llu,\"rollouts_diverged\":%llu}",
      (long long)update->job, mo_job_state_name(update->state), (unsigned long long)update->total,
      (unsigned long long)update->done, (unsigned long long)update->cached,
      (unsigned long long)update->diverged);
}

/* Stores the class of a job that starts. If the previous process had a different class, the job
 * starts over in the new class: its recordings and recomputed losses are deleted. */
static int set_class(struct mo_store *store, const struct mo_job_update *update)
{
  static const char before_sql[] =
      "SELECT a.text,b.text FROM evaluations e JOIN fingerprints a ON a.id=e.fingerprint"
      " JOIN fingerprints b ON b.id=?2 WHERE e.job=?1 AND e.fingerprint<>?2";
  static const char class_sql[] = "UPDATE evaluations SET fingerprint=?2,workers=?3 WHERE job=?1";
  static const char recomputed_sql[] = "DELETE FROM recomputed WHERE job=?1";
  struct mo_connection *writer = &store->writer;
  const struct mo_value job = mo_int(update->job), now = mo_int(update->fingerprint);
  int64_t recorded_bytes;
  sqlite3_stmt *row;
  int error = mo_sql_row(writer, &row, before_sql, job, now);
  if (error == MO_OK) {
    error = mo_writer_event(store, update->job, "evaluation.code_changed",
                            "{\"id\":\"%lld\",\"before\":\"%s\",\"fingerprint\":\"%s\"}",
                            (long long)update->job, (const char *)sqlite3_column_text(row, 0),
                            (const char *)sqlite3_column_text(row, 1));
    if (error == MO_OK)
      error = mo_recordings_drop(writer, update->job, &recorded_bytes);
    if (error == MO_OK)
      error = mo_sql_do(writer, recomputed_sql, job);
  }
  return error == MO_OK || error == MO_ERR_NOT_FOUND
             ? mo_sql_do(writer, class_sql, job, now, mo_int(update->workers))
             : error;
}

/* If the job has left the state that the step requires, stores only the counts and, for a start,
 * the class that the results of its blocks in flight belong to. */
static int apply_update(struct mo_store *store, struct mo_job_update *update)
{
  static const char late_sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1 AND state IN (0,2)";
  enum mo_job_kind kind;
  int error = mo_job_step(store, update, &kind);
  update->applied = error == MO_OK;
  if (error == MO_ERR_CONFLICT && update->total > 0)
    error = mo_sql_change(&store->writer, late_sql, mo_int(update->job));
  if (error == MO_OK && update->step == MO_STEP_START && update->fingerprint != 0)
    error = set_class(store, update);
  if (error == MO_OK)
    error = apply_counts(&store->writer, update);
  if (error == MO_OK && update->applied && update->counted != NULL)
    error = set_counted(&store->writer, update);
  if (error == MO_OK && update->applied && update->step == MO_STEP_SUCCEED && update->diverged > 0)
    error = mo_run_announce_warnings(store, update->job, false);
  if (error == MO_OK && update->applied && !update->quiet)
    error = announce(store, update);
  return error == MO_ERR_CONFLICT ? MO_OK : error;
}

static int save(struct mo_store *store, void *arguments)
{
  struct mo_save *call = arguments;
  struct mo_connection *writer = &store->writer;
  const int64_t now_us = mo_clock_wall_us();
  int error = mo_blocks_insert(store, call->blocks, call->n_blocks, now_us);
  if (error == MO_OK)
    error = mo_measures_insert(store, call->blocks, call->n_blocks, now_us);
  if (error == MO_OK)
    error = mo_trajectories_insert(writer, call->trajectories, call->n_trajectories);
  for (size_t i = 0; i < call->n_designs && error == MO_OK; i++)
    error = mo_set_score_insert(writer, &call->designs[i]);
  for (size_t i = 0; i < call->n_updates && error == MO_OK; i++)
    error = apply_update(store, &call->updates[i]);
  return error;
}

static void saved(void *arguments, int status)
{
  struct mo_save *call = arguments;
  if (status == MO_OK && (call->n_trajectories > 0 || mo_recordings_are_many(call->store)))
    mo_recordings_check(call->store);
  call->done(call, status);
}

int mo_store_save(struct mo_store *store, struct mo_save *call)
{
  call->store = store;
  return mo_write_later(store, save, call, saved);
}
