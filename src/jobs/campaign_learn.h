/* campaign_learn.h: the learning of a campaign within a generation. Only for the files campaign*.c
 * of this room. */
#ifndef MORPHO_JOBS_CAMPAIGN_LEARN_H
#define MORPHO_JOBS_CAMPAIGN_LEARN_H

#include "jobs/learner.h"
#include "store/campaign_runs.h"

struct mo_campaign_run;

struct mo_campaign_learning {
  struct mo_learner learner;
  struct mo_campaign_step *steps; /* (parent + child steps) not yet written, starting at
                                   * steps_saved */
  uint32_t step, steps_saved;     /* steps done in this generation, and at the last checkpoint */
  int64_t checkpoint_us;
  double first_loss, last_loss;
};
void mo_campaign_free_learning(struct mo_campaign_learning *learning);

uint64_t mo_campaign_n_steps(const struct mo_campaign_run *run); /* of this generation */
/* Runs the remaining learning steps of this generation. */
int mo_campaign_learn(struct mo_campaign_run *run);
/* Ends a campaign if no robot of generation 0 could learn or be scored. */
int mo_campaign_check_learned(struct mo_campaign_run *run);
/* Saves a checkpoint of the steps since the last one. */
int mo_campaign_save_learning(struct mo_campaign_run *run);
/* Loads the learning state at the end of the newest committed generation, for the result. */
int mo_campaign_load_learning(struct mo_campaign_run *run);

#endif
