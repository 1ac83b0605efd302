/* scheduler.c: the thread that decides what is computed next.
 *
 * Each round takes finished blocks, requests and the result of a save from the inbox; claims queued
 * jobs while places are free; fills the back end's window, interactive jobs first; starts a save
 * when one is due; and sleeps until news or the next due time. Among jobs of one priority, the job
 * with the least virtual time goes next. A block advances the virtual time of its job by rollouts ×
 * steps / weight. A new job starts at the virtual time of the running ones, so that no job waits
 * for the others to end. The back end divides its time between all evaluations together and the
 * trainings and campaigns; the share of evaluations weighs as much as they do. */
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "jobs/internal.h"

#include "base/clock.h"

#define DESIGNS_A_ROUND 256
#define ROUND_US        1000000
#define CLAIMS_MAX      1024

void mo_jobs_wake(struct mo_jobs *jobs)
{
  pthread_mutex_lock(&jobs->mutex);
  jobs->look = true;
  pthread_cond_signal(&jobs->news);
  pthread_mutex_unlock(&jobs->mutex);
}

void mo_jobs_closed(struct mo_jobs *jobs, uint64_t rollouts)
{
  pthread_mutex_lock(&jobs->admission_mutex);
  jobs->open_jobs -= jobs->open_jobs > 0;
  jobs->open_rollouts -= rollouts < jobs->open_rollouts ? rollouts : jobs->open_rollouts;
  pthread_mutex_unlock(&jobs->admission_mutex);
}

/* ---- active jobs ---- */

struct mo_active *mo_active_find(struct mo_jobs *jobs, int64_t id)
{
  for (struct mo_active *active = jobs->actives; active != NULL; active = active->next)
    if (active->id == id && (!active->detached || active->failing))
      return active;
  return NULL;
}

static void free_active(struct mo_jobs *jobs, struct mo_active *active)
{
  mo_loaded_release(jobs, active->controller);
  mo_work_free(active->work);
  free(active->cells);
  free(active->left);
  free(active);
}

void mo_active_release(struct mo_jobs *jobs, struct mo_active *active)
{
  if (active->references > 0)
    active->references--;
  (void)jobs; /* sweep() frees the job outside of loops over the list */
}

void mo_actives_free_all(struct mo_jobs *jobs)
{
  while (jobs->actives != NULL) {
    struct mo_active *active = jobs->actives;
    jobs->actives = active->next;
    free_active(jobs, active);
  }
}

/* Frees the detached jobs that have no references and whose counts are saved. Returns whether there
 * was one, because the same job may be claimed again. */
static bool sweep(struct mo_jobs *jobs)
{
  struct mo_active **link = &jobs->actives;
  bool freed = false;
  while (*link != NULL) {
    struct mo_active *active = *link;
    if (active->detached && !active->failing && !active->changed && active->references == 0) {
      *link = active->next;
      free_active(jobs, active);
      freed = true;
    } else {
      link = &active->next;
    }
  }
  return freed;
}

void mo_active_fail(struct mo_jobs *jobs, struct mo_active *active, int error, const char *text)
{
  if (active->detached)
    return;
  active->detached = true;
  char loss[256];
  if (error == MO_ERR_DEVICE) {
    mo_back_end_describe_loss(jobs, loss, sizeof(loss));
    text = loss;
  }
  if (jobs->config.warn != NULL)
    jobs->config.warn(jobs->config.warn_context, active->id, error, text);
  active->failing =
      mo_pending_update(jobs, active, error == MO_ERR_DEVICE ? MO_STEP_HALT : MO_STEP_RETRY, error,
                        text) == MO_OK;
  mo_flights_cancel(jobs, false);
}

enum mo_lane mo_lane_of(enum mo_urgency priority, enum mo_back_end back_end)
{
  return back_end == MO_ON_DEVICE     ? MO_LANE_DEVICE
         : priority == MO_INTERACTIVE ? MO_LANE_INTERACTIVE
                                      : MO_LANE_BATCH;
}

static enum mo_lane lane_of(const struct mo_active *active)
{
  return mo_lane_of(active->priority, active->back_end);
}

static uint32_t count_active(const struct mo_jobs *jobs, enum mo_urgency priority)
{
  uint32_t n = 0;
  for (const struct mo_active *active = jobs->actives; active != NULL; active = active->next)
    n += !active->detached && active->priority == priority;
  return n;
}

/* Returns whether an earlier claim of the job still exists. A resumed job is claimed only when its
 * earlier blocks have finished and are saved; otherwise they would be computed twice and counted as
 * another job's. */
static bool is_held(const struct mo_jobs *jobs, int64_t id)
{
  for (const struct mo_active *active = jobs->actives; active != NULL; active = active->next)
    if (active->id == id)
      return true;
  return false;
}

static bool is_delayed(const struct mo_jobs *jobs, int64_t id)
{
  for (unsigned i = 0; i < jobs->n_delayed; i++)
    if (jobs->delayed[i].id == id)
      return true;
  return false;
}

/* Marks what earlier claims of the job have done. */
static void mark_finished(struct mo_active *active)
{
  const struct mo_work *work = active->work;
  memset(active->left, (int)work->n_environments, work->n_designs);
  active->total = work->job.rollouts_total;
  active->private_runs = work->finished != NULL;
  if (!active->private_runs) {
    active->done_before = work->job.rollouts_done;
    active->cached_before = work->job.rollouts_cached;
    active->diverged_before = work->job.rollouts_diverged;
    if (work->job.rollouts_done > work->job.rollouts_cached)
      active->own_before = work->job.rollouts_done - work->job.rollouts_cached;
    return;
  }
  for (size_t cell = 0; cell < active->total; cell++)
    if (work->finished[cell]) {
      active->cells[cell] = MO_CELL_DONE;
      active->left[cell / work->n_environments]--;
    }
  active->done = work->n_finished;
  active->diverged = work->n_finished_diverged;
}

static int load_active(struct mo_jobs *jobs, struct mo_active *active, char text[256])
{
  char digits[MO_SHA256_DIGITS + 1];
  int error = mo_store_load_work(jobs->store, active->id, &jobs->classes, &active->work);
  snprintf(text, 256, "the job could not be prepared: %s", mo_error_text(error));
  if (error != MO_OK)
    return error;
  active->cells = calloc(active->work->job.rollouts_total, 1);
  active->left = calloc(active->work->n_designs, 1);
  if (active->cells == NULL || active->left == NULL) {
    snprintf(text, 256, "the job could not be prepared: %s", mo_error_text(MO_ERR_NO_MEMORY));
    return MO_ERR_NO_MEMORY;
  }
  active->weight = active->work->job.weight;
  active->back_end = active->work->job.back_end;
  mark_finished(active);
  error = mo_loaded_acquire(jobs, &active->work->job.controller_sha256, &active->controller);
  if (error == MO_ERR_CORRUPT || error == MO_ERR_IO || error == MO_ERR_FORMAT) {
    mo_sha256_to_hex(&active->work->job.controller_sha256, digits);
    snprintf(text, 256,
             "the file controllers/%s.safetensors is missing, damaged or unreadable: store the "
             "same file again (PUT "
             "/v1/controllers/<name>), then submit again",
             digits);
  } else {
    snprintf(text, 256, "the controller could not be prepared: %s", mo_error_text(error));
  }
  return error;
}

static bool claim_one(struct mo_jobs *jobs, int64_t id, enum mo_urgency priority)
{
  struct mo_active *active = calloc(1, sizeof(*active));
  char text[256];
  int error;
  if (active == NULL)
    return false;
  active->id = id;
  active->priority = priority;
  active->weight = 1;
  active->last_event_us = mo_clock_us();
  error = load_active(jobs, active, text);
  active->pass = jobs->pass[lane_of(active)];
  active->next = jobs->actives;
  jobs->actives = active;
  if (mo_pending_update(jobs, active, MO_STEP_START, MO_OK, NULL) != MO_OK) {
    active->detached = true;
    return false;
  }
  if (error != MO_OK) {
    mo_active_fail(jobs, active, error, text);
  } else if (active->done == active->total) {
    mo_pending_touch(jobs); /* its last rollouts were saved, but not its end */
  }
  return true;
}

static void claim_priority(struct mo_jobs *jobs, enum mo_urgency priority, uint32_t places)
{
  int64_t ids[CLAIMS_MAX];
  uint32_t n_active = count_active(jobs, priority);
  size_t limit = (size_t)n_active + jobs->n_delayed + places;
  int64_t n;
  if (n_active >= places)
    return;
  for (const struct mo_active *active = jobs->actives; active != NULL; active = active->next)
    limit += active->detached;
  n = mo_store_queued(jobs->store, priority, 0, ids, limit < CLAIMS_MAX ? limit : CLAIMS_MAX);
  if (n < 0)
    jobs->look_again = true; /* within a second */
  for (int64_t i = 0; i < n && n_active < places; i++) {
    if (is_held(jobs, ids[i]) || is_delayed(jobs, ids[i]))
      continue;
    if (!claim_one(jobs, ids[i], priority))
      return;
    n_active++;
  }
}

/* Releases the jobs whose delay after an error is over. Returns the next such time. */
static int64_t release_delayed(struct mo_jobs *jobs)
{
  int64_t now = mo_clock_us(), next = INT64_MAX;
  for (unsigned i = 0; i < jobs->n_delayed;) {
    if (jobs->delayed[i].until_us <= now) {
      jobs->delayed[i] = jobs->delayed[--jobs->n_delayed];
      jobs->look_again = true;
      continue;
    }
    if (jobs->delayed[i].until_us < next)
      next = jobs->delayed[i].until_us;
    i++;
  }
  return next;
}

/* ---- filling the window ---- */

static struct mo_active *pick(struct mo_jobs *jobs, enum mo_lane lane)
{
  const bool is_full = mo_saver_is_full(jobs);
  struct mo_active *best = NULL;
  for (struct mo_active *active = jobs->actives; active != NULL; active = active->next)
    if (!active->detached && !active->finishing && lane_of(active) == lane &&
        !(is_full && (active->work->job.record_com || active->work->job.record_masses)) &&
        active->cursor < active->work->n_designs && (best == NULL || active->pass < best->pass))
      best = active;
  return best;
}

/* true: the round's budget of designs is used up, and work is left. */
static bool fill(struct mo_jobs *jobs, enum mo_lane lane, uint32_t window)
{
  unsigned budget = DESIGNS_A_ROUND;
  while (jobs->n_flights[lane] < window) {
    struct mo_active *active = pick(jobs, lane);
    if (active == NULL)
      return false;
    jobs->pass[lane] = active->pass;
    (void)mo_active_advance(jobs, active, &budget);
    if (budget == 0)
      return true;
  }
  return false;
}

/* ---- rounds ---- */

struct inbox {
  struct mo_flight *finished;
  struct mo_wish *wishes;
  bool look, saved, stopping, abandon;
  int save_status;
};

static void take_inbox(struct mo_jobs *jobs, int64_t until_us, struct inbox *inbox)
{
  struct timespec deadline = {.tv_sec = until_us / 1000000, .tv_nsec = (until_us % 1000000) * 1000};
  pthread_mutex_lock(&jobs->mutex);
  while (jobs->finished == NULL && jobs->wishes == NULL && !jobs->look && !jobs->saved)
    if (pthread_cond_timedwait(&jobs->news, &jobs->mutex, &deadline) == ETIMEDOUT)
      break;
  *inbox = (struct inbox){.finished = jobs->finished,
                          .wishes = jobs->wishes,
                          .look = jobs->look,
                          .saved = jobs->saved,
                          .stopping = jobs->stopping,
                          .abandon = jobs->abandon,
                          .save_status = jobs->save_status};
  jobs->finished = NULL;
  jobs->wishes = NULL;
  jobs->look = jobs->saved = false;
  pthread_mutex_unlock(&jobs->mutex);
}

/* A pause request can arrive after the job was resumed, or before its start was committed. The
 * database would then say "running" although no thread runs the job, so requeue it. Requeueing a
 * paused or cancelled job is a no-op. */
static void detach(struct mo_jobs *jobs, const struct mo_wish *wish)
{
  struct mo_active *active = mo_active_find(jobs, wish->id);
  if (active != NULL && !active->detached) {
    active->detached = true;
    (void)mo_pending_update(jobs, active, MO_STEP_PARK, MO_OK, NULL);
  }
  mo_flights_cancel(jobs, false); /* a block may take minutes; it is computed again after a pause */
}

/* Changes the weight of a job, and keeps its lead or lag in rollout steps. */
static void reweigh(struct mo_jobs *jobs, int64_t id)
{
  struct mo_active *active = mo_active_find(jobs, id);
  struct mo_job job;
  double lead;
  if (active == NULL || mo_store_job(jobs->store, id, &job) != MO_OK)
    return;
  lead = (active->pass - jobs->pass[lane_of(active)]) * active->weight;
  active->weight = job.weight;
  active->pass = jobs->pass[lane_of(active)] + lead / active->weight;
}

static void take_in(struct mo_jobs *jobs, struct inbox *inbox)
{
  while (inbox->finished != NULL) {
    struct mo_flight *flight = inbox->finished;
    inbox->finished = flight->next_inbox;
    mo_flight_land(jobs, flight);
  }
  while (inbox->wishes != NULL) {
    struct mo_wish *wish = inbox->wishes;
    inbox->wishes = wish->next;
    if (wish->weigh)
      reweigh(jobs, wish->id);
    else
      detach(jobs, wish);
    inbox->look = inbox->look || !wish->weigh;
    free(wish);
  }
  if (inbox->saved)
    mo_saver_finished(jobs, inbox->save_status);
}

static void weigh_evaluations(struct mo_jobs *jobs)
{
  double sum = 0;
  for (const struct mo_active *active = jobs->actives; active != NULL; active = active->next)
    if (!active->detached && active->priority == MO_BATCH)
      sum += active->weight;
  if (sum <= 0 || sum == jobs->evaluations_weight)
    return;
  jobs->evaluations_weight = sum;
  mo_compute_share_set_weight(jobs->evaluations, sum);
}

/* Claims jobs and launches blocks. Returns whether more can be done at once. */
static bool go_on(struct mo_jobs *jobs, bool look)
{
  bool more;
  if (look) {
    claim_priority(jobs, MO_INTERACTIVE, jobs->config.max_active_interactive);
    claim_priority(jobs, MO_BATCH, jobs->config.max_active_batch);
  }
  weigh_evaluations(jobs);
  if (mo_saver_is_behind(jobs))
    return false;
  more = fill(jobs, MO_LANE_INTERACTIVE, jobs->config.window_interactive);
  more = fill(jobs, MO_LANE_DEVICE, jobs->config.window_device) || more;
  return fill(jobs, MO_LANE_BATCH, jobs->config.window_batch) || more;
}

/* Runs one round of stopping. true: all is done. */
static bool wind_down(struct mo_jobs *jobs, bool abandon, bool *parked)
{
  mo_flights_cancel(jobs, true);
  if (jobs->flights != NULL)
    return false;
  if (!*parked) {
    for (struct mo_active *active = jobs->actives; active != NULL; active = active->next)
      if (!active->detached && !active->finishing && active->done < active->total)
        (void)mo_pending_update(jobs, active, MO_STEP_PARK, MO_OK, NULL);
    *parked = true;
  }
  return mo_saver_idle(jobs) ||
         (!jobs->save_under_way && (abandon || jobs->broken || atomic_load(&jobs->no_space)));
}

static void publish(struct mo_jobs *jobs)
{
  atomic_store(&jobs->active_batch, count_active(jobs, MO_BATCH));
  atomic_store(&jobs->active_interactive, count_active(jobs, MO_INTERACTIVE));
  atomic_store(&jobs->heartbeat_us, mo_clock_us());
}

void *mo_scheduler_loop(void *context)
{
  struct mo_jobs *jobs = context;
  int64_t until = 0;
  bool parked = false;
  for (;;) {
    struct inbox inbox;
    int64_t due, retry;
    bool more = false;
    take_inbox(jobs, until, &inbox);
    take_in(jobs, &inbox);
    retry = release_delayed(jobs);
    inbox.look = inbox.look || jobs->look_again;
    jobs->look_again = false;
    if (inbox.stopping) {
      if (wind_down(jobs, inbox.abandon, &parked))
        break;
    } else if (!jobs->broken && !atomic_load(&jobs->no_space)) {
      more = go_on(jobs, inbox.look);
    }
    due = mo_saver_run(jobs, inbox.stopping);
    if (sweep(jobs))
      more = jobs->look_again = true;
    publish(jobs);
    until = mo_clock_us() + (more ? 0 : ROUND_US);
    if (due < until)
      until = due;
    if (retry < until)
      until = retry;
  }
  publish(jobs);
  pthread_mutex_lock(&jobs->mutex);
  jobs->stopped = true;
  pthread_cond_broadcast(&jobs->stop_done);
  pthread_mutex_unlock(&jobs->mutex);
  return NULL;
}
