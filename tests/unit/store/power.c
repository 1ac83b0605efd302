/* power.c: the power fails at any moment, again and again. What was acknowledged is there
 * afterwards, bit for bit; of what was in flight nothing or all.
 *
 * A folder lives through several cuts: in the middle of its work, while it is idle, while it is
 * opened, in a row. Between some of them the process alone is killed, and the next one goes on with
 * what the machine has in its memory. After each the store is opened, checked and compared with
 * what it had promised, and works on. A disk that only says that it has synced is found out. */
#include "../check.h"
#include "fixture.h"
#include "life.h"
#include "store/internal.h"

enum { CUTS_OF_A_LIFE = 5, ACTS_MAX = 60 };

struct outcome {
  unsigned cuts, in_openings, in_closings, idle, kills, doubts, came_through, findings,
      acts[ACT_KINDS];
  char first[400];
};

static void open_store(struct life *life, int *error, struct mo_message *message)
{
  struct mo_store_config config = {.path = disk_folder(life->disk),
                                   .vfs = disk_vfs(life->disk),
                                   .files = disk_files(life->disk),
                                   .n_readers = 1,
                                   .checkpoint_frames = 200};
  life->store = NULL;
  *error = mo_store_open(&config, &life->store, message);
  if (*error == MO_OK && life->store->epoch <= life->model.epoch)
    life_found(life, "opening %lld came after %lld", (long long)life->store->epoch,
               (long long)life->model.epoch);
  if (*error == MO_OK)
    life->model.epoch = life->store->epoch;
}

/* What was in doubt has come through as far as can be told now: `doing` keeps the parts that have
 * not. */
static void resolve(struct life *life, struct outcome *outcome)
{
  const uint32_t n = life->in_doubt ? life->doing.parts : 0;
  char text[300], last[300];
  struct mo_message message;
  if (mo_store_check(life->store, &message) != MO_OK) {
    life_found(life, "%s", message.text);
    return;
  }
  outcome->doubts += life->in_doubt;
  life->in_doubt = false;
  for (uint32_t parts = n + 1; parts-- > 0;) {
    struct model model = life->model;
    life_apply(&model, &life->doing, parts);
    if (life_matches(life, &model, text)) {
      life->model = model;
      life->doing.parts -= n > 0 ? parts : 0;
      outcome->came_through += parts > 0;
      return;
    }
    if (parts == n)
      snprintf(last, sizeof(last), "%s", text);
  }
  life_found(life, "%s (with act %d of %u parts in doubt: %s)", text,
             n > 0 ? (int)life->doing.kind : -1, (unsigned)n, last);
}

/* One act; false: everything stopped, or something is wrong. */
static bool act_once(struct life *life, struct act act)
{
  uint32_t done;
  int error = MO_OK;
  life->doing = act;
  life->in_doubt = true;
  life->acts[act.kind]++;
  done = life_do(life, &act, &error);
  life_settle(life);
  life_apply(&life->model, &act, done);
  life->doing.parts -= done;
  if (act.kind == ACT_SAVE)
    life->doing.n -= done;
  if (life->doing.parts == 0)
    life->in_doubt = false;
  if (error != MO_OK && !disk_has_stopped(life->disk))
    life_found(life, "act %d: error %d on a disk that works", (int)act.kind, error);
  return error == MO_OK && !disk_has_stopped(life->disk) && life->findings == 0;
}

/* Until everything stops, or for some acts. goes_well: it does not stop. */
static void work(struct life *life, bool goes_well)
{
  const long changes = 1 + (long)(disk_random(life->disk) % 800);
  int n = goes_well ? (int)(disk_random(life->disk) % ACTS_MAX) : ACTS_MAX;
  if (!goes_well && disk_random(life->disk) % 2 == 0)
    disk_stop_at_sync(life->disk, changes);
  else if (!goes_well)
    disk_stop_after(life->disk, changes);
  if (!act_once(life, (struct act){.kind = ACT_REQUEUE, .parts = 1}))
    return;
  while (n-- > 0 && act_once(life, life_choose(life)))
    ;
}

/* Opens, checks, works, stops. Returns whether a cut (not a kill) came. */
static bool live_once(struct life *life, struct outcome *outcome)
{
  struct mo_message message;
  const uint64_t how = disk_random(life->disk) % 8;
  const bool kill = how == 0, opening = how == 1 || how == 2, idle = how == 3, closing = how == 4;
  int error;
  if (opening)
    disk_stop_after(life->disk, 1 + (long)(disk_random(life->disk) % 40));
  open_store(life, &error, &message);
  if (error != MO_OK && !disk_has_stopped(life->disk)) {
    life_found(life, "opening: %s", message.text);
    return true;
  }
  if (error == MO_OK && !disk_has_stopped(life->disk)) {
    disk_stop_after(life->disk, 0);
    resolve(life, outcome);
    if (life->findings == 0)
      work(life, idle || closing);
    if (idle)
      disk_stop(life->disk);
    if (closing)
      disk_stop_after(life->disk, 1 + (long)(disk_random(life->disk) % 60));
    outcome->idle += idle;
    outcome->in_closings += closing;
  } else {
    outcome->in_openings++;
  }
  mo_store_close(life->store);
  life->store = NULL;
  if (kill)
    disk_go_on(life->disk);
  else if (disk_cut(life->disk, DISK_ANY) != 0)
    life_found(life, "the disk cannot be made");
  outcome->kills += kill;
  outcome->cuts += !kill;
  return !kill;
}

static void start(struct life *life, uint64_t seed, unsigned lies, struct mo_bits *forms,
                  struct mo_bits *genotypes)
{
  *life = (struct life){.disk = disk_new(seed, lies), .forms = forms, .genotypes = genotypes};
  for (int i = 0; i < NAMES; i++)
    life->model.names[i].content = -1;
}

static void live(uint64_t seed, unsigned lies, struct mo_bits *forms, struct mo_bits *genotypes,
                 struct outcome *outcome)
{
  static struct life life;
  struct mo_message message;
  int error;
  start(&life, seed, lies, forms, genotypes);
  REQUIRE(life.disk != NULL);
  for (int n = 0; n < CUTS_OF_A_LIFE && life.findings == 0;)
    n += live_once(&life, outcome);
  if (life.findings == 0) { /* the last one, too, left something that opens */
    open_store(&life, &error, &message);
    if (error == MO_OK)
      resolve(&life, outcome);
    else
      life_found(&life, "opening at the end: %s", message.text);
    mo_store_close(life.store);
  }
  disk_free(life.disk);
  for (int i = 0; i < ACT_KINDS; i++)
    outcome->acts[i] += life.acts[i];
  if (life.findings > 0 && outcome->findings++ == 0)
    snprintf(outcome->first, sizeof(outcome->first), "seed %llu: %.300s", (unsigned long long)seed,
             life.first);
}

static void live_many(uint64_t seed, unsigned lies, unsigned cuts, struct outcome *outcome)
{
  struct mo_bits *forms = NULL, *genotypes = NULL;
  *outcome = (struct outcome){0};
  REQUIRE(fixture_bodies(7, BODIES, &forms, &genotypes) == MO_OK);
  while (outcome->cuts < cuts && (lies == DISK_HONEST || outcome->findings == 0))
    live(seed++, lies, forms, genotypes, outcome);
  free(forms);
  free(genotypes);
}

static void keeps_promises(unsigned cuts)
{
  const char *given = getenv("MORPHO_POWER_SEED");
  struct outcome outcome;
  live_many(given != NULL ? strtoull(given, NULL, 10) : 1, DISK_HONEST, cuts, &outcome);
  printf("# %u cuts (%u while opening, %u while closing, %u while idle), %u kills; of %u acts in "
         "doubt %u came through\n",
         outcome.cuts, outcome.in_openings, outcome.in_closings, outcome.idle, outcome.kills,
         outcome.doubts, outcome.came_through);
  for (int i = 0; i < ACT_KINDS; i++)
    CHECK(outcome.acts[i] > 0);
  CHECK(outcome.in_openings > 0 && outcome.in_closings > 0 && outcome.idle > 0 &&
        outcome.kills > 0);
  CHECK(outcome.came_through > 0 && outcome.came_through < outcome.doubts);
  CHECK_INT(outcome.findings, 0);
  if (outcome.findings > 0)
    printf("# %s\n", outcome.first);
}

static void keeps_promises_50(void)
{
  keeps_promises(50);
}

static void keeps_promises_500(void)
{
  keeps_promises(500);
}

static void is_found_out(unsigned lies)
{
  struct outcome outcome;
  live_many(1, lies, 100, &outcome);
  CHECK(outcome.findings > 0);
  printf("# after %u cuts: %s\n", outcome.cuts, outcome.first);
}

static void needs_syncs_of_the_database(void)
{
  is_found_out(DISK_FORGETS_DATABASE);
}

static void needs_syncs_of_files(void)
{
  is_found_out(DISK_FORGETS_FILES);
}

static void needs_syncs_of_folders(void)
{
  is_found_out(DISK_FORGETS_FOLDERS);
}

/* ---- at every change in turn ---- */

static const struct act script[] = {
    {ACT_PUT, 0, 9, 0, 1},
    {ACT_TRAIN, 0, 21, 0, 1},
    {ACT_TRAIN_START, 0, 0, 0, 1},
    {ACT_TRAIN_PROGRESS, 0, 3, 7, 1},
    {ACT_TRAIN_CHECKPOINT, 0, 0, 1,
     1}, /* changes are counted from here on, or from the first opening on */
    {ACT_PUT, 1, 10, 0, 1},
    {ACT_SUBMIT, 0, 1, 0, 1},
    {ACT_SAVE, 0, 0, 2, 2},
    {ACT_TRAIN_PROGRESS, 0, 3, 7, 1},
    {ACT_TRAIN_CHECKPOINT, 0, 0, 1, 1},
    {ACT_TRAIN_FINISH, 0, 17, 0, 1},
    {ACT_CAMPAIGN, 0, 22, 0, 1}, /* one that learns */
    {ACT_CAMPAIGN_START, 0, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 0, 0, 0, 1},
    {ACT_CAMPAIGN_LOSSES, 0, 0, 3, 1},
    {ACT_CAMPAIGN_CHECKPOINT, 0, 0, 2, 1},
    {ACT_CAMPAIGN_GENERATION, 0, 0, 0, 1},
    {ACT_CAMPAIGN_FINISH, 0, 18, 0, 1},
    {ACT_CAMPAIGN, 1, 23, 0, 1}, /* one that does not */
    {ACT_CAMPAIGN_START, 1, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 1, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 1, 0, 0, 1},
};
enum { SCRIPT = sizeof(script) / sizeof(script[0]), COUNTED_FROM = 4 };

/* What was requeued is started again; a training from its checkpoint, so that it has perhaps
 * nothing to write yet. */
static bool prepare(struct life *life, enum act_kind kind, int index)
{
  const struct training_model *training = &life->model.trainings[0];
  bool goes_on = true;
  if (kind > ACT_CAMPAIGN_START && life->model.campaigns[index].state == MO_JOB_QUEUED)
    return act_once(life, (struct act){.kind = ACT_CAMPAIGN_START, .index = index, .parts = 1});
  if (kind <= ACT_TRAIN_START || kind > ACT_TRAIN_FINISH)
    return true;
  if (training->state == MO_JOB_QUEUED)
    goes_on = act_once(life, (struct act){.kind = ACT_TRAIN_START, .parts = 1});
  if (goes_on && kind == ACT_TRAIN_CHECKPOINT && training->position == 0)
    goes_on = act_once(life, (struct act){.kind = ACT_TRAIN_PROGRESS, .n = 7, .parts = 1});
  return goes_on;
}

/* The script from its act `from` on, up to `end`; returns the first that is not done. */
static int play(struct life *life, int from, int end, long stop_after)
{
  struct act act;
  if (!act_once(life, (struct act){.kind = ACT_REQUEUE, .parts = 1}))
    return from;
  for (; from < end; from++) {
    if (from == COUNTED_FROM && stop_after > 0)
      disk_stop_after(life->disk, stop_after);
    act = script[from];
    if (act.kind == ACT_SAVE) /* the part of it that is not done */
      act.n = act.parts = act.n - life->model.evaluations[0].saved;
    if (!prepare(life, act.kind, act.index) || !act_once(life, act))
      break;
  }
  return from;
}

static void stop_and_reopen(struct life *life, bool kill, enum disk_luck luck,
                            struct outcome *outcome)
{
  struct mo_message message;
  int error = MO_OK;
  disk_stop(life->disk);
  mo_store_close(life->store);
  life->store = NULL;
  if (kill)
    disk_go_on(life->disk);
  else if (disk_cut(life->disk, luck) != 0)
    life_found(life, "the disk cannot be made");
  open_store(life, &error, &message);
  if (error != MO_OK)
    life_found(life, "opening: %s", message.text);
  else
    resolve(life, outcome);
}

struct stops {
  bool opening, kill;
  enum disk_luck luck;
};

/* Stopped at change `n` of the script or of the first opening: by a kill or a cut; then what is
 * left of the script, and the worst cut. Returns whether there was such a change. */
static bool stop_at(long n, const struct stops *stops, int end, struct mo_bits *forms,
                    struct mo_bits *genotypes, struct outcome *outcome)
{
  static struct life life;
  struct mo_message message;
  bool stopped;
  int next = 0, error = MO_OK;
  start(&life, (uint64_t)n, DISK_HONEST, forms, genotypes);
  if (life.disk == NULL)
    return false;
  if (stops->opening)
    disk_stop_after(life.disk, n);
  open_store(&life, &error, &message);
  if (error != MO_OK && !disk_has_stopped(life.disk))
    life_found(&life, "opening: %s", message.text);
  if (!stops->opening && error == MO_OK)
    next = play(&life, 0, end, n);
  stopped = disk_has_stopped(life.disk);
  if (life.findings == 0)
    stop_and_reopen(&life, stops->kill, stops->luck, outcome);
  if (next < end && life.doing.kind == script[next].kind &&
      life.doing.index == script[next].index && life.doing.parts == 0)
    next += !stops->opening;
  if (life.findings == 0 && play(&life, next, end, 0) < end)
    life_found(&life, "the script does not go on after act %d", next);
  if (life.findings == 0)
    stop_and_reopen(&life, false, DISK_WORST, outcome);
  mo_store_close(life.store);
  disk_free(life.disk);
  outcome->cuts += 2 - stops->kill;
  outcome->kills += stops->kill;
  if (life.findings > 0 && outcome->findings++ == 0)
    snprintf(outcome->first, sizeof(outcome->first), "change %ld: %.300s", n, life.first);
  return stopped;
}

/* At every `stride`th change of the script up to its act `end`. */
static void stops_everywhere(const struct stops *stops, long stride, int end)
{
  struct mo_bits *forms = NULL, *genotypes = NULL;
  struct outcome outcome = {0};
  long n = 1, tried = 0;
  REQUIRE(fixture_bodies(7, BODIES, &forms, &genotypes) == MO_OK);
  for (; stop_at(n, stops, end, forms, genotypes, &outcome); n += stride)
    tried++;
  printf("# %ld of about %ld changes; of %u acts in doubt %u came through\n", tried, n - 1,
         outcome.doubts, outcome.came_through);
  CHECK(n > 30);
  CHECK_INT(outcome.findings, 0);
  if (outcome.findings > 0)
    printf("# %s\n", outcome.first);
  free(forms);
  free(genotypes);
}

/* A name that the killed process has made is not certain because the next one sees it. */
static const struct stops kills = {.kill = true}, worst_cuts = {.luck = DISK_WORST},
                          any_cuts = {.luck = DISK_ANY}, openings = {.opening = true};

static void survives_kills(void)
{
  stops_everywhere(&kills, 1, COUNTED_FROM + 2);
}

static void survives_the_worst_cuts(void)
{
  stops_everywhere(&worst_cuts, 11, SCRIPT);
}

static void survives_any_cuts(void)
{
  stops_everywhere(&any_cuts, 11, SCRIPT);
}

static void survives_cuts_of_an_opening(void)
{
  stops_everywhere(&openings, 5, SCRIPT);
}

/* An act that finds no descriptor for one of its files or folders is asked for again, and then
 * certain. */
static void certain_at_the_second_try(void)
{
  static struct life life;
  struct outcome outcome = {0};
  struct mo_bits *forms = NULL, *genotypes = NULL;
  struct mo_message message;
  bool lacked = true;
  int error = MO_OK;
  REQUIRE(fixture_bodies(7, BODIES, &forms, &genotypes) == MO_OK);
  for (long n = 1; lacked && n < 100; n++) {
    lacked = false;
    start(&life, (uint64_t)n, DISK_HONEST, forms, genotypes);
    REQUIRE(life.disk != NULL);
    open_store(&life, &error, &message);
    CHECK_INT(error, MO_OK);
    CHECK_INT(play(&life, 0, COUNTED_FROM, 0), COUNTED_FROM);
    for (int i = COUNTED_FROM; i < COUNTED_FROM + 2; i++) { /* a checkpoint, a controller */
      disk_lack_descriptor(life.disk, n);
      error = MO_OK;
      life_apply(&life.model, &script[i], life_do(&life, &script[i], &error));
      lacked = lacked || disk_has_failed(life.disk);
      disk_lack_descriptor(life.disk, 0);
      CHECK(error == MO_OK || error == MO_ERR_NO_MEMORY);
      if (error != MO_OK)
        CHECK(act_once(&life, script[i]));
    }
    stop_and_reopen(&life, false, DISK_WORST, &outcome);
    CHECK_INT(life.findings, 0);
    if (life.findings > 0)
      printf("# descriptor %ld: %s\n", n, life.first);
    mo_store_close(life.store);
    disk_free(life.disk);
  }
  CHECK(!lacked);
  free(forms);
  free(genotypes);
}

static void survives_all(void)
{
  stops_everywhere(&kills, 1, SCRIPT);
  stops_everywhere(&worst_cuts, 1, SCRIPT);
  stops_everywhere(&any_cuts, 1, SCRIPT);
  stops_everywhere(&openings, 1, SCRIPT);
}

static const struct check_case cases[] = {
    {"short: keeps its promises through 50 power cuts", keeps_promises_50},
    {"short: a disk that does not sync the database is found out", needs_syncs_of_the_database},
    {"short: a disk that does not sync files is found out", needs_syncs_of_files},
    {"short: a disk that does not sync folders is found out", needs_syncs_of_folders},
    {"short: a kill at every change of some acts, and a cut later", survives_kills},
    {"short: a cut at many changes leaves only what is certain", survives_the_worst_cuts},
    {"short: a cut at many changes leaves anything", survives_any_cuts},
    {"short: a cut at many changes of the first opening", survives_cuts_of_an_opening},
    {"short: what found no descriptor is certain at the second try", certain_at_the_second_try},
    {"long: keeps its promises through 500 power cuts", keeps_promises_500},
    {"long: a kill or cut at every change", survives_all},
};
CHECK_MAIN(cases)
