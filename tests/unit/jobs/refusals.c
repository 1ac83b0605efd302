/* refusals.c: requests that are refused, and the messages that say why. */
#include "fakes.h"

/* Submits `bad`, which is `good` with some changes, and checks the refusal. */
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
  struct mo_evaluation_request good, bad;
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
  CHECK_INT(submit_evaluation(&good), id); /* a known key still gets its reply */
  REFUSED(submit_evaluation, MO_ERR_CONFLICT, "key", mo_sha256_of("x", 1, &bad.job.key.sha256));
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
  good = service_request(genotypes, 1);
  REFUSED(submit_evaluation, MO_ERR_NOT_FOUND, "nobody", bad.controller = "nobody");
  REFUSED(submit_evaluation, MO_ERR_NOT_FOUND, "elsewhere", bad.environment_set = "elsewhere");
}

SERVICE_CASE(of_trainings, 0)
{
  struct mo_training_request good = pretraining(""), bad;
  service.config.max_open_jobs = 1;
  REQUIRE_OK(service_reopen());
  fake_plan.gradient_delay_us = 1000000;
  good.job.key.text = "k";
  int64_t id = submit_training(&good);
  CHECK(id > 0);
  CHECK_INT(submit_training(&good), id);
  REFUSED(submit_training, MO_ERR_CONFLICT, "key", mo_sha256_of("x", 1, &bad.job.key.sha256));
  good.job.key.text = NULL;
  REFUSED(submit_training, MO_ERR_BUSY, "jobs are open", (void)0);
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
  REFUSED(submit_training, MO_ERR_NOT_FOUND, "controller \"nobody\"", bad.parent = "nobody");
  good.record.settings.kind = MO_TRAINING_FINETUNE;
  REFUSED(submit_training, MO_ERR_NOT_FOUND, "population 77", bad.record.population = 77);
  REFUSED(submit_training, MO_ERR_NOT_FOUND, "population",
          bad.record.population = id); /* a training run */
  CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
  good = pretraining("");
  REFUSED(submit_training, MO_ERR_CANCELLED, "stopping", (void)0);
}

SERVICE_CASE(of_campaigns, 1)
{
  struct mo_campaign_request good = campaign(MO_ZERO_SHOT), bad;
  REFUSED(submit_campaign, MO_ERR_NOT_FOUND, "controller \"nobody\" does not exist",
          bad.controller = "nobody");
  REFUSED(submit_campaign, MO_ERR_NOT_FOUND, "campaign 77 does not exist",
          bad.record.initial_campaign = 77);
  REFUSED(submit_campaign, MO_ERR_NOT_FOUND, "unknown set of environments \"moon\"",
          strcpy(bad.record.environment_set, "moon"));
  /* A known key returns its campaign. */
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
  CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
  REFUSED(submit_campaign, MO_ERR_CANCELLED, "stopping", bad.job.key.text = NULL);
  CHECK_INT(extend(id, 1), MO_ERR_CANCELLED);
}

static const struct check_case cases[] = {
    {"of evaluations", of_evaluations},
    {"of trainings", of_trainings},
    {"of campaigns", of_campaigns},
};
CHECK_MAIN(cases)
