/* gradient-physics.c: the float32 physics of the fast gradient, function by function, compared with
 * the float64 reference: the start, the bound of the adjoint, divergence. gradient-physics-step.c
 * tests a step, gradient-fast.c whole rollouts. */

#include "gradient-physics-both.h"

/* ---- start and clip ---- */

static void start_and_clip(void)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (uint32_t k = 0; k < GRADIENT_CASES; k++) {
      struct gradient_case c = make_gradient_case(k);
      struct both *b = make_both(&c);
      const uint32_t n = c.body->n_masses;
      struct mo_outcome outcome;
      REQUIRE(functions[isa]->start(&b->scene, &outcome, b->fast.next_m, b->fast.d_position));
      const struct mo_goal goal = mo_goal_of(&c.environment, outcome.com_start_m);
      mo_adjoint_start(&b->reference, outcome.com_end_m, &goal, 1.0, &b->adjoint);
      double com[3];
      mo_scene_com(b->reference.position_m, n, com);
      const double size = size_of(b->adjoint.d_position, 3 * n);
      CHECK_NEAR(outcome.loss, 1, 1e-5);
      for (uint32_t i = 0; i < 3 * n; i++) {
        CHECK_NEAR(b->fast.next_m[i], b->reference.position_m[i], 3e-7);
        CHECK_NEAR(b->fast.d_position[i], b->adjoint.d_position[i], 1e-6 * size);
      }
      for (int axis = 0; axis < 3; axis++)
        CHECK(outcome.com_start_m[axis] == com[axis]);

      const double scale_m =
          hypot(com[0] - c.environment.light_xy_m[0], com[1] - c.environment.light_xy_m[1]) + 1e-8;
      struct mo_random random = dice(6, 1, k);
      for (uint32_t round = 0; round < 8; round++) {
        static const double sizes[] = {1e-3, 1, 1e3, 1e25, 1e-25};
        const double bound = round == 0 ? 0 : 2;
        double x = 0, v = 0, m;
        bool clipped, finite;
        for (uint32_t i = 0; i < 3 * n; i++) {
          b->fast.d_position[i] = b->d_position[i] =
              rounded(sizes[round % 5] * mo_random_normal(&random));
          b->fast.d_velocity[i] = b->d_velocity[i] =
              rounded(sizes[round * 2 % 5] * mo_random_normal(&random));
          x += b->d_position[i] * b->d_position[i];
          v += b->d_velocity[i] * b->d_velocity[i];
        }
        const double expected = scale_m * fmax(sqrt(x), MO_ADJOINT_RATE_PER_S * sqrt(v));
        REQUIRE(functions[isa]->clip(&b->scene, bound, b->fast.d_position, b->fast.d_velocity, &m,
                                     &clipped, &finite));
        CHECK(finite);
        CHECK_NEAR(m, expected, 1e-5 * expected);
        CHECK(clipped == (bound > 0 && expected > bound));
        const double factor = clipped ? bound / expected : 1;
        for (uint32_t i = 0; i < 3 * n; i++) {
          CHECK_NEAR(b->fast.d_position[i], factor * b->d_position[i],
                     1e-5 * fabs(factor * b->d_position[i]) + 1e-37);
          CHECK_NEAR(b->fast.d_velocity[i], factor * b->d_velocity[i],
                     1e-5 * fabs(factor * b->d_velocity[i]) + 1e-37);
        }
        b->fast.d_velocity[round % n] = round % 2 == 0 ? (double)NAN : (double)INFINITY;
        REQUIRE(functions[isa]->clip(&b->scene, bound, b->fast.d_position, b->fast.d_velocity, &m,
                                     &clipped, &finite));
        CHECK(!finite);
      }
      check_drop_to(0);
    }
}

/* ---- divergence ---- */

static void divergence(void)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct gradient_case c = make_gradient_case(4);
    struct both *b = make_both(&c);
    const struct {
      double value, up_m;
      bool position, sane;
    } cases[] = {{900, 10, false, true},
                 {1200, 10, false, false},
                 {(double)NAN, 10, false, false},
                 {900, 0, false, true},
                 {(double)INFINITY, 0, false, false},
                 {(double)NAN, 0, true, false},
                 {(double)INFINITY, 0, true, false}};
    for (size_t i = 0; i < COUNT(cases); i++)
      for (uint32_t m = 0; m < c.body->n_masses; m += 7)
        for (int axis = 0; axis < 3; axis++) {
          mo_scene_start(c.body, &c.environment, &c.physics, b->position);
          for (uint32_t j = 0; j < 3 * c.body->n_masses; j++) {
            b->position[j] += j % 3 == 2 ? cases[i].up_m : 0;
            b->velocity[j] = 0;
          }
          (cases[i].position ? b->position : b->velocity)[3 * m + (uint32_t)axis] = cases[i].value;
          memset(b->fast.d_position, 0, 3 * c.body->n_masses * sizeof(double));
          memset(b->fast.d_velocity, 0, 3 * c.body->n_masses * sizeof(double));
          REQUIRE(functions[isa]->step(&b->scene, &b->fast));
          if (cases[i].sane != b->fast.sane)
            printf("# %s: case %zu, mass %u, axis %d\n", mo_isa_name((enum mo_isa)isa), i, m, axis);
          CHECK(b->fast.sane == cases[i].sane);
        }
    check_drop_to(0);
  }
}

static const struct check_case cases[] = {
    {"the start, its derivative and the bound", start_and_clip}, {"divergence", divergence}};
CHECK_MAIN(cases)
