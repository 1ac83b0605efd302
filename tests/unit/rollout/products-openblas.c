/* The kernels' products compared with OpenBLAS's, within the rounding error of sums of k terms in
 * any order. */
#include "probe.h"

#include <cblas.h>

enum { K = PRODUCT_K_MAX, ROWS = MO_BLOCK_LANES };

static double x[ROWS * K], w[K * PANEL_MAX], init[PANEL_MAX];

static double largest_error(enum mo_isa isa, enum mo_precision precision, uint32_t rows)
{
  static double expected64[ROWS * PANEL_MAX];
  static float expected32[ROWS * PANEL_MAX], x32[ROWS * K], w32[K * PANEL_MAX];
  const int panel = (int)panel_of(isa, precision), m = (int)rows;
  put_reals(MO_FLOAT32, x32, x, (size_t)rows * K);
  put_reals(MO_FLOAT32, w32, w, (size_t)K * (size_t)panel);
  for (uint32_t r = 0; r < rows; r++) {
    put_reals(MO_FLOAT64, expected64 + r * (uint32_t)panel, init, (size_t)panel);
    put_reals(MO_FLOAT32, expected32 + r * (uint32_t)panel, init, (size_t)panel);
  }
  if (precision == MO_FLOAT64)
    cblas_dgemm(CblasRowMajor, CblasNoTrans, CblasNoTrans, m, panel, K, 1.0, x, K, w, panel, 1.0,
                expected64, panel);
  else
    cblas_sgemm(CblasRowMajor, CblasNoTrans, CblasNoTrans, m, panel, K, 1.0f, x32, K, w32, panel,
                1.0f, expected32, panel);
  const void *c = run_product(isa, precision, rows, K, (uint32_t)panel, x, w, init);
  double worst = 0;
  for (int i = 0; i < m * panel; i++) {
    double magnitude = fabs(init[i % panel]);
    for (int k = 0; k < K; k++)
      magnitude += fabs(x[i / panel * K + k] * w[k * panel + i % panel]);
    const double expected = precision == MO_FLOAT64 ? expected64[i] : (double)expected32[i];
    worst = fmax(worst, fabs(get_real(precision, c, (size_t)i) - expected) / magnitude);
  }
  return worst;
}

static void products(void)
{
  struct mo_random random = dice(4, 0, 0);
  openblas_set_num_threads(1);
  for (int i = 0; i < ROWS * K; i++)
    x[i] = (float)mo_random_normal(&random);
  for (int i = 0; i < K * PANEL_MAX; i++)
    w[i] = (float)mo_random_normal(&random);
  for (int i = 0; i < PANEL_MAX; i++)
    init[i] = (float)mo_random_normal(&random);
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      const double unit = precision == MO_FLOAT64 ? 0x1p-53 : 0x1p-24;
      double worst = 0;
      for (uint32_t rows = 1; rows <= ROWS; rows++)
        worst = fmax(worst, largest_error((enum mo_isa)isa, (enum mo_precision)precision, rows));
      printf("# %s %s: within %.1f units of the sum of magnitudes\n", mo_isa_name((enum mo_isa)isa),
             precision == MO_FLOAT64 ? "float64" : "float32", worst / unit);
      CHECK(worst > 0); /* two orders of summation, not one result compared with itself */
      /* The bound of two sums is 2·K units; random signs stay far below. */
      CHECK(worst <= 2 * K * unit / 8);
    }
}

static const struct check_case cases[] = {{"products agree with OpenBLAS", products}};
CHECK_MAIN(cases)
