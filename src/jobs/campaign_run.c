/* campaign_run.c: runs one campaign, generation by generation, to its end or until a request.
 *
 * A generation consists of children, learning, scores, selection and one commit, which is written
 * while the next generation runs. Everything before the commit can be repeated with the same
 * result: children depend on the population and on all designs ever born, learning continues from
 * its checkpoint, and saved losses are read again. So a campaign is a function of its settings and
 * seed, whatever interrupts it. A campaign ends when all its generations are committed, or when no
 * child can be found; a generation without a child is not committed. */
#include "jobs/campaign_run.h"
#include "base/clock.h"
#include "base/parallel.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define PROGRESS_EVERY_US   INT64_C(1000000)
#define HISTORY_ROWS        64
#define CHILDREN_PER_THREAD 1024 /* take about a millisecond */

static const struct mo_campaign_settings *settings_of(const struct mo_campaign_run *run)
{
  return &run->status.record.settings;
}

/* ---- live figures ---- */

static int set_phase(struct mo_runner *runner, int phase, const char *reason)
{
  struct mo_campaign_live *live = &runner->live.campaign;
  int before;
  pthread_mutex_lock(&runner->runners->mutex);
  before = (int)live->phase;
  live->phase = (enum mo_campaign_phase)phase;
  snprintf(live->reason, sizeof(live->reason), "%s", reason);
  pthread_mutex_unlock(&runner->runners->mutex);
  return before;
}

int mo_campaign_enter(struct mo_campaign_run *run, enum mo_campaign_phase phase, uint64_t total)
{
  struct mo_runner *runner = run->attempt.runner;
  const uint32_t last = settings_of(run)->generations;
  pthread_mutex_lock(&runner->runners->mutex);
  runner->live.campaign.generation =
      run->generation < last ? run->generation : last; /* no generation is current at the end */
  runner->live.campaign.done = 0;
  runner->live.campaign.total = total;
  pthread_mutex_unlock(&runner->runners->mutex);
  return set_phase(runner, (int)phase, "");
}

/* Estimates the rest of the campaign: from the remaining rollouts if only scoring takes time, else
 * from the last whole generation. Negative: unknown. */
static double seconds_left(const struct mo_campaign_run *run, const struct mo_campaign_live *live)
{
  const struct mo_campaign_settings *settings = settings_of(run);
  const double after =
      run->generation < settings->generations ? settings->generations - run->generation : 0;
  const double passed = (double)(mo_clock_us() - run->begin_us) * 1e-6;
  if (settings->mode == MO_ZERO_SHOT && live->rollouts_per_s > 0 && run->generation > 0) {
    double left = after * settings->population + run->n_scored - run->n_done;
    return left * run->n_environments / live->rollouts_per_s;
  }
  if (run->generation_s <= 0)
    return -1;
  return after * run->generation_s + (passed < run->generation_s ? run->generation_s - passed : 0);
}

void mo_campaign_advance(struct mo_campaign_run *run, uint64_t done)
{
  struct mo_runner *runner = run->attempt.runner;
  pthread_mutex_lock(&runner->runners->mutex);
  runner->live.campaign.done = done;
  runner->live.campaign.seconds_left = seconds_left(run, &runner->live.campaign);
  pthread_mutex_unlock(&runner->runners->mutex);
}

/* Estimates all remaining generations from the newest one; 0: unknown. */
static double generations_s(const struct mo_campaign_run *run)
{
  const uint32_t generations = settings_of(run)->generations;
  return run->generation <= generations ? (generations - run->generation + 1.0) * run->generation_s
                                        : 0;
}

void mo_campaign_show_drawing(struct mo_campaign_run *run,
                              const struct mo_campaign_drawing *drawing)
{
  struct mo_runner *runner = run->attempt.runner;
  struct mo_campaign_live *live = &runner->live.campaign;
  const double after_s = generations_s(run);
  pthread_mutex_lock(&runner->runners->mutex);
  live->done = drawing != NULL ? drawing->done : 0;
  live->total = drawing != NULL ? drawing->total : 0;
  live->reason[0] = '\0';
  if (drawing == NULL)
    live->seconds_left = after_s > 0 ? after_s : -1;
  else
    live->seconds_left = drawing->seconds_left < 0 ? -1 : drawing->seconds_left + after_s;
  if (drawing != NULL && drawing->drawer != run->id)
    snprintf(live->reason, sizeof(live->reason),
             "campaign %lld draws the bodies again that the controller was pretrained on: this one "
             "waits for the same",
             (long long)drawing->drawer);
  pthread_mutex_unlock(&runner->runners->mutex);
}

void mo_campaign_show_rate(struct mo_campaign_run *run, double rollouts_per_s)
{
  struct mo_runner *runner = run->attempt.runner;
  pthread_mutex_lock(&runner->runners->mutex);
  runner->live.campaign.rollouts_per_s = rollouts_per_s;
  pthread_mutex_unlock(&runner->runners->mutex);
}

const char *mo_campaign_progress(struct mo_campaign_run *run, const char *phase, uint64_t done,
                                 uint64_t total, char text[256])
{
  if (mo_clock_us() - run->progress_us < PROGRESS_EVERY_US)
    return NULL;
  snprintf(text, 256,
           "{\"id\":\"%lld\",\"generation\":%u,\"phase\":\"%s\",\"done\":%llu,\"total\":%llu}",
           (long long)run->id, (unsigned)run->generation, phase, (unsigned long long)done,
           (unsigned long long)total);
  return text;
}

void mo_campaign_told(struct mo_campaign_run *run)
{
  run->progress_us = mo_clock_us();
}

/* ---- resumption ---- */

static int load_controller(struct mo_campaign_run *run)
{
  const struct mo_campaign_record *record = &run->status.record;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error;
  if (!record->has_controller)
    return MO_OK;
  error = mo_store_controller_bytes(run->jobs->store, &record->controller_sha256, &bytes, &size);
  if (error == MO_OK)
    error = mo_controller_decode(bytes, size, &run->controller, NULL);
  free(bytes);
  if (error == MO_ERR_CORRUPT || error == MO_ERR_IO || error == MO_ERR_FORMAT)
    return mo_attempt_fail_controller(&run->attempt, error, &record->controller_sha256);
  return error;
}

static int allocate(struct mo_campaign_run *run)
{
  const size_t n = settings_of(run)->population, room = 2 * n;
  run->words = mo_workspace_words(settings_of(run)->workspace);
  run->genotypes = calloc(room * run->words, sizeof(*run->genotypes));
  run->bits = calloc(room, sizeof(*run->bits));
  run->forms = calloc(n, sizeof(*run->forms));
  run->sizes = calloc(room, sizeof(*run->sizes));
  run->scores = calloc(room, sizeof(*run->scores));
  run->numbers = calloc(room, sizeof(*run->numbers));
  run->born = calloc(room, sizeof(*run->born));
  run->births = calloc(n, sizeof(*run->births));
  run->survivors = calloc(n, sizeof(*run->survivors));
  return run->genotypes == NULL || run->bits == NULL || run->forms == NULL || run->sizes == NULL ||
                 run->scores == NULL || run->numbers == NULL || run->born == NULL ||
                 run->births == NULL || run->survivors == NULL
             ? MO_ERR_NO_MEMORY
             : MO_OK;
}

static uint64_t *genotype(const struct mo_campaign_run *run, uint32_t place)
{
  return run->genotypes + run->words * place;
}

/* Reads the maximum diversity, whether its collapse was reported, and the time of the newest
 * generation. */
static int read_history(struct mo_campaign_run *run)
{
  struct mo_campaign_generation *rows = calloc(HISTORY_ROWS, sizeof(*rows));
  int64_t after = -1, n = HISTORY_ROWS;
  if (rows == NULL)
    return MO_ERR_NO_MEMORY;
  while (n == HISTORY_ROWS) {
    n = mo_store_campaign_generations(run->jobs->store, run->id, after, rows, HISTORY_ROWS);
    for (int64_t i = 0; i < n; i++) {
      after = rows[i].generation;
      if (rows[i].stats.diversity > run->diversity_max) {
        run->diversity_max = rows[i].stats.diversity;
        run->is_warned = false;
      }
      run->is_warned = run->is_warned || rows[i].collapse;
      if (rows[i].generation > 0) /* the time of generation 0 includes the preparation */
        run->generation_s = rows[i].seconds;
    }
  }
  free(rows);
  return n < 0 ? (int)n : MO_OK;
}

static int read_population(struct mo_campaign_run *run)
{
  struct mo_campaign_state *state = NULL;
  int error = mo_store_campaign_state(run->jobs->store, run->id, &state);
  if (error == MO_ERR_NOT_FOUND) /* nothing is committed yet */
    return MO_OK;
  if (error == MO_OK && state->n > settings_of(run)->population)
    error = MO_ERR_CORRUPT;
  for (uint32_t i = 0; error == MO_OK && i < state->n; i++) {
    run->bits[i] = state->genotypes[i];
    run->numbers[i] = state->numbers[i];
    run->born[i] = state->born[i];
    run->scores[i] = state->scores[i];
    error = mo_genotype_move(MO_DEFAULT_WORKSPACE, state->genotypes[i].words,
                             settings_of(run)->workspace, genotype(run, i));
    if (error == MO_OK)
      error = mo_design_size(run->jobs->lattice, run->bits[i].words, &run->sizes[i]);
  }
  if (error == MO_OK) {
    run->n_parents = state->n;
    run->generation = state->generation + 1;
    run->n_designs = state->n_designs;
    error = read_history(run);
  }
  mo_campaign_state_free(state);
  return error;
}

struct remembering {
  struct mo_campaign_run *run;
  uint64_t *moved;
};

static int remember(void *context, const struct mo_bits *born)
{
  const struct remembering *remembering = context;
  struct mo_campaign_run *run = remembering->run;
  int error = mo_genotype_move(MO_DEFAULT_WORKSPACE, born->words, settings_of(run)->workspace,
                               remembering->moved);
  if (error == MO_OK)
    error = mo_seen_add(run->seen, remembering->moved);
  return error < 0 ? error : MO_OK;
}

/* Collects the designs that must not be born again. */
static int read_seen(struct mo_campaign_run *run)
{
  struct remembering remembering = {run, calloc(run->words, sizeof(uint64_t))};
  int error = remembering.moved == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  if (error == MO_OK && settings_of(run)->exclude_pretraining)
    error = mo_exclusion_acquire(run, &run->exclusion);
  if (error == MO_OK)
    error =
        mo_seen_create(settings_of(run)->workspace, mo_exclusion_forms(run->exclusion), &run->seen);
  if (error == MO_OK)
    error = mo_store_campaign_each(run->jobs->store, run->id, remember, &remembering);
  free(remembering.moved);
  return error;
}

static int prepare(struct mo_campaign_run *run)
{
  int error = mo_store_campaign(run->jobs->store, run->id, &run->status);
  if (error != MO_OK)
    return mo_attempt_fail_unreadable(&run->attempt, error);
  run->generation = (uint32_t)(run->status.generation + 1);
  (void)mo_campaign_enter(run, MO_CAMPAIGN_PREPARE, 0);
  error = mo_back_end_check(run->jobs, run->status.job.back_end);
  if (error == MO_OK)
    error = load_controller(run);
  if (error == MO_OK)
    error = allocate(run);
  if (error == MO_OK)
    error = mo_campaign_writing_create(run);
  if (error == MO_OK)
    error = mo_share_open(run->jobs, run->id, MO_JOB_CAMPAIGN, &run->share);
  if (error == MO_OK)
    error = mo_store_campaign_environments(run->jobs->store, run->id, &run->environments,
                                           &run->n_environments);
  if (error == MO_OK)
    error = read_population(run);
  if (error == MO_OK && run->generation <= settings_of(run)->generations)
    error = read_seen(run);
  return error;
}

/* ---- children ---- */

static int make_first(struct mo_campaign_run *run, uint32_t *n)
{
  const struct mo_campaign_settings *settings = settings_of(run);
  const uint32_t n_listed = run->status.record.n_listed;
  struct mo_bits *given = NULL;
  uint32_t n_given = 0;
  int error = mo_store_campaign_initial(run->jobs->store, run->id, &given, &n_given);
  if (error == MO_OK && n_given > settings->population)
    error = MO_ERR_CORRUPT;
  for (uint32_t i = 0; i < n_given && error == MO_OK; i++)
    error = mo_genotype_move(MO_DEFAULT_WORKSPACE, given[i].words, settings->workspace,
                             genotype(run, i));
  free(given);
  if (error == MO_OK)
    error = mo_population_initial(settings, run->seen, run->genotypes, n_given, n, NULL,
                                  &run->attempt.runner->interrupt);
  for (uint32_t i = 0; i < *n && error == MO_OK; i++)
    run->births[i] = (struct mo_birth){.op = i >= n_given   ? MO_BORN_RANDOM
                                             : i < n_listed ? MO_BORN_LISTED
                                                            : MO_BORN_INHERITED,
                                       .parents = {MO_NO_PARENT, MO_NO_PARENT},
                                       .attempts = 1};
  return error;
}

struct describing {
  struct mo_campaign_run *run;
  atomic_int error;
};

static void describe_some(void *context, size_t first, size_t end)
{
  struct describing *describing = context;
  struct mo_campaign_run *run = describing->run;
  for (uint32_t i = (uint32_t)first; i < end; i++) {
    const uint32_t place = run->n_parents + i;
    int error = mo_genotype_move(settings_of(run)->workspace, genotype(run, place),
                                 MO_DEFAULT_WORKSPACE, run->bits[place].words);
    if (error != MO_OK) {
      atomic_store(&describing->error, error);
      return;
    }
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, run->bits[place].words, run->forms[i].words);
    error = mo_design_size(run->jobs->lattice, run->bits[place].words, &run->sizes[place]);
    run->numbers[place] = (uint32_t)(run->n_designs + i);
    run->born[place] = run->generation;
    if (error != MO_OK)
      atomic_store(&describing->error, error);
  }
}

/* Converts the children for the store and the back end. */
static int describe_children(struct mo_campaign_run *run)
{
  struct describing describing = {.run = run};
  mo_parallel(1 + run->n_children / CHILDREN_PER_THREAD, run->n_children, describe_some,
              &describing);
  return atomic_load(&describing.error);
}

static int vary(struct mo_campaign_run *run)
{
  int error;
  uint32_t n = 0;
  (void)mo_campaign_enter(run, MO_CAMPAIGN_VARY, 0);
  run->variation = (struct mo_variation_counts){.mutants = 0};
  if (run->generation == 0)
    error = make_first(run, &n);
  else
    error = mo_variation(settings_of(run), run->generation, run->genotypes, run->n_parents,
                         run->seen, genotype(run, run->n_parents), run->births, &n, &run->variation,
                         &run->attempt.runner->interrupt);
  run->n_children = error == MO_OK ? n : 0;
  return error == MO_OK ? describe_children(run) : error;
}

/* ---- selection ---- */

static int select_survivors(struct mo_campaign_run *run)
{
  const uint32_t n = run->n_parents + run->n_children;
  struct mo_candidate *candidates = calloc(n, sizeof(*candidates));
  int error = candidates == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  for (uint32_t i = 0; i < n && error == MO_OK; i++)
    candidates[i] = (struct mo_candidate){run->scores[i], run->numbers[i], run->born[i]};
  if (error == MO_OK)
    error = mo_select(settings_of(run), run->generation, run->genotypes, candidates, n,
                      run->survivors, &run->n_survivors);
  free(candidates);
  return error;
}

/* Replaces rows 0 … n − 1 of an array by the rows at `places`. */
static int gather(void *array, size_t size, const uint32_t *places, uint32_t n)
{
  uint8_t *rows = array, *copy = malloc(size * n + 1);
  if (copy == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n; i++)
    memcpy(copy + size * i, rows + size * places[i], size);
  memcpy(rows, copy, size * n);
  free(copy);
  return MO_OK;
}

/* Makes the survivors the population. After an error the run is unusable. */
static int succeed(struct mo_campaign_run *run)
{
  const struct {
    void *array;
    size_t size;
  } rows[] = {{run->genotypes, run->words * sizeof(*run->genotypes)},
              {run->bits, sizeof(*run->bits)},
              {run->sizes, sizeof(*run->sizes)},
              {run->scores, sizeof(*run->scores)},
              {run->numbers, sizeof(*run->numbers)},
              {run->born, sizeof(*run->born)}};
  int error = MO_OK;
  for (size_t i = 0; i < sizeof(rows) / sizeof(rows[0]) && error == MO_OK; i++)
    error = gather(rows[i].array, rows[i].size, run->survivors, run->n_survivors);
  run->n_designs += run->n_children;
  run->n_parents = run->n_survivors;
  run->n_children = 0;
  run->prepared_s = 0;
  run->generation++;
  mo_campaign_free_scores(run);
  return error;
}

/* ---- generations and the end ---- */

/* MO_ERR_EXHAUSTED: no child was found. */
static int run_generation(struct mo_campaign_run *run)
{
  int error;
  run->begin_us = mo_clock_us();
  error = vary(run);
  if (error == MO_OK && run->n_children == 0)
    error = MO_ERR_EXHAUSTED;
  if (error == MO_OK)
    error = mo_campaign_learn(run);
  if (error == MO_OK)
    error = mo_campaign_score(run);
  if (error == MO_OK)
    error = select_survivors(run);
  if (error == MO_OK)
    error = mo_campaign_commit(run);
  return error == MO_OK ? succeed(run) : error;
}

struct ending {
  struct mo_campaign_run *run;
  enum mo_campaign_end end;
};

static int write_end(void *context)
{
  const struct ending *ending = context;
  struct mo_campaign_run *run = ending->run;
  const struct mo_campaign_record *record = &run->status.record;
  struct mo_controller *controller = NULL;
  char digits[MO_SHA256_DIGITS + 1], name[MO_NAME_BYTES_MAX + 1];
  uint8_t *bytes = NULL;
  size_t size = 0;
  int error = MO_OK;
  mo_sha256_to_hex(&record->controller_sha256, digits);
  if (record->name[0] != '\0')
    snprintf(name, sizeof(name), "%s", record->name);
  else
    snprintf(name, sizeof(name), "campaign-%lld", (long long)run->id);
  if (run->learner.training != NULL)
    error =
        mo_training_export(run->learner.training, record->has_controller ? digits : NULL,
                           run->jobs->code_versions[run->status.job.back_end], NULL, &controller);
  if (error == MO_OK && controller != NULL)
    error = mo_controller_encode(controller, &bytes, &size);
  if (error == MO_OK)
    error = mo_store_campaign_finish(run->jobs->store, run->id, ending->end,
                                     record->settings.generations, controller != NULL ? name : NULL,
                                     bytes, size, controller);
  free(bytes);
  mo_controller_free(controller);
  return error;
}

/* MO_ERR_CONFLICT: the campaign was extended, paused or cancelled. */
static int finish(struct mo_campaign_run *run, enum mo_campaign_end end)
{
  struct ending ending = {run, end};
  int error = MO_OK;
  if (settings_of(run)->mode != MO_ZERO_SHOT && run->generation > 0) {
    /* The result is the state of the last committed generation. This run has that state unless it
     * has committed no generation, or has found no children since. */
    if (run->learner.training == NULL)
      error = mo_campaign_load_learning(run);
  } else {
    mo_campaign_free_learning(run);
  }
  return error == MO_OK
             ? mo_attempt_persist(&run->attempt, write_end, &ending, "the end of the campaign")
             : error;
}

/* Runs generations to the end of the campaign. Reads the campaign again after each one, because
 * generations may have been added. */
static int evolve(struct mo_campaign_run *run)
{
  bool exhausted = false;
  int error = MO_OK;
  while (error == MO_OK) {
    const uint32_t generations = settings_of(run)->generations;
    const bool is_over = exhausted || run->generation > generations;
    if (mo_runner_is_interrupted(run->attempt.runner))
      return MO_ERR_CANCELLED;
    if (!is_over && run->seen == NULL) /* complete at first, extended since */
      error = read_seen(run);
    if (is_over && error == MO_OK) {
      (void)mo_campaign_enter(run, MO_CAMPAIGN_SAVE, 0);
      error = mo_campaign_settle(run);
      if (error != MO_OK)
        return error;
    }
    if (error == MO_OK)
      error = is_over ? finish(run, exhausted ? MO_CAMPAIGN_EXHAUSTED : MO_CAMPAIGN_COMPLETED)
                      : run_generation(run);
    if (is_over ? error != MO_ERR_CONFLICT : error != MO_OK && error != MO_ERR_EXHAUSTED)
      return error;
    exhausted = exhausted || error == MO_ERR_EXHAUSTED;
    error = mo_store_campaign(run->jobs->store, run->id, &run->status);
    if (error == MO_OK && is_over && settings_of(run)->generations == generations)
      error = MO_ERR_CONFLICT; /* paused or cancelled */
  }
  return error;
}

/* Saves what a stopped run has computed. */
static int save_rest(void *context)
{
  struct mo_campaign_run *run = context;
  int error = mo_campaign_settle(run), learned;
  if (error != MO_OK)
    return error;
  error = mo_campaign_save_losses(run);
  learned = run->learner.training != NULL ? mo_campaign_save_learning(run) : MO_OK;
  return error != MO_OK ? error : learned;
}

static void free_run(struct mo_campaign_run *run)
{
  mo_campaign_writing_free(run);
  mo_campaign_free_scores(run);
  mo_campaign_free_learning(run);
  mo_share_close(run->jobs, run->id);
  mo_compute_controller_free(run->frozen);
  mo_controller_free(run->controller);
  mo_seen_free(run->seen);
  mo_exclusion_release(run, run->exclusion);
  free(run->environments);
  free(run->genotypes);
  free(run->bits);
  free(run->forms);
  free(run->sizes);
  free(run->scores);
  free(run->numbers);
  free(run->born);
  free(run->births);
  free(run->survivors);
  free(run);
}

static bool run_campaign(struct mo_runner *runner, int64_t id)
{
  struct mo_campaign_run *run = calloc(1, sizeof(*run));
  bool failed;
  int error;
  if (run == NULL) {
    runner->is_short = true;
    return false;
  }
  run->attempt = (struct mo_attempt){.jobs = runner->jobs, .runner = runner, .id = id};
  run->jobs = runner->jobs;
  run->id = id;
  run->begin_us = run->progress_us = mo_clock_us();
  error = prepare(run);
  if (run->generation == 0)
    run->prepared_s = (double)(mo_clock_us() - run->begin_us) * 1e-6;
  if (error == MO_OK)
    error = evolve(run);
  mo_campaign_writing_join(run); /* the commit may reset the count of attempts */
  failed = mo_attempt_settle(&run->attempt, error, save_rest, run);
  free_run(run);
  return failed;
}

static int need(struct mo_jobs *jobs, int64_t id, struct mo_need *need)
{
  struct mo_campaign_status status;
  int error = mo_store_campaign(jobs->store, id, &status);
  *need = (struct mo_need){0};
  if (error == MO_OK)
    error =
        mo_need_of_campaign(jobs, &status.record.settings,
                            status.record.has_controller ? &status.record.controller_sha256 : NULL,
                            status.job.back_end, need, NULL);
  return mo_is_shortage(error) ? error : MO_OK;
}

static void begin(struct mo_runner *runner)
{
  runner->live.campaign =
      (struct mo_campaign_live){.phase = MO_CAMPAIGN_PREPARE, .seconds_left = -1};
}

const struct mo_runner_kind mo_campaign_runners = {.noun = "campaign",
                                                   .queued = mo_store_queued_campaigns,
                                                   .need = need,
                                                   .start = mo_store_campaign_start,
                                                   .park = mo_store_campaign_park,
                                                   .run = run_campaign,
                                                   .begin = begin,
                                                   .set_phase = set_phase,
                                                   .waiting = MO_CAMPAIGN_WAIT,
                                                   .busy = MO_CAMPAIGN_PREPARE};
