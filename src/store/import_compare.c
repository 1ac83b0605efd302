/* import_compare.c: see import_compare.h. Rows have different numbers in the source of a bundle, so
 * each row is looked up by its content. */
#include "store/import_compare.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/evaluations.h"
#include "store/import_state.h"
#include "store/measures.h"
#include "store/scores.h"
#include "store/store.h"

#define CLASSES_MAX 1000 /* of the scores of a campaign */

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
  rows->n_scores = 0;
  rows->n_classes = 0;
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

/* Returns the place of a class in the bundle's list; n_classes if it is not there. */
static uint32_t find_class(const struct mo_import_comparison *rows, const char *fingerprint)
{
  uint32_t i = rows->n_classes; /* most lines have the same class as the previous one */
  while (i > 0 && strcmp(rows->classes[i - 1], fingerprint) != 0)
    i--;
  return i > 0 ? i - 1 : rows->n_classes;
}

static int add_class(struct mo_import_comparison *rows, const char *fingerprint)
{
  if (rows->n_classes == CLASSES_MAX)
    return MO_ERR_LIMIT;
  if (rows->n_classes == rows->classes_room) {
    const uint32_t room = 2 * rows->classes_room + 4;
    char(*grown)[MO_FINGERPRINT_BYTES] = realloc(rows->classes, room * sizeof(*grown));
    if (grown == NULL)
      return MO_ERR_NO_MEMORY;
    rows->classes = grown;
    rows->classes_room = room;
  }
  snprintf(rows->classes[rows->n_classes++], MO_FINGERPRINT_BYTES, "%s", fingerprint);
  return MO_OK;
}

static int note_score(struct mo_import_comparison *rows, const struct mo_campaign_score *score)
{
  const uint32_t class = find_class(rows, score->fingerprint);
  const int error = class == rows->n_classes ? add_class(rows, score->fingerprint) : MO_OK;
  if (error != MO_OK)
    return error;
  if (rows->n_scores == rows->scores_room) {
    const size_t room = 2 * rows->scores_room + 4096;
    struct mo_compared_score *grown = realloc(rows->scores, room * sizeof(*grown));
    if (grown == NULL)
      return MO_ERR_NO_MEMORY;
    rows->scores = grown;
    rows->scores_room = room;
  }
  struct mo_compared_score *noted = &rows->scores[rows->n_scores++];
  *noted = (struct mo_compared_score){.number = score->number, .class = class};
  for (uint32_t k = 0; k < score->n; k++)
    noted->environments |= UINT64_C(1) << score->environments[k];
  return MO_OK;
}

int mo_compare_score(struct mo_store *store, struct mo_import_comparison *rows,
                     const struct mo_campaign_score *score)
{
  static const char sql[] = "SELECT id FROM fingerprints WHERE text=?1";
  struct mo_score stored[MO_BLOCK_LANES];
  const int noted = note_score(rows, score);
  if (noted != MO_OK || !may_have_scores(rows) || rows->genotypes[score->number] == 0)
    return noted;
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
  const int error =
      mo_source_evaluation(reader, mo_store_id(store), false, evaluation, &rows->evaluation);
  return error == MO_OK ? 1 : error == MO_ERR_NOT_FOUND ? 0 : error;
}

/* Returns the environments in which the bundle has losses of a design, of either class. */
static uint64_t environments_of(const struct mo_import_comparison *rows, uint32_t number,
                                uint32_t class, uint32_t other)
{
  size_t first = 0, end = rows->n_scores;
  uint64_t found = 0;
  while (first < end) {
    const size_t middle = first + (end - first) / 2;
    if (rows->scores[middle].number < number)
      first = middle + 1;
    else
      end = middle;
  }
  for (; first < rows->n_scores && rows->scores[first].number == number; first++)
    if (rows->scores[first].class == class || rows->scores[first].class == other)
      found |= rows->scores[first].environments;
  return found;
}

/* Finds the classes of an evaluation; 0: not stored. */
static int find_stored_classes(struct mo_connection *reader,
                               const struct mo_imported_evaluation *evaluation,
                               struct mo_saved_design *design)
{
  static const char sql[] = "SELECT id FROM fingerprints WHERE text=?1";
  const int error =
      absent(mo_sql_find(reader, &design->fingerprint, sql, mo_string(evaluation->fingerprint)),
             &design->fingerprint);
  return error == MO_OK
             ? absent(mo_sql_find(reader, &design->workers, sql, mo_string(evaluation->workers)),
                      &design->workers)
             : error;
}

int mo_compare_losses(struct mo_store *store, const struct mo_import_comparison *rows,
                      const struct mo_imported_evaluation *evaluation)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  const uint32_t class = find_class(rows, evaluation->fingerprint),
                 other = find_class(rows, evaluation->workers), n = evaluation->n_environments;
  struct mo_saved_design design = {.controller = rows->controller, .physics = rows->physics};
  struct mo_score stored[MO_ENVIRONMENTS_MAX];
  int64_t environments[MO_ENVIRONMENTS_MAX];
  uint64_t needed = 0;
  int error = find_stored_classes(reader, evaluation, &design);
  for (uint32_t k = 0; k < n; k++) {
    needed |= UINT64_C(1) << evaluation->environments[k];
    environments[k] = rows->environments[evaluation->environments[k]];
  }
  for (uint32_t i = 0; i < evaluation->n_designs && error == MO_OK; i++) {
    const uint32_t number = evaluation->numbers[i];
    const uint64_t known = environments_of(rows, number, class, other);
    if ((needed & ~known) == 0)
      continue;
    design.genotype = number < rows->n ? rows->genotypes[number] : 0;
    error = mo_losses_read(reader, &design, environments, n, stored);
    for (uint32_t k = 0; k < n && error == MO_OK; k++)
      if (!stored[k].known && (known >> evaluation->environments[k] & 1) == 0)
        error = MO_ERR_NOT_FOUND;
  }
  return error;
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
  free(rows->scores);
  free(rows->classes);
}
