/* reference-golden.c: the float64 reference against the stored rollouts, which have 9 digits. A
 * rollout bifurcates where a mass touches the ground or not by a rounding error, so the comparison
 * is by distribution (docs/model.md). */
#include "../check.h"
#include "golden.h"

static struct golden golden;

static int by_value(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

/* Smallest value that at least `share` of the sorted values do not exceed; the middle pair's mean
 * for the median. */
static double quantile(double *values, size_t n, double share)
{
  qsort(values, n, sizeof(*values), by_value);
  if (share == 0.5 && n % 2 == 0)
    return 0.5 * (values[n / 2 - 1] + values[n / 2]);
  const size_t rank = (size_t)ceil(share * (double)n);
  return values[rank > 0 ? rank - 1 : 0];
}

static void compare(enum mo_impact mode)
{
  struct mo_physics physics = mo_default_physics();
  physics.impact = mode;
  double *com = malloc((physics.n_steps + 1) * 3 * sizeof(double));
  double *loss_error = malloc(golden.n * sizeof(double)), *com_error[GOLDEN_STEPS];
  for (int s = 0; s < GOLDEN_STEPS; s++)
    com_error[s] = malloc(golden.n * sizeof(double));
  const struct mo_recording recording = {.stride = 1, .com_m = com};
  double mean = 0, golden_mean = 0;
  for (size_t i = 0; i < golden.n; i++) {
    const struct golden_case *c = &golden.cases[i];
    struct mo_outcome outcome;
    CHECK_INT(mo_rollout_reference(c->body, golden.controller, &c->environment, &physics,
                                   &recording, &outcome),
              MO_OK);
    CHECK_INT(outcome.diverged_step, 0);
    loss_error[i] = fabs(outcome.loss - c->loss[mode]);
    mean += outcome.loss / (double)golden.n;
    golden_mean += c->loss[mode] / (double)golden.n;
    for (int s = 0; s < GOLDEN_STEPS; s++) {
      const double *here = com + 3 * (size_t)golden_steps[s], *there = c->com_m[mode][s];
      com_error[s][i] = hypot(hypot(here[0] - there[0], here[1] - there[1]), here[2] - there[2]);
    }
    if (loss_error[i] > 1e-6)
      printf("# case %zu bifurcates: loss %.9f, stored %.9f; com off by %.1e m at step 200\n", i,
             outcome.loss, c->loss[mode], com_error[4][i]);
  }
  const double median = quantile(loss_error, golden.n, 0.5),
               most = quantile(loss_error, golden.n, 0.9);
  printf("# |loss error|: median %.2e, 90%% %.2e, max %.2e; mean loss %.9f, stored %.9f\n", median,
         most, loss_error[golden.n - 1], mean, golden_mean);
  for (int s = 0; s < GOLDEN_STEPS; s++)
    printf("# com error at step %4d: median %.2e m, 90%% %.2e m, max %.2e m\n", golden_steps[s],
           quantile(com_error[s], golden.n, 0.5), quantile(com_error[s], golden.n, 0.9),
           quantile(com_error[s], golden.n, 1));
  CHECK_INT(golden.n, 24);
  CHECK(median <= 1e-8);
  CHECK(most <= 1e-5);
  CHECK(quantile(com_error[4], golden.n, 0.5) <= 1e-8);
  for (int s = 0; s < GOLDEN_STEPS; s++)
    free(com_error[s]);
  free(loss_error);
  free(com);
}

static void exact(void)
{
  compare(MO_IMPACT_EXACT);
}

static void bisection(void)
{
  compare(MO_IMPACT_BISECTION);
}

int main(int argc, char **argv)
{
  static const struct check_case cases[] = {{"exact impact times", exact},
                                            {"8 bisections", bisection}};
  if (golden_load(&golden) < 0) {
    printf("Bail out! no golden rollouts\n");
    return 1;
  }
  const int r = check_run(cases, 2, argc, argv);
  golden_free(&golden);
  return r;
}
