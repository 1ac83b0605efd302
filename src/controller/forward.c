/* forward.c: the network in float64, as simple as the speed of the tests permits. Each neuron's sum
 * is added in input order; four neurons are computed together so that their chains of additions
 * overlap. */
#include "controller/tape.h"

#include <math.h>

#define SIDE_BY_SIDE 4

/* sums[k] += row k · inputs, except for the last column, which the caller adds in code that
 * sanitizers check, so that they still catch arrays that are too short. Sanitizing this loop would
 * take a quarter of the time of the rollout tests. */
__attribute__((no_sanitize("address", "undefined"))) static void
sum_along(const float *const rows[SIDE_BY_SIDE], uint32_t width, const double *inputs,
          double sums[SIDE_BY_SIDE])
{
  for (uint32_t j = 0; j + 1 < width; j++)
    for (uint32_t k = 0; k < SIDE_BY_SIDE; k++)
      sums[k] += (double)rows[k][j] * inputs[j];
}

/* sums[i] = bias + row · inputs for the n rows listed in `rows` (NULL: 0 … n−1) of a matrix with
 * `width` columns. */
static void dense(const float *weight, const float *bias, const uint32_t *rows, uint32_t n,
                  uint32_t width, const double *inputs, double *sums)
{
  for (uint32_t i = 0; i < n; i += SIDE_BY_SIDE) {
    uint32_t row[SIDE_BY_SIDE];
    const float *w[SIDE_BY_SIDE];
    double sum[SIDE_BY_SIDE] = {0};
    for (uint32_t k = 0; k < SIDE_BY_SIDE; k++) {
      const uint32_t at = i + k < n ? i + k : n - 1;
      row[k] = rows != NULL ? rows[at] : at;
      w[k] = weight + (size_t)row[k] * width;
    }
    sum_along(w, width, inputs, sum);
    for (uint32_t k = 0; k < SIDE_BY_SIDE && i + k < n; k++)
      sums[i + k] = sum[k] + (double)w[k][width - 1] * inputs[width - 1] + (double)bias[row[k]];
  }
}

/* h ← ReLU(LayerNorm(h)); the variance is the biased one, as in PyTorch. Keeps the normalized
 * values and 1/σ. */
static void norm_relu(const float *gain, const float *shift, double *h, double *normal,
                      double *scale)
{
  double mean = 0;
  for (int i = 0; i < MO_HIDDEN; i++)
    mean += h[i];
  mean /= MO_HIDDEN;
  double variance = 0;
  for (int i = 0; i < MO_HIDDEN; i++)
    variance += (h[i] - mean) * (h[i] - mean);
  variance /= MO_HIDDEN;
  *scale = 1.0 / sqrt(variance + MO_LAYERNORM_EPSILON);
  for (int i = 0; i < MO_HIDDEN; i++) {
    normal[i] = (h[i] - mean) * *scale;
    const double y = normal[i] * (double)gain[i] + (double)shift[i];
    h[i] = y < 0 ? 0 : y; /* keeps NaN */
  }
}

void mo_controller_forward(const struct mo_controller *controller, const uint32_t *springs,
                           uint32_t n, struct mo_controller_tape *tape)
{
  const double *in = tape->input;
  uint32_t width = controller->n_inputs;
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    double *h = tape->hidden + (size_t)l * MO_HIDDEN;
    dense(controller->weight[l], controller->bias[l], NULL, MO_HIDDEN, width, in, h);
    norm_relu(controller->norm_gain[l], controller->norm_shift[l], h,
              tape->normal + (size_t)l * MO_HIDDEN, tape->scale + l);
    in = h;
    width = MO_HIDDEN;
  }
  dense(controller->weight[MO_HIDDEN_LAYERS], controller->bias[MO_HIDDEN_LAYERS], springs, n,
        MO_HIDDEN, in, tape->output);
  for (uint32_t i = 0; i < n; i++)
    tape->output[i] = tanh(tape->output[i]);
}
