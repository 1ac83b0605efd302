/* gradient_float.c: gradients of blocks in float; MO_FAST_ISA is the instruction set it is compiled
 * for. */
#define MO_FAST_DOUBLE    0
#define MO_JOIN2(a, b)    a##b
#define MO_JOIN(a, b)     MO_JOIN2(a, b)
#define MO_GRADIENT_BLOCK MO_JOIN(mo_gradient_, MO_FAST_ISA)
#include "rollout/gradient_kernel.inc"
