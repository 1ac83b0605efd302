/* held_out.c: bodies and environments that training never uses.
 *
 * Whether a body is held out depends only on its canonical form: a hash chooses one form in 16. The
 * bodies that are used to compare two controllers are therefore new to both, regardless of their
 * training seeds. The hash is one application of Philox, whose counter and key are exactly the 192
 * bits of a form in the default workspace. */
#include <morpho/learning.h>

#include <string.h>

/* Workspace of the bodies, whose forms have the 192 bits that the hash takes. */
#define HOME MO_DEFAULT_WORKSPACE

int mo_held_out_form(const uint64_t *form)
{
  const uint32_t counter[4] = {(uint32_t)form[0], (uint32_t)(form[0] >> 32), (uint32_t)form[1],
                               (uint32_t)(form[1] >> 32)};
  const uint32_t key[2] = {(uint32_t)form[2], (uint32_t)(form[2] >> 32)};
  uint32_t hash[4];
  mo_philox4x32_10(counter, key, hash);
  return hash[0] % MO_HELD_OUT_ONE_IN == 0;
}

static int draw(uint64_t seed, uint32_t n, struct mo_form_set *seen, uint64_t *designs)
{
  uint32_t found = 0;
  for (uint64_t i = 0; found < n; i++) {
    uint64_t body[MO_DEFAULT_WORDS], form[MO_DEFAULT_WORDS];
    struct mo_random random;
    mo_random_init(&random, seed, MO_PURPOSE_HELD_OUT_BODY, 0, i);
    int r = mo_genotype_random(HOME, &random, body);
    if (r < 0)
      return r;
    mo_genotype_canonical(HOME, body, form);
    r = mo_held_out_form(form) ? mo_form_set_add(seen, form) : 0;
    if (r < 0)
      return r;
    if (r == 1)
      memcpy(designs + MO_DEFAULT_WORDS * (size_t)found++, body, sizeof(body));
  }
  return MO_OK;
}

int mo_held_out_designs(uint64_t seed, uint32_t n, uint64_t *designs)
{
  if (n > MO_TRAINING_DESIGNS_MAX)
    return MO_ERR_RANGE;
  struct mo_form_set *seen = NULL;
  int r = mo_form_set_create(HOME, &seen);
  if (r == MO_OK)
    r = draw(seed, n, seen, designs);
  mo_form_set_free(seen);
  return r;
}

void mo_held_out_environments(uint64_t seed, uint32_t n, struct mo_environment *environments)
{
  for (uint32_t i = 0; i < n; i++)
    mo_environment_held_out(seed, i, &environments[i]);
}
