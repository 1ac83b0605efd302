/* The tasks of a device's rows, compiled for the host, against src/rollout/course.c: bit by bit. */
#include "../make.h"
#include "../rollout/objective-cases.h"
#include "../rollout/task-cases.h"

#include "compute/cuda/course_back.cuh"
#include "rollout/distance.h"
#include "rollout/fast.h"

enum { WALKS = 40, PERIODS = 60 };

/* A center of mass that wanders, on a path also to the waypoints and past them. */
static void wander(const struct mo_guide *guide, struct mo_random *dice, uint32_t period,
                   double com_m[3])
{
  const bool leads = guide->kind == MO_GUIDE_PATH && mo_random_uniform(dice) < 0.7;
  const double *to = guide->points_m[period * guide->n_points / PERIODS];
  for (int axis = 0; axis < 3; axis++) {
    com_m[axis] += 0.05 * mo_random_normal(dice);
    if (leads && axis < 2)
      com_m[axis] += 0.3 * (to[axis] - com_m[axis]);
  }
}

/* Gives an environment a profile of the first n heights. */
static void make_profile(struct mo_environment *environment, uint32_t n, double spacing_m)
{
  environment->n_profile = n;
  environment->profile_spacing_m = spacing_m;
  for (uint32_t k = n; k < MO_TERRAIN_HEIGHTS; k++)
    environment->terrain_heights_m[k] = 0;
}

static struct mo_environment environment_of(uint32_t k, uint32_t walk)
{
  struct mo_environment environment;
  mo_environment_training(71, walk, k, &environment);
  environment.task = task_case(k);
  if (walk % 3 == 1)
    make_profile(&environment, 20 + walk, 0.1);
  if (walk == 0) /* a start at the light: a distance of 0 */
    environment.light_xy_m[0] = environment.light_xy_m[1] = MO_WORLD_CENTER_M;
  return environment;
}

static bool same_course(const struct mo_course *a, const struct mo_course *b)
{
  return a->environment == b->environment &&
         memcmp(a->start_m, b->start_m, sizeof(a->start_m)) == 0 && a->scale_m == b->scale_m &&
         a->end_s == b->end_s && a->n_periods == b->n_periods;
}

/* Except for the tally. */
static bool same_track(const struct mo_track *a, const struct mo_track *b)
{
  return memcmp(a, b, offsetof(struct mo_track, tally)) == 0;
}

static bool same_light(const struct mo_course *course, double t_s, const struct mo_track *track)
{
  double light_m[3], other_m[3];
  mo_course_light(course, t_s, track, light_m);
  course_light(course, t_s, track, other_m);
  return memcmp(light_m, other_m, sizeof(light_m)) == 0;
}

static struct mo_scheme scheme_of(void)
{
  struct mo_scheme scheme = mo_default_physics().scheme;
  scheme.control_period_s = 7 * scheme.dt_s;
  scheme.n_steps = 7 * PERIODS - 3;
  return scheme;
}

static void forward(void)
{
  uint32_t legs = 0, kept = 0, set = 0;
  for (uint32_t k = 0; k < TASK_CASES; k++)
    for (uint32_t walk = 0; walk < WALKS; walk++) {
      const struct mo_environment environment = environment_of(k, walk);
      struct mo_random dice;
      const struct mo_scheme scheme = scheme_of();
      struct mo_course course, other_course;
      struct mo_track track, other;
      struct mo_outcome outcome = {0};
      double com_m[3] = {MO_WORLD_CENTER_M, MO_WORLD_CENTER_M, 0.2};
      mo_random_init(&dice, 5, MO_PURPOSE_CHECK, k, walk);
      mo_course_begin(&course, &environment, &scheme, com_m, &track);
      course_begin(&other_course, &environment, scheme.n_steps * scheme.dt_s, PERIODS, com_m,
                   &other);
      CHECK(same_course(&course, &other_course) && same_track(&track, &other));
      CHECK(same_light(&course, 0, &track));
      for (uint32_t period = 1; period <= PERIODS; period++) {
        const double t_s = period < PERIODS ? 7 * period * scheme.dt_s : course.end_s;
        wander(&environment.task.guide, &dice, period - 1, com_m);
        mo_course_advance(&course, t_s, com_m, &track);
        course_advance(&other_course, t_s, com_m, &other);
        REQUIRE(same_track(&track, &other));
        REQUIRE(same_light(&course, t_s, &track));
        kept += environment.task.guide.kind == MO_GUIDE_PATH && track.along_is == MO_TRACK_KEPT;
        set += track.along_is == MO_TRACK_SET;
      }
      mo_course_finish(&course, &track, NULL, &outcome);
      const struct course_result result = course_finish(&other_course, &other);
      CHECK(result.loss == outcome.loss && result.value == outcome.value);
      CHECK(isfinite(result.loss));
      const struct course_result all = course_finish_all(&other_course, &other, 0, false);
      CHECK(all.loss == outcome.loss && all.value == outcome.value);
      legs += track.leg;
    }
  printf("# %u waypoints reached, progress kept %u times, at an end %u times\n", legs, kept, set);
  CHECK(legs > 0 && kept > 0 && set > 0);
}

/* What scores need: all but the smooth maximum, which only gradients have. */
static bool same_tally(const struct mo_tally *a, const struct mo_tally *b)
{
  return memcmp(a->sums, b->sums, sizeof(a->sums)) == 0 && a->peak_m == b->peak_m;
}

static bool same_soft_tally(const struct mo_tally *a, const struct mo_tally *b)
{
  return same_tally(a, b) && a->soft == b->soft && a->n_heights == b->n_heights;
}

/* The losses, hard and soft, of a task that has a gradient. */
static void check_losses(const struct mo_course *course, const struct mo_track *track,
                         double work_j)
{
  const struct mo_observed observed = {.work_j = work_j};
  struct mo_outcome outcome = {0};
  mo_course_finish(course, track, &observed, &outcome);
  const struct course_result result = course_finish_all(course, track, work_j, false);
  CHECK(result.loss == outcome.loss && result.value == outcome.value && isfinite(result.loss));
  CHECK(course_finish_all(course, track, work_j, true).loss ==
        mo_course_soft_loss(course, track, &observed));
}

static void tallies(void)
{
  const struct mo_scheme scheme = scheme_of();
  for (uint32_t k = 0; k < OBJECTIVE_CASES; k++)
    for (uint32_t walk = 0; walk < WALKS; walk++) {
      struct mo_environment environment = environment_of(0, walk);
      struct mo_random dice;
      struct mo_course course, other_course;
      struct mo_track track, other, soft;
      double com_m[3] = {MO_WORLD_CENTER_M, MO_WORLD_CENTER_M, 0.2}, sums = 0;
      set_objective(&environment, k);
      mo_random_init(&dice, 6, MO_PURPOSE_CHECK, k, walk);
      mo_course_begin(&course, &environment, &scheme, com_m, &track);
      course_begin(&other_course, &environment, scheme.n_steps * scheme.dt_s, PERIODS, com_m,
                   &other);
      course_begin_tally(&other);
      soft = track;
      CHECK(course_has_tally(&environment.task) && same_tally(&track.tally, &other.tally));
      for (uint32_t period = 1; period <= PERIODS; period++) {
        const double t_s = period < PERIODS ? 7 * period * scheme.dt_s : course.end_s;
        const struct mo_track before = other;
        wander(&environment.task.guide, &dice, period - 1, com_m);
        mo_course_advance(&course, t_s, com_m, &track);
        course_advance(&other_course, t_s, com_m, &other);
        course_add_tally(&other_course, t_s, &before, &other);
        course_advance_all(&other_course, t_s, com_m, &soft);
        REQUIRE(same_track(&track, &other) && same_tally(&track.tally, &other.tally));
        REQUIRE(same_track(&track, &soft) && same_soft_tally(&track.tally, &soft.tally));
        REQUIRE(same_light(&course, t_s, &track));
      }
      if (k < SMOOTH_CASES)
        check_losses(&course, &track, walk % 4 == 0 ? 0 : 500 * mo_random_uniform(&dice));
      for (int sum = 0; sum < 5; sum++)
        sums += fabs(track.tally.sums[sum]);
      CHECK(sums > 0 || isfinite(track.tally.peak_m) || k == 2 || k == 3 || k == 8);
      for (uint32_t t = 0; t < TASK_CASES; t++) {
        const struct mo_task task = task_case(t);
        CHECK(!course_has_tally(&task));
      }
    }
}

static bool same_adjoint(const struct mo_course_adjoint *a, const struct mo_course_adjoint *b,
                         const double *d_com, const double *other)
{
  bool same = a->d_sum == b->d_sum && a->d_along == b->d_along && a->d_peak == b->d_peak &&
              a->d_work == b->d_work && a->loss == b->loss && a->work_j == b->work_j &&
              same_soft_tally(&a->tally, &b->tally);
  for (int sum = 0; sum < 5; sum++)
    same = same && a->d_sums[sum] == b->d_sums[sum];
  return same && memcmp(d_com, other, 3 * sizeof(double)) == 0;
}

static struct mo_environment back_environment_of(uint32_t k, uint32_t walk)
{
  struct mo_environment environment = environment_of(k < TASK_CASES ? k : 0, walk);
  if (k >= TASK_CASES)
    set_objective(&environment, k - TASK_CASES);
  return environment;
}

/* Backward from the end to the start, with restarts. */
static void backward(void)
{
  static struct mo_track tracks[PERIODS + 1];
  uint32_t moving = 0, working = 0, rising = 0;
  for (uint32_t k = 0; k < TASK_CASES + SMOOTH_CASES; k++)
    for (uint32_t walk = 0; walk < WALKS; walk++) {
      const struct mo_environment environment = back_environment_of(k, walk);
      const struct mo_scheme scheme = scheme_of();
      struct mo_random dice;
      struct mo_course course;
      struct mo_course_adjoint adjoint, other_adjoint;
      double com_m[3] = {MO_WORLD_CENTER_M, MO_WORLD_CENTER_M, 0.2}, d_com[3], other[3];
      mo_random_init(&dice, 7, MO_PURPOSE_CHECK, k, walk);
      mo_course_begin(&course, &environment, &scheme, com_m, &tracks[0]);
      for (uint32_t period = 1; period <= PERIODS; period++) {
        wander(&environment.task.guide, &dice, period - 1, com_m);
        tracks[period] = tracks[period - 1];
        mo_course_advance(&course, period < PERIODS ? 7 * period * scheme.dt_s : course.end_s,
                          com_m, &tracks[period]);
      }
      const double work_j = walk % 4 == 0 ? 0 : 500 * mo_random_uniform(&dice);
      mo_course_end_back(&course, &tracks[PERIODS - 1], &tracks[PERIODS], work_j, &adjoint, d_com);
      course_end_back(&course, &tracks[PERIODS - 1], &tracks[PERIODS], work_j, &other_adjoint,
                      other);
      REQUIRE(same_adjoint(&adjoint, &other_adjoint, d_com, other));
      working += adjoint.d_work != 0;
      rising += adjoint.d_peak != 0;
      for (uint32_t period = PERIODS; period-- > 0;) {
        const struct mo_track *track = &tracks[period], *before = period > 0 ? track - 1 : NULL;
        const double t_s = 7 * period * scheme.dt_s;
        double d_light[3];
        for (int axis = 0; axis < 3; axis++)
          d_light[axis] = mo_random_normal(&dice);
        if (period % 9 == 4) {
          mo_course_restart(&course, t_s, track, com_m, 3, &adjoint, d_com);
          course_restart(&course, t_s, track, com_m, 3, &other_adjoint, other);
          REQUIRE(same_adjoint(&adjoint, &other_adjoint, d_com, other));
        }
        mo_course_back(&course, t_s, before, track, d_light, &adjoint, d_com);
        course_back(&course, t_s, before, track, track + 1, d_light, &other_adjoint, other);
        REQUIRE(same_adjoint(&adjoint, &other_adjoint, d_com, other));
        moving += adjoint.d_along != 0;
      }
    }
  CHECK(moving > 0 && working > 0 && rising > 0);
}

/* Losses whose exponents are limited, and a fall that would overflow. */
static void falls(void)
{
  struct mo_environment environment = environment_of(1, 1);
  const struct mo_scheme scheme = mo_default_physics().scheme;
  struct mo_course course;
  struct mo_track track;
  struct mo_outcome outcome = {0};
  const double start_m[3] = {MO_WORLD_CENTER_M, MO_WORLD_CENTER_M, 0.2};
  REQUIRE(environment.task.objective == MO_OBJECTIVE_CLIMB);
  mo_course_begin(&course, &environment, &scheme, start_m, &track);
  for (double rise = -100; rise <= 100; rise += 0.37) {
    track.com_m[2] = start_m[2] + rise;
    mo_course_finish(&course, &track, NULL, &outcome);
    const struct course_result result = course_finish(&course, &track);
    CHECK(result.loss == outcome.loss && result.value == outcome.value);
  }
}

static void functions(void)
{
  struct mo_random dice;
  mo_random_init(&dice, 6, MO_PURPOSE_CHECK, 0, 0);
  for (uint32_t i = 0; i < 200000; i++) {
    const double x = 400 * mo_random_uniform(&dice) - 200, y = 7 * mo_random_uniform(&dice) - 1,
                 z = 7 * mo_random_uniform(&dice) - 1;
    CHECK(course_sin(x) == mo_fast_sin(x));
    CHECK(course_exp(-fabs(3 * x)) == mo_fast_exp(-fabs(3 * x)));
    CHECK(course_log(fabs(x)) == mo_fast_log(fabs(x)));
    CHECK(course_length(x, y) == mo_distance(x, y));
    CHECK(course_length(x, 1e-17 * y) == mo_distance(x, 1e-17 * y));
    CHECK(course_length(1e-150 * z, 1e-150 * y) == mo_distance(1e-150 * z, 1e-150 * y));
    if (i % 100 == 0) {
      struct mo_environment environment = environment_of(0, 3 * i);
      const double *heights_m = environment.terrain_heights_m;
      double slope[2], other[2];
      if (i % 200 == 0)
        make_profile(&environment, 7 + i / 200 % 58, 0.02 + 0.1 * (y + 1));
      const struct terrain_map map = terrain_map_of(&environment);
      CHECK(terrain_height(&map, heights_m, y, z) == mo_terrain_height(&environment, y, z));
      mo_terrain_gradient(&environment, y, z, slope);
      terrain_slope(&map, heights_m, y, z, other);
      CHECK(slope[0] == other[0] && slope[1] == other[1]);
    }
  }
  CHECK(course_length(0, 0) == 0 && course_length(3, 4) == 5);
  CHECK(isinf(course_length(-INFINITY, NAN)) && isnan(course_length(NAN, 1)));
  for (uint32_t k = 0; k < TASK_CASES; k++) {
    const struct mo_task task = task_case(k), plain = {0};
    CHECK(course_is_plain(&task) == mo_task_is_plain(&task) && course_is_plain(&plain));
  }
}

static const struct check_case cases[] = {
    {"lights, sums and results are those of course.c", forward},
    {"tallies of other objectives and of sums", tallies},
    {"their derivatives are those of course.c", backward},
    {"exponents of long falls", falls},
    {"sines, exponentials, lengths, terrain", functions},
};
CHECK_MAIN(cases)
