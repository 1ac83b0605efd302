/* designs.c: reads designs and their scores. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "store/scores.h"

#define ROLLOUTS_MAX 1000 /* largest number of rollouts reported for one design */

/* ---- lists ---- */

static int read_by_row(sqlite3_stmt *row, void *any)
{
  struct mo_design_row *design = any;
  *design = (struct mo_design_row){.row = sqlite3_column_int64(row, 0),
                                   .first_seen_us = sqlite3_column_int64(row, 2),
                                   .score = NAN};
  return mo_column_genotype(row, 1, &design->form);
}

/* Finds the ranking that a query selects. MO_ERR_NOT_FOUND: no scores. */
static int find_ranking(struct mo_connection *reader, const struct mo_design_query *query,
                        int64_t *row)
{
  static const char sensor_sql[] = "SELECT sensor FROM controllers WHERE sha256=?1";
  static const char sql[] =
      "SELECT id FROM rankings WHERE controller=(SELECT id FROM controllers WHERE sha256=?1)"
      " AND physics=(SELECT id FROM physics WHERE sha256=?2)"
      " AND fingerprint=(SELECT id FROM fingerprints WHERE text=?3)"
      " AND environment_set=(SELECT id FROM environment_sets WHERE name=?4)";
  const struct mo_value controller = mo_hash(&query->controller_sha256);
  struct mo_sha256 hash;
  int64_t sensor;
  const int error = mo_sql_find(reader, &sensor, sensor_sql, controller);
  if (error != MO_OK)
    return error;
  mo_physics_hash(&query->physics, query->precision, (enum mo_sensor)sensor, &hash);
  return mo_sql_find(reader, row, sql, controller, mo_hash(&hash), mo_string(query->fingerprint),
                     mo_string(query->environment_set));
}

static int64_t list_by_score(struct mo_connection *reader, const struct mo_design_query *query,
                             struct mo_design_row *rows, size_t limit)
{
#define RANKED                                                                                     \
  "SELECT s.genotype,s.score,s.checksum,g.bits,d.id,d.form,d.first_seen_us FROM set_scores s"      \
  " JOIN genotypes g ON g.id=s.genotype JOIN designs d ON d.id=g.design WHERE s.ranking=?1"
  static const char *const sql[] = {
      RANKED " AND (s.score,s.genotype)>(?2,?3) ORDER BY s.score,s.genotype LIMIT ?4",
      RANKED " AND (s.score,s.genotype)<(?2,?3) ORDER BY s.score DESC,s.genotype DESC LIMIT ?4"};
#undef RANKED
  const bool is_first = query->after_row == 0, is_descending = query->is_descending;
  const double after = is_first ? (is_descending ? INFINITY : -INFINITY) : query->after_score;
  int64_t ranking = 0, n = 0;
  int error = find_ranking(reader, query, &ranking);
  if (error == MO_ERR_NOT_FOUND)
    return 0;
  sqlite3_stmt *row = mo_sql_rows(
      reader, &error, sql[is_descending], mo_int(ranking), mo_real(after),
      mo_int(is_first && is_descending ? INT64_MAX : query->after_row), mo_int((int64_t)limit));
  while (mo_sql_next(reader, row, &error)) {
    struct mo_design_row *design = &rows[n++];
    *design = (struct mo_design_row){.row = sqlite3_column_int64(row, 4),
                                     .first_seen_us = sqlite3_column_int64(row, 6),
                                     .genotype_row = sqlite3_column_int64(row, 0)};
    error = mo_set_score_from_row(row, 1, ranking, design->genotype_row, &design->score);
    if (error == MO_OK)
      error = mo_column_design(row, 3, 5, &design->genotype, &design->form);
  }
  return error != MO_OK ? error : n;
}

int64_t mo_store_designs(struct mo_store *store, const struct mo_design_query *query,
                         struct mo_design_row *rows, size_t limit)
{
  static const char *const sql[] = {
      "SELECT id,form,first_seen_us FROM designs WHERE id>?1 ORDER BY id LIMIT ?2",
      "SELECT id,form,first_seen_us FROM designs WHERE id<?1 ORDER BY id DESC LIMIT ?2"};
  const bool is_newest = query->is_descending && query->after_row == 0;
  if (query->sort != MO_DESIGNS_BY_SCORE)
    return mo_read_page(
        store, sql[query->is_descending],
        MO_VALUES(mo_int(is_newest ? INT64_MAX : query->after_row), mo_int((int64_t)limit)),
        read_by_row, rows, sizeof(*rows));
  if (limit > MO_PAGE_MAX)
    return MO_ERR_LIMIT;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return list_by_score(reader, query, rows, limit);
}

/* ---- one design ---- */

#define ORIENTATIONS_MAX 8 /* of one design */

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

static int load_orientations(struct mo_connection *reader, int64_t id, struct mo_design *design,
                             int64_t genotypes[ORIENTATIONS_MAX])
{
  static const char sql[] = "SELECT g.id,g.bits,d.form FROM genotypes g JOIN designs d ON"
                            " d.id=g.design WHERE g.design=?1 ORDER BY g.id LIMIT ?2";
  struct mo_genotype form;
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id), mo_int(ORIENTATIONS_MAX));
  design->orientations = calloc(ORIENTATIONS_MAX, sizeof(*design->orientations));
  if (design->orientations == NULL)
    return MO_ERR_NO_MEMORY;
  while (mo_sql_next(reader, row, &error)) {
    genotypes[design->n_orientations] = sqlite3_column_int64(row, 0);
    error = mo_column_design(row, 1, 2, &design->orientations[design->n_orientations++].genotype,
                             &form);
  }
  return error;
}

/* The group of a loss. Consecutive losses of a group with a set form one score. */
struct group {
  int64_t controller, physics, fingerprint, set;
};

/* Columns of the query below: the columns of the score, then these. */
enum {
  SET = 8,
  POSITION,
  SET_NAME,
  SET_SIZE,
  CONTROLLER_HASH,
  PHYSICS_HASH,
  PHYSICS,
  ENVIRONMENT_HASH,
  FINGERPRINT,
  ORIGIN,
  ENVIRONMENT,
  PLACE
};

static int start_score(sqlite3_stmt *row, struct mo_design_score *score)
{
  struct mo_physics physics;
  int64_t n = sqlite3_column_int64(row, SET_SIZE);
  int error = mo_column_hash(row, CONTROLLER_HASH, &score->controller_sha256);
  if (error == MO_OK)
    error = mo_column_hash(row, PHYSICS_HASH, &score->physics_sha256);
  if (error == MO_OK)
    error = mo_column_physics(row, PHYSICS, &physics, &score->precision, &score->sensor);
  if (error == MO_OK)
    error = mo_column_hash(row, ENVIRONMENT_HASH, &score->environment_sha256);
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    return MO_ERR_CORRUPT;
  mo_column_text(row, SET_NAME, score->environment_set, sizeof(score->environment_set));
  mo_column_text(row, FINGERPRINT, score->fingerprint, sizeof(score->fingerprint));
  score->n_losses = (uint32_t)n;
  for (uint32_t k = 0; k < score->n_losses; k++)
    score->losses[k] = NAN;
  return error;
}

static int load_scores(struct mo_connection *reader, int64_t genotype,
                       struct mo_design_orientation *orientation, uint32_t *room)
{
  static const char sql[] =
      "SELECT " MO_SCORE_COLUMNS ",coalesce(m.environment_set,0),coalesce(m.position,0),"
      "coalesce(s.name,''),coalesce(s.n,1),k.sha256,p.sha256,p.encoding,e.sha256,f.text,o.text,"
      "v.environment,v.position FROM scores x JOIN conditions c ON c.id=x.condition"
      " JOIN condition_environments v ON v.condition=c.id JOIN controllers k ON k.id=c.controller"
      " JOIN physics p ON p.id=c.physics JOIN fingerprints f ON f.id=c.fingerprint"
      " JOIN origins o ON o.id=x.origin JOIN environments e ON e.id=v.environment"
      " LEFT JOIN environment_set_members m ON m.environment=v.environment"
      " LEFT JOIN environment_sets s ON s.id=m.environment_set WHERE x.genotype=?1"
      " ORDER BY c.controller,c.physics,9,c.fingerprint,10,v.environment,x.computed_us LIMIT ?2";
  struct group group = {0, 0, 0, -1};
  struct mo_design_score *score = NULL;
  int64_t last = 0; /* environment */
  int error = MO_OK;
  sqlite3_stmt *statement =
      mo_sql_rows(reader, &error, sql, mo_int(genotype), mo_int((int64_t)*room + 1));
  while (mo_sql_next(reader, statement, &error)) {
    const int64_t position = sqlite3_column_int64(statement, POSITION),
                  place = sqlite3_column_int64(statement, PLACE),
                  environment = sqlite3_column_int64(statement, ENVIRONMENT),
                  computed_us = sqlite3_column_int64(statement, 6);
    struct mo_condition condition;
    double losses[MO_BLOCK_LANES];
    uint32_t steps[MO_BLOCK_LANES];
    bool is_same;
    error = mo_score_from_row(statement, 0, &condition, losses, steps);
    if (error == MO_OK &&
        (place < 0 || place >= condition.n || condition.environments[place] != environment))
      error = MO_ERR_CORRUPT;
    if (error != MO_OK)
      break;
    is_same = score != NULL && condition.controller == group.controller &&
              condition.physics == group.physics && condition.fingerprint == group.fingerprint &&
              sqlite3_column_int64(statement, SET) == group.set;
    if (*room == 0) { /* at least one more row exists than is reported, possibly of this score */
      *room = UINT32_MAX;
      orientation->n_scores -= is_same && group.set != 0;
      break;
    }
    (*room)--;
    if (is_same && environment == last)
      continue; /* it is in another row, which was computed first */
    last = environment;
    group = (struct group){condition.controller, condition.physics, condition.fingerprint,
                           sqlite3_column_int64(statement, SET)};
    if (!is_same || group.set == 0) {
      score = add_score(orientation);
      error = score == NULL ? MO_ERR_NO_MEMORY : start_score(statement, score);
    }
    if (error == MO_OK && (position < 0 || position >= score->n_losses))
      error = MO_ERR_CORRUPT;
    if (error != MO_OK)
      break;
    score->losses[position] = losses[place];
    score->diverged_steps[position] = (int32_t)steps[place];
    if (computed_us > score->computed_us) {
      score->computed_us = computed_us;
      mo_column_text(statement, ORIGIN, score->origin, sizeof(score->origin));
    }
  }
  return error;
}

static int load_design(struct mo_connection *reader, const void *any, void *ret)
{
  const struct mo_genotype *form = any;
  static const char sql[] = "SELECT id,first_seen_us FROM designs WHERE form=?1";
  struct mo_design *design = ret;
  uint8_t bytes[MO_BITS_BYTES];
  int64_t genotypes[ORIENTATIONS_MAX] = {0};
  uint32_t room = ROLLOUTS_MAX;
  sqlite3_stmt *row;
  mo_encode_genotype(form->words, bytes);
  int error = mo_sql_row(reader, &row, sql, mo_blob(bytes, sizeof(bytes)));
  if (error != MO_OK)
    return error;
  design->form = *form;
  design->first_seen_us = sqlite3_column_int64(row, 1);
  error = load_orientations(reader, sqlite3_column_int64(row, 0), design, genotypes);
  for (uint32_t i = 0; i < design->n_orientations && error == MO_OK && room != UINT32_MAX; i++)
    error = load_scores(reader, genotypes[i], &design->orientations[i], &room);
  design->truncated = room == UINT32_MAX;
  return error;
}

void mo_design_free(void *any)
{
  struct mo_design *design = any;
  if (design == NULL)
    return;
  for (uint32_t i = 0; i < design->n_orientations; i++)
    free(design->orientations[i].scores);
  free(design->orientations);
  free(design);
}

int mo_store_design(struct mo_store *store, const struct mo_genotype *form, struct mo_design **ret)
{
  int error;
  *ret = mo_read_whole(store, sizeof(**ret), load_design, form, mo_design_free, &error);
  return error;
}
