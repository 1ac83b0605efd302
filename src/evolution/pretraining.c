/* pretraining.c: redraws the bodies that a pretraining run learned from.
 *
 * They are the draws of mo_training_draw: (seed, BODY, 0, i), i = 0, 1, …, without held-out and
 * repeated forms. If `set` is empty and of the default workspace, it also serves to detect
 * duplicates, so that ten million forms are in memory only once.
 *
 * A draw depends only on its number, so threads divide a round of draws, and then the detection of
 * duplicates (form_set.h). A round has at most as many draws as there are bodies still missing, so
 * it never finds too many. */
#include "evolution/internal.h"

#include "base/thread.h"
#include "morphospace/bits.h"
#include "morphospace/form_set.h"

#include <stdatomic.h>

#define ASK_EVERY     64
#define FRUITLESS_MAX (UINT32_C(1) << 20) /* as in a body stream */
/* Draws per thread, which take about 30 ms; fewer if a form has more words. */
#define ROUND          32768
#define WORTH_A_THREAD 256 /* draws, which take about 200 µs */

struct drawing {
  uint64_t seed;
  uint32_t n_threads;
  const volatile int *cancel;
  struct mo_form_set *distinct;        /* detects duplicates */
  struct mo_form_set *set;             /* NULL: `distinct` is the set */
  struct mo_workspace home, workspace; /* of the bodies; of the set */
  size_t words;                        /* words of a form of the workspace */
  uint64_t first;
  size_t n, room;
  uint64_t *bodies;    /* (room, MO_DEFAULT_WORDS); NULL without `set` */
  uint64_t *forms;     /* (room, MO_DEFAULT_WORDS) */
  uint64_t *elsewhere; /* (room, words) forms in the workspace; NULL without `set` */
  uint64_t *hashes;    /* (room) */
  uint8_t *marks;      /* (room) enum mo_form_mark */
  atomic_int error;
};

static void draw_some(void *context, size_t first, size_t end)
{
  struct drawing *drawing = context;
  for (size_t i = first; i < end; i++) {
    uint64_t one[MO_DEFAULT_WORDS], *form = drawing->forms + MO_DEFAULT_WORDS * i;
    uint64_t *body = drawing->bodies != NULL ? drawing->bodies + MO_DEFAULT_WORDS * i : one;
    struct mo_random random;
    int r =
        (i - first) % ASK_EVERY == 0 && mo_is_cancelled(drawing->cancel) ? MO_ERR_CANCELLED : MO_OK;
    mo_random_init(&random, drawing->seed, MO_PURPOSE_BODY, 0, drawing->first + i);
    if (r == MO_OK)
      r = mo_genotype_random(drawing->home, &random, body);
    if (r < 0) {
      atomic_store(&drawing->error, r);
      return;
    }
    mo_genotype_canonical(drawing->home, body, form);
    drawing->marks[i] = mo_held_out_form(form) ? MO_FORM_OUT : MO_FORM_IN;
    drawing->hashes[i] = mo_form_set_hash(drawing->distinct, form);
  }
}

/* Computes the forms of new bodies in the target workspace, if they fit it. */
static void move_some(void *context, size_t first, size_t end)
{
  struct drawing *drawing = context;
  struct mo_scratch moved;
  int r = mo_scratch_open(&moved, (uint32_t)drawing->words);
  for (size_t i = first; i < end && r == MO_OK; i++) {
    uint64_t *form = drawing->elsewhere + drawing->words * i;
    if (drawing->marks[i] == MO_FORM_NEW)
      r = mo_genotype_move(drawing->home, drawing->bodies + MO_DEFAULT_WORDS * i,
                           drawing->workspace, moved.bits);
    if (drawing->marks[i] != MO_FORM_NEW || r != MO_OK) {
      drawing->marks[i] = MO_FORM_OUT;
      r = r == MO_ERR_RANGE ? MO_OK : r;
      continue;
    }
    drawing->marks[i] = MO_FORM_IN;
    mo_genotype_canonical(drawing->workspace, moved.bits, form);
    drawing->hashes[i] = mo_form_set_hash(drawing->set, form);
  }
  mo_scratch_close(&moved);
  if (r != MO_OK)
    atomic_store(&drawing->error, r);
}

static uint32_t threads_for(const struct drawing *drawing)
{
  const size_t enough = 1 + drawing->n / WORTH_A_THREAD;
  return drawing->n_threads < enough ? drawing->n_threads : (uint32_t)enough;
}

/* Counts the round's new bodies, and the draws since the last new form. MO_ERR_EXHAUSTED: too many
 * in a row. */
static int count(const struct drawing *drawing, uint64_t *found, uint32_t *fruitless)
{
  for (size_t i = 0; i < drawing->n; i++) {
    if (drawing->marks[i] == MO_FORM_IN && ++*fruitless == FRUITLESS_MAX)
      return MO_ERR_EXHAUSTED;
    if (drawing->marks[i] == MO_FORM_NEW) {
      *fruitless = 0;
      ++*found;
    }
  }
  return MO_OK;
}

static int draw_round(struct drawing *drawing, uint64_t *found, uint32_t *fruitless)
{
  mo_parallel(threads_for(drawing), drawing->n, draw_some, drawing);
  int r = atomic_load(&drawing->error);
  if (r == MO_OK)
    r = mo_form_set_add_many(drawing->distinct, drawing->forms, drawing->hashes, drawing->n,
                             drawing->n_threads, drawing->marks);
  if (r == MO_OK)
    r = count(drawing, found, fruitless);
  if (r != MO_OK || drawing->set == NULL)
    return r;
  mo_parallel(threads_for(drawing), drawing->n, move_some, drawing);
  r = atomic_load(&drawing->error);
  return r == MO_OK ? mo_form_set_add_many(drawing->set, drawing->elsewhere, drawing->hashes,
                                           drawing->n, drawing->n_threads, drawing->marks)
                    : r;
}

static int draw(struct drawing *drawing, uint64_t n_bodies, volatile uint64_t *done)
{
  uint64_t found = 0;
  uint32_t fruitless = 0;
  while (found < n_bodies) {
    drawing->n = n_bodies - found < drawing->room ? (size_t)(n_bodies - found) : drawing->room;
    const int r = draw_round(drawing, &found, &fruitless);
    if (r != MO_OK)
      return r;
    drawing->first += drawing->n;
    if (done != NULL)
      __atomic_store_n(done, found, __ATOMIC_RELAXED);
  }
  return MO_OK;
}

static int make_room(struct drawing *drawing, uint64_t n_bodies)
{
  const size_t share =
      drawing->words <= MO_DEFAULT_WORDS ? ROUND : ROUND * MO_DEFAULT_WORDS / drawing->words + 1;
  const size_t most = share * drawing->n_threads;
  drawing->room = n_bodies < most ? (size_t)n_bodies + 1 : most;
  drawing->forms = calloc(drawing->room, MO_DEFAULT_WORDS * sizeof(*drawing->forms));
  drawing->hashes = calloc(drawing->room, sizeof(*drawing->hashes));
  drawing->marks = calloc(drawing->room, sizeof(*drawing->marks));
  if (drawing->forms == NULL || drawing->hashes == NULL || drawing->marks == NULL)
    return MO_ERR_NO_MEMORY;
  if (drawing->set == NULL)
    return MO_OK;
  drawing->bodies = calloc(drawing->room, MO_DEFAULT_WORDS * sizeof(*drawing->bodies));
  drawing->elsewhere = calloc(drawing->room, drawing->words * sizeof(*drawing->elsewhere));
  return drawing->bodies == NULL || drawing->elsewhere == NULL ? MO_ERR_NO_MEMORY : MO_OK;
}

int mo_pretraining_forms(uint64_t seed, uint64_t n_bodies, struct mo_workspace workspace,
                         uint32_t n_threads, const volatile int *cancel, volatile uint64_t *done,
                         struct mo_form_set *set)
{
  const struct mo_workspace home = MO_DEFAULT_WORKSPACE; /* of the pretraining run */
  const bool tells_apart = mo_workspace_equal(workspace, home) && mo_form_set_count(set) == 0;
  struct mo_form_set *own = NULL;
  int r = tells_apart ? MO_OK : mo_form_set_create(home, &own);
  if (r < 0)
    return r;
  struct drawing drawing = {.seed = seed,
                            .n_threads = n_threads < 1 ? 1
                                         : n_threads < MO_PARALLEL_THREADS_MAX
                                             ? n_threads
                                             : MO_PARALLEL_THREADS_MAX,
                            .cancel = cancel,
                            .distinct = tells_apart ? set : own,
                            .set = tells_apart ? NULL : set,
                            .home = home,
                            .workspace = workspace,
                            .words = mo_workspace_words(workspace)};
  r = make_room(&drawing, n_bodies);
  if (r == MO_OK)
    r = draw(&drawing, n_bodies, done);
  free(drawing.bodies);
  free(drawing.forms);
  free(drawing.elsewhere);
  free(drawing.hashes);
  free(drawing.marks);
  mo_form_set_free(own);
  return r;
}
