/* trajectories.c: recorded positions. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "api/handlers.h"

static void write_frames(struct mo_text *text, const struct mo_trajectory *t)
{
  if (t->com_m != NULL) {
    mo_text_add(text, ",\"com_m\":[");
    for (uint32_t f = 0; f < t->n_frames; f++)
      for (int axis = 0; axis < 3; axis++) {
        mo_text_add(text, axis > 0 ? "," : f > 0 ? "],[" : "[");
        mo_text_json_number(text, t->com_m[(size_t)f * 3 + (size_t)axis]);
      }
    mo_text_add(text, "]]");
  }
  if (t->mass_m != NULL) {
    mo_text_add(text, ",\"masses_m\":[");
    for (uint32_t f = 0; f < t->n_frames; f++) {
      mo_text_add(text, f > 0 ? "],[" : "[");
      const float *frame = &t->mass_m[(size_t)f * t->n_masses * 3];
      for (size_t i = 0; i < (size_t)t->n_masses * 3; i++) {
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

/* Replies with the trajectory. *masses: the binary form holds the masses, not the center of mass.
 */
static void reply_trajectory(struct mo_request *request, const struct mo_trajectory *t, int64_t id,
                             int64_t n, int64_t k)
{
  struct mo_text text = {0};
  mo_text_format(&text,
                 "{\"evaluation\":\"%lld\",\"design\":%lld,\"environment\":%lld,\"stride\":%u,"
                 "\"frames\":%u,\"dt_s\":",
                 (long long)id, (long long)n, (long long)k, t->stride, t->n_frames);
  mo_text_json_number(&text, t->dt_s);
  write_frames(&text, t);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
}

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

/* Reads the trajectory that the path and `environment` name. array: "com" or "masses", which must
 * have been recorded; NULL: any. NULL: the reply is made. */
static struct mo_trajectory *read_trajectory(struct mo_request *request, const char *array,
                                             int64_t *id, int64_t *n, int64_t *k)
{
  struct mo_store *store = mo_api_of(request)->store;
  const char *design = request->parameters[1];
  *k = 0;
  if (!mo_path_id(request, 0, id))
    return NULL;
  if (!mo_decimal(design, strlen(design), 0, MO_DESIGNS_MAX - 1, n)) {
    mo_reply_problem(request, 404, NULL,
                     "There is no such design: its place in the request, from 0, is expected.");
    return NULL;
  }
  if (!mo_query_number(request, "environment", 0, MO_ENVIRONMENTS_MAX - 1, k))
    return NULL;
  bool com = array != NULL && strcmp(array, "com") == 0,
       masses = array != NULL && strcmp(array, "masses") == 0;
  if (array != NULL && !com && !masses) {
    mo_reply_bad_parameter(request, "array", "com or masses is expected");
    return NULL;
  }
  struct mo_trajectory *trajectory = NULL;
  struct mo_job job;
  int error = mo_store_job(store, *id, &job);
  if (error != MO_OK)
    mo_reply_error(request, error, "evaluation");
  else if ((uint32_t)*n >= job.n_designs || (uint32_t)*k >= job.n_environments)
    mo_reply_problem(request, 404, NULL, "The evaluation has %u designs and %u environments.",
                     job.n_designs, job.n_environments);
  else if (!job.record_com && !job.record_masses)
    mo_reply_problem(request, 404, NULL, "The evaluation did not ask for a recording.");
  else if ((masses && !job.record_masses) || (com && !job.record_com))
    mo_reply_problem(request, 404, NULL,
                     "The evaluation did not ask for a recording of this array.");
  else if ((error = mo_store_trajectory(store, *id, (uint32_t)*n, (uint32_t)*k, &trajectory)) !=
           MO_OK)
    reply_missing(request, &job, error);
  return trajectory;
}

void mo_api_get_trajectory(struct mo_request *request)
{
  int64_t id, n, k;
  struct mo_trajectory *trajectory = read_trajectory(request, NULL, &id, &n, &k);
  if (trajectory == NULL)
    return;
  reply_trajectory(request, trajectory, id, n, k);
  mo_reply_etag(request, "%" PRIx64 "-trajectory-%lld-%lld-%lld",
                mo_store_id(mo_api_of(request)->store), (long long)id, (long long)n, (long long)k);
  mo_trajectory_free(trajectory);
}

void mo_api_get_trajectory_file(struct mo_request *request)
{
  static const char *const types[] = {"application/octet-stream"};
  const char *array = mo_query(request, "array");
  int64_t id, n, k;
  int form;
  if (!mo_accept(request, types, 1, &form))
    return;
  struct mo_trajectory *trajectory = read_trajectory(request, array, &id, &n, &k);
  if (trajectory == NULL)
    return;
  bool com = array != NULL && strcmp(array, "com") == 0;
  reply_binary(request, trajectory, !com && trajectory->mass_m != NULL);
  if (request->reply.status == 200)
    mo_reply_etag(request, "%" PRIx64 "-file-%lld-%lld-%lld-%s",
                  mo_store_id(mo_api_of(request)->store), (long long)id, (long long)n, (long long)k,
                  array != NULL ? array : "");
  mo_trajectory_free(trajectory);
}
