/* The device's float32 physics and its derivatives, compiled for the host, against the float64
 * physics of src/rollout. */
#include "../check.h"

#include "compute/cuda/lane.cuh"

#include "rollout/contact.h"

#include <morpho/random.h>

static struct mo_random dice;

static double uniform(double low, double high)
{
  return low + (high - low) * mo_random_uniform(&dice);
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

/* A terrain in float32, and the same as an environment. */
struct ground {
  struct mo_environment environment;
  float heights32[MO_TERRAIN_HEIGHTS];
  struct lane_cells cells;
  struct lane_terrain terrain;
};

/* Heights are rounded to float32, so that both sides have the same terrain. spacing_m: of a
 * profile; 0: a grid. */
static void random_ground(double highest, double spacing_m, struct ground *g)
{
  g->environment = (struct mo_environment){.profile_spacing_m = spacing_m};
  g->environment.n_profile = spacing_m > 0 ? 40 : 0;
  for (int k = 0; k < (spacing_m > 0 ? 40 : MO_TERRAIN_HEIGHTS); k++)
    g->environment.terrain_heights_m[k] = (float)uniform(0, highest);
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    g->heights32[k] = (float)g->environment.terrain_heights_m[k];
  g->cells = lane_cells_of(&g->environment);
  g->terrain = (struct lane_terrain){g->heights32, spacing_m > 0 ? &g->cells : NULL};
}

static struct lane_physics physics_of(const struct mo_physics *physics)
{
  const struct mo_scheme *scheme = &physics->scheme;
  const struct lane_constants constants = lane_both_of(scheme, &physics->constants, false).physics;
  return lane_physics_alike((float)scheme->dt_s, lane_bisections(scheme), &constants);
}

static void check_terrain(double spacing_m)
{
  static struct ground ground;
  double worst = 0, steepest = 0;
  mo_random_init(&dice, 1, MO_PURPOSE_CHECK, 0, 0);
  random_ground(0.1, spacing_m, &ground);
  const struct mo_environment *environment = &ground.environment;
  const struct lane_map map = lane_map_of(ground.terrain);
  for (int i = 0; i < 20000; i++) { /* also beyond all edges */
    const float p[2] = {(float)uniform(-4, 4), (float)uniform(-4, 4)};
    const float x = lane_coordinate(&map, 0, p[0]), y = lane_coordinate(&map, 1, p[1]);
    struct lane_cell g;
    float slope[2];
    double gradient[2];
    const float height = lane_ground(ground.terrain, p[0], p[1], &g);
    lane_slope(ground.terrain, &g, p[0], p[1], slope);
    mo_terrain_gradient(environment, p[0] + 2.5, p[1] + 2.5, gradient);
    worst =
        fmax(worst, fabs((double)height - mo_terrain_height(environment, p[0] + 2.5, p[1] + 2.5)));
    if (fabs((double)x - roundf(x)) > 2e-5 && (spacing_m > 0 || fabs((double)y - roundf(y)) > 1e-5))
      for (int axis = 0; axis < 2; axis++)
        steepest = fmax(steepest, fabs((double)slope[axis] - gradient[axis]));
  }
  CHECK(worst < 1e-6);
  CHECK(steepest < 2e-6);
  const float last = spacing_m > 0 ? 39 : 7;
  CHECK(lane_cell_number(&map, 0, NAN) == last && lane_cell_number(&map, 0, 1e30f) == last);
  CHECK(lane_cell_number(&map, 0, -1e30f) == -1);
}

static void terrain(void)
{
  check_terrain(0);
  check_terrain(0.125);
}

enum { STRIKES = 20000 };

/* Masses that hit the ground, forward and backward: near the ground and above it, some below it,
 * some across cell borders and beyond the map, at up to `reach` m/s in each direction, every eighth
 * one `far` times as fast. spacing_m: as random_ground. */
static void check_contact(enum mo_integrator integrator, enum mo_impact impact, double spacing_m,
                          double reach, double far, double median_m, double most_m,
                          double most_apart)
{
  static struct ground ground;
  static double moved[STRIKES], differ[STRIKES];
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = integrator;
  physics.scheme.impact = impact;
  const bool splits = integrator == MO_INTEGRATOR_SPLIT;
  const struct lane_physics lane = physics_of(&physics);
  const struct lane_split_constants constants =
      lane_both_of(&physics.scheme, &physics.constants, false).split;
  const struct lane_split split = lane_split_alike(&constants);
  int n = 0, crossing = 0;
  mo_random_init(&dice, 11, MO_PURPOSE_CHECK, 0, impact);
  while (n < STRIKES) {
    random_ground(n % 2 == 0 ? 0.1 : 0.5, spacing_m, &ground);
    const struct mo_environment *environment = &ground.environment;
    const double speed_m_per_s = n % 8 == 0 ? far * reach : reach;
    const float x = (float)uniform(-2.7, 2.7), y = (float)uniform(-2.7, 2.7);
    const float z =
        (float)(mo_terrain_height(environment, x + MO_WORLD_CENTER_M, y + MO_WORLD_CENTER_M) +
                uniform(1e-4, 0.004) * speed_m_per_s / 2);
    const float v[3] = {(float)uniform(-speed_m_per_s, speed_m_per_s),
                        (float)uniform(-speed_m_per_s, speed_m_per_s),
                        (float)uniform(-speed_m_per_s, 0)};
    const float start[3] = {x, y, z};
    float p[3] = {x, y, z}, w[3] = {v[0], v[1], v[2]}, dp[3], dv[3];
    double position[3] = {x + MO_WORLD_CENTER_M, y + MO_WORLD_CENTER_M, z},
           speed[3] = {v[0], v[1], v[2]}, d_position[3], d_velocity[3];
    const double from[3] = {position[0], position[1], position[2]}, with[3] = {v[0], v[1], v[2]};
    float push[3] = {0, 0, 0}, da[3] = {0, 0, 0};
    double a[3], d_acceleration[3] = {0, 0, 0};
    for (int k = 0; k < 3; k++) {
      push[k] = splits ? (float)uniform(-0.05, 0.05) : 0;
      a[k] = lane_acceleration(&split, k, push[k]);
    }
    if (!lane_move(&lane, ground.terrain, 1e9f, p, w))
      continue;
    if (splits) {
      memcpy(p, start, sizeof(p));
      memcpy(w, v, sizeof(w));
      lane_move_split(&lane, &split, ground.terrain, push, p, w);
      mo_contact_split(&physics.scheme, &physics.constants, environment, INFINITY, a, position,
                       speed);
    } else {
      mo_contact_move(&physics.scheme, &physics.constants, environment, INFINITY, position, speed);
    }
    for (int k = 0; k < 3; k++) {
      d_position[k] = dp[k] = (float)uniform(-1, 1);
      d_velocity[k] = dv[k] = (float)uniform(-0.05, 0.05);
    }
    if (splits) {
      lane_move_split_back(&lane, &split, ground.terrain, push, start, v, dp, dv, da);
      mo_contact_split_adjoint(&physics.scheme, &physics.constants, environment, INFINITY, a, from,
                               with, d_position, d_velocity, d_acceleration);
    } else {
      lane_move_back(&lane, ground.terrain, 1e9f, start, v, dp, dv);
      mo_contact_move_adjoint(&physics.scheme, &physics.constants, environment, INFINITY, from,
                              with, d_position, d_velocity);
    }
    double distance = 0, error = 0, size = 0;
    for (int k = 0; k < 3; k++) {
      const double center = k < 2 ? MO_WORLD_CENTER_M : 0;
      distance =
          fmax(distance, fmax(fabs(p[k] + center - position[k]), 0.004 * fabs(w[k] - speed[k])));
      error += pow(dp[k] - d_position[k], 2) + pow(15 * (dv[k] - d_velocity[k]), 2);
      size += pow(d_position[k], 2) + pow(15 * d_velocity[k], 2);
      error += pow(3000 * (da[k] - d_acceleration[k]), 2);
      size += pow(3000 * d_acceleration[k], 2);
    }
    const double per_m = spacing_m > 0 ? 1 / spacing_m : 1.4;
    crossing += floor(from[0] * per_m) != floor((from[0] + 0.004 * v[0]) * per_m);
    moved[n] = distance;
    differ[n++] = sqrt(error / size);
  }
  qsort(moved, STRIKES, sizeof(*moved), ascending);
  qsort(differ, STRIKES, sizeof(*differ), ascending);
  printf("# %d strikes, %d across a border: moved apart median %.1e m, 99 %% %.1e; derivative "
         "differs by median %.1e, 99 %% %.1e\n",
         STRIKES, crossing, moved[STRIKES / 2], moved[STRIKES * 99 / 100], differ[STRIKES / 2],
         differ[STRIKES * 99 / 100]);
  CHECK(crossing > 500);
  CHECK(moved[STRIKES / 2] < median_m && moved[STRIKES * 99 / 100] < most_m);
  CHECK(differ[STRIKES / 2] < 1e-5 && differ[STRIKES * 99 / 100] < most_apart);
}

static void contact(void)
{
  check_contact(MO_INTEGRATOR_PAPER, MO_IMPACT_EXACT, 0, 2, 30, 1e-6, 1e-5, 1e-2);
  check_contact(MO_INTEGRATOR_PAPER, MO_IMPACT_BISECTION, 0, 2, 30, 1e-6, 1e-2, 1e-1);
}

static void contact_split(void)
{
  check_contact(MO_INTEGRATOR_SPLIT, MO_IMPACT_EXACT, 0, 2, 30, 1e-6, 1e-5, 1e-2);
  check_contact(MO_INTEGRATOR_SPLIT, MO_IMPACT_BISECTION, 0, 2, 30, 1e-6, 1e-2, 1e-1);
}

/* Profiles, the cells of which are smaller; the far masses cross all of them. */
static void contact_profile(void)
{
  for (int integrator = MO_INTEGRATOR_PAPER; integrator <= MO_INTEGRATOR_SPLIT; integrator++) {
    check_contact((enum mo_integrator)integrator, MO_IMPACT_EXACT, 0.125, 2, 500, 1e-6, 1e-3, 0.1);
    check_contact((enum mo_integrator)integrator, MO_IMPACT_BISECTION, 0.125, 2, 30, 1e-6, 1e-2,
                  0.1);
  }
}

/* A mass in the air only flies; one that hits the ground in the next step lies on it, in float32 as
 * in float64. */
static void lying(void)
{
  const struct mo_physics physics = mo_paper_physics();
  const struct lane_physics lane = physics_of(&physics);
  static struct ground ground;
  int below = 0;
  mo_random_init(&dice, 12, MO_PURPOSE_CHECK, 0, 0);
  for (int n = 0; n < 2000; n++) {
    random_ground(0.3, n % 2 == 0 ? 0 : 0.125, &ground);
    float p[3] = {(float)uniform(-2, 2), (float)uniform(-2, 2), 0.31f},
          v[3] = {(float)uniform(-1, 1), (float)uniform(-1, 1), 0};
    for (int step = 0; step < 60; step++) {
      struct lane_cell g;
      v[2] -= 0.04f;
      lane_move(&lane, ground.terrain, 0.3f, p, v);
      below += p[2] < lane_ground(ground.terrain, p[0], p[1], &g);
    }
  }
  CHECK(below == 0);
  float p[3] = {0, 0, 2}, v[3] = {1, 2, 3}, dp[3] = {1, 2, 3}, dv[3] = {0.5f, 0, 0};
  lane_move_back(&lane, ground.terrain, 0.3f, p, v, dp, dv);
  CHECK_NEAR(dv[0], 0.504, 1e-6);
  CHECK_NEAR(dv[2], 0.012, 1e-6);
  CHECK(dp[0] == 1 && dp[1] == 2 && dp[2] == 3);
}

/* Whatever values a diverging rollout contains, the routines return, and the result is recognized
 * as not finite. */
static void insanity(void)
{
  const struct mo_physics physics = mo_paper_physics();
  struct lane_physics lane = physics_of(&physics);
  static struct ground ground;
  const float odd[] = {NAN, INFINITY, -INFINITY, 1e30f, -1e30f, 0.0f};
  for (int mode = 0; mode < 4; mode++) {
    random_ground(0.1, mode < 2 ? 0 : 0.125, &ground);
    lane.bisections = mode % 2 == 0 ? 0 : 8;
    for (int a = 0; a < 6; a++)
      for (int b = 0; b < 6; b++)
        for (int axis = 0; axis < 3; axis++) {
          float p[3] = {0.1f, 0.2f, 0.3f}, v[3] = {0.1f, 0.1f, -0.1f};
          p[axis] = odd[a];
          v[2 - axis] = odd[b];
          lane_move(&lane, ground.terrain, 1.0f, p, v);
          if (a == 0 && b == 0)
            CHECK(!lane_is_sane(p, v));
        }
  }
  const float p[3] = {0, 0, 0}, slow[3] = {999, 0, 0}, quick[3] = {0, 1001, 0},
              lost[3] = {INFINITY, 0, 0};
  CHECK(lane_is_sane(p, slow));
  CHECK(!lane_is_sane(p, quick));
  CHECK(!lane_is_sane(lost, slow));
}

/* ---- springs and sensors, against differences in float64 ---- */

/* The effect of a spring of length |d| on a velocity, per meter, times `across` · d. */
static double loss64(const struct mo_physics *p, double wanted, const double *d,
                     const double *across)
{
  const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  return p->scheme.dt_s * p->constants.stiffness_n_per_m / p->constants.mass_kg *
         (length - wanted) / (length + 1e-8) *
         (across[0] * d[0] + across[1] * d[1] + across[2] * d[2]);
}

static void springs(void)
{
  const struct mo_physics physics = mo_paper_physics();
  const struct lane_physics lane = physics_of(&physics);
  double worst = 0;
  mo_random_init(&dice, 13, MO_PURPOSE_CHECK, 0, 0);
  for (int n = 0; n < 3000; n++) {
    const float wanted = (float)uniform(0.08, 0.17);
    const float d[3] = {(float)uniform(-0.1, 0.1), (float)uniform(-0.1, 0.1),
                        (float)uniform(0.02, 0.1)};
    const float across[3] = {(float)uniform(-1, 1), (float)uniform(-1, 1), (float)uniform(-1, 1)};
    double d64[3] = {d[0], d[1], d[2]};
    const double across64[3] = {across[0], across[1], across[2]}, h = 1e-6;
    const struct lane_length length = lane_length_of(lane_squared(d));
    const float q = lane_spring(lane.pull, &length, wanted);
    float dd[3];
    const float d_wanted = -lane_spring_back(lane.pull, &length, wanted, d, across, dd);
    CHECK_NEAR(q * (across[0] * d[0] + across[1] * d[1] + across[2] * d[2]),
               loss64(&physics, wanted, d64, across64), 1e-4);
    double size = 0, error = 0;
    for (int k = 0; k < 3; k++) {
      const double at = d64[k];
      d64[k] = at + h;
      const double up = loss64(&physics, wanted, d64, across64);
      d64[k] = at - h;
      const double down = loss64(&physics, wanted, d64, across64);
      d64[k] = at;
      size += pow((up - down) / (2 * h), 2);
      error += pow((up - down) / (2 * h) - dd[k], 2);
    }
    const double slope = (loss64(&physics, wanted + h, d64, across64) -
                          loss64(&physics, wanted - h, d64, across64)) /
                         (2 * h);
    worst = fmax(worst, sqrt(error / size));
    CHECK_NEAR(d_wanted, slope, 1e-3);
  }
  CHECK(worst < 1e-4);
  const struct lane_length none = lane_length_of(0), short_one = lane_length_of(1e-24f);
  CHECK(isfinite(lane_spring(1, &none, 0.1f)) && isfinite(lane_spring(1, &short_one, 0.1f)));
}

/* k / 2 · max(after² − before², 0). */
static double work64(const struct mo_physics *p, double rest, const double *d, double now,
                     double before)
{
  const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  const double a = length - rest * (1 + p->constants.actuation * now),
               b = length - rest * (1 + p->constants.actuation * before);
  return 0.5 * p->constants.stiffness_n_per_m * fmax(a * a - b * b, 0);
}

/* The work of new outputs on a spring, and its derivatives. */
static void work(void)
{
  const struct mo_physics physics = mo_paper_physics();
  const float stiffness = (float)physics.constants.stiffness_n_per_m,
              actuation = (float)physics.constants.actuation;
  int gains = 0;
  mo_random_init(&dice, 14, MO_PURPOSE_CHECK, 0, 0);
  for (int n = 0; n < 3000; n++) {
    const float d[3] = {(float)uniform(-0.1, 0.1), (float)uniform(-0.1, 0.1),
                        (float)uniform(0.02, 0.1)},
                rest = lane_rest(n % 2 == 0);
    /* the output, the one before, and the vector between the ends */
    double x[5] = {uniform(-1, 1), uniform(-1, 1), d[0], d[1], d[2]}, size = 0, error = 0;
    const struct lane_length length = lane_length_of(lane_squared(d));
    const struct lane_work w = lane_work_of(&length, rest, actuation, (float)x[0], (float)x[1]);
    const struct lane_work_adjoint adjoint =
        lane_work_back(stiffness, &length, rest, actuation, &w);
    const double found[5] = {adjoint.activation, adjoint.activation_before, adjoint.along * d[0],
                             adjoint.along * d[1], adjoint.along * d[2]};
    CHECK_NEAR(0.5 * stiffness * fmaxf(w.gain, 0), work64(&physics, rest, x + 2, x[0], x[1]), 1e-4);
    for (int k = 0; k < 5; k++) {
      const double at = x[k], h = 1e-7;
      x[k] = at + h;
      const double up = work64(&physics, rest, x + 2, x[0], x[1]);
      x[k] = at - h;
      const double down = work64(&physics, rest, x + 2, x[0], x[1]);
      x[k] = at;
      size += pow((up - down) / (2 * h), 2);
      error += pow((up - down) / (2 * h) - found[k], 2);
    }
    gains += w.gain > 0;
    if (fabs((double)w.gain) > 1e-6)
      CHECK(sqrt(error) <= 1e-3 * sqrt(size));
    const struct lane_work_adjoint none = lane_work_back(0, &length, rest, actuation, &w);
    CHECK(none.activation == 0 && none.activation_before == 0 && none.along == 0);
  }
  CHECK(gains > 1000 && gains < 2000);
}

static double light64(enum mo_sensor sensor, double distance)
{
  return sensor == MO_SENSOR_INVERSE_SQUARE ? 1 / (distance * distance + 1e-4)
                                            : 1 / (sqrt(distance + 1e-8) + 1e-8);
}

static void lights(void)
{
  for (int sensor = 0; sensor < 2; sensor++)
    for (int i = 0; i < 20000; i++) {
      const float squared = (float)exp(2 * (-18.0 + 20.0 * i / 20000));
      const double d = sqrt((double)squared), h = 1e-4 * d;
      const double slope =
          (light64((enum mo_sensor)sensor, d + h) - light64((enum mo_sensor)sensor, d - h)) /
          (2 * h) / d;
      CHECK_NEAR(lane_light((enum mo_sensor)sensor, squared) / light64((enum mo_sensor)sensor, d),
                 1, 1e-6);
      if (d > 0.1)
        CHECK_NEAR(lane_light_slope((enum mo_sensor)sensor, squared) / slope, 1, 1e-5);
    }
  CHECK(lane_light_slope(MO_SENSOR_INVERSE_SQRT, 0) == 0);
}

static const struct check_case cases[] = {{"terrain", terrain},
                                          {"contact, forward and backward", contact},
                                          {"contact with split", contact_split},
                                          {"contact with profiles", contact_profile},
                                          {"masses on the ground", lying},
                                          {"values that are not finite", insanity},
                                          {"springs", springs},
                                          {"the work of new outputs", work},
                                          {"light", lights}};
CHECK_MAIN(cases)
