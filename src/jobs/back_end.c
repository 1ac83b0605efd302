/* back_end.c: which jobs devices compute.
 *
 * The back end is chosen at submission and never changes. Bits differ between devices and workers,
 * so a training or campaign that continued elsewhere would no longer be a function of its settings.
 * A job whose devices are lost waits for them, paused. */
#include "jobs/state.h"

#define BLOCKS_A_DEVICE 16384 /* more than one call, at ten environments per block */
#define BLOCKS_A_WORKER 2

int mo_back_end_choose(const struct mo_jobs *jobs, struct mo_submission *request, bool suits,
                       bool is_large, struct mo_message *message)
{
  const int asked = request->back_end;
  const bool is_there = mo_compute_devices_working(jobs->compute) > 0;
  request->back_end =
      asked == MO_ON_DEVICE || (asked == MO_BACK_END_AUTO && is_there && suits && is_large)
          ? MO_ON_DEVICE
          : MO_ON_CPU;
  if (request->back_end == MO_ON_DEVICE && !suits)
    return mo_fail(message, MO_ERR_DEVICE,
                   "devices compute batches in float32 that record nothing: ask for \"cpu\" or "
                   "\"auto\", or for such a batch");
  if (request->back_end == MO_ON_DEVICE && !is_there)
    return mo_fail(
        message, MO_ERR_DEVICE,
        "%s: ask for \"cpu\" or \"auto\", or restart the service when its devices are in order",
        mo_compute_devices(jobs->compute) > 0 ? "no device works any more"
                                              : "the service has no devices");
  return MO_OK;
}

int mo_back_end_check(const struct mo_jobs *jobs, enum mo_back_end back_end)
{
  return back_end == MO_ON_DEVICE && mo_compute_devices_working(jobs->compute) == 0 ? MO_ERR_DEVICE
                                                                                    : MO_OK;
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
             "there is no memory left for even the smallest part of this job: end what else uses "
             "the devices, then resume the job");
    return;
  }
  while (i < n && mo_compute_device(jobs->compute, i, &status) == MO_OK &&
         status.state == MO_DEVICE_WORKS)
    i++;
  if (i == n)
    snprintf(text, size,
             "devices compute this job, and there are none: start the service with devices, then "
             "resume the job");
  else
    snprintf(text, size,
             "no device works any more (%.40s: %.100s): restart the service, then resume the job",
             status.name, status.error);
}

int64_t mo_back_end_fingerprint(const struct mo_jobs *jobs, enum mo_back_end back_end)
{
  return back_end == MO_ON_DEVICE ? jobs->classes.device : jobs->classes.cpu[MO_FLOAT32];
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
