/* course.c: see course.h.
 *
 * Sines and exponentials are those of elementary.c, so that no bit depends on the C library. */
#include "rollout/course.h"

#include "rollout/distance.h"
#include "rollout/fast.h"

#include <math.h>
#include <string.h>

#define EXPONENT_MAX 600.0 /* mo_fast_exp is 0 below −700 */

static const struct mo_guide *guide_of(const struct mo_course *course)
{
  return &course->environment->task.guide;
}

static double distance(const double *a_m, const double *b_m)
{
  return mo_distance(a_m[0] - b_m[0], a_m[1] - b_m[1]);
}

static double dot(const double a[2], const double b[2])
{
  return a[0] * b[0] + a[1] * b[1];
}

/* exp(x), of either sign. A body can fall so far that the loss would overflow; only one that
 * diverged has an infinite loss. */
static double exponential(double x)
{
  const double bounded = fmin(fmax(x, -EXPONENT_MAX), EXPONENT_MAX);
  return bounded <= 0 ? mo_fast_exp(bounded) : 1 / mo_fast_exp(-bounded);
}

/* ---- the path ---- */

static const double *leg_start(const struct mo_course *course, uint32_t leg)
{
  return leg == 0 ? course->start_m : guide_of(course)->points_m[leg - 1];
}

static const double *leg_end(const struct mo_course *course, uint32_t leg)
{
  return guide_of(course)->points_m[leg];
}

/* Begins the leg number track->leg. */
static void face(const struct mo_course *course, struct mo_track *track)
{
  const double *from = leg_start(course, track->leg), *to = leg_end(course, track->leg);
  track->length_m = distance(to, from);
  for (int axis = 0; axis < 2; axis++)
    track->facing[axis] = track->length_m > 0 ? (to[axis] - from[axis]) / track->length_m : 0;
}

/* How far along the track's leg the place nearest to its center of mass is, if the leg had no
 * ends. */
static double along_leg(const struct mo_course *course, const struct mo_track *track)
{
  const double *from = leg_start(course, track->leg);
  const double away[2] = {track->com_m[0] - from[0], track->com_m[1] - from[1]};
  return dot(away, track->facing);
}

/* From the track's leg, its nearest place, to the center of mass. */
static void off_path(const struct mo_course *course, const struct mo_track *track, double off_m[2])
{
  const double *from = leg_start(course, track->leg);
  const double along = fmin(fmax(along_leg(course, track), 0), track->length_m);
  for (int axis = 0; axis < 2; axis++)
    off_m[axis] = track->com_m[axis] - (from[axis] + along * track->facing[axis]);
}

/* Moves the progress to where the center of mass is: to the next legs whose way-points it has
 * reached, then along the leg. */
static void make_progress(const struct mo_course *course, struct mo_track *track)
{
  track->along_is = MO_TRACK_KEPT;
  while (track->leg + 1 < guide_of(course)->n_points &&
         distance(track->com_m, leg_end(course, track->leg)) <= MO_GUIDE_REACHED_M) {
    track->before_m += track->length_m;
    track->along_m = 0;
    track->along_is = MO_TRACK_SET;
    track->leg++;
    face(course, track);
  }
  const double along = along_leg(course, track);
  if (!(along > track->along_m))
    return;
  track->along_is = along < track->length_m ? MO_TRACK_MOVED : MO_TRACK_SET;
  track->along_m = fmin(along, track->length_m);
}

/* ---- an instant ---- */

/* Sets a unit vector to the direction of an angle. */
static void point(double angle_rad, double facing[2])
{
  facing[0] = mo_fast_sin(angle_rad + 0.5 * M_PI);
  facing[1] = mo_fast_sin(angle_rad);
}

/* Aims at time t_s from the track's center of mass; an `ahead` keeps its heading. */
static void aim(const struct mo_course *course, double t_s, struct mo_track *track)
{
  const struct mo_guide *guide = guide_of(course);
  switch (guide->kind) {
  case MO_GUIDE_FIXED:
  case MO_GUIDE_AHEAD: return;
  case MO_GUIDE_TURNING:
    point(guide->heading_rad + guide->turn_rad_per_s * t_s, track->facing);
    return;
  case MO_GUIDE_PATH: make_progress(course, track); return;
  case MO_GUIDE_MOVING:
    if (guide->turn_rad_per_s != 0)
      point(guide->turn_rad_per_s * t_s, track->facing);
    return;
  }
}

/* Places the light in x and y. */
static void light_xy(const struct mo_course *course, double t_s, const struct mo_track *track,
                     double light_m[2])
{
  const struct mo_guide *guide = guide_of(course);
  const double *xy = course->environment->light_xy_m, *facing = track->facing;
  switch (guide->kind) {
  case MO_GUIDE_FIXED: memcpy(light_m, xy, 2 * sizeof(double)); break;
  case MO_GUIDE_AHEAD:
  case MO_GUIDE_TURNING:
    for (int axis = 0; axis < 2; axis++)
      light_m[axis] = track->com_m[axis] + guide->distance_m * facing[axis];
    break;
  case MO_GUIDE_PATH: {
    const double along = fmin(track->along_m + guide->distance_m, track->length_m);
    for (int axis = 0; axis < 2; axis++)
      light_m[axis] = leg_start(course, track->leg)[axis] + along * facing[axis];
    break;
  }
  case MO_GUIDE_MOVING: {
    const double arm[2] = {xy[0] - guide->center_m[0], xy[1] - guide->center_m[1]};
    const double turned[2] = {arm[0] * facing[0] - arm[1] * facing[1],
                              arm[0] * facing[1] + arm[1] * facing[0]};
    for (int axis = 0; axis < 2; axis++)
      light_m[axis] = guide->center_m[axis] + guide->velocity_m_per_s[axis] * t_s + turned[axis];
    break;
  }
  }
}

void mo_course_light(const struct mo_course *course, double t_s, const struct mo_track *track,
                     double light_m[3])
{
  light_xy(course, t_s, track, light_m);
  light_m[2] = mo_terrain_height(course->environment, light_m[0], light_m[1]);
}

void mo_course_begin(struct mo_course *course, const struct mo_environment *environment,
                     const struct mo_scheme *scheme, const double com_start_m[3],
                     struct mo_track *track)
{
  const struct mo_guide *guide = &environment->task.guide;
  const uint32_t period = mo_control_steps(scheme);
  *course =
      (struct mo_course){.environment = environment,
                         .end_s = scheme->n_steps * scheme->dt_s,
                         .n_periods = scheme->n_steps / period + (scheme->n_steps % period != 0)};
  memcpy(course->start_m, com_start_m, sizeof(course->start_m));
  *track = (struct mo_track){.facing = {1, 0}};
  memcpy(track->com_m, com_start_m, sizeof(track->com_m));
  if (guide->kind == MO_GUIDE_AHEAD)
    point(guide->heading_rad, track->facing);
  else if (guide->kind == MO_GUIDE_PATH)
    face(course, track);
  aim(course, 0, track);
  track->before_m = -track->along_m; /* progress is 0 at the start, even if it reaches way-points */
  course->scale_m = mo_objective_scale(environment->task.objective);
  if (course->scale_m == 0) {
    double light_m[2];
    light_xy(course, 0, track, light_m);
    course->scale_m = distance(com_start_m, light_m) + 1e-8;
  }
}

void mo_course_advance(const struct mo_course *course, double t_s, const double com_m[3],
                       struct mo_track *track)
{
  const enum mo_objective objective = course->environment->task.objective;
  if (objective == MO_OBJECTIVE_TRAVEL) {
    const double way[2] = {com_m[0] - track->com_m[0], com_m[1] - track->com_m[1]};
    track->sum += dot(way, track->facing);
  }
  memcpy(track->com_m, com_m, sizeof(track->com_m));
  aim(course, t_s, track);
  if (objective == MO_OBJECTIVE_APPROACH || objective == MO_OBJECTIVE_PURSUE) {
    double light_m[2];
    light_xy(course, t_s, track, light_m);
    track->sum += distance(com_m, light_m);
  } else if (objective == MO_OBJECTIVE_FOLLOW) {
    double off_m[2];
    off_path(course, track, off_m);
    track->sum += mo_distance(off_m[0], off_m[1]);
  }
}

void mo_course_finish(const struct mo_course *course, const struct mo_track *track,
                      struct mo_outcome *outcome)
{
  double light_m[2], share = 0;
  switch (course->environment->task.objective) {
  case MO_OBJECTIVE_REACH:
    light_xy(course, course->end_s, track, light_m);
    share = distance(track->com_m, light_m) / course->scale_m;
    break;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: share = track->sum / course->n_periods / course->scale_m; break;
  case MO_OBJECTIVE_TRAVEL: outcome->value = track->sum; break;
  case MO_OBJECTIVE_FOLLOW:
    outcome->value = track->before_m + track->along_m - track->sum / course->n_periods;
    break;
  case MO_OBJECTIVE_CLIMB: outcome->value = track->com_m[2] - course->start_m[2]; break;
  }
  const bool is_share = mo_objective_scale(course->environment->task.objective) == 0;
  outcome->loss = is_share ? share : exponential(-outcome->value / course->scale_m);
  if (is_share)
    outcome->value = 1 - share;
  if (outcome->diverged_step != 0) {
    outcome->loss = (double)INFINITY;
    outcome->value = -(double)INFINITY;
  }
}

/* ---- backward ---- */

/* d += factor · (a − b) / |a − b| in x, y; nothing where they meet. */
static void add_away(double factor, const double *a_m, const double *b_m, double d[3])
{
  const double length = distance(a_m, b_m);
  for (int axis = 0; axis < 2 && length > 0; axis++)
    d[axis] += factor * (a_m[axis] - b_m[axis]) / length;
}

static void add_facing(double factor, const struct mo_track *track, double d[3])
{
  for (int axis = 0; axis < 2; axis++)
    d[axis] += factor * track->facing[axis];
}

/* Passes back what this instant added to the sum. before: NULL at the start, which adds nothing. */
static void sum_back(const struct mo_course *course, double t_s, const struct mo_track *before,
                     const struct mo_track *track, double d_sum, double d_com[3])
{
  const enum mo_objective objective = course->environment->task.objective;
  double light_m[2], off_m[2];
  if (before == NULL)
    return;
  if (objective == MO_OBJECTIVE_TRAVEL) {
    add_facing(d_sum, before, d_com);
  } else if (objective == MO_OBJECTIVE_APPROACH || objective == MO_OBJECTIVE_PURSUE) {
    light_xy(course, t_s, track, light_m);
    add_away(d_sum, track->com_m, light_m, d_com);
  } else if (objective == MO_OBJECTIVE_FOLLOW) {
    static const double on_path[2] = {0, 0};
    off_path(course, track, off_m);
    add_away(d_sum, off_m, on_path, d_com);
  }
}

static void progress_back(const struct mo_track *track, struct mo_course_adjoint *adjoint,
                          double d_com[3])
{
  if (track->along_is == MO_TRACK_KEPT)
    return;
  if (track->along_is == MO_TRACK_MOVED)
    add_facing(adjoint->d_along, track, d_com);
  adjoint->d_along = 0;
}

void mo_course_end_back(const struct mo_course *course, const struct mo_track *before,
                        const struct mo_track *track, double loss,
                        struct mo_course_adjoint *adjoint, double d_com[3])
{
  double light_m[2];
  *adjoint = (struct mo_course_adjoint){0};
  memset(d_com, 0, 3 * sizeof(double));
  switch (course->environment->task.objective) {
  case MO_OBJECTIVE_REACH: /* loss = |com − light| / scale */
    light_xy(course, course->end_s, track, light_m);
    add_away(1 / course->scale_m, track->com_m, light_m, d_com);
    break;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: /* loss = sum / n / scale */
    adjoint->d_sum = 1 / (course->scale_m * course->n_periods);
    break;
  case MO_OBJECTIVE_TRAVEL: /* loss = exp(−sum / scale) */
    adjoint->d_sum = -loss / course->scale_m;
    break;
  case MO_OBJECTIVE_FOLLOW: /* loss = exp(−(before + along − sum / n) / scale) */
    adjoint->d_along = -loss / course->scale_m;
    adjoint->d_sum = loss / course->scale_m / course->n_periods;
    break;
  case MO_OBJECTIVE_CLIMB: /* loss = exp(−(z − z at the start) / scale) */
    d_com[2] = -loss / course->scale_m;
    break;
  }
  sum_back(course, course->end_s, before, track, adjoint->d_sum, d_com);
  progress_back(track, adjoint, d_com);
}

void mo_course_back(const struct mo_course *course, double t_s, const struct mo_track *before,
                    const struct mo_track *track, const double d_light[3],
                    struct mo_course_adjoint *adjoint, double d_com[3])
{
  const struct mo_guide *guide = guide_of(course);
  double light_m[2], slope[2];
  memset(d_com, 0, 3 * sizeof(double));
  light_xy(course, t_s, track, light_m);
  mo_terrain_gradient(course->environment, light_m[0], light_m[1], slope);
  /* light[2] = height(light[0], light[1]) */
  const double d_xy[2] = {d_light[0] + slope[0] * d_light[2], d_light[1] + slope[1] * d_light[2]};
  if (guide->kind == MO_GUIDE_AHEAD || guide->kind == MO_GUIDE_TURNING) {
    d_com[0] = d_xy[0]; /* light = com + distance · facing */
    d_com[1] = d_xy[1];
  } else if (guide->kind == MO_GUIDE_PATH && track->along_m + guide->distance_m < track->length_m) {
    adjoint->d_along += dot(d_xy, track->facing); /* light = … + (along + distance) · facing */
  }
  if (course->environment->task.objective == MO_OBJECTIVE_TRAVEL)
    add_facing(-adjoint->d_sum, track, d_com); /* sum += (the next com − com) · facing */
  sum_back(course, t_s, before, track, adjoint->d_sum, d_com);
  progress_back(track, adjoint, d_com);
}

void mo_course_restart(const struct mo_course *course, double t_s, const struct mo_track *track,
                       const double com_m[3], double loss, double weight,
                       struct mo_course_adjoint *adjoint, double d_com[3])
{
  double light_m[2];
  memset(d_com, 0, 3 * sizeof(double));
  adjoint->d_along = 0;
  switch (course->environment->task.objective) {
  case MO_OBJECTIVE_REACH:
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE:
    light_xy(course, t_s, track, light_m);
    add_away(weight / course->scale_m, com_m, light_m, d_com);
    break;
  case MO_OBJECTIVE_TRAVEL:
  case MO_OBJECTIVE_FOLLOW: add_facing(-weight * loss / course->scale_m, track, d_com); break;
  case MO_OBJECTIVE_CLIMB: d_com[2] = -weight * loss / course->scale_m; break;
  }
}
