/* scoring.c: scores designs in environments under one controller. */
#include "jobs/scoring.h"

#include <math.h>

#define NOT_A_LOSS MO_ERR_RANGE /* a code that back ends do not return */

void mo_block_describe(int error, char text[128])
{
  if (error == NOT_A_LOSS)
    snprintf(text, 128, "the runner of rollouts gave a loss that is not a number");
  else
    snprintf(text, 128, "the runner of rollouts reported: %s", mo_error_text(error));
}

int mo_block_check(const struct mo_block *block, uint32_t i)
{
  if (block->status != MO_OK)
    return mo_back_end_error(block->back_end, block->status);
  return block->outcomes[i].loss > -INFINITY ? MO_OK : NOT_A_LOSS;
}
