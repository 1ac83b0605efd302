/* campaigns.h: what the tests of campaigns have in common: small campaigns on the fake back end. */
#ifndef MORPHO_TESTS_JOBS_CAMPAIGNS_H
#define MORPHO_TESTS_JOBS_CAMPAIGNS_H

#include "campaign_history.h"
#include "jobs/campaigns.h"
#include "watch.h"

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
  settings->physics.n_steps = 20;
  snprintf(request.record.environment_set, sizeof(request.record.environment_set), "paper-test");
  return request;
}

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

/* The file of the default controller, as the fixture stores it. */
static inline const char *default_digits(void)
{
  static char digits[MO_SHA256_DIGITS + 1];
  struct fixture fixture;
  struct mo_controller_record record;
  if (digits[0] == '\0' && fixture_start(&fixture) == MO_OK) {
    if (mo_store_controller(fixture.store, "default", &record) == MO_OK)
      mo_sha256_to_hex(&record.sha256, digits);
    fixture_end(&fixture);
  }
  return digits;
}

static inline struct origin origin_of(const struct mo_campaign_request *request)
{
  const bool has_controller =
      request->controller != NULL || request->record.settings.mode != MO_SIMULTANEOUS;
  return (struct origin){
      .settings = request->record.settings,
      .environments = request->record.environment_set[0] != '\0' ? paper : request->environments,
      .n_environments = request->record.environment_set[0] != '\0' ? MO_PAPER_TEST_COUNT
                                                                   : request->record.n_environments,
      .controller = has_controller ? default_weights() : NULL,
      .digits = has_controller ? default_digits() : NULL,
      .given = request->genotypes,
      .n_given = request->record.n_listed};
}

static inline int64_t submit(struct service *service, const struct mo_campaign_request *request)
{
  int64_t id = 0;
  bool replayed = false;
  uint32_t fault = 0;
  int error = mo_jobs_submit_campaign(service->jobs, request, &id, &replayed, &fault,
                                      &service->fixture.message);
  if (error != MO_OK)
    printf("# submission: %s\n", service->fixture.message.text);
  return error != MO_OK ? error : id;
}

static inline int start(struct service *service, uint32_t side_by_side)
{
  int error = watch_start(service);
  if (error != MO_OK)
    return error;
  service->config.max_active_campaigns = side_by_side;
  return service_open(service);
}

static inline struct mo_live live_of(struct service *service, int64_t id)
{
  struct mo_live live;
  mo_jobs_live(service->jobs, id, &live);
  return live;
}

static inline bool await_phase(struct service *service, int64_t id, enum mo_phase phase)
{
  double end = now_s() + 60;
  while (live_of(service, id).phase != phase)
    if (now_s() > end)
      return false;
    else
      usleep(300);
  return true;
}

/* At least so far: the current generation, or a later one, in this phase. */
static inline bool await_place(struct service *service, int64_t id, uint32_t generation,
                               enum mo_phase phase)
{
  double end = now_s() + 60;
  struct mo_live live;
  do {
    usleep(300);
    live = live_of(service, id);
  } while ((live.position < generation || live.phase != phase) && now_s() < end);
  return live.phase == phase;
}

static inline struct mo_campaign_status status_of(struct service *service, int64_t id)
{
  struct mo_campaign_status status = {.generation = -2};
  (void)mo_store_campaign(service->fixture.store, id, &status);
  return status;
}

/* Whether it succeeds, with everything that plain loops give. */
static inline bool ends_as_plain(struct service *service, int64_t id, const struct origin *origin)
{
  struct mo_job job;
  return await_end(service->jobs, id, 120000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED &&
         job.attempts == 0 && is_as_plain(service->fixture.store, id, &fake_plain, origin);
}

/* The rollouts and learning robots that a campaign needs, when nothing is computed twice. */
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
