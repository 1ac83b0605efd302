/* body_stream.c: random bodies without repetition.
 *
 * Draws and their canonical forms depend only on the numbers of the draws, so a few hundred are
 * made ahead, on as many threads as allowed. They are then checked for repetitions one after
 * another, in the order of their numbers. With one thread, no draws are made ahead. */
#include <morpho/morphospace.h>

#include "base/thread.h"
#include "morphospace/bits.h"

#define FRUITLESS_MAX (UINT32_C(1) << 20)

enum { AHEAD_PER_THREAD = 256 }; /* about 2 ms of work */

struct mo_body_stream {
  struct mo_workspace workspace;
  size_t words;
  uint64_t seed;
  uint64_t draws;
  struct mo_form_set *seen;
  uint32_t n_threads;
  /* Draws made ahead: `first` … `first + n − 1`, each a body, its form, and a result code. */
  uint64_t first;
  size_t n, room;
  uint64_t *ahead; /* (room, 2, words) */
  int *codes;      /* (room) */
};

static int make_room(struct mo_body_stream *stream, size_t room)
{
  uint64_t *ahead = calloc(room, 2 * stream->words * sizeof(*ahead));
  int *codes = calloc(room, sizeof(*codes));
  if (ahead == NULL || codes == NULL) {
    free(ahead);
    free(codes);
    return MO_ERR_NO_MEMORY;
  }
  free(stream->ahead);
  free(stream->codes);
  stream->ahead = ahead;
  stream->codes = codes;
  stream->room = room;
  stream->n = 0;
  return MO_OK;
}

int mo_body_stream_create(struct mo_workspace workspace, uint64_t seed,
                          struct mo_body_stream **stream)
{
  struct mo_form_set *seen = NULL;
  int code = mo_form_set_create(workspace, &seen);
  if (code != MO_OK)
    return code;
  struct mo_body_stream *made = calloc(1, sizeof(*made));
  if (made == NULL) {
    mo_form_set_free(seen);
    return MO_ERR_NO_MEMORY;
  }
  *made = (struct mo_body_stream){.workspace = workspace,
                                  .words = mo_workspace_words(workspace),
                                  .seed = seed,
                                  .seen = seen,
                                  .n_threads = 1};
  code = make_room(made, 1);
  if (code == MO_OK)
    *stream = made;
  else
    mo_body_stream_free(made);
  return code;
}

void mo_body_stream_free(struct mo_body_stream *stream)
{
  if (stream == NULL)
    return;
  mo_form_set_free(stream->seen);
  free(stream->ahead);
  free(stream->codes);
  free(stream);
}

int mo_body_stream_set_threads(struct mo_body_stream *stream, uint32_t n_threads)
{
  n_threads = n_threads < 1                         ? 1
              : n_threads < MO_PARALLEL_THREADS_MAX ? n_threads
                                                    : MO_PARALLEL_THREADS_MAX;
  if (n_threads == stream->n_threads) /* this keeps the draws made ahead */
    return MO_OK;
  const int code = make_room(stream, n_threads == 1 ? 1 : (size_t)n_threads * AHEAD_PER_THREAD);
  if (code == MO_OK)
    stream->n_threads = n_threads;
  return code;
}

static void draw(void *context, size_t first, size_t end)
{
  const struct mo_body_stream *stream = context;
  for (size_t i = first; i < end; i++) {
    uint64_t *body = stream->ahead + 2 * stream->words * i;
    struct mo_random random;
    mo_random_init(&random, stream->seed, MO_PURPOSE_BODY, 0, stream->first + i);
    stream->codes[i] = mo_genotype_random(stream->workspace, &random, body);
    if (stream->codes[i] == MO_OK)
      mo_genotype_canonical(stream->workspace, body, body + stream->words);
  }
}

/* Returns the index of draw number stream->draws. */
static size_t draw_next(struct mo_body_stream *stream)
{
  const uint64_t at = stream->draws - stream->first;
  if (at < stream->n && stream->codes[at] == MO_OK)
    return (size_t)at;
  stream->first = stream->draws;
  stream->n = stream->room;
  mo_parallel(stream->n_threads, stream->n, draw, stream);
  return 0;
}

int mo_body_stream_next(struct mo_body_stream *stream, uint64_t *bits, uint64_t *form)
{
  for (uint32_t fruitless = 0; fruitless < FRUITLESS_MAX; fruitless++) {
    const size_t at = draw_next(stream);
    const uint64_t *body = stream->ahead + 2 * stream->words * at;
    int code = stream->codes[at];
    if (code != MO_OK)
      return code;
    code = mo_form_set_add(stream->seen, body + stream->words);
    if (code < 0)
      return code; /* the next call repeats the same draw */
    stream->draws++;
    if (code == 1) {
      memcpy(bits, body, stream->words * sizeof(uint64_t));
      if (form != NULL)
        memcpy(form, body + stream->words, stream->words * sizeof(uint64_t));
      return MO_OK;
    }
  }
  return MO_ERR_EXHAUSTED;
}

uint64_t mo_body_stream_draws(const struct mo_body_stream *stream)
{
  return stream->draws;
}
