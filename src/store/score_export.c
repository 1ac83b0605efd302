/* score_export.c: reads scores as blocks (score_blocks.h). Blocks follow the order of the rows'
 * key; a walk holds a reader only for a bounded number of rows, so that the log can be copied in
 * between. */
#include "store/score_blocks.h"

#include <stdlib.h>

#include "store/controller_rows.h"
#include "store/internal.h"
#include "store/scores.h"

#define VISITED_MAX 50000

struct mo_score_walk {
  struct mo_store *store;
  int64_t controller, fingerprint, since_us; /* 0: all; −1: a class without stored scores */
  struct mo_origin_place place;              /* of the last row that was taken or skipped */
  uint32_t n_blocks;
  struct mo_sha256 *sent; /* (n_sent) controllers whose weights are in a block */
  size_t n_sent, room;
  /* The rows of the block's tables. */
  int64_t conditions[MO_SCORED_CONDITIONS][2]; /* controller, physics */
  int64_t environments[MO_SCORED_ENVIRONMENTS];
  int64_t design;
};

/* ---- blocks ---- */

struct mo_score_block *mo_score_block_create(void)
{
  return calloc(1, sizeof(struct mo_score_block));
}

void mo_score_block_clear(struct mo_score_block *block)
{
  free(block->weights);
  mo_controller_free(block->controller);
  mo_environments_drop(block->environments, block->n_environments);
  block->weights = NULL;
  block->controller = NULL;
  block->n_conditions = block->n_environments = block->n_designs = block->n_scores = 0;
}

void mo_score_block_free(struct mo_score_block *block)
{
  if (block != NULL)
    mo_score_block_clear(block);
  free(block);
}

/* ---- the tables of a block. MO_ERR_LIMIT: the block is full ---- */

/* Marks the block to include the weights of a controller; a block has room for one. */
static int send_weights(struct mo_score_walk *walk, struct mo_score_block *block,
                        const struct mo_sha256 *sha256)
{
  for (size_t i = 0; i < walk->n_sent; i++)
    if (mo_sha256_equal(&walk->sent[i], sha256))
      return MO_OK;
  if (block->weights_size > 0)
    return MO_ERR_LIMIT;
  if (walk->n_sent == walk->room) {
    const size_t room = walk->room > 0 ? 2 * walk->room : 16;
    struct mo_sha256 *sent = realloc(walk->sent, room * sizeof(*sent));
    if (sent == NULL)
      return MO_ERR_NO_MEMORY;
    walk->sent = sent;
    walk->room = room;
  }
  walk->sent[walk->n_sent++] = block->weights_sha256 = *sha256;
  block->weights_size = 1; /* a placeholder until they are read */
  return MO_OK;
}

static int condition_place(struct mo_score_walk *walk, struct mo_connection *reader,
                           struct mo_score_block *block, const struct mo_condition *condition,
                           uint32_t *place)
{
  static const char sql[] =
      "SELECT k.sha256,p.encoding FROM controllers k, physics p WHERE k.id=?1 AND p.id=?2";
  struct mo_scored_condition *made = &block->conditions[block->n_conditions];
  sqlite3_stmt *row;
  for (*place = 0; *place < block->n_conditions; ++*place)
    if (walk->conditions[*place][0] == condition->controller &&
        walk->conditions[*place][1] == condition->physics)
      return MO_OK;
  if (*place == MO_SCORED_CONDITIONS)
    return MO_ERR_LIMIT;
  int error =
      mo_sql_row(reader, &row, sql, mo_int(condition->controller), mo_int(condition->physics));
  if (error == MO_OK)
    error = mo_column_hash(row, 0, &made->controller);
  if (error == MO_OK)
    error = mo_column_physics(row, 1, &made->physics, &made->precision, &made->sensor);
  if (error == MO_OK)
    error = send_weights(walk, block, &made->controller);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  walk->conditions[*place][0] = condition->controller;
  walk->conditions[*place][1] = condition->physics;
  block->n_conditions++;
  return MO_OK;
}

static int environment_place(struct mo_score_walk *walk, struct mo_connection *reader,
                             struct mo_score_block *block, int64_t environment, uint32_t *place)
{
  for (*place = 0; *place < block->n_environments; ++*place)
    if (walk->environments[*place] == environment)
      return MO_OK;
  if (*place == MO_SCORED_ENVIRONMENTS)
    return MO_ERR_LIMIT;
  const int error = mo_environment_get(reader, environment, &block->environments[*place], NULL);
  if (error != MO_OK)
    return error;
  walk->environments[*place] = environment;
  block->n_environments++;
  return MO_OK;
}

/* Rows of one design are adjacent. */
static int design_place(struct mo_score_walk *walk, struct mo_connection *reader,
                        struct mo_score_block *block, int64_t genotype, uint32_t *place)
{
  static const char sql[] = "SELECT g.bits,d.form FROM genotypes g JOIN designs d ON d.id=g.design"
                            " WHERE g.id=?1";
  sqlite3_stmt *row;
  *place = block->n_designs;
  if (*place > 0 && walk->design == genotype) {
    --*place;
    return MO_OK;
  }
  int error = mo_sql_row(reader, &row, sql, mo_int(genotype));
  if (error == MO_OK)
    error =
        mo_column_design(row, 0, 1, &block->designs[*place].genotype, &block->designs[*place].form);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  walk->design = genotype;
  block->n_designs++;
  return MO_OK;
}

/* ---- the walk ---- */

int mo_score_walk_create(struct mo_store *store, const struct mo_score_query *query,
                         struct mo_score_walk **ret)
{
  static const char class_sql[] = "SELECT id FROM fingerprints WHERE text=?1";
  struct mo_score_walk *walk = calloc(1, sizeof(*walk));
  enum mo_sensor sensor;
  int error = MO_OK;
  if (walk == NULL)
    return MO_ERR_NO_MEMORY;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  *walk = (struct mo_score_walk){.store = store, .since_us = query->since_us};
  if (query->controller != NULL)
    error = mo_controller_find(reader, query->controller, &walk->controller, &sensor, NULL);
  if (error == MO_OK && query->fingerprint != NULL) {
    error = mo_sql_find(reader, &walk->fingerprint, class_sql, mo_string(query->fingerprint));
    if (error == MO_ERR_NOT_FOUND) {
      walk->fingerprint = -1;
      error = MO_OK;
    }
  }
  if (error != MO_OK)
    free(walk);
  else
    *ret = walk;
  return error == MO_ERR_UNSUPPORTED ? MO_ERR_NOT_FOUND : error;
}

void mo_score_walk_free(struct mo_score_walk *walk)
{
  if (walk != NULL)
    free(walk->sent);
  free(walk);
}

/* Takes the first rollout of a row for each environment: a row of a campaign or of a verify job may
 * have an environment twice, which readers of blocks reject. */
static int take_rollouts(struct mo_score_walk *walk, struct mo_connection *reader,
                         struct mo_score_block *block, const struct mo_condition *condition,
                         struct mo_campaign_score *score)
{
  int error = MO_OK;
  score->n = 0;
  for (uint32_t k = 0; k < condition->n && error == MO_OK; k++) {
    uint32_t place, i = 0;
    error = environment_place(walk, reader, block, condition->environments[k], &place);
    while (i < score->n && score->environments[i] != place)
      i++;
    if (error != MO_OK || i < score->n)
      continue;
    score->environments[i] = place;
    score->losses[i] = score->losses[k];
    score->diverged_steps[i] = score->diverged_steps[k];
    score->n++;
  }
  return error;
}

/* Adds a row to the block, if the query selects it. */
static int take(struct mo_score_walk *walk, struct mo_connection *reader, sqlite3_stmt *row,
                struct mo_score_block *block)
{
  struct mo_campaign_score *score = &block->scores[block->n_scores];
  struct mo_condition condition = {.n = 0};
  if ((walk->controller != 0 && sqlite3_column_int64(row, 1) != walk->controller) ||
      (walk->fingerprint != 0 && sqlite3_column_int64(row, 3) != walk->fingerprint) ||
      sqlite3_column_int64(row, 6) < walk->since_us)
    return MO_OK;
  if (block->n_scores == MO_SCORED_ROWS)
    return MO_ERR_LIMIT;
  int error = mo_score_from_row(row, 0, &condition, score->losses, score->diverged_steps);
  if (error == MO_OK)
    error = condition_place(walk, reader, block, &condition, &block->condition_of[block->n_scores]);
  if (error == MO_OK)
    error = take_rollouts(walk, reader, block, &condition, score);
  if (error == MO_OK)
    error = design_place(walk, reader, block, sqlite3_column_int64(row, 0), &score->number);
  if (error != MO_OK)
    return error;
  score->computed_us = sqlite3_column_int64(row, 6);
  mo_column_text(row, 9, score->fingerprint, sizeof(score->fingerprint));
  mo_column_text(row, 10, score->origin, sizeof(score->origin));
  block->n_scores++;
  return MO_OK;
}

/* Reads a bounded number of rows. Returns 1 if there are more, 0 at the end, or an error. */
static int read_page(struct mo_score_walk *walk, struct mo_connection *reader,
                     struct mo_score_block *block)
{
  static const char sql[] =
      "SELECT " MO_SCORE_COLUMNS ",x.condition,f.text,o.text FROM scores x"
      " CROSS JOIN conditions c ON c.id=x.condition CROSS JOIN fingerprints f ON f.id=c.fingerprint"
      " CROSS JOIN origins o ON o.id=x.origin"
      " WHERE (x.genotype,x.condition)>(?1,?2) ORDER BY x.genotype,x.condition";
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(reader, &error, sql, mo_int(walk->place.genotype), mo_int(walk->place.condition));
  for (size_t visited = 0; visited < VISITED_MAX; visited++) {
    if (!mo_sql_next(reader, row, &error))
      return error;
    error = take(walk, reader, row, block);
    if (error != MO_OK)
      return error;
    walk->place =
        (struct mo_origin_place){sqlite3_column_int64(row, 0), sqlite3_column_int64(row, 8)};
  }
  return 1;
}

static int read_host(struct mo_connection *reader, int64_t origin, struct mo_score_block *block)
{
  static const char sql[] = "SELECT text FROM origins WHERE id=?1";
  sqlite3_stmt *row;
  const int error = mo_sql_row(reader, &row, sql, mo_int(origin));
  if (error == MO_OK)
    mo_column_text(row, 0, block->host, sizeof(block->host));
  return error;
}

int mo_score_walk_next(struct mo_score_walk *walk, struct mo_score_block *block)
{
  mo_score_block_clear(block);
  block->store = mo_store_id(walk->store);
  block->number = walk->n_blocks++;
  block->weights_size = 0;
  int error = 1;
  while (error == 1) {
    MO_SCOPED struct mo_connection *reader = mo_reader_acquire(walk->store);
    error = read_host(reader, walk->store->origin, block);
    if (error == MO_OK)
      error = read_page(walk, reader, block);
  }
  block->is_last = error == MO_OK;
  if (error == MO_ERR_LIMIT) /* an empty block has room for any row */
    error = block->n_scores > 0 ? MO_OK : MO_ERR_CORRUPT;
  if (error == MO_OK && block->weights_size > 0)
    error = mo_store_controller_bytes(walk->store, &block->weights_sha256, &block->weights,
                                      &block->weights_size);
  return error;
}
