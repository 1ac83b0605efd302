/* absent.c: devices that exist only on other machines. Their blocks wait in a queue, like the
 * blocks of other devices, and remote takers compute them all. One thread, the keeper, handles the
 * blocks that takers do not get: cancelled blocks, and blocks that no taker can compute, which go
 * to the workers. */
#include "compute/devices.h"

#include <stdlib.h>
#include <string.h>

#include "base/clock.h"

#define LOOK_AGAIN_US 50000 /* a cancellation does not wake the keeper */

static bool is_for_keeper(const struct mo_block *block, void *context)
{
  const struct mo_devices *devices = context;
  return devices->stopping || !mo_block_suits_remote(block) || mo_block_is_cancelled(block);
}

static void *keep(void *context)
{
  struct mo_devices *devices = context;
  struct mo_fair *fair = &devices->fair;
  pthread_mutex_lock(&fair->mutex);
  for (;;) {
    struct mo_fair_charge charge;
    struct mo_block *block = mo_fair_take(fair, &charge, is_for_keeper, devices);
    if (block != NULL) {
      const bool is_cancelled = devices->stopping || mo_block_is_cancelled(block);
      mo_fair_correct(fair, &charge, 0, false);
      pthread_mutex_unlock(&fair->mutex);
      mo_chunk_end_block(devices, block, is_cancelled ? MO_ERR_CANCELLED : MO_CHUNK_TO_WORKERS,
                         NULL);
      pthread_mutex_lock(&fair->mutex);
    } else if (devices->stopping) {
      break;
    } else if (atomic_load(&fair->waiting) > 0) {
      (void)mo_wait_until(&devices->wake, &fair->mutex, mo_clock_us() + LOOK_AGAIN_US);
    } else {
      pthread_cond_wait(&devices->wake, &fair->mutex);
    }
  }
  pthread_mutex_unlock(&fair->mutex);
  return NULL;
}

int mo_compute_expect_devices(struct mo_compute *compute)
{
  if (mo_core(compute)->devices != NULL)
    return MO_ERR_CONFLICT;
  struct mo_devices *devices = mo_devices_create(compute);
  if (devices == NULL)
    return MO_ERR_NO_MEMORY;
  devices->is_absent = true;
  devices->has_keeper = mo_thread_create(&devices->keeper, "mo-absent", keep, devices) == 0;
  if (!devices->has_keeper) {
    mo_devices_free(devices);
    return MO_ERR_NO_MEMORY;
  }
  mo_core(compute)->devices = devices;
  return MO_OK;
}

bool mo_compute_expects_devices(const struct mo_compute *compute)
{
  const struct mo_devices *devices = mo_core(compute)->devices;
  return devices != NULL && devices->is_absent;
}

int mo_compute_name_devices(struct mo_compute *compute, const char *scores, const char *gradients)
{
  struct mo_devices *devices = mo_core(compute)->devices;
  struct mo_device_class *class = &devices->class;
  if (!devices->is_absent || atomic_load(&devices->is_named))
    return MO_ERR_CONFLICT;
  if (strlen(scores) >= sizeof(class->scores) || strlen(gradients) >= sizeof(class->gradients))
    return MO_ERR_LIMIT;
  memcpy(class->scores, scores, strlen(scores) + 1);
  memcpy(class->gradients, gradients, strlen(gradients) + 1);
  atomic_store(&devices->is_named, true);
  return MO_OK;
}

bool mo_compute_serves_devices(const struct mo_compute *compute)
{
  const struct mo_devices *devices = mo_core(compute)->devices;
  return devices != NULL && (devices->is_absent ? atomic_load(&devices->is_named)
                                                : atomic_load(&devices->n_working) > 0);
}

bool mo_compute_lacks_takers(const struct mo_compute *compute, enum mo_back_end back_end)
{
  const struct mo_compute_core *core = mo_core(compute);
  const bool leaves = back_end == MO_ON_DEVICE ? mo_compute_expects_devices(compute)
                                               : atomic_load(&core->remote.leave);
  return leaves && atomic_load(&core->remote.blocks[back_end]) == 0;
}
