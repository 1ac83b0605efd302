/* rollouts.c: POST /v1/rollouts: computes rollouts that are not stored, and replies with a scene or
 * JSON. */
#include "api/scene.h"
#include "api/states.h"
#include "api/submission.h"

static void refuse(struct mo_request *request, int error, const struct mo_message *message,
                   struct mo_faults *faults)
{
  const char *words = message->text[0] != '\0' ? message->text : mo_error_text(error);
  const bool unknown = error == MO_ERR_NOT_FOUND || error == MO_ERR_UNSUPPORTED;
  const char *pointer = unknown                    ? "/controller"
                        : error == MO_ERR_LIMIT    ? ""
                        : error == MO_ERR_CONFLICT ? "/states"
                                                   : "/designs";
  switch (error) {
  case MO_ERR_NOT_FOUND:
  case MO_ERR_UNSUPPORTED:
  case MO_ERR_INVALID:
  case MO_ERR_RANGE:
  case MO_ERR_LIMIT:
  case MO_ERR_CONFLICT:
    mo_faults_add(faults, MO_FAULT_BODY, pointer, "%s", words);
    mo_reply_problem(request, 422, faults, NULL);
    return;
  default: mo_reply_error(request, error, "rollout");
  }
}

void mo_api_post_rollouts(struct mo_request *request)
{
  static const char *const types[] = {"application/json", MO_SCENE_TYPE, NULL};
  struct mo_parsed_rollouts parsed;
  struct mo_rollouts *rollouts = NULL;
  struct mo_message message = {{0}};
  struct mo_faults faults = {0};
  int form;
  if (!mo_check_content(request, "application/json", NULL) || !mo_accept(request, types, &form))
    return;
  int error = mo_rollouts_parse(request->body, request->body_size, &parsed, &faults);
  struct mo_evaluation_request *wanted = &parsed.evaluation.request;
  const struct mo_rollout_states states = {parsed.states.list, parsed.states.n,
                                           parsed.states.wants_final};
  if (form == 0) /* JSON has no recordings: make none */
    wanted->record = 0;
  if (error != MO_OK)
    mo_reply_parse_error(request, error, &faults, "rollout");
  else if ((error = mo_jobs_roll(mo_api_of(request)->jobs, wanted, &states, request->is_crowded,
                                 &rollouts, &message)) != MO_OK)
    refuse(request, error, &message, &faults);
  else
    mo_reply_rollouts(request, rollouts,
                      form == 0                    ? MO_ROLLOUTS_JSON
                      : parsed.states.int16_masses ? MO_ROLLOUTS_INT16
                                                   : MO_ROLLOUTS_SCENE);
  mo_rollouts_free(rollouts);
  mo_states_free(&parsed.states);
  mo_parts_free(&parsed.evaluation.parts);
}
