/* evaluations.c: evaluations: submission, state, results. */
#include <math.h>
#include <stdlib.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "api/submission.h"
#include "api/suite.h"
#include "rollout/physics.h"

/* The reply for a whole evaluation contains at most this many measured numbers, about 60 MB: those
 * of MO_DESIGNS_MAX designs on the paper's test set. Longer results are read in pages. In a suite,
 * each rollout counts as two numbers: its loss and its value. */
#define MEASURED_MAX 2000000

/* ---- the kind ---- */

static void write_error(struct mo_text *text, const struct mo_score_error *error)
{
  mo_text_open(text, "error", "{");
  mo_text_member_number(text, "low", error->low);
  mo_text_member_number(text, "high", error->high);
  mo_text_member_number(text, "discretization", error->discretization);
  mo_text_member_number(text, "rounding", error->rounding);
  mo_text_member_number(text, "standard_error", error->standard_error);
  mo_text_open(text, "bifurcates", "[");
  for (uint64_t left = error->bifurcates; left != 0; left &= left - 1) {
    mo_text_next(text);
    mo_text_format(text, "%d", __builtin_ctzll(left));
  }
  mo_text_add(text, "]}");
}

static const char *precision_word(enum mo_precision precision)
{
  return precision == MO_FLOAT64 ? "float64" : "float32";
}

/* Writes the settings of a rung; NULL: there is none. */
static void write_setting(struct mo_text *text, const struct mo_setting *setting)
{
  mo_text_member_number(text, "dt_s", setting != NULL ? setting->physics.scheme.dt_s : NAN);
  mo_text_member(text, "precision", setting != NULL ? precision_word(setting->precision) : NULL);
}

/* Writes how a design climbed to its tolerance. */
static void write_climb(struct mo_text *text, const struct mo_evaluation_results *results,
                        const struct mo_climbed *climbed)
{
  const uint32_t chosen = climbed->climb.rung;
  const bool has_any = climbed->n > 0;
  mo_text_open(text, "tolerance", "{");
  mo_text_member_number(text, "asked", results->tolerance);
  mo_text_member_bool(text, "reached", climbed->climb.reached);
  mo_text_member_number(text, "estimated_error",
                        has_any ? climbed->errors[chosen].half_width : NAN);
  mo_text_member_bool(text, "bifurcates", climbed->climb.bifurcates);
  write_setting(text, has_any ? &results->rungs[chosen] : NULL);
  mo_text_open(text, "rungs", "[");
  for (uint32_t rung = 0; rung < climbed->n; rung++) {
    mo_text_object(text);
    write_setting(text, &results->rungs[rung]);
    mo_text_member_number(text, "score", climbed->scores[rung]);
    mo_text_member_number(text, "estimated_error", climbed->errors[rung].half_width);
    mo_text_member_number(text, "discretization", climbed->errors[rung].discretization);
    mo_text_member_number(text, "rounding", climbed->errors[rung].rounding);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]}");
}

static int write_result(struct mo_text *text, const struct mo_lattice *lattice,
                        const struct mo_evaluation_results *results,
                        const struct mo_environment *tasks, int suite, uint32_t d,
                        const struct mo_design_note *note)
{
  const uint32_t columns = results->n_environments;
  const int32_t *steps = &results->diverged_steps[(size_t)d * columns];
  mo_text_object(text);
  const struct mo_genotype form = mo_genotype_of(lattice->workspace, &results->forms[d]),
                           genotype = mo_genotype_of(lattice->workspace, &results->genotypes[d]);
  const int error = mo_members_design(text, lattice, &form, &genotype, note);
  mo_member_orientation(text, note != NULL ? note->orientation : MO_ORIENTATION_GIVEN);
  mo_text_member_number(text, "path_length_m", results->paths_m[d]);
  mo_text_member_number(text, "score", results->scores[d]);
  mo_text_member_bool(text, "lower_bound", results->is_bound[d]);
  struct mo_measured measured = {.set = results->measure_set};
  if (results->measure_set != 0) {
    measured.values = &results->measures[(size_t)d * columns * results->n_measures];
    measured.flags = &results->flags[(size_t)d * columns];
  }
  mo_members_losses(text, &results->losses[(size_t)d * columns], columns, tasks,
                    results->measure_set != 0 ? &measured : NULL);
  if (suite >= 0)
    mo_suite_write_design(text, results, d, tasks);
  mo_text_add(text, ",\"diverged\":[");
  for (uint32_t k = 0; k < columns; k++)
    if (steps[k] != 0) {
      mo_text_next(text);
      mo_text_format(text, "{\"environment\":%u,\"step\":%d}", k, (int)steps[k]);
    }
  mo_text_add(text, "]");
  if (results->errors != NULL)
    write_error(text, &results->errors[d]);
  if (results->climbed != NULL)
    write_climb(text, results, &results->climbed[d]);
  if (results->stored_losses != NULL) {
    const double *stored = &results->stored_losses[(size_t)d * columns];
    bool any = false;
    for (uint32_t k = 0; k < columns; k++)
      any |= !isnan(stored[k]);
    mo_member_numbers(text, "stored_losses", stored, columns);
    if (any)
      mo_text_member_bool(text, "agrees", results->agrees[d]);
    else
      mo_text_member(text, "agrees", NULL);
  }
  mo_text_add(text, "}");
  return error;
}

static int write_results(struct mo_text *text, const struct mo_lattice *lattice,
                         const struct mo_evaluation_results *results,
                         const struct mo_environment *tasks, int suite)
{
  int error = MO_OK;
  mo_text_add(text, ",\"results\":[");
  for (uint32_t d = 0, k = 0; d < results->n_designs && error == MO_OK; d++) {
    const bool has_note = k < results->n_notes && results->notes[k].place == d;
    error = write_result(text, lattice, results, tasks, suite, d,
                         has_note ? &results->notes[k++] : NULL);
  }
  mo_text_add(text, "]");
  return error;
}

static void write_progress(struct mo_text *text, const struct mo_job *job,
                           const struct mo_live *live)
{
  const bool runs = job->state == MO_JOB_RUNNING && live->phase != MO_PHASE_IDLE;
  mo_text_open(text, "progress", "{");
  mo_member_number_if(text, "rollouts_per_s", runs && live->rate > 0, live->rate);
  mo_member_number_if(text, "seconds_left", runs && live->seconds_left >= 0, live->seconds_left);
  mo_member_number_if(text, "busy_s", runs && live->busy_s >= 0, live->busy_s);
  mo_text_add(text, "}");
}

/* Writes an evaluation without its results, and leaves the object open. */
static void write_job(struct mo_text *text, const struct mo_job *job, const struct mo_live *live)
{
  struct mo_live shown = *live;
  shown.phase = MO_PHASE_IDLE;
  mo_text_object(text);
  mo_text_member_id(text, "id", job->id);
  mo_text_member(text, "kind", mo_job_kind_name(job->kind));
  mo_job_write_head(text, job, &shown);
  mo_member_controller(text, "controller", true, job->controller_name, &job->controller_sha256);
  mo_member_environments(text, job->environment_set, job->n_environments);
  mo_text_name(text, "physics");
  mo_fields_write_object(text, &mo_physics_fields, &job->physics);
  mo_text_member(text, "precision", precision_word(job->precision));
  mo_text_open(text, "record", "[");
  for (unsigned i = 0; i < MO_CHANNELS; i++)
    if (job->record >> i & 1) {
      mo_text_next(text);
      mo_text_format(text, "\"%s\"", mo_channel_words[i]);
    }
  mo_text_add(text, "]");
  mo_text_member_count(text, "record_stride", job->record_stride > 0 ? job->record_stride : 1);
  mo_text_member_count(text, "recorded_bytes", job->recorded_bytes);
  mo_text_member_time(text, "recordings_removed_at", job->recordings_removed_us);
  mo_text_member_bool(text, "verify", job->verify);
  if (job->n_displaced > 0)
    mo_text_member_count(text, "displaced_starts", job->n_displaced);
  if (job->tolerance > 0)
    mo_text_member_number(text, "tolerance", job->tolerance);
  if (job->measures != 0)
    mo_member_measures(text, "measures", job->measures);
  mo_member_count_if(text, "best", job->best > 0, job->best);
  if (job->is_random)
    mo_text_format(text, ",\"random\":{\"seed\":%llu,\"first\":%u,\"drawn\":%u}",
                   (unsigned long long)job->random_seed, job->random_first,
                   job->n_designs - job->n_waiting);
  else
    mo_text_member(text, "random", NULL);
  mo_text_member_count(text, "n_designs", job->n_designs);
  mo_text_member_count(text, "n_skipped", job->n_skipped);
  mo_text_member_count(text, "n_waiting", job->n_waiting);
  mo_text_member_count(text, "rollouts_total", job->rollouts_total);
  mo_text_member_count(text, "rollouts_done", job->rollouts_done);
  mo_text_member_count(text, "rollouts_cached", job->rollouts_cached);
  mo_text_member_count(text, "rollouts_diverged", job->rollouts_diverged);
  mo_text_member_count(text, "rollouts_cut", job->rollouts_cut);
  write_progress(text, job, live);
}

static int read_status(struct mo_store *store, int64_t id, union mo_job_status *status)
{
  return mo_store_job(store, id, &status->job);
}

/* Returns how many numbers a design may add to a reply in addition to a short list of losses; 0: no
 * others. */
static uint64_t numbers_of_design(const struct mo_job *job)
{
  const uint32_t each =
      (uint32_t)__builtin_popcount(job->measures) + (mo_suite_of(job) >= 0 ? 2 : 0);
  return (uint64_t)job->n_environments * each;
}

bool mo_results_fit(const struct mo_job *job)
{
  return job->n_designs <= MO_DESIGNS_MAX &&
         job->n_designs * numbers_of_design(job) <= MEASURED_MAX;
}

static int write_whole(struct mo_api *api, struct mo_text *text, const void *status,
                       const struct mo_live *live, bool is_listed)
{
  const struct mo_job *job = status;
  struct mo_evaluation_results *results = NULL;
  struct mo_environment *tasks = NULL;
  int error = MO_OK;
  if (job->state == MO_JOB_SUCCEEDED && !is_listed && mo_results_fit(job))
    error = mo_store_results(api->store, job->id, &results);
  if (error == MO_OK && results != NULL)
    error = mo_tasks_read(api->store, job->id, job->kind, job->environment_set, &tasks);
  if (error == MO_OK) {
    const int suite = mo_suite_of(job);
    write_job(text, job, live);
    if (suite >= 0 && !is_listed)
      mo_suite_write(text, suite, results, tasks);
    if (results != NULL)
      error = write_results(text, api->lattice, results, tasks, suite);
    mo_text_add(text, "}");
  }
  free(tasks);
  mo_evaluation_results_free(results);
  return error;
}

static void write_item(struct mo_text *text, const void *status, const struct mo_live *live)
{
  write_job(text, status, live);
  mo_text_add(text, "}");
}

const struct mo_resource mo_evaluation_resource = {.kind = MO_JOB_EVALUATION,
                                                   .path = "/v1/evaluations",
                                                   .status_size = sizeof(struct mo_job),
                                                   .read = read_status,
                                                   .page = mo_store_jobs,
                                                   .write = write_whole,
                                                   .write_job = write_item,
                                                   .versioned = true};

/* ---- pages of results ---- */

/* Writes the result of a design, with its number. */
static int write_numbered(struct mo_api *api, struct mo_text *text, const struct mo_job *job,
                          const struct mo_environment *tasks, uint32_t number)
{
  struct mo_evaluation_results *results = NULL;
  struct mo_text one = {0};
  int error = mo_store_result(api->store, job->id, number, &results);
  const struct mo_design_note *note = NULL;
  for (uint32_t i = 0; error == MO_OK && i < results->n_notes; i++)
    if (results->notes[i].place == number)
      note = &results->notes[i];
  if (error == MO_OK)
    error = write_result(&one, api->lattice, results, tasks, mo_suite_of(job), 0, note);
  if (error == MO_OK) {
    mo_text_next(text);
    mo_text_format(text, "{\"number\":%u,", number);
    mo_text_add(text, one.data + 1);
  }
  mo_text_free(&one);
  mo_evaluation_results_free(results);
  return error;
}

static const char *const whole_words[] = {"false", "true", NULL};

void mo_api_get_results(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_environment *tasks = NULL;
  struct mo_text text = {0};
  struct mo_job job;
  int64_t id, first;
  size_t limit;
  int whole = 0;
  if (!mo_query_cursor(request, &first) || !mo_query_word(request, "whole", whole_words, &whole) ||
      !mo_query_limit(request, &limit) || !mo_path_id(request, 0, &id))
    return;
  int error = mo_store_job(api->store, id, &job);
  if (error == MO_OK && job.kind != MO_JOB_EVALUATION)
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK && job.state != MO_JOB_SUCCEEDED) {
    mo_reply_problem(request, 409, NULL,
                     "The evaluation is %s; it has results once it has succeeded.",
                     mo_job_state_name(job.state));
    return;
  }
  if (first < 0)
    first = 0;
  if (error == MO_OK && first > job.n_designs)
    first = job.n_designs; /* past the last design */
  const uint64_t each = error == MO_OK ? numbers_of_design(&job) : 0;
  if (each > 0 && limit * each > MEASURED_MAX)
    limit = each < MEASURED_MAX ? MEASURED_MAX / each : 1;
  uint32_t *numbers = malloc(limit * sizeof(*numbers));
  int64_t n = 0;
  if (numbers == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    n = mo_store_result_numbers(api->store, id, (uint32_t)first, whole == 0, numbers, limit);
  if (n < 0)
    error = (int)n;
  if (error == MO_OK)
    error = mo_tasks_read(api->store, id, job.kind, job.environment_set, &tasks);
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n && error == MO_OK; i++)
    error = write_numbered(api, &text, &job, tasks, numbers[i]);
  if (n == (int64_t)limit && numbers[n - 1] + 1 < job.n_designs)
    mo_text_format(&text, "],\"next_cursor\":\"%u\"}", numbers[n - 1] + 1);
  else
    mo_text_add(&text, "],\"next_cursor\":null}");
  mo_reply_text(request, error, &text, "evaluation");
  free(numbers);
  free(tasks);
}

/* ---- submission ---- */

/* Parses and stores the evaluation. */
static int submit(struct mo_request *request, struct mo_post *post)
{
  struct mo_parsed_evaluation parsed;
  bool replayed;
  int error = mo_evaluation_parse(request->body, request->body_size, &parsed, &post->faults);
  post->parsed = error == MO_OK;
  post->pointers = (struct mo_refusal_pointers){.controller = "/controller", .limit = "/record"};
  mo_post_sign(request, post, &parsed.request.job);
  if (error == MO_OK)
    error = mo_jobs_submit_evaluation(mo_api_of(request)->jobs, &parsed.request, &request->kept,
                                      &replayed, &post->message);
  mo_parts_free(&parsed.parts);
  return error;
}

void mo_api_post_evaluation(struct mo_request *request)
{
  struct mo_job job;
  mo_read_wait(request);
  if (request->kept == 0 && !mo_handle_submission(request, "evaluation", submit))
    return;
  if (mo_await_job(request, &mo_evaluation_resource, request->kept, &job))
    mo_reply_submitted(request, &mo_evaluation_resource, request->kept,
                       request->wait_s >= 0 && mo_job_state_is_final(job.state));
}
