/* probe-double.c: probe-float.c in double. */
#define MO_FAST_DOUBLE 1
#define PROBE          MO_JOIN(probe_, MO_FAST_ISA, _double)
#include "probe-float.c" /* NOLINT(bugprone-suspicious-include) */
