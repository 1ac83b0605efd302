/* designs.c: reads designs and their scores. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "store/internal.h"

#define ROLLOUTS_MAX 1000 /* the most that are reported of one design */

/* ---- lists ---- */

static int64_t list_by_row(struct mo_connection *reader, const struct mo_design_query *query,
                           struct mo_design_row *rows, size_t limit)
{
  static const char sql[] =
      "SELECT id,form,first_seen_us FROM designs WHERE id>?1 ORDER BY id LIMIT ?2";
  int error = MO_OK;
  int64_t n = 0;
  int step = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, query->after_row);
  sqlite3_bind_int64(statement, 2, (sqlite3_int64)limit);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    struct mo_design_row *row = &rows[n++];
    memset(row, 0, sizeof(*row));
    row->row = sqlite3_column_int64(statement, 0);
    error = mo_column_bits(statement, 1, &row->form);
    row->first_seen_us = sqlite3_column_int64(statement, 2);
    row->score = NAN;
  }
  return step < 0 ? step : error != MO_OK ? error : n;
}

/* Finds the row of a physics setting under a controller's sensor. MO_ERR_NOT_FOUND: it has no
 * scores. */
static int find_physics(struct mo_connection *reader, const struct mo_design_query *query,
                        int64_t *row)
{
  static const char sensor_sql[] = "SELECT sensor FROM controllers WHERE sha256=?1";
  static const char physics_sql[] = "SELECT id FROM physics WHERE sha256=?1";
  struct mo_sha256 hash;
  int64_t sensor;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, sensor_sql, &error);
  if (statement == NULL)
    return error;
  mo_bind_hash(statement, 1, &query->controller_sha256);
  error = mo_sql_integer(reader, statement, &sensor);
  if (error != MO_OK)
    return error;
  mo_physics_hash(&query->physics, query->precision, (enum mo_sensor)sensor, &hash);
  statement = mo_sql(reader, physics_sql, &error);
  if (statement == NULL)
    return error;
  mo_bind_hash(statement, 1, &hash);
  error = mo_sql_integer(reader, statement, row);
  (void)sqlite3_clear_bindings(statement);
  return error;
}

static int64_t list_by_score(struct mo_connection *reader, const struct mo_design_query *query,
                             struct mo_design_row *rows, size_t limit)
{
  static const char sql[] =
      "SELECT s.genotype,s.bits,g.bits,d.id,d.form,d.first_seen_us FROM set_scores s"
      " JOIN genotypes g ON g.id=s.genotype JOIN designs d ON d.id=g.design"
      " WHERE s.controller=(SELECT id FROM controllers WHERE sha256=?1) AND s.physics=?2"
      " AND s.environment_set=(SELECT id FROM environment_sets WHERE name=?3)"
      " AND (s.score,s.genotype)>(?4,?5) ORDER BY s.score,s.genotype LIMIT ?6";
  int64_t physics = 0, n = 0;
  sqlite3_stmt *statement;
  int step = 0;
  int error = find_physics(reader, query, &physics);
  if (error == MO_ERR_NOT_FOUND)
    return 0;
  if (error != MO_OK)
    return error;
  statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  mo_bind_hash(statement, 1, &query->controller_sha256);
  sqlite3_bind_int64(statement, 2, physics);
  sqlite3_bind_text(statement, 3, query->environment_set, -1, SQLITE_STATIC);
  sqlite3_bind_double(statement, 4, query->after_row != 0 ? query->after_score : -INFINITY);
  sqlite3_bind_int64(statement, 5, query->after_row);
  sqlite3_bind_int64(statement, 6, (sqlite3_int64)limit);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    struct mo_design_row *row = &rows[n++];
    memset(row, 0, sizeof(*row));
    row->genotype_row = sqlite3_column_int64(statement, 0);
    row->row = sqlite3_column_int64(statement, 3);
    row->first_seen_us = sqlite3_column_int64(statement, 5);
    error = mo_column_double(statement, 1, &row->score);
    if (error == MO_OK)
      error = mo_column_bits(statement, 2, &row->genotype);
    if (error == MO_OK)
      error = mo_column_bits(statement, 4, &row->form);
  }
  (void)sqlite3_reset(statement);
  (void)sqlite3_clear_bindings(statement);
  return step < 0 ? step : error != MO_OK ? error : n;
}

int64_t mo_store_designs(struct mo_store *store, const struct mo_design_query *query,
                         struct mo_design_row *rows, size_t limit)
{
  struct mo_connection *reader;
  int64_t n;
  if (limit > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  reader = mo_reader_acquire(store);
  n = mo_sql_exec(reader, "BEGIN");
  if (n == MO_OK)
    n = query->sort == MO_DESIGNS_BY_SCORE ? list_by_score(reader, query, rows, limit)
                                           : list_by_row(reader, query, rows, limit);
  mo_reader_release(store, reader);
  return n;
}

/* ---- one design ---- */

static int add_orientation(struct mo_design *design, const struct mo_bits *genotype)
{
  struct mo_design_orientation *more =
      realloc(design->orientations, (design->n_orientations + 1) * sizeof(*design->orientations));
  if (more == NULL)
    return MO_ERR_NO_MEMORY;
  design->orientations = more;
  design->orientations[design->n_orientations] =
      (struct mo_design_orientation){.genotype = *genotype};
  design->n_orientations++;
  return MO_OK;
}

/* Appends an empty score to an orientation. */
static struct mo_design_score *add_score(struct mo_design_orientation *orientation)
{
  struct mo_design_score *more =
      realloc(orientation->scores, (orientation->n_scores + 1) * sizeof(*orientation->scores));
  if (more == NULL)
    return NULL;
  orientation->scores = more;
  memset(&more[orientation->n_scores], 0, sizeof(*more));
  return &more[orientation->n_scores++];
}

static int load_orientations(struct mo_connection *reader, int64_t row, struct mo_design *design,
                             int64_t *genotypes)
{
  static const char sql[] = "SELECT id,bits FROM genotypes WHERE design=?1 ORDER BY id LIMIT 8";
  int error = MO_OK;
  int step = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, row);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    struct mo_bits bits;
    genotypes[design->n_orientations] = sqlite3_column_int64(statement, 0);
    error = mo_column_bits(statement, 1, &bits);
    if (error == MO_OK)
      error = add_orientation(design, &bits);
  }
  return step < 0 ? step : error;
}

/* What a score row belongs to. Consecutive rows of one group with a set form one score. */
struct group {
  int64_t controller, physics, set;
};

static int start_score(sqlite3_stmt *row, struct mo_design_score *score)
{
  const void *encoding = sqlite3_column_blob(row, 8);
  struct mo_physics physics;
  int64_t n = sqlite3_column_int64(row, 5);
  int error = mo_column_hash(row, 6, &score->controller_sha256);
  if (error == MO_OK)
    error = mo_column_hash(row, 7, &score->physics_sha256);
  if (error == MO_OK)
    error = encoding == NULL ? MO_ERR_CORRUPT
                             : mo_decode_physics(encoding, (size_t)sqlite3_column_bytes(row, 8),
                                                 &physics, &score->precision, &score->sensor);
  if (error == MO_OK)
    error = mo_column_hash(row, 9, &score->environment_sha256);
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    return MO_ERR_CORRUPT;
  mo_column_text(row, 4, score->environment_set, sizeof(score->environment_set));
  score->n_losses = (uint32_t)n;
  for (uint32_t k = 0; k < score->n_losses; k++)
    score->losses[k] = NAN;
  return error;
}

static int load_scores(struct mo_connection *reader, int64_t genotype,
                       struct mo_design_orientation *orientation, uint32_t *room)
{
  static const char sql[] =
      "SELECT "
      "x.controller,x.physics,coalesce(m.environment_set,0),coalesce(m.position,0),coalesce(s.name,"
      "''),"
      "coalesce(s.n,1),c.sha256,p.sha256,p.encoding,e.sha256,x.loss,x.diverged_step,x.computed_us,"
      "f.text"
      " FROM scores x JOIN controllers c ON c.id=x.controller JOIN physics p ON p.id=x.physics"
      " JOIN environments e ON e.id=x.environment JOIN fingerprints f ON f.id=x.fingerprint"
      " LEFT JOIN environment_set_members m ON m.environment=x.environment"
      " LEFT JOIN environment_sets s ON s.id=m.environment_set"
      " WHERE x.genotype=?1 ORDER BY x.controller,x.physics,3,4,x.environment LIMIT ?2";
  struct group group = {0, 0, -1};
  struct mo_design_score *score = NULL;
  int error = MO_OK;
  int step = 0;
  sqlite3_stmt *statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, genotype);
  sqlite3_bind_int64(statement, 2, (sqlite3_int64)*room + 1);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    struct group here = {sqlite3_column_int64(statement, 0), sqlite3_column_int64(statement, 1),
                         sqlite3_column_int64(statement, 2)};
    int64_t position = sqlite3_column_int64(statement, 3);
    if (*room == 0) {
      *room = UINT32_MAX; /* there is at least one row more than reported */
      break;
    }
    (*room)--;
    if (score == NULL || here.set == 0 || here.controller != group.controller ||
        here.physics != group.physics || here.set != group.set) {
      score = add_score(orientation);
      error = score == NULL ? MO_ERR_NO_MEMORY : start_score(statement, score);
    }
    group = here;
    if (error == MO_OK && (position < 0 || position >= score->n_losses))
      error = MO_ERR_CORRUPT;
    if (error == MO_OK)
      error = mo_column_double(statement, 10, &score->losses[position]);
    if (error != MO_OK)
      break;
    score->diverged_steps[position] = sqlite3_column_int(statement, 11);
    if (sqlite3_column_int64(statement, 12) > score->computed_us) {
      score->computed_us = sqlite3_column_int64(statement, 12);
      mo_column_text(statement, 13, score->fingerprint, sizeof(score->fingerprint));
    }
  }
  (void)sqlite3_reset(statement);
  for (uint32_t i = 0; i < orientation->n_scores; i++) {
    double sum = 0;
    for (uint32_t k = 0; k < orientation->scores[i].n_losses; k++)
      sum += orientation->scores[i].losses[k];
    orientation->scores[i].score = sum / orientation->scores[i].n_losses;
  }
  return step < 0 ? step : error;
}

static int load_design(struct mo_connection *reader, const struct mo_bits *form,
                       struct mo_design *design)
{
  static const char sql[] = "SELECT id,first_seen_us FROM designs WHERE form=?1";
  uint8_t bytes[MO_BITS_BYTES];
  int64_t genotypes[8] = {0};
  uint32_t room = ROLLOUTS_MAX;
  int64_t row;
  int step;
  int error = mo_sql_exec(reader, "BEGIN");
  sqlite3_stmt *statement = error == MO_OK ? mo_sql(reader, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  mo_encode_bits(form, bytes);
  sqlite3_bind_blob(statement, 1, bytes, sizeof(bytes), SQLITE_STATIC);
  step = mo_sql_step(reader, statement);
  if (step > 0) {
    row = sqlite3_column_int64(statement, 0);
    design->first_seen_us = sqlite3_column_int64(statement, 1);
  }
  (void)sqlite3_reset(statement);
  (void)sqlite3_clear_bindings(statement);
  if (step <= 0)
    return step < 0 ? step : MO_ERR_NOT_FOUND;
  design->form = *form;
  error = load_orientations(reader, row, design, genotypes);
  for (uint32_t i = 0; i < design->n_orientations && error == MO_OK && room != UINT32_MAX; i++)
    error = load_scores(reader, genotypes[i], &design->orientations[i], &room);
  design->truncated = room == UINT32_MAX;
  return error;
}

int mo_store_design(struct mo_store *store, const struct mo_bits *form, struct mo_design **ret)
{
  struct mo_design *design = calloc(1, sizeof(*design));
  struct mo_connection *reader;
  int error;
  if (design == NULL)
    return MO_ERR_NO_MEMORY;
  reader = mo_reader_acquire(store);
  error = load_design(reader, form, design);
  mo_reader_release(store, reader);
  if (error != MO_OK) {
    mo_design_free(design);
    return error;
  }
  *ret = design;
  return MO_OK;
}
