/* devices.c: loads a module, opens its devices, and keeps their queue and status. */
#include "compute/devices.h"

#include <dlfcn.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "base/clock.h"

#define DEVICES_MAX 64
/* Estimated seconds of a rollout step before any measurement. */
#define SCORING_S  1e-8
#define GRADIENT_S 3e-8

/* ---- loading ---- */

static int load(struct mo_devices *devices, const char *path, struct mo_message *message)
{
  const struct mo_device_module *(*get)(void) = NULL;
  const struct mo_device_module *module;
  void *symbol;
  if (access(path, F_OK) != 0 && errno == ENOENT)
    return mo_fail(message, MO_ERR_NOT_FOUND, "the file %s does not exist", path);
  devices->library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
  if (devices->library == NULL)
    return mo_fail(message, MO_ERR_UNSUPPORTED, "%s", dlerror());
  symbol = dlsym(devices->library, "mo_device_module");
  memcpy(&get, &symbol, sizeof(get));
  module = get != NULL ? get() : NULL;
  if (module == NULL)
    return mo_fail(message, MO_ERR_UNSUPPORTED, "%s is not a device module", path);
  if (module->abi != MO_DEVICE_ABI)
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "%s is for a different version of this program (interface %u, not %u); install "
                   "this version's module",
                   path, (unsigned)module->abi, (unsigned)MO_DEVICE_ABI);
  devices->module = module;
  return MO_OK;
}

/* ---- opening ---- */

static void close_unit(struct mo_unit *unit)
{
  const struct mo_device_module *module = unit->devices->module;
  for (struct mo_caller *caller = unit->callers; caller < unit->callers + MO_CALLERS; caller++) {
    while (caller->copies != NULL) {
      struct mo_device_copy *copy = caller->copies;
      caller->copies = copy->next;
      module->controller_free(caller->device, copy->controller);
      free(copy);
    }
    if (caller->device != NULL)
      module->close(caller->device);
    mo_chunk_destroy(&caller->chunk);
  }
}

static int open_caller(struct mo_unit *unit, struct mo_caller *caller)
{
  caller->unit = unit;
  const int status = mo_chunk_create(&caller->chunk);
  return status == MO_OK ? unit->devices->module->open(unit->status.index, &caller->device)
                         : status;
}

static int open_unit(struct mo_devices *devices, struct mo_unit *unit, uint32_t index)
{
  struct mo_device_info info = {.name = ""};
  *unit = (struct mo_unit){.devices = devices,
                           .n_callers = 1,
                           .status = {.index = index, .rows_at_once = MO_CHUNK_ROWS},
                           .changed_ns = mo_clock_ns(),
                           .row_limit = MO_CHUNK_ROWS,
                           .shard_limit = MO_DEVICE_ROWS_MAX / MO_DEVICE_SHARD};
  struct mo_device **device = &unit->callers[0].device;
  int status = open_caller(unit, &unit->callers[0]);
  if (status == MO_OK)
    status = devices->module->info(*device, &info);
  snprintf(unit->status.name, sizeof(unit->status.name), "%s", info.name);
  snprintf(unit->status.id, sizeof(unit->status.id), "%s", info.id);
  unit->status.memory_bytes = info.memory_bytes;
  unit->status.free_bytes = info.free_bytes;
  unit->status.multiprocessors = info.multiprocessors;
  unit->status.capability = info.capability;
  if (status == MO_OK && open_caller(unit, &unit->callers[1]) == MO_OK)
    unit->n_callers = 2; /* without a second caller, calls run one after another */
  if (status != MO_OK) {
    unit->status.state = MO_DEVICE_LOST;
    snprintf(unit->status.error, sizeof(unit->status.error), "%s",
             *device != NULL ? devices->module->error(*device) : mo_error_text(status));
    close_unit(unit);
  }
  return status;
}

/* Rejects a device whose bits would differ from the devices opened before it. */
static int check_class(const struct mo_devices *devices, struct mo_unit *unit)
{
  const struct mo_device_status *first = &devices->units[0].status, *status = &unit->status;
  if (devices->n == 0 || status->capability == first->capability)
    return MO_OK;
  snprintf(unit->status.error, sizeof(unit->status.error),
           "its compute capability is %u.%u, but device %u has %u.%u; use only devices with the "
           "same capability",
           (unsigned)status->capability / 10, (unsigned)status->capability % 10,
           (unsigned)first->index, (unsigned)first->capability / 10,
           (unsigned)first->capability % 10);
  unit->status.state = MO_DEVICE_LOST;
  close_unit(unit);
  return MO_ERR_DEVICE;
}

/* Writes everything that the bits depend on. Tensor cores of different capabilities round
 * differently. */
static void write_fingerprints(struct mo_devices *devices)
{
  const struct mo_device_module *module = devices->module;
  const unsigned capability = devices->units[0].status.capability;
  struct mo_device_class *class = &devices->class;
  snprintf(class->scores, sizeof(class->scores), "%s float32 %s sm%u", module->name,
           module->score_code, capability);
  snprintf(class->gradients, sizeof(class->gradients), "%s float32 %s sm%u", module->name,
           module->gradient_code, capability);
  atomic_store(&devices->is_named, true);
}

/* Opens the requested devices, or all devices that can be opened and have the capability of the
 * first. */
static int open_units(struct mo_devices *devices, const struct mo_devices_config *config,
                      struct mo_message *message)
{
  uint32_t found = 0;
  int status = devices->module->count(&found);
  if (status != MO_OK)
    return mo_fail(message, MO_ERR_DEVICE, "the module %s cannot count its devices",
                   devices->module->name);
  const uint32_t wanted = config->devices != NULL ? config->n
                          : found < DEVICES_MAX   ? found
                                                  : DEVICES_MAX;
  devices->units = calloc((size_t)wanted + 1, sizeof(*devices->units));
  if (devices->units == NULL)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  for (uint32_t i = 0; i < wanted; i++) {
    const uint32_t index = config->devices != NULL ? config->devices[i] : i;
    struct mo_unit *unit = &devices->units[devices->n];
    if (index >= found)
      return mo_fail(message, MO_ERR_RANGE,
                     "device %u does not exist; the module %s finds %u devices", (unsigned)index,
                     devices->module->name, (unsigned)found);
    status = open_unit(devices, unit,
                       index); /* MO_ERR_NO_MEMORY: other processes may be using its memory */
    if (status == MO_OK)
      status = check_class(devices, unit);
    if (status == MO_OK) {
      devices->n++;
      continue;
    }
    if (config->lost != NULL)
      config->lost(config->context, &unit->status);
    if (config->devices != NULL)
      return mo_fail(message, MO_ERR_DEVICE, "device %u cannot be used: %.180s", (unsigned)index,
                     unit->status.error);
  }
  return devices->n > 0 ? MO_OK
                        : mo_fail(message, MO_ERR_EXHAUSTED,
                                  "the module %s finds no working device", devices->module->name);
}

static int start(struct mo_devices *devices)
{
  char name[16];
  for (uint32_t i = 0; i < devices->n; i++) {
    struct mo_unit *unit = &devices->units[i];
    snprintf(name, sizeof(name), "mo-gather-%u", (unsigned)i % 10000);
    unit->has_gatherer = mo_thread_create(&unit->gatherer, name, mo_unit_gather, unit) == 0;
    snprintf(name, sizeof(name), "mo-device-%u", (unsigned)i % 10000);
    for (uint32_t c = 0; c < unit->n_callers; c++) {
      struct mo_caller *caller = &unit->callers[c];
      caller->has_thread =
          unit->has_gatherer && mo_thread_create(&caller->thread, name, mo_caller_run, caller) == 0;
      if (!caller->has_thread)
        return MO_ERR_NO_MEMORY;
    }
  }
  return MO_OK;
}

struct mo_devices *mo_devices_create(struct mo_compute *compute)
{
  struct mo_devices *devices = calloc(1, sizeof(*devices));
  if (devices == NULL)
    return NULL;
  devices->compute = compute;
  pthread_cond_init(&devices->wake, NULL);
  mo_fair_init(&devices->fair, 1);
  devices->fair.unit_s[MO_FAIR_SCORING] = SCORING_S;
  devices->fair.unit_s[MO_FAIR_GRADIENT] = GRADIENT_S;
  mo_fair_add(&devices->fair, &devices->own, 1);
  mo_fair_add(&devices->fair, &devices->urgent, MO_SHARE_WEIGHT_MAX);
  return devices;
}

int mo_compute_add_devices(struct mo_compute *compute, const struct mo_devices_config *config,
                           struct mo_message *message)
{
  if (mo_core(compute)->devices != NULL)
    return mo_fail(message, MO_ERR_CONFLICT, "devices were already added");
  struct mo_devices *devices = mo_devices_create(compute);
  if (devices == NULL)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  devices->lost = config->lost;
  devices->context = config->context;
  int status = load(devices, config->module, message);
  if (status == MO_OK)
    status = open_units(devices, config, message);
  if (status == MO_OK) {
    write_fingerprints(devices);
    devices->fair.credit_s = MO_FAIR_CREDIT_S * devices->n;
    atomic_store(&devices->n_working, devices->n);
    status = start(devices);
    if (status != MO_OK)
      mo_fail(message, status, "cannot start a thread for a device");
  }
  if (status == MO_OK)
    mo_core(compute)->devices = devices;
  else
    mo_devices_free(devices);
  return status;
}

void mo_devices_free(struct mo_devices *devices)
{
  if (devices == NULL)
    return;
  pthread_mutex_lock(&devices->fair.mutex);
  devices->stopping = true;
  for (uint32_t i = 0; i < devices->n; i++) {
    for (uint32_t c = 0; c < MO_CALLERS; c++)
      __atomic_store_n(&devices->units[i].callers[c].cancel, 1, __ATOMIC_RELAXED);
    devices->units[i].gathered_all =
        devices->units[i].gathered_all || !devices->units[i].has_gatherer;
  }
  pthread_cond_broadcast(&devices->wake);
  pthread_mutex_unlock(&devices->fair.mutex);
  for (uint32_t i = 0; i < devices->n; i++) {
    if (devices->units[i].has_gatherer)
      pthread_join(devices->units[i].gatherer, NULL);
    for (uint32_t c = 0; c < MO_CALLERS; c++)
      if (devices->units[i].callers[c].has_thread)
        pthread_join(devices->units[i].callers[c].thread, NULL);
  }
  if (devices->has_keeper)
    pthread_join(devices->keeper, NULL);
  for (uint32_t i = 0; i < devices->n; i++)
    close_unit(&devices->units[i]);
  free(devices->units);
  pthread_cond_destroy(&devices->wake);
  pthread_mutex_destroy(&devices->fair.mutex);
  if (devices->library != NULL)
    dlclose(devices->library);
  free(devices);
}

/* ---- the queue ---- */

static struct mo_compute_share *share_of(struct mo_devices *devices, const struct mo_block *block)
{
  if (block->urgency != MO_BATCH && block->shards == NULL)
    return &devices->urgent;
  return block->share != NULL ? block->share->on_devices : &devices->own;
}

void mo_compute_begin_blocks(struct mo_compute *compute)
{
  struct mo_devices *devices = mo_core(compute)->devices;
  if (devices != NULL)
    atomic_fetch_add(&devices->submitting, 1);
}

void mo_compute_end_blocks(struct mo_compute *compute)
{
  struct mo_devices *devices = mo_core(compute)->devices;
  if (devices != NULL)
    atomic_fetch_sub(&devices->submitting, 1);
}

int mo_devices_submit(struct mo_devices *devices, struct mo_block *block)
{
  MO_GUARD(&devices->fair.mutex);
  if (devices->stopping)
    return MO_ERR_CANCELLED;
  if (devices->is_absent ? !atomic_load(&devices->is_named) || !mo_block_suits_remote(block)
                         : atomic_load(&devices->n_working) == 0)
    return MO_ERR_DEVICE;
  const bool nothing_waits = atomic_load(&devices->fair.waiting) == 0;
  devices->tasks_waiting += block->shards != NULL;
  mo_fair_push(&devices->fair, share_of(devices, block), block);
  mo_remote_arrived(mo_core(devices->compute), block);
  if (nothing_waits || block->shards != NULL)
    pthread_cond_broadcast(&devices->wake);
  return MO_OK;
}

/* ---- status ---- */

uint32_t mo_compute_devices(const struct mo_compute *compute)
{
  const struct mo_devices *devices = mo_core(compute)->devices;
  return devices != NULL ? devices->n : 0;
}

uint32_t mo_compute_devices_working(const struct mo_compute *compute)
{
  const struct mo_devices *devices = mo_core(compute)->devices;
  return devices != NULL ? atomic_load(&devices->n_working) : 0;
}

int mo_compute_device(struct mo_compute *compute, uint32_t position,
                      struct mo_device_status *status)
{
  struct mo_devices *devices = mo_core(compute)->devices;
  if (devices == NULL || position >= devices->n)
    return MO_ERR_RANGE;
  struct mo_unit *unit = &devices->units[position];
  MO_GUARD(&devices->fair.mutex);
  mo_unit_account(unit);
  *status = unit->status;
  status->is_busy = mo_unit_is_running(unit);
  unit->wants_info = true;
  pthread_cond_broadcast(&devices->wake);
  return MO_OK;
}

static const struct mo_device_class *class_of(const struct mo_compute *compute)
{
  const struct mo_devices *devices = mo_core(compute)->devices;
  return devices != NULL && atomic_load(&devices->is_named) ? &devices->class : NULL;
}

const char *mo_compute_device_fingerprint(const struct mo_compute *compute)
{
  const struct mo_device_class *class = class_of(compute);
  return class != NULL ? class->scores : NULL;
}

const char *mo_compute_device_gradient_fingerprint(const struct mo_compute *compute)
{
  const struct mo_device_class *class = class_of(compute);
  return class != NULL ? class->gradients : NULL;
}
