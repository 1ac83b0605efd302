/* probe.h: calls parts of the scoring kernels, which are compiled unchanged for every instruction
 * set: tanh over n values in place, and the plain product c = init + x·w. */
#ifndef MORPHO_TESTS_ROLLOUT_PROBE_H
#define MORPHO_TESTS_ROLLOUT_PROBE_H

#include "../make.h"

#include "rollout/fast.h"

/* n_tanh: a multiple of the vector; x (rows, k); w one panel (k, panel); init (panel); c (rows,
 * panel). */
struct probe {
  void *tanh_values;
  size_t n_tanh;
  uint32_t rows, k;
  const void *x, *w, *init;
  void *c;
};

typedef void probe_function(const struct probe *probe);
probe_function probe_baseline_float, probe_baseline_double;
probe_function probe_avx2_float, probe_avx2_double;
probe_function probe_avx512_float, probe_avx512_double;

static inline void run_probe(enum mo_isa isa, enum mo_precision precision, struct probe probe)
{
  static probe_function *const functions[MO_ISA_COUNT][2] = {
      {probe_baseline_float, probe_baseline_double},
      {probe_avx2_float, probe_avx2_double},
      {probe_avx512_float, probe_avx512_double},
  };
  functions[isa][precision](&probe);
}

/* n numbers in the precision of a kernel, and one such number. */
static inline void put_reals(enum mo_precision precision, void *to, const double *from, size_t n)
{
  for (size_t i = 0; i < n; i++)
    if (precision == MO_FLOAT64)
      ((double *)to)[i] = from[i];
    else
      ((float *)to)[i] = (float)from[i];
}

static inline double get_real(enum mo_precision precision, const void *from, size_t i)
{
  return precision == MO_FLOAT64 ? ((const double *)from)[i] : (double)((const float *)from)[i];
}

/* Computes c = init + x·w with a kernel, in its precision: x (rows, k); w (k, panel). */
enum { PRODUCT_K_MAX = 256, PANEL_MAX = 32 };

static inline const void *run_product(enum mo_isa isa, enum mo_precision precision, uint32_t rows,
                                      uint32_t k, uint32_t panel, const double *x, const double *w,
                                      const double *init)
{
  static double storage[4][MO_BLOCK_LANES * PRODUCT_K_MAX + PRODUCT_K_MAX * PANEL_MAX]
      __attribute__((aligned(64)));
  put_reals(precision, storage[0], x, (size_t)rows * k);
  put_reals(precision, storage[1], w, (size_t)k * panel);
  put_reals(precision, storage[2], init, panel);
  run_probe(isa, precision,
            (struct probe){.rows = rows,
                           .k = k,
                           .x = storage[0],
                           .w = storage[1],
                           .init = storage[2],
                           .c = storage[3]});
  return storage[3];
}

/* Returns the columns of one panel. */
static inline uint32_t panel_of(enum mo_isa isa, enum mo_precision precision)
{
  return 2 * mo_isa_vector_bytes(isa) / (precision == MO_FLOAT64 ? 8 : 4);
}

#endif
