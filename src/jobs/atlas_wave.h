/* atlas_wave.h: the bodies of an atlas that are scored together. Only for the files atlas*.c of
 * this room. */
#ifndef MORPHO_JOBS_ATLAS_WAVE_H
#define MORPHO_JOBS_ATLAS_WAVE_H

#include <morpho/atlas.h>

/* Consecutive bodies, with the designs that are scored for each. */
struct mo_atlas_wave {
  struct mo_atlas_scope scope;
  enum mo_atlas_orientations orientations;
  uint32_t n_environments;
  uint32_t measures, n_measures; /* the measures, as bits, and their number */
  uint32_t most;                 /* designs */
  uint32_t n, n_designs;         /* bodies and their designs */
  struct mo_bits *forms;         /* (most) bodies */
  uint32_t *begins;              /* (most + 1) the first design of each body */
  uint8_t *left;                 /* (most) number of a body's designs that still lack losses */
  struct mo_bits *designs;       /* (most) */
  uint32_t *bodies;              /* (most) the body of each design */
  double *losses;                /* (most, n_environments) */
  double *values;                /* (most, n_environments, n_measures) the measures */
};

/* Allocates a wave with the members up to `most`. MO_ERR_NO_MEMORY. */
int mo_atlas_wave_create(struct mo_atlas_wave *wave);
void mo_atlas_wave_free(struct mo_atlas_wave *wave);
uint64_t mo_atlas_wave_bytes(uint32_t most, uint32_t n_environments, uint32_t n_measures);
/* Stores the measures of a rollout. */
void mo_atlas_wave_measured(struct mo_atlas_wave *wave, uint32_t design, uint32_t environment,
                            const double values[MO_MEASURES]);
/* Fills the wave with the next bodies of a stream; n 0: no body is left. MO_ERR_NO_MEMORY. */
int mo_atlas_wave_fill(struct mo_atlas_wave *wave, struct mo_atlas_bodies *bodies);
/* Computes the losses of body i, once all of its designs have theirs: the means over its designs,
 * added in order. losses: (n_environments). measures: (n_measures) the means over its designs, and
 * then over the environments, added in order; NaN if one of the numbers is NaN. */
void mo_atlas_wave_mean(const struct mo_atlas_wave *wave, uint32_t i, double *losses,
                        double *measures);
/* Counts the designs of the bodies at the positions from `first` to `end`. */
int mo_atlas_count_designs(const struct mo_atlas_scope *scope,
                           enum mo_atlas_orientations orientations, uint64_t first, uint64_t end,
                           uint64_t *n);

#endif
