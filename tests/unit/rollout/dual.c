/* dual.c: the second implementation on dual numbers v + Σ t[k] ε_k, ε_j ε_k = 0: every operation
 * carries its derivatives along. */
#include "second.h"

#include <math.h>
#include <stdlib.h>

#define NAME(x) dual_##x
typedef struct dual num;

#define LANES(expression)                                                                          \
  for (int k = 0; k < SECOND_LANES; k++)                                                           \
    r.t[k] = (expression);                                                                         \
  return r

static inline num con(double x)
{
  return (num){.v = x};
}
static inline double val(num a)
{
  return a.v;
}
static inline num add(num a, num b)
{
  num r = {.v = a.v + b.v};
  LANES(a.t[k] + b.t[k]);
}
static inline num sub(num a, num b)
{
  num r = {.v = a.v - b.v};
  LANES(a.t[k] - b.t[k]);
}
static inline num mul(num a, num b)
{
  num r = {.v = a.v * b.v};
  LANES(a.t[k] * b.v + a.v * b.t[k]);
}
static inline num div_(num a, num b)
{
  num r = {.v = a.v / b.v};
  LANES((a.t[k] - r.v * b.t[k]) / b.v);
}
static inline num scaled(num a, double b)
{
  num r = {.v = a.v * b};
  LANES(a.t[k] * b);
}
static inline num root(num a)
{
  num r = {.v = sqrt(a.v)};
  LANES(a.t[k] / (2 * r.v));
}
static inline num tanh_(num a)
{
  num r = {.v = tanh(a.v)};
  LANES(a.t[k] * (1 - r.v * r.v));
}

static num parameter(const struct second_parameters *theta, size_t at, int lane)
{
  num r = con(theta->value[at]);
  r.t[lane] = theta->alone[at];
  for (int k = 0; k < SECOND_WHOLES; k++)
    r.t[SECOND_LANES - SECOND_WHOLES + k] = theta->whole[k][at];
  return r;
}

/* Σ_j weights[j] · in[j]: values in order, and for each lane Σ_j weights[j] · in[j].t. The compiler
 * picks the widest vectors of this machine at run time; lanes never mix, so that the result is the
 * same. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) &&                             \
    !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
__attribute__((target_clones("avx512f", "avx2", "default")))
#endif
static void
weigh(const double *weights, const num *in, uint32_t width, num *sum)
{
  double v = 0, t[SECOND_LANES] = {0};
  for (uint32_t j = 0; j < width; j++) {
    v += weights[j] * in[j].v;
    for (int k = 0; k < SECOND_LANES; k++)
      t[k] += weights[j] * in[j].t[k];
  }
  sum->v = v;
  for (int k = 0; k < SECOND_LANES; k++)
    sum->t[k] = t[k];
}

/* As in plain.c. Lane `lane` moves the matrix, lane + 1 its biases. */
static void dense(const struct second_parameters *theta, size_t at, int lane, uint32_t height,
                  const uint32_t *rows, uint32_t n, uint32_t width, const num *in, num *out)
{
  const size_t biases = at + (size_t)height * width;
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t row = rows != NULL ? rows[i] : i;
    const size_t begin = at + (size_t)row * width;
    num sum;
    weigh(theta->value + begin, in, width, &sum);
    double alone = 0, whole[SECOND_WHOLES] = {0};
    for (uint32_t j = 0; j < width; j++) {
      alone += theta->alone[begin + j] * in[j].v;
      for (int k = 0; k < SECOND_WHOLES; k++)
        whole[k] += theta->whole[k][begin + j] * in[j].v;
    }
    sum.t[lane] += alone;
    for (int k = 0; k < SECOND_WHOLES; k++)
      sum.t[SECOND_LANES - SECOND_WHOLES + k] += whole[k];
    out[i] = add(sum, parameter(theta, biases + row, lane + 1));
  }
}

#include "second.inc"

uint64_t dual_move(const struct second_setup *setup, struct dual p[3], struct dual v[3])
{
  return move(setup, highest_of(setup->environment->terrain_heights_m), p, v);
}
