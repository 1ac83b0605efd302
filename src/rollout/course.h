/* course.h: a task during one rollout, in float64: where the guide puts the light, what the
 * objective sums up, and their derivatives. All paths on processors share it; docs/model.md has the
 * equations. It runs once for each control period.
 *
 * An instant is the start of a control period, or the end of the rollout. */
#ifndef MORPHO_ROLLOUT_COURSE_H
#define MORPHO_ROLLOUT_COURSE_H

#include <morpho/rollout.h>

/* The constants of a rollout's task. */
struct mo_course {
  const struct mo_environment *environment;
  double start_m[3]; /* center of mass */
  double scale_m; /* the loss's unit of distances, also of adjoints: docs/numerics.md, Clipping */
  double end_s;   /* when the rollout ends */
  uint32_t n_periods; /* control periods, of which the last may be shorter */
};

/* The state of a task at an instant. */
struct mo_track {
  double com_m[3];
  double sum;       /* over the periods that have ended: way, or distances */
  double facing[2]; /* unit vector: the heading, the direction of the path's leg, or, for a light
                       that moves on its own, the angle that it has turned by */
  double length_m;  /* path: of this leg */
  double before_m;  /* path: progress at the start of this leg */
  double along_m;   /* path: the farthest place on this leg that the body has reached */
  uint32_t leg;     /* path: number of way-points that the body has reached */
  enum {
    MO_TRACK_KEPT,  /* along_m is that of the instant before */
    MO_TRACK_MOVED, /* it changes with the center of mass at this instant */
    MO_TRACK_SET    /* it is an end of the leg */
  } along_is;
};

/* ∂loss/∂ what lasts from one instant to the next. */
struct mo_course_adjoint {
  double d_sum, d_along;
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
                      struct mo_outcome *outcome);

/* Begins the backward pass at the end of the rollout: sets the adjoint and d_com, ∂loss/∂ the
 * center of mass there. before: at the instant before the end. */
void mo_course_end_back(const struct mo_course *course, const struct mo_track *before,
                        const struct mo_track *track, double loss,
                        struct mo_course_adjoint *adjoint, double d_com[3]);

/* Runs an instant backward, from ∂loss/∂ the light that was placed there: the adjoint becomes
 * that before the instant; sets d_com. before: NULL at the start of the rollout. */
void mo_course_back(const struct mo_course *course, double t_s, const struct mo_track *before,
                    const struct mo_track *track, const double d_light[3],
                    struct mo_course_adjoint *adjoint, double d_com[3]);

/* Restarts the backward pass (gradient.h) within the control period that began with `track`, where
 * the center of mass is com_m: sets d_com, weight · the gradient as if the rollout ended there. */
void mo_course_restart(const struct mo_course *course, double t_s, const struct mo_track *track,
                       const double com_m[3], double loss, double weight,
                       struct mo_course_adjoint *adjoint, double d_com[3]);

#endif
