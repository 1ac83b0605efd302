/* probe-float.c: see probe.h; MO_FAST_ISA is the instruction set that it is compiled for. */
#ifndef MO_FAST_DOUBLE
#define MO_FAST_DOUBLE 0
#define PROBE          MO_JOIN(probe_, MO_FAST_ISA, _float)
#endif
#define MO_JOIN3(a, b, c) a##b##c
#define MO_JOIN(a, b, c)  MO_JOIN3(a, b, c)

#include "probe.h"

#include "rollout/vector.inc"

#include "rollout/kernel_tiles.inc"

void PROBE(const struct probe *probe)
{
  REAL *x = probe->tanh_values;
  (void)panel_listed;
  (void)norm_relu;
  for (size_t i = 0; i < probe->n_tanh; i += MO_VL)
    v_store(x + i, tanh_v(v_load(x + i)));
  if (probe->rows > 0)
    panel_all(probe->rows, probe->k, probe->w, probe->x, 1, probe->k, probe->init, probe->c,
              2 * MO_VL);
}
