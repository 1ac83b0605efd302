/* certificates.c: certificates: submission and state. */
#include <stdlib.h>

#include "api/certificate_request.h"
#include "api/certificates.h"
#include "api/job_json.h"
#include "api/jobs.h"
#include "api/submission.h"
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

static void write_population(struct mo_text *text, enum mo_job_kind kind, int64_t population)
{
  if (population == 0) {
    mo_text_member(text, "population", NULL);
    return;
  }
  mo_text_open(text, "population", "{");
  mo_text_member_id(text, mo_job_kind_name(kind), population);
  mo_text_add(text, "}");
}

/* Writes which settings were taken from the job with the designs. */
static void write_taken(struct mo_text *text, uint32_t taken)
{
  static const char *const words[] = {"controller", "environments", "physics"};
  mo_text_open(text, "from_population", "[");
  for (unsigned i = 0; i < 3; i++)
    if (taken >> i & 1) {
      mo_text_next(text);
      mo_text_format(text, "\"%s\"", words[i]);
    }
  mo_text_add(text, "]");
}

static enum mo_job_kind population_kind(struct mo_store *store, int64_t population)
{
  struct mo_job job;
  return population > 0 && mo_store_job(store, population, &job) == MO_OK ? job.kind
                                                                          : MO_JOB_EVALUATION;
}

/* Writes the job and leaves the object open. */
static void write_open(struct mo_text *text, const void *any, const struct mo_live *live)
{
  const struct mo_certificate_status *status = any;
  const struct mo_certificate_record *record = &status->record;
  const struct mo_job *job = &status->job;
  struct mo_certificate_settings shown = record->settings;
  shown.top = mo_certificate_top(&record->settings, job->n_designs);
  mo_text_object(text);
  mo_text_member_id(text, "id", job->id);
  mo_text_member(text, "kind", mo_job_kind_name(job->kind));
  mo_job_write_head(text, job, live);
  mo_text_open(text, "certificate", "{");
  mo_member_controller(text, "controller", true, job->controller_name, &job->controller_sha256);
  mo_member_environments(text, job->environment_set, job->n_environments);
  mo_text_name(text, "physics");
  mo_fields_write_object(text, &mo_physics_fields, &job->physics);
  mo_text_member_count(text, "designs", job->n_designs);
  mo_fields_write(text, &mo_certificate_fields, &shown);
  write_taken(text, record->taken);
  mo_text_member_count(text, "trials_done", record->trials_done);
  mo_text_member_count(text, "trials", record->n_trials);
  mo_text_member_count(text, "rollouts_done", record->rollouts_done);
  mo_text_member_count(text, "rollouts", record->n_rollouts);
  mo_text_member(text, "phase", mo_phase_name(live->phase));
  write_progress(text, live);
  mo_text_add(text, "}");
}

static void write_job(struct mo_text *text, const void *status, const struct mo_live *live)
{
  write_open(text, status, live);
  mo_text_add(text, "}");
}

static void write_axis(struct mo_text *text, unsigned axis, const char *name, const char *words)
{
  mo_text_object(text);
  mo_text_member(text, "axis", mo_axis_words[axis]);
  mo_text_member(text, name, words);
  mo_text_add(text, "}");
}

void mo_members_axes(struct mo_text *text, const struct mo_certificate_settings *settings,
                     const struct mo_certificate_base *base)
{
  mo_text_open(text, "left_out", "[");
  for (unsigned axis = 0; axis < MO_AXES; axis++) {
    const char *why = mo_certificate_omits(settings, base, (enum mo_axis)axis);
    if (why != NULL)
      write_axis(text, axis, "reason", why);
  }
  mo_text_add(text, "]");
  mo_text_open(text, "axis_notes", "[");
  for (unsigned axis = 0; axis < MO_AXES; axis++) {
    struct mo_message note = {.text = ""};
    if (mo_certificate_omits(settings, base, (enum mo_axis)axis) == NULL &&
        mo_certificate_note(settings, base, (enum mo_axis)axis, &note))
      write_axis(text, axis, "note", note.text);
  }
  mo_text_add(text, "]");
}

/* Writes the members that list items do not have: the source of the designs, the axes that do not
 * apply, and the notes. */
static int write_whole(struct mo_api *api, struct mo_text *text, const void *any,
                       const struct mo_live *live, bool is_listed)
{
  static const char *const below[] = {"report", "report", "report_csv", "report.csv", NULL};
  const struct mo_certificate_status *status = any;
  const struct mo_certificate_record *record = &status->record;
  const int64_t id = status->job.id;
  struct mo_certificate_base base = {.n_environments = 0};
  struct mo_environment *environments = NULL;
  struct mo_design_note *notes = NULL;
  uint32_t n = 0;
  write_open(text, status, live);
  int error = is_listed ? MO_OK : mo_store_design_notes(api->store, id, &notes, &n);
  if (!is_listed && error == MO_OK)
    error = mo_store_certificate_base(api->store, status, &environments, &base);
  if (!is_listed && error == MO_OK) {
    write_population(text, population_kind(api->store, record->population), record->population);
    mo_members_axes(text, &record->settings, &base);
    mo_member_notes(text, "notes", notes, n);
    mo_links_write(text, &status->job, below);
  }
  mo_text_add(text, "}");
  mo_environments_free(environments, base.n_environments);
  free(notes);
  return error;
}

/* ---- the kind ---- */

static int read_status(struct mo_store *store, int64_t id, union mo_job_status *status)
{
  return mo_store_certificate(store, id, &status->certificate);
}

const struct mo_resource mo_certificate_resource = {.kind = MO_JOB_CERTIFICATE,
                                                    .path = "/v1/certificates",
                                                    .status_size =
                                                        sizeof(struct mo_certificate_status),
                                                    .read = read_status,
                                                    .page = mo_store_certificates,
                                                    .write = write_whole,
                                                    .write_job = write_job};

/* ---- submission ---- */

static int submit(struct mo_request *request, struct mo_post *post)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_faults *faults = &post->faults;
  struct mo_parsed_certificate parsed;
  bool replayed;
  int error = mo_certificate_parse(request->body, request->body_size, &parsed, faults);
  const int64_t population = parsed.request.record.population;
  const char *pointer =
      parsed.population_kind == MO_JOB_CAMPAIGN ? "/population/campaign" : "/population/evaluation";
  const bool invalid = error == MO_ERR_INVALID;
  if (invalid)
    mo_look_up_controller(api->store, parsed.request.controller, faults);
  if (error == MO_OK || invalid) /* the job with this id may be of a different kind */
    mo_look_up_job(api->store, population, parsed.population_kind, pointer, faults);
  if (error == MO_OK && faults->n > 0)
    error = MO_ERR_INVALID;
  if (error == MO_OK) {
    post->parsed = true;
    post->pointers = (struct mo_refusal_pointers){
        .invalid = "/physics", .empty = "/controller", .conflict = population > 0 ? pointer : NULL};
    mo_post_sign(request, post, &parsed.request.job);
    error = mo_jobs_submit_certificate(api->jobs, &parsed.request, &request->kept, &replayed,
                                       &post->message);
  }
  if (!invalid && mo_names_unknown(post, error))
    mo_look_up_controller(api->store, parsed.request.controller, faults);
  mo_parts_free(&parsed.parts);
  return error;
}

void mo_api_post_certificate(struct mo_request *request)
{
  if (mo_handle_submission(request, "certificate", submit))
    mo_reply_submitted(request, &mo_certificate_resource, request->kept, false);
}
