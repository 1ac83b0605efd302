/* champions.c: the champions of a campaign, and recordings of them. */
#include <limits.h>
#include <stdlib.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "api/submission.h"
#include "base/words.h"

#define CHAMPIONS_MAX 1000

/* Writes the re-evaluation in which the champions may have taken part; nothing if the campaign has
 none.
 */
static int write_re_evaluated(struct mo_text *text, struct mo_store *store,
                              const struct mo_campaign_status *status, int64_t generation)
{
  const struct mo_re_evaluation *settings = &status->record.re_evaluate;
  int64_t newest;
  if (settings->every == 0)
    return MO_OK;
  const int error = mo_store_campaign_re_evaluated(store, status->job.id, generation, &newest);
  mo_text_name(text, "re_evaluated");
  if (error == MO_OK)
    mo_text_format(text, "{\"generation\":%lld,\"designs\":%u,\"champions\":%u}", (long long)newest,
                   (unsigned)settings->designs, (unsigned)MO_CHAMPIONS_USUAL);
  else
    mo_text_add(text, "null");
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

void mo_api_get_campaign_champions(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_campaign_status status;
  int64_t id, count = MO_CHAMPIONS_USUAL, generation = -1;
  uint32_t n = 0;
  if (!mo_query_number(request, "count", 1, CHAMPIONS_MAX, &count) ||
      !mo_query_number(request, "generation", 0, MO_GENERATIONS_MAX, &generation) ||
      !mo_path_id(request, 0, &id))
    return;
  struct mo_campaign_design *rows = malloc((size_t)count * sizeof(*rows));
  double *distinctiveness = malloc((size_t)count * sizeof(*distinctiveness));
  int error = rows != NULL && distinctiveness != NULL ? mo_store_campaign(api->store, id, &status)
                                                      : MO_ERR_NO_MEMORY;
  const bool known = error == MO_OK;
  if (known && generation < 0)
    generation = status.generation;
  if (known)
    error = generation >= 0 ? mo_jobs_campaign_champions(api->jobs, id, generation, (uint32_t)count,
                                                         rows, distinctiveness, &n)
                            : MO_ERR_NOT_FOUND;
  if (error == MO_ERR_NOT_FOUND && known) {
    mo_reply_problem(request, 404, NULL,
                     status.generation < 0 ? "The campaign has no population yet."
                                           : "The campaign does not have this generation.");
  } else {
    struct mo_text text = {0};
    mo_text_format(&text, "{\"generation\":%lld", (long long)generation);
    mo_member_own_score(&text, &status.record.own_score);
    mo_member_fresh_worlds(&text, &status.record);
    if (error == MO_OK)
      error = write_re_evaluated(&text, api->store, &status, generation);
    mo_text_open(&text, "items", "[");
    for (uint32_t i = 0; i < n; i++) {
      mo_text_object(&text);
      mo_campaign_json_design(&text, &rows[i], &status.words);
      mo_text_member_number(&text, "distinctiveness", distinctiveness[i]);
      mo_text_add(&text, "}");
    }
    mo_text_add(&text, "]}");
    mo_reply_text(request, error, &text, "campaign");
  }
  free(rows);
  free(distinctiveness);
}

struct asked {
  struct mo_champions_request request; /* record is NOT_GIVEN unless the request has it */
  struct mo_parts parts;
};
#define NOT_GIVEN UINT_MAX

#define AT(member) offsetof(struct asked, member)
static const struct mo_field champion_rows[] = {
    {"count", MO_FIELD_COUNT, 0, AT(request.count), .min = 1, .max = CHAMPIONS_MAX},
    {"record", MO_FIELD_OWN, 0, AT(request.record), .own = &mo_channels_field},
    {"stride", MO_FIELD_COUNT, 0, AT(request.stride), .min = 1, .max = MO_STEPS_MAX},
    {"environments", MO_FIELD_OWN, 0, AT(parts), .own = &mo_environments_field},
    {"controller", MO_FIELD_OWN, 0, AT(parts), .own = &mo_controller_field},
    {"label", MO_FIELD_OWN, 0, AT(parts), .own = &mo_label_field},
};
#undef AT
static const struct mo_fields fields = MO_FIELDS(champion_rows);

/* Recording is the default only in the campaign's own environments. */
static int check(struct mo_json *json, void *any)
{
  struct asked *asked = any;
  struct mo_champions_request *request = &asked->request;
  const struct mo_parts *parts = &asked->parts;
  const bool is_suite =
      parts->environment_set != NULL && mo_word_index(mo_suite_words, parts->environment_set) >= 0;
  if (parts->no_controller)
    mo_json_fault_at(json, 0, "/controller", "must be a controller's name, got null");
  if (is_suite && request->record != NOT_GIVEN && request->record != 0)
    mo_json_fault_at(json, 0, "/record",
                     "cannot be combined with a suite; give the set of one of its tasks, such as "
                     "morpho-12-walk");
  if (request->record == NOT_GIVEN)
    request->record = parts->has_environments ? 0 : MO_RECORD_COM;
  request->environment_set = parts->environment_set;
  request->controller = mo_parts_controller(parts);
  request->label = parts->job.label;
  return MO_OK;
}

static int record(struct mo_request *request, struct mo_post *post)
{
  struct mo_request_key known;
  struct asked asked = {.request = {.count = MO_CHAMPIONS_USUAL, .stride = 10, .record = NOT_GIVEN},
                        .parts = {.takes_suites = true, .only_named = true}};
  int64_t id;
  if (!mo_path_job(request, &id))
    return MO_ERR_NOT_FOUND;
  int error = mo_read_body(request->body, request->body_size, &fields, &asked, &asked.parts, check,
                           &post->faults);
  if (error == MO_OK) {
    post->parsed = true;
    post->what = "campaign";
    post->pointers = (struct mo_refusal_pointers){.controller = "/controller"};
    asked.request.submitted_by = mo_user_of(request);
    error = mo_jobs_campaign_record_champions(mo_api_of(request)->jobs, id, &asked.request,
                                              mo_post_key_of(post, "champions", id, &known),
                                              &request->kept, &post->message);
  }
  if (error == MO_ERR_NOT_FOUND && post->parsed)
    mo_look_up_controller(mo_api_of(request)->store, asked.request.controller, &post->faults);
  mo_parts_free(&asked.parts);
  if (!post->parsed || post->faults.n > 0)
    return error;
  if (error == MO_ERR_NOT_FOUND || error == MO_ERR_CONFLICT)
    mo_reply_problem(request, 409, NULL, "The campaign's champions cannot be evaluated: %s.",
                     mo_post_words(post, error));
  else if (error == MO_ERR_DUPLICATE)
    mo_reply_key_conflict(request, &post->faults);
  return error;
}

void mo_api_post_campaign_champions(struct mo_request *request)
{
  if (mo_handle_submission(request, "evaluation", record))
    mo_reply_submitted(request, &mo_evaluation_resource, request->kept, false);
}
