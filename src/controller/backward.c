/* backward.c: the derivative of forward.c, in float64. Each function quotes the forward lines that
 * it differentiates; dx is ∂loss/∂x, and contributions are added, never assigned. */
#include "controller/tape.h"

size_t mo_controller_tape_doubles(const struct mo_controller *controller, uint32_t n)
{
  return controller->n_inputs + (size_t)MO_HIDDEN_LAYERS * (4 * (size_t)MO_HIDDEN + 1) +
         2 * (size_t)n;
}

struct mo_controller_tape mo_controller_tape_place(const struct mo_controller *controller,
                                                   uint32_t n, double *memory)
{
  const size_t layers = (size_t)MO_HIDDEN_LAYERS * MO_HIDDEN;
  struct mo_controller_tape tape;
  tape.input = memory;
  tape.normal = tape.input + controller->n_inputs;
  tape.hidden = tape.normal + layers;
  tape.d_dense = tape.hidden + layers;
  tape.d_shifted = tape.d_dense + layers;
  tape.scale = tape.d_shifted + layers;
  tape.output = tape.scale + MO_HIDDEN_LAYERS;
  tape.d_last = tape.output + n;
  return tape;
}

/* sums[i] = bias + row · inputs */
static void dense_adjoint(const float *weight, const uint32_t *rows, uint32_t n, uint32_t width,
                          const double *d_sums, double *d_inputs)
{
  for (uint32_t i = 0; i < n; i++) {
    const float *w = weight + (size_t)(rows != NULL ? rows[i] : i) * width;
    const double d = d_sums[i];
    if (d == 0)
      continue;
    for (uint32_t j = 0; j < width; j++)
      d_inputs[j] += d * (double)w[j];
  }
}

/* normal[i] = (h[i] − mean) · scale, y = normal[i] · gain[i] + shift[i], h[i] ← y < 0 ? 0 : y The
 * derivative of the ReLU at 0 is taken to be 0. */
static void norm_relu_adjoint(const float *gain, const double *normal, double scale,
                              const double *hidden, const double *d_hidden, double *d_shifted,
                              double *d_dense)
{
  double mean = 0, mean_along = 0; /* means of d_normal, and of d_normal · normal */
  for (int i = 0; i < MO_HIDDEN; i++) {
    d_shifted[i] = hidden[i] > 0 ? d_hidden[i] : 0;
    const double d_normal = d_shifted[i] * (double)gain[i];
    mean += d_normal;
    mean_along += d_normal * normal[i];
  }
  mean /= MO_HIDDEN;
  mean_along /= MO_HIDDEN;
  for (int i = 0; i < MO_HIDDEN; i++)
    d_dense[i] = scale * (d_shifted[i] * (double)gain[i] - mean - normal[i] * mean_along);
}

void mo_controller_backward(const struct mo_controller *controller, const uint32_t *springs,
                            uint32_t n, const double *d_outputs, struct mo_controller_tape *tape,
                            double *d_inputs)
{
  /* outputs[i] = tanh(outputs[i]) */
  for (uint32_t i = 0; i < n; i++)
    tape->d_last[i] = d_outputs[i] * (1.0 - tape->output[i] * tape->output[i]);
  double d_hidden[MO_HIDDEN] = {0};
  dense_adjoint(controller->weight[MO_HIDDEN_LAYERS], springs, n, MO_HIDDEN, tape->d_last,
                d_hidden);
  for (int l = MO_HIDDEN_LAYERS - 1; l >= 0; l--) {
    const size_t at = (size_t)l * MO_HIDDEN;
    double *d_dense = tape->d_dense + at;
    norm_relu_adjoint(controller->norm_gain[l], tape->normal + at, tape->scale[l],
                      tape->hidden + at, d_hidden, tape->d_shifted + at, d_dense);
    if (l == 0) {
      dense_adjoint(controller->weight[0], NULL, MO_HIDDEN, controller->n_inputs, d_dense,
                    d_inputs);
    } else {
      for (int i = 0; i < MO_HIDDEN; i++)
        d_hidden[i] = 0;
      dense_adjoint(controller->weight[l], NULL, MO_HIDDEN, MO_HIDDEN, d_dense, d_hidden);
    }
  }
}

/* sums[i] = bias + row · inputs, for row `row` of a matrix: both gradients, summed over the tapes.
 */
static void row_adjoint(double *d_weight, double *d_bias, uint32_t width, double d_sum,
                        const double *inputs)
{
  if (d_sum == 0)
    return;
  *d_bias += d_sum;
  for (uint32_t j = 0; j < width; j++)
    d_weight[j] += d_sum * inputs[j];
}

void mo_controller_accumulate(const struct mo_controller *controller, const uint32_t *springs,
                              uint32_t n, const struct mo_controller_tape *tapes, uint32_t n_tapes,
                              double *d_parameters)
{
  const float *base = controller->parameters;
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    const uint32_t width = l == 0 ? controller->n_inputs : MO_HIDDEN;
    double *d_weight = d_parameters + (controller->weight[l] - base);
    double *d_bias = d_parameters + (controller->bias[l] - base);
    double *d_gain = d_parameters + (controller->norm_gain[l] - base);
    double *d_shift = d_parameters + (controller->norm_shift[l] - base);
    for (size_t i = 0; i < MO_HIDDEN; i++) {
      const size_t at = (size_t)l * MO_HIDDEN + i;
      for (uint32_t t = 0; t < n_tapes; t++) {
        const double *inputs =
            l == 0 ? tapes[t].input : tapes[t].hidden + (size_t)(l - 1) * MO_HIDDEN;
        row_adjoint(d_weight + i * width, d_bias + i, width, tapes[t].d_dense[at], inputs);
        /* y = normal[i] · gain[i] + shift[i] */
        d_gain[i] += tapes[t].d_shifted[at] * tapes[t].normal[at];
        d_shift[i] += tapes[t].d_shifted[at];
      }
    }
  }
  double *d_weight = d_parameters + (controller->weight[MO_HIDDEN_LAYERS] - base);
  double *d_bias = d_parameters + (controller->bias[MO_HIDDEN_LAYERS] - base);
  for (uint32_t i = 0; i < n; i++) {
    const size_t row = springs != NULL ? springs[i] : i;
    for (uint32_t t = 0; t < n_tapes; t++)
      row_adjoint(d_weight + row * MO_HIDDEN, d_bias + row, MO_HIDDEN, tapes[t].d_last[i],
                  tapes[t].hidden + (size_t)(MO_HIDDEN_LAYERS - 1) * MO_HIDDEN);
  }
}
