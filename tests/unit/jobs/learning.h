/* learning.h: a small training with the fake back end, what it must end with, and what the tests of
 * trainings wait for. */
#ifndef MORPHO_TESTS_JOBS_LEARNING_H
#define MORPHO_TESTS_JOBS_LEARNING_H

#include "jobs/trainings.h"
#include "watch.h"

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

static inline int64_t submit(struct service *service, const struct mo_training_request *request)
{
  int64_t id = 0;
  bool replayed = false;
  int error =
      mo_jobs_submit_training(service->jobs, request, &id, &replayed, &service->fixture.message);
  if (error != MO_OK)
    printf("# submission: %s\n", service->fixture.message.text);
  return error != MO_OK ? error : id;
}

/* The weights of a training that nothing disturbs, as the hash of its file. */
static inline bool expect(const struct mo_training_request *request,
                          const struct mo_controller *parent, const char *parent_digits,
                          const struct mo_bits *designs, uint32_t n,
                          const struct mo_training_lineage *lineage, struct mo_sha256 *sha256)
{
  struct mo_training *training = NULL;
  struct mo_controller *controller = NULL;
  struct mo_outcome outcomes[BATCH];
  double *gradient = NULL;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error = mo_training_create(&request->record.settings, parent,
                                 designs != NULL ? designs[0].words : NULL, n, &training, NULL);
  if (error == MO_OK)
    gradient = calloc(mo_training_controller(training)->n_parameters, sizeof(*gradient));
  while (error == MO_OK && mo_training_step(training) < request->record.settings.n_steps) {
    const struct mo_robot *robots = NULL;
    struct mo_gradient_counts counts;
    error = mo_training_draw(training, NULL, NULL, &robots);
    if (error == MO_OK) {
      fake_gradient(mo_training_controller(training), robots, request->record.settings.batch,
                    gradient, outcomes, &counts);
      error = mo_training_apply(training, gradient, outcomes, &counts, NULL);
    }
  }
  if (error == MO_OK)
    error = mo_training_export(training, parent_digits, "fake gradient", lineage, &controller);
  if (error == MO_OK)
    error = mo_controller_encode(controller, &bytes, &size);
  if (error == MO_OK)
    mo_sha256_of(bytes, size, sha256);
  free(bytes);
  free(gradient);
  mo_controller_free(controller);
  mo_training_free(training);
  return error == MO_OK;
}

static const struct mo_training_lineage one_code = {1, {{0, "fake gradient"}}};

static inline struct mo_sha256 undisturbed(void)
{
  static struct mo_sha256 sha256;
  static bool known;
  struct mo_training_request request = pretraining("");
  if (!known)
    known = expect(&request, NULL, NULL, NULL, 0, &one_code, &sha256);
  return sha256;
}

static inline bool has_result(struct service *service, int64_t id, const struct mo_sha256 *expected)
{
  struct mo_training_status status;
  return mo_store_training(service->fixture.store, id, &status) == MO_OK &&
         status.job.state == MO_JOB_SUCCEEDED && status.has_result &&
         mo_sha256_equal(&status.result_sha256, expected);
}

static inline bool await_step(struct service *service, int64_t id, uint32_t step)
{
  struct mo_live live;
  double end = now_s() + 20;
  do {
    usleep(500);
    mo_jobs_live(service->jobs, id, &live);
  } while (live.position < step && now_s() < end);
  return live.position >= step;
}

static inline bool await_phase(struct service *service, int64_t id, enum mo_phase phase,
                               struct mo_live *live)
{
  double end = now_s() + 20;
  do {
    usleep(500);
    mo_jobs_live(service->jobs, id, live);
  } while (live->phase != phase && now_s() < end);
  return live->phase == phase;
}

static inline int start(struct service *service, uint32_t side_by_side)
{
  int error = watch_start(service);
  if (error != MO_OK)
    return error;
  service->config.max_active_trainings = side_by_side;
  return service_open(service);
}

#endif
