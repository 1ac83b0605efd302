/* window.h: where in a rollout a window is, and how its task and its measures continue. The
 * reference, the CPU kernels and the writer of scenes share it. Internal to this room and to the
 * writer. */
#ifndef MORPHO_ROLLOUT_WINDOW_H
#define MORPHO_ROLLOUT_WINDOW_H

#include <morpho/state.h>

#include "rollout/course.h"
#include "rollout/measuring.h"

/* Which steps of the rollout a window covers: from first_step up to, but excluding, end_step. */
struct mo_window {
  uint32_t first_step, end_step;
  uint32_t control_steps; /* in a control period */
};
/* from: a checked state, or NULL. control_steps is 0 if the period is invalid. */
struct mo_window mo_window_of(const struct mo_scheme *scheme, const struct mo_state *from);

/* Calls mo_state_check, and checks that a tally that continues includes everything that must be
 * observed now. */
int mo_window_check(const struct mo_state *from, const struct mo_body *body,
                    const struct mo_environment *environment, const struct mo_physics *physics,
                    enum mo_precision precision, unsigned observations, struct mo_message *message);

/* Writes the data that a state must have in common with the rollout that starts from it, and the
 * task of its tally. */
void mo_window_identify(const struct mo_environment *environment, const struct mo_physics *physics,
                        struct mo_state *state);

/* Begins or continues the tally of a rollout; com_m: the center of mass now. Returns the step in
 * which it began: before first_step if it continues. com_start_m: where it began. */
uint32_t mo_window_begin(const struct mo_window *window, const struct mo_state *from,
                         const struct mo_environment *environment, const double com_m[3],
                         double com_start_m[3]);
/* Begins or continues the course of a task whose tally began in step `begun`. */
void mo_window_course(const struct mo_window *window, const struct mo_state *from, uint32_t begun,
                      const struct mo_environment *environment, const struct mo_scheme *scheme,
                      const double com_start_m[3], struct mo_course *course,
                      struct mo_track *track);
/* Begins or continues an observer. A new observer that begins after step 0 needs
 * mo_observer_pose. */
void mo_window_observer(const struct mo_window *window, const struct mo_state *from, uint32_t begun,
                        const struct mo_body *body, const struct mo_environment *environment,
                        const struct mo_physics *physics, const double com_start_m[3],
                        struct mo_observer *observer);

/* Write a tally. `observed`: the parts of the observer to write; the caller writes its springs. */
void mo_window_save_track(const struct mo_track *track, struct mo_state_tally *tally);
void mo_window_save_observer(const struct mo_observer *observer, unsigned observed,
                             struct mo_state_tally *tally);

#endif
