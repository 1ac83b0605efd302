/* training_runs.c: writes of a training run's runner: steps, checkpoints, code and the end. Writes
 * are fenced as in runs.h. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "store/checkpoint_files.h"
#include "store/contents.h"
#include "store/rows.h"
#include "store/runs.h"
#include "store/trainings.h"

/* Formats a JSON number; null if it is not finite. */
static const char *number(double value, char text[32])
{
  snprintf(text, 32, isfinite(value) ? "%.17g" : "null", value);
  return text;
}

int mo_store_training_finish(struct mo_store *store, int64_t id, const char *name,
                             const uint8_t *bytes, size_t size,
                             const struct mo_controller *controller)
{
  const struct mo_run_result result = {name, bytes, size, controller};
  return mo_run_finish(store, id, &result, "", NULL, NULL);
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
  char mean[32], deviation[32];
  const int error = mo_row_write(&store->writer, MO_TRAINING_VALIDATIONS, id, row);
  if (error != MO_OK)
    return error;
  return mo_writer_event(store, id, "training.validation",
                         "{\"id\":\"%lld\",\"step\":%u,\"mean_score\":%s,"
                         "\"standard_error\":%s,\"rollouts\":%u,\"diverged\":%u}",
                         (long long)id, (unsigned)row->step, number(row->mean_score, mean),
                         number(row->standard_error, deviation), (unsigned)row->rollouts,
                         (unsigned)row->diverged);
}

static int progress(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE trainings SET step=max(step,?2) WHERE job=?1";
  const struct progress_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  int error = mo_run_touch(store, call->id);
  for (size_t i = 0; i < call->n_steps && error == MO_OK; i++)
    error = mo_row_write(writer, MO_TRAINING_STEPS, call->id, &call->steps[i]);
  if (error == MO_OK && call->n_steps > 0)
    error = mo_sql_do(writer, sql, mo_int(call->id),
                      mo_int(call->steps[call->n_steps - 1].report.step));
  if (error == MO_OK && call->n_steps > 0 && call->event_data != NULL)
    error = mo_writer_event(store, call->id, "training.progress", "%s", call->event_data);
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
  /* Resets the attempts when a checkpoint is beyond all earlier ones, because that is progress. An
   * error that recurs at the same step prevents progress, so the third attempt still ends the
   * run. */
  static const char forgive_sql[] =
      "UPDATE jobs SET attempts=0 WHERE id=?1 AND attempts>0 AND"
      " ?2>(SELECT coalesce(max(step),0) FROM checkpoints WHERE job=?1)";
  /* Later steps, which this step invalidates (they were damaged, or another run wrote them), and
   * steps beyond the number to keep. */
  static const char replaced_sql[] =
      "SELECT generation,step,size FROM checkpoints WHERE job=?1 AND (step>?3 OR step NOT IN"
      " (SELECT step FROM checkpoints WHERE job=?1 AND step<=?3 ORDER BY step DESC LIMIT ?4))";
  struct checkpoint_arguments *call = arguments;
  struct mo_checkpoint *checkpoint = &call->checkpoint;
  int error = mo_run_touch(store, checkpoint->id);
  if (error == MO_OK)
    error = mo_sql_do(&store->writer, forgive_sql, mo_int(checkpoint->id),
                      mo_int(checkpoint->place.step));
  if (error == MO_OK)
    error = mo_checkpoint_row_write(store, checkpoint);
  if (error == MO_OK)
    error = mo_checkpoint_drop(store, replaced_sql, call->keep, checkpoint);
  if (error != MO_OK)
    return error;
  return mo_writer_event(store, checkpoint->id, "training.checkpoint",
                         "{\"id\":\"%lld\",\"step\":%u,\"sha256\":\"%s\",\"size\":%llu}",
                         (long long)checkpoint->id, (unsigned)checkpoint->place.step,
                         MO_SHA256_HEX(&checkpoint->sha256), (unsigned long long)checkpoint->size);
}

int mo_store_training_checkpoint(struct mo_store *store, int64_t id, uint32_t step,
                                 const uint8_t *bytes, size_t size, uint32_t keep)
{
  struct checkpoint_arguments call = {
      {.id = id, .kind = MO_JOB_TRAINING, .place.step = step, .size = size}, keep};
  return mo_checkpoint_write(store, bytes, &call.checkpoint, write_checkpoint, &call);
}

int mo_store_training_checkpoint_bytes(struct mo_store *store, int64_t id, uint32_t step,
                                       uint8_t **bytes, size_t *size)
{
  struct mo_checkpoint_place place;
  return mo_checkpoint_read(store, id, MO_JOB_TRAINING, 0, step > 0 ? (int64_t)step : -1, &place,
                            bytes, size);
}

/* ---- which code computed the steps ----
 *
 * Each change has one row: a step, and the fingerprint of the code that computed the steps after
 * it. Before its first step, a run stores its code under its starting step, and deletes the later
 * rows, because it recomputes their steps. After any crash, the rows below a step therefore
 * describe the weights at that step, and a run that computes no step leaves no row. */

#define VARIOUS "various"

int mo_training_code_load(struct mo_connection *connection, int64_t id,
                          struct mo_training_lineage *lineage)
{
  static const char sql[] = "SELECT c.from_step,f.text FROM training_code c JOIN fingerprints f ON"
                            " f.id=c.fingerprint WHERE c.job=?1 ORDER BY c.from_step LIMIT ?2";
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(connection, &error, sql, mo_int(id), mo_int(MO_LINEAGE_MAX));
  for (lineage->n = 0; mo_sql_next(connection, row, &error);) {
    struct mo_training_code *code = &lineage->codes[lineage->n++];
    code->from_step = mo_column_u32(row, 0);
    mo_column_text(row, 1, code->fingerprint, sizeof(code->fingerprint));
  }
  return error;
}

static int insert_code(struct mo_connection *writer, int64_t id, uint32_t step,
                       const char *fingerprint)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO training_code(job,from_step,fingerprint) VALUES(?1,?2,?3)";
  int64_t row = 0;
  const int error = mo_text_row(writer, MO_FINGERPRINTS, fingerprint, &row);
  return error == MO_OK ? mo_sql_do(writer, sql, mo_int(id), mo_int(step), mo_int(row)) : error;
}

struct code_arguments {
  int64_t id;
  uint32_t step;
  const char *fingerprint;
  struct mo_training_lineage *lineage;
};

static int note_code(struct mo_store *store, void *arguments)
{
  static const char sql[] = "DELETE FROM training_code WHERE job=?1 AND from_step>=?2";
  struct code_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char before[MO_FINGERPRINT_BYTES];
  uint32_t n;
  int error = mo_run_touch(store, call->id);
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, mo_int(call->id), mo_int(call->step));
  if (error == MO_OK)
    error = mo_training_code_load(writer, call->id, call->lineage);
  if (error != MO_OK)
    return error;
  n = call->lineage->n;
  snprintf(before, sizeof(before), "%s", n > 0 ? call->lineage->codes[n - 1].fingerprint : "");
  if (n > 0 && strcmp(before, call->fingerprint) == 0)
    return MO_OK;
  if (n < MO_LINEAGE_MAX)
    error = insert_code(writer, call->id, call->step, call->fingerprint);
  else if (strcmp(before, VARIOUS) != 0) /* no room for another entry */
    error = insert_code(writer, call->id, call->lineage->codes[n - 1].from_step, VARIOUS);
  if (error == MO_OK)
    error = mo_training_code_load(writer, call->id, call->lineage);
  if (error != MO_OK || n == 0)
    return error;
  return mo_writer_event(
      store, call->id, "training.code_changed",
      "{\"id\":\"%lld\",\"from_step\":%u,\"before\":\"%s\",\"fingerprint\":\"%s\"}",
      (long long)call->id, (unsigned)call->step, before, call->fingerprint);
}

int mo_store_training_code(struct mo_store *store, int64_t id, uint32_t step,
                           const char *fingerprint, struct mo_training_lineage *lineage)
{
  return mo_write(store, note_code, &(struct code_arguments){id, step, fingerprint, lineage});
}
