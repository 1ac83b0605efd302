/* course_back.cuh: rollout/course_back.c for a device: the derivatives of a task, and the losses of
 * tasks with a tally, of which scores need only the sums (course.cuh). The same operations in the
 * same order, in float64; also valid C17, and compared with course.c by a test without a device. */
#ifndef MORPHO_COMPUTE_CUDA_COURSE_BACK_CUH
#define MORPHO_COMPUTE_CUDA_COURSE_BACK_CUH

#include "compute/cuda/course.cuh"

#define COURSE_MEASURE(name) (MO_TERM_MEASURE + MO_MEASURE_##name)

/* Like mo_fast_log. */
MO_COURSE double course_log(double x)
{
  int exponent;
  double m = frexp(x, &exponent), sum = 0;
  if (m < 0.70710678118654752440) {
    m *= 2;
    exponent--;
  }
  const double s = (m - 1) / (m + 1), square = s * s;
  for (int i = 23; i > 1; i -= 2)
    sum = square * (1.0 / i + sum);
  return exponent * 0x1.62e42fefa2p-1 + (exponent * 0x1.9ef35793c7673p-41 + 2 * (s + s * sum));
}

/* Returns whether a term has a case below: all that have a derivative. */
MO_COURSE bool course_has_case(uint32_t term)
{
  switch (term) {
  case MO_OBJECTIVE_REACH:
  case MO_OBJECTIVE_CLIMB:
  case MO_OBJECTIVE_EFFICIENT:
  case COURSE_MEASURE(DISPLACEMENT):
  case COURSE_MEASURE(WORK): return true;
  default: return course_need(term) != 0;
  }
}

/* ---- terms, as in course_terms.h ---- */

MO_COURSE bool course_is_sum(const struct mo_course *course)
{
  return course->environment->task.objective == MO_OBJECTIVE_SUM;
}

MO_COURSE uint32_t course_terms(const struct mo_course *course)
{
  return course_is_sum(course) ? course->environment->task.n_terms : 1;
}

MO_COURSE uint32_t course_term(const struct mo_course *course, uint32_t i)
{
  const struct mo_task *task = &course->environment->task;
  return course_is_sum(course) ? task->terms[i] : (uint32_t)task->objective;
}

MO_COURSE double course_weight(const struct mo_course *course, uint32_t i)
{
  return course_is_sum(course) ? course->environment->task.weights[i] : 1;
}

MO_COURSE double course_sum_in(const struct mo_course *course, const struct mo_track *track,
                               unsigned sum)
{
  return course_is_sum(course) ? track->tally.sums[sum] : track->sum;
}

MO_COURSE double *course_d_sum_at(const struct mo_course *course, struct mo_course_adjoint *adjoint,
                                  unsigned sum)
{
  return course_is_sum(course) ? &adjoint->d_sums[sum] : &adjoint->d_sum;
}

MO_COURSE double course_d_sum_in(const struct mo_course *course,
                                 const struct mo_course_adjoint *adjoint, unsigned sum)
{
  return course_is_sum(course) ? adjoint->d_sums[sum] : adjoint->d_sum;
}

MO_COURSE double course_far_m(const struct mo_course *course)
{
  return course_is_sum(course)
             ? course_distance(course->start_m, course->environment->light_xy_m) + 1e-8
             : course->scale_m;
}

MO_COURSE double course_work_kj(double work_j)
{
  return fmax(work_j, MO_EFFICIENT_LEAST_J) / 1000;
}

/* Like mo_objective_scale. */
MO_COURSE double course_loss_scale(const struct mo_course *course)
{
  switch (course->environment->task.objective) {
  case MO_OBJECTIVE_REACH:
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: return 0;
  case MO_OBJECTIVE_CLIMB:
  case MO_OBJECTIVE_EFFICIENT:
  case MO_OBJECTIVE_JUMP: return 0.1;
  default: return 1;
  }
}

/* ---- heights of a jump ---- */

MO_COURSE double course_soft_share(double height_m, double peak_m)
{
  return course_exp((height_m - peak_m) / MO_JUMP_SOFTNESS_M);
}

/* Adds the smooth maximum of heights to what course_add_tally has added. */
MO_COURSE void course_add_soft(const struct mo_course *course, double t_s,
                               const struct mo_track *before, struct mo_track *track)
{
  const double height = track->com_m[2], peak = before->tally.peak_m;
  struct mo_tally *tally = &track->tally;
  if ((course_needs(&course->environment->task) >> COURSE_PEAK & 1) == 0 ||
      !course_counts(course, t_s))
    return;
  tally->n_heights++;
  if (height > peak)
    tally->soft *= course_soft_share(peak, height);
  tally->soft += course_soft_share(height, tally->peak_m);
}

/* Like mo_course_advance, for any task. */
MO_COURSE void course_advance_all(const struct mo_course *course, double t_s, const double com_m[3],
                                  struct mo_track *track)
{
  if (!course_has_tally(&course->environment->task)) {
    course_advance(course, t_s, com_m, track);
    return;
  }
  const struct mo_track before = *track;
  course_advance(course, t_s, com_m, track);
  course_add_tally(course, t_s, &before, track);
  course_add_soft(course, t_s, &before, track);
}

/* ---- values ---- */

MO_COURSE double course_share(const struct mo_course *course, const struct mo_track *track,
                              uint32_t term)
{
  double light_m[2];
  if (term != MO_OBJECTIVE_REACH)
    return course_sum_in(course, track, COURSE_AWAY) / course->n_periods / course_far_m(course);
  course_light_xy(course, course->end_s, track, light_m);
  return course_distance(track->com_m, light_m) / course_far_m(course);
}

/* Like mo_course_value, for terms that have a derivative. */
MO_COURSE double course_value(const struct mo_course *course, const struct mo_track *track,
                              double work_j, bool soft, uint32_t term)
{
  const struct mo_tally *tally = &track->tally;
  const double displacement = course_distance(track->com_m, course->start_m);
  const double path = tally->sums[COURSE_PATH];
  switch (term) {
  case MO_OBJECTIVE_REACH:
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: return 1 - course_share(course, track, term);
  case MO_OBJECTIVE_TRAVEL: return course_sum_in(course, track, COURSE_WAY);
  case MO_OBJECTIVE_FOLLOW:
    return track->before_m + track->along_m -
           course_sum_in(course, track, COURSE_OFF) / course->n_periods;
  case MO_OBJECTIVE_CLIMB: return track->com_m[2] - course->start_m[2];
  case MO_OBJECTIVE_EFFICIENT:
    return fmax(displacement - MO_EFFICIENT_FLOOR_M, 0.0) / course_work_kj(work_j);
  case MO_OBJECTIVE_JUMP: {
    const double below = soft ? MO_JUMP_SOFTNESS_M * course_log(tally->soft / tally->n_heights) : 0;
    return tally->peak_m + below - course->start_m[2] - MO_JUMP_SIDEWAYS * displacement;
  }
  case COURSE_MEASURE(DISPLACEMENT): return displacement;
  case COURSE_MEASURE(PATH_LENGTH): return path;
  case COURSE_MEASURE(MEAN_SPEED): return path / course->end_s;
  case COURSE_MEASURE(STRAIGHTNESS): return path > 0 ? displacement / path : 0;
  case COURSE_MEASURE(MEAN_HEIGHT): return tally->sums[COURSE_HEIGHT] / course->n_periods;
  case COURSE_MEASURE(WORK): return work_j;
  default: return (double)NAN; /* refused: gradient_plan.c */
  }
}

/* Like mo_course_finish, or mo_course_soft_loss, for a rollout that did not diverge. */
MO_COURSE struct course_result course_finish_all(const struct mo_course *course,
                                                 const struct mo_track *track, double work_j,
                                                 bool soft)
{
  const double scale = course_loss_scale(course);
  struct course_result result = {0, 0};
  if (scale == 0) {
    result.loss = course_share(course, track, (uint32_t)course->environment->task.objective);
    result.value = 1 - result.loss;
    return result;
  }
  for (uint32_t i = 0; i < course_terms(course); i++)
    result.value += course_weight(course, i) *
                    course_value(course, track, work_j, soft, course_term(course, i));
  const double x =
      fmin(fmax(-result.value / scale, -MO_COURSE_EXPONENT_MAX), MO_COURSE_EXPONENT_MAX);
  result.loss = x <= 0 ? course_exp(x) : 1 / course_exp(-x);
  return result;
}

/* ---- backward ---- */

MO_COURSE void course_add_away(double factor, const double *a_m, const double *b_m, double d[3])
{
  const double length = course_distance(a_m, b_m);
  for (int axis = 0; axis < 2; axis++)
    if (length > 0)
      d[axis] += factor * (a_m[axis] - b_m[axis]) / length;
}

MO_COURSE void course_add_facing(double factor, const struct mo_track *track, double d[3])
{
  for (int axis = 0; axis < 2; axis++)
    d[axis] += factor * track->facing[axis];
}

MO_COURSE void course_terrain_slope(const struct mo_course *course, const double *xy_m,
                                    double slope[2])
{
  const struct terrain_map map = terrain_map_of(course->environment);
  terrain_slope(&map, course->environment->terrain_heights_m, xy_m[0], xy_m[1], slope);
}

MO_COURSE void course_add_height(double factor, const struct mo_course *course,
                                 const double com_m[3], double d[3])
{
  double slope[2];
  course_terrain_slope(course, com_m, slope);
  d[0] -= factor * slope[0];
  d[1] -= factor * slope[1];
  d[2] += factor;
}

MO_COURSE double course_slope_of(const struct mo_course *course, uint32_t i, double loss,
                                 double weight)
{
  const double scale = course_loss_scale(course);
  return scale == 0 ? -weight : -weight * (loss * course_weight(course, i)) / scale;
}

MO_COURSE void course_sums_back(const struct mo_course *course, double t_s,
                                const struct mo_track *before, const struct mo_track *track,
                                const struct mo_course_adjoint *adjoint, double d_com[3])
{
  const unsigned needs = course_needs(&course->environment->task);
  double light_m[2], off_m[2];
  if (before == NULL)
    return;
  if ((needs >> COURSE_WAY & 1) != 0)
    course_add_facing(course_d_sum_in(course, adjoint, COURSE_WAY), before, d_com);
  if ((needs >> COURSE_AWAY & 1) != 0) {
    course_light_xy(course, t_s, track, light_m);
    course_add_away(course_d_sum_in(course, adjoint, COURSE_AWAY), track->com_m, light_m, d_com);
  }
  if ((needs >> COURSE_OFF & 1) != 0) {
    const double on_path[2] = {0, 0};
    course_off_path(course, track, off_m);
    course_add_away(course_d_sum_in(course, adjoint, COURSE_OFF), off_m, on_path, d_com);
  }
  if ((needs >> COURSE_PATH & 1) != 0)
    course_add_away(course_d_sum_in(course, adjoint, COURSE_PATH), track->com_m, before->com_m,
                    d_com);
  if ((needs >> COURSE_HEIGHT & 1) != 0)
    course_add_height(course_d_sum_in(course, adjoint, COURSE_HEIGHT), course, track->com_m, d_com);
  if ((needs >> COURSE_PEAK & 1) != 0 && course_counts(course, t_s))
    d_com[2] += adjoint->d_peak * course_soft_share(track->com_m[2], adjoint->tally.peak_m) /
                adjoint->tally.soft;
}

MO_COURSE void course_progress_back(const struct mo_track *track, struct mo_course_adjoint *adjoint,
                                    double d_com[3])
{
  if (track->along_is == MO_TRACK_WORD(MO_TRACK_KEPT))
    return;
  if (track->along_is == MO_TRACK_WORD(MO_TRACK_MOVED))
    course_add_facing(adjoint->d_along, track, d_com);
  adjoint->d_along = 0;
}

MO_COURSE void course_add_efficiency(double slope, const struct mo_course *course,
                                     const double com_m[3], double work_j, double d_com[3])
{
  if (course_distance(com_m, course->start_m) > MO_EFFICIENT_FLOOR_M)
    course_add_away(slope / course_work_kj(work_j), com_m, course->start_m, d_com);
}

MO_COURSE void course_term_end_back(const struct mo_course *course, const struct mo_track *track,
                                    uint32_t term, double slope, struct mo_course_adjoint *adjoint,
                                    double d_com[3])
{
  const double *com = track->com_m, *start = course->start_m;
  const double path = track->tally.sums[COURSE_PATH], n = course->n_periods,
               work_j = adjoint->work_j;
  double light_m[2];
  switch (term) {
  case MO_OBJECTIVE_REACH:
    course_light_xy(course, course->end_s, track, light_m);
    course_add_away(-slope / course_far_m(course), com, light_m, d_com);
    break;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE:
    *course_d_sum_at(course, adjoint, COURSE_AWAY) += -slope / (course_far_m(course) * n);
    break;
  case MO_OBJECTIVE_TRAVEL: *course_d_sum_at(course, adjoint, COURSE_WAY) += slope; break;
  case MO_OBJECTIVE_FOLLOW:
    adjoint->d_along += slope;
    *course_d_sum_at(course, adjoint, COURSE_OFF) += -slope / n;
    break;
  case MO_OBJECTIVE_CLIMB: d_com[2] += slope; break;
  case MO_OBJECTIVE_EFFICIENT:
    course_add_efficiency(slope, course, com, work_j, d_com);
    if (work_j > MO_EFFICIENT_LEAST_J)
      adjoint->d_work -= slope * course_value(course, track, work_j, true, term) / work_j;
    break;
  case MO_OBJECTIVE_JUMP:
    adjoint->d_peak += slope;
    course_add_away(-slope * MO_JUMP_SIDEWAYS, com, start, d_com);
    break;
  case COURSE_MEASURE(DISPLACEMENT): course_add_away(slope, com, start, d_com); break;
  case COURSE_MEASURE(PATH_LENGTH): *course_d_sum_at(course, adjoint, COURSE_PATH) += slope; break;
  case COURSE_MEASURE(MEAN_SPEED):
    *course_d_sum_at(course, adjoint, COURSE_PATH) += slope / course->end_s;
    break;
  case COURSE_MEASURE(STRAIGHTNESS):
    if (path > 0) {
      course_add_away(slope / path, com, start, d_com);
      *course_d_sum_at(course, adjoint, COURSE_PATH) -=
          slope * course_distance(com, start) / (path * path);
    }
    break;
  case COURSE_MEASURE(MEAN_HEIGHT):
    *course_d_sum_at(course, adjoint, COURSE_HEIGHT) += slope / n;
    break;
  case COURSE_MEASURE(WORK): adjoint->d_work += slope; break;
  default: break; /* refused: gradient_plan.c */
  }
}

/* Like mo_course_end_back. */
MO_COURSE void course_end_back(const struct mo_course *course, const struct mo_track *before,
                               const struct mo_track *track, double work_j,
                               struct mo_course_adjoint *adjoint, double d_com[3])
{
  adjoint->d_sum = adjoint->d_along = adjoint->d_peak = adjoint->d_work = 0;
  for (int k = 0; k < 5; k++)
    adjoint->d_sums[k] = 0;
  adjoint->tally = track->tally;
  adjoint->work_j = work_j;
  adjoint->loss = course_finish_all(course, track, work_j, true).loss;
  d_com[0] = d_com[1] = d_com[2] = 0;
  for (uint32_t i = 0; i < course_terms(course); i++)
    course_term_end_back(course, track, course_term(course, i),
                         course_slope_of(course, i, adjoint->loss, 1), adjoint, d_com);
  course_sums_back(course, course->end_s, before, track, adjoint, d_com);
  course_progress_back(track, adjoint, d_com);
}

/* Like mo_course_back. after: at the next instant. */
MO_COURSE void course_back(const struct mo_course *course, double t_s,
                           const struct mo_track *before, const struct mo_track *track,
                           const struct mo_track *after, const double d_light[3],
                           struct mo_course_adjoint *adjoint, double d_com[3])
{
  const struct mo_guide *guide = course_guide(course);
  const unsigned needs = course_needs(&course->environment->task);
  double light_m[2], slope[2];
  d_com[0] = d_com[1] = d_com[2] = 0;
  course_light_xy(course, t_s, track, light_m);
  course_terrain_slope(course, light_m, slope);
  const double d_xy[2] = {d_light[0] + slope[0] * d_light[2], d_light[1] + slope[1] * d_light[2]};
  if (guide->kind == MO_GUIDE_AHEAD || guide->kind == MO_GUIDE_TURNING) {
    d_com[0] = d_xy[0];
    d_com[1] = d_xy[1];
  } else if (guide->kind == MO_GUIDE_PATH && track->along_m + guide->distance_m < track->length_m) {
    adjoint->d_along += course_dot(d_xy, track->facing);
  }
  if ((needs >> COURSE_WAY & 1) != 0)
    course_add_facing(-course_d_sum_in(course, adjoint, COURSE_WAY), track, d_com);
  if ((needs >> COURSE_PATH & 1) != 0)
    course_add_away(-course_d_sum_in(course, adjoint, COURSE_PATH), after->com_m, track->com_m,
                    d_com);
  course_sums_back(course, t_s, before, track, adjoint, d_com);
  course_progress_back(track, adjoint, d_com);
}

MO_COURSE void course_term_restart(const struct mo_course *course, double t_s,
                                   const struct mo_track *track, const double com_m[3],
                                   uint32_t term, double slope,
                                   const struct mo_course_adjoint *adjoint, double d_com[3])
{
  const double path = adjoint->tally.sums[COURSE_PATH];
  double light_m[2];
  switch (term) {
  case MO_OBJECTIVE_REACH:
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE:
    course_light_xy(course, t_s, track, light_m);
    course_add_away(-slope / course_far_m(course), com_m, light_m, d_com);
    break;
  case MO_OBJECTIVE_TRAVEL:
  case MO_OBJECTIVE_FOLLOW: course_add_facing(slope, track, d_com); break;
  case MO_OBJECTIVE_CLIMB: d_com[2] += slope; break;
  case MO_OBJECTIVE_EFFICIENT:
    course_add_efficiency(slope, course, com_m, adjoint->work_j, d_com);
    break;
  case MO_OBJECTIVE_JUMP:
    d_com[2] += slope;
    course_add_away(-slope * MO_JUMP_SIDEWAYS, com_m, course->start_m, d_com);
    break;
  case COURSE_MEASURE(DISPLACEMENT): course_add_away(slope, com_m, course->start_m, d_com); break;
  case COURSE_MEASURE(PATH_LENGTH): course_add_away(slope, com_m, track->com_m, d_com); break;
  case COURSE_MEASURE(MEAN_SPEED):
    course_add_away(slope / course->end_s, com_m, track->com_m, d_com);
    break;
  case COURSE_MEASURE(STRAIGHTNESS):
    if (path > 0)
      course_add_away(slope / path, com_m, course->start_m, d_com);
    break;
  case COURSE_MEASURE(MEAN_HEIGHT):
    course_add_height(slope / course->n_periods, course, com_m, d_com);
    break;
  default: break;
  }
}

/* Like mo_course_restart; it does not depend on com_m[2]. */
MO_COURSE void course_restart(const struct mo_course *course, double t_s,
                              const struct mo_track *track, const double com_m[3], double weight,
                              struct mo_course_adjoint *adjoint, double d_com[3])
{
  d_com[0] = d_com[1] = d_com[2] = 0;
  adjoint->d_along = 0;
  for (uint32_t i = 0; i < course_terms(course); i++)
    course_term_restart(course, t_s, track, com_m, course_term(course, i),
                        course_slope_of(course, i, adjoint->loss, weight), adjoint, d_com);
}

#endif
