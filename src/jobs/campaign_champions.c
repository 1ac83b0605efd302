/* campaign_champions.c: the champions of a generation, and recordings of them. */
#include "jobs/campaigns.h"

#include <stdlib.h>
#include <string.h>

#include "jobs/evaluations.h"
#include "jobs/learner.h"
#include "jobs/trainings.h"
#include "store/runner.h"
#include "store/worlds.h"

/* ---- champions ---- */

/* Reads a whole population of at most `most` designs, best first (malloc). */
static int read_population(struct mo_store *store, int64_t id, int64_t generation, uint32_t most,
                           struct mo_campaign_design **designs, uint32_t *n)
{
  struct mo_campaign_design *rows = calloc(most, sizeof(*rows));
  uint32_t read = 0, size = 0;
  int64_t got = rows != NULL ? 1 : MO_ERR_NO_MEMORY;
  while (got > 0 && read < most) {
    const uint32_t before = size, left = most - read;
    got = mo_store_campaign_population(store, id, generation, read, rows + read,
                                       left < MO_PAGE_MAX ? left : MO_PAGE_MAX, &size);
    if (read > 0 && size != before) /* a newer generation was committed in the meantime */
      got = MO_ERR_BUSY;
    read += got > 0 ? (uint32_t)got : 0;
  }
  if (got < 0) {
    free(rows);
    return (int)got;
  }
  *n = read;
  *designs = rows;
  return MO_OK;
}

static int choose(struct mo_workspace workspace, const struct mo_campaign_design *designs,
                  uint32_t n, uint32_t m, struct mo_campaign_design *rows, double *distinctiveness)
{
  const size_t words = mo_workspace_words(workspace);
  uint64_t *genotypes = calloc((size_t)n * words + 1, sizeof(*genotypes));
  double *scores = calloc((size_t)n + 1, sizeof(*scores));
  uint32_t *picks = calloc((size_t)m + 1, sizeof(*picks));
  int error = genotypes == NULL || scores == NULL || picks == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    scores[i] = designs[i].score;
    error = mo_genotype_move(designs[i].genotype.workspace, designs[i].genotype.words, workspace,
                             genotypes + words * i);
  }
  if (error == MO_OK)
    error = mo_champions(workspace, genotypes, scores, n, m, picks, distinctiveness);
  for (uint32_t i = 0; i < m && error == MO_OK; i++)
    rows[i] = designs[picks[i]];
  free(genotypes);
  free(scores);
  free(picks);
  return error;
}

int mo_jobs_campaign_champions(struct mo_jobs *jobs, int64_t id, int64_t generation, uint32_t m,
                               struct mo_campaign_design *rows, double *distinctiveness,
                               uint32_t *n)
{
  struct mo_campaign_status status;
  struct mo_campaign_design *designs = NULL;
  uint32_t size = 0;
  int error = mo_store_campaign(jobs->store, id, &status);
  if (error == MO_OK && generation < 0)
    generation = status.generation;
  if (error == MO_OK && generation < 0)
    error = MO_ERR_NOT_FOUND;
  if (error == MO_OK)
    error = read_population(jobs->store, id, generation, status.record.settings.population,
                            &designs, &size);
  if (error != MO_OK)
    return error;
  if (m > size)
    m = size;
  error = choose(status.record.settings.workspace, designs, size, m, rows, distinctiveness);
  if (error == MO_OK)
    *n = m;
  free(designs);
  return error;
}

/* ---- recordings ---- */

/* Finds an unused file name. */
static int free_name(struct mo_store *store, int64_t id, int64_t generation,
                     const struct mo_sha256 *sha256, char name[MO_NAME_BYTES_MAX + 1])
{
  struct mo_controller_record record;
  int error = MO_OK;
  for (int i = 0; i < 100 && error == MO_OK; i++) {
    snprintf(name, MO_NAME_BYTES_MAX + 1, "campaign-%lld.generation-%lld.%d", (long long)id,
             (long long)generation, i);
    error = mo_store_controller(store, name, &record);
    if (error == MO_OK && mo_sha256_equal(&record.sha256, sha256))
      return MO_OK;
  }
  return error == MO_ERR_NOT_FOUND ? MO_OK : error == MO_OK ? MO_ERR_CONFLICT : error;
}

/* Stores the controller that scored the newest generation of a campaign that learns, from its
 * checkpoint, under a new name. *created: remove the name once a job refers to the file. */
static int store_controller(struct mo_jobs *jobs, const struct mo_campaign_status *status,
                            struct mo_sha256 *sha256, char name[MO_NAME_BYTES_MAX + 1],
                            bool *created)
{
  struct mo_training *training = NULL;
  struct mo_learned learned = {.controller = NULL};
  struct mo_controller_record stored;
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t step = 0;
  int error = mo_store_campaign_checkpoint_of(jobs->store, status->job.id,
                                              (uint32_t)status->generation, &step, &bytes, &size);
  if (error == MO_OK)
    error = mo_training_decode(bytes, size, &training, NULL);
  free(bytes);
  if (error == MO_OK)
    error = mo_learned_create(jobs, &status->job, training, NULL, &learned);
  mo_training_free(training);
  if (error == MO_OK) {
    mo_sha256_of(learned.bytes, learned.size, sha256);
    error = free_name(jobs->store, status->job.id, status->generation, sha256, name);
  }
  if (error == MO_OK)
    error = mo_store_controller_put(jobs->store, name, learned.bytes, learned.size,
                                    learned.controller, &stored, created);
  mo_learned_free(&learned);
  return error;
}

static int submit_recording(struct mo_jobs *jobs, const struct mo_campaign_status *status,
                            const struct mo_sha256 *sha256, const struct mo_bits *genotypes,
                            uint32_t n, const struct mo_champions_request *asked,
                            const struct mo_request_key *key, int64_t *evaluation,
                            struct mo_message *message)
{
  const struct mo_campaign_record *record = &status->record;
  struct mo_environment *environments = NULL;
  char controller[MO_SHA256_DIGITS + 8] = "sha256:";
  bool replayed = false;
  struct mo_evaluation_request request = {
      .genotypes = genotypes,
      .n_designs = n,
      .environment_set = asked->environment_set != NULL       ? asked->environment_set
                         : record->environment_set[0] != '\0' ? record->environment_set
                                                              : NULL,
      .controller = asked->controller != NULL ? asked->controller : controller,
      .physics = record->settings.physics,
      .precision = MO_FLOAT32,
      .job = {.priority = -1, .label = asked->label, .submitted_by = asked->submitted_by},
      .record = asked->record,
      .record_stride = asked->stride};
  const uint32_t steps = request.physics.scheme.n_steps;
  int error = MO_OK;
  if (n == 0) /* a study can leave an empty population */
    return mo_fail(message, MO_ERR_RANGE, "an evaluation must have 1 to %d designs, got 0",
                   MO_DESIGNS_MAX);
  if (asked->record != 0 && asked->stride > steps)
    return mo_fail(message, MO_ERR_RANGE,
                   "the stride of a recording must be 1 to the number of steps (%u), got %u",
                   (unsigned)steps, (unsigned)asked->stride);
  if (key != NULL)
    request.job.key = *key;
  mo_sha256_to_hex(sha256, controller + strlen(controller));
  if (request.environment_set == NULL) {
    error = mo_store_job_environments(jobs->store, status->job.id, MO_JOB_CAMPAIGN, &environments,
                                      &request.n_environments);
    request.environments = environments;
  }
  if (error == MO_OK)
    error = mo_jobs_submit_evaluation(jobs, &request, evaluation, &replayed, message);
  mo_environments_free(environments, request.n_environments);
  return error == MO_ERR_CONFLICT ? MO_ERR_DUPLICATE : error;
}

int mo_jobs_campaign_record_champions(struct mo_jobs *jobs, int64_t id,
                                      const struct mo_champions_request *request,
                                      const struct mo_request_key *key, int64_t *evaluation,
                                      struct mo_message *message)
{
  struct mo_campaign_status status;
  struct mo_campaign_design *rows;
  struct mo_bits *genotypes;
  char name[MO_NAME_BYTES_MAX + 1];
  bool created = false;
  const uint32_t m = request->count;
  uint32_t n = 0;
  if (key != NULL && mo_store_replay(jobs->store, key, evaluation) == MO_OK)
    return MO_OK;
  int error = mo_store_campaign(jobs->store, id, &status);
  if (error == MO_OK && status.generation < 0)
    return mo_fail(message, MO_ERR_NOT_FOUND, "campaign %lld has no population yet", (long long)id);
  if (error != MO_OK)
    return mo_fail(message, error, "campaign %lld: %s", (long long)id, mo_error_text(error));
  rows = calloc(m, sizeof(*rows));
  genotypes = calloc(m, sizeof(*genotypes));
  error = rows == NULL || genotypes == NULL
              ? MO_ERR_NO_MEMORY
              : mo_jobs_campaign_champions(jobs, id, status.generation, m, rows, NULL, &n);
  for (uint32_t i = 0; i < n; i++)
    memcpy(genotypes[i].words, rows[i].genotype.words, sizeof(*genotypes));
  struct mo_sha256 sha256 =
      status.job.has_result ? status.job.result_sha256 : status.job.controller_sha256;
  if (error == MO_OK && request->controller == NULL &&
      mo_modes[status.record.settings.mode].learns && !status.job.has_result)
    error = store_controller(jobs, &status, &sha256, name, &created);
  if (error != MO_OK)
    (void)mo_fail(message, error, "the champions cannot be evaluated: %s", mo_error_text(error));
  else
    error =
        submit_recording(jobs, &status, &sha256, genotypes, n, request, key, evaluation, message);
  if (created) /* the evaluation refers to the file by its hash */
    (void)mo_store_controller_remove(jobs->store, name);
  free(rows);
  free(genotypes);
  return error;
}
