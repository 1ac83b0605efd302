/* gradient_order.c: how the gradient converges as the time step shrinks.
 *
 * The controller computes its outputs every 16 ms whatever the step, so that all steps approximate
 * the same motion. Each body's gradient of its loss (float64, no bound on the adjoints) is compared
 * with Richardson's limit, extrapolated from the two smallest steps. So is the mean gradient of all
 * bodies, which learning uses. The limits of the two integrators are compared, too: their contact
 * laws differ (docs/model.md). */
#include "bench.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <unistd.h>

#define PERIOD_S 0.016

enum { STEPS = 6, INTEGRATORS = 2, THREADS_MAX = 64 };

/* The last one only serves the limit. */
static const double steps_ms[STEPS] = {4, 2, 1, 0.5, 0.25, 0.125};
static const double horizons_s[] = {0.208, 1.008, 4}; /* whole periods */

/* How one gradient differs from its limit. */
struct deviation {
  double angle; /* 1 − cosine */
  double norm;  /* ratio of the norms */
  double error; /* norm of the difference, relative to the limit's norm */
};

struct sweep {
  const struct bench_scene *scene;
  const struct mo_controller *controller;
  double horizon_s;
  uint32_t n, n_threads;
  struct deviation *deviations; /* (n, INTEGRATORS, STEPS − 1) */
  struct deviation *limits;     /* (n) split's limit against paper's */
  bool *usable;                 /* (n) no rollout diverged, and no gradient is 0 */
  double *sums; /* (INTEGRATORS, STEPS, n_parameters) over the usable robots; of the limits in place
                   of the last step */
};

struct share {
  struct sweep *sweep;
  uint32_t first;
  double *sums; /* as in the sweep, over the share's robots */
  pthread_t thread;
};

static struct deviation deviation_of(const double *a, const double *limit, size_t n)
{
  double product = 0, aa = 0, ll = 0, dd = 0;
  for (size_t i = 0; i < n; i++) {
    product += a[i] * limit[i];
    aa += a[i] * a[i];
    ll += limit[i] * limit[i];
    dd += (a[i] - limit[i]) * (a[i] - limit[i]);
  }
  return (struct deviation){1 - product / sqrt(aa * ll), sqrt(aa / ll), sqrt(dd / ll)};
}

/* Writes the gradient of one robot. Returns whether there is one that is not 0. */
static bool differentiate(const struct sweep *s, uint32_t robot, int integrator, int step,
                          double *gradient)
{
  const size_t n = s->controller->n_parameters;
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = (enum mo_integrator)integrator;
  physics.scheme.dt_s = steps_ms[step] / 1000;
  physics.scheme.n_steps = (uint32_t)lround(s->horizon_s / physics.scheme.dt_s);
  physics.scheme.control_period_s = PERIOD_S;
  struct mo_gradient_options options = mo_default_gradient_options();
  options.adjoint_bound = 0;
  options.weight = 1;
  struct mo_outcome outcome;
  struct mo_gradient_counts counts = {0};
  for (size_t i = 0; i < n; i++)
    gradient[i] = 0;
  bench_check(mo_gradient_reference(s->scene->robots[robot].body, s->controller,
                                    s->scene->robots[robot].environment, &physics, &options,
                                    &outcome, gradient, &counts),
              "gradient");
  double square = 0;
  for (size_t i = 0; i < n; i++)
    square += gradient[i] * gradient[i];
  return counts.diverged_robots == 0 && counts.zeroed_robots == 0 && square > 0;
}

/* Writes the limit over the last of the gradients (STEPS). Halving the step halves the error of the
 * gradient with both integrators, although the motion of `split` is of second order. */
static void extrapolate(double *const *gradients, size_t n)
{
  double *last = gradients[STEPS - 1];
  for (size_t p = 0; p < n; p++)
    last[p] = 2 * last[p] - gradients[STEPS - 2][p];
}

static void *run_share(void *argument)
{
  struct share *share = argument;
  struct sweep *s = share->sweep;
  const size_t n = s->controller->n_parameters;
  double *gradients[INTEGRATORS * STEPS];
  for (int k = 0; k < INTEGRATORS * STEPS; k++)
    gradients[k] = bench_zeros(n, sizeof(double));
  for (uint32_t i = share->first; i < s->n; i += s->n_threads) {
    bool usable = true;
    for (int k = 0; k < INTEGRATORS * STEPS && usable; k++)
      usable = differentiate(s, i, k / STEPS, k % STEPS, gradients[k]);
    s->usable[i] = usable;
    if (!usable)
      continue;
    for (int m = 0; m < INTEGRATORS; m++) {
      double *const *own = gradients + m * STEPS;
      extrapolate(own, n);
      for (int k = 0; k < STEPS - 1; k++)
        s->deviations[(i * INTEGRATORS + (uint32_t)m) * (STEPS - 1) + (uint32_t)k] =
            deviation_of(own[k], own[STEPS - 1], n);
    }
    s->limits[i] = deviation_of(gradients[2 * STEPS - 1], gradients[STEPS - 1], n);
    for (size_t k = 0; k < INTEGRATORS * STEPS; k++)
      for (size_t p = 0; p < n; p++)
        share->sums[k * n + p] += gradients[k][p];
  }
  for (int k = 0; k < INTEGRATORS * STEPS; k++)
    free(gradients[k]);
  return NULL;
}

/* Prints one row: medians over the usable robots, the share with a cosine above 0.99, the observed
 * order, and the mean gradient. before: the median error at twice the step, which is replaced; 0:
 * unknown; NULL: the row has no order. */
static void print_row(const struct sweep *s, const char *name, const struct deviation *first,
                      size_t stride, double *before, struct deviation mean)
{
  double *angle = bench_zeros(s->n, sizeof(double)), *norm = bench_zeros(s->n, sizeof(double)),
         *error = bench_zeros(s->n, sizeof(double));
  uint32_t count = 0, alike = 0;
  for (uint32_t i = 0; i < s->n; i++)
    if (s->usable[i]) {
      const struct deviation *d = first + i * stride;
      angle[count] = d->angle;
      norm[count] = d->norm;
      error[count++] = d->error;
      alike += d->angle < 0.01;
    }
  if (count > 0) {
    char order[16] = "";
    const double middle = bench_median(error, count);
    if (before != NULL && *before > 0)
      snprintf(order, sizeof(order), "%.2f", log2(*before / middle));
    printf("  %-16s %9.1e %8.4f %9.1e %6.0f %% %6s | %9.1e %8.4f\n", name,
           bench_median(angle, count), bench_median(norm, count), middle, 100.0 * alike / count,
           order, mean.angle, mean.norm);
    if (before != NULL)
      *before = middle;
  }
  free(angle);
  free(norm);
  free(error);
}

static void print(const struct sweep *s, const char *name)
{
  const size_t n = s->controller->n_parameters;
  uint32_t usable = 0;
  for (uint32_t i = 0; i < s->n; i++)
    usable += s->usable[i];
  printf("\n%s, %g s, %u of %u robots (the others diverged or have no gradient)\n"
         "                       median of the robots                     | mean gradient\n"
         "  integrator, step   1 - cos     norm     error  > 0.99   order |   1 - cos     norm\n",
         name, s->horizon_s, usable, s->n);
  for (int m = 0; m < INTEGRATORS; m++) {
    const double *sums = s->sums + (size_t)m * STEPS * n, *limit = sums + (STEPS - 1) * n;
    double before = 0;
    for (int k = 0; k < STEPS - 1; k++) {
      char words[32];
      snprintf(words, sizeof(words), "%s, %g ms", mo_integrator_words[m], steps_ms[k]);
      print_row(s, words, s->deviations + m * (STEPS - 1) + k, INTEGRATORS * (STEPS - 1), &before,
                deviation_of(sums + (size_t)k * n, limit, n));
    }
  }
  print_row(s, "limits of both", s->limits, 1, NULL,
            deviation_of(s->sums + (2 * STEPS - 1) * n, s->sums + (STEPS - 1) * n, n));
}

static void run(const struct bench_scene *scene, const struct mo_controller *controller,
                const char *name, double horizon_s, const struct bench_options *options)
{
  const long online = options->workers > 0 ? options->workers : sysconf(_SC_NPROCESSORS_ONLN);
  const uint32_t n = scene->n_bodies;
  const size_t sums = controller->n_parameters * INTEGRATORS * STEPS;
  struct sweep s = {
      .scene = scene,
      .controller = controller,
      .horizon_s = horizon_s,
      .n = n,
      .n_threads = (uint32_t)(online < 1             ? 1
                              : online > THREADS_MAX ? THREADS_MAX
                                                     : online),
      .deviations = bench_zeros((size_t)n * INTEGRATORS * (STEPS - 1), sizeof(struct deviation)),
      .limits = bench_zeros(n, sizeof(struct deviation)),
      .usable = bench_zeros(n, sizeof(bool)),
      .sums = bench_zeros(sums, sizeof(double))};
  struct share shares[THREADS_MAX];
  for (uint32_t t = 0; t < s.n_threads; t++) {
    shares[t] = (struct share){.sweep = &s, .first = t, .sums = bench_zeros(sums, sizeof(double))};
    bench_check(pthread_create(&shares[t].thread, NULL, run_share, &shares[t]) == 0
                    ? MO_OK
                    : MO_ERR_NO_MEMORY,
                "thread");
  }
  for (uint32_t t = 0; t < s.n_threads; t++) {
    pthread_join(shares[t].thread, NULL);
    for (size_t i = 0; i < sums; i++)
      s.sums[i] += shares[t].sums[i];
    free(shares[t].sums);
  }
  print(&s, name);
  free(s.sums);
  free(s.deviations);
  free(s.limits);
  free(s.usable);
}

int bench_gradient_order(const struct bench_options *options)
{
  const uint32_t n = options->bodies > 0 ? options->bodies : options->quick ? 4 : 32;
  struct bench_scene scene;
  bench_scene_create(&scene, options, n);
  printf("float64 reference, outputs every %g ms, no bound on the adjoints\n", 1000 * PERIOD_S);
  for (size_t h = 0; h < sizeof(horizons_s) / sizeof(horizons_s[0]); h++) {
    run(&scene, scene.random, "random weights", horizons_s[h], options);
    run(&scene, scene.controller, "trained controller", horizons_s[h], options);
  }
  return 0;
}
