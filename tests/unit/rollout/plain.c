/* plain.c: the second implementation on doubles. */
#include "second.h"

#include <math.h>
#include <stdlib.h>

#define NAME(x) plain_##x
typedef double num;

static double con(double x)
{
  return x;
}
static double val(double x)
{
  return x;
}
static double add(double a, double b)
{
  return a + b;
}
static double sub(double a, double b)
{
  return a - b;
}
static double mul(double a, double b)
{
  return a * b;
}
static double div_(double a, double b)
{
  return a / b;
}
static double scaled(double a, double b)
{
  return a * b;
}
static double root(double a)
{
  return sqrt(a);
}
static double tanh_(double a)
{
  return tanh(a);
}

static double parameter(const struct second_parameters *theta, size_t at, int lane)
{
  (void)lane;
  return theta->value[at];
}

/* The matrix starts at parameter `at` and has `height` rows, its biases follow; `rows` (NULL: 0 …)
 * are wanted, n of them. */
static void dense(const struct second_parameters *theta, size_t at, int lane, uint32_t height,
                  const uint32_t *rows, uint32_t n, uint32_t width, const double *in, double *out)
{
  (void)lane;
  const double *bias = theta->value + at + (size_t)height * width;
  uint32_t i = 0;
  for (; i + 4 <= n; i += 4) { /* four chains of additions at a time */
    const double *w[4];
    double sum[4] = {0, 0, 0, 0};
    for (uint32_t k = 0; k < 4; k++)
      w[k] = theta->value + at + (size_t)(rows != NULL ? rows[i + k] : i + k) * width;
    for (uint32_t j = 0; j < width; j++)
      for (int k = 0; k < 4; k++)
        sum[k] += w[k][j] * in[j];
    for (uint32_t k = 0; k < 4; k++)
      out[i + k] = sum[k] + bias[rows != NULL ? rows[i + k] : i + k];
  }
  for (; i < n; i++) {
    const uint32_t row = rows != NULL ? rows[i] : i;
    const double *w = theta->value + at + (size_t)row * width;
    double sum = 0;
    for (uint32_t j = 0; j < width; j++)
      sum += w[j] * in[j];
    out[i] = sum + bias[row];
  }
}

#include "second.inc"
