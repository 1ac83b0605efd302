/* lane-cases.h: checks of environments that share a block: outcomes and gradients of the kernels
 * compared with the reference, and with those of each lane by itself. */
#ifndef MORPHO_TESTS_LANE_CASES_H
#define MORPHO_TESTS_LANE_CASES_H

#include "../make.h"

#define LANES MO_BLOCK_LANES

/* Rolls out environment lanes[l] in lane l. */
static inline void block_of(const struct mo_pack *pack, const struct mo_body *body,
                            const struct mo_environment *environments, const uint32_t *lanes,
                            uint32_t n, const struct mo_physics *physics,
                            struct mo_outcome *outcomes)
{
  const struct mo_environment *list[LANES];
  for (uint32_t l = 0; l < n; l++)
    list[l] = environments + lanes[l];
  make_check(mo_rollout_block(make_workspace_memory(), pack, body, list, n, physics, NULL, NULL,
                              NULL, outcomes),
             "block");
}

static inline double apart(const struct mo_outcome *a, const struct mo_outcome *b)
{
  double most = fabs(a->loss - b->loss);
  for (int axis = 0; axis < 3; axis++)
    most = fmax(most, fabs(a->com_end_m[axis] - b->com_end_m[axis]));
  return most;
}

/* Rolls every environment out by the reference, with four settings of physics: robot k's body with
 * setting k. */
static inline void
reference_lives(const struct mo_controller *controller, const struct mo_robot *robots,
                const struct mo_environment *environments,
                struct mo_physics (*physics_of_variant)(uint32_t variant, uint32_t n_steps),
                uint32_t n_steps, struct mo_outcome outcomes[4][LANES])
{
  for (uint32_t variant = 0; variant < 4; variant++) {
    const struct mo_physics physics = physics_of_variant(variant, n_steps);
    for (uint32_t k = 0; k < LANES; k++)
      make_check(mo_rollout_reference(robots[variant].body, controller, &environments[k], &physics,
                                      NULL, NULL, &outcomes[variant][k]),
                 "reference");
  }
}

/* Rolls every environment out in every kernel, with four settings of physics: close to the
 * reference, and with the bits of each lane by itself, wherever in the block it is. */
static inline void
follow_lives(const struct mo_controller *controller, const struct mo_robot *robots,
             const struct mo_environment environments[LANES],
             struct mo_physics (*physics_of_variant)(uint32_t variant, uint32_t n_steps),
             uint32_t n_steps)
{
  static const uint32_t alone[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  struct mo_outcome exact[4][LANES];
  reference_lives(controller, robots, environments, physics_of_variant, n_steps, exact);
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      const size_t kept = check_n_kept;
      const struct mo_pack *pack =
          make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
      double worst = 0;
      for (uint32_t variant = 0; variant < 4; variant++) {
        const struct mo_body *body = robots[variant].body;
        const struct mo_physics physics = physics_of_variant(variant, n_steps);
        struct mo_outcome outcomes[LANES], turned[LANES], one;
        uint32_t lanes[LANES];
        for (uint32_t l = 0; l < LANES; l++)
          lanes[l] = (5 * l + 3) % LANES;
        block_of(pack, body, environments, alone, LANES, &physics, outcomes);
        block_of(pack, body, environments, lanes, LANES, &physics, turned);
        for (uint32_t k = 0; k < LANES; k++) {
          block_of(pack, body, environments, alone + k, 1, &physics, &one);
          CHECK(SAME(&one, &outcomes[k], 1));
          CHECK(SAME(&turned[k], &outcomes[lanes[k]], 1));
          CHECK(isfinite(apart(&exact[variant][k], &one))); /* fmax ignores NaN */
          worst = fmax(worst, apart(&exact[variant][k], &one));
        }
      }
      printf("# %s, %s: within %.1e of the reference\n", mo_isa_name((enum mo_isa)isa),
             precision == MO_FLOAT32 ? "float32" : "float64", worst);
      CHECK(worst <= (precision == MO_FLOAT32 ? 1e-4 : 1e-10));
      check_drop_to(kept);
    }
}

/* Both integrators, both ways to find an impact, held outputs. */
static inline struct mo_physics ground_physics(uint32_t k, uint32_t n_steps)
{
  struct mo_physics physics = physics_of(n_steps);
  physics.scheme.integrator = k % 2 == 0 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
  physics.scheme.impact = k % 3 == 2 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
  physics.scheme.control_period_s = k % 4 == 3 ? 4 * physics.scheme.dt_s : 0;
  return physics;
}

/* Bodies that blow up on grounds of set_ground, with every fourth as usual: their places are soon
 * infinite or undefined, and no other lane notices. */
static inline void follow_divergence(const struct mo_controller *controller,
                                     const struct mo_lattice *lattice,
                                     void (*set_ground)(struct mo_environment *environment,
                                                        uint64_t k, double sigma_m))
{
  struct mo_physics physics = physics_of(400);
  struct mo_environment environments[LANES];
  const struct mo_body *body = make_full_body(lattice);
  uint32_t lanes[LANES];
  physics.constants.stiffness_n_per_m = 21000;
  for (uint32_t l = 0; l < LANES; l++) {
    lanes[l] = l;
    mo_environment_training(34, 0, l, &environments[l]);
    if (l % 4 != 3)
      set_ground(&environments[l], l, 0.03);
  }
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      const struct mo_pack *pack =
          make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
      struct mo_outcome outcomes[LANES], one;
      uint32_t diverged = 0;
      block_of(pack, body, environments, lanes, LANES, &physics, outcomes);
      for (uint32_t l = 0; l < LANES; l++) {
        diverged += outcomes[l].diverged_step > 0;
        CHECK(isfinite(outcomes[l].com_end_m[0]) && isfinite(outcomes[l].com_end_m[2]));
        block_of(pack, body, environments, lanes + l, 1, &physics, &one);
        CHECK(SAME(&one, &outcomes[l], 1));
      }
      printf("# %s, %s: %u of %d diverged\n", mo_isa_name((enum mo_isa)isa),
             precision == MO_FLOAT32 ? "float32" : "float64", diverged, LANES);
      CHECK(diverged > 0);
    }
}

/* Checks the gradients of LANES robots on every instruction set, with four settings of physics: at
 * most `most` from the reference, twice that where impacts are bisected. */
static inline void
follow_gradients(const struct mo_controller *controller, const struct mo_robot own[LANES],
                 struct mo_physics (*physics_of_variant)(uint32_t variant, uint32_t n_steps),
                 double most)
{
  const struct mo_gradient_options options = {.weight = 1};
  const size_t n = controller->n_parameters;
  double *exact = make_zeros(LANES * n, sizeof(double));
  float *fast = make_zeros(n, sizeof(float));
  struct mo_outcome expected[LANES];
  for (uint32_t variant = 0; variant < 4; variant++) {
    const struct mo_physics physics = physics_of_variant(variant, 24);
    memset(exact, 0, LANES * n * sizeof(double));
    for (uint32_t k = 0; k < LANES; k++)
      REQUIRE_OK(mo_gradient_reference(own[k].body, controller, own[k].environment, &physics,
                                       &options, &expected[k], exact + k * n, NULL));
    for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
      const size_t kept = check_n_kept;
      const struct mo_pack *pack = make_gradient_pack(controller, (enum mo_isa)isa);
      struct mo_gradient_memory *memory = make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES);
      struct mo_outcome outcomes[LANES], one;
      double worst = 0;
      REQUIRE_OK(mo_gradient_block(memory, pack, own, LANES, &physics, &options, NULL, outcomes,
                                   fast, NULL));
      for (uint32_t k = 0; k < LANES; k++) {
        const double *true_one = exact + k * n;
        double error = 0, size = 0;
        REQUIRE_OK(mo_gradient_block(memory, pack, &own[k], 1, &physics, &options, NULL, &one, fast,
                                     NULL));
        for (size_t i = 0; i < n; i++) {
          error += (fast[i] - true_one[i]) * (fast[i] - true_one[i]);
          size += true_one[i] * true_one[i];
        }
        CHECK(SAME(&one, &outcomes[k], 1));
        CHECK_NEAR(one.loss, expected[k].loss, 2e-4);
        worst = fmax(worst, sqrt(error / size));
      }
      printf("# %s, variant %u: worst relative error of a gradient %.1e\n",
             mo_isa_name((enum mo_isa)isa), variant, worst);
      CHECK(worst <= (physics.scheme.impact == MO_IMPACT_EXACT ? most : 2 * most));
      check_drop_to(kept);
    }
  }
}

#endif
