/* orientations.c: resolves an id without an orientation to the scored orientation with the best
 * score. */
#include <math.h>
#include <string.h>

#include "base/words.h"
#include "store/contents.h"
#include "store/controller_rows.h"
#include "store/designs.h"
#include "store/scores.h"

/* The rows of the conditions in struct mo_orienting. */
struct scored_under {
  struct mo_saved_design design; /* except its genotype */
  int64_t environments[MO_SUITE_ENVIRONMENTS_MAX];
  uint32_t n;
  struct mo_workspace workspace;
};

/* Adds the environments of a set. */
static int add_set(struct mo_connection *reader, const char *set, struct scored_under *found)
{
  static const char sql[] =
      "SELECT m.environment FROM environment_sets s JOIN environment_set_members m"
      " ON m.environment_set=s.id WHERE s.name=?1 ORDER BY m.position LIMIT ?2";
  const uint32_t before = found->n;
  int error = MO_OK;
  sqlite3_stmt *row = mo_sql_rows(reader, &error, sql, mo_string(set), mo_int(MO_ENVIRONMENTS_MAX));
  while (mo_sql_next(reader, row, &error))
    found->environments[found->n++] = sqlite3_column_int64(row, 0);
  return error == MO_OK && found->n == before ? MO_ERR_NOT_FOUND : error;
}

static int find_environments(struct mo_connection *reader, const struct mo_orienting *under,
                             struct scored_under *found)
{
  static const char sql[] = "SELECT id FROM environments WHERE sha256=?1";
  int error = MO_OK;
  if (under->environment_set == NULL) {
    for (; found->n < under->n_environments && error == MO_OK; found->n++) {
      struct mo_sha256 hash;
      mo_environment_hash(&under->environments[found->n], &hash);
      error = mo_sql_find(reader, &found->environments[found->n], sql, mo_hash(&hash));
    }
    return error;
  }
  const int suite = mo_word_index(mo_suite_words, under->environment_set);
  if (suite < 0)
    return add_set(reader, under->environment_set, found);
  for (uint32_t task = 0; task < MO_SUITE_TASKS && error == MO_OK; task++)
    error = add_set(reader, mo_suite_set(suite, task), found);
  return error;
}

/* MO_ERR_NOT_FOUND: nothing can have been scored under these conditions. */
static int find_rows(struct mo_connection *reader, const struct mo_orienting *under,
                     struct scored_under *found)
{
  static const char physics_sql[] = "SELECT id FROM physics WHERE sha256=?1";
  enum mo_sensor sensor = MO_SENSOR_INVERSE_SQRT;
  struct mo_sha256 hash;
  *found = (struct scored_under){
      .design = {.fingerprint = under->fingerprint, .workers = under->workers},
      .workspace = under->workspace};
  if (under->controller == NULL)
    return MO_ERR_NOT_FOUND;
  struct mo_physics physics = *under->physics;
  int error =
      mo_controller_find(reader, under->controller, &found->design.controller, &sensor, &physics);
  if (error == MO_ERR_UNSUPPORTED || error == MO_ERR_RANGE) /* the submission will be rejected */
    return MO_ERR_NOT_FOUND;
  mo_physics_hash(&physics, under->precision, sensor, &hash);
  if (error == MO_OK)
    error = mo_sql_find(reader, &found->design.physics, physics_sql, mo_hash(&hash));
  return error == MO_OK ? find_environments(reader, under, found) : error;
}

bool mo_fits_as_it_is(struct mo_workspace workspace, const struct mo_genotype *genotype)
{
  struct mo_genotype moved = {.workspace = workspace}, back = {.workspace = genotype->workspace};
  return mo_genotype_move(genotype->workspace, genotype->words, workspace, moved.words) == MO_OK &&
         mo_genotype_move(workspace, moved.words, genotype->workspace, back.words) == MO_OK &&
         mo_genotype_equal(&back, genotype);
}

/* Computes the mean loss of a genotype. *known: whether it has all losses. */
static int score_of(struct mo_connection *reader, const struct scored_under *under,
                    int64_t genotype, double *score, bool *known)
{
  struct mo_score losses[MO_ENVIRONMENTS_MAX];
  struct mo_saved_design design = under->design;
  double sum = 0;
  int error = MO_OK;
  design.genotype = genotype;
  *known = true;
  for (uint32_t first = 0; first < under->n && *known; first += MO_ENVIRONMENTS_MAX) {
    const uint32_t left = under->n - first,
                   columns = left < MO_ENVIRONMENTS_MAX ? left : MO_ENVIRONMENTS_MAX;
    error = mo_losses_read(reader, &design, &under->environments[first], columns, losses);
    *known = error == MO_OK;
    for (uint32_t k = 0; k < columns && *known; k++) {
      *known = losses[k].known;
      sum += losses[k].loss; /* diverged: infinity */
    }
  }
  *score = sum / under->n;
  return error;
}

/* Replaces a canonical genotype with the best scored orientation of its design, if one exists. */
static int orient(struct mo_connection *reader, const struct scored_under *under,
                  struct mo_bits *genotype, struct mo_design_note *note)
{
  static const char sql[] = "SELECT g.id,g.bits,d.form FROM designs d JOIN genotypes g"
                            " ON g.design=d.id WHERE d.form=?1 LIMIT ?2";
  struct mo_genotype found[MO_ORIENTATIONS], its_form;
  struct mo_bits form = {{0}};
  int64_t rows[MO_ORIENTATIONS];
  uint8_t bytes[MO_BITS_BYTES];
  double best = INFINITY;
  uint32_t n = 0;
  int error = MO_OK;
  mo_genotype_canonical(MO_STORE_WORKSPACE, genotype->words, form.words);
  mo_encode_genotype(form.words, bytes);
  sqlite3_stmt *row =
      mo_sql_rows(reader, &error, sql, mo_blob(bytes, sizeof(bytes)), mo_int(MO_ORIENTATIONS));
  while (mo_sql_next(reader, row, &error)) {
    rows[n] = sqlite3_column_int64(row, 0);
    error = mo_column_design(row, 1, 2, &found[n++], &its_form);
  }
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    char robot[MO_DEFAULT_ROBOT_DIGITS + 1];
    double score = 0;
    bool known = false;
    error = score_of(reader, under, rows[i], &score, &known);
    if (error != MO_OK || !known || !mo_fits_as_it_is(under->workspace, &found[i]))
      continue;
    mo_genotype_robot(found[i].workspace, found[i].words, robot);
    if (note->orientation != MO_ORIENTATION_BEST || score < best ||
        (score == best && strcmp(robot, note->robot) < 0)) {
      note->orientation = MO_ORIENTATION_BEST;
      memcpy(note->robot, robot, sizeof(robot));
      memcpy(genotype->words, found[i].words, sizeof(genotype->words));
      best = score;
    }
  }
  return error;
}

int mo_store_orient(struct mo_store *store, const struct mo_orienting *under,
                    struct mo_bits *genotypes, uint32_t n, struct mo_design_note *notes,
                    uint32_t n_notes)
{
  struct scored_under found;
  uint32_t open = 0;
  for (; open < n_notes && notes[open].orientation == MO_ORIENTATION_GIVEN; open++)
    ;
  if (open == n_notes)
    return MO_OK;
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  int error = find_rows(reader, under, &found);
  const bool scored = error == MO_OK;
  if (error == MO_ERR_NOT_FOUND)
    error = MO_OK;
  for (uint32_t i = 0, place = 0, k = 0; i < n && error == MO_OK; i++, place++) {
    for (; k < n_notes && notes[k].place <= place; k++)
      place += mo_is_skipped(&notes[k]);
    struct mo_design_note *note = k > 0 && notes[k - 1].place == place ? &notes[k - 1] : NULL;
    if (note == NULL || note->orientation == MO_ORIENTATION_GIVEN)
      continue;
    mo_genotype_robot(MO_STORE_WORKSPACE, genotypes[i].words, note->robot);
    if (scored)
      error = orient(reader, &found, &genotypes[i], note);
  }
  return error;
}
