/* shares.c: the shares of the back end: one per running job.
 *
 * The store holds the weight of a job. An opened share is listed here before its weight is read
 * from the store; a new weight is stored before its share is looked up. Whichever happens first,
 * the share gets the newest weight. */
#include <stdlib.h>
#include <string.h>

#include "base/thread.h"
#include "jobs/state.h"

static const struct mo_live idle = {.phase = MO_PHASE_IDLE, .seconds_left = -1, .busy_s = -1};

static void add(const struct mo_compute_share *share, double *worker_s, double *device_s)
{
  struct mo_compute_share_stats stats;
  mo_compute_share_get_stats(share, &stats);
  *worker_s += stats.busy_s;
  *device_s += stats.device_s;
}

/* Call it under shares_mutex. Returns the address of the list's pointer to the share, which is NULL
 * if there is no share. */
static struct mo_job_share **find(struct mo_jobs *jobs, int64_t id)
{
  struct mo_job_share **link = &jobs->shares;
  while (*link != NULL && (*link)->id != id)
    link = &(*link)->next;
  return link;
}

/* Updates a share from the job's row. opens: the share is new, and continues from the job's usage
 * so far. */
static int read_share(struct mo_jobs *jobs, int64_t id, bool opens)
{
  struct mo_job job;
  pthread_mutex_lock(&jobs->weigh_mutex);
  int error = mo_store_job(jobs->store, id, &job);
  pthread_mutex_lock(&jobs->shares_mutex);
  struct mo_job_share *entry = *find(jobs, id);
  if (error == MO_OK && entry != NULL) {
    mo_compute_share_set_weight(entry->share, job.weight);
    entry->is_batch = job.priority == MO_BATCH;
    entry->weight = job.weight;
    entry->back_end = job.back_end;
    snprintf(entry->label, sizeof(entry->label), "%s", job.label);
    entry->before_s = opens ? job.worker_s : entry->before_s;
    entry->before_device_s = opens ? job.device_s : entry->before_device_s;
  }
  pthread_mutex_unlock(&jobs->shares_mutex);
  pthread_mutex_unlock(&jobs->weigh_mutex);
  return error;
}

int mo_share_reweigh(struct mo_jobs *jobs, int64_t id)
{
  return read_share(jobs, id, false);
}

int mo_share_open(struct mo_jobs *jobs, int64_t id, enum mo_job_kind kind,
                  struct mo_compute_share **share)
{
  struct mo_job_share *entry = calloc(1, sizeof(*entry));
  int error =
      entry == NULL ? MO_ERR_NO_MEMORY : mo_compute_share_create(jobs->compute, 1, &entry->share);
  if (error != MO_OK) {
    free(entry);
    return error;
  }
  entry->id = id;
  entry->kind = kind;
  entry->live = idle;
  *share = entry->share;
  pthread_mutex_lock(&jobs->shares_mutex);
  entry->next = jobs->shares;
  jobs->shares = entry;
  pthread_mutex_unlock(&jobs->shares_mutex);
  error = read_share(jobs, id, true);
  if (error != MO_OK)
    mo_share_close(jobs, id);
  return error;
}

void mo_share_close(struct mo_jobs *jobs, int64_t id)
{
  pthread_mutex_lock(&jobs->shares_mutex);
  struct mo_job_share **link = find(jobs, id), *entry = *link;
  if (entry != NULL) {
    *link = entry->next;
    add(entry->share, &jobs->ended_s[entry->kind], &jobs->ended_device_s[entry->kind]);
    mo_compute_share_free(entry->share);
  }
  pthread_mutex_unlock(&jobs->shares_mutex);
  free(entry);
}

void mo_share_show(struct mo_jobs *jobs, int64_t id, const struct mo_live *live)
{
  MO_GUARD(&jobs->shares_mutex);
  struct mo_job_share *entry = *find(jobs, id);
  if (entry != NULL)
    entry->live = *live;
}

void mo_share_live(struct mo_jobs *jobs, int64_t id, struct mo_live *live)
{
  double device_s = 0;
  *live = idle;
  MO_GUARD(&jobs->shares_mutex);
  const struct mo_job_share *entry = *find(jobs, id);
  if (entry != NULL) {
    *live = entry->live;
    live->busy_s = 0;
    add(entry->share, &live->busy_s, &device_s);
    live->worker_s = entry->before_s + live->busy_s;
    live->device_s = entry->before_device_s + device_s;
    live->back_end = entry->back_end;
  }
}

bool mo_share_used(void *context, int64_t id, double *worker_s, double *device_s)
{
  struct mo_live live;
  mo_share_live(context, id, &live);
  *worker_s = live.worker_s;
  *device_s = live.device_s;
  return live.busy_s >= 0;
}

size_t mo_shares_heaviest(struct mo_jobs *jobs, struct mo_running *rows, size_t limit)
{
  size_t n = 0;
  MO_GUARD(&jobs->shares_mutex);
  for (const struct mo_job_share *entry = jobs->shares; entry != NULL; entry = entry->next) {
    size_t place = n;
    while (place > 0 &&
           (rows[place - 1].weight < entry->weight ||
            (rows[place - 1].weight == entry->weight && rows[place - 1].id < entry->id)))
      place--;
    if (!entry->is_batch || place == limit)
      continue;
    n += n < limit;
    memmove(&rows[place + 1], &rows[place], (n - place - 1) * sizeof(*rows));
    rows[place] =
        (struct mo_running){.id = entry->id, .kind = entry->kind, .weight = entry->weight};
    memcpy(rows[place].label, entry->label, sizeof(entry->label));
  }
  return n;
}

void mo_shares_seconds(struct mo_jobs *jobs, double worker_s[MO_JOB_KINDS],
                       double device_s[MO_JOB_KINDS])
{
  MO_GUARD(&jobs->shares_mutex);
  for (int kind = 0; kind < MO_JOB_KINDS; kind++) {
    worker_s[kind] = jobs->ended_s[kind];
    device_s[kind] = jobs->ended_device_s[kind];
  }
  for (const struct mo_job_share *entry = jobs->shares; entry != NULL; entry = entry->next)
    add(entry->share, &worker_s[entry->kind], &device_s[entry->kind]);
}
