/* campaign_losses.c: losses of a campaign: losses of the current generation, saved as they arrive,
 * and losses stored earlier as scores. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "store/campaign_rows.h"
#include "store/contents.h"
#include "store/measures.h"
#include "store/scores.h"

/* ---- losses of the current generation ---- */

struct losses_arguments {
  int64_t id;
  uint32_t generation;
  const struct mo_campaign_loss *losses;
  size_t n;
  const char *event_data;
};

/* Flags in the word of the step, as in struct mo_campaign_loss. Steps are smaller. */
#define BY_WORKERS (UINT32_C(1) << 31)
#define STORED     (UINT32_C(1) << 30)
_Static_assert(MO_STEPS_MAX < STORED, "a step does not reach the flags");

int mo_campaign_losses_drop(struct mo_connection *writer, int64_t id)
{
  static const char sql[] = "DELETE FROM campaign_losses WHERE job=?1";
  return mo_sql_do(writer, sql, mo_int(id));
}

/* Writes the words that a row's checksum covers in addition to the losses. Returns their number:
 * origins are stored only if this host did not compute everything. */
#define KEY_WORDS          (2 + MO_ENVIRONMENTS_MAX)
#define MEASURES_KEY_WORDS 2 /* words that the checksum of measures covers: job and place */
static size_t key_of(int64_t id, const struct mo_campaign_loss *loss, int64_t key[KEY_WORDS])
{
  bool is_remote = false;
  key[0] = id;
  key[1] = loss->place;
  for (size_t k = 0; k < KEY_WORDS - 2; k++) {
    key[2 + k] = loss->origins[k];
    is_remote = is_remote || loss->origins[k] != 0;
  }
  return is_remote ? KEY_WORDS : 2;
}

static int save_loss(struct mo_connection *writer, int64_t id, const struct mo_campaign_loss *loss,
                     uint32_t n, int64_t *added)
{
  static const char sql[] =
      "INSERT OR IGNORE INTO campaign_losses(job,place,losses,origins,measures)"
      " VALUES(?1,?2,?3,?4,?5)";
  int64_t key[KEY_WORDS];
  uint8_t bytes[MO_PACKED_BYTES(MO_ENVIRONMENTS_MAX)];
  uint8_t measures[MO_PACKED_MEASURES_BYTES(MO_ENVIRONMENTS_MAX)];
  uint32_t steps[MO_ENVIRONMENTS_MAX];
  size_t measures_size = 0;
  for (uint32_t k = 0; k < n; k++)
    steps[k] = (uint32_t)loss->diverged_steps[k] | (loss->by_workers >> k & 1 ? BY_WORKERS : 0) |
               (loss->stored >> k & 1 ? STORED : 0);
  const size_t n_key = key_of(id, loss, key);
  const size_t size = mo_pack_losses(key, n_key, loss->losses, steps, n, bytes);
  if (loss->measures != NULL)
    measures_size = mo_pack_measures(key, MEASURES_KEY_WORDS,
                                     (const double(*)[MO_MEASURES])loss->measures, n, measures);
  int error = mo_sql_change(writer, sql, mo_int(id), mo_int(loss->place), mo_blob(bytes, size),
                            n_key > 2 ? mo_blob(loss->origins, sizeof(loss->origins)) : mo_null(),
                            measures_size > 0 ? mo_blob(measures, measures_size) : mo_null());
  *added += error == MO_OK;
  return error == MO_ERR_CONFLICT ? MO_OK : error; /* they are already saved */
}

static int save_losses(struct mo_store *store, void *arguments)
{
  static const char sql[] = "UPDATE campaigns SET scored_generation=?2,scored=?3 WHERE job=?1";
  const struct losses_arguments *call = arguments;
  struct mo_connection *writer = &store->writer;
  struct mo_campaign_head head = {0};
  int64_t scored = 0;
  int error = mo_run_touch(store, call->id);
  if (error == MO_OK)
    error = mo_campaign_head_get(writer, call->id, &head);
  if (error == MO_OK && head.generation + 1 != call->generation)
    error = MO_ERR_CONFLICT;
  if (error == MO_OK && head.scored_generation != call->generation)
    error = mo_campaign_losses_drop(writer, call->id);
  else if (error == MO_OK)
    scored = head.scored;
  for (size_t i = 0; i < call->n && error == MO_OK; i++)
    error = save_loss(writer, call->id, &call->losses[i], head.n_environments, &scored);
  if (error == MO_OK)
    error = mo_sql_do(writer, sql, mo_int(call->id), mo_int(call->generation), mo_int(scored));
  if (error == MO_OK && call->event_data != NULL)
    error = mo_writer_event(store, call->id, "campaign.progress", "%s", call->event_data);
  return error;
}

int mo_store_campaign_save_losses(struct mo_store *store, int64_t id, uint32_t generation,
                                  const struct mo_campaign_loss *losses, size_t n,
                                  const char *event_data)
{
  struct losses_arguments call = {id, generation, losses, n, event_data};
  return mo_write(store, save_losses, &call);
}

/* loss->measures: NULL: the campaign names none. */
static int loss_from_row(sqlite3_stmt *row, int64_t id, uint32_t n, struct mo_campaign_loss *loss)
{
  int64_t key[KEY_WORDS];
  uint32_t steps[MO_ENVIRONMENTS_MAX], n_measures = 0;
  loss->place = (uint32_t)sqlite3_column_int64(row, 0);
  if (sqlite3_column_bytes(row, 2) == sizeof(loss->origins))
    memcpy(loss->origins, sqlite3_column_blob(row, 2), sizeof(loss->origins));
  int error = mo_unpack_losses(key, key_of(id, loss, key), sqlite3_column_blob(row, 1),
                               (size_t)sqlite3_column_bytes(row, 1), n, loss->losses, steps);
  loss->by_workers = loss->stored = 0;
  for (uint32_t k = 0; k < n && error == MO_OK; k++) {
    loss->diverged_steps[k] = (int32_t)(steps[k] & ~(BY_WORKERS | STORED));
    loss->by_workers |= (uint64_t)((steps[k] & BY_WORKERS) != 0) << k;
    loss->stored |= (uint64_t)((steps[k] & STORED) != 0) << k;
  }
  return error == MO_OK && loss->measures != NULL
             ? mo_unpack_measures(key, MEASURES_KEY_WORDS, sqlite3_column_blob(row, 3),
                                  (size_t)sqlite3_column_bytes(row, 3), n, loss->measures,
                                  &n_measures)
             : error;
}

int mo_store_campaign_losses(struct mo_store *store, int64_t id, uint32_t generation,
                             struct mo_campaign_loss **ret, size_t *ret_n)
{
  static const char sql[] =
      "SELECT place,losses,origins,measures FROM campaign_losses WHERE job=?1 ORDER BY place";
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_head head = {0};
  int error = mo_campaign_head_get(reader, id, &head);
  const bool is_current = head.scored_generation == generation && head.generation + 1 == generation;
  const size_t most = is_current ? (size_t)head.scored : 0;
  const size_t measured = head.measures != 0 ? head.n_environments : 0; /* rows of each */
  struct mo_campaign_loss *losses =
      calloc(most + 1, sizeof(*losses) + measured * sizeof(*losses->measures));
  size_t n = 0;
  if (error == MO_OK && losses == NULL)
    error = MO_ERR_NO_MEMORY;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_int(id));
  while (losses != NULL && n < most && mo_sql_next(reader, row, &error)) {
    if (measured > 0)
      losses[n].measures = (double(*)[MO_MEASURES])(losses + most + 1) + n * measured;
    error = loss_from_row(row, id, head.n_environments, &losses[n++]);
  }
  if (error != MO_OK || n != most) {
    free(losses);
    return error != MO_OK ? error : MO_ERR_CORRUPT;
  }
  *ret = losses;
  *ret_n = n;
  return MO_OK;
}

/* ---- losses stored as scores ---- */

/* Returns 1 if a loss of a genotype in n environments is known. */
static int find_known(struct mo_connection *reader, const struct mo_campaign_head *head,
                      struct mo_saved_design *design, const int64_t *environments,
                      const struct mo_bits *genotype, struct mo_campaign_loss *loss)
{
  static const char find_sql[] = "SELECT id FROM genotypes WHERE bits=?1";
  const uint32_t n = head->n_environments;
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  uint8_t bits[MO_BITS_BYTES];
  uint64_t measured = UINT64_MAX;
  mo_encode_genotype(genotype->words, bits);
  int error = mo_sql_find(reader, &design->genotype, find_sql, mo_blob(bits, sizeof(bits)));
  if (error == MO_OK)
    error = mo_losses_read(reader, design, environments, n, scores);
  if (error == MO_OK && loss->measures != NULL)
    error = mo_measures_read(reader, design, environments, n, head->measures, loss->measures,
                             &measured);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? 0 : error;
  loss->by_workers = loss->stored = 0;
  for (uint32_t k = 0; k < n; k++) {
    const bool known = scores[k].known && (measured >> k & 1) != 0;
    loss->losses[k] = known ? scores[k].loss : (double)NAN;
    loss->diverged_steps[k] = known ? scores[k].diverged_step : 0;
    loss->stored |= (uint64_t)known << k;
  }
  return loss->stored != 0;
}

int64_t mo_store_campaign_known(struct mo_store *store, int64_t id, int64_t fingerprint,
                                int64_t workers, const struct mo_bits *genotypes, uint32_t n,
                                struct mo_campaign_loss *losses)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_campaign_head head = {0};
  struct mo_saved_design design = {.fingerprint = fingerprint, .workers = workers};
  int64_t environments[MO_ENVIRONMENTS_MAX], n_known = 0;
  int error = mo_campaign_head_get(reader, id, &head);
  if (error == MO_OK)
    error = mo_environments_read(reader, head.group, head.n_environments, NULL, environments);
  if (error != MO_OK || mo_modes[head.mode].learns || head.controller == 0)
    n = 0;
  design.controller = head.controller;
  design.physics = head.physics;
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    const int known =
        find_known(reader, &head, &design, environments, &genotypes[i], &losses[n_known]);
    if (known < 0)
      error = known;
    else if (known > 0)
      losses[n_known++].place = i;
  }
  return error != MO_OK ? error : n_known;
}
