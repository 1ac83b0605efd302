/* certificates.c: see certificates.h. */
#include "store/certificates.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/words.h"
#include "store/certificate_rows.h"
#include "store/contents.h"
#include "store/controller_rows.h"
#include "store/jobs.h"
#include "store/measures.h"
#include "store/runs.h"
#include "store/scores.h"
#include "store/warnings.h"
#include "store/worlds.h"

#define CHECKSUM  8
#define KEY_WORDS 3

/* ---- submission ---- */

static int insert_row(struct mo_connection *writer, int64_t id,
                      const struct mo_certificate_request *request, int64_t controller,
                      int64_t physics, int64_t set, int64_t n_environments)
{
  static const char sql[] =
      "INSERT INTO certificates(job,settings,n_designs,population,taken,controller,"
      "controller_name,physics,environment_set,n_environments,n_trials,n_rollouts)"
      " VALUES(?1,?2,?3,?4,?5,?6,?7,?8,nullif(?9,0),?10,?11,?12)";
  const struct mo_certificate_record *record = &request->record;
  const char *by_name = strncmp(request->controller, "sha256:", 7) == 0 ? "" : request->controller;
  struct mo_text settings = {0};
  int error = MO_ERR_NO_MEMORY;
  mo_fields_write_object(&settings, &mo_certificate_fields, &record->settings);
  if (!settings.failed)
    error = mo_sql_do(writer, sql, mo_int(id), mo_string(settings.data), mo_int(request->n_designs),
                      mo_int(record->population), mo_int(record->taken), mo_int(controller),
                      mo_string(by_name), mo_int(physics), mo_int(set), mo_int(n_environments),
                      mo_int(record->n_trials), mo_int((int64_t)record->n_rollouts));
  mo_text_free(&settings);
  return error;
}

static int insert(struct mo_store *store, const void *any, int64_t *id)
{
  const struct mo_certificate_request *request = any;
  struct mo_connection *writer = &store->writer;
  struct mo_physics physics = request->physics;
  enum mo_sensor sensor = MO_SENSOR_INVERSE_SQRT;
  int64_t controller = 0, physics_row = 0, set = 0, n_environments = request->n_environments;
  int error = mo_controller_find(writer, request->controller, &controller, &sensor, &physics);
  if (error == MO_OK)
    error = mo_physics_row(writer, &physics, MO_FLOAT32, sensor, &physics_row);
  if (error == MO_OK && request->environment_set != NULL)
    error = mo_environment_set_find(writer, request->environment_set, &set, &n_environments);
  if (error == MO_OK)
    error = mo_job_insert(writer, &request->job, MO_JOB_CERTIFICATE, id);
  if (error == MO_OK)
    error = insert_row(writer, *id, request, controller, physics_row, set, n_environments);
  if (error == MO_OK)
    error =
        mo_environments_insert(writer, *id, set, request->environments, (uint32_t)n_environments);
  if (error == MO_OK)
    error = mo_notes_insert(writer, *id, request->notes, request->n_notes);
  if (error == MO_OK)
    error = mo_designs_insert(writer, *id, request->forms, request->genotypes, request->n_designs,
                              NULL, 0, mo_clock_wall_us());
  if (error == MO_OK)
    error = mo_writer_event(store, *id, "job.created",
                            "{\"id\":\"%lld\",\"kind\":\"certificate\",\"state\":\"queued\"}",
                            (long long)*id);
  return error == MO_OK ? mo_run_announce_warnings(store, *id, true) : error;
}

int mo_store_submit_certificate(struct mo_store *store,
                                const struct mo_certificate_request *request, int64_t *id,
                                bool *replayed)
{
  return mo_submit(store, &request->job.key, insert, request, id, replayed);
}

/* ---- reading ---- */

static int load_status(struct mo_connection *reader, int64_t id, void *any)
{
  struct mo_certificate_status *status = any;
  sqlite3_stmt *row;
  memset(status, 0, sizeof(*status));
  int error = mo_job_row(reader, id, MO_JOB_CERTIFICATE, &row);
  if (error == MO_OK)
    error = mo_job_read(row, &status->job, &status->record);
  return error == MO_OK ? mo_job_warn(reader, &status->job, &status->record) : error;
}

int mo_store_certificate(struct mo_store *store, int64_t id, struct mo_certificate_status *status)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return load_status(reader, id, status);
}

int64_t mo_store_certificates(struct mo_store *store, const struct mo_job_query *query,
                              void *statuses, size_t limit)
{
  struct mo_job_query certificates = *query;
  certificates.kind = MO_JOB_CERTIFICATE;
  return mo_read_jobs(store, &certificates, limit, load_status, statuses,
                      sizeof(struct mo_certificate_status));
}

int mo_store_certificate_classes(struct mo_store *store, int64_t id,
                                 struct mo_certificate_classes *classes)
{
  static const char sql[] =
      "SELECT f.text,g.text FROM certificates k LEFT JOIN fingerprints f ON f.id=k.fingerprint"
      " LEFT JOIN fingerprints g ON g.id=k.fingerprint64 WHERE k.job=?1";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_int(id));
  for (int i = 0; i < 2 && error == MO_OK; i++)
    mo_column_text(row, i, classes->fingerprint[i], sizeof(classes->fingerprint[i]));
  return error;
}

int mo_store_certificate_base(struct mo_store *store, const struct mo_certificate_status *status,
                              struct mo_environment **environments,
                              struct mo_certificate_base *base)
{
  const struct mo_job *job = &status->job;
  const int set = mo_word_index(mo_set_words, job->environment_set);
  *environments = NULL;
  *base = (struct mo_certificate_base){.physics = job->physics,
                                       .precision = job->precision,
                                       .set = set >= 0 ? mo_set_words[set] : NULL};
  const int error = mo_store_job_environments(store, job->id, MO_JOB_CERTIFICATE, environments,
                                              &base->n_environments);
  if (error != MO_OK)
    base->n_environments = 0;
  base->environments = *environments;
  return error == MO_OK && base->n_environments != job->n_environments ? MO_ERR_CORRUPT : error;
}

/* ---- the losses of a trial ---- */

/* A trial that is being read. */
struct trial {
  uint32_t n_designs, n_environments;
  uint64_t n; /* losses read so far */
  float *losses;
  double (*measures)[MO_MEASURES];
};

/* Returns the index of a loss, by design and environment, from its place in the order of storing.
 * Parts before the last one are full. */
static size_t index_of(const struct trial *trial, uint64_t place)
{
  const uint64_t of_part = (uint64_t)MO_CERTIFICATE_PART * trial->n_designs;
  const uint32_t first = (uint32_t)(place / of_part) * MO_CERTIFICATE_PART;
  const uint32_t left = trial->n_environments - first;
  const uint32_t width = left < MO_CERTIFICATE_PART ? left : MO_CERTIFICATE_PART;
  const uint64_t rest = place % of_part;
  return (size_t)(rest / width) * trial->n_environments + first + rest % width;
}

/* A row of certificate_losses: trial, place, losses, measures, starting at column `first`. */
struct row {
  int64_t key[KEY_WORDS];
  uint64_t place;
  const uint8_t *losses, *measures; /* measures NULL: none */
  size_t n, measures_size;
};
/* MO_ERR_CORRUPT: wrong size or wrong checksum. Does not check the measures. */
static int read_row(sqlite3_stmt *statement, int first, int64_t id, struct row *row)
{
  const size_t size = (size_t)sqlite3_column_bytes(statement, first + 2);
  uint64_t sum;
  *row = (struct row){.key = {id, sqlite3_column_int64(statement, first),
                              sqlite3_column_int64(statement, first + 1)},
                      .place = (uint64_t)sqlite3_column_int64(statement, first + 1),
                      .losses = sqlite3_column_blob(statement, first + 2),
                      .measures = sqlite3_column_blob(statement, first + 3),
                      .measures_size = (size_t)sqlite3_column_bytes(statement, first + 3)};
  if (row->losses == NULL || size <= CHECKSUM || (size - CHECKSUM) % sizeof(float) != 0)
    return MO_ERR_CORRUPT;
  row->n = (size - CHECKSUM) / sizeof(float);
  memcpy(&sum, row->losses + size - CHECKSUM, CHECKSUM);
  return sum == mo_row_checksum(row->key, KEY_WORDS, row->losses, size - CHECKSUM) ? MO_OK
                                                                                   : MO_ERR_CORRUPT;
}

/* Reads the measures of a row (malloc). */
static int unpack(const struct row *row, double (**values)[MO_MEASURES])
{
  uint32_t n_measures = 0;
  *values = malloc((row->n + 1) * sizeof(**values));
  return *values == NULL
             ? MO_ERR_NO_MEMORY
             : mo_unpack_measures(row->key, KEY_WORDS, row->measures, row->measures_size,
                                  (uint32_t)row->n, *values, &n_measures);
}

int mo_certificate_row_check(sqlite3_stmt *statement)
{
  double(*values)[MO_MEASURES] = NULL;
  struct row row;
  int error = read_row(statement, 1, sqlite3_column_int64(statement, 0), &row);
  if (error == MO_OK && row.measures != NULL)
    error = unpack(&row, &values);
  free(values);
  return error;
}

/* Adds a row, which must continue the earlier ones. */
static int add_row(sqlite3_stmt *statement, int64_t id, struct trial *trial)
{
  const uint64_t left = (uint64_t)trial->n_designs * trial->n_environments - trial->n;
  double(*values)[MO_MEASURES] = NULL;
  struct row row;
  int error = read_row(statement, 0, id, &row);
  if (error == MO_OK && (row.place != trial->n || row.n > left))
    error = MO_ERR_CORRUPT;
  if (error == MO_OK && trial->measures != NULL)
    error = unpack(&row, &values);
  for (size_t i = 0; i < row.n && error == MO_OK; i++) {
    const size_t at = index_of(trial, row.place + i);
    memcpy(&trial->losses[at], row.losses + i * sizeof(float), sizeof(float));
    if (values != NULL)
      memcpy(trial->measures[at], values[i], sizeof(values[i]));
  }
  free(values);
  trial->n += row.n;
  return error;
}

int mo_store_certificate_losses(struct mo_store *store, int64_t id, uint32_t number,
                                uint32_t n_designs, uint32_t n_environments, float *losses,
                                double (*measures)[MO_MEASURES])
{
  static const char sql[] = "SELECT trial,place,losses,measures FROM certificate_losses"
                            " WHERE job=?1 AND trial=?2 ORDER BY place";
  struct trial trial = {n_designs, n_environments, 0, losses, measures};
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id), mo_int(number));
  while (mo_sql_next(reader, row, &error))
    error = add_row(row, id, &trial);
  return error == MO_OK && trial.n < (uint64_t)n_designs * n_environments ? MO_ERR_NOT_FOUND
                                                                          : error;
}

/* ---- the runner's writes ---- */

struct start {
  int64_t id;
  const struct mo_certificate_classes *classes;
  bool restarts;
};

static int start(struct mo_store *store, void *arguments)
{
  static const char known_sql[] =
      "SELECT rollouts_done>0 AND (fingerprint IS NOT ?2 OR fingerprint64 IS NOT ?3)"
      " FROM certificates WHERE job=?1";
  static const char set_sql[] =
      "UPDATE certificates SET fingerprint=?2,fingerprint64=?3 WHERE job=?1";
  static const char forget_sql[] = "DELETE FROM certificate_losses WHERE job=?1";
  static const char zero_sql[] =
      "UPDATE certificates SET trials_done=0,rollouts_done=0 WHERE job=?1";
  struct start *call = arguments;
  struct mo_connection *writer = &store->writer;
  int64_t of[2] = {0, 0}, differs = 0;
  int error = mo_run_touch(store, call->id);
  for (int i = 0; i < 2 && error == MO_OK; i++)
    error = mo_text_row(writer, MO_FINGERPRINTS, call->classes->fingerprint[i], &of[i]);
  if (error == MO_OK)
    error =
        mo_sql_find(writer, &differs, known_sql, mo_int(call->id), mo_int(of[0]), mo_int(of[1]));
  if (error == MO_OK && differs != 0)
    error = mo_sql_do(writer, forget_sql, mo_int(call->id));
  if (error == MO_OK && differs != 0)
    error = mo_sql_do(writer, zero_sql, mo_int(call->id));
  if (error == MO_OK)
    error = mo_sql_do(writer, set_sql, mo_int(call->id), mo_int(of[0]), mo_int(of[1]));
  call->restarts = differs != 0;
  return error;
}

int mo_store_certificate_start(struct mo_store *store, int64_t id,
                               const struct mo_certificate_classes *classes, bool *restarts)
{
  struct start call = {id, classes, false};
  const int error = mo_write(store, start, &call);
  *restarts = error == MO_OK && call.restarts;
  return error;
}

struct save {
  int64_t id;
  const struct mo_certificate_losses *losses;
  size_t n;
  const struct mo_certificate_record *progress;
};

static int save_losses(struct mo_connection *writer, int64_t id,
                       const struct mo_certificate_losses *losses)
{
  static const char sql[] =
      "INSERT INTO certificate_losses(job,trial,place,losses,measures) VALUES(?1,?2,?3,?4,?5)";
  const int64_t key[KEY_WORDS] = {id, losses->trial, (int64_t)losses->place};
  const size_t size = losses->n * sizeof(float);
  uint8_t *bytes = malloc(size + CHECKSUM),
          *measures = losses->measures != NULL ? malloc(MO_PACKED_MEASURES_BYTES(losses->n)) : NULL;
  size_t measures_size = 0;
  int error = MO_ERR_NO_MEMORY;
  if (bytes != NULL && (measures != NULL || losses->measures == NULL)) {
    memcpy(bytes, losses->losses, size);
    const uint64_t sum = mo_row_checksum(key, KEY_WORDS, bytes, size);
    memcpy(bytes + size, &sum, CHECKSUM);
    if (measures != NULL)
      measures_size = mo_pack_measures(key, KEY_WORDS, losses->measures, losses->n, measures);
    error = mo_sql_do(writer, sql, mo_int(id), mo_int(losses->trial),
                      mo_int((int64_t)losses->place), mo_blob(bytes, size + CHECKSUM),
                      measures != NULL ? mo_blob(measures, measures_size) : mo_null());
  }
  free(measures);
  free(bytes);
  return error;
}

static int save(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE certificates SET trials_done=?2,rollouts_done=?3 WHERE job=?1";
  static const char forgive_sql[] = "UPDATE jobs SET attempts=0 WHERE id=?1 AND attempts>0";
  const struct save *call = arguments;
  const struct mo_certificate_record *progress = call->progress;
  struct mo_connection *writer = &store->writer;
  int error = mo_run_touch(store, call->id);
  if (error == MO_OK)
    error = mo_sql_do(writer, forgive_sql, mo_int(call->id));
  for (size_t i = 0; i < call->n && error == MO_OK; i++)
    error = save_losses(writer, call->id, &call->losses[i]);
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, mo_int(call->id), mo_int(progress->trials_done),
                      mo_int((int64_t)progress->rollouts_done));
  if (error != MO_OK)
    return error;
  return mo_writer_event(store, call->id, "certificate.progress",
                         "{\"id\":\"%lld\",\"trials_done\":%u,\"trials\":%u,"
                         "\"rollouts_done\":%llu,\"rollouts\":%llu}",
                         (long long)call->id, (unsigned)progress->trials_done,
                         (unsigned)progress->n_trials, (unsigned long long)progress->rollouts_done,
                         (unsigned long long)progress->n_rollouts);
}

int mo_store_certificate_save(struct mo_store *store, int64_t id,
                              const struct mo_certificate_losses *losses, size_t n,
                              const struct mo_certificate_record *progress)
{
  return mo_write(store, save, &(struct save){id, losses, n, progress});
}

struct verdicts {
  const uint8_t *of; /* (n) */
  uint32_t n;
};

/* A design that is listed twice has equal losses and one row. */
static int insert_verdicts(struct mo_connection *writer, int64_t id, const void *context)
{
  static const char sql[] =
      "INSERT OR REPLACE INTO certificate_verdicts(genotype,job,controller,verdict)"
      " SELECT d.genotype,k.job,k.controller,?3 FROM certificates k JOIN job_designs d"
      " ON d.job=k.job AND d.position=?2 WHERE k.job=?1";
  const struct verdicts *verdicts = context;
  int error = MO_OK;
  for (uint32_t i = 0; i < verdicts->n && error == MO_OK; i++)
    error = mo_sql_do(writer, sql, mo_int(id), mo_int(i), mo_int(verdicts->of[i]));
  return error;
}

int mo_store_certificate_finish(struct mo_store *store, int64_t id, const uint8_t *verdicts,
                                uint32_t n_designs)
{
  const struct mo_run_result none = {.controller = NULL};
  const struct verdicts all = {verdicts, n_designs};
  return mo_run_finish(store, id, &none, "", insert_verdicts, &all);
}
