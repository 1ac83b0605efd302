/* campaign_race.h: the race of the children of a generation. Only for the files campaign_*.c of
 * this room. */
#ifndef MORPHO_JOBS_CAMPAIGN_RACE_H
#define MORPHO_JOBS_CAMPAIGN_RACE_H

#include "jobs/campaign_run.h"

/* Closes the cells of the children until the race begins, if there is one. After the cells are
 * made; MO_ERR_NO_MEMORY. */
int mo_race_close(struct mo_campaign_run *run);
/* Begins the race, unless parents have no scores yet. After what is known is marked. */
void mo_race_begin(struct mo_campaign_run *run);
/* Goes on with a candidate whose losses have come. is_done: it has no cell left. Returns whether it
 * is done now: it may be cut short. */
bool mo_race_take(struct mo_campaign_run *run, uint32_t place, bool is_done);
/* Returns whether a race saved time in this generation, or would have; if that cannot be said, as
 * before it. */
bool mo_race_pays(const struct mo_campaign_run *run);
/* Keeps the losses of the survivors for the plan of the next generation, in `to`. */
void mo_race_keep(const struct mo_campaign_run *run, struct mo_campaign_rows *to);
/* Reads the losses of the population that a campaign goes on with. */
int mo_race_read(struct mo_campaign_run *run);

#endif
