/* course.cuh: rollout/course.c for a device: the task of one rollout, computed by one lane, with
 * the functions and structures of course.h. course_back.cuh has what gradients need in addition.
 *
 * The operations are those of course.c in the same order, in float64, which devices round as CPUs
 * do: the same centers of mass give the same bits. A test without a device compares them; this file
 * is also valid C17. It must be compiled without contraction (nvcc -fmad=false). */
#ifndef MORPHO_COMPUTE_CUDA_COURSE_CUH
#define MORPHO_COMPUTE_CUDA_COURSE_CUH

#include "compute/cuda/terrain.cuh"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __CUDACC__
#define MO_COURSE         static __host__ __device__ __forceinline__
#define MO_TRACK_WORD(is) mo_track::is
extern "C" {
#include "rollout/course.h"
}
#else
#define MO_COURSE         static inline __attribute__((unused))
#define MO_TRACK_WORD(is) is
#include "rollout/course.h"
#endif

#define MO_COURSE_PI           3.14159265358979323846
#define MO_COURSE_EXPONENT_MAX 600.0
#define MO_COURSE_TRAVEL_M     1.0 /* the units of losses */
#define MO_COURSE_CLIMB_M      0.1

/* ---- functions of the CPU's files that devices cannot call ---- */

/* Like mo_task_is_plain. */
MO_COURSE bool course_is_plain(const struct mo_task *task)
{
  return task->guide.kind == MO_GUIDE_FIXED && task->objective == MO_OBJECTIVE_REACH;
}

/* Like mo_fast_sin. */
MO_COURSE double course_sin(double x)
{
  const double sine[8] = {
      1.0 / 355687428096000.0, -1.0 / 1307674368000.0, 1.0 / 6227020800.0, -1.0 / 39916800.0,
      1.0 / 362880.0,          -1.0 / 5040.0,          1.0 / 120.0,        -1.0 / 6.0};
  const double cosine[8] = {
      1.0 / 20922789888000.0, -1.0 / 87178291200.0, 1.0 / 479001600.0, -1.0 / 3628800.0,
      1.0 / 40320.0,          -1.0 / 720.0,         1.0 / 24.0,        -0.5};
  const double n = nearbyint(x * 0.63661977236758134308);
  const double r = (x - n * 0x1.921fb544p+0) - n * 0x1.0b4611a626331p-34;
  const double s = r * r;
  const int quadrant = (int)((int64_t)n & 3);
  const bool odd = (quadrant & 1) != 0;
  double sum = odd ? cosine[0] : sine[0];
  for (int i = 1; i < 8; i++)
    sum = sum * s + (odd ? cosine[i] : sine[i]);
  sum = odd ? sum * s + 1.0 : r + r * s * sum;
  return (quadrant & 2) != 0 ? -sum : sum;
}

/* Like mo_fast_exp. */
MO_COURSE double course_exp(double x)
{
  if (x < -700.0)
    return 0.0;
  const double n = nearbyint(x * 1.4426950408889634074);
  const double r = (x - n * 0x1.62e42fefa2p-1) - n * 0x1.9ef35793c7673p-41;
  double sum = 1.0;
  for (int i = 14; i > 0; i--)
    sum = 1.0 + r / i * sum;
  return ldexp(sum, (int)n);
}

/* Like mo_distance. */
MO_COURSE double course_length(double dx_m, double dy_m)
{
  double a = fmax(fabs(dx_m), fabs(dy_m)), b = fmin(fabs(dx_m), fabs(dy_m));
  double unit = 1.0, excess;
  if (isinf(dx_m) || isinf(dy_m))
    return (double)INFINITY;
  if (isnan(dx_m) || isnan(dy_m))
    return (double)NAN;
  if (b <= a * 0x1p-54)
    return a + b;
  if (a > 0x1p510 || b < 0x1p-459) {
    unit = a > 0x1p510 ? 0x1p600 : 0x1p-600;
    a /= unit;
    b /= unit;
  }
  const double e = sqrt(a * a + b * b);
  if (e <= 2.0 * b) {
    const double rest = e - b;
    excess = a * (2.0 * rest - a) + (rest - 2.0 * (a - b)) * rest;
  } else {
    const double rest = e - a;
    excess = 2.0 * rest * (a - 2.0 * b) + ((4.0 * rest - b) * b + rest * rest);
  }
  return (e - excess / (2.0 * e)) * unit;
}

/* ---- the path ---- */

MO_COURSE const struct mo_guide *course_guide(const struct mo_course *course)
{
  return &course->environment->task.guide;
}

MO_COURSE double course_distance(const double *a_m, const double *b_m)
{
  return course_length(a_m[0] - b_m[0], a_m[1] - b_m[1]);
}

MO_COURSE double course_dot(const double *a, const double *b)
{
  return a[0] * b[0] + a[1] * b[1];
}

MO_COURSE const double *course_leg_start(const struct mo_course *course, uint32_t leg)
{
  return leg == 0 ? course->start_m : course_guide(course)->points_m[leg - 1];
}

MO_COURSE const double *course_leg_end(const struct mo_course *course, uint32_t leg)
{
  return course_guide(course)->points_m[leg];
}

MO_COURSE void course_face(const struct mo_course *course, struct mo_track *track)
{
  const double *from = course_leg_start(course, track->leg),
               *to = course_leg_end(course, track->leg);
  const double length = course_distance(to, from);
  track->length_m = length;
  for (int axis = 0; axis < 2; axis++)
    track->facing[axis] = length > 0 ? (to[axis] - from[axis]) / length : 0;
}

MO_COURSE double course_along_leg(const struct mo_course *course, const struct mo_track *track)
{
  const double *from = course_leg_start(course, track->leg);
  const double away[2] = {track->com_m[0] - from[0], track->com_m[1] - from[1]};
  return course_dot(away, track->facing);
}

MO_COURSE void course_off_path(const struct mo_course *course, const struct mo_track *track,
                               double off_m[2])
{
  const double *from = course_leg_start(course, track->leg);
  const double along = fmin(fmax(course_along_leg(course, track), 0.0), track->length_m);
  for (int axis = 0; axis < 2; axis++)
    off_m[axis] = track->com_m[axis] - (from[axis] + along * track->facing[axis]);
}

MO_COURSE void course_make_progress(const struct mo_course *course, struct mo_track *track)
{
  track->along_is = MO_TRACK_WORD(MO_TRACK_KEPT);
  while (track->leg + 1 < course_guide(course)->n_points &&
         course_distance(track->com_m, course_leg_end(course, track->leg)) <= MO_GUIDE_REACHED_M) {
    track->before_m += track->length_m;
    track->along_m = 0;
    track->along_is = MO_TRACK_WORD(MO_TRACK_SET);
    track->leg++;
    course_face(course, track);
  }
  const double along = course_along_leg(course, track);
  if (!(along > track->along_m))
    return;
  track->along_is =
      along < track->length_m ? MO_TRACK_WORD(MO_TRACK_MOVED) : MO_TRACK_WORD(MO_TRACK_SET);
  track->along_m = fmin(along, track->length_m);
}

/* ---- an instant ---- */

MO_COURSE void course_point(double angle_rad, double facing[2])
{
  facing[0] = course_sin(angle_rad + 0.5 * MO_COURSE_PI);
  facing[1] = course_sin(angle_rad);
}

MO_COURSE void course_aim(const struct mo_course *course, double t_s, struct mo_track *track)
{
  const struct mo_guide *guide = course_guide(course);
  const enum mo_guide_kind kind = guide->kind;
  if (kind == MO_GUIDE_PATH)
    course_make_progress(course, track);
  else if (kind == MO_GUIDE_TURNING || (kind == MO_GUIDE_MOVING && guide->turn_rad_per_s != 0))
    course_point(kind == MO_GUIDE_TURNING ? guide->heading_rad + guide->turn_rad_per_s * t_s
                                          : guide->turn_rad_per_s * t_s,
                 track->facing);
}

MO_COURSE void course_light_xy(const struct mo_course *course, double t_s,
                               const struct mo_track *track, double *light_m)
{
  const struct mo_guide *guide = course_guide(course);
  const double *xy = course->environment->light_xy_m, *facing = track->facing;
  const enum mo_guide_kind kind = guide->kind;
  light_m[0] = xy[0];
  light_m[1] = xy[1];
  if (kind == MO_GUIDE_AHEAD || kind == MO_GUIDE_TURNING) {
    for (int axis = 0; axis < 2; axis++)
      light_m[axis] = track->com_m[axis] + guide->distance_m * facing[axis];
  } else if (kind == MO_GUIDE_PATH) {
    const double along = fmin(track->along_m + guide->distance_m, track->length_m);
    for (int axis = 0; axis < 2; axis++)
      light_m[axis] = course_leg_start(course, track->leg)[axis] + along * facing[axis];
  } else if (kind == MO_GUIDE_MOVING) {
    const double arm[2] = {xy[0] - guide->center_m[0], xy[1] - guide->center_m[1]};
    const double turned[2] = {arm[0] * facing[0] - arm[1] * facing[1],
                              arm[0] * facing[1] + arm[1] * facing[0]};
    for (int axis = 0; axis < 2; axis++)
      light_m[axis] = guide->center_m[axis] + guide->velocity_m_per_s[axis] * t_s + turned[axis];
  }
}

/* Like mo_course_light. */
MO_COURSE void course_light(const struct mo_course *course, double t_s,
                            const struct mo_track *track, double light_m[3])
{
  course_light_xy(course, t_s, track, light_m);
  const struct terrain_map map = terrain_map_of(course->environment);
  light_m[2] = terrain_height(&map, course->environment->terrain_heights_m, light_m[0], light_m[1]);
}

/* Like mo_course_begin, for a rollout of n_periods control periods that ends at end_s. */
MO_COURSE void course_begin(struct mo_course *course, const struct mo_environment *environment,
                            double end_s, uint32_t n_periods, const double com_start_m[3],
                            struct mo_track *track)
{
  const struct mo_guide *guide = &environment->task.guide;
  course->environment = environment;
  course->end_s = end_s;
  course->n_periods = n_periods;
  for (int axis = 0; axis < 3; axis++)
    course->start_m[axis] = track->com_m[axis] = com_start_m[axis];
  track->sum = track->length_m = track->before_m = track->along_m = 0;
  track->facing[0] = 1;
  track->facing[1] = 0;
  track->leg = 0;
  track->along_is = MO_TRACK_WORD(MO_TRACK_KEPT);
  if (guide->kind == MO_GUIDE_AHEAD)
    course_point(guide->heading_rad, track->facing);
  else if (guide->kind == MO_GUIDE_PATH)
    course_face(course, track);
  course_aim(course, 0, track);
  track->before_m = -track->along_m;
  switch (environment->task.objective) {
  case MO_OBJECTIVE_REACH:
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: {
    double light_m[2];
    course_light_xy(course, 0, track, light_m);
    course->scale_m = course_distance(com_start_m, light_m) + 1e-8;
    break;
  }
  case MO_OBJECTIVE_TRAVEL:
  case MO_OBJECTIVE_FOLLOW: course->scale_m = MO_COURSE_TRAVEL_M; break;
  case MO_OBJECTIVE_CLIMB: course->scale_m = MO_COURSE_CLIMB_M; break;
  default: course->scale_m = 1; /* the host computes the loss */
  }
}

/* Like mo_course_advance, but without the tally. */
MO_COURSE void course_advance(const struct mo_course *course, double t_s, const double com_m[3],
                              struct mo_track *track)
{
  const enum mo_objective objective = course->environment->task.objective;
  if (objective == MO_OBJECTIVE_TRAVEL) {
    const double way[2] = {com_m[0] - track->com_m[0], com_m[1] - track->com_m[1]};
    track->sum += course_dot(way, track->facing);
  }
  for (int axis = 0; axis < 3; axis++)
    track->com_m[axis] = com_m[axis];
  course_aim(course, t_s, track);
  if (objective == MO_OBJECTIVE_APPROACH || objective == MO_OBJECTIVE_PURSUE) {
    double light_m[2];
    course_light_xy(course, t_s, track, light_m);
    track->sum += course_distance(com_m, light_m);
  } else if (objective == MO_OBJECTIVE_FOLLOW) {
    double off_m[2];
    course_off_path(course, track, off_m);
    track->sum += course_length(off_m[0], off_m[1]);
  }
}

/* ---- the tally of other objectives and of sums, of which the host makes the result ---- */

/* What tallies add up, as in course.c; PEAK is not a sum. */
enum { COURSE_WAY, COURSE_AWAY, COURSE_OFF, COURSE_PATH, COURSE_HEIGHT, COURSE_PEAK };

/* Returns whether a task has a tally. */
MO_COURSE bool course_has_tally(const struct mo_task *task)
{
  return task->objective > MO_OBJECTIVE_PURSUE;
}

/* Like sum_of_term. */
MO_COURSE unsigned course_need(uint32_t term)
{
  switch (term) {
  case MO_OBJECTIVE_TRAVEL: return 1U << COURSE_WAY;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: return 1U << COURSE_AWAY;
  case MO_OBJECTIVE_FOLLOW: return 1U << COURSE_OFF;
  case MO_OBJECTIVE_JUMP: return 1U << COURSE_PEAK;
  case MO_TERM_MEASURE + MO_MEASURE_PATH_LENGTH:
  case MO_TERM_MEASURE + MO_MEASURE_MEAN_SPEED:
  case MO_TERM_MEASURE + MO_MEASURE_STRAIGHTNESS: return 1U << COURSE_PATH;
  case MO_TERM_MEASURE + MO_MEASURE_MEAN_HEIGHT: return 1U << COURSE_HEIGHT;
  default: return 0;
  }
}

MO_COURSE unsigned course_needs(const struct mo_task *task)
{
  unsigned needs = 0;
  if (task->objective != MO_OBJECTIVE_SUM)
    return course_need((uint32_t)task->objective);
  for (uint32_t i = 0; i < task->n_terms; i++)
    needs |= course_need(task->terms[i]);
  return needs;
}

MO_COURSE void course_begin_tally(struct mo_track *track)
{
  for (int k = 0; k < 5; k++)
    track->tally.sums[k] = 0;
  track->tally.peak_m = -(double)INFINITY;
  track->tally.soft = 0;
  track->tally.n_heights = 0;
}

/* Returns whether the height at an instant counts for a jump. */
MO_COURSE bool course_counts(const struct mo_course *course, double t_s)
{
  return t_s >= fmin(MO_JUMP_FROM_S, course->end_s) - 1e-9;
}

/* Like mo_course_advance, from the instant before to that of `track`, which course_advance has
 * reached. The smooth maximum of heights is left out: only gradients have it. */
MO_COURSE void course_add_tally(const struct mo_course *course, double t_s,
                                const struct mo_track *before, struct mo_track *track)
{
  const struct mo_environment *environment = course->environment;
  const unsigned needs = course_needs(&environment->task);
  double *sums = track->tally.sums;
  if ((needs >> COURSE_WAY & 1) != 0) {
    const double way[2] = {track->com_m[0] - before->com_m[0], track->com_m[1] - before->com_m[1]};
    sums[COURSE_WAY] += course_dot(way, before->facing);
  }
  if ((needs >> COURSE_PATH & 1) != 0)
    sums[COURSE_PATH] += course_distance(track->com_m, before->com_m);
  if ((needs >> COURSE_AWAY & 1) != 0) {
    double light_m[2];
    course_light_xy(course, t_s, track, light_m);
    sums[COURSE_AWAY] += course_distance(track->com_m, light_m);
  }
  if ((needs >> COURSE_OFF & 1) != 0) {
    double off_m[2];
    course_off_path(course, track, off_m);
    sums[COURSE_OFF] += course_length(off_m[0], off_m[1]);
  }
  if ((needs >> COURSE_HEIGHT & 1) != 0) {
    const struct terrain_map map = terrain_map_of(environment);
    sums[COURSE_HEIGHT] += track->com_m[2] - terrain_height(&map, environment->terrain_heights_m,
                                                            track->com_m[0], track->com_m[1]);
  }
  if ((needs >> COURSE_PEAK & 1) != 0 && course_counts(course, t_s))
    track->tally.peak_m = fmax(track->tally.peak_m, track->com_m[2]);
}

/* ---- the result ---- */

struct course_result {
  double loss, value;
};

/* Like mo_course_finish, for a rollout that did not diverge and a task without a tally. */
MO_COURSE struct course_result course_finish(const struct mo_course *course,
                                             const struct mo_track *track)
{
  struct course_result result = {0, 0};
  double light_m[2], share = 0, x;
  switch (course->environment->task.objective) {
  case MO_OBJECTIVE_REACH:
    course_light_xy(course, course->end_s, track, light_m);
    share = course_distance(track->com_m, light_m) / course->scale_m;
    result.loss = share;
    result.value = 1 - share;
    return result;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE:
    share = track->sum / course->n_periods / course->scale_m;
    result.loss = share;
    result.value = 1 - share;
    return result;
  case MO_OBJECTIVE_TRAVEL: result.value = track->sum; break;
  case MO_OBJECTIVE_FOLLOW:
    result.value = track->before_m + track->along_m - track->sum / course->n_periods;
    break;
  case MO_OBJECTIVE_CLIMB: result.value = track->com_m[2] - course->start_m[2]; break;
  default: break; /* the host has the result */
  }
  x = fmin(fmax(-result.value / course->scale_m, -MO_COURSE_EXPONENT_MAX), MO_COURSE_EXPONENT_MAX);
  result.loss = x <= 0 ? course_exp(x) : 1 / course_exp(-x);
  return result;
}

#endif
