/* campaign-excluded.c: the bodies that a campaign's controller was pretrained on: found by its
 * lineage, drawn again, left out. */
#include "campaigns.h"

/* ---- controllers ---- */

static int put(struct service *service, const char *name, struct mo_controller *controller,
               struct mo_sha256 *sha256)
{
  struct mo_controller_record record;
  uint8_t *bytes = NULL;
  size_t size = 0;
  bool created = false;
  int error = mo_controller_encode(controller, &bytes, &size);
  if (error == MO_OK)
    error = mo_store_controller_put(service->fixture.store, name, bytes, size, controller, &record,
                                    &created);
  free(bytes);
  *sha256 = record.sha256;
  return error;
}

/* What a controller says of how it was trained; NULL: nothing. */
struct said {
  const char *kind, *parent, *seed, *step, *settings;
};

static const struct said good = {"pretrain", "random", "31", "40",
                                 "{\"steps\":900,\"batch\":64,\"x\":1}"};

/* A controller with the default weights. */
static int put_saying(struct service *service, const char *name, const struct said *said,
                      char digits[MO_SHA256_DIGITS + 1])
{
  const char *const entries[][2] = {{"morphod.kind", said->kind},
                                    {"morphod.parent", said->parent},
                                    {"morphod.seed", said->seed},
                                    {"morphod.step", said->step},
                                    {"morphod.settings", said->settings}};
  struct mo_controller *controller = NULL;
  struct mo_sha256 sha256;
  int error = mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller);
  if (error != MO_OK)
    return error;
  mo_controller_randomize(controller, 1);
  for (size_t i = 0; i < sizeof(entries) / sizeof(entries[0]); i++)
    if (entries[i][1] != NULL)
      (void)mo_controller_set_metadata(controller, entries[i][0], entries[i][1]);
  error = put(service, name, controller, &sha256);
  mo_sha256_to_hex(&sha256, digits);
  mo_controller_free(controller);
  return error;
}

/* "pretrained" with a seed of bodies, 64 of them a step; "tuned", its child. */
static int put_family(struct service *service, const char *steps)
{
  struct said said = good;
  char digits[MO_SHA256_DIGITS + 1], child[MO_SHA256_DIGITS + 1];
  int error;
  said.step = steps;
  error = put_saying(service, "pretrained", &said, digits);
  said.kind = "finetune";
  said.parent = digits;
  return error == MO_OK ? put_saying(service, "tuned", &said, child) : error;
}

/* "line": five pretrainings, each from the one before, of which no one has more bodies than can be
 * drawn again, but all together do. */
static int put_line(struct service *service)
{
  struct mo_controller *controller = NULL;
  struct mo_sha256 sha256;
  char parent[MO_SHA256_DIGITS + 1] = "random";
  int error = mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller);
  if (error != MO_OK)
    return error;
  mo_controller_randomize(controller, 1);
  (void)mo_controller_set_metadata(controller, "morphod.kind", "pretrain");
  (void)mo_controller_set_metadata(controller, "morphod.seed", "31");
  (void)mo_controller_set_metadata(controller, "morphod.step", "1000000");
  (void)mo_controller_set_metadata(
      controller, "morphod.settings",
      "{\"steps\": 1000000, \"x\": {\"batch\":1}, \"batch\" : 64}"); /* as others may write it */
  for (int i = 0; i < 5 && error == MO_OK; i++) {
    (void)mo_controller_set_metadata(controller, "morphod.parent", parent);
    error = put(service, "line", controller, &sha256);
    mo_sha256_to_hex(&sha256, parent);
  }
  mo_controller_free(controller);
  return error;
}

/* ---- what is left out ---- */

__attribute__((unused)) static void leaves_out_what_was_learned_from(void)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct mo_form_set *excluded = NULL;
  struct history *without;
  struct service service;
  struct origin origin;
  struct mo_job job;
  int64_t ids[3];
  REQUIRE(start(&service, 3) == MO_OK);
  REQUIRE(put_family(&service, "40") == MO_OK);
  request.record.settings.workspace = (struct mo_workspace){3, 3, 2};
  origin = origin_of(&request);
  without = plain_history(&fake_plain, &origin);
  REQUIRE(mo_form_set_create(request.record.settings.workspace, &excluded) == MO_OK);
  REQUIRE(mo_pretraining_forms(31, 64 * 40, request.record.settings.workspace, 1, NULL, NULL,
                               excluded) == MO_OK);
  CHECK(mo_form_set_count(excluded) > 0);
  origin.excluded = excluded;
  request.controller = "tuned";
  for (int i = 0; i < 3; i++) {
    request.record.settings.exclude_pretraining = i < 2; /* two that share the set, one without */
    ids[i] = submit(&service, &request);
  }
  CHECK(ends_as_plain(&service, ids[0], &origin));
  CHECK(ends_as_plain(&service, ids[1], &origin));
  REQUIRE(await_end(service.jobs, ids[2], 120000, &job) == MO_OK);
  {
    struct history *stored = stored_history(service.fixture.store, ids[2]);
    CHECK(same_history(stored, without));
    free(stored);
    stored = stored_history(service.fixture.store, ids[0]);
    printf("# the next line is to be a difference:\n");
    CHECK(!same_history(stored, without));
    free(stored);
  }
  /* More than can be drawn again. */
  REQUIRE(put_family(&service, "1000000000") == MO_OK);
  request.record.settings.exclude_pretraining = true;
  CHECK_INT(submit(&service, &request), MO_ERR_LIMIT); /* before anything is stored or drawn */
  CHECK(strstr(service.fixture.message.text, "exclude_pretraining false") != NULL);
  REQUIRE(put_line(&service) == MO_OK);
  request.controller = "line";
  CHECK_INT(submit(&service, &request), MO_ERR_LIMIT); /* before anything is stored or drawn */
  CHECK(strstr(service.fixture.message.text, "exclude_pretraining false") != NULL);
  mo_form_set_free(excluded);
  free(without);
  service_end(&service);
}

/* ---- lineages that cannot be read ---- */

/* How often the campaign reported this field of this controller (its digits, or NULL: any). */
static int reported(struct service *service, int64_t id, const char *digits, const char *field)
{
  struct mo_event events[80];
  char quoted[128];
  int n_told = 0;
  const int64_t n = mo_store_events(service->fixture.store, 0, id, events, 80, NULL, NULL);
  snprintf(quoted, sizeof(quoted), "\"field\":\"%s\"", field);
  for (int64_t i = 0; i < n; i++)
    n_told += strcmp(events[i].type, "campaign.lineage_unreadable") == 0 &&
              (digits == NULL || strstr(events[i].data, digits) != NULL) &&
              strstr(events[i].data, quoted) != NULL;
  return n_told;
}

__attribute__((unused)) static void reports_what_cannot_be_read(void)
{
  static const char settings[] = "{\"steps\":900,\"batch\":64,\"x\":1}";
  static const char *const fields[] = {"morphod.kind", "morphod.parent", "morphod.seed",
                                       "morphod.step", "morphod.settings"};
  static const struct {
    struct said said;
    const char *reported[3];
  } cases[] = {
      {{"pretrain", "random", "31", "0", settings}, {NULL}}, /* no step, no bodies */
      {{"finetune", "random", NULL, NULL, NULL}, {NULL}},
      {{NULL, NULL, NULL, NULL, NULL}, {NULL}},
      {{"distill", "random", "31", "40", settings}, {"morphod.kind"}},
      {{"pretrain", "random", "31x", "40", settings}, {"morphod.seed"}},
      {{"pretrain", "random", "31,", "40", settings}, {"morphod.seed"}},
      {{"pretrain", "random", "18446744073709551616", "40", settings}, {"morphod.seed"}},
      {{"pretrain", "random", "31", "", settings}, {"morphod.step"}},
      {{"pretrain", "random", NULL, "-40", settings}, {"morphod.seed", "morphod.step"}},
      {{"pretrain", "random", "31", "40", "{\"steps\":900}"}, {"morphod.settings"}},
      {{"pretrain", "random", "31", "40", "{\"batch\":\"64\"}"}, {"morphod.settings"}},
      {{"pretrain", "random", "31", "40", "{\"x\":{\"batch\":64}}"}, {"morphod.settings"}},
      {{"pretrain", "random", "31", "40", "{\"batch\":64"}, {"morphod.settings"}},
      {{"pretrain", "random", "31", "40", "{\"batch\":9223372036854775808}"}, {"morphod.settings"}},
      {{"pretrain", "random", "31", "40", "{\"batch\":0}"}, {"morphod.settings"}},
      {{"finetune", "chance", "31", "40", settings}, {"morphod.parent"}},
  };
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct service service;
  struct origin origin;
  REQUIRE(start(&service, 1) == MO_OK);
  request.record.settings.workspace = (struct mo_workspace){3, 3, 2};
  request.record.settings.generations = 1;
  origin = origin_of(&request);
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
    char digits[MO_SHA256_DIGITS + 1], child[MO_SHA256_DIGITS + 1];
    const struct said tuned = {"finetune", digits, "7", "3", settings};
    REQUIRE(put_saying(&service, "odd", &cases[i].said, digits) == MO_OK);
    REQUIRE(put_saying(&service, "odd-child", &tuned, child) == MO_OK);
    for (int as_parent = 0; as_parent < 2; as_parent++) {
      int64_t id;
      request.controller = as_parent ? "odd-child" : "odd";
      id = submit(&service, &request);
      CHECK(ends_as_plain(&service, id, &origin)); /* nothing is excluded */
      for (size_t f = 0; f < sizeof(fields) / sizeof(fields[0]); f++) {
        int expected = 0;
        for (size_t t = 0; t < 3 && cases[i].reported[t] != NULL; t++)
          expected += strcmp(cases[i].reported[t], fields[f]) == 0;
        CHECK_INT(reported(&service, id, digits, fields[f]), expected);
        CHECK_INT(reported(&service, id, NULL, fields[f]), expected);
      }
    }
  }
  CHECK_INT(warnings, 0);
  service_end(&service);
}

/* "long": so many controllers, each the child of the one before, with `first` at its beginning and
 * `other` after that. */
static int put_long(struct service *service, int n, const struct said *first,
                    const struct said *other, char digits[MO_SHA256_DIGITS + 1])
{
  int error = put_saying(service, "long", first, digits);
  for (int i = 1; i < n && error == MO_OK; i++) {
    char parent[MO_SHA256_DIGITS + 1], seed[16];
    struct said said = *other;
    memcpy(parent, digits, sizeof(parent));
    snprintf(seed, sizeof(seed), "%d", i);
    said.parent = parent;
    said.seed = seed;
    error = put_saying(service, "long", &said, digits);
  }
  return error;
}

/* A lineage ends where it is too long to be read, which is reported; with too many pretrainings it
 * is refused, and the words say of what. */
__attribute__((unused)) static void reports_long_lineages(void)
{
  const struct said tuned = {"finetune", NULL, NULL, NULL, NULL};
  struct said odd = good, short_one = good;
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  char digits[MO_SHA256_DIGITS + 1];
  struct service service;
  struct origin origin;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  request.controller = "long";
  request.record.settings.workspace = (struct mo_workspace){3, 3, 2};
  request.record.settings.generations = 1;
  origin = origin_of(&request);
  odd.seed = "none"; /* reported as far as it is read */
  for (int n = 64; n <= 65; n++) {
    REQUIRE(put_long(&service, n, &odd, &tuned, digits) == MO_OK);
    id = submit(&service, &request);
    CHECK(ends_as_plain(&service, id, &origin));
    CHECK_INT(reported(&service, id, NULL, "morphod.seed"), n == 64);
    CHECK_INT(reported(&service, id, NULL, "morphod.parent"), n == 65);
  }
  short_one.step = "1";
  REQUIRE(put_long(&service, 17, &short_one, &short_one, digits) == MO_OK);
  CHECK_INT(submit(&service, &request), MO_ERR_LIMIT);
  CHECK(strstr(service.fixture.message.text, "16 pretrainings") != NULL);
  service_end(&service);
}

/* What can be read counts, though a descendant or an ancestor cannot be. */
__attribute__((unused)) static void leaves_out_what_can_be_read(void)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct mo_form_set *excluded = NULL;
  char first[MO_SHA256_DIGITS + 1], second[MO_SHA256_DIGITS + 1], third[MO_SHA256_DIGITS + 1];
  struct said said = good;
  struct service service;
  struct origin origin;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  said.seed = "none";
  REQUIRE(put_saying(&service, "first", &said, first) == MO_OK);
  said.seed = "31";
  said.parent = first;
  REQUIRE(put_saying(&service, "second", &said, second) == MO_OK);
  said.step = "some";
  said.parent = second;
  REQUIRE(put_saying(&service, "third", &said, third) == MO_OK);
  request.controller = "third";
  request.record.settings.workspace = (struct mo_workspace){3, 3, 2};
  origin = origin_of(&request);
  REQUIRE(mo_form_set_create(request.record.settings.workspace, &excluded) == MO_OK);
  REQUIRE(mo_pretraining_forms(31, 64 * 40, request.record.settings.workspace, 1, NULL, NULL,
                               excluded) == MO_OK);
  origin.excluded = excluded;
  id = submit(&service, &request);
  CHECK(ends_as_plain(&service, id, &origin));
  CHECK_INT(reported(&service, id, first, "morphod.seed"), 1);
  CHECK_INT(reported(&service, id, third, "morphod.step"), 1);
  CHECK_INT(reported(&service, id, NULL, "morphod.seed") +
                reported(&service, id, NULL, "morphod.step"),
            2);
  mo_form_set_free(excluded);
  service_end(&service);
}

/* ---- while they are drawn ---- */

/* Steps of 64 bodies that take long enough to be met, a second or two; and so many that nobody
 * awaits their end. */
#if defined(__SANITIZE_THREAD__) || defined(__SANITIZE_ADDRESS__)
#define LONG_STEPS 1000
#else
#define LONG_STEPS 4000
#endif
#define LONGER_STEPS     (2 * LONG_STEPS)
#define ENDLESS          "1000000"
#define LONG_GENERATIONS 1000
#define SEEN             40

/* "tuned", pretrained for so many steps, and a campaign with it, on one worker. */
static int start_drawing(struct service *service, const char *steps,
                         struct mo_campaign_request *request)
{
  int error = watch_start(service);
  service->config.max_active_campaigns = 3;
  service->n_workers = 1;
  if (error == MO_OK)
    error = service_open(service);
  if (error == MO_OK)
    error = put_family(service, steps);
  *request = campaign(MO_ZERO_SHOT);
  request->controller = "tuned";
  request->record.settings.workspace = (struct mo_workspace){3, 3, 2};
  return error;
}

/* The figures of a campaign as soon as some of its bodies are drawn. */
static struct mo_live await_drawing(struct service *service, int64_t id)
{
  const double end = now_s() + 60;
  struct mo_live live;
  do {
    usleep(300);
    live = live_of(service, id);
  } while ((live.phase != MO_PHASE_PREPARE || live.done == 0 || live.seconds_left < 0) &&
           now_s() < end);
  return live;
}

static struct mo_exclusion *exclusions(struct service *service)
{
  struct mo_exclusion *first;
  pthread_mutex_lock(&service->jobs->exclusions_mutex);
  first = service->jobs->exclusions;
  pthread_mutex_unlock(&service->jobs->exclusions_mutex);
  return first;
}

static bool names(const struct mo_live *live, int64_t id)
{
  char text[64];
  snprintf(text, sizeof(text), "campaign %lld draws", (long long)id);
  return strstr(live->reason, text) != NULL;
}

/* Whether one shows that it draws, and the other that it waits for that one. */
static bool draws_for(struct service *service, int64_t drawer, int64_t other)
{
  const struct mo_live first = live_of(service, drawer), second = live_of(service, other);
  return first.phase == MO_PHASE_PREPARE && first.reason[0] == '\0' && names(&second, drawer);
}

/* What one draws, others wait for, and they report that; when it is paused or cancelled, the
 * drawing goes on for them. */
static void hands_the_drawing_over(void)
{
  struct mo_campaign_request request;
  struct mo_form_set *excluded = NULL;
  struct mo_live live;
  struct service service;
  struct origin origin;
  char steps[16];
  int64_t ids[3];
  uint64_t done;
  snprintf(steps, sizeof(steps), "%d", LONGER_STEPS);
  REQUIRE(start_drawing(&service, steps, &request) == MO_OK);
  origin = origin_of(&request);
  ids[0] = submit(&service, &request);
  live = await_drawing(&service, ids[0]);
  CHECK(live.done > 0 && live.total == 64 * LONGER_STEPS && live.reason[0] == '\0');
  for (int i = 1; i < 3; i++) {
    ids[i] = submit(&service, &request);
    live = await_drawing(&service, ids[i]);
    CHECK(live.done > 0 && live.total == 64 * LONGER_STEPS && live.seconds_left > 0);
    CHECK(names(&live, ids[0]));
  }
  done = live_of(&service, ids[1]).done;
  CHECK_INT(mo_jobs_pause(service.jobs, ids[0]), MO_OK);
  REQUIRE(await_phase(&service, ids[0], MO_PHASE_IDLE));
  CHECK_INT(state_of(&service, ids[0]), MO_JOB_PAUSED);
  for (int i = 0;
       i < 500 && !draws_for(&service, ids[1], ids[2]) && !draws_for(&service, ids[2], ids[1]); i++)
    usleep(1000); /* one of them takes its place */
  CHECK(draws_for(&service, ids[1], ids[2]) || draws_for(&service, ids[2], ids[1]));
  for (int i = 1; i < 3; i++) {
    live = live_of(&service, ids[i]);
    CHECK(live.phase == MO_PHASE_PREPARE && live.done >= done); /* not from the beginning */
  }
  CHECK_INT(mo_jobs_resume(service.jobs, ids[0]), MO_OK); /* it finds the drawing in progress */
  live = await_drawing(&service, ids[0]);
  CHECK(live.done >= done && live.reason[0] != '\0');
  CHECK_INT(mo_jobs_cancel(service.jobs, ids[live_of(&service, ids[1]).reason[0] == '\0' ? 1 : 2]),
            MO_OK);
  for (uint64_t before = done;; before = live.done) {
    live = live_of(&service, ids[0]);
    if (live.phase != MO_PHASE_PREPARE || live.total == 0)
      break;
    CHECK(live.done >= before);
    usleep(2000);
  }
  REQUIRE(mo_form_set_create(request.record.settings.workspace, &excluded) == MO_OK);
  REQUIRE(mo_pretraining_forms(31, UINT64_C(64) * LONGER_STEPS, request.record.settings.workspace,
                               1, NULL, NULL, excluded) == MO_OK);
  origin.excluded = excluded;
  CHECK(ends_as_plain(&service, ids[0], &origin));
  CHECK((state_of(&service, ids[1]) == MO_JOB_CANCELLED) !=
        (state_of(&service, ids[2]) == MO_JOB_CANCELLED));
  for (int i = 1; i < 3; i++)
    CHECK(state_of(&service, ids[i]) == MO_JOB_CANCELLED ||
          ends_as_plain(&service, ids[i], &origin));
  (void)idle_stats(&service);
  CHECK(exclusions(&service) == NULL);
  CHECK_INT(warnings, 0);
  mo_form_set_free(excluded);
  service_end(&service);
}

/* Nobody waits for it any more: it ends at once; so it does at the end of the process. */
static void draws_for_nobody(void)
{
  struct mo_campaign_request request;
  struct service service;
  int64_t ids[2];
  double begin;
  REQUIRE(start_drawing(&service, ENDLESS, &request) == MO_OK);
  for (int i = 0; i < 2; i++) {
    ids[i] = submit(&service, &request);
    CHECK(await_drawing(&service, ids[i]).done > 0);
  }
  begin = now_s();
  CHECK_INT(mo_jobs_cancel(service.jobs, ids[0]), MO_OK);
  CHECK_INT(mo_jobs_pause(service.jobs, ids[1]), MO_OK);
  for (int i = 0; i < 2; i++)
    CHECK(await_phase(&service, ids[i], MO_PHASE_IDLE));
  CHECK(exclusions(&service) == NULL);
  CHECK_INT(mo_jobs_resume(service.jobs, ids[1]), MO_OK); /* again */
  ids[0] = submit(&service, &request);
  for (int i = 0; i < 2; i++)
    CHECK(await_drawing(&service, ids[i]).done > 0);
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
  CHECK(now_s() - begin < 5);
  for (int i = 0; i < 2; i++)
    CHECK_INT(state_of(&service, ids[i]), MO_JOB_QUEUED);
  CHECK(exclusions(&service) == NULL);
  service_end(&service);
}

/* The time that is left: of the drawing by its own rate; of the generations, too, once there is one
 * beside the first. */
__attribute__((unused)) static void reports_how_long_it_draws(void)
{
  struct mo_campaign_generation rows[SEEN];
  struct mo_campaign_request request;
  struct mo_live live;
  struct mo_event events[80];
  struct service service;
  double begin, drawing_s, rest;
  char steps[16];
  int64_t id, n, committed;
  snprintf(steps, sizeof(steps), "%d", LONG_STEPS);
  REQUIRE(start_drawing(&service, steps, &request) == MO_OK);
  request.record.settings.generations = LONG_GENERATIONS;
  fake_plan.delay_us = 10000;
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_PREPARE));
  begin = now_s();
  (void)await_drawing(&service, id);
  do { /* half of it */
    usleep(1000);
    live = live_of(&service, id);
  } while (live.phase == MO_PHASE_PREPARE && live.done < live.total / 2);
  REQUIRE(live.phase == MO_PHASE_PREPARE);
  rest = (now_s() - begin) * (double)(live.total - live.done) / (double)live.done;
  printf("# %.2f s left, %.2f s by this clock\n", live.seconds_left, rest);
  CHECK(live.seconds_left > 0.5 * rest && live.seconds_left < 2 * rest + 0.1);
  while (live_of(&service, id).phase == MO_PHASE_PREPARE)
    usleep(300);
  drawing_s = now_s() - begin;
  CHECK(live_of(&service, id).seconds_left < 0); /* nothing is known of the generations */
  REQUIRE(await_place(&service, id, 2, MO_PHASE_SCORE));
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  REQUIRE(await_phase(&service, id, MO_PHASE_IDLE));
  n = mo_store_campaign_generations(service.fixture.store, id, -1, rows, SEEN);
  REQUIRE(n >= 2 && n < SEEN);
  committed = n;
  CHECK(rows[0].seconds > drawing_s && rows[0].seconds < drawing_s + 20 * rows[1].seconds);
  CHECK(rows[1].seconds < drawing_s);
  /* What the first generation's event says of the rest does not count the drawing again. */
  n = mo_store_events(service.fixture.store, 0, id, events, 80, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    if (strcmp(events[i].type, "campaign.generation") == 0 &&
        strstr(events[i].data, "\"generation\":0,") != NULL)
      CHECK(strtod(strstr(events[i].data, "seconds_left\":") + 14, NULL) <
            LONG_GENERATIONS * (rows[0].seconds - 0.9 * drawing_s));
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  live = await_drawing(&service, id);
  CHECK(live.done > 0 && live.seconds_left > (double)(LONG_GENERATIONS + 1 - committed) *
                                                 rows[committed - 1].seconds);
  REQUIRE(
      await_place(&service, id, (uint32_t)committed + 2,
                  MO_PHASE_SCORE)); /* a commit is written while the next generation is scored */
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  REQUIRE(mo_store_campaign_generations(service.fixture.store, id, -1, rows, SEEN) > committed);
  CHECK(rows[committed].seconds < drawing_s); /* what was drawn after the pause is no part of it */
  service_end(&service);
}

static const struct check_case cases[] = {
    {"hands the drawing over", hands_the_drawing_over},
    {"draws for nobody", draws_for_nobody},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"reports how long it draws", reports_how_long_it_draws},
    {"leaves out what was learned from", leaves_out_what_was_learned_from},
    {"reports what cannot be read", reports_what_cannot_be_read},
    {"reports long lineages", reports_long_lineages},
    {"leaves out what can be read", leaves_out_what_can_be_read},
#endif
};
CHECK_MAIN(cases)
