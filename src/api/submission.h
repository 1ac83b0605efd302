/* submission.h: shared by all submissions of work. */
#ifndef MORPHO_API_SUBMISSION_H
#define MORPHO_API_SUBMISSION_H

#include "api/handlers.h"
#include "api/requests.h"

/* JSON pointers to the causes of errors that are found only when a submission is stored. NULL: no
 * pointer; "": the whole body. */
struct mo_refusal_pointers {
  const char *controller, *limit, *empty, *conflict; /* conflict NULL: only a key can conflict */
  const char *invalid;
};

struct mo_post {
  const char *what; /* "training" */
  char key_text[256];
  struct mo_request_key key; /* of the body */
  bool parsed;               /* the body is valid: any later fault is found when it is stored */
  struct mo_refusal_pointers pointers;
  struct mo_message message; /* why it was not stored */
  struct mo_faults faults;   /* faults in the body, and in the resources that it refers to */
};

/* Handles a whole submission: checks the conditions of every submission (the body is JSON, the
 * service accepts work, the Idempotency-Key is well-formed) and calls `submit`, which reads the
 * body and stores the job. If `submit` fails without a reply, replies with its error. Returns true
 * if the job is stored; the memory of the body is then freed. */
bool mo_handle_submission(struct mo_request *request, const char *what,
                          int (*submit)(struct mo_request *request, struct mo_post *post));
/* Returns the name of the caller's token, or NULL if the request has no token. */
const char *mo_user_of(const struct mo_request *request);
/* Sets who submits a job, and the key. */
void mo_post_sign(const struct mo_request *request, const struct mo_post *post,
                  struct mo_submission *job);
/* Returns why the submission was not stored. */
const char *mo_post_words(const struct mo_post *post, int error);
/* Returns the key of a request about job `id`, filled into `known`. The same body for a different
 * job or a different action (`what`) counts as a different request. Returns NULL if no key was
 * sent. */
const struct mo_request_key *mo_post_key_of(const struct mo_post *post, const char *what,
                                            int64_t id, struct mo_request_key *known);

/* Reads the body of a request that submits no job, as mo_read_body (requests.h) does. Returns false
 * after an error reply if the body is not JSON or has faults. */
bool mo_read_request(struct mo_request *request, const struct mo_fields *fields, void *parsed,
                     struct mo_parts *parts, int (*check)(struct mo_json *json, void *parsed),
                     const char *what);
/* Replies that a body cannot be parsed, or that a key was used with a different body. */
void mo_reply_parse_error(struct mo_request *request, int error, const struct mo_faults *faults,
                          const char *what);
void mo_reply_key_conflict(struct mo_request *request, struct mo_faults *faults);

/* Returns whether to look up the resources of a request: because one of them was not found when the
 * job was stored, or because the body is invalid and the client should receive all faults at
 * once. */
bool mo_names_unknown(const struct mo_post *post, int error);
/* Look up a resource of a request: a controller for the service's workspace (NULL: none), or a job
 * of this kind (0: none). Add a fault if it does not exist. */
void mo_look_up_controller(struct mo_store *store, const char *reference, struct mo_faults *faults);
void mo_look_up_job(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *pointer,
                    struct mo_faults *faults);

#endif
