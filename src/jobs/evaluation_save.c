/* evaluation_save.c: batches results into transactions; at most one save is in progress.
 *
 * Losses wait at most save_interval_ms; losses of interactive jobs do not wait. A save is one
 * transaction: the losses since the last save, the counts of their jobs, and the ends of jobs whose
 * last loss is included. If the disk is full, the save is kept and tried again every second
 * (retry_ms). No new work starts meanwhile, nor while the store is so slow that unsaved results
 * would fill the memory. */
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "jobs/evaluation.h"

#define EVENT_EVERY_US 1000000
#define SCORES_AT_ONCE 4096
#define SCORES_BEHIND  16384
#define BYTES_BEHIND   (UINT64_C(64) << 20)

static uint64_t larger(uint64_t a, uint64_t b)
{
  return a > b ? a : b;
}

/* Grows an array for one more element. */
static bool grow(void **array, size_t n, size_t *room, size_t size)
{
  size_t more;
  void *grown;
  if (n < *room)
    return true;
  more = *room > 0 ? *room * 2 : 64;
  grown = realloc(*array, more * size);
  if (grown == NULL)
    return false;
  *array = grown;
  *room = more;
  return true;
}

void mo_pending_touch(struct mo_evaluations *all)
{
  if (all->pending.since_us == 0)
    all->pending.since_us = mo_clock_us();
}

int mo_pending_score(struct mo_evaluations *all, const struct mo_saved_score *score)
{
  struct mo_pending *pending = &all->pending;
  void *array = pending->save.scores;
  bool grown = grow(&array, pending->save.n_scores, &pending->scores_room, sizeof(*score));
  pending->save.scores = array;
  if (!grown)
    return MO_ERR_NO_MEMORY;
  pending->save.scores[pending->save.n_scores++] = *score;
  mo_pending_touch(all);
  return MO_OK;
}

int mo_pending_design(struct mo_evaluations *all, const struct mo_saved_design *design)
{
  struct mo_pending *pending = &all->pending;
  void *array = pending->save.designs;
  bool grown = grow(&array, pending->save.n_designs, &pending->designs_room, sizeof(*design));
  pending->save.designs = array;
  if (!grown)
    return MO_ERR_NO_MEMORY;
  pending->save.designs[pending->save.n_designs++] = *design;
  mo_pending_touch(all);
  return MO_OK;
}

int mo_pending_trajectory(struct mo_evaluations *all, const struct mo_saved_trajectory *trajectory)
{
  struct mo_pending *pending = &all->pending;
  void *array = pending->save.trajectories;
  bool grown =
      grow(&array, pending->save.n_trajectories, &pending->trajectories_room, sizeof(*trajectory));
  pending->save.trajectories = array;
  if (!grown)
    return MO_ERR_NO_MEMORY;
  pending->save.trajectories[pending->save.n_trajectories++] = *trajectory;
  pending->recorded_bytes +=
      (uint64_t)trajectory->frames * ((trajectory->com_m != NULL ? 24 : 0) +
                                      (trajectory->mass_m != NULL ? trajectory->n_masses * 12 : 0));
  mo_pending_touch(all);
  return MO_OK;
}

int mo_pending_update(struct mo_evaluations *all, struct mo_active *active, enum mo_job_step step,
                      int error, const char *text)
{
  struct mo_pending *pending = &all->pending;
  size_t n = pending->save.n_updates;
  void *updates = pending->save.updates, *owners = pending->owners;
  struct mo_job_update *update;
  bool grown = grow(&updates, n, &pending->updates_room, sizeof(*update));
  pending->save.updates = updates;
  if (grown)
    grown = grow(&owners, n, &pending->owners_room, sizeof(struct mo_active *));
  pending->owners = owners;
  if (!grown)
    return MO_ERR_NO_MEMORY;
  update = &pending->save.updates[n];
  *update = (struct mo_job_update){.job = active->id,
                                   .step = step,
                                   .total = active->total,
                                   .done = larger(active->done, active->done_before),
                                   .cached = larger(active->cached, active->cached_before),
                                   .diverged = larger(active->diverged, active->diverged_before),
                                   .started_us = step == MO_STEP_START ? mo_clock_wall_us() : 0,
                                   .error = error,
                                   .max_attempts = all->jobs->config.max_attempts};
  if (text != NULL)
    snprintf(update->error_text, sizeof(update->error_text), "%s", text);
  pending->owners[n] = active;
  pending->save.n_updates++;
  active->references++;
  mo_pending_touch(all);
  return MO_OK;
}

/* Empties the batch but keeps its arrays. */
void mo_pending_clear(struct mo_pending *pending)
{
  for (size_t i = 0; i < pending->save.n_trajectories; i++) {
    free((void *)pending->save.trajectories[i].com_m);
    free((void *)pending->save.trajectories[i].mass_m);
  }
  pending->save.n_scores = pending->save.n_trajectories = pending->save.n_designs =
      pending->save.n_updates = 0;
  pending->rollouts = NULL;
  pending->recorded_bytes = 0;
  pending->since_us = 0;
  pending->urgent = false;
}

void mo_pending_free(struct mo_pending *pending)
{
  mo_pending_clear(pending);
  free(pending->save.scores);
  free(pending->save.trajectories);
  free(pending->save.designs);
  free(pending->save.updates);
  free(pending->owners);
  memset(pending, 0, sizeof(*pending));
}

bool mo_saver_idle(const struct mo_evaluations *all)
{
  return !all->is_saving && all->saving.since_us == 0 && all->pending.since_us == 0;
}

bool mo_saver_is_behind(const struct mo_evaluations *all)
{
  const struct mo_pending *pending = &all->pending;
  if (all->saving.since_us != 0 && !all->is_saving)
    return true; /* the save failed and will be tried again */
  return pending->save.n_scores + pending->save.n_designs >= SCORES_BEHIND ||
         pending->recorded_bytes >= BYTES_BEHIND;
}

bool mo_saver_is_full(const struct mo_evaluations *all)
{
  const uint64_t most =
      all->jobs->config.max_memory > 0 ? all->jobs->config.max_memory / 8 : BYTES_BEHIND;
  return all->recording_bytes + all->pending.recorded_bytes + all->saving.recorded_bytes >=
         (most < BYTES_BEHIND ? most : BYTES_BEHIND);
}

static void save_done(struct mo_save *save, int status)
{
  struct mo_evaluations *all = save->context;
  pthread_mutex_lock(&all->runners->mutex);
  all->saved = true;
  all->save_error = status;
  pthread_cond_broadcast(&all->runners->news);
  pthread_mutex_unlock(&all->runners->mutex);
}

static void start(struct mo_evaluations *all)
{
  int error;
  all->is_saving = true;
  all->saving.save.done = save_done;
  all->saving.save.context = all;
  error = mo_store_save(all->jobs->store, &all->saving.save);
  if (error != MO_OK)
    save_done(&all->saving.save, error);
}

/* Adds the counts and ends of the jobs whose losses are pending. */
static void add_counts(struct mo_evaluations *all)
{
  int64_t now = mo_clock_us();
  for (struct mo_active *active = all->actives; active != NULL; active = active->next) {
    bool ended = !active->detached && active->done == active->total;
    int error;
    if (active->finishing || !(active->changed || ended))
      continue;
    error = mo_pending_update(all, active, ended ? MO_STEP_SUCCEED : MO_STEP_PROGRESS, MO_OK, NULL);
    if (error != MO_OK)
      continue; /* retried with the next save */
    active->changed = false;
    active->finishing = ended;
    if (!ended) {
      bool loud = now - active->last_event_us >= EVENT_EVERY_US;
      all->pending.save.updates[all->pending.save.n_updates - 1].quiet = !loud;
      if (loud)
        active->last_event_us = now;
    }
  }
}

static bool interactive_ended(const struct mo_evaluations *all)
{
  for (const struct mo_active *active = all->actives; active != NULL; active = active->next)
    if (!active->detached && !active->finishing && active->priority == MO_INTERACTIVE &&
        active->done == active->total)
      return true;
  return false;
}

int64_t mo_saver_run(struct mo_evaluations *all, bool at_once)
{
  int64_t now = mo_clock_us();
  int64_t due;
  struct mo_pending swap;
  if (all->is_saving || all->broken)
    return INT64_MAX;
  if (all->saving.since_us != 0) { /* a save that failed for lack of space */
    if (now < all->retry_save_us)
      return all->retry_save_us;
    start(all);
    return INT64_MAX;
  }
  if (all->pending.since_us == 0)
    return INT64_MAX;
  due = all->pending.since_us + (int64_t)all->jobs->config.save_interval_ms * 1000;
  if (!at_once && now < due && !all->pending.urgent &&
      all->pending.save.n_scores < SCORES_AT_ONCE && !interactive_ended(all))
    return due;
  add_counts(all);
  swap = all->saving;
  all->saving = all->pending;
  all->pending = swap;
  start(all);
  return INT64_MAX;
}
