/* evaluation_save.c: batches results into transactions; at most one save is in progress.
 *
 * Losses wait at most SAVE_EVERY_US; losses of interactive jobs do not wait. A save is one
 * transaction: the losses since the last save, the counts of their jobs, and the ends of jobs whose
 * last loss is included. If the disk is full, the save is kept and retried every second (retry_ms).
 * No new work starts during that time, or while the store is so slow that unsaved results would
 * fill the memory. */
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "jobs/evaluation.h"

#define EVENT_EVERY_US 1000000
#define SAVE_EVERY_US  100000
#define LOSSES_AT_ONCE 4096
#define LOSSES_BEHIND  16384
#define BYTES_BEHIND   (UINT64_C(64) << 20)

static uint64_t larger(uint64_t a, uint64_t b)
{
  return a > b ? a : b;
}

void mo_pending_touch(struct mo_evaluations *all)
{
  if (all->pending.since_us == 0)
    all->pending.since_us = mo_clock_us();
}

void *mo_pending_add(struct mo_evaluations *all, struct mo_rows *rows, const void *row, size_t size)
{
  if (rows->n == rows->room) {
    const size_t more = rows->room > 0 ? rows->room * 2 : 64;
    void *grown = realloc(rows->rows, more * size);
    if (grown == NULL)
      return NULL;
    rows->rows = grown;
    rows->room = more;
  }
  mo_pending_touch(all);
  return memcpy((uint8_t *)rows->rows + size * rows->n++, row, size);
}

struct mo_job_update *mo_pending_update(struct mo_evaluations *all, struct mo_active *active,
                                        enum mo_job_step step, int error, const char *text)
{
  struct mo_job_update update = {.job = active->id,
                                 .step = step,
                                 .total = active->total,
                                 .done = larger(active->done, active->done_before),
                                 .cached = larger(active->cached, active->cached_before),
                                 .diverged = larger(active->diverged, active->diverged_before),
                                 .cut = larger(active->cut, active->cut_before),
                                 .started_us = step == MO_STEP_START ? mo_clock_wall_us() : 0,
                                 .error = error,
                                 .max_attempts = MO_ATTEMPTS_MAX,
                                 .owner = active};
  struct mo_job_update *added;
  if (active->work != NULL) {
    update.fingerprint = active->work->fingerprint;
    update.workers = active->work->workers;
    update.positions = active->work->positions;
    update.n_designs = active->work->n_designs;
    update.n_environments = active->work->n_environments;
  }
  if (active->race != NULL && step == MO_STEP_SUCCEED)
    update.counted = active->race->asked;
  if ((active->race != NULL || active->climbs != NULL) && step == MO_STEP_SUCCEED)
    update.cut = active->cut; /* under a different class, there may have been more */
  if (text != NULL)
    snprintf(update.error_text, sizeof(update.error_text), "%s", text);
  added = mo_pending_add(all, &all->pending.updates, &update, sizeof(update));
  active->references += added != NULL;
  return added;
}

void mo_pending_clear(struct mo_pending *pending)
{
  struct mo_saved_trajectory *trajectories = pending->trajectories.rows;
  const struct mo_saved_block *blocks = pending->blocks.rows;
  struct mo_rows *const arrays[] = {&pending->blocks, &pending->trajectories, &pending->designs,
                                    &pending->updates};
  for (size_t i = 0; i < pending->trajectories.n; i++)
    mo_recording_free(&trajectories[i].recording);
  for (size_t i = 0; i < pending->blocks.n; i++)
    free(blocks[i].measures);
  for (size_t i = 0; i < sizeof(arrays) / sizeof(arrays[0]); i++)
    arrays[i]->n = 0;
  pending->rollouts = NULL;
  pending->n_losses = pending->recorded_bytes = 0;
  pending->since_us = 0;
  pending->urgent = false;
}

void mo_pending_free(struct mo_pending *pending)
{
  mo_pending_clear(pending);
  free(pending->blocks.rows);
  free(pending->trajectories.rows);
  free(pending->designs.rows);
  free(pending->updates.rows);
}

bool mo_saver_idle(const struct mo_evaluations *all)
{
  return !all->is_saving && all->saving.since_us == 0 && all->pending.since_us == 0;
}

bool mo_saver_is_behind(const struct mo_evaluations *all)
{
  const struct mo_pending *pending = &all->pending;
  if (all->saving.since_us != 0 && !all->is_saving)
    return true; /* the save failed and will be retried */
  return pending->n_losses + pending->designs.n >= LOSSES_BEHIND ||
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
  struct mo_pending *saving = &all->saving;
  int error;
  all->is_saving = true;
  saving->save = (struct mo_save){.blocks = saving->blocks.rows,
                                  .n_blocks = saving->blocks.n,
                                  .trajectories = saving->trajectories.rows,
                                  .n_trajectories = saving->trajectories.n,
                                  .designs = saving->designs.rows,
                                  .n_designs = saving->designs.n,
                                  .updates = saving->updates.rows,
                                  .n_updates = saving->updates.n,
                                  .done = save_done,
                                  .context = all};
  error = mo_store_save(all->jobs->store, &saving->save);
  if (error != MO_OK)
    save_done(&saving->save, error);
}

/* Adds the counts and ends of the jobs with pending losses. */
static void add_counts(struct mo_evaluations *all)
{
  int64_t now = mo_clock_us();
  for (struct mo_active *active = all->actives; active != NULL; active = active->next) {
    bool ended = !active->detached && active->done == active->total;
    struct mo_job_update *update;
    if (active->finishing || !(active->changed || ended))
      continue;
    update =
        mo_pending_update(all, active, ended ? MO_STEP_SUCCEED : MO_STEP_PROGRESS, MO_OK, NULL);
    if (update == NULL)
      continue; /* retried with the next save */
    active->changed = false;
    active->finishing = ended;
    update->quiet = !ended && now - active->last_event_us < EVENT_EVERY_US;
    if (!ended && !update->quiet)
      active->last_event_us = now;
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
  if (all->saving.since_us != 0) { /* retries a save that failed for lack of space */
    if (now < all->retry_save_us)
      return all->retry_save_us;
    start(all);
    return INT64_MAX;
  }
  if (all->pending.since_us == 0)
    return INT64_MAX;
  due = all->pending.since_us + SAVE_EVERY_US;
  if (!at_once && now < due && !all->pending.urgent && all->pending.n_losses < LOSSES_AT_ONCE &&
      !interactive_ended(all))
    return due;
  add_counts(all);
  swap = all->saving;
  all->saving = all->pending;
  all->pending = swap;
  start(all);
  return INT64_MAX;
}
