/* campaigns.h: what the tests of campaigns have in common: small campaigns on the fake back end. */
#ifndef MORPHO_TESTS_JOBS_CAMPAIGNS_H
#define MORPHO_TESTS_JOBS_CAMPAIGNS_H

#include "campaign_history.h"
#include "jobs/campaigns.h"
#include "watch.h"

#define POPULATION   10
#define GENERATIONS  4
#define PARENT_STEPS 2
#define CHILD_STEPS  3

static struct mo_environment paper[MO_PAPER_TEST_COUNT];

static inline struct mo_campaign_request campaign(enum mo_campaign_mode mode)
{
  struct mo_campaign_request request = {.record = {.settings = mo_campaign_preset(mode, MO_PRESET_DEMO)}};
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
                                     const struct mo_controller *controller, const struct mo_environment *environment,
                                     const struct mo_physics *physics)
{
  (void)context;
  return fake_outcome(genotype->words, controller, environment, physics, MO_FLOAT32).loss;
}

static inline void fake_plain_gradient(void *context, const struct mo_controller *controller,
                                       const struct mo_robot *robots, uint32_t n, const struct mo_physics *physics,
                                       double *d_parameters, struct mo_outcome *outcomes,
                                       struct mo_gradient_counts *counts)
{
  (void)context;
  (void)physics;
  fake_gradient(controller, robots, n, d_parameters, outcomes, counts);
}

static const struct plain fake_plain = {fake_plain_loss, fake_plain_gradient, NULL, "fake gradient"};

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
  const bool has_controller = request->controller != NULL || request->record.settings.mode != MO_SIMULTANEOUS;
  return (struct origin){.settings = request->record.settings,
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
  int error = mo_jobs_submit_campaign(service->jobs, request, &id, &replayed, &fault, &service->fixture.message);
  if (error != MO_OK)
    printf("# submission: %s\n", service->fixture.message.text);
  return error != MO_OK ? error : id;
}

static char warned[256];
static pthread_mutex_t warned_mutex = PTHREAD_MUTEX_INITIALIZER;
static int warnings;

static inline void hear_warning(void *context, int64_t job, int error, const char *text)
{
  (void)context;
  (void)job;
  (void)error;
  pthread_mutex_lock(&warned_mutex);
  snprintf(warned, sizeof(warned), "%s", text);
  warnings++;
  pthread_mutex_unlock(&warned_mutex);
}

static inline int start(struct service *service, uint32_t side_by_side)
{
  int error = service_start(service);
  if (error != MO_OK)
    return error;
  service_close(service);
  pthread_mutex_lock(&warned_mutex);
  warnings = 0;
  warned[0] = '\0';
  pthread_mutex_unlock(&warned_mutex);
  service->config.max_active_campaigns = side_by_side;
  service->config.warn = hear_warning;
  return service_open(service);
}

#endif
