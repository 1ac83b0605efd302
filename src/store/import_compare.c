/* import_compare.c: see import_compare.h. Rows have different numbers in the source of a bundle, so
 * each row is looked up by its content. */
#include "store/import_compare.h"

#include <stdlib.h>
#include <string.h>

#include "store/evaluations.h"
#include "store/import_state.h"
#include "store/measures.h"
#include "store/scores.h"
#include "store/store.h"

/* Turns a row that was not found into row 0. */
static int absent(int error, int64_t *row)
{
  if (error != MO_ERR_NOT_FOUND)
    return error;
  *row = 0;
  return MO_OK;
}

int mo_compare_campaign(struct mo_store *store, struct mo_import_comparison *rows,
                        const struct mo_imported_campaign *campaign)
{
  static const char controller_sql[] = "SELECT id FROM controllers WHERE sha256=?1";
  static const char physics_sql[] = "SELECT id FROM physics WHERE sha256=?1";
  static const char environment_sql[] = "SELECT id FROM environments WHERE sha256=?1";
  const struct mo_campaign_settings *settings = &campaign->record.settings;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  struct mo_sha256 hash;
  int error = MO_OK;
  rows->controller = rows->physics = 0;
  rows->fingerprint[0] = '\0';
  rows->class = 0;
  rows->n = 0;
  if (campaign->has_controller)
    error = absent(mo_sql_find(reader, &rows->controller, controller_sql,
                               mo_hash(&campaign->controller_sha256)),
                   &rows->controller);
  mo_physics_hash(&settings->physics, MO_FLOAT32, settings->sensor, &hash);
  if (error == MO_OK)
    error =
        absent(mo_sql_find(reader, &rows->physics, physics_sql, mo_hash(&hash)), &rows->physics);
  for (uint32_t k = 0; k < campaign->record.n_environments && error == MO_OK; k++) {
    mo_environment_hash(&campaign->environments[k], &hash);
    error = absent(mo_sql_find(reader, &rows->environments[k], environment_sql, mo_hash(&hash)),
                   &rows->environments[k]);
  }
  return error;
}

/* Returns whether scores of the campaign can be stored. */
static bool may_have_scores(const struct mo_import_comparison *rows)
{
  return rows->controller != 0 && rows->physics != 0;
}

int mo_compare_design(struct mo_store *store, struct mo_import_comparison *rows,
                      const struct mo_campaign_design *design)
{
  static const char sql[] = "SELECT id FROM genotypes WHERE bits=?1";
  uint8_t bits[MO_BITS_BYTES];
  if (!may_have_scores(rows))
    return MO_OK;
  if (rows->n == rows->room) {
    const uint32_t room = 2 * rows->room + 4096;
    int64_t *grown = realloc(rows->genotypes, room * sizeof(*grown));
    if (grown == NULL)
      return MO_ERR_NO_MEMORY;
    rows->genotypes = grown;
    rows->room = room;
  }
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  mo_encode_genotype(design->genotype.words, bits);
  int64_t *row = &rows->genotypes[rows->n++];
  return absent(mo_sql_find(reader, row, sql, mo_blob(bits, sizeof(bits))), row);
}

int mo_compare_score(struct mo_store *store, struct mo_import_comparison *rows,
                     const struct mo_campaign_score *score)
{
  static const char sql[] = "SELECT id FROM fingerprints WHERE text=?1";
  struct mo_score stored[MO_BLOCK_LANES];
  if (!may_have_scores(rows) || rows->genotypes[score->number] == 0)
    return MO_OK;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  if (strcmp(rows->fingerprint, score->fingerprint) != 0) {
    const int error =
        absent(mo_sql_find(reader, &rows->class, sql, mo_string(score->fingerprint)), &rows->class);
    if (error != MO_OK)
      return error;
    memcpy(rows->fingerprint, score->fingerprint, sizeof(rows->fingerprint));
  }
  struct mo_condition condition = {.controller = rows->controller,
                                   .physics = rows->physics,
                                   .fingerprint = rows->class,
                                   .n = score->n};
  for (uint32_t k = 0; k < score->n; k++)
    condition.environments[k] = rows->environments[score->environments[k]];
  if (rows->class == 0)
    return MO_OK;
  const struct mo_saved_design design =
      mo_design_under(&condition, rows->genotypes[score->number], 0);
  uint64_t known;
  const int error = mo_losses_compare(reader, &condition, design.genotype, score->losses,
                                      score->diverged_steps, stored);
  return error == MO_OK && score->measures != NULL
             ? mo_measures_compare(reader, &design, condition.environments, condition.n,
                                   (const double(*)[MO_MEASURES])score->measures, &known)
             : error;
}

int mo_compare_evaluation(struct mo_store *store, struct mo_import_comparison *rows,
                          const struct mo_imported_evaluation *evaluation)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  const int error = mo_source_evaluation(reader, mo_store_id(store), evaluation, &rows->evaluation);
  return error == MO_OK ? 1 : error == MO_ERR_NOT_FOUND ? 0 : error;
}

static bool same_recording(const struct mo_trajectory *stored,
                           const struct mo_saved_trajectory *rollout)
{
  const struct mo_recording *own = &rollout->recording;
  bool same = stored->n_frames == rollout->frames && stored->n_masses == rollout->n_masses &&
              (stored->n_springs == 0 || stored->n_springs == rollout->n_springs);
  for (unsigned channel = 1; channel < 1U << MO_CHANNELS && same; channel <<= 1) {
    const void *a = mo_recording_array(&stored->recording, (enum mo_channel)channel);
    const void *b = mo_recording_array(own, (enum mo_channel)channel);
    const size_t bytes =
        mo_recording_frame_bytes(channel, rollout->n_masses, rollout->n_springs) * rollout->frames;
    same = (a == NULL) == (b == NULL) && (a == NULL || memcmp(a, b, bytes) == 0);
  }
  return same;
}

int mo_compare_rollout(struct mo_store *store, const struct mo_import_comparison *rows,
                       const struct mo_saved_trajectory *rollout)
{
  struct mo_trajectory *stored = NULL;
  int error = mo_store_trajectory(store, rows->evaluation, rollout->design_position,
                                  rollout->environment_position, &stored);
  if (error == MO_ERR_NOT_FOUND)
    return MO_OK; /* its recordings were deleted */
  if (error == MO_OK && !same_recording(stored, rollout))
    error = MO_ERR_CONFLICT;
  mo_trajectory_free(stored);
  return error;
}

void mo_compare_end(struct mo_import_comparison *rows)
{
  free(rows->genotypes);
}
