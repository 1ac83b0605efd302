/* real.c: the jobs room with the real back end: the losses of a job are those of its rollouts run
 * alone, for any number of workers, in company or not, and after a restart. */
#include <stdio.h>

#include "../check.h"
#include "../store/fixture.h"
#include "jobs/evaluations.h"
#include "wait.h"

#define BODIES 12
#define STEPS  150

struct real {
  struct fixture fixture;
  struct mo_compute *compute;
  struct mo_jobs *jobs;
};

static int open_real(struct real *real, uint32_t n_workers)
{
  struct mo_store_config store_config = {.path = real->fixture.path};
  struct mo_compute_config compute_config = {.n_workers = n_workers, .isa = mo_isa_best()};
  struct mo_jobs_config config = {0};
  int error = mo_store_open(&store_config, &real->fixture.store, &real->fixture.message);
  if (error == MO_OK)
    error = mo_compute_create_cpu(&compute_config, &real->compute);
  if (error == MO_OK)
    error = mo_jobs_create(real->fixture.store, real->compute, &config, &real->jobs,
                           &real->fixture.message);
  return error;
}

static void close_real(struct real *real)
{
  mo_jobs_free(real->jobs);
  mo_compute_free(real->compute);
  mo_store_close(real->fixture.store);
  real->jobs = NULL;
  real->compute = NULL;
  real->fixture.store = NULL;
}

/* One body in one environment, alone in its block. */
static double alone(const struct mo_pack *pack, const struct mo_lattice *lattice,
                    const struct mo_bits *genotype, const struct mo_environment *environment,
                    const struct mo_physics *physics)
{
  struct mo_workspace_memory *memory = NULL;
  struct mo_body *body = NULL;
  struct mo_bits placed = *genotype;
  struct mo_outcome outcome = {.loss = -1};
  mo_genotype_place(MO_DEFAULT_WORKSPACE, placed.words);
  if (mo_workspace_memory_create(&memory) == MO_OK &&
      mo_body_create(lattice, placed.words, &body) == MO_OK)
    (void)mo_rollout_block(memory, pack, body, &environment, 1, physics, NULL, NULL, &outcome);
  mo_body_free(body);
  mo_workspace_memory_free(memory);
  return outcome.loss;
}

static void gives_the_bits_of_lone_rollouts(void)
{
  struct real real = {.compute = NULL};
  struct mo_controller *controller = NULL;
  struct mo_controller_record record;
  struct mo_lattice *lattice = NULL;
  struct mo_pack *pack = NULL;
  struct mo_bits *forms, *genotypes, reversed[BODIES];
  struct mo_environment paper[MO_PAPER_TEST_COUNT];
  struct mo_evaluation_request request = {
      .environment_set = "paper-test", .priority = -1, .record_stride = 50};
  struct mo_job job;
  int64_t id;
  bool replayed;
  REQUIRE(fixture_folder(&real.fixture) == 0);
  REQUIRE(open_real(&real, 2) == MO_OK);
  REQUIRE(fixture_controller(real.fixture.store, "default", 1, &record) == MO_OK);
  REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) == MO_OK);
  mo_controller_randomize(controller, 1);
  REQUIRE(mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) == MO_OK);
  REQUIRE(mo_pack_create(controller, mo_isa_best(), MO_FLOAT32, &pack) == MO_OK);
  REQUIRE(fixture_bodies(3, BODIES, &forms, &genotypes) == MO_OK);
  mo_environment_paper_test(paper);
  for (int i = 0; i < BODIES; i++)
    reversed[i] = genotypes[BODIES - 1 - i];
  request.physics = mo_default_physics();
  request.physics.n_steps = STEPS;
  for (uint32_t round = 0; round < 3; round++) {
    struct mo_evaluation_results *results = NULL;
    request.genotypes = round == 1 ? reversed : genotypes;
    request.n_designs = round == 0 ? BODIES / 2 : BODIES;
    request.verify = round > 0; /* computed again, in other company */
    request.record_com = round == 2;
    REQUIRE(mo_jobs_submit_evaluation(real.jobs, &request, &id, &replayed, &real.fixture.message) ==
            MO_OK);
    REQUIRE(await_end(real.jobs, id, 60000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_SUCCEEDED);
    REQUIRE(mo_store_results(real.fixture.store, id, &results) == MO_OK);
    for (uint32_t n = 0; n < request.n_designs; n++) {
      for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
        double expected = alone(pack, lattice, &request.genotypes[n], &paper[k], &request.physics);
        CHECK(memcmp(&expected, &results->losses[n * MO_PAPER_TEST_COUNT + k], sizeof(expected)) ==
              0);
      }
      if (request.verify)
        CHECK_INT(results->agrees[n], 1);
    }
    mo_evaluation_results_free(results);
    if (round == 2) {
      struct mo_trajectory *trajectory = NULL;
      REQUIRE(mo_store_trajectory(real.fixture.store, id, 0, 0, &trajectory) == MO_OK);
      CHECK_INT(trajectory->n_frames, STEPS / 50 + 1);
      CHECK(trajectory->com_m[2] > 0 && trajectory->com_m[0] > 1.5 && trajectory->com_m[0] < 3.5);
      mo_trajectory_free(trajectory);
    }
    close_real(&real);
    REQUIRE(open_real(&real, round == 0 ? 1 : 7) == MO_OK);
  }
  mo_pack_free(pack);
  mo_lattice_free(lattice);
  mo_controller_free(controller);
  free(forms);
  free(genotypes);
  close_real(&real);
  fixture_remove(real.fixture.path);
}

static const struct check_case cases[] = {
    {"gives the bits of lone rollouts", gives_the_bits_of_lone_rollouts}};
CHECK_MAIN(cases)
