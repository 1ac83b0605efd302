/* campaign-excluded.c: the bodies that a campaign's controller was pretrained on: found through its
 * lineage, redrawn, and excluded. */
#include <dirent.h>
#include <fcntl.h>
#include <limits.h>
#include <sys/stat.h>

#include "fakes.h"

/* ---- controllers ---- */

/* Training metadata of a controller; NULL if it has none. */
struct said {
  const char *kind, *parent, *seed, *step, *settings;
};

static const struct said good = {"pretrain", "random", "31", "40",
                                 "{\"steps\":900,\"batch\":64,\"x\":1}"};

/* Stores a controller with the default weights. digits: the hash of its file. */
static void put(const char *name, const struct said *said, char digits[MO_SHA256_DIGITS + 1])
{
  const char *const entries[][2] = {{"morphod.kind", said->kind},
                                    {"morphod.parent", said->parent},
                                    {"morphod.seed", said->seed},
                                    {"morphod.step", said->step},
                                    {"morphod.settings", said->settings}};
  struct mo_controller *controller = weights_of(1);
  struct mo_controller_record record;
  uint8_t *bytes = NULL;
  size_t size = 0;
  bool created;
  for (size_t i = 0; i < COUNT(entries); i++)
    if (entries[i][1] != NULL)
      (void)mo_controller_set_metadata(controller, entries[i][0], entries[i][1]);
  CHECK_OK(mo_controller_encode(controller, &bytes, &size));
  CHECK_OK(mo_store_controller_put(store, name, bytes, size, controller, &record, &created));
  mo_sha256_to_hex(&record.sha256, digits);
  free(bytes);
  mo_controller_free(controller);
}

/* Stores "pretrained", trained on 64 bodies per step drawn from a seed, and "tuned", its child. */
static void put_family(const char *steps)
{
  struct said said = good;
  char digits[MO_SHA256_DIGITS + 1], child[MO_SHA256_DIGITS + 1];
  said.step = steps;
  put("pretrained", &said, digits);
  said.kind = "finetune";
  said.parent = digits;
  put("tuned", &said, child);
}

/* Stores "long": a chain of n controllers, each the child of the previous one. The metadata of the
 * first is `first`, that of the others `other`. */
static void put_long(int n, const struct said *first, const struct said *other)
{
  char digits[MO_SHA256_DIGITS + 1], parent[MO_SHA256_DIGITS + 1], seed[16];
  put("long", first, digits);
  for (int i = 1; i < n; i++) {
    struct said said = *other;
    memcpy(parent, digits, sizeof(parent));
    snprintf(seed, sizeof(seed), "%d", i);
    said.parent = parent;
    said.seed = seed;
    put("long", &said, digits);
  }
}

/* Returns the forms of the bodies that "pretrained" learned from in n steps. */
static struct mo_form_set *forms_of(struct mo_workspace workspace, uint64_t steps)
{
  struct mo_form_set *forms = NULL;
  CHECK_OK(mo_form_set_create(workspace, &forms));
  CHECK_OK(mo_pretraining_forms(31, 64 * steps, workspace, 1, NULL, NULL, forms));
  return forms;
}

/* ---- exclusions ---- */

SERVICE_CASE(leaves_out_what_was_learned_from, 3)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  const struct said line = {"pretrain", "random", "31", "1000000",
                            "{\"steps\": 1000000, \"x\": {\"batch\":1}, \"batch\" : 64}"};
  struct origin origin, plain;
  int64_t ids[3];
  put_family("40");
  request.record.settings.workspace = (struct mo_workspace){3, 3, 2};
  origin = plain = origin_of(&request);
  struct history *without = plain_history(&fake_plain, &origin);
  struct mo_form_set *excluded = forms_of(request.record.settings.workspace, 40);
  CHECK(mo_form_set_count(excluded) > 0);
  origin.excluded = excluded;
  request.controller = "tuned";
  for (int i = 0; i < 3; i++) {
    request.record.settings.exclude_pretraining = i < 2; /* two share the set, one has none */
    ids[i] = submit_campaign(&request);
  }
  CHECK(ends_as_plain(ids[0], &origin));
  CHECK(ends_as_plain(ids[1], &origin));
  CHECK(ends_as_plain(ids[2], &plain));
  struct history *stored = stored_history(ids[0]);
  printf("# the next line is to be a difference:\n");
  CHECK(!same_history(stored, without));
  free(stored);
  /* More bodies than can be redrawn. */
  put_family("1000000000");
  request.record.settings.exclude_pretraining = true;
  CHECK_INT(submit_campaign(&request), MO_ERR_LIMIT); /* before anything is stored or drawn */
  CHECK_SAYS(fixture.message, "exclude_pretraining false");
  /* The five pretraining runs together exceed the limit, although each one is below it; written as
   * other programs may write it. */
  put_long(5, &line, &line);
  request.controller = "long";
  CHECK_INT(submit_campaign(&request), MO_ERR_LIMIT); /* before anything is stored or drawn */
  CHECK_SAYS(fixture.message, "exclude_pretraining false");
  mo_form_set_free(excluded);
  free(without);
}

/* ---- unreadable lineages ---- */

/* Returns how often the campaign reported this field of this controller (its digits; NULL =
 * any). */
static int reported(int64_t id, const char *digits, const char *field)
{
  struct mo_event events[80];
  char quoted[128];
  int n_told = 0;
  const int64_t n = mo_store_events(store, 0, id, events, 80, NULL, NULL);
  snprintf(quoted, sizeof(quoted), "\"field\":\"%s\"", field);
  for (int64_t i = 0; i < n; i++)
    n_told += strcmp(events[i].type, "campaign.lineage_unreadable") == 0 &&
              (digits == NULL || strstr(events[i].data, digits) != NULL) &&
              strstr(events[i].data, quoted) != NULL;
  return n_told;
}

SERVICE_CASE(reports_what_cannot_be_read, 1)
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
  request.record.settings.workspace = (struct mo_workspace){3, 3, 2};
  request.record.settings.generations = 1;
  struct origin origin = origin_of(&request);
  for (size_t i = 0; i < COUNT(cases); i++) {
    char digits[MO_SHA256_DIGITS + 1], child[MO_SHA256_DIGITS + 1];
    const struct said tuned = {"finetune", digits, "7", "3", settings};
    put("odd", &cases[i].said, digits);
    put("odd-child", &tuned, child);
    for (int as_parent = 0; as_parent < 2; as_parent++) {
      request.controller = as_parent ? "odd-child" : "odd";
      int64_t id = submit_campaign(&request);
      CHECK(ends_as_plain(id, &origin)); /* nothing is excluded */
      for (size_t f = 0; f < COUNT(fields); f++) {
        int expected = 0;
        for (size_t t = 0; t < 3 && cases[i].reported[t] != NULL; t++)
          expected += strcmp(cases[i].reported[t], fields[f]) == 0;
        CHECK_INT(reported(id, digits, fields[f]), expected);
        CHECK_INT(reported(id, NULL, fields[f]), expected);
      }
    }
  }
  CHECK_INT(warnings, 0);
}

/* A lineage is cut off where it becomes too long to read, and that is reported. With too many
 * pretraining runs, the campaign is refused with a message that says why. */
SERVICE_CASE(reports_long_lineages, 1)
{
  const struct said tuned = {"finetune", NULL, NULL, NULL, NULL};
  struct said odd = good, short_one = good;
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  int64_t id;
  request.controller = "long";
  request.record.settings.workspace = (struct mo_workspace){3, 3, 2};
  request.record.settings.generations = 1;
  struct origin origin = origin_of(&request);
  odd.seed = "none"; /* reported as far as it was read */
  for (int n = 64; n <= 65; n++) {
    put_long(n, &odd, &tuned);
    id = submit_campaign(&request);
    CHECK(ends_as_plain(id, &origin));
    CHECK_INT(reported(id, NULL, "morphod.seed"), n == 64);
    CHECK_INT(reported(id, NULL, "morphod.parent"), n == 65);
  }
  short_one.step = "1";
  put_long(17, &short_one, &short_one);
  CHECK_INT(submit_campaign(&request), MO_ERR_LIMIT);
  CHECK_SAYS(fixture.message, "16 pretraining runs");
}

/* Readable entries count even if a descendant or an ancestor is unreadable. */
SERVICE_CASE(leaves_out_what_can_be_read, 1)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  struct mo_form_set *excluded;
  char first[MO_SHA256_DIGITS + 1], second[MO_SHA256_DIGITS + 1], third[MO_SHA256_DIGITS + 1];
  struct said said = good;
  said.seed = "none";
  put("first", &said, first);
  said.seed = "31";
  said.parent = first;
  put("second", &said, second);
  said.step = "some";
  said.parent = second;
  put("third", &said, third);
  request.controller = "third";
  request.record.settings.workspace = (struct mo_workspace){3, 3, 2};
  struct origin origin = origin_of(&request);
  origin.excluded = excluded = forms_of(request.record.settings.workspace, 40);
  int64_t id = submit_campaign(&request);
  CHECK(ends_as_plain(id, &origin));
  CHECK_INT(reported(id, first, "morphod.seed"), 1);
  CHECK_INT(reported(id, third, "morphod.step"), 1);
  CHECK_INT(reported(id, NULL, "morphod.seed") + reported(id, NULL, "morphod.step"), 2);
  mo_form_set_free(excluded);
}

/* ---- during the drawing ---- */

/* Numbers of steps of 64 bodies: one takes a second or two, so that a test can observe it; the
 * other never ends within a test. */
#if defined(__SANITIZE_THREAD__) || defined(__SANITIZE_ADDRESS__)
#define LONG_STEPS 1000
#else
#define LONG_STEPS 4000
#endif
#define LONGER_STEPS     (2 * LONG_STEPS)
#define ENDLESS          "1000000"
#define LONG_GENERATIONS 1000
#define SEEN             40

/* Submits a campaign with "tuned", pretrained for n steps, on one worker. */
static int start_drawing(const char *steps, struct mo_campaign_request *request)
{
  int error = service_begin();
  service.config.max_active_campaigns = 3;
  service.n_workers = 1;
  if (error == MO_OK)
    error = service_open();
  put_family(steps);
  *request = campaign(MO_ZERO_SHOT);
  request->controller = "tuned";
  request->record.settings.workspace = (struct mo_workspace){3, 3, 2};
  return error;
}

/* Returns the figures of a campaign as soon as some of its bodies are drawn. */
static struct mo_live await_drawing(int64_t id)
{
  struct mo_live live;
  CHECK(AWAIT((live = live_of(id)).phase == MO_PHASE_PREPARE && live.done > 0 &&
              live.seconds_left >= 0));
  return live;
}

/* Waits until a campaign no longer draws and returns when it was last seen drawing. The result is
 * never too late, no matter how busy the computer is. */
__attribute__((unused)) static double await_drawn(int64_t id)
{
  double seen = now_s(), look = seen;
  CHECK(AWAIT((seen = look, look = now_s(), live_of(id).phase != MO_PHASE_PREPARE)));
  return seen;
}

__attribute__((unused)) static double seconds_of(const struct mo_campaign_generation *rows,
                                                 int64_t n)
{
  double sum = 0;
  for (int64_t i = 0; i < n; i++)
    sum += rows[i].seconds;
  return sum;
}

static struct mo_exclusion *exclusions(void)
{
  pthread_mutex_lock(&service.jobs->exclusions_mutex);
  struct mo_exclusion *first = service.jobs->exclusions;
  pthread_mutex_unlock(&service.jobs->exclusions_mutex);
  return first;
}

static bool names(const struct mo_live *live, int64_t id)
{
  char text[96];
  snprintf(text, sizeof(text), "waiting for campaign %lld, which is redrawing", (long long)id);
  return strstr(live->reason, text) != NULL;
}

/* Returns whether one campaign shows that it is drawing, and the other that it is waiting for
 * it. */
static bool draws_for(int64_t drawer, int64_t other)
{
  const struct mo_live first = live_of(drawer), second = live_of(other);
  return first.phase == MO_PHASE_PREPARE && first.reason[0] == '\0' && names(&second, drawer);
}

/* While one campaign draws, others wait for it, and report that. If it is paused or cancelled, the
 * drawing continues for them. */
static void hands_the_drawing_over(void)
{
  struct mo_campaign_request request;
  struct mo_form_set *excluded;
  char steps[16];
  int64_t ids[3];
  uint64_t done;
  snprintf(steps, sizeof(steps), "%d", LONGER_STEPS);
  REQUIRE_OK(start_drawing(steps, &request));
  struct origin origin = origin_of(&request);
  ids[0] = submit_campaign(&request);
  struct mo_live live = await_drawing(ids[0]);
  CHECK(live.done > 0 && live.total == 64 * LONGER_STEPS && live.reason[0] == '\0');
  for (int i = 1; i < 3; i++) {
    ids[i] = submit_campaign(&request);
    live = await_drawing(ids[i]);
    CHECK(live.done > 0 && live.total == 64 * LONGER_STEPS && live.seconds_left > 0);
    CHECK(names(&live, ids[0]));
  }
  done = live_of(ids[1]).done;
  CHECK_OK(mo_jobs_pause(service.jobs, ids[0]));
  REQUIRE(await_phase(ids[0], MO_PHASE_IDLE));
  CHECK_INT(state_of(ids[0]), MO_JOB_PAUSED);
  CHECK(AWAIT(draws_for(ids[1], ids[2]) ||
              draws_for(ids[2], ids[1]))); /* one of them takes its place */
  for (int i = 1; i < 3; i++) {
    live = live_of(ids[i]);
    CHECK(live.phase == MO_PHASE_PREPARE && live.done >= done); /* not from the beginning */
  }
  CHECK_OK(mo_jobs_resume(service.jobs, ids[0])); /* it finds the drawing in progress */
  live = await_drawing(ids[0]);
  CHECK(live.done >= done && live.reason[0] != '\0');
  CHECK_OK(mo_jobs_cancel(service.jobs, ids[live_of(ids[1]).reason[0] == '\0' ? 1 : 2]));
  for (uint64_t before = done;; before = live.done) {
    live = live_of(ids[0]);
    if (live.phase != MO_PHASE_PREPARE || live.total == 0)
      break;
    CHECK(live.done >= before);
    usleep(2000);
  }
  origin.excluded = excluded = forms_of(request.record.settings.workspace, LONGER_STEPS);
  CHECK(ends_as_plain(ids[0], &origin));
  CHECK((state_of(ids[1]) == MO_JOB_CANCELLED) != (state_of(ids[2]) == MO_JOB_CANCELLED));
  for (int i = 1; i < 3; i++)
    CHECK(state_of(ids[i]) == MO_JOB_CANCELLED || ends_as_plain(ids[i], &origin));
  (void)idle_stats();
  CHECK(exclusions() == NULL);
  CHECK_INT(warnings, 0);
  mo_form_set_free(excluded);
}

/* If no campaign waits for the drawing any more, it ends at once, as it does when the process
 * stops. */
static void draws_for_nobody(void)
{
  struct mo_campaign_request request;
  int64_t ids[2];
  REQUIRE_OK(start_drawing(ENDLESS, &request));
  for (int i = 0; i < 2; i++) {
    ids[i] = submit_campaign(&request);
    CHECK(await_drawing(ids[i]).done > 0);
  }
  double begin = now_s();
  CHECK_OK(mo_jobs_cancel(service.jobs, ids[0]));
  CHECK_OK(mo_jobs_pause(service.jobs, ids[1]));
  for (int i = 0; i < 2; i++)
    CHECK(await_phase(ids[i], MO_PHASE_IDLE));
  CHECK(exclusions() == NULL);
  CHECK_OK(mo_jobs_resume(service.jobs, ids[1])); /* drawn again */
  ids[0] = submit_campaign(&request);
  for (int i = 0; i < 2; i++)
    CHECK(await_drawing(ids[i]).done > 0);
  CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
  CHECK(is_soon_after(begin));
  for (int i = 0; i < 2; i++)
    CHECK_INT(state_of(ids[i]), MO_JOB_QUEUED);
  CHECK(exclusions() == NULL);
}

/* The remaining time covers the drawing, from its own rate, and then the generations, once there is
 * one after the first. */
__attribute__((unused)) static void reports_how_long_it_draws(void)
{
  struct mo_campaign_generation rows[SEEN];
  struct mo_campaign_request request;
  struct mo_event events[80];
  char steps[16];
  snprintf(steps, sizeof(steps), "%d", LONG_STEPS);
  REQUIRE_OK(start_drawing(steps, &request));
  request.record.settings.generations = LONG_GENERATIONS;
  fake_plan.delay_us = 10000;
  const double submitted = now_s();
  int64_t id = submit_campaign(&request);
  REQUIRE(await_phase(id, MO_PHASE_PREPARE));
  const double begin = now_s();
  struct mo_live live = await_drawing(id);
  REQUIRE(AWAIT(live_of(id).done >= live.total / 2)); /* half of it */
  /* Bounds on how long it has been drawing, however late this thread looks. */
  const double least = now_s() - begin;
  live = live_of(id);
  const double most = now_s() - submitted;
  REQUIRE(live.phase == MO_PHASE_PREPARE);
  const double rest = (double)(live.total - live.done) / (double)live.done;
  printf("# %.2f s left, %.2f to %.2f s by this clock\n", live.seconds_left, rest * least,
         rest * most);
  CHECK(live.seconds_left > 0.5 * rest * least);
  CHECK(live.seconds_left < 2 * rest * most + 0.1);
  const double drawing_s = await_drawn(id) - begin;
  CHECK(live_of(id).seconds_left < 0); /* the duration of generations is still unknown */
  REQUIRE(await_place(id, 2, MO_PHASE_SCORE));
  CHECK_OK(mo_jobs_pause(service.jobs, id));
  REQUIRE(await_phase(id, MO_PHASE_IDLE));
  int64_t n = mo_store_campaign_generations(store, id, -1, 1, rows, SEEN);
  REQUIRE(n >= 2 && n < SEEN);
  int64_t committed = n;
  CHECK(rows[0].seconds > drawing_s);
  CHECK(seconds_of(rows, committed) < now_s() - submitted); /* the drawing is counted once */
  /* The estimate in the first generation's event does not count the drawing again. */
  n = mo_store_events(store, 0, id, events, 80, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    if (strcmp(events[i].type, "campaign.generation") == 0 &&
        strstr(events[i].data, "\"generation\":0,") != NULL)
      CHECK(strtod(strstr(events[i].data, "seconds_left\":") + 14, NULL) <
            LONG_GENERATIONS * (rows[0].seconds - 0.9 * drawing_s));
  CHECK_OK(mo_jobs_resume(service.jobs, id));
  live = await_drawing(id);
  const double again = now_s();
  CHECK(live.done > 0 && live.seconds_left > (double)(LONG_GENERATIONS + 1 - committed) *
                                                 rows[committed - 1].seconds);
  const double again_s = await_drawn(id) - again;
  REQUIRE(
      await_place(id, (uint32_t)committed + 2,
                  MO_PHASE_SCORE)); /* a commit is written while the next generation is scored */
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
  REQUIRE(mo_store_campaign_generations(store, id, -1, 1, rows, SEEN) > committed);
  /* Drawing after the pause does not count toward any generation. */
  CHECK(seconds_of(rows, committed + 1) < now_s() - submitted - again_s);
}

/* ---- files ---- */

/* Returns the path of the only file in the folder "excluded". n: how many there are. */
static struct stat only_file(int *n, char path[PATH_MAX])
{
  struct stat status = {.st_ino = 0};
  char folder[PATH_MAX - 256];
  snprintf(folder, sizeof(folder), "%s/excluded", fixture.path);
  DIR *names = opendir(folder);
  const struct dirent *name;
  *n = 0;
  while (names != NULL && (name = readdir(names)) != NULL)
    if (name->d_name[0] != '.' || name->d_name[1] == 't') {
      snprintf(path, PATH_MAX, "%s/%s", folder, name->d_name);
      CHECK(stat(path, &status) == 0);
      ++*n;
    }
  if (names != NULL)
    closedir(names);
  return status;
}

#define KEPT_STEPS "40"

static void start_kept(uint64_t most, struct mo_campaign_request *request, struct origin *origin)
{
  service.max_excluded_bytes = most;
  REQUIRE_OK(service_reopen());
  put_family(KEPT_STEPS);
  *request = campaign(MO_ZERO_SHOT);
  request->controller = "tuned";
  request->record.settings.workspace = (struct mo_workspace){3, 3, 2};
  *origin = origin_of(request);
}

/* A set is drawn once and then read from its file, also after a restart and for another controller
 * with the same lineage. A damaged file is redrawn, and the log says so. */
SERVICE_CASE(keeps_what_was_drawn, 2)
{
  static const struct timespec long_ago[2] = {{.tv_sec = 1000}, {.tv_sec = 1000}};
  struct mo_campaign_request request;
  struct origin origin;
  char path[PATH_MAX];
  int n;
  start_kept(1 << 20, &request, &origin);
  struct mo_form_set *excluded = forms_of(request.record.settings.workspace, 40);
  origin.excluded = excluded;
  const int64_t first = submit_campaign(&request), second = submit_campaign(&request);
  CHECK(ends_as_plain(first, &origin) && ends_as_plain(second, &origin));
  (void)idle_stats();
  const struct stat made = only_file(&n, path);
  CHECK_INT(n, 1);
  for (int life = 0; life < 3; life++) {
    CHECK(utimensat(AT_FDCWD, path, long_ago, 0) == 0);
    if (life == 1)
      CHECK_OK(service_reopen());
    if (life == 2)
      request.controller = "pretrained";
    CHECK(ends_as_plain(submit_campaign(&request), &origin));
    (void)idle_stats();
    const struct stat used = only_file(&n, path);
    CHECK(n == 1 && used.st_ino == made.st_ino && used.st_mtime > 1000); /* opened, not created */
  }
  CHECK_INT(warnings, 0);
  for (off_t size = made.st_size; size >= 0; size -= made.st_size / 2) {
    const int fd = open(path, O_RDWR);
    CHECK(pwrite(fd, "damage", 6, 20) == 6 && ftruncate(fd, size) == 0);
    close(fd);
    CHECK(ends_as_plain(submit_campaign(&request), &origin));
    (void)idle_stats();
    CHECK_INT(warnings, 1);
    CHECK(has_warned("damaged; redrawing them"));
    warnings = 0;
    CHECK(ends_as_plain(submit_campaign(&request), &origin));
    (void)idle_stats();
    CHECK_INT(warnings, 0);
    CHECK_INT(only_file(&n, path).st_size, made.st_size);
    CHECK_INT(n, 1);
  }
  mo_form_set_free(excluded);
}

/* Files beyond the budget are deleted, the least recently used first. A set above the budget is not
 * stored, and the log says so. */
SERVICE_CASE(keeps_to_a_budget, 1)
{
  struct mo_campaign_request request;
  struct origin origin;
  char path[PATH_MAX];
  int n;
  start_kept(1 << 20, &request, &origin);
  CHECK(submit_campaign(&request) > 0);
  (void)idle_stats();
  const struct stat first = only_file(&n, path);
  const uint64_t one = (uint64_t)first.st_size;
  struct stat status;
  char other[PATH_MAX];
  CHECK_INT(n, 1);
  service.max_excluded_bytes = 2 * one + one / 2;
  CHECK_OK(service_reopen());
  for (int i = 0; i < 4; i++) {
    static const char *const steps[] = {"41", KEPT_STEPS, "42", "43"};
    put_family(steps[i]);
    CHECK(succeeds(submit_campaign(&request), NULL));
    (void)idle_stats();
    (void)only_file(&n, other);
    CHECK_INT(n, 2);
    CHECK_INT(stat(path, &status) == 0 && status.st_ino == first.st_ino, i < 3);
  }
  CHECK_INT(warnings, 0);
  for (int life = 0; life < 2; life++) { /* above the budget: nothing is stored */
    service.max_excluded_bytes = life == 0 ? one / 2 : 0;
    CHECK_OK(service_reopen());
    CHECK(succeeds(submit_campaign(&request), NULL));
    (void)idle_stats();
    (void)only_file(&n, path);
    CHECK_INT(n, 0);
    CHECK_INT(warnings, 1);
    CHECK(has_warned("max_excluded"));
  }
}

/* A file is deleted with its controller; so are files that a killed process left. If the folder is
 * not writable, the only effect is that nothing is stored. */
SERVICE_CASE(gives_files_up, 1)
{
  struct mo_campaign_request request;
  struct origin origin;
  char path[PATH_MAX], left[PATH_MAX];
  int n;
  start_kept(1 << 20, &request, &origin);
  request.controller = "pretrained";
  CHECK(succeeds(submit_campaign(&request), NULL));
  (void)idle_stats();
  (void)only_file(&n, path);
  snprintf(left, sizeof(left), "%.*s/.tmp-7", (int)(strrchr(path, '/') - path), path);
  close(open(left, O_WRONLY | O_CREAT, 0600));
  CHECK_OK(service_reopen());
  (void)only_file(&n, path);
  CHECK_INT(n, 1);
  CHECK_INT(mo_store_orphans(store)->n, 0);
  service_close();
  rename(path, left); /* as for a deleted controller */
  char *digits = strrchr(path, '/') + 1;
  memset(digits, digits[0] == 'a' ? 'b' : 'a', 4);
  rename(left, path);
  CHECK_OK(service_open());
  (void)only_file(&n, path);
  CHECK_INT(n, 0);
  snprintf(left, sizeof(left), "%s/excluded", fixture.path);
  CHECK(rmdir(left) == 0);
  close(open(left, O_WRONLY | O_CREAT, 0600)); /* the folder cannot be created there */
  request.controller = "tuned";
  CHECK(succeeds(submit_campaign(&request), NULL));
  (void)idle_stats();
  CHECK(has_warned("cannot be kept in the state folder"));
  unlink(left);
}

static const struct check_case cases[] = {
    {"hands over the drawing", hands_the_drawing_over},
    {"stops drawing if no campaign waits", draws_for_nobody},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"reports how long it draws", reports_how_long_it_draws},
    {"excludes the bodies of a pretraining run", leaves_out_what_was_learned_from},
    {"reports unreadable lineages", reports_what_cannot_be_read},
    {"reports long lineages", reports_long_lineages},
    {"excludes what it can read", leaves_out_what_can_be_read},
    {"stores what was drawn", keeps_what_was_drawn},
    {"keeps to a budget", keeps_to_a_budget},
    {"deletes files with their controllers", gives_files_up},
#endif
};
CHECK_MAIN(cases)
