/* second.h: a second implementation of the rollout, for the tests of the gradient. It shares only
 * bodies, terrains and constants with the library. dual.c is written from docs/model.md with dual
 * numbers, and computes the loss with its derivatives along SECOND_LANES directions, by
 * forward-mode differentiation.
 *
 * Values are computed in the order that the model documents, so that they agree with the reference
 * to rounding or better, also where the motion is chaotic. */
#ifndef MORPHO_TESTS_SECOND_H
#define MORPHO_TESTS_SECOND_H

#include <morpho/rollout.h>

#define SECOND_LANES                                                                               \
  16 /* one per parameter tensor, each perturbed separately; then two directions in all parameters \
      */
#define SECOND_WHOLES 2

struct second_setup {
  const struct mo_body *body;
  const struct mo_environment *environment;
  const struct mo_physics *physics; /* n_steps: the number of steps to run */
  enum mo_sensor sensor;
};

/* (n_parameters) each, in file order. */
struct second_parameters {
  const double *value;
  const double *alone; /* directions of lanes 0 … 13, each in its own tensor's place */
  const double *whole[SECOND_WHOLES]; /* of lanes 14, 15 */
};

struct dual {
  double v;
  double t[SECOND_LANES];
};

/* Computes the losses after each of `at` (n of them, ascending, ≤ n_steps). Returns 0, or −1 if out
 * of memory. */
int dual_rollout(const struct second_setup *setup, const struct second_parameters *parameters,
                 const uint32_t *at, uint32_t n, struct dual *losses);

/* The branches that a contact took. Friction at the impact is capped unless SECOND_BELOW_CAP is
 * set; with `split`, an impact has friction only if SECOND_INTO is set. Bits 4 … 15 hold the cell
 * of the impact, bits 16 … 39 the cell of the end: 4 · its index, + 2 if beyond the map along y, +
 * 1 if along x. */
#define SECOND_CONTACT   UINT64_C(1)
#define SECOND_BELOW_CAP UINT64_C(2)
#define SECOND_INTO      UINT64_C(4)         /* the normal velocity at the impact is negative */
#define SECOND_RAISED    UINT64_C(8)         /* from below the terrain, at the end */
#define SECOND_PRESSED   (UINT64_C(1) << 40) /* split: l < 0, so there is friction over time */
#define SECOND_STOPPED   (UINT64_C(1) << 41) /* split: that friction stops the mass */

/* Computes one mass's motion and contact; returns the branches taken (0 = no contact). v is the
 * velocity after the kick; it becomes the one that the next kick starts from. acceleration: by
 * springs and gravity, without drag; only `split` uses it (`paper`: may be NULL). */
uint64_t dual_move(const struct second_setup *setup, struct dual p[3], struct dual v[3],
                   const struct dual acceleration[3]);

#endif
