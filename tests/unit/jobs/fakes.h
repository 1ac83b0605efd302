/* fakes.h: small jobs on the fake back end, and their expected results. */
#ifndef MORPHO_TESTS_JOBS_FAKES_H
#define MORPHO_TESTS_JOBS_FAKES_H

#include "campaign_history.h"
#include "service.h"

/* Plain loops with the fake's losses and gradients. */
static inline double fake_plain_loss(void *context, const struct mo_bits *genotype,
                                     const struct mo_controller *controller,
                                     const struct mo_environment *environment,
                                     const struct mo_physics *physics)
{
  (void)context;
  return fake_outcome(genotype->words, controller, environment, physics, MO_FLOAT32).loss;
}

static inline void fake_plain_gradient(void *context, const struct mo_controller *controller,
                                       const struct mo_robot *robots, uint32_t n,
                                       const struct mo_physics *physics, double *d_parameters,
                                       struct mo_outcome *outcomes,
                                       struct mo_gradient_counts *counts)
{
  (void)context;
  (void)physics;
  fake_gradient(controller, robots, n, d_parameters, outcomes, counts);
}

static const struct plain fake_plain = {fake_plain_loss, fake_plain_gradient, NULL,
                                        "fake gradient"};

/* ---- evaluations ---- */

/* Returns whether the results of an evaluation are, bit for bit, those of the fake back end. */
static inline bool results_right(int64_t id, const struct mo_bits *genotypes,
                                 enum mo_precision precision,
                                 const struct mo_controller *controller)
{
  const struct mo_physics physics = mo_paper_physics();
  struct mo_evaluation_results *results = NULL;
  struct mo_environment paper[MO_PAPER_TEST_COUNT];
  bool is_right = true;
  if (mo_store_results(store, id, &results) != MO_OK)
    return false;
  mo_environment_paper_test(paper);
  for (uint32_t n = 0; n < results->n_designs; n++) {
    struct mo_bits placed = genotypes[n];
    mo_genotype_place(MO_DEFAULT_WORKSPACE, placed.words);
    for (uint32_t k = 0; k < results->n_environments; k++) {
      struct mo_outcome outcome =
          fake_outcome(placed.words, controller, &paper[k], &physics, precision);
      size_t cell = (size_t)n * results->n_environments + k;
      is_right = is_right && same_number(outcome.loss, results->losses[cell]) &&
                 outcome.diverged_step == results->diverged_steps[cell];
    }
  }
  mo_evaluation_results_free(results);
  return is_right;
}

/* Returns whether an evaluation succeeds with these losses. */
static inline bool right(int64_t id, const struct mo_bits *genotypes)
{
  if (!succeeds(id, NULL))
    return false;
  return results_right(id, genotypes, MO_FLOAT32, default_weights());
}

/* Submits an evaluation of these bodies and returns its id. */
static inline int64_t evaluate(const struct mo_bits *genotypes, uint32_t n)
{
  const struct mo_evaluation_request request = service_request(genotypes, n);
  return submit_evaluation(&request);
}

/* ---- training runs ---- */

#define STEPS 18
#define BATCH 8

static inline struct mo_training_request pretraining(const char *name)
{
  struct mo_training_request request = {
      .record = {.settings = mo_training_defaults(MO_TRAINING_PRETRAIN),
                 .validate_every_steps = 10,
                 .checkpoint_every_steps = 6,
                 .checkpoints_kept = 2}};
  request.record.settings.n_steps = STEPS;
  request.record.settings.batch = BATCH;
  request.record.settings.held_out_designs = 3;
  request.record.settings.held_out_environments = 20;
  snprintf(request.record.name, sizeof(request.record.name), "%s", name);
  return request;
}

/* Returns the hash of the file that a training run must export. parent_digits, lineage: as in
 * mo_training_export. */
static inline struct mo_sha256 expect(const struct mo_training_request *request,
                                      const struct mo_controller *parent, const char *parent_digits,
                                      const struct mo_bits *designs, uint32_t n,
                                      const struct mo_training_lineage *lineage)
{
  const struct mo_training_settings *settings = &request->record.settings;
  struct mo_training *training = NULL;
  CHECK_OK(mo_training_create(settings, parent, designs != NULL ? designs[0].words : NULL, n,
                              &training));
  plain_steps(&fake_plain, training, settings->n_steps, NULL);
  struct mo_sha256 sha256 = plain_result(training, parent_digits, "fake gradient", lineage);
  mo_training_free(training);
  return sha256;
}

static const struct mo_training_lineage one_code = {1, {{0, "fake gradient"}}};

/* The same for pretraining(""). */
static inline const struct mo_sha256 *undisturbed(void)
{
  static struct mo_sha256 sha256;
  static bool known;
  struct mo_training_request request = pretraining("");
  if (!known)
    sha256 = expect(&request, NULL, NULL, NULL, 0, &one_code);
  known = true;
  return &sha256;
}

static inline struct mo_training_status training_of(int64_t id)
{
  struct mo_training_status status = {.step = 0};
  CHECK_OK(mo_store_training(store, id, &status));
  return status;
}

/* Returns whether a training run succeeds with this result and without an attempt that counts. */
static inline bool learns_to(int64_t id, const struct mo_sha256 *expected)
{
  struct mo_job job;
  if (!succeeds(id, &job) || job.attempts != 0)
    return false;
  struct mo_training_status status = training_of(id);
  return status.job.has_result && mo_sha256_equal(&status.job.result_sha256, expected);
}

static inline bool await_step(int64_t id, uint32_t step)
{
  return AWAIT(live_of(id).position >= step);
}

/* ---- campaigns ---- */

#define POPULATION   10
#define GENERATIONS  3
#define PARENT_STEPS 2
#define CHILD_STEPS  3

static struct mo_environment paper[MO_PAPER_TEST_COUNT];

static inline struct mo_campaign_request campaign(enum mo_campaign_mode mode)
{
  struct mo_campaign_request request = {
      .record = {.settings = mo_campaign_preset(mode, MO_PRESET_DEMO)}};
  struct mo_campaign_settings *settings = &request.record.settings;
  mo_environment_paper_test(paper);
  settings->population = POPULATION;
  settings->generations = GENERATIONS;
  settings->seed = 5;
  if (mode != MO_ZERO_SHOT) {
    settings->parent_steps = PARENT_STEPS;
    settings->child_steps = CHILD_STEPS;
  }
  settings->physics.scheme.n_steps = 20;
  snprintf(request.record.environment_set, sizeof(request.record.environment_set), "paper-test");
  return request;
}

/* Returns the file of the default controller, as put_weights stores it. */
static inline const char *default_digits(void)
{
  static char digits[MO_SHA256_DIGITS + 1];
  struct mo_controller *controller = NULL;
  struct mo_sha256 sha256;
  uint8_t *bytes = NULL;
  size_t size = 0;
  if (digits[0] != '\0')
    return digits;
  CHECK_OK(draw_weights(1, &controller, &bytes, &size));
  mo_sha256_of(bytes, size, &sha256);
  mo_sha256_to_hex(&sha256, digits);
  free(bytes);
  mo_controller_free(controller);
  return digits;
}

static inline struct origin origin_of(const struct mo_campaign_request *request)
{
  const bool has_controller =
      request->controller != NULL || request->record.settings.mode != MO_SIMULTANEOUS;
  const bool has_set = request->record.environment_set[0] != '\0';
  return (struct origin){.settings = request->record.settings,
                         .environments = has_set ? paper : request->environments,
                         .n_environments =
                             has_set ? MO_PAPER_TEST_COUNT : request->record.n_environments,
                         .controller = has_controller ? default_weights() : NULL,
                         .digits = has_controller ? default_digits() : NULL,
                         .given = request->genotypes,
                         .n_given = request->record.n_listed};
}

static inline struct mo_campaign_status status_of(int64_t id)
{
  struct mo_campaign_status status = {.generation = -1};
  (void)mo_store_campaign(store, id, &status);
  return status;
}

/* Waits for this phase in this generation or a later one. */
static inline bool await_place(int64_t id, uint32_t generation, enum mo_phase phase)
{
  struct mo_live live;
  return AWAIT((live = live_of(id)).position >= generation && live.phase == phase);
}

/* Returns whether a campaign succeeds with the history that plain loops compute. */
static inline bool ends_as_plain(int64_t id, const struct origin *origin)
{
  struct mo_job job;
  return succeeds(id, &job) && job.attempts == 0 && is_as_plain(id, &fake_plain, origin);
}

static inline int extend(int64_t id, uint32_t generations)
{
  return mo_jobs_extend_campaign(service.jobs, id, generations, NULL, &fixture.message);
}

/* ---- training runs and campaigns, for behavior that they share ---- */

enum { TRAINING = -1 }; /* in addition to the modes of campaigns */

static inline int64_t submit_one(int mode)
{
  struct mo_training_request training = pretraining("");
  if (mode == TRAINING)
    return submit_training(&training);
  struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
  return submit_campaign(&request);
}

/* Returns whether a job of submit_one ends as if it had not been disturbed. Learning dominates the
 * time of these tests, so the history from plain loops is computed once for each mode. */
static inline bool ends_right(int64_t id, int mode)
{
  static struct history *known[MO_SIMULTANEOUS + 1];
  struct mo_job job;
  if (mode == TRAINING)
    return learns_to(id, undisturbed());
  const struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
  const struct origin origin = origin_of(&request);
  if (known[mode] == NULL)
    known[mode] = plain_history(&fake_plain, &origin);
  return succeeds(id, &job) && job.attempts == 0 && is_history(id, known[mode]);
}

/* Returns the rollouts and learning robots of a campaign in which nothing is computed twice. */
static inline void needs(const struct origin *origin, uint64_t *rollouts, uint64_t *robots)
{
  struct history *history = plain_history(&fake_plain, origin);
  *rollouts = *robots = 0;
  for (uint32_t g = 0; g < history->n_generations; g++) {
    *rollouts += history->generations[g].rollouts;
    *robots += (uint64_t)history->generations[g].learning_steps * origin->settings.population;
  }
  free(history);
}

#endif
