/* campaign.c: the kind "campaign": runs one campaign, generation by generation, to its end or until
 * a request.
 *
 * A generation runs through a table of phases: children, learning, scores, selection, a
 * re-evaluation of the best designs if it is due, and one commit, which is written while the next
 * generation runs. Everything before the commit can be repeated with the same result: children
 * depend on the population and on all designs ever born, learning continues from its checkpoint,
 * and saved losses are reread. A campaign is therefore a function of its settings and seed, no
 * matter what interrupts it. A campaign ends when all its generations are committed, or when no
 * child can be found; a generation without a child is not committed. */
#include <stdlib.h>

#include "base/clock.h"
#include "jobs/campaign_excluded.h"
#include "jobs/trainings.h"

/* ---- a generation ---- */

/* The wall time before generation 0 counts toward that generation. */
static int begin(struct mo_campaign_run *run)
{
  const int64_t now_us = mo_clock_us();
  if (run->generation == 0)
    run->times.prepared_s = (double)(now_us - run->times.begin_us) * 1e-6;
  run->times.begin_us = now_us;
  return MO_OK;
}

static void free_weights(struct mo_campaign_run *run)
{
  mo_compute_controller_free(run->scores.weights);
  run->scores.weights = NULL;
}

/* Makes the survivors the population. A commit may still be reading the rows from which they were
 * copied. */
static int advance_generation(struct mo_campaign_run *run)
{
  struct mo_campaign_rows *committed = run->rows;
  run->rows = run->other_rows;
  run->other_rows = committed;
  run->n_designs += run->n_children;
  run->n_parents = run->n_survivors;
  run->n_children = 0;
  run->times.prepared_s = 0;
  run->generation++;
  mo_campaign_free_scores(&run->scores);
  if (run->mode->learns)
    free_weights(run);
  return MO_OK;
}

struct phase {
  int (*run)(struct mo_campaign_run *run);
  enum mo_phase shown;                                  /* shown as live figures; idle: unchanged */
  uint64_t (*total)(const struct mo_campaign_run *run); /* total of its progress; nullable */
  bool learns;                                          /* only in modes that learn */
  bool parks;                                           /* a request stops the campaign before this
                                                         * phase */
  bool after_commit; /* begins when the commit of the previous generation has ended */
};
static const struct phase generation[] = {
    {mo_campaign_read_seen, .parks = true},
    {begin},
    {mo_campaign_vary, MO_PHASE_VARY},
    {mo_campaign_learn, MO_PHASE_LEARN, mo_campaign_n_steps, .learns = true, .parks = true},
    {mo_campaign_look_up, .parks = true},
    {mo_campaign_score, MO_PHASE_SCORE, mo_campaign_n_scores},
    {mo_campaign_check_learned, .learns = true},
    {mo_campaign_select},
    {mo_campaign_succeed, .after_commit = true},
    {mo_campaign_re_evaluate, .parks = true},
    {mo_campaign_commit, MO_PHASE_SAVE},
    {advance_generation},
};
#define N_PHASES (sizeof(generation) / sizeof(generation[0]))

/* Runs a phase, after whatever must precede it. */
static int run_phase(struct mo_campaign_run *run, const struct phase *phase)
{
  int error = MO_OK;
  if (phase->learns && !run->mode->learns)
    return MO_OK;
  if (phase->parks && mo_runner_is_interrupted(run->runner))
    return MO_ERR_CANCELLED;
  if (phase->after_commit)
    error = mo_campaign_wait_for_commit(run);
  if (error != MO_OK)
    return error;
  if (phase->shown != MO_PHASE_IDLE)
    mo_campaign_enter(run, phase->shown, phase->total != NULL ? phase->total(run) : 0);
  return phase->run(run);
}

/* MO_ERR_EXHAUSTED: no child was found. */
static int run_generation(struct mo_campaign_run *run)
{
  int error = MO_OK;
  for (size_t i = 0; i < N_PHASES && error == MO_OK; i++)
    error = run_phase(run, &generation[i]);
  return error;
}

/* ---- the end ---- */

static int write_end(void *context)
{
  struct mo_campaign_run *run = context;
  const struct mo_campaign_record *record = &run->status.record;
  struct mo_learned learned = {.controller = NULL};
  char made[MO_MADE_BYTES];
  int error = MO_OK;
  if (run->learning.learner.training != NULL)
    error = mo_learned_create(run->jobs, &run->status.job, run->learning.learner.training, NULL,
                              &learned);
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

/* Writes the end, unless the campaign was extended in the meantime. MO_ERR_CONFLICT: it was paused
 * or cancelled. */
static int finish(struct mo_campaign_run *run)
{
  const uint32_t generations = run->settings->generations;
  int error = MO_OK;
  if (run->mode->learns && run->generation > 0) {
    /* The result is the state of the last committed generation. This run has that state unless it
     * has committed no generation, or has found no children since. */
    if (run->learning.learner.training == NULL)
      error = mo_campaign_load_learning(run);
  } else {
    mo_campaign_free_learning(&run->learning);
  }
  if (error == MO_OK)
    error = mo_campaign_persist(run, write_end, run, "the end of the campaign");
  run->has_ended = error == MO_OK;
  if (error != MO_ERR_CONFLICT)
    return error;
  error = mo_store_campaign(run->jobs->store, run->id, &run->status);
  return error == MO_OK && run->settings->generations == generations ? MO_ERR_CONFLICT : error;
}

static const struct phase end = {finish, MO_PHASE_SAVE, .parks = true, .after_commit = true};

/* Runs generations until the campaign ends. Rereads the campaign after each one, because
 * generations may have been added. */
static int evolve(struct mo_campaign_run *run)
{
  int error = MO_OK;
  while (error == MO_OK && !run->has_ended) {
    if (run->is_exhausted || run->generation > run->settings->generations) {
      error = run_phase(run, &end);
      continue;
    }
    error = run_generation(run);
    run->is_exhausted = error == MO_ERR_EXHAUSTED;
    if (error == MO_OK || run->is_exhausted)
      error = mo_store_campaign(run->jobs->store, run->id, &run->status);
  }
  return error;
}

/* Runs the pending batch of a study. Its commit puts the study back into the queue, where it waits
 * for its client, so there is no attempt left to end (MO_ERR_CONFLICT). */
static int run_batch(struct mo_campaign_run *run)
{
  int error = run_generation(run);
  if (error == MO_OK)
    error = mo_campaign_wait_for_commit(run);
  return error == MO_OK ? MO_ERR_CONFLICT : error;
}

/* Saves the results of a stopped run. */
static int save_rest(void *context)
{
  struct mo_campaign_run *run = context;
  int error = mo_campaign_wait_for_commit(run), learned;
  if (error != MO_OK)
    return error;
  error = mo_campaign_save_losses(run);
  learned = run->learning.learner.training != NULL ? mo_campaign_save_learning(run) : MO_OK;
  return error != MO_OK ? error : learned;
}

static void clean_up(void *context)
{
  struct mo_campaign_run *run = context;
  mo_campaign_writing_free(run);
  mo_campaign_free_scores(&run->scores);
  mo_campaign_free_learning(&run->learning);
  free_weights(run);
  mo_controller_free(run->controller);
  mo_seen_free(run->seen);
  mo_study_batch_free(run->batch);
  mo_exclusion_release(run);
  mo_environments_free(run->environments, run->n_environments);
  mo_campaign_free_rows(run);
}

static int run_campaign(struct mo_runner *runner, void *context)
{
  struct mo_campaign_run *run = context;
  run->runner = runner;
  run->jobs = runner->jobs;
  run->id = runner->id;
  run->settings = &run->status.record.settings;
  run->times.begin_us = run->times.progress_us = mo_clock_us();
  int error = mo_campaign_resume(run);
  if (error == MO_OK)
    error = run->mode->makes_children ? evolve(run) : run_batch(run);
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
             : mo_campaign_need(jobs, &status.record,
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
