/* records.c: names of states and kinds, and the functions that free what the store returns. */
#include "base/words.h"
#include "store/runner.h"

#include <stdlib.h>
#include <string.h>

const char *const mo_job_state_words[] = {"queued", "running",   "paused", "succeeded",
                                          "failed", "cancelled", NULL};
const char *const mo_job_kind_words[] = {"evaluation", "training", "campaign", NULL};

const char *mo_job_state_name(enum mo_job_state state)
{
  return mo_word(mo_job_state_words, state);
}

const char *mo_job_kind_name(enum mo_job_kind kind)
{
  return mo_word(mo_job_kind_words, kind);
}

void mo_design_free(void *any)
{
  struct mo_design *design = any;
  if (design == NULL)
    return;
  for (uint32_t i = 0; i < design->n_orientations; i++)
    free(design->orientations[i].scores);
  free(design->orientations);
  free(design);
}

void mo_evaluation_results_free(void *any)
{
  struct mo_evaluation_results *results = any;
  if (results == NULL)
    return;
  free(results->forms);
  free(results->genotypes);
  free(results->scores);
  free(results->losses);
  free(results->diverged_steps);
  free(results->stored_losses);
  free(results->agrees);
  free(results->notes);
  free(results->is_bound);
  free(results->paths_m);
  free(results);
}

void mo_trajectory_free(void *any)
{
  struct mo_trajectory *trajectory = any;
  if (trajectory == NULL)
    return;
  mo_recording_free(&trajectory->recording);
  free(trajectory);
}

void mo_work_free(struct mo_work *work)
{
  if (work == NULL)
    return;
  free(work->environment_rows);
  free(work->environments);
  free(work->genotype_rows);
  free(work->positions);
  free(work->genotypes);
  free(work->finished);
  free(work);
}
