/* gradient-compare.c: see gradient-compare.h. */
#include "gradient-compare.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { THREADS_MAX = 64 };

const char *const gradient_tensor_names[MO_CONTROLLER_TENSORS] = {
    "net.0.weight", "net.0.bias",   "net.1.weight", "net.1.bias",   "net.3.weight", "net.3.bias",   "net.4.weight",
    "net.4.bias",   "net.6.weight", "net.6.bias",   "net.7.weight", "net.7.bias",   "net.9.weight", "net.9.bias"};

static double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

/* The reference's share of thread t: robots t, t + threads, … */
struct share {
  const struct mo_controller *controller;
  const struct mo_robot *robots;
  uint32_t first, n, stride;
  const struct mo_physics *physics;
  struct mo_gradient_options options;
  struct mo_outcome *outcomes;
  double *d_parameters;
  struct mo_gradient_counts counts;
  pthread_t thread;
  int status;
};

static void *run_share(void *argument)
{
  struct share *s = argument;
  for (uint32_t i = s->first; i < s->n && s->status == MO_OK; i += s->stride)
    s->status = mo_gradient_reference(s->robots[i].body, s->controller, s->robots[i].environment, s->physics,
                                      &s->options, s->outcomes + i, s->d_parameters, &s->counts);
  return NULL;
}

static void add_counts(struct mo_gradient_counts *sum, const struct mo_gradient_counts *counts)
{
  sum->robots += counts->robots;
  sum->steps += counts->steps;
  sum->clipped_steps += counts->clipped_steps;
  sum->clipped_robots += counts->clipped_robots;
  sum->zeroed_robots += counts->zeroed_robots;
  sum->diverged_robots += counts->diverged_robots;
  sum->largest = fmax(sum->largest, counts->largest);
}

/* Sums into d_parameters, which starts from zeros. */
static int run_reference(const struct share *what, uint32_t threads, double *d_parameters,
                         struct mo_gradient_counts *counts)
{
  struct share shares[THREADS_MAX];
  const size_t n = what->controller->n_parameters;
  int status = MO_OK;
  uint32_t started = 0;
  for (; started < threads && status == MO_OK; started++) {
    struct share *s = shares + started;
    *s = *what;
    s->first = started;
    s->stride = threads;
    s->d_parameters = calloc(n, sizeof(double));
    if (s->d_parameters == NULL || pthread_create(&s->thread, NULL, run_share, s) != 0) {
      free(s->d_parameters);
      status = MO_ERR_NO_MEMORY;
      break;
    }
  }
  for (uint32_t t = 0; t < started; t++) {
    struct share *s = shares + t;
    pthread_join(s->thread, NULL);
    status = status == MO_OK ? s->status : status;
    for (size_t i = 0; i < n; i++)
      d_parameters[i] += s->d_parameters[i];
    add_counts(counts, &s->counts);
    free(s->d_parameters);
  }
  return status;
}

static int run_fast(const struct share *what, enum mo_isa isa, uint32_t workers, struct mo_outcome *outcomes,
                    double *d_parameters, struct mo_gradient_counts *counts)
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
                                    .d_parameters = d_parameters,
                                    .outcomes = outcomes};
  if (status == MO_OK)
    status = mo_compute_gradient(state, &batch);
  *counts = batch.counts;
  mo_gradient_state_free(state);
  mo_compute_free(compute);
  return status;
}

static struct gradient_likeness compare(const double *a, const double *b, size_t n)
{
  double ab = 0, aa = 0, bb = 0;
  for (size_t i = 0; i < n; i++) {
    ab += a[i] * b[i];
    aa += a[i] * a[i];
    bb += b[i] * b[i];
  }
  return (struct gradient_likeness){aa > 0 && bb > 0 ? ab / (sqrt(aa) * sqrt(bb)) : 0, sqrt(aa), sqrt(bb)};
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static void compare_losses(const struct mo_outcome *a, const struct mo_outcome *b, uint32_t n, double *differences,
                           struct gradient_comparison *c)
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

int gradient_compare(const struct mo_controller *controller, const struct mo_robot *robots, uint32_t n,
                     const struct mo_physics *physics, double adjoint_bound, enum mo_isa isa, uint32_t workers,
                     struct gradient_comparison *comparison)
{
  const size_t n_parameters = controller->n_parameters;
  struct mo_outcome *outcomes = calloc(2 * (size_t)n, sizeof(*outcomes));
  double *gradients = calloc(2 * n_parameters, sizeof(*gradients)), *differences = calloc(n, sizeof(*differences));
  int status = workers < 1 || workers > THREADS_MAX ? MO_ERR_RANGE : MO_OK;
  *comparison = (struct gradient_comparison){.loss_median = 0};
  if (status == MO_OK && (outcomes == NULL || gradients == NULL || differences == NULL))
    status = MO_ERR_NO_MEMORY;
  const struct share what = {.controller = controller,
                             .robots = robots,
                             .n = n,
                             .physics = physics,
                             .options = {.adjoint_bound = adjoint_bound, .weight = 1.0 / n},
                             .outcomes = outcomes + n};
  double start_s = now_s();
  if (status == MO_OK)
    status = run_fast(&what, isa, workers, outcomes, gradients, &comparison->fast);
  comparison->fast_s = now_s() - start_s;
  start_s = now_s();
  if (status == MO_OK)
    status = run_reference(&what, workers, gradients + n_parameters, &comparison->reference);
  comparison->reference_s = now_s() - start_s;
  if (status == MO_OK) {
    compare_losses(outcomes, outcomes + n, n, differences, comparison);
    comparison->all = compare(gradients, gradients + n_parameters, n_parameters);
    size_t at = 0;
    for (int t = 0; t < MO_CONTROLLER_TENSORS; t++) {
      const size_t rows = t / 4 < MO_HIDDEN_LAYERS ? MO_HIDDEN : controller->n_springs;
      const size_t size = rows * (t % 4 != 0 ? 1 : t == 0 ? controller->n_inputs : MO_HIDDEN);
      comparison->tensor[t] = compare(gradients + at, gradients + n_parameters + at, size);
      at += size;
    }
  }
  free(outcomes);
  free(gradients);
  free(differences);
  return status;
}
