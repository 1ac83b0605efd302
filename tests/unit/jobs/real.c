/* real.c: the jobs room with the real back end, for several numbers of workers: the losses of a job
 * equal those of its rollouts run one by one, and what campaigns learn equals the result of plain
 * loops. */
#include "campaign_history.h"
#include "service.h"

#define WORKERS        7
#define BOUND          0.25 /* even such short rollouts exceed it */
#define RESTART_WEIGHT 2.5

/* Computes one rollout or one batch at a time. */
struct alone {
  struct mo_lattice *lattice;
  struct mo_workspace_memory *memory;
  struct mo_compute *compute;
  struct mo_gradient_state *gradients;
  struct mo_pack *pack; /* of the default weights, which never change */
};

static int open_alone(struct alone *alone)
{
  struct mo_compute_config config = {.n_workers = 1, .isa = mo_isa_best()};
  int error = mo_lattice_create(MO_DEFAULT_WORKSPACE, &alone->lattice);
  if (error == MO_OK)
    error = mo_workspace_memory_create(&alone->memory);
  if (error == MO_OK)
    error = mo_compute_create_cpu(&config, &alone->compute);
  if (error == MO_OK)
    error = mo_pack_create(default_weights(), mo_isa_best(), MO_FLOAT32, &alone->pack);
  return error == MO_OK ? mo_gradient_state_create(alone->compute, &alone->gradients) : error;
}

static void close_alone(struct alone *alone)
{
  mo_gradient_state_free(alone->gradients);
  mo_compute_free(alone->compute);
  mo_workspace_memory_free(alone->memory);
  mo_pack_free(alone->pack);
  mo_lattice_free(alone->lattice);
}

/* Computes one body in one environment, in a block by itself. */
static double lone_loss(void *context, const struct mo_bits *genotype,
                        const struct mo_controller *controller,
                        const struct mo_environment *environment, const struct mo_physics *physics)
{
  struct alone *alone = context;
  struct mo_outcome outcome = {.loss = NAN};
  struct mo_body *body = NULL;
  struct mo_pack *own = NULL; /* of weights that learn */
  if ((controller == default_weights() ||
       mo_pack_create(controller, mo_isa_best(), MO_FLOAT32, &own) == MO_OK) &&
      mo_body_create(alone->lattice, genotype->words, &body) == MO_OK)
    CHECK_OK(mo_rollout_block(alone->memory, own != NULL ? own : alone->pack, body, &environment, 1,
                              physics, NULL, NULL, NULL, &outcome));
  mo_body_free(body);
  mo_pack_free(own);
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
                                    .options = {.adjoint_bound = BOUND,
                                                .adjoint_rule = MO_ADJOINT_RESTART,
                                                .restart_weight = RESTART_WEIGHT},
                                    .d_parameters = d_parameters,
                                    .outcomes = outcomes};
  CHECK_OK(mo_compute_gradient(alone->gradients, &batch));
  *counts = batch.counts;
}

/* ---- evaluations: alone or with others, and after a restart ---- */

static void evaluates(void)
{
  enum { BODIES = 12, STEPS = 150 };
  static const uint32_t workers[] = {2, 1, WORKERS};
  struct alone alone = {NULL};
  struct mo_bits reversed[BODIES];
  struct mo_environment paper[MO_PAPER_TEST_COUNT];
  REQUIRE_OK(open_alone(&alone));
  REQUIRE_OK(service_begin());
  const struct mo_bits *genotypes = bodies(3, BODIES);
  mo_environment_paper_test(paper);
  for (int i = 0; i < BODIES; i++)
    reversed[i] = genotypes[BODIES - 1 - i];
  for (int round = 0; round < 3; round++) {
    struct mo_evaluation_request request =
        service_request(round == 1 ? reversed : genotypes, round == 0 ? BODIES / 2 : BODIES);
    struct mo_evaluation_results *results = NULL;
    struct mo_trajectory *trajectory = NULL;
    service.n_workers = workers[round];
    REQUIRE_OK(service_reopen());
    request.physics.scheme.n_steps = STEPS;
    request.verify = round > 0; /* recomputed, together with others */
    request.record = round == 2 ? MO_RECORD_COM : 0;
    request.record_stride = 50;
    int64_t id = submit_evaluation(&request);
    CHECK(succeeds(id, NULL));
    REQUIRE_OK(mo_store_results(store, id, &results));
    for (uint32_t n = 0; n < request.n_designs; n++) {
      for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++)
        CHECK(same_number(lone_loss(&alone, &request.genotypes[n], default_weights(), &paper[k],
                                    &request.physics),
                          results->losses[n * MO_PAPER_TEST_COUNT + k]));
      if (request.verify)
        CHECK_INT(results->agrees[n], 1);
    }
    mo_evaluation_results_free(results);
    if (round < 2)
      continue;
    REQUIRE_OK(mo_store_trajectory(store, id, 0, 0, &trajectory));
    CHECK_INT(trajectory->n_frames, STEPS / 50 + 1);
    CHECK(trajectory->recording.com_m[2] > 0 && trajectory->recording.com_m[0] > 1.5 &&
          trajectory->recording.com_m[0] < 3.5);
    mo_trajectory_free(trajectory);
  }
  close_alone(&alone);
}

/* ---- campaigns ---- */

static void check_mode(struct alone *alone, enum mo_campaign_mode mode, uint32_t n_workers)
{
  struct mo_campaign_request request = {
      .record = {.settings = mo_campaign_preset(mode, MO_PRESET_DEMO)}};
  struct mo_campaign_settings *settings = &request.record.settings;
  struct plain plain = {lone_loss, lone_gradient, alone, NULL};
  struct mo_environment paper[MO_PAPER_TEST_COUNT];
  struct mo_controller_record record;
  struct origin origin;
  char digits[MO_SHA256_DIGITS + 1];
  settings->population = 6;
  settings->generations = 2;
  settings->physics.scheme.n_steps = 30;
  if (mode != MO_ZERO_SHOT)
    settings->parent_steps = settings->child_steps = 1;
  settings->learning.gradient.adjoint_bound = BOUND;
  settings->learning.gradient.adjoint_rule = MO_ADJOINT_RESTART;
  settings->learning.gradient.restart_weight = RESTART_WEIGHT;
  snprintf(request.record.environment_set, sizeof(request.record.environment_set), "paper-test");
  mo_environment_paper_test(paper);
  REQUIRE_OK(service_begin());
  service.n_workers = n_workers;
  service.config.version = "1";
  REQUIRE_OK(service_open());
  REQUIRE_OK(mo_store_controller(store, "default", &record));
  mo_sha256_to_hex(&record.sha256, digits);
  plain.code_version = mo_jobs_code_version(service.jobs, MO_ON_CPU);
  int64_t id = submit_campaign(&request);
  CHECK(succeeds(id, NULL));
  origin = (struct origin){.settings = *settings,
                           .environments = paper,
                           .n_environments = MO_PAPER_TEST_COUNT,
                           .controller = mode == MO_SIMULTANEOUS ? NULL : default_weights(),
                           .digits = mode == MO_SIMULTANEOUS ? NULL : digits};
  CHECK(is_as_plain(id, &plain, &origin));
}

static void evolves(void)
{
  static const uint32_t workers[] = {1, 2, WORKERS};
  struct alone alone = {NULL};
  REQUIRE_OK(open_alone(&alone));
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++)
    for (int i = mode == MO_ZERO_SHOT ? 1 : 0; i < 3; i += 2)
      check_mode(&alone, (enum mo_campaign_mode)mode, workers[(i + mode) % 3]);
  close_alone(&alone);
}

static const struct check_case cases[] = {
    {"evaluations have the bits of single rollouts", evaluates},
    {"campaigns have the bits of single rollouts", evolves},
};
CHECK_MAIN(cases)
