/* training_bodies.c: see training_bodies.h. */
#include "store/training_bodies.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "store/checkpoint_files.h"
#include "store/controller_rows.h"
#include "store/runs.h"

#define NAME_BYTES (MO_NAME_BYTES_MAX + 1)

/* ---- writing ---- */

struct writing {
  int64_t id;
  const struct mo_training_body *body;
  const char *name;              /* of the training run's controllers */
  struct mo_controller_put *put; /* NULL: its controller is not kept */
  /* The kept controller that it displaces, if any. */
  bool displaces;
  int64_t displaced;
  struct mo_sha256 displaced_sha256;
  struct mo_checkpoint checkpoint;
};

static void name_of(const char *name, int64_t position, char text[NAME_BYTES])
{
  snprintf(text, NAME_BYTES, "%s-%lld", name, (long long)position);
}

/* Decides whether the controller is kept, and which one it displaces: the worst one that is kept
 * and, among equal ones, the last. */
static int choose(struct mo_store *store, const struct mo_training_record *record,
                  struct writing *call, bool *keeps)
{
  static const char n_sql[] = "SELECT count(*) FROM training_bodies WHERE job=?1 AND kept";
  static const char worst_sql[] =
      "SELECT position,controller,finetuned FROM training_bodies WHERE job=?1 AND kept"
      " ORDER BY finetuned DESC,position DESC LIMIT 1";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int64_t n = 0;
  sqlite3_stmt *row;
  int error = mo_sql_find(reader, &n, n_sql, mo_int(call->id));
  *keeps = record->keep == MO_KEEP_ALL;
  if (error != MO_OK || *keeps || record->keep_best == 0 || isnan(call->body->finetuned))
    return error;
  *keeps = n < record->keep_best;
  if (*keeps)
    return MO_OK;
  error = mo_sql_row(reader, &row, worst_sql, mo_int(call->id));
  if (error != MO_OK)
    return error;
  *keeps = call->displaces = call->body->finetuned < sqlite3_column_double(row, 2);
  call->displaced = sqlite3_column_int64(row, 0);
  return mo_column_hash(row, 1, &call->displaced_sha256);
}

/* Removes the name of the displaced controller, unless it has other content by now. */
static int displace(struct mo_store *store, const struct writing *call)
{
  static const char kept_sql[] = "UPDATE training_bodies SET kept=0 WHERE job=?1 AND position=?2";
  static const char name_sql[] = "DELETE FROM controller_names WHERE name=?1 AND controller="
                                 "(SELECT id FROM controllers WHERE sha256=?2)";
  struct mo_connection *writer = &store->writer;
  char name[NAME_BYTES];
  name_of(call->name, call->displaced, name);
  int error = mo_sql_do(writer, kept_sql, mo_int(call->id), mo_int(call->displaced));
  if (error == MO_OK)
    error = mo_sql_do(writer, name_sql, mo_string(name), mo_hash(&call->displaced_sha256));
  if (error != MO_OK || sqlite3_changes(writer->db) == 0)
    return error;
  return mo_writer_event(store, 0, "controller.removed", "{\"name\":\"%s\"}", name);
}

static const char *number(double value, char text[32])
{
  snprintf(text, 32, isfinite(value) ? "%.17g" : "null", value);
  return text;
}

static int announce(struct mo_store *store, const struct writing *call)
{
  const struct mo_training_body *body = call->body;
  char zero_shot[32], finetuned[32];
  return mo_writer_event(store, call->id, "training.body",
                         "{\"id\":\"%lld\",\"position\":%u,\"zero_shot\":%s,\"finetuned\":%s}",
                         (long long)call->id, (unsigned)body->position,
                         number(body->zero_shot, zero_shot), number(body->finetuned, finetuned));
}

static int write_body(struct mo_store *store, void *arguments)
{
  static const char sql[] =
      "INSERT INTO training_bodies(job,position,zero_shot,zero_shot_diverged,finetuned,"
      "finetuned_diverged,controller,kept,stored_us) VALUES(?1,?2,?3,?4,?5,?6,?7,?8,?9)";
  static const char forgive_sql[] = "UPDATE jobs SET attempts=0 WHERE id=?1 AND attempts>0";
  static const char checkpoints_sql[] =
      "SELECT generation,step,size FROM checkpoints WHERE job=?1 AND ?2=0 AND ?3=0 AND ?4=0";
  struct writing *call = arguments;
  const struct mo_training_body *body = call->body;
  struct mo_connection *writer = &store->writer;
  int error = mo_run_touch(store, call->id);
  if (error == MO_OK && call->displaces)
    error = displace(store, call);
  if (error == MO_OK && call->put != NULL)
    error = mo_controller_put_row(store, call->put);
  if (error == MO_OK)
    error =
        mo_sql_do(writer, sql, mo_int(call->id), mo_int(body->position), mo_real(body->zero_shot),
                  mo_int(body->zero_shot_diverged), mo_real(body->finetuned),
                  mo_int(body->finetuned_diverged), mo_hash(&body->controller_sha256),
                  mo_int(call->put != NULL), mo_int(mo_clock_wall_us()));
  if (error == MO_OK)
    error = mo_sql_do(writer, forgive_sql, mo_int(call->id));
  if (error == MO_OK)
    error = mo_checkpoint_drop(store, checkpoints_sql, 0, &call->checkpoint);
  return error == MO_OK ? announce(store, call) : error;
}

int mo_store_training_body(struct mo_store *store, int64_t id,
                           const struct mo_training_record *record,
                           const struct mo_training_body *body, const char *name,
                           const uint8_t *bytes, size_t size,
                           const struct mo_controller *controller)
{
  struct writing call = {
      .id = id, .body = body, .name = name, .checkpoint = {.id = id, .kind = MO_JOB_TRAINING}};
  struct mo_controller_put put = {.name = ""};
  char own[NAME_BYTES], displaced[8 + MO_SHA256_DIGITS];
  struct mo_message message;
  bool keeps = false;
  int error = choose(store, record, &call, &keeps);
  name_of(name, body->position, own);
  if (error == MO_OK && keeps) {
    error = mo_controller_put_begin(store, own, bytes, size, controller, &put);
    call.put = &put;
  }
  if (error == MO_OK)
    error = mo_checkpoint_write(store, NULL, &call.checkpoint, write_body, &call);
  mo_controller_put_end(store, &put);
  if (error == MO_OK && call.displaces) {
    /* If something refers to the file, it stays; after an error, it remains as an unused file. */
    snprintf(displaced, sizeof(displaced), "sha256:%s", MO_SHA256_HEX(&call.displaced_sha256));
    (void)mo_store_controller_delete(store, displaced, &message);
  }
  return error;
}

/* ---- reading ---- */

static int take_body(sqlite3_stmt *row, void *any)
{
  struct mo_training_body *body = any;
  *body = (struct mo_training_body){.position = mo_column_u32(row, 0),
                                    .zero_shot = mo_column_number(row, 1),
                                    .zero_shot_diverged = mo_column_u32(row, 2),
                                    .finetuned = mo_column_number(row, 3),
                                    .finetuned_diverged = mo_column_u32(row, 4),
                                    .is_kept = sqlite3_column_int(row, 6) != 0,
                                    .first_loss = mo_column_number(row, 9),
                                    .last_loss = mo_column_number(row, 10),
                                    .skipped = mo_column_u32(row, 11)};
  const int error = mo_column_hash(row, 5, &body->controller_sha256);
  return error == MO_OK ? mo_column_listed(row, 7, 8, &body->genotype, &body->form) : error;
}

int64_t mo_store_training_bodies(struct mo_store *store, int64_t id, int64_t after,
                                 struct mo_training_body *rows, size_t limit)
{
#define STEPS "FROM training_steps s WHERE s.job=?1 AND s.step"
  static const char sql[] =
      "SELECT b.position,b.zero_shot,b.zero_shot_diverged,b.finetuned,b.finetuned_diverged,"
      "b.controller,b.kept,g.bits,d.form,"
      "(SELECT s.mean_loss " STEPS "=b.position*?2+1),"
      "(SELECT s.mean_loss " STEPS "=(b.position+1)*?2),"
      "(SELECT count(*) " STEPS ">b.position*?2 AND s.step<=(b.position+1)*?2 AND s.skipped)"
      " FROM training_bodies b JOIN job_designs x ON x.job=b.job AND x.position=b.position"
      " JOIN genotypes g ON g.id=x.genotype JOIN designs d ON d.id=g.design"
      " WHERE b.job=?1 AND b.position>?3 ORDER BY b.position LIMIT ?4";
#undef STEPS
  struct mo_training_status status;
  const int error = mo_store_training(store, id, &status);
  if (error != MO_OK)
    return error;
  return mo_read_page(store, sql,
                      MO_VALUES(mo_int(id), mo_int(status.record.settings.n_steps), mo_int(after),
                                mo_int((int64_t)limit)),
                      take_body, rows, sizeof(*rows));
}

int mo_store_training_pairs(struct mo_store *store, int64_t id, double **pairs, uint32_t *n)
{
  static const char n_sql[] = "SELECT count(*) FROM training_bodies WHERE job=?1 AND"
                              " zero_shot IS NOT NULL AND finetuned IS NOT NULL";
  static const char sql[] = "SELECT zero_shot,finetuned FROM training_bodies WHERE job=?1 AND"
                            " zero_shot IS NOT NULL AND finetuned IS NOT NULL ORDER BY position";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int64_t count = 0;
  uint32_t at = 0;
  int error = mo_sql_find(reader, &count, n_sql, mo_int(id));
  *n = 0;
  *pairs = NULL;
  if (error != MO_OK)
    return error;
  double *numbers = calloc(2 * (size_t)count + 1, sizeof(*numbers));
  if (numbers == NULL)
    return MO_ERR_NO_MEMORY;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id));
  for (; at < count && mo_sql_next(reader, row, &error); at++) {
    numbers[at] = sqlite3_column_double(row, 0);
    numbers[count + at] = sqlite3_column_double(row, 1);
  }
  if (error == MO_OK && at < count)
    error = MO_ERR_CORRUPT;
  if (error != MO_OK) {
    free(numbers);
    return error;
  }
  *pairs = numbers;
  *n = at;
  return MO_OK;
}
