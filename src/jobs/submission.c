/* submission.c: the common parts of all submissions: keys, texts, designs, environments, and
 * queueing. */
#include "jobs/submission.h"

#include <stdlib.h>

#include "base/words.h"

/* ---- queueing ---- */

static int explain(int error, const char *controller, struct mo_message *message)
{
  switch (error) {
  case MO_ERR_NOT_FOUND:
    return mo_fail(message, error, "controller \"%.80s\" does not exist", controller);
  case MO_ERR_CONFLICT:
    return mo_fail(message, error,
                   "the idempotency key was used with a different request; use a new key");
  case MO_ERR_UNSUPPORTED:
    return mo_fail(message, error, "controller \"%.80s\" is for a different workspace", controller);
  case MO_ERR_RANGE:
    return mo_fail(message, error,
                   "the control period of controller \"%.80s\" must be a whole multiple of "
                   "physics.dt_s, and at most %d times it where a controller learns; choose "
                   "another dt_s, or set physics.control_period_s",
                   controller, MO_GRADIENT_PERIOD_MAX);
  case MO_ERR_EMPTY:
    return mo_fail(message, error, "no design of that campaign fits the requested workspace");
  case MO_ERR_NO_SPACE:
    return mo_fail(message, error, "the disk of the state folder is full; free some space");
  default: return mo_fail(message, error, "the job could not be stored: %s", mo_error_text(error));
  }
}

int mo_submitting_begin(struct mo_jobs *jobs, const struct mo_submitting *submitting, int64_t *id,
                        bool *replayed, struct mo_message *message)
{
  *replayed = false;
  if (atomic_load(&jobs->is_stopping))
    return mo_fail(message, MO_ERR_CANCELLED, "the service is stopping");
  const int error = mo_store_replay(jobs->store, &submitting->request->key, id);
  *replayed = error == MO_OK;
  return error == MO_OK || error == MO_ERR_NOT_FOUND
             ? MO_OK
             : explain(error, submitting->controller, message);
}

int mo_submitting_end(struct mo_jobs *jobs, const struct mo_submitting *submitting, int error,
                      bool replayed, struct mo_message *message)
{
  if (error != MO_OK || replayed)
    mo_jobs_closed(jobs, submitting->n_jobs, submitting->rollouts);
  if (error != MO_OK)
    return explain(error, submitting->controller, message);
  if (!replayed) {
    atomic_fetch_add(&jobs->jobs_submitted, submitting->n_jobs);
    mo_runners_wake(&jobs->runners[submitting->kind]);
  }
  return MO_OK;
}

/* ---- parts of requests ---- */

int mo_placed_create(struct mo_workspace workspace, const struct mo_bits *asked, uint32_t n,
                     struct mo_placed *placed)
{
  placed->forms = calloc((size_t)n + 1, sizeof(*placed->forms));
  placed->genotypes = calloc((size_t)n + 1, sizeof(*placed->genotypes));
  if (placed->forms == NULL || placed->genotypes == NULL) {
    mo_placed_free(placed);
    return MO_ERR_NO_MEMORY;
  }
  for (uint32_t i = 0; i < n; i++) {
    placed->genotypes[i] = asked[i];
    mo_genotype_place(workspace, placed->genotypes[i].words);
    mo_genotype_canonical(workspace, placed->genotypes[i].words, placed->forms[i].words);
  }
  return MO_OK;
}

void mo_placed_free(struct mo_placed *placed)
{
  free(placed->forms);
  free(placed->genotypes);
  *placed = (struct mo_placed){NULL, NULL};
}

int mo_placed_orient(struct mo_jobs *jobs, const struct mo_orienting *under,
                     enum mo_back_end back_end, struct mo_placed *placed, uint32_t n,
                     struct mo_design_note *notes, uint32_t n_notes, struct mo_message *message)
{
  struct mo_orienting of_class = *under;
  of_class.workers = jobs->classes.cpu[under->precision];
  of_class.fingerprint =
      back_end == MO_ON_DEVICE ? mo_back_end_fingerprint(jobs, back_end) : of_class.workers;
  const int error = mo_store_orient(jobs->store, &of_class, placed->genotypes, n, notes, n_notes);
  return error == MO_OK ? MO_OK
                        : mo_fail(message, error, "the stored scores cannot be read: %s",
                                  mo_error_text(error));
}

int mo_environments_count(struct mo_jobs *jobs, const char *set, uint32_t *n,
                          struct mo_message *message)
{
  const uint32_t n_suite = mo_suite_environments(mo_word_index(mo_suite_words, set));
  const int error = n_suite > 0 ? MO_OK : mo_store_environment_set_size(jobs->store, set, n);
  if (n_suite > 0)
    *n = n_suite;
  return error == MO_OK ? MO_OK
                        : mo_fail(message, error, "unknown set of environments \"%.64s\"", set);
}
