/* trainings.c: submits and reads trainings: settings, curve, checkpoints, the designs of
 * populations. */
#include "store/trainings.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "base/clock.h"
#include "store/campaigns.h"
#include "store/internal.h"

/* ---- submission ---- */

struct submit_arguments {
  const struct mo_training_submission *submission;
  int64_t id;
  bool replayed;
};

static int insert_training(struct mo_connection *writer,
                           const struct mo_training_submission *submission, int64_t parent,
                           const struct mo_training_settings *settings, int64_t id)
{
  static const char sql[] =
      "INSERT INTO "
      "trainings(job,kind,settings,name,parent,parent_name,n_designs,population,n_steps,"
      "validate_every_steps,checkpoint_every_steps,checkpoint_every_s,checkpoints_kept,step)"
      " VALUES(?1,?2,?3,?4,nullif(?5,0),?6,?7,?8,?9,?10,?11,?12,?13,0)";
  const struct mo_training_record *record = &submission->record;
  bool named = submission->parent != NULL && strncmp(submission->parent, "sha256:", 7) != 0;
  uint8_t bytes[MO_TRAINING_BYTES];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  mo_encode_training(settings, bytes);
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, settings->kind);
  sqlite3_bind_blob(statement, 3, bytes, sizeof(bytes), SQLITE_STATIC);
  sqlite3_bind_text(statement, 4, record->name, -1, SQLITE_STATIC);
  sqlite3_bind_int64(statement, 5, parent);
  sqlite3_bind_text(statement, 6, named ? submission->parent : "", -1, SQLITE_STATIC);
  sqlite3_bind_int64(statement, 7, record->n_designs);
  sqlite3_bind_int64(statement, 8, record->population);
  sqlite3_bind_int64(statement, 9, settings->n_steps);
  sqlite3_bind_int64(statement, 10, record->validate_every_steps);
  sqlite3_bind_int64(statement, 11, record->checkpoint_every_steps);
  sqlite3_bind_int64(statement, 12, record->checkpoint_every_s);
  sqlite3_bind_int64(statement, 13, record->checkpoints_kept);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error;
}

static int submit(struct mo_store *store, void *arguments)
{
  static const char designs_sql[] =
      "INSERT INTO training_designs(job,position,genotype) VALUES(?1,?2,?3)";
  struct submit_arguments *call = arguments;
  const struct mo_training_submission *submission = call->submission;
  struct mo_training_settings settings = submission->record.settings;
  struct mo_connection *writer = &store->writer;
  int64_t parent = 0, now_us = mo_clock_wall_us();
  char data[160];
  int error = MO_OK;
  call->replayed = false;
  if (submission->idempotency_key != NULL) {
    error = mo_key_find(writer, submission->idempotency_key, &submission->body_sha256, &call->id);
    call->replayed = error == MO_OK;
    if (error != MO_ERR_NOT_FOUND)
      return error;
    error = MO_OK;
  }
  if (submission->parent != NULL) {
    error = mo_controller_find(writer, submission->parent, &parent);
    if (error == MO_OK)
      error = mo_controller_sensor(writer, parent, &settings.sensor);
  }
  if (error == MO_OK)
    error = mo_job_insert(writer, MO_JOB_TRAINING, submission->priority, submission->back_end,
                          submission->weight, submission->label, now_us, &call->id);
  if (error == MO_OK)
    error = insert_training(writer, submission, parent, &settings, call->id);
  if (error == MO_OK)
    error = mo_designs_insert(writer, designs_sql, call->id, submission->forms,
                              submission->genotypes, submission->record.n_designs, now_us);
  if (error == MO_OK && submission->idempotency_key != NULL)
    error = mo_key_insert(writer, submission->idempotency_key, &submission->body_sha256, now_us,
                          call->id);
  if (error == MO_OK) {
    snprintf(data, sizeof(data),
             "{\"id\":\"%lld\",\"kind\":\"training\",\"state\":\"queued\",\"steps\":%u}",
             (long long)call->id, (unsigned)settings.n_steps);
    error = mo_writer_event(store, call->id, "job.created", data);
  }
  return error;
}

int mo_store_submit_training(struct mo_store *store,
                             const struct mo_training_submission *submission, int64_t *id,
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

/* ---- one training ---- */

static double column_number(sqlite3_stmt *row, int column)
{
  return sqlite3_column_type(row, column) == SQLITE_NULL ? NAN : sqlite3_column_double(row, column);
}

#define STEP_COLUMNS                                                                               \
  "step,mean_loss,rate,gradient_norm,clipped_share,clipped_robots_share,diverged,zeroed,skipped,"  \
  "bounded,seconds"

static int step_from_row(sqlite3_stmt *row, void *any)
{
  struct mo_training_step_row *step = any;
  *step =
      (struct mo_training_step_row){.report = {.step = (uint32_t)sqlite3_column_int64(row, 0),
                                               .mean_loss = column_number(row, 1),
                                               .rate = column_number(row, 2),
                                               .gradient_norm = column_number(row, 3),
                                               .clipped_share = column_number(row, 4),
                                               .clipped_robots_share = column_number(row, 5),
                                               .diverged = (uint32_t)sqlite3_column_int64(row, 6),
                                               .zeroed = (uint32_t)sqlite3_column_int64(row, 7),
                                               .skipped = sqlite3_column_int(row, 8) != 0,
                                               .bounded = (uint32_t)sqlite3_column_int64(row, 9)},
                                    .seconds = column_number(row, 10)};
  return MO_OK;
}

#define VALIDATION_COLUMNS "step,rollouts,diverged,mean_score,standard_error"

static int validation_from_row(sqlite3_stmt *row, void *any)
{
  struct mo_training_validation_row *validation = any;
  *validation =
      (struct mo_training_validation_row){.step = (uint32_t)sqlite3_column_int64(row, 0),
                                          .rollouts = (uint32_t)sqlite3_column_int64(row, 1),
                                          .diverged = (uint32_t)sqlite3_column_int64(row, 2),
                                          .mean_score = column_number(row, 3),
                                          .standard_error = column_number(row, 4)};
  return MO_OK;
}

static int load_head(struct mo_connection *reader, int64_t id, struct mo_training_status *status)
{
  static const char sql[] =
      "SELECT " MO_JOB_COLUMNS
      ",t.name,t.population,t.validate_every_steps,t.checkpoint_every_steps,t.checkpoint_every_s,"
      "t.checkpoints_kept,r.sha256,t.parent IS NOT NULL" MO_JOB_TABLES
      "LEFT JOIN controllers r ON r.id=t.result WHERE j.id=?1 AND j.kind=1";
  struct mo_training_record *record = &status->record;
  int error = MO_OK;
  int step;
  sqlite3_stmt *row = mo_sql(reader, sql, &error);
  if (row == NULL)
    return error;
  sqlite3_bind_int64(row, 1, id);
  step = mo_sql_step(reader, row);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_NOT_FOUND;
  error = mo_job_from_row(row, &status->job);
  if (error == MO_OK) /* they can be decoded: that was tried */
    error = mo_decode_training(sqlite3_column_blob(row, 26), (size_t)sqlite3_column_bytes(row, 26),
                               &record->settings);
  mo_column_text(row, 24, record->parent_name, sizeof(record->parent_name));
  record->n_designs = status->job.n_designs;
  status->step = status->job.steps_done;
  mo_column_text(row, MO_JOB_N_COLUMNS, record->name, sizeof(record->name));
  record->population = sqlite3_column_int64(row, MO_JOB_N_COLUMNS + 1);
  record->validate_every_steps = (uint32_t)sqlite3_column_int64(row, MO_JOB_N_COLUMNS + 2);
  record->checkpoint_every_steps = (uint32_t)sqlite3_column_int64(row, MO_JOB_N_COLUMNS + 3);
  record->checkpoint_every_s = (uint32_t)sqlite3_column_int64(row, MO_JOB_N_COLUMNS + 4);
  record->checkpoints_kept = (uint32_t)sqlite3_column_int64(row, MO_JOB_N_COLUMNS + 5);
  status->has_result = sqlite3_column_type(row, MO_JOB_N_COLUMNS + 6) != SQLITE_NULL;
  if (error == MO_OK && status->has_result &&
      mo_column_hash(row, MO_JOB_N_COLUMNS + 6, &status->result_sha256) != MO_OK)
    error = MO_ERR_CORRUPT;
  record->has_parent = sqlite3_column_int(row, MO_JOB_N_COLUMNS + 7) != 0;
  record->parent_sha256 = status->job.controller_sha256;
  (void)sqlite3_reset(row);
  return error;
}

/* Steps to the first row of a query by job. Returns 1: a row, on which the statement stays; 0:
 * none; negative: an error. */
static int first_row(struct mo_connection *reader, const char *sql, int64_t id, sqlite3_stmt **row)
{
  int error = MO_OK;
  *row = mo_sql(reader, sql, &error);
  if (*row == NULL)
    return error;
  sqlite3_bind_int64(*row, 1, id);
  return mo_sql_step(reader, *row);
}

static int load_status(struct mo_connection *reader, int64_t id, void *any)
{
  static const char step_sql[] =
      "SELECT " STEP_COLUMNS " FROM training_steps WHERE job=?1 ORDER BY step DESC LIMIT 1";
  static const char validation_sql[] =
      "SELECT " VALIDATION_COLUMNS
      " FROM training_validations WHERE job=?1 ORDER BY step DESC LIMIT 1";
  static const char checkpoint_sql[] =
      "SELECT step FROM training_checkpoints WHERE job=?1 ORDER BY step DESC LIMIT 1";
  struct mo_training_status *status = any;
  sqlite3_stmt *row;
  int found;
  int error;
  memset(status, 0, sizeof(*status));
  error = load_head(reader, id, status);
  if (error != MO_OK)
    return error;
  found = first_row(reader, step_sql, id, &row);
  if (found > 0) {
    (void)step_from_row(row, &status->last);
    (void)sqlite3_reset(row);
  }
  if (found >= 0 && (found = first_row(reader, validation_sql, id, &row)) > 0) {
    status->has_validation = true;
    (void)validation_from_row(row, &status->validation);
    (void)sqlite3_reset(row);
  }
  if (found >= 0 && (found = first_row(reader, checkpoint_sql, id, &row)) > 0) {
    status->checkpoint_step = (uint32_t)sqlite3_column_int64(row, 0);
    (void)sqlite3_reset(row);
  }
  return found < 0 ? found : mo_training_code_load(reader, id, &status->code);
}

int mo_store_training(struct mo_store *store, int64_t id, struct mo_training_status *status)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_training_status found = {0};
  int error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = load_status(reader, id, &found);
  mo_reader_release(store, reader);
  if (error == MO_OK)
    *status = found;
  return error;
}

/* ---- lists ---- */

int64_t mo_store_trainings(struct mo_store *store, const struct mo_job_query *query,
                           struct mo_training_status *statuses, size_t limit)
{
  static const char *const all_sql[] =
      MO_PAGES("SELECT j.id FROM jobs j CROSS JOIN trainings t ON t.job=j.id", "j.kind=1");
  static const char *const label_sql[] = MO_PAGES(
      "SELECT j.id FROM jobs j CROSS JOIN trainings t ON t.job=j.id", "j.label=?6 AND j.kind=1");
  const char *const *sql = query->label != NULL ? label_sql : all_sql;
  return mo_read_jobs(store, sql[mo_job_page(query)], query, 0, limit, load_status, statuses,
                      sizeof(*statuses));
}

int64_t mo_store_training_steps(struct mo_store *store, int64_t id, uint32_t after, uint32_t stride,
                                struct mo_training_step_row *rows, size_t limit)
{
  static const char all_sql[] =
      "SELECT " STEP_COLUMNS " FROM training_steps WHERE job=?1 AND step>?2"
      " AND ?3<=1 ORDER BY step LIMIT ?4";
  /* Looks up each multiple: in a million rows, reading all rows between takes a third of a second.
   */
  static const char some_sql[] =
      "WITH RECURSIVE wanted(at) AS (SELECT (?2/?3+1)*?3 UNION ALL SELECT at+?3 FROM wanted"
      " WHERE at+?3<=(SELECT max(step) FROM training_steps WHERE job=?1) LIMIT ?4)"
      " SELECT " STEP_COLUMNS " FROM wanted CROSS JOIN training_steps WHERE job=?1 AND step=at"
      " ORDER BY at";
  const int64_t values[] = {id, after, stride};
  return mo_read_rows(store, stride > 1 ? some_sql : all_sql, values, 3, limit, step_from_row, rows,
                      sizeof(*rows));
}

int64_t mo_store_training_validations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_training_validation_row *rows, size_t limit)
{
  static const char sql[] =
      "SELECT " VALIDATION_COLUMNS " FROM training_validations WHERE job=?1 AND step>?2"
      " ORDER BY step LIMIT ?3";
  const int64_t values[] = {id, after};
  return mo_read_rows(store, sql, values, 2, limit, validation_from_row, rows, sizeof(*rows));
}

static int take_checkpoint(sqlite3_stmt *statement, void *any)
{
  struct mo_training_checkpoint_row *row = any;
  row->step = (uint32_t)sqlite3_column_int64(statement, 0);
  row->size = (uint64_t)sqlite3_column_int64(statement, 2);
  row->stored_us = sqlite3_column_int64(statement, 3);
  return mo_column_hash(statement, 1, &row->sha256);
}

int64_t mo_store_training_checkpoints(struct mo_store *store, int64_t id,
                                      struct mo_training_checkpoint_row *rows, size_t limit)
{
  static const char sql[] =
      "SELECT step,sha256,size,stored_us FROM training_checkpoints WHERE job=?1"
      " ORDER BY step DESC LIMIT ?2";
  return mo_read_rows(store, sql, &id, 1, limit, take_checkpoint, rows, sizeof(*rows));
}

int mo_store_training_designs(struct mo_store *store, int64_t id, struct mo_bits **ret,
                              uint32_t *ret_n)
{
  static const char sql[] =
      "SELECT x.position,g.bits,d.form FROM training_designs x JOIN genotypes g ON"
      " g.id=x.genotype JOIN designs d ON d.id=g.design WHERE x.job=?1 ORDER BY x.position";
  struct mo_training_status status;
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_bits *genotypes = NULL;
  sqlite3_stmt *statement = NULL;
  uint32_t n = 0;
  int step = 0;
  int error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = load_head(reader, id, memset(&status, 0, sizeof(status)));
  if (error == MO_OK) {
    genotypes =
        calloc(status.record.n_designs > 0 ? status.record.n_designs : 1, sizeof(*genotypes));
    error = genotypes == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  }
  if (error == MO_OK)
    statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, id);
    while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
      if (n == status.record.n_designs || sqlite3_column_int64(statement, 0) != n)
        error = MO_ERR_CORRUPT;
      else
        error = mo_column_genotype(statement, 1, 2, &genotypes[n++], NULL);
    }
    if (step < 0)
      error = step;
    if (error == MO_OK && n != status.record.n_designs)
      error = MO_ERR_CORRUPT;
  }
  mo_reader_release(store, reader);
  if (error != MO_OK) {
    free(genotypes);
    return error;
  }
  *ret = genotypes;
  *ret_n = n;
  return MO_OK;
}

/* ---- populations ---- */

struct ranked {
  double score;
  struct mo_bits genotype;
};

/* Compares by score, then by bits, so that equal genotypes, which have equal scores, become
 * neighbors. */
static int compare_ranked(const void *a, const void *b)
{
  const struct ranked *first = a, *second = b;
  if (first->score != second->score)
    return first->score < second->score ? -1 : 1;
  for (int w = 0; w < MO_DEFAULT_WORDS; w++)
    if (first->genotype.words[w] != second->genotype.words[w])
      return first->genotype.words[w] < second->genotype.words[w] ? -1 : 1;
  return 0;
}

/* Reads the newest population of a campaign, which is sorted and has each form once. */
static int population_of_campaign(struct mo_store *store, int64_t id, uint32_t best,
                                  struct mo_bits **ret, uint32_t *ret_n)
{
  struct mo_campaign_state *state = NULL;
  uint32_t n = 0;
  int error = mo_store_campaign_state(store, id, &state);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CONFLICT : error;
  for (uint32_t i = 0; i < state->n && (best == 0 || n < best); i++)
    if (isfinite(state->scores[i]))
      state->genotypes[n++] = state->genotypes[i];
  *ret = state->genotypes;
  *ret_n = n;
  state->genotypes = NULL;
  mo_campaign_state_free(state);
  return MO_OK;
}

int mo_store_population(struct mo_store *store, int64_t id, uint32_t best, struct mo_bits **ret,
                        uint32_t *ret_n)
{
  struct mo_evaluation_results *results = NULL;
  struct mo_bits *genotypes = NULL;
  struct ranked *ranked = NULL;
  struct mo_job job;
  uint32_t n_ranked = 0, n = 0;
  int error = mo_store_job(store, id, &job);
  if (error == MO_OK && job.kind == MO_JOB_CAMPAIGN)
    return population_of_campaign(store, id, best, ret, ret_n);
  if (error == MO_OK && job.kind != MO_JOB_EVALUATION)
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK && job.state != MO_JOB_SUCCEEDED)
    error = MO_ERR_CONFLICT;
  if (error == MO_OK)
    error = mo_store_results(store, id, &results);
  if (error != MO_OK)
    return error;
  ranked = calloc(results->n_designs, sizeof(*ranked));
  genotypes = calloc(results->n_designs, sizeof(*genotypes));
  if (ranked == NULL || genotypes == NULL)
    error = MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < results->n_designs && error == MO_OK; i++)
    if (isfinite(results->scores[i]))
      ranked[n_ranked++] = (struct ranked){results->scores[i], results->genotypes[i]};
  if (n_ranked > 0)
    qsort(ranked, n_ranked, sizeof(*ranked), compare_ranked);
  for (uint32_t i = 0; i < n_ranked && (best == 0 || n < best); i++)
    if (i == 0 || compare_ranked(&ranked[i - 1], &ranked[i]) != 0)
      genotypes[n++] = ranked[i].genotype;
  free(ranked);
  mo_evaluation_results_free(results);
  if (error != MO_OK) {
    free(genotypes);
    return error;
  }
  *ret = genotypes;
  *ret_n = n;
  return MO_OK;
}
