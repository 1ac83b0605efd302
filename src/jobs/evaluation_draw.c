/* evaluation_draw.c: stores the designs of large evaluations, and draws random ones, before the
 * evaluations are claimed.
 *
 * Storing a million designs takes about a minute of CPU time, so a submission stores only a
 * description of them: a seed, or a list of bits. One thread stores them in groups, each in its own
 * transaction, and between these transactions the store's writer serves other requests. A crash or
 * a pause loses at most one group. The random bodies before it must be redrawn, because whether a
 * body is new depends on them, but they are not stored again. Each evaluation is finished before
 * the next one begins, and the one with the fewest designs left comes next. */
#include <stdio.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/evaluation.h"
#include "jobs/submission.h"

static bool is_stopping(struct mo_runners *runners)
{
  MO_GUARD(&runners->mutex);
  return runners->stopping;
}

/* Draws the next n bodies. genotypes NULL: skips them. MO_ERR_CANCELLED: stopping. */
static int draw(struct mo_evaluations *all, struct mo_body_stream *stream, uint32_t n,
                struct mo_bits *genotypes)
{
  struct mo_bits passed;
  int error = MO_OK;
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    error =
        mo_body_stream_next(stream, genotypes != NULL ? genotypes[i].words : passed.words, NULL);
    if (error == MO_OK && i % MO_DESIGN_GROUP == 0 && is_stopping(all->runners))
      error = MO_ERR_CANCELLED;
  }
  return error;
}

/* Stores the next group, which begins with body `first`. stream NULL: the bodies are listed. */
static int store_group(struct mo_evaluations *all, struct mo_body_stream *stream, int64_t id,
                       uint32_t first, uint32_t n)
{
  struct mo_bits genotypes[MO_DESIGN_GROUP];
  struct mo_placed placed = {NULL, NULL};
  int error = stream != NULL ? draw(all, stream, n, genotypes)
                             : mo_store_waiting_designs(all->jobs->store, id, first, genotypes, n);
  if (stream == NULL && error == MO_ERR_NOT_FOUND)
    error = MO_ERR_CORRUPT;
  if (error == MO_OK && is_stopping(all->runners))
    error = MO_ERR_CANCELLED;
  if (error == MO_OK)
    error = mo_placed_create(all->jobs->lattice->workspace, genotypes, n, &placed);
  if (error == MO_OK)
    error = mo_store_group(all->jobs->store, id, first, placed.forms, placed.genotypes, n);
  mo_placed_free(&placed);
  return error;
}

/* Stores the rest of an evaluation. MO_ERR_CONFLICT: it was paused or cancelled. */
static int store_rest(struct mo_evaluations *all, int64_t id)
{
  struct mo_body_stream *stream = NULL;
  struct mo_job job;
  int error = mo_store_job(all->jobs->store, id, &job);
  if (error != MO_OK)
    return error;
  const uint32_t n_stored = job.n_designs - job.n_waiting;
  if (job.is_random)
    error = mo_body_stream_create(all->jobs->lattice->workspace, job.random_seed, &stream);
  if (job.is_random && error == MO_OK)
    error = draw(all, stream, job.random_first + n_stored, NULL);
  for (uint32_t first = n_stored, n; first < job.n_designs && error == MO_OK; first += n) {
    const uint32_t left = job.n_designs - first;
    n = left < MO_DESIGN_GROUP ? left : MO_DESIGN_GROUP;
    error = store_group(all, stream, id, first, n);
  }
  mo_body_stream_free(stream);
  return error;
}

/* Fails an evaluation with a damaged list, so that it does not block the others. */
static int fail_damaged(struct mo_evaluations *all, int64_t id)
{
  enum mo_job_state after = MO_JOB_QUEUED;
  const int error = mo_store_run_park(all->jobs->store, id, MO_ERR_CORRUPT,
                                      "its list of designs is damaged", 1, &after);
  if (error == MO_OK && after == MO_JOB_FAILED) {
    atomic_fetch_add(&all->jobs->jobs_failed, 1);
    mo_jobs_recount(all->jobs);
  }
  return error;
}

/* Returns whether the thread must wait after this error. */
static bool draw_next(struct mo_evaluations *all, bool *any)
{
  int64_t id = 0;
  int error = mo_store_waiting(all->jobs->store, &id);
  *any = error == MO_OK && id != 0;
  if (*any)
    error = store_rest(all, id);
  if (error == MO_ERR_CORRUPT && id != 0)
    error = fail_damaged(all, id);
  if (error == MO_OK && id != 0)
    mo_runners_wake(all->runners);
  const bool goes_on = error == MO_OK || error == MO_ERR_CONFLICT || error == MO_ERR_NOT_FOUND;
  pthread_mutex_lock(&all->runners->mutex);
  all->unstored = goes_on ? 0 : id;
  all->unstored_error = error;
  pthread_mutex_unlock(&all->runners->mutex);
  if (goes_on)
    return false;
  const struct mo_jobs_config *config = &all->jobs->config;
  if (error != MO_ERR_CANCELLED && !mo_is_shortage(error) && config->warn != NULL)
    config->warn(config->warn_context, id, error, "its designs could not be stored");
  return true;
}

bool mo_drawer_reason(struct mo_evaluations *all, int64_t id, char reason[160])
{
  MO_GUARD(&all->runners->mutex);
  if (all->unstored != id)
    return false;
  snprintf(reason, 160, "its designs cannot be stored now: %s",
           all->unstored_error == MO_ERR_NO_SPACE ? "the disk of the state folder is full"
                                                  : mo_error_text(all->unstored_error));
  return true;
}

static void *draw_all(void *context)
{
  struct mo_evaluations *all = context;
  struct mo_runners *runners = all->runners;
  uint64_t seen = UINT64_MAX, requests = 0; /* so that it checks at once */
  bool again = false;
  for (;;) {
    pthread_mutex_lock(&runners->mutex);
    const int64_t until_us = mo_clock_us() + (int64_t)all->jobs->config.retry_ms * 1000;
    while (!runners->stopping && runners->look == seen && runners->requests == requests)
      if (!again)
        pthread_cond_wait(&runners->news, &runners->mutex);
      else if (!mo_wait_until(&runners->news, &runners->mutex, until_us))
        break;
    seen = runners->look;
    requests = runners->requests;
    const bool stopping = runners->stopping;
    pthread_mutex_unlock(&runners->mutex);
    if (stopping)
      return NULL;
    bool any = true;
    for (again = false; any && !again;)
      again = draw_next(all, &any);
  }
}

int mo_drawer_start(struct mo_evaluations *all)
{
  all->draws = pthread_create(&all->drawer, NULL, draw_all, all) == 0;
  return all->draws ? MO_OK : MO_ERR_NO_MEMORY;
}

void mo_drawer_join(struct mo_evaluations *all)
{
  if (all->draws)
    pthread_join(all->drawer, NULL);
  all->draws = false;
}
