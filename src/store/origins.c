/* origins.c: see origins.h. An index by origin would cost space in every score, so there is no such
 * index: a page visits a bounded number of rows in the order of their key. */
#include "store/origins.h"

#include "base/clock.h"
#include "store/runs.h"
#include "store/scores.h"

#define VISITED_MAX 50000

#define FROM_SCORES                                                                                \
  " FROM scores x JOIN conditions c ON c.id=x.condition JOIN genotypes g ON g.id=x.genotype"       \
  " JOIN designs d ON d.id=g.design JOIN controllers k ON k.id=c.controller"                       \
  " JOIN physics p ON p.id=c.physics JOIN fingerprints f ON f.id=c.fingerprint"                    \
  " WHERE x.genotype=?1 AND x.condition=?2"

/* ---- reading ---- */

static int read_row(struct mo_connection *reader, struct mo_origin_place place,
                    struct mo_origin_row *row)
{
  static const char sql[] =
      "SELECT " MO_SCORE_COLUMNS ",g.bits,d.form,k.sha256,p.sha256,p.encoding,f.text" FROM_SCORES;
  struct mo_condition condition;
  enum mo_sensor sensor;
  sqlite3_stmt *found;
  int error = mo_sql_row(reader, &found, sql, mo_int(place.genotype), mo_int(place.condition));
  *row = (struct mo_origin_row){.genotype_row = place.genotype, .condition = place.condition};
  if (error == MO_OK)
    error = mo_score_from_row(found, 0, &condition, row->stored.losses, row->stored.diverged_steps);
  if (error == MO_OK)
    error = mo_column_design(found, 8, 9, &row->genotype, &row->form);
  if (error == MO_OK)
    error = mo_column_hash(found, 10, &row->controller_sha256);
  if (error == MO_OK)
    error = mo_column_hash(found, 11, &row->physics_sha256);
  if (error == MO_OK)
    error = mo_column_physics(found, 12, &row->physics, &row->precision, &sensor);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  row->computed_us = sqlite3_column_int64(found, 6);
  mo_column_text(found, 13, row->fingerprint, sizeof(row->fingerprint));
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
  static const char sql[] = "SELECT genotype,condition,origin FROM scores"
                            " WHERE (genotype,condition)>(?1,?2) ORDER BY genotype,condition";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int64_t id = 0;
  size_t n = 0, visited = 0;
  int error = mo_sql_find(reader, &id, origin_sql, mo_string(origin));
  sqlite3_stmt *row =
      mo_sql_rows(reader, &error, sql, mo_int(place->genotype), mo_int(place->condition));
  *is_last = false;
  while (n < limit && visited++ < VISITED_MAX && error == MO_OK) {
    *is_last = !mo_sql_next(reader, row, &error);
    if (*is_last)
      break;
    *place = (struct mo_origin_place){sqlite3_column_int64(row, 0), sqlite3_column_int64(row, 1)};
    if (sqlite3_column_int64(row, 2) == id)
      error = read_row(reader, *place, &rows[n++]);
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

static int replace_row(struct mo_store *store, const struct mo_origin_row *row, int64_t now_us)
{
  static const char sql[] = "SELECT " MO_SCORE_COLUMNS FROM_SCORES;
  /* The ETag of evaluations includes the job's version. */
  static const char version_sql[] =
      "UPDATE jobs SET " MO_NEXT_VERSION
      " WHERE id IN (SELECT job FROM evaluations WHERE controller=?1 AND"
      " (physics=?2 OR n_displaced>0))"; /* whose other runs have other physics */
  struct mo_connection *writer = &store->writer;
  struct mo_condition condition;
  struct mo_loss_row stored;
  sqlite3_stmt *found;
  int error = mo_sql_row(writer, &found, sql, mo_int(row->genotype_row), mo_int(row->condition));
  if (error == MO_OK)
    error = mo_score_from_row(found, 0, &condition, stored.losses, stored.diverged_steps);
  if (error != MO_OK || condition.n != row->n || !mo_loss_rows_equal(&stored, &row->stored, row->n))
    return error;
  condition.id = row->condition;
  error = mo_losses_replace(store, &condition, row->genotype_row, row->again.losses,
                            row->again.diverged_steps, now_us);
  if (error == MO_OK)
    error = replace_means(writer, row->genotype_row, &condition);
  return error == MO_OK ? mo_sql_do(writer, version_sql, mo_int(condition.controller),
                                    mo_int(condition.physics))
                        : error;
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
