/* seen.c: the designs that a campaign has seen, by canonical form, and the bodies that its
 * controller was pretrained on. */
#include "evolution/internal.h"

#include "morphospace/bits.h"

struct mo_seen {
  struct mo_workspace workspace;
  const struct mo_form_set *excluded; /* NULL: none */
  struct mo_form_set *own;
};

int mo_seen_create(struct mo_workspace workspace, const struct mo_form_set *excluded,
                   struct mo_seen **seen)
{
  struct mo_seen *made = malloc(sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  *made = (struct mo_seen){.workspace = workspace, .excluded = excluded};
  const int r = mo_form_set_create(workspace, &made->own);
  if (r == MO_OK)
    *seen = made;
  else
    free(made);
  return r;
}

void mo_seen_free(struct mo_seen *seen)
{
  if (seen == NULL)
    return;
  mo_form_set_free(seen->own);
  free(seen);
}

static int add(struct mo_seen *seen, const struct mo_form_set *excluded, const uint64_t *genotype)
{
  struct mo_scratch form;
  if (mo_scratch_open(&form, mo_workspace_words(seen->workspace)) != MO_OK)
    return MO_ERR_NO_MEMORY;
  mo_genotype_canonical(seen->workspace, genotype, form.bits);
  int r = 0;
  if (excluded == NULL || !mo_form_set_has(excluded, form.bits))
    r = mo_form_set_add(seen->own, form.bits);
  mo_scratch_close(&form);
  return r;
}

int mo_seen_add(struct mo_seen *seen, const uint64_t *genotype)
{
  return add(seen, seen->excluded, genotype);
}

int mo_seen_take(void *any, const struct mo_genotype *genotype)
{
  struct mo_seen *seen = any;
  struct mo_scratch moved;
  if (mo_scratch_open(&moved, mo_workspace_words(seen->workspace)) != MO_OK)
    return MO_ERR_NO_MEMORY;
  int r = mo_genotype_move(genotype->workspace, genotype->words, seen->workspace, moved.bits);
  if (r == MO_OK)
    r = mo_seen_add(seen, moved.bits);
  mo_scratch_close(&moved);
  return r < 0 ? r : MO_OK;
}

int mo_seen_add_own(struct mo_seen *seen, const uint64_t *genotype)
{
  return add(seen, NULL, genotype);
}

uint64_t mo_seen_count(const struct mo_seen *seen)
{
  return mo_form_set_count(seen->own);
}
