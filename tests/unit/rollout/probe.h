/* probe.h: calls parts of the kernels that scoring uses, compiled for every instruction set as they
 * are: tanh over n values in place, and the plain product c = init + x·w. */
#ifndef MORPHO_TESTS_ROLLOUT_PROBE_H
#define MORPHO_TESTS_ROLLOUT_PROBE_H

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

#endif
