/* power.c: the power fails at any moment, over and over. Afterward everything that was acknowledged
 * is there, bit for bit; what was in flight is either complete or absent.
 *
 * A folder survives several cuts: during work, while idle, while being opened, several in a row.
 * Between some cuts only the process is killed, and the next process continues with what the
 * machine has in memory. After each stop the store is opened, checked and compared with its
 * promises, and continues working. A disk that lies about syncing is detected. */
#include "../check.h"
#include "fixture.h"
#include "life.h"
#include "store/internal.h"

static struct mo_bits *forms, *genotypes; /* (BODIES) */

static void draw_bodies(void)
{
  genotypes = make_bodies(7, BODIES, &forms);
}

enum { CUTS_OF_A_LIFE = 5, ACTS_MAX = 60 };

struct outcome {
  unsigned cuts, in_openings, in_closings, idle, kills, doubts, came_through, findings,
      acts[ACT_KINDS];
  char first[400];
};

static void open_store(struct life *life, int *error, struct mo_message *message)
{
  *error = life_open(life, 200, message);
  if (*error == MO_OK && life->store->epoch <= life->epoch)
    life_found(life, "opening %lld came after %lld", (long long)life->store->epoch, life->epoch);
  if (*error == MO_OK)
    life->epoch = life->store->epoch;
}

/* Resolves what was in doubt as far as possible now: `doing` keeps the parts that were not
 * stored. */
static void resolve(struct life *life, struct outcome *outcome)
{
  const uint32_t doubted = life->in_doubt ? life->doing.parts : 0;
  char text[MATCH_TEXT];
  struct mo_message message;
  if (mo_store_check(life->store, &message) != MO_OK) {
    life_found(life, "%s", message.text);
    return;
  }
  outcome->doubts += life->in_doubt;
  life->in_doubt = false;
  for (uint32_t parts = 0; !life_matches(life, text); parts++) {
    if (parts == doubted || life->findings > 0) {
      life_found(life, "%s (act %d, %u parts in doubt)", text, (int)life->doing.kind, doubted);
      return;
    }
    outcome->came_through += parts == 0;
    life_apply(life, &life->doing, 1);
  }
  life_follow(life);
}

static void close_life(struct life *life)
{
  life->was_stopped = life->was_stopped || disk_has_stopped(life->disk);
  mo_store_close(life->store);
  life->store = NULL;
}

/* Performs one act. Returns false if everything stopped or something is wrong. */
static bool act_once(struct life *life, struct act act)
{
  int error = MO_OK;
  life->doing = act;
  life->in_doubt = true;
  life->acts[act.kind]++;
  uint32_t done = life_do(life, life->store, &act, &error);
  life_wait_for_writer(life->store);
  life_apply(life, &life->doing, done);
  life->in_doubt = life->doing.parts > 0;
  if (error != MO_OK && !disk_has_stopped(life->disk) && !disk_has_failed(life->disk))
    life_found(life, "act %d: error %d on a disk that works", (int)act.kind, error);
  return error == MO_OK && !disk_has_stopped(life->disk) && life->findings == 0;
}

/* Performs acts until everything stops, or a few. goes_well: no stop is planned. */
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

/* Opens, checks, works and stops. Returns whether a cut (not a kill) occurred. */
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
  close_life(life);
  if (kill)
    disk_go_on(life->disk);
  else if (disk_cut(life->disk, DISK_ANY) != 0)
    life_found(life, "the disk cannot be made");
  outcome->kills += kill;
  outcome->cuts += !kill;
  return !kill;
}

static void live(uint64_t seed, unsigned lies, struct outcome *outcome)
{
  static struct life life;
  struct mo_message message;
  int error;
  REQUIRE_OK(life_start(&life, seed, lies, forms, genotypes));
  for (int n = 0; n < CUTS_OF_A_LIFE && life.findings == 0;)
    n += live_once(&life, outcome);
  if (life.findings == 0) { /* the state after the last stop can be opened, too */
    open_store(&life, &error, &message);
    if (error == MO_OK)
      resolve(&life, outcome);
    else
      life_found(&life, "opening at the end: %s", message.text);
  }
  life_end(&life);
  for (int i = 0; i < ACT_KINDS; i++)
    outcome->acts[i] += life.acts[i];
  if (life.findings > 0 && outcome->findings++ == 0)
    snprintf(outcome->first, sizeof(outcome->first), "seed %llu: %.300s", (unsigned long long)seed,
             life.first);
}

static bool has_all_acts(const struct outcome *outcome)
{
  for (int i = 0; i < ACT_KINDS; i++)
    if (outcome->acts[i] == 0)
      return false;
  return true;
}

/* Honest disks get more cuts, at most twice as many, until every kind of act has been done. */
static void live_many(uint64_t seed, unsigned lies, unsigned cuts, struct outcome *outcome)
{
  *outcome = (struct outcome){0};
  while (lies == DISK_HONEST
             ? outcome->cuts < cuts || (outcome->cuts < 2 * cuts && !has_all_acts(outcome))
             : outcome->cuts < cuts && outcome->findings == 0)
    live(seed++, lies, outcome);
}

static void keeps_promises(int cuts)
{
  const char *given = getenv("MORPHO_POWER_SEED");
  struct outcome outcome;
  live_many(given != NULL ? strtoull(given, NULL, 10) : 1, DISK_HONEST, (unsigned)cuts, &outcome);
  printf("# %u cuts (%u while opening, %u while closing, %u while idle), %u kills; of %u acts in "
         "doubt %u came through\n",
         outcome.cuts, outcome.in_openings, outcome.in_closings, outcome.idle, outcome.kills,
         outcome.doubts, outcome.came_through);
  for (int i = 0; i < ACT_KINDS; i++) {
    CHECK(outcome.acts[i] > 0);
    if (outcome.acts[i] == 0)
      printf("# no act of kind %d\n", i);
  }
  CHECK(outcome.in_openings > 0 && outcome.in_closings > 0 && outcome.idle > 0 &&
        outcome.kills > 0);
  CHECK(outcome.came_through > 0 && outcome.came_through < outcome.doubts);
  CHECK_INT(outcome.findings, 0);
  if (outcome.findings > 0)
    printf("# %s\n", outcome.first);
}

static void is_found_out(int lies)
{
  struct outcome outcome;
  live_many(1, (unsigned)lies, 100, &outcome);
  CHECK(outcome.findings > 0);
  printf("# after %u cuts: %s\n", outcome.cuts, outcome.first);
}

/* ---- at every change in turn ---- */

/* Restarts requeued jobs. A training run restarts from its checkpoint, so it may have nothing to
 * write yet. */
static bool prepare(struct life *life, enum act_kind kind, int index)
{
  const struct subject *training = &life->jobs[MO_JOB_TRAINING][0];
  bool goes_on = true;
  if (kind > ACT_CAMPAIGN_START && life->jobs[MO_JOB_CAMPAIGN][index].state == MO_JOB_QUEUED)
    return act_once(life, (struct act){.kind = ACT_CAMPAIGN_START, .index = index, .parts = 1});
  if (kind <= ACT_TRAIN_START || kind > ACT_TRAIN_FINISH)
    return true;
  if (training->state == MO_JOB_QUEUED)
    goes_on = act_once(life, (struct act){.kind = ACT_TRAIN_START, .parts = 1});
  if (goes_on && kind == ACT_TRAIN_CHECKPOINT && training->done == 0)
    goes_on = act_once(life, (struct act){.kind = ACT_TRAIN_PROGRESS, .n = 7, .parts = 1});
  return goes_on;
}

/* How and where to stop the script: at change `first` and every `stride`th after it, up to act
 * `end`. */
struct stops {
  bool opening, kill;
  bool fails; /* one call fails, and so does the store; the disk keeps working */
  enum disk_luck luck;
  long first, stride;
  int end;
};
enum { KILLS, WORST_CUTS, ANY_CUTS, OPENINGS, FAILURES };
static const struct stops all_stops[] = {
    /* A name that the killed process created is not durable just because the next process sees
     * it. */
    [KILLS] = {.kill = true, .first = 1, .stride = 1, .end = COUNTED_FROM + 2},
    /* Together at every 11th change, in turn with the two kinds of luck. */
    [WORST_CUTS] = {.luck = DISK_WORST, .first = 1, .stride = 22, .end = SCRIPT},
    [ANY_CUTS] = {.luck = DISK_ANY, .first = 12, .stride = 22, .end = SCRIPT},
    /* What an opening leaves behind matters to the first acts. */
    [OPENINGS] = {.opening = true, .first = 1, .stride = 5, .end = COUNTED_FROM + 4},
    [FAILURES] = {.fails = true, .kill = true, .first = 1, .stride = 13, .end = SCRIPT},
};

/* Runs the script from act `from` up to `end`; returns the first act that was not done. stops
 * (nullable): stops at change or call `n`. */
static int play(struct life *life, int from, int end, const struct stops *stops, long n)
{
  struct act act;
  if (!act_once(life, (struct act){.kind = ACT_REQUEUE, .parts = 1}))
    return from;
  for (; from < end; from++) {
    if (from == COUNTED_FROM && stops != NULL && stops->fails)
      disk_fail_at(life->disk, n, false);
    else if (from == COUNTED_FROM && stops != NULL)
      disk_stop_after(life->disk, n);
    act = life_script[from];
    if (act.kind == ACT_SAVE) /* the part of the act that was not done */
      act.n = act.parts = act.n - life->jobs[MO_JOB_EVALUATION][0].done;
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
  close_life(life);
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

/* Stops at change `n` of the script or of the first opening, by a kill or a cut. Then runs the rest
 * of the script, followed by the worst cut. Returns whether there was such a change. */
static bool stop_at(long n, const struct stops *stops, int end, struct outcome *outcome)
{
  static struct life life;
  struct mo_message message;
  int next = 0, error = MO_OK;
  if (life_start(&life, (uint64_t)n, DISK_HONEST, forms, genotypes) != 0)
    return false;
  if (stops->opening)
    disk_stop_after(life.disk, n);
  open_store(&life, &error, &message);
  if (error != MO_OK && !disk_has_stopped(life.disk))
    life_found(&life, "opening: %s", message.text);
  if (!stops->opening && error == MO_OK)
    next = play(&life, 0, end, stops, n);
  bool stopped = disk_has_stopped(life.disk) || disk_has_failed(life.disk);
  if (life.findings == 0)
    stop_and_reopen(&life, stops->kill, stops->luck, outcome);
  if (next < end && life.doing.kind == life_script[next].kind &&
      life.doing.index == life_script[next].index && life.doing.parts == 0)
    next += !stops->opening;
  if (life.findings == 0 && play(&life, next, end, NULL, 0) < end)
    life_found(&life, "the script does not continue after act %d", next);
  if (life.findings == 0)
    stop_and_reopen(&life, false, DISK_WORST, outcome);
  life_end(&life);
  outcome->cuts += 2 - stops->kill;
  outcome->kills += stops->kill;
  if (life.findings > 0 && outcome->findings++ == 0)
    snprintf(outcome->first, sizeof(outcome->first), "change %ld: %.300s", n, life.first);
  return stopped;
}

/* At change `first` and every `stride`th after it of the script up to its act `end`. */
static void stops_everywhere(const struct stops *stops, long first, long stride, int end)
{
  struct outcome outcome = {0};
  long n = first, tried = 0;
  for (; stop_at(n, stops, end, &outcome); n += stride)
    tried++;
  printf("# %ld of about %ld changes; %u acts in doubt, of which %u were stored\n", tried, n - 1,
         outcome.doubts, outcome.came_through);
  CHECK(n > 30);
  CHECK_INT(outcome.findings, 0);
  if (outcome.findings > 0)
    printf("# %s\n", outcome.first);
}

static void survives_stops(int which)
{
  const struct stops *stops = &all_stops[which];
  stops_everywhere(stops, stops->first, stops->stride, stops->end);
}

/* An act that finds no descriptor for one of its files or folders is repeated, and must then be
 * durable. */
static void certain_at_the_second_try(void)
{
  static struct life life;
  struct outcome outcome = {0};
  struct mo_message message;
  bool lacked = true;
  int error = MO_OK;
  for (long n = 1; lacked && n < 100; n++) {
    lacked = false;
    REQUIRE_OK(life_start(&life, (uint64_t)n, DISK_HONEST, forms, genotypes));
    open_store(&life, &error, &message);
    CHECK_OK(error);
    CHECK_INT(play(&life, 0, COUNTED_FROM, NULL, 0), COUNTED_FROM);
    for (int i = COUNTED_FROM; i < COUNTED_FROM + 2; i++) { /* a checkpoint, a controller */
      disk_lack_descriptor(life.disk, n);
      error = MO_OK;
      struct act act = life_script[i];
      life_apply(&life, &act, life_do(&life, life.store, &act, &error));
      lacked = lacked || disk_has_failed(life.disk);
      disk_lack_descriptor(life.disk, 0);
      CHECK(error == MO_OK || error == MO_ERR_NO_MEMORY);
      if (error != MO_OK)
        CHECK(act_once(&life, life_script[i]));
    }
    stop_and_reopen(&life, false, DISK_WORST, &outcome);
    CHECK_INT(life.findings, 0);
    if (life.findings > 0)
      printf("# descriptor %ld: %s\n", n, life.first);
    life_end(&life);
  }
  CHECK(!lacked);
}

static void survives_all(void)
{
  for (size_t i = 0; i < COUNT(all_stops); i++)
    stops_everywhere(&all_stops[i], 1, 1, SCRIPT);
}

static const struct check_case cases[] = {
    {"short: keeps its promises through 50 power cuts", WITH(keeps_promises, 50)},
    {"short: a disk that does not sync the database is detected",
     WITH(is_found_out, DISK_FORGETS_DATABASE)},
    {"short: a disk that does not sync files is detected", WITH(is_found_out, DISK_FORGETS_FILES)},
    {"short: a disk that does not sync folders is detected",
     WITH(is_found_out, DISK_FORGETS_FOLDERS)},
    {"short: a kill at every change of some acts, and a cut later", WITH(survives_stops, KILLS)},
    {"short: a cut at many changes leaves only durable data", WITH(survives_stops, WORST_CUTS)},
    {"short: a cut at many changes may leave anything", WITH(survives_stops, ANY_CUTS)},
    {"short: a cut at many changes of the first opening", WITH(survives_stops, OPENINGS)},
    {"short: a failed call leaves its whole act or nothing", WITH(survives_stops, FAILURES)},
    {"short: an act without a descriptor is durable at the second try", certain_at_the_second_try},
    {"long: keeps its promises through 500 power cuts", WITH(keeps_promises, 500)},
    {"long: a kill or cut at every change", survives_all},
};
CHECK_MAIN_WITH(draw_bodies, cases)
