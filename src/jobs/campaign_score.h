/* campaign_score.h: the scores of a generation, and the race of its children. Only for the files
 * campaign*.c of this room. */
#ifndef MORPHO_JOBS_CAMPAIGN_SCORE_H
#define MORPHO_JOBS_CAMPAIGN_SCORE_H

#include "jobs/scoring.h"
#include "store/campaign_runs.h"

struct mo_campaign_rows;
struct mo_campaign_run;

/* ---- campaign_score.c ---- */

/* The scores of the candidates, starting at `first`. */
struct mo_campaign_scores {
  struct mo_scoring scoring;
  uint32_t first, n;
  struct mo_compute_controller *weights; /* that score this generation; NULL: not prepared yet */
  struct mo_campaign_loss *losses;       /* (n) */
  /* For a campaign that names measures: the measures of each rollout, (n, n_environments), and the
   * means of each candidate, (n, means). */
  double (*measures)[MO_MEASURES];
  double *means;
  uint32_t *unsaved; /* (n) candidates with unsaved losses */
  uint32_t n_unsaved;
  uint32_t n_done;   /* of n */
  uint64_t n_cached; /* losses that were found in the table `scores` */
};
void mo_campaign_free_scores(struct mo_campaign_scores *scores); /* frees everything except the
                                                                    weights */

/* Finds stored losses. */
int mo_campaign_look_up(struct mo_campaign_run *run);
uint64_t mo_campaign_n_scores(const struct mo_campaign_run *run);
/* Scores the children, after the look-up, and the parents as well in a campaign that learns. */
int mo_campaign_score(struct mo_campaign_run *run);
/* Saves the losses that are not saved yet. run: struct mo_campaign_run. */
int mo_campaign_save_losses(void *run);

/* ---- campaign_race.c ---- */

struct mo_campaign_race {
  bool is_possible;      /* the race is planned, and counts */
  bool pays;             /* a race in the previous generation saved time, or would have */
  uint32_t parents_left; /* parents whose scores are still missing for the plan */
  struct mo_race plan;
};
/* Closes the cells of the children until the race begins, if there is one. Call it after the cells
 * are made. MO_ERR_NO_MEMORY. */
int mo_race_close(struct mo_campaign_run *run);
/* Begins the race, unless parents still lack scores. Call it after known losses are marked. */
void mo_race_begin(struct mo_campaign_run *run);
/* Continues the race with a candidate that has received losses. is_done: it has no cell left.
 * Returns whether it is done now, possibly because it was cut short. */
bool mo_race_take(struct mo_campaign_run *run, uint32_t place, bool is_done);
/* Returns whether a race saved time in this generation, or would have. If that is unknown, returns
 * the previous answer. */
bool mo_race_pays(const struct mo_campaign_run *run);
/* Keeps the losses of the survivors in `to`, for the plan of the next generation. */
void mo_race_keep(const struct mo_campaign_run *run, struct mo_campaign_rows *to);
/* Reads the losses of the population that a campaign continues with. */
int mo_race_read(struct mo_campaign_run *run);

#endif
