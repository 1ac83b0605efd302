/* trainings.c: training runs: submission and state. */
#include <math.h>
#include <stdlib.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "api/submission.h"
#include "base/words.h"
#include "exchange/columns.h"
#include "store/fields.h"
#include "store/worlds.h"
#include "world/task_json.h"

/* ---- as JSON ---- */

static const char *kind_name(const struct mo_training_status *status)
{
  return status->record.settings.kind == MO_TRAINING_FINETUNE ? "finetune" : "pretrain";
}

/* Returns the steps applied. After a crash, a run that resumed from a checkpoint may be behind the
 * stored curve. The step of a run that is being prepared is not known yet. */
static uint32_t step_of(const struct mo_training_status *status, const struct mo_live *live)
{
  if (live->phase == MO_PHASE_IDLE)
    return status->step;
  return live->position > 0 ? live->position : status->checkpoint_step;
}

/* tasks: of a training run with its own tasks. */
static void write_worlds(struct mo_text *text, const struct mo_training_record *record,
                         const struct mo_environment *tasks)
{
  if (record->n_environments > 0 && !record->draws_worlds)
    mo_member_environments(text, record->environment_set, record->n_environments);
  else
    mo_text_add(text, ",\"environments\":null");
  mo_text_add(text, tasks != NULL ? ",\"tasks\":[" : ",\"tasks\":null");
  for (uint32_t i = 0; tasks != NULL && i < record->n_environments; i++) {
    mo_text_add(text, i > 0 ? "," : "");
    mo_task_write(text, &tasks[i]);
  }
  mo_text_add(text, tasks != NULL ? "]" : "");
}

static void write_settings(struct mo_text *text, const struct mo_training_status *status,
                           enum mo_job_kind population_kind, const struct mo_environment *tasks)
{
  const struct mo_training_record *record = &status->record;
  struct mo_training_record shown = *record;
  if (status->job.has_controller)
    shown.settings.sensor = (enum mo_sensor) - 1; /* null: the sensor of the parent */
  mo_text_add(text, ",\"settings\":{");
  mo_fields_write(text, &mo_training_record_fields, &shown);
  write_worlds(text, record, tasks);
  mo_member_count_if(text, "n_designs", record->settings.kind == MO_TRAINING_FINETUNE,
                     record->n_designs);
  if (record->each) {
    mo_text_member_bool(text, "each", true);
    mo_text_member(text, "keep",
                   record->keep_best > 0 ? NULL : mo_word(mo_keep_words, record->keep));
    mo_member_count_if(text, "best", record->keep_best > 0, record->keep_best);
  }
  mo_text_name(text, "population");
  if (record->population > 0)
    mo_text_format(text, "{\"%s\":\"%lld\"}", mo_job_kind_name(population_kind),
                   (long long)record->population);
  else if (record->sample.atlas[0] != '\0')
    mo_fields_write_object(text, &mo_atlas_asked_fields, &record->sample);
  else
    mo_text_add(text, "null");
  mo_text_add(text, "}");
}

/* Writes how the designs were drawn, and from which atlas. */
static void write_sample(struct mo_text *text, const struct mo_atlas_sample *sample)
{
  mo_text_open(text, "sample", "{");
  mo_fields_write(text, &mo_atlas_drawn_fields, sample);
  mo_text_open(text, "places", "[");
  for (uint32_t i = 0; i < sample->count; i++)
    mo_text_format(text, i > 0 ? ",%u" : "%u", (unsigned)mo_atlas_sample_place(sample, i));
  mo_text_add(text, "]}");
}

static void write_progress(struct mo_text *text, const struct mo_training_status *status,
                           const struct mo_live *live)
{
  static const struct mo_training_report none = {.mean_loss = NAN,
                                                 .gradient_norm = NAN,
                                                 .rate = NAN,
                                                 .clipped_share = NAN,
                                                 .clipped_robots_share = NAN};
  const struct mo_training_report *last = status->step > 0 ? &status->last.report : &none;
  bool runs = live->phase != MO_PHASE_IDLE;
  mo_text_format(text, ",\"progress\":{\"step\":%u,\"steps\":%u", step_of(status, live),
                 status->job.steps_total);
  if (status->record.each) {
    mo_text_member_count(text, "bodies_done", status->bodies_done);
    mo_text_member_count(text, "bodies", status->record.n_designs);
  }
  mo_text_member_number(text, "mean_loss", last->mean_loss);
  mo_text_member_number(text, "gradient_norm", last->gradient_norm);
  mo_text_member_number(text, "rate", last->rate);
  mo_text_member_number(text, "clipped_share", last->clipped_share);
  mo_text_member_number(text, "clipped_robots_share", last->clipped_robots_share);
  mo_text_member_count(text, "diverged", last->diverged);
  mo_text_member_count(text, "zeroed", last->zeroed);
  mo_text_member_bool(text, "skipped", last->skipped);
  mo_member_number_if(text, "bodies_per_s", runs && live->rate > 0, live->rate);
  mo_member_number_if(text, "seconds_left", runs && live->seconds_left >= 0, live->seconds_left);
  mo_member_number_if(text, "busy_s", runs && live->busy_s >= 0, live->busy_s);
  mo_text_member_count(text, "replayed", runs ? live->done : 0);
  mo_text_member_count(text, "replay_total", runs ? live->total : 0);
  mo_text_add(text, "}");
}

static void write_code(struct mo_text *text, const struct mo_training_lineage *lineage)
{
  mo_text_add(text, ",\"code\":[");
  for (uint32_t i = 0; i < lineage->n; i++) {
    mo_text_object(text);
    mo_text_member_count(text, "from_step", lineage->codes[i].from_step);
    mo_text_member(text, "fingerprint", lineage->codes[i].fingerprint);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

void mo_training_json_write(struct mo_text *text, const struct mo_training_status *status,
                            enum mo_job_kind population_kind, const struct mo_environment *tasks,
                            const struct mo_live *live)
{
  static const char *const below[] = {"each",        "each",        "steps",       "steps",
                                      "validations", "validations", "checkpoints", "checkpoints",
                                      "controller",  "controller",  "held_out",    "held-out",
                                      NULL};
  const struct mo_training_record *record = &status->record;
  char made[MO_MADE_BYTES];
  const char *name = mo_result_name(&status->job, record->name, made);
  mo_text_object(text);
  mo_text_member_id(text, "id", status->job.id);
  mo_text_member(text, "kind", kind_name(status));
  mo_text_member(text, "name", name);
  mo_job_write_head(text, &status->job, live);
  mo_text_member(text, "phase", mo_phase_name(live->phase));
  mo_member_controller(text, "parent", status->job.has_controller, status->job.controller_name,
                       &status->job.controller_sha256);
  write_settings(text, status, population_kind, tasks);
  write_progress(text, status, live);
  mo_text_name(text, "validation");
  mo_columns_json(text, &mo_validation_columns,
                  status->has_validation ? &status->validation : NULL);
  mo_member_count_if(text, "checkpoint_step", status->checkpoint_step > 0, status->checkpoint_step);
  write_code(text, &status->code);
  mo_member_controller(text, "controller", status->job.has_result, name,
                       &status->job.result_sha256);
  mo_links_write(text, &status->job, record->each ? below : below + 2);
}

void mo_training_json_job(struct mo_text *text, const void *any, const struct mo_live *live)
{
  const struct mo_training_status *status = any;
  char made[MO_MADE_BYTES];
  mo_text_object(text);
  mo_text_member_id(text, "id", status->job.id);
  mo_text_member(text, "kind", mo_job_kind_name(status->job.kind));
  mo_job_write_head(text, &status->job, live);
  mo_text_format(text, ",\"training\":{\"kind\":\"%s\"", kind_name(status));
  mo_text_member(text, "name", mo_result_name(&status->job, status->record.name, made));
  mo_text_format(text, ",\"step\":%u,\"steps\":%u", step_of(status, live), status->job.steps_total);
  mo_text_member_number(text, "score",
                        status->has_validation ? status->validation.mean_score : NAN);
  if (status->record.n_environments > 0 && !status->record.draws_worlds)
    mo_member_environments(text, status->record.environment_set, status->record.n_environments);
  else
    mo_text_member(text, "environments", NULL);
  mo_text_add(text, "}}");
}

/* ---- the kind ---- */

static int read_status(struct mo_store *store, int64_t id, union mo_job_status *status)
{
  return mo_store_training(store, id, &status->training);
}

/* Returns the kind of the job whose designs a training run learns from. */
static enum mo_job_kind population_kind(struct mo_store *store,
                                        const struct mo_training_status *status)
{
  const int64_t id = status->record.population;
  struct mo_job job;
  return id > 0 && mo_store_job(store, id, &job) == MO_OK ? job.kind : MO_JOB_EVALUATION;
}

static int write_whole(struct mo_api *api, struct mo_text *text, const void *status,
                       const struct mo_live *live, bool is_listed)
{
  struct mo_design_note *notes = NULL;
  struct mo_environment *tasks = NULL;
  uint32_t n = 0, n_tasks;
  const struct mo_training_status *training = status;
  const int64_t id = training->job.id;
  int error = is_listed ? MO_OK : mo_store_design_notes(api->store, id, &notes, &n);
  if (error == MO_OK && training->record.draws_worlds)
    error = mo_store_job_environments(api->store, id, MO_JOB_TRAINING, &tasks, &n_tasks);
  mo_training_json_write(text, training, population_kind(api->store, training), tasks, live);
  if (!is_listed && training->record.sample.atlas[0] != '\0')
    write_sample(text, &training->record.sample);
  if (!is_listed)
    mo_member_notes(text, "notes", notes, n);
  mo_text_add(text, "}");
  free(tasks);
  free(notes);
  return error;
}

const struct mo_resource mo_training_resource = {.kind = MO_JOB_TRAINING,
                                                 .path = "/v1/trainings",
                                                 .status_size = sizeof(struct mo_training_status),
                                                 .read = read_status,
                                                 .page = mo_store_trainings,
                                                 .write = write_whole,
                                                 .write_job = mo_training_json_job};

/* ---- submission ---- */

/* Parses and stores the training run. */
static int submit(struct mo_request *request, struct mo_post *post)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_faults *faults = &post->faults;
  struct mo_parsed_training parsed;
  bool replayed;
  int error = mo_training_parse(request->body, request->body_size, &parsed, faults);
  const int64_t population = parsed.request.record.population;
  const char *pointer =
      parsed.population_kind == MO_JOB_CAMPAIGN ? "/population/campaign" : "/population/evaluation";
  const bool invalid = error == MO_ERR_INVALID;
  const bool is_drawn = parsed.request.record.sample.atlas[0] != '\0';
  if (invalid)
    mo_look_up_controller(api->store, parsed.request.parent, faults);
  if (error == MO_OK || invalid) /* the job with this id may be of a different kind */
    mo_look_up_job(api->store, population, parsed.population_kind, pointer, faults);
  if (error == MO_OK && faults->n > 0)
    error = MO_ERR_INVALID;
  if (error == MO_OK) {
    post->parsed = true;
    post->pointers =
        (struct mo_refusal_pointers){.empty = population > 0 ? "/population" : "/designs",
                                     .conflict = population > 0 ? pointer : NULL};
    if (is_drawn)
      post->pointers = (struct mo_refusal_pointers){.controller = "/population/atlas",
                                                    .invalid = "/population/count",
                                                    .conflict = "/population/atlas"};
    mo_post_sign(request, post, &parsed.request.job);
    error = mo_jobs_submit_training(api->jobs, &parsed.request, &request->kept, &replayed,
                                    &post->message);
  }
  if (!invalid && mo_names_unknown(post, error))
    mo_look_up_controller(api->store, parsed.request.parent, faults);
  mo_parts_free(&parsed.parts);
  return error;
}

void mo_api_post_training(struct mo_request *request)
{
  if (mo_handle_submission(request, "training", submit))
    mo_reply_submitted(request, &mo_training_resource, request->kept, false);
}
