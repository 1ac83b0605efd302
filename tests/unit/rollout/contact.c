/* contact.c: one mass on the terrain: impact times compared with a fine search, and the strike with
 * closed forms. */
#include "../make.h"

#include <morpho/random.h>

#include "rollout/contact.h"

static struct mo_random random_numbers;

static double uniform(double low, double high)
{
  return low + (high - low) * mo_random_uniform(&random_numbers);
}

static struct mo_environment flat(double height_m)
{
  struct mo_environment environment = {0};
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    environment.terrain_heights_m[k] = height_m;
  return environment;
}

static double gap(const struct mo_environment *environment, const double p[3], const double v[3],
                  double t)
{
  return p[2] + t * v[2] - mo_terrain_height(environment, p[0] + t * v[0], p[1] + t * v[1]);
}

/* Returns the first time at which the gap turns negative, found by walking in small steps, then
 * halving. */
static double search(const struct mo_environment *environment, const double p[3], const double v[3],
                     double dt, int n)
{
  for (int i = 1; i <= n; i++) {
    if (gap(environment, p, v, dt * i / n) < 0) {
      double low = dt * (i - 1) / n, high = dt * i / n;
      for (int k = 0; k < 60; k++) {
        const double middle = 0.5 * (low + high);
        if (gap(environment, p, v, middle) < 0)
          high = middle;
        else
          low = middle;
      }
      return low;
    }
  }
  return dt;
}

/* Up to `highest_m`; every other one is a profile, and of the others every other one a custom grid,
 * kept until the next. */
static struct mo_environment rough(int number, double highest_m)
{
  struct mo_environment environment = {0};
  if (number % 2 == 1) {
    environment.n_profile = 2 + mo_random_below(&random_numbers, 63);
    environment.profile_spacing_m = uniform(0.06, 0.4);
  }
  const int n = environment.n_profile != 0 ? (int)environment.n_profile : MO_TERRAIN_HEIGHTS;
  for (int k = 0; k < n; k++)
    environment.terrain_heights_m[k] = uniform(0, highest_m);
  check_drop_to(0);
  if (number % 4 == 2) {
    memset(environment.terrain_heights_m, 0, sizeof(environment.terrain_heights_m));
    environment.grid = make_grid(2 + mo_random_below(&random_numbers, 60),
                                 2 + mo_random_below(&random_numbers, 60), uniform(0.06, 0.4),
                                 (uint64_t)number, highest_m / 3);
  }
  return environment;
}

/* Segments of all lengths, up to many cells, on and off the map, over rough terrain. The walk may
 * miss a dip that is shorter than one of its steps; then the gap at the closed form's time must
 * vanish, and right after it must be negative. */
static void exact_against_search(void)
{
  mo_random_init(&random_numbers, 5, MO_PURPOSE_CHECK, 0, 0);
  int tried = 0, crossing = 0, earlier = 0, on_profiles = 0, on_grids = 0;
  double worst = 0, worst_gap = 0;
  for (int number = 0; tried < 6000; number++) {
    const struct mo_environment environment = rough(number, 0.5);
    const double dt = 0.1, reach = tried % 3 == 0 ? 0.02 : tried % 3 == 1 ? 1.0 : 6.0;
    const double p[3] = {uniform(-0.5, 5.5), uniform(-0.5, 5.5), uniform(0, 1)};
    const double v[3] = {uniform(-reach, reach) / dt, uniform(-reach, reach) / dt,
                         uniform(-1, 0.3) / dt};
    if (gap(&environment, p, v, 0) < 0 || !(gap(&environment, p, v, dt) < 0))
      continue;
    tried++;
    on_profiles += environment.n_profile != 0;
    on_grids += environment.grid != NULL;
    const double exact = mo_impact_exact(&environment, p, v, dt),
                 found = search(&environment, p, v, dt, 3000);
    REQUIRE(exact >= 0 && exact <= dt);
    worst_gap = fmax(worst_gap, fabs(gap(&environment, p, v, exact)));
    crossing += hypot(v[0], v[1]) * dt > 1;
    if (exact < found - 1e-9) {
      earlier++;
      CHECK(gap(&environment, p, v, exact + 1e-9) < 1e-12);
    } else {
      worst = fmax(worst, fabs(exact - found));
    }
  }
  printf("# %d segments, %d longer than a meter, %d on profiles, %d on grids of other sizes: "
         "largest difference %.1e s, largest "
         "gap %.1e m, %d dips that the walk missed\n",
         tried, crossing, on_profiles, on_grids, worst, worst_gap, earlier);
  CHECK(worst < 1e-9);
  CHECK(worst_gap < 1e-12);
  CHECK(crossing > 1000 && on_profiles > 2000 && on_grids > 1000 && earlier < 60);
}

/* Already on the ground, borders, edges, and a start slightly below the terrain because of
 * rounding. */
static void exact_at_limits(void)
{
  struct mo_environment environment = flat(0.25);
  const double dt = 0.004;
  const double resting[3] = {2.5, 2.5, 0.25}, below[3] = {2.5, 2.5, 0.25 - 1e-17},
               down[3] = {0.3, -0.2, -1};
  CHECK_NEAR(mo_impact_exact(&environment, resting, down, dt), 0, 0);
  CHECK_NEAR(mo_impact_exact(&environment, below, down, dt), 0, 0);
  const double line = 3 * MO_TERRAIN_SIZE_M / 7, on_line[3] = {line, line, 0.252};
  for (int k = 0; k < 4; k++) {
    const double v[3] = {k & 1 ? 1.0 : -1.0, k & 2 ? 1.0 : -1.0, -1};
    CHECK_NEAR(mo_impact_exact(&environment, on_line, v, dt), 0.002, 1e-15);
  }
  const double corners[][2] = {{0, 0},  {5, 5}, {-1, 2}, {6, 2},
                               {2, -1}, {2, 6}, {5, 0},  {1e6, -1e6}};
  for (size_t i = 0; i < COUNT(corners); i++)
    for (int k = 0; k < 4; k++) {
      const double p[3] = {corners[i][0], corners[i][1], 0.252},
                   v[3] = {k & 1 ? 500.0 : -500.0, k & 2 ? 1.0 : 0.0, -1};
      CHECK_NEAR(mo_impact_exact(&environment, p, v, dt), 0.002, 1e-15);
    }
  /* A ridge along x = line: the segment starts and ends on opposite sides, and hits the far one. */
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    environment.terrain_heights_m[k] = k % 8 >= 4 ? 0.5 : 0.1;
  const double left[3] = {line - 0.01, 2.2, 0.1 + 0.01}, right[3] = {10, 0, 0};
  /* Flat up to x = line, then a rise of 0.4 m in 5/7 m: z = 0.11 is reached after 0.01 + 0.01 ·
   * (5/7)/0.4 m. */
  CHECK_NEAR(mo_impact_exact(&environment, left, right, dt), (0.01 + 0.01 * (5.0 / 7) / 0.4) / 10,
             1e-15);
}

static void bisection(void)
{
  const struct mo_environment environment = flat(0.25);
  const double dt = 0.004, p[3] = {2.5, 2.5, 0.25 + 0.0013}, v[3] = {0, 0, -1};
  /* The lower end: the last multiple of dt/2^n before the impact. */
  for (uint32_t n = 1; n <= 30; n++) {
    const double cell = dt / (double)(1U << n);
    CHECK_NEAR(mo_impact_bisection(&environment, p, v, dt, n), floor(0.0013 / cell) * cell, 1e-15);
  }
  CHECK_NEAR(mo_impact_bisection(&environment, p, v, dt, 52),
             mo_impact_exact(&environment, p, v, dt), 1e-15);
}

static void strike_flat(void)
{
  struct mo_physics physics = mo_paper_physics();
  const struct mo_environment environment = flat(0.25);
  /* Capped: 0.9 · 2 > 0.95 · 1. */
  double p[3] = {2.5, 2.5, 0.25 + 0.003}, v[3] = {1, 0, -2};
  mo_contact_move(&physics.scheme, &physics.constants, &environment, 0.25, p, v);
  CHECK_NEAR(v[0], 0.05, 1e-15);
  CHECK_NEAR(v[1], 0, 0);
  CHECK_NEAR(v[2], 0, 0);
  CHECK_NEAR(p[0], 2.5 + 0.0015 + 0.0025 * 0.05, 1e-15);
  CHECK_NEAR(p[2], 0.25, 0);
  /* Not capped: 5 m/s tangential lose 0.9 · 2. */
  double q[3] = {2.5, 2.5, 0.25 + 0.003}, w[3] = {3, -4, -2};
  mo_contact_move(&physics.scheme, &physics.constants, &environment, 0.25, q, w);
  CHECK_NEAR(w[0], 3 * (1 - 1.8 / 5), 1e-15);
  CHECK_NEAR(w[1], -4 * (1 - 1.8 / 5), 1e-15);
  CHECK_NEAR(q[1], 2.5 - 4 * 0.0015 - 4 * (1 - 1.8 / 5) * 0.0025, 1e-15);
  /* Straight down: no tangential speed to divide by. */
  double s[3] = {2.5, 2.5, 0.25}, u[3] = {0, 0, -2};
  mo_contact_move(&physics.scheme, &physics.constants, &environment, 0.25, s, u);
  CHECK(u[0] == 0 && u[1] == 0 && u[2] == 0 && s[2] == 0.25);
  /* No friction. */
  physics.constants.friction = 0;
  double a[3] = {2.5, 2.5, 0.25}, b[3] = {3, 0, -2};
  mo_contact_move(&physics.scheme, &physics.constants, &environment, 0.25, a, b);
  CHECK_NEAR(b[0], 3, 0);
  CHECK_NEAR(a[0], 2.512, 1e-15);
  /* Above the ground: only motion. */
  double c[3] = {2.5, 2.5, 0.25}, d[3] = {1, 2, 0};
  mo_contact_move(&physics.scheme, &physics.constants, &environment, 0.25, c, d);
  CHECK_NEAR(c[1], 2.508, 1e-15);
  CHECK_NEAR(d[1], 2, 0);
}

/* On a plane of slope 0.3 along x, the velocity after the strike is tangential, and reduced by the
 * correct amount. */
static void strike_slope(void)
{
  struct mo_physics physics = mo_paper_physics();
  struct mo_environment environment = {0};
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    environment.terrain_heights_m[k] = 0.3 * (k % 8) * MO_TERRAIN_SIZE_M / 7;
  const double n[3] = {-0.3 / sqrt(1.09), 0, 1 / sqrt(1.09)};
  double p[3] = {2.5, 2.5, 0.75 + 0.001}, v[3] = {1, 4, -0.5};
  const double vn = v[0] * n[0] + v[2] * n[2];
  const double t[3] = {v[0] - vn * n[0], v[1], v[2] - vn * n[2]};
  const double vt = sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]);
  const double scale = 1 - 0.9 * fabs(vn) / vt;
  mo_contact_move(&physics.scheme, &physics.constants, &environment, 2.0, p, v);
  for (int axis = 0; axis < 3; axis++)
    CHECK_NEAR(v[axis], scale * t[axis], 1e-15);
  CHECK_NEAR(v[0] * n[0] + v[2] * n[2], 0, 1e-15);
  const double impact = 0.001 / (0.5 + 0.3);
  CHECK_NEAR(p[0], 2.5 + impact + (0.004 - impact) * v[0], 1e-15);
  CHECK_NEAR(p[2], 0.3 * p[0], 1e-15);
}

/* In every case the mass ends on or above the ground, no faster than before. */
static void never_below(void)
{
  mo_random_init(&random_numbers, 6, MO_PURPOSE_CHECK, 0, 0);
  struct mo_physics physics = mo_paper_physics();
  int struck = 0;
  struct mo_environment environment = {0};
  for (int trial = 0; trial < 200000; trial++) {
    if (trial % 50 == 0)
      environment = rough(trial / 50, trial % 3 ? 0.5 : 5);
    physics.scheme.impact = trial % 2 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
    double p[3] = {uniform(-1, 6), uniform(-1, 6), 0},
           v[3] = {uniform(-30, 30), uniform(-30, 30), uniform(-30, 5)};
    p[2] = mo_terrain_height(&environment, p[0], p[1]) + (trial % 5 ? uniform(0, 0.05) : 0);
    const double before = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], vz = v[2];
    mo_contact_move(&physics.scheme, &physics.constants, &environment,
                    mo_terrain_highest(&environment), p, v);
    REQUIRE(p[2] >= mo_terrain_height(&environment, p[0], p[1]));
    REQUIRE(v[0] * v[0] + v[1] * v[1] + v[2] * v[2] <= before * (1 + 1e-14));
    struck += v[2] != vz;
  }
  CHECK(struck > 20000);
}

static const struct check_case cases[] = {
    {"exact impact times agree with a search", exact_against_search},
    {"exact impact times at borders and limits", exact_at_limits},
    {"bisection keeps the lower end", bisection},
    {"a strike on flat ground", strike_flat},
    {"a strike on a slope", strike_slope},
    {"never below the ground, never faster", never_below}};
CHECK_MAIN(cases)
