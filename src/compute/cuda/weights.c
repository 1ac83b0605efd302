/* weights.c: lays out a controller for the device's matrix instructions. */
#include "compute/cuda/weights.h"

#include "compute/cuda/plan.h"

#include <math.h>
#include <string.h>

enum {
  TILE = 16,
  PAIR_HALVES = MO_WEIGHTS_PAIR_BYTES / 2,
  LARGEST_EXPONENT = 12 /* scaled values are below 2^12 */
};

#define HIDDEN_LIMIT   60000.0f /* float16's largest number is 65504 */
#define EXPONENT_LIMIT 50       /* LayerNorm's epsilon, scaled, stays a normal float32 */
#define BIAS_LIMIT     1e15f    /* scaled; its square is summed in float32 */

static uint32_t bits_of(float value)
{
  uint32_t bits;
  memcpy(&bits, &value, sizeof(bits));
  return bits;
}

static float float_of(uint32_t bits)
{
  float value;
  memcpy(&value, &bits, sizeof(value));
  return value;
}

uint16_t mo_weights_half(float value)
{
  const uint32_t bits = bits_of(value), sign = bits >> 16 & 0x8000, magnitude = bits & 0x7fffffff;
  if (magnitude > 0x7f800000) /* not a number */
    return (uint16_t)(sign | 0x7e00);
  if (magnitude >= 0x477ff000) /* 65520 or more */
    return (uint16_t)(sign | 0x7c00);
  if (magnitude < 0x38800000) { /* below 2^-14: adding 1/2 leaves the value, rounded, in units of
                                   2^-24 in the last bits */
    const uint32_t shifted = bits_of(float_of(magnitude) + 0.5f);
    return (uint16_t)(sign | (shifted - 0x3f000000));
  }
  const uint32_t rounded = magnitude + 0xfff + (magnitude >> 13 & 1);
  return (uint16_t)(sign | (rounded - 0x38000000) >> 13);
}

float mo_weights_from_half(uint16_t half)
{
  const uint32_t sign = (uint32_t)(half & 0x8000) << 16, exponent = half >> 10 & 31,
                 mantissa = half & 0x3ff;
  if (exponent == 31)
    return float_of(sign | 0x7f800000 | mantissa << 13);
  const float magnitude = exponent == 0 ? (float)mantissa * 0x1p-24f
                                        : float_of((exponent + 112) << 23 | mantissa << 13);
  return sign != 0 ? -magnitude : magnitude;
}

static size_t place(size_t *used, size_t bytes)
{
  const size_t at = *used;
  *used += (bytes + 255) / 256 * 256;
  return at;
}

struct mo_weights_layout mo_weights_layout(void)
{
  struct mo_weights_layout layout;
  const size_t pair = (size_t)MO_WEIGHTS_UNITS * MO_WEIGHTS_PAIR_BYTES;
  size_t used = 0;
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++)
    layout.hidden[l] = place(&used, MO_HIDDEN / 2 * pair);
  layout.output = place(&used, MO_PLAN_PAIRS * pair);
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    layout.bias[l] = place(&used, MO_HIDDEN * sizeof(float));
    layout.gain[l] = place(&used, MO_HIDDEN * sizeof(float));
    layout.shift[l] = place(&used, MO_HIDDEN * sizeof(float));
  }
  layout.generators = place(&used, (size_t)MO_CPG_INPUTS * MO_HIDDEN * sizeof(float));
  layout.output_bias = place(&used, MO_DEFAULT_SPRINGS * sizeof(float));
  layout.scalars = place(&used, sizeof(struct mo_weights_scalars));
  layout.bytes = used;
  return layout;
}

/* Writes the registers of the outputs with weights row[0] (g) and row[1] (g + 8) for one tile of
 * inputs. */
static void put_tile(const float *const row[2], uint32_t tile, float scale, int low, uint16_t *out)
{
  for (uint32_t t = 0; t < 4; t++)
    for (uint32_t r = 0; r < 2; r++)
      for (uint32_t h = 0; h < 2; h++)
        for (uint32_t e = 0; e < 2; e++) {
          const float value = row[h][tile * TILE + 2 * t + r + 8 * e] * scale;
          const uint16_t high = mo_weights_half(value);
          out[8 * t + 4 * r + 2 * h + e] =
              low ? mo_weights_half(value - mo_weights_from_half(high)) : high;
        }
}

/* Writes a pair of outputs. unit_halves: distance from unit to unit; half_halves: from a unit's
 * first half to its second. */
static void put_pair(const float *const row[2], float scale, uint16_t *out, size_t unit_halves,
                     size_t half_halves)
{
  for (uint32_t u = 0; u < MO_WEIGHTS_UNITS; u++) {
    put_tile(row, u, scale, 0, out + u * unit_halves);
    put_tile(row, u, scale, 1, out + u * unit_halves + half_halves);
  }
}

/* Returns the power of two that scales the largest magnitude into [2^11, 2^12). */
static int scale_exponent(const float *values, size_t n)
{
  float largest = 0;
  for (size_t i = 0; i < n; i++)
    largest = fmaxf(largest, fabsf(values[i]));
  int exponent = 0;
  if (largest > 0)
    frexpf(largest, &exponent);
  const int scale = LARGEST_EXPONENT - exponent;
  return scale > 30 ? 30 : scale; /* enough for a matrix close to zero */
}

static void put_scaled(const float *values, size_t n, float scale, float *out)
{
  for (size_t i = 0; i < n; i++)
    out[i] = values[i] * scale;
}

int mo_weights_pack(const struct mo_controller *controller, void *memory)
{
  if (!mo_workspace_equal(controller->workspace, MO_DEFAULT_WORKSPACE))
    return MO_ERR_UNSUPPORTED;
  /* A normalized value is at most √256. */
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++)
    for (uint32_t o = 0; o < MO_HIDDEN; o++)
      if (!(16.0f * fabsf(controller->norm_gain[l][o]) + fabsf(controller->norm_shift[l][o]) <=
            HIDDEN_LIMIT))
        return MO_ERR_UNSUPPORTED;
  const struct mo_weights_layout layout = mo_weights_layout();
  char *base = memory;
  struct mo_weights_scalars scalars = {.sensor = (uint32_t)controller->sensor};
  int mass_of[MO_PLAN_INPUTS];
  uint16_t slots[MO_DEFAULT_SPRINGS];
  const int status = mo_plan_slots(slots);
  if (status != MO_OK)
    return status;
  memset(memory, 0, layout.bytes);
  for (uint32_t i = 0; i < MO_PLAN_INPUTS; i++)
    mass_of[i] = mo_plan_input_mass(i);

  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    const size_t n_inputs = l == 0 ? controller->n_inputs : MO_HIDDEN;
    const int exponent = scale_exponent(controller->weight[l], MO_HIDDEN * n_inputs);
    const float scale = ldexpf(1.0f, exponent);
    if (exponent < -EXPONENT_LIMIT)
      return MO_ERR_UNSUPPORTED;
    for (uint32_t o = 0; o < MO_HIDDEN; o++)
      if (!(fabsf(controller->bias[l][o] * scale) <= BIAS_LIMIT))
        return MO_ERR_UNSUPPORTED;
    uint16_t *out = (uint16_t *)(void *)(base + layout.hidden[l]);
    for (uint32_t tile = 0; tile < MO_WEIGHTS_UNITS; tile++)
      for (uint32_t g = 0; g < 8; g++) {
        float ordered[2][MO_PLAN_INPUTS];
        const float *rows[2];
        for (uint32_t h = 0; h < 2; h++) {
          const float *row = rows[h] = controller->weight[l] + (tile * TILE + g + 8 * h) * n_inputs;
          for (uint32_t i = 0; l == 0 && i < MO_PLAN_INPUTS; i++)
            ordered[h][i] = mass_of[i] < 0 ? 0.0f : row[mass_of[i]];
          if (l == 0)
            rows[h] = ordered[h];
        }
        put_pair(rows, scale, out + tile * MO_WEIGHTS_UNITS * 8 * PAIR_HALVES + g * PAIR_HALVES / 2,
                 8 * PAIR_HALVES, 4 * PAIR_HALVES);
      }
    for (uint32_t o = 0; l == 0 && o < MO_HIDDEN; o++)
      for (uint32_t i = 0; i < MO_CPG_INPUTS; i++)
        ((float *)(void *)(base + layout.generators))[i * MO_HIDDEN + o] =
            controller->weight[0][o * n_inputs + MO_DEFAULT_MASSES + i] * scale;
    put_scaled(controller->bias[l], MO_HIDDEN, scale, (float *)(void *)(base + layout.bias[l]));
    memcpy(base + layout.gain[l], controller->norm_gain[l], MO_HIDDEN * sizeof(float));
    memcpy(base + layout.shift[l], controller->norm_shift[l], MO_HIDDEN * sizeof(float));
    scalars.epsilon[l] = (float)ldexp(MO_LAYERNORM_EPSILON, 2 * exponent);
  }

  const float *output = controller->weight[MO_HIDDEN_LAYERS];
  const int exponent = scale_exponent(output, (size_t)MO_DEFAULT_SPRINGS * MO_HIDDEN);
  scalars.output = ldexpf(1.0f, -exponent);
  const float *rows[MO_DEFAULT_SPRINGS];
  for (uint32_t s = 0; s < MO_DEFAULT_SPRINGS; s++) {
    rows[slots[s]] = output + (size_t)s * MO_HIDDEN;
    ((float *)(void *)(base + layout.output_bias))[slots[s]] =
        controller->bias[MO_HIDDEN_LAYERS][s];
  }
  for (uint32_t p = 0; p < MO_PLAN_PAIRS; p++)
    put_pair(rows + 2 * (size_t)p, ldexpf(1.0f, exponent),
             (uint16_t *)(void *)(base + layout.output) +
                 (size_t)p * MO_WEIGHTS_UNITS * PAIR_HALVES,
             PAIR_HALVES, PAIR_HALVES / 2);
  memcpy(base + layout.scalars, &scalars, sizeof(scalars));
  return MO_OK;
}
