/* isa.c: chooses the compiled kernels that this CPU can run. */
#include "rollout/block_physics.h"

#include <cpuid.h>
#include <stdbool.h>

static const char *const names[MO_ISA_COUNT] = {"x86-64", "avx2", "avx512"};

/* Checks three features of x86-64-v3 that some compilers' builtins do not support: MOVBE, F16C,
 * LZCNT. None of them adds registers, so querying only the CPU is enough. */
static bool has_small_features(void)
{
  unsigned a, b, basic, d, extended;
  return __get_cpuid(1, &a, &b, &basic, &d) && __get_cpuid(0x80000001, &a, &b, &extended, &d) &&
         (basic & bit_MOVBE) != 0 && (basic & bit_F16C) != 0 && (extended & bit_LZCNT) != 0;
}

/* The compiler's builtins query the CPU and, for the wide registers, the operating system. The
 * lists contain the features that meson.build compiles for: x86-64-v3 and x86-64-v4. */
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

uint32_t mo_isa_vector_bytes(enum mo_isa isa)
{
  return UINT32_C(16) << isa;
}

const struct mo_block_physics *mo_block_physics_find(enum mo_isa isa, enum mo_precision precision,
                                                     uint32_t n)
{
  /* The physics of each instruction set and precision, starting with the narrowest vectors: each
   * instruction set adds one width. */
  static const struct mo_block_physics *const found[MO_ISA_COUNT][2][MO_ISA_COUNT] = {
      {{&mo_physics_baseline_float_16}, {&mo_physics_baseline_double_16}},
      {{&mo_physics_avx2_float_16, &mo_physics_avx2_float_32},
       {&mo_physics_avx2_double_16, &mo_physics_avx2_double_32}},
      {{&mo_physics_avx512_float_16, &mo_physics_avx512_float_32, &mo_physics_avx512_float_64},
       {&mo_physics_avx512_double_16, &mo_physics_avx512_double_32, &mo_physics_avx512_double_64}},
  };
  const struct mo_block_physics *const *widths = found[isa][precision];
  while (widths != &found[isa][precision][isa] && (*widths)->n_lanes < n)
    widths++;
  return *widths;
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

mo_gradient_function *mo_gradient_find(enum mo_isa isa)
{
  static mo_gradient_function *const functions[MO_ISA_COUNT] = {
      mo_gradient_baseline, mo_gradient_avx2, mo_gradient_avx512};
  return functions[isa];
}
