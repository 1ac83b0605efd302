/* scoring.h: scores designs in environments under one controller. */
#ifndef MORPHO_JOBS_SCORING_H
#define MORPHO_JOBS_SCORING_H

#include "jobs/state.h"

/* Returns the error of lane i of a finished block, for its job. A diverged rollout has the loss
 * +infinity. NaN and −infinity must not be stored; no input should give them, so they are an error,
 * which mo_block_describe words. */
int mo_block_check(const struct mo_block *block, uint32_t i);
void mo_block_describe(int error, char text[128]);

#endif
