/* trajectories.c: recorded positions. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "api/handlers.h"
#include "api/job_json.h"

static void write_frames(struct mo_text *text, const struct mo_trajectory *t)
{
  const size_t numbers = (size_t)t->n_masses * 3;
  if (t->com_m != NULL) {
    mo_text_add(text, ",\"com_m\":[");
    for (uint32_t f = 0; f < t->n_frames; f++) {
      mo_text_next(text);
      mo_json_numbers(text, &t->com_m[(size_t)f * 3], 3);
    }
    mo_text_add(text, "]");
  }
  if (t->mass_m != NULL) {
    mo_text_add(text, ",\"masses_m\":[");
    for (uint32_t f = 0; f < t->n_frames; f++) {
      const float *frame = &t->mass_m[f * numbers];
      mo_text_add(text, f > 0 ? "],[" : "[");
      for (size_t i = 0; i < numbers; i++) {
        mo_text_add(text, i % 3 > 0 ? "," : i > 0 ? "],[" : "[");
        mo_text_json_float(text, frame[i]);
      }
      mo_text_add(text, "]");
    }
    mo_text_add(text, "]]");
  }
}

/* Replies with one array as float32, little-endian (the byte order of this machine: the build
 * refuses others). */
static void reply_binary(struct mo_request *request, const struct mo_trajectory *t, bool masses)
{
  size_t n = masses ? (size_t)t->n_frames * t->n_masses * 3 : (size_t)t->n_frames * 3;
  float *numbers = malloc(n * sizeof(float));
  if (numbers == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "trajectory");
    return;
  }
  for (size_t i = 0; i < n; i++)
    numbers[i] = masses ? t->mass_m[i] : (float)t->com_m[i];
  mo_reply_bytes(request, 200, "application/octet-stream", (char *)numbers, n * sizeof(float));
  mo_reply_extra(request, "Morphod-Array", "%s", masses ? "masses" : "com");
  if (masses)
    mo_reply_extra(request, "Morphod-Shape", "%u,%u,3", t->n_frames, t->n_masses);
  else
    mo_reply_extra(request, "Morphod-Shape", "%u,3", t->n_frames);
  mo_reply_extra(request, "Morphod-Type", "float32-le");
  mo_reply_extra(request, "Morphod-Stride", "%u", t->stride);
  mo_reply_extra(request, "Morphod-Dt-S", "%.17g", t->dt_s);
}
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "the binary form is little-endian");

/* Says why there is no such recording. */
static void reply_missing(struct mo_request *request, const struct mo_job *job, int error)
{
  const char *state = mo_job_state_name(job->state);
  if (error != MO_ERR_NOT_FOUND)
    mo_reply_error(request, error, "trajectory");
  else if (mo_job_state_is_final(job->state))
    mo_reply_problem(request, 404, NULL, "This rollout was not recorded: the evaluation has %s.",
                     state);
  else
    mo_reply_problem(request, 409, NULL, "This rollout is not done yet: the evaluation is %s.",
                     state);
}

/* What the path and the query name. */
struct place {
  int64_t evaluation, design, environment;
  int array; /* 0: com, 1: masses, −1: any */
};

/* Reads the trajectory. NULL: the reply is made. */
static struct mo_trajectory *read_trajectory(struct mo_request *request, struct place *place)
{
  static const char *const arrays[] = {"com", "masses", NULL};
  struct mo_store *store = mo_api_of(request)->store;
  const char *design = request->parameters[1];
  *place = (struct place){.array = -1};
  if (!mo_path_id(request, 0, &place->evaluation))
    return NULL;
  if (!mo_decimal(design, strlen(design), 0, MO_DESIGNS_MAX - 1, &place->design)) {
    mo_reply_problem(request, 404, NULL,
                     "There is no such design: its place in the request, from 0, is expected.");
    return NULL;
  }
  if (!mo_query_number(request, "environment", 0, MO_ENVIRONMENTS_MAX - 1, &place->environment) ||
      !mo_query_word(request, "array", arrays, &place->array))
    return NULL;
  const uint32_t d = (uint32_t)place->design, k = (uint32_t)place->environment;
  struct mo_trajectory *trajectory = NULL;
  struct mo_job job;
  int error = mo_store_job(store, place->evaluation, &job);
  if (error != MO_OK)
    mo_reply_error(request, error, "evaluation");
  else if (d >= job.n_designs || k >= job.n_environments)
    mo_reply_problem(request, 404, NULL, "The evaluation has %u designs and %u environments.",
                     job.n_designs, job.n_environments);
  else if (!job.record_com && !job.record_masses)
    mo_reply_problem(request, 404, NULL, "The evaluation did not ask for a recording.");
  else if ((place->array == 1 && !job.record_masses) || (place->array == 0 && !job.record_com))
    mo_reply_problem(request, 404, NULL,
                     "The evaluation did not ask for a recording of this array.");
  else if ((error = mo_store_trajectory(store, place->evaluation, d, k, &trajectory)) != MO_OK)
    reply_missing(request, &job, error);
  return trajectory;
}

void mo_api_get_trajectory(struct mo_request *request)
{
  struct mo_text text = {0};
  struct place place;
  struct mo_trajectory *trajectory = read_trajectory(request, &place);
  if (trajectory == NULL)
    return;
  mo_text_object(&text);
  mo_text_member_id(&text, "evaluation", place.evaluation);
  mo_text_member_count(&text, "design", (uint64_t)place.design);
  mo_text_member_count(&text, "environment", (uint64_t)place.environment);
  mo_text_member_count(&text, "stride", trajectory->stride);
  mo_text_member_count(&text, "frames", trajectory->n_frames);
  mo_text_member_number(&text, "dt_s", trajectory->dt_s);
  write_frames(&text, trajectory);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
  mo_reply_etag(request, "%" PRIx64 "-trajectory-%" PRId64 "-%" PRId64 "-%" PRId64,
                mo_store_id(mo_api_of(request)->store), place.evaluation, place.design,
                place.environment);
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
  reply_binary(request, trajectory, place.array != 0 && trajectory->mass_m != NULL);
  if (request->reply.status == 200)
    mo_reply_etag(request, "%" PRIx64 "-file-%" PRId64 "-%" PRId64 "-%" PRId64 "-%s",
                  mo_store_id(mo_api_of(request)->store), place.evaluation, place.design,
                  place.environment, array != NULL ? array : "");
  mo_trajectory_free(trajectory);
}
