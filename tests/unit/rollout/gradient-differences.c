/* gradient-differences.c: the adjoint against central differences, (L(θ + h u) − L(θ − h u)) / 2h,
 * with exact times of impact.
 *
 * u: normal numbers, each scaled by the root mean square of its tensor, so that h is a relative
 * step. The loss comes from the second implementation on doubles (second.h), because float32
 * parameters cannot be moved by less than their last bit.
 *
 * The loss has kinks: a ReLU that switches, a contact more or less, friction that reaches its cap,
 * another terrain cell. A difference across a kink does not converge. plain.c returns a signature
 * of all those choices per step; where the two ends' signatures differ the direction is counted as
 * crossing at that h, and reported apart. Convergence is asserted for the others. */
#include <stdbool.h>

#include "gradient-cases.h"

#define STEP_SIZES 7
static const double step_sizes[STEP_SIZES] = {1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9};
#define DIRECTIONS_MAX 64

struct comparison {
  double error[STEP_SIZES][DIRECTIONS_MAX];
  bool crosses[STEP_SIZES][DIRECTIONS_MAX];
  uint32_t n;
};

static double quantile(double *sorted, uint32_t n, double q)
{
  qsort(sorted, n, sizeof(*sorted), ascending);
  return n > 0 ? sorted[(uint32_t)(q * (n - 1))] : (double)NAN;
}

static void make_direction(const struct gradient_case *c, uint32_t k, uint32_t number, double *u)
{
  size_t first[MO_CONTROLLER_TENSORS], count[MO_CONTROLLER_TENSORS];
  gradient_tensors(c->controller, first, count);
  struct mo_random random = dice(77, 6, 1000 * k + number);
  for (int t = 0; t < MO_CONTROLLER_TENSORS; t++) {
    double square = 0;
    for (size_t i = first[t]; i < first[t] + count[t]; i++)
      square += c->theta[i] * c->theta[i];
    for (size_t i = first[t]; i < first[t] + count[t]; i++)
      u[i] = sqrt(square / (double)count[t]) * mo_random_normal(&random);
  }
}

/* One end: the losses after each of `at`, and one hash per reported length of all signatures up to
 * there. */
static int run_end(const struct gradient_case *c, const double *u, double h, const uint32_t *at,
                   uint32_t n_at, double *moved, uint64_t *signatures, double *losses,
                   uint64_t *hashes)
{
  for (size_t i = 0; i < c->controller->n_parameters; i++)
    moved[i] = c->theta[i] + h * u[i];
  const struct second_setup setup = {c->body, &c->environment, &c->physics, c->controller->sensor};
  const struct second_parameters parameters = {.value = moved};
  if (plain_rollout(&setup, &parameters, at, n_at, losses, signatures) < 0)
    return -1;
  uint64_t hash = 0;
  uint32_t a = 0;
  for (uint32_t step = 0; step < c->physics.n_steps; step++) {
    hash = (hash ^ signatures[step]) * UINT64_C(0x9E3779B97F4A7C15) ^ (hash >> 31);
    while (a < n_at && at[a] == step + 1)
      hashes[a++] = hash;
  }
  return 0;
}

struct buffers {
  double *gradient[3], *u, *moved;
  uint64_t *signatures;
};

static void compare_direction(struct gradient_case *c, struct buffers *b, const uint32_t *at,
                              uint32_t n_at, struct comparison *out)
{
  for (int s = 0; s < STEP_SIZES; s++) {
    const double h = step_sizes[s];
    double up[3], down[3];
    uint64_t up_hash[3], down_hash[3];
    REQUIRE(run_end(c, b->u, h, at, n_at, b->moved, b->signatures, up, up_hash) == 0);
    REQUIRE(run_end(c, b->u, -h, at, n_at, b->moved, b->signatures, down, down_hash) == 0);
    for (uint32_t a = 0; a < n_at; a++) {
      double slope = 0;
      for (size_t i = 0; i < c->controller->n_parameters; i++)
        slope += b->gradient[a][i] * b->u[i];
      out[a].error[s][out[a].n] = fabs((up[a] - down[a]) / (2 * h) - slope) / fabs(slope);
      out[a].crosses[s][out[a].n] = up_hash[a] != down_hash[a];
    }
  }
  for (uint32_t a = 0; a < n_at; a++)
    out[a].n++;
}

static struct buffers prepare(const struct gradient_case *c, const uint32_t *at, uint32_t n_at)
{
  const struct mo_gradient_options options = {.adjoint_bound = 0, .weight = 1};
  const size_t n = c->controller->n_parameters;
  struct buffers b = {.u = make_zeros(n, sizeof(double)),
                      .moved = make_zeros(n, sizeof(double)),
                      .signatures = make_zeros(c->physics.n_steps, sizeof(uint64_t))};
  for (uint32_t a = 0; a < n_at; a++) {
    struct mo_physics physics = c->physics;
    struct mo_outcome outcome;
    struct mo_gradient_counts counts = {0};
    physics.n_steps = at[a];
    b.gradient[a] = make_zeros(n, sizeof(double));
    CHECK_INT(mo_gradient_reference(c->body, c->controller, &c->environment, &physics, &options,
                                    &outcome, b.gradient[a], &counts),
              MO_OK);
    CHECK_INT(counts.zeroed_robots + counts.diverged_robots, 0);
  }
  return b;
}

/* The table; returns the smallest median error of directions that cross nothing, where at least 4
 * of them are left. */
static double print_table(uint32_t steps, struct comparison *c)
{
  double best = (double)INFINITY;
  printf("# %u steps, %u directions\n", steps, c->n);
  printf("#     h     crossing   not crossing: median, largest error   all: median error\n");
  for (int s = 0; s < STEP_SIZES; s++) {
    double smooth[DIRECTIONS_MAX], all[DIRECTIONS_MAX];
    uint32_t n = 0;
    for (uint32_t d = 0; d < c->n; d++) {
      all[d] = c->error[s][d];
      if (!c->crosses[s][d])
        smooth[n++] = c->error[s][d];
    }
    const double median = quantile(smooth, n, 0.5);
    printf("#   %.0e   %3u of %-3u", step_sizes[s], c->n - n, c->n);
    if (n > 0)
      printf("   %10.1e   %10.1e", median, quantile(smooth, n, 1.0));
    else
      printf("   %10s   %10s", "-", "-");
    printf("               %10.1e\n", quantile(all, c->n, 0.5));
    if (n >= 4)
      best = fmin(best, median);
  }
  return best;
}

static void run_cases(const uint32_t *numbers, uint32_t n_cases, uint32_t n_directions,
                      const uint32_t *at, uint32_t n_at, const double *tolerances)
{
  struct comparison *comparisons = make_zeros(n_at, sizeof(*comparisons));
  for (uint32_t k = 0; k < n_cases; k++) {
    struct gradient_case c = make_gradient_case(numbers[k]);
    c.physics.impact = MO_IMPACT_EXACT;
    c.physics.n_steps = at[n_at - 1];
    struct buffers b = prepare(&c, at, n_at);
    for (uint32_t d = 0; d < n_directions; d++) {
      make_direction(&c, numbers[k], d, b.u);
      compare_direction(&c, &b, at, n_at, comparisons);
    }
  }
  for (uint32_t a = 0; a < n_at; a++) {
    const double best = print_table(at[a], &comparisons[a]);
    CHECK(best <= tolerances[a]);
    CHECK(best > 0); /* two ways to compute, not one */
  }
}

static void short_runs(void)
{
  static const uint32_t numbers[] = {3, 11, 13, 6}, at[] = {50, 200};
  static const double tolerances[] = {1e-7, 1e-6};
  run_cases(numbers, 4, 5, at, 2, tolerances);
}

static void long_runs(void)
{
  static const uint32_t numbers[] = {3, 11, 13, 2, 5, 10}, at[] = {50, 200, 1000};
  static const double tolerances[] = {1e-7, 1e-6, 1e-3};
  run_cases(numbers, 6, 4, at, 3, tolerances);
}

static const struct check_case cases[] = {
    {"central differences: 50 and 200 steps", short_runs},
    {"central differences: up to 1000 steps", long_runs},
};
CHECK_MAIN(cases)
