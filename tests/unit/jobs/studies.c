/* studies.c: studies with a fake back end. A study whose client asks for the population and tells
 * the same population back must equal the campaign with the same settings, bit for bit, no matter
 * what happens between two steps. */
#include "jobs/studies.h"
#include "fakes.h"

static struct mo_campaign_request study_of(const struct mo_campaign_request *request)
{
  struct mo_campaign_request study = *request;
  study.record.settings.mode = MO_STUDY;
  study.record.settings.generations = 0;
  study.record.settings.exclude_pretraining = false;
  return study;
}

/* Tells the population that was requested. Returns MO_OK or an error. */
static int tell(int64_t id, const struct mo_asked *asked, struct mo_telling_reply *reply)
{
  static const uint8_t state[] = "state";
  struct mo_study_telling telling = {
      .batch = {.number = asked->batch, .n_children = asked->n, .children = asked->children},
      .sampler = state,
      .sampler_size = sizeof(state)};
  telling.sha256.bytes[0] = (uint8_t)(asked->batch + 1);
  *reply = (struct mo_telling_reply){.is_new = false};
  return mo_jobs_tell(service.jobs, id, &telling, reply, &fixture.message);
}

static bool is_committed(int64_t id, uint32_t batch)
{
  return AWAIT(status_of(id).generation == (int64_t)batch && state_of(id) != MO_JOB_RUNNING);
}

/* What happens after a batch was told. */
static void disturb(int64_t id, uint32_t batch)
{
  switch (batch % 4) {
  case 1:
    CHECK_OK(mo_jobs_pause(service.jobs, id));
    usleep(3000);
    CHECK_OK(mo_jobs_resume(service.jobs, id));
    break;
  case 2: CHECK_OK(service_reopen()); break;
  case 3:
    usleep(4000);
    service_close();
    service_set_states(id, id, MO_JOB_RUNNING); /* as if killed */
    CHECK_OK(service_open());
    break;
  default: break;
  }
}

SERVICE_CASE(is_a_campaign, 2)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT), study;
  struct mo_telling_reply reply;
  struct mo_asked asked, again;
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t step;
  request.record.settings.exclude_pretraining = false;
  request.record.settings.racing = MO_RACING_OFF; /* as in every study */
  const struct origin origin = origin_of(&request);
  study = study_of(&request);
  fake_plan.delay_us = 300;
  const int64_t id = submit_campaign(&study);
  const struct mo_ask ask = {.n = POPULATION};
  for (uint32_t g = 0; g <= GENERATIONS; g++) {
    CHECK(status_of(id).told == (int64_t)g - 1 && state_of(id) == MO_JOB_QUEUED);
    REQUIRE_OK(mo_jobs_ask(service.jobs, id, &ask, &asked, &fixture.message));
    REQUIRE_OK(mo_jobs_ask(service.jobs, id, &ask, &again, &fixture.message));
    CHECK(asked.batch == g && asked.n == POPULATION &&
          memcmp(asked.children, again.children, POPULATION * sizeof(*asked.children)) == 0);
    CHECK(tell(id, &asked, &reply) == MO_OK && reply.is_new);
    CHECK(tell(id, &asked, &reply) == MO_OK && !reply.is_new);
    disturb(id, g);
    REQUIRE(is_committed(id, g));
    CHECK(tell(id, &asked, &reply) == MO_OK && !reply.is_new);
    asked.batch += 2;
    CHECK(tell(id, &asked, &reply) == MO_ERR_CONFLICT && reply.next == g + 1);
    free(asked.children);
    free(again.children);
  }
  CHECK(is_as_plain(id, &fake_plain, &origin));
  CHECK_OK(mo_store_campaign_checkpoint_of(store, id, GENERATIONS, &step, &bytes, &size));
  CHECK(size == sizeof("state") && memcmp(bytes, "state", size) == 0);
  free(bytes);
  CHECK(AWAIT(stats_of().open_jobs == 1 && stats_of().active_campaigns == 0));
  CHECK_OK(mo_jobs_finish_study(service.jobs, id));
  CHECK_OK(mo_jobs_finish_study(service.jobs, id));
  CHECK_INT(idle_stats().open_jobs, 0);
  CHECK_INT(mo_jobs_ask(service.jobs, id, &ask, &asked, &fixture.message), MO_ERR_CONFLICT);
  CHECK_INT(warnings, 0);
  CHECK_OK(check_whole());
}

/* While it waits for its client, it has no thread: other campaigns run on the only one. */
SERVICE_CASE(waits_without_a_thread, 1)
{
  const struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  const struct mo_campaign_request study = study_of(&request);
  const struct origin origin = origin_of(&request);
  const struct mo_ask ask = {.n = 5, .is_random = true};
  struct mo_telling_reply reply;
  struct mo_asked asked;
  const int64_t first = submit_campaign(&study), second = submit_campaign(&request);
  CHECK(ends_as_plain(second, &origin));
  CHECK(state_of(first) == MO_JOB_QUEUED && live_of(first).phase == MO_PHASE_IDLE);
  REQUIRE_OK(mo_jobs_ask(service.jobs, first, &ask, &asked, &fixture.message));
  CHECK_OK(tell(first, &asked, &reply));
  CHECK(is_committed(first, 0));
  free(asked.children);
  CHECK_OK(mo_jobs_cancel(service.jobs, first));
  CHECK_INT(mo_jobs_finish_study(service.jobs, first), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_finish_study(service.jobs, second), MO_ERR_NOT_FOUND);
}

/* The population is in the order of the client's scores, in every process; the losses of the fake
 * back end are in another one. */
SERVICE_CASE(ranks_by_own_scores, 1)
{
  const struct mo_campaign_request plain = campaign(MO_ZERO_SHOT);
  struct mo_campaign_request request = study_of(&plain);
  const struct mo_ask ask = {.n = 5, .is_random = true};
  double scores[] = {0.5, -3, 2e9, -0.25, -3.5};
  static const uint32_t order[] = {4, 1, 3, 0, 2};
  struct mo_campaign_state *state = NULL;
  struct mo_telling_reply reply;
  struct mo_asked asked;
  request.record.own_score = (struct mo_own_score){"cost", "J/m"};
  const int64_t id = submit_campaign(&request);
  REQUIRE_OK(mo_jobs_ask(service.jobs, id, &ask, &asked, &fixture.message));
  REQUIRE(asked.n == 5);
  struct mo_study_telling telling = {
      .batch = {.n_children = 5, .children = asked.children, .scores = scores}};
  telling.batch.scores = NULL;
  CHECK_INT(mo_jobs_tell(service.jobs, id, &telling, &reply, &fixture.message), MO_ERR_UNSUPPORTED);
  telling.batch.scores = scores;
  CHECK_OK(mo_jobs_tell(service.jobs, id, &telling, &reply, &fixture.message));
  disturb(id, 3);
  REQUIRE(is_committed(id, 0));
  CHECK_OK(service_reopen());
  REQUIRE_OK(mo_store_campaign_state(store, id, &state));
  for (uint32_t i = 0; i < 5; i++)
    CHECK(state->numbers[i] == order[i] && state->scores[i] == scores[order[i]]);
  mo_campaign_state_free(state);
  CHECK(status_of(id).best_score == -3.5);
  telling.batch.number = 1;
  telling.sha256.bytes[0] = 1;
  scores[3] = 0;
  CHECK_INT(mo_jobs_tell(service.jobs, id, &telling, &reply, &fixture.message), MO_ERR_INVALID);
  CHECK(reply.fault == MO_TELLING_SCORE && reply.place == 3 && reply.score == -0.25);
  scores[3] = -0.25;
  CHECK_OK(mo_jobs_tell(service.jobs, id, &telling, &reply, &fixture.message));
  CHECK(is_committed(id, 1));
  free(asked.children);
  CHECK_OK(check_whole());
}

static const struct check_case cases[] = {
    {"equals a campaign if it tells what it asked", is_a_campaign},
    {"waits without a thread", waits_without_a_thread},
    {"ranks by own scores", ranks_by_own_scores},
};
CHECK_MAIN(cases)
