/* block_physics_double.c: the physics of blocks in double; MO_FAST_ISA is the instruction set, and
 * MO_VBYTES the size of its vectors. */
#define MO_FAST_DOUBLE         1
#define MO_NAME_OF(isa, bytes) mo_physics_##isa##_double_##bytes
#define MO_NAME(isa, bytes)    MO_NAME_OF(isa, bytes)
#define MO_BLOCK_PHYSICS       MO_NAME(MO_FAST_ISA, MO_VBYTES)
#include "rollout/block_physics.inc"
