/* measure.h: numbers that describe a rollout, in addition to its loss: how far and how straight the
 * body went, how it touched the ground, what its springs did. docs/model.md defines each of them.
 *
 * An instant is the start of a control period, or the end of the rollout. */
#ifndef MORPHO_MEASURE_H
#define MORPHO_MEASURE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* In a fixed order: new measures are appended, and none is ever removed. */
enum mo_measure {
  MO_MEASURE_DISPLACEMENT = 0,
  MO_MEASURE_PATH_LENGTH,
  MO_MEASURE_MEAN_SPEED,
  MO_MEASURE_STRAIGHTNESS,
  MO_MEASURE_HEADING_ERROR,
  MO_MEASURE_SIDEWAYS,
  MO_MEASURE_PEAK_HEIGHT,
  MO_MEASURE_MEAN_HEIGHT,
  MO_MEASURE_TILT,
  MO_MEASURE_YAW_RATE,
  MO_MEASURE_AIR_SHARE,
  MO_MEASURE_CONTACT_FRONT,
  MO_MEASURE_CONTACT_BACK,
  MO_MEASURE_CONTACT_LEFT,
  MO_MEASURE_CONTACT_RIGHT,
  MO_MEASURE_HOPS,
  MO_MEASURE_WORK,
  MO_MEASURE_COST_OF_TRANSPORT,
  MO_MEASURE_PEAK_STRAIN,
  MO_MEASURE_INVERTED_VOXELS,
  MO_MEASURES
};
#define MO_MEASURES_ALL ((UINT32_C(1) << MO_MEASURES) - 1)

struct mo_measure_info {
  const char *name;    /* with its unit, as in requests and replies: "displacement_m" */
  const char *unit;    /* "m"; "" for a number without a unit */
  const char *help;    /* one line */
  double steps_in_one; /* values are rounded to whole multiples of 1 / steps_in_one */
};
extern const struct mo_measure_info mo_measure_info[MO_MEASURES];

/* Which measures a rollout computes, and where they go. Without this struct, or with an empty set,
 * rollouts spend no time on measures. Measures change no other result. */
struct mo_measuring {
  uint32_t set;                  /* bit k: measure k is requested */
  double (*values)[MO_MEASURES]; /* (rollouts) NaN: not requested, without a value, or the rollout
                                    diverged. The caller owns it */
};

/* Signs that a rollout scored well by doing what real bodies cannot do. */
enum mo_measure_flag {
  MO_FLAG_OVERSTRAINED = 1, /* peak_strain is above MO_PEAK_STRAIN_BOUND */
  MO_FLAG_INVERTED = 2      /* a voxel was inside out for a control period or longer */
};
#define MO_PEAK_STRAIN_BOUND 2.0 /* three times as long; 1000 ordinary rollouts stay below 1 */
/* Returns the flags, as bits, of a rollout's measures; a measure without a value sets no flag. */
uint32_t mo_measures_flags(const double measures[MO_MEASURES]);

#ifdef __cplusplus
}
#endif
#endif
