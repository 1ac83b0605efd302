/* course.h: a task during one rollout, in float64: where the guide puts the light, what the
 * objective sums up, and their derivatives. All CPU paths share it; docs/model.md has the
 * equations. It runs once for each control period.
 *
 * An instant is the start of a control period, or the end of the rollout. */
#ifndef MORPHO_ROLLOUT_COURSE_H
#define MORPHO_ROLLOUT_COURSE_H

#include <morpho/rollout.h>

/* The constants of the task of a rollout. */
struct mo_course {
  const struct mo_environment *environment;
  double start_m[3];  /* center of mass */
  double scale_m;     /* the unit of distances in the loss, and in adjoints: docs/numerics.md,
                         Clipping */
  double end_s;       /* time at which the rollout ends */
  uint32_t n_periods; /* control periods, of which the last may be shorter */
};

/* What a task adds up in addition to the sum of struct mo_track. */
struct mo_tally {
  double sums[5];     /* of the terms of a sum, as numbered in course.c */
  double peak_m;      /* jump: largest height of the center of mass at the instants that count */
  double soft;        /* jump: sum over these instants of exp((height − peak_m) / softness) */
  uint32_t n_heights; /* jump: number of these instants */
};

/* The state of a task at an instant. Devices share the layout: the host makes their first states,
 * and the results of tasks that have a tally. */
struct mo_track {
  double com_m[3];
  double sum;       /* over the periods that have ended: distance traveled, or distances */
  double facing[2]; /* unit vector: the heading, the direction of the path's leg, or, for a light
                       that moves on its own, the angle by which it has turned */
  double length_m;  /* path: of this leg */
  double before_m;  /* path: progress at the start of this leg */
  double along_m;   /* path: the farthest place on this leg that the body has reached */
  uint32_t leg;     /* path: number of waypoints that the body has reached */
  enum {
    MO_TRACK_KEPT,  /* along_m is that of the previous instant */
    MO_TRACK_MOVED, /* it changes with the center of mass at this instant */
    MO_TRACK_SET    /* it is an end of the leg */
  } along_is;
  struct mo_tally tally;
};

/* What is known about a rollout in addition to its track. */
struct mo_observed {
  double work_j;          /* measure work_j without rounding; unused by tasks that do not need it */
  const double *measures; /* (MO_MEASURES) of which those of mo_task_measures count, without
                             rounding; NULL if there are none */
};

/* ∂loss/∂ the quantities that are carried from one instant to the next, and what these derivatives
 * depend on. */
struct mo_course_adjoint {
  double d_sum, d_along;
  double d_sums[5], d_peak; /* of a sum's terms; of a jump */
  double d_work;            /* per J; 0 for tasks that do not need the work */
  struct mo_tally tally;    /* at the end */
  double loss;              /* the loss that is differentiated: mo_course_soft_loss */
  double work_j;
};

/* Begins a course: *track is its state at the start. Borrows the environment. */
void mo_course_begin(struct mo_course *course, const struct mo_environment *environment,
                     const struct mo_scheme *scheme, const double com_start_m[3],
                     struct mo_track *track);

/* Turns the state at an instant into that at the next, which is at time t_s. */
void mo_course_advance(const struct mo_course *course, double t_s, const double com_m[3],
                       struct mo_track *track);

/* Computes the light at an instant, in world coordinates. */
void mo_course_light(const struct mo_course *course, double t_s, const struct mo_track *track,
                     double light_m[3]);

/* Sets loss and value of an outcome whose other members are set; track: at the end. */
void mo_course_finish(const struct mo_course *course, const struct mo_track *track,
                      const struct mo_observed *observed, struct mo_outcome *outcome);

/* Returns the loss that gradients differentiate: that of mo_course_finish, with a smooth maximum
 * instead of the largest height. */
double mo_course_soft_loss(const struct mo_course *course, const struct mo_track *track,
                           const struct mo_observed *observed);

/* Begins the backward pass at the end of the rollout: sets the adjoint and d_com, ∂loss/∂ the
 * center of mass there. before: at the instant before the end. Only for tasks that
 * mo_task_check_gradient accepts. */
void mo_course_end_back(const struct mo_course *course, const struct mo_track *before,
                        const struct mo_track *track, double work_j,
                        struct mo_course_adjoint *adjoint, double d_com[3]);

/* Runs an instant backward, from ∂loss/∂ the light that was placed there: updates the adjoint to
 * that before the instant, and sets d_com. before: NULL at the start of the rollout; track[1] is at
 * the next instant. */
void mo_course_back(const struct mo_course *course, double t_s, const struct mo_track *before,
                    const struct mo_track *track, const double d_light[3],
                    struct mo_course_adjoint *adjoint, double d_com[3]);

/* Restarts the backward pass (gradient.h) within the control period that began with `track`, where
 * the center of mass is com_m: sets d_com, weight · the gradient as if the rollout ended there. */
void mo_course_restart(const struct mo_course *course, double t_s, const struct mo_track *track,
                       const double com_m[3], double weight, struct mo_course_adjoint *adjoint,
                       double d_com[3]);

#endif
