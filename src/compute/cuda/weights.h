/* weights.h: a controller laid out for the device's matrix instructions. Plain C, no CUDA.
 *
 * Products are transposed: weights are the left operand (16 outputs × 16 inputs), activations the
 * right one (16 inputs × 8 rows), as in mma.m16n8k16. A lane of a warp (g = lane / 4, t = lane % 4)
 * holds rows g and g + 8 of the left operand, inputs 2t, 2t + 1, 2t + 8, 2t + 9, two per register.
 * The order of the inputs is arbitrary as long as both operands use the same: here input 2t + 8r +
 * e of a tile of 16 is the tile's value number g + 8e, g = 2t + r. So the lane that computed
 * outputs g and g + 8 of a layer has a complete register of the next layer's right operand.
 *
 * A lane's four registers of one tile of inputs, (g, r0), (g + 8, r0), (g, r1), (g + 8, r1), are 16
 * bytes: one load. Two of them are a *unit*: the values of one tile of inputs, then the remainders
 * of rounding them to float16.
 *
 * Each matrix is scaled by a power of two, so that its largest value is in [2^11, 2^12): the
 * remainders of rounding are then not subnormal in float16. A hidden layer's bias is scaled by the
 * same factor, and LayerNorm's epsilon by its square, so that the scale cancels. The last layer's
 * sums are scaled back.
 *
 * A hidden layer's matrix is (16 tiles of outputs, units, 2 halves of a unit, 8 g, 4 t) times 16
 * bytes; the last one's (824 pairs of springs, units, 2, 4 t): a pair's springs (plan.h) are
 * outputs g and g + 8. */
#ifndef MORPHO_COMPUTE_CUDA_WEIGHTS_H
#define MORPHO_COMPUTE_CUDA_WEIGHTS_H

#include <stddef.h>
#include <stdint.h>

#include <morpho/controller.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_WEIGHTS_LOAD_BYTES 16
#define MO_WEIGHTS_PAIR_BYTES 128 /* of one unit of one pair of outputs */
/* Tiles of 16 values: the outputs of a hidden layer, or inputs, with a unit for each tile. */
#define MO_WEIGHTS_UNITS 16

/* Offsets in bytes from the start, each a multiple of 256. */
struct mo_weights_layout {
  size_t hidden[MO_HIDDEN_LAYERS]; /* matrices; the first layer's inputs are in the order of
                                      mo_plan_input_mass */
  size_t output;                   /* matrix */
  size_t bias[MO_HIDDEN_LAYERS];   /* float (256), scaled */
  size_t generators; /* float (5, 256), scaled: the first layer's columns of the generators */
  size_t gain[MO_HIDDEN_LAYERS];  /* float (256) */
  size_t shift[MO_HIDDEN_LAYERS]; /* float (256) */
  size_t output_bias;             /* float (1648) by slot */
  size_t scalars;                 /* struct mo_weights_scalars */
  size_t bytes;
};

struct mo_weights_scalars {
  float epsilon[MO_HIDDEN_LAYERS]; /* LayerNorm's, scaled */
  float output;                    /* factor that undoes the last layer's scale */
  uint32_t sensor;                 /* enum mo_sensor */
};

struct mo_weights_layout mo_weights_layout(void);

/* Writes the layout, 16-byte aligned. MO_ERR_UNSUPPORTED: a workspace other than the default;
 * LayerNorm gains and shifts so large that hidden values might exceed float16's range; hidden
 * weights or biases so large that LayerNorm's sums or epsilon might exceed float32's.
 * MO_ERR_NO_MEMORY. */
int mo_weights_pack(const struct mo_controller *controller, void *memory);

/* Convert float32 to float16 and back, rounding to nearest, ties to even; infinity above 65504. */
uint16_t mo_weights_half(float value);
float mo_weights_from_half(uint16_t half);

#ifdef __cplusplus
}
#endif
#endif
