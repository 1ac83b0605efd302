/* origins.c: see origins.h. An index by origin would take space for every score, so there is none:
 * a page visits a bounded number of rows in the order of their key. */
#include "store/origins.h"

#include <math.h>

#include "base/clock.h"
#include "store/measures.h"
#include "store/runs.h"
#include "store/scores.h"

#define VISITED_MAX 50000

/* ---- reading ---- */

static int read_losses(struct mo_connection *connection, struct mo_origin_place place,
                       struct mo_condition *condition, int64_t *computed_us,
                       struct mo_loss_row *losses)
{
  static const char sql[] =
      "SELECT " MO_SCORE_COLUMNS " FROM scores x JOIN conditions c ON c.id=x.condition"
      " WHERE x.genotype=?1 AND x.condition=?2";
  sqlite3_stmt *found;
  const int error =
      mo_sql_row(connection, &found, sql, mo_int(place.genotype), mo_int(place.condition));
  if (error != MO_OK)
    return error;
  *computed_us = sqlite3_column_int64(found, 6);
  return mo_score_from_row(found, 0, condition, losses->losses, losses->diverged_steps);
}

static int read_measures(struct mo_connection *connection, struct mo_origin_place place,
                         struct mo_condition *condition, int64_t *computed_us,
                         struct mo_measures_row *measures, uint32_t *n_measures)
{
  static const char sql[] =
      "SELECT " MO_MEASURE_COLUMNS " FROM measures x JOIN conditions c ON c.id=x.condition"
      " WHERE x.genotype=?1 AND x.condition=?2";
  sqlite3_stmt *found;
  const int error =
      mo_sql_row(connection, &found, sql, mo_int(place.genotype), mo_int(place.condition));
  if (error != MO_OK)
    return error;
  *computed_us = sqlite3_column_int64(found, 5);
  return mo_measures_from_row(found, 0, condition, measures->values, n_measures);
}

/* Reads the inputs that rollouts depend on in addition to their environments. */
static int read_inputs(struct mo_connection *reader, struct mo_origin_row *row)
{
  static const char sql[] =
      "SELECT g.bits,d.form,k.sha256,p.sha256,p.encoding,f.text FROM genotypes g"
      " JOIN designs d ON d.id=g.design JOIN conditions c ON c.id=?2"
      " JOIN controllers k ON k.id=c.controller JOIN physics p ON p.id=c.physics"
      " JOIN fingerprints f ON f.id=c.fingerprint WHERE g.id=?1";
  enum mo_sensor sensor;
  sqlite3_stmt *found;
  int error = mo_sql_row(reader, &found, sql, mo_int(row->genotype_row), mo_int(row->condition));
  if (error == MO_OK)
    error = mo_column_design(found, 0, 1, &row->genotype, &row->form);
  if (error == MO_OK)
    error = mo_column_hash(found, 2, &row->controller_sha256);
  if (error == MO_OK)
    error = mo_column_hash(found, 3, &row->physics_sha256);
  if (error == MO_OK)
    error = mo_column_physics(found, 4, &row->physics, &row->precision, &sensor);
  if (error == MO_OK)
    mo_column_text(found, 5, row->fingerprint, sizeof(row->fingerprint));
  return error;
}

static int read_row(struct mo_connection *reader, struct mo_origin_place place, bool has_losses,
                    bool has_measures, struct mo_origin_row *row)
{
  struct mo_condition condition = {.n = 0};
  *row = (struct mo_origin_row){.genotype_row = place.genotype,
                                .condition = place.condition,
                                .has_losses = has_losses,
                                .has_measures = has_measures};
  int error = read_inputs(reader, row);
  if (error == MO_OK && has_measures)
    error = read_measures(reader, place, &condition, &row->computed_us, &row->stored_measures,
                          &row->n_measures);
  if (error == MO_OK && has_losses)
    error = read_losses(reader, place, &condition, &row->computed_us, &row->stored);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  row->n = condition.n;
  for (uint32_t k = 0; k < row->n && error == MO_OK; k++)
    error = mo_environment_get(reader, condition.environments[k], &row->environments[k],
                               &row->environment_sha256[k]);
  return error;
}

int64_t mo_store_origin_rows(struct mo_store *store, const char *origin,
                             struct mo_origin_place *place, struct mo_origin_row *rows,
                             size_t limit, bool *is_last)
{
  static const char origin_sql[] = "SELECT id FROM origins WHERE text=?1";
  static const char sql[] =
      "SELECT x.genotype,x.condition,x.origin=?3,"
      "m.genotype IS NOT NULL AND ifnull(m.origin,?3)=?3 FROM scores x"
      " LEFT JOIN measures m ON m.genotype=x.genotype AND m.condition=x.condition"
      " WHERE (x.genotype,x.condition)>(?1,?2) UNION ALL"
      " SELECT m.genotype,m.condition,-1,ifnull(m.origin,?3)=?3 FROM measures m"
      " WHERE (m.genotype,m.condition)>(?1,?2) ORDER BY 1,2,3 DESC";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int64_t id = 0;
  size_t n = 0, visited = 0;
  int error = mo_sql_find(reader, &id, origin_sql, mo_string(origin));
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(place->genotype),
                                  mo_int(place->condition), mo_int(id));
  *is_last = false;
  while (n < limit && visited++ < VISITED_MAX && error == MO_OK) {
    *is_last = !mo_sql_next(reader, row, &error);
    if (*is_last)
      break;
    const struct mo_origin_place here = {sqlite3_column_int64(row, 0),
                                         sqlite3_column_int64(row, 1)};
    const int losses = sqlite3_column_int(row, 2); /* −1: a row of measures */
    const bool is_again = losses < 0 && here.genotype == place->genotype &&
                          here.condition == place->condition; /* its losses precede it */
    const bool has_losses = losses > 0, has_measures = sqlite3_column_int(row, 3) != 0;
    *place = here;
    if (!is_again && (has_losses || has_measures))
      error = read_row(reader, *place, has_losses, has_measures, &rows[n++]);
  }
  return error != MO_OK ? error : (int64_t)n;
}

/* ---- replacing ---- */

/* Recomputes the means that a genotype's losses under a condition are part of. A mean may include
 * losses of two classes: the class of devices, and the class of the workers that assist them. */
static int replace_means(struct mo_connection *writer, int64_t genotype,
                         const struct mo_condition *condition)
{
  static const char sql[] =
      "SELECT r.id,r.environment_set,r.fingerprint FROM rankings r"
      " JOIN set_scores s ON s.ranking=r.id AND s.genotype=?1"
      " WHERE r.controller=?2 AND r.physics=?3 AND r.id>?5 AND EXISTS("
      "SELECT 1 FROM environment_set_members m JOIN condition_environments v"
      " ON v.environment=m.environment"
      " WHERE m.environment_set=r.environment_set AND v.condition=?4) ORDER BY r.id LIMIT 1";
  int64_t ranking = 0;
  int error = MO_OK;
  while (error == MO_OK) {
    sqlite3_stmt *row;
    error = mo_sql_row(writer, &row, sql, mo_int(genotype), mo_int(condition->controller),
                       mo_int(condition->physics), mo_int(condition->id), mo_int(ranking));
    if (error != MO_OK)
      break;
    ranking = sqlite3_column_int64(row, 0);
    const struct mo_saved_design design = {.genotype = genotype,
                                           .controller = condition->controller,
                                           .physics = condition->physics,
                                           .environment_set = sqlite3_column_int64(row, 1),
                                           .fingerprint = sqlite3_column_int64(row, 2),
                                           .workers = condition->fingerprint};
    error = mo_set_score_replace(writer, &design, ranking);
  }
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

bool mo_loss_rows_equal(const struct mo_loss_row *a, const struct mo_loss_row *b, uint32_t n)
{
  return memcmp(a->losses, b->losses, n * sizeof(a->losses[0])) == 0 &&
         memcmp(a->diverged_steps, b->diverged_steps, n * sizeof(a->diverged_steps[0])) == 0;
}

bool mo_measure_equal(double a, double b)
{
  return isnan(a) ? isnan(b) : mo_same_bits(a, b);
}

static bool measures_equal(const struct mo_measures_row *a, const struct mo_measures_row *b,
                           uint32_t n)
{
  for (uint32_t k = 0; k < n; k++)
    for (unsigned m = 0; m < MO_MEASURES; m++)
      if (!mo_measure_equal(a->values[k][m], b->values[k][m]))
        return false;
  return true;
}

static int replace_losses(struct mo_store *store, const struct mo_origin_row *row, int64_t now_us)
{
  struct mo_condition condition;
  struct mo_loss_row stored;
  int64_t computed_us;
  int error =
      read_losses(&store->writer, (struct mo_origin_place){row->genotype_row, row->condition},
                  &condition, &computed_us, &stored);
  if (error != MO_OK || condition.n != row->n || !mo_loss_rows_equal(&stored, &row->stored, row->n))
    return error;
  condition.id = row->condition;
  error = mo_losses_replace(store, &condition, row->genotype_row, row->again.losses,
                            row->again.diverged_steps, now_us);
  return error == MO_OK ? replace_means(&store->writer, row->genotype_row, &condition) : error;
}

static int replace_measures(struct mo_store *store, const struct mo_origin_row *row, int64_t now_us)
{
  struct mo_condition condition;
  struct mo_measures_row stored;
  uint32_t n_measures;
  int64_t computed_us;
  const int error =
      read_measures(&store->writer, (struct mo_origin_place){row->genotype_row, row->condition},
                    &condition, &computed_us, &stored, &n_measures);
  if (error != MO_OK || condition.n != row->n ||
      !measures_equal(&stored, &row->stored_measures, row->n))
    return error;
  condition.id = row->condition;
  return mo_measures_insert_row(store, &condition, row->genotype_row, 0,
                                (const double(*)[MO_MEASURES])row->again_measures.values, now_us);
}

static int replace_row(struct mo_store *store, const struct mo_origin_row *row, int64_t now_us)
{
  static const char sql[] = "SELECT controller,physics FROM conditions WHERE id=?1";
  /* The ETag of evaluations includes the job's version. */
  static const char version_sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION
      " WHERE id IN (SELECT job FROM evaluations WHERE controller=?1 AND"
      " (physics=?2 OR n_displaced>0))"; /* the other runs of these have different physics */
  struct mo_connection *writer = &store->writer;
  sqlite3_stmt *found;
  int error = MO_OK;
  if (row->differs)
    error = replace_losses(store, row, now_us);
  if (error == MO_OK && row->measures_differ)
    error = replace_measures(store, row, now_us);
  if (error == MO_OK)
    error = mo_sql_row(writer, &found, sql, mo_int(row->condition));
  if (error != MO_OK)
    return error;
  const int64_t controller = sqlite3_column_int64(found, 0),
                physics = sqlite3_column_int64(found, 1);
  return mo_sql_do(writer, version_sql, mo_int(controller), mo_int(physics));
}

struct replacing {
  const struct mo_origin_row *rows;
  size_t n;
};

static int replace(struct mo_store *store, void *arguments)
{
  const struct replacing *call = arguments;
  const int64_t now_us = mo_clock_wall_us();
  int error = MO_OK;
  for (size_t i = 0; i < call->n && error == MO_OK; i++)
    error = replace_row(store, &call->rows[i], now_us);
  return error;
}

int mo_store_origin_replace(struct mo_store *store, const struct mo_origin_row *rows, size_t n)
{
  return mo_write(store, replace, &(struct replacing){rows, n});
}
