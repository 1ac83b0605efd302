/* device_gradient.c: the gradient of a batch, on devices (gradient.c: on workers).
 *
 * The batch is cut into shards of MO_DEVICE_SHARD consecutive robots, and these into as many parts as devices work, one call each. Every
 * shard has a float32 sum of its own; they are added up in float64, in order. So the bits do not depend on how many devices there
 * are, nor on how a call had to be halved. */
#include "compute/devices.h"

#include <stdlib.h>

struct waiter {
  pthread_mutex_t mutex;
  pthread_cond_t all_done;
  uint32_t left;
  atomic_bool stop;
};

static void part_done(struct mo_block *block, void *context)
{
  struct waiter *waiter = context;
  pthread_mutex_lock(&waiter->mutex);
  if (block->status != MO_OK)
    atomic_store(&waiter->stop, true);
  if (--waiter->left == 0)
    pthread_cond_signal(&waiter->all_done);
  pthread_mutex_unlock(&waiter->mutex);
}

static void submit(struct mo_devices *devices, const struct mo_gradient_batch *batch, float *d_parameters,
                   struct mo_device_task *parts, uint32_t n_parts, struct waiter *waiter)
{
  const uint32_t n_shards = (batch->n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD;
  for (uint32_t p = 0; p < n_parts; p++) {
    const uint32_t first = (uint32_t)((uint64_t)n_shards * p / n_parts) * MO_DEVICE_SHARD;
    uint32_t end = (uint32_t)((uint64_t)n_shards * (p + 1) / n_parts) * MO_DEVICE_SHARD;
    if (end > batch->n)
      end = batch->n;
    parts[p] = (struct mo_device_task){.block = {.physics = batch->physics,
                                                 .urgency = MO_BATCH,
                                                 .back_end = MO_ON_DEVICE,
                                                 .cancel = batch->cancel,
                                                 .tag = batch->tag,
                                                 .share = batch->share,
                                                 .done = part_done,
                                                 .context = waiter,
                                                 .shards = &parts[p]},
                                       .controller = batch->controller,
                                       .robots = batch->robots + first,
                                       .n = end - first,
                                       .adjoint_bound = batch->adjoint_bound,
                                       .weight = 1.0 / batch->n,
                                       .stop = &waiter->stop,
                                       .outcomes = batch->outcomes + first,
                                       .d_parameters =
                                           d_parameters + first / MO_DEVICE_SHARD * batch->controller->n_parameters};
  }
  waiter->left = n_parts;
  for (uint32_t p = 0; p < n_parts; p++) {
    const int status = mo_devices_submit(devices, &parts[p].block);
    if (status != MO_OK) {
      parts[p].block.status = status;
      part_done(&parts[p].block, waiter);
    }
  }
}

/* What ended the batch: one part's own error, rather than that the others were stopped for it. */
static int result_of(const struct mo_device_task *parts, uint32_t n_parts)
{
  int status = MO_OK;
  for (uint32_t p = 0; p < n_parts; p++)
    if (parts[p].block.status != MO_OK && (status == MO_OK || status == MO_ERR_CANCELLED))
      status = parts[p].block.status;
  return status;
}

int mo_devices_gradient(struct mo_devices *devices, struct mo_gradient_batch *batch, float **shards, size_t *room)
{
  const size_t n_parameters = batch->controller->n_parameters;
  const uint32_t n_shards = (batch->n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD;
  const uint32_t n_working = atomic_load(&devices->n_working), n_parts = n_working < n_shards ? n_working : n_shards;
  struct waiter waiter = {.mutex = PTHREAD_MUTEX_INITIALIZER, .all_done = PTHREAD_COND_INITIALIZER};
  if (n_parts == 0)
    return MO_ERR_DEVICE;
  if (n_shards * n_parameters > *room) {
    free(*shards);
    *shards = malloc(n_shards * n_parameters * sizeof(**shards));
    *room = *shards != NULL ? n_shards * n_parameters : 0;
  }
  struct mo_device_task *parts = calloc(n_parts, sizeof(*parts));
  if (*shards == NULL || parts == NULL) {
    free(parts);
    return MO_ERR_NO_MEMORY;
  }
  submit(devices, batch, *shards, parts, n_parts, &waiter);
  pthread_mutex_lock(&waiter.mutex);
  while (waiter.left > 0)
    pthread_cond_wait(&waiter.all_done, &waiter.mutex);
  pthread_mutex_unlock(&waiter.mutex);
  pthread_cond_destroy(&waiter.all_done);
  pthread_mutex_destroy(&waiter.mutex);
  const int status = result_of(parts, n_parts);
  for (uint32_t p = 0; p < n_parts && status == MO_OK; p++)
    mo_gradient_counts_add(&batch->counts, &parts[p].counts);
  for (uint32_t s = 0; s < n_shards && status == MO_OK; s++)
    for (size_t i = 0; i < n_parameters; i++)
      batch->d_parameters[i] += (double)(*shards)[s * n_parameters + i];
  free(parts);
  return status;
}
