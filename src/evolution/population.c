/* population.c: the initial population: given designs, then random ones. */
#include "evolution/internal.h"

#define ASK_EVERY 64 /* draws between two checks of `cancel` */

/* Fills places *n … population − 1. */
static int fill(const struct mo_campaign_settings *settings, struct mo_seen *seen,
                uint64_t *genotypes, uint32_t *n, const volatile int *cancel)
{
  const size_t words = mo_workspace_words(settings->workspace);
  uint32_t fruitless = 0;
  for (uint64_t i = 0; *n < settings->population && fruitless < MO_FRUITLESS_MAX; i++) {
    struct mo_random random;
    uint64_t *body = genotypes + words * *n;
    if (i % ASK_EVERY == 0 && mo_is_cancelled(cancel))
      return MO_ERR_CANCELLED;
    mo_random_init(&random, settings->seed, MO_PURPOSE_POPULATION, 0, i);
    int r = mo_genotype_random(settings->workspace, &random, body);
    if (r == MO_OK)
      r = mo_seen_add(seen, body);
    if (r < 0)
      return r;
    *n += r == 1;
    fruitless = r == 1 ? 0 : fruitless + 1;
  }
  return MO_OK;
}

int mo_population_initial(const struct mo_campaign_settings *settings, struct mo_seen *seen,
                          uint64_t *genotypes, uint32_t n_given, uint32_t *n, uint32_t *fault,
                          const volatile int *cancel)
{
  const size_t words = mo_workspace_words(settings->workspace);
  if (n_given > settings->population)
    return MO_ERR_RANGE;
  for (uint32_t i = 0; i < n_given; i++) {
    const int r = mo_seen_add_own(seen, genotypes + words * i);
    if (r == 1)
      continue;
    if (r == 0 && fault != NULL)
      *fault = i;
    return r == 0 ? MO_ERR_DUPLICATE : r;
  }
  uint32_t found = n_given;
  const int r = fill(settings, seen, genotypes, &found, cancel);
  if (r < 0)
    return r;
  *n = found;
  return MO_OK;
}
