/* cpu.c: the CPU back end: worker threads, queues, and urgent blocks that run inside others.
 *
 * Workers take blocks from the queues under one mutex, the most urgent first. Batch blocks wait in
 * shares, and fair.h decides which share is next. A share is charged for a block before the block's
 * `done` is called, so that the share may be freed afterward.
 *
 * A worker inside a block reads atomic counts every few steps. If a more urgent scoring block
 * waits, the worker runs it at once, on its own stack and with separate scratch memory, and then
 * resumes its block; the bits of that block do not change. Interactive blocks interrupt batch and
 * gradient blocks; immediate blocks also interrupt interactive ones, so that a client with one
 * rollout does not wait for a client with many. A more urgent block therefore waits for a few steps
 * of a rollout, never for an entire block, and one thread per worker is enough. Gradient blocks
 * never run inside another block, because a worker has only one gradient scratch, of hundreds of
 * megabytes, which is created at first use.
 *
 * Shutdown: `stopping` makes running blocks return at their next pause point; the workers then
 * return the queued blocks as cancelled, and exit. Every block's `done` is called exactly once.
 * Counters are atomics: reading them takes no lock. */
#include "compute/devices.h"
#include "compute/rates.h"

#include "base/clock.h"
#include "base/processors.h"

#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <unistd.h>

enum {
  PAUSE_STEPS =
      20, /* steps between checks of the queue, for bodies of the default workspace: about 1 ms */
  PAUSE_SPRINGS = 2000, /* bodies with more springs check after every step */
  PAUSE_GRADIENT_STEPS = 4,
  PAUSE_GRADIENT_SPRINGS = MO_GRADIENT_ROBOTS * PAUSE_SPRINGS,
  LOOK_AGAIN_US = 50000,
  DEPTHS = 3 /* a batch or gradient block, an interactive one inside it, an immediate one in both */
};

/* In ascending order of urgency; all come before batch blocks. */
enum { URGENT_GRADIENTS, INTERACTIVE, IMMEDIATE, QUEUES };

struct worker {
  struct mo_compute *compute;
  struct mo_workspace_memory *memory[DEPTHS];
  struct mo_gradient_memory *gradient; /* NULL before the first gradient block */
  uint64_t overtaken_ns;
  uint_fast32_t trimmed; /* number of the last trim that the worker performed */
  bool is_running;
  pthread_t thread;
};

struct mo_compute {
  struct mo_compute_core core;
  int nice;
  atomic_size_t gradient_bytes;
  atomic_uint_fast32_t trims; /* number of trims requested */
  struct worker *workers;     /* (core.n_workers) */
  struct mo_fair fair;        /* its mutex guards all queues */
  pthread_cond_t wake;
  struct mo_block_queue queues[QUEUES];
  struct mo_compute_share own; /* for blocks without a share */
  atomic_bool stopping;        /* written under the mutex */
  atomic_uint_fast32_t n_busy;
  atomic_uint_fast64_t blocks_done, rollouts_done, rollout_steps, rollouts_diverged,
      blocks_preempted, busy_ns;
  atomic_uint_fast64_t gradient_robots_done, gradient_robots_diverged, gradient_robots_zeroed;
  atomic_size_t worker_bytes_max;
  struct mo_rates rates;
  char fingerprint[2][64], gradient_fingerprint[64];
};

/* ---- one block ---- */

/* Frees the worker's gradient scratch if a trim was requested. */
static void follow_trims(struct worker *worker)
{
  const uint_fast32_t trims = atomic_load_explicit(&worker->compute->trims, memory_order_relaxed);
  if (worker->trimmed == trims)
    return;
  worker->trimmed = trims;
  mo_gradient_memory_free(worker->gradient);
  worker->gradient = NULL;
}

/* A block that runs on a worker. It is charged for CPU time, so that other threads on the same
 * cores do not count, minus the time of urgent blocks inside it. The counters of the share are
 * updated at every pause point, so that a long block counts before it ends. */
struct run {
  struct worker *worker;
  struct mo_block *block;
  int depth;
  struct mo_compute_share *share;
  bool urgent;
  uint64_t read_ns, overtaken_ns; /* at the last reading */
  uint64_t total_ns;
  uint64_t springs; /* summed over the robots of a gradient */
};

static void run_block(struct worker *worker, struct mo_block *block, int depth,
                      const struct mo_fair_charge *charge);

static bool is_cancelled(const struct mo_compute *compute, const struct mo_block *block)
{
  return atomic_load_explicit(&compute->stopping, memory_order_relaxed) ||
         mo_block_is_cancelled(block);
}

static void read_meter(struct run *run)
{
  const uint64_t now_ns = mo_clock_thread_ns();
  const uint64_t inside_ns = run->worker->overtaken_ns - run->overtaken_ns;
  const uint64_t own_ns = now_ns - run->read_ns - inside_ns;
  run->read_ns = now_ns;
  run->overtaken_ns = run->worker->overtaken_ns;
  run->total_ns += own_ns;
  atomic_fetch_add_explicit(&run->share->busy_ns, own_ns, memory_order_relaxed);
  if (run->urgent)
    atomic_fetch_add_explicit(&run->share->urgent_ns, own_ns, memory_order_relaxed);
}

/* Returns the least urgent queue, other than gradients, that may interrupt a running block. */
static int first_queue_over(const struct mo_block *block)
{
  return block->gradient != NULL || block->urgency == MO_BATCH ? INTERACTIVE
         : block->urgency == MO_INTERACTIVE                    ? IMMEDIATE
                                                               : QUEUES;
}

static bool has_more_urgent(const struct mo_compute *compute, const struct mo_block *block)
{
  bool has = false;
  for (int q = first_queue_over(block); q < QUEUES; q++)
    has = has || atomic_load_explicit(&compute->queues[q].n, memory_order_relaxed) > 0;
  return has;
}

static struct mo_block *pop_more_urgent(struct mo_compute *compute, const struct mo_block *running)
{
  struct mo_block *block = NULL;
  for (int q = QUEUES; q-- > first_queue_over(running) && block == NULL;)
    block = mo_queue_pop(&compute->queues[q]);
  return block;
}

/* Runs at the pause point of a block. */
static int at_pause_point(void *context)
{
  struct run *run = context;
  struct worker *worker = run->worker;
  struct mo_compute *compute = worker->compute;
  if (run->block->gradient == NULL && run->depth == 0)
    follow_trims(worker);
  while (has_more_urgent(compute, run->block) && !is_cancelled(compute, run->block)) {
    pthread_mutex_lock(&compute->fair.mutex);
    struct mo_block *block = pop_more_urgent(compute, run->block);
    pthread_mutex_unlock(&compute->fair.mutex);
    if (block == NULL)
      break;
    atomic_fetch_add(&compute->blocks_preempted, 1);
    /* The time of a block counts once, at any depth. */
    const uint64_t start_ns = mo_clock_thread_ns(), overtaken_ns = worker->overtaken_ns;
    run_block(worker, block, run->depth + 1, NULL);
    worker->overtaken_ns = overtaken_ns + mo_clock_thread_ns() - start_ns;
  }
  read_meter(run);
  return is_cancelled(compute, run->block);
}

static int simulate(struct run *run)
{
  struct mo_block *block = run->block;
  const struct mo_pack *pack = NULL;
  int status = mo_compute_controller_pack(block->controller, block->precision, &pack);
  struct mo_body *built = NULL;
  const struct mo_body *body = block->body;
  if (status == MO_OK && body == NULL) {
    status = mo_body_create(block->lattice, block->genotype, &built);
    body = built;
  }
  if (status != MO_OK || body == NULL)
    return status;
  run->springs = body->n_springs;
  const struct mo_pause_point pause = {body->n_springs > PAUSE_SPRINGS ? 1 : PAUSE_STEPS,
                                       at_pause_point, run};
  status = mo_rollout_block_window(run->worker->memory[run->depth], pack, body, block->environments,
                                   block->n_environments, &block->physics, &block->states,
                                   block->recordings, block->measuring, &pause, block->outcomes);
  mo_body_free(built);
  return status;
}

static int differentiate(struct run *run)
{
  struct worker *worker = run->worker;
  struct mo_gradient_task *task = run->block->gradient;
  if (worker->gradient == NULL) {
    const int status =
        mo_gradient_memory_create(atomic_load(&worker->compute->gradient_bytes), &worker->gradient);
    if (status != MO_OK)
      return status;
  }
  for (uint32_t i = 0; i < task->n; i++)
    run->springs += task->robots[i].body->n_springs;
  const struct mo_pause_point pause = {
      run->springs > PAUSE_GRADIENT_SPRINGS ? 1 : PAUSE_GRADIENT_STEPS, at_pause_point, run};
  return mo_gradient_block(worker->gradient, task->pack, task->robots, task->n,
                           &task->block.physics, &task->options, &pause, task->outcomes,
                           task->d_parameters, &task->counts);
}

static void count(struct worker *worker, const struct mo_block *block)
{
  struct mo_compute *compute = worker->compute;
  atomic_fetch_add(&compute->blocks_done, 1);
  size_t bytes = worker->gradient != NULL ? mo_gradient_memory_bytes(worker->gradient) : 0;
  for (int depth = 0; depth < DEPTHS; depth++)
    bytes += mo_workspace_memory_bytes(worker->memory[depth]);
  size_t most = atomic_load(&compute->worker_bytes_max);
  while (most < bytes && !atomic_compare_exchange_weak(&compute->worker_bytes_max, &most, bytes))
    ;
  if (block->status != MO_OK)
    return;
  if (block->gradient != NULL) {
    atomic_fetch_add(&compute->gradient_robots_done, block->gradient->n);
    atomic_fetch_add(&compute->gradient_robots_diverged, block->gradient->counts.diverged_robots);
    atomic_fetch_add(&compute->gradient_robots_zeroed, block->gradient->counts.zeroed_robots);
    return;
  }
  uint32_t diverged = 0;
  for (uint32_t i = 0; i < block->n_environments; i++)
    diverged += block->outcomes[i].diverged_step > 0;
  atomic_fetch_add(&compute->rollouts_done, block->n_environments);
  atomic_fetch_add(&compute->rollout_steps,
                   (uint64_t)block->n_environments * block->physics.scheme.n_steps);
  atomic_fetch_add(&compute->rollouts_diverged, diverged);
}

/* Returns whether a block's time is typical of scoring blocks: passive bodies take less time, and
 * recordings, measures and states take more. */
static bool is_plain(const struct mo_block *block)
{
  return mo_compute_controller_weights(block->controller) != NULL && block->recordings == NULL &&
         block->measuring == NULL && block->states.from == NULL && block->states.to == NULL;
}

/* Adds a block to the rates. */
static void rate(const struct run *run)
{
  const struct mo_block *block = run->block;
  const struct mo_gradient_task *task = block->gradient;
  const struct mo_scheme *scheme = &block->physics.scheme;
  if (block->status != MO_OK || (task == NULL && !is_plain(block)))
    return;
  struct mo_rate work =
      mo_rate_of(task != NULL, MO_ON_CPU, task != NULL ? MO_FLOAT32 : block->precision, scheme);
  work.blocks = 1;
  work.rollouts = task != NULL ? task->n : block->n_environments;
  work.steps = work.rollouts * scheme->n_steps;
  work.spring_steps = run->springs * scheme->n_steps * (task != NULL ? 1 : block->n_environments);
  work.busy_s = 1e-9 * (double)run->total_ns;
  mo_rates_add(run->worker->compute->core.rates, &work);
}

/* Runs a block and charges its share. charge: for a batch block, else NULL; only a batch block's
 * time affects when its share is next. */
static void run_block(struct worker *worker, struct mo_block *block, int depth,
                      const struct mo_fair_charge *charge)
{
  struct mo_compute *compute = worker->compute;
  const int64_t outer_tag = mo_thread_tag;
  struct run run = {.worker = worker,
                    .block = block,
                    .depth = depth,
                    .share = block->share != NULL ? block->share : &compute->own,
                    .urgent = charge == NULL,
                    .read_ns = mo_clock_thread_ns(),
                    .overtaken_ns = worker->overtaken_ns};
  mo_thread_tag = block->tag;
  block->status = is_cancelled(compute, block) ? MO_ERR_CANCELLED
                  : block->gradient != NULL    ? differentiate(&run)
                                               : simulate(&run);
  block->computed_on = MO_ON_CPU;
  count(worker, block);
  read_meter(&run);
  rate(&run);
  if (charge != NULL) {
    MO_GUARD(&compute->fair.mutex);
    mo_fair_correct(&compute->fair, charge, 1e-9 * (double)run.total_ns, block->status == MO_OK);
  } else {
    atomic_fetch_add(&run.share->blocks_done, 1);
  }
  block->done(block, block->context); /* the block and its share may have been freed by now */
  mo_thread_tag = outer_tag;
}

/* ---- workers ---- */

/* Batch scheduling and a higher niceness keep the service's threads responsive on the same cores.
 * Results do not depend on either, so if the kernel refuses, that is not an error. */
void mo_compute_lower_priority(const struct mo_compute *compute)
{
  const struct sched_param none = {0};
  (void)pthread_setschedparam(pthread_self(), SCHED_BATCH, &none);
  if (compute->nice > 0) {
    const id_t thread = (id_t)gettid();
    (void)setpriority(PRIO_PROCESS, thread, getpriority(PRIO_PROCESS, thread) + compute->nice);
  }
}

static bool is_for_workers(const struct mo_block *block, void *context)
{
  const struct mo_compute *compute = context;
  return !atomic_load_explicit(&compute->core.remote.leave, memory_order_relaxed) ||
         atomic_load(&compute->stopping) || !mo_block_suits_remote(block) ||
         mo_block_is_cancelled(block);
}

static void *work(void *argument)
{
  struct worker *worker = argument;
  struct mo_compute *compute = worker->compute;
  mo_compute_lower_priority(compute);
  pthread_mutex_lock(&compute->fair.mutex);
  for (;;) {
    struct mo_block *block = NULL;
    struct mo_fair_charge charge;
    for (int q = QUEUES; q-- > 0 && block == NULL;)
      block = mo_queue_pop(&compute->queues[q]);
    const bool urgent = block != NULL;
    if (!urgent)
      block = mo_fair_take(&compute->fair, &charge, is_for_workers, compute);
    if (block == NULL) {
      if (atomic_load(&compute->stopping))
        break;
      follow_trims(worker);
      /* Blocks that are left to remote takers may be cancelled, which does not wake workers. */
      if (atomic_load(&compute->core.remote.leave) && atomic_load(&compute->fair.waiting) > 0)
        (void)mo_wait_until(&compute->wake, &compute->fair.mutex, mo_clock_us() + LOOK_AGAIN_US);
      else
        pthread_cond_wait(&compute->wake, &compute->fair.mutex);
      continue;
    }
    atomic_fetch_add(&compute->n_busy, 1);
    pthread_mutex_unlock(&compute->fair.mutex);
    const uint64_t start_ns = mo_clock_ns();
    run_block(worker, block, 0, urgent ? NULL : &charge);
    atomic_fetch_add(&compute->busy_ns, mo_clock_ns() - start_ns);
    pthread_mutex_lock(&compute->fair.mutex);
    atomic_fetch_sub(&compute->n_busy, 1);
  }
  pthread_mutex_unlock(&compute->fair.mutex);
  return NULL;
}

static int start_worker(struct mo_compute *compute, struct worker *worker, uint32_t number)
{
  worker->compute = compute;
  for (int depth = 0; depth < DEPTHS; depth++)
    if (mo_workspace_memory_create(&worker->memory[depth]) != MO_OK)
      return MO_ERR_NO_MEMORY;
  char name[16];
  snprintf(name, sizeof(name), "mo-worker-%u", number % 10000);
  worker->is_running = mo_thread_create(&worker->thread, name, work, worker) == 0;
  return worker->is_running ? MO_OK : MO_ERR_NO_MEMORY;
}

void mo_compute_set_gradient_bytes(struct mo_compute *compute, size_t bytes)
{
  atomic_store(&compute->gradient_bytes, bytes);
}

void mo_compute_wake(struct mo_compute *compute)
{
  struct mo_devices *devices = compute->core.devices;
  pthread_mutex_lock(&compute->fair.mutex);
  pthread_cond_broadcast(&compute->wake);
  pthread_mutex_unlock(&compute->fair.mutex);
  if (devices == NULL)
    return;
  pthread_mutex_lock(&devices->fair.mutex);
  pthread_cond_broadcast(&devices->wake);
  pthread_mutex_unlock(&devices->fair.mutex);
}

void mo_compute_trim(struct mo_compute *compute)
{
  MO_GUARD(&compute->fair.mutex);
  atomic_fetch_add(&compute->trims, 1);
  pthread_cond_broadcast(&compute->wake);
}

static int submit_to_workers(struct mo_compute *compute, struct mo_block *block);

int mo_compute_create_cpu(const struct mo_compute_config *config, struct mo_compute **ret)
{
  if (config->isa > mo_isa_best())
    return MO_ERR_UNSUPPORTED;
  const uint32_t wanted = config->n_workers > 0 ? config->n_workers : mo_processors();
  struct mo_compute *compute = calloc(1, sizeof(*compute));
  if (compute == NULL)
    return MO_ERR_NO_MEMORY;
  compute->workers = calloc(wanted, sizeof(*compute->workers));
  if (compute->workers == NULL) {
    free(compute);
    return MO_ERR_NO_MEMORY;
  }
  compute->core.isa = config->isa;
  compute->core.n_workers = wanted;
  compute->core.submit_to_workers = submit_to_workers;
  compute->nice = config->nice;
  compute->gradient_bytes = MO_GRADIENT_DEFAULT_BYTES;
  for (int precision = 0; precision < 2; precision++)
    snprintf(compute->fingerprint[precision], sizeof(compute->fingerprint[precision]),
             "cpu %s %s kernel-%d", mo_isa_name(config->isa),
             precision == MO_FLOAT32 ? "float32" : "float64", MO_KERNEL_VERSION);
  snprintf(compute->gradient_fingerprint, sizeof(compute->gradient_fingerprint),
           "cpu %s float32 gradient-%d", mo_isa_name(config->isa), MO_GRADIENT_VERSION);
  pthread_mutex_init(&compute->rates.mutex, NULL);
  compute->core.rates = &compute->rates;
  pthread_cond_init(&compute->wake, NULL);
  mo_fair_init(&compute->fair, wanted);
  compute->core.fair = &compute->fair;
  compute->own.compute = compute;
  mo_fair_add(&compute->fair, &compute->own, 1);
  for (uint32_t i = 0; i < wanted; i++)
    if (start_worker(compute, compute->workers + i, i) != MO_OK) {
      mo_compute_free(compute);
      return MO_ERR_NO_MEMORY;
    }
  *ret = compute;
  return MO_OK;
}

void mo_compute_free(struct mo_compute *compute)
{
  if (compute == NULL)
    return;
  mo_devices_free(compute->core.devices);
  pthread_mutex_lock(&compute->fair.mutex);
  atomic_store(&compute->stopping, true);
  pthread_cond_broadcast(&compute->wake);
  pthread_mutex_unlock(&compute->fair.mutex);
  for (uint32_t i = 0; i < compute->core.n_workers; i++) {
    if (compute->workers[i].is_running)
      pthread_join(compute->workers[i].thread, NULL);
    for (int depth = 0; depth < DEPTHS; depth++)
      mo_workspace_memory_free(compute->workers[i].memory[depth]);
    mo_gradient_memory_free(compute->workers[i].gradient);
  }
  for (struct mo_compute_share *share = compute->fair.shares; share != NULL; share = share->next)
    share->compute = NULL; /* it may be freed later */
  pthread_cond_destroy(&compute->wake);
  pthread_mutex_destroy(&compute->fair.mutex);
  pthread_mutex_destroy(&compute->rates.mutex);
  free(compute->workers);
  free(compute);
}

/* ---- submitting ---- */

static int enqueue(struct mo_compute *compute, struct mo_block *block)
{
  MO_GUARD(&compute->fair.mutex);
  if (atomic_load(&compute->stopping))
    return MO_ERR_CANCELLED;
  if (block->urgency != MO_BATCH)
    mo_queue_push(&compute->queues[block->gradient != NULL          ? URGENT_GRADIENTS
                                   : block->urgency == MO_IMMEDIATE ? IMMEDIATE
                                                                    : INTERACTIVE],
                  block);
  else
    mo_fair_push(&compute->fair, block->share != NULL ? block->share : &compute->own, block);
  mo_remote_arrived(&compute->core, block);
  pthread_cond_signal(&compute->wake);
  return MO_OK;
}

static int submit_to_workers(struct mo_compute *compute, struct mo_block *block)
{
  return enqueue(compute, block);
}

int mo_compute_submit(struct mo_compute *compute, struct mo_block *block)
{
  block->gradient = NULL;
  block->shards = NULL;
  block->stays = false;
  block->origin = 0;
  if (block->back_end == MO_ON_DEVICE && block->precision == MO_FLOAT32 &&
      block->recordings == NULL && block->states.from == NULL && block->states.to == NULL)
    return compute->core.devices != NULL ? mo_devices_submit(compute->core.devices, block)
                                         : MO_ERR_DEVICE;
  return enqueue(compute, block);
}

int mo_compute_submit_gradient(struct mo_compute *compute, struct mo_gradient_task *task)
{
  task->block.gradient = task;
  return enqueue(compute, &task->block);
}

/* ---- shares ---- */

int mo_compute_share_create(struct mo_compute *compute, double weight,
                            struct mo_compute_share **ret)
{
  struct mo_devices *devices = compute->core.devices;
  struct mo_compute_share *share = calloc(devices != NULL ? 2 : 1, sizeof(*share));
  if (share == NULL)
    return MO_ERR_NO_MEMORY;
  share->compute = compute;
  mo_fair_add(&compute->fair, share, weight);
  if (devices != NULL) {
    share->on_devices = share + 1;
    mo_fair_add(&devices->fair, share->on_devices, weight);
  }
  *ret = share;
  return MO_OK;
}

void mo_compute_share_free(struct mo_compute_share *share)
{
  if (share == NULL)
    return;
  if (share->compute != NULL) {
    mo_fair_remove(&share->compute->fair, share);
    if (share->on_devices != NULL)
      mo_fair_remove(&share->compute->core.devices->fair, share->on_devices);
  }
  free(share);
}

void mo_compute_share_set_weight(struct mo_compute_share *share, double weight)
{
  mo_fair_set_weight(&share->compute->fair, share, weight);
  if (share->on_devices != NULL)
    mo_fair_set_weight(&share->compute->core.devices->fair, share->on_devices, weight);
}

void mo_compute_share_get_stats(const struct mo_compute_share *share,
                                struct mo_compute_share_stats *stats)
{
  *stats = (struct mo_compute_share_stats){
      .busy_s = 1e-9 * (double)atomic_load(&share->busy_ns),
      .urgent_s = 1e-9 * (double)atomic_load(&share->urgent_ns),
      .waiting = atomic_load(&share->queue.n),
      .blocks_done = atomic_load(&share->blocks_done),
  };
  const struct mo_compute_share *on_devices = share->on_devices;
  if (on_devices == NULL)
    return;
  stats->device_s = 1e-9 * (double)atomic_load(&on_devices->busy_ns);
  stats->waiting += atomic_load(&on_devices->queue.n);
  stats->blocks_done += atomic_load(&on_devices->blocks_done);
}

/* ---- facts ---- */

void mo_compute_get_stats(const struct mo_compute *compute, struct mo_compute_stats *stats)
{
  *stats = (struct mo_compute_stats){
      .n_workers = compute->core.n_workers,
      .n_busy = (uint32_t)atomic_load(&compute->n_busy),
      .blocks_done = atomic_load(&compute->blocks_done),
      .rollouts_done = atomic_load(&compute->rollouts_done),
      .rollout_steps = atomic_load(&compute->rollout_steps),
      .rollouts_diverged = atomic_load(&compute->rollouts_diverged),
      .blocks_preempted = atomic_load(&compute->blocks_preempted),
      .gradient_robots_done = atomic_load(&compute->gradient_robots_done),
      .gradient_robots_diverged = atomic_load(&compute->gradient_robots_diverged),
      .gradient_robots_zeroed = atomic_load(&compute->gradient_robots_zeroed),
      .queued_batch = atomic_load(&compute->fair.waiting),
      .queued_interactive = atomic_load(&compute->queues[IMMEDIATE].n) +
                            atomic_load(&compute->queues[INTERACTIVE].n) +
                            atomic_load(&compute->queues[URGENT_GRADIENTS].n),
      .busy_s = 1e-9 * (double)atomic_load(&compute->busy_ns),
      .worker_bytes_max = atomic_load(&compute->worker_bytes_max),
  };
}

const char *mo_compute_fingerprint(const struct mo_compute *compute, enum mo_precision precision)
{
  return compute->fingerprint[precision == MO_FLOAT64];
}

const char *mo_compute_gradient_fingerprint(const struct mo_compute *compute)
{
  return compute->gradient_fingerprint;
}
