/* learned.c: results of a training run: its controller so far, and its held-out designs and
 * environments. */
#include <stdlib.h>

#include "api/handlers.h"
#include "api/job_json.h"
#include "jobs/held_out.h"
#include "jobs/trainings.h"
#include "rollout/physics.h"
#include "world/environment.h"
#include "world/task_json.h"

#define HELD_OUT_DESIGNS_MAX 1000
#define HELD_OUT_PLACES_MAX  64

/* ---- the controller ---- */

/* Exports the controller of a checkpoint (step 0: the newest) as a file. *at: its step. */
static int export_checkpoint(struct mo_api *api, const struct mo_training_status *status,
                             uint32_t step, uint8_t **bytes, size_t *size, uint32_t *at)
{
  const struct mo_job *job = &status->job;
  struct mo_training *training = NULL;
  struct mo_learned learned = {.bytes = NULL};
  struct mo_message message = {""};
  uint8_t *stored = NULL;
  size_t n = 0;
  int code = mo_store_training_checkpoint_bytes(api->store, job->id, step, &stored, &n);
  if (code == MO_OK)
    code = mo_training_decode(stored, n, &training, &message);
  free(stored);
  if (code == MO_OK) {
    *at = mo_training_step(training);
    code = mo_learned_create(api->jobs, job, training, &status->code, &learned);
  }
  if (code == MO_OK) {
    *bytes = learned.bytes;
    *size = learned.size;
    learned.bytes = NULL;
  }
  mo_learned_free(&learned);
  mo_training_free(training);
  return code == MO_ERR_FORMAT ? MO_ERR_CORRUPT : code;
}

/* Replies that the file of the training run's result, or of a checkpoint (step 0: the newest), is
 * missing or damaged, and does not match its row. */
static void reply_damaged(struct mo_request *request, const struct mo_training_status *status,
                          bool result, uint32_t step)
{
  static const char words[] = "in the state folder of the service is missing or damaged.";
  struct mo_checkpoint_row newest = {.step = step};
  if (step == 0 && !result)
    (void)mo_store_checkpoints(mo_api_of(request)->store, status->job.id, &newest, 1);
  if (result)
    mo_reply_problem(request, 500, NULL, "The file controllers/%s.safetensors %s",
                     MO_SHA256_HEX(&status->job.result_sha256), words);
  else
    mo_reply_problem(request, 500, NULL, "The file trainings/%lld/%u.checkpoint %s",
                     (long long)status->job.id, newest.step, words);
}

void mo_api_get_training_controller(struct mo_request *request)
{
  static const char *const types[] = {"application/octet-stream", "application/vnd.safetensors",
                                      NULL};
  struct mo_api *api = mo_api_of(request);
  bool named = mo_query(request, "step") != NULL;
  int64_t id, step = 0;
  int form;
  if (!mo_accept(request, types, &form) ||
      !mo_query_number(request, "step", 1, MO_TRAINING_STEPS_MAX, &step) ||
      !mo_path_id(request, 0, &id))
    return;
  struct mo_training_status status;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int code = mo_store_training(api->store, id, &status);
  if (code != MO_OK) {
    mo_reply_error(request, code, "training");
    return;
  }
  if (status.record.each) {
    mo_reply_problem(request, 404, NULL,
                     "The training run has one controller per design and no single result; GET "
                     "/v1/trainings/%lld/each lists the designs and the stored controllers.",
                     (long long)id);
    return;
  }
  uint32_t at = status.record.settings.n_steps;
  const bool result = status.job.has_result && (!named || step == at);
  if (result)
    code = mo_store_controller_bytes(api->store, &status.job.result_sha256, &bytes, &size);
  else
    code = export_checkpoint(api, &status, (uint32_t)step, &bytes, &size, &at);
  if (code == MO_ERR_NOT_FOUND && named)
    mo_reply_problem(request, 404, NULL,
                     "The training run has no checkpoint of step %lld; GET "
                     "/v1/trainings/%lld/checkpoints lists its checkpoints.",
                     (long long)step, (long long)id);
  else if (code == MO_ERR_NOT_FOUND)
    mo_reply_problem(request, 404, NULL,
                     mo_job_state_is_final(status.job.state)
                         ? "The training run has ended without a result, and has no checkpoint."
                         : "The training run has no checkpoint yet.");
  else if (code == MO_ERR_CORRUPT)
    reply_damaged(request, &status, result, (uint32_t)step);
  else if (code != MO_OK)
    mo_reply_error(request, code, "controller");
  else {
    struct mo_sha256 hash;
    mo_sha256_of(bytes, size, &hash);
    mo_reply_bytes(request, 200, types[form], (char *)bytes, size);
    mo_reply_extra(request, "Morphod-Step", "%u", at);
    mo_reply_etag(request, "%s", MO_SHA256_HEX(&hash));
  }
}

/* ---- held-out sets ---- */

/* Replies with designs and environments as the body of an evaluation request. physics NULL: the
 * default. genotypes: (n_designs), placed. */
static void reply_held_out(struct mo_request *request, const struct mo_bits *genotypes,
                           uint32_t n_designs, const struct mo_environment *environments,
                           uint32_t n_environments, const struct mo_physics *physics)
{
  struct mo_text text = {0};
  mo_text_add(&text, "{\"designs\":[");
  for (uint32_t i = 0; i < n_designs; i++) {
    const struct mo_genotype genotype =
        mo_genotype_of(mo_api_of(request)->lattice->workspace, &genotypes[i]);
    mo_text_object(&text);
    mo_member_genotype(&text, "voxels", &genotype);
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "],\"environments\":[");
  for (uint32_t k = 0; k < n_environments; k++) {
    mo_text_object(&text);
    mo_environment_write_members(&text, &environments[k]);
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "]");
  if (physics != NULL) {
    mo_text_name(&text, "physics");
    mo_fields_write_object(&text, &mo_physics_fields, physics);
  }
  mo_text_add(&text, "}");
  mo_reply_text(request, MO_OK, &text, "set");
}

static int draw(uint64_t seed, uint32_t n, struct mo_bits **genotypes)
{
  _Static_assert(sizeof(**genotypes) == MO_DEFAULT_WORDS * sizeof(uint64_t),
                 "genotypes are contiguous");
  *genotypes = calloc(n, sizeof(**genotypes));
  return *genotypes != NULL ? mo_held_out_designs(seed, n, (*genotypes)->words) : MO_ERR_NO_MEMORY;
}

static int draw_environments(uint64_t seed, uint32_t n, struct mo_environment **environments)
{
  *environments = calloc(n, sizeof(**environments));
  if (*environments == NULL)
    return MO_ERR_NO_MEMORY;
  mo_held_out_environments(seed, n, *environments);
  return MO_OK;
}

void mo_api_get_training_held_out(struct mo_request *request)
{
  struct mo_store *store = mo_api_of(request)->store;
  struct mo_training_status status;
  struct mo_environment *environments = NULL;
  struct mo_bits *genotypes = NULL;
  uint32_t n = 0, n_environments = 0;
  int64_t id;
  if (!mo_path_id(request, 0, &id))
    return;
  const struct mo_training_settings *settings = &status.record.settings;
  int code = mo_store_training(store, id, &status);
  if (code == MO_OK && settings->kind == MO_TRAINING_FINETUNE)
    code = mo_store_job_designs(store, id, &genotypes, &n);
  else if (code == MO_OK && (n = settings->held_out_designs) > 0)
    code = draw(settings->seed, n, &genotypes);
  if (code == MO_OK)
    code = mo_held_out_worlds(store, &status, &environments, &n_environments);
  if (code != MO_OK)
    mo_reply_error(request, code, "training");
  else
    reply_held_out(
        request, genotypes,
        n < settings->held_out_designs || status.record.each ? n : settings->held_out_designs,
        environments, n_environments, &settings->physics);
  mo_environments_free(environments, n_environments);
  free(genotypes);
}

void mo_api_get_held_out(struct mo_request *request)
{
  int64_t seed = 1, designs = 64, environments = 8;
  struct mo_environment *places = NULL;
  struct mo_bits *genotypes = NULL;
  if (!mo_query_number(request, "seed", 0, MO_SEED_MAX, &seed) ||
      !mo_query_number(request, "designs", 1, HELD_OUT_DESIGNS_MAX, &designs) ||
      !mo_query_number(request, "environments", 1, HELD_OUT_PLACES_MAX, &environments))
    return;
  int code = draw((uint64_t)seed, (uint32_t)designs, &genotypes);
  if (code == MO_OK)
    code = draw_environments((uint64_t)seed, (uint32_t)environments, &places);
  if (code != MO_OK)
    mo_reply_error(request, code, "set");
  else
    reply_held_out(request, genotypes, (uint32_t)designs, places, (uint32_t)environments, NULL);
  free(places);
  free(genotypes);
}
