/* device_run.c: the threads of a device.
 *
 * The gatherer takes a chunk for an idle caller when work waits, while the device is still busy
 * with the previous one, and builds its bodies. Submitters submit one block at a time, but a device
 * takes as long for one block as for a thousand. The gatherer therefore waits while a submitter
 * announces more blocks, and then until no new block has arrived for a few milliseconds. It also
 * cancels a running chunk if all of its blocks were cancelled.
 *
 * Two callers call the module. While the last rollouts of a call finish, most of the device would
 * be idle, so it begins the rollouts of the other call, with rows that are laid out and copied by
 * then. A gradient needs the entire device and its memory, so it runs without another call. The
 * time of a device is charged once, to the call that began first.
 *
 * When the module lacks memory for a chunk, the caller halves it, and grows chunks again later; the
 * second caller returns its chunk and takes no more. A caller also halves a chunk that the module
 * does not support, until only the unsupported blocks are left, so that the choice does not depend
 * on a block's neighbors. After a failure of the device, its threads exit, and everything without a
 * result is requeued. */
#include "compute/devices.h"
#include "compute/rates.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"

enum {
  LINGER_IDLE_MS = 2,  /* without a new block, before an idle device starts on the waiting blocks */
  LINGER_BUSY_MS = 10, /* the same for a busy device */
  LINGER_MAX_MS = 50,  /* upper limit, even if blocks keep arriving */
  WATCH_MS = 20,
  BUILD_THREADS_MAX = 16,
  GROW_AFTER = 8 /* number of chunks without a lack of memory */
};

static const double load_s = 10; /* time constant of the load's average */

/* Waits for a wake-up, under the mutex. */
static void wait_ms(struct mo_devices *devices, int64_t ms)
{
  (void)mo_wait_until(&devices->wake, &devices->fair.mutex, mo_clock_us() + ms * 1000);
}

static bool is_running(const struct mo_caller *caller)
{
  return caller->state == MO_CALLER_RUNS;
}

bool mo_unit_is_running(const struct mo_unit *unit)
{
  return is_running(&unit->callers[0]) || is_running(&unit->callers[1]);
}

void mo_unit_account(struct mo_unit *unit)
{
  const uint64_t now_ns = mo_clock_ns();
  const double passed_s = 1e-9 * (double)(now_ns - unit->changed_ns),
               keep = exp(-passed_s / load_s);
  const bool is_busy = mo_unit_is_running(unit);
  unit->changed_ns = now_ns;
  unit->status.load = unit->status.load * keep + (is_busy ? 1 - keep : 0);
  if (is_busy)
    unit->status.busy_s += passed_s;
}

static bool has_ended(const struct mo_unit *unit)
{
  return unit->devices->stopping || unit->status.state == MO_DEVICE_LOST;
}

/* ---- the gatherer ---- */

static void watch(struct mo_unit *unit)
{
  for (struct mo_caller *caller = unit->callers; caller < unit->callers + MO_CALLERS; caller++)
    if (is_running(caller) && (unit->devices->stopping || mo_chunk_is_cancelled(&caller->chunk)))
      __atomic_store_n(&caller->cancel, 1, __ATOMIC_RELAXED);
}

/* Waits until no more blocks arrive, or enough are waiting for all devices. */
static void linger(struct mo_unit *unit)
{
  struct mo_devices *devices = unit->devices;
  const uint64_t enough = (uint64_t)MO_CHUNK_ROWS / 8 * devices->n;
  const uint64_t end_ns = mo_clock_ns() + UINT64_C(1000000) * LINGER_MAX_MS;
  uint64_t before = 0, waiting = atomic_load(&devices->fair.waiting), since_ns = mo_clock_ns();
  bool were_submitting = false;
  while (waiting > 0 && waiting < enough && devices->tasks_waiting == 0 && !has_ended(unit) &&
         mo_clock_ns() < end_ns) {
    const uint64_t patience_ns =
        UINT64_C(1000000) * (mo_unit_is_running(unit) ? LINGER_BUSY_MS : LINGER_IDLE_MS);
    const bool are_submitting = atomic_load(&devices->submitting) > 0;
    if (were_submitting && !are_submitting)
      return; /* the last submitter is done */
    were_submitting = are_submitting;
    if (waiting > before || are_submitting)
      since_ns = mo_clock_ns();
    else if (mo_clock_ns() - since_ns >= patience_ns)
      return;
    before = waiting;
    wait_ms(devices, 1);
    watch(unit);
    waiting = atomic_load(&devices->fair.waiting);
  }
}

/* Returns NULL if there is none. */
static struct mo_caller *idle_caller(struct mo_unit *unit)
{
  for (uint32_t c = 0; c < unit->n_callers; c++)
    if (unit->callers[c].state == MO_CALLER_IDLE)
      return &unit->callers[c];
  return NULL;
}

/* Returns whether no work is waiting, or whether an idle device should take it instead. */
static bool has_to_wait(struct mo_unit *unit)
{
  const struct mo_devices *devices = unit->devices;
  if (idle_caller(unit) == NULL || atomic_load(&devices->fair.waiting) == 0)
    return true;
  for (uint32_t i = 0; i < devices->n && mo_unit_held(unit) > 0; i++)
    if (devices->units[i].status.state == MO_DEVICE_WORKS && mo_unit_held(&devices->units[i]) == 0)
      return true;
  return false;
}

static bool gather(struct mo_unit *unit)
{
  struct mo_devices *devices = unit->devices;
  while (!has_ended(unit) && has_to_wait(unit)) {
    watch(unit);
    if (mo_unit_held(unit) > 0)
      wait_ms(devices, WATCH_MS);
    else
      pthread_cond_wait(&devices->wake, &devices->fair.mutex);
  }
  if (!has_ended(unit))
    linger(unit);
  return !has_ended(unit);
}

void *mo_unit_gather(void *context)
{
  struct mo_unit *unit = context;
  struct mo_devices *devices = unit->devices;
  const uint32_t n_threads = mo_core(devices->compute)->n_workers;
  pthread_mutex_lock(&devices->fair.mutex);
  while (gather(unit)) {
    struct mo_caller *caller = idle_caller(unit);
    if (has_to_wait(unit) || !mo_chunk_take(unit, &caller->chunk)) /* another device took it */
      continue;
    caller->state = MO_CALLER_GETS;
    pthread_mutex_unlock(&devices->fair.mutex);
    mo_chunk_build(&caller->chunk, n_threads < BUILD_THREADS_MAX ? n_threads : BUILD_THREADS_MAX);
    pthread_mutex_lock(&devices->fair.mutex);
    caller->state = MO_CALLER_READY;
    pthread_cond_broadcast(&devices->wake);
  }
  while (devices->stopping && mo_unit_is_running(unit)) { /* it will stop soon */
    watch(unit);
    wait_ms(devices, WATCH_MS);
  }
  unit->gathered_all = true;
  pthread_cond_broadcast(&devices->wake);
  pthread_mutex_unlock(&devices->fair.mutex);
  return NULL;
}

/* ---- weights ---- */

/* Called under the mutex, which it releases for a while: frees the copies that are no longer
 * needed. Only the caller changes the list. */
static void drop_copies(struct mo_caller *caller)
{
  struct mo_devices *devices = caller->unit->devices;
  struct mo_device_copy **link = &caller->copies;
  while (*link != NULL) {
    struct mo_device_copy *copy = *link;
    if (copy->owner != NULL) {
      link = &copy->next;
      continue;
    }
    *link = copy->next;
    pthread_mutex_unlock(&devices->fair.mutex);
    devices->module->controller_free(caller->device, copy->controller);
    free(copy);
    pthread_mutex_lock(&devices->fair.mutex);
  }
}

/* Finds or creates the caller's copy of the weights. *ret NULL: passive bodies.
 * MO_ERR_UNSUPPORTED, MO_ERR_NO_MEMORY, MO_ERR_DEVICE. */
static int prepare_controller(struct mo_caller *caller, const struct mo_compute_controller *owner,
                              struct mo_device_controller **ret)
{
  const struct mo_controller *weights = mo_compute_controller_weights(owner);
  const struct mo_devices *devices = caller->unit->devices;
  pthread_mutex_t *mutex = &caller->unit->devices->fair.mutex;
  *ret = NULL;
  if (weights == NULL)
    return MO_OK;
  pthread_mutex_lock(mutex);
  struct mo_device_copy *copy = caller->copies;
  while (copy != NULL && copy->owner != owner)
    copy = copy->next;
  pthread_mutex_unlock(mutex);
  if (copy == NULL) {
    copy = calloc(1, sizeof(*copy));
    if (copy == NULL)
      return MO_ERR_NO_MEMORY;
    const int status =
        devices->module->controller_create(caller->device, weights, &copy->controller);
    if (status != MO_OK && status != MO_ERR_UNSUPPORTED) {
      free(copy);
      return status;
    }
    pthread_mutex_lock(mutex);
    copy->owner = owner;
    copy->next = caller->copies;
    caller->copies = copy;
    pthread_mutex_unlock(mutex);
  }
  *ret = copy->controller;
  return copy->controller != NULL ? MO_OK : MO_ERR_UNSUPPORTED;
}

/* ---- callers ---- */

static void shrink(_Atomic uint32_t *limit, uint32_t tried, struct mo_unit *unit)
{
  MO_GUARD(&unit->devices->fair.mutex);
  if (*limit > tried / 2)
    *limit = tried / 2 > 0 ? tried / 2 : 1;
  unit->good_chunks = 0;
}

/* If there is not enough memory for the second caller, the first one gets all of it. Returns
 * whether that is the case; the blocks without a result are then requeued. */
static bool retires(struct mo_caller *caller, int status)
{
  struct mo_unit *unit = caller->unit;
  if (status != MO_ERR_NO_MEMORY || caller == &unit->callers[0])
    return false;
  MO_GUARD(&unit->devices->fair.mutex);
  unit->n_callers = 1;
  return true;
}

static void set_status(struct mo_chunk *chunk, uint32_t first, uint32_t last, int status)
{
  for (uint32_t i = first; i < last; i++)
    chunk->items[i].status = status;
}

/* Scores blocks first … last − 1 and sets their statuses. MO_ERR_DEVICE, or MO_OK for any other
 * result. */
static int score(struct mo_caller *caller, struct mo_device_controller *controller, uint32_t first,
                 uint32_t last)
{
  struct mo_unit *unit = caller->unit;
  struct mo_chunk *chunk = &caller->chunk;
  const uint32_t row = chunk->items[first].first_row, middle = first + (last - first) / 2;
  struct mo_device_score call = {
      .controller = controller,
      .robots = chunk->robots + row,
      .n = (last < chunk->n_active ? chunk->items[last].first_row : chunk->n_rows) - row,
      .physics = chunk->items[first].block->physics,
      .cancel = &caller->cancel,
      .outcomes = chunk->outcomes + row,
      .measures = chunk->is_measured ? chunk->measures + row : NULL};
  const bool is_one = last - first == 1, is_too_large = !is_one && call.n > unit->row_limit;
  int status =
      is_too_large ? MO_ERR_NO_MEMORY : unit->devices->module->score(caller->device, &call);
  if (status == MO_ERR_DEVICE)
    return status;
  if (status == MO_OK || status == MO_ERR_CANCELLED) {
    set_status(chunk, first, last, status);
    return MO_OK;
  }
  if (!is_too_large && retires(caller, status))
    return MO_OK;
  if (status == MO_ERR_NO_MEMORY && !is_too_large)
    shrink(&unit->row_limit, call.n, unit);
  if (is_one) {
    chunk->items[first].status = status == MO_ERR_UNSUPPORTED ? MO_CHUNK_TO_WORKERS : status;
    return MO_OK;
  }
  status = score(caller, controller, first, middle);
  return status == MO_OK ? score(caller, controller, middle, last) : status;
}

static int run_blocks(struct mo_caller *caller)
{
  struct mo_chunk *chunk = &caller->chunk;
  struct mo_device_controller *controller = NULL;
  int status = MO_OK;
  if (chunk->n_active == 0)
    return MO_OK;
  status = prepare_controller(caller, chunk->items[0].block->controller, &controller);
  if (status == MO_OK)
    return score(caller, controller, 0, chunk->n_active);
  if (status == MO_ERR_DEVICE)
    return status;
  if (!retires(caller, status))
    set_status(chunk, 0, chunk->n_active,
               status == MO_ERR_UNSUPPORTED ? MO_CHUNK_TO_WORKERS : status);
  return MO_OK;
}

/* Differentiates shards first … last − 1. */
static int differentiate(struct mo_caller *caller, struct mo_device_task *task, uint32_t first,
                         uint32_t last)
{
  struct mo_unit *unit = caller->unit;
  const uint32_t row = first * MO_DEVICE_SHARD, n = last - first, middle = first + n / 2;
  const uint32_t end = last * MO_DEVICE_SHARD < task->n ? last * MO_DEVICE_SHARD : task->n;
  const struct mo_gradient_batch *batch = task->batch;
  struct mo_device_gradient call = {.controller = batch->controller,
                                    .robots = batch->robots + task->first + row,
                                    .n = end - row,
                                    .physics = batch->physics,
                                    .layout = end - row == task->n ? task->layout : NULL,
                                    .options = mo_batch_options(batch),
                                    .cancel = &caller->cancel,
                                    .d_parameters = task->d_parameters +
                                                    first * batch->controller->n_parameters,
                                    .outcomes = batch->outcomes + task->first + row};
  const bool is_too_large = n > 1 && n > unit->shard_limit;
  int status = is_too_large ? MO_ERR_NO_MEMORY
                            : unit->devices->module->gradient(unit->callers[0].device, &call);
  if (status == MO_OK)
    mo_gradient_counts_add(&task->counts, &call.counts);
  if (status != MO_ERR_NO_MEMORY)
    return status;
  if (!is_too_large)
    shrink(&unit->shard_limit, n, unit);
  if (n == 1)
    return status;
  status = differentiate(caller, task, first, middle);
  return status == MO_OK ? differentiate(caller, task, middle, last) : status;
}

static int run_task(struct mo_caller *caller)
{
  struct mo_chunk *chunk = &caller->chunk;
  struct mo_device_task *task = chunk->task;
  int status = MO_ERR_CANCELLED;
  task->counts = (struct mo_gradient_counts){0};
  if (!mo_chunk_is_cancelled(chunk))
    status = differentiate(caller, task, 0, (task->n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD);
  if (status != MO_ERR_DEVICE)
    chunk->items[0].status = status;
  return status == MO_ERR_DEVICE ? status : MO_OK;
}

static uint32_t doubled(uint32_t limit, uint32_t most)
{
  return limit < most / 2 ? 2 * limit : most;
}

static void count(struct mo_unit *unit, const struct mo_chunk *chunk)
{
  unit->status.calls++;
  if (chunk->task != NULL && chunk->items[0].status == MO_OK)
    unit->status.gradient_robots_done += chunk->task->n;
  for (uint32_t i = 0; chunk->task == NULL && i < chunk->n_active; i++)
    if (chunk->items[i].status == MO_OK)
      unit->status.rollouts_done += chunk->items[i].block->n_environments;
  if (++unit->good_chunks >= GROW_AFTER) {
    unit->good_chunks = 0;
    unit->row_limit = doubled(unit->row_limit, MO_CHUNK_ROWS);
    unit->shard_limit = doubled(unit->shard_limit, MO_DEVICE_ROWS_MAX / MO_DEVICE_SHARD);
  }
  unit->status.rows_at_once = unit->row_limit;
}

/* Returns and delivers a chunk. Called under the mutex, which it releases for a while. */
static void hand_back(struct mo_devices *devices, struct mo_chunk *chunk)
{
  mo_chunk_return(devices, chunk);
  pthread_mutex_unlock(&devices->fair.mutex);
  mo_chunk_deliver(devices, chunk);
  pthread_mutex_lock(&devices->fair.mutex);
}

/* Under the mutex: ends waiting work when the back end stops or no device is left. */
static void drain(struct mo_caller *caller)
{
  struct mo_devices *devices = caller->unit->devices;
  struct mo_chunk *chunk = &caller->chunk;
  while ((devices->stopping || atomic_load(&devices->n_working) == 0) &&
         mo_chunk_take(caller->unit, chunk)) {
    mo_fair_correct(&devices->fair, &chunk->charge, 0, false);
    chunk->n_active = 0;
    hand_back(devices, chunk);
  }
}

/* Under the mutex: marks the device as lost. The other caller may also detect it. */
static void lose(const struct mo_caller *caller)
{
  struct mo_unit *unit = caller->unit;
  struct mo_devices *devices = unit->devices;
  if (unit->status.state == MO_DEVICE_LOST)
    return;
  unit->status.state = MO_DEVICE_LOST;
  snprintf(unit->status.error, sizeof(unit->status.error), "%s",
           devices->module->error(caller->chunk.task != NULL ? unit->callers[0].device
                                                             : caller->device));
  atomic_fetch_sub(&devices->n_working, 1);
  pthread_cond_broadcast(&devices->wake);
  if (devices->lost != NULL) {
    const struct mo_device_status status = unit->status;
    pthread_mutex_unlock(&devices->fair.mutex);
    devices->lost(devices->context, &status);
    pthread_mutex_lock(&devices->fair.mutex);
  }
}

static const struct mo_caller *other_of(const struct mo_caller *caller)
{
  return &caller->unit->callers[caller == caller->unit->callers];
}

static bool runs_gradient(const struct mo_caller *caller)
{
  return is_running(caller) && caller->chunk.task != NULL;
}

/* Returns whether the caller has a chunk that may run now: a gradient uses the first caller's
 * device, and nothing else runs at the same time. */
static bool may_run(const struct mo_caller *caller)
{
  const struct mo_caller *other = other_of(caller);
  return caller->state == MO_CALLER_READY &&
         (caller->chunk.task == NULL ? !runs_gradient(other)
                                     : !is_running(other) && other->state != MO_CALLER_ASKS);
}

/* Under the mutex: returns the device time of a call that has finished, without the time charged to
 * an earlier call. */
static uint64_t charge_ns(struct mo_unit *unit, uint64_t start_ns)
{
  const uint64_t now_ns = mo_clock_ns();
  const uint64_t from_ns = start_ns > unit->charged_ns ? start_ns : unit->charged_ns;
  unit->charged_ns = now_ns;
  return now_ns - from_ns;
}

/* Returns what a call has computed, without its time; no rollouts: nothing to add to the rates.
 * Called without the mutex, because a call has up to a hundred thousand rows. */
static struct mo_rate work_of(const struct mo_chunk *chunk)
{
  const struct mo_device_task *task = chunk->task;
  const struct mo_block *first = chunk->items[0].block;
  const struct mo_scheme *scheme =
      task != NULL ? &task->batch->physics.scheme : &first->physics.scheme;
  const bool is_plain = task == NULL && !chunk->is_measured &&
                        mo_compute_controller_weights(first->controller) != NULL;
  struct mo_rate work = mo_rate_of(task != NULL, MO_ON_DEVICE, MO_FLOAT32, scheme);
  uint64_t springs = 0;
  work.blocks = 1;
  if (task != NULL && chunk->items[0].status == MO_OK)
    work.rollouts = task->n;
  for (uint64_t i = 0; task != NULL && i < work.rollouts; i++)
    springs += task->batch->robots[task->first + i].body->n_springs;
  for (uint32_t i = 0; is_plain && i < chunk->n_active; i++) {
    const struct mo_chunk_item *item = &chunk->items[i];
    if (item->status != MO_OK) /* for example a block that the workers will compute */
      continue;
    work.rollouts += item->block->n_environments;
    springs +=
        (uint64_t)chunk->robots[item->first_row].body->n_springs * item->block->n_environments;
  }
  work.steps = work.rollouts * scheme->n_steps;
  work.spring_steps = springs * scheme->n_steps;
  return work;
}

/* Under the mutex: runs the caller's chunk. */
static void run_chunk(struct mo_caller *caller)
{
  struct mo_unit *unit = caller->unit;
  struct mo_devices *devices = unit->devices;
  struct mo_chunk *chunk = &caller->chunk;
  mo_unit_account(unit);
  caller->state = MO_CALLER_RUNS;
  caller->cancel = devices->stopping;
  pthread_cond_broadcast(&devices->wake);
  const uint64_t start_ns = mo_clock_ns();
  pthread_mutex_unlock(&devices->fair.mutex);
  mo_thread_tag = chunk->items[0].block->tag;
  const int status = chunk->task != NULL ? run_task(caller) : run_blocks(caller);
  mo_thread_tag = -1;
  struct mo_rate work = work_of(chunk);
  pthread_mutex_lock(&devices->fair.mutex);
  const uint64_t took_ns = charge_ns(unit, start_ns);
  mo_unit_account(unit);
  caller->state = MO_CALLER_DELIVERS;
  count(unit, chunk);
  work.busy_s = 1e-9 * (double)took_ns;
  if (status == MO_OK && work.rollouts > 0)
    mo_rates_add(mo_core(devices->compute)->rates, &work);
  mo_fair_correct(&devices->fair, &chunk->charge, 1e-9 * (double)took_ns, status == MO_OK);
  atomic_fetch_add(&chunk->charge.share->busy_ns, took_ns);
  if (status == MO_ERR_DEVICE)
    lose(caller);
  hand_back(devices, chunk);
  caller->state = MO_CALLER_IDLE;
  pthread_cond_broadcast(&devices->wake);
}

static void read_free_memory(struct mo_caller *caller)
{
  struct mo_unit *unit = caller->unit;
  struct mo_devices *devices = unit->devices;
  struct mo_device_info info = {.name = ""};
  caller->state = MO_CALLER_ASKS;
  pthread_mutex_unlock(&devices->fair.mutex);
  const int status = devices->module->info(caller->device, &info);
  pthread_mutex_lock(&devices->fair.mutex);
  caller->state = MO_CALLER_IDLE;
  unit->wants_info = false;
  if (status == MO_OK)
    unit->status.free_bytes = info.free_bytes;
  pthread_cond_broadcast(&devices->wake);
}

static bool wants_memory(const struct mo_caller *caller)
{
  const struct mo_unit *unit = caller->unit;
  return unit->wants_info && caller == unit->callers && caller->state == MO_CALLER_IDLE &&
         !runs_gradient(other_of(caller));
}

void *mo_caller_run(void *context)
{
  struct mo_caller *caller = context;
  struct mo_unit *unit = caller->unit;
  struct mo_devices *devices = unit->devices;
  pthread_mutex_lock(&devices->fair.mutex);
  while (!has_ended(unit) || !unit->gathered_all) {
    if (!has_ended(unit) && may_run(caller))
      run_chunk(caller);
    else if (!has_ended(unit) && wants_memory(caller))
      read_free_memory(caller);
    else
      pthread_cond_wait(&devices->wake, &devices->fair.mutex);
    drop_copies(caller);
  }
  if (caller->state == MO_CALLER_READY) {
    mo_fair_correct(&devices->fair, &caller->chunk.charge, 0, false);
    hand_back(devices, &caller->chunk);
    caller->state = MO_CALLER_IDLE;
  }
  drain(caller);
  pthread_mutex_unlock(&devices->fair.mutex);
  return NULL;
}
