/* races.c: whole campaigns, with and without races, on a disk that loses power: the same
 * populations, births, deaths and controllers, bit for bit, for any number of workers.
 *
 * Plain loops compute a campaign in which every child is scored completely, and one in which
 * children race. The two must agree in everything except the scores of children that were cut
 * short, and after the power cuts the store must hold the second one. tests/crash does the same to
 * the daemon, with kills and real robots. MORPHO_RACE_SEEDS: how many seeds (default 3). */
#include "../store/disk.h"
#include "fakes.h"

enum { CUTS_MAX = 2 };

static struct {
  unsigned cuts, stops, cut, whole; /* number of cuts while the campaign was working */
} seen;

/* A mode, and how losses become scores, as one number. */
#define BY(mode, aggregate) ((mode) + 16 * (int)(aggregate))

/* Like the presets but small: the more designs, the fewer of their children survive. */
static struct mo_campaign_request request_of(int by, uint32_t seed, bool is_large)
{
  const int mode = by % 16;
  struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
  struct mo_campaign_settings *settings = &request.record.settings;
  settings->population = is_large ? HISTORY_POPULATION : POPULATION;
  settings->generations = is_large ? 7 : 5;
  settings->seed = seed;
  settings->aggregate = (struct mo_aggregate){(enum mo_aggregate_kind)(by / 16), 0.95, 1};
  if (mode != MO_ZERO_SHOT)
    settings->parent_steps = settings->child_steps = 1;
  request.record.checkpoint_every_s = 0;
  request.job.key.text = "one campaign";
  return request;
}

/* ---- with and without races ---- */

/* Copies what a race may change from the campaign without races; everything else must be equal. */
static void check_same_lives(const struct history *raced, const struct history *whole)
{
  struct history *same = malloc(sizeof(*same));
  *same = *raced;
  for (uint32_t i = 0; i < same->n_designs; i++) {
    struct mo_campaign_design *one = &same->designs[i];
    if (one->score != whole->designs[i].score) /* also for children that diverged later */
      CHECK(one->score < whole->designs[i].score && one->died == one->born && one->born > 0);
    one->score = whole->designs[i].score;
    one->is_cut = false;
  }
  for (uint32_t g = 0; g < same->n_generations; g++) {
    struct mo_campaign_generation *one = &same->generations[g];
    const uint64_t all = whole->generations[g].rollouts;
    CHECK(one->rollouts < all || one->children_cut == 0);
    seen.cut += one->children_cut;
    seen.whole += g > 0 && one->rollouts == all;
    one->rollouts = all;
    one->children_cut = 0;
  }
  CHECK(same_history(same, whole));
  free(same);
}

/* ---- power cuts ---- */

/* Opens the service on the disk and runs the campaign until it has ended or everything stops. */
static bool live(struct disk *disk, const struct mo_campaign_request *request, long stop_after)
{
  static const uint32_t workers[] = {1, 2, 7};
  int64_t id = 0;
  bool replayed;
  snprintf(fixture.path, sizeof(fixture.path), "%s", disk_folder(disk));
  service.vfs = disk_vfs(disk);
  service.files = disk_files(disk);
  service.n_workers = workers[disk_random(disk) % COUNT(workers)];
  fake_plan.delay_us = 50; /* so that a cut hits blocks in flight */
  CHECK_OK(service_open());
  if (service.jobs == NULL)
    return true;
  disk_stop_after(disk, stop_after);
  const int error = mo_jobs_submit_campaign(service.jobs, request, &id, &replayed, NULL);
  CHECK(error == MO_OK || disk_has_stopped(disk));
  CHECK(error != MO_OK ||
        AWAIT(mo_job_state_is_final(status_of(id).job.state) || disk_has_stopped(disk)));
  seen.stops += disk_has_stopped(disk) && error == MO_OK;
  return !disk_has_stopped(disk);
}

static void check_on_disk(const struct mo_campaign_request *request, const struct history *expected)
{
  struct disk *disk = disk_new(request->record.settings.seed, DISK_HONEST);
  char folder[sizeof(fixture.path)];
  REQUIRE(disk != NULL);
  REQUIRE_OK(service_begin());
  memcpy(folder, fixture.path, sizeof(folder));
  for (int cut = 0;; cut++) {
    const long changes = cut < CUTS_MAX ? 1 + (long)(disk_random(disk) % 300) : 0;
    if (live(disk, request, changes))
      break;
    service_close();
    REQUIRE(disk_cut(disk, DISK_ANY) == 0);
    seen.cuts++;
  }
  CHECK_INT(state_of(1), MO_JOB_SUCCEEDED);
  CHECK(is_history(1, expected));
  CHECK_OK(check_whole());
  service_close();
  memcpy(fixture.path, folder, sizeof(folder));
  disk_free(disk);
}

/* ---- the cases ---- */

static void same_campaigns(int by)
{
  const char *text = getenv("MORPHO_RACE_SEEDS");
  const uint32_t n_seeds = text != NULL ? (uint32_t)strtoul(text, NULL, 10) : 3;
  memset(&seen, 0, sizeof(seen));
  for (uint32_t seed = 1; seed <= n_seeds; seed++)
    for (int is_large = 0; is_large < 2; is_large++) {
      const struct mo_campaign_request request = request_of(by, seed, is_large > 0);
      struct origin origin = origin_of(&request);
      struct history *raced = plain_history(&fake_plain, &origin);
      origin.settings.racing = MO_RACING_OFF;
      struct history *whole = plain_history(&fake_plain, &origin);
      check_same_lives(raced, whole);
      check_on_disk(&request, raced);
      free(raced);
      free(whole);
    }
  printf("# %u children cut short, %u generations whole; %u cuts, %u of them at work\n", seen.cut,
         seen.whole, seen.cuts, seen.stops);
  CHECK(seen.cut > 0 && seen.whole > 0 && seen.stops > seen.cuts / 2);
}

static const struct check_case cases[] = {
    {"zero-shot: the same campaign", WITH(same_campaigns, MO_ZERO_SHOT)},
    {"few-shot: the same campaign", WITH(same_campaigns, MO_FEW_SHOT)},
    {"simultaneous: the same campaign", WITH(same_campaigns, MO_SIMULTANEOUS)},
    {"zero-shot by quantiles", WITH(same_campaigns, BY(MO_ZERO_SHOT, MO_AGGREGATE_QUANTILE))},
    {"few-shot by cvar", WITH(same_campaigns, BY(MO_FEW_SHOT, MO_AGGREGATE_CVAR))},
};
CHECK_MAIN(cases)
