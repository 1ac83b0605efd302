/* champions.c: the champions of a campaign, and recordings of them. */
#include <stdlib.h>

#include "api/campaign_json.h"
#include "api/job_reply.h"
#include "api/requests.h"
#include "api/submission.h"

void mo_api_get_campaign_champions(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  int64_t id, count = 12, generation = -1;
  if (!mo_query_number(request, "count", 1, MO_CHAMPIONS_MAX, &count) ||
      !mo_query_number(request, "generation", 0, MO_GENERATIONS_MAX, &generation) ||
      !mo_path_id(request, 0, &id))
    return;
  struct mo_campaign_status *status = malloc(sizeof(*status));
  struct mo_campaign_design *rows = malloc((size_t)count * sizeof(*rows));
  double *distinctiveness = malloc((size_t)count * sizeof(*distinctiveness));
  uint32_t n = 0;
  bool memory = status != NULL && rows != NULL && distinctiveness != NULL;
  int code = memory ? mo_store_campaign(api->store, id, status) : MO_ERR_NO_MEMORY;
  bool known = code == MO_OK;
  if (known && generation < 0)
    generation = status->generation;
  if (known)
    code = generation >= 0 ? mo_jobs_campaign_champions(api->jobs, id, generation, (uint32_t)count,
                                                        rows, distinctiveness, &n)
                           : MO_ERR_NOT_FOUND;
  if (code == MO_ERR_NOT_FOUND && known) {
    mo_reply_problem(request, 404, NULL,
                     status->generation < 0 ? "The campaign has no population yet."
                                            : "The campaign has no such generation.");
  } else if (code != MO_OK) {
    mo_reply_error(request, code, "campaign");
  } else {
    struct mo_text text = {0};
    mo_text_format(&text, "{\"generation\":%lld,\"items\":[", (long long)generation);
    for (uint32_t i = 0; i < n; i++) {
      mo_text_add(&text, i > 0 ? ",{" : "{");
      mo_campaign_json_design(&text, &rows[i]);
      mo_text_member_number(&text, "distinctiveness", distinctiveness[i]);
      mo_text_add(&text, "}");
    }
    mo_text_add(&text, "]}");
    mo_reply_text(request, MO_OK, &text, "campaign");
  }
  free(status);
  free(rows);
  free(distinctiveness);
}

static void record_error(struct mo_request *request, const struct mo_submission_key *key, int code,
                         const struct mo_message *message, struct mo_faults *faults)
{
  static const struct mo_refusal_pointers nowhere = {0};
  const char *words = message->text[0] != '\0' ? message->text : mo_error_text(code);
  switch (code) {
  case MO_ERR_NOT_FOUND:
  case MO_ERR_CONFLICT:
    mo_reply_problem(request, 409, NULL, "The campaign's champions cannot be recorded: %s.", words);
    break;
  case MO_ERR_DUPLICATE: mo_reply_key_conflict(request, faults); break;
  default: mo_reply_not_stored(request, key, code, message, &nowhere, faults, "campaign"); break;
  }
}

static bool record(struct mo_request *request, const struct mo_submission_key *key,
                   struct mo_faults *faults)
{
  struct mo_message message = {""};
  struct mo_request_key known;
  uint32_t count = 12, stride = 10;
  int64_t id;
  if (!mo_path_job(request, MO_JOB_CAMPAIGN, &id))
    return false;
  int code = mo_champions_parse(request->body, request->body_size, &count, &stride, faults);
  if (code != MO_OK) {
    mo_reply_parse_error(request, code, faults, "evaluation");
    return false;
  }
  code = mo_jobs_campaign_record_champions(mo_api_of(request)->jobs, id, count, stride,
                                           mo_submission_key_of(key, "champions", id, &known),
                                           &request->kept, &message);
  if (code != MO_OK)
    record_error(request, key, code, &message, faults);
  return code == MO_OK;
}

void mo_api_post_campaign_champions(struct mo_request *request)
{
  if (mo_handle_submission(request, "evaluation", record))
    mo_reply_submitted(request, &mo_evaluation_resource, request->kept, false);
}
