/* pretraining.c: the bodies that a pretraining learned from, drawn again.
 *
 * They are the draws of mo_training_draw: (seed, BODY, 0, i), i = 0, 1, …, without those that are held out and without those whose form
 * came before. An empty set of the default workspace is itself what tells them apart, so that ten million forms are held once. */
#include "evolution/internal.h"

#include "morphospace/bits.h"

#define ASK_EVERY     64
#define FRUITLESS_MAX (UINT32_C(1) << 20) /* as in a body stream */

static bool is_default(struct mo_workspace w)
{
  const struct mo_workspace all = MO_DEFAULT_WORKSPACE;
  return w.nx == all.nx && w.ny == all.ny && w.nz == all.nz;
}

/* Adds a body's form to `set` if it fits; `moved`, `form`: scratch of the set's workspace. */
static int add_moved(const uint64_t *body, struct mo_workspace workspace, struct mo_form_set *set, uint64_t *moved,
                     uint64_t *form)
{
  const int r = mo_genotype_move(MO_DEFAULT_WORKSPACE, body, workspace, moved);
  if (r < 0)
    return r == MO_ERR_RANGE ? MO_OK : r;
  mo_genotype_canonical(workspace, moved, form);
  return mo_form_set_add(set, form);
}

/* distinct: what tells the bodies apart. set: NULL if it is that. */
static int draw(uint64_t seed, uint64_t n_bodies, struct mo_workspace workspace, const volatile int *cancel,
                volatile uint64_t *done, struct mo_form_set *distinct, struct mo_form_set *set, uint64_t *scratch)
{
  uint64_t found = 0;
  uint32_t fruitless = 0;
  for (uint64_t i = 0; found < n_bodies; i++) {
    uint64_t body[MO_DEFAULT_WORDS], form[MO_DEFAULT_WORDS];
    struct mo_random random;
    if (i % ASK_EVERY == 0 && mo_is_cancelled(cancel))
      return MO_ERR_CANCELLED;
    mo_random_init(&random, seed, MO_PURPOSE_BODY, 0, i);
    int r = mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, body);
    if (r < 0)
      return r;
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, body, form);
    if (mo_held_out_form(form))
      continue;
    const int is_new = mo_form_set_add(distinct, form);
    if (is_new < 0)
      return is_new;
    if (is_new == 0 && ++fruitless == FRUITLESS_MAX)
      return MO_ERR_EXHAUSTED;
    if (is_new == 0)
      continue;
    if (set != NULL && (r = add_moved(body, workspace, set, scratch, scratch + mo_workspace_words(workspace))) < 0)
      return r;
    fruitless = 0;
    found++;
    if (done != NULL)
      __atomic_store_n(done, found, __ATOMIC_RELAXED);
  }
  return MO_OK;
}

int mo_pretraining_forms(uint64_t seed, uint64_t n_bodies, struct mo_workspace workspace, const volatile int *cancel,
                         volatile uint64_t *done, struct mo_form_set *set)
{
  if (is_default(workspace) && mo_form_set_count(set) == 0)
    return draw(seed, n_bodies, workspace, cancel, done, set, NULL, NULL);
  struct mo_form_set *distinct = NULL;
  int r = mo_form_set_create(MO_DEFAULT_WORKSPACE, &distinct);
  if (r < 0)
    return r;
  uint64_t *scratch = calloc(2 * (size_t)mo_workspace_words(workspace), sizeof(*scratch));
  r = scratch != NULL ? draw(seed, n_bodies, workspace, cancel, done, distinct, set, scratch) : MO_ERR_NO_MEMORY;
  free(scratch);
  mo_form_set_free(distinct);
  return r;
}
