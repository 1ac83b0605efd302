/* training_runs.c: what the runner of a training writes: steps, checkpoints and the end. Writes are
 * fenced as in runs.h. */
#include <math.h>
#include <stdio.h>

#include "store/checkpoint_files.h"
#include "store/rows.h"
#include "store/runs.h"
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

int mo_store_training_finish(struct mo_store *store, int64_t id, const char *name,
                             const uint8_t *bytes, size_t size,
                             const struct mo_controller *controller)
{
  const struct mo_run_result result = {name, bytes, size, controller};
  return mo_run_finish(store, id, MO_JOB_TRAINING, &result, "", NULL, NULL);
}

/* ---- progress ---- */

struct progress_arguments {
  int64_t id;
  const struct mo_training_step_row *steps;
  size_t n_steps;
  const struct mo_training_validation_row *validation;
  const char *event_data;
};

static int write_validation(struct mo_store *store, int64_t id,
                            const struct mo_training_validation_row *row)
{
  char data[256], mean[32], deviation[32];
  const int error = mo_row_write(&store->writer, MO_TRAINING_VALIDATIONS, id, row);
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"step\":%u,\"mean_score\":%s,\"standard_error\":%s,\"rollouts\":%u,"
           "\"diverged\":%u}",
           (long long)id, (unsigned)row->step, number(row->mean_score, mean),
           number(row->standard_error, deviation), (unsigned)row->rollouts,
           (unsigned)row->diverged);
  return error == MO_OK ? mo_writer_event(store, id, "training.validation", data) : error;
}

static int progress(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE trainings SET step=max(step,?2) WHERE job=?1";
  const struct progress_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  int error = mo_run_touch(store, call->id, MO_JOB_TRAINING);
  for (size_t i = 0; i < call->n_steps && error == MO_OK; i++)
    error = mo_row_write(writer, MO_TRAINING_STEPS, call->id, &call->steps[i]);
  if (error == MO_OK && call->n_steps > 0)
    error = mo_sql_do(writer, sql, mo_int(call->id),
                      mo_int(call->steps[call->n_steps - 1].report.step));
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

/* ---- checkpoints ---- */

struct checkpoint_arguments {
  struct mo_checkpoint checkpoint;
  uint32_t keep;
};

static int write_checkpoint(struct mo_store *store, void *arguments)
{
  /* Resets the attempts when a checkpoint goes beyond all earlier ones, because that is progress.
   * An error that recurs at the same step prevents that, so the third attempt still ends the
   * training. */
  static const char forgive_sql[] =
      "UPDATE jobs SET attempts=0 WHERE id=?1 AND attempts>0 AND"
      " ?2>(SELECT coalesce(max(step),0) FROM checkpoints WHERE job=?1)";
  /* Later steps, which this step makes false (they were damaged, or another run wrote them), and
   * those beyond the number to keep. */
  static const char replaced_sql[] =
      "SELECT generation,step,size FROM checkpoints WHERE job=?1 AND (step>?3 OR step NOT IN"
      " (SELECT step FROM checkpoints WHERE job=?1 AND step<=?3 ORDER BY step DESC LIMIT ?4))";
  struct checkpoint_arguments *call = arguments;
  struct mo_checkpoint *checkpoint = &call->checkpoint;
  char data[256], digits[MO_SHA256_DIGITS + 1];
  int error = mo_run_touch(store, checkpoint->id, MO_JOB_TRAINING);
  if (error == MO_OK)
    error = mo_sql_do(&store->writer, forgive_sql, mo_int(checkpoint->id),
                      mo_int(checkpoint->place.step));
  if (error == MO_OK)
    error = mo_checkpoint_row_write(store, checkpoint);
  if (error == MO_OK)
    error = mo_checkpoint_drop(store, replaced_sql, call->keep, checkpoint);
  mo_sha256_to_hex(&checkpoint->sha256, digits);
  snprintf(data, sizeof(data), "{\"id\":\"%lld\",\"step\":%u,\"sha256\":\"%s\",\"size\":%llu}",
           (long long)checkpoint->id, (unsigned)checkpoint->place.step, digits,
           (unsigned long long)checkpoint->size);
  return error == MO_OK ? mo_writer_event(store, checkpoint->id, "training.checkpoint", data)
                        : error;
}

int mo_store_training_checkpoint(struct mo_store *store, int64_t id, uint32_t step,
                                 const uint8_t *bytes, size_t size, uint32_t keep)
{
  struct checkpoint_arguments call = {
      {.id = id, .kind = MO_JOB_TRAINING, .place.step = step, .size = size}, keep > 0 ? keep : 1};
  return step == 0 ? MO_ERR_RANGE
                   : mo_checkpoint_write(store, bytes, &call.checkpoint, write_checkpoint, &call);
}

int mo_store_training_checkpoint_bytes(struct mo_store *store, int64_t id, uint32_t step,
                                       uint8_t **bytes, size_t *size)
{
  struct mo_checkpoint_place place;
  return mo_checkpoint_read(store, id, MO_JOB_TRAINING, 0, step > 0 ? (int64_t)step : -1, &place,
                            bytes, size);
}
