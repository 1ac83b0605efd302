/* training_code.c: which code computed the steps of a training.
 *
 * There is one row for each change: from this step on, this fingerprint. Before its first step, a
 * run stores its code under the step at which it starts, and deletes the rows from there on, whose
 * steps it computes again. So after any crash the rows below a step describe the weights at that
 * step, and a run that computes no step leaves no row. */
#include <stdio.h>
#include <string.h>

#include "store/contents.h"
#include "store/runs.h"
#include "store/trainings.h"

#define VARIOUS "various"

static int take_code(sqlite3_stmt *row, void *any)
{
  struct mo_training_lineage *lineage = any;
  struct mo_training_code *code = &lineage->codes[lineage->n++];
  code->from_step = mo_column_u32(row, 0);
  mo_column_text(row, 1, code->fingerprint, sizeof(code->fingerprint));
  return MO_OK;
}

int mo_training_code_load(struct mo_connection *connection, int64_t id,
                          struct mo_training_lineage *lineage)
{
  static const char sql[] = "SELECT c.from_step,f.text FROM training_code c JOIN fingerprints f ON"
                            " f.id=c.fingerprint WHERE c.job=?1 ORDER BY c.from_step LIMIT ?2";
  int64_t n;
  lineage->n = 0;
  n = mo_sql_each(connection, take_code, lineage, sql, mo_int(id), mo_int(MO_LINEAGE_MAX));
  return n < 0 ? (int)n : MO_OK;
}

static int insert(struct mo_connection *writer, int64_t id, uint32_t step, const char *fingerprint)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO training_code(job,from_step,fingerprint) VALUES(?1,?2,?3)";
  int64_t row = 0;
  const int error = mo_fingerprint_row(writer, fingerprint, &row);
  return error == MO_OK ? mo_sql_do(writer, sql, mo_int(id), mo_int(step), mo_int(row)) : error;
}

struct code_arguments {
  int64_t id;
  uint32_t step;
  const char *fingerprint;
  struct mo_training_lineage *lineage;
};

static int announce(struct mo_store *store, const struct code_arguments *call, const char *before)
{
  char data[320];
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"from_step\":%u,\"before\":\"%s\",\"fingerprint\":\"%s\"}",
           (long long)call->id, (unsigned)call->step, before, call->fingerprint);
  return mo_writer_event(store, call->id, "training.code_changed", data);
}

static int note(struct mo_store *store, void *arguments)
{
  static const char sql[] = "DELETE FROM training_code WHERE job=?1 AND from_step>=?2";
  struct code_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char before[MO_FINGERPRINT_BYTES];
  uint32_t n;
  int error = mo_run_touch(store, call->id, MO_JOB_TRAINING);
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
    error = insert(writer, call->id, call->step, call->fingerprint);
  else if (strcmp(before, VARIOUS) != 0) /* no room for another entry */
    error = insert(writer, call->id, call->lineage->codes[n - 1].from_step, VARIOUS);
  if (error == MO_OK)
    error = mo_training_code_load(writer, call->id, call->lineage);
  return error == MO_OK && n > 0 ? announce(store, call, before) : error;
}

int mo_store_training_code(struct mo_store *store, int64_t id, uint32_t step,
                           const char *fingerprint, struct mo_training_lineage *lineage)
{
  struct code_arguments call = {id, step, fingerprint, lineage};
  size_t size = strlen(fingerprint);
  if (size == 0 || size >= MO_FINGERPRINT_BYTES)
    return MO_ERR_RANGE;
  for (size_t i = 0; i < size; i++)
    if (fingerprint[i] < ' ' || fingerprint[i] > '~' || fingerprint[i] == '"' ||
        fingerprint[i] == '\\')
      return MO_ERR_INVALID;
  return mo_write(store, note, &call);
}
