/* re_evaluation.h: scores of a campaign's best designs in fresh worlds, which do not affect
 * selection: when they are computed, and their results. */
#ifndef MORPHO_STORE_RE_EVALUATION_H
#define MORPHO_STORE_RE_EVALUATION_H

#include <stdint.h>

#include <morpho/certificate.h>

#include "base/fields.h"

/* Every `every` generations, in the last generation, and in one that is short of children, the
 * elite is scored in `environments` fresh worlds, which differ between these generations; for a set
 * of the suite, they are the first of its held-out worlds. The elite: the best `designs` of the
 * population, and its champions. */
struct mo_re_evaluation {
  uint32_t every;        /* 0: never; at most MO_GENERATIONS_MAX */
  uint32_t environments; /* 2 … MO_CERTIFICATE_HELD_OUT_MAX; 64 */
  uint32_t designs;      /* 1 … MO_ELITE_BEST_MAX; 10 */
};
#define MO_ELITE_BEST_MAX 100
/* Number of designs in lists of champions, unless the request specifies it. */
#define MO_CHAMPIONS_USUAL 12
#define MO_ELITE_MAX       (MO_ELITE_BEST_MAX + MO_CHAMPIONS_USUAL)
/* An object; null: never. */
extern const struct mo_fields mo_re_evaluation_fields;
extern const struct mo_field_own mo_re_evaluation_field;
struct mo_re_evaluation mo_re_evaluation_defaults(void);

/* The result of a design. */
struct mo_re_evaluated {
  uint32_t number;
  uint32_t generation; /* that was re-evaluated, with its controller */
  uint32_t worlds;     /* 0: there is no result */
  uint32_t diverged;   /* rollouts; with select_by, also those without a value of the measure */
  /* Of the numbers whose mean over the campaign's environments is the score: the losses or, with
   * select_by, the measure. (For another aggregate, the score is not their mean.) NaN: diverged. */
  double mean, standard_error;
};
/* Returns the 95 % interval of the mean over all worlds of this kind, by Student's t. NaN, NaN: it
 * has none. */
struct mo_interval mo_held_out_interval(const struct mo_re_evaluated *held_out);

/* A summary of the results of a generation. */
struct mo_held_out_summary {
  uint32_t designs, worlds; /* 0: the generation was not re-evaluated */
  uint64_t rollouts, diverged;
  struct mo_re_evaluated champion;      /* of the design with the best score */
  struct mo_interval champion_interval; /* NaN, NaN: it has none */
  /* Means over the best `designs` that have both: their held-out means, and their scores. NaN:
   * none. */
  double top_mean, top_score;
};
/* scores: (n_best) of the population, best first; numbers: (n_best) of the same designs. rows: (n)
 * in any order. */
struct mo_held_out_summary mo_held_out_summary(const struct mo_re_evaluation *settings,
                                               const struct mo_re_evaluated *rows, uint32_t n,
                                               const uint32_t *numbers, const double *scores,
                                               uint32_t n_best);

#endif
