/* golden-lives.c: whole rollouts compared with the stored float64 rollouts, which have 9 digits:
 * the float64 reference, and every kernel. A rollout bifurcates when a rounding error decides
 * whether a mass touches the ground. So the comparison is by distribution (docs/model.md), and
 * cases that diverge from the stored ones are listed. */
#include "../make.h"
#include "golden.h"

static struct golden golden;

enum { CASES_MAX = 256, AT_200 = 4 /* of golden_steps */ };

/* Returns the loss of one case; com: (steps + 1, 3). isa −1: by the reference. */
static double live(const struct golden_case *c, int isa, enum mo_precision precision,
                   const struct mo_physics *physics, double *com)
{
  const struct mo_recording recording = {.stride = 1, .com_m = com};
  const struct mo_environment *list[1] = {&c->environment};
  struct mo_outcome outcome;
  if (isa < 0)
    make_check(mo_rollout_reference(c->body, golden.controller, list[0], physics, &recording, NULL,
                                    &outcome),
               "reference");
  else
    make_check(mo_rollout_block(make_workspace_memory(),
                                make_pack(golden.controller, (enum mo_isa)isa, precision), c->body,
                                list, 1, physics, &recording, NULL, NULL, &outcome),
               "kernel");
  CHECK_INT(outcome.diverged_step, 0);
  return outcome.loss;
}

static void compare(int isa, enum mo_precision precision, int mode)
{
  static double loss_error[CASES_MAX], com_error[GOLDEN_STEPS][CASES_MAX];
  const size_t n = golden.n;
  const bool exact = isa < 0, rough = precision == MO_FLOAT32;
  double mean = 0, golden_mean = 0;
  struct mo_physics physics = mo_paper_physics();
  double *com = make_zeros((physics.scheme.n_steps + 1) * 3, sizeof(double));
  physics.scheme.impact = mode == 0 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
  printf("# %s %s %s\n", exact ? "reference" : mo_isa_name((enum mo_isa)isa),
         rough ? "float32" : "float64", mode == 0 ? "exact" : "bisection8");
  for (size_t i = 0; i < n; i++) {
    const struct golden_case *c = golden.cases + i;
    const double loss = live(c, isa, precision, &physics, com);
    loss_error[i] = fabs(loss - c->loss[mode]);
    mean += loss / (double)n;
    golden_mean += c->loss[mode] / (double)n;
    for (int s = 0; s < GOLDEN_STEPS; s++) {
      const double *here = com + 3 * (size_t)golden_steps[s], *there = c->com_m[mode][s];
      com_error[s][i] = hypot(hypot(here[0] - there[0], here[1] - there[1]), here[2] - there[2]);
    }
    if (loss_error[i] > (rough ? 1e-2 : 1e-6))
      printf("# case %zu bifurcates: loss %.9f, stored %.9f; com off by %.1e m at step 200\n", i,
             loss, c->loss[mode], com_error[AT_200][i]);
  }
  qsort(loss_error, n, sizeof(double), ascending);
  const double median = median_of(loss_error, n);
  printf("# |loss error|: median %.2e, 90 %% %.2e, max %.2e; mean loss %.9f, stored %.9f\n", median,
         loss_error[n * 9 / 10], loss_error[n - 1], mean, golden_mean);
  for (int s = 0; s < GOLDEN_STEPS; s++) {
    qsort(com_error[s], n, sizeof(double), ascending);
    printf("# com error at step %4d: median %.2e m, max %.2e m\n", golden_steps[s],
           median_of(com_error[s], n), com_error[s][n - 1]);
  }
  CHECK(median <= (rough ? 1e-4 : 1e-8));
  CHECK(median_of(com_error[AT_200], n) <= (rough ? 1e-4 : 1e-8));
  CHECK(rough || loss_error[(n * 9 + 9) / 10 - 1] <= 1e-5);
  CHECK_NEAR(mean, golden_mean, 0.02);
  check_drop_to(0);
}

static void reference(void)
{
  CHECK_INT(golden.n, 24);
  for (int mode = 0; mode < GOLDEN_MODES; mode++)
    compare(-1, MO_FLOAT64, mode);
}

static void kernels(void)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++)
      for (int mode = 0; mode < GOLDEN_MODES; mode++)
        compare(isa, (enum mo_precision)precision, mode);
}

static const struct check_case cases[] = {
    {"the reference reproduces the golden rollouts", reference},
    {"the kernels come close to them", kernels}};

int main(int argc, char **argv)
{
  make_check(golden_load(&golden) < 0 || golden.n > CASES_MAX ? MO_ERR_FORMAT : MO_OK, "golden");
  const int r = check_run(cases, COUNT(cases), argc, argv);
  golden_free(&golden);
  return r;
}
