/* evaluation.c: the kind "evaluation": the thread that decides what is computed next.
 *
 * Each round takes finished blocks, requests and the result of a save from the inbox; claims queued
 * jobs while places are free; fills the back end's window, interactive jobs first; starts a save
 * when one is due; and sleeps until something arrives or is due. Each evaluation has its own share
 * of the back end, as training runs and campaigns do, and keeps a window of blocks in it. The back
 * end divides its time by the shares' weights. */
#include <stdlib.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/evaluation_climb.h"
#include "jobs/submission.h"

#define DESIGNS_A_ROUND 64 /* designs of each job per round */
#define ROUND_US        1000000
#define CLAIMS_MAX      1024
#define SHOW_US         250000 /* between two updates of a job's live figures */
/* Jobs that run concurrently. */
#define ACTIVE_BATCH_MAX       8
#define ACTIVE_INTERACTIVE_MAX 64

/* ---- active jobs ---- */

static void free_active(struct mo_evaluations *all, struct mo_active *active)
{
  mo_loaded_release(&all->jobs->controllers, active->controller);
  mo_work_free(active->work);
  mo_best_free(active->race);
  mo_climbs_free(active->climbs);
  mo_grid_free(&active->grid);
  mo_share_close(all->jobs, active->id);
  free(active);
}

/* Frees detached jobs without references once their counts are saved; after an error, only after a
 * delay. Such a job may be claimed again. Returns the time at which to call this next, or 0: at
 * once. */
static int64_t sweep(struct mo_evaluations *all)
{
  const int64_t now = mo_clock_us();
  int64_t next = INT64_MAX;
  struct mo_active **link = &all->actives;
  while (*link != NULL) {
    struct mo_active *active = *link;
    if (!active->detached || active->failing || active->changed || active->references > 0 ||
        active->window.n_flights > 0) {
      link = &active->next;
    } else if (active->until_us > now) {
      next = active->until_us < next ? active->until_us : next;
      link = &active->next;
    } else {
      *link = active->next;
      free_active(all, active);
      next = 0;
    }
  }
  return next;
}

static uint32_t count_active(const struct mo_evaluations *all, enum mo_urgency priority)
{
  uint32_t n = 0;
  for (const struct mo_active *active = all->actives; active != NULL; active = active->next)
    n += !active->detached && active->priority == priority;
  return n;
}

/* Returns whether a claimed job has more designs than can be listed. Only one such job runs at a
 * time, because all its designs are in memory. */
static bool has_large(const struct mo_evaluations *all)
{
  for (const struct mo_active *active = all->actives; active != NULL; active = active->next)
    if (active->work != NULL && active->work->job.n_designs > MO_DESIGNS_MAX)
      return true;
  return false;
}

static uint64_t count_blocks(const struct mo_evaluations *all)
{
  uint64_t n = 0;
  for (const struct mo_active *active = all->actives; active != NULL; active = active->next)
    n += active->window.n_flights;
  return n;
}

/* Returns whether an earlier claim of the job still exists. A resumed job is claimed only when its
 * earlier blocks have finished and are saved; otherwise they would be computed twice and counted
 * for another job. */
static bool is_held(const struct mo_evaluations *all, int64_t id)
{
  for (const struct mo_active *active = all->actives; active != NULL; active = active->next)
    if (active->id == id)
      return true;
  return false;
}

/* Marks the work that earlier claims of the job have done. */
static void mark_finished(struct mo_active *active)
{
  const struct mo_work *work = active->work;
  active->total = work->job.rollouts_total;
  active->private_runs = work->finished != NULL;
  if (!active->private_runs) {
    active->done_before = work->job.rollouts_done;
    active->cached_before = work->job.rollouts_cached;
    active->diverged_before = work->job.rollouts_diverged;
    active->cut_before = work->job.rollouts_cut;
    if (work->job.rollouts_done > work->job.rollouts_cached + work->job.rollouts_cut)
      active->own_before =
          work->job.rollouts_done - work->job.rollouts_cached - work->job.rollouts_cut;
    return;
  }
  for (uint32_t design = 0; design < work->n_designs; design++)
    for (uint32_t k = 0; k < work->n_environments; k++)
      if (work->finished[(size_t)design * work->n_environments + k])
        (void)mo_grid_finish(&active->grid, design, k);
  active->done = work->n_finished;
  active->diverged = work->n_finished_diverged;
}

static int load_active(struct mo_evaluations *all, struct mo_active *active, char text[256])
{
  const struct mo_work *work;
  const int64_t *cpu = all->jobs->classes.cpu;
  const struct mo_classes classes = {.cpu = {cpu[0], cpu[1]},
                                     .device = mo_back_end_fingerprint(all->jobs, MO_ON_DEVICE)};
  int error = mo_store_load_work(all->jobs->store, active->id, &classes, &active->work);
  snprintf(text, 256, "the job could not be prepared: %s",
           mo_error_text(error != MO_OK ? error : MO_ERR_NO_MEMORY));
  if (error != MO_OK)
    return error;
  work = active->work;
  active->grid = (struct mo_grid){.block = mo_block_of(all->jobs, &work->job),
                                  .genotypes = work->genotypes,
                                  .environments = work->environments,
                                  .n_designs = work->n_designs,
                                  .n_environments = work->n_environments,
                                  .n_sets = work->n_sets};
  active->grid.block.cancel = &active->cancel;
  error = mo_grid_create(&active->grid);
  if (error == MO_OK)
    error = mo_share_open(all->jobs, active->id, MO_JOB_EVALUATION, &active->grid.block.share);
  if (error != MO_OK)
    return error;
  mark_finished(active);
  if (work->fingerprint == 0 && active->done < active->total)
    return MO_ERR_DEVICE; /* this process does not know its class */
  error = mo_active_race(active);
  if (error == MO_OK)
    error = mo_active_climb(active);
  if (error != MO_OK)
    return error;
  mo_active_open_window(active);
  error = mo_loaded_acquire(&all->jobs->controllers, &active->work->job.controller_sha256,
                            &active->controller);
  if (error == MO_OK)
    active->grid.block.controller = active->controller->ready;
  if (mo_controller_is_unusable(error))
    mo_controller_describe_fault(&active->work->job.controller_sha256, "submit the job again",
                                 text);
  else
    snprintf(text, 256, "the controller could not be prepared: %s", mo_error_text(error));
  return error;
}

static bool claim_one(struct mo_evaluations *all, int64_t id, enum mo_urgency priority)
{
  struct mo_active *active = calloc(1, sizeof(*active));
  char text[256];
  int error;
  if (active == NULL)
    return false;
  active->all = all;
  active->id = id;
  active->priority = priority;
  active->last_event_us = mo_clock_us();
  error = load_active(all, active, text);
  active->next = all->actives;
  all->actives = active;
  if (mo_pending_update(all, active, MO_STEP_START, MO_OK, NULL) == NULL) {
    active->detached = true;
    return false;
  }
  if (error != MO_OK) {
    mo_active_fail(all, active, error, text);
  } else if (active->done == active->total) {
    mo_pending_touch(all); /* its last rollouts were saved, but not its end */
  }
  return true;
}

static void claim_priority(struct mo_evaluations *all, enum mo_urgency priority, uint32_t places)
{
  int64_t ids[CLAIMS_MAX];
  uint32_t n_active = count_active(all, priority);
  size_t limit = (size_t)n_active + places;
  int64_t n;
  if (n_active >= places)
    return;
  for (const struct mo_active *active = all->actives; active != NULL; active = active->next)
    limit += active->detached;
  const bool had_large = has_large(all);
  n = mo_store_queued(all->jobs->store, priority, 0, !had_large, ids,
                      limit < CLAIMS_MAX ? limit : CLAIMS_MAX);
  if (n < 0)
    all->look_again = true; /* within a second */
  for (int64_t i = 0; i < n && n_active < places; i++) {
    if (is_held(all, ids[i]))
      continue;
    if (!claim_one(all, ids[i], priority))
      return;
    n_active++;
    if (!had_large && has_large(all)) { /* the other jobs may be large as well */
      all->look_again = true;
      return;
    }
  }
}

/* ---- after a save ---- */

static void finish_update(struct mo_evaluations *all, struct mo_active *active,
                          const struct mo_job_update *update)
{
  switch (update->step) {
  case MO_STEP_START:
  case MO_STEP_PROGRESS:
    if (!update->applied)
      mo_active_detach(active); /* paused or cancelled by a request */
    break;
  case MO_STEP_SUCCEED:
    active->detached = true;
    if (update->applied) {
      atomic_fetch_add(&all->jobs->jobs_succeeded, 1);
      mo_jobs_closed(all->jobs, 1, mo_job_admitted(&active->work->job));
    }
    break;
  case MO_STEP_RETRY:
    active->failing = false;
    if (update->applied && update->state == MO_JOB_FAILED) {
      atomic_fetch_add(&all->jobs->jobs_failed, 1);
      if (active->work != NULL)
        mo_jobs_closed(all->jobs, 1, mo_job_admitted(&active->work->job));
      else
        mo_jobs_recount(all->jobs);
    } else {
      active->until_us = mo_clock_us() + (int64_t)all->jobs->config.retry_ms * 1000;
    }
    break;
  case MO_STEP_HALT: active->failing = false; break;
  case MO_STEP_PARK: break;
  }
}

static void finish_updates(struct mo_evaluations *all, int status)
{
  struct mo_pending *saving = &all->saving;
  while (saving->rollouts != NULL) {
    struct mo_rollout *rollout = saving->rollouts;
    saving->rollouts = rollout->next_save;
    mo_rollout_forget(all, rollout);
  }
  if (status != MO_OK)
    for (struct mo_active *active = all->actives; active != NULL; active = active->next)
      if (!active->detached)
        mo_active_fail(all, active, status, "its losses could not be saved");
  for (size_t i = 0; i < saving->updates.n; i++) {
    const struct mo_job_update *update = &saving->save.updates[i];
    struct mo_active *active = update->owner;
    if (status == MO_OK)
      finish_update(all, active, update);
    else if (update->step == MO_STEP_RETRY || update->step == MO_STEP_HALT)
      active->failing = mo_pending_update(all, active, update->step, update->error,
                                          update->error_text) != NULL; /* without results */
    active->references--;
  }
  mo_pending_clear(saving);
  all->look_again = true;
}

static void end_save(struct mo_evaluations *all, int status)
{
  all->is_saving = false;
  atomic_store(&all->jobs->no_space, status == MO_ERR_NO_SPACE);
  switch (status) {
  case MO_ERR_NO_SPACE:
  case MO_ERR_BUSY:
  case MO_ERR_NO_MEMORY:
    all->retry_save_us = mo_clock_us() + (int64_t)all->jobs->config.retry_ms * 1000;
    break;
  case MO_ERR_IO:
  case MO_ERR_CANCELLED: all->broken = true; break;
  default: finish_updates(all, status); break;
  }
}

/* ---- filling the window ---- */

/* Fills the window of one job. Returns true if its budget of designs is used up and work may be
 * left. */
static bool fill(struct mo_evaluations *all, struct mo_active *active)
{
  unsigned budget = DESIGNS_A_ROUND;
  int launched = 1;
  if (active->detached || active->finishing)
    return false;
  active->window.most = mo_back_end_window(all->jobs, active->work->job.back_end);
  while ((launched > 0 ||
          (launched == 0 && (mo_active_race_on(active) || mo_active_climb_on(active)))) &&
         !(active->work->job.record != 0 && mo_saver_is_full(all)))
    launched = mo_window_launch(&active->window, &budget);
  if (launched < 0)
    mo_active_fail(all, active, launched, mo_error_text(launched));
  return budget == 0;
}

/* ---- rounds ---- */

struct inbox {
  struct mo_flight *finished;
  bool look, requests, saved, stopping;
  int save_error;
};

static bool is_empty(const struct mo_evaluations *all)
{
  return all->inbox.finished == NULL && !all->saved && all->runners->look == all->seen &&
         all->runners->requests == all->seen_requests;
}

static void take_inbox(struct mo_evaluations *all, int64_t until_us, struct inbox *inbox)
{
  struct mo_runners *runners = all->runners;
  pthread_mutex_lock(&runners->mutex);
  while (is_empty(all) && mo_wait_until(&runners->news, &runners->mutex, until_us))
    ;
  *inbox = (struct inbox){.finished = all->inbox.finished,
                          .look = runners->look != all->seen,
                          .requests = runners->requests != all->seen_requests,
                          .saved = all->saved,
                          .stopping = runners->stopping,
                          .save_error = all->save_error};
  all->inbox.finished = NULL;
  all->saved = false;
  all->seen = runners->look;
  all->seen_requests = runners->requests;
  pthread_mutex_unlock(&runners->mutex);
}

/* Reads whether the job was paused or cancelled, because a request only means that some job has
 * changed. If the job is resumed before a save in progress has written its start, the database says
 * "running" although no thread runs it, so requeue it. Requeueing a paused or cancelled job is a
 * no-op. */
static int review(struct mo_evaluations *all, struct mo_active *active)
{
  struct mo_job job;
  const int error = mo_store_job(all->jobs->store, active->id, &job);
  if (error != MO_OK)
    return error;
  if (job.state != MO_JOB_RUNNING && job.state != MO_JOB_QUEUED) { /* its start may be unsaved */
    mo_active_detach(active); /* a block may take minutes; it is recomputed after a pause */
    (void)mo_pending_update(all, active, MO_STEP_PARK, MO_OK, NULL);
  }
  return MO_OK;
}

static void review_all(struct mo_evaluations *all)
{
  all->review_again = false;
  for (struct mo_active *active = all->actives; active != NULL; active = active->next)
    if (!active->detached && review(all, active) != MO_OK)
      all->review_again = true; /* within a second */
  all->look_again = true;
}

/* Lets the jobs repeat the look-ups that they have deferred. */
static void visit_again(struct mo_evaluations *all)
{
  for (struct mo_active *active = all->actives; active != NULL; active = active->next)
    if (active->has_deferred) {
      active->has_deferred = false;
      active->grid.cursor = 0;
    }
  all->visit_again = false;
}

/* Claims jobs and launches blocks, interactive jobs first. Returns whether more can be done at
 * once. */
static bool launch_more(struct mo_evaluations *all, bool look)
{
  bool more = false;
  if (look) {
    claim_priority(all, MO_INTERACTIVE, ACTIVE_INTERACTIVE_MAX);
    claim_priority(all, MO_BATCH, ACTIVE_BATCH_MAX);
  }
  for (int priority = MO_INTERACTIVE; priority >= MO_BATCH; priority--)
    for (struct mo_active *active = all->actives; active != NULL; active = active->next)
      if ((int)active->priority == priority && !mo_saver_is_behind(all))
        more = fill(all, active) || more;
  return more;
}

/* Runs one round of stopping. Returns true when everything is done. */
static bool wind_down(struct mo_evaluations *all, bool *parked)
{
  for (struct mo_active *active = all->actives; active != NULL; active = active->next)
    __atomic_store_n(&active->cancel, 1, __ATOMIC_RELAXED);
  if (count_blocks(all) > 0)
    return false;
  if (!*parked) {
    for (struct mo_active *active = all->actives; active != NULL; active = active->next)
      if (!active->detached && !active->finishing && active->done < active->total)
        (void)mo_pending_update(all, active, MO_STEP_PARK, MO_OK, NULL);
    *parked = true;
  }
  return mo_saver_idle(all) ||
         (!all->is_saving &&
          (atomic_load(&all->jobs->abandon) || all->broken || atomic_load(&all->jobs->no_space)));
}

/* Shows the progress of a job. */
static void show(struct mo_evaluations *all, struct mo_active *active)
{
  const int64_t now_us = mo_clock_us();
  struct mo_live live = {.phase = MO_PHASE_IDLE, .seconds_left = -1};
  if (!active->detached) {
    if (now_us - active->shown_us < SHOW_US)
      return;
    active->shown_us = now_us;
    live = (struct mo_live){.phase = MO_PHASE_SCORE,
                            .done = active->done > active->done_before ? active->done
                                                                       : active->done_before,
                            .total = active->total,
                            .rate = mo_pace_rate(&active->pace, now_us)};
    const double left = mo_active_left(active, live.done);
    live.seconds_left = live.rate > 0 && left >= 0 ? left / live.rate : -1;
  }
  mo_share_show(all->jobs, active->id, &live);
}

static void publish(struct mo_evaluations *all)
{
  for (struct mo_active *active = all->actives; active != NULL; active = active->next)
    show(all, active);
  atomic_store(&all->jobs->active_batch, count_active(all, MO_BATCH));
  atomic_store(&all->jobs->active_interactive, count_active(all, MO_INTERACTIVE));
  atomic_store(&all->jobs->blocks_in_flight, count_blocks(all));
  atomic_store(&all->jobs->heartbeat_us, mo_clock_us());
}

static void *serve(void *context)
{
  struct mo_evaluations *all = ((struct mo_runner *)context)->jobs->evaluations;
  int64_t until = 0;
  bool parked = false;
  for (;;) {
    struct inbox inbox;
    int64_t due, next;
    bool more = false;
    take_inbox(all, until, &inbox);
    while (inbox.finished != NULL) {
      struct mo_flight *flight = inbox.finished;
      inbox.finished = flight->next;
      mo_active_take_back(all, flight);
    }
    if (inbox.requests || all->review_again)
      review_all(all);
    if (inbox.saved)
      end_save(all, inbox.save_error);
    if (all->visit_again)
      visit_again(all);
    inbox.look = inbox.look || all->look_again;
    all->look_again = false;
    if (inbox.stopping) {
      if (wind_down(all, &parked))
        break;
    } else if (!all->broken && !atomic_load(&all->jobs->no_space)) {
      more = launch_more(all, inbox.look);
    }
    due = mo_saver_run(all, inbox.stopping);
    next = sweep(all);
    all->look_again = all->look_again || next == 0;
    publish(all);
    until = mo_clock_us() + (more ? 0 : ROUND_US);
    if (due < until)
      until = due;
    if (next < until)
      until = next;
  }
  publish(all);
  return NULL;
}

/* ---- the kind ---- */

static int open_all(struct mo_jobs *jobs)
{
  struct mo_evaluations *all = calloc(1, sizeof(*all));
  if (all == NULL)
    return MO_ERR_NO_MEMORY;
  all->jobs = jobs;
  all->runners = &jobs->runners[MO_JOB_EVALUATION];
  all->inbox = (struct mo_inbox){.mutex = &all->runners->mutex, .news = &all->runners->news};
  all->look_again = true;
  jobs->evaluations = all;
  return mo_drawer_start(all);
}

static void free_rollouts(struct mo_pending *pending)
{
  while (pending->rollouts != NULL) {
    struct mo_rollout *rollout = pending->rollouts;
    pending->rollouts = rollout->next_save;
    free(rollout);
  }
  mo_pending_free(pending);
}

static void close_all(struct mo_jobs *jobs)
{
  struct mo_evaluations *all = jobs->evaluations;
  if (all == NULL)
    return;
  mo_drawer_join(all);
  free_rollouts(&all->saving);
  free_rollouts(&all->pending);
  while (all->actives != NULL) {
    struct mo_active *active = all->actives;
    all->actives = active->next;
    free_active(all, active);
  }
  free(all);
}

const struct mo_kind mo_evaluation_kind = {
    .kind = MO_JOB_EVALUATION, .open = open_all, .close = close_all, .serve = serve};
