/* course_back.c: the derivatives of course.c, backward from the end of a rollout: those of the
 * light and of the sums at each instant, and those of the loss where the backward pass restarts. */
#include "rollout/course_terms.h"

#include <string.h>

/* Computes d += factor · (a − b) / |a − b| in x, y; adds nothing where a and b coincide. */
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

/* Adds factor times the derivative of the height above the terrain to d. */
static void add_height(double factor, const struct mo_course *course, const double com_m[3],
                       double d[3])
{
  double slope[2];
  mo_terrain_gradient(course->environment, com_m[0], com_m[1], slope);
  d[0] -= factor * slope[0];
  d[1] -= factor * slope[1];
  d[2] += factor;
}

/* Returns weight · ∂loss/∂ the value of term i. */
static double slope_of(const struct mo_course *course, uint32_t i, double loss, double weight)
{
  const double scale = mo_objective_scale(task_of(course)->objective);
  return scale == 0 ? -weight : -weight * (loss * weight_of(course, i)) / scale;
}

/* Runs the sums backward: adds the derivatives of what this instant contributed. before: NULL at
 * the start, which contributes nothing. */
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
    mo_course_light_xy(course, t_s, track, light_m);
    add_away(d_sum_in(course, adjoint, AWAY), track->com_m, light_m, d_com);
  }
  if ((needs >> OFF & 1) != 0) {
    static const double on_path[2] = {0, 0};
    mo_course_off_path(course, track, off_m);
    add_away(d_sum_in(course, adjoint, OFF), off_m, on_path, d_com);
  }
  if ((needs >> PATH & 1) != 0)
    add_away(d_sum_in(course, adjoint, PATH), track->com_m, before->com_m, d_com);
  if ((needs >> HEIGHT & 1) != 0)
    add_height(d_sum_in(course, adjoint, HEIGHT), course, track->com_m, d_com);
  if ((needs & PEAK) != 0 && mo_course_counts(course, t_s))
    d_com[2] += adjoint->d_peak * mo_course_soft_share(track->com_m[2], adjoint->tally.peak_m) /
                adjoint->tally.soft;
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

/* For displacement minus the floor, per work: adds the derivative through the displacement. */
static void add_efficiency(double slope, const struct mo_course *course, const double com_m[3],
                           double work_j, double d_com[3])
{
  if (distance(com_m, course->start_m) > MO_EFFICIENT_FLOOR_M)
    add_away(slope / work_kj(work_j), com_m, course->start_m, d_com);
}

/* Adds the derivatives of a term at the end. slope: ∂loss/∂ its value. */
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
    mo_course_light_xy(course, course->end_s, track, light_m);
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
      adjoint->d_work -= slope * mo_course_value(course, track, &observed, true, term) / work_j;
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
  default: break; /* mo_task_check_gradient rejects it */
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
  mo_course_light_xy(course, t_s, track, light_m);
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

/* Adds the derivatives of a term at a restart. slope: weight · ∂loss/∂ its value. */
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
    mo_course_light_xy(course, t_s, track, light_m);
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
  default: break; /* work does not depend on the position of the body */
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
