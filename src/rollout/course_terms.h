/* course_terms.h: the terms of a task's objective, and the sums that they need. Only for course.c
 * and course_back.c, both of which have a case for each term. */
#ifndef MORPHO_ROLLOUT_COURSE_TERMS_H
#define MORPHO_ROLLOUT_COURSE_TERMS_H

#include <math.h>

#include "rollout/course.h"
#include "rollout/distance.h"

/* The sums that objectives and measures need. For a single objective, the sum is in struct
 * mo_track. */
enum { WAY, AWAY, OFF, PATH, HEIGHT, SUMS };
_Static_assert(SUMS == sizeof(((struct mo_tally *)0)->sums) / sizeof(double), "one place each");

static inline const struct mo_guide *guide_of(const struct mo_course *course)
{
  return &course->environment->task.guide;
}

static inline double distance(const double *a_m, const double *b_m)
{
  return mo_distance(a_m[0] - b_m[0], a_m[1] - b_m[1]);
}

static inline double dot(const double a[2], const double b[2])
{
  return a[0] * b[0] + a[1] * b[1];
}

static inline const struct mo_task *task_of(const struct mo_course *course)
{
  return &course->environment->task;
}

static inline bool is_sum(const struct mo_course *course)
{
  return task_of(course)->objective == MO_OBJECTIVE_SUM;
}

/* Returns the number of terms; a single objective is one. */
static inline uint32_t terms_of(const struct mo_course *course)
{
  return is_sum(course) ? task_of(course)->n_terms : 1;
}

static inline uint32_t term_of(const struct mo_course *course, uint32_t i)
{
  return is_sum(course) ? task_of(course)->terms[i] : (uint32_t)task_of(course)->objective;
}

static inline double weight_of(const struct mo_course *course, uint32_t i)
{
  return is_sum(course) ? task_of(course)->weights[i] : 1;
}

#define MEASURE(name) (MO_TERM_MEASURE + MO_MEASURE_##name)

/* Returns the sum that a term uses; SUMS: no sum. */
static inline unsigned sum_of_term(uint32_t term)
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
static inline unsigned needs_of(const struct mo_course *course)
{
  unsigned needs = 0;
  for (uint32_t i = 0; i < terms_of(course); i++) {
    const uint32_t term = term_of(course, i);
    needs |= term == MO_OBJECTIVE_JUMP ? PEAK : (1U << sum_of_term(term)) & ~PEAK;
  }
  return needs;
}

static inline double *sum_at(const struct mo_course *course, struct mo_track *track, unsigned sum)
{
  return is_sum(course) ? &track->tally.sums[sum] : &track->sum;
}

static inline double sum_in(const struct mo_course *course, const struct mo_track *track,
                            unsigned sum)
{
  return is_sum(course) ? track->tally.sums[sum] : track->sum;
}

/* Returns the address of ∂loss/∂ a sum. */
static inline double *d_sum_at(const struct mo_course *course, struct mo_course_adjoint *adjoint,
                               unsigned sum)
{
  return is_sum(course) ? &adjoint->d_sums[sum] : &adjoint->d_sum;
}

static inline double d_sum_in(const struct mo_course *course,
                              const struct mo_course_adjoint *adjoint, unsigned sum)
{
  return is_sum(course) ? adjoint->d_sums[sum] : adjoint->d_sum;
}

/* Returns the distance by which distances to the light are divided. */
static inline double far_m(const struct mo_course *course)
{
  return is_sum(course) ? distance(course->start_m, course->environment->light_xy_m) + 1e-8
                        : course->scale_m;
}

static inline const double *leg_start(const struct mo_course *course, uint32_t leg)
{
  return leg == 0 ? course->start_m : guide_of(course)->points_m[leg - 1];
}

static inline double work_kj(double work_j)
{
  return fmax(work_j, MO_EFFICIENT_LEAST_J) / 1000;
}

/* ---- course.c ---- */

/* Places the light in x and y. */
void mo_course_light_xy(const struct mo_course *course, double t_s, const struct mo_track *track,
                        double light_m[2]);
/* Computes the vector from the nearest point of the track's leg to the center of mass. */
void mo_course_off_path(const struct mo_course *course, const struct mo_track *track,
                        double off_m[2]);
/* Returns whether the height at an instant counts for a jump. */
bool mo_course_counts(const struct mo_course *course, double t_s);
/* Returns what a height adds to the soft maximum of a jump. */
double mo_course_soft_share(double height_m, double peak_m);
/* Returns the value of a term. soft: with the smooth maximum of heights. */
double mo_course_value(const struct mo_course *course, const struct mo_track *track,
                       const struct mo_observed *observed, bool soft, uint32_t term);

#endif
