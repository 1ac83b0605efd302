/* submission.c: see submission.h. */
#include "api/submission.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/runner.h"

/* Checks the request, and reads its key. False: the 4xx or 503 is made. */
static bool begin(struct mo_request *request, const char *what, struct mo_submission_key *key)
{
  const char *field = request->framing.idempotency_key;
  *key = (struct mo_submission_key){.key = ""};
  if (!mo_check_content(request, "application/json", NULL))
    return false;
  if (!mo_http_is_ready(mo_api_of(request)->http)) {
    mo_reply_error(request, MO_ERR_CANCELLED, what);
    return false;
  }
  if (field != NULL && !mo_idempotency_key(field, key->key)) {
    mo_reply_bad_header(request, 400, "Idempotency-Key",
                        "1 to 255 printable ASCII characters are expected", NULL);
    return false;
  }
  if (field != NULL)
    mo_sha256_of(request->body, request->body_size, &key->body_sha256);
  return true;
}

bool mo_handle_submission(struct mo_request *request, const char *what,
                          bool (*submit)(struct mo_request *request,
                                         const struct mo_submission_key *key,
                                         struct mo_faults *faults))
{
  struct mo_submission_key key;
  if (!begin(request, what, &key))
    return false;
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  bool stored = false;
  if (faults == NULL)
    mo_reply_error(request, MO_ERR_NO_MEMORY, what);
  else
    stored = submit(request, &key, faults);
  free(faults);
  if (stored)
    mo_request_drop_body(request); /* frees memory while this request waits for a result */
  return stored;
}

const struct mo_request_key *mo_submission_key_of(const struct mo_submission_key *key,
                                                  const char *what, int64_t id,
                                                  struct mo_request_key *known)
{
  char digits[MO_SHA256_DIGITS + 1], text[MO_SHA256_DIGITS + 64];
  if (key->key[0] == '\0')
    return NULL;
  mo_sha256_to_hex(&key->body_sha256, digits);
  int n = snprintf(text, sizeof(text), "%s %lld %s", what, (long long)id, digits);
  known->text = key->key;
  mo_sha256_of(text, (size_t)n, &known->sha256);
  return known;
}

/* Says whether the key was used with another body. */
static bool key_conflicts(struct mo_store *store, const struct mo_submission_key *key)
{
  int64_t id;
  return key->key[0] != '\0' &&
         mo_store_replay(store, key->key, &key->body_sha256, &id) == MO_ERR_CONFLICT;
}

void mo_reply_parse_error(struct mo_request *request, int code, const struct mo_faults *faults,
                          const char *what)
{
  if (code == MO_ERR_FORMAT)
    mo_reply_problem(request, 400, faults, "The body is not JSON: %s.", faults->items[0].detail);
  else if (code == MO_ERR_INVALID)
    mo_reply_problem(request, 422, faults, NULL);
  else
    mo_reply_error(request, code, what);
}

void mo_reply_key_conflict(struct mo_request *request, struct mo_faults *faults)
{
  if (faults != NULL)
    mo_faults_add(faults, MO_FAULT_HEADER, "Idempotency-Key", "the key was used with another body");
  mo_reply_problem(
      request, 422, faults,
      "The Idempotency-Key was used with another body; use a new key for a new request.");
}

static void reply_fault(struct mo_request *request, unsigned status, const char *pointer,
                        const char *words, struct mo_faults *faults)
{
  mo_faults_add(faults, MO_FAULT_BODY, pointer != NULL ? pointer : "", "%s", words);
  mo_reply_problem(request, status, faults, NULL);
}

void mo_reply_not_stored(struct mo_request *request, const struct mo_submission_key *key, int error,
                         const struct mo_message *message,
                         const struct mo_refusal_pointers *pointers, struct mo_faults *faults,
                         const char *what)
{
  const char *words = message->text[0] != '\0' ? message->text : mo_error_text(error);
  switch (error) {
  case MO_ERR_NOT_FOUND:
  case MO_ERR_UNSUPPORTED:
    if (faults->n > 0)
      mo_reply_problem(request, 422, faults, NULL);
    else
      reply_fault(request, 422, pointers->controller, words, faults);
    break;
  case MO_ERR_DUPLICATE:
  case MO_ERR_INVALID:
  case MO_ERR_RANGE: reply_fault(request, 422, pointers->invalid, words, faults); break;
  case MO_ERR_LIMIT: reply_fault(request, 422, pointers->limit, words, faults); break;
  case MO_ERR_EMPTY: reply_fault(request, 422, pointers->empty, words, faults); break;
  case MO_ERR_DEVICE: reply_fault(request, 422, "/device", words, faults); break;
  case MO_ERR_CONFLICT:
    if (pointers->conflict == NULL || key_conflicts(mo_api_of(request)->store, key))
      mo_reply_key_conflict(request, faults);
    else
      reply_fault(request, 409, pointers->conflict, words, faults);
    break;
  case MO_ERR_BUSY:
    mo_reply_problem(request, 503, NULL, "The queue is full; try again when some work is done.");
    request->reply.retry_after_s = 10;
    break;
  default: mo_reply_error(request, error, what); break;
  }
}

void mo_look_up_controller(struct mo_store *store, const char *reference, struct mo_faults *faults)
{
  const struct mo_workspace ours = MO_DEFAULT_WORKSPACE;
  struct mo_controller_record controller;
  int code = reference != NULL ? mo_store_controller(store, reference, &controller) : MO_OK;
  if (code == MO_ERR_NOT_FOUND)
    mo_faults_add(
        faults, MO_FAULT_BODY, "/controller",
        "there is no controller \"%.80s\"; one of those in GET /v1/controllers is expected",
        reference);
  else if (reference != NULL && code == MO_OK &&
           (controller.workspace.nx != ours.nx || controller.workspace.ny != ours.ny ||
            controller.workspace.nz != ours.nz))
    mo_faults_add(faults, MO_FAULT_BODY, "/controller",
                  "controller \"%.80s\" is for a workspace of %u × %u × %u voxels; one for %u × %u "
                  "× %u is expected",
                  reference, controller.workspace.nx, controller.workspace.ny,
                  controller.workspace.nz, ours.nx, ours.ny, ours.nz);
}

void mo_look_up_job(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *pointer,
                    struct mo_faults *faults)
{
  struct mo_job *job = id > 0 ? malloc(sizeof(*job)) : NULL;
  if (job == NULL)
    return;
  int code = mo_store_job(store, id, job);
  if (code == MO_ERR_NOT_FOUND || (code == MO_OK && job->kind != kind))
    mo_faults_add(faults, MO_FAULT_BODY, pointer, "there is no %s %lld; the id of one is expected",
                  mo_job_kind_name(kind), (long long)id);
  free(job);
}
