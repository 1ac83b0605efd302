/* service.h: a store, the fake back end and the jobs room together, in a folder of their own. */
#ifndef MORPHO_TESTS_JOBS_SERVICE_H
#define MORPHO_TESTS_JOBS_SERVICE_H

#include "../store/fixture.h"
#include "fake_compute.h"
#include "jobs/evaluations.h"
#include "wait.h"

struct service {
  struct fixture fixture;
  struct mo_compute *compute;
  struct mo_jobs *jobs;
  struct mo_jobs_config config;
  const char *vfs;
  uint32_t n_workers; /* 0: 2 */
};

static inline int service_open(struct service *service)
{
  struct mo_store_config store_config = {.path = service->fixture.path, .vfs = service->vfs};
  struct mo_compute_config compute_config = {.n_workers =
                                                 service->n_workers > 0 ? service->n_workers : 2};
  struct mo_controller_record record;
  int error = mo_store_open(&store_config, &service->fixture.store, &service->fixture.message);
  if (error == MO_OK &&
      mo_store_controller(service->fixture.store, "default", &record) == MO_ERR_NOT_FOUND)
    error = fixture_controller(service->fixture.store, "default", 1, &record);
  if (error == MO_OK)
    error = mo_compute_create_cpu(&compute_config, &service->compute);
  if (error == MO_OK)
    error = mo_jobs_create(service->fixture.store, service->compute, &service->config,
                           &service->jobs, &service->fixture.message);
  return error;
}

static inline int service_start(struct service *service)
{
  memset(service, 0, sizeof(*service));
  service->config.retry_ms = 100;
  fake_plan.delay_us = 0;
  fake_plan.fail_status = 0;
  fake_plan.skew = 0;
  fake_plan.poison = false;
  fake_plan.gradient_delay_us = 0;
  fake_plan.gradient_status = 0;
  fake_plan.gradient_crash = false;
  fake_forget();
  if (fixture_folder(&service->fixture) != 0)
    return -1;
  return service_open(service);
}

static inline void service_close(struct service *service)
{
  mo_jobs_free(service->jobs);
  mo_compute_free(service->compute);
  mo_store_close(service->fixture.store);
  service->jobs = NULL;
  service->compute = NULL;
  service->fixture.store = NULL;
}

static inline void service_end(struct service *service)
{
  service_close(service);
  fixture_remove(service->fixture.path);
}

static inline struct mo_evaluation_request service_request(const struct mo_bits *genotypes,
                                                           uint32_t n)
{
  return (struct mo_evaluation_request){.genotypes = genotypes,
                                        .n_designs = n,
                                        .environment_set = "paper-test",
                                        .physics = mo_default_physics(),
                                        .priority = -1,
                                        .record_stride = 100};
}

static inline int64_t service_submit(struct service *service,
                                     const struct mo_evaluation_request *request)
{
  int64_t id = 0;
  bool replayed = false;
  int error =
      mo_jobs_submit_evaluation(service->jobs, request, &id, &replayed, &service->fixture.message);
  if (error != MO_OK) {
    printf("# submission: %s\n", service->fixture.message.text);
    return error;
  }
  return id;
}

/* Whether the results of a job are, bit for bit, what the fake back end gives. */
static inline bool service_results_right(struct service *service, int64_t id,
                                         const struct mo_bits *genotypes,
                                         const struct mo_physics *physics,
                                         enum mo_precision precision,
                                         const struct mo_controller *controller)
{
  struct mo_evaluation_results *results = NULL;
  struct mo_environment paper[MO_PAPER_TEST_COUNT];
  bool right = true;
  if (mo_store_results(service->fixture.store, id, &results) != MO_OK)
    return false;
  mo_environment_paper_test(paper);
  for (uint32_t n = 0; n < results->n_designs; n++) {
    struct mo_bits placed = genotypes[n];
    mo_genotype_place(MO_DEFAULT_WORKSPACE, placed.words);
    for (uint32_t k = 0; k < results->n_environments; k++) {
      struct mo_outcome outcome =
          fake_outcome(placed.words, controller, &paper[k], physics, precision);
      size_t cell = (size_t)n * results->n_environments + k;
      right = right && memcmp(&outcome.loss, &results->losses[cell], sizeof(double)) == 0 &&
              outcome.diverged_step == results->diverged_steps[cell];
    }
  }
  mo_evaluation_results_free(results);
  return right;
}

#endif
