/* course.c: see course.h: the light, the sums, and the values. course_back.c has the derivatives.
 *
 * Sines and exponentials are those of elementary.c, so that no bit depends on the C library. */
#include "rollout/course_terms.h"
#include "rollout/fast.h"

#include <string.h>

#define EXPONENT_MAX 600.0 /* mo_fast_exp is 0 below −700 */

/* Returns exp(x) for x of either sign. A body can fall so far that the loss would overflow, but
 * only a body that diverged may have an infinite loss. */
static double exponential(double x)
{
  const double bounded = fmin(fmax(x, -EXPONENT_MAX), EXPONENT_MAX);
  return bounded <= 0 ? mo_fast_exp(bounded) : 1 / mo_fast_exp(-bounded);
}

static double height_of(const struct mo_course *course, const double com_m[3])
{
  return com_m[2] - mo_terrain_height(course->environment, com_m[0], com_m[1]);
}

/* ---- the path ---- */

static const double *leg_end(const struct mo_course *course, uint32_t leg)
{
  return guide_of(course)->points_m[leg];
}

/* Begins leg number track->leg. */
static void face(const struct mo_course *course, struct mo_track *track)
{
  const double *from = leg_start(course, track->leg), *to = leg_end(course, track->leg);
  track->length_m = distance(to, from);
  for (int axis = 0; axis < 2; axis++)
    track->facing[axis] = track->length_m > 0 ? (to[axis] - from[axis]) / track->length_m : 0;
}

/* Returns how far along the track's leg the point nearest to the center of mass is, with the leg
 * extended to an infinite line. */
static double along_leg(const struct mo_course *course, const struct mo_track *track)
{
  const double *from = leg_start(course, track->leg);
  const double away[2] = {track->com_m[0] - from[0], track->com_m[1] - from[1]};
  return dot(away, track->facing);
}

void mo_course_off_path(const struct mo_course *course, const struct mo_track *track,
                        double off_m[2])
{
  const double *from = leg_start(course, track->leg);
  const double along = fmin(fmax(along_leg(course, track), 0), track->length_m);
  for (int axis = 0; axis < 2; axis++)
    off_m[axis] = track->com_m[axis] - (from[axis] + along * track->facing[axis]);
}

/* Advances the progress to the center of mass: past the waypoints that it has reached, then along
 * the leg. */
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

/* ---- heights of a jump ---- */

bool mo_course_counts(const struct mo_course *course, double t_s)
{
  return t_s >= fmin(MO_JUMP_FROM_S, course->end_s) - 1e-9;
}

double mo_course_soft_share(double height_m, double peak_m)
{
  return mo_fast_exp((height_m - peak_m) / MO_JUMP_SOFTNESS_M);
}

/* ---- an instant ---- */

/* Sets a unit vector to the direction of an angle. */
static void point(double angle_rad, double facing[2])
{
  facing[0] = mo_fast_sin(angle_rad + 0.5 * M_PI);
  facing[1] = mo_fast_sin(angle_rad);
}

/* Sets the direction of the guide at time t_s from the track's center of mass; the guide `ahead`
 * keeps its heading. */
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

void mo_course_light_xy(const struct mo_course *course, double t_s, const struct mo_track *track,
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
  mo_course_light_xy(course, t_s, track, light_m);
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
  /* Progress is 0 at the start, even if waypoints are reached there. */
  track->before_m = -track->along_m;
  track->tally.peak_m = -(double)INFINITY;
  course->scale_m = mo_objective_scale(environment->task.objective);
  if (environment->task.objective == MO_OBJECTIVE_EFFICIENT ||
      environment->task.objective == MO_OBJECTIVE_SUM) {
    course->scale_m = 1; /* their losses do not measure a distance */
  } else if (course->scale_m == 0) {
    double light_m[2];
    mo_course_light_xy(course, 0, track, light_m);
    course->scale_m = distance(com_start_m, light_m) + 1e-8;
  }
}

/* Adds the height of the center of mass at an instant to the heights of a jump. */
static void look_up(const struct mo_course *course, double t_s, struct mo_track *track)
{
  struct mo_tally *tally = &track->tally;
  const double height = track->com_m[2];
  if (!mo_course_counts(course, t_s))
    return;
  tally->n_heights++;
  if (height > tally->peak_m) {
    tally->soft *= mo_course_soft_share(tally->peak_m, height);
    tally->peak_m = height;
  }
  tally->soft += mo_course_soft_share(height, tally->peak_m);
}

void mo_course_advance(const struct mo_course *course, double t_s, const double com_m[3],
                       struct mo_track *track)
{
  const unsigned needs = needs_of(course);
  double light_m[2], off_m[2];
  if ((needs >> WAY & 1) != 0) {
    const double way[2] = {com_m[0] - track->com_m[0], com_m[1] - track->com_m[1]};
    *sum_at(course, track, WAY) += dot(way, track->facing);
  }
  if ((needs >> PATH & 1) != 0)
    track->tally.sums[PATH] += distance(com_m, track->com_m);
  memcpy(track->com_m, com_m, sizeof(track->com_m));
  aim(course, t_s, track);
  if ((needs >> AWAY & 1) != 0) {
    mo_course_light_xy(course, t_s, track, light_m);
    *sum_at(course, track, AWAY) += distance(com_m, light_m);
  }
  if ((needs >> OFF & 1) != 0) {
    mo_course_off_path(course, track, off_m);
    *sum_at(course, track, OFF) += mo_distance(off_m[0], off_m[1]);
  }
  if ((needs >> HEIGHT & 1) != 0)
    track->tally.sums[HEIGHT] += height_of(course, com_m);
  if ((needs & PEAK) != 0)
    look_up(course, t_s, track);
}

/* ---- values ---- */

/* Returns 1 − the value of `reach`, `approach` or `pursue`, which is the loss if this is the only
 * term. */
static double share_of(const struct mo_course *course, const struct mo_track *track, uint32_t term)
{
  double light_m[2];
  if (term != MO_OBJECTIVE_REACH)
    return sum_in(course, track, AWAY) / course->n_periods / far_m(course);
  mo_course_light_xy(course, course->end_s, track, light_m);
  return distance(track->com_m, light_m) / far_m(course);
}

double mo_course_value(const struct mo_course *course, const struct mo_track *track,
                       const struct mo_observed *observed, bool soft, uint32_t term)
{
  const struct mo_tally *tally = &track->tally;
  const double displacement = distance(track->com_m, course->start_m);
  switch (term) {
  case MO_OBJECTIVE_REACH:
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: return 1 - share_of(course, track, term);
  case MO_OBJECTIVE_TRAVEL: return sum_in(course, track, WAY);
  case MO_OBJECTIVE_FOLLOW:
    return track->before_m + track->along_m - sum_in(course, track, OFF) / course->n_periods;
  case MO_OBJECTIVE_CLIMB: return track->com_m[2] - course->start_m[2];
  case MO_OBJECTIVE_EFFICIENT:
    return fmax(displacement - MO_EFFICIENT_FLOOR_M, 0) / work_kj(observed->work_j);
  case MO_OBJECTIVE_JUMP: {
    const double below =
        soft ? MO_JUMP_SOFTNESS_M * mo_fast_log(tally->soft / tally->n_heights) : 0;
    return tally->peak_m + below - course->start_m[2] - MO_JUMP_SIDEWAYS * displacement;
  }
  case MEASURE(DISPLACEMENT): return displacement;
  case MEASURE(PATH_LENGTH): return tally->sums[PATH];
  case MEASURE(MEAN_SPEED): return tally->sums[PATH] / course->end_s;
  case MEASURE(STRAIGHTNESS): return tally->sums[PATH] > 0 ? displacement / tally->sums[PATH] : 0;
  case MEASURE(MEAN_HEIGHT): return tally->sums[HEIGHT] / course->n_periods;
  case MEASURE(WORK): return observed->work_j;
  default: return observed->measures != NULL ? observed->measures[term - MO_TERM_MEASURE] : NAN;
  }
}

static double loss_of(const struct mo_course *course, const struct mo_track *track,
                      const struct mo_observed *observed, bool soft, double *value)
{
  const struct mo_task *task = task_of(course);
  const double scale = mo_objective_scale(task->objective);
  if (scale == 0) {
    const double share = share_of(course, track, task->objective);
    *value = 1 - share;
    return share;
  }
  *value = 0;
  for (uint32_t i = 0; i < terms_of(course); i++)
    *value +=
        weight_of(course, i) * mo_course_value(course, track, observed, soft, term_of(course, i));
  return exponential(-*value / scale);
}

void mo_course_finish(const struct mo_course *course, const struct mo_track *track,
                      const struct mo_observed *observed, struct mo_outcome *outcome)
{
  if (outcome->diverged_step != 0) {
    outcome->loss = (double)INFINITY;
    outcome->value = -(double)INFINITY;
    return;
  }
  outcome->loss = loss_of(course, track, observed, false, &outcome->value);
}

double mo_course_soft_loss(const struct mo_course *course, const struct mo_track *track,
                           const struct mo_observed *observed)
{
  double value;
  return loss_of(course, track, observed, true, &value);
}
