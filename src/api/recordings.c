/* recordings.c: everything that an evaluation recorded in one channel, as one NumPy array:
 * (designs, environments, frames, …). Designs have different numbers of masses and springs, so the
 * last dimensions fit the largest design. The rest, including the designs that were skipped, is
 * padded with values that no recording contains. The array is read and sent rollout by rollout. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/jobs.h"
#include "api/scene.h"
#include "exchange/values.h"
#include "http/download.h"

#define PIECE_BYTES ((size_t)512 << 10)

struct recordings {
  struct mo_store *store;
  int64_t id;
  enum mo_channel channel;
  uint32_t n_designs, n_environments, next; /* next: the rollout to send */
  struct mo_trajectory_sides sides;         /* the largest of all */
  size_t row;                               /* bytes of a frame */
  struct mo_design_note *notes;             /* (n_notes) */
  uint32_t n_notes, note;                   /* note: index of the first note at or after the design
                                               of the next rollout */
  bool begun;
};

static void free_recordings(void *any)
{
  struct recordings *all = any;
  free(all->notes);
  free(all);
}

/* Returns whether the design was skipped. Calls are in the order of the designs. */
static bool is_skipped(struct recordings *all, uint32_t design)
{
  while (all->note < all->n_notes && all->notes[all->note].place < design)
    all->note++;
  return all->note < all->n_notes && all->notes[all->note].place == design &&
         mo_is_skipped(&all->notes[all->note]);
}

/* Appends `missing` bytes of padding. */
static void fill(struct mo_text *text, enum mo_channel channel, size_t missing)
{
  const double nan = NAN;
  const float nan_float = NAN;
  const uint8_t none[] = {0x80, 0xFF}; /* −128, 255 */
  const void *const values[MO_CHANNELS] = {&nan, &nan_float, &none[0], &none[1]};
  const size_t width = mo_channel_width(channel);
  for (size_t i = 0; i < missing; i += width)
    mo_text_bytes(text, values[__builtin_ctz(channel)], width);
}

/* Appends one rollout. */
static int write_rollout(struct mo_text *text, const struct recordings *all,
                         const struct mo_trajectory *trajectory)
{
  const char *numbers = mo_recording_array(&trajectory->recording, all->channel);
  const size_t own =
      mo_recording_frame_bytes(all->channel, trajectory->n_masses, trajectory->n_springs);
  if (numbers == NULL || own > all->row || trajectory->n_frames != all->sides.frames)
    return MO_ERR_CORRUPT;
  if (own == all->row)
    mo_text_bytes(text, numbers, own * trajectory->n_frames);
  for (uint32_t f = 0; f < trajectory->n_frames && own < all->row; f++) {
    mo_text_bytes(text, numbers + f * own, own);
    fill(text, all->channel, all->row - own);
  }
  return MO_OK;
}

/* A callback of type mo_download_more. */
static int more_rollouts(void *context, struct mo_text *text)
{
  struct recordings *all = context;
  const uint32_t n = all->n_designs * all->n_environments;
  int error = MO_OK;
  if (!all->begun) {
    char leading[32];
    snprintf(leading, sizeof(leading), "%u, %u, ", all->n_designs, all->n_environments);
    mo_recording_header(text, all->channel, leading, &all->sides);
  }
  all->begun = true;
  while (error == MO_OK && all->next < n && text->size < PIECE_BYTES) {
    const uint32_t design = all->next / all->n_environments, k = all->next++ % all->n_environments;
    struct mo_trajectory *trajectory = NULL;
    if (is_skipped(all, design)) {
      fill(text, all->channel, all->row * all->sides.frames);
      continue;
    }
    error = mo_store_trajectory(all->store, all->id, design, k, &trajectory);
    if (error == MO_OK)
      error = write_rollout(text, all, trajectory);
    mo_trajectory_free(trajectory);
  }
  return error != MO_OK ? error : all->next < n;
}

/* Chooses the channel that the query specifies, or the default one. Returns false if it has
 * replied. */
static bool choose(struct mo_request *request, const struct mo_job *job, enum mo_channel *channel)
{
  int asked = -1;
  if (!mo_query_word(request, "array", mo_channel_words, &asked))
    return false;
  if (job->record == 0 || (asked >= 0 && !(job->record >> asked & 1))) {
    mo_reply_problem(request, 404, NULL, "The evaluation did not request a recording%s.",
                     job->record == 0 ? "" : " of this array");
    return false;
  }
  *channel =
      (enum mo_channel)(1U << (asked >= 0 ? (unsigned)asked : mo_usual_channel(job->record)));
  return true;
}

void mo_api_get_trajectories(struct mo_request *request)
{
  static const char *const types[] = {"application/octet-stream", NULL};
  struct mo_store *store = mo_api_of(request)->store;
  struct recordings all = {.store = store};
  struct mo_job job;
  char tag[96];
  int form;
  if (!mo_accept(request, types, &form) || !mo_path_id(request, 0, &all.id) ||
      !mo_job_of_kind(request, &mo_evaluation_resource, all.id, &job) ||
      !choose(request, &job, &all.channel))
    return;
  int error = mo_store_trajectory_sides(store, all.id, &all.sides);
  if (error == MO_OK && (all.sides.n == 0 || all.sides.n < job.rollouts_total))
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK)
    error = mo_store_design_notes(store, all.id, &all.notes, &all.n_notes);
  if (error != MO_OK) {
    mo_reply_no_recording(request, &job, error);
    return;
  }
  all.n_designs = job.n_designs;
  all.n_environments = job.n_environments;
  all.row = mo_recording_frame_bytes(all.channel, all.sides.masses, all.sides.springs);
  struct recordings *kept = malloc(sizeof(*kept));
  if (kept == NULL) {
    free(all.notes);
    mo_reply_error(request, MO_ERR_NO_MEMORY, "reply");
    return;
  }
  *kept = all;
  snprintf(tag, sizeof(tag), "%llx-recordings-%lld-%u", (unsigned long long)mo_store_history(store),
           (long long)all.id, all.channel);
  mo_download_open(request, types[form], tag, sizeof(*kept) + 2 * PIECE_BYTES, more_rollouts, kept,
                   free_recordings);
}
