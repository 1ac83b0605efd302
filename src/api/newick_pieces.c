/* newick_pieces.c: see newick_pieces.h. */
#include "api/newick_pieces.h"

#include <pthread.h>
#include <stdlib.h>

#define PIECE_BYTES ((size_t)32 * 1024)

struct mo_newick_pieces {
  struct mo_descent *descents;
  uint32_t *born;
  uint32_t n;
  pthread_t thread;
  pthread_mutex_t lock;
  pthread_cond_t changed;
  struct mo_text piece; /* waits to be taken once it is full */
  bool full, ended, cancelled;
  int code; /* result of mo_newick */
};

/* Receives output of mo_newick, on the thread. */
static int take(void *context, const char *text, size_t length)
{
  struct mo_newick_pieces *pieces = context;
  pthread_mutex_lock(&pieces->lock);
  while (pieces->full && !pieces->cancelled)
    pthread_cond_wait(&pieces->changed, &pieces->lock);
  bool cancelled = pieces->cancelled;
  if (!cancelled) {
    mo_text_bytes(&pieces->piece, text, length);
    pieces->full = pieces->piece.size >= PIECE_BYTES;
    if (pieces->full)
      pthread_cond_signal(&pieces->changed);
  }
  bool failed = pieces->piece.failed;
  pthread_mutex_unlock(&pieces->lock);
  return cancelled ? MO_ERR_CANCELLED : failed ? MO_ERR_NO_MEMORY : MO_OK;
}

static void *run(void *context)
{
  struct mo_newick_pieces *pieces = context;
  int code = mo_newick(pieces->descents, pieces->born, NULL, pieces->n, take, pieces);
  pthread_mutex_lock(&pieces->lock);
  pieces->code = code;
  pieces->ended = true;
  pthread_cond_signal(&pieces->changed);
  pthread_mutex_unlock(&pieces->lock);
  return NULL;
}

int mo_newick_pieces_start(struct mo_descent *descents, uint32_t *born, uint32_t n,
                           struct mo_newick_pieces **ret)
{
  struct mo_newick_pieces *pieces = calloc(1, sizeof(*pieces));
  if (pieces != NULL) {
    *pieces = (struct mo_newick_pieces){.descents = descents, .born = born, .n = n};
    pthread_mutex_init(&pieces->lock, NULL);
    pthread_cond_init(&pieces->changed, NULL);
    if (pthread_create(&pieces->thread, NULL, run, pieces) == 0) {
      *ret = pieces;
      return MO_OK;
    }
    pthread_cond_destroy(&pieces->changed);
    pthread_mutex_destroy(&pieces->lock);
  }
  free(pieces);
  free(descents);
  free(born);
  return MO_ERR_NO_MEMORY;
}

int mo_newick_pieces_more(void *context, struct mo_text *text)
{
  struct mo_newick_pieces *pieces = context;
  pthread_mutex_lock(&pieces->lock);
  while (!pieces->full && !pieces->ended)
    pthread_cond_wait(&pieces->changed, &pieces->lock);
  mo_text_bytes(text, pieces->piece.data, pieces->piece.size);
  pieces->piece.size = 0;
  pieces->full = false;
  int more = !pieces->ended ? 1 : pieces->code;
  pthread_cond_signal(&pieces->changed);
  pthread_mutex_unlock(&pieces->lock);
  return more;
}

void mo_newick_pieces_free(void *context)
{
  struct mo_newick_pieces *pieces = context;
  pthread_mutex_lock(&pieces->lock);
  pieces->cancelled = true;
  pthread_cond_signal(&pieces->changed);
  pthread_mutex_unlock(&pieces->lock);
  pthread_join(pieces->thread, NULL);
  pthread_cond_destroy(&pieces->changed);
  pthread_mutex_destroy(&pieces->lock);
  mo_text_free(&pieces->piece);
  free(pieces->descents);
  free(pieces->born);
  free(pieces);
}

uint64_t mo_newick_pieces_bytes(uint32_t n)
{
  return 2 * PIECE_BYTES + (uint64_t)n * (sizeof(struct mo_descent) + 4 * sizeof(uint32_t));
}
