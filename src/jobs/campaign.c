/* campaign.c: the kind "campaign": runs one campaign, generation by generation, to its end or until
 * a request.
 *
 * A generation consists of children, learning, scores, selection and one commit, which is written
 * while the next generation runs. Everything before the commit can be repeated with the same
 * result: children depend on the population and on all designs ever born, learning continues from
 * its checkpoint, and saved losses are read again. So a campaign is a function of its settings and
 * seed, whatever interrupts it. A campaign ends when all its generations are committed, or when no
 * child can be found; a generation without a child is not committed. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/campaign_excluded.h"
#include "jobs/trainings.h"
#include "store/worlds.h"

#define HISTORY_ROWS        64
#define CHILDREN_PER_THREAD 1024 /* take about a millisecond */

/* ---- resumption ---- */

/* Allocates the rows of two generations. */
static int allocate(struct mo_campaign_run *run)
{
  const size_t n = run->settings->population, words = mo_workspace_words(run->settings->workspace);
  const size_t e = run->n_environments;
  bool is_whole = true;
  for (int i = 0; i < 2; i++) {
    struct mo_campaign_rows *rows = &run->all_rows[i];
#define MO_COLUMN(type, name, length)                                                              \
  rows->name = calloc(length, sizeof(type));                                                       \
  is_whole = is_whole && rows->name != NULL;
    MO_CAMPAIGN_COLUMNS(MO_COLUMN)
#undef MO_COLUMN
  }
  run->words = words;
  run->rows = &run->all_rows[0];
  run->other_rows = &run->all_rows[1];
  return is_whole ? MO_OK : MO_ERR_NO_MEMORY;
}

static void free_rows(struct mo_campaign_rows *rows)
{
#define MO_COLUMN(type, name, length) free(rows->name);
  MO_CAMPAIGN_COLUMNS(MO_COLUMN)
#undef MO_COLUMN
}

static uint64_t *genotype(const struct mo_campaign_run *run, uint32_t place)
{
  return run->rows->genotypes + run->words * place;
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
    n = mo_store_campaign_generations(run->jobs->store, run->id, after, 1, rows, HISTORY_ROWS);
    for (int64_t i = 0; i < n; i++) {
      after = rows[i].generation;
      if (rows[i].stats.diversity > run->diversity_max) {
        run->diversity_max = rows[i].stats.diversity;
        run->is_warned = false;
      }
      run->is_warned = run->is_warned || rows[i].collapse;
      run->generation_rollouts = rows[i].rollouts;
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
  if (error == MO_OK && state->n > run->settings->population)
    error = MO_ERR_CORRUPT;
  for (uint32_t i = 0; error == MO_OK && i < state->n; i++) {
    run->rows->bits[i] = state->genotypes[i];
    run->rows->numbers[i] = state->numbers[i];
    run->rows->born[i] = state->born[i];
    run->rows->scores[i] = state->scores[i];
    error = mo_genotype_move(MO_DEFAULT_WORKSPACE, state->genotypes[i].words,
                             run->settings->workspace, genotype(run, i));
    if (error == MO_OK)
      error = mo_design_size(run->jobs->lattice, run->rows->bits[i].words, &run->rows->sizes[i]);
  }
  if (error == MO_OK) {
    run->n_parents = state->n;
    run->generation = state->generation + 1;
    run->n_designs = state->n_designs;
    run->race_pays = state->race_pays;
    error = read_history(run);
  }
  mo_campaign_state_free(state);
  return error;
}

static int remember(void *context, const struct mo_bits *born)
{
  struct mo_campaign_run *run = context;
  struct mo_bits moved;
  int error =
      mo_genotype_move(MO_DEFAULT_WORKSPACE, born->words, run->settings->workspace, moved.words);
  if (error == MO_OK)
    error = mo_seen_add(run->seen, moved.words);
  return error < 0 ? error : MO_OK;
}

/* Collects the designs that must not be born again. */
static int read_seen(struct mo_campaign_run *run)
{
  const struct mo_form_set *excluded = NULL;
  int error = MO_OK;
  if (run->settings->exclude_pretraining)
    error = mo_exclusion_acquire(run, &excluded);
  if (error == MO_OK)
    error = mo_seen_create(run->settings->workspace, excluded, &run->seen);
  if (error == MO_OK)
    error = mo_store_campaign_each(run->jobs->store, run->id, remember, run);
  return error;
}

static int prepare(struct mo_campaign_run *run)
{
  int error = mo_store_campaign(run->jobs->store, run->id, &run->status);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  run->generation = (uint32_t)(run->status.generation + 1);
  mo_campaign_enter(run, MO_PHASE_PREPARE, 0);
  error = mo_back_end_check(run->jobs, run->status.job.back_end);
  if (error == MO_OK && run->status.job.has_controller)
    error = mo_runner_load(run->runner, &run->status.job.controller_sha256, &run->controller);
  if (error == MO_OK)
    error = mo_store_job_environments(run->jobs->store, run->id, MO_JOB_CAMPAIGN,
                                      &run->environments, &run->n_environments);
  if (error == MO_OK)
    error = allocate(run);
  if (error == MO_OK)
    error = read_population(run);
  if (error == MO_OK)
    error = mo_race_read(run);
  if (error == MO_OK && run->settings->mode != MO_STUDY &&
      run->generation <= run->settings->generations)
    error = read_seen(run);
  return error;
}

/* ---- children ---- */

static int make_first(struct mo_campaign_run *run, uint32_t *n)
{
  const struct mo_campaign_settings *settings = run->settings;
  const uint32_t n_listed = run->status.record.n_listed;
  struct mo_bits *given = NULL;
  uint32_t n_given = 0;
  int error = mo_store_job_designs(run->jobs->store, run->id, &given, &n_given);
  if (error == MO_OK && n_given > settings->population)
    error = MO_ERR_CORRUPT;
  for (uint32_t i = 0; i < n_given && error == MO_OK; i++)
    error = mo_genotype_move(MO_DEFAULT_WORKSPACE, given[i].words, settings->workspace,
                             genotype(run, i));
  free(given);
  if (error == MO_OK)
    error = mo_population_initial(settings, run->seen, run->rows->genotypes, n_given, n, NULL,
                                  &run->runner->interrupt);
  for (uint32_t i = 0; i < *n && error == MO_OK; i++)
    run->rows->births[i] = (struct mo_birth){.op = i >= n_given   ? MO_BORN_RANDOM
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
    int error = mo_genotype_move(run->settings->workspace, genotype(run, place),
                                 MO_DEFAULT_WORKSPACE, run->rows->bits[place].words);
    if (error != MO_OK) {
      atomic_store(&describing->error, error);
      return;
    }
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, run->rows->bits[place].words,
                          run->rows->forms[i].words);
    error =
        mo_design_size(run->jobs->lattice, run->rows->bits[place].words, &run->rows->sizes[place]);
    run->rows->numbers[place] = (uint32_t)(run->n_designs + i);
    run->rows->born[place] = run->generation;
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

/* Reads the pending batch of a study, whose client makes the children. */
static int read_told(struct mo_campaign_run *run, uint32_t *n)
{
  int error = mo_store_study_batch(run->jobs->store, run->id, &run->told);
  if (error != MO_OK)
    return mo_runner_fail_unreadable(run->runner, error);
  const struct mo_study_batch *batch = run->told;
  if (batch->number != run->generation || batch->n_children > run->settings->population)
    return MO_ERR_CORRUPT;
  for (uint32_t i = 0; i < batch->n_children && error == MO_OK; i++) {
    const struct mo_descent *descent = &batch->children[i].descent;
    run->rows->births[i] = (struct mo_birth){.op = (enum mo_operator)descent->op,
                                             .parents = {descent->parents[0], descent->parents[1]},
                                             .attempts = 1};
    run->variation.mutants += descent->op == MO_BORN_MUTATION;
    run->variation.recombinants += descent->op == MO_BORN_CROSSOVER;
    error = mo_genotype_move(MO_DEFAULT_WORKSPACE, batch->children[i].genotype.words,
                             run->settings->workspace, genotype(run, run->n_parents + i));
  }
  run->variation.mutation_attempts = run->variation.mutants;
  run->variation.crossover_attempts = run->variation.recombinants;
  *n = batch->n_children;
  return error;
}

static int vary(struct mo_campaign_run *run)
{
  int error;
  uint32_t n = 0;
  mo_campaign_enter(run, MO_PHASE_VARY, 0);
  run->variation = (struct mo_variation_counts){.mutants = 0};
  if (run->settings->mode == MO_STUDY)
    error = read_told(run, &n);
  else if (run->generation == 0)
    error = make_first(run, &n);
  else
    error = mo_variation(run->settings, run->generation, run->rows->genotypes, run->n_parents,
                         run->seen, genotype(run, run->n_parents), run->rows->births, &n,
                         &run->variation, &run->runner->interrupt);
  run->n_children = error == MO_OK ? n : 0;
  return error == MO_OK ? describe_children(run) : error;
}

/* ---- selection ---- */

static int by_number(const void *a, const void *b)
{
  const uint32_t x = *(const uint32_t *)a, y = *(const uint32_t *)b;
  return x < y ? -1 : x > y;
}

/* Selects the survivors. The client of a study may choose the parents among them; all children then
 * survive, too. */
static int select_survivors(struct mo_campaign_run *run)
{
  const uint32_t n = run->n_parents + run->n_children;
  const struct mo_study_batch *told = run->told != NULL && run->told->selects ? run->told : NULL;
  struct mo_campaign_settings settings = *run->settings;
  struct mo_candidate *candidates = calloc((size_t)n + 1, sizeof(*candidates));
  uint32_t *places = calloc((size_t)n + 1, sizeof(*places)), n_kept = 0;
  int error = candidates == NULL || places == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  if (told != NULL)
    qsort(told->survivors, told->n_survivors, sizeof(*told->survivors), by_number);
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    if (told != NULL && i < run->n_parents &&
        bsearch(&run->rows->numbers[i], told->survivors, told->n_survivors,
                sizeof(*told->survivors), by_number) == NULL)
      continue;
    candidates[n_kept] =
        (struct mo_candidate){run->rows->scores[i], run->rows->numbers[i], run->rows->born[i]};
    places[n_kept++] = i;
  }
  if (told != NULL) {
    settings.selection.kind = MO_SELECT_TRUNCATION; /* of all: it only ranks them */
    settings.population = n_kept;
  }
  if (error == MO_OK)
    error = mo_select(&settings, run->generation, run->rows->genotypes, candidates, n_kept,
                      run->rows->survivors, &run->n_survivors);
  for (uint32_t i = 0; i < run->n_survivors && error == MO_OK; i++)
    run->rows->survivors[i] = places[run->rows->survivors[i]];
  free(candidates);
  free(places);
  return error;
}

/* Copies the survivors, in their order, to the other rows, which no commit uses any more. */
static void gather(struct mo_campaign_run *run)
{
  const struct mo_campaign_rows *from = run->rows;
  struct mo_campaign_rows *to = run->other_rows;
  for (uint32_t i = 0; i < run->n_survivors; i++) {
    const uint32_t place = from->survivors[i];
    memcpy(to->genotypes + run->words * i, from->genotypes + run->words * place,
           run->words * sizeof(*to->genotypes));
    to->bits[i] = from->bits[place];
    to->sizes[i] = from->sizes[place];
    to->scores[i] = from->scores[place];
    to->numbers[i] = from->numbers[place];
    to->born[i] = from->born[place];
    to->cut[i] = 0;
  }
  mo_race_keep(run, to);
}

/* Commits the generation, and makes the survivors the population. */
static int succeed(struct mo_campaign_run *run)
{
  struct mo_campaign_rows *committed = run->rows;
  int error = mo_campaign_settle(run);
  if (error != MO_OK)
    return error;
  gather(run);
  error = mo_campaign_commit(run);
  if (error != MO_OK)
    return error;
  run->rows = run->other_rows;
  run->other_rows = committed;
  run->n_designs += run->n_children;
  run->n_parents = run->n_survivors;
  run->n_children = 0;
  run->prepared_s = 0;
  run->generation++;
  mo_campaign_free_scores(run);
  return MO_OK;
}

/* ---- generations and the end ---- */

/* Ends a campaign in which no robot of generation 0 could learn or be scored. */
static int check_learned(struct mo_campaign_run *run)
{
  const struct mo_training *training = run->learner.training;
  bool any = run->generation > 0 || training == NULL || mo_training_step(training) == 0 ||
             mo_training_skipped(training) < mo_training_step(training);
  for (uint32_t i = 0; i < run->n_children && !any; i++)
    any = isfinite(run->rows->scores[i]);
  return any ? MO_OK
             : mo_runner_give_up(run->runner, MO_ERR_RANGE,
                                 "every robot of generation 0 diverged, while it learned and while "
                                 "it was scored: choose a smaller dt_s or stiffness_n_per_m");
}

/* MO_ERR_EXHAUSTED: no child was found. */
static int run_generation(struct mo_campaign_run *run)
{
  run->begin_us = mo_clock_us();
  int error = vary(run);
  if (error == MO_OK && run->n_children == 0 && run->told == NULL)
    error = MO_ERR_EXHAUSTED;
  if (error == MO_OK)
    error = mo_campaign_learn(run);
  if (error == MO_OK)
    error = mo_campaign_score(run);
  if (error == MO_OK)
    error = check_learned(run);
  if (error == MO_OK)
    error = select_survivors(run);
  return error == MO_OK ? succeed(run) : error;
}

static int write_end(void *context)
{
  struct mo_campaign_run *run = context;
  const struct mo_campaign_record *record = &run->status.record;
  struct mo_learned learned = {.controller = NULL};
  char made[MO_MADE_BYTES];
  int error = MO_OK;
  if (run->learner.training != NULL)
    error = mo_learned_create(run->jobs, &run->status.job, run->learner.training, NULL, &learned);
  if (error == MO_OK)
    error = mo_store_campaign_finish(
        run->jobs->store, run->id,
        run->is_exhausted ? MO_CAMPAIGN_EXHAUSTED : MO_CAMPAIGN_COMPLETED,
        record->settings.generations,
        learned.controller != NULL ? mo_result_name(&run->status.job, record->name, made) : NULL,
        learned.bytes, learned.size, learned.controller);
  mo_learned_free(&learned);
  return error;
}

/* MO_ERR_CONFLICT: the campaign was extended, paused or cancelled. */
static int finish(struct mo_campaign_run *run)
{
  int error = MO_OK;
  if (mo_mode_learns(run->settings->mode) && run->generation > 0) {
    /* The result is the state of the last committed generation. This run has that state unless it
     * has committed no generation, or has found no children since. */
    if (run->learner.training == NULL)
      error = mo_campaign_load_learning(run);
  } else {
    mo_campaign_free_learning(run);
  }
  return error == MO_OK ? mo_runner_persist(run->runner, write_end, run, "the end of the campaign")
                        : error;
}

/* Runs generations to the end of the campaign. Reads the campaign again after each one, because
 * generations may have been added. */
static int evolve(struct mo_campaign_run *run)
{
  int error = MO_OK;
  while (error == MO_OK) {
    const uint32_t generations = run->settings->generations;
    const bool is_over = run->is_exhausted || run->generation > generations;
    if (mo_runner_is_interrupted(run->runner))
      return MO_ERR_CANCELLED;
    if (!is_over && run->seen == NULL) /* complete at first, extended since */
      error = read_seen(run);
    if (is_over && error == MO_OK) {
      mo_campaign_enter(run, MO_PHASE_SAVE, 0);
      error = mo_campaign_settle(run);
      if (error != MO_OK)
        return error;
    }
    if (error == MO_OK)
      error = is_over ? finish(run) : run_generation(run);
    if (is_over ? error != MO_ERR_CONFLICT : error != MO_OK && error != MO_ERR_EXHAUSTED)
      return error;
    run->is_exhausted = run->is_exhausted || error == MO_ERR_EXHAUSTED;
    error = mo_store_campaign(run->jobs->store, run->id, &run->status);
    if (error == MO_OK && is_over && run->settings->generations == generations)
      error = MO_ERR_CONFLICT; /* paused or cancelled */
  }
  return error;
}

/* Runs the pending batch of a study. The commit leaves the study in the queue, where it waits for
 * its client (MO_ERR_CONFLICT: the attempt has nothing to end). */
static int run_told(struct mo_campaign_run *run)
{
  int error = run_generation(run);
  if (error == MO_OK)
    error = mo_campaign_settle(run);
  return error == MO_OK ? MO_ERR_CONFLICT : error;
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

static void clean_up(void *context)
{
  struct mo_campaign_run *run = context;
  mo_campaign_writing_free(run);
  mo_campaign_free_scores(run);
  mo_campaign_free_learning(run);
  mo_compute_controller_free(run->frozen);
  mo_controller_free(run->controller);
  mo_seen_free(run->seen);
  mo_study_batch_free(run->told);
  mo_exclusion_release(run);
  free(run->environments);
  free_rows(&run->all_rows[0]);
  free_rows(&run->all_rows[1]);
}

static int run_campaign(struct mo_runner *runner, void *context)
{
  struct mo_campaign_run *run = context;
  run->runner = runner;
  run->jobs = runner->jobs;
  run->id = runner->id;
  run->settings = &run->status.record.settings;
  run->begin_us = run->progress_us = mo_clock_us();
  int error = prepare(run);
  if (run->generation == 0)
    run->prepared_s = (double)(mo_clock_us() - run->begin_us) * 1e-6;
  if (error == MO_OK)
    error = run->settings->mode == MO_STUDY ? run_told(run) : evolve(run);
  mo_campaign_writing_join(run); /* the commit may reset the count of attempts */
  return error;
}

/* ---- the kind ---- */

static int need(struct mo_jobs *jobs, int64_t id, struct mo_need *need)
{
  struct mo_campaign_status status;
  const int error = mo_store_campaign(jobs->store, id, &status);
  return error != MO_OK
             ? error
             : mo_campaign_need(jobs, &status.record.settings,
                                status.job.has_controller ? &status.job.controller_sha256 : NULL,
                                status.job.back_end, need, NULL);
}

const struct mo_kind mo_campaign_kind = {.kind = MO_JOB_CAMPAIGN,
                                         .need = need,
                                         .first = MO_PHASE_PREPARE,
                                         .run_bytes = sizeof(struct mo_campaign_run),
                                         .run = run_campaign,
                                         .save = save_rest,
                                         .clean_up = clean_up};
