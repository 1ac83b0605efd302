/* evaluations.c: reads the results and trajectories of evaluations. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/scores.h"

/* ---- results ---- */

struct result_keys {
  int64_t controller, physics, fingerprint, workers; /* fingerprint 0: the job has not started */
  bool verify, is_complete; /* is_complete: the job has succeeded, so that no loss is missing */
  int64_t environments[MO_ENVIRONMENTS_MAX];
};

static int load_keys(struct mo_connection *reader, int64_t id, struct result_keys *keys,
                     struct mo_evaluation_results *results)
{
  static const char sql[] =
      "SELECT controller,physics,verify,n_designs,n_environments,coalesce(fingerprint,0),"
      "coalesce(workers,0),state=3 FROM evaluations JOIN jobs ON id=job WHERE job=?1";
  static const char environments_sql[] =
      "SELECT position,environment FROM evaluation_environments WHERE job=?1 ORDER BY position";
  int error = MO_OK;
  int64_t n_designs, n_environments;
  uint32_t k = 0;
  int step;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  step = mo_sql_step(reader, statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_NOT_FOUND;
  keys->controller = sqlite3_column_int64(statement, 0);
  keys->physics = sqlite3_column_int64(statement, 1);
  keys->verify = sqlite3_column_int(statement, 2) != 0;
  n_designs = sqlite3_column_int64(statement, 3);
  n_environments = sqlite3_column_int64(statement, 4);
  keys->fingerprint = sqlite3_column_int64(statement, 5);
  keys->workers = sqlite3_column_int64(statement, 6);
  keys->is_complete = sqlite3_column_int(statement, 7) != 0;
  (void)sqlite3_reset(statement);
  if (n_designs < 1 || n_designs > MO_DESIGNS_MAX || n_environments < 1 ||
      n_environments > MO_ENVIRONMENTS_MAX)
    return MO_ERR_CORRUPT;
  results->n_designs = (uint32_t)n_designs;
  results->n_environments = (uint32_t)n_environments;
  statement = mo_sql(reader, environments_sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  while ((step = mo_sql_step(reader, statement)) > 0) {
    if (k == results->n_environments || sqlite3_column_int64(statement, 0) != k)
      return MO_ERR_CORRUPT;
    keys->environments[k++] = sqlite3_column_int64(statement, 1);
  }
  if (step < 0)
    return step;
  return k == results->n_environments ? MO_OK : MO_ERR_CORRUPT;
}

static int allocate_results(struct mo_evaluation_results *results, bool verify)
{
  size_t n = results->n_designs, cells = n * results->n_environments;
  results->forms = calloc(n, sizeof(*results->forms));
  results->genotypes = calloc(n, sizeof(*results->genotypes));
  results->scores = calloc(n, sizeof(*results->scores));
  results->losses = calloc(cells, sizeof(*results->losses));
  results->diverged_steps = calloc(cells, sizeof(*results->diverged_steps));
  if (verify) {
    results->stored_losses = calloc(cells, sizeof(*results->stored_losses));
    results->agrees = calloc(n, sizeof(*results->agrees));
  }
  if (results->forms == NULL || results->genotypes == NULL || results->scores == NULL ||
      results->losses == NULL || results->diverged_steps == NULL ||
      (verify && (results->stored_losses == NULL || results->agrees == NULL)))
    return MO_ERR_NO_MEMORY;
  for (size_t i = 0; i < cells; i++) {
    results->losses[i] = NAN;
    if (verify)
      results->stored_losses[i] = NAN;
  }
  return MO_OK;
}

/* Reads the stored losses of one genotype into row `n` of the results. */
static int load_losses(struct mo_connection *reader, const struct result_keys *keys,
                       int64_t genotype, size_t n, struct mo_evaluation_results *results)
{
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  const size_t first = n * results->n_environments;
  int error = mo_losses_read(reader, genotype, keys->controller, keys->physics, keys->fingerprint,
                             keys->workers, keys->environments, results->n_environments, scores);
  for (uint32_t k = 0; k < results->n_environments && error == MO_OK; k++)
    if (scores[k].known) {
      results->losses[first + k] = scores[k].loss;
      results->diverged_steps[first + k] = scores[k].diverged_step;
    } else if (keys->is_complete) {
      error = MO_ERR_CORRUPT;
    }
  return error;
}

static int load_designs(struct mo_connection *reader, int64_t id, const struct result_keys *keys,
                        struct mo_evaluation_results *results)
{
  static const char sql[] = "SELECT e.position,e.genotype,g.bits,d.form FROM evaluation_designs e"
                            " JOIN genotypes g ON g.id=e.genotype JOIN designs d ON d.id=g.design"
                            " WHERE e.job=?1 ORDER BY e.position";
  int error = MO_OK;
  int step = 0;
  uint32_t n = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    if (n == results->n_designs || sqlite3_column_int64(statement, 0) != n) {
      error = MO_ERR_CORRUPT;
      break;
    }
    error = mo_column_genotype(statement, 2, 3, &results->genotypes[n], &results->forms[n]);
    if (error == MO_OK && !keys->verify && keys->fingerprint != 0)
      error = load_losses(reader, keys, sqlite3_column_int64(statement, 1), n, results);
    n++;
  }
  if (step < 0)
    return step;
  return error == MO_OK && n != results->n_designs ? MO_ERR_CORRUPT : error;
}

static bool same_bits(double a, double b)
{
  uint64_t words[2];
  memcpy(&words[0], &a, sizeof(a));
  memcpy(&words[1], &b, sizeof(b));
  return words[0] == words[1];
}

static int load_recomputed(struct mo_connection *reader, int64_t id,
                           struct mo_evaluation_results *results)
{
  static const char sql[] =
      "SELECT position,environment,diverged_step,loss,stored,checksum FROM recomputed"
      " WHERE job=?1 ORDER BY position,environment";
  int error = MO_OK;
  int step = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  memset(results->agrees, 1, results->n_designs);
  sqlite3_bind_int64(statement, 1, id);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    const int64_t n = sqlite3_column_int64(statement, 0), k = sqlite3_column_int64(statement, 1);
    const int64_t key[4] = {id, n, k, sqlite3_column_int64(statement, 2)};
    const bool has_stored = sqlite3_column_type(statement, 4) != SQLITE_NULL;
    double values[2] = {NAN, NAN};
    size_t cell;
    if (n < 0 || n >= results->n_designs || k < 0 || k >= results->n_environments)
      return MO_ERR_CORRUPT;
    cell = (size_t)n * results->n_environments + (size_t)k;
    for (int i = 0; i <= has_stored && error == MO_OK; i++)
      error = mo_column_double(statement, 3 + i, &values[i]);
    if (error == MO_OK && mo_recomputed_checksum(key, values, has_stored ? 2 : 1) !=
                              (uint64_t)sqlite3_column_int64(statement, 5))
      error = MO_ERR_CORRUPT;
    results->losses[cell] = values[0];
    results->stored_losses[cell] = values[1];
    results->diverged_steps[cell] = (int32_t)key[3];
    if (has_stored && !same_bits(values[0], values[1]))
      results->agrees[n] = 0;
  }
  return step < 0 ? step : error;
}

int mo_store_results(struct mo_store *store, int64_t id, struct mo_evaluation_results **ret)
{
  struct mo_evaluation_results *results = calloc(1, sizeof(*results));
  struct mo_connection *reader;
  struct result_keys keys = {0};
  int error;
  if (results == NULL)
    return MO_ERR_NO_MEMORY;
  reader = mo_reader_acquire(store);
  error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = load_keys(reader, id, &keys, results);
  if (error == MO_OK)
    error = allocate_results(results, keys.verify);
  if (error == MO_OK)
    error = load_designs(reader, id, &keys, results);
  if (error == MO_OK && keys.verify)
    error = load_recomputed(reader, id, results);
  mo_reader_release(store, reader);
  if (error != MO_OK) {
    mo_evaluation_results_free(results);
    return error;
  }
  for (uint32_t n = 0; n < results->n_designs; n++) {
    double sum = 0;
    for (uint32_t k = 0; k < results->n_environments; k++)
      sum += results->losses[(size_t)n * results->n_environments + k];
    results->scores[n] = sum / results->n_environments;
  }
  *ret = results;
  return MO_OK;
}

/* ---- trajectories ---- */

static int read_trajectory(sqlite3_stmt *row, struct mo_trajectory *trajectory)
{
  int64_t stride = sqlite3_column_int64(row, 0), frames = sqlite3_column_int64(row, 1);
  int64_t n_masses = sqlite3_column_int64(row, 2);
  bool has_com = sqlite3_column_type(row, 3) != SQLITE_NULL,
       has_masses = sqlite3_column_type(row, 4) != SQLITE_NULL;
  if (stride < 1 || stride > MO_STEPS_MAX || frames < 1 || frames > MO_STEPS_MAX + 1 ||
      n_masses < 1 || n_masses > MO_DEFAULT_MASSES ||
      (has_com && sqlite3_column_bytes(row, 3) != frames * 24) ||
      (has_masses && sqlite3_column_bytes(row, 4) != frames * n_masses * 12))
    return MO_ERR_CORRUPT;
  trajectory->stride = (uint32_t)stride;
  trajectory->n_frames = (uint32_t)frames;
  trajectory->n_masses = (uint32_t)n_masses;
  if (has_com) {
    size_t n = (size_t)frames * 3;
    trajectory->com_m = malloc(n * sizeof(double));
    if (trajectory->com_m == NULL)
      return MO_ERR_NO_MEMORY;
    mo_decode_doubles(sqlite3_column_blob(row, 3), n, trajectory->com_m);
  }
  if (has_masses) {
    size_t n = (size_t)frames * (size_t)n_masses * 3;
    trajectory->mass_m = malloc(n * sizeof(float));
    if (trajectory->mass_m == NULL)
      return MO_ERR_NO_MEMORY;
    mo_decode_floats(sqlite3_column_blob(row, 4), n, trajectory->mass_m);
  }
  return MO_OK;
}

int mo_store_trajectory(struct mo_store *store, int64_t id, uint32_t n, uint32_t k,
                        struct mo_trajectory **ret)
{
  static const char sql[] =
      "SELECT t.stride,t.frames,t.n_masses,t.com,t.masses,p.encoding FROM trajectories t"
      " JOIN evaluations e ON e.job=t.job JOIN physics p ON p.id=e.physics"
      " WHERE t.job=?1 AND t.position=?2 AND t.environment=?3";
  struct mo_trajectory *trajectory = calloc(1, sizeof(*trajectory));
  struct mo_connection *reader;
  sqlite3_stmt *statement;
  struct mo_physics physics;
  enum mo_precision precision;
  enum mo_sensor sensor;
  int error = MO_OK;
  if (trajectory == NULL)
    return MO_ERR_NO_MEMORY;
  reader = mo_reader_acquire(store);
  statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    int step;
    sqlite3_bind_int64(statement, 1, id);
    sqlite3_bind_int64(statement, 2, n);
    sqlite3_bind_int64(statement, 3, k);
    step = mo_sql_step(reader, statement);
    error = step > 0 ? read_trajectory(statement, trajectory) : step < 0 ? step : MO_ERR_NOT_FOUND;
    if (error == MO_OK) {
      const void *encoding = sqlite3_column_blob(statement, 5);
      error = encoding == NULL
                  ? MO_ERR_CORRUPT
                  : mo_decode_physics(encoding, (size_t)sqlite3_column_bytes(statement, 5),
                                      &physics, &precision, &sensor);
      if (error == MO_OK)
        trajectory->dt_s = physics.dt_s;
    }
  }
  mo_reader_release(store, reader);
  if (error != MO_OK) {
    mo_trajectory_free(trajectory);
    return error;
  }
  *ret = trajectory;
  return MO_OK;
}
