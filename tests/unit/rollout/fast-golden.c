/* The fast path over whole lives, against the stored float64 rollouts. A single float32 life may
 * bifurcate at a contact, so the losses are compared by distribution, and the cases that part are
 * named. */
#include "../check.h"
#include "golden.h"

#include <math.h>

static struct golden golden;

static int setup(void)
{
  return golden.cases != NULL || golden_load(&golden) == 0;
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static void compare(enum mo_isa isa, enum mo_precision precision, int mode)
{
  enum { MAX = 256 };
  static double loss_error[MAX], com_error[MAX];
  double mean = 0, golden_mean = 0;
  struct mo_physics physics = mo_default_physics();
  physics.impact = mode == 0 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
  struct mo_pack *pack = NULL;
  struct mo_workspace_memory *memory = NULL;
  REQUIRE(golden.n > 0 && golden.n <= MAX);
  REQUIRE(mo_pack_create(golden.controller, isa, precision, &pack) == MO_OK);
  REQUIRE(mo_workspace_memory_create(&memory) == MO_OK);
  char name[64];
  snprintf(name, sizeof(name), "%s %s %s", mo_isa_name(isa),
           precision == MO_FLOAT32 ? "float32" : "float64", mode == 0 ? "exact" : "bisection8");
  for (size_t i = 0; i < golden.n; i++) {
    const struct golden_case *golden_case = golden.cases + i;
    const struct mo_environment *list[1] = {&golden_case->environment};
    double com[6][3];
    const struct mo_recording recording = {.stride = 200, .com_m = com[0]};
    struct mo_outcome outcome;
    REQUIRE(mo_rollout_block(memory, pack, golden_case->body, list, 1, &physics, &recording, NULL,
                             &outcome) == 0);
    loss_error[i] = fabs(outcome.loss - golden_case->loss[mode]);
    if (precision == MO_FLOAT32 && loss_error[i] > 1e-2)
      printf("# %s: case %zu bifurcates: loss %.6f, golden %.6f\n", name, i, outcome.loss,
             golden_case->loss[mode]);
    com_error[i] = 0;
    for (int axis = 0; axis < 3; axis++)
      com_error[i] = fmax(com_error[i], fabs(com[1][axis] - golden_case->com_m[mode][4][axis]));
    mean += outcome.loss / (double)golden.n;
    golden_mean += golden_case->loss[mode] / (double)golden.n;
  }
  qsort(loss_error, golden.n, sizeof(double), ascending);
  qsort(com_error, golden.n, sizeof(double), ascending);
  const double median = 0.5 * (loss_error[(golden.n - 1) / 2] + loss_error[golden.n / 2]);
  const double com_median = 0.5 * (com_error[(golden.n - 1) / 2] + com_error[golden.n / 2]);
  printf("# %s: |Δloss| median %.2g, 90 %% %.2g, max %.2g; mean %.6f, golden %.6f; center of mass "
         "at step 200 within "
         "%.2g m\n",
         name, median, loss_error[golden.n * 9 / 10], loss_error[golden.n - 1], mean, golden_mean,
         com_median);
  CHECK(median <= (precision == MO_FLOAT32 ? 1e-4 : 1e-8));
  CHECK(com_median <= (precision == MO_FLOAT32 ? 1e-4 : 1e-8));
  CHECK_NEAR(mean, golden_mean, 0.02);
  if (precision == MO_FLOAT64)
    CHECK(loss_error[golden.n * 9 / 10 - 1] <= 1e-5);
  mo_workspace_memory_free(memory);
  mo_pack_free(pack);
}

static void all_kernels(void)
{
  REQUIRE(setup());
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++)
      for (int mode = 0; mode < GOLDEN_MODES; mode++)
        compare((enum mo_isa)isa, (enum mo_precision)precision, mode);
}

static const struct check_case cases[] = {{"whole lives close to the golden ones", all_kernels}};
CHECK_MAIN(cases)
