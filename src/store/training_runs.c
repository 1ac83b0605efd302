/* training_runs.c: what the runner of a training writes: its steps and its end. Checkpoints are in
 * training_checkpoints.c.
 *
 * Writes are fenced by the epoch: the training must have been started under this opening of the
 * store and must not be final. A training that was paused, or paused and resumed at once, still
 * takes rows and checkpoints, because its thread saves the steps that it has applied. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/internal.h"
#include "store/trainings.h"

/* Formats a JSON number; null if it is not finite. */
static const char *number(double value, char text[32])
{
  snprintf(text, 32, isfinite(value) ? "%.17g" : "null", value);
  return text;
}

/* ---- the queue and the attempt ---- */

int64_t mo_store_queued_trainings(struct mo_store *store, int64_t *ids, size_t limit)
{
  return mo_run_queued(store, MO_JOB_TRAINING, ids, limit);
}

int mo_store_training_start(struct mo_store *store, int64_t id)
{
  return mo_run_start(store, id, MO_JOB_TRAINING);
}

int mo_store_training_park(struct mo_store *store, int64_t id, int error, const char *error_text,
                           uint32_t max_attempts, enum mo_job_state *after)
{
  return mo_run_park(store, id, MO_JOB_TRAINING, error, error_text, max_attempts, after);
}

/* ---- progress ---- */

struct progress_arguments {
  int64_t id;
  const struct mo_training_step_row *steps;
  size_t n_steps;
  const struct mo_training_validation_row *validation;
  const char *event_data;
};

static int write_step(struct mo_connection *writer, int64_t id,
                      const struct mo_training_step_row *row)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO "
      "training_steps(job,step,mean_loss,rate,gradient_norm,clipped_share,clipped_robots_share,"
      "diverged,zeroed,skipped,bounded,seconds) VALUES(?1,?2,?3,?4,?5,?6,?7,?8,?9,?10,?11,?12)";
  const struct mo_training_report *report = &row->report;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, report->step);
  sqlite3_bind_double(statement, 3, report->mean_loss);
  sqlite3_bind_double(statement, 4, report->rate);
  sqlite3_bind_double(statement, 5, report->gradient_norm);
  sqlite3_bind_double(statement, 6, report->clipped_share);
  sqlite3_bind_double(statement, 7, report->clipped_robots_share);
  sqlite3_bind_int64(statement, 8, report->diverged);
  sqlite3_bind_int64(statement, 9, report->zeroed);
  sqlite3_bind_int64(statement, 10, report->skipped);
  sqlite3_bind_int64(statement, 11, report->bounded);
  sqlite3_bind_double(statement, 12, row->seconds);
  return mo_sql_run(writer, statement);
}

static int write_validation(struct mo_store *store, int64_t id,
                            const struct mo_training_validation_row *row)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO training_validations(job,step,rollouts,diverged,mean_score,"
      "standard_error) VALUES(?1,?2,?3,?4,?5,?6)";
  struct mo_connection *writer = &store->writer;
  char data[256], mean[32], deviation[32];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, row->step);
  sqlite3_bind_int64(statement, 3, row->rollouts);
  sqlite3_bind_int64(statement, 4, row->diverged);
  sqlite3_bind_double(statement, 5, row->mean_score);
  sqlite3_bind_double(statement, 6, row->standard_error);
  error = mo_sql_run(writer, statement);
  if (error != MO_OK)
    return error;
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"step\":%u,\"mean_score\":%s,\"standard_error\":%s,\"rollouts\":%u,"
           "\"diverged\":%u}",
           (long long)id, (unsigned)row->step, number(row->mean_score, mean),
           number(row->standard_error, deviation), (unsigned)row->rollouts,
           (unsigned)row->diverged);
  return mo_writer_event(store, id, "training.validation", data);
}

static int progress(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE trainings SET step=max(step,?2) WHERE job=?1";
  const struct progress_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  sqlite3_stmt *statement;
  int error = mo_run_touch(store, call->id, MO_JOB_TRAINING);
  for (size_t i = 0; i < call->n_steps && error == MO_OK; i++)
    error = write_step(writer, call->id, &call->steps[i]);
  if (error == MO_OK && call->n_steps > 0 && (statement = mo_sql(writer, sql, &error)) != NULL) {
    sqlite3_bind_int64(statement, 1, call->id);
    sqlite3_bind_int64(statement, 2, call->steps[call->n_steps - 1].report.step);
    error = mo_sql_run(writer, statement);
  }
  if (error == MO_OK && call->n_steps > 0 && call->event_data != NULL)
    error = mo_writer_event(store, call->id, "training.progress", call->event_data);
  if (error == MO_OK && call->validation != NULL)
    error = write_validation(store, call->id, call->validation);
  return error;
}

int mo_store_training_progress(struct mo_store *store, int64_t id,
                               const struct mo_training_step_row *steps, size_t n_steps,
                               const struct mo_training_validation_row *validation,
                               const char *event_data)
{
  struct progress_arguments call = {id, steps, n_steps, validation, event_data};
  return mo_write(store, progress, &call);
}

/* ---- the end ---- */

struct finish_arguments {
  int64_t id;
  struct mo_controller_put put;
};

static int finish(struct mo_store *store, void *arguments)
{
  static const char job_sql[] =
      "UPDATE jobs SET state=3," MO_NEXT_VERSION ",finished_us=?3,error=0,error_text=NULL"
      " WHERE id=?1 AND kind=1 AND state=1 AND epoch=?2";
  static const char sql[] = "UPDATE trainings SET result=?2 WHERE job=?1";
  struct finish_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char more[192], digits[MO_SHA256_DIGITS + 1];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, job_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, store->epoch);
  sqlite3_bind_int64(statement, 3, mo_clock_wall_us());
  error = mo_run_changed(writer, statement);
  if (error == MO_OK)
    error = mo_controller_put_row(store, &call->put);
  statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, call->put.row);
  error = mo_sql_run(writer, statement);
  if (error != MO_OK)
    return error;
  mo_sha256_to_hex(&call->put.sha256, digits);
  snprintf(more, sizeof(more), ",\"controller\":\"%s\",\"sha256\":\"%s\"", call->put.name, digits);
  return mo_run_announce(store, call->id, MO_JOB_TRAINING, "job.finished", MO_JOB_SUCCEEDED, more);
}

int mo_store_training_finish(struct mo_store *store, int64_t id, const char *name,
                             const uint8_t *bytes, size_t size,
                             const struct mo_controller *controller)
{
  struct finish_arguments call = {.id = id};
  int error = mo_controller_put_begin(store, name, bytes, size, controller, &call.put);
  if (error == MO_OK)
    error = mo_write(store, finish, &call);
  mo_controller_put_end(store, &call.put);
  return error;
}
