/* reference_measures.h: the measures of the float64 rollout. */
#ifndef MORPHO_ROLLOUT_REFERENCE_MEASURES_H
#define MORPHO_ROLLOUT_REFERENCE_MEASURES_H

#include "rollout/measuring.h"
#include "rollout/reference.h"

/* All zero: no measures. */
struct mo_reference_measures {
  uint32_t set, wanted;         /* measures that are observed; measures that are written to
                                   `values` */
  double *values;               /* receives the measures of the set; NULL: only the task needs
                                   measures */
  double observed[MO_MEASURES]; /* without rounding */
  struct mo_observer observer;
  double (*rows)[3];    /* (n_masses) mo_measuring_frame */
  uint8_t (*halves)[2]; /* (n_masses) mo_measuring_halves */
  bool *inverted;       /* (n_voxels) at the previous instant */
  bool touches;         /* the terrain, in the previous step */
};

/* from: the state that the reference starts from, or NULL. measuring: NULL or of one rollout. If
 * there is something to observe, the reference adds up the work. MO_ERR_NO_MEMORY; call
 * mo_reference_measures_done in any case. */
int mo_reference_measures_init(struct mo_reference_measures *measures,
                               struct mo_reference *reference, const struct mo_state *from,
                               const struct mo_measuring *measuring);
/* Adds what was observed to the tally of a state. */
void mo_reference_measures_save(const struct mo_reference_measures *measures, unsigned observed,
                                struct mo_state *to);
void mo_reference_measures_done(struct mo_reference_measures *measures);

/* Observes step number `step`, from 0, which the reference has just run. */
void mo_reference_observe(struct mo_reference_measures *measures,
                          const struct mo_reference *reference, uint32_t step);

/* Writes the measures that are requested. Returns all of them without rounding, valid as long as
 * `measures`; NULL: nothing was observed. */
const double *mo_reference_measures_finish(struct mo_reference_measures *measures,
                                           const struct mo_reference *reference,
                                           const struct mo_outcome *outcome);

#endif
