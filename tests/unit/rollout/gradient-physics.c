/* gradient-physics.c: the float32 physics of the fast gradient, function by function, against the
 * float64 reference: many bodies, the start, the bound of the adjoint, divergence. A step is in
 * gradient-physics-step.c, whole rollouts are in gradient-physics-rollouts.c. */

#include "gradient-physics-both.h"

/* ---- many bodies ---- */

/* A step and the sensors of one body without actuation. Returns the number of masses that took
 * another branch, or −1. */
static int passive_step(const struct mo_body *body, const struct mo_environment *environment,
                        uint64_t seed, const struct physics_functions *f)
{
  const struct mo_physics physics = mo_default_physics();
  const struct physics_scene scene = {body, environment, &physics, MO_SENSOR_INVERSE_SQRT};
  const size_t n = 3 * (size_t)body->n_masses;
  struct mo_reference reference;
  struct mo_random random = dice(seed, 2, 0);
  int astray = 0;
  double *memory = make_zeros(8 * n + 2 * (size_t)body->n_springs, sizeof(double));
  make_check(mo_reference_init(&reference, body, NULL, environment, &physics), "reference");
  struct physics_step step = {.position_m = memory,
                              .velocity_m_per_s = memory + n,
                              .activation = memory + 8 * n,
                              .sensors = memory + 2 * n,
                              .next_m = memory + 3 * n,
                              .next_m_per_s = memory + 4 * n,
                              .d_position = memory + 5 * n,
                              .d_velocity = memory + 6 * n,
                              .d_sensors = memory + 7 * n,
                              .d_activation = memory + 8 * n + body->n_springs};
  for (size_t i = 0; i < n; i++) {
    const double center = i % 3 < 2 ? MO_WORLD_CENTRE_M : 0;
    reference.position_m[i] =
        rounded(reference.position_m[i] - center + 0.002 * (mo_random_uniform(&random) - 0.5)) +
        center;
    reference.velocity_m_per_s[i] = rounded(0.1 * mo_random_normal(&random));
    memory[i] = reference.position_m[i];
    memory[n + i] = reference.velocity_m_per_s[i];
    step.d_position[i] = 0;
    step.d_velocity[i] = i % 3 == 0 ? 1 : 0;
  }
  double mean = 0, light_m[3];
  mo_scene_light(environment, light_m);
  for (uint32_t pass = 0; pass < 2; pass++)
    for (uint32_t m = 0; m < body->n_masses; m++) {
      const double *p = memory + 3 * (size_t)m;
      const double d = hypot(hypot(p[0] - light_m[0], p[1] - light_m[1]), p[2] - light_m[2]);
      const double light = 1 / (sqrt(d + 1e-8) + 1e-8);
      if (pass == 0)
        mean += light / body->n_masses;
      else
        reference.impulse_n_s[m] = light - mean;
    }
  bool good = f->step(&scene, &step) && step.sane;
  for (uint32_t m = 0; m < body->n_masses; m++)
    good &= fabs(step.sensors[m] - reference.impulse_n_s[m]) < 1e-5;
  good &= mo_reference_step(&reference, 0);
  for (uint32_t m = 0; m < body->n_masses; m++) {
    const size_t at = 3 * (size_t)m;
    astray += !(distance(step.next_m + at, reference.position_m + at) < 2e-6 &&
                distance(step.next_m_per_s + at, reference.velocity_m_per_s + at) < 2e-4);
  }
  for (uint32_t s = 0; s < body->n_springs; s++)
    good &= isfinite(step.d_activation[s]);
  mo_reference_done(&reference);
  return good ? astray : -1;
}

static void many_bodies(void)
{
  static const struct mo_workspace workspaces[] = {
      {6, 6, 4}, {6, 6, 4}, {1, 5, 2}, {9, 2, 3}, {2, 7, 5}};
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    int astray = 0, masses = 0;
    struct mo_environment environment;
    for (size_t w = 0; w < COUNT(workspaces); w++) {
      const struct mo_lattice *lattice = make_lattice(workspaces[w]);
      struct mo_random random = dice(8, 1, w);
      for (uint32_t k = 0; k < 150; k++) {
        uint64_t bits[4] = {0};
        REQUIRE(mo_genotype_random(workspaces[w], &random, bits) == 0);
        const struct mo_body *body = make_body(lattice, bits);
        mo_environment_training(8, 0, k, &environment);
        const int result = passive_step(body, &environment, k, functions[isa]);
        CHECK(result >= 0);
        astray += result;
        masses += (int)body->n_masses;
      }
    }
    /* More springs than the layout is chosen for. */
    const struct mo_body *body = make_full_body(make_lattice((struct mo_workspace){14, 14, 12}));
    mo_environment_training(8, 0, 0, &environment);
    const int result = passive_step(body, &environment, 1, functions[isa]);
    CHECK(result >= 0);
    astray += result;
    printf("# %s: %d of %d masses at a kink, and of a body of %u springs\n",
           mo_isa_name((enum mo_isa)isa), astray, masses, body->n_springs);
    CHECK(body->n_springs > 20000);
    CHECK(astray <= masses / 1000);
    check_drop_to(0);
  }
}

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
      mo_adjoint_start(&b->reference, outcome.com_end_m,
                       mo_scene_distance(outcome.com_start_m[0] - c.environment.light_xy_m[0],
                                         outcome.com_start_m[1] - c.environment.light_xy_m[1]) +
                           MO_LOSS_GUARD_M,
                       1.0, &b->adjoint);
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
    {"many bodies", many_bodies},
    {"the start, its derivative and the bound", start_and_clip},
    {"divergence", divergence}};
CHECK_MAIN(cases)
