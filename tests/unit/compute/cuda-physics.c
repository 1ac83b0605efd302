/* The device's float32 physics, compiled for the host, against the float64 physics of src/rollout.
 */
#include "../check.h"

#include "compute/cuda/physics.cuh"

#include "rollout/contact.h"

#include <morpho/random.h>

static struct mo_random dice;

static double uniform(double low, double high)
{
  return low + (high - low) * mo_random_uniform(&dice);
}

static struct mo_cuda_constants constants_of(const struct mo_physics *physics)
{
  return (struct mo_cuda_constants){
      .dt = (float)physics->dt_s,
      .keep = (float)exp(-physics->drag_per_s * physics->dt_s),
      .fall = (float)(physics->gravity_m_per_s2 * physics->dt_s),
      .pull = (float)(physics->dt_s * physics->stiffness_n_per_m / physics->mass_kg),
      .actuation = (float)physics->actuation,
      .friction = (float)physics->friction,
      .friction_cap = (float)physics->friction_cap,
      .fastest_squared = (float)(MO_DIVERGED_SPEED_M_PER_S * MO_DIVERGED_SPEED_M_PER_S),
      .bisections = physics->impact == MO_IMPACT_EXACT ? 0 : physics->bisections,
  };
}

static void cells_of(const double *heights, struct mo_cuda_cell *cells)
{
  for (int k = 0; k < MO_CUDA_CELLS; k++)
    cells[k] = mo_cuda_cell_of(heights, k % MO_CUDA_CELLS_SIDE - 1, k / MO_CUDA_CELLS_SIDE - 1);
}

static void heights(void)
{
  mo_random_init(&dice, 1, MO_PURPOSE_CHECK, 0, 0);
  double terrain[MO_TERRAIN_HEIGHTS], worst = 0, steepest = 0;
  struct mo_cuda_cell cells[MO_CUDA_CELLS];
  mo_terrain_random(2, 0, 0, 0.1, terrain);
  cells_of(terrain, cells);
  for (int i = 0; i < 20000; i++) {
    const float p[2] = {(float)uniform(-4, 4),
                        (float)uniform(-4, 4)}; /* from the center: beyond all edges, too */
    const float x = mo_cuda_coordinate(p[0]), y = mo_cuda_coordinate(p[1]);
    struct mo_cuda_patch patch;
    float slope[2];
    double gradient[2];
    mo_cuda_patch_load(cells, mo_cuda_cell_number(x), mo_cuda_cell_number(y), &patch);
    mo_cuda_slope(&patch, x, y, slope);
    mo_terrain_gradient(terrain, p[0] + 2.5, p[1] + 2.5, gradient);
    worst = fmax(worst, fabs((double)mo_cuda_height(&patch, x, y) -
                             mo_terrain_height(terrain, p[0] + 2.5, p[1] + 2.5)));
    if (fabs((double)x - roundf(x)) > 1e-5 && fabs((double)y - roundf(y)) > 1e-5)
      for (int axis = 0; axis < 2; axis++)
        steepest = fmax(steepest, fabs((double)slope[axis] - gradient[axis]));
  }
  CHECK(worst < 1e-6);
  CHECK(steepest < 2e-6);
  CHECK_INT(mo_cuda_cell_number(NAN), 7);
  CHECK_INT(mo_cuda_cell_number(1e30f), 7);
  CHECK_INT(mo_cuda_cell_number(-1e30f), -1);
}

/* Random masses near rough ground, slow and fast: some cross several cells in a step, some start
 * below the ground. */
static void check_contact(enum mo_impact impact, double speed, double allowed, int least_met)
{
  mo_random_init(&dice, 3, MO_PURPOSE_CHECK, 0, (uint64_t)impact);
  struct mo_physics physics = mo_default_physics();
  physics.impact = impact;
  const struct mo_cuda_constants k = constants_of(&physics);
  double terrain[MO_TERRAIN_HEIGHTS], worst = 0;
  struct mo_cuda_cell cells[MO_CUDA_CELLS];
  int met = 0, apart = 0;
  for (int i = 0; i < 20000; i++) {
    if (i % 1000 == 0) {
      mo_terrain_random(4, 0, (uint64_t)i, 0.2, terrain);
      cells_of(terrain, cells);
    }
    const double highest = mo_terrain_highest(terrain);
    float p[3] = {(float)uniform(-3, 3), (float)uniform(-3, 3), 0};
    p[2] = (float)(mo_terrain_height(terrain, p[0] + 2.5, p[1] + 2.5) + uniform(-1e-3, 1e-2));
    float v[3] = {(float)uniform(-speed, speed), (float)uniform(-speed, speed),
                  (float)uniform(-speed, 0.2 * speed)};
    double from[3] = {p[0] + 2.5, p[1] + 2.5, p[2]}, to[3] = {v[0], v[1], v[2]};
    met += mo_cuda_move(&k, cells, (float)(highest + 1e-6), p, v);
    mo_contact_move(&physics, terrain, highest, from, to);
    double error = 0;
    for (int axis = 0; axis < 3; axis++) {
      error = fmax(error, fabs((double)p[axis] - from[axis] + (axis < 2 ? 2.5 : 0)));
      error = fmax(error, fabs((double)v[axis] - to[axis]) * physics.dt_s);
    }
    /* Where rounding decides whether a grazing mass touches, or which half a bisection keeps, the
     * results part. */
    if (error > allowed)
      apart++;
    else
      worst = fmax(worst, error);
  }
  printf("# %s, %g m/s: %d met the ground, %d of 20000 apart, the others within %.1e m\n",
         impact == MO_IMPACT_EXACT ? "exact" : "bisection8", speed, met, apart, worst);
  CHECK(met > least_met);
  CHECK(apart <= 20);
}

static void contact(void)
{
  check_contact(MO_IMPACT_EXACT, 2, 3e-6, 5000);
  check_contact(MO_IMPACT_EXACT, 500, 3e-4, 5000); /* 2 m in a step */
  check_contact(MO_IMPACT_BISECTION, 2, 3e-6, 5000);
}

/* Whatever a diverging life hands over, the routines end, and leave what is found to be insane. */
static void insanity(void)
{
  const struct mo_physics physics = mo_default_physics();
  struct mo_cuda_constants k = constants_of(&physics);
  double terrain[MO_TERRAIN_HEIGHTS];
  struct mo_cuda_cell cells[MO_CUDA_CELLS];
  const float odd[] = {NAN, INFINITY, -INFINITY, 1e30f, -1e30f, 0.0f};
  mo_terrain_random(5, 0, 0, 0.1, terrain);
  cells_of(terrain, cells);
  for (int mode = 0; mode < 2; mode++) {
    k.bisections = mode == 0 ? 0 : 8;
    for (int a = 0; a < 6; a++)
      for (int b = 0; b < 6; b++)
        for (int axis = 0; axis < 3; axis++) {
          float p[3] = {0.1f, 0.2f, 0.3f}, v[3] = {0.1f, 0.1f, -0.1f};
          p[axis] = odd[a];
          v[2 - axis] = odd[b];
          mo_cuda_move(&k, cells, 1.0f, p, v);
          if (a == 0 && b == 0)
            CHECK(!mo_cuda_is_sane(&k, p, v));
        }
  }
  const float p[3] = {0, 0, 0}, slow[3] = {999, 0, 0}, quick[3] = {0, 1001, 0},
              lost[3] = {INFINITY, 0, 0};
  CHECK(mo_cuda_is_sane(&k, p, slow));
  CHECK(!mo_cuda_is_sane(&k, p, quick));
  CHECK(!mo_cuda_is_sane(&k, lost, slow));
}

static void springs(void)
{
  mo_random_init(&dice, 6, MO_PURPOSE_CHECK, 0, 0);
  double worst = 0;
  for (int i = 0; i < 20000; i++) {
    const float d[3] = {(float)uniform(-0.2, 0.2), (float)uniform(-0.2, 0.2),
                        (float)uniform(-0.2, 0.2)};
    const float wanted = (float)uniform(0.08, 0.17);
    const double length = sqrt((double)d[0] * d[0] + (double)d[1] * d[1] + (double)d[2] * d[2]);
    const double truth = (length - wanted) / (length + 1e-8);
    if (length >= 0.02) /* no spring is ever as short; below, 1e-8 of the length counts */
      worst =
          fmax(worst, fabs(mo_cuda_spring(d[0], d[1], d[2], wanted) - truth) * length); /* meters */
  }
  CHECK(worst < 2e-7);
  CHECK(0 * mo_cuda_spring(0, 0, 0, 0.1f) == 0);
  CHECK(isfinite(mo_cuda_spring(1e-12f, 0, 0, 0.1f)));
}

static void lights(void)
{
  double worst[2] = {0, 0};
  for (int i = 0; i < 20000; i++) {
    const double distance = i == 0 ? 0 : exp(-18.0 + 20.0 * i / 20000);
    const float squared = (float)(distance * distance);
    const double d = sqrt((double)squared);
    const double truth[2] = {1.0 / (sqrt(d + 1e-8) + 1e-8), 1.0 / (d * d + 1e-4)};
    worst[0] = fmax(worst[0], fabs(mo_cuda_light(MO_SENSOR_INVERSE_SQRT, squared) / truth[0] - 1));
    worst[1] =
        fmax(worst[1], fabs(mo_cuda_light(MO_SENSOR_INVERSE_SQUARE, squared) / truth[1] - 1));
  }
  CHECK(worst[0] < 1e-6);
  CHECK(worst[1] < 1e-6);
}

static const struct check_case cases[] = {{"terrain", heights},
                                          {"contact", contact},
                                          {"what is not finite", insanity},
                                          {"springs", springs},
                                          {"light", lights}};
CHECK_MAIN(cases)
