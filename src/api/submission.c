/* submission.c: see submission.h. */
#include "api/submission.h"

#include <stdio.h>

#include "store/runner.h"

/* Checks the request and reads its key. Returns false after replying with 4xx or 503. */
static bool begin(struct mo_request *request, struct mo_post *post)
{
  const char *field = request->framing.idempotency_key;
  if (!mo_check_content(request, "application/json", NULL))
    return false;
  if (!mo_http_is_ready(mo_api_of(request)->http)) {
    mo_reply_error(request, MO_ERR_CANCELLED, post->what);
    return false;
  }
  if (field == NULL)
    return true;
  if (!mo_idempotency_key(field, post->key_text)) {
    mo_reply_bad_header(request, "Idempotency-Key", "must be 1 to 255 printable ASCII characters");
    return false;
  }
  post->key.text = post->key_text;
  mo_sha256_of(request->body, request->body_size, &post->key.sha256);
  return true;
}

_Static_assert(MO_USER_BYTES_MAX == MO_TOKEN_NAME_MAX, "the store keeps whole names");

const char *mo_user_of(const struct mo_request *request)
{
  return request->caller.name[0] != '\0' ? request->caller.name : NULL;
}

void mo_post_sign(const struct mo_request *request, const struct mo_post *post,
                  struct mo_submission *job)
{
  job->submitted_by = mo_user_of(request);
  job->key = post->key;
}

const char *mo_post_words(const struct mo_post *post, int error)
{
  const char *words = post->message.text;
  return words[0] != '\0' ? words : mo_error_text(error);
}

const struct mo_request_key *mo_post_key_of(const struct mo_post *post, const char *what,
                                            int64_t id, struct mo_request_key *known)
{
  char text[MO_SHA256_DIGITS + 64];
  int n = snprintf(text, sizeof(text), "%s %lld %s", what, (long long)id,
                   MO_SHA256_HEX(&post->key.sha256));
  known->text = post->key.text;
  mo_sha256_of(text, (size_t)n, &known->sha256);
  return known->text != NULL ? known : NULL;
}

/* Returns whether the key was used with a different body. */
static bool key_conflicts(struct mo_store *store, const struct mo_post *post)
{
  int64_t id;
  return mo_store_replay(store, &post->key, &id) == MO_ERR_CONFLICT;
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

bool mo_read_request(struct mo_request *request, const struct mo_fields *fields, void *parsed,
                     struct mo_parts *parts, int (*check)(struct mo_json *json, void *parsed),
                     const char *what)
{
  struct mo_faults faults = {0};
  if (!mo_check_content(request, "application/json", NULL))
    return false;
  const int error =
      mo_read_body(request->body, request->body_size, fields, parsed, parts, check, &faults);
  if (error != MO_OK)
    mo_reply_parse_error(request, error, &faults, what);
  return error == MO_OK;
}

void mo_reply_key_conflict(struct mo_request *request, struct mo_faults *faults)
{
  mo_faults_add(faults, MO_FAULT_HEADER, "Idempotency-Key",
                "the key was used with a different body");
  mo_reply_problem(
      request, 422, faults,
      "The Idempotency-Key was used with a different body; use a new key for a new request.");
}

/* Replies with the reason why a submission was not stored. */
static void reply_not_stored(struct mo_request *request, struct mo_post *post, int error)
{
  const struct mo_refusal_pointers *pointers = &post->pointers;
  struct mo_faults *faults = &post->faults;
  const char *pointer = NULL;
  unsigned status = 422;
  switch (error) {
  case MO_ERR_NOT_FOUND:
  case MO_ERR_UNSUPPORTED:
    if (faults->n > 0) {
      mo_reply_problem(request, 422, faults, NULL);
      return;
    }
    pointer = pointers->controller;
    break;
  case MO_ERR_DUPLICATE:
  case MO_ERR_INVALID:
  case MO_ERR_RANGE: pointer = pointers->invalid; break;
  case MO_ERR_LIMIT: pointer = pointers->limit; break;
  case MO_ERR_EMPTY: pointer = pointers->empty; break;
  case MO_ERR_DEVICE: pointer = "/device"; break;
  case MO_ERR_CONFLICT:
    if (pointers->conflict == NULL || key_conflicts(mo_api_of(request)->store, post)) {
      mo_reply_key_conflict(request, faults);
      return;
    }
    status = 409;
    pointer = pointers->conflict;
    break;
  case MO_ERR_BUSY:
    mo_reply_problem(request, 503, NULL, "The queue is full; try again when some jobs have ended.");
    request->reply.retry_after_s = 10;
    return;
  default: mo_reply_error(request, error, post->what); return;
  }
  mo_faults_add(faults, MO_FAULT_BODY, pointer != NULL ? pointer : "", "%s",
                mo_post_words(post, error));
  mo_reply_problem(request, status, faults, NULL);
}

bool mo_handle_submission(struct mo_request *request, const char *what,
                          int (*submit)(struct mo_request *request, struct mo_post *post))
{
  struct mo_post post = {.what = what};
  if (!begin(request, &post))
    return false;
  int error = submit(request, &post);
  if (error == MO_OK)
    mo_request_drop_body(request); /* frees memory while this request waits for a result */
  else if (request->reply.status == 0 && post.parsed)
    reply_not_stored(request, &post, error);
  else if (request->reply.status == 0)
    mo_reply_parse_error(request, error, &post.faults, post.what);
  return error == MO_OK;
}

bool mo_names_unknown(const struct mo_post *post, int error)
{
  return error == MO_ERR_NOT_FOUND || error == MO_ERR_UNSUPPORTED ||
         (error == MO_ERR_INVALID && !post->parsed);
}

void mo_look_up_controller(struct mo_store *store, const char *reference, struct mo_faults *faults)
{
  const struct mo_workspace ours = MO_STORE_WORKSPACE;
  struct mo_controller_record controller;
  int code = reference != NULL ? mo_store_controller(store, reference, &controller) : MO_OK;
  if (code == MO_ERR_NOT_FOUND)
    mo_faults_add(faults, MO_FAULT_BODY, "/controller",
                  "controller \"%.80s\" does not exist; GET /v1/controllers lists all controllers",
                  reference);
  else if (reference != NULL && code == MO_OK &&
           (controller.workspace.nx != ours.nx || controller.workspace.ny != ours.ny ||
            controller.workspace.nz != ours.nz))
    mo_faults_add(
        faults, MO_FAULT_BODY, "/controller",
        "controller \"%.80s\" is for a workspace of %u × %u × %u voxels; use one for %u × %u × %u",
        reference, controller.workspace.nx, controller.workspace.ny, controller.workspace.nz,
        ours.nx, ours.ny, ours.nz);
}

void mo_look_up_job(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *pointer,
                    struct mo_faults *faults)
{
  struct mo_job job;
  int code = id > 0 ? mo_store_job(store, id, &job) : MO_ERR_EMPTY;
  if (code == MO_ERR_NOT_FOUND || (code == MO_OK && job.kind != kind))
    mo_faults_add(faults, MO_FAULT_BODY, pointer, "%s %lld does not exist", mo_job_kind_name(kind),
                  (long long)id);
}
