/* submission.c: what the submissions of all kinds have in common: keys, texts, designs,
 * environments, and the way into the queue. */
#include "jobs/submission.h"

#include <stdlib.h>
#include <string.h>

#include "base/text.h"

/* ---- the way into the queue ---- */

static int explain(int error, const char *controller, struct mo_message *message)
{
  switch (error) {
  case MO_ERR_NOT_FOUND:
    return mo_fail(message, error, "there is no controller \"%.80s\"", controller);
  case MO_ERR_CONFLICT:
    return mo_fail(message, error, "the idempotency key was used with another request");
  case MO_ERR_UNSUPPORTED:
    return mo_fail(message, error, "controller \"%.80s\" is for another workspace", controller);
  case MO_ERR_NO_SPACE: return mo_fail(message, error, "the disk of the state folder is full");
  default: return mo_fail(message, error, "the job could not be stored: %s", mo_error_text(error));
  }
}

static int check_texts(const struct mo_submission *request, struct mo_message *message)
{
  const char *label = request->label, *key = request->key.text;
  if (label != NULL && strlen(label) > MO_LABEL_BYTES_MAX)
    return mo_fail(message, MO_ERR_RANGE, "the label is longer than %d bytes", MO_LABEL_BYTES_MAX);
  if (key != NULL && (key[0] == '\0' || strlen(key) > MO_IDEMPOTENCY_BYTES_MAX))
    return mo_fail(message, MO_ERR_RANGE, "an idempotency key has 1 to %d bytes",
                   MO_IDEMPOTENCY_BYTES_MAX);
  return MO_OK;
}

int mo_submitting_begin(struct mo_jobs *jobs, const struct mo_submitting *submitting, int64_t *id,
                        bool *replayed, struct mo_message *message)
{
  const double weight = submitting->request->weight;
  int error;
  *replayed = false;
  if (atomic_load(&jobs->is_stopping))
    return mo_fail(message, MO_ERR_CANCELLED, "the service is stopping");
  if (weight != 0 && !(weight >= MO_WEIGHT_MIN && weight <= MO_WEIGHT_MAX)) /* 0: not given */
    return mo_fail(message, MO_ERR_RANGE, "a weight is %s to %s, not %s", MO_NUMBER(MO_WEIGHT_MIN),
                   MO_NUMBER(MO_WEIGHT_MAX), MO_NUMBER(weight));
  error = check_texts(submitting->request, message);
  if (error != MO_OK)
    return error;
  error = mo_store_replay(jobs->store, &submitting->request->key, id);
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

static int place(const struct mo_bits *asked, uint32_t n, struct mo_placed *placed,
                 struct mo_message *message)
{
  for (uint32_t i = 0; i < n; i++) {
    uint64_t *words = placed->genotypes[i].words;
    int contiguous;
    placed->genotypes[i] = asked[i];
    if (mo_genotype_count(MO_DEFAULT_WORKSPACE, words) == 0)
      return mo_fail(message, MO_ERR_INVALID, "design %u is empty", (unsigned)i);
    contiguous = mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, words);
    if (contiguous < 0)
      return contiguous;
    if (contiguous == 0)
      return mo_fail(message, MO_ERR_INVALID, "design %u is not in one piece", (unsigned)i);
    mo_genotype_place(MO_DEFAULT_WORKSPACE, words);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, words, placed->forms[i].words);
  }
  return MO_OK;
}

int mo_placed_create(const struct mo_bits *asked, uint32_t n, struct mo_placed *placed,
                     struct mo_message *message)
{
  int error;
  placed->forms = calloc((size_t)n + 1, sizeof(*placed->forms));
  placed->genotypes = calloc((size_t)n + 1, sizeof(*placed->genotypes));
  error = placed->forms == NULL || placed->genotypes == NULL
              ? mo_fail(message, MO_ERR_NO_MEMORY, "out of memory")
              : place(asked, n, placed, message);
  if (error != MO_OK)
    mo_placed_free(placed);
  return error;
}

void mo_placed_free(struct mo_placed *placed)
{
  free(placed->forms);
  free(placed->genotypes);
  *placed = (struct mo_placed){NULL, NULL};
}

int mo_environments_check(const struct mo_environment *environments, uint32_t n, const char *whose,
                          struct mo_message *message)
{
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "%s has 1 to %d environments, not %u", whose,
                   MO_ENVIRONMENTS_MAX, (unsigned)n);
  for (uint32_t k = 0; k < n; k++) {
    uint32_t where = 0;
    int error = mo_environment_check(&environments[k], &where);
    if (error != MO_OK)
      return mo_fail(message, error, "environment %u: value %u is not finite or out of range",
                     (unsigned)k, (unsigned)where);
  }
  return MO_OK;
}

int mo_environments_count(struct mo_jobs *jobs, const char *set, uint32_t *n,
                          struct mo_message *message)
{
  const int error = mo_store_environment_set_size(jobs->store, set, n);
  return error == MO_OK ? MO_OK
                        : mo_fail(message, error, "there is no set of environments \"%.64s\"", set);
}

int mo_result_check(const char *name, int priority, struct mo_message *message)
{
  if (name[0] != '\0' && mo_controller_name_check(name) != MO_OK)
    return mo_fail(message, MO_ERR_INVALID, "\"%.64s\" is not a name of a controller", name);
  if (priority != MO_BATCH && priority != MO_INTERACTIVE)
    return mo_fail(message, MO_ERR_INVALID, "no such priority");
  return MO_OK;
}
