/* fake.c: a module of devices that computes on the processor, for tests on machines without
 * devices: scores with the fast path, gradients with blocks of the CPU. Environment variables
 * control it when it is loaded or opens a device:
 *   MORPHO_FAKE_DEVICES   number of devices (1)
 *   MORPHO_FAKE_ROWS      maximum rows of a call to `score`; more fail for lack of memory
 *   MORPHO_FAKE_SHARDS    maximum shards of a call to `gradient`; more fail for lack of memory
 *   MORPHO_FAKE_SPRINGS   a body with more springs is not supported
 *   MORPHO_FAKE_DELAY_MS  additional time of every call
 *   MORPHO_FAKE_LOSE      "1:5": device 1 is lost in its fifth call
 *   MORPHO_FAKE_LOSE_IF   every device is lost as soon as a file of this name exists
 *   MORPHO_FAKE_SHUT      this device cannot be opened
 *   MORPHO_FAKE_FULL      this device lacks the memory to be opened
 *   MORPHO_FAKE_HASTE     a gradient whose robots were not laid out ahead is invalid
 *   MORPHO_FAKE_FAULT     laying out robots is a memory fault
 *   MORPHO_FAKE_MEET      this many layouts must run in parallel: one that waits 20 s fails
 *   MORPHO_FAKE_BESIDE    the same for calls to `score`, until it has happened once
 *   MORPHO_FAKE_OLDER     this device has compute capability 8.0, the others have 9.0
 *   MORPHO_FAKE_ABI, MORPHO_FAKE_CODE  the interface and code versions that it reports
 *
 * Tests may also set `turns`: the calls to `score` numbered from it on wait until it is raised. */
#include "compute/device.h"

#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define NO_LIMIT UINT32_MAX

struct mo_device {
  uint32_t index, rows, shards, springs, delay_ms, lost_in, haste, calls;
  const char *lost_if;
  bool is_lost;
  uint32_t n_controllers;
  struct mo_workspace_memory *memory;
  struct mo_gradient_memory *gradient;
  struct mo_pack *passive;
  const volatile int *cancel; /* inside a call */
};

struct mo_device_controller {
  struct mo_pack *pack;
};

/* The robots that were laid out: a call that gets other robots' layout would be a mistake. */
struct mo_device_layout {
  const struct mo_robot *robots;
  uint32_t n;
  uint64_t springs; /* of all robots */
};

static uint32_t number(const char *name, uint32_t otherwise)
{
  const char *text = getenv(name);
  return text != NULL && text[0] != '\0' ? (uint32_t)strtoul(text, NULL, 10) : otherwise;
}

static int fake_count(uint32_t *n)
{
  *n = number("MORPHO_FAKE_DEVICES", 1);
  return MO_OK;
}

static int fake_open(uint32_t index, struct mo_device **ret)
{
  unsigned which = 0, call = 0;
  const char *lose = getenv("MORPHO_FAKE_LOSE");
  struct mo_device *device;
  int status;
  if (number("MORPHO_FAKE_SHUT", NO_LIMIT) == index)
    return MO_ERR_DEVICE;
  if (number("MORPHO_FAKE_FULL", NO_LIMIT) == index)
    return MO_ERR_NO_MEMORY;
  device = calloc(1, sizeof(*device));
  if (device == NULL)
    return MO_ERR_NO_MEMORY;
  device->index = index;
  device->rows = number("MORPHO_FAKE_ROWS", NO_LIMIT);
  device->shards = number("MORPHO_FAKE_SHARDS", NO_LIMIT);
  device->springs = number("MORPHO_FAKE_SPRINGS", NO_LIMIT);
  device->delay_ms = number("MORPHO_FAKE_DELAY_MS", 0);
  device->haste = number("MORPHO_FAKE_HASTE", 0);
  device->lost_if = getenv("MORPHO_FAKE_LOSE_IF");
  if (lose != NULL && sscanf(lose, "%u:%u", &which, &call) == 2 && which == index)
    device->lost_in = call;
  status = mo_workspace_memory_create(&device->memory);
  if (status == MO_OK)
    status = mo_gradient_memory_create(MO_GRADIENT_DEFAULT_BYTES, &device->gradient);
  if (status == MO_OK)
    status = mo_pack_create(NULL, mo_isa_best(), MO_FLOAT32, &device->passive);
  if (status != MO_OK)
    abort();
  *ret = device;
  return MO_OK;
}

static void fake_close(struct mo_device *device)
{
  if (device == NULL)
    return;
  if (device->n_controllers > 0)
    abort(); /* they should have been freed before */
  mo_pack_free(device->passive);
  mo_workspace_memory_free(device->memory);
  mo_gradient_memory_free(device->gradient);
  free(device);
}

static int fake_info(struct mo_device *device, struct mo_device_info *info)
{
  *info = (struct mo_device_info){
      .name = "Fake device",
      .memory_bytes = UINT64_C(8) << 30,
      .free_bytes = UINT64_C(6) << 30,
      .multiprocessors = 4,
      .capability = number("MORPHO_FAKE_OLDER", NO_LIMIT) == device->index ? 80 : 90};
  snprintf(info->id, sizeof(info->id), "FAKE-%u", (unsigned)device->index);
  return MO_OK;
}

static int fake_controller_create(struct mo_device *device, const struct mo_controller *controller,
                                  struct mo_device_controller **ret)
{
  struct mo_device_controller *made = calloc(1, sizeof(*made));
  if (made == NULL || mo_pack_create(controller, mo_isa_best(), MO_FLOAT32, &made->pack) != MO_OK)
    abort();
  device->n_controllers++;
  *ret = made;
  return MO_OK;
}

static void fake_controller_free(struct mo_device *device, struct mo_device_controller *controller)
{
  if (controller == NULL)
    return;
  device->n_controllers--;
  mo_pack_free(controller->pack);
  free(controller);
}

struct meeting {
  pthread_mutex_t mutex;
  pthread_cond_t came;
  uint64_t met;
};
#define MEETING                                                                                    \
  {                                                                                                \
    .mutex = PTHREAD_MUTEX_INITIALIZER, .came = PTHREAD_COND_INITIALIZER                           \
  }

/* Returns false if the others did not arrive. */
static bool meet(struct meeting *meeting, uint32_t n, bool once)
{
  struct timespec end;
  int status = 0;
  clock_gettime(CLOCK_REALTIME, &end);
  end.tv_sec += 20;
  pthread_mutex_lock(&meeting->mutex);
  const uint64_t all = once ? n : (meeting->met / n + 1) * n;
  meeting->met++;
  pthread_cond_broadcast(&meeting->came);
  while (meeting->met < all && status == 0)
    status = pthread_cond_timedwait(&meeting->came, &meeting->mutex, &end);
  const bool there = meeting->met >= all;
  pthread_mutex_unlock(&meeting->mutex);
  return there;
}

static int look(void *context)
{
  const struct mo_device *device = context;
  return device->cancel != NULL && __atomic_load_n(device->cancel, __ATOMIC_RELAXED) != 0;
}

/* Every call starts with this. */
static int begin(struct mo_device *device, const struct mo_robot *robots, uint32_t n,
                 const volatile int *cancel)
{
  const struct timespec millisecond = {.tv_nsec = 1000000};
  device->cancel = cancel;
  device->calls++;
  if (device->is_lost) /* a lost device must not be used any more */
    abort();
  for (uint32_t i = 0; i < n; i++)
    if (robots[i].body->n_springs > device->springs)
      return MO_ERR_UNSUPPORTED;
  for (uint32_t ms = 0; ms < device->delay_ms && look(device) == 0; ms++)
    nanosleep(&millisecond, NULL);
  device->is_lost = (device->lost_in > 0 && device->calls >= device->lost_in) ||
                    (device->lost_if != NULL && access(device->lost_if, F_OK) == 0);
  return device->is_lost ? MO_ERR_DEVICE : look(device) != 0 ? MO_ERR_CANCELLED : MO_OK;
}

__attribute__((visibility("default"))) atomic_int turns = INT_MAX, started;

static void wait_for_turn(void)
{
  const struct timespec millisecond = {.tv_nsec = 1000000};
  const int number = atomic_fetch_add(&started, 1);
  while (atomic_load(&turns) <= number)
    nanosleep(&millisecond, NULL);
}

static int fake_score(struct mo_device *device, struct mo_device_score *score)
{
  static struct meeting meeting = MEETING;
  const struct mo_pause_point pause = {.interval = 10, .reached = look, .context = device};
  const struct mo_pack *pack =
      score->controller != NULL ? score->controller->pack : device->passive;
  int status;
  if (score->n < 1 || score->n > MO_DEVICE_ROWS_MAX)
    return MO_ERR_INVALID;
  if (score->n > device->rows)
    return MO_ERR_NO_MEMORY;
  const uint32_t beside = number("MORPHO_FAKE_BESIDE", 0);
  if (beside > 0 && !meet(&meeting, beside, true))
    return MO_ERR_DEVICE;
  wait_for_turn();
  status = begin(device, score->robots, score->n, score->cancel);
  for (uint32_t i = 0; i < score->n && status == MO_OK;) {
    const struct mo_environment *environments[MO_BLOCK_LANES];
    uint32_t lanes = 0;
    while (i + lanes < score->n && lanes < MO_BLOCK_LANES &&
           score->robots[i + lanes].body == score->robots[i].body) {
      environments[lanes] = score->robots[i + lanes].environment;
      lanes++;
    }
    const struct mo_measuring measuring = {
        .set = MO_MEASURES_ALL, .values = score->measures != NULL ? score->measures + i : NULL};
    status = mo_rollout_block(device->memory, pack, score->robots[i].body, environments, lanes,
                              &score->physics, NULL, score->measures != NULL ? &measuring : NULL,
                              &pause, score->outcomes + i);
    i += lanes;
  }
  return status;
}

static uint64_t springs_of(const struct mo_robot *robots, uint32_t n)
{
  uint64_t sum = 0;
  for (uint32_t i = 0; i < n; i++)
    sum = sum * 31 + robots[i].body->n_springs;
  return sum;
}

static int fake_lay_out(const struct mo_device *device, const struct mo_robot *robots, uint32_t n,
                        const struct mo_physics *physics, struct mo_device_layout **layout)
{
  static struct meeting meeting = MEETING;
  (void)device;
  (void)physics;
  if (number("MORPHO_FAKE_FAULT", 0) > 0)
    raise(SIGSEGV);
  if (!meet(&meeting, number("MORPHO_FAKE_MEET", 1), false))
    return MO_ERR_DEVICE;
  if (*layout == NULL && (*layout = malloc(sizeof(**layout))) == NULL)
    return MO_ERR_NO_MEMORY;
  **layout = (struct mo_device_layout){robots, n, springs_of(robots, n)};
  return MO_OK;
}

static void fake_layout_free(struct mo_device_layout *layout)
{
  free(layout);
}

static void *fake_allocate(const struct mo_device *device, size_t bytes)
{
  (void)device;
  return malloc(bytes);
}

static void fake_release(void *memory)
{
  free(memory);
}

static int fake_gradient(struct mo_device *device, struct mo_device_gradient *gradient)
{
  const struct mo_pause_point pause = {.interval = 4, .reached = look, .context = device};
  const uint32_t n_parameters = (uint32_t)gradient->controller->n_parameters;
  const struct mo_device_layout *layout = gradient->layout;
  struct mo_pack *pack = NULL;
  if (layout != NULL && (layout->robots != gradient->robots || layout->n != gradient->n ||
                         layout->springs != springs_of(gradient->robots, gradient->n)))
    abort();
  float *part = calloc(n_parameters, sizeof(*part));
  int status;
  if (gradient->n < 1 || gradient->n > MO_DEVICE_ROWS_MAX || (device->haste > 0 && layout == NULL))
    status = MO_ERR_INVALID;
  else if ((gradient->n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD > device->shards)
    status = MO_ERR_NO_MEMORY;
  else
    status = begin(device, gradient->robots, gradient->n, gradient->cancel);
  if (status == MO_OK && (part == NULL || mo_pack_create_for_gradients(
                                              gradient->controller, mo_isa_best(), &pack) != MO_OK))
    abort();
  for (uint32_t i = 0; i < gradient->n && status == MO_OK; i += MO_GRADIENT_ROBOTS) {
    float *sum = gradient->d_parameters + (size_t)(i / MO_DEVICE_SHARD) * n_parameters;
    const uint32_t left = gradient->n - i,
                   n = left < MO_GRADIENT_ROBOTS ? left : MO_GRADIENT_ROBOTS;
    status = mo_gradient_block(device->gradient, pack, gradient->robots + i, n, &gradient->physics,
                               &gradient->options, &pause, gradient->outcomes + i, part,
                               &gradient->counts);
    for (uint32_t k = 0; k < n_parameters; k++)
      sum[k] = i % MO_DEVICE_SHARD == 0 ? part[k] : sum[k] + part[k];
  }
  mo_pack_free(pack);
  free(part);
  return status;
}

static const char *fake_error(const struct mo_device *device)
{
  return device->is_lost ? "the fake device has fallen off its bus" : "no error";
}

const struct mo_device_module *mo_device_module(void)
{
  static struct mo_device_module module = {.abi = MO_DEVICE_ABI,
                                           .name = "fake",
                                           .score_code = "score-1",
                                           .gradient_code = "gradient-1",
                                           .count = fake_count,
                                           .open = fake_open,
                                           .close = fake_close,
                                           .info = fake_info,
                                           .controller_create = fake_controller_create,
                                           .controller_free = fake_controller_free,
                                           .score = fake_score,
                                           .gradient = fake_gradient,
                                           .lay_out = fake_lay_out,
                                           .layout_free = fake_layout_free,
                                           .allocate = fake_allocate,
                                           .release = fake_release,
                                           .error = fake_error};
  module.abi = number("MORPHO_FAKE_ABI", MO_DEVICE_ABI);
  if (getenv("MORPHO_FAKE_CODE") != NULL)
    module.score_code = module.gradient_code = getenv("MORPHO_FAKE_CODE");
  return &module;
}
