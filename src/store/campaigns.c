/* campaigns.c: reads campaigns: settings, progress, generations, learning curves. */
#include "store/campaigns.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"

/* ---- rows of numbers: one list gives the columns and their destinations ---- */

enum kind { U32, U64, TIME, REAL, FLAG }; /* REAL: NaN is none */
struct field {
  enum kind kind;
  size_t offset;
};

static double column_number(sqlite3_stmt *row, int column)
{
  return sqlite3_column_type(row, column) == SQLITE_NULL ? NAN : sqlite3_column_double(row, column);
}

static void read_fields(sqlite3_stmt *row, int column, const struct field *fields, size_t n,
                        void *structure)
{
  for (size_t i = 0; i < n; i++, column++) {
    const int64_t integer = sqlite3_column_int64(row, column);
    void *at = (char *)structure + fields[i].offset;
    switch (fields[i].kind) {
    case U32: *(uint32_t *)at = (uint32_t)integer; break;
    case U64: *(uint64_t *)at = (uint64_t)integer; break;
    case TIME: *(int64_t *)at = integer; break;
    case REAL: *(double *)at = column_number(row, column); break;
    case FLAG: *(bool *)at = integer != 0; break;
    }
  }
}

static void bind_fields(sqlite3_stmt *statement, int index, const struct field *fields, size_t n,
                        const void *structure)
{
  for (size_t i = 0; i < n; i++, index++) {
    const void *at = (const char *)structure + fields[i].offset;
    switch (fields[i].kind) {
    case U32: sqlite3_bind_int64(statement, index, *(const uint32_t *)at); break;
    case U64: sqlite3_bind_int64(statement, index, (sqlite3_int64) * (const uint64_t *)at); break;
    case TIME: sqlite3_bind_int64(statement, index, *(const int64_t *)at); break;
    case REAL: sqlite3_bind_double(statement, index, *(const double *)at); break;
    case FLAG: sqlite3_bind_int64(statement, index, *(const bool *)at); break;
    }
  }
}

#define GENERATION_FIELDS(X)                                                                       \
  X(generation, U32, generation)                                                                   \
  X(born_before, U64, born_before)                                                                 \
  X(n_children, U32, n_children)                                                                   \
  X(n, U32, stats.n)                                                                               \
  X(n_diverged, U32, stats.n_diverged)                                                             \
  X(mean_score, REAL, stats.mean_score)                                                            \
  X(least_score, REAL, stats.quantiles[0])                                                         \
  X(score_5, REAL, stats.quantiles[1])                                                             \
  X(score_25, REAL, stats.quantiles[2])                                                            \
  X(median_score, REAL, stats.quantiles[3])                                                        \
  X(score_75, REAL, stats.quantiles[4])                                                            \
  X(score_95, REAL, stats.quantiles[5])                                                            \
  X(most_score, REAL, stats.quantiles[6])                                                          \
  X(diversity, REAL, stats.diversity)                                                              \
  X(species, U32, stats.species)                                                                   \
  X(least_voxels, REAL, stats.voxels.least)                                                        \
  X(mean_voxels, REAL, stats.voxels.mean)                                                          \
  X(most_voxels, REAL, stats.voxels.most)                                                          \
  X(least_footprint, REAL, stats.footprint.least)                                                  \
  X(mean_footprint, REAL, stats.footprint.mean)                                                    \
  X(most_footprint, REAL, stats.footprint.most)                                                    \
  X(least_masses, REAL, stats.masses.least)                                                        \
  X(mean_masses, REAL, stats.masses.mean)                                                          \
  X(most_masses, REAL, stats.masses.most)                                                          \
  X(least_springs, REAL, stats.springs.least)                                                      \
  X(mean_springs, REAL, stats.springs.mean)                                                        \
  X(most_springs, REAL, stats.springs.most)                                                        \
  X(mean_parents, REAL, mean_parents)                                                              \
  X(mean_children, REAL, mean_children)                                                            \
  X(mutation_attempts, U64, variation.mutation_attempts)                                           \
  X(crossover_attempts, U64, variation.crossover_attempts)                                         \
  X(mutants, U32, variation.mutants)                                                               \
  X(recombinants, U32, variation.recombinants)                                                     \
  X(fallbacks, U32, variation.fallbacks)                                                           \
  X(exhausted, FLAG, variation.exhausted)                                                          \
  X(survived_mutants, U32, survived_mutants)                                                       \
  X(survived_recombinants, U32, survived_recombinants)                                             \
  X(turnover, REAL, turnover)                                                                      \
  X(rollouts, U64, rollouts)                                                                       \
  X(rollouts_cached, U64, rollouts_cached)                                                         \
  X(rollouts_diverged, U64, rollouts_diverged)                                                     \
  X(learning_steps, U32, learning_steps)                                                           \
  X(first_loss, REAL, first_loss)                                                                  \
  X(last_loss, REAL, last_loss)                                                                    \
  X(collapse, FLAG, collapse)                                                                      \
  X(seconds, REAL, seconds)                                                                        \
  X(stored_us, TIME, stored_us)

#define STEP_FIELDS(X)                                                                             \
  X(generation, U32, generation)                                                                   \
  X(step, U32, step)                                                                               \
  X(on_children, FLAG, on_children)                                                                \
  X(training_step, U32, report.step)                                                               \
  X(mean_loss, REAL, report.mean_loss)                                                             \
  X(rate, REAL, report.rate)                                                                       \
  X(gradient_norm, REAL, report.gradient_norm)                                                     \
  X(clipped_share, REAL, report.clipped_share)                                                     \
  X(clipped_robots_share, REAL, report.clipped_robots_share)                                       \
  X(diverged, U32, report.diverged)                                                                \
  X(zeroed, U32, report.zeroed)                                                                    \
  X(skipped, FLAG, report.skipped)                                                                 \
  X(bounded, U32, report.bounded)                                                                  \
  X(seconds, REAL, seconds)

#define COLUMN(column, kind, member) "," #column
#define PLACE(column, kind, member)  ",?"
#define GENERATION_PLACE(column, kind, member)                                                     \
  {kind, offsetof(struct mo_campaign_generation, member)},
#define STEP_PLACE(column, kind, member) {kind, offsetof(struct mo_campaign_step, member)},

static const struct field generation_fields[] = {GENERATION_FIELDS(GENERATION_PLACE)};
static const struct field step_fields[] = {STEP_FIELDS(STEP_PLACE)};
#define N_GENERATION_FIELDS (sizeof(generation_fields) / sizeof(generation_fields[0]))
#define N_STEP_FIELDS       (sizeof(step_fields) / sizeof(step_fields[0]))

int mo_campaign_generation_write(struct mo_connection *writer, int64_t id,
                                 const struct mo_campaign_generation *row)
{
  static const char sql[] = "INSERT INTO campaign_generations(job" GENERATION_FIELDS(
      COLUMN) ") VALUES(?" GENERATION_FIELDS(PLACE) ")";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  bind_fields(statement, 2, generation_fields, N_GENERATION_FIELDS, row);
  return mo_sql_run(writer, statement);
}

int mo_campaign_step_write(struct mo_connection *writer, int64_t id,
                           const struct mo_campaign_step *row)
{
  static const char sql[] = "INSERT OR REPLACE INTO campaign_steps(job" STEP_FIELDS(
      COLUMN) ") VALUES(?" STEP_FIELDS(PLACE) ")";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  bind_fields(statement, 2, step_fields, N_STEP_FIELDS, row);
  return mo_sql_run(writer, statement);
}

/* ---- one campaign ---- */

int mo_campaign_head_get(struct mo_connection *connection, int64_t id,
                         struct mo_campaign_head *head)
{
  static const char sql[] =
      "SELECT settings,generations,n_environments,replicates_of,physics,coalesce(controller,0),"
      "coalesce(environment_set,0),generation,n_designs,scored_generation,scored,diversity_max "
      "FROM campaigns"
      " WHERE job=?1";
  struct mo_campaign_settings settings;
  int error = MO_OK;
  int step;
  sqlite3_stmt *row = mo_sql(connection, sql, &error);
  if (row == NULL)
    return error;
  sqlite3_bind_int64(row, 1, id);
  step = mo_sql_step(connection, row);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_NOT_FOUND;
  error = mo_decode_campaign(sqlite3_column_blob(row, 0), (size_t)sqlite3_column_bytes(row, 0),
                             &settings);
  *head = (struct mo_campaign_head){.mode = settings.mode,
                                    .population = settings.population,
                                    .generations = (uint32_t)sqlite3_column_int64(row, 1),
                                    .n_environments = (uint32_t)sqlite3_column_int64(row, 2),
                                    .group = sqlite3_column_int64(row, 3),
                                    .physics = sqlite3_column_int64(row, 4),
                                    .controller = sqlite3_column_int64(row, 5),
                                    .environment_set = sqlite3_column_int64(row, 6),
                                    .generation = sqlite3_column_int64(row, 7),
                                    .n_designs = (uint64_t)sqlite3_column_int64(row, 8),
                                    .scored_generation = sqlite3_column_int64(row, 9),
                                    .scored = sqlite3_column_int64(row, 10),
                                    .diversity_max = sqlite3_column_double(row, 11)};
  (void)sqlite3_reset(row);
  if (error == MO_OK && (head->n_environments < 1 || head->n_environments > MO_ENVIRONMENTS_MAX))
    error = MO_ERR_CORRUPT;
  return error;
}

enum { FIRST = MO_JOB_N_COLUMNS };

static int load_record(struct mo_connection *reader, int64_t id, struct mo_campaign_status *status)
{
  static const char sql[] =
      "SELECT " MO_JOB_COLUMNS
      ",m.name,m.preset,m.controller IS NOT NULL,m.n_listed,m.initial_campaign,"
      "m.replicates_of,m.replicate,m.replicates,m.checkpoint_every_s,m.generation,m.n_designs,m."
      "best_score,"
      "m.diversity_max,m.ended,CASE m.scored_generation WHEN m.generation+1 THEN m.scored ELSE 0 "
      "END,r.sha256,"
      "m.settings" MO_JOB_TABLES
      "LEFT JOIN controllers r ON r.id=m.result WHERE j.id=?1 AND j.kind=2";
  struct mo_campaign_record *record = &status->record;
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
  if (error == MO_OK)
    error = mo_decode_campaign(sqlite3_column_blob(row, FIRST + 16),
                               (size_t)sqlite3_column_bytes(row, FIRST + 16), &record->settings);
  record->settings.generations = status->job.steps_total;
  mo_column_text(row, FIRST, record->name, sizeof(record->name));
  mo_column_text(row, FIRST + 1, record->preset, sizeof(record->preset));
  record->has_controller = sqlite3_column_int(row, FIRST + 2) != 0;
  memcpy(record->controller_name, status->job.controller_name, sizeof(record->controller_name));
  record->controller_sha256 = status->job.controller_sha256;
  record->sensor = status->job.sensor;
  memcpy(record->environment_set, status->job.environment_set, sizeof(record->environment_set));
  record->n_environments = status->job.n_environments;
  record->n_listed = (uint32_t)sqlite3_column_int64(row, FIRST + 3);
  record->initial_campaign = sqlite3_column_int64(row, FIRST + 4);
  record->group = sqlite3_column_int64(row, FIRST + 5);
  record->replicate = (uint32_t)sqlite3_column_int64(row, FIRST + 6);
  record->replicates = (uint32_t)sqlite3_column_int64(row, FIRST + 7);
  record->checkpoint_every_s = (uint32_t)sqlite3_column_int64(row, FIRST + 8);
  status->generation = sqlite3_column_int64(row, FIRST + 9);
  status->n_designs = (uint64_t)sqlite3_column_int64(row, FIRST + 10);
  status->best_score = column_number(row, FIRST + 11);
  status->diversity_max = sqlite3_column_double(row, FIRST + 12);
  status->end = (enum mo_campaign_end)sqlite3_column_int(row, FIRST + 13);
  status->scored = (uint32_t)sqlite3_column_int64(row, FIRST + 14);
  status->has_result = sqlite3_column_type(row, FIRST + 15) != SQLITE_NULL;
  if (error == MO_OK && status->has_result &&
      mo_column_hash(row, FIRST + 15, &status->result_sha256) != MO_OK)
    error = MO_ERR_CORRUPT;
  (void)sqlite3_reset(row);
  return error;
}

static int load_status(struct mo_connection *reader, int64_t id, void *any)
{
  static const char sql[] = "SELECT job" GENERATION_FIELDS(
      COLUMN) " FROM campaign_generations WHERE job=?1 AND generation=?2";
  struct mo_campaign_status *status = any;
  sqlite3_stmt *row;
  int step;
  int error;
  memset(status, 0, sizeof(*status));
  error = load_record(reader, id, status);
  if (error != MO_OK || status->generation < 0)
    return error;
  row = mo_sql(reader, sql, &error);
  if (row == NULL)
    return error;
  sqlite3_bind_int64(row, 1, id);
  sqlite3_bind_int64(row, 2, status->generation);
  step = mo_sql_step(reader, row);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_CORRUPT;
  read_fields(row, 1, generation_fields, N_GENERATION_FIELDS, &status->last);
  (void)sqlite3_reset(row);
  return MO_OK;
}

int mo_store_campaign(struct mo_store *store, int64_t id, struct mo_campaign_status *status)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_status found = {0};
  int error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = load_status(reader, id, &found);
  mo_reader_release(store, reader);
  if (error == MO_OK)
    *status = found;
  return error;
}

/* ---- lists ---- */

int64_t mo_store_campaigns(struct mo_store *store, const struct mo_campaign_query *query,
                           struct mo_campaign_status *statuses, size_t limit)
{
  static const char *const all_sql[] =
      MO_PAGES("SELECT j.id FROM jobs j CROSS JOIN campaigns m ON m.job=j.id", "j.kind=2");
  static const char *const group_sql[] =
      MO_PAGES("SELECT j.id FROM campaigns m CROSS JOIN jobs j ON j.id=m.job",
               "m.replicates_of=?4 AND j.kind=2");
  static const char *const label_sql[2][3] = {
      MO_PAGES("SELECT j.id FROM jobs j CROSS JOIN campaigns m ON m.job=j.id",
               "j.label=?6 AND j.kind=2"),
      MO_PAGES("SELECT j.id FROM campaigns m CROSS JOIN jobs j ON j.id=m.job",
               "m.replicates_of=?4 AND j.kind=2 AND j.label=?6")};
  const struct mo_job_query shown = {.before = query->before,
                                     .state = query->state,
                                     .waiting = query->waiting,
                                     .n_waiting = query->n_waiting,
                                     .label = query->label};
  const char *const *sql = query->label != NULL ? label_sql[query->group != 0]
                           : query->group != 0  ? group_sql
                                                : all_sql;
  return mo_read_jobs(store, sql[mo_job_page(&shown)], &shown, query->group, limit, load_status,
                      statuses, sizeof(*statuses));
}

static int take_generation(sqlite3_stmt *statement, void *row)
{
  struct mo_campaign_generation *generation = row;
  read_fields(statement, 1, generation_fields, N_GENERATION_FIELDS, generation);
  return MO_OK;
}

int64_t mo_store_campaign_generations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_campaign_generation *rows, size_t limit)
{
  static const char sql[] = "SELECT job" GENERATION_FIELDS(
      COLUMN) " FROM campaign_generations WHERE job=?1 AND generation>?2 "
              "ORDER BY generation LIMIT ?3";
  const int64_t values[] = {id, after};
  return mo_read_rows(store, sql, values, 2, limit, take_generation, rows, sizeof(*rows));
}

static int take_step(sqlite3_stmt *statement, void *row)
{
  struct mo_campaign_step *step = row;
  read_fields(statement, 1, step_fields, N_STEP_FIELDS, step);
  return MO_OK;
}

int64_t mo_store_campaign_steps(struct mo_store *store, int64_t id, int64_t after_generation,
                                uint32_t after_step, struct mo_campaign_step *rows, size_t limit)
{
  static const char sql[] = "SELECT job" STEP_FIELDS(
      COLUMN) " FROM campaign_steps WHERE job=?1 AND (generation,step)>(?2,?3) "
              "ORDER BY generation,step LIMIT ?4";
  const int64_t values[] = {id, after_generation, after_step};
  return mo_read_rows(store, sql, values, 3, limit, take_step, rows, sizeof(*rows));
}

/* ---- environments and initial designs, which the group shares ---- */

int mo_campaign_environment_rows(struct mo_connection *connection, int64_t group, int64_t *rows,
                                 uint32_t n)
{
  static const char sql[] =
      "SELECT environment FROM campaign_environments WHERE job=?1 ORDER BY position LIMIT ?2";
  uint32_t found = 0;
  int error = MO_OK;
  int step;
  sqlite3_stmt *statement = mo_sql(connection, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, group);
  sqlite3_bind_int64(statement, 2, n);
  while ((step = mo_sql_step(connection, statement)) > 0)
    rows[found++] = sqlite3_column_int64(statement, 0);
  return step < 0 ? step : found == n ? MO_OK : MO_ERR_CORRUPT;
}

int mo_store_campaign_environments(struct mo_store *store, int64_t id, struct mo_environment **ret,
                                   uint32_t *ret_n)
{
  static const char sql[] = "SELECT e.data,e.sha256 FROM campaign_environments x JOIN environments "
                            "e ON e.id=x.environment"
                            " WHERE x.job=?1 ORDER BY x.position";
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_environment *environments = NULL;
  struct mo_campaign_head head = {0};
  sqlite3_stmt *statement = NULL;
  uint32_t n = 0;
  int step = 0;
  int error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = mo_campaign_head_get(reader, id, &head);
  if (error == MO_OK) {
    environments = calloc(head.n_environments + 1, sizeof(*environments));
    error = environments == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  }
  if (error == MO_OK)
    statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, head.group);
    while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
      error = n == head.n_environments ? MO_ERR_CORRUPT
                                       : mo_column_environment(statement, 0, 1, &environments[n++]);
    }
    if (step < 0)
      error = step;
    if (error == MO_OK && n != head.n_environments)
      error = MO_ERR_CORRUPT;
  }
  mo_reader_release(store, reader);
  if (error != MO_OK) {
    free(environments);
    return error;
  }
  *ret = environments;
  *ret_n = n;
  return MO_OK;
}

int mo_store_campaign_initial(struct mo_store *store, int64_t id, struct mo_bits **ret,
                              uint32_t *ret_n)
{
  static const char sql[] =
      "SELECT g.bits FROM campaign_initial x JOIN genotypes g ON g.id=x.genotype"
      " WHERE x.job=?1 ORDER BY x.position";
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_bits *genotypes = NULL;
  struct mo_campaign_head head = {0};
  sqlite3_stmt *statement = NULL;
  uint32_t n = 0;
  int step = 0;
  int error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = mo_campaign_head_get(reader, id, &head);
  if (error == MO_OK) {
    genotypes = calloc(head.population + 1, sizeof(*genotypes));
    error = genotypes == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  }
  if (error == MO_OK)
    statement = mo_sql(reader, sql, &error);
  if (statement != NULL) {
    sqlite3_bind_int64(statement, 1, head.group);
    while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0)
      error = n == head.population ? MO_ERR_CORRUPT : mo_column_bits(statement, 0, &genotypes[n++]);
    if (step < 0)
      error = step;
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
