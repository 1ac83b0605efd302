/* A controller laid out for matrix instructions: decoded as the instructions read it, it equals the
 * original controller. */
#include "../make.h"

#include "compute/cuda/plan.h"
#include "compute/cuda/weights.h"

static struct mo_controller *controller;

static void setup(void)
{
  controller = make_random_controller(MO_SENSOR_INVERSE_SQUARE, 11);
  for (uint32_t o = 0; o < MO_HIDDEN; o++) {
    controller->bias[1][o] = 0.01f * (float)o;
    controller->norm_gain[2][o] = 1.0f + 0.001f * (float)o;
    controller->norm_shift[0][o] = -0.002f * (float)o;
  }
  for (uint32_t s = 0; s < MO_DEFAULT_SPRINGS; s++)
    controller->bias[MO_HIDDEN_LAYERS][s] = (float)s;
}

static void halves(void)
{
  /* All values converted and converted back. */
  for (uint32_t h = 0; h < 0x10000; h++) {
    const float value = mo_weights_from_half((uint16_t)h);
    const uint16_t back = mo_weights_half(value);
    if (value != value)
      CHECK((back & 0x7c00) == 0x7c00 && (back & 0x3ff) != 0);
    else
      CHECK_INT(back, h);
  }
  CHECK_NEAR(mo_weights_from_half(0x3c01), 1.0 + 0x1p-10, 0);
  CHECK_NEAR(mo_weights_from_half(0x8001), -0x1p-24, 0);
  /* Ties round to even; values just next to ties. */
  CHECK_INT(mo_weights_half(1.0f + 0x1p-11f), 0x3c00);
  CHECK_INT(mo_weights_half(1.0f + 0x1.8p-10f), 0x3c02);
  CHECK_INT(mo_weights_half(1.0f + 0x1.002p-11f), 0x3c01);
  CHECK_INT(mo_weights_half(0x1p-25f), 0);
  CHECK_INT(mo_weights_half(0x1.8p-24f), 2);
  CHECK_INT(mo_weights_half(0x1.002p-25f), 1);
  CHECK_INT(mo_weights_half(65519.996f), 0x7bff);
  CHECK_INT(mo_weights_half(65520.0f), 0x7c00);
  CHECK_INT(mo_weights_half(-INFINITY), 0xfc00);
}

/* Returns value `input` of the left operand's row g (h = 0) or g + 8 (h = 1), as lane (g, t) reads
 * it. */
static double decode(const uint16_t *first_unit, size_t unit_halves, size_t half_halves, uint32_t h,
                     uint32_t input)
{
  const uint32_t tile = input / 16, e = input % 16 / 8, t = input % 8 / 2, r = input % 2;
  const uint16_t *place = first_unit + tile * unit_halves + 8 * t + 4 * r + 2 * h + e;
  return (double)mo_weights_from_half(place[0]) + (double)mo_weights_from_half(place[half_halves]);
}

static void values(void)
{
  const struct mo_weights_layout layout = mo_weights_layout();
  char *packed = aligned_alloc(256, (layout.bytes + 255) / 256 * 256);
  uint16_t slots[MO_DEFAULT_SPRINGS];
  REQUIRE(packed != NULL);
  REQUIRE(mo_weights_pack(controller, packed) == MO_OK);
  REQUIRE(mo_plan_slots(slots) == MO_OK);
  const struct mo_weights_scalars *scalars = (const void *)(packed + layout.scalars);
  CHECK_INT(scalars->sensor, MO_SENSOR_INVERSE_SQUARE);
  const double bound = 0x1p-22; /* from rounding the remainder of one float16 to another */
  double worst = 0;
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    const uint16_t *matrix = (const void *)(packed + layout.hidden[l]);
    const float *bias = (const void *)(packed + layout.bias[l]),
                *gain = (const void *)(packed + layout.gain[l]);
    const float *shift = (const void *)(packed + layout.shift[l]);
    const uint32_t n_inputs = l == 0 ? controller->n_inputs : MO_HIDDEN;
    const double scale = sqrt((double)scalars->epsilon[l] / MO_LAYERNORM_EPSILON);
    CHECK_NEAR(scale / exp2(round(log2(scale))), 1.0, 1e-6);
    for (uint32_t o = 0; o < MO_HIDDEN; o++) {
      const uint32_t tile = o / 16, h = o % 16 / 8, g = o % 8;
      CHECK_NEAR(bias[o], scale * controller->bias[l][o], 1e-5 * scale);
      CHECK_NEAR(gain[o], controller->norm_gain[l][o], 0);
      CHECK_NEAR(shift[o], controller->norm_shift[l][o], 0);
      for (uint32_t i = 0; i < MO_HIDDEN; i++) {
        const int column = l == 0 ? mo_plan_input_mass(i) : (int)i;
        const double weight =
            column < 0 ? 0 : controller->weight[l][o * n_inputs + (uint32_t)column];
        const double value =
            decode(matrix + (size_t)tile * MO_WEIGHTS_UNITS * 512 + g * 32, 512, 256, h, i) / scale;
        worst = fmax(worst, fabs(value - weight) - bound * fabs(weight));
      }
    }
    if (l == 0)
      for (uint32_t o = 0; o < MO_HIDDEN; o++)
        for (uint32_t k = 0; k < MO_CPG_INPUTS; k++)
          CHECK_NEAR(((const float *)(const void *)(packed + layout.generators))[k * MO_HIDDEN + o],
                     scale * controller->weight[0][o * n_inputs + MO_DEFAULT_MASSES + k],
                     1e-5 * scale);
  }
  CHECK(worst <= 1e-9);
  const uint16_t *output = (const void *)(packed + layout.output);
  const float *bias = (const void *)(packed + layout.output_bias);
  worst = 0;
  for (uint32_t s = 0; s < MO_DEFAULT_SPRINGS; s++) {
    CHECK_NEAR(bias[slots[s]], controller->bias[MO_HIDDEN_LAYERS][s], 0);
    for (uint32_t i = 0; i < MO_HIDDEN; i++) {
      const double weight = controller->weight[MO_HIDDEN_LAYERS][(size_t)s * MO_HIDDEN + i];
      const double value = decode(output + (size_t)(slots[s] / 2) * MO_WEIGHTS_UNITS * 64, 64, 32,
                                  slots[s] % 2U, i) *
                           scalars->output;
      worst = fmax(worst, fabs(value - weight) - bound * fabs(weight));
    }
  }
  CHECK(worst <= 1e-9);
  free(packed);
}

static void refusals(void)
{
  const struct mo_weights_layout layout = mo_weights_layout();
  char *packed = aligned_alloc(256, (layout.bytes + 255) / 256 * 256);
  REQUIRE(packed != NULL);
  struct mo_controller *other =
      make_controller((struct mo_workspace){3, 3, 3}, MO_SENSOR_INVERSE_SQRT);
  CHECK_INT(mo_weights_pack(other, packed), MO_ERR_UNSUPPORTED);
  const float gain = controller->norm_gain[1][7];
  controller->norm_gain[1][7] = 4000.0f; /* √256 times this exceeds float16 */
  CHECK_INT(mo_weights_pack(controller, packed), MO_ERR_UNSUPPORTED);
  controller->norm_gain[1][7] = -3000.0f;
  CHECK_INT(mo_weights_pack(controller, packed), MO_OK);
  controller->norm_gain[1][7] = gain;
  /* The squares in LayerNorm, and its epsilon next to them, must be float32 numbers. */
  const float bias = controller->bias[1][7], weight = controller->weight[2][9];
  controller->bias[1][7] = 1e20f;
  CHECK_INT(mo_weights_pack(controller, packed), MO_ERR_UNSUPPORTED);
  controller->bias[1][7] = 1e4f;
  CHECK_INT(mo_weights_pack(controller, packed), MO_OK);
  controller->bias[1][7] = bias;
  controller->weight[2][9] = 1e30f;
  CHECK_INT(mo_weights_pack(controller, packed), MO_ERR_UNSUPPORTED);
  controller->weight[2][9] = 1e10f;
  CHECK_INT(mo_weights_pack(controller, packed), MO_OK);
  controller->weight[2][9] = weight;
  free(packed);
}

static const struct check_case cases[] = {
    {"float16", halves}, {"values", values}, {"refusals", refusals}};
CHECK_MAIN_WITH(setup, cases)
