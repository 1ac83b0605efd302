/* course.c: see course.h.
 *
 * Sines and exponentials are those of elementary.c, so that no bit depends on the C library. */
#include "rollout/course.h"

#include "rollout/distance.h"
#include "rollout/fast.h"

#include <math.h>
#include <string.h>

#define EXPONENT_MAX 600.0 /* mo_fast_exp is 0 below −700 */

/* What objectives and measures add up. Of a single objective, struct mo_track has the sum. */
enum { WAY, AWAY, OFF, PATH, HEIGHT, SUMS };
_Static_assert(SUMS == sizeof(((struct mo_tally *)0)->sums) / sizeof(double), "one place each");

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

/* ---- the terms ---- */

static const struct mo_task *task_of(const struct mo_course *course)
{
  return &course->environment->task;
}

static bool is_sum(const struct mo_course *course)
{
  return task_of(course)->objective == MO_OBJECTIVE_SUM;
}

/* A single objective is one term. */
static uint32_t terms_of(const struct mo_course *course)
{
  return is_sum(course) ? task_of(course)->n_terms : 1;
}

static uint32_t term_of(const struct mo_course *course, uint32_t i)
{
  return is_sum(course) ? task_of(course)->terms[i] : (uint32_t)task_of(course)->objective;
}

static double weight_of(const struct mo_course *course, uint32_t i)
{
  return is_sum(course) ? task_of(course)->weights[i] : 1;
}

#define MEASURE(name) (MO_TERM_MEASURE + MO_MEASURE_##name)

/* Returns the sum that a term has, or SUMS. */
static unsigned sum_of_term(uint32_t term)
{
  switch (term) {
  case MO_OBJECTIVE_TRAVEL: return WAY;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: return AWAY;
  case MO_OBJECTIVE_FOLLOW: return OFF;
  case MEASURE(PATH_LENGTH):
  case MEASURE(MEAN_SPEED):
  case MEASURE(STRAIGHTNESS): return PATH;
  case MEASURE(MEAN_HEIGHT): return HEIGHT;
  default: return SUMS;
  }
}

/* Returns the sums, as bits, that a task needs; bit SUMS: the peak. */
#define PEAK (1U << SUMS)
static unsigned needs_of(const struct mo_course *course)
{
  unsigned needs = 0;
  for (uint32_t i = 0; i < terms_of(course); i++) {
    const uint32_t term = term_of(course, i);
    needs |= term == MO_OBJECTIVE_JUMP ? PEAK : (1U << sum_of_term(term)) & ~PEAK;
  }
  return needs;
}

static double *sum_at(const struct mo_course *course, struct mo_track *track, unsigned sum)
{
  return is_sum(course) ? &track->tally.sums[sum] : &track->sum;
}

static double sum_in(const struct mo_course *course, const struct mo_track *track, unsigned sum)
{
  return is_sum(course) ? track->tally.sums[sum] : track->sum;
}

/* ∂loss/∂ a sum. */
static double *d_sum_at(const struct mo_course *course, struct mo_course_adjoint *adjoint,
                        unsigned sum)
{
  return is_sum(course) ? &adjoint->d_sums[sum] : &adjoint->d_sum;
}

static double d_sum_in(const struct mo_course *course, const struct mo_course_adjoint *adjoint,
                       unsigned sum)
{
  return is_sum(course) ? adjoint->d_sums[sum] : adjoint->d_sum;
}

/* The distance that those to the light are divided by. */
static double far_m(const struct mo_course *course)
{
  return is_sum(course) ? distance(course->start_m, course->environment->light_xy_m) + 1e-8
                        : course->scale_m;
}

static double height_of(const struct mo_course *course, const double com_m[3])
{
  return com_m[2] - mo_terrain_height(course->environment, com_m[0], com_m[1]);
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

/* ---- heights of a jump ---- */

/* Returns whether the height at an instant counts. */
static bool counts(const struct mo_course *course, double t_s)
{
  return t_s >= fmin(MO_JUMP_FROM_S, course->end_s) - 1e-9;
}

static double soft_share(double height_m, double peak_m)
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
  track->tally.peak_m = -(double)INFINITY;
  course->scale_m = mo_objective_scale(environment->task.objective);
  if (environment->task.objective == MO_OBJECTIVE_EFFICIENT ||
      environment->task.objective == MO_OBJECTIVE_SUM) {
    course->scale_m = 1; /* their losses are not of a distance */
  } else if (course->scale_m == 0) {
    double light_m[2];
    light_xy(course, 0, track, light_m);
    course->scale_m = distance(com_start_m, light_m) + 1e-8;
  }
}

/* Adds the height of the center of mass at an instant to those that a jump reaches. */
static void look_up(const struct mo_course *course, double t_s, struct mo_track *track)
{
  struct mo_tally *tally = &track->tally;
  const double height = track->com_m[2];
  if (!counts(course, t_s))
    return;
  tally->n_heights++;
  if (height > tally->peak_m) {
    tally->soft *= soft_share(tally->peak_m, height);
    tally->peak_m = height;
  }
  tally->soft += soft_share(height, tally->peak_m);
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
    light_xy(course, t_s, track, light_m);
    *sum_at(course, track, AWAY) += distance(com_m, light_m);
  }
  if ((needs >> OFF & 1) != 0) {
    off_path(course, track, off_m);
    *sum_at(course, track, OFF) += mo_distance(off_m[0], off_m[1]);
  }
  if ((needs >> HEIGHT & 1) != 0)
    track->tally.sums[HEIGHT] += height_of(course, com_m);
  if ((needs & PEAK) != 0)
    look_up(course, t_s, track);
}

/* ---- values ---- */

/* 1 − the value of an objective whose loss that is when it stands alone. */
static double share_of(const struct mo_course *course, const struct mo_track *track, uint32_t term)
{
  double light_m[2];
  if (term != MO_OBJECTIVE_REACH)
    return sum_in(course, track, AWAY) / course->n_periods / far_m(course);
  light_xy(course, course->end_s, track, light_m);
  return distance(track->com_m, light_m) / far_m(course);
}

static double work_kj(double work_j)
{
  return fmax(work_j, MO_EFFICIENT_LEAST_J) / 1000;
}

/* soft: with the smooth maximum of heights. */
static double value_of(const struct mo_course *course, const struct mo_track *track,
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
    *value += weight_of(course, i) * value_of(course, track, observed, soft, term_of(course, i));
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

/* Height above the terrain. */
static void add_height(double factor, const struct mo_course *course, const double com_m[3],
                       double d[3])
{
  double slope[2];
  mo_terrain_gradient(course->environment, com_m[0], com_m[1], slope);
  d[0] -= factor * slope[0];
  d[1] -= factor * slope[1];
  d[2] += factor;
}

/* weight · ∂loss/∂ the value of term i. */
static double slope_of(const struct mo_course *course, uint32_t i, double loss, double weight)
{
  const double scale = mo_objective_scale(task_of(course)->objective);
  return scale == 0 ? -weight : -weight * (loss * weight_of(course, i)) / scale;
}

/* Passes back what this instant added to the sums. before: NULL at the start, which adds
 * nothing. */
static void sums_back(const struct mo_course *course, double t_s, const struct mo_track *before,
                      const struct mo_track *track, const struct mo_course_adjoint *adjoint,
                      double d_com[3])
{
  const unsigned needs = needs_of(course);
  double light_m[2], off_m[2];
  if (before == NULL)
    return;
  if ((needs >> WAY & 1) != 0)
    add_facing(d_sum_in(course, adjoint, WAY), before, d_com);
  if ((needs >> AWAY & 1) != 0) {
    light_xy(course, t_s, track, light_m);
    add_away(d_sum_in(course, adjoint, AWAY), track->com_m, light_m, d_com);
  }
  if ((needs >> OFF & 1) != 0) {
    static const double on_path[2] = {0, 0};
    off_path(course, track, off_m);
    add_away(d_sum_in(course, adjoint, OFF), off_m, on_path, d_com);
  }
  if ((needs >> PATH & 1) != 0)
    add_away(d_sum_in(course, adjoint, PATH), track->com_m, before->com_m, d_com);
  if ((needs >> HEIGHT & 1) != 0)
    add_height(d_sum_in(course, adjoint, HEIGHT), course, track->com_m, d_com);
  if ((needs & PEAK) != 0 && counts(course, t_s))
    d_com[2] +=
        adjoint->d_peak * soft_share(track->com_m[2], adjoint->tally.peak_m) / adjoint->tally.soft;
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

/* Displacement less the floor, per work: the part through the displacement. */
static void add_efficiency(double slope, const struct mo_course *course, const double com_m[3],
                           double work_j, double d_com[3])
{
  if (distance(com_m, course->start_m) > MO_EFFICIENT_FLOOR_M)
    add_away(slope / work_kj(work_j), com_m, course->start_m, d_com);
}

/* slope: ∂loss/∂ the value of the term. */
static void term_end_back(const struct mo_course *course, const struct mo_track *track,
                          uint32_t term, double slope, struct mo_course_adjoint *adjoint,
                          double d_com[3])
{
  const double *com = track->com_m, *start = course->start_m;
  const double path = track->tally.sums[PATH], n = course->n_periods, work_j = adjoint->work_j;
  const struct mo_observed observed = {.work_j = work_j};
  double light_m[2];
  switch (term) {
  case MO_OBJECTIVE_REACH: /* value = 1 − |com − light| / far */
    light_xy(course, course->end_s, track, light_m);
    add_away(-slope / far_m(course), com, light_m, d_com);
    break;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: /* value = 1 − sum / n / far */
    *d_sum_at(course, adjoint, AWAY) += -slope / (far_m(course) * n);
    break;
  case MO_OBJECTIVE_TRAVEL: *d_sum_at(course, adjoint, WAY) += slope; break;
  case MO_OBJECTIVE_FOLLOW: /* value = before + along − sum / n */
    adjoint->d_along += slope;
    *d_sum_at(course, adjoint, OFF) += -slope / n;
    break;
  case MO_OBJECTIVE_CLIMB: d_com[2] += slope; break;
  case MO_OBJECTIVE_EFFICIENT: /* value = max(|com − start| − floor, 0) / work */
    add_efficiency(slope, course, com, work_j, d_com);
    if (work_j > MO_EFFICIENT_LEAST_J)
      adjoint->d_work -= slope * value_of(course, track, &observed, true, term) / work_j;
    break;
  case MO_OBJECTIVE_JUMP: /* value = peak − start − |com − start| · sideways */
    adjoint->d_peak += slope;
    add_away(-slope * MO_JUMP_SIDEWAYS, com, start, d_com);
    break;
  case MEASURE(DISPLACEMENT): add_away(slope, com, start, d_com); break;
  case MEASURE(PATH_LENGTH): *d_sum_at(course, adjoint, PATH) += slope; break;
  case MEASURE(MEAN_SPEED): *d_sum_at(course, adjoint, PATH) += slope / course->end_s; break;
  case MEASURE(STRAIGHTNESS): /* value = |com − start| / path */
    if (path > 0) {
      add_away(slope / path, com, start, d_com);
      *d_sum_at(course, adjoint, PATH) -= slope * distance(com, start) / (path * path);
    }
    break;
  case MEASURE(MEAN_HEIGHT): *d_sum_at(course, adjoint, HEIGHT) += slope / n; break;
  case MEASURE(WORK): adjoint->d_work += slope; break;
  default: break; /* mo_task_check_gradient refuses it */
  }
}

void mo_course_end_back(const struct mo_course *course, const struct mo_track *before,
                        const struct mo_track *track, double work_j,
                        struct mo_course_adjoint *adjoint, double d_com[3])
{
  const struct mo_observed observed = {.work_j = work_j};
  *adjoint = (struct mo_course_adjoint){.tally = track->tally, .work_j = work_j};
  adjoint->loss = mo_course_soft_loss(course, track, &observed);
  memset(d_com, 0, 3 * sizeof(double));
  for (uint32_t i = 0; i < terms_of(course); i++)
    term_end_back(course, track, term_of(course, i), slope_of(course, i, adjoint->loss, 1), adjoint,
                  d_com);
  sums_back(course, course->end_s, before, track, adjoint, d_com);
  progress_back(track, adjoint, d_com);
}

void mo_course_back(const struct mo_course *course, double t_s, const struct mo_track *before,
                    const struct mo_track *track, const double d_light[3],
                    struct mo_course_adjoint *adjoint, double d_com[3])
{
  const struct mo_guide *guide = guide_of(course);
  const unsigned needs = needs_of(course);
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
  if ((needs >> WAY & 1) != 0)
    add_facing(-d_sum_in(course, adjoint, WAY), track,
               d_com);          /* sum += (the next com − com) · facing */
  if ((needs >> PATH & 1) != 0) /* sum += |the next com − com| */
    add_away(-d_sum_in(course, adjoint, PATH), track[1].com_m, track->com_m, d_com);
  sums_back(course, t_s, before, track, adjoint, d_com);
  progress_back(track, adjoint, d_com);
}

/* slope: weight · ∂loss/∂ the value of the term. */
static void term_restart(const struct mo_course *course, double t_s, const struct mo_track *track,
                         const double com_m[3], uint32_t term, double slope,
                         const struct mo_course_adjoint *adjoint, double d_com[3])
{
  const double path = adjoint->tally.sums[PATH];
  double light_m[2];
  switch (term) {
  case MO_OBJECTIVE_REACH:
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE:
    light_xy(course, t_s, track, light_m);
    add_away(-slope / far_m(course), com_m, light_m, d_com);
    break;
  case MO_OBJECTIVE_TRAVEL:
  case MO_OBJECTIVE_FOLLOW: add_facing(slope, track, d_com); break;
  case MO_OBJECTIVE_CLIMB: d_com[2] += slope; break;
  case MO_OBJECTIVE_EFFICIENT: add_efficiency(slope, course, com_m, adjoint->work_j, d_com); break;
  case MO_OBJECTIVE_JUMP:
    d_com[2] += slope;
    add_away(-slope * MO_JUMP_SIDEWAYS, com_m, course->start_m, d_com);
    break;
  case MEASURE(DISPLACEMENT): add_away(slope, com_m, course->start_m, d_com); break;
  case MEASURE(PATH_LENGTH): add_away(slope, com_m, track->com_m, d_com); break;
  case MEASURE(MEAN_SPEED): add_away(slope / course->end_s, com_m, track->com_m, d_com); break;
  case MEASURE(STRAIGHTNESS):
    if (path > 0)
      add_away(slope / path, com_m, course->start_m, d_com);
    break;
  case MEASURE(MEAN_HEIGHT): add_height(slope / course->n_periods, course, com_m, d_com); break;
  default: break; /* work does not depend on where the body is */
  }
}

void mo_course_restart(const struct mo_course *course, double t_s, const struct mo_track *track,
                       const double com_m[3], double weight, struct mo_course_adjoint *adjoint,
                       double d_com[3])
{
  memset(d_com, 0, 3 * sizeof(double));
  adjoint->d_along = 0;
  for (uint32_t i = 0; i < terms_of(course); i++)
    term_restart(course, t_s, track, com_m, term_of(course, i),
                 slope_of(course, i, adjoint->loss, weight), adjoint, d_com);
}
