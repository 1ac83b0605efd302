/* training_code.c: which code computed the steps of a training.
 *
 * There is one row for each change: from this step on, this fingerprint. Before its first step, a
 * run stores its code under the step at which it starts, and deletes the rows from there on, whose
 * steps it computes again. So after any crash the rows below a step describe the weights at that
 * step, and a run that computes no step leaves no row. */
#include <stdio.h>
#include <string.h>

#include "store/internal.h"
#include "store/trainings.h"

#define VARIOUS "various"

int mo_training_code_load(struct mo_connection *connection, int64_t id,
                          struct mo_training_lineage *lineage)
{
  static const char sql[] = "SELECT c.from_step,f.text FROM training_code c JOIN fingerprints f ON"
                            " f.id=c.fingerprint WHERE c.job=?1 ORDER BY c.from_step LIMIT ?2";
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(connection, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, MO_LINEAGE_MAX);
  lineage->n = 0;
  while ((step = mo_sql_step(connection, statement)) > 0) {
    struct mo_training_code *code = &lineage->codes[lineage->n++];
    code->from_step = (uint32_t)sqlite3_column_int64(statement, 0);
    mo_column_text(statement, 1, code->fingerprint, sizeof(code->fingerprint));
  }
  return step;
}

static int forget_from(struct mo_connection *writer, int64_t id, uint32_t step)
{
  static const char sql[] = "DELETE FROM training_code WHERE job=?1 AND from_step>=?2";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, step);
  return mo_sql_run(writer, statement);
}

static int insert(struct mo_connection *writer, int64_t id, uint32_t step, const char *fingerprint)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO training_code(job,from_step,fingerprint) VALUES(?1,?2,?3)";
  int64_t row = 0;
  int error = mo_fingerprint_row(writer, fingerprint, &row);
  sqlite3_stmt *statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, step);
  sqlite3_bind_int64(statement, 3, row);
  return mo_sql_run(writer, statement);
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
  struct code_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  char before[MO_FINGERPRINT_BYTES];
  uint32_t n;
  int error = mo_run_touch(store, call->id, MO_JOB_TRAINING);
  if (error == MO_OK)
    error = forget_from(writer, call->id, call->step);
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
