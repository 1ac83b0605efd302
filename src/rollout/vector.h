/* vector.h: one vector of REAL, for the instruction set that this file is compiled for.
 *
 * kernel.inc is written once with these names and compiled six times (float, double × x86-64, AVX2
 * + FMA, AVX-512). C's vector extension covers + − * /, loads, shuffles and integer bits; only the
 * rest has a name here:
 *   V        MO_VL numbers            I       as many integers of the same size
 *   M        one truth value per lane; & | ^ work on it, v_bits gives bit l for lane l
 *   v_fma    a·b + c, one rounding where the instruction set has it, two on plain x86-64
 *   v_min    x86 order: the second operand if either is NaN (or both are zeros); also v_max
 * Contraction is off for the whole project, so only explicit operations are fused: each lane
 * performs the same operations, whatever the other lanes hold and however loops are unrolled. */
#ifndef MORPHO_ROLLOUT_VECTOR_H
#define MORPHO_ROLLOUT_VECTOR_H

#include <immintrin.h>
#include <stdint.h>

#if MO_FAST_DOUBLE
typedef double REAL;
typedef int64_t REAL_INT;
#define MO_MANTISSA_BITS 52
#define MO_EXPONENT_BIAS 1023
#define MO_ROUND_MAGIC   6755399441055744.0 /* 1.5·2^52 */
#else
typedef float REAL;
typedef int32_t REAL_INT;
#define MO_MANTISSA_BITS 23
#define MO_EXPONENT_BIAS 127
#define MO_ROUND_MAGIC   12582912.0f /* 1.5·2^23 */
#endif

#if defined(__AVX512F__)
#define MO_VBYTES 64
#elif defined(__AVX2__)
#define MO_VBYTES 32
#else
#define MO_VBYTES 16
#endif
#define MO_VL ((int)(MO_VBYTES / sizeof(REAL)))

typedef REAL V __attribute__((vector_size(MO_VBYTES)));
typedef REAL_INT I __attribute__((vector_size(MO_VBYTES)));

#define MO_INLINE static inline __attribute__((always_inline))

MO_INLINE V v_load(const REAL *p)
{
  return *(const V *)p;
}

MO_INLINE void v_store(REAL *p, V v)
{
  *(V *)p = v;
}

/* Loads a vector into a register. Otherwise compilers fold a load that is used twice into both
 * operations, and load it twice. */
MO_INLINE V v_load_once(const REAL *p)
{
  V v = *(const V *)p;
#if defined(__AVX512F__)
  __asm__("" : "+v"(v));
#else
  __asm__("" : "+x"(v));
#endif
  return v;
}

/* Stores a vector that is not read again soon: past the caches, if the instruction set has such a
 * store of the vector's width. p: aligned. */
MO_INLINE void v_stream(REAL *p, V v)
{
#if MO_VBYTES == 64 && MO_FAST_DOUBLE
  _mm512_stream_pd(p, (__m512d)v);
#elif MO_VBYTES == 64
  _mm512_stream_ps(p, (__m512)v);
#elif MO_VBYTES == 32 && MO_FAST_DOUBLE
  _mm256_stream_pd(p, (__m256d)v);
#elif MO_VBYTES == 32
  _mm256_stream_ps(p, (__m256)v);
#elif MO_FAST_DOUBLE
  _mm_stream_pd(p, (__m128d)v);
#else
  _mm_stream_ps(p, (__m128)v);
#endif
}

MO_INLINE V v_set(REAL x)
{
  return x - (V){0};
}

#define v_div(a, b) ((a) / (b))

/* ---- what only intrinsics can say ---- */

#if defined(__AVX512F__) && MO_FAST_DOUBLE
typedef __mmask8 M;
#define v_fma(a, b, c)  ((V)_mm512_fmadd_pd((__m512d)(a), (__m512d)(b), (__m512d)(c)))
#define v_fnma(a, b, c) ((V)_mm512_fnmadd_pd((__m512d)(a), (__m512d)(b), (__m512d)(c)))
#define v_sqrt(a)       ((V)_mm512_sqrt_pd((__m512d)(a)))
#define v_min(a, b)     ((V)_mm512_min_pd((__m512d)(a), (__m512d)(b)))
#define v_max(a, b)     ((V)_mm512_max_pd((__m512d)(a), (__m512d)(b)))
#define v_lt(a, b)      _mm512_cmp_pd_mask((__m512d)(a), (__m512d)(b), _CMP_LT_OQ)
#define v_le(a, b)      _mm512_cmp_pd_mask((__m512d)(a), (__m512d)(b), _CMP_LE_OQ)
#define v_eq(a, b)      _mm512_cmp_pd_mask((__m512d)(a), (__m512d)(b), _CMP_EQ_OQ)
#define v_sel(m, a, b)  ((V)_mm512_mask_blend_pd((m), (__m512d)(b), (__m512d)(a)))
#define v_bits(m)       ((unsigned)(m))
#define v_mask(bits)    ((M)(bits))
#define v_gather(p, i)  ((V)_mm512_i64gather_pd((__m512i)(i), (p), 8))
#define v_broadcast(p)  ((V)_mm512_set1_pd(*(p)))

#elif defined(__AVX512F__)
typedef __mmask16 M;
#define v_fma(a, b, c)  ((V)_mm512_fmadd_ps((__m512)(a), (__m512)(b), (__m512)(c)))
#define v_fnma(a, b, c) ((V)_mm512_fnmadd_ps((__m512)(a), (__m512)(b), (__m512)(c)))
#define v_sqrt(a)       ((V)_mm512_sqrt_ps((__m512)(a)))
#define v_min(a, b)     ((V)_mm512_min_ps((__m512)(a), (__m512)(b)))
#define v_max(a, b)     ((V)_mm512_max_ps((__m512)(a), (__m512)(b)))
#define v_lt(a, b)      _mm512_cmp_ps_mask((__m512)(a), (__m512)(b), _CMP_LT_OQ)
#define v_le(a, b)      _mm512_cmp_ps_mask((__m512)(a), (__m512)(b), _CMP_LE_OQ)
#define v_eq(a, b)      _mm512_cmp_ps_mask((__m512)(a), (__m512)(b), _CMP_EQ_OQ)
#define v_sel(m, a, b)  ((V)_mm512_mask_blend_ps((m), (__m512)(b), (__m512)(a)))
#define v_bits(m)       ((unsigned)(m))
#define v_mask(bits)    ((M)(bits))
#define v_gather(p, i)  ((V)_mm512_i32gather_ps((__m512i)(i), (p), 4))
#define v_broadcast(p)  ((V)_mm512_set1_ps(*(p)))

#elif defined(__AVX2__) && MO_FAST_DOUBLE
typedef I M;
#define v_fma(a, b, c)  ((V)_mm256_fmadd_pd((__m256d)(a), (__m256d)(b), (__m256d)(c)))
#define v_fnma(a, b, c) ((V)_mm256_fnmadd_pd((__m256d)(a), (__m256d)(b), (__m256d)(c)))
#define v_sqrt(a)       ((V)_mm256_sqrt_pd((__m256d)(a)))
#define v_min(a, b)     ((V)_mm256_min_pd((__m256d)(a), (__m256d)(b)))
#define v_max(a, b)     ((V)_mm256_max_pd((__m256d)(a), (__m256d)(b)))
#define v_sel(m, a, b)  ((V)_mm256_blendv_pd((__m256d)(b), (__m256d)(a), (__m256d)(m)))
#define v_bits(m)       ((unsigned)_mm256_movemask_pd((__m256d)(m)))
#define v_gather(p, i)  ((V)_mm256_i64gather_pd((p), (__m256i)(i), 8))
#define v_broadcast(p)  ((V)_mm256_broadcast_sd(p))

#elif defined(__AVX2__)
typedef I M;
#define v_fma(a, b, c)  ((V)_mm256_fmadd_ps((__m256)(a), (__m256)(b), (__m256)(c)))
#define v_fnma(a, b, c) ((V)_mm256_fnmadd_ps((__m256)(a), (__m256)(b), (__m256)(c)))
#define v_sqrt(a)       ((V)_mm256_sqrt_ps((__m256)(a)))
#define v_min(a, b)     ((V)_mm256_min_ps((__m256)(a), (__m256)(b)))
#define v_max(a, b)     ((V)_mm256_max_ps((__m256)(a), (__m256)(b)))
#define v_sel(m, a, b)  ((V)_mm256_blendv_ps((__m256)(b), (__m256)(a), (__m256)(m)))
#define v_bits(m)       ((unsigned)_mm256_movemask_ps((__m256)(m)))
#define v_gather(p, i)  ((V)_mm256_i32gather_ps((p), (__m256i)(i), 4))
#define v_broadcast(p)  ((V)_mm256_broadcast_ss(p))

#else /* plain x86-64: SSE2, no fused operations, no gathers */
typedef I M;
#define v_fma(a, b, c)  ((a) * (b) + (c))
#define v_fnma(a, b, c) ((c) - (a) * (b))
#define v_sel(m, a, b)  ((V)(((I)(a) & (m)) | ((I)(b) & ~(m))))
#if MO_FAST_DOUBLE
#define v_sqrt(a)      ((V)_mm_sqrt_pd((__m128d)(a)))
#define v_min(a, b)    ((V)_mm_min_pd((__m128d)(a), (__m128d)(b)))
#define v_max(a, b)    ((V)_mm_max_pd((__m128d)(a), (__m128d)(b)))
#define v_bits(m)      ((unsigned)_mm_movemask_pd((__m128d)(m)))
#define v_broadcast(p) ((V)_mm_set1_pd(*(p)))
#else
#define v_sqrt(a)      ((V)_mm_sqrt_ps((__m128)(a)))
#define v_min(a, b)    ((V)_mm_min_ps((__m128)(a), (__m128)(b)))
#define v_max(a, b)    ((V)_mm_max_ps((__m128)(a), (__m128)(b)))
#define v_bits(m)      ((unsigned)_mm_movemask_ps((__m128)(m)))
#define v_broadcast(p) ((V)_mm_set1_ps(*(p)))
#endif
MO_INLINE V v_gather(const REAL *p, I index)
{
  V v;
  for (int l = 0; l < MO_VL; l++)
    v[l] = p[index[l]];
  return v;
}
#endif

#if !defined(__AVX512F__)
#define v_lt(a, b) ((M)((a) < (b)))
#define v_le(a, b) ((M)((a) <= (b)))
#define v_eq(a, b) ((M)((a) == (b)))
MO_INLINE M v_mask(unsigned bits)
{
  M m;
  for (int l = 0; l < MO_VL; l++)
    m[l] = (bits >> l & 1) ? -1 : 0;
  return m;
}
#endif

/* ---- shuffles: (a0 b0 a1 b1 …) of the lower and of the upper halves ---- */

#if MO_VBYTES == 64 && !MO_FAST_DOUBLE
#define v_zip_low(a, b)                                                                            \
  __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23)
#define v_zip_high(a, b)                                                                           \
  __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)
#elif (MO_VBYTES == 64 && MO_FAST_DOUBLE) || (MO_VBYTES == 32 && !MO_FAST_DOUBLE)
#define v_zip_low(a, b)  __builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11)
#define v_zip_high(a, b) __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15)
#elif (MO_VBYTES == 32 && MO_FAST_DOUBLE) || (MO_VBYTES == 16 && !MO_FAST_DOUBLE)
#define v_zip_low(a, b)  __builtin_shufflevector(a, b, 0, 4, 1, 5)
#define v_zip_high(a, b) __builtin_shufflevector(a, b, 2, 6, 3, 7)
#else
#define v_zip_low(a, b)  __builtin_shufflevector(a, b, 0, 2)
#define v_zip_high(a, b) __builtin_shufflevector(a, b, 1, 3)
#endif

/* Transposes the square of MO_VL rows by MO_VL columns: log2(MO_VL) perfect shuffles. */
MO_INLINE void v_transpose(V square[MO_VL])
{
#pragma GCC unroll 4
  for (int stage = 1; stage < MO_VL; stage *= 2) {
    V next[MO_VL];
#pragma GCC unroll 8
    for (int i = 0; i < MO_VL / 2; i++) {
      next[2 * i] = v_zip_low(square[i], square[i + MO_VL / 2]);
      next[2 * i + 1] = v_zip_high(square[i], square[i + MO_VL / 2]);
    }
#pragma GCC unroll 16
    for (int i = 0; i < MO_VL; i++)
      square[i] = next[i];
  }
}

/* Sums the lanes as a fixed binary tree: lane l with lane l + half, down to one. */
MO_INLINE REAL v_sum(V v)
{
#if MO_VBYTES >= 32
  typedef REAL H __attribute__((vector_size(MO_VBYTES / 2)));
#endif
#if MO_VBYTES == 64
  typedef REAL Q __attribute__((vector_size(MO_VBYTES / 4)));
#if MO_FAST_DOUBLE
  const H half =
      __builtin_shufflevector(v, v, 0, 1, 2, 3) + __builtin_shufflevector(v, v, 4, 5, 6, 7);
  const Q q = __builtin_shufflevector(half, half, 0, 1) + __builtin_shufflevector(half, half, 2, 3);
  return q[0] + q[1];
#else
  const H half = __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7) +
                 __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
  const Q q = __builtin_shufflevector(half, half, 0, 1, 2, 3) +
              __builtin_shufflevector(half, half, 4, 5, 6, 7);
  return (q[0] + q[2]) + (q[1] + q[3]);
#endif
#elif MO_VBYTES == 32 && MO_FAST_DOUBLE
  const H half = __builtin_shufflevector(v, v, 0, 1) + __builtin_shufflevector(v, v, 2, 3);
  return half[0] + half[1];
#elif MO_VBYTES == 32
  const H half =
      __builtin_shufflevector(v, v, 0, 1, 2, 3) + __builtin_shufflevector(v, v, 4, 5, 6, 7);
  return (half[0] + half[2]) + (half[1] + half[3]);
#elif MO_FAST_DOUBLE
  return v[0] + v[1];
#else
  return (v[0] + v[2]) + (v[1] + v[3]);
#endif
}

/* a where m, else 0. */
MO_INLINE V v_keep(M m, V a)
{
  return v_sel(m, a, (V){0});
}

MO_INLINE V v_abs(V v)
{
  const I sign = (I)v_set((REAL)-0.0);
  return (V)((I)v & ~sign);
}

/* The magnitude of `a` with the sign of `b`. */
MO_INLINE V v_copysign(V a, V b)
{
  const I sign = (I)v_set((REAL)-0.0);
  return (V)(((I)a & ~sign) | ((I)b & sign));
}

/* Returns the largest integer ≤ v, for |v| < 2^(MO_MANTISSA_BITS − 2). */
MO_INLINE V v_floor(V v)
{
  V nearest = (v + (REAL)MO_ROUND_MAGIC) - (REAL)MO_ROUND_MAGIC;
  return v_sel(v_lt(v, nearest), nearest - (REAL)1, nearest);
}

/* Converts whole numbers to integers. */
MO_INLINE I v_int(V whole)
{
  const V magic = v_set((REAL)MO_ROUND_MAGIC);
  return (I)(whole + magic) - (I)magic;
}

#endif
