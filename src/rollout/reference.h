/* reference.h: the float64 rollout one step at a time, so that tests can set and inspect a state.
 */
#ifndef MORPHO_ROLLOUT_REFERENCE_H
#define MORPHO_ROLLOUT_REFERENCE_H

#include <stdbool.h>

#include "controller/tape.h"
#include "rollout/course.h"
#include "rollout/kick.h"

#include <morpho/state.h>

#include "rollout/window.h"

/* The data that the derivative of one step needs. Inputs of masses that the body lacks must be
 * 0. */
struct mo_step_tape {
  double *position_m;       /* (n_masses, 3) at the start of the step */
  double *velocity_m_per_s; /* (n_masses, 3) after springs, drag and gravity, before contact */
  double *acceleration;     /* (n_masses, 3) m/s² by springs and gravity */
  double *activation;       /* (n_springs) the activations with which the springs pulled */
  double *previous;         /* (n_springs) the controller's outputs in the previous step */
  struct mo_controller_tape control; /* over the body's springs; the steps of a control period share
                                        one */
};

struct mo_reference {
  const struct mo_body *body;
  const struct mo_controller *controller; /* NULL: passive */
  const struct mo_environment *environment;
  const struct mo_physics *physics;
  uint32_t control_steps;   /* in a control period */
  struct mo_window window;  /* which steps of the rollout it runs */
  uint32_t begun;           /* the step in which the tally began (window.h) */
  double com_start_m[3];    /* center of mass when it began */
  uint32_t first_track;     /* the control period of tracks[0] */
  double light_m[3];        /* unless the task is plain, that of the latest control period */
  struct mo_course course;  /* unused by plain tasks */
  bool works;               /* the task or a measure needs work_j */
  double work_j;            /* of the actuators so far */
  struct mo_track *tracks;  /* (control periods + 1) at the start of each, and at the end; NULL if
                               the task is plain. In a window, the latest instant before it comes
                               first */
  double highest_m;         /* of the terrain */
  double *position_m;       /* (n_masses, 3) */
  double *velocity_m_per_s; /* (n_masses, 3) */
  double *impulse_n_s;      /* (n_masses, 3) impulses of the last step's springs */
  double *output;           /* (n_springs) the latest outputs of the controller */
  uint8_t *contacts;        /* (n_masses) 1: touched the terrain in the last step */
  uint8_t *cut;             /* (n_springs) 1: exerts no force in step cut_step and later ones; 2:
                               never exerts force */
  uint32_t cut_step;
  struct mo_step_tape own;   /* its `control` is empty without a controller */
  struct mo_step_tape *tape; /* of the next step; initially `own` */
};

/* Initializes a rollout. Borrows all arguments. MO_ERR_INVALID: the controller is for a different
 * workspace, or the control period is invalid; MO_ERR_NO_MEMORY. */
int mo_reference_init(struct mo_reference *reference, const struct mo_body *body,
                      const struct mo_controller *controller,
                      const struct mo_environment *environment, const struct mo_physics *physics);
/* The same from a state (nullable), which has been checked. Step numbers are the rollout's. */
int mo_reference_init_from(struct mo_reference *reference, const struct mo_body *body,
                           const struct mo_controller *controller,
                           const struct mo_environment *environment,
                           const struct mo_physics *physics, const struct mo_state *from);
void mo_reference_done(struct mo_reference *reference);

/* Writes the state after the last step, except for the part of the tally that belongs to
 * observers. */
void mo_reference_save(const struct mo_reference *reference, struct mo_state *to);

/* Runs step number `step`, from 0. Its tape must hold the controller's outputs of the previous
 * step, unless a control period starts. Returns false if it diverged; the positions are then those
 * before the step. */
bool mo_reference_step(struct mo_reference *reference, uint32_t step);

/* Computes the light of the control period that starts with step number `step`. Its track must be
 * set. */
void mo_reference_light(const struct mo_reference *reference, uint32_t step, double light_m[3]);

/* Returns whether the springs pull with the mean of new and previous outputs in a step. */
bool mo_reference_blends(const struct mo_reference *reference, uint32_t step);

/* Returns the kick of a step. */
struct mo_kick mo_reference_kick(const struct mo_reference *reference,
                                 const struct mo_constants *constants, uint32_t step);

/* Runs all steps until a divergence. Calls visit(context, step) with the state before each step and
 * after the last one, also after a divergence. Loss and value of the outcome are not set. */
void mo_reference_run(struct mo_reference *reference, void (*visit)(void *context, uint32_t step),
                      void *context, struct mo_outcome *outcome);

/* Sets loss and value after a run. measures: as in struct mo_observed; nullable. */
void mo_reference_finish(const struct mo_reference *reference, const double *measures,
                         struct mo_outcome *outcome);

#endif
