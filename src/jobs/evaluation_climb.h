/* evaluation_climb.h: the climbs of an evaluation that requested a tolerance. Only for the files
 * evaluation*.c. */
#ifndef MORPHO_JOBS_EVALUATION_CLIMB_H
#define MORPHO_JOBS_EVALUATION_CLIMB_H

#include "jobs/evaluation.h"

/* Begins the climbs of the designs of a loaded job that requested a tolerance: closes all rungs but
 * the first. MO_ERR_NO_MEMORY. */
int mo_active_climb(struct mo_active *active);
void mo_climbs_free(struct mo_climbs *climbs); /* NULL-safe */
/* Records the loss of a cell of the grid. */
void mo_active_climb_give(struct mo_active *active, uint32_t row, uint32_t k, double loss);
/* Opens the next rungs of the designs whose rungs have all losses and miss the tolerance. Returns
 * whether there are any. */
bool mo_active_climb_on(struct mo_active *active);

#endif
