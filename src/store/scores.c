/* scores.c: stored losses.
 *
 * A row of `scores` holds the losses of one genotype in a block of up to 16 environments, as one
 * call computed them, under one condition: weights, physics, class and those environments. Losses
 * are looked up by environment, no matter which block they are in. Readers check each row against
 * its checksum, which covers the row and its condition. Only a repair changes rows (origins.c). If
 * two rows have the same environment, the row that was computed first counts. */
#include "store/scores.h"

#include <math.h>
#include <string.h>

_Static_assert(MO_BLOCK_LANES == 16, "the schema limits the length of rows");

#define KEY_WORDS (6 + MO_BLOCK_LANES)

/* ---- packed losses ---- */

/* A permutation of h for any fixed word, and of the word for any fixed h. */
static uint64_t mix(uint64_t h, uint64_t word)
{
  h = (h ^ word) * UINT64_C(0x9E3779B97F4A7C15);
  return h ^ h >> 32;
}

uint64_t mo_row_checksum(const int64_t *key, size_t n_key, const void *bytes, size_t size)
{
  uint64_t h = mix(n_key, size);
  for (size_t i = 0; i < n_key; i++)
    h = mix(h, (uint64_t)key[i]);
  for (size_t i = 0; i < size; i += 8) {
    uint64_t word = 0;
    memcpy(&word, (const uint8_t *)bytes + i, size - i < 8 ? size - i : 8);
    h = mix(h, word);
  }
  return h;
}

size_t mo_pack_losses(const int64_t *key, size_t n_key, const double *losses,
                      const uint32_t *diverged_steps, uint32_t n, uint8_t *bytes)
{
  size_t size = (size_t)8 * n;
  uint32_t any = 0;
  memcpy(bytes, losses, size);
  for (uint32_t k = 0; k < n; k++)
    any |= diverged_steps[k];
  if (any != 0) {
    memcpy(bytes + size, diverged_steps, (size_t)4 * n);
    size += (size_t)4 * n;
  }
  uint64_t sum = mo_row_checksum(key, n_key, bytes, size);
  memcpy(bytes + size, &sum, 8);
  return size + 8;
}

int mo_unpack_losses(const int64_t *key, size_t n_key, const uint8_t *bytes, size_t size,
                     uint32_t n, double *losses, uint32_t *diverged_steps)
{
  const size_t plain = (size_t)8 * n, with_steps = (size_t)12 * n;
  uint64_t sum;
  if (bytes == NULL || (size != plain + 8 && size != with_steps + 8))
    return MO_ERR_CORRUPT;
  memcpy(&sum, bytes + size - 8, 8);
  if (sum != mo_row_checksum(key, n_key, bytes, size - 8))
    return MO_ERR_CORRUPT;
  memcpy(losses, bytes, plain);
  if (size == with_steps + 8)
    memcpy(diverged_steps, bytes + plain, (size_t)4 * n);
  else
    memset(diverged_steps, 0, (size_t)4 * n);
  return MO_OK;
}

/* ---- rows ---- */

static size_t key_of(const struct mo_condition *condition, int64_t genotype, int64_t origin,
                     int64_t computed_us, int64_t key[KEY_WORDS])
{
  key[0] = genotype;
  key[1] = condition->controller;
  key[2] = condition->physics;
  key[3] = condition->fingerprint;
  key[4] = origin;
  key[5] = computed_us;
  memcpy(key + 6, condition->environments, condition->n * sizeof(*key));
  return 6 + condition->n;
}

int mo_condition_row(struct mo_connection *writer, struct mo_condition *condition)
{
  static const char find_sql[] = "SELECT id FROM conditions WHERE controller=?1 AND physics=?2 AND "
                                 "fingerprint=?3 AND environments=?4";
  static const char insert_sql[] =
      "INSERT INTO conditions(controller,physics,fingerprint,environments) VALUES(?1,?2,?3,?4)";
  static const char member_sql[] =
      "INSERT INTO condition_environments(condition,position,environment) VALUES(?1,?2,?3)";
  const struct mo_values values = MO_VALUES(
      mo_int(condition->controller), mo_int(condition->physics), mo_int(condition->fingerprint),
      mo_blob(condition->environments, condition->n * sizeof(*condition->environments)));
  int error = mo_sql_find_with(writer, &condition->id, find_sql, values);
  if (error != MO_ERR_NOT_FOUND)
    return error;
  error = mo_sql_insert_with(writer, &condition->id, insert_sql, values);
  for (uint32_t k = 0; k < condition->n && error == MO_OK; k++)
    error = mo_sql_do(writer, member_sql, mo_int(condition->id), mo_int(k),
                      mo_int(condition->environments[k]));
  return error;
}

int mo_condition_row_after(struct mo_connection *writer, struct mo_condition *condition,
                           struct mo_condition *last)
{
  const bool is_same = last->controller == condition->controller &&
                       last->physics == condition->physics &&
                       last->fingerprint == condition->fingerprint && last->n == condition->n &&
                       memcmp(last->environments, condition->environments,
                              condition->n * sizeof(*condition->environments)) == 0;
  const int error = is_same ? MO_OK : mo_condition_row(writer, condition);
  if (is_same)
    condition->id = last->id;
  else if (error == MO_OK)
    *last = *condition;
  return error;
}

/* Runs a statement with the values of a row. */
static int write_losses(struct mo_store *store, const char *sql,
                        const struct mo_condition *condition, int64_t genotype, int64_t origin,
                        const double *losses, const uint32_t *diverged_steps, int64_t computed_us)
{
  uint8_t bytes[MO_PACKED_BYTES(MO_BLOCK_LANES)];
  int64_t key[KEY_WORDS];
  const size_t size = mo_pack_losses(key, key_of(condition, genotype, origin, computed_us, key),
                                     losses, diverged_steps, condition->n, bytes);
  return mo_sql_change(&store->writer, sql, mo_int(genotype), mo_int(condition->id), mo_int(origin),
                       mo_int(computed_us), mo_blob(bytes, size));
}

int mo_losses_insert(struct mo_store *store, const struct mo_condition *condition, int64_t genotype,
                     int64_t origin, const double *losses, const uint32_t *diverged_steps,
                     int64_t computed_us, bool *is_new)
{
  static const char sql[] =
      "INSERT OR IGNORE INTO scores(genotype,condition,origin,computed_us,losses)"
      " VALUES(?1,?2,?3,?4,?5)";
  const int error =
      write_losses(store, sql, condition, genotype, origin != 0 ? origin : store->origin, losses,
                   diverged_steps, computed_us);
  *is_new = error == MO_OK;
  return error == MO_ERR_CONFLICT ? MO_OK : error; /* they are already stored */
}

int mo_losses_replace(struct mo_store *store, const struct mo_condition *condition,
                      int64_t genotype, const double *losses, const uint32_t *diverged_steps,
                      int64_t computed_us)
{
  static const char sql[] = "UPDATE scores SET origin=?3,computed_us=?4,losses=?5"
                            " WHERE genotype=?1 AND condition=?2";
  return write_losses(store, sql, condition, genotype, store->origin, losses, diverged_steps,
                      computed_us);
}

int mo_condition_from_row(sqlite3_stmt *statement, int first, struct mo_condition *condition)
{
  const void *environments = sqlite3_column_blob(statement, first + 3);
  const int size = sqlite3_column_bytes(statement, first + 3);
  if (environments == NULL || size < 8 || size > 8 * MO_BLOCK_LANES || size % 8 != 0)
    return MO_ERR_CORRUPT;
  condition->controller = sqlite3_column_int64(statement, first);
  condition->physics = sqlite3_column_int64(statement, first + 1);
  condition->fingerprint = sqlite3_column_int64(statement, first + 2);
  condition->n = (uint32_t)size / 8;
  memcpy(condition->environments, environments, (size_t)size);
  return MO_OK;
}

int mo_score_from_row(sqlite3_stmt *statement, int first, struct mo_condition *condition,
                      double *losses, uint32_t *diverged_steps)
{
  int64_t key[KEY_WORDS];
  if (mo_condition_from_row(statement, first + 1, condition) != MO_OK)
    return MO_ERR_CORRUPT;
  size_t n_key = key_of(condition, sqlite3_column_int64(statement, first),
                        sqlite3_column_int64(statement, first + 5),
                        sqlite3_column_int64(statement, first + 6), key);
  return mo_unpack_losses(key, n_key, sqlite3_column_blob(statement, first + 7),
                          (size_t)sqlite3_column_bytes(statement, first + 7), condition->n, losses,
                          diverged_steps);
}

/* Reads the losses of one class into scores that are not known yet. */
static int read_class(struct mo_connection *connection, const struct mo_saved_design *design,
                      int64_t fingerprint, const int64_t *environments, uint32_t n,
                      struct mo_score *scores)
{
  static const char sql[] =
      "SELECT " MO_SCORE_COLUMNS " FROM scores x CROSS JOIN conditions c ON c.id=x.condition"
      " WHERE x.genotype=?1 AND c.controller=?2 AND c.physics=?3 AND c.fingerprint=?4";
  int64_t computed_us[MO_ENVIRONMENTS_MAX] = {0};
  int error = MO_OK;
  sqlite3_stmt *row =
      mo_sql_rows(connection, &error, sql, mo_int(design->genotype), mo_int(design->controller),
                  mo_int(design->physics), mo_int(fingerprint));
  while (mo_sql_next(connection, row, &error)) {
    const int64_t time_us = sqlite3_column_int64(row, 6);
    struct mo_condition condition = {.n = 0};
    double losses[MO_BLOCK_LANES];
    uint32_t steps[MO_BLOCK_LANES];
    error = mo_score_from_row(row, 0, &condition, losses, steps);
    for (uint32_t i = 0; i < condition.n && error == MO_OK; i++)
      for (uint32_t k = 0; k < n; k++)
        if (environments[k] == condition.environments[i] &&
            (!scores[k].known || time_us < computed_us[k])) {
          scores[k] = (struct mo_score){losses[i], (int32_t)steps[i], true};
          computed_us[k] = time_us;
        }
  }
  return error;
}

int mo_losses_read(struct mo_connection *connection, const struct mo_saved_design *design,
                   const int64_t *environments, uint32_t n, struct mo_score *scores)
{
  uint32_t n_known = 0;
  memset(scores, 0, n * sizeof(*scores));
  int error = read_class(connection, design, design->fingerprint, environments, n, scores);
  for (uint32_t k = 0; k < n; k++)
    n_known += scores[k].known;
  if (error == MO_OK && n_known < n && design->workers != 0 &&
      design->workers != design->fingerprint)
    error = read_class(connection, design, design->workers, environments, n, scores);
  return error;
}

int mo_losses_compare(struct mo_connection *connection, const struct mo_condition *condition,
                      int64_t genotype, const double *losses, const uint32_t *diverged_steps,
                      struct mo_score stored[MO_BLOCK_LANES])
{
  const struct mo_saved_design design = mo_design_under(condition, genotype, 0);
  const int error =
      mo_losses_read(connection, &design, condition->environments, condition->n, stored);
  for (uint32_t k = 0; error == MO_OK && k < condition->n; k++)
    if (stored[k].known && (!mo_same_bits(stored[k].loss, losses[k]) ||
                            stored[k].diverged_step != (int32_t)diverged_steps[k]))
      return MO_ERR_CONFLICT;
  return error;
}

int mo_store_scores(struct mo_store *store, const struct mo_saved_design *design,
                    const int64_t *environment_rows, uint32_t n, struct mo_score *scores)
{
  MO_SCOPED struct mo_connection *reader = mo_runner_acquire(store);
  return mo_losses_read(reader, design, environment_rows, n, scores);
}

/* ---- scores of evaluations ---- */

/* Stores a verify job's loss together with the loss of its class that was stored before. */
static int note_recomputed(struct mo_connection *writer, const struct mo_saved_block *block,
                           uint32_t i, bool *is_known)
{
  static const char sql[] =
      "INSERT OR IGNORE INTO recomputed(job,position,environment,diverged_step,loss,stored,"
      "checksum) SELECT ?1,?2,?3,?4,?5,?6,?7 FROM jobs WHERE id=?1 AND state<>6";
  const int64_t key[4] = {block->verify_job, block->design_position, block->places[i],
                          block->diverged_steps[i]};
  struct mo_score before;
  double values[2] = {block->losses[i], 0};
  const struct mo_saved_design design = mo_design_under(&block->condition, block->genotype, 0);
  const int error = mo_losses_read(writer, &design, &block->condition.environments[i], 1, &before);
  if (error != MO_OK)
    return error;
  *is_known = before.known;
  values[1] = before.loss;
  return mo_sql_do(writer, sql, mo_int(key[0]), mo_int(key[1]), mo_int(key[2]), mo_int(key[3]),
                   mo_blob(&values[0], 8), before.known ? mo_blob(&values[1], 8) : mo_null(),
                   mo_int((int64_t)mo_row_checksum(
                       key, 4, values, before.known ? sizeof(values) : sizeof(values[0]))));
}

int mo_losses_are_known(struct mo_connection *connection, const struct mo_condition *condition,
                        int64_t genotype, bool *are_known)
{
  const struct mo_saved_design design = mo_design_under(condition, genotype, 0);
  struct mo_score scores[MO_BLOCK_LANES];
  const int error =
      mo_losses_read(connection, &design, condition->environments, condition->n, scores);
  *are_known = true;
  for (uint32_t k = 0; k < condition->n; k++)
    *are_known = *are_known && scores[k].known;
  return error;
}

static int insert_block(struct mo_store *store, const struct mo_saved_block *block, int64_t now_us,
                        struct mo_condition *last)
{
  struct mo_condition condition = block->condition;
  bool all_known = block->verify_job != 0, is_known = false, is_new = false;
  int error = MO_OK;
  for (uint32_t i = 0; i < block->condition.n && block->verify_job != 0 && error == MO_OK; i++) {
    error = note_recomputed(&store->writer, block, i, &is_known);
    all_known = all_known && is_known;
  }
  if (error == MO_OK && block->measures != NULL &&
      block->verify_job == 0) /* it may have been computed only for its measures */
    error = mo_losses_are_known(&store->writer, &condition, block->genotype, &all_known);
  if (error != MO_OK || all_known)
    return error;
  error = mo_condition_row_after(&store->writer, &condition, last);
  return error == MO_OK ? mo_losses_insert(store, &condition, block->genotype, block->origin,
                                           block->losses, block->diverged_steps, now_us, &is_new)
                        : error;
}

int mo_blocks_insert(struct mo_store *store, const struct mo_saved_block *blocks, size_t n,
                     int64_t now_us)
{
  struct mo_condition last = {.n = 0};
  int error = MO_OK;
  for (size_t i = 0; i < n && error == MO_OK; i++)
    error = insert_block(store, &blocks[i], now_us, &last);
  return error;
}

/* ---- means over named sets ---- */

static uint64_t set_score_checksum(int64_t ranking, int64_t genotype, double mean)
{
  const int64_t key[] = {ranking, genotype};
  return mo_row_checksum(key, 2, &mean, sizeof(mean));
}

/* Finds or inserts the row of `rankings`. */
static int ranking_row(struct mo_connection *writer, const struct mo_saved_design *design,
                       int64_t *ranking)
{
  static const char insert_sql[] =
      "INSERT INTO rankings(controller,physics,fingerprint,environment_set) VALUES(?1,?2,?3,?4)";
  static const char find_sql[] = "SELECT id FROM rankings WHERE controller=?1 AND physics=?2 AND "
                                 "fingerprint=?3 AND environment_set=?4";
  const struct mo_values values =
      MO_VALUES(mo_int(design->controller), mo_int(design->physics), mo_int(design->fingerprint),
                mo_int(design->environment_set));
  const int error = mo_sql_find_with(writer, ranking, find_sql, values);
  return error == MO_ERR_NOT_FOUND ? mo_sql_insert_with(writer, ranking, insert_sql, values)
                                   : error;
}

static int write_mean(struct mo_connection *writer, const char *sql, int64_t ranking,
                      int64_t genotype, double mean)
{
  if (isnan(mean))
    return MO_ERR_CORRUPT;
  mean = mean == 0 ? 0 : mean; /* REAL has no −0 */
  return mo_sql_do(writer, sql, mo_int(ranking), mo_int(genotype), mo_real(mean),
                   mo_int((int64_t)set_score_checksum(ranking, genotype, mean)));
}

int mo_set_score_insert_mean(struct mo_connection *writer, const struct mo_saved_design *design,
                             double mean)
{
  static const char sql[] =
      "INSERT OR IGNORE INTO set_scores(ranking,genotype,score,checksum) VALUES(?1,?2,?3,?4)";
  int64_t ranking = 0;
  const int error = ranking_row(writer, design, &ranking);
  return error == MO_OK ? write_mean(writer, sql, ranking, design->genotype, mean) : error;
}

int mo_set_score_from_row(sqlite3_stmt *statement, int first, int64_t ranking, int64_t genotype,
                          double *mean)
{
  *mean = sqlite3_column_double(statement, first);
  return (uint64_t)sqlite3_column_int64(statement, first + 1) ==
                 set_score_checksum(ranking, genotype, *mean)
             ? MO_OK
             : MO_ERR_CORRUPT;
}

/* Computes a genotype's mean over a set. MO_ERR_NOT_FOUND: losses are missing. */
static int mean_of(struct mo_connection *writer, const struct mo_saved_design *design, double *mean)
{
  static const char set_sql[] = "SELECT environment FROM environment_set_members"
                                " WHERE environment_set=?1 ORDER BY position LIMIT ?2";
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  int64_t environments[MO_ENVIRONMENTS_MAX];
  uint32_t n = 0;
  double sum = 0;
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(writer, &error, set_sql, mo_int(design->environment_set),
                                  mo_int(MO_ENVIRONMENTS_MAX));
  while (mo_sql_next(writer, row, &error))
    environments[n++] = sqlite3_column_int64(row, 0);
  if (error == MO_OK)
    error = n > 0 ? mo_losses_read(writer, design, environments, n, scores) : MO_ERR_NOT_FOUND;
  for (uint32_t k = 0; k < n && error == MO_OK; k++) {
    error = scores[k].known ? MO_OK : MO_ERR_NOT_FOUND;
    sum += scores[k].loss;
  }
  *mean = sum / n;
  return error;
}

int mo_set_score_insert(struct mo_connection *writer, const struct mo_saved_design *design)
{
  static const char known_sql[] =
      "SELECT 1 FROM rankings r JOIN set_scores s ON s.ranking=r.id AND s.genotype=?5"
      " WHERE r.controller=?1 AND r.physics=?2 AND r.fingerprint=?3 AND r.environment_set=?4";
  int64_t known;
  double mean;
  int error = mo_sql_find(writer, &known, known_sql, mo_int(design->controller),
                          mo_int(design->physics), mo_int(design->fingerprint),
                          mo_int(design->environment_set), mo_int(design->genotype));
  if (error != MO_ERR_NOT_FOUND)
    return error;
  error = mean_of(writer, design, &mean);
  if (error == MO_OK)
    error = mo_set_score_insert_mean(writer, design, mean);
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

int mo_set_score_replace(struct mo_connection *writer, const struct mo_saved_design *design,
                         int64_t ranking)
{
  static const char sql[] =
      "UPDATE set_scores SET score=?3,checksum=?4 WHERE ranking=?1 AND genotype=?2";
  double mean;
  const int error = mean_of(writer, design, &mean);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_OK : error;
  return write_mean(writer, sql, ranking, design->genotype, mean);
}
