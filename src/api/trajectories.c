/* trajectories.c: the recordings of evaluations. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/handlers.h"
#include "api/job_json.h"
#include "api/scene.h"
#include "store/worlds.h"

/* Replies with one array, little-endian (the byte order of this machine: the build rejects others),
 * and the center of mass as float32. */
static void reply_binary(struct mo_request *request, const struct mo_trajectory *t,
                         unsigned channel)
{
  struct mo_scene_array array;
  char shape[64];
  size_t n = 1, used = 0;
  if (!mo_scene_channel(&t->recording, (enum mo_channel)(1U << channel), t->n_frames, t->n_masses,
                        t->n_springs, &array)) {
    mo_reply_error(request, MO_ERR_CORRUPT, "trajectory");
    return;
  }
  for (unsigned d = 0; d < array.dimensions; d++) {
    n *= array.shape[d];
    used +=
        (size_t)snprintf(shape + used, sizeof(shape) - used, d > 0 ? ",%u" : "%u", array.shape[d]);
  }
  const bool is_double = array.width == sizeof(double);
  const size_t width = is_double ? sizeof(float) : array.width;
  char *bytes = malloc(n * width);
  if (bytes == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "trajectory");
    return;
  }
  for (size_t i = 0; is_double && i < n; i++)
    ((float *)(void *)bytes)[i] = (float)((const double *)array.numbers)[i];
  if (!is_double)
    memcpy(bytes, array.numbers, n * width);
  mo_reply_bytes(request, 200, "application/octet-stream", bytes, n * width);
  mo_reply_extra(request, "Morphod-Array", "%s", mo_channel_words[channel]);
  mo_reply_extra(request, "Morphod-Shape", "%s", shape);
  mo_reply_extra(request, "Morphod-Type", "%s", width == sizeof(float) ? "float32-le" : array.type);
  mo_reply_extra(request, "Morphod-Stride", "%u", t->recording.stride);
  mo_reply_extra(request, "Morphod-Dt-S", "%.17g", t->dt_s);
}
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "the binary form is little-endian");

void mo_reply_no_recording(struct mo_request *request, const struct mo_job *job, int error)
{
  const char *state = mo_job_state_name(job->state);
  if (error != MO_ERR_NOT_FOUND)
    mo_reply_error(request, error, "trajectory");
  else if (job->recordings_removed_us != 0)
    mo_reply_problem(request, 410, NULL,
                     "The recordings of this evaluation were removed, to free space "
                     "(max_recordings) or on request. To recompute the same motion, use POST "
                     "/v1/rollouts with the genotype in the results, or resubmit the evaluation.");
  else if (mo_job_state_is_final(job->state))
    mo_reply_problem(request, 404, NULL, "This rollout was not recorded: the evaluation has %s.",
                     state);
  else
    mo_reply_problem(request, 409, NULL, "This rollout is not done yet: the evaluation is %s.",
                     state);
}

/* The rollout that the path and the query specify. */
struct place {
  int64_t evaluation, design, environment;
  int array; /* of mo_channel_words; −1: any */
  struct mo_job job;
};

/* Reads the trajectory. Returns NULL if it has replied. */
static struct mo_trajectory *read_trajectory(struct mo_request *request, struct place *place)
{
  struct mo_store *store = mo_api_of(request)->store;
  const char *design = request->parameters[1];
  *place = (struct place){.array = -1};
  if (!mo_path_id(request, 0, &place->evaluation))
    return NULL;
  if (!mo_decimal(design, strlen(design), 0, MO_DESIGNS_MAX - 1, &place->design)) {
    mo_reply_problem(
        request, 404, NULL,
        "There is no design \"%s\": give the index of a design in the request, from 0.",
        MO_SHOWN(design));
    return NULL;
  }
  if (!mo_query_number(request, "environment", 0, MO_ENVIRONMENTS_MAX - 1, &place->environment) ||
      !mo_query_word(request, "array", mo_channel_words, &place->array))
    return NULL;
  const uint32_t d = (uint32_t)place->design, k = (uint32_t)place->environment;
  struct mo_trajectory *trajectory = NULL;
  const struct mo_job *job = &place->job;
  int error = mo_store_job(store, place->evaluation, &place->job);
  if (error != MO_OK)
    mo_reply_error(request, error, "evaluation");
  else if (d >= job->n_designs || k >= job->n_environments)
    mo_reply_problem(request, 404, NULL, "The evaluation has %s and %s.",
                     MO_COUNTED(job->n_designs, "design"),
                     MO_COUNTED(job->n_environments, "environment"));
  else if (job->record == 0)
    mo_reply_problem(request, 404, NULL, "The evaluation did not request a recording.");
  else if (place->array >= 0 && !(job->record >> place->array & 1))
    mo_reply_problem(request, 404, NULL,
                     "The evaluation did not request a recording of this array.");
  else if ((error = mo_store_trajectory(store, place->evaluation, d, k, &trajectory)) != MO_OK)
    mo_reply_no_recording(request, job, error);
  return trajectory;
}

static void reply_json(struct mo_request *request, const struct place *place,
                       const struct mo_trajectory *trajectory)
{
  struct mo_text text = {0};
  struct mo_scene_array array;
  mo_text_object(&text);
  mo_text_member_id(&text, "evaluation", place->evaluation);
  mo_text_member_count(&text, "design", (uint64_t)place->design);
  mo_text_member_count(&text, "environment", (uint64_t)place->environment);
  mo_text_member_count(&text, "stride", trajectory->recording.stride);
  mo_text_member_count(&text, "frames", trajectory->n_frames);
  mo_text_member_number(&text, "dt_s", trajectory->dt_s);
  for (unsigned i = 0; i < MO_CHANNELS; i++)
    if (mo_scene_channel(&trajectory->recording, (enum mo_channel)(1U << i), trajectory->n_frames,
                         trajectory->n_masses, trajectory->n_springs, &array))
      mo_scene_write_array(&text, NULL, &array);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
  mo_reply_etag(request, "%" PRIx64 "-trajectory-%" PRId64 "-%" PRId64 "-%" PRId64,
                mo_store_history(mo_api_of(request)->store), place->evaluation, place->design,
                place->environment);
}

static bool fits(const struct mo_trajectory *trajectory, const struct mo_body *body)
{
  return trajectory->n_masses == body->n_masses &&
         (trajectory->n_springs == 0 || trajectory->n_springs == body->n_springs);
}

/* Fills in the only rollout of a scene. The scene takes over the recording. */
static int fill_rollout(struct mo_api *api, const struct place *place,
                        struct mo_trajectory *trajectory, struct mo_rollouts *rollouts)
{
  struct mo_evaluation_results *results = NULL;
  struct mo_rolled_design *design = &rollouts->designs[0];
  struct mo_rolled *rolled = &rollouts->rollouts[0];
  const size_t k = (size_t)place->environment;
  uint32_t n = 0;
  int error = mo_store_job_environments(api->store, place->evaluation, MO_JOB_EVALUATION,
                                        &rollouts->environments, &n);
  if (error == MO_OK)
    error = mo_store_result(api->store, place->evaluation, (uint32_t)place->design, &results);
  if (error == MO_OK && (k >= n || k >= results->n_environments))
    error = MO_ERR_CORRUPT;
  if (error == MO_OK) {
    rollouts->environments[0] = rollouts->environments[k];
    const struct mo_workspace workspace = api->lattice->workspace;
    *design =
        (struct mo_rolled_design){.form = mo_genotype_of(workspace, &results->forms[0]),
                                  .genotype = mo_genotype_of(workspace, &results->genotypes[0]),
                                  .score = results->scores[0]};
    rolled->outcome = (struct mo_outcome){.loss = results->losses[k],
                                          .diverged_step = results->diverged_steps[k]};
    error = mo_body_create(api->lattice, design->genotype.words, &design->body);
    if (design->body != NULL && !fits(trajectory, design->body))
      error = MO_ERR_CORRUPT;
  }
  mo_evaluation_results_free(results);
  rolled->recording = trajectory->recording;
  trajectory->recording = (struct mo_recording){0};
  return error;
}

static void reply_scene(struct mo_request *request, const struct place *place,
                        struct mo_trajectory *trajectory)
{
  const struct mo_job *job = &place->job;
  struct mo_rollouts *rollouts = calloc(1, sizeof(*rollouts));
  int error = rollouts != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (error == MO_OK) {
    *rollouts = (struct mo_rollouts){.n_designs = 1,
                                     .n_environments = 1,
                                     .n_frames = trajectory->n_frames,
                                     .designs = calloc(1, sizeof(*rollouts->designs)),
                                     .rollouts = calloc(1, sizeof(*rollouts->rollouts)),
                                     .physics = job->physics,
                                     .precision = job->precision,
                                     .controller = job->controller_sha256,
                                     .sensor = job->sensor};
    error = rollouts->designs != NULL && rollouts->rollouts != NULL
                ? fill_rollout(mo_api_of(request), place, trajectory, rollouts)
                : MO_ERR_NO_MEMORY;
  }
  if (error != MO_OK) {
    mo_reply_error(request, error, "trajectory");
  } else {
    mo_reply_rollouts(request, rollouts, MO_ROLLOUTS_SCENE);
    mo_reply_etag_of_body(request);
  }
  mo_rollouts_free(rollouts);
}

void mo_api_get_trajectory(struct mo_request *request)
{
  static const char *const forms[] = {"json", "scene", NULL};
  static const char *const types[] = {"application/json", MO_SCENE_TYPE, NULL};
  struct place place;
  int form;
  if (!mo_query_form(request, forms, types, &form))
    return;
  struct mo_trajectory *trajectory = read_trajectory(request, &place);
  if (trajectory == NULL)
    return;
  if (form == 1)
    reply_scene(request, &place, trajectory);
  else
    reply_json(request, &place, trajectory);
  mo_trajectory_free(trajectory);
}

void mo_api_get_trajectory_file(struct mo_request *request)
{
  static const char *const types[] = {"application/octet-stream", NULL};
  const char *array = mo_query(request, "array");
  struct place place;
  int form;
  if (!mo_accept(request, types, &form))
    return;
  struct mo_trajectory *trajectory = read_trajectory(request, &place);
  if (trajectory == NULL)
    return;
  reply_binary(request, trajectory,
               place.array >= 0 ? (unsigned)place.array : mo_usual_channel(place.job.record));
  if (request->reply.status == 200)
    mo_reply_etag(request, "%" PRIx64 "-file-%" PRId64 "-%" PRId64 "-%" PRId64 "-%s",
                  mo_store_history(mo_api_of(request)->store), place.evaluation, place.design,
                  place.environment, array != NULL ? array : "");
  mo_trajectory_free(trajectory);
}

void mo_api_delete_trajectories(struct mo_request *request)
{
  struct mo_text text = {0};
  uint64_t bytes = 0;
  int64_t id;
  if (!mo_path_id(request, 0, &id))
    return;
  const int error = mo_store_trajectories_remove(mo_api_of(request)->store, id, &bytes);
  if (error == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL,
                     "The evaluation has not ended, and continues from its recordings. Delete them "
                     "after it has ended or was cancelled.");
  } else if (error != MO_OK) {
    mo_reply_error(request, error, "evaluation");
  } else {
    mo_text_object(&text);
    mo_text_member_id(&text, "evaluation", id);
    mo_text_member_count(&text, "bytes", bytes);
    mo_text_add(&text, "}");
    mo_reply_json(request, 200, &text);
  }
}
