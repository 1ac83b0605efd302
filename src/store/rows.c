/* rows.c: see rows.h. One list per table gives the columns and their destinations. REAL keeps the
 * bits of every number but NaN, which is NULL. */
#include "store/rows.h"

#include "store/campaigns.h"
#include "store/internal.h"
#include "store/trainings.h"

enum type { U32, U64, TIME, REAL, FLAG };
struct column {
  enum type type;
  size_t offset;
};

#define REPORT_COLUMNS(X)                                                                          \
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

#define TRAINING_STEP_COLUMNS(X) X(step, U32, report.step) REPORT_COLUMNS(X)

#define CAMPAIGN_STEP_COLUMNS(X)                                                                   \
  X(generation, U32, generation)                                                                   \
  X(step, U32, step)                                                                               \
  X(on_children, FLAG, on_children)                                                                \
  X(training_step, U32, report.step)                                                               \
  REPORT_COLUMNS(X)

#define VALIDATION_COLUMNS(X)                                                                      \
  X(step, U32, step)                                                                               \
  X(rollouts, U32, rollouts)                                                                       \
  X(diverged, U32, diverged)                                                                       \
  X(mean_score, REAL, mean_score)                                                                  \
  X(standard_error, REAL, standard_error)

#define GENERATION_COLUMNS(X)                                                                      \
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

#define NAME(column, type, member)          "," #column
#define PLACE(column, type, member)         ",?"
#define TRAINING_STEP(column, type, member) {type, offsetof(struct mo_training_step_row, member)},
#define CAMPAIGN_STEP(column, type, member) {type, offsetof(struct mo_campaign_step, member)},
#define VALIDATION(column, type, member)                                                           \
  {type, offsetof(struct mo_training_validation_row, member)},
#define GENERATION(column, type, member) {type, offsetof(struct mo_campaign_generation, member)},

static const struct column training_step[] = {TRAINING_STEP_COLUMNS(TRAINING_STEP)};
static const struct column campaign_step[] = {CAMPAIGN_STEP_COLUMNS(CAMPAIGN_STEP)};
static const struct column validation[] = {VALIDATION_COLUMNS(VALIDATION)};
static const struct column generation[] = {GENERATION_COLUMNS(GENERATION)};

#define WRITE(table, columns)                                                                      \
  "INSERT OR REPLACE INTO " table "(job" columns(NAME) ") VALUES(?" columns(PLACE) ")"
#define NEWEST(table, columns, key)                                                                \
  "SELECT job" columns(NAME) " FROM " table " WHERE job=?1 ORDER BY " key " DESC LIMIT 1"
#define AFTER(table, columns, key)                                                                 \
  "SELECT job" columns(NAME) " FROM " table " WHERE job=?1 AND " key ">?2 ORDER BY " key " LIMIT " \
                             "?3"
#define COLUMNS(list) list, sizeof(list) / sizeof((list)[0])

static const struct table {
  const struct column *columns;
  size_t n;
  size_t size; /* of a row in memory */
  const char *write, *newest, *after;
} tables[] = {
    [MO_TRAINING_STEPS] = {COLUMNS(training_step), sizeof(struct mo_training_step_row),
                           WRITE("training_steps", TRAINING_STEP_COLUMNS),
                           NEWEST("training_steps", TRAINING_STEP_COLUMNS, "step"),
                           AFTER("training_steps", TRAINING_STEP_COLUMNS, "step")},
    [MO_TRAINING_VALIDATIONS] = {COLUMNS(validation), sizeof(struct mo_training_validation_row),
                                 WRITE("training_validations", VALIDATION_COLUMNS),
                                 NEWEST("training_validations", VALIDATION_COLUMNS, "step"),
                                 AFTER("training_validations", VALIDATION_COLUMNS, "step")},
    [MO_CAMPAIGN_GENERATIONS] = {COLUMNS(generation), sizeof(struct mo_campaign_generation),
                                 WRITE("campaign_generations", GENERATION_COLUMNS),
                                 NEWEST("campaign_generations", GENERATION_COLUMNS, "generation"),
                                 AFTER("campaign_generations", GENERATION_COLUMNS, "generation")},
    [MO_CAMPAIGN_STEPS] = {COLUMNS(campaign_step), sizeof(struct mo_campaign_step),
                           WRITE("campaign_steps", CAMPAIGN_STEP_COLUMNS), NULL, NULL}};

#define ROW_MAX 64
_Static_assert(sizeof(generation) / sizeof(generation[0]) < ROW_MAX, "the longest row");

static void read_row(sqlite3_stmt *statement, const struct table *table, void *row)
{
  for (size_t i = 0; i < table->n; i++) {
    const int column = (int)i + 1; /* after the job */
    const int64_t integer = sqlite3_column_int64(statement, column);
    void *at = (char *)row + table->columns[i].offset;
    switch (table->columns[i].type) {
    case U32: *(uint32_t *)at = (uint32_t)integer; break;
    case U64: *(uint64_t *)at = (uint64_t)integer; break;
    case TIME: *(int64_t *)at = integer; break;
    case REAL: *(double *)at = mo_column_number(statement, column); break;
    case FLAG: *(bool *)at = integer != 0; break;
    }
  }
}

int mo_row_write(struct mo_connection *writer, enum mo_row_table which, int64_t id, const void *row)
{
  const struct table *table = &tables[which];
  struct mo_value values[ROW_MAX] = {mo_int(id)};
  for (size_t i = 0; i < table->n; i++) {
    const void *at = (const char *)row + table->columns[i].offset;
    struct mo_value *value = &values[i + 1];
    switch (table->columns[i].type) {
    case U32: *value = mo_int(*(const uint32_t *)at); break;
    case U64: *value = mo_int((int64_t) * (const uint64_t *)at); break;
    case TIME: *value = mo_int(*(const int64_t *)at); break;
    case REAL: *value = mo_real(*(const double *)at); break;
    case FLAG: *value = mo_int(*(const bool *)at); break;
    }
  }
  return mo_sql_do_with(writer, table->write, (struct mo_values){values, (int)table->n + 1});
}

int mo_row_newest(struct mo_connection *reader, enum mo_row_table which, int64_t id, void *row,
                  bool *found)
{
  sqlite3_stmt *statement;
  const int error = mo_sql_row(reader, &statement, tables[which].newest, mo_int(id));
  *found = error == MO_OK;
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_OK : error;
  read_row(statement, &tables[which], row);
  (void)sqlite3_reset(statement);
  return MO_OK;
}

/* ---- pages ---- */

struct page {
  const struct table *table;
  char *row;
};

static int take(sqlite3_stmt *statement, void *any)
{
  struct page *page = any;
  read_row(statement, page->table, page->row);
  page->row += page->table->size;
  return MO_OK;
}

static int64_t read_page(struct mo_store *store, enum mo_row_table which, const char *sql,
                         struct mo_values values, void *rows)
{
  struct page page = {&tables[which], rows};
  return mo_read_each(store, sql, values, take, &page);
}

int64_t mo_store_training_steps(struct mo_store *store, int64_t id, uint32_t after, uint32_t stride,
                                struct mo_training_step_row *rows, size_t limit)
{
  /* Looks up each multiple: in a million rows, reading all rows between takes a third of a second.
   */
  static const char sql[] =
      "WITH RECURSIVE wanted(at) AS (SELECT (?2/?3+1)*?3 UNION ALL SELECT at+?3 FROM wanted"
      " WHERE at+?3<=(SELECT max(step) FROM training_steps WHERE job=?1) LIMIT ?4)"
      " SELECT job" TRAINING_STEP_COLUMNS(NAME) " FROM wanted CROSS JOIN training_steps"
                                                " WHERE job=?1 AND step=at ORDER BY at";
  const struct mo_value last = mo_int((int64_t)limit);
  return stride > 1 ? read_page(store, MO_TRAINING_STEPS, sql,
                                MO_VALUES(mo_int(id), mo_int(after), mo_int(stride), last), rows)
                    : read_page(store, MO_TRAINING_STEPS, tables[MO_TRAINING_STEPS].after,
                                MO_VALUES(mo_int(id), mo_int(after), last), rows);
}

int64_t mo_store_training_validations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_training_validation_row *rows, size_t limit)
{
  return read_page(store, MO_TRAINING_VALIDATIONS, tables[MO_TRAINING_VALIDATIONS].after,
                   MO_VALUES(mo_int(id), mo_int(after), mo_int((int64_t)limit)), rows);
}

int64_t mo_store_campaign_generations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_campaign_generation *rows, size_t limit)
{
  return read_page(store, MO_CAMPAIGN_GENERATIONS, tables[MO_CAMPAIGN_GENERATIONS].after,
                   MO_VALUES(mo_int(id), mo_int(after), mo_int((int64_t)limit)), rows);
}

int64_t mo_store_campaign_steps(struct mo_store *store, int64_t id, int64_t after_generation,
                                uint32_t after_step, struct mo_campaign_step *rows, size_t limit)
{
  static const char sql[] = "SELECT job" CAMPAIGN_STEP_COLUMNS(
      NAME) " FROM campaign_steps WHERE job=?1 AND (generation,step)>(?2,?3) ORDER BY "
            "generation,step LIMIT ?4";
  return read_page(
      store, MO_CAMPAIGN_STEPS, sql,
      MO_VALUES(mo_int(id), mo_int(after_generation), mo_int(after_step), mo_int((int64_t)limit)),
      rows);
}
