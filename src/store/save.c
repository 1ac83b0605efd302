/* save.c: what the scheduler writes, in one transaction: losses, trajectories, steps of jobs.
 *
 * Updates of a job are fenced: they apply only to a job that runs under this opening of the store
 * (its epoch). So a job that a client has cancelled or paused meanwhile keeps that state. Scores
 * are stored in any case, because they are true. So are the counts of a job that is not final;
 * otherwise blocks that finish after a pause would seem to be another job's work. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/runs.h"

#include "base/clock.h"

static int read_stored(struct mo_connection *writer, const struct mo_saved_score *score,
                       uint8_t stored[8], bool *known)
{
  static const char sql[] = "SELECT loss FROM scores WHERE genotype=?1 AND controller=?2 AND "
                            "physics=?3 AND environment=?4";
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, score->genotype);
  sqlite3_bind_int64(statement, 2, score->controller);
  sqlite3_bind_int64(statement, 3, score->physics);
  sqlite3_bind_int64(statement, 4, score->environment);
  step = mo_sql_step(writer, statement);
  *known = step > 0;
  if (step > 0) {
    const void *blob = sqlite3_column_blob(statement, 0);
    if (blob == NULL || sqlite3_column_bytes(statement, 0) != 8)
      error = MO_ERR_CORRUPT;
    else
      memcpy(stored, blob, 8);
    (void)sqlite3_reset(statement);
  }
  return step < 0 ? step : error;
}

static int note_recomputed(struct mo_connection *writer, const struct mo_saved_score *score,
                           const uint8_t loss[8])
{
  static const char sql[] =
      "INSERT OR IGNORE INTO recomputed(job,position,environment,loss,diverged_step,stored)"
      " VALUES(?1,?2,?3,?4,?5,?6)";
  uint8_t stored[8];
  bool known = false;
  sqlite3_stmt *statement;
  int error = read_stored(writer, score, stored, &known);
  if (error != MO_OK)
    return error;
  statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, score->verify_job);
  sqlite3_bind_int64(statement, 2, score->design_position);
  sqlite3_bind_int64(statement, 3, score->environment_position);
  sqlite3_bind_blob(statement, 4, loss, 8, SQLITE_STATIC);
  sqlite3_bind_int64(statement, 5, score->diverged_step);
  if (known)
    sqlite3_bind_blob(statement, 6, stored, 8, SQLITE_STATIC);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error;
}

static const char score_sql[] =
    "INSERT OR IGNORE INTO scores(genotype,controller,physics,environment,loss,"
    "diverged_step,fingerprint,computed_us) VALUES(?,?,?,?,?,?,?,?)";
/* Inserting eight rows at once takes two thirds of the time. */
enum { TOGETHER = 8, COLUMNS = 8 };
#define ROW "(?,?,?,?,?,?,?,?)"
static const char scores_sql[] =
    "INSERT OR IGNORE INTO scores(genotype,controller,physics,environment,loss,"
    "diverged_step,fingerprint,computed_us) VALUES" ROW "," ROW "," ROW "," ROW "," ROW "," ROW
    "," ROW "," ROW;

/* Inserts TOGETHER scores, or one. */
static int insert_scores(struct mo_connection *writer, const struct mo_saved_score *scores, int n,
                         int64_t now_us, uint32_t *n_new)
{
  uint8_t losses[TOGETHER][8];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, n == TOGETHER ? scores_sql : score_sql, &error);
  if (statement == NULL)
    return error;
  for (int i = 0; i < n; i++) {
    const int column = COLUMNS * i;
    mo_encode_double(scores[i].loss, losses[i]);
    sqlite3_bind_int64(statement, column + 1, scores[i].genotype);
    sqlite3_bind_int64(statement, column + 2, scores[i].controller);
    sqlite3_bind_int64(statement, column + 3, scores[i].physics);
    sqlite3_bind_int64(statement, column + 4, scores[i].environment);
    sqlite3_bind_blob(statement, column + 5, losses[i], 8, SQLITE_STATIC);
    sqlite3_bind_int64(statement, column + 6, scores[i].diverged_step);
    sqlite3_bind_int64(statement, column + 7, scores[i].fingerprint);
    sqlite3_bind_int64(statement, column + 8, now_us);
  }
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  if (error == MO_OK)
    *n_new += (uint32_t)sqlite3_changes(writer->db);
  return error;
}

/* Returns how many scores to insert next. A score that a verify job compares with the stored one is
 * inserted alone, in its turn. */
static size_t run_of_scores(const struct mo_saved_score *scores, size_t n)
{
  size_t i = 0;
  while (i < n && i < TOGETHER && scores[i].verify_job == 0)
    i++;
  return i == TOGETHER ? TOGETHER : 1;
}

int mo_scores_insert(struct mo_connection *writer, const struct mo_saved_score *scores, size_t n,
                     int64_t now_us, uint32_t *n_new)
{
  int error = MO_OK;
  *n_new = 0;
  for (size_t i = 0, run; i < n && error == MO_OK; i += run) {
    run = run_of_scores(scores + i, n - i);
    if (scores[i].verify_job != 0) {
      uint8_t loss[8];
      mo_encode_double(scores[i].loss, loss);
      error = note_recomputed(writer, &scores[i], loss);
    }
    if (error == MO_OK)
      error = insert_scores(writer, scores + i, (int)run, now_us, n_new);
  }
  return error;
}

static int save_trajectory(struct mo_connection *writer,
                           const struct mo_saved_trajectory *trajectory)
{
  static const char sql[] =
      "INSERT OR IGNORE INTO "
      "trajectories(job,position,environment,stride,frames,n_masses,com,masses)"
      " VALUES(?1,?2,?3,?4,?5,?6,?7,?8)";
  size_t n_com = trajectory->com_m != NULL ? (size_t)trajectory->frames * 3 : 0;
  size_t n_mass =
      trajectory->mass_m != NULL ? (size_t)trajectory->frames * trajectory->n_masses * 3 : 0;
  uint8_t *bytes = malloc(n_com * 8 + n_mass * 4 + 1);
  sqlite3_stmt *statement;
  int error = MO_OK;
  if (bytes == NULL)
    return MO_ERR_NO_MEMORY;
  mo_encode_doubles(trajectory->com_m, n_com, bytes);
  mo_encode_floats(trajectory->mass_m, n_mass, bytes + n_com * 8);
  statement = mo_sql(writer, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, trajectory->job);
    sqlite3_bind_int64(statement, 2, trajectory->design_position);
    sqlite3_bind_int64(statement, 3, trajectory->environment_position);
    sqlite3_bind_int64(statement, 4, trajectory->stride);
    sqlite3_bind_int64(statement, 5, trajectory->frames);
    sqlite3_bind_int64(statement, 6, trajectory->n_masses);
    if (n_com > 0)
      sqlite3_bind_blob64(statement, 7, bytes, n_com * 8, SQLITE_STATIC);
    if (n_mass > 0)
      sqlite3_bind_blob64(statement, 8, bytes + n_com * 8, n_mass * 4, SQLITE_STATIC);
    error = mo_sql_run(writer, statement);
    (void)sqlite3_clear_bindings(statement);
  }
  free(bytes);
  return error;
}

static void bind_design(sqlite3_stmt *statement, const struct mo_saved_design *design)
{
  sqlite3_bind_int64(statement, 1, design->controller);
  sqlite3_bind_int64(statement, 2, design->physics);
  sqlite3_bind_int64(statement, 3, design->environment_set);
  sqlite3_bind_int64(statement, 4, design->genotype);
}

int mo_set_score_insert_mean(struct mo_connection *writer, const struct mo_saved_design *design,
                             double mean)
{
  static const char sql[] =
      "INSERT INTO set_scores(controller,physics,environment_set,genotype,score,bits)"
      " VALUES(?1,?2,?3,?4,?5,?6)";
  uint8_t bits[8];
  int error = MO_OK;
  sqlite3_stmt *statement = isnan(mean) ? NULL : mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error != MO_OK ? error : MO_ERR_CORRUPT;
  mo_encode_double(mean, bits);
  bind_design(statement, design);
  sqlite3_bind_double(statement, 5, mean);
  sqlite3_bind_blob(statement, 6, bits, sizeof(bits), SQLITE_STATIC);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  return error;
}

/* Stores the mean over a named set, computed from the stored bits in the set's order. Writes
 * nothing while the set is incomplete. */
int mo_set_score_insert(struct mo_connection *writer, const struct mo_saved_design *design)
{
  static const char known_sql[] = "SELECT 1 FROM set_scores WHERE controller=?1 AND physics=?2 AND "
                                  "environment_set=?3 AND genotype=?4";
  static const char losses_sql[] = "SELECT x.loss FROM environment_set_members m LEFT JOIN scores "
                                   "x ON x.genotype=?4 AND x.controller=?1"
                                   " AND x.physics=?2 AND x.environment=m.environment WHERE "
                                   "m.environment_set=?3 ORDER BY m.position";
  sqlite3_stmt *statement;
  double sum = 0;
  int64_t n = 0;
  int step;
  int error = MO_OK;
  statement = mo_sql(writer, known_sql, &error);
  if (statement == NULL)
    return error;
  bind_design(statement, design);
  error = mo_sql_integer(writer, statement, &n);
  if (error != MO_ERR_NOT_FOUND)
    return error; /* it is stored already, or an error */
  n = 0;
  error = MO_OK;
  statement = mo_sql(writer, losses_sql, &error);
  if (statement == NULL)
    return error;
  bind_design(statement, design);
  while ((step = mo_sql_step(writer, statement)) > 0) {
    double loss;
    if (sqlite3_column_type(statement, 0) == SQLITE_NULL) {
      (void)sqlite3_reset(statement);
      return MO_OK;
    }
    error = mo_column_double(statement, 0, &loss);
    if (error != MO_OK) {
      (void)sqlite3_reset(statement);
      return error;
    }
    sum += loss;
    n++;
  }
  if (step < 0 || n == 0)
    return step;
  return mo_set_score_insert_mean(writer, design, sum / (double)n);
}

/* ---- steps of jobs ---- */

static const char start_sql[] = "UPDATE jobs SET state=1,epoch=?2," MO_NEXT_VERSION
                                ",started_us=CASE started_us WHEN 0 THEN ?3 ELSE started_us END"
                                " WHERE id=?1 AND (state=0 OR (state=1 AND epoch=?2))";
static const char progress_sql[] =
    "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1 AND state=1 AND epoch=?2";
static const char succeed_sql[] =
    "UPDATE jobs SET state=3," MO_NEXT_VERSION ",finished_us=?3,error=0,error_text=NULL"
    " WHERE id=?1 AND state=1 AND epoch=?2";
static const char retry_sql[] =
    "UPDATE jobs SET attempts=" MO_NEXT_ATTEMPT "," MO_NEXT_VERSION ",error=?4,error_text=?5,"
    "state=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN 4 ELSE 0 END,"
    "finished_us=CASE WHEN " MO_NEXT_ATTEMPT ">=?6 THEN ?3 ELSE 0 END"
    " WHERE id=?1 AND (state=0 OR (state=1 AND epoch=?2))";
static const char park_sql[] =
    "UPDATE jobs SET state=0," MO_NEXT_VERSION " WHERE id=?1 AND state=1 AND epoch=?2";

static const char halt_sql[] = "UPDATE jobs SET state=2," MO_NEXT_VERSION ",error=?4,error_text=?5"
                               " WHERE id=?1 AND (state=0 OR (state=1 AND epoch=?2))";

static int apply_counts(struct mo_connection *writer, const struct mo_job_update *update)
{
  static const char sql[] = "UPDATE evaluations SET done=?2,cached=?3,diverged=?4 WHERE job=?1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, update->job);
  sqlite3_bind_int64(statement, 2, (sqlite3_int64)update->done);
  sqlite3_bind_int64(statement, 3, (sqlite3_int64)update->cached);
  sqlite3_bind_int64(statement, 4, (sqlite3_int64)update->diverged);
  return mo_sql_run(writer, statement);
}

static int read_state(struct mo_connection *writer, struct mo_job_update *update)
{
  static const char sql[] = "SELECT state FROM jobs WHERE id=?1";
  int64_t state;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, update->job);
  error = mo_sql_integer(writer, statement, &state);
  if (error == MO_OK && (state < 0 || state >= MO_JOB_STATES))
    error = MO_ERR_CORRUPT;
  if (error == MO_OK)
    update->state = (enum mo_job_state)state;
  return error;
}

static int announce(struct mo_store *store, const struct mo_job_update *update)
{
  const char *type = update->step == MO_STEP_START          ? "job.started"
                     : update->step == MO_STEP_PROGRESS     ? "job.progress"
                     : update->step == MO_STEP_HALT         ? "job.paused"
                     : mo_job_state_is_final(update->state) ? "job.finished"
                                                            : "job.requeued";
  char data[320];
  snprintf(data, sizeof(data),
           "{\"id\":\"%lld\",\"kind\":\"evaluation\",\"state\":\"%s\",\"rollouts_total\":%llu,"
           "\"rollouts_done\":%llu,"
           "\"rollouts_cached\":%llu,\"rollouts_diverged\":%llu}",
           (long long)update->job, mo_job_state_name(update->state),
           (unsigned long long)update->total, (unsigned long long)update->done,
           (unsigned long long)update->cached, (unsigned long long)update->diverged);
  return mo_writer_event(store, update->job, type, data);
}

/* Stores only the counts of a step that came after the job left its state. */
static int apply_late_counts(struct mo_connection *writer, const struct mo_job_update *update)
{
  static const char sql[] = "UPDATE jobs SET " MO_NEXT_VERSION " WHERE id=?1 AND state IN (0,2)";
  int error = MO_OK;
  sqlite3_stmt *statement;
  if (update->total == 0)
    return MO_OK;
  statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, update->job);
  error = mo_sql_run(writer, statement);
  return error == MO_OK && sqlite3_changes(writer->db) > 0 ? apply_counts(writer, update) : error;
}

static int apply_update(struct mo_store *store, struct mo_job_update *update)
{
  static const char *const sql[] = {start_sql, progress_sql, succeed_sql,
                                    retry_sql, park_sql,     halt_sql};
  struct mo_connection *writer = &store->writer;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql[update->step], &error);
  update->applied = false;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, update->job);
  sqlite3_bind_int64(statement, 2, store->epoch);
  if (update->step == MO_STEP_START)
    sqlite3_bind_int64(statement, 3,
                       update->started_us != 0 ? update->started_us : mo_clock_wall_us());
  if (update->step == MO_STEP_SUCCEED || update->step == MO_STEP_RETRY)
    sqlite3_bind_int64(statement, 3, mo_clock_wall_us());
  if (update->step == MO_STEP_RETRY || update->step == MO_STEP_HALT) {
    sqlite3_bind_int64(statement, 4, update->error);
    sqlite3_bind_text(statement, 5, update->error_text, -1, SQLITE_STATIC);
  }
  if (update->step == MO_STEP_RETRY)
    sqlite3_bind_int64(statement, 6, update->max_attempts);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  if (error != MO_OK)
    return error;
  if (sqlite3_changes(writer->db) == 0)
    return apply_late_counts(writer, update);
  update->applied = true;
  if (update->total > 0)
    error = apply_counts(writer, update);
  if (error == MO_OK)
    error = read_state(writer, update);
  return error == MO_OK && !update->quiet ? announce(store, update) : error;
}

static int save(struct mo_store *store, void *arguments)
{
  struct mo_save *call = arguments;
  struct mo_connection *writer = &store->writer;
  uint32_t n_new = 0;
  int error = mo_scores_insert(writer, call->scores, call->n_scores, mo_clock_wall_us(), &n_new);
  for (size_t i = 0; i < call->n_trajectories && error == MO_OK; i++)
    error = save_trajectory(writer, &call->trajectories[i]);
  for (size_t i = 0; i < call->n_designs && error == MO_OK; i++)
    error = mo_set_score_insert(writer, &call->designs[i]);
  for (size_t i = 0; i < call->n_updates && error == MO_OK; i++)
    error = apply_update(store, &call->updates[i]);
  return error;
}

static void saved(void *arguments, int status)
{
  struct mo_save *call = arguments;
  call->done(call, status);
}

int mo_store_save(struct mo_store *store, struct mo_save *call)
{
  return mo_write_later(store, save, call, saved);
}
