/* risers.c: how much energy robots get from the rise of the ground.
 *
 * At the end of a step, a mass that would be below the ground is raised to it (docs/model.md). On
 * even ground this raises nothing: the mass slides along it. Where the ground turns up, as at the
 * foot of a riser, a mass keeps its direction to the end of the step, and is then raised by what
 * the ground gained on it. Its speed pays for that only from the next step on, when the ground
 * takes the part along the new normal; the energy of the raise, against gravity and the springs, is
 * a gift. This sums the gifts of each rollout (raises that cost energy, because springs relax, do
 * not count against others) and compares them with the work of the actuators. Float64 reference,
 * default physics; robots start on level ground and walk along x to a light 2 m ahead. */
#include "bench.h"

#include <math.h>
#include <stdlib.h>

#include "rollout/contact.h"
#include "rollout/reference.h"
#include "rollout/scene.h"

#define LIGHT_M   2.0
#define FOOT_M    2.9 /* of the first riser of a steep grid: the workspace ends at 2.8 m */
#define RUN_M     0.3
#define SPACING_M 0.02

struct ground {
  const char *name;
  enum mo_terrain_family family;
  double rise_m;  /* of the stairs of a family; 0: its default */
  double steep_m; /* above 0: a grid with risers of this height, one SPACING_M wide */
};
static const struct ground grounds[] = {
    {"flat", MO_TERRAIN_FLAT, 0, 0},
    {"rough", MO_TERRAIN_ROUGH, 0, 0},
    {"hurdles", MO_TERRAIN_HURDLES, 0, 0},
    {"stairs-up", MO_TERRAIN_STAIRS_UP, 0, 0},
    {"stairs-up, rise 0.1 m: 45 degrees", MO_TERRAIN_STAIRS_UP, 0.1, 0},
    {"grid, risers of 0.05 m: 68 degrees", MO_TERRAIN_FLAT, 0, 0.05},
    {"grid, risers of 0.2 m: 84 degrees", MO_TERRAIN_FLAT, 0, 0.2},
};
#define N_GROUNDS (sizeof(grounds) / sizeof(grounds[0]))

struct walk {
  struct mo_reference r;
  struct mo_constants constants;
  double gift_j, largest_j, largest_m; /* sum; of one raise */
  uint32_t raises;
};

/* ---- the ground ---- */

static void make_steep(double rise_m, struct mo_environment *environment)
{
  static double heights[2][MO_GRID_SIDE_MAX];
  for (uint32_t i = 0; i < MO_GRID_SIDE_MAX; i++) {
    const double x = MO_WORLD_CENTER_M + SPACING_M * (i - (MO_GRID_SIDE_MAX - 1) / 2.0);
    heights[0][i] = heights[1][i] =
        MO_TERRAIN_FLOOR_M + (x > FOOT_M ? rise_m * (1 + floor((x - FOOT_M) / RUN_M)) : 0);
  }
  bench_check(
      mo_terrain_grid_create(MO_GRID_SIDE_MAX, 2, SPACING_M, heights[0], &environment->grid),
      "a grid");
}

static struct mo_environment make_ground(const struct ground *ground, uint64_t seed)
{
  struct mo_environment environment = {
      .light_xy_m = {MO_WORLD_CENTER_M + LIGHT_M, MO_WORLD_CENTER_M}};
  struct mo_terrain_recipe recipe = mo_terrain_recipe_default(ground->family);
  recipe.seed = seed;
  if (ground->rise_m > 0)
    recipe.rise_m = ground->rise_m;
  if (ground->steep_m > 0)
    make_steep(ground->steep_m, &environment);
  else
    bench_check(mo_terrain_draw(&recipe, &environment, NULL), ground->name);
  return environment;
}

/* ---- one rollout ---- */

/* Returns the energy of one mass and its springs, with the activations of the last step. */
static double energy_at(const struct walk *walk, uint32_t mass, const double at[3])
{
  const struct mo_reference *r = &walk->r;
  const struct mo_constants *c = &walk->constants;
  double energy = c->mass_kg * c->gravity_m_per_s2 * at[2];
  for (uint32_t s = 0; s < r->body->n_springs; s++) {
    const uint32_t a = r->body->spring_a[s], b = r->body->spring_b[s];
    if (a != mass && b != mass)
      continue;
    const double *other = r->position_m + 3 * (size_t)(a == mass ? b : a);
    const double length = hypot(hypot(at[0] - other[0], at[1] - other[1]), at[2] - other[2]);
    const double stretch =
        length - r->body->spring_rest_m[s] * (1 + c->actuation * r->tape->activation[s]);
    energy += 0.5 * c->stiffness_n_per_m * stretch * stretch;
  }
  return energy;
}

/* Returns by how much the last step raised a mass: how far the ground at the end is above the plane
 * of the ground at the impact. */
static double raise_of(const struct walk *walk, uint32_t mass)
{
  const struct mo_reference *r = &walk->r;
  const struct mo_environment *environment = r->environment;
  const double *p = r->tape->position_m + 3 * (size_t)mass,
               *v = r->tape->velocity_m_per_s + 3 * (size_t)mass,
               *end = r->position_m + 3 * (size_t)mass;
  if (r->contacts[mass] == 0 || end[2] - mo_terrain_height(environment, end[0], end[1]) > MO_LIES_M)
    return 0;
  const bool lies = p[2] - mo_terrain_height(environment, p[0], p[1]) < MO_LIES_M;
  const double impact = lies ? 0 : mo_impact_exact(environment, p, v, r->physics->scheme.dt_s);
  const double hit[2] = {p[0] + impact * v[0], p[1] + impact * v[1]};
  double g[2];
  mo_terrain_gradient(environment, hit[0], hit[1], g);
  const double raise = end[2] - mo_terrain_height(environment, hit[0], hit[1]) -
                       g[0] * (end[0] - hit[0]) - g[1] * (end[1] - hit[1]);
  return raise > MO_LIES_M ? raise : 0;
}

/* The state after step number `step` − 1. */
static void visit(void *context, uint32_t step)
{
  struct walk *walk = context;
  for (uint32_t m = 0; step > 0 && m < walk->r.body->n_masses; m++) {
    const double raise = raise_of(walk, m), *end = walk->r.position_m + 3 * (size_t)m;
    if (raise == 0)
      continue;
    const double before[3] = {end[0], end[1], end[2] - raise};
    const double gift = fmax(energy_at(walk, m, end) - energy_at(walk, m, before), 0);
    walk->raises++;
    walk->gift_j += gift;
    walk->largest_j = fmax(walk->largest_j, gift);
    walk->largest_m = fmax(walk->largest_m, raise);
  }
}

/* ---- all bodies ---- */

static void report(const struct bench_scene *scene, const struct ground *ground,
                   const struct mo_physics *physics)
{
  const uint32_t n = scene->n_bodies;
  double *shares = bench_zeros(n, sizeof(*shares));
  double gift_j = 0, work_j = 0, most_j = 0, largest_m = 0, largest_j = 0;
  uint32_t counted = 0;
  for (uint32_t i = 0; i < n; i++) {
    struct mo_environment environment = make_ground(ground, i + 1);
    struct walk walk = {.constants = mo_scene_constants(&environment, physics)};
    struct mo_outcome outcome;
    bench_check(
        mo_reference_init(&walk.r, scene->bodies[i], scene->controller, &environment, physics),
        "a rollout");
    walk.r.works = true;
    mo_reference_run(&walk.r, visit, &walk, &outcome);
    const double work = walk.r.work_j, share = walk.gift_j / work;
    mo_reference_done(&walk.r);
    mo_terrain_grid_drop(environment.grid);
    printf("%s,%u,%u,%u,%.3f,%.6f,%.6f,%.6f\n", ground->name, i, (unsigned)outcome.diverged_step,
           walk.raises, work, walk.gift_j, walk.largest_j, walk.largest_m);
    if (outcome.diverged_step != 0 || !(work > 0))
      continue;
    gift_j += walk.gift_j;
    work_j += work;
    most_j = fmax(most_j, walk.gift_j);
    shares[counted++] = share;
    largest_j = fmax(largest_j, walk.largest_j);
    largest_m = fmax(largest_m, walk.largest_m);
  }
  fprintf(stderr,
          "%s: %u of %u bodies did not diverge; raises give %.4f %% of the work of their actuators "
          "(per body: median %.4f %%, 99 %% %.4f %%, at most %.4f %%), at most %.1f J to a body; "
          "the largest raise is %.1f mm, and the largest gift %.2f J\n",
          ground->name, counted, n, 100 * gift_j / work_j, 100 * bench_median(shares, counted),
          100 * bench_quantile(shares, counted, 0.99), 100 * bench_quantile(shares, counted, 1),
          most_j, 1e3 * largest_m, largest_j);
  free(shares);
}

int bench_risers(const struct bench_options *options)
{
  struct bench_scene scene;
  struct mo_physics physics = mo_default_physics();
  const uint32_t n = options->bodies > 0 ? options->bodies : options->quick ? 20 : 200;
  bench_scene_create(&scene, options, n);
  physics.scheme.control_period_s = MO_DEFAULT_CONTROL_PERIOD_S;
  printf("ground,body,diverged_step,raises,work_j,gift_j,largest_gift_j,largest_raise_m\n");
  for (size_t i = 0; i < N_GROUNDS; i++)
    report(&scene, &grounds[i], &physics);
  return 0;
}
