/* gradient_options.h: the options of a gradient as tables of fields. */
#ifndef MORPHO_ROLLOUT_GRADIENT_OPTIONS_H
#define MORPHO_ROLLOUT_GRADIENT_OPTIONS_H

#include <morpho/gradient.h>

#include "base/fields.h"

/* For struct mo_gradient_options as settings, without the weight. */
extern const struct mo_fields mo_gradient_fields;
/* Same, with the weight, to be packed (base/fields.h): float64 bound, weight and weight of
 * restarts, then the rule in 32 bits, until an option is added. */
extern const struct mo_fields mo_gradient_packed_fields;

#endif
