/* campaign_losses.c: losses of a campaign: those of the current generation, saved as they come, and
 * those stored earlier as scores. */
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"

/* ---- losses of the current generation ---- */

struct losses_arguments {
  int64_t id;
  uint32_t generation;
  const struct mo_campaign_loss *losses;
  size_t n;
  const char *event_data;
};

/* A bit in the column `diverged`, beside the step: workers computed this loss of a campaign that
 * devices compute. */
#define BY_WORKERS (UINT32_C(1) << 31)

int mo_campaign_losses_drop(struct mo_connection *writer, int64_t id)
{
  static const char sql[] = "DELETE FROM campaign_losses WHERE job=?1";
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  return mo_sql_run(writer, statement);
}

static int save_loss(struct mo_connection *writer, int64_t id, const struct mo_campaign_loss *loss,
                     uint32_t n, int64_t *added)
{
  static const char sql[] =
      "INSERT OR IGNORE INTO campaign_losses(job,place,losses,diverged) VALUES(?1,?2,?3,?4)";
  uint8_t losses[8 * MO_ENVIRONMENTS_MAX], diverged[4 * MO_ENVIRONMENTS_MAX];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  mo_encode_doubles(loss->losses, n, losses);
  for (uint32_t k = 0; k < n; k++)
    mo_encode_u32((uint32_t)loss->diverged_steps[k] | (loss->by_workers >> k & 1 ? BY_WORKERS : 0),
                  diverged + (size_t)4 * k);
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, loss->place);
  sqlite3_bind_blob(statement, 3, losses, (int)(8 * n), SQLITE_STATIC);
  sqlite3_bind_blob(statement, 4, diverged, (int)(4 * n), SQLITE_STATIC);
  error = mo_sql_run(writer, statement);
  (void)sqlite3_clear_bindings(statement);
  *added += error == MO_OK && sqlite3_changes(writer->db) > 0;
  return error;
}

static int save_losses(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE campaigns SET scored_generation=?2,scored=?3 WHERE job=?1";
  const struct losses_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  struct mo_campaign_head head = {0};
  sqlite3_stmt *statement;
  int64_t scored = 0;
  int error = mo_run_touch(store, call->id, MO_JOB_CAMPAIGN);
  if (error == MO_OK)
    error = mo_campaign_head_get(writer, call->id, &head);
  if (error == MO_OK && head.generation + 1 != call->generation)
    error = MO_ERR_CONFLICT;
  if (error == MO_OK && head.scored_generation != call->generation)
    error = mo_campaign_losses_drop(writer, call->id);
  else if (error == MO_OK)
    scored = head.scored;
  for (size_t i = 0; i < call->n && error == MO_OK; i++)
    error = call->losses[i].place >= 2 * head.population
                ? MO_ERR_RANGE
                : save_loss(writer, call->id, &call->losses[i], head.n_environments, &scored);
  statement = error == MO_OK ? mo_sql(writer, sql, &error) : NULL;
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, call->id);
  sqlite3_bind_int64(statement, 2, call->generation);
  sqlite3_bind_int64(statement, 3, scored);
  error = mo_sql_run(writer, statement);
  if (error == MO_OK && call->event_data != NULL)
    error = mo_writer_event(store, call->id, "campaign.progress", call->event_data);
  return error;
}

int mo_store_campaign_save_losses(struct mo_store *store, int64_t id, uint32_t generation,
                                  const struct mo_campaign_loss *losses, size_t n,
                                  const char *event_data)
{
  struct losses_arguments call = {id, generation, losses, n, event_data};
  return mo_write(store, save_losses, &call);
}

static int loss_from_row(sqlite3_stmt *row, uint32_t n, struct mo_campaign_loss *loss)
{
  const void *losses = sqlite3_column_blob(row, 1), *diverged = sqlite3_column_blob(row, 2);
  if (losses == NULL || diverged == NULL || sqlite3_column_bytes(row, 1) != (int)(8 * n) ||
      sqlite3_column_bytes(row, 2) != (int)(4 * n))
    return MO_ERR_CORRUPT;
  loss->place = (uint32_t)sqlite3_column_int64(row, 0);
  mo_decode_doubles(losses, n, loss->losses);
  loss->by_workers = 0;
  for (uint32_t k = 0; k < n; k++) {
    const uint32_t step = mo_decode_u32((const uint8_t *)diverged + (size_t)4 * k);
    loss->diverged_steps[k] = (int32_t)(step & ~BY_WORKERS);
    loss->by_workers |= (uint64_t)(step >> 31) << k;
  }
  return MO_OK;
}

static int load_losses(struct mo_connection *reader, int64_t id, uint32_t generation,
                       struct mo_campaign_loss **losses, size_t *n)
{
  static const char sql[] =
      "SELECT place,losses,diverged FROM campaign_losses WHERE job=?1 ORDER BY place";
  struct mo_campaign_head head = {0};
  sqlite3_stmt *statement;
  int64_t most;
  int step = 0;
  int error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = mo_campaign_head_get(reader, id, &head);
  if (error != MO_OK)
    return error;
  most =
      head.scored_generation == generation && head.generation + 1 == generation ? head.scored : 0;
  *losses = calloc((size_t)most + 1, sizeof(**losses));
  if (*losses == NULL)
    return MO_ERR_NO_MEMORY;
  if (most == 0)
    return MO_OK;
  statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, id);
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0)
    error = (int64_t)*n == most ? MO_ERR_CORRUPT
                                : loss_from_row(statement, head.n_environments, &(*losses)[(*n)++]);
  if (step < 0)
    return step;
  return error == MO_OK && (int64_t)*n != most ? MO_ERR_CORRUPT : error;
}

int mo_store_campaign_losses(struct mo_store *store, int64_t id, uint32_t generation,
                             struct mo_campaign_loss **ret, size_t *ret_n)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_loss *losses = NULL;
  size_t n = 0;
  int error = load_losses(reader, id, generation, &losses, &n);
  mo_reader_release(store, reader);
  if (error != MO_OK) {
    free(losses);
    return error;
  }
  *ret = losses;
  *ret_n = n;
  return MO_OK;
}

/* ---- losses that are stored as scores ---- */

struct known_keys {
  struct mo_campaign_head head;
  int64_t fingerprint, environments[MO_ENVIRONMENTS_MAX], lowest, highest;
};

/* Returns 1 if all losses of a genotype are known. */
static int find_known(struct mo_connection *reader, const struct known_keys *keys,
                      const struct mo_bits *genotype, struct mo_campaign_loss *loss)
{
  static const char find_sql[] = "SELECT id FROM genotypes WHERE bits=?1";
  static const char sql[] =
      "SELECT environment,loss,diverged_step FROM scores WHERE genotype=?1 AND controller=?2"
      " AND physics=?3 AND environment BETWEEN ?4 AND ?5 AND fingerprint=?6";
  uint8_t bits[MO_BITS_BYTES];
  uint64_t found = 0;
  int64_t row = 0;
  int step = 0;
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(reader, find_sql, &error);
  if (statement == NULL)
    return error;
  mo_encode_bits(genotype, bits);
  sqlite3_bind_blob(statement, 1, bits, sizeof(bits), SQLITE_STATIC);
  error = mo_sql_integer(reader, statement, &row);
  (void)sqlite3_clear_bindings(statement);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? 0 : error;
  statement = mo_sql(reader, sql, &error);
  if (statement == NULL)
    return error;
  sqlite3_bind_int64(statement, 1, row);
  sqlite3_bind_int64(statement, 2, keys->head.controller);
  sqlite3_bind_int64(statement, 3, keys->head.physics);
  sqlite3_bind_int64(statement, 4, keys->lowest);
  sqlite3_bind_int64(statement, 5, keys->highest);
  sqlite3_bind_int64(statement, 6, keys->fingerprint);
  loss->by_workers = 0;
  while (error == MO_OK && (step = mo_sql_step(reader, statement)) > 0) {
    int64_t environment = sqlite3_column_int64(statement, 0);
    for (uint32_t k = 0; k < keys->head.n_environments && error == MO_OK; k++)
      if (keys->environments[k] == environment) {
        error = mo_column_double(statement, 1, &loss->losses[k]);
        loss->diverged_steps[k] = sqlite3_column_int(statement, 2);
        found |= UINT64_C(1) << k;
      }
  }
  (void)sqlite3_reset(statement);
  if (error != MO_OK || step < 0)
    return error != MO_OK ? error : step;
  return (uint32_t)__builtin_popcountll(found) == keys->head.n_environments;
}

static int load_keys(struct mo_connection *reader, int64_t id, struct known_keys *keys)
{
  int error = mo_campaign_head_get(reader, id, &keys->head);
  if (error == MO_OK)
    error = mo_campaign_environment_rows(reader, keys->head.group, keys->environments,
                                         keys->head.n_environments);
  keys->lowest = INT64_MAX;
  keys->highest = INT64_MIN;
  for (uint32_t k = 0; k < keys->head.n_environments && error == MO_OK; k++) {
    if (keys->environments[k] < keys->lowest)
      keys->lowest = keys->environments[k];
    if (keys->environments[k] > keys->highest)
      keys->highest = keys->environments[k];
  }
  return error;
}

int64_t mo_store_campaign_known(struct mo_store *store, int64_t id, int64_t fingerprint,
                                const struct mo_bits *genotypes, uint32_t n,
                                struct mo_campaign_loss *losses)
{
  struct mo_connection *reader = mo_reader_acquire(store);
  struct known_keys keys = {.fingerprint = fingerprint};
  int64_t n_known = 0;
  int error = mo_sql_exec(reader, "BEGIN");
  if (error == MO_OK)
    error = load_keys(reader, id, &keys);
  for (uint32_t i = 0;
       i < n && error == MO_OK && keys.head.mode == MO_ZERO_SHOT && keys.head.controller != 0;
       i++) {
    int known = find_known(reader, &keys, &genotypes[i], &losses[n_known]);
    if (known < 0)
      error = known;
    else if (known > 0)
      losses[n_known++].place = i;
  }
  mo_reader_release(store, reader);
  return error != MO_OK ? error : n_known;
}
