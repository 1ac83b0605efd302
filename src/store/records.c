/* records.c: names of states and kinds, and the functions that free what the store returns. */
#include "store/runner.h"

#include <stdlib.h>
#include <string.h>

static const char *const state_names[MO_JOB_STATES] = {"queued",    "running", "paused",
                                                       "succeeded", "failed",  "cancelled"};
static const char *const kind_names[] = {"evaluation", "training", "campaign"};

const char *mo_job_state_name(enum mo_job_state state)
{
  return (unsigned)state < MO_JOB_STATES ? state_names[state] : "unknown";
}

int mo_job_state_from_name(const char *name, enum mo_job_state *state)
{
  for (int i = 0; i < MO_JOB_STATES; i++)
    if (strcmp(name, state_names[i]) == 0) {
      *state = (enum mo_job_state)i;
      return MO_OK;
    }
  return MO_ERR_NOT_FOUND;
}

const char *mo_job_kind_name(enum mo_job_kind kind)
{
  return (unsigned)kind < sizeof(kind_names) / sizeof(kind_names[0]) ? kind_names[kind] : "unknown";
}

int mo_job_kind_from_name(const char *name, enum mo_job_kind *kind)
{
  for (size_t i = 0; i < sizeof(kind_names) / sizeof(kind_names[0]); i++)
    if (strcmp(name, kind_names[i]) == 0) {
      *kind = (enum mo_job_kind)i;
      return MO_OK;
    }
  return MO_ERR_NOT_FOUND;
}

void mo_design_free(struct mo_design *design)
{
  if (design == NULL)
    return;
  for (uint32_t i = 0; i < design->n_orientations; i++)
    free(design->orientations[i].scores);
  free(design->orientations);
  free(design);
}

void mo_evaluation_results_free(struct mo_evaluation_results *results)
{
  if (results == NULL)
    return;
  free(results->forms);
  free(results->genotypes);
  free(results->scores);
  free(results->losses);
  free(results->diverged_steps);
  free(results->stored_losses);
  free(results->agrees);
  free(results);
}

void mo_trajectory_free(struct mo_trajectory *trajectory)
{
  if (trajectory == NULL)
    return;
  free(trajectory->com_m);
  free(trajectory->mass_m);
  free(trajectory);
}

void mo_work_free(struct mo_work *work)
{
  if (work == NULL)
    return;
  free(work->environment_rows);
  free(work->environments);
  free(work->genotype_rows);
  free(work->genotypes);
  free(work->finished);
  free(work);
}
