/* back_end.c: chooses which jobs devices compute.
 *
 * The back end is chosen at submission and never changes. Bits differ between devices and workers,
 * so a training run or campaign that continued elsewhere would no longer be a function of its
 * settings. If the devices of a job are lost, the job is paused until they are back.
 *
 * A service without devices may expect workers with devices. Their class is set once: by the first
 * worker that has devices, or, if a job needs it earlier, from the record of an earlier process in
 * the store. From then on, all jobs on devices have this class and wait for such workers. */
#include <stdlib.h>
#include <string.h>

#include "base/thread.h"
#include "jobs/state.h"
#include "jobs/trainings.h"

#define BLOCKS_A_DEVICE 16384 /* more than one call takes, with ten environments per block */
#define BLOCKS_A_WORKER 2

/* ---- classes ---- */

/* Composes the code version, on which the bits of a trained controller depend in addition to the
 * settings. */
static int name_code(struct mo_jobs *jobs, enum mo_back_end back_end, const char *fingerprint)
{
  const char *version = jobs->config.version != NULL ? jobs->config.version : "";
  char *text = NULL;
  if (asprintf(&text, "%s%s%s", version, version[0] != '\0' ? " " : "", fingerprint) < 0)
    return MO_ERR_NO_MEMORY;
  __atomic_store_n(&jobs->code_versions[back_end], text, __ATOMIC_RELEASE);
  return MO_OK;
}

/* Under class_mutex. */
static int enter_device_class(struct mo_jobs *jobs, const char *scores, const char *gradients)
{
  int64_t row = 0;
  int error = mo_store_keep_device_class(jobs->store, scores, gradients);
  if (error == MO_OK)
    error = mo_store_fingerprint(jobs->store, scores, &row);
  if (error == MO_OK)
    error = name_code(jobs, MO_ON_DEVICE, gradients);
  if (error == MO_OK)
    __atomic_store_n(&jobs->classes.device, row, __ATOMIC_RELEASE);
  return error;
}

/* Under class_mutex. */
static int name_devices(struct mo_jobs *jobs, const char *scores, const char *gradients)
{
  const char *named = mo_compute_device_fingerprint(jobs->compute);
  if (named != NULL)
    return strcmp(named, scores) == 0 &&
                   strcmp(mo_compute_device_gradient_fingerprint(jobs->compute), gradients) == 0
               ? MO_OK
               : MO_ERR_CONFLICT;
  const int error = enter_device_class(jobs, scores, gradients);
  return error == MO_OK ? mo_compute_name_devices(jobs->compute, scores, gradients) : error;
}

int mo_jobs_name_devices(struct mo_jobs *jobs, const char *scores, const char *gradients)
{
  MO_GUARD(&jobs->class_mutex);
  return mo_compute_expects_devices(jobs->compute) ? name_devices(jobs, scores, gradients)
                                                   : MO_ERR_CONFLICT;
}

int mo_back_end_prepare(struct mo_jobs *jobs)
{
  struct mo_compute *compute = jobs->compute;
  struct mo_device_memory *known = &jobs->known_device;
  int error = name_code(jobs, MO_ON_CPU, mo_compute_gradient_fingerprint(compute));
  for (int precision = 0; precision < 2 && error == MO_OK; precision++)
    error = mo_store_fingerprint(jobs->store,
                                 mo_compute_fingerprint(compute, (enum mo_precision)precision),
                                 &jobs->classes.cpu[precision]);
  if (error == MO_OK && mo_compute_devices(compute) > 0)
    return enter_device_class(jobs, mo_compute_device_fingerprint(compute),
                              mo_compute_device_gradient_fingerprint(compute));
  if (error == MO_OK && mo_compute_expects_devices(compute))
    error = mo_store_device_memory(jobs->store, known);
  if (error == MO_OK && known->scores[0] != '\0' && known->open_jobs > 0)
    error = mo_jobs_name_devices(jobs, known->scores, known->gradients);
  return error;
}

/* Returns whether jobs on devices can be computed, now or once workers have joined. */
static bool serves_devices(struct mo_jobs *jobs)
{
  if (mo_compute_serves_devices(jobs->compute))
    return true;
  const struct mo_device_memory *known = &jobs->known_device;
  return known->scores[0] != '\0' &&
         mo_jobs_name_devices(jobs, known->scores, known->gradients) == MO_OK;
}

const char *mo_jobs_code_version(const struct mo_jobs *jobs, enum mo_back_end back_end)
{
  const char *text = __atomic_load_n(&jobs->code_versions[back_end], __ATOMIC_ACQUIRE);
  return text != NULL ? text : "no device";
}

int64_t mo_back_end_fingerprint(const struct mo_jobs *jobs, enum mo_back_end back_end)
{
  return back_end == MO_ON_DEVICE ? __atomic_load_n(&jobs->classes.device, __ATOMIC_ACQUIRE)
                                  : jobs->classes.cpu[MO_FLOAT32];
}

/* ---- jobs ---- */

int mo_back_end_choose(struct mo_jobs *jobs, struct mo_submission *request, const char *unsuited,
                       bool is_large, struct mo_message *message)
{
  const int asked = request->back_end;
  const bool is_there = mo_compute_devices_working(jobs->compute) > 0;
  request->back_end = asked == MO_ON_DEVICE || (asked == MO_BACK_END_AUTO && is_there &&
                                                unsuited == NULL && is_large)
                          ? MO_ON_DEVICE
                          : MO_ON_CPU;
  if (request->back_end == MO_ON_DEVICE && unsuited != NULL)
    return mo_fail(message, MO_ERR_DEVICE, "%s", unsuited);
  if (request->back_end == MO_ON_CPU || serves_devices(jobs))
    return MO_OK;
  if (mo_compute_expects_devices(jobs->compute))
    return mo_fail(message, MO_ERR_DEVICE,
                   "the service has no devices, and no worker with devices has joined yet; "
                   "request \"cpu\" or \"auto\", or start such a worker");
  return mo_fail(message, MO_ERR_DEVICE,
                 "%s; request \"cpu\" or \"auto\", or repair the devices and restart the service",
                 mo_compute_devices(jobs->compute) > 0 ? "all devices have failed"
                                                       : "the service has no devices");
}

const char *mo_back_end_unsuited(const struct mo_environment *environments, uint32_t n)
{
  for (uint32_t i = 0; environments != NULL && i < n; i++)
    if (environments[i].grid != NULL)
      return "GPUs cannot compute terrains of kind \"grid\" yet; request \"cpu\" or \"auto\", or "
             "use terrain_heights_m or a profile";
  return NULL;
}

int mo_back_end_check(struct mo_jobs *jobs, enum mo_back_end back_end)
{
  return back_end == MO_ON_CPU || serves_devices(jobs) ? MO_OK : MO_ERR_DEVICE;
}

enum mo_urgency mo_back_end_urgency(const struct mo_jobs *jobs, const struct mo_job *job)
{
  return job->back_end == MO_ON_DEVICE && mo_compute_expects_devices(jobs->compute) ? MO_BATCH
                                                                                    : job->priority;
}

int mo_back_end_error(enum mo_back_end back_end, int error)
{
  return back_end == MO_ON_DEVICE && error == MO_ERR_NO_MEMORY ? MO_ERR_DEVICE : error;
}

void mo_back_end_describe_loss(struct mo_jobs *jobs, char *text, size_t size)
{
  struct mo_device_status status;
  const uint32_t n = mo_compute_devices(jobs->compute);
  uint32_t i = 0;
  if (mo_compute_devices_working(jobs->compute) > 0) {
    snprintf(text, size,
             "the devices do not have enough memory for even the smallest part of this job; stop "
             "other programs that use them, then resume the job");
    return;
  }
  while (i < n && mo_compute_device(jobs->compute, i, &status) == MO_OK &&
         status.state == MO_DEVICE_WORKS)
    i++;
  if (i == n && mo_compute_serves_devices(jobs->compute))
    snprintf(text, size,
             "workers crashed repeatedly while they computed a part of this job; repair them, then "
             "resume the job");
  else if (i == n && mo_compute_expects_devices(jobs->compute))
    snprintf(text, size,
             "this job needs a worker with devices, but none has joined; start one, then resume "
             "the job");
  else if (i == n)
    snprintf(text, size,
             "this job needs devices, but the service has none; start the service with devices, "
             "then resume the job");
  else
    snprintf(text, size,
             "all devices have failed (%.40s: %.100s); restart the service, then resume the job",
             status.name, status.error);
}

void mo_back_end_describe_wait(const struct mo_jobs *jobs, enum mo_back_end back_end, char *text,
                               size_t size)
{
  const char *class = back_end == MO_ON_DEVICE ? mo_compute_device_fingerprint(jobs->compute)
                                               : mo_compute_fingerprint(jobs->compute, MO_FLOAT32);
  text[0] = '\0';
  if (class != NULL && mo_compute_lacks_takers(jobs->compute, back_end))
    snprintf(text, size, "waiting for a worker of class \"%s\"", class);
}

uint32_t mo_back_end_window(const struct mo_jobs *jobs, enum mo_back_end back_end)
{
  struct mo_compute_stats stats;
  const uint32_t n_devices = mo_compute_devices(jobs->compute);
  const uint32_t remote = mo_compute_remote_wanted(jobs->compute, back_end);
  if (back_end == MO_ON_DEVICE)
    return remote + BLOCKS_A_DEVICE * (n_devices > 0 ? n_devices : 1);
  mo_compute_get_stats(jobs->compute, &stats);
  return remote + BLOCKS_A_WORKER * (stats.n_workers > 0 ? stats.n_workers : 1);
}
