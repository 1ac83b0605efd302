/* gradient-stress.c: settings far outside of what the physics is made for. Whatever happens, no
 * number that is not finite reaches the gradient, and each robot is accounted for. */

#include "gradient-cases.h"

struct stress {
  const char *name;
  double stiffness_factor, dt_s, weight_factor, drop_m, sigma_m;
  int light_inside;
};

static const struct stress stresses[] = {
    {"as it is", 1, 0.004, 1, 0, 0.1, 0},
    {"stiffness x4", 4, 0.004, 1, 0, 0.1, 0},
    {"dt 5 ms", 1, 0.005, 1, 0, 0.1, 0},
    {"stiffness x4, dt 5 ms", 4, 0.005, 1, 0, 0.1, 0},
    {"stiffness x1.3", 1.3, 0.004, 1, 0, 0.1, 0}, /* around the linear bound of stability */
    {"weights x100", 1, 0.004, 100, 0, 0.1, 0},
    {"light inside the body", 1, 0.004, 1, 0, 0.1, 1},
    {"drop from 1 m", 1, 0.004, 1, 1, 0.1, 0},
    {"drop from 10 m", 1, 0.004, 1, 10, 0.1, 0}, /* with this drag, still falling at the end */
    {"terrain of 1 m", 1, 0.004, 1, 0, 1.0, 0},
    {"weights x100, light inside", 1, 0.004, 100, 0, 1.0, 1},
    {"everything", 4, 0.005, 100, 10, 1.0, 1},
};

static void apply(const struct stress *s, uint32_t n_steps, struct gradient_case *c)
{
  c->physics = mo_default_physics();
  c->physics.n_steps = n_steps;
  c->physics.stiffness_n_per_m *= s->stiffness_factor;
  c->physics.dt_s = s->dt_s;
  c->physics.drop_height_m = s->drop_m;
  mo_terrain_random(77, 7, 0, s->sigma_m, c->environment.terrain_heights_m);
  for (size_t i = 0; i < c->controller->n_parameters; i++)
    c->controller->parameters[i] = (float)(c->theta[i] * s->weight_factor);
  if (s->light_inside) { /* at the center of mass, where the loss itself has a pole */
    double com[2] = {0, 0};
    for (uint32_t i = 0; i < c->body->n_masses; i++)
      for (int axis = 0; axis < 2; axis++)
        com[axis] += MO_VOXEL_M * c->body->mass_xyz[3 * i + (uint32_t)axis] / c->body->n_masses;
    c->environment.light_xy_m[0] =
        MO_WORLD_CENTRE_M - 0.5 * MO_VOXEL_M * c->body->workspace.nx + com[0];
    c->environment.light_xy_m[1] =
        MO_WORLD_CENTRE_M - 0.5 * MO_VOXEL_M * c->body->workspace.ny + com[1];
  }
}

static void run(const uint32_t *numbers, uint32_t n_cases, uint32_t n_steps)
{
  uint64_t diverged = 0, contributed = 0;
  printf("# robots of each line: %u, half of them without a bound; %u steps\n", 2 * n_cases,
         n_steps);
  printf("# %-26s diverged zeroed clipped steps  largest m   largest |gradient|, bound 2 and off\n",
         "");
  for (size_t s = 0; s < COUNT(stresses); s++) {
    struct mo_gradient_counts counts = {0};
    double largest[2] = {0, 0};
    for (uint32_t k = 0; k < n_cases; k++) {
      struct gradient_case c = make_gradient_case(numbers[k]);
      apply(&stresses[s], n_steps, &c);
      double *gradient = make_zeros(c.controller->n_parameters, sizeof(double));
      for (int off = 0; off < 2; off++) {
        const struct mo_gradient_options options = {.adjoint_bound = off ? 0 : MO_ADJOINT_BOUND,
                                                    .weight = 1};
        struct mo_gradient_counts one = counts;
        struct mo_outcome outcome;
        memset(gradient, 0, c.controller->n_parameters * sizeof(double));
        REQUIRE(mo_gradient_reference(c.body, c.controller, &c.environment, &c.physics, &options,
                                      &outcome, gradient, &counts) == MO_OK);
        double size = 0;
        size_t bad = 0;
        for (size_t i = 0; i < c.controller->n_parameters; i++) {
          bad += !isfinite(gradient[i]);
          size = fmax(size, fabs(gradient[i]));
        }
        CHECK(bad == 0);
        const uint64_t nothing =
            counts.diverged_robots + counts.zeroed_robots - one.diverged_robots - one.zeroed_robots;
        CHECK(nothing <= 1 && (nothing == 0 || size == 0));
        CHECK((outcome.diverged_step != 0) == (counts.diverged_robots > one.diverged_robots));
        largest[off] = fmax(largest[off], size);
      }
    }
    printf("# %-26s %8llu %6llu %13llu  %9.1e   %9.1e %9.1e\n", stresses[s].name,
           (unsigned long long)counts.diverged_robots, (unsigned long long)counts.zeroed_robots,
           (unsigned long long)counts.clipped_steps, counts.largest, largest[0], largest[1]);
    CHECK_INT(counts.robots, 2 * n_cases);
    CHECK(isfinite(counts.largest));
    diverged += counts.diverged_robots;
    contributed += counts.robots - counts.diverged_robots - counts.zeroed_robots;
  }
  CHECK(diverged > 0 && contributed > 0); /* both sides of the border were met */
}

static void short_runs(void)
{
  static const uint32_t numbers[] = {0, 3, 13}; /* all 144 voxels; a few; a single one */
  run(numbers, 3, 50);
}

static void long_runs(void)
{
  static const uint32_t numbers[] = {0, 3, 13, 10};
  run(numbers, 4, 1000);
}

static const struct check_case cases[] = {
    {"no NaN in any gradient: 50 steps", short_runs},
    {"no NaN in any gradient: 1000 steps", long_runs},
};
CHECK_MAIN(cases)
