/* gradient-clip.c: the effect of the adjoint's bound, the handling of non-finite numbers, memory
 * and time, and edge cases of the contract. Linked with a wrapped calloc, so that allocations can
 * be counted and made to fail. */
#include "gradient-cases.h"

#include <stdbool.h>

#include "rollout/adjoint.h"

void *__real_calloc(size_t count, size_t size);
void *__wrap_calloc(size_t count, size_t size);

static long calls_left = -1; /* allocations until one fails; negative = never */
static size_t allocated;     /* bytes */

void *__wrap_calloc(size_t count, size_t size)
{
  if (calls_left >= 0 && calls_left-- == 0)
    return NULL;
  allocated += count * size;
  return __real_calloc(count, size);
}

enum { STEPS_MAX = 200 };

struct watch {
  const struct gradient_case *c;
  enum mo_adjoint_rule rule;
  double weight;                  /* of a restarted adjoint */
  double com_m[STEPS_MAX + 1][2]; /* after this many steps */
  double scale_m, bound, largest_before, largest_after, factor;
  double kept[2][3 * MO_DEFAULT_MASSES]; /* what the adjoint must be after it was compared with the
                                            bound */
  uint32_t calls, above, astray,
      inject_at; /* inject_at: step at which a NaN is put into the adjoint; 0 = never */
};

static double size_of(const struct watch *w, const double *dx, const double *dv)
{
  double x = 0, v = 0;
  for (uint32_t i = 0; i < 3 * w->c->body->n_masses; i++) {
    x += dx[i] * dx[i];
    v += dv[i] * dv[i];
  }
  return w->scale_m * fmax(sqrt(x), 15.0 * sqrt(v));
}

static void before(void *context, uint32_t step, double *dx, double *dv)
{
  struct watch *w = context;
  const double m = size_of(w, dx, dv);
  w->calls++;
  w->above += w->bound > 0 && m > w->bound;
  w->largest_before = fmax(w->largest_before, m);
  w->factor = w->bound > 0 && m > w->bound ? w->bound / m : 1;
  const uint32_t n = w->c->body->n_masses;
  memcpy(w->kept[0], dx, 3 * n * sizeof(double));
  memcpy(w->kept[1], dv, 3 * n * sizeof(double));
  if (w->factor < 1 &&
      w->rule == MO_ADJOINT_RESTART) { /* as at the end of a rollout that stops there */
    const double *light = w->c->environment.light_xy_m, *com = w->com_m[step - 1];
    const double far = hypot(com[0] - light[0], com[1] - light[1]);
    w->factor = 1;
    memset(w->kept, 0, sizeof(w->kept));
    for (uint32_t i = 0; i < n; i++)
      for (uint32_t axis = 0; axis < 2; axis++)
        w->kept[0][3 * i + axis] = w->weight * (com[axis] - light[axis]) / (far * n * w->scale_m);
  }
  if (step == w->inject_at)
    dv[1] = (double)NAN;
}

static void after(void *context, uint32_t step, double *dx, double *dv)
{
  struct watch *w = context;
  (void)step;
  w->largest_after = fmax(w->largest_after, size_of(w, dx, dv));
  for (uint32_t i = 0; i < 3 * w->c->body->n_masses;
       i++) { /* one factor for all of it; 1e-7: d0 + 1e-8 m versus d0 */
    const double x = w->factor * w->kept[0][i], v = w->factor * w->kept[1][i];
    w->astray += !(fabs(dx[i] - x) <= 1e-7 * fabs(x)) + !(fabs(dv[i] - v) <= 1e-7 * fabs(v));
  }
}

/* Returns where the center of mass is in the forward pass. */
static bool go(struct watch *w)
{
  const struct gradient_case *c = w->c;
  struct mo_reference r;
  if (c->physics.scheme.n_steps > STEPS_MAX ||
      mo_reference_init(&r, c->body, c->controller, &c->environment, &c->physics) < 0)
    return false;
  for (uint32_t step = 0; step <= c->physics.scheme.n_steps; step++) {
    for (uint32_t i = 0; i < c->body->n_masses; i++)
      for (uint32_t axis = 0; axis < 2; axis++)
        w->com_m[step][axis] += r.position_m[3 * i + axis] / c->body->n_masses;
    mo_reference_step(&r, step);
  }
  mo_reference_done(&r);
  w->scale_m = hypot(w->com_m[0][0] - c->environment.light_xy_m[0],
                     w->com_m[0][1] - c->environment.light_xy_m[1]);
  return true;
}

static int run_by(enum mo_adjoint_rule rule, double weight, const struct gradient_case *c,
                  double bound, uint32_t inject_at, struct watch *w, double *gradient,
                  struct mo_gradient_counts *counts)
{
  struct mo_outcome outcome;
  const struct mo_gradient_options options = {
      .adjoint_bound = bound, .weight = 0.25, .adjoint_rule = rule, .restart_weight = weight};
  const struct mo_gradient_probe probe = {before, after, w};
  *w = (struct watch){
      .c = c, .rule = rule, .weight = weight, .bound = bound, .inject_at = inject_at};
  if (!go(w))
    return -1;
  return mo_gradient_probed(c->body, c->controller, &c->environment, &c->physics, &options, &probe,
                            &outcome, gradient, counts);
}

static int run(const struct gradient_case *c, double bound, uint32_t inject_at, struct watch *w,
               double *gradient, struct mo_gradient_counts *counts)
{
  return run_by(MO_ADJOINT_CLIP, 1, c, bound, inject_at, w, gradient, counts);
}

/* Finds a case whose adjoint exceeds 1, and computes its gradient without a bound. */
static double *prepare(struct gradient_case *c, uint32_t n_steps, struct watch *w)
{
  struct mo_gradient_counts counts = {0};
  *c = make_gradient_case(3);
  c->physics.scheme.n_steps = n_steps;
  double *gradient = make_zeros(c->controller->n_parameters, sizeof(double));
  make_check(run(c, 0, 0, w, gradient, &counts), "gradient");
  return gradient;
}

static bool is_zero(const double *x, size_t n)
{
  size_t i = 0;
  while (i < n && x[i] == 0)
    i++;
  return i == n;
}

static void bounds_every_step(void)
{
  struct gradient_case c;
  struct watch free_run, bounded;
  double *unbounded = prepare(&c, 200, &free_run);
  const size_t n = c.controller->n_parameters;
  double *gradient = make_zeros(n, sizeof(double));
  printf("# unbounded: m up to %g\n", free_run.largest_before);
  const double bounds[] = {2 * free_run.largest_before, 0.5 * free_run.largest_before,
                           0.1 * free_run.largest_before};
  for (int k = 0; k < 3; k++) {
    struct mo_gradient_counts counts = {0};
    memset(gradient, 0, n * sizeof(double));
    REQUIRE(run(&c, bounds[k], 0, &bounded, gradient, &counts) == MO_OK);
    printf("# bound %g: %llu of %llu steps scaled, m up to %g before and %g after\n", bounds[k],
           (unsigned long long)counts.clipped_steps, (unsigned long long)counts.steps,
           bounded.largest_before, bounded.largest_after);
    CHECK(bounded.largest_after <= bounds[k] * (1 + 1e-7)); /* d0 + 1e-8 m against d0 */
    CHECK_INT(counts.steps, 200);
    CHECK_INT(bounded.calls, 200);
    CHECK_INT(counts.clipped_steps, bounded.above);
    CHECK_INT(bounded.astray, 0);
    CHECK_INT(counts.clipped_robots, k > 0);
    CHECK_INT(counts.robots, 1);
    CHECK_INT(counts.zeroed_robots, 0);
    CHECK(SAME(gradient, unbounded, n) == (k == 0)); /* never reached: same bits */
  }
}

static void restarts(void)
{
  struct gradient_case c;
  struct watch free_run, bounded;
  double *unbounded = prepare(&c, 200, &free_run);
  const size_t n = c.controller->n_parameters;
  double *gradient = make_zeros(n, sizeof(double)), *clipped = make_zeros(n, sizeof(double));
  const double fresh = 1 / sqrt(c.body->n_masses); /* m at the end of a rollout */
  const struct {
    double bound, weight;
    uint32_t least, most; /* steps that restart */
  } list[] = {
      {2 * free_run.largest_before, 3, 0, 0}, /* never reached */
      {2 * fresh, 1, 1, 99},
      {4 * fresh, 2.5, 1, 99},
      {2 * fresh, 0, 1, 1},       /* a restarted adjoint does not revive */
      {0.5 * fresh, 1, 200, 200}, /* already exceeded by an adjoint that has just started */
  };
  for (size_t k = 0; k < COUNT(list); k++) {
    struct mo_gradient_counts counts = {0};
    memset(gradient, 0, n * sizeof(double));
    REQUIRE(run_by(MO_ADJOINT_RESTART, list[k].weight, &c, list[k].bound, 0, &bounded, gradient,
                   &counts) == MO_OK);
    printf("# bound %g, weight %g: %llu of %llu steps restart, m up to %g before and %g after\n",
           list[k].bound, list[k].weight, (unsigned long long)counts.clipped_steps,
           (unsigned long long)counts.steps, bounded.largest_before, bounded.largest_after);
    CHECK(bounded.largest_after <=
          fmax(list[k].bound, fmax(1, list[k].weight) * fresh) * (1 + 1e-7));
    CHECK_INT(counts.steps, 200);
    CHECK_INT(counts.clipped_steps, bounded.above);
    CHECK_INT(bounded.astray, 0);
    CHECK(bounded.above >= list[k].least && bounded.above <= list[k].most);
    CHECK(SAME(gradient, unbounded, n) == (k == 0));
  }
  struct mo_gradient_counts counts = {0};
  REQUIRE(run(&c, 0.5 * fresh, 0, &bounded, clipped, &counts) == MO_OK);
  CHECK(!SAME(gradient, clipped, n));
}

static void zeroes_what_is_not_finite(void)
{
  struct gradient_case c;
  struct watch w;
  double *gradient = prepare(&c, 40, &w);
  const size_t n = c.controller->n_parameters;
  for (uint32_t inject_at = 1; inject_at <= 40; inject_at += 13) {
    struct mo_gradient_counts counts = {0};
    for (size_t i = 0; i < n; i++)
      gradient[i] = (double)i;
    REQUIRE(run(&c, inject_at % 2 ? 2 : 0, inject_at, &w, gradient, &counts) == MO_OK);
    CHECK_INT(counts.zeroed_robots, 1);
    CHECK_INT(counts.robots, 1);
    CHECK_INT(counts.steps, 40 - inject_at + 1);
    size_t touched = 0;
    for (size_t i = 0; i < n; i++)
      touched += gradient[i] != (double)i;
    CHECK_INT(touched, 0);
  }
}

/* Adds weight · gradient to the existing contents, with the same bits each time; the outcome is
 * that of the rollout. */
static void adds_up(void)
{
  struct gradient_case c = make_gradient_case(1);
  c.physics.scheme.n_steps = 37; /* not a square: the last segment is shorter */
  const size_t n = c.controller->n_parameters;
  double *once = make_zeros(2 * n, sizeof(double)), *twice = once + n;
  struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_outcome outcome, plain;
  struct mo_gradient_counts counts = {0};
  CHECK_NEAR(options.adjoint_bound, 2.0, 0);
  CHECK_NEAR(options.weight, 1.0, 0);
  REQUIRE(mo_gradient_reference(c.body, c.controller, &c.environment, &c.physics, &options,
                                &outcome, once, &counts) == MO_OK);
  REQUIRE(mo_rollout_reference(c.body, c.controller, &c.environment, &c.physics, NULL, NULL,
                               &plain) == MO_OK);
  CHECK(SAME(&outcome, &plain, 1));
  options.weight = 0.5;
  for (int k = 0; k < 2; k++)
    REQUIRE(mo_gradient_reference(c.body, c.controller, &c.environment, &c.physics, &options,
                                  &outcome, twice, &counts) == MO_OK);
  CHECK(SAME(once, twice, n));
  CHECK_INT(counts.robots, 3);
  CHECK_INT(counts.steps, 3 * 37);
  /* Only the body's masses and springs have a gradient. */
  size_t first[MO_CONTROLLER_TENSORS], count[MO_CONTROLLER_TENSORS], springs = 0, masses = 0;
  gradient_tensors(c.controller, first, count);
  for (uint32_t s = 0; s < c.controller->n_springs; s++)
    springs += once[first[13] + s] != 0;
  for (uint32_t i = 0; i < c.controller->n_masses; i++)
    masses += once[first[0] + i] != 0;
  CHECK_INT(springs, c.body->n_springs);
  CHECK(masses == c.body->n_masses || masses == 0); /* 0: neuron 0 never fired */
}

static void refuses(void)
{
  struct gradient_case c = make_gradient_case(1), other = make_gradient_case(3);
  double *gradient = make_zeros(c.controller->n_parameters, sizeof(double));
  struct mo_gradient_counts counts = {0};
  struct mo_outcome outcome = {.loss = -7};
  const struct {
    const struct mo_controller *controller;
    double bound, weight;
    int code;
    enum mo_adjoint_rule rule;
    double restart_weight;
  } faults[] = {
      {NULL, 2, 1, MO_ERR_INVALID, MO_ADJOINT_CLIP, 1},
      {other.controller, 2, 1, MO_ERR_INVALID, MO_ADJOINT_CLIP, 1},
      {c.controller, -1, 1, MO_ERR_RANGE, MO_ADJOINT_CLIP, 1},
      {c.controller, (double)NAN, 1, MO_ERR_INVALID, MO_ADJOINT_CLIP, 1},
      {c.controller, (double)INFINITY, 1, MO_ERR_INVALID, MO_ADJOINT_CLIP, 1},
      {c.controller, 2, (double)NAN, MO_ERR_INVALID, MO_ADJOINT_CLIP, 1},
      {c.controller, 2, 1, MO_ERR_INVALID, (enum mo_adjoint_rule)2, 1},
      {c.controller, 2, 1, MO_ERR_INVALID, (enum mo_adjoint_rule) - 1, 1},
      {c.controller, 2, 1, MO_ERR_RANGE, MO_ADJOINT_RESTART, -1},
      {c.controller, 2, 1, MO_ERR_RANGE, MO_ADJOINT_RESTART, 1e7},
      {c.controller, 2, 1, MO_ERR_INVALID, MO_ADJOINT_RESTART, (double)NAN},
  };
  c.physics.scheme.n_steps = 3;
  for (size_t k = 0; k < COUNT(faults); k++) {
    const struct mo_gradient_options options = {.adjoint_bound = faults[k].bound,
                                                .weight = faults[k].weight,
                                                .adjoint_rule = faults[k].rule,
                                                .restart_weight = faults[k].restart_weight};
    CHECK_INT(mo_gradient_reference(c.body, faults[k].controller, &c.environment, &c.physics,
                                    &options, &outcome, gradient, &counts),
              faults[k].code);
  }
  CHECK_INT(counts.robots, 0);
  CHECK_NEAR(outcome.loss, -7, 0);
  CHECK(is_zero(gradient, c.controller->n_parameters));
}

/* All 144 voxels, 1000 steps; too stiff, so that the rollout diverges soon after everything was
 * allocated. */
static void memory(void)
{
  struct gradient_case c = make_gradient_case(0);
  CHECK_INT(c.body->n_masses, MO_DEFAULT_MASSES);
  c.physics.constants.stiffness_n_per_m *= 4;
  double *gradient = make_zeros(c.controller->n_parameters, sizeof(double));
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_outcome outcome = {.loss = -7};
  struct mo_gradient_counts counts = {0};
  long failures = 0;
  for (int r = MO_ERR_NO_MEMORY; r == MO_ERR_NO_MEMORY && failures < 100; failures++) {
    allocated = 0;
    calls_left = failures;
    r = mo_gradient_reference(c.body, c.controller, &c.environment, &c.physics, &options, &outcome,
                              gradient, &counts);
    calls_left = -1;
    if (r == MO_OK)
      break;
    CHECK_INT(r, MO_ERR_NO_MEMORY);
    CHECK_NEAR(outcome.loss, -7, 0);
    CHECK_INT(counts.robots, 0);
  }
  printf("# %ld allocations, %.2f MB for %u masses, %u springs, 1000 steps\n", failures,
         (double)allocated / 1e6, c.body->n_masses, c.body->n_springs);
  CHECK(failures >= 4);
  CHECK(allocated > 1000000 && allocated < 10000000);
  CHECK(outcome.diverged_step > 0 && isinf(outcome.loss));
  CHECK_INT(counts.diverged_robots, 1);
  CHECK_INT(counts.steps, 0);
  CHECK(is_zero(gradient, c.controller->n_parameters));
}

static const struct check_case cases[] = {
    {"the bound holds at every step, exactly", bounds_every_step},
    {"above the bound, the adjoint restarts from where the robot is", restarts},
    {"a robot whose adjoint is not finite contributes nothing", zeroes_what_is_not_finite},
    {"gradients add up, weighted, in the same bits", adds_up},
    {"memory is bounded, and allocations may fail", memory},
    {"invalid arguments change nothing", refuses},
};
CHECK_MAIN(cases)
