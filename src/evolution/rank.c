/* rank.c: ranks candidates by score, then by number, so that no two have the same rank. */
#include "evolution/internal.h"

#include <stdlib.h>

static int compare_ranks(const void *a, const void *b)
{
  const struct mo_rank *one = a, *other = b;
  if (one->score != other->score)
    return one->score < other->score ? -1 : 1;
  if (one->number != other->number)
    return one->number < other->number ? -1 : 1;
  return one->place < other->place ? -1 : one->place > other->place;
}

void mo_rank_sort(struct mo_rank *ranks, uint32_t n)
{
  if (n > 1)
    qsort(ranks, n, sizeof(*ranks), compare_ranks);
}
