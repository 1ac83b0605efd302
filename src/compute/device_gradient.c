/* device_gradient.c: computes the gradient of a batch on devices (gradient.c does so on workers).
 *
 * The batch is cut into shards of MO_DEVICE_SHARD consecutive robots, and the shards into as many
 * parts as there are working devices, one call each. Every shard has its own float32 sum; shards
 * are added in float64, in order. The bits therefore depend neither on the number of devices nor on
 * whether calls had to be halved.
 *
 * The robots of the next batch do not depend on the weights: another thread may lay out the next
 * batch while one is computed. */
#include "compute/device_gradient.h"

#include <stdlib.h>
#include <string.h>

#include "rollout/physics.h"

enum { SUM_THREADS_MAX = 16 };

/* A batch, cut into parts, each with its own layout. */
struct laid_out {
  struct mo_devices *devices;
  enum { FREE = 0, READY, IN_USE } state;
  const struct mo_robot *robots;
  uint32_t n, n_parts;
  struct mo_physics physics;
  struct {
    struct mo_device_layout *layout; /* keeps its memory between batches */
    int status;
  } * parts; /* one for each device */
};

struct mo_device_gradients {
  struct mo_devices *devices;
  uint32_t n_threads;
  float *shards; /* (room) */
  size_t room;
  pthread_mutex_t mutex;
  struct laid_out batches[2]; /* the current and the next; the mutex guards `state` and what
                                 identifies the batch */
};

int mo_device_gradients_create(struct mo_devices *devices, struct mo_device_gradients **ret)
{
  const uint32_t n_workers = mo_core(devices->compute)->n_workers;
  struct mo_device_gradients *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->devices = devices;
  made->n_threads = n_workers < SUM_THREADS_MAX ? n_workers : SUM_THREADS_MAX;
  pthread_mutex_init(&made->mutex, NULL);
  for (struct laid_out *batch = made->batches; batch < made->batches + 2; batch++) {
    batch->devices = devices;
    batch->parts = calloc(devices->n, sizeof(*batch->parts));
    if (batch->parts == NULL) {
      mo_device_gradients_free(made);
      return MO_ERR_NO_MEMORY;
    }
  }
  *ret = made;
  return MO_OK;
}

void mo_device_gradients_free(struct mo_device_gradients *gradients)
{
  if (gradients == NULL)
    return;
  for (int b = 0; b < 2; b++) {
    for (uint32_t p = 0; gradients->batches[b].parts != NULL && p < gradients->devices->n; p++)
      gradients->devices->module->layout_free(gradients->batches[b].parts[p].layout);
    free(gradients->batches[b].parts);
  }
  gradients->devices->module->release(gradients->shards);
  pthread_mutex_destroy(&gradients->mutex);
  free(gradients);
}

/* Returns the p-th working device, or NULL if fewer devices work. */
static const struct mo_device *working_device(struct mo_devices *devices, uint32_t p)
{
  MO_GUARD(&devices->fair.mutex);
  for (uint32_t i = 0; i < devices->n; i++)
    if (devices->units[i].status.state == MO_DEVICE_WORKS && p-- == 0)
      return devices->units[i].callers[0].device;
  return NULL;
}

static int reserve(struct mo_device_gradients *gradients, size_t n)
{
  struct mo_devices *devices = gradients->devices;
  const struct mo_device *device = working_device(devices, 0);
  if (n <= gradients->room)
    return MO_OK;
  if (device == NULL)
    return MO_ERR_DEVICE;
  devices->module->release(gradients->shards);
  gradients->shards = devices->module->allocate(device, n * sizeof(float));
  gradients->room = gradients->shards != NULL ? n : 0;
  return gradients->shards != NULL ? MO_OK : MO_ERR_NO_MEMORY;
}

/* ---- parts ---- */

static uint32_t parts_of(const struct mo_devices *devices, uint32_t n)
{
  const uint32_t n_shards = (n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD,
                 n_working = atomic_load(&devices->n_working);
  return n_working < n_shards ? n_working : n_shards;
}

struct part {
  uint32_t first, end; /* robots */
};

static struct part part_of(uint32_t n, uint32_t n_parts, uint32_t p)
{
  const uint64_t n_shards = (n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD;
  const struct part part = {(uint32_t)(n_shards * p / n_parts) * MO_DEVICE_SHARD,
                            (uint32_t)(n_shards * (p + 1) / n_parts) * MO_DEVICE_SHARD};
  return (struct part){part.first, part.end < n ? part.end : n};
}

/* ---- laying out ahead ---- */

void mo_device_gradients_forget(struct mo_device_gradients *gradients)
{
  MO_GUARD(&gradients->mutex);
  for (int b = 0; b < 2; b++)
    if (gradients->batches[b].state == READY)
      gradients->batches[b].state = FREE;
}

static void lay_out_parts(void *context, size_t first, size_t end)
{
  struct laid_out *batch = context;
  struct mo_devices *devices = batch->devices;
  for (uint32_t p = (uint32_t)first; p < end; p++) {
    const struct part part = part_of(batch->n, batch->n_parts, p);
    const struct mo_device *device = working_device(devices, p);
    batch->parts[p].status =
        device == NULL
            ? MO_ERR_DEVICE
            : devices->module->lay_out(device, batch->robots + part.first, part.end - part.first,
                                       &batch->physics, &batch->parts[p].layout);
  }
}

/* Lays out all parts concurrently. A part uses one thread per shard, and has few shards if there
 * are many parts. */
int mo_devices_lay_out(struct mo_device_gradients *gradients, const struct mo_robot *robots,
                       uint32_t n, const struct mo_physics *physics)
{
  struct laid_out *batch = NULL;
  int status = MO_OK;
  mo_device_gradients_forget(gradients);
  pthread_mutex_lock(&gradients->mutex);
  for (int b = 0; b < 2 && batch == NULL; b++)
    if (gradients->batches[b].state == FREE)
      batch = &gradients->batches[b];
  if (batch != NULL)
    batch->state = IN_USE;
  pthread_mutex_unlock(&gradients->mutex);
  if (batch == NULL)
    return MO_ERR_CONFLICT;
  batch->robots = robots;
  batch->n = n;
  batch->physics = *physics;
  batch->n_parts = parts_of(gradients->devices, n);
  mo_parallel(batch->n_parts, batch->n_parts, lay_out_parts, batch);
  for (uint32_t p = 0; p < batch->n_parts && status == MO_OK; p++)
    status = batch->parts[p].status;
  pthread_mutex_lock(&gradients->mutex);
  batch->state = status == MO_OK ? READY : FREE;
  pthread_mutex_unlock(&gradients->mutex);
  return status;
}

static bool is_of(const struct laid_out *laid, const struct mo_gradient_batch *batch)
{
  return laid->state == READY && laid->robots == batch->robots && laid->n == batch->n &&
         mo_physics_equal(&laid->physics, &batch->physics);
}

/* Returns the ready layout of a batch, which is in use until give_back, or NULL if there is
 * none. */
static struct laid_out *take(struct mo_device_gradients *gradients,
                             const struct mo_gradient_batch *batch, uint32_t n_parts)
{
  struct laid_out *found = NULL;
  MO_GUARD(&gradients->mutex);
  for (int b = 0; b < 2 && found == NULL; b++)
    if (is_of(&gradients->batches[b], batch))
      found = &gradients->batches[b];
  if (found != NULL && found->n_parts != n_parts) { /* a device was lost in the meantime */
    found->state = FREE;
    found = NULL;
  }
  if (found != NULL)
    found->state = IN_USE;
  return found;
}

static void give_back(struct mo_device_gradients *gradients, struct laid_out *laid)
{
  MO_GUARD(&gradients->mutex);
  if (laid != NULL)
    laid->state = FREE;
}

/* ---- computing ---- */

static void submit(struct mo_device_gradients *gradients, const struct mo_gradient_batch *batch,
                   const struct laid_out *laid, struct mo_device_task *parts, uint32_t n_parts,
                   struct mo_waiter *waiter)
{
  const size_t n_parameters = batch->controller->n_parameters;
  for (uint32_t p = 0; p < n_parts; p++) {
    const struct part part = part_of(batch->n, n_parts, p);
    parts[p] = (struct mo_device_task){.block = {.physics = batch->physics,
                                                 .urgency = MO_BATCH,
                                                 .back_end = MO_ON_DEVICE,
                                                 .cancel = batch->cancel,
                                                 .tag = batch->tag,
                                                 .share = batch->share,
                                                 .done = mo_waiter_done,
                                                 .context = waiter,
                                                 .shards = &parts[p]},
                                       .batch = batch,
                                       .first = part.first,
                                       .n = part.end - part.first,
                                       .layout = laid != NULL ? laid->parts[p].layout : NULL,
                                       .stop = &waiter->failed,
                                       .d_parameters = gradients->shards +
                                                       part.first / MO_DEVICE_SHARD * n_parameters};
  }
  for (uint32_t p = 0; p < n_parts; p++) {
    const int status = mo_devices_submit(gradients->devices, &parts[p].block);
    if (status != MO_OK) {
      parts[p].block.status = status;
      mo_waiter_done(&parts[p].block, waiter);
    }
  }
}

/* Returns the error that stopped the batch: the error of the failed part, not the cancellation of
 * the others. */
static int result_of(const struct mo_device_task *parts, uint32_t n_parts)
{
  int status = MO_OK;
  for (uint32_t p = 0; p < n_parts; p++)
    if (parts[p].block.status != MO_OK && (status == MO_OK || status == MO_ERR_CANCELLED))
      status = parts[p].block.status;
  return status;
}

struct sum {
  const float *shards; /* (n_shards, n_parameters) */
  uint32_t n_shards;
  size_t n_parameters;
  double *d_parameters;
};

static void add_up(void *context, size_t first, size_t end)
{
  const struct sum *sum = context;
  double *d = sum->d_parameters;
  memset(d + first, 0, (end - first) * sizeof(*d));
  for (uint32_t s = 0; s < sum->n_shards; s++) {
    const float *shard = sum->shards + s * sum->n_parameters;
    for (size_t i = first; i < end; i++)
      d[i] += (double)shard[i];
  }
}

int mo_devices_gradient(struct mo_device_gradients *gradients, struct mo_gradient_batch *batch)
{
  const size_t n_parameters = batch->controller->n_parameters;
  const uint32_t n_shards = (batch->n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD;
  const uint32_t n_parts = parts_of(gradients->devices, batch->n);
  struct mo_waiter waiter = MO_WAITER(n_parts);
  if (n_parts == 0)
    return MO_ERR_DEVICE;
  struct mo_device_task *parts = calloc(n_parts, sizeof(*parts));
  const int reserved =
      parts == NULL ? MO_ERR_NO_MEMORY : reserve(gradients, n_shards * n_parameters);
  if (reserved != MO_OK) {
    free(parts);
    return reserved;
  }
  struct laid_out *laid = take(gradients, batch, n_parts);
  submit(gradients, batch, laid, parts, n_parts, &waiter);
  mo_waiter_wait(&waiter);
  give_back(gradients, laid);
  const int status = result_of(parts, n_parts);
  for (uint32_t p = 0; p < n_parts && status == MO_OK; p++)
    mo_gradient_counts_add(&batch->counts, &parts[p].counts);
  if (status == MO_OK) {
    struct sum sum = {gradients->shards, n_shards, n_parameters, batch->d_parameters};
    mo_parallel(gradients->n_threads, n_parameters, add_up, &sum);
  }
  free(parts);
  return status;
}
