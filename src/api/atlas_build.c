/* atlas_build.c: jobs that build atlases: submission and state. */
#include "api/atlas_request.h"
#include "api/job_json.h"
#include "api/jobs.h"
#include "api/submission.h"
#include "base/words.h"
#include "exchange/values.h"
#include "rollout/physics.h"

/* ---- as JSON ---- */

static void write_progress(struct mo_text *text, const struct mo_live *live)
{
  const bool runs = live->phase != MO_PHASE_IDLE;
  mo_text_open(text, "progress", "{");
  mo_member_number_if(text, "rollouts_per_s", runs && live->rate > 0, live->rate);
  mo_member_number_if(text, "seconds_left", runs && live->seconds_left >= 0, live->seconds_left);
  mo_member_number_if(text, "busy_s", runs && live->busy_s >= 0, live->busy_s);
  mo_text_add(text, "}");
}

static void write_job(struct mo_text *text, const void *any, const struct mo_live *live)
{
  const struct mo_atlas_status *status = any;
  const struct mo_atlas_record *record = &status->record;
  const struct mo_job *job = &status->job;
  const uint64_t total = live->total > 0 ? live->total : record->bodies_total;
  mo_text_object(text);
  mo_text_member_id(text, "id", job->id);
  mo_text_member(text, "kind", mo_job_kind_name(job->kind));
  mo_job_write_head(text, job, live);
  mo_text_open(text, "atlas", "{");
  mo_text_member(text, "name", record->name);
  mo_text_member_count(text, "voxels", record->voxels);
  mo_text_member(text, "orientations", mo_atlas_orientation_words[record->orientations]);
  mo_member_measures(text, "measures", record->measures);
  mo_member_controller(text, "controller", true, job->controller_name, &job->controller_sha256);
  mo_member_environments(text, job->environment_set, job->n_environments);
  mo_text_name(text, "physics");
  mo_fields_write_object(text, &mo_physics_fields, &job->physics);
  mo_text_member(text, "phase", mo_phase_name(live->phase));
  mo_text_member_count(text, "bodies_done", live->total > 0 ? live->done : record->bodies_done);
  mo_member_count_if(text, "bodies_total", total > 0, total);
  mo_text_member_count(text, "rollouts_done", record->rollouts_done);
  write_progress(text, live);
  mo_text_add(text, "}}");
}

/* ---- the kind ---- */

static int read_status(struct mo_store *store, int64_t id, union mo_job_status *status)
{
  return mo_store_atlas(store, id, &status->atlas);
}

/* Builds are read and listed only as jobs, because GET /v1/atlases lists finished files. */
const struct mo_resource mo_atlas_resource = {.kind = MO_JOB_ATLAS,
                                              .path = "/v1/atlases",
                                              .status_size = sizeof(struct mo_atlas_status),
                                              .read = read_status,
                                              .write_job = write_job};

/* ---- submission ---- */

static int submit(struct mo_request *request, struct mo_post *post)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_faults *faults = &post->faults;
  struct mo_parsed_atlas parsed;
  bool replayed;
  int error = mo_atlas_parse(request->body, request->body_size, &parsed, faults);
  const bool invalid = error == MO_ERR_INVALID;
  if (invalid)
    mo_look_up_controller(api->store, parsed.request.controller, faults);
  if (error == MO_OK) {
    post->parsed = true;
    post->pointers = (struct mo_refusal_pointers){.limit = "/voxels", .invalid = "/physics"};
    mo_post_sign(request, post, &parsed.request.job);
    error =
        mo_jobs_submit_atlas(api->jobs, &parsed.request, &request->kept, &replayed, &post->message);
    if (error == MO_ERR_DUPLICATE) {
      mo_faults_add(faults, MO_FAULT_BODY, "/name", "%s", mo_post_words(post, error));
      mo_reply_problem(request, 409, faults, NULL);
    }
  }
  if (!invalid && mo_names_unknown(post, error))
    mo_look_up_controller(api->store, parsed.request.controller, faults);
  mo_parts_free(&parsed.parts);
  return error;
}

void mo_api_post_atlas(struct mo_request *request)
{
  if (!mo_handle_submission(request, "atlas", submit) ||
      mo_reply_job(request, 202, &mo_atlas_resource, request->kept, false) != MO_OK)
    return;
  snprintf(request->reply.location, sizeof(request->reply.location), "/v1/jobs/%lld",
           (long long)request->kept);
  request->reply.retry_after_s = 1;
}
