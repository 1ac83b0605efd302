/* import_pieces.c: see imports.h. Rows are copied as the bundle is read, and written in pieces:
 * each is one operation of the writer, which ends after PIECE_US. Between two pieces, the writer
 * takes the operations of others. */
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"
#include "store/campaign_rows.h"
#include "store/controller_rows.h"
#include "store/import_state.h"
#include "store/recordings.h"

#define PIECE_US   40000 /* of the writer's time, without the commit */
#define ROWS_BYTES ((size_t)1 << 20)
#define WAIT_US    100000

/* ---- rows that wait ---- */

enum kind { DESIGN, GENERATION, HELD_OUT, STEP, SCORE, ROLLOUT };

/* Followed by the data to which the row refers. */
struct row {
  size_t bytes; /* with all that follows */
  enum kind kind;
  union {
    struct mo_campaign_design design;
    struct {
      struct mo_campaign_generation row;
      uint32_t n_members;
    } generation; /* members, births */
    struct mo_re_evaluated held_out;
    struct mo_campaign_step step;
    struct mo_campaign_score score;     /* its measures, if it has any */
    struct mo_saved_trajectory rollout; /* the arrays of its channels */
  };
};

static size_t aligned(size_t bytes)
{
  const size_t unit = _Alignof(struct row);
  return (bytes + unit - 1) / unit * unit;
}

/* Appends a row with zeros and room for `more` bytes. Writes the rows so far if they are many. */
static int append(struct mo_import *import, enum kind kind, size_t more, struct row **row)
{
  const size_t bytes = aligned(sizeof(**row) + more);
  int error = import->size >= ROWS_BYTES ? mo_import_flush(import) : MO_OK;
  if (error != MO_OK)
    return error;
  if (import->room - import->size < bytes) {
    const size_t room = import->size + bytes + ROWS_BYTES;
    uint8_t *rows = realloc(import->rows, room);
    if (rows == NULL)
      return MO_ERR_NO_MEMORY;
    import->rows = rows;
    import->room = room;
  }
  *row = (struct row *)(void *)&import->rows[import->size];
  memset(*row, 0, sizeof(**row));
  (*row)->bytes = bytes;
  (*row)->kind = kind;
  import->size += bytes;
  return MO_OK;
}

int mo_import_design(struct mo_import *import, const struct mo_campaign_design *design)
{
  struct row *row = NULL;
  const int error = append(import, DESIGN, 0, &row);
  if (error == MO_OK)
    row->design = *design;
  return error;
}

int mo_import_generation(struct mo_import *import, const struct mo_campaign_generation *generation,
                         const struct mo_descent *births, const struct mo_campaign_member *members,
                         uint32_t n_members)
{
  const size_t members_bytes = n_members * sizeof(*members),
               births_bytes = generation->n_children * sizeof(*births);
  struct row *row = NULL;
  const int error = append(import, GENERATION, members_bytes + births_bytes, &row);
  if (error != MO_OK)
    return error;
  row->generation.row = *generation;
  row->generation.n_members = n_members;
  uint8_t *more = (uint8_t *)(row + 1);
  if (members_bytes > 0)
    memcpy(more, members, members_bytes);
  if (births_bytes > 0)
    memcpy(more + members_bytes, births, births_bytes);
  return MO_OK;
}

int mo_import_held_out(struct mo_import *import, const struct mo_re_evaluated *result)
{
  struct row *row = NULL;
  const int error = append(import, HELD_OUT, 0, &row);
  if (error == MO_OK)
    row->held_out = *result;
  return error;
}

int mo_import_step(struct mo_import *import, const struct mo_campaign_step *step)
{
  struct row *row = NULL;
  const int error = append(import, STEP, 0, &row);
  if (error == MO_OK)
    row->step = *step;
  return error;
}

int mo_import_score(struct mo_import *import, const struct mo_campaign_score *score)
{
  const size_t bytes = score->measures != NULL ? score->n * sizeof(*score->measures) : 0;
  struct row *row = NULL;
  const int error = append(import, SCORE, bytes, &row);
  if (error != MO_OK)
    return error;
  row->score = *score;
  if (bytes > 0)
    memcpy(row + 1, score->measures, bytes);
  return MO_OK;
}

/* Writes a copied score. The pointer in it is set only now, because the rows may have been
 * moved. */
static int enter_score(struct mo_import *import, struct row *row)
{
  if (row->score.measures != NULL)
    row->score.measures = (void *)(row + 1);
  return mo_enter_score(import, &row->score);
}

/* Returns the bytes of a channel, 0 if the recording lacks it. */
static size_t channel_bytes(const struct mo_saved_trajectory *rollout, unsigned channel)
{
  return mo_recording_array(&rollout->recording, (enum mo_channel)channel) != NULL
             ? aligned(rollout->frames *
                       mo_recording_frame_bytes(channel, rollout->n_masses, rollout->n_springs))
             : 0;
}

static void set_array(struct mo_recording *recording, unsigned channel, void *array)
{
  switch ((enum mo_channel)channel) {
  case MO_RECORD_COM: recording->com_m = array; break;
  case MO_RECORD_MASSES: recording->mass_m = array; break;
  case MO_RECORD_ACTUATION: recording->actuation = array; break;
  case MO_RECORD_CONTACTS: recording->contacts = array; break;
  }
}

int mo_import_rollout(struct mo_import *import, const struct mo_saved_trajectory *rollout)
{
  struct row *row = NULL;
  size_t bytes = 0;
  for (unsigned channel = 1; channel < 1U << MO_CHANNELS; channel <<= 1)
    bytes += channel_bytes(rollout, channel);
  const int error = append(import, ROLLOUT, bytes, &row);
  if (error != MO_OK)
    return error;
  row->rollout = *rollout;
  uint8_t *more = (uint8_t *)(row + 1);
  for (unsigned channel = 1; channel < 1U << MO_CHANNELS; channel <<= 1) {
    const void *array = mo_recording_array(&rollout->recording, (enum mo_channel)channel);
    if (array == NULL)
      continue;
    memcpy(more, array,
           rollout->frames *
               mo_recording_frame_bytes(channel, rollout->n_masses, rollout->n_springs));
    more += channel_bytes(rollout, channel);
  }
  return MO_OK;
}

/* Writes a copied rollout in the same way. */
static int enter_rollout(struct mo_import *import, struct row *row)
{
  struct mo_saved_trajectory rollout = row->rollout;
  uint8_t *more = (uint8_t *)(row + 1);
  for (unsigned channel = 1; channel < 1U << MO_CHANNELS; channel <<= 1) {
    const size_t bytes = channel_bytes(&row->rollout, channel);
    if (bytes > 0)
      set_array(&rollout.recording, channel, more);
    more += bytes;
  }
  return mo_enter_rollout(import, &rollout);
}

static int enter_row(struct mo_import *import, struct row *row)
{
  const struct mo_campaign_member *members = (const void *)(row + 1);
  switch (row->kind) {
  case DESIGN: return mo_enter_design(import, &row->design);
  case GENERATION:
    return mo_enter_generation(import, &row->generation.row,
                               (const void *)&members[row->generation.n_members], members,
                               row->generation.n_members);
  case HELD_OUT:
    return mo_campaign_held_out_row(&import->store->writer, import->id, &row->held_out);
  case STEP: return mo_enter_step(import, &row->step);
  case SCORE: return enter_score(import, row);
  default: return enter_rollout(import, row);
  }
}

/* ---- pieces ---- */

/* An operation of the writer. It may run more than once: each time it begins with `before`. */
struct piece {
  struct mo_import *import, before;
  int (*run)(struct mo_import *import, const void *what, int64_t until_us);
  const void *what;
  int result; /* of `run`, if not negative */
};

static int run_piece(struct mo_store *store, void *arguments)
{
  struct piece *piece = arguments;
  (void)store;
  *piece->import = piece->before;
  piece->result = piece->run(piece->import, piece->what, mo_clock_us() + PIECE_US);
  return piece->result < 0 ? piece->result : MO_OK;
}

static int write_piece(struct mo_import *import,
                       int (*run)(struct mo_import *import, const void *what, int64_t until_us),
                       const void *what)
{
  struct piece piece = {.import = import, .before = *import, .run = run, .what = what};
  const int error = mo_write(import->store, run_piece, &piece);
  return error != MO_OK ? error : piece.result;
}

static int enter_rows(struct mo_import *import, const void *unused, int64_t until_us)
{
  int error = MO_OK;
  (void)unused;
  while (error == MO_OK && import->at < import->size) {
    struct row *row = (struct row *)(void *)&import->rows[import->at];
    error = enter_row(import, row);
    import->at += row->bytes;
    if (mo_clock_us() >= until_us)
      break;
  }
  return error;
}

int mo_import_flush(struct mo_import *import)
{
  int error = MO_OK;
  while (error == MO_OK && import->at < import->size)
    error = write_piece(import, enter_rows, NULL);
  import->at = import->size = 0;
  return error;
}

/* ---- what begins a part ---- */

struct weights {
  const struct mo_controller *controller;
  const struct mo_sha256 *sha256;
  size_t size;
};

static int enter_controller(struct mo_import *import, const void *what, int64_t until_us)
{
  const struct weights *weights = what;
  int64_t row = 0;
  (void)until_us;
  return mo_controller_content_row(&import->store->writer, weights->controller, weights->sha256,
                                   weights->size, import->now_us, &row);
}

int mo_import_controller(struct mo_import *import, const struct mo_controller *controller,
                         const struct mo_sha256 *sha256, size_t size)
{
  const struct weights weights = {controller, sha256, size};
  return write_piece(import, enter_controller, &weights);
}

static int enter_campaign(struct mo_import *import, const void *what, int64_t until_us)
{
  (void)until_us;
  return mo_enter_campaign(import, what);
}

int mo_import_campaign(struct mo_import *import, const struct mo_imported_campaign *campaign,
                       int64_t *id)
{
  const int error = write_piece(import, enter_campaign, campaign);
  *id = import->id;
  return error;
}

static int enter_evaluation(struct mo_import *import, const void *what, int64_t until_us)
{
  (void)until_us;
  return mo_enter_evaluation(import, what);
}

static int enter_designs(struct mo_import *import, const void *what, int64_t until_us)
{
  return mo_enter_evaluation_designs(import, what, until_us);
}

int mo_import_evaluation(struct mo_import *import, const struct mo_imported_evaluation *evaluation)
{
  free(import->diverged_steps);
  import->recorded_environments = evaluation->n_environments;
  import->diverged_steps = calloc((size_t)evaluation->n_designs * evaluation->n_environments,
                                  sizeof(*import->diverged_steps));
  if (import->diverged_steps == NULL)
    return MO_ERR_NO_MEMORY;
  int error = write_piece(import, enter_evaluation, evaluation);
  if (error != 1)
    return error;
  do
    error = write_piece(import, enter_designs, evaluation);
  while (error == MO_OK && import->n_inserted < evaluation->n_designs);
  return error == MO_OK ? 1 : error;
}

uint32_t mo_import_conflict(const struct mo_import *import)
{
  return import->conflict;
}

uint64_t mo_import_losses(const struct mo_import *import)
{
  return import->n_losses;
}

/* ---- beginning and end ---- */

/* Waits for the end of another import. */
static int enter_turn(struct mo_store *store, bool (*is_over)(void *context), void *context)
{
  MO_GUARD(&store->imports_mutex);
  while (store->is_importing) {
    if (is_over(context))
      return MO_ERR_CANCELLED;
    (void)mo_wait_until(&store->import_closed, &store->imports_mutex, mo_clock_us() + WAIT_US);
  }
  store->is_importing = true;
  return MO_OK;
}

static void leave_turn(struct mo_store *store)
{
  MO_GUARD(&store->imports_mutex);
  store->is_importing = false;
  pthread_cond_signal(&store->import_closed);
}

int mo_import_open(struct mo_store *store, bool (*is_over)(void *context), void *context,
                   struct mo_import **import)
{
  *import = calloc(1, sizeof(**import));
  if (*import == NULL)
    return MO_ERR_NO_MEMORY;
  (*import)->store = store;
  (*import)->now_us = mo_clock_wall_us();
  int error = enter_turn(store, is_over, context);
  if (error == MO_OK) {
    error = mo_write(store, mo_import_forget, NULL);
    if (error != MO_OK)
      leave_turn(store);
  }
  if (error != MO_OK) {
    free(*import);
    *import = NULL;
  }
  return error;
}

int mo_import_finish(struct mo_import *import)
{
  int error = mo_import_flush(import);
  if (error == MO_OK)
    error = mo_write(import->store, mo_import_show, NULL);
  import->is_finished = error == MO_OK;
  if (error == MO_OK)
    mo_recordings_check(import->store);
  return error;
}

void mo_import_close(struct mo_import *import)
{
  if (import == NULL)
    return;
  if (!import->is_finished) /* if this fails, the next import or start does it */
    mo_import_abandon(import->store);
  leave_turn(import->store);
  free(import->diverged_steps);
  free(import->rows);
  free(import);
}
