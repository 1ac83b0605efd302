/* ledger.c: momentum and energy of the reference, for both integrators: what is conserved exactly,
 * and what to the scheme's order. */
#include "ledger.h"

/* ---- momentum ---- */

/* Springs act in pairs: without drag and contact they change neither momentum nor angular momentum
 * about a fixed point. Both hold exactly: a step kicks along x − x' and moves along v. */
static void conserve(enum mo_integrator integrator)
{
  struct mo_physics physics = scheme_of(integrator, 0.002);
  physics.constants.gravity_m_per_s2 = 0;
  struct scene *s = make_flight((struct mo_workspace){3, 2, 2}, physics);
  shake(s, s->r.velocity_m_per_s, 0.5, 1);
  double first[6], worst = 0;
  for (int pass = 0; pass < 2; pass++) {
    double sum[6] = {0};
    for (uint32_t i = 0; i < s->body->n_masses; i++) {
      const double *x = s->r.position_m + 3 * i, *v = s->r.velocity_m_per_s + 3 * i;
      const double arm[3] = {x[0] - 2.5, x[1] - 2.5, x[2] - 100};
      for (int a = 0; a < 3; a++) {
        sum[a] += v[a];
        sum[3 + a] += arm[(a + 1) % 3] * v[(a + 2) % 3] - arm[(a + 2) % 3] * v[(a + 1) % 3];
      }
    }
    for (int a = 0; a < 6; a++) {
      worst = fmax(worst, pass == 1 ? fabs(sum[a] - first[a]) : 0);
      first[a] = sum[a];
    }
    if (pass == 0)
      advance_for(s, 1);
  }
  printf("# momentum and angular momentum after 500 steps: changed by %.1e\n", worst);
  CHECK(worst < 1e-10);
}

/* Gravity adds n m g dt in each step; half of it in the first one of `split`, which ends at dt/2.
 */
static void gain_by_gravity(enum mo_integrator integrator)
{
  struct scene *s = make_flight((struct mo_workspace){3, 2, 2}, scheme_of(integrator, 0.002));
  shake(s, s->r.velocity_m_per_s, 0.5, 2);
  double worst = 0;
  for (int n = 0; n < 500; n++) {
    const double before = mean_of(s, s->r.velocity_m_per_s, 2);
    const double share = n == 0 && integrator == MO_INTEGRATOR_SPLIT ? 0.5 : 1;
    advance(s);
    const double gained = mean_of(s, s->r.velocity_m_per_s, 2) - before;
    worst = fmax(worst, fabs(gained + share * GRAVITY_M_PER_S2 * 0.002));
  }
  printf("# momentum by gravity: largest error of a step %.1e m/s\n", worst);
  CHECK(worst < 1e-13);
}

static void momentum(void)
{
  for (int i = 0; i < 2; i++) {
    conserve((enum mo_integrator)i);
    gain_by_gravity((enum mo_integrator)i);
  }
}

/* ---- energy ---- */

/* Returns the energy of a spring that pulls with k (L − L0) L/(L + g), as the step does: the
 * integral of it. */
static double spring_energy(double stiffness_n_per_m, double length_m, double rest_m)
{
  const double guard = 1e-8, d = length_m - rest_m, r = rest_m + guard;
  return stiffness_n_per_m * (0.5 * d * d - guard * d + guard * r * log1p(d / r));
}

static double potential(const struct scene *s, const double *x)
{
  const struct mo_constants *c = &s->physics.constants;
  double energy = 0;
  for (uint32_t i = 0; i < s->body->n_masses; i++)
    energy += c->mass_kg * c->gravity_m_per_s2 * x[3 * i + 2];
  for (uint32_t k = 0; k < s->body->n_springs; k++) {
    const double *a = x + 3 * s->body->spring_a[k], *b = x + 3 * s->body->spring_b[k];
    const double length = hypot(hypot(a[0] - b[0], a[1] - b[1]), a[2] - b[2]);
    energy += spring_energy(c->stiffness_n_per_m, length, s->body->spring_rest_m[k]);
  }
  return energy;
}

/* Returns m Σ v · w. */
static double product(const struct scene *s, const double *v, const double *w)
{
  double sum = 0;
  for (uint32_t k = 0; k < 3 * s->body->n_masses; k++)
    sum += v[k] * w[k];
  return s->physics.constants.mass_kg * sum;
}

/* Returns the energy at the time when the last step started. */
static double energy_of(const struct scene *s)
{
  return 0.5 * product(s, s->start_m_per_s, s->start_m_per_s) + potential(s, s->r.tape->position_m);
}

/* What leapfrog conserves exactly: 1/2 m v(n − 1/2) · v(n + 1/2) + U(x(n)), for forces linear in x,
 * as those of a breathing voxel are (but for the guard of the step's d/(L + 1e-8), which matters
 * less the smaller the amplitude). The same holds for `paper`, with the velocities before and after
 * a step: without drag, its steps are those of leapfrog, from another start. */
static void invariant(void)
{
  for (int i = 0; i < 2; i++) {
    struct mo_physics physics = scheme_of((enum mo_integrator)i, 0.002);
    physics.constants.gravity_m_per_s2 = 0;
    physics.drop_height_m = 1; /* in the air, but places round less than at 100 m */
    struct scene *s = make_scene(make_full_body(make_lattice(one)), plane_of(0), physics);
    inflate(s, 1e-4);
    const double stored = potential(s, s->r.position_m);
    double first = 0, worst = 0, least = INFINITY, most = -INFINITY;
    for (int n = 0; n < 500; n++) {
      advance(s);
      const double energy = 0.5 * product(s, s->before_m_per_s, s->r.tape->velocity_m_per_s) +
                            potential(s, s->r.tape->position_m);
      first = n <= 1 ? energy : first; /* the first step of `split` is half a step */
      worst = fmax(worst, fabs(energy - first));
      least = fmin(least, energy_of(s));
      most = fmax(most, energy_of(s));
    }
    printf("# %s: 1/2 m v v' + U of a breathing voxel changes by %.1e in 500 steps; the energy "
           "oscillates by %.1e\n",
           i ? "split" : "paper", worst / stored, (most - least) / stored);
    CHECK(worst < 1e-10 * stored);
    CHECK(most - least > 0.01 * stored); /* the energy itself is not constant */
  }
}

/* Returns the largest |E(t) − E(0) + work of drag| of a vibrating body, relative to the energy of
 * its vibration. */
static double ledger(enum mo_integrator integrator, double dt_s, double drag_per_s)
{
  struct mo_physics physics = scheme_of(integrator, dt_s);
  physics.constants.drag_per_s = drag_per_s;
  struct scene *s = make_flight((struct mo_workspace){3, 2, 2}, physics);
  const double rest = potential(s, s->r.position_m);
  shake(s, s->r.position_m, 2e-3, 3);
  if (drag_per_s == 0)
    shake(s, s->r.velocity_m_per_s, 0.3, 4);
  double first = 0, work = 0, worst = 0;
  for (uint32_t n = steps_in(s, 0.5); n > 0; n--) {
    advance(s);
    first = s->step == 1 ? energy_of(s) : first;
    worst = fmax(worst, fabs(energy_of(s) - first + work));
    const double *v = s->r.tape->velocity_m_per_s;
    work += dt_s * drag_per_s * product(s, v, v);
  }
  return worst / (first - rest);
}

static double ledger_free(enum mo_integrator integrator, double dt_s)
{
  return ledger(integrator, dt_s, 0);
}

static double ledger_drag(enum mo_integrator integrator, double dt_s)
{
  return ledger(integrator, dt_s, 15);
}

static void energy_in_flight(void)
{
  compare("energy without drag", ledger_free, 5e-4, 0.1, (struct expected){1, 0.07},
          (struct expected){2, 4e-3});
  compare("energy and work of drag", ledger_drag, 5e-4, 0.1, (struct expected){1, 0.08},
          (struct expected){2, 6e-3});
}

enum ground { FLAT, TERRAIN, STAIRS };

static void make_ground(enum ground ground, uint64_t i, struct mo_environment *environment)
{
  struct mo_terrain_recipe recipe = mo_terrain_recipe_default(MO_TERRAIN_STAIRS_UP);
  if (ground == TERRAIN)
    mo_environment_training(90, 0, i, environment);
  if (ground == STAIRS)
    make_check(mo_terrain_draw(&recipe, environment, NULL), "stairs");
}

/* Returns the largest rise of energy over an earlier, lower one, relative to the energy at the
 * start above the ground, of bodies that fall, hit the ground and slide, without drag. On stairs,
 * they start where these begin, and slide into the risers without friction, which would hide what
 * the risers give. */
static double rise(enum mo_integrator integrator, double dt_s, enum ground ground)
{
  double largest = 0;
  for (uint64_t i = 0; i < 4; i++) {
    const size_t kept = check_n_kept;
    struct mo_environment environment = plane_of(0);
    make_ground(ground, i, &environment);
    struct mo_physics physics = scheme_of(integrator, dt_s);
    physics.drop_height_m = 0.05;
    if (ground == STAIRS)
      physics.constants.friction = 0;
    struct mo_random random = dice(91, 0, i);
    uint64_t bits[MO_DEFAULT_WORDS];
    make_check(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, bits), "a body");
    struct scene *s =
        make_scene(make_body(make_lattice(MO_DEFAULT_WORKSPACE), bits), environment, physics);
    for (uint32_t k = 0; k < s->body->n_masses; k++) {
      s->r.velocity_m_per_s[3 * k] = 1;
      s->r.position_m[3 * k] += ground == STAIRS ? MO_FAMILY_BEGINS_M - MO_SLOPE_BEGINS_M : 0;
    }
    double least = INFINITY, first = 0;
    for (uint32_t n = steps_in(s, 0.5); n > 0; n--) {
      advance(s);
      const double energy = energy_of(s);
      first = s->step == 1 ? energy : first;
      least = fmin(least, energy);
      largest = fmax(largest, (energy - least) / first);
    }
    check_drop_to(kept);
  }
  return largest;
}

static double rise_on_flat(enum mo_integrator integrator, double dt_s)
{
  return rise(integrator, dt_s, FLAT);
}

static double rise_on_terrain(enum mo_integrator integrator, double dt_s)
{
  return rise(integrator, dt_s, TERRAIN);
}

static double rise_on_stairs(enum mo_integrator integrator, double dt_s)
{
  return rise(integrator, dt_s, STAIRS);
}

static void energy_on_ground(void)
{
  compare("rise of energy, flat ground", rise_on_flat, 1e-3, 0.3, (struct expected){1, 0.03},
          (struct expected){2, 2e-3});
  compare("rise of energy, terrain", rise_on_terrain, 1e-3, 0.3, (struct expected){1, 0.03},
          (struct expected){2, 2e-3});
  compare("rise of energy, stairs", rise_on_stairs, 1e-3, 0.3, (struct expected){1, 0.03},
          (struct expected){1, 2e-3});
}

static const struct check_case cases[] = {
    {"momentum", momentum},
    {"an exact invariant", invariant},
    {"energy in flight", energy_in_flight},
    {"energy on the ground", energy_on_ground},
};
CHECK_MAIN(cases)
