/* campaign_losses.c: losses of a campaign: those of the current generation, saved as they come, and
 * those stored earlier as scores. */
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"
#include "store/scores.h"

/* ---- losses of the current generation ---- */

struct losses_arguments {
  int64_t id;
  uint32_t generation;
  const struct mo_campaign_loss *losses;
  size_t n;
  const char *event_data;
};

/* A bit beside the step: workers computed this loss of a campaign that devices compute. */
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
      "INSERT OR IGNORE INTO campaign_losses(job,place,losses) VALUES(?1,?2,?3)";
  const int64_t key[] = {id, loss->place};
  uint8_t bytes[MO_PACKED_BYTES(MO_ENVIRONMENTS_MAX)];
  uint32_t steps[MO_ENVIRONMENTS_MAX];
  int error = MO_OK;
  sqlite3_stmt *statement = mo_sql(writer, sql, &error);
  if (statement == NULL)
    return error;
  for (uint32_t k = 0; k < n; k++)
    steps[k] = (uint32_t)loss->diverged_steps[k] | (loss->by_workers >> k & 1 ? BY_WORKERS : 0);
  sqlite3_bind_int64(statement, 1, id);
  sqlite3_bind_int64(statement, 2, loss->place);
  sqlite3_bind_blob(statement, 3, bytes, (int)mo_pack_losses(key, 2, loss->losses, steps, n, bytes),
                    SQLITE_STATIC);
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

static int loss_from_row(sqlite3_stmt *row, int64_t id, uint32_t n, struct mo_campaign_loss *loss)
{
  const int64_t key[] = {id, sqlite3_column_int64(row, 0)};
  uint32_t steps[MO_ENVIRONMENTS_MAX];
  int error = mo_unpack_losses(key, 2, sqlite3_column_blob(row, 1),
                               (size_t)sqlite3_column_bytes(row, 1), n, loss->losses, steps);
  loss->place = (uint32_t)key[1];
  loss->by_workers = 0;
  for (uint32_t k = 0; k < n && error == MO_OK; k++) {
    loss->diverged_steps[k] = (int32_t)(steps[k] & ~BY_WORKERS);
    loss->by_workers |= (uint64_t)(steps[k] >> 31) << k;
  }
  return error;
}

static int load_losses(struct mo_connection *reader, int64_t id, uint32_t generation,
                       struct mo_campaign_loss **losses, size_t *n)
{
  static const char sql[] = "SELECT place,losses FROM campaign_losses WHERE job=?1 ORDER BY place";
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
    error = (int64_t)*n == most
                ? MO_ERR_CORRUPT
                : loss_from_row(statement, id, head.n_environments, &(*losses)[(*n)++]);
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
  int64_t fingerprint, environments[MO_ENVIRONMENTS_MAX];
};

/* Returns 1 if all losses of a genotype are known. */
static int find_known(struct mo_connection *reader, const struct known_keys *keys,
                      const struct mo_bits *genotype, struct mo_campaign_loss *loss)
{
  static const char find_sql[] = "SELECT id FROM genotypes WHERE bits=?1";
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  const uint32_t n = keys->head.n_environments;
  uint8_t bits[MO_BITS_BYTES];
  int64_t row = 0;
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
  error = mo_losses_read(reader, row, keys->head.controller, keys->head.physics, keys->fingerprint,
                         0, keys->environments, n, scores);
  loss->by_workers = 0;
  for (uint32_t k = 0; k < n && error == MO_OK; k++) {
    if (!scores[k].known)
      return 0;
    loss->losses[k] = scores[k].loss;
    loss->diverged_steps[k] = scores[k].diverged_step;
  }
  return error == MO_OK ? 1 : error;
}

static int load_keys(struct mo_connection *reader, int64_t id, struct known_keys *keys)
{
  int error = mo_campaign_head_get(reader, id, &keys->head);
  return error == MO_OK ? mo_campaign_environment_rows(reader, keys->head.group, keys->environments,
                                                       keys->head.n_environments)
                        : error;
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
