/* gradient-compare.c: see gradient-compare.h. */
#include "gradient-compare.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { THREADS_MAX = 64 };

const char *const gradient_tensor_names[MO_CONTROLLER_TENSORS] = {
    "net.0.weight", "net.0.bias",   "net.1.weight", "net.1.bias",   "net.3.weight",
    "net.3.bias",   "net.4.weight", "net.4.bias",   "net.6.weight", "net.6.bias",
    "net.7.weight", "net.7.bias",   "net.9.weight", "net.9.bias"};

static double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

#define MOVED_M 1e-7

/* The share of thread t: robots t, t + threads, …, each alone, by the reference and by the fast
 * path. */
struct share {
  const struct mo_controller *controller;
  const struct mo_robot *robots;
  uint32_t first, n, stride;
  const struct mo_physics *physics;
  struct mo_gradient_options options;
  const struct mo_pack *pack;
  bool moved;
  struct mo_outcome *outcomes;           /* (n) of the reference */
  double *difference, *moved_difference; /* (n) 1 − cosine of the robot's gradients */
  double *sum, *moved_sum;               /* (n_parameters) of this thread's robots */
  double *one, *other;                   /* (n_parameters) */
  float *fast;                           /* (n_parameters) */
  struct mo_gradient_memory *memory;
  struct mo_gradient_counts counts;
  pthread_t thread;
  int status;
};

static struct gradient_likeness compare(const double *a, const double *b, size_t n)
{
  double ab = 0, aa = 0, bb = 0;
  for (size_t i = 0; i < n; i++) {
    ab += a[i] * b[i];
    aa += a[i] * a[i];
    bb += b[i] * b[i];
  }
  return (struct gradient_likeness){aa > 0 && bb > 0 ? ab / (sqrt(aa) * sqrt(bb)) : 0, sqrt(aa),
                                    sqrt(bb)};
}

static int run_robot(struct share *s, uint32_t i)
{
  const struct mo_robot *robot = s->robots + i;
  const size_t n = s->controller->n_parameters;
  struct mo_outcome outcome;
  memset(s->one, 0, n * sizeof(double));
  int status = mo_gradient_reference(robot->body, s->controller, robot->environment, s->physics,
                                     &s->options, s->outcomes + i, s->one, &s->counts);
  if (status == MO_OK)
    status = mo_gradient_block(s->memory, s->pack, robot, 1, s->physics, &s->options, NULL,
                               &outcome, s->fast, NULL);
  if (status != MO_OK)
    return status;
  for (size_t p = 0; p < n; p++) {
    s->sum[p] += s->one[p];
    s->other[p] = (double)s->fast[p];
  }
  s->difference[i] = 1 - compare(s->other, s->one, n).cosine;
  if (!s->moved)
    return MO_OK;
  struct mo_environment environment = *robot->environment;
  environment.light_xy_m[0] += MOVED_M;
  memset(s->other, 0, n * sizeof(double));
  status = mo_gradient_reference(robot->body, s->controller, &environment, s->physics, &s->options,
                                 &outcome, s->other, NULL);
  for (size_t p = 0; p < n; p++)
    s->moved_sum[p] += s->other[p];
  s->moved_difference[i] = 1 - compare(s->other, s->one, n).cosine;
  return status;
}

static void *run_share(void *argument)
{
  struct share *s = argument;
  for (uint32_t i = s->first; i < s->n && s->status == MO_OK; i += s->stride)
    s->status = run_robot(s, i);
  return NULL;
}

static int start_share(struct share *s, const struct share *what, uint32_t number, uint32_t threads)
{
  const size_t n = what->controller->n_parameters;
  *s = *what;
  s->first = number;
  s->stride = threads;
  s->sum = calloc(4 * n, sizeof(double));
  s->fast = calloc(n, sizeof(float));
  if (s->sum == NULL || s->fast == NULL ||
      mo_gradient_memory_create((size_t)32 << 20, &s->memory) != MO_OK)
    return MO_ERR_NO_MEMORY;
  s->moved_sum = s->sum + n;
  s->one = s->sum + 2 * n;
  s->other = s->sum + 3 * n;
  return pthread_create(&s->thread, NULL, run_share, s) == 0 ? MO_OK : MO_ERR_NO_MEMORY;
}

static void free_share(struct share *s)
{
  free(s->sum);
  free(s->fast);
  mo_gradient_memory_free(s->memory);
}

/* Sums into d_parameters and moved, which start from zeros. */
static int run_reference(const struct share *what, uint32_t threads, double *d_parameters,
                         double *moved, struct mo_gradient_counts *counts)
{
  struct share shares[THREADS_MAX];
  const size_t n = what->controller->n_parameters;
  int status = MO_OK;
  uint32_t started = 0;
  for (; started < threads && status == MO_OK; started += status == MO_OK)
    status = start_share(shares + started, what, started, threads);
  if (started < threads)
    free_share(shares + started);
  for (uint32_t t = 0; t < started; t++) {
    struct share *s = shares + t;
    pthread_join(s->thread, NULL);
    status = status == MO_OK ? s->status : status;
    for (size_t i = 0; i < n; i++) {
      d_parameters[i] += s->sum[i];
      moved[i] += s->moved_sum[i];
    }
    mo_gradient_counts_add(counts, &s->counts);
    free_share(s);
  }
  return status;
}

static int run_fast(const struct share *what, enum mo_isa isa, uint32_t workers,
                    struct mo_outcome *outcomes, double *d_parameters,
                    struct mo_gradient_counts *counts)
{
  struct mo_compute *compute = NULL;
  struct mo_gradient_state *state = NULL;
  const struct mo_compute_config config = {.n_workers = workers, .isa = isa};
  int status = mo_compute_create_cpu(&config, &compute);
  if (status == MO_OK)
    status = mo_gradient_state_create(compute, &state);
  struct mo_gradient_batch batch = {.controller = what->controller,
                                    .robots = what->robots,
                                    .n = what->n,
                                    .physics = *what->physics,
                                    .adjoint_bound = what->options.adjoint_bound,
                                    .adjoint_rule = what->options.adjoint_rule,
                                    .restart_weight = what->options.restart_weight,
                                    .d_parameters = d_parameters,
                                    .outcomes = outcomes};
  if (status == MO_OK)
    status = mo_compute_gradient(state, &batch);
  *counts = batch.counts;
  mo_gradient_state_free(state);
  mo_compute_free(compute);
  return status;
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static struct gradient_spread spread_of(double *differences, uint32_t n)
{
  struct gradient_spread spread = {0};
  for (uint32_t i = 0; i < n; i++)
    spread.share_alike += (differences[i] < 1e-3) / (double)n;
  qsort(differences, n, sizeof(*differences), ascending);
  spread.median = differences[n / 2];
  spread.p90 = differences[n * (size_t)9 / 10];
  return spread;
}

static void compare_losses(const struct mo_outcome *a, const struct mo_outcome *b, uint32_t n,
                           double *differences, struct gradient_comparison *c)
{
  uint32_t both = 0;
  for (uint32_t i = 0; i < n; i++)
    if (a[i].diverged_step == 0 && b[i].diverged_step == 0)
      differences[both++] = fabs(a[i].loss - b[i].loss);
    else
      c->diverged_in_one += a[i].diverged_step == 0 || b[i].diverged_step == 0;
  if (both == 0)
    return;
  qsort(differences, both, sizeof(*differences), ascending);
  c->loss_median = differences[both / 2];
  c->loss_p90 = differences[both * 9 / 10];
  c->loss_most = differences[both - 1];
}

int gradient_compare(const struct mo_controller *controller, const struct mo_robot *robots,
                     uint32_t n, const struct mo_physics *physics,
                     const struct mo_gradient_options *options, enum mo_isa isa, uint32_t workers,
                     bool moved, struct gradient_comparison *c)
{
  const size_t size = controller->n_parameters;
  struct mo_outcome *outcomes = calloc(2 * (size_t)n, sizeof(*outcomes));
  double *gradients = calloc(3 * size, sizeof(*gradients)),
         *differences = calloc(3 * (size_t)n, sizeof(*differences));
  struct mo_pack *pack = NULL;
  int status = workers < 1 || workers > THREADS_MAX
                   ? MO_ERR_RANGE
                   : mo_pack_create_for_gradients(controller, isa, &pack);
  *c = (struct gradient_comparison){.loss_median = 0};
  if (status == MO_OK && (outcomes == NULL || gradients == NULL || differences == NULL))
    status = MO_ERR_NO_MEMORY;
  struct share what = {.controller = controller,
                       .robots = robots,
                       .n = n,
                       .physics = physics,
                       .options = *options,
                       .pack = pack,
                       .moved = moved,
                       .outcomes = outcomes + n,
                       .difference = differences,
                       .moved_difference = differences + n};
  what.options.weight = 1.0 / n;
  double start_s = now_s();
  if (status == MO_OK)
    status = run_fast(&what, isa, workers, outcomes, gradients, &c->fast);
  c->fast_s = now_s() - start_s;
  start_s = now_s();
  if (status == MO_OK)
    status = run_reference(&what, workers, gradients + size, gradients + 2 * size, &c->reference);
  c->reference_s = now_s() - start_s;
  if (status == MO_OK) {
    compare_losses(outcomes, outcomes + n, n, differences + 2 * n, c);
    c->robots = spread_of(differences, n);
    c->all = compare(gradients, gradients + size, size);
    if (moved) {
      c->moved_robots = spread_of(differences + n, n);
      c->moved_all = compare(gradients + 2 * size, gradients + size, size);
    }
    size_t at = 0;
    for (int t = 0; t < MO_CONTROLLER_TENSORS; t++) {
      const size_t rows = t / 4 < MO_HIDDEN_LAYERS ? MO_HIDDEN : controller->n_springs;
      const size_t count = rows * (t % 4 != 0 ? 1 : t == 0 ? controller->n_inputs : MO_HIDDEN);
      c->tensor[t] = compare(gradients + at, gradients + size + at, count);
      at += count;
    }
  }
  mo_pack_free(pack);
  free(outcomes);
  free(gradients);
  free(differences);
  return status;
}
