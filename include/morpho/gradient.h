/* gradient.h: the gradient of a rollout's loss with respect to every parameter of its controller,
 * by backpropagation through all steps (docs/numerics.md derives it). Two implementations of the
 * same mathematics:
 *   mo_gradient_reference  float64, plain C, one rollout: the reference
 *   mo_gradient_block      float32 vectors over up to MO_GRADIENT_ROBOTS different robots, each
 *                          in its own environment, compiled for several instruction sets
 *
 * A rollout is a long chain of contacts, along which the adjoint (∂loss/∂state) can grow
 * exponentially. A bound limits it. At every backward step, the adjoint of all masses' positions
 * and velocities gives
 *   m = d0 · max(‖∂loss/∂x‖₂, 15 s⁻¹ · ‖∂loss/∂v‖₂)
 * which is compared with the bound. m has no unit; d0 = distance in x, y to the light at the start
 * + 1e-8 m, or, if the objective's value is in meters, the unit in its loss: 1 m or 0.1 m; 1 m for
 * `efficient` and for sums. If m > bound,
 *   MO_ADJOINT_CLIP     scales both by bound/m
 *   MO_ADJOINT_RESTART  resets both, as if the rollout ended there: ∂/∂v = 0, and ∂/∂x is
 *                       restart_weight times that of the distance to the light, over d0, at the
 *                       center of mass one step earlier; for objectives in meters, that of the
 *                       loss (docs/model.md)
 * A restart drops the effect of the state on later time. It keeps the effect of the parameters that
 * the backward pass has accumulated so far. With a weight of 0 the backward pass ends there. */
#ifndef MORPHO_GRADIENT_H
#define MORPHO_GRADIENT_H

#include <stddef.h>
#include <stdint.h>

#include <morpho/controller.h>
#include <morpho/morphospace.h>
#include <morpho/rollout.h>
#include <morpho/world.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_ADJOINT_BOUND      2.0
#define MO_ADJOINT_BOUND_MAX  1e6 /* of settings */
#define MO_ADJOINT_RATE_PER_S 15.0
#define MO_RESTART_WEIGHT     3.0 /* docs/learning.md: the best value measured */
#define MO_RESTART_WEIGHT_MAX 1e6

/* Stored by these numbers. */
enum mo_adjoint_rule { MO_ADJOINT_CLIP = 0, MO_ADJOINT_RESTART = 1 };
extern const char *const mo_adjoint_words[]; /* "clip", "restart", NULL */

struct mo_gradient_options {
  double adjoint_bound; /* ≥ 0; 0 = off */
  double weight; /* finite; factor of this rollout's gradient in the sum: 1/B for the mean over a
                    batch of B */
  enum mo_adjoint_rule adjoint_rule;
  double restart_weight; /* 0 … MO_RESTART_WEIGHT_MAX; used only by MO_ADJOINT_RESTART */
};
/* MO_ADJOINT_BOUND, 1, MO_ADJOINT_CLIP, MO_RESTART_WEIGHT. */
struct mo_gradient_options mo_default_gradient_options(void);
/* MO_ERR_INVALID: not finite, or an unknown rule; MO_ERR_RANGE: a bound below 0, a weight outside
 * its range. */
int mo_gradient_options_check(const struct mo_gradient_options *options);

/* Counts that calls add to; start from {0}. */
struct mo_gradient_counts {
  uint64_t robots;          /* calls that returned MO_OK */
  uint64_t steps;           /* backward steps, over all robots */
  uint64_t clipped_steps;   /* backward steps where m was above the bound */
  uint64_t clipped_robots;  /* robots with at least one such step */
  uint64_t zeroed_robots;   /* contributed nothing: an adjoint, or the gradient of a parameter, was
                               not finite */
  uint64_t diverged_robots; /* contributed nothing: the rollout itself diverged */
  double largest;           /* largest finite m, measured before clipping */
};
void mo_gradient_counts_add(struct mo_gradient_counts *sum,
                            const struct mo_gradient_counts *counts);

/* Computes the gradient of one rollout. Runs the rollout exactly as mo_rollout_reference does (with
 * the same outcome, bit for bit) and adds weight · ∂loss/∂parameters to d_parameters
 * (controller->n_parameters, in file order; the float32 parameters count as real numbers). Springs
 * and masses that the body lacks get a gradient of 0. A robot whose rollout diverged, or whose
 * gradient is not finite, does not change d_parameters. With MO_IMPACT_EXACT the time of impact is
 * differentiated too; with MO_IMPACT_BISECTION it counts as a constant. Where the loss has a kink,
 * one of the two one-sided derivatives is used (docs/numerics.md).
 *
 * physics must have passed mo_physics_check. d_parameters and outcome belong to the caller; counts
 * nullable. Everything else is borrowed for the call. Memory, freed on return: n_parameters doubles
 * and about sqrt(n_steps) steps: 7.5 MB for the full default workspace and 1000 steps. Costs about
 * three rollouts.
 *
 * MO_ERR_INVALID: no controller, a controller of a different workspace, an option that is not
 * finite, or an unknown rule; MO_ERR_RANGE: a bound below 0, a weight outside its range;
 * MO_ERR_UNSUPPORTED: a task without a gradient (mo_task_check_gradient); MO_ERR_NO_MEMORY. On
 * error nothing is written. */
int mo_gradient_reference(const struct mo_body *body, const struct mo_controller *controller,
                          const struct mo_environment *environment,
                          const struct mo_physics *physics,
                          const struct mo_gradient_options *options, struct mo_outcome *outcome,
                          double *d_parameters, struct mo_gradient_counts *counts);

/* ---- the fast path ---- */

#define MO_GRADIENT_ROBOTS        32                  /* largest number of robots in a block */
#define MO_GRADIENT_DEFAULT_BYTES ((size_t)384 << 20) /* budget of one worker's scratch */
#define MO_GRADIENT_PERIOD_MAX                                                                     \
  256 /* steps of a control period: a tape has at least four periods,                              \
         which must fit the budget */

/* One robot of a batch; its pointers are borrowed. */
struct mo_robot {
  const struct mo_body *body;
  const struct mo_environment *environment;
  const uint64_t *genotype; /* placed, of the body; NULL: remote takers cannot compute it */
};

/* Same as mo_pack_create with MO_FLOAT32, for rollouts and gradients. */
int mo_pack_create_for_gradients(const struct mo_controller *controller, enum mo_isa isa,
                                 struct mo_pack **pack);
/* Copies new parameters, of the same workspace and sensor, into the pack for the next learning
 * step. MO_ERR_UNSUPPORTED: a different workspace or sensor. */
int mo_pack_update(struct mo_pack *pack, const struct mo_controller *controller);

/* Scratch of one worker: grows to the size that its blocks need. The tape of a block (the data of
 * every step that the backward pass needs) is kept in full if it fits `budget_bytes`. Otherwise the
 * rollout is cut into segments: only their starts are kept, and the backward pass reruns each
 * segment. The budget changes no bit of a result. If it is too small for the shortest segments, it
 * is exceeded. */
struct mo_gradient_memory;
int mo_gradient_memory_create(size_t budget_bytes, struct mo_gradient_memory **memory);
void mo_gradient_memory_free(struct mo_gradient_memory *memory); /* NULL-safe */
size_t mo_gradient_memory_bytes(const struct mo_gradient_memory *memory);

/* Orders the n robots so that each run of MO_GRADIENT_ROBOTS fits together (bodies that overlap
 * share work). Depends only on the bodies. order: (n). MO_ERR_NO_MEMORY. */
int mo_gradient_arrange(const struct mo_robot *robots, size_t n, uint32_t *order);

/* Rolls out n robots (1 … MO_GRADIENT_ROBOTS) and WRITES to d_parameters (n_parameters, file order)
 * the sum of their ∂loss/∂parameters · options->weight. As in mo_gradient_reference, robots that
 * diverged or whose adjoint is not finite contribute nothing and are counted.
 *
 * float32 overflows before float64, so two rare cases zero robots that the reference would include.
 * An adjoint that leaves float32's range within a step is infinite, and its robot is left out. And
 * if every adjoint is finite but the sum over the block is not, the robots whose own gradient is
 * not below 1/64 of float32's largest number are left out, or, if there are none, all robots: the
 * block's gradient is then 0. The rest is exactly the sum of the other robots (docs/numerics.md,
 * Range).
 *
 * The result depends only on the inputs (robots, in this order) and the instruction set. outcomes:
 * (n). pause, counts nullable (counts are added to). MO_ERR_UNSUPPORTED as above, MO_ERR_INVALID (a
 * body of a different workspace, invalid options, an invalid control period or one of more than
 * MO_GRADIENT_PERIOD_MAX steps), MO_ERR_NO_MEMORY, MO_ERR_CANCELLED (by the pause point). */
int mo_gradient_block(struct mo_gradient_memory *memory, const struct mo_pack *pack,
                      const struct mo_robot *robots, uint32_t n, const struct mo_physics *physics,
                      const struct mo_gradient_options *options, const struct mo_pause_point *pause,
                      struct mo_outcome *outcomes, float *d_parameters,
                      struct mo_gradient_counts *counts);

#ifdef __cplusplus
}
#endif
#endif
