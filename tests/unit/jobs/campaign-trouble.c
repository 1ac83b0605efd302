/* campaign-trouble.c: exhausted morphospaces, errors, damage and want of room. */
#include <fcntl.h>
#include <signal.h>
#include <sys/resource.h>

#include "campaigns.h"

/* A workspace that holds one body, or two: what there is gets scored, and then it is over. */
__attribute__((unused)) static void exhausts_small_spaces(void)
{
  static const struct mo_workspace spaces[] = {{1, 1, 1}, {2, 1, 1}, {2, 2, 1}};
  struct service service;
  REQUIRE(start(&service, 2) == MO_OK);
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++)
    for (int i = 0; i < 3; i++) {
      struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
      struct origin origin;
      struct mo_campaign_status status;
      int64_t id;
      request.record.settings.workspace = spaces[i];
      request.record.settings.population = i == 2 ? 3 : POPULATION;
      request.record.settings.generations = 20;
      origin = origin_of(&request);
      id = submit(&service, &request);
      CHECK(ends_as_plain(&service, id, &origin));
      status = status_of(&service, id);
      CHECK_INT(status.end, MO_CAMPAIGN_EXHAUSTED);
      CHECK(status.generation >= 0 && status.generation < 20);
      CHECK_INT(status.n_designs, (i == 0 ? 1 : i == 1 ? 2 : 4)); /* 1, 2, L and the square */
      CHECK_INT(status.has_result, mode != MO_ZERO_SHOT);
      CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, NULL, NULL), MO_ERR_CONFLICT);
    }
  service_end(&service);
}

/* A design of generation 1 and its block. */
static uint64_t word_of(const struct origin *origin)
{
  struct history *history = plain_history(&fake_plain, origin);
  uint64_t word = history->designs[POPULATION + 2].genotype.words[0];
  free(history);
  return word;
}

__attribute__((unused)) static void tries_three_times(void)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct origin origin = origin_of(&request);
  struct service service;
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.fail_word = word_of(&origin);
  fake_plan.fail_times = 1;
  fake_plan.fail_status = MO_ERR_IO;
  id = submit(&service, &request);
  CHECK(ends_as_plain(&service, id, &origin));
  CHECK_INT(status_of(&service, id).job.attempts,
            0); /* one, forgiven by the generation that came after it */
  CHECK_INT(warnings, 1);
  CHECK(strstr(warned, "input or output failed") != NULL);
  request.record.settings.seed = 9;
  origin = origin_of(&request);
  fake_plan.fail_word = word_of(&origin);
  fake_plan.fail_times = 1000;
  id = submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 120000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.attempts, 3);
  CHECK_INT(job.error, MO_ERR_IO);
  CHECK(strstr(job.error_text, "the runner of rollouts reported: input or output failed") != NULL);
  CHECK_INT(status_of(&service, id).generation, 0);
  CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, NULL, NULL), MO_ERR_CONFLICT);
  CHECK_INT(idle_stats(&service).jobs_failed, 1);
  /* Nothing is lost: when the cause is gone, it goes on. */
  fake_plan.fail_times = 0;
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  CHECK(ends_as_plain(&service, id, &origin));
  CHECK_INT(status_of(&service, id).job.error, MO_OK);
  CHECK_INT(idle_stats(&service).open_jobs, 0);
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_ERR_CONFLICT);
  service_end(&service);
}

__attribute__((unused)) static void tries_three_times_to_learn(void)
{
  struct mo_campaign_request request = campaign(MO_SIMULTANEOUS);
  struct origin origin = origin_of(&request);
  struct service service;
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_fails = 1;
  fake_plan.gradient_status = MO_ERR_IO;
  id = submit(&service, &request);
  CHECK(ends_as_plain(&service, id, &origin));
  fake_plan.gradient_fails = 1000;
  id = submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 120000, &job) == MO_OK);
  CHECK(job.state == MO_JOB_FAILED && job.error == MO_ERR_IO);
  fake_plan.gradient_status = 0;
  fake_plan.poison = true;
  id = submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 120000, &job) == MO_OK);
  CHECK(job.state == MO_JOB_FAILED && strstr(job.error_text, "not a number") != NULL);
  service_end(&service);
}

/* The bodies that a campaign scores do not fit in memory for a while: it waits, and ends as if
 * nothing had been. */
__attribute__((unused)) static void waits_for_memory(void)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct origin origin = origin_of(&request);
  struct service service;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.fail_word = word_of(&origin);
  fake_plan.fail_times = 5;
  fake_plan.fail_status = MO_ERR_NO_MEMORY;
  id = submit(&service, &request);
  CHECK(ends_as_plain(&service, id, &origin));
  CHECK(fake_plan.fail_times <= 0);
  CHECK_INT(status_of(&service, id).job.attempts, 0);
  CHECK_INT(warnings, 1);
  CHECK(strstr(warned, "no memory") != NULL);
  service_end(&service);
}

/* No file may grow beyond so many bytes: the database can, checkpoints cannot. */
static void limit_files(rlim_t bytes)
{
  struct rlimit limit;
  signal(SIGXFSZ, SIG_IGN);
  getrlimit(RLIMIT_FSIZE, &limit);
  limit.rlim_cur = bytes;
  setrlimit(RLIMIT_FSIZE, &limit);
}

static void waits_for_room(void)
{
  struct mo_campaign_request request = campaign(MO_FEW_SHOT);
  struct origin origin = origin_of(&request);
  struct service service;
  struct mo_live live;
  int64_t id, waiting[MO_WAITING_MAX] = {0};
  double begin;
  REQUIRE(start(&service, 1) == MO_OK);
  limit_files(8 << 20);
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT));
  live = live_of(&service, id);
  CHECK(strstr(live.reason, "no space") != NULL &&
        strstr(live.reason, "checkpoint of generation 0") != NULL);
  CHECK_INT(mo_jobs_waiting(service.jobs, waiting), 1);
  CHECK_INT(waiting[0], id);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK); /* it has nowhere to save to, and waits on */
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  limit_files(RLIM_INFINITY);
  CHECK(ends_as_plain(&service, id, &origin));
  /* Cancelled while it waits. */
  limit_files(8 << 20);
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT));
  begin = now_s();
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  CHECK(await_phase(&service, id, MO_PHASE_IDLE));
  CHECK(now_s() - begin < 1);
  /* Stopped while it waits: at once; what it had learned comes again. */
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT));
  begin = now_s();
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_ERR_BUSY);
  CHECK(now_s() - begin < 2);
  service_close(&service);
  limit_files(RLIM_INFINITY);
  REQUIRE(service_open(&service) == MO_OK);
  CHECK(ends_as_plain(&service, id, &origin));
  service_end(&service);
}

/* Damages six bytes, or puts them right: the second time. */
static int damage(struct service *service, int64_t id, uint32_t generation, uint32_t step)
{
  uint8_t bytes[6];
  char path[512];
  int fd, error = -1;
  snprintf(path, sizeof(path), "%s/campaigns/%lld/%u-%u.checkpoint", service->fixture.path,
           (long long)id, generation, step);
  fd = open(path, O_RDWR);
  if (fd >= 0 && pread(fd, bytes, 6, 5000) == 6) {
    for (int i = 0; i < 6; i++)
      bytes[i] ^= 0x55;
    error = pwrite(fd, bytes, 6, 5000) == 6 ? 0 : -1;
    close(fd);
  }
  return error;
}

/* What was learned inside a generation is learned again; what a generation left cannot be. */
__attribute__((unused)) static void reports_damaged_checkpoints(void)
{
  struct mo_campaign_request request = campaign(MO_SIMULTANEOUS);
  struct origin origin = origin_of(&request);
  struct service service;
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.delay_us = 20000;
  for (int round = 0; round < 2; round++) {
    uint32_t generation;
    id = submit(&service, &request);
    REQUIRE(await_place(&service, id, 2, MO_PHASE_SCORE));
    CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
    generation = (uint32_t)status_of(&service, id).generation + 1;
    service_close(&service);
    REQUIRE(damage(&service, id, generation, PARENT_STEPS + CHILD_STEPS) == 0);
    if (round == 1)
      REQUIRE(damage(&service, id, generation - 1, PARENT_STEPS + CHILD_STEPS) == 0);
    warnings = 0;
    fake_plan.delay_us = round == 0 ? 20000 : 0;
    REQUIRE(service_open(&service) == MO_OK);
    if (round == 0) {
      CHECK(ends_as_plain(&service, id, &origin));
      CHECK_INT(warnings, 1);
      CHECK(strstr(warned, "learns again") != NULL);
    } else {
      REQUIRE(await_end(service.jobs, id, 120000, &job) == MO_OK);
      CHECK(job.state == MO_JOB_FAILED && job.error == MO_ERR_CORRUPT);
      CHECK(strstr(job.error_text, "cannot be used (it is missing, or its bytes") != NULL &&
            strstr(job.error_text, "backup") != NULL);
      REQUIRE(damage(&service, id, generation - 1, PARENT_STEPS + CHILD_STEPS) == 0);
      CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
      CHECK(ends_as_plain(&service, id, &origin));
    }
  }
  service_end(&service);
}

__attribute__((unused)) static void needs_its_controller(void)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct service service;
  struct mo_job job;
  char path[512];
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  snprintf(path, sizeof(path), "%s/controllers/%s.safetensors", service.fixture.path,
           default_digits());
  REQUIRE(truncate(path, 1000) == 0);
  id = submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 120000, &job) == MO_OK);
  CHECK(job.state == MO_JOB_FAILED && strstr(job.error_text, "store the same file again") != NULL);
  service_end(&service);
}

/* ---- submissions ---- */

static int refuse(struct service *service, const struct mo_campaign_request *request,
                  const char *says, uint32_t *fault)
{
  int64_t id = 0;
  bool replayed = false;
  int error = mo_jobs_submit_campaign(service->jobs, request, &id, &replayed, fault,
                                      &service->fixture.message);
  if (strstr(service->fixture.message.text, says) == NULL) {
    printf("# \"%s\" lacks \"%s\"\n", service->fixture.message.text, says);
    CHECK(0);
  }
  return error;
}

__attribute__((unused)) static void refuses(void)
{
  struct service service;
  struct mo_bits *forms = NULL, *genotypes = NULL, listed[3];
  struct mo_campaign_request good = campaign(MO_ZERO_SHOT), bad = good;
  struct mo_environment wrong = {.light_xy_m = {NAN, 0}};
  int64_t id, again = 0;
  uint32_t fault = 0;
  bool replayed = false;
  REQUIRE(start(&service, 1) == MO_OK);
  REQUIRE(fixture_bodies(3, 3, &forms, &genotypes) == MO_OK);
  for (uint64_t n = 0; n <= 100000000; n += n < 2 ? 1 : 99999998) {
    bad.record.settings.population = (uint32_t)n;
    if (n != 2)
      CHECK_INT(refuse(&service, &bad, "population must be at least 2", NULL), MO_ERR_RANGE);
  }
  bad = good;
  bad.controller = "nobody";
  CHECK_INT(refuse(&service, &bad, "no controller \"nobody\"", NULL), MO_ERR_NOT_FOUND);
  bad = good;
  bad.record.initial_campaign = 77;
  CHECK_INT(refuse(&service, &bad, "no campaign 77", NULL), MO_ERR_NOT_FOUND);
  bad = good;
  snprintf(bad.record.environment_set, sizeof(bad.record.environment_set), "moon");
  CHECK_INT(refuse(&service, &bad, "no set of environments \"moon\"", NULL), MO_ERR_NOT_FOUND);
  bad.record.environment_set[0] = '\0';
  CHECK_INT(refuse(&service, &bad, "1 to 64 environments", NULL), MO_ERR_RANGE);
  bad.environments = &wrong;
  bad.record.n_environments = 1;
  CHECK_INT(refuse(&service, &bad, "environment 0", NULL), MO_ERR_INVALID);
  bad = good;
  bad.weight = -1;
  CHECK_INT(refuse(&service, &bad, "weight", NULL), MO_ERR_RANGE);
  bad = good;
  bad.priority = 7;
  CHECK_INT(refuse(&service, &bad, "priority", NULL), MO_ERR_INVALID);
  bad = good;
  bad.record.replicates = 101;
  CHECK_INT(refuse(&service, &bad, "replicates", NULL), MO_ERR_RANGE);
  bad = good;
  snprintf(bad.record.name, sizeof(bad.record.name), "walker");
  CHECK_INT(refuse(&service, &bad, "no controller that could have a name", NULL), MO_ERR_INVALID);
  bad.record.settings = campaign(MO_FEW_SHOT).record.settings;
  snprintf(bad.record.name, sizeof(bad.record.name), "No Name");
  CHECK_INT(refuse(&service, &bad, "not a name", NULL), MO_ERR_INVALID);
  /* Listed designs. */
  bad = good;
  listed[0] = genotypes[0];
  listed[1] = genotypes[1];
  REQUIRE(mo_genotype_image(MO_DEFAULT_WORKSPACE, genotypes[0].words, 3, listed[2].words) == MO_OK);
  bad.genotypes = listed;
  bad.record.n_listed = 3;
  CHECK_INT(refuse(&service, &bad, "design 2 has the form of an earlier one", &fault),
            MO_ERR_DUPLICATE);
  CHECK_INT(fault, 2);
  bad.record.n_listed = 2;
  bad.record.settings.workspace = (struct mo_workspace){2, 2, 1};
  CHECK_INT(refuse(&service, &bad, "does not fit a workspace of 2x2x1", &fault), MO_ERR_RANGE);
  CHECK_INT(fault, 0);
  bad = good;
  bad.genotypes = listed;
  bad.record.n_listed = 3;
  bad.record.settings.population = 2;
  CHECK_INT(refuse(&service, &bad, "3 designs are listed for a population of 2", &fault),
            MO_ERR_RANGE);
  /* A key is answered with its campaign. */
  good.idempotency_key = "once";
  good.record.replicates = 3;
  fake_plan.delay_us = 1000000;
  id = submit(&service, &good);
  CHECK_INT(mo_jobs_submit_campaign(service.jobs, &good, &again, &replayed, NULL, NULL), MO_OK);
  CHECK(replayed && again == id);
  CHECK_INT(status_of(&service, id + 2).record.settings.seed, good.record.settings.seed + 2);
  CHECK_INT(status_of(&service, id + 2).record.group, id);
  CHECK_INT(status_of(&service, id + 3).generation, -2); /* no such campaign */
  bad = good;
  bad.idempotency_key = NULL;
  bad.record.initial_campaign = id;
  CHECK_INT(refuse(&service, &bad, "has no population yet", NULL), MO_ERR_CONFLICT);
  for (int i = 0; i < 3; i++)
    CHECK_INT(mo_jobs_cancel(service.jobs, id + i), MO_OK);
  CHECK_INT(idle_stats(&service).open_jobs, 0);
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
  bad = campaign(MO_ZERO_SHOT);
  CHECK_INT(refuse(&service, &bad, "stopping", NULL), MO_ERR_CANCELLED);
  CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, NULL, NULL), MO_ERR_CANCELLED);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static const struct check_case cases[] = {
    {"waits for room", waits_for_room},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"exhausts small spaces", exhausts_small_spaces},
    {"tries three times", tries_three_times},
    {"waits for memory", waits_for_memory},
    {"tries three times to learn", tries_three_times_to_learn},
    {"reports damaged checkpoints", reports_damaged_checkpoints},
    {"needs its controller", needs_its_controller},
    {"refuses", refuses},
#endif
};
CHECK_MAIN(cases)
