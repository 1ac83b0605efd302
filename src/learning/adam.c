/* adam.c: Adam (Kingma & Ba, ICLR 2015) with float64 moments and float32 weights.
 *
 *   m ← β1 m + (1 − β1) g,  v ← β2 v + (1 − β2) g²
 *   w ← w − rate · m/(1 − β1^t) / (√(v/(1 − β2^t)) + ε)
 *
 * It uses only +, −, ×, ÷ and √, which IEEE 754 rounds correctly, element by element, and adds in
 * the order of the elements, so the bits are equal on every machine, with any number of threads. An
 * update is computed twice, first to check that all of it is finite, so that it is applied
 * completely or not at all. */
#include "learning/internal.h"

#include "base/thread.h"

#include <math.h>
#include <stdatomic.h>
#include <string.h>

void mo_adam_count(struct mo_adam *adam, const struct mo_training_settings *settings,
                   uint32_t updates)
{
  adam->beta1_power = 1.0;
  adam->beta2_power = 1.0;
  for (uint32_t i = 0; i < updates; i++) {
    adam->beta1_power *= settings->learning.beta1;
    adam->beta2_power *= settings->learning.beta2;
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
  uint64_t most = 0; /* largest magnitude, compared as bits, which have the same order */
  for (size_t i = 0; i < n; i++) {
    uint64_t bits;
    memcpy(&bits, gradient + i, sizeof(bits));
    bits &= ~(UINT64_C(1) << 63);
    most = bits > most ? bits : most;
  }
  double largest;
  memcpy(&largest, &most, sizeof(largest));
  if (!isfinite(largest))
    return NAN;
  /* Scaling by a power of two changes no bit of the sum when both ways are possible. */
  const double scale = largest > 0x1p400 ? 0x1p-600 : largest < 0x1p-400 ? 0x1p+500 : 1.0;
  return norm_of_scaled(gradient, n, scale);
}

struct constants {
  double beta1, beta2, epsilon, scale, rate;
  double correct1, correct2; /* 1 − β^t */
};

/* An update in progress: ranges of elements, each on a thread. */
struct update {
  struct mo_adam *adam;
  const double *gradient;
  float *weights;
  struct constants c;
  atomic_bool is_infinite;
  atomic_uint bounded;
};

struct element {
  double first, second, weight;
};

static inline struct element updated(const struct constants *c, double first, double second,
                                     double weight, double gradient)
{
  const double g = gradient * c->scale;
  struct element e;
  e.first = c->beta1 * first + (1.0 - c->beta1) * g;
  e.second = c->beta2 * second + (1.0 - c->beta2) * (g * g);
  e.weight =
      weight - c->rate * (e.first / c->correct1) / (sqrt(e.second / c->correct2) + c->epsilon);
  return e;
}

static void check_range(void *context, size_t from, size_t end)
{
  struct update *u = context;
  const struct constants c = u->c;
  bool finite = true;
  for (size_t i = from; i < end; i++) {
    const struct element e =
        updated(&c, u->adam->first[i], u->adam->second[i], u->weights[i], u->gradient[i]);
    finite &= isfinite(e.first) && isfinite(e.second) && isfinite(e.weight);
  }
  if (!finite)
    atomic_store(&u->is_infinite, true);
}

static void apply_range(void *context, size_t from, size_t end)
{
  struct update *u = context;
  const struct constants c = u->c;
  unsigned bounded = 0;
  for (size_t i = from; i < end; i++) {
    struct element e =
        updated(&c, u->adam->first[i], u->adam->second[i], u->weights[i], u->gradient[i]);
    if (fabs(e.weight) > (double)MO_WEIGHT_LIMIT) {
      e.weight = copysign((double)MO_WEIGHT_LIMIT, e.weight);
      bounded++;
    }
    u->adam->first[i] = e.first;
    u->adam->second[i] = e.second;
    u->weights[i] = (float)e.weight;
  }
  atomic_fetch_add(&u->bounded, bounded);
}

bool mo_adam_update(struct mo_adam *adam, const struct mo_training_settings *settings, double rate,
                    double scale, const double *gradient, float *weights, size_t n,
                    uint32_t n_threads, uint32_t *bounded)
{
  const double power1 = adam->beta1_power * settings->learning.beta1;
  const double power2 = adam->beta2_power * settings->learning.beta2;
  struct update update = {.adam = adam,
                          .gradient = gradient,
                          .weights = weights,
                          .c = {settings->learning.beta1, settings->learning.beta2,
                                settings->learning.epsilon, scale, rate, 1.0 - power1,
                                1.0 - power2}};
  mo_parallel(n_threads, n, check_range, &update);
  if (atomic_load(&update.is_infinite))
    return false;
  mo_parallel(n_threads, n, apply_range, &update);
  *bounded += atomic_load(&update.bounded);
  adam->beta1_power = power1;
  adam->beta2_power = power2;
  return true;
}
