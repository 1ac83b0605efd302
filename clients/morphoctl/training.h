/* training.h: how parts of a training's progress are told: templates (table.h) of values below
 * a place, "progress." or the like. */
#ifndef MORPHOCTL_TRAINING_H
#define MORPHOCTL_TRAINING_H

#include "live.h"

#define STEP_WORDS(place) "step {" place "step:,} of {" place "steps:,}"
#define NUMBER_WORDS(place)                                                                        \
  "loss {" place "mean_loss:.4f}  gradient {" place "gradient_norm:.4g}  rate {" place             \
  "rate:.4g}  clipped {" place "clipped_share:.1%}"
#define PACE_WORDS(place)                                                                          \
  "[  {" place "bodies_per_s:.4g} bodies/s][  {" place "seconds_left:duration} left]"
/* "0.2450 ± 0.0110 at step 1,200", with the diverged rollouts if there are any. */
#define VALIDATION_WORDS(place)                                                                    \
  "[[{" place "mean_score:.4f}|–] ± [{" place "standard_error:.4f}|–] at step {" place             \
  "step:,}|–][, {" place "diverged>0} of {" place "rollouts} rollouts diverged]"

extern const struct live_kind training_kind;

#endif
