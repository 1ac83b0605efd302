/* isa.c: which of the compiled kernels this processor runs; sin and exp that do not depend on it.
 */
#include "rollout/fast.h"

#include <cpuid.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>

static const char *const names[MO_ISA_COUNT] = {"x86-64", "avx2", "avx512"};

/* Three features of x86-64-v3 that not every compiler's builtin knows by name: MOVBE, F16C, LZCNT.
 * None of them has registers of its own, so the processor's word is enough. */
static bool has_small_features(void)
{
  unsigned a, b, basic, d, extended;
  return __get_cpuid(1, &a, &b, &basic, &d) && __get_cpuid(0x80000001, &a, &b, &extended, &d) &&
         (basic & bit_MOVBE) != 0 && (basic & bit_F16C) != 0 && (extended & bit_LZCNT) != 0;
}

/* The compiler's builtins ask the processor and, for the wide registers, the operating system. The
 * lists are what meson.build compiles for: x86-64-v3 and x86-64-v4. */
enum mo_isa mo_isa_best(void)
{
  __builtin_cpu_init();
  if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma") ||
      !__builtin_cpu_supports("bmi") || !__builtin_cpu_supports("bmi2") || !has_small_features())
    return MO_ISA_BASELINE;
  if (!__builtin_cpu_supports("avx512f") || !__builtin_cpu_supports("avx512bw") ||
      !__builtin_cpu_supports("avx512cd") || !__builtin_cpu_supports("avx512dq") ||
      !__builtin_cpu_supports("avx512vl"))
    return MO_ISA_AVX2;
  return MO_ISA_AVX512;
}

const char *mo_isa_name(enum mo_isa isa)
{
  return (unsigned)isa < MO_ISA_COUNT ? names[isa] : "unknown";
}

int mo_isa_from_name(const char *name, enum mo_isa *isa)
{
  for (int i = 0; i < MO_ISA_COUNT; i++)
    if (strcmp(name, names[i]) == 0) {
      *isa = (enum mo_isa)i;
      return MO_OK;
    }
  return MO_ERR_NOT_FOUND;
}

uint32_t mo_isa_vector_bytes(enum mo_isa isa)
{
  return UINT32_C(16) << isa;
}

mo_fast_function *mo_fast_find(enum mo_isa isa, enum mo_precision precision)
{
  static mo_fast_function *const functions[MO_ISA_COUNT][2] = {
      {mo_fast_baseline_float, mo_fast_baseline_double},
      {mo_fast_avx2_float, mo_fast_avx2_double},
      {mo_fast_avx512_float, mo_fast_avx512_double},
  };
  return functions[isa][precision];
}

mo_fast_probe_function *mo_fast_probe_find(enum mo_isa isa, enum mo_precision precision)
{
  static mo_fast_probe_function *const functions[MO_ISA_COUNT][2] = {
      {mo_fast_probe_baseline_float, mo_fast_probe_baseline_double},
      {mo_fast_probe_avx2_float, mo_fast_probe_avx2_double},
      {mo_fast_probe_avx512_float, mo_fast_probe_avx512_double},
  };
  return functions[isa][precision];
}

double mo_fast_sin(double x)
{
  /* x = n π/2 + r, π/2 in two parts of which the first has trailing zeros: n · high is exact for
   * |n| < 2^20. */
  const double n = nearbyint(x * 0.63661977236758134308);
  const double r = (x - n * 0x1.921fb544p+0) - n * 0x1.0b4611a626331p-34;
  const double s = r * r;
  const int quadrant = (int)((int64_t)n & 3);
  double sum;
  if (quadrant & 1) { /* cosine, Taylor to s^8 */
    sum = 1.0 / 20922789888000.0;
    sum = sum * s - 1.0 / 87178291200.0;
    sum = sum * s + 1.0 / 479001600.0;
    sum = sum * s - 1.0 / 3628800.0;
    sum = sum * s + 1.0 / 40320.0;
    sum = sum * s - 1.0 / 720.0;
    sum = sum * s + 1.0 / 24.0;
    sum = sum * s - 0.5;
    sum = sum * s + 1.0;
  } else { /* sine, Taylor to r^17 */
    sum = 1.0 / 355687428096000.0;
    sum = sum * s - 1.0 / 1307674368000.0;
    sum = sum * s + 1.0 / 6227020800.0;
    sum = sum * s - 1.0 / 39916800.0;
    sum = sum * s + 1.0 / 362880.0;
    sum = sum * s - 1.0 / 5040.0;
    sum = sum * s + 1.0 / 120.0;
    sum = sum * s - 1.0 / 6.0;
    sum = r + r * s * sum;
  }
  return quadrant & 2 ? -sum : sum;
}

double mo_fast_exp(double x)
{
  if (x < -700.0)
    return 0.0;
  const double n = nearbyint(x * 1.4426950408889634074);
  const double r = (x - n * 0x1.62e42fefa2p-1) - n * 0x1.9ef35793c7673p-41;
  double sum = 1.0;
  for (int i = 14; i > 0; i--) /* Horner: 1 + r/1 (1 + r/2 (1 + …)) */
    sum = 1.0 + r / i * sum;
  return ldexp(sum, (int)n);
}
