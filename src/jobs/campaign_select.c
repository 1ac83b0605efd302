/* campaign_select.c: the survivors of a generation, which are the next population. */
#include <stdlib.h>
#include <string.h>

#include "jobs/campaign_run.h"

static int by_number(const void *a, const void *b)
{
  const uint32_t x = *(const uint32_t *)a, y = *(const uint32_t *)b;
  return x < y ? -1 : x > y;
}

/* The client of a study may choose the parents among the survivors; then all children survive as
 * well. */
int mo_campaign_select(struct mo_campaign_run *run)
{
  const uint32_t n = run->n_parents + run->n_children;
  const struct mo_study_batch *chosen =
      run->batch != NULL && run->batch->selects ? run->batch : NULL;
  struct mo_campaign_settings settings = *run->settings;
  struct mo_candidate *candidates = calloc((size_t)n + 1, sizeof(*candidates));
  uint32_t *places = calloc((size_t)n + 1, sizeof(*places)), n_kept = 0;
  int error = candidates == NULL || places == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  if (chosen != NULL)
    qsort(chosen->survivors, chosen->n_survivors, sizeof(*chosen->survivors), by_number);
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    if (chosen != NULL && i < run->n_parents &&
        bsearch(&run->rows->numbers[i], chosen->survivors, chosen->n_survivors,
                sizeof(*chosen->survivors), by_number) == NULL)
      continue;
    candidates[n_kept] =
        (struct mo_candidate){run->rows->scores[i], run->rows->numbers[i], run->rows->born[i]};
    places[n_kept++] = i;
  }
  if (chosen != NULL) {
    /* All of them survive, so this only ranks them. */
    settings.selection.kind = MO_SELECT_TRUNCATION;
    settings.population = n_kept;
  }
  if (error == MO_OK)
    error = mo_select(&settings, run->generation, run->rows->genotypes, candidates, n_kept,
                      run->rows->survivors, &run->n_survivors);
  for (uint32_t i = 0; i < run->n_survivors && error == MO_OK; i++)
    run->rows->survivors[i] = places[run->rows->survivors[i]];
  free(candidates);
  free(places);
  return error;
}

int mo_campaign_succeed(struct mo_campaign_run *run)
{
  const struct mo_campaign_rows *from = run->rows;
  struct mo_campaign_rows *to = run->other_rows;
  for (uint32_t i = 0; i < run->n_survivors; i++) {
    const uint32_t place = from->survivors[i];
    memcpy(to->genotypes + run->words * i, from->genotypes + run->words * place,
           run->words * sizeof(*to->genotypes));
    to->bits[i] = from->bits[place];
    to->sizes[i] = from->sizes[place];
    to->scores[i] = from->scores[place];
    to->numbers[i] = from->numbers[place];
    to->born[i] = from->born[place];
    to->cut[i] = 0;
  }
  mo_race_keep(run, to);
  return MO_OK;
}
