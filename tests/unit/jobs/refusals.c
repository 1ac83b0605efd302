/* refusals.c: submissions that are refused, with the words that say why. */
#include "fakes.h"

/* Submits `bad`, which is `good` after some changes. */
#define REFUSED(submit, error, words, ...)                                                         \
  do {                                                                                             \
    bad = good;                                                                                    \
    __VA_ARGS__;                                                                                   \
    CHECK_INT(submit(&bad), error);                                                                \
    if (strstr(fixture.message.text, words) == NULL) {                                             \
      printf("# \"%s\" lacks \"%s\"\n", fixture.message.text, words);                              \
      CHECK(false);                                                                                \
    }                                                                                              \
  } while (0)

SERVICE_CASE(of_evaluations, 0)
{
  struct mo_bits apart = {{0x8001}}, none = {{0}};
  struct mo_evaluation_request good, bad;
  struct mo_environment environment;
  service.config.max_open_jobs = 2;
  service.config.max_open_rollouts = 300;
  REQUIRE_OK(service_reopen());
  const struct mo_bits *genotypes = bodies(9, 40);
  fake_plan.delay_us = 20000;
  good = service_request(genotypes, 20);
  good.job.key.text = "k";
  int64_t id = submit_evaluation(&good);
  CHECK(id > 0);
  REFUSED(submit_evaluation, MO_ERR_BUSY, "rollouts are waiting", bad.job.key.text = NULL);
  bad.n_designs = 1;
  CHECK(submit_evaluation(&bad) > 0);
  CHECK_INT(submit_evaluation(&bad), MO_ERR_BUSY);
  CHECK_INT(submit_evaluation(&good), id); /* a known key is answered even now */
  REFUSED(submit_evaluation, MO_ERR_CONFLICT, "key", mo_sha256_of("x", 1, &bad.job.key.sha256));
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
  good = service_request(genotypes, 1);
  REFUSED(submit_evaluation, MO_ERR_NOT_FOUND, "nobody", bad.controller = "nobody");
  REFUSED(submit_evaluation, MO_ERR_NOT_FOUND, "elsewhere", bad.environment_set = "elsewhere");
  REFUSED(submit_evaluation, MO_ERR_RANGE, "1 to", bad.n_designs = 0);
  REFUSED(submit_evaluation, MO_ERR_INVALID, "design 0 is empty", bad.genotypes = &none);
  REFUSED(submit_evaluation, MO_ERR_INVALID, "not in one piece", bad.genotypes = &apart);
  mo_environment_training(1, 0, 0, &environment);
  environment.terrain_heights_m[5] = NAN;
  REFUSED(submit_evaluation, MO_ERR_INVALID, "environment 0", bad.environment_set = NULL,
          bad.environments = &environment, bad.n_environments = 1);
  REFUSED(submit_evaluation, MO_ERR_RANGE, "dt_s", bad.physics.dt_s = -1);
  REFUSED(submit_evaluation, MO_ERR_RANGE, "stride", bad.record = MO_RECORD_COM,
          bad.record_stride = 0);
}

SERVICE_CASE(of_trainings, 0)
{
  struct mo_bits apart = {{0x8001}};
  struct mo_training_request good = pretraining(""), bad;
  service.config.max_open_jobs = 1;
  REQUIRE_OK(service_reopen());
  const struct mo_bits *genotypes = bodies(9, 4);
  fake_plan.gradient_delay_us = 1000000;
  good.job.key.text = "k";
  int64_t id = submit_training(&good);
  CHECK(id > 0);
  CHECK_INT(submit_training(&good), id);
  REFUSED(submit_training, MO_ERR_CONFLICT, "key", mo_sha256_of("x", 1, &bad.job.key.sha256));
  good.job.key.text = NULL;
  REFUSED(submit_training, MO_ERR_BUSY, "jobs are open", (void)0);
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
  REFUSED(submit_training, MO_ERR_RANGE, "batch", bad.record.settings.batch = 0);
  REFUSED(submit_training, MO_ERR_RANGE, "steps", bad.record.settings.n_steps = 1000000000);
  REFUSED(submit_training, MO_ERR_RANGE, "peak", bad.record.settings.learning.schedule.peak = -1);
  REFUSED(submit_training, MO_ERR_INVALID, "No Name", strcpy(bad.record.name, "No Name"));
  REFUSED(submit_training, MO_ERR_RANGE, "checkpoints", bad.record.checkpoints_kept = 0);
  REFUSED(submit_training, MO_ERR_INVALID, "validation", bad.record.settings.held_out_designs = 0);
  REFUSED(submit_training, MO_ERR_NOT_FOUND, "controller \"nobody\"", bad.parent = "nobody");
  good.genotypes = genotypes;
  REFUSED(submit_training, MO_ERR_INVALID, "draws its own", bad.record.n_designs = 2);
  good.record.settings.kind = MO_TRAINING_FINETUNE;
  REFUSED(submit_training, MO_ERR_INVALID, "not both", bad.record.n_designs = 2,
          bad.record.population = 77);
  REFUSED(submit_training, MO_ERR_NOT_FOUND, "population 77", bad.record.population = 77);
  REFUSED(submit_training, MO_ERR_NOT_FOUND, "population",
          bad.record.population = id); /* a training */
  REFUSED(submit_training, MO_ERR_RANGE, "1 to 10000 designs", bad.record.n_designs = 0);
  REFUSED(submit_training, MO_ERR_INVALID, "one piece", bad.genotypes = &apart,
          bad.record.n_designs = 1);
  CHECK_OK(mo_jobs_stop(service.jobs, 5000));
  good = pretraining("");
  REFUSED(submit_training, MO_ERR_CANCELLED, "stopping", (void)0);
}

/* The position of the listed design at fault in the last request. */
static uint32_t fault;

static int64_t submit_listed(const struct mo_campaign_request *request)
{
  int64_t id = 0;
  bool replayed;
  return mo_jobs_submit_campaign(service.jobs, request, &id, &replayed, &fault, &fixture.message);
}

SERVICE_CASE(of_campaigns, 1)
{
  struct mo_bits listed[3];
  struct mo_campaign_request good = campaign(MO_ZERO_SHOT), bad;
  struct mo_environment wrong = {.light_xy_m = {NAN, 0}};
  const struct mo_bits *genotypes = bodies(3, 3);
  for (int i = 0; i < 3; i++)
    REFUSED(submit_campaign, MO_ERR_RANGE, "population must be at least 2",
            bad.record.settings.population = (const uint32_t[]){0, 1, 100000000}[i]);
  REFUSED(submit_campaign, MO_ERR_NOT_FOUND, "no controller \"nobody\"", bad.controller = "nobody");
  REFUSED(submit_campaign, MO_ERR_NOT_FOUND, "no campaign 77", bad.record.initial_campaign = 77);
  REFUSED(submit_campaign, MO_ERR_NOT_FOUND, "no set of environments \"moon\"",
          strcpy(bad.record.environment_set, "moon"));
  REFUSED(submit_campaign, MO_ERR_RANGE, "1 to 64 environments",
          bad.record.environment_set[0] = '\0');
  REFUSED(submit_campaign, MO_ERR_INVALID, "environment 0", bad.record.environment_set[0] = '\0',
          bad.environments = &wrong, bad.record.n_environments = 1);
  REFUSED(submit_campaign, MO_ERR_RANGE, "weight", bad.job.weight = -1);
  REFUSED(submit_campaign, MO_ERR_INVALID, "priority", bad.job.priority = 7);
  REFUSED(submit_campaign, MO_ERR_RANGE, "replicates", bad.record.replicates = 101);
  REFUSED(submit_campaign, MO_ERR_INVALID, "no controller that could have a name",
          strcpy(bad.record.name, "walker"));
  REFUSED(submit_campaign, MO_ERR_INVALID, "not a name", strcpy(bad.record.name, "No Name"),
          bad.record.settings = campaign(MO_FEW_SHOT).record.settings);
  listed[0] = genotypes[0];
  listed[1] = genotypes[1];
  REQUIRE_OK(mo_genotype_image(MO_DEFAULT_WORKSPACE, genotypes[0].words, 3, listed[2].words));
  good.genotypes = listed;
  REFUSED(submit_listed, MO_ERR_DUPLICATE, "design 2 has the form of an earlier one",
          bad.record.n_listed = 3);
  CHECK_INT(fault, 2);
  REFUSED(submit_listed, MO_ERR_RANGE, "does not fit a workspace of 2x2x1", bad.record.n_listed = 2,
          bad.record.settings.workspace = (struct mo_workspace){2, 2, 1});
  CHECK_INT(fault, 0);
  REFUSED(submit_listed, MO_ERR_RANGE, "3 designs are listed for a population of 2",
          bad.record.n_listed = 3, bad.record.settings.population = 2);
  /* A key is answered with its campaign. */
  good = campaign(MO_ZERO_SHOT);
  good.job.key.text = "once";
  good.record.replicates = 3;
  fake_plan.delay_us = 1000000;
  int64_t id = submit_campaign(&good);
  CHECK_INT(submit_campaign(&good), id);
  struct mo_campaign_status status = status_of(id + 2);
  CHECK_INT(status.record.settings.seed, good.record.settings.seed + 2);
  CHECK_INT(status.record.group, id);
  CHECK_INT(mo_store_campaign(store, id + 3, &status), MO_ERR_NOT_FOUND);
  REFUSED(submit_campaign, MO_ERR_CONFLICT, "has no population yet", bad.job.key.text = NULL,
          bad.record.initial_campaign = id);
  for (int i = 0; i < 3; i++)
    CHECK_OK(mo_jobs_cancel(service.jobs, id + i));
  CHECK_INT(idle_stats().open_jobs, 0);
  CHECK_OK(mo_jobs_stop(service.jobs, 5000));
  REFUSED(submit_campaign, MO_ERR_CANCELLED, "stopping", bad.job.key.text = NULL);
  CHECK_INT(extend(id, 1), MO_ERR_CANCELLED);
}

static const struct check_case cases[] = {
    {"of evaluations", of_evaluations},
    {"of trainings", of_trainings},
    {"of campaigns", of_campaigns},
};
CHECK_MAIN(cases)
