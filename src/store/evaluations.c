/* evaluations.c: reads the results and trajectories of evaluations. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "store/contents.h"
#include "store/measures.h"
#include "store/scores.h"

/* ---- results ---- */

/* The range of designs to read. */
struct range {
  int64_t id;
  uint32_t first, n; /* n 0: all */
  bool no_measures;  /* they are not read */
};

struct result_keys {
  struct mo_saved_design design; /* fingerprint 0: the job has not started */
  bool verify, is_complete;      /* is_complete: the job has succeeded, so no loss may be missing */
  enum mo_integrator integrator;
  uint32_t n_displaced;
  int64_t physics[MO_LADDER_RUNS_MAX]; /* rows of the settings of all runs */
  int64_t environments[MO_SUITE_ENVIRONMENTS_MAX];
};

static int load_keys(struct mo_connection *reader, struct range *range, struct result_keys *keys,
                     struct mo_evaluation_results *results)
{
  static const char sql[] =
      "SELECT controller,physics,verify,n_designs,n_environments,coalesce(fingerprint,0),"
      "coalesce(workers,0),state=3,n_displaced,encoding,measures,tolerance,suite FROM evaluations "
      "JOIN "
      "jobs j ON j.id=job"
      " JOIN physics p ON p.id=physics WHERE job=?1 AND state<>6";
  struct mo_setting first;
  enum mo_sensor sensor;
  sqlite3_stmt *row;
  int error = mo_sql_row(reader, &row, sql, mo_int(range->id));
  if (error == MO_OK)
    error = mo_column_physics(row, 9, &first.physics, &first.precision, &sensor);
  if (error != MO_OK)
    return error;
  *keys = (struct result_keys){.design = {.controller = sqlite3_column_int64(row, 0),
                                          .physics = sqlite3_column_int64(row, 1),
                                          .fingerprint = sqlite3_column_int64(row, 5),
                                          .workers = sqlite3_column_int64(row, 6)},
                               .verify = sqlite3_column_int(row, 2) != 0,
                               .is_complete = sqlite3_column_int(row, 7) != 0,
                               .integrator = first.physics.scheme.integrator,
                               .n_displaced = mo_column_u32(row, 8),
                               .physics = {sqlite3_column_int64(row, 1)}};
  results->n_designs = mo_column_u32(row, 3);
  results->n_environments = mo_column_u32(row, 4);
  results->measure_set = range->no_measures ? 0 : mo_column_u32(row, 10);
  results->n_measures = (uint32_t)__builtin_popcount(results->measure_set);
  if ((results->measure_set & ~MO_MEASURES_ALL) != 0)
    return MO_ERR_CORRUPT;
  results->tolerance = sqlite3_column_double(row, 11);
  const bool is_suite = sqlite3_column_type(row, 12) != SQLITE_NULL;
  for (uint32_t rung = 0; rung < MO_LADDER_RUNGS; rung++)
    results->rungs[rung] = mo_ladder_rung(&first, rung);
  if (results->n_designs < 1 || results->n_designs > MO_LARGE_MAX || results->n_environments < 1 ||
      results->n_environments > (is_suite ? MO_SUITE_ENVIRONMENTS_MAX : MO_ENVIRONMENTS_MAX) ||
      (is_suite && keys->n_displaced > 0) || keys->n_displaced > MO_ERROR_DISPLACED ||
      !mo_tolerance_is_sound(results->tolerance, keys->n_displaced))
    return MO_ERR_CORRUPT;
  if (range->first + range->n > results->n_designs)
    return MO_ERR_NOT_FOUND;
  if (range->n == 0)
    range->n = results->n_designs;
  results->n_designs = range->n;
  error =
      mo_physics_runs(reader, &first, sensor, keys->n_displaced, results->tolerance, keys->physics);
  if (error != MO_OK)
    return error;
  return mo_environments_read(reader, range->id, results->n_environments, NULL, keys->environments);
}

static int allocate_results(struct mo_evaluation_results *results, bool verify, bool has_errors)
{
  const bool climbs = results->tolerance > 0;
  size_t n = results->n_designs, cells = n * results->n_environments;
  results->forms = calloc(n, sizeof(*results->forms));
  results->genotypes = calloc(n, sizeof(*results->genotypes));
  results->scores = calloc(n, sizeof(*results->scores));
  results->is_bound = calloc(n, sizeof(*results->is_bound));
  results->losses = calloc(cells, sizeof(*results->losses));
  results->paths_m = calloc(n, sizeof(*results->paths_m));
  results->diverged_steps = calloc(cells, sizeof(*results->diverged_steps));
  if (has_errors)
    results->errors = calloc(n, sizeof(*results->errors));
  if (climbs)
    results->climbed = calloc(n, sizeof(*results->climbed));
  if (verify) {
    results->stored_losses = calloc(cells, sizeof(*results->stored_losses));
    results->agrees = calloc(n, sizeof(*results->agrees));
  }
  if (results->measure_set != 0) {
    results->measures = calloc(cells * results->n_measures, sizeof(*results->measures));
    results->flags = calloc(cells, sizeof(*results->flags));
    if (results->measures == NULL || results->flags == NULL)
      return MO_ERR_NO_MEMORY;
  }
  if (results->forms == NULL || results->genotypes == NULL || results->scores == NULL ||
      results->is_bound == NULL || results->losses == NULL || results->diverged_steps == NULL ||
      results->paths_m == NULL || (has_errors && results->errors == NULL) ||
      (climbs && results->climbed == NULL) ||
      (verify && (results->stored_losses == NULL || results->agrees == NULL)))
    return MO_ERR_NO_MEMORY;
  for (size_t i = 0; i < n; i++) {
    results->paths_m[i] = NAN;
    if (has_errors)
      results->errors[i] = mo_score_error_unknown();
  }
  for (size_t i = 0; i < cells; i++) {
    results->losses[i] = NAN;
    if (verify)
      results->stored_losses[i] = NAN;
  }
  for (size_t i = 0; i < cells * results->n_measures; i++)
    results->measures[i] = NAN;
  return MO_OK;
}

/* The environments of a suite are read in parts of up to MO_ENVIRONMENTS_MAX columns. */
static uint32_t part_of(const struct mo_evaluation_results *results, uint32_t first)
{
  const uint32_t left = results->n_environments - first;
  return left < MO_ENVIRONMENTS_MAX ? left : MO_ENVIRONMENTS_MAX;
}

/* Reads the losses of one part. */
static int load_part(struct mo_connection *reader, const struct result_keys *keys, size_t n,
                     uint64_t counted, uint32_t first, struct mo_evaluation_results *results)
{
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  const size_t cell = n * results->n_environments + first;
  const uint32_t columns = part_of(results, first);
  int error = mo_losses_read(reader, &keys->design, &keys->environments[first], columns, scores);
  for (uint32_t k = 0; k < columns && error == MO_OK; k++)
    if (!(counted >> k & 1)) {
      results->is_bound[n] = 1;
    } else if (scores[k].known) {
      results->losses[cell + k] = scores[k].loss;
      results->diverged_steps[cell + k] = scores[k].diverged_step;
    } else if (keys->is_complete) {
      error = MO_ERR_CORRUPT;
    }
  return error;
}

/* Reads the stored losses that count for the key's genotype into row `n` of the results. counted:
 * the environments of the first part that count; there are several parts only if all count. */
static int load_losses(struct mo_connection *reader, const struct result_keys *keys, size_t n,
                       uint64_t counted, struct mo_evaluation_results *results)
{
  int error = MO_OK;
  for (uint32_t k = 0; k < results->n_environments && error == MO_OK; k += MO_ENVIRONMENTS_MAX)
    error = load_part(reader, keys, n, counted, k, results);
  return error;
}

static double mean_of(const double *losses, uint32_t n)
{
  double sum = 0;
  for (uint32_t k = 0; k < n; k++)
    sum += losses[k];
  return sum / n;
}

static bool has_unknown(const double *losses, uint32_t n)
{
  bool any = false;
  for (uint32_t i = 0; i < n; i++)
    any |= isnan(losses[i]);
  return any;
}

/* Reads the losses of the runs first … end − 1 for the key's genotype. losses: (end − first,
 * columns) NaN: not stored. */
static int load_runs(struct mo_connection *reader, const struct result_keys *keys, uint32_t columns,
                     uint32_t first, uint32_t end, double *losses)
{
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  struct mo_saved_design design = keys->design;
  int error = MO_OK;
  for (uint32_t run = first; run < end && error == MO_OK; run++) {
    design.physics = keys->physics[run];
    error = mo_losses_read(reader, &design, keys->environments, columns, scores);
    for (uint32_t k = 0; k < columns && error == MO_OK; k++)
      *losses++ = scores[k].known ? scores[k].loss : NAN;
  }
  return error;
}

/* Estimates the error of row `n` of the results, which has its losses, for the key's genotype. */
static int estimate_error(struct mo_connection *reader, const struct result_keys *keys, size_t n,
                          struct mo_evaluation_results *results)
{
  const uint32_t columns = results->n_environments;
  double losses[MO_ERROR_RUNS_MAX * MO_ENVIRONMENTS_MAX];
  memcpy(losses, &results->losses[n * columns], columns * sizeof(*losses));
  for (uint32_t k = 0; k < columns; k++)
    if (isnan(losses[k])) { /* there is nothing to estimate yet */
      results->errors[n] = mo_score_error_unknown();
      return MO_OK;
    }
  const uint32_t n_runs = mo_error_runs(keys->n_displaced);
  const int error = load_runs(reader, keys, columns, 1, n_runs, losses + columns);
  if (error != MO_OK)
    return error;
  if (keys->is_complete && has_unknown(losses, n_runs * columns))
    return MO_ERR_CORRUPT;
  results->errors[n] = mo_score_error_of(losses, keys->n_displaced, columns, keys->integrator);
  return MO_OK;
}

/* Climbs from the stored losses of the key's genotype. Row `n` of the results gets the losses and
 * the error of the chosen rung. */
static int climb(struct mo_connection *reader, struct result_keys *keys, size_t n,
                 struct mo_evaluation_results *results)
{
  const uint32_t columns = results->n_environments, n_runs = mo_error_runs(keys->n_displaced);
  struct mo_climbed *climbed = &results->climbed[n];
  double losses[MO_ERROR_RUNS_MAX * MO_ENVIRONMENTS_MAX] = {0};
  while (climbed->n < MO_LADDER_RUNGS && !climbed->climb.reached) {
    const uint32_t rung = climbed->n, first = rung * n_runs;
    const int error = load_runs(reader, keys, columns, first, first + n_runs, losses);
    if (error != MO_OK)
      return error;
    if (has_unknown(losses, n_runs * columns)) /* the next rung is not computed yet */
      break;
    climbed->errors[rung] = mo_score_error_of(losses, keys->n_displaced, columns, keys->integrator);
    climbed->scores[rung] = mean_of(losses, columns);
    climbed->climb = mo_ladder_climb(climbed->errors, ++climbed->n, results->tolerance);
  }
  /* After a repair of wrong losses, a design that ended here may need a rung that was never
   * computed. In that case, the computed rungs count, as if there were no others. */
  const bool has_ended = climbed->n == MO_LADDER_RUNGS || climbed->climb.reached ||
                         (keys->is_complete && climbed->n > 0);
  if (!has_ended)
    return keys->is_complete ? MO_ERR_CORRUPT : MO_OK;
  results->errors[n] = climbed->errors[climbed->climb.rung];
  keys->design.physics = keys->physics[climbed->climb.rung * n_runs];
  const int error = load_losses(reader, keys, n, UINT64_MAX, results);
  keys->design.physics = keys->physics[0];
  return error;
}

/* Reads the measures of one part. */
static int load_measured_part(struct mo_connection *reader, const struct result_keys *keys,
                              size_t n, uint64_t counted, uint32_t first,
                              struct mo_evaluation_results *results)
{
  const uint32_t columns = part_of(results, first), set = results->measure_set;
  double values[MO_ENVIRONMENTS_MAX][MO_MEASURES];
  uint64_t known = 0;
  const int error = mo_measures_read(reader, &keys->design, &keys->environments[first], columns,
                                     set, values, &known);
  if (error != MO_OK)
    return error;
  for (uint32_t k = 0; k < columns; k++) {
    const size_t cell = n * results->n_environments + first + k;
    double *to = &results->measures[cell * results->n_measures];
    if (!(counted >> k & 1))
      continue;
    if (!(known >> k & 1) && keys->is_complete)
      return MO_ERR_CORRUPT;
    if (!(known >> k & 1))
      continue;
    for (unsigned m = 0; m < MO_MEASURES; m++)
      if (set >> m & 1)
        *to++ = values[k][m];
    results->flags[cell] = (uint8_t)mo_measures_flags(values[k]);
  }
  return MO_OK;
}

/* Reads the stored measures that count for the key's genotype into row `n` of the results. */
static int load_measures(struct mo_connection *reader, const struct result_keys *keys, size_t n,
                         uint64_t counted, struct mo_evaluation_results *results)
{
  int error = MO_OK;
  for (uint32_t k = 0; k < results->n_environments && error == MO_OK; k += MO_ENVIRONMENTS_MAX)
    error = load_measured_part(reader, keys, n, counted, k, results);
  return error;
}

/* Skipped designs have no row, so they keep empty genotypes and unknown losses. */
static int load_designs(struct mo_connection *reader, const struct range *range,
                        struct result_keys *keys, struct mo_evaluation_results *results)
{
  static const char sql[] =
      "SELECT x.position,x.genotype,g.bits,d.form,coalesce(x.counted,-1) FROM job_designs x"
      " JOIN genotypes g ON g.id=x.genotype JOIN designs d ON d.id=g.design"
      " WHERE x.job=?1 AND x.position>=?2 AND x.position<?3"
      " ORDER BY x.position";
  int error = MO_OK;
  uint32_t found = 0;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(range->id), mo_int(range->first),
                                  mo_int((int64_t)range->first + range->n));
  for (; mo_sql_next(reader, row, &error); found++) {
    const uint32_t n = mo_column_u32(row, 0) - range->first;
    if (n >= results->n_designs)
      return MO_ERR_CORRUPT;
    error = mo_column_listed(row, 2, 3, &results->genotypes[n], &results->forms[n]);
    keys->design.genotype = sqlite3_column_int64(row, 1);
    if (error != MO_OK || keys->design.fingerprint == 0)
      continue;
    if (results->climbed != NULL)
      error = climb(reader, keys, n, results);
    else if (!keys->verify)
      error = load_losses(reader, keys, n, (uint64_t)sqlite3_column_int64(row, 4), results);
    if (error == MO_OK && results->climbed == NULL && results->errors != NULL)
      error = estimate_error(reader, keys, n, results);
    if (error == MO_OK && results->measure_set != 0 && keys->design.fingerprint != 0)
      error = load_measures(reader, keys, n, (uint64_t)sqlite3_column_int64(row, 4), results);
  }
  for (uint32_t i = 0; i < results->n_notes; i++) {
    const struct mo_design_note *note = &results->notes[i];
    found += mo_is_skipped(note) && note->place >= range->first &&
             note->place - range->first < results->n_designs;
  }
  return error == MO_OK && found != results->n_designs ? MO_ERR_CORRUPT : error;
}

static int load_recomputed(struct mo_connection *reader, const struct range *range,
                           struct mo_evaluation_results *results)
{
  static const char sql[] =
      "SELECT position,environment,diverged_step,loss,stored,checksum FROM recomputed"
      " WHERE job=?1 AND position>=?2 AND position<?3 ORDER BY position,environment";
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(range->id), mo_int(range->first),
                                  mo_int((int64_t)range->first + range->n));
  memset(results->agrees, 1, results->n_designs);
  while (mo_sql_next(reader, row, &error)) {
    const uint32_t position = mo_column_u32(row, 0), n = position - range->first,
                   k = mo_column_u32(row, 1);
    const int64_t key[4] = {range->id, position, k, sqlite3_column_int64(row, 2)};
    const bool has_stored = sqlite3_column_type(row, 4) != SQLITE_NULL;
    double values[2] = {NAN, NAN};
    size_t cell;
    if (n >= results->n_designs || k >= results->n_environments)
      return MO_ERR_CORRUPT;
    cell = (size_t)n * results->n_environments + k;
    for (int i = 0; i <= has_stored && error == MO_OK; i++)
      error = mo_column_double(row, 3 + i, &values[i]);
    if (error == MO_OK &&
        mo_row_checksum(key, 4, values, has_stored ? sizeof(values) : sizeof(values[0])) !=
            (uint64_t)sqlite3_column_int64(row, 5))
      error = MO_ERR_CORRUPT;
    results->losses[cell] = values[0];
    results->stored_losses[cell] = values[1];
    results->diverged_steps[cell] = (int32_t)key[3];
    if (has_stored && !mo_same_bits(values[0], values[1]))
      results->agrees[n] = 0;
  }
  return error;
}

static int load_paths(struct mo_connection *reader, const struct range *range,
                      struct mo_evaluation_results *results)
{
  static const char sql[] = "SELECT position,sum(path_m) FROM trajectories"
                            " WHERE job=?1 AND position>=?2 AND position<?3"
                            " GROUP BY position HAVING count(path_m)=?4";
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(reader, &error, sql, mo_int(range->id), mo_int(range->first),
                  mo_int((int64_t)range->first + range->n), mo_int(results->n_environments));
  while (mo_sql_next(reader, row, &error)) {
    const uint32_t n = mo_column_u32(row, 0) - range->first;
    if (n >= results->n_designs)
      return MO_ERR_CORRUPT;
    results->paths_m[n] = sqlite3_column_double(row, 1) / results->n_environments;
  }
  return error;
}

/* Computes the mean of a row's losses. In a lower bound, unknown losses count as 0. */
static void finish_score(struct mo_evaluation_results *results, uint32_t n)
{
  const double *losses = &results->losses[(size_t)n * results->n_environments];
  double sum = 0;
  for (uint32_t k = 0; k < results->n_environments; k++)
    sum += results->is_bound[n] && isnan(losses[k]) ? 0 : losses[k];
  results->scores[n] = sum / results->n_environments;
  results->is_bound[n] = results->is_bound[n] && isfinite(sum);
}

static int load_results(struct mo_connection *reader, const void *key, void *ret)
{
  struct range range = *(const struct range *)key;
  struct mo_evaluation_results *results = ret;
  struct result_keys keys;
  int error = load_keys(reader, &range, &keys, results);
  if (error == MO_OK)
    error = allocate_results(results, keys.verify, keys.n_displaced > 0);
  if (error == MO_OK)
    error = mo_notes_read(reader, range.id, &results->notes, &results->n_notes);
  if (error == MO_OK)
    error = load_designs(reader, &range, &keys, results);
  if (error == MO_OK && keys.verify)
    error = load_recomputed(reader, &range, results);
  if (error == MO_OK)
    error = load_paths(reader, &range, results);
  for (uint32_t n = 0; n < results->n_designs && error == MO_OK; n++)
    finish_score(results, n);
  return error;
}

void mo_evaluation_results_free(void *any)
{
  struct mo_evaluation_results *results = any;
  if (results == NULL)
    return;
  free(results->forms);
  free(results->genotypes);
  free(results->scores);
  free(results->losses);
  free(results->diverged_steps);
  free(results->stored_losses);
  free(results->agrees);
  free(results->notes);
  free(results->is_bound);
  free(results->errors);
  free(results->measures);
  free(results->flags);
  free(results->climbed);
  free(results->paths_m);
  free(results);
}

static int read_results(struct mo_store *store, struct range range,
                        struct mo_evaluation_results **ret)
{
  int error;
  *ret =
      mo_read_whole(store, sizeof(**ret), load_results, &range, mo_evaluation_results_free, &error);
  return error;
}

static int read_number(sqlite3_stmt *row, void *number)
{
  *(uint32_t *)number = mo_column_u32(row, 0);
  return MO_OK;
}

int64_t mo_store_result_numbers(struct mo_store *store, int64_t id, uint32_t first, bool any,
                                uint32_t *numbers, size_t limit)
{
  /* Designs that were skipped have a note and no row. */
  static const char *const sql[] = {
      "SELECT position FROM job_designs WHERE job=?1 AND position>=?2 AND counted IS NULL"
      " ORDER BY position LIMIT ?3",
      "SELECT position FROM job_designs WHERE job=?1 AND position>=?2"
      " UNION SELECT position FROM design_notes WHERE job=?1 AND position>=?2"
      " ORDER BY position LIMIT ?3"};
  return mo_read_page(store, sql[any], MO_VALUES(mo_int(id), mo_int(first), mo_int((int64_t)limit)),
                      read_number, numbers, sizeof(*numbers));
}

int mo_store_results(struct mo_store *store, int64_t id, struct mo_evaluation_results **ret)
{
  return read_results(store, (struct range){.id = id}, ret);
}

int mo_store_results_unmeasured(struct mo_store *store, int64_t id,
                                struct mo_evaluation_results **ret)
{
  return read_results(store, (struct range){.id = id, .no_measures = true}, ret);
}

int mo_store_result(struct mo_store *store, int64_t id, uint32_t n,
                    struct mo_evaluation_results **ret)
{
  return read_results(store, (struct range){.id = id, .first = n, .n = 1}, ret);
}

/* ---- trajectories ---- */

/* Columns 4 to 7 of a row contain the channels, in their order. */
#define FIRST_CHANNEL 4

/* key: evaluation, design, environment. */
static int load_trajectory(struct mo_connection *reader, const void *any, void *ret)
{
  static const char sql[] =
      "SELECT t.stride,t.frames,t.n_masses,p.encoding,t.com,t.masses,t.actuation,t.contacts"
      " FROM trajectories t"
      " JOIN evaluations e ON e.job=t.job JOIN physics p ON p.id=e.physics"
      " WHERE t.job=?1 AND t.position=?2 AND t.environment=?3";
  const int64_t *key = any;
  struct mo_trajectory *trajectory = ret;
  struct mo_physics physics;
  enum mo_precision precision;
  enum mo_sensor sensor;
  unsigned channels = 0;
  sqlite3_stmt *row;
  int error = mo_sql_row(reader, &row, sql, mo_int(key[0]), mo_int(key[1]), mo_int(key[2]));
  if (error == MO_OK)
    error = mo_column_physics(row, 3, &physics, &precision, &sensor);
  if (error != MO_OK)
    return error;
  trajectory->dt_s = physics.scheme.dt_s;
  trajectory->n_frames = mo_column_u32(row, 1);
  trajectory->n_masses = mo_column_u32(row, 2);
  for (int i = 0; i < MO_CHANNELS; i++)
    channels |= (unsigned)(sqlite3_column_type(row, FIRST_CHANNEL + i) != SQLITE_NULL) << i;
  if ((channels & MO_RECORD_ACTUATION) && trajectory->n_frames > 0)
    trajectory->n_springs =
        (uint32_t)sqlite3_column_bytes(row, FIRST_CHANNEL + 2) / trajectory->n_frames;
  error = mo_recording_create(&trajectory->recording, channels, mo_column_u32(row, 0),
                              trajectory->n_frames, trajectory->n_masses, trajectory->n_springs);
  for (int i = 0; i < MO_CHANNELS && error == MO_OK; i++) {
    const enum mo_channel channel = (enum mo_channel)(channels & 1U << i);
    const uint64_t bytes =
        trajectory->n_frames *
        mo_recording_frame_bytes(channel, trajectory->n_masses, trajectory->n_springs);
    const void *blob = sqlite3_column_blob(row, FIRST_CHANNEL + i);
    if ((uint64_t)sqlite3_column_bytes(row, FIRST_CHANNEL + i) != bytes)
      return MO_ERR_CORRUPT;
    if (blob != NULL)
      memcpy(mo_recording_array(&trajectory->recording, channel), blob, bytes);
    else if (bytes > 0)
      error = MO_ERR_NO_MEMORY; /* a long BLOB is copied */
  }
  return error;
}

void mo_trajectory_free(void *any)
{
  struct mo_trajectory *trajectory = any;
  if (trajectory == NULL)
    return;
  mo_recording_free(&trajectory->recording);
  free(trajectory);
}

int mo_store_trajectory(struct mo_store *store, int64_t id, uint32_t n, uint32_t k,
                        struct mo_trajectory **ret)
{
  const int64_t key[] = {id, n, k};
  int error;
  *ret = mo_read_whole(store, sizeof(**ret), load_trajectory, key, mo_trajectory_free, &error);
  return error;
}

int mo_store_trajectory_sides(struct mo_store *store, int64_t id, struct mo_trajectory_sides *sides)
{
  static const char sql[] =
      "SELECT count(*),coalesce(max(frames),0),coalesce(min(frames),0),coalesce(max(n_masses),0),"
      "coalesce(max(length(actuation)),0) FROM trajectories WHERE job=?1";
  int64_t found[5] = {0};
  const int error = mo_read_integers(store, sql, MO_VALUES(mo_int(id)), 5, found);
  *sides = (struct mo_trajectory_sides){
      .n = (uint64_t)found[0],
      .frames = (uint32_t)found[1],
      .masses = (uint32_t)found[3],
      .springs = found[1] > 0 ? (uint32_t)(found[4] / found[1]) : 0,
  };
  return error == MO_OK && found[1] != found[2] ? MO_ERR_CORRUPT : error;
}
