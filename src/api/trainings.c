/* trainings.c: trainings: submission, state, lists. */
#include <stdlib.h>
#include <string.h>

#include "api/job_reply.h"
#include "api/requests.h"
#include "api/submission.h"
#include "api/training_json.h"

/* ---- the kind ---- */

static int read_status(struct mo_store *store, int64_t id, void *status)
{
  return mo_store_training(store, id, status);
}

static int64_t read_page(struct mo_store *store, const struct mo_campaign_query *query,
                         void *statuses, size_t limit)
{
  const struct mo_job_query jobs = {.before = query->before,
                                    .state = query->state,
                                    .kind = -1,
                                    .label = query->label,
                                    .waiting = query->waiting,
                                    .n_waiting = query->n_waiting};
  return mo_store_trainings(store, &jobs, statuses, limit);
}

/* Returns the kind of the job whose designs a training learns from. */
static enum mo_job_kind population_kind(struct mo_store *store,
                                        const struct mo_training_status *status)
{
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  struct mo_job *job = status->record.population > 0 ? malloc(sizeof(*job)) : NULL;
  if (job != NULL && mo_store_job(store, status->record.population, job) == MO_OK)
    kind = job->kind;
  free(job);
  return kind;
}

static int write_whole(struct mo_api *api, struct mo_text *text, const void *status,
                       const struct mo_live *live)
{
  mo_training_json_write(text, status, population_kind(api->store, status), live);
  return MO_OK;
}

const struct mo_resource mo_training_resource = {.kind = MO_JOB_TRAINING,
                                                 .path = "/v1/trainings",
                                                 .status_size = sizeof(struct mo_training_status),
                                                 .read = read_status,
                                                 .page = read_page,
                                                 .has_live = true,
                                                 .write = write_whole,
                                                 .write_job = mo_training_json_job};

/* ---- routes ---- */

static const char *population_pointer(const struct mo_parsed_training *parsed)
{
  return parsed->population_kind == MO_JOB_CAMPAIGN ? "/population/campaign"
                                                    : "/population/evaluation";
}

/* Checks that what the request names exists, and adds all faults to those of the body. */
static void look_up(struct mo_store *store, const struct mo_parsed_training *parsed,
                    struct mo_faults *faults)
{
  mo_look_up_controller(store, parsed->request.parent, faults);
  mo_look_up_job(store, parsed->request.population, parsed->population_kind,
                 population_pointer(parsed), faults);
}

/* Parses and stores the training. False: a reply was made. */
static bool submit(struct mo_request *request, const struct mo_submission_key *key,
                   struct mo_faults *faults)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_parsed_training *parsed = malloc(sizeof(*parsed));
  if (parsed == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "training");
    return false;
  }
  int code = mo_training_parse(request->body, request->body_size, parsed, faults);
  if (code == MO_OK) /* the job with this id may be of another kind */
    mo_look_up_job(api->store, parsed->request.population, parsed->population_kind,
                   population_pointer(parsed), faults);
  if (code == MO_OK && faults->n > 0)
    mo_look_up_controller(api->store, parsed->request.parent, faults);
  if (code == MO_OK && faults->n > 0) {
    code = MO_ERR_INVALID;
    mo_reply_problem(request, 422, faults, NULL);
  } else if (code == MO_OK) {
    struct mo_message message = {""};
    bool replayed;
    parsed->request.idempotency_key = key->key[0] != '\0' ? key->key : NULL;
    parsed->request.body_sha256 = key->body_sha256;
    code =
        mo_jobs_submit_training(api->jobs, &parsed->request, &request->kept, &replayed, &message);
    if (code == MO_ERR_NOT_FOUND || code == MO_ERR_UNSUPPORTED)
      look_up(api->store, parsed, faults);
    const struct mo_refusal_pointers pointers = {
        .empty = parsed->request.population > 0 ? "/population" : "/designs",
        .conflict = parsed->request.population > 0 ? population_pointer(parsed) : NULL};
    if (code != MO_OK)
      mo_reply_not_stored(request, key, code, &message, &pointers, faults, "training");
  } else {
    if (code == MO_ERR_INVALID)
      look_up(api->store, parsed, faults);
    mo_reply_parse_error(request, code, faults, "training");
  }
  mo_training_parsed_free(parsed);
  free(parsed);
  return code == MO_OK;
}

void mo_api_post_training(struct mo_request *request)
{
  if (mo_handle_submission(request, "training", submit))
    mo_reply_submitted(request, &mo_training_resource, request->kept, false);
}

void mo_api_get_training(struct mo_request *request)
{
  mo_get_of_kind(request, &mo_training_resource);
}

void mo_api_list_trainings(struct mo_request *request)
{
  mo_list_of_kind(request, &mo_training_resource, 0);
}
