/* campaign-real.c: campaigns with the real back end, for 1, 2 and 7 workers: the bits of rollouts
 * run alone, and of gradients computed by one worker, in plain loops. */
#include "campaign_history.h"

#include "../store/fixture.h"
#include "jobs/campaigns.h"
#include "jobs/trainings.h"
#include "wait.h"

#define BODIES         6
#define STEPS          30
#define BOUND          0.25 /* passed by lives this short, too */
#define RESTART_WEIGHT 2.5

struct alone {
  struct mo_lattice *lattice;
  struct mo_workspace_memory *memory;
  struct mo_compute *compute;
  struct mo_gradient_state *gradients;
};

static double lone_loss(void *context, const struct mo_bits *genotype,
                        const struct mo_controller *controller,
                        const struct mo_environment *environment, const struct mo_physics *physics)
{
  struct alone *alone = context;
  struct mo_outcome outcome = {.loss = NAN};
  struct mo_body *body = NULL;
  struct mo_pack *pack = NULL;
  if (mo_pack_create(controller, mo_isa_best(), MO_FLOAT32, &pack) == MO_OK &&
      mo_body_create(alone->lattice, genotype->words, &body) == MO_OK)
    CHECK_INT(
        mo_rollout_block(alone->memory, pack, body, &environment, 1, physics, NULL, NULL, &outcome),
        MO_OK);
  mo_body_free(body);
  mo_pack_free(pack);
  return outcome.loss;
}

static void lone_gradient(void *context, const struct mo_controller *controller,
                          const struct mo_robot *robots, uint32_t n,
                          const struct mo_physics *physics, double *d_parameters,
                          struct mo_outcome *outcomes, struct mo_gradient_counts *counts)
{
  struct alone *alone = context;
  struct mo_gradient_batch batch = {.controller = controller,
                                    .robots = robots,
                                    .n = n,
                                    .physics = *physics,
                                    .adjoint_bound = BOUND,
                                    .adjoint_rule = MO_ADJOINT_RESTART,
                                    .restart_weight = RESTART_WEIGHT,
                                    .d_parameters = d_parameters,
                                    .outcomes = outcomes};
  CHECK_INT(mo_compute_gradient(alone->gradients, &batch), MO_OK);
  *counts = batch.counts;
}

static int open_alone(struct alone *alone)
{
  struct mo_compute_config config = {.n_workers = 1, .isa = mo_isa_best()};
  int error = mo_lattice_create(MO_DEFAULT_WORKSPACE, &alone->lattice);
  if (error == MO_OK)
    error = mo_workspace_memory_create(&alone->memory);
  if (error == MO_OK)
    error = mo_compute_create_cpu(&config, &alone->compute);
  return error == MO_OK ? mo_gradient_state_create(alone->compute, &alone->gradients) : error;
}

static void close_alone(struct alone *alone)
{
  mo_gradient_state_free(alone->gradients);
  mo_compute_free(alone->compute);
  mo_workspace_memory_free(alone->memory);
  mo_lattice_free(alone->lattice);
}

static void check_mode(struct alone *alone, enum mo_campaign_mode mode, uint32_t n_workers)
{
  struct mo_campaign_request request = {
      .record = {.settings = mo_campaign_preset(mode, MO_PRESET_DEMO)}};
  struct mo_campaign_settings *settings = &request.record.settings;
  struct mo_compute_config compute_config = {.n_workers = n_workers, .isa = mo_isa_best()};
  struct plain plain = {lone_loss, lone_gradient, alone, NULL};
  struct mo_environment paper[MO_PAPER_TEST_COUNT];
  struct mo_jobs_config config = {.version = "1"};
  struct mo_controller *controller = NULL;
  struct mo_controller_record record;
  struct mo_compute *compute = NULL;
  struct mo_jobs *jobs = NULL;
  struct fixture fixture;
  struct mo_job job;
  char digits[MO_SHA256_DIGITS + 1];
  int64_t id = 0;
  bool replayed = false;
  settings->population = BODIES;
  settings->generations = 2;
  settings->physics.n_steps = STEPS;
  if (mode != MO_ZERO_SHOT)
    settings->parent_steps = settings->child_steps = 1;
  settings->learning.adjoint_bound = BOUND;
  settings->learning.adjoint_rule = MO_ADJOINT_RESTART;
  settings->learning.restart_weight = RESTART_WEIGHT;
  snprintf(request.record.environment_set, sizeof(request.record.environment_set), "paper-test");
  mo_environment_paper_test(paper);
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) == MO_OK);
  mo_controller_randomize(controller, 1); /* as fixture_start's */
  REQUIRE(mo_store_controller(fixture.store, "default", &record) == MO_OK);
  mo_sha256_to_hex(&record.sha256, digits);
  REQUIRE(mo_compute_create_cpu(&compute_config, &compute) == MO_OK);
  REQUIRE(mo_jobs_create(fixture.store, compute, &config, &jobs, &fixture.message) == MO_OK);
  plain.code_version = mo_jobs_code_version(jobs, MO_ON_CPU);
  REQUIRE(mo_jobs_submit_campaign(jobs, &request, &id, &replayed, NULL, &fixture.message) == MO_OK);
  REQUIRE(await_end(jobs, id, 60000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  {
    struct origin origin = {.settings = *settings,
                            .environments = paper,
                            .n_environments = MO_PAPER_TEST_COUNT,
                            .controller = mode == MO_SIMULTANEOUS ? NULL : controller,
                            .digits = mode == MO_SIMULTANEOUS ? NULL : digits};
    CHECK(is_as_plain(fixture.store, id, &plain, &origin));
  }
  mo_jobs_free(jobs);
  mo_compute_free(compute);
  mo_controller_free(controller);
  fixture_end(&fixture);
}

static void gives_the_bits_of_lone_rollouts(void)
{
  static const uint32_t workers[] = {1, 2, 7};
  struct alone alone = {NULL};
  REQUIRE(open_alone(&alone) == MO_OK);
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++)
    for (int i = mode == MO_ZERO_SHOT ? 1 : 0; i < 3; i += 2)
      check_mode(&alone, (enum mo_campaign_mode)mode, workers[(i + mode) % 3]);
  close_alone(&alone);
}

static const struct check_case cases[] = {
    {"gives the bits of lone rollouts", gives_the_bits_of_lone_rollouts}};
CHECK_MAIN(cases)
