/* The kernels' products against OpenBLAS, within what rounding allows for sums of k terms in any
 * order. */
#include "../check.h"
#include "probe.h"

#include <cblas.h>

enum { K = 256, ROWS = MO_BLOCK_LANES, PANEL_MAX = 32 };

static double x[ROWS * K], w[K * PANEL_MAX], init[PANEL_MAX], magnitude[ROWS * PANEL_MAX];
static double storage[4][ROWS * K + K * PANEL_MAX] __attribute__((aligned(64)));

static double largest_error(enum mo_isa isa, enum mo_precision precision, uint32_t rows)
{
  const int real = precision == MO_FLOAT64 ? 8 : 4,
            panel = 2 * (int)mo_isa_vector_bytes(isa) / real;
  static double expected64[ROWS * PANEL_MAX];
  static float expected32[ROWS * PANEL_MAX], x32[ROWS * K], w32[K * PANEL_MAX];
  for (int i = 0; i < ROWS * K; i++) {
    x32[i] = (float)x[i];
    precision == MO_FLOAT64 ? (void)(storage[0][i] = x[i])
                            : (void)(((float *)storage[0])[i] = (float)x[i]);
  }
  for (int i = 0; i < K * panel; i++) {
    w32[i] = (float)w[i];
    precision == MO_FLOAT64 ? (void)(storage[1][i] = w[i])
                            : (void)(((float *)storage[1])[i] = (float)w[i]);
  }
  for (int o = 0; o < panel; o++) {
    precision == MO_FLOAT64 ? (void)(storage[2][o] = init[o])
                            : (void)(((float *)storage[2])[o] = (float)init[o]);
    for (uint32_t r = 0; r < rows; r++) {
      expected64[(int)r * panel + o] = init[o];
      expected32[(int)r * panel + o] = (float)init[o];
      magnitude[(int)r * panel + o] = fabs(init[o]);
      for (int k = 0; k < K; k++)
        magnitude[(int)r * panel + o] += fabs(x[(int)r * K + k] * w[k * panel + o]);
    }
  }
  if (precision == MO_FLOAT64)
    cblas_dgemm(CblasRowMajor, CblasNoTrans, CblasNoTrans, (int)rows, panel, K, 1.0, x, K, w, panel,
                1.0, expected64, panel);
  else
    cblas_sgemm(CblasRowMajor, CblasNoTrans, CblasNoTrans, (int)rows, panel, K, 1.0f, x32, K, w32,
                panel, 1.0f, expected32, panel);
  run_probe(isa, precision,
            (struct probe){.rows = rows,
                           .k = K,
                           .x = storage[0],
                           .w = storage[1],
                           .init = storage[2],
                           .c = storage[3]});
  double worst = 0;
  for (int i = 0; i < (int)rows * panel; i++) {
    const double error = precision == MO_FLOAT64
                             ? fabs(storage[3][i] - expected64[i])
                             : fabs((double)((float *)storage[3])[i] - (double)expected32[i]);
    worst = fmax(worst, error / magnitude[i]);
  }
  return worst;
}

static void products(void)
{
  openblas_set_num_threads(1);
  struct mo_random random;
  mo_random_init(&random, 4, MO_PURPOSE_CHECK, 0, 0);
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
      CHECK(worst > 0); /* two different orders of summation, not one result compared with itself */
      CHECK(worst <=
            2 * K * unit / 8); /* the bound of two sums is 2·K units; random signs stay far below */
    }
}

static const struct check_case cases[] = {{"products agree with OpenBLAS", products}};
CHECK_MAIN(cases)
