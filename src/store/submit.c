/* submit.c: accepts an evaluation: stores all that it needs later, in one transaction. */
#include <stdio.h>
#include <string.h>

#include "store/internal.h"

#include "base/clock.h"

/* ---- rows by content: found or inserted ---- */

/* Finds or inserts the row of a table whose rows are identified by the hash of their bytes. */
static int content_row(struct mo_connection *writer, const char *find_sql, const char *insert_sql,
                       const uint8_t *bytes, int size, int64_t *row)
{
  struct mo_sha256 hash;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, find_sql, &error);
  if (statement == NULL)
    return error;
  mo_sha256_of(bytes, (size_t)size, &hash);
  mo_bind_hash(statement, 1, &hash);
  error = mo_sql_integer(writer, statement, row);
  if (error != MO_ERR_NOT_FOUND)
    return error;
  statement = mo_sql(writer, insert_sql, &error);
  if (statement == NULL)
    return error;
  mo_bind_hash(statement, 1, &hash);
  sqlite3_bind_blob(statement, 2, bytes, size, SQLITE_STATIC);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  *row = sqlite3_last_insert_rowid(writer->db);
  return error;
}

int mo_environment_row(struct mo_connection *writer, const struct mo_environment *environment,
                       int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM environments WHERE sha256=?1";
  static const char insert_sql[] = "INSERT INTO environments(sha256,data) VALUES(?1,?2)";
  uint8_t bytes[MO_ENVIRONMENT_BYTES];
  mo_encode_environment(environment, bytes);
  return content_row(writer, find_sql, insert_sql, bytes, sizeof(bytes), row);
}

int mo_physics_row(struct mo_connection *writer, const struct mo_physics *physics,
                   enum mo_precision precision, enum mo_sensor sensor, int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM physics WHERE sha256=?1";
  static const char insert_sql[] = "INSERT INTO physics(sha256,encoding) VALUES(?1,?2)";
  uint8_t bytes[MO_PHYSICS_BYTES];
  mo_encode_physics(physics, precision, sensor, bytes);
  return content_row(writer, find_sql, insert_sql, bytes, sizeof(bytes), row);
}

int mo_genotype_row(struct mo_connection *writer, const struct mo_bits *form,
                    const struct mo_bits *genotype, int64_t now_us, int64_t *row)
{
  static const char find_sql[] = "SELECT id FROM genotypes WHERE bits=?1";
  static const char find_design_sql[] = "SELECT id FROM designs WHERE form=?1";
  static const char insert_design_sql[] = "INSERT INTO designs(form,first_seen_us) VALUES(?1,?2)";
  static const char insert_sql[] = "INSERT INTO genotypes(bits,design) VALUES(?1,?2)";
  uint8_t bits[MO_BITS_BYTES], canonical[MO_BITS_BYTES];
  sqlite3_stmt *statement;
  int64_t design = 0;
  int error = MO_OK;
  mo_encode_bits(genotype, bits);
  statement = mo_sql(writer, find_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_blob(statement, 1, bits, sizeof(bits), SQLITE_STATIC);
  error = mo_sql_integer(writer, statement, row);
  if (error != MO_ERR_NOT_FOUND)
    return error;
  mo_encode_bits(form, canonical);
  statement = mo_sql(writer, find_design_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_blob(statement, 1, canonical, sizeof(canonical), SQLITE_STATIC);
  error = mo_sql_integer(writer, statement, &design);
  if (error == MO_ERR_NOT_FOUND) {
    statement = mo_sql(writer, insert_design_sql, &error);
    if (statement == NULL)
      return error;
    sqlite3_bind_blob(statement, 1, canonical, sizeof(canonical), SQLITE_STATIC);
    sqlite3_bind_int64(statement, 2, now_us);
    error = mo_sql_run(writer, statement);
    design = sqlite3_last_insert_rowid(writer->db);
  }
  if (error != MO_OK)
    return error;
  statement = mo_sql(writer, insert_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_blob(statement, 1, bits, sizeof(bits), SQLITE_STATIC);
  sqlite3_bind_int64(statement, 2, design);
  error = mo_sql_run(writer, statement);
  *row = sqlite3_last_insert_rowid(writer->db);
  return error;
}

/* ---- named sets ---- */

int mo_environment_set_find(struct mo_connection *connection, const char *name, int64_t *row,
                            int64_t *n)
{
  static const char sql[] = "SELECT id,n FROM environment_sets WHERE name=?1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(connection, sql, &error);
  int step;
  if (statement == NULL)
    return error;
  sqlite3_bind_text(statement, 1, name, -1, SQLITE_STATIC);
  step = mo_sql_step(connection, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_NOT_FOUND;
  *row = sqlite3_column_int64(statement, 0);
  *n = sqlite3_column_int64(statement, 1);
  (void)sqlite3_reset(statement);
  return MO_OK;
}

int mo_store_environment_set_size(struct mo_store *store, const char *name, uint32_t *n)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  int64_t row, size = 0;
  int error = mo_environment_set_find(reader, name, &row, &size);
  mo_reader_release(store, reader);
  if (error == MO_OK && (size < 1 || size > MO_ENVIRONMENTS_MAX))
    error = MO_ERR_CORRUPT;
  if (error == MO_OK)
    *n = (uint32_t)size;
  return error;
}

/* ---- submission ---- */

int mo_key_find(struct mo_connection *connection, const char *key, const struct mo_sha256 *body,
                int64_t *id)
{
  static const char sql[] = "SELECT job,body_sha256 FROM idempotency_keys WHERE key=?1";
  struct mo_sha256 known;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(connection, sql, &error);
  int step;
  if (statement == NULL)
    return error;
  sqlite3_bind_text(statement, 1, key, -1, SQLITE_STATIC);
  step = mo_sql_step(connection, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_NOT_FOUND;
  error = mo_column_hash(statement, 1, &known);
  if (error == MO_OK && !mo_sha256_equal(&known, body))
    error = MO_ERR_CONFLICT;
  if (error == MO_OK)
    *id = sqlite3_column_int64(statement, 0);
  (void)sqlite3_reset(statement);
  return error;
}

int mo_store_replay(struct mo_store *store, const char *key, const struct mo_sha256 *body_sha256,
                    int64_t *id)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  int error = mo_key_find(reader, key, body_sha256, id);
  mo_reader_release(store, reader);
  return error;
}

struct submit_arguments {
  const struct mo_submission *submission;
  int64_t id;
  bool replayed;
};

struct setting {
  int64_t controller, physics, set;
  uint32_t n_environments;
};

int mo_controller_sensor(struct mo_connection *connection, int64_t row, enum mo_sensor *sensor)
{
  static const char sql[] = "SELECT sensor,nx,ny,nz FROM controllers WHERE id=?1";
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(connection, sql, &error);
  bool fits;
  int step;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, row);
  step = mo_sql_step(connection, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_CORRUPT;
  *sensor = (enum mo_sensor)sqlite3_column_int(statement, 0);
  fits = sqlite3_column_int64(statement, 1) == workspace.nx &&
         sqlite3_column_int64(statement, 2) == workspace.ny &&
         sqlite3_column_int64(statement, 3) == workspace.nz;
  (void)sqlite3_reset(statement);
  return fits ? MO_OK : MO_ERR_UNSUPPORTED;
}

/* Finds the rows of what a submission names, and inserts those of what it lists. */
static int resolve(struct mo_connection *writer, const struct mo_submission *submission,
                   struct setting *setting)
{
  enum mo_sensor sensor = MO_SENSOR_INVERSE_SQRT;
  int64_t n = 0;
  int error = mo_controller_find(writer, submission->controller, &setting->controller);
  if (error == MO_OK)
    error = mo_controller_sensor(writer, setting->controller, &sensor);
  if (error != MO_OK)
    return error;
  error = mo_physics_row(writer, &submission->physics, submission->precision, sensor,
                         &setting->physics);
  setting->set = 0;
  setting->n_environments = submission->n_environments;
  if (error == MO_OK && submission->environment_set != NULL) {
    error = mo_environment_set_find(writer, submission->environment_set, &setting->set, &n);
    if (error == MO_OK &&
        (setting->set == 0 /* 0 means that there is no set */ || n < 1 || n > MO_ENVIRONMENTS_MAX))
      error = MO_ERR_CORRUPT;
    setting->n_environments = (uint32_t)n;
  }
  return error;
}

int mo_job_insert(struct mo_connection *writer, enum mo_job_kind kind, enum mo_urgency priority,
                  enum mo_back_end back_end, double weight, const char *label, int64_t now_us,
                  int64_t *id)
{
  static const char sql[] =
      "INSERT INTO jobs(kind,state,priority,version,epoch,attempts,label,created_us,started_us,"
      "finished_us,error,weight,back_end) VALUES(?1,0,?2,1,0,0,?3,?4,0,0,0,?5,?6)";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, kind);
  sqlite3_bind_int64(statement, 2, priority);
  sqlite3_bind_text(statement, 3, label, -1, SQLITE_STATIC);
  sqlite3_bind_int64(statement, 4, now_us);
  sqlite3_bind_double(statement, 5, weight > 0 ? weight : 1);
  sqlite3_bind_int64(statement, 6, back_end);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  *id = sqlite3_last_insert_rowid(writer->db);
  return error;
}

static int insert_job(struct mo_connection *writer, const struct mo_submission *submission,
                      const struct setting *setting, int64_t now_us, int64_t *id)
{
  static const char evaluation_sql[] = "INSERT INTO "
                                       "evaluations(job,controller,controller_name,physics,"
                                       "environment_set,n_designs,n_environments,verify,"
                                       "record,record_stride,done,cached,diverged) "
                                       "VALUES(?1,?2,?3,?4,nullif(?5,0),?6,?7,?8,?9,?10,0,0,0)";
  const char *name =
      strncmp(submission->controller, "sha256:", 7) == 0 ? "" : submission->controller;
  sqlite3_stmt *statement;
  int error = mo_job_insert(writer, MO_JOB_EVALUATION, submission->priority, submission->back_end,
                            submission->weight, submission->label, now_us, id);
  statement = error == MO_OK ? mo_sql(writer, evaluation_sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, *id);
  sqlite3_bind_int64(statement, 2, setting->controller);
  sqlite3_bind_text(statement, 3, name, -1, SQLITE_STATIC);
  sqlite3_bind_int64(statement, 4, setting->physics);
  sqlite3_bind_int64(statement, 5, setting->set);
  sqlite3_bind_int64(statement, 6, submission->n_designs);
  sqlite3_bind_int64(statement, 7, setting->n_environments);
  sqlite3_bind_int64(statement, 8, submission->verify);
  sqlite3_bind_int64(statement, 9,
                     (submission->record_com ? 1 : 0) + (submission->record_masses ? 2 : 0));
  sqlite3_bind_int64(statement, 10, submission->record_stride);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error;
}

int mo_environments_insert(struct mo_connection *writer, const char *copy_sql, const char *sql,
                           int64_t id, int64_t set, const struct mo_environment *environments,
                           uint32_t n)
{
  sqlite3_stmt *statement;
  int64_t row = 0;
  int error = MO_OK;
  if (set != 0) {
    statement = mo_sql(writer, copy_sql, &error);
    if (statement == NULL)
      return error;
    sqlite3_bind_int64(statement, 1, id);
    sqlite3_bind_int64(statement, 2, set);
    return mo_sql_run(writer, statement);
  }
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    error = mo_environment_row(writer, &environments[i], &row);
    if (error == MO_OK && (statement = mo_sql(writer, sql, &error)) != NULL) {
      sqlite3_bind_int64(statement, 1, id);
      sqlite3_bind_int64(statement, 2, i);
      sqlite3_bind_int64(statement, 3, row);
      error = mo_sql_run(writer, statement);
    }
  }
  return error;
}

int mo_designs_insert(struct mo_connection *writer, const char *sql, int64_t id,
                      const struct mo_bits *forms, const struct mo_bits *genotypes, uint32_t n,
                      int64_t now_us)
{
  sqlite3_stmt *statement;
  int64_t row = 0;
  int error = MO_OK;
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    error = mo_genotype_row(writer, &forms[i], &genotypes[i], now_us, &row);
    if (error == MO_OK && (statement = mo_sql(writer, sql, &error)) != NULL) {
      sqlite3_bind_int64(statement, 1, id);
      sqlite3_bind_int64(statement, 2, i);
      sqlite3_bind_int64(statement, 3, row);
      error = mo_sql_run(writer, statement);
    }
  }
  return error;
}

int mo_key_insert(struct mo_connection *writer, const char *key, const struct mo_sha256 *body,
                  int64_t now_us, int64_t id)
{
  static const char sql[] =
      "INSERT INTO idempotency_keys(key,body_sha256,job,created_us) VALUES(?1,?2,?3,?4)";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_text(statement, 1, key, -1, SQLITE_STATIC);
  mo_bind_hash(statement, 2, body);
  sqlite3_bind_int64(statement, 3, id);
  sqlite3_bind_int64(statement, 4, now_us);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error;
}

static int submit(struct mo_store *store, void *arguments)
{
  static const char copy_sql[] =
      "INSERT INTO evaluation_environments(job,position,environment)"
      " SELECT ?1,position,environment FROM environment_set_members WHERE environment_set=?2";
  static const char environments_sql[] =
      "INSERT INTO evaluation_environments(job,position,environment) VALUES(?1,?2,?3)";
  static const char designs_sql[] =
      "INSERT INTO evaluation_designs(job,position,genotype) VALUES(?1,?2,?3)";
  struct submit_arguments *call = arguments;
  const struct mo_submission *submission = call->submission;
  struct mo_connection *writer = &store->writer;
  struct setting setting;
  int64_t now_us = mo_clock_wall_us();
  char data[160];
  int error;
  call->replayed = false;
  if (submission->idempotency_key != NULL) {
    error = mo_key_find(writer, submission->idempotency_key, &submission->body_sha256, &call->id);
    call->replayed = error == MO_OK;
    if (error != MO_ERR_NOT_FOUND)
      return error;
  }
  error = resolve(writer, submission, &setting);
  if (error == MO_OK)
    error = insert_job(writer, submission, &setting, now_us, &call->id);
  if (error == MO_OK)
    error = mo_environments_insert(writer, copy_sql, environments_sql, call->id, setting.set,
                                   submission->environments, submission->n_environments);
  if (error == MO_OK)
    error = mo_designs_insert(writer, designs_sql, call->id, submission->forms,
                              submission->genotypes, submission->n_designs, now_us);
  if (error == MO_OK && submission->idempotency_key != NULL)
    error = mo_key_insert(writer, submission->idempotency_key, &submission->body_sha256, now_us,
                          call->id);
  if (error == MO_OK) {
    snprintf(
        data, sizeof(data),
        "{\"id\":\"%lld\",\"kind\":\"evaluation\",\"state\":\"queued\",\"rollouts_total\":%llu}",
        (long long)call->id, (unsigned long long)submission->n_designs * setting.n_environments);
    error = mo_writer_event(store, call->id, "job.created", data);
  }
  return error;
}

int mo_store_submit(struct mo_store *store, const struct mo_submission *submission, int64_t *id,
                    bool *replayed)
{
  struct submit_arguments call = {.submission = submission};
  int error = mo_write(store, submit, &call);
  if (error == MO_OK) {
    *id = call.id;
    *replayed = call.replayed;
  }
  return error;
}
