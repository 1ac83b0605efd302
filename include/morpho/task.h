/* task.h: what a robot is asked to do in an environment: a guide moves the light that the robot
 * follows, and an objective measures the rollout. docs/model.md has the equations.
 *
 * The light is placed at the start of every control period, when the controller senses it, from the
 * body's center of mass at that moment, and stands there until the next period. It always stands on
 * the terrain. Sums and means over time have one sample for each control period. */
#ifndef MORPHO_TASK_H
#define MORPHO_TASK_H

#include <stdbool.h>
#include <stdint.h>

#include <morpho/error.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_GUIDE_POINTS_MAX         16
#define MO_GUIDE_DISTANCE_M         1.5 /* the default distance of a light that leads */
#define MO_GUIDE_DISTANCE_MIN_M     0.1
#define MO_GUIDE_DISTANCE_MAX_M     10.0
#define MO_GUIDE_HEADING_MAX_RAD    10.0 /* of |heading_rad| */
#define MO_GUIDE_TURN_MAX_RAD_PER_S 10.0 /* of |turn_rad_per_s| */
#define MO_GUIDE_SPEED_MAX_M_PER_S  10.0 /* of each component of velocity_m_per_s */
#define MO_GUIDE_REACHED_M          0.2  /* a waypoint this near to the center of mass is reached */

/* How the light moves. */
enum mo_guide_kind {
  MO_GUIDE_FIXED = 0, /* the light does not move: it stands at light_xy_m of the environment */
  MO_GUIDE_AHEAD,     /* distance_m ahead of the center of mass, in the direction heading_rad */
  MO_GUIDE_TURNING,   /* the same; at time t the direction is heading_rad + turn_rad_per_s · t */
  MO_GUIDE_PATH,      /* on a path, ahead of the place that the body has reached */
  MO_GUIDE_MOVING     /* on its own, from light_xy_m of the environment: on a line, on a circle, or
                         on a circle whose center moves on a line */
};
extern const char *const mo_guide_words[]; /* "fixed", "ahead", …, NULL */

/* Only the fields of the kind are used; the others must be 0. */
struct mo_guide {
  enum mo_guide_kind kind;
  uint32_t n_points;                       /* path: 1 … MO_GUIDE_POINTS_MAX */
  double heading_rad;                      /* ahead, turning: from the x axis toward the y axis */
  double turn_rad_per_s;                   /* turning; moving: of the light around center_m */
  double distance_m;                       /* ahead, turning, path */
  double points_m[MO_GUIDE_POINTS_MAX][2]; /* path: waypoints, in this order, after the center of
                                              mass at the start */
  double velocity_m_per_s[2];              /* moving */
  double center_m[2];                      /* moving, if it turns: at time 0 */
};

/* What the score measures. Each has a loss (at least 0, 1 for a body that does nothing, lower is
 * better) and a value (larger is better, 0 for a body that does nothing). Stored by these
 * numbers. */
enum mo_objective {
  MO_OBJECTIVE_REACH = 0, /* distance to the light at the end over that at the start; fixed, moving
                           */
  MO_OBJECTIVE_APPROACH,  /* mean distance to the light over that at the start; fixed, moving */
  MO_OBJECTIVE_TRAVEL,    /* distance traveled in the direction of the heading; ahead, turning */
  MO_OBJECTIVE_FOLLOW,    /* progress on the path, minus the mean distance from it; path */
  MO_OBJECTIVE_CLIMB,     /* height that the center of mass has gained; any guide */
  MO_OBJECTIVE_PURSUE,    /* the same as approach, for a light that moves; moving */
  MO_OBJECTIVE_EFFICIENT, /* displacement minus MO_EFFICIENT_FLOOR_M, per work; any guide */
  MO_OBJECTIVE_JUMP,      /* largest height that the center of mass gains; any guide */
  MO_OBJECTIVE_SUM = 255  /* a weighted sum of objectives and measures (measure.h) */
};
extern const char *const mo_objective_words[]; /* "reach", "approach", …, NULL; none for the sum */

#define MO_EFFICIENT_FLOOR_M 0.2  /* distance that does not count */
#define MO_EFFICIENT_LEAST_J 1.0  /* less work than this counts as this much */
#define MO_JUMP_FROM_S       0.4  /* earlier heights do not count; the end always does */
#define MO_JUMP_SIDEWAYS     0.5  /* height that a meter of displacement subtracts, in m */
#define MO_JUMP_SOFTNESS_M   0.02 /* of the smooth maximum that gradients use */

/* The terms of a sum. The service accepts at most this many. */
#define MO_TERMS_MAX       8
#define MO_TERM_WEIGHT_MAX 1e6 /* of |weight| */
#define MO_TERM_MEASURE    256 /* this number + a measure is that measure */

/* All zero: the light is fixed, and the robot is to reach it. */
struct mo_task {
  struct mo_guide guide;
  enum mo_objective objective;
  uint32_t n_terms; /* of MO_OBJECTIVE_SUM, 1 … MO_TERMS_MAX; otherwise 0. Unused terms are 0 */
  uint32_t terms[MO_TERMS_MAX]; /* enum mo_objective, or MO_TERM_MEASURE + enum mo_measure;
                                   ascending, without duplicates */
  double weights[MO_TERMS_MAX]; /* not 0 */
};

/* Returns whether the light is fixed and the objective is `reach`. */
bool mo_task_is_plain(const struct mo_task *task);

/* Returns whether the guide uses light_xy_m of the environment; if not, that must be (0, 0). */
bool mo_guide_has_light(const struct mo_guide *guide);

/* Checks a task: known words, an objective that fits the guide, finite numbers within their bounds.
 * MO_ERR_INVALID or MO_ERR_RANGE; message (nullable) says which field is wrong and what to do. */
int mo_task_check(const struct mo_task *task, struct mo_message *message);

/* Checks whether a gradient exists: not for a sum with a measure that has no derivative.
 * MO_ERR_UNSUPPORTED; message (nullable) lists the terms that a gradient can have. */
int mo_task_check_gradient(const struct mo_task *task, struct mo_message *message);

/* Returns whether a task's value depends on the work of the springs. */
bool mo_task_needs_work(const struct mo_task *task);
/* Returns the measures, as bits, that a sum has among its terms and that have no derivative. */
uint32_t mo_task_measures(const struct mo_task *task);
/* Returns the name of a term: that of an objective or a measure; NULL: a sum cannot have it. */
const char *mo_term_name(uint32_t term);

/* Returns the unit of an objective's value: "m", "m/kJ", or "" for a number without a unit. */
const char *mo_objective_unit(enum mo_objective objective);
/* Returns the scale of the loss exp(−value / scale), in the unit of the value; 0: the loss is
 * 1 − value. */
double mo_objective_scale(enum mo_objective objective);
/* Returns the value that has a loss, to within rounding: −infinity for an infinite loss. */
double mo_objective_value(enum mo_objective objective, double loss);

#ifdef __cplusplus
}
#endif
#endif
