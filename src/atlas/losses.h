/* losses.h: losses in 16 bits, for single environments: IEEE 754 binary16, rounded to the nearest.
 *
 * Relative error at most 2⁻¹¹ at 6.1e−5 and above; absolute error at most 3e−8 below. Finite losses
 * beyond ±65504 are stored as ±65504, the largest. Infinity, the loss of a rollout that diverged,
 * is exact. */
#ifndef MORPHO_ATLAS_LOSSES_H
#define MORPHO_ATLAS_LOSSES_H

#include <stdbool.h>
#include <stdint.h>

uint16_t mo_atlas_pack_loss(double loss); /* not NaN */
float mo_atlas_unpack_loss(uint16_t packed);
bool mo_atlas_loss_is_nan(uint16_t packed);

#endif
