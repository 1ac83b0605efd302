/* memory.c: estimates the memory of jobs with their own thread before they start, so that all
 * running jobs fit into `max_memory`.
 *
 * A job starts when it fits in addition to the running ones. Until then it stays queued, with a
 * reason. At most OVERTAKEN_MAX later jobs that fit may start before it; after that, all later jobs
 * wait for it. Submission rejects a job that would not fit even alone. If such a job was stored
 * under a higher limit, it waits, and no other job waits for it.
 *
 * If a process was killed while several jobs ran, jobs start one at a time, each after the earlier
 * ones have saved something. The next kill then identifies the job at fault (mo_store_requeue). */
#include "jobs/memory.h"

#include <malloc.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/thread.h"
#include "jobs/state.h"

#define MIB           ((uint64_t)1 << 20)
#define OVERTAKEN_MAX 8

/* Measured, and rounded up. */
#define SERVICE_BYTES  (88 * MIB)    /* evaluations, requests, caches of the store */
#define LEARNING_BYTES (28 * MIB)    /* weights, Adam, gradient, a checkpoint being written */
#define SLOT_BYTES     (5 * MIB / 2) /* the gradient of a block */
#define SCRATCH_BYTES  (12 * MIB)    /* a worker's gradients without the tape */
/* A step of a full block of the largest bodies, and the start of a segment of its tape. */
#define TAPE_STEP_BYTES          ((uint64_t)550 << 10)
#define TAPE_SEGMENT_BYTES       ((uint64_t)300 << 10)
#define SPLIT_TAPE_STEP_BYTES    ((uint64_t)850 << 10)
#define SPLIT_TAPE_SEGMENT_BYTES ((uint64_t)430 << 10)

/* ---- the limit ---- */

static uint64_t available(const struct mo_jobs *jobs)
{
  const uint64_t most = jobs->config.max_memory;
  return most > SERVICE_BYTES ? most - SERVICE_BYTES : 0;
}

void mo_memory_init(struct mo_jobs *jobs)
{
  struct mo_compute_stats stats;
  uint64_t tape = MO_GRADIENT_DEFAULT_BYTES, share;
  mo_compute_get_stats(jobs->compute, &stats);
  jobs->memory.n_workers = stats.n_workers > 0 ? stats.n_workers : 1;
  if (jobs->config.max_memory >
      0) { /* the gradients of all workers take at most half of the limit, if possible */
    share = available(jobs) / 2 / jobs->memory.n_workers;
    share = share > SCRATCH_BYTES + 8 * MIB ? share - SCRATCH_BYTES : 8 * MIB;
    tape = share < tape ? share : tape;
    mo_compute_set_gradient_bytes(jobs->compute, tape);
  }
  jobs->memory.tape_bytes = tape;
}

/* ---- needs ---- */

/* Returns the scratch memory of one worker: the whole tape, or a tape in segments that fit the
 * budget. If no segments fit, uses the segments that need the least memory (sqrt). */
static uint64_t scratch(const struct mo_jobs *jobs, const struct mo_scheme *scheme)
{
  const bool splits = scheme->integrator == MO_INTEGRATOR_SPLIT;
  const uint64_t step = splits ? SPLIT_TAPE_STEP_BYTES : TAPE_STEP_BYTES,
                 segment = splits ? SPLIT_TAPE_SEGMENT_BYTES : TAPE_SEGMENT_BYTES;
  const uint64_t whole = scheme->n_steps * step, cut = jobs->memory.tape_bytes;
  const uint64_t least = (uint64_t)(2 * sqrt((double)scheme->n_steps * (double)(step * segment)));
  const uint64_t tape = least > cut ? least : cut;
  return SCRATCH_BYTES + (tape < whole ? tape : whole);
}

void mo_memory_add_learning(const struct mo_jobs *jobs, uint32_t batch,
                            const struct mo_physics *physics, enum mo_back_end back_end,
                            struct mo_need *need)
{
  const uint64_t blocks = (batch + MO_GRADIENT_ROBOTS - 1) / MO_GRADIENT_ROBOTS,
                 n = jobs->memory.n_workers;
  need->own += LEARNING_BYTES;
  if (back_end == MO_ON_DEVICE)
    return;
  need->own += (blocks < 2 * n ? blocks : 2 * n) * SLOT_BYTES;
  need->scratch = (blocks < n ? blocks : n) * scratch(jobs, &physics->scheme);
}

static uint64_t need_alone(const struct mo_need *need)
{
  return need->own + need->shared + need->scratch;
}

static unsigned mib(uint64_t bytes)
{
  return (unsigned)((bytes + MIB - 1) / MIB);
}

int mo_memory_check(const struct mo_jobs *jobs, const struct mo_need *need,
                    struct mo_message *message)
{
  if (jobs->config.max_memory == 0 || need_alone(need) <= available(jobs))
    return MO_OK;
  if (need->shared == 0)
    return mo_fail(
        message, MO_ERR_LIMIT,
        "this needs %u MiB of memory, but jobs can use only %u MiB; reduce the request, or "
        "raise max_memory",
        mib(need_alone(need)), mib(available(jobs)));
  return mo_fail(
      message, MO_ERR_LIMIT,
      "this needs %u MiB of memory (%u MiB of it for the controller's pretraining bodies), but "
      "jobs can use only %u MiB; submit with exclude_pretraining false, or raise max_memory",
      mib(need_alone(need)), mib(need->shared), mib(available(jobs)));
}

/* ---- accounting, under the mutex ---- */

static uint64_t in_use_with(const struct mo_memory *memory, const struct mo_need *need)
{
  uint64_t sum = need->own, scratch = need->scratch;
  bool is_there = need->shared == 0;
  for (const struct mo_memory_user *user = memory->users; user != NULL; user = user->next) {
    bool counted = user->need.shared == 0;
    for (const struct mo_memory_user *before = memory->users; before != user && !counted;
         before = before->next)
      counted = before->need.shared > 0 && before->need.shared_key == user->need.shared_key;
    sum += user->need.own + (counted ? 0 : user->need.shared);
    is_there = is_there || (user->need.shared > 0 && user->need.shared_key == need->shared_key);
    scratch = user->need.scratch > scratch ? user->need.scratch : scratch;
  }
  return sum + (is_there ? 0 : need->shared) + scratch;
}

static struct mo_memory_user **find(struct mo_memory_user **link, int64_t id)
{
  while (*link != NULL && (*link)->id != id)
    link = &(*link)->next;
  return link;
}

static void drop(struct mo_memory_user **link)
{
  struct mo_memory_user *user = *link;
  if (user == NULL)
    return;
  *link = user->next;
  free(user);
}

/* Returns NULL if memory runs out, or if the job's need is unknown for now because of a
 * shortage. */
static struct mo_memory_user *make_user(struct mo_jobs *jobs, const struct mo_kind *kind,
                                        int64_t id)
{
  struct mo_memory_user *user = calloc(1, sizeof(*user));
  if (user != NULL) {
    user->id = id;
    user->kind = kind;
    if (mo_is_shortage(kind->need(jobs, id, &user->need)))
      drop(&user);
  }
  return user;
}

/* Returns whether the job may start now; if not, stores the reason. */
static bool fits(const struct mo_jobs *jobs, struct mo_memory_user *asker)
{
  const struct mo_memory *memory = &jobs->memory;
  const struct mo_need *need = &asker->need, none = {0};
  char *reason = asker->reason;
  for (const struct mo_memory_user *user = memory->users; user != NULL && memory->n_suspects > 0;
       user = user->next)
    if (!user->is_proven) {
      snprintf(reason, sizeof(asker->reason),
               "the service was killed while several jobs ran, so jobs start one at a time; "
               "waiting until job %lld has saved its work",
               (long long)user->id);
      return false;
    }
  if (jobs->config.max_memory == 0)
    return true;
  if (need_alone(need) > available(jobs)) {
    snprintf(reason, sizeof(asker->reason),
             "it needs %u MiB of memory, but jobs can use only %u MiB; raise max_memory, or cancel "
             "the job",
             mib(need_alone(need)), mib(available(jobs)));
    return false;
  }
  for (const struct mo_memory_user *other = memory->waiting; other != NULL && other != asker;
       other = other->next)
    if (other->overtaken >= OVERTAKEN_MAX && need_alone(&other->need) <= available(jobs)) {
      snprintf(reason, sizeof(asker->reason),
               "job %lld has waited longer for memory and starts first", (long long)other->id);
      return false;
    }
  if (in_use_with(memory, need) <= available(jobs))
    return true;
  const uint64_t used = in_use_with(memory, &none),
                 left = used < available(jobs) ? available(jobs) - used : 0;
  snprintf(
      reason, sizeof(asker->reason),
      "it needs %u MiB more memory, but only %u of the %u MiB for jobs are free; it starts when "
      "other jobs end",
      mib(in_use_with(memory, need) - used), (unsigned)(left / MIB), mib(available(jobs)));
  return false;
}

bool mo_memory_take(struct mo_jobs *jobs, const struct mo_kind *kind, int64_t id)
{
  struct mo_memory *memory = &jobs->memory;
  MO_GUARD(&memory->mutex);
  struct mo_memory_user **link = find(&memory->waiting, id);
  if (*link == NULL && *find(&memory->users, id) == NULL)
    *link = make_user(jobs, kind, id);
  struct mo_memory_user *user =
      *link; /* NULL: an earlier run has not ended yet, or another thread took the job */
  bool taken = user != NULL && fits(jobs, user);
  if (taken) {
    for (struct mo_memory_user *before = memory->waiting; before != user; before = before->next)
      before->overtaken++;
    *link = user->next;
    user->next = memory->users;
    memory->users = user;
  }
  return taken;
}

/* Reduces the number of suspects by one, if this job was not proven before. */
static bool clear(struct mo_memory *memory, const struct mo_memory_user *user)
{
  if (memory->n_suspects == 0 || user == NULL || user->is_proven)
    return false;
  memory->n_suspects--;
  return true;
}

static void wake(struct mo_jobs *jobs)
{
  for (int kind = 0; kind < MO_JOB_KINDS; kind++)
    mo_runners_wake(&jobs->runners[kind]);
}

void mo_memory_give(struct mo_jobs *jobs, int64_t id)
{
  struct mo_memory *memory = &jobs->memory;
  bool learns = false;
  pthread_mutex_lock(&memory->mutex);
  clear(memory, *find(&memory->users, id));
  drop(find(&memory->users, id));
  for (const struct mo_memory_user *user = memory->users; user != NULL; user = user->next)
    learns = learns || user->need.scratch > 0;
  pthread_mutex_unlock(&memory->mutex);
  if (!learns)
    mo_compute_trim(jobs->compute);
  (void)malloc_trim(0);
  wake(jobs);
}

void mo_memory_forget(struct mo_jobs *jobs, int64_t id)
{
  pthread_mutex_lock(&jobs->memory.mutex);
  drop(find(&jobs->memory.waiting, id));
  pthread_mutex_unlock(&jobs->memory.mutex);
  wake(jobs);
}

void mo_memory_keep(struct mo_jobs *jobs, const struct mo_kind *kind, const int64_t *ids, int64_t n)
{
  struct mo_memory_user **link = &jobs->memory.waiting;
  MO_GUARD(&jobs->memory.mutex);
  while (*link != NULL) {
    bool is_there = (*link)->kind != kind;
    for (int64_t i = 0; i < n && !is_there; i++)
      is_there = ids[i] == (*link)->id;
    if (is_there)
      link = &(*link)->next;
    else
      drop(link);
  }
}

void mo_memory_renew(struct mo_jobs *jobs, enum mo_job_kind kind, int64_t id)
{
  struct mo_need need = {0};
  const int error = jobs->runners[kind].kind->need(jobs, id, &need);
  pthread_mutex_lock(&jobs->memory.mutex);
  struct mo_memory_user *user = *find(&jobs->memory.users, id);
  if (user != NULL && !mo_is_shortage(error))
    user->need = need;
  pthread_mutex_unlock(&jobs->memory.mutex);
  mo_memory_forget(jobs, id);
}

void mo_memory_prove(struct mo_jobs *jobs, int64_t id)
{
  pthread_mutex_lock(&jobs->memory.mutex);
  struct mo_memory_user *user = *find(&jobs->memory.users, id);
  bool is_news = clear(&jobs->memory, user);
  if (user != NULL)
    user->is_proven = true;
  pthread_mutex_unlock(&jobs->memory.mutex);
  if (is_news)
    wake(jobs);
}

bool mo_memory_reason(struct mo_jobs *jobs, int64_t id, char reason[160])
{
  MO_GUARD(&jobs->memory.mutex);
  const struct mo_memory_user *user = *find(&jobs->memory.waiting, id);
  if (user == NULL || user->reason[0] == '\0')
    return false;
  memcpy(reason, user->reason, sizeof(user->reason));
  return true;
}

void mo_memory_free(struct mo_jobs *jobs)
{
  while (jobs->memory.waiting != NULL)
    drop(&jobs->memory.waiting);
  while (jobs->memory.users != NULL)
    drop(&jobs->memory.users);
}
