/* adam.c: Adam (Kingma & Ba, ICLR 2015) with float64 moments and float32 weights.
 *
 *   m ← β1 m + (1 − β1) g,  v ← β2 v + (1 − β2) g²,  w ← w − rate · m/(1 − β1^t) / (√(v/(1 − β2^t)) + ε)
 *
 * Only +, −, ×, ÷ and √, which IEEE 754 rounds correctly, element by element, or summed in the order of the elements: equal bits on
 * every machine. An update is computed twice, first to see that all of it is finite, so that it happens whole or not at all. */
#include "learning/internal.h"

#include <math.h>

void mo_adam_count(struct mo_adam *adam, const struct mo_training_settings *settings, uint32_t updates)
{
  adam->beta1_power = 1.0;
  adam->beta2_power = 1.0;
  for (uint32_t i = 0; i < updates; i++) {
    adam->beta1_power *= settings->beta1;
    adam->beta2_power *= settings->beta2;
  }
}

static double norm_of_scaled(const double *gradient, size_t n, double scale)
{
  double sum = 0.0;
  for (size_t i = 0; i < n; i++)
    sum += gradient[i] * scale * (gradient[i] * scale);
  return sqrt(sum) / scale;
}

double mo_gradient_norm(const double *gradient, size_t n)
{
  double largest = 0.0;
  for (size_t i = 0; i < n; i++) {
    if (!isfinite(gradient[i]))
      return NAN;
    largest = fmax(largest, fabs(gradient[i]));
  }
  /* Powers of two change no bit of the sum where both ways are possible. */
  const double scale = largest > 0x1p400 ? 0x1p-600 : largest < 0x1p-400 ? 0x1p+500 : 1.0;
  return norm_of_scaled(gradient, n, scale);
}

struct update {
  double first, second, weight;
};

struct constants {
  double beta1, beta2, epsilon, scale, rate;
  double correct1, correct2; /* 1 − β^t */
};

static inline struct update updated(const struct constants *c, double first, double second, double weight,
                                    double gradient)
{
  const double g = gradient * c->scale;
  struct update u;
  u.first = c->beta1 * first + (1.0 - c->beta1) * g;
  u.second = c->beta2 * second + (1.0 - c->beta2) * (g * g);
  u.weight = weight - c->rate * (u.first / c->correct1) / (sqrt(u.second / c->correct2) + c->epsilon);
  return u;
}

bool mo_adam_update(struct mo_adam *adam, const struct mo_training_settings *settings, double rate, double scale,
                    const double *gradient, float *weights, size_t n, uint32_t *bounded)
{
  const double power1 = adam->beta1_power * settings->beta1;
  const double power2 = adam->beta2_power * settings->beta2;
  const struct constants c = {settings->beta1, settings->beta2, settings->epsilon, scale, rate,
                              1.0 - power1,    1.0 - power2};
  bool finite = true;
  for (size_t i = 0; i < n; i++) {
    const struct update u = updated(&c, adam->first[i], adam->second[i], weights[i], gradient[i]);
    finite &= isfinite(u.first) && isfinite(u.second) && isfinite(u.weight);
  }
  if (!finite)
    return false;
  for (size_t i = 0; i < n; i++) {
    struct update u = updated(&c, adam->first[i], adam->second[i], weights[i], gradient[i]);
    if (fabs(u.weight) > (double)MO_WEIGHT_LIMIT) {
      u.weight = copysign((double)MO_WEIGHT_LIMIT, u.weight);
      ++*bounded;
    }
    adam->first[i] = u.first;
    adam->second[i] = u.second;
    weights[i] = (float)u.weight;
  }
  adam->beta1_power = power1;
  adam->beta2_power = power2;
  return true;
}
