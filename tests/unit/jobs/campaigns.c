/* campaigns.c: campaigns with a fake back end, whose losses and gradients are functions of their inputs: every mode end to end,
 * against plain loops (campaign_history.h). */
#include "campaigns.h"

static void evolves_in_every_mode(void)
{
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++) {
    struct service service;
    struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
    struct origin origin = origin_of(&request);
    struct mo_job job;
    int64_t id;
    REQUIRE(start(&service, 2) == MO_OK);
    id = submit(&service, &request);
    REQUIRE(id > 0 && mo_jobs_wait(service.jobs, id, 30000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_SUCCEEDED);
    CHECK(is_as_plain(service.fixture.store, id, &fake_plain, &origin));
    CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
    CHECK_INT(warnings, 0);
    service_end(&service);
  }
}

static const struct check_case cases[] = {
    {"evolves in every mode", evolves_in_every_mode},
};
CHECK_MAIN(cases)
