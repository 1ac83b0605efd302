/* fake_compute.c: see fake_compute.h. */
#pragma GCC diagnostic ignored "-Wunused-parameter" /* of functions that do nothing here */

#include "fake_compute.h"

#include "base/thread.h"
#include "learning/internal.h"

#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define HISTORY_MAX 100000
#define WEIGHTS     1024

struct fake_plan fake_plan;
struct fake_count *fake_count;

static pthread_mutex_t history_mutex = PTHREAD_MUTEX_INITIALIZER;
static int64_t history[HISTORY_MAX];
static size_t n_history;
static double weights[WEIGHTS]; /* by tag, modulo the size */

struct mo_compute_controller {
  const struct mo_controller *controller;
};

struct mo_compute {
  uint32_t n_workers;
  pthread_t threads[64];
  pthread_mutex_t mutex;
  pthread_cond_t wake;
  struct mo_block *first[3], *last[3];
  bool ending;
  atomic_uint_fast64_t blocks, rollouts;
  atomic_uint busy;
};

struct mo_compute_share {
  _Atomic double weight;
  atomic_uint_fast64_t blocks, busy_us;
};

static atomic_int n_shares;

int mo_compute_share_create(struct mo_compute *compute, double weight,
                            struct mo_compute_share **ret)
{
  *ret = calloc(1, sizeof(**ret));
  if (*ret == NULL)
    return MO_ERR_NO_MEMORY;
  atomic_store(&(*ret)->weight, weight);
  atomic_fetch_add(&n_shares, 1);
  return MO_OK;
}

void mo_compute_share_free(struct mo_compute_share *share)
{
  if (share != NULL)
    atomic_fetch_sub(&n_shares, 1);
  free(share);
}

void mo_compute_share_set_weight(struct mo_compute_share *share, double weight)
{
  atomic_store(&share->weight, weight);
}

void mo_compute_share_get_stats(const struct mo_compute_share *share,
                                struct mo_compute_share_stats *stats)
{
  *stats = (struct mo_compute_share_stats){.busy_s = 1e-6 * (double)atomic_load(&share->busy_us),
                                           .blocks_done = atomic_load(&share->blocks)};
}

int fake_shares(void)
{
  return atomic_load(&n_shares);
}

static uint64_t mix(uint64_t h, const void *data, size_t size)
{
  const uint8_t *bytes = data;
  for (size_t i = 0; i < size; i++)
    h = (h ^ bytes[i]) * UINT64_C(0x100000001B3);
  return h ^ (h >> 29);
}

struct mo_outcome fake_outcome(const uint64_t *genotype, const struct mo_controller *controller,
                               const struct mo_environment *environment,
                               const struct mo_physics *physics, enum mo_precision precision)
{
  struct mo_outcome outcome = {.loss = 0};
  uint64_t h = UINT64_C(0xCBF29CE484222325);
  int kind = precision;
  h = mix(h, genotype, MO_DEFAULT_WORDS * sizeof(*genotype));
  const int talent = (int)(h >> 20 & 7);
  h = mix(h, environment, offsetof(struct mo_environment, task.n_terms));
  h = mix(h, environment->task.terms, environment->task.n_terms * sizeof(*environment->task.terms));
  h = mix(h, environment->task.weights,
          environment->task.n_terms * sizeof(*environment->task.weights));
  if (environment->n_profile != 0)
    h = mix(h, &environment->profile_spacing_m, sizeof(environment->profile_spacing_m));
  if (environment->grid != NULL)
    h = mix(h, environment->grid->heights_m,
            (size_t)environment->grid->columns * environment->grid->rows * sizeof(double));
  if (environment->damage.cut != 0)
    h = mix(h, &environment->damage.time_s, sizeof(environment->damage.time_s));
  h = mix(h, &physics->scheme.dt_s, sizeof(physics->scheme.dt_s));
  h = mix(h, &physics->scheme.n_steps, sizeof(physics->scheme.n_steps));
  h = mix(h, &kind, sizeof(kind));
  const bool diverges = h % 31 == 0;
  if (controller != NULL)
    h = mix(h, controller->parameters, 64 * sizeof(float));
  if (atomic_load(&fake_plan.poison)) {
    outcome.loss = NAN;
  } else if (diverges) {
    outcome.loss = INFINITY;
    outcome.diverged_step = (int32_t)(1 + (h >> 20) % physics->scheme.n_steps);
  } else {
    outcome.loss = ldexp((double)(h >> 11), -53 - talent) + atomic_load(&fake_plan.skew);
  }
  return outcome;
}

size_t fake_history(int64_t *tags, size_t room)
{
  pthread_mutex_lock(&history_mutex);
  size_t n = n_history < room ? n_history : room;
  memcpy(tags, history, n * sizeof(*tags));
  pthread_mutex_unlock(&history_mutex);
  return n;
}

void fake_reset(void)
{
  memset(&fake_plan, 0, sizeof(fake_plan));
  pthread_mutex_lock(&history_mutex);
  n_history = 0;
  pthread_mutex_unlock(&history_mutex);
}

static void begin(int64_t tag)
{
  pthread_mutex_lock(&history_mutex);
  if (n_history < HISTORY_MAX)
    history[n_history++] = tag;
  pthread_mutex_unlock(&history_mutex);
}

static bool is_cancelled(const volatile int *cancel)
{
  return cancel != NULL && __atomic_load_n(cancel, __ATOMIC_RELAXED) != 0;
}

/* Sleeps. Returns false if the block was cancelled in the meantime. */
static bool pass(int delay_us, const volatile int *cancel)
{
  for (int waited = 0; waited < delay_us && !is_cancelled(cancel); waited += 200)
    usleep(200);
  return !is_cancelled(cancel);
}

static int run_block(struct mo_block *block)
{
  if (!pass(atomic_load(&fake_plan.delay_us), block->cancel))
    return MO_ERR_CANCELLED;
  if (atomic_load(&fake_plan.fail_status) != 0 &&
      (atomic_load(&fake_plan.fail_word) == 0 ||
       block->genotype[0] == atomic_load(&fake_plan.fail_word)) &&
      atomic_fetch_sub(&fake_plan.fail_times, 1) > 0)
    return atomic_load(&fake_plan.fail_status);
  for (uint32_t i = 0; i < block->n_environments; i++) {
    block->outcomes[i] = fake_outcome(block->genotype, block->controller->controller,
                                      block->environments[i], &block->physics, block->precision);
    if (block->recordings != NULL) {
      uint32_t frames = mo_recording_frames(&block->physics, block->recordings[i].stride);
      if (block->recordings[i].com_m != NULL)
        for (uint32_t f = 0; f < frames * 3; f++)
          block->recordings[i].com_m[f] = block->outcomes[i].loss + f;
      if (block->recordings[i].mass_m != NULL)
        for (uint32_t f = 0; f < frames * block->body->n_masses * 3; f++)
          block->recordings[i].mass_m[f] = (float)f;
    }
  }
  if (fake_count != NULL)
    atomic_fetch_add(&fake_count->rollouts, block->n_environments);
  return MO_OK;
}

/* Every block takes a worker one millisecond. */
static void charge(struct mo_compute_share *share, int64_t tag)
{
  double weight = 0;
  if (share != NULL) {
    atomic_fetch_add(&share->blocks, 1);
    atomic_fetch_add(&share->busy_us, 1000);
    weight = atomic_load(&share->weight);
  }
  pthread_mutex_lock(&history_mutex);
  weights[(uint64_t)tag % WEIGHTS] = weight;
  pthread_mutex_unlock(&history_mutex);
}

double fake_weight(int64_t tag)
{
  pthread_mutex_lock(&history_mutex);
  double weight = weights[(uint64_t)tag % WEIGHTS];
  pthread_mutex_unlock(&history_mutex);
  return weight;
}

static struct mo_block *take(struct mo_compute *compute)
{
  struct mo_block *block = NULL;
  pthread_mutex_lock(&compute->mutex);
  while (block == NULL) {
    for (int u = MO_IMMEDIATE; u >= MO_BATCH && block == NULL; u--)
      if (compute->first[u] != NULL) {
        block = compute->first[u];
        compute->first[u] = block->next;
      }
    if (block == NULL && compute->ending)
      break;
    if (block == NULL)
      pthread_cond_wait(&compute->wake, &compute->mutex);
  }
  pthread_mutex_unlock(&compute->mutex);
  return block;
}

static void *work(void *context)
{
  struct mo_compute *compute = context;
  struct mo_block *block;
  while ((block = take(compute)) != NULL) {
    begin(block->tag);
    mo_thread_tag = block->tag;
    atomic_fetch_add(&compute->busy, 1);
    block->status = run_block(block);
    atomic_fetch_sub(&compute->busy, 1);
    charge(block->share, block->tag);
    mo_thread_tag = -1;
    atomic_fetch_add(&compute->blocks, 1);
    if (block->status == MO_OK)
      atomic_fetch_add(&compute->rollouts, block->n_environments);
    block->done(block, block->context);
  }
  return NULL;
}

int mo_compute_create_cpu(const struct mo_compute_config *config, struct mo_compute **ret)
{
  struct mo_compute *compute = calloc(1, sizeof(*compute));
  if (compute == NULL)
    return MO_ERR_NO_MEMORY;
  compute->n_workers = config->n_workers > 0 ? config->n_workers : 2;
  pthread_mutex_init(&compute->mutex, NULL);
  pthread_cond_init(&compute->wake, NULL);
  for (uint32_t i = 0; i < compute->n_workers; i++)
    pthread_create(&compute->threads[i], NULL, work, compute);
  *ret = compute;
  return MO_OK;
}

void mo_compute_free(struct mo_compute *compute)
{
  if (compute == NULL)
    return;
  pthread_mutex_lock(&compute->mutex);
  compute->ending = true;
  pthread_cond_broadcast(&compute->wake);
  pthread_mutex_unlock(&compute->mutex);
  for (uint32_t i = 0; i < compute->n_workers; i++)
    pthread_join(compute->threads[i], NULL);
  pthread_mutex_destroy(&compute->mutex);
  pthread_cond_destroy(&compute->wake);
  free(compute);
}

int mo_compute_controller_create(struct mo_compute *compute, const struct mo_controller *controller,
                                 struct mo_compute_controller **ret)
{
  struct mo_compute_controller *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->controller = controller;
  *ret = made;
  return MO_OK;
}

void mo_compute_controller_free(struct mo_compute_controller *controller)
{
  free(controller);
}

int mo_compute_submit(struct mo_compute *compute, struct mo_block *block)
{
  pthread_mutex_lock(&compute->mutex);
  block->next = NULL;
  if (compute->first[block->urgency] != NULL)
    compute->last[block->urgency]->next = block;
  else
    compute->first[block->urgency] = block;
  compute->last[block->urgency] = block;
  pthread_cond_signal(&compute->wake);
  pthread_mutex_unlock(&compute->mutex);
  return MO_OK;
}

/* ---- gradients ---- */

struct mo_gradient_state {
  struct mo_compute *compute;
};

/* Rollouts that are not stored anywhere are tested with the real back end. */
int mo_compute_run(struct mo_compute *compute, struct mo_block *blocks, size_t n)
{
  (void)compute;
  (void)blocks;
  (void)n;
  return MO_ERR_CANCELLED;
}

int mo_gradient_state_create(struct mo_compute *compute, struct mo_gradient_state **ret)
{
  *ret = calloc(1, sizeof(**ret));
  if (*ret == NULL)
    return MO_ERR_NO_MEMORY;
  (*ret)->compute = compute;
  return MO_OK;
}

void mo_gradient_state_free(struct mo_gradient_state *state)
{
  free(state);
}

/* Not sanitized, which would take longer than all else that it does. */
__attribute__((no_sanitize("address", "thread", "undefined"))) static void
spread(uint64_t all, const struct mo_controller *controller, double *d_parameters)
{
  for (size_t i = 0; i < controller->n_parameters; i++)
    d_parameters[i] =
        1e-3 * ((double)((all + i * UINT64_C(0x9E3779B97F4A7C15)) >> 11) * 0x1p-53 - 0.5) +
        1e-3 * (double)controller->parameters[i];
}

void fake_gradient(const struct mo_controller *controller, const struct mo_robot *robots,
                   uint32_t n, double *d_parameters, struct mo_outcome *outcomes,
                   struct mo_gradient_counts *counts)
{
  uint64_t all = UINT64_C(0xCBF29CE484222325);
  *counts =
      (struct mo_gradient_counts){.robots = n, .steps = 100 * (uint64_t)n, .clipped_steps = n};
  for (uint32_t i = 0; i < n; i++) {
    uint64_t h =
        mix(UINT64_C(0xCBF29CE484222325), robots[i].environment, sizeof(*robots[i].environment));
    h = mix(h, robots[i].body->mass_lattice,
            robots[i].body->n_masses * sizeof(*robots[i].body->mass_lattice));
    h = mix(h, controller->parameters, 64 * sizeof(float));
    outcomes[i] = (struct mo_outcome){.loss = (double)(h >> 11) * 0x1p-53};
    all = mix(all, &h, sizeof(h));
  }
  spread(all, controller, d_parameters);
}

int mo_compute_gradient(struct mo_gradient_state *state, struct mo_gradient_batch *batch)
{
  begin(batch->tag);
  if (!pass(atomic_load(&fake_plan.gradient_delay_us), batch->cancel))
    return MO_ERR_CANCELLED;
  charge(batch->share, batch->tag);
  if (atomic_load(&fake_plan.gradient_crash))
    raise(SIGSEGV);
  if (atomic_load(&fake_plan.gradient_status) != 0 &&
      atomic_fetch_sub(&fake_plan.gradient_fails, 1) > 0)
    return atomic_load(&fake_plan.gradient_status);
  if (fake_count != NULL)
    atomic_fetch_add(&fake_count->robots, batch->n);
  fake_gradient(batch->controller, batch->robots, batch->n, batch->d_parameters, batch->outcomes,
                &batch->counts);
  return MO_OK;
}

const char *mo_compute_gradient_fingerprint(const struct mo_compute *compute)
{
  const char *fingerprint = atomic_load(&fake_plan.gradient_fingerprint);
  return fingerprint != NULL ? fingerprint : "fake gradient";
}

typeof(mo_adam_update) __real_mo_adam_update, __wrap_mo_adam_update;

/* The thread sanitizer does not look into the update (src/learning/meson.build): here it sees some
 * of what the update reads and writes. */
bool __wrap_mo_adam_update(struct mo_adam *adam, const struct mo_training_settings *settings,
                           double rate, double scale, const double *gradient, float *parameters,
                           size_t n, uint32_t n_threads, uint32_t *bounded)
{
  for (size_t i = 0; i < n; i += i + 64 < n ? 64 : 1) {
    volatile double *const moments[] = {&adam->first[i], &adam->second[i]};
    volatile float *const parameter = &parameters[i];
    (void)*(const volatile double *)&gradient[i];
    for (int k = 0; k < 2; k++)
      *moments[k] = *moments[k];
    *parameter = *parameter;
  }
  return __real_mo_adam_update(adam, settings, rate, scale, gradient, parameters, n, n_threads,
                               bounded);
}

void mo_compute_get_stats(const struct mo_compute *compute, struct mo_compute_stats *stats)
{
  *stats = (struct mo_compute_stats){.n_workers = compute->n_workers,
                                     .n_busy = atomic_load(&compute->busy),
                                     .blocks_done = atomic_load(&compute->blocks),
                                     .rollouts_done = atomic_load(&compute->rollouts)};
}

const char *mo_compute_fingerprint(const struct mo_compute *compute, enum mo_precision precision)
{
  return precision == MO_FLOAT64 ? "fake float64" : "fake float32";
}

/* ---- functions without effect here; there are no devices ---- */

#define ONLY(type, value, name, ...)                                                               \
  type name(__VA_ARGS__)                                                                           \
  {                                                                                                \
    return value;                                                                                  \
  }
#define NOTHING(name, ...) ONLY(void, , name, __VA_ARGS__)

NOTHING(mo_compute_set_gradient_bytes, struct mo_compute *compute, size_t bytes)
NOTHING(mo_compute_trim, struct mo_compute *compute)
NOTHING(mo_compute_begin_blocks, struct mo_compute *compute)
NOTHING(mo_compute_end_blocks, struct mo_compute *compute)
ONLY(int, MO_OK, mo_compute_gradient_lay_out, struct mo_gradient_state *state,
     const struct mo_robot *robots, uint32_t n, const struct mo_physics *physics)
NOTHING(mo_compute_gradient_forget, struct mo_gradient_state *state)
NOTHING(mo_compute_lower_priority, const struct mo_compute *compute)
ONLY(uint32_t, 0, mo_compute_devices, const struct mo_compute *compute)
ONLY(uint32_t, 0, mo_compute_devices_working, const struct mo_compute *compute)
ONLY(uint32_t, 0, mo_compute_remote_wanted, const struct mo_compute *compute,
     enum mo_back_end back_end)
ONLY(int, MO_ERR_RANGE, mo_compute_device, struct mo_compute *compute, uint32_t position,
     struct mo_device_status *status)
ONLY(const char *, NULL, mo_compute_device_fingerprint, const struct mo_compute *compute)
ONLY(const char *, NULL, mo_compute_device_gradient_fingerprint, const struct mo_compute *compute)
ONLY(bool, false, mo_compute_expects_devices, const struct mo_compute *compute)
ONLY(bool, false, mo_compute_serves_devices, const struct mo_compute *compute)
ONLY(int, MO_ERR_CONFLICT, mo_compute_name_devices, struct mo_compute *compute, const char *scores,
     const char *gradients)
ONLY(bool, false, mo_compute_lacks_takers, const struct mo_compute *compute,
     enum mo_back_end back_end)
