/* kernel_double.c: the fast path in double; MO_FAST_ISA is the instruction set it is compiled
 * for. */
#define MO_FAST_DOUBLE    1
#define MO_JOIN3(a, b, c) a##b##c
#define MO_JOIN(a, b, c)  MO_JOIN3(a, b, c)
#define MO_FAST_RUN       MO_JOIN(mo_fast_, MO_FAST_ISA, _double)
#include "rollout/kernel.inc"
