/* task.c: the words, units and bounds of tasks. */
#include "world/task.h"

#include <morpho/measure.h>
#include <morpho/world.h>

#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

const char *const mo_guide_words[] = {"fixed", "ahead", "turning", "path", "moving", NULL};
const char *const mo_objective_words[] = {"reach",  "approach",  "travel", "follow", "climb",
                                          "pursue", "efficient", "jump",   NULL};

/* Sets of guides. */
#define GUIDE(kind) (1U << MO_GUIDE_##kind)
#define DRIVEN      (GUIDE(FIXED) | GUIDE(MOVING))
#define EVERY       (DRIVEN | GUIDE(AHEAD) | GUIDE(TURNING) | GUIDE(PATH))

static const struct {
  unsigned guides;
  const char *words, *unit;
  double scale;
} objectives[] = {
    [MO_OBJECTIVE_REACH] = {DRIVEN, "fixed or moving", "", 0},
    [MO_OBJECTIVE_APPROACH] = {DRIVEN, "fixed or moving", "", 0},
    [MO_OBJECTIVE_TRAVEL] = {GUIDE(AHEAD) | GUIDE(TURNING), "ahead or turning", "m", 1},
    [MO_OBJECTIVE_FOLLOW] = {GUIDE(PATH), "path", "m", 1},
    [MO_OBJECTIVE_CLIMB] = {EVERY, "any", "m", 0.1},
    [MO_OBJECTIVE_PURSUE] = {GUIDE(MOVING), "moving", "", 0},
    [MO_OBJECTIVE_EFFICIENT] = {EVERY, "any", "m/kJ", 0.1},
    [MO_OBJECTIVE_JUMP] = {EVERY, "any", "m", 0.1},
};
#define OBJECTIVES (sizeof(objectives) / sizeof(*objectives))
#define SUM_SCALE  1.0

bool mo_task_is_plain(const struct mo_task *task)
{
  return task->guide.kind == MO_GUIDE_FIXED && task->objective == MO_OBJECTIVE_REACH;
}

const char *mo_objective_unit(enum mo_objective objective)
{
  return (unsigned)objective < OBJECTIVES ? objectives[objective].unit : "";
}

double mo_objective_scale(enum mo_objective objective)
{
  return objective == MO_OBJECTIVE_SUM ? SUM_SCALE : objectives[objective].scale;
}

double mo_objective_value(enum mo_objective objective, double loss)
{
  const double scale = mo_objective_scale(objective);
  if (!isfinite(loss))
    return -(double)INFINITY;
  return scale > 0 ? -scale * log(loss) : 1 - loss;
}

/* ---- the terms of a sum ---- */

#define TERM(measure) (1U << MO_MEASURE_##measure)
/* Measures that may have no value, or whose sign says nothing about good or bad. */
#define NO_TERMS (TERM(HEADING_ERROR) | TERM(COST_OF_TRANSPORT) | TERM(SIDEWAYS))
/* Measures that have a derivative. */
#define SMOOTH                                                                                     \
  (TERM(DISPLACEMENT) | TERM(PATH_LENGTH) | TERM(MEAN_SPEED) | TERM(STRAIGHTNESS) |                \
   TERM(MEAN_HEIGHT) | TERM(WORK))

const char *mo_term_name(uint32_t term)
{
  if (term < OBJECTIVES)
    return mo_objective_words[term];
  if (term < MO_TERM_MEASURE || term - MO_TERM_MEASURE >= MO_MEASURES ||
      (NO_TERMS >> (term - MO_TERM_MEASURE) & 1) != 0)
    return NULL;
  return mo_measure_info[term - MO_TERM_MEASURE].name;
}

bool mo_task_has_tally(const struct mo_task *task)
{
  return task->objective > MO_OBJECTIVE_PURSUE;
}

bool mo_task_needs_work(const struct mo_task *task)
{
  bool needs = task->objective == MO_OBJECTIVE_EFFICIENT;
  for (uint32_t i = 0; i < task->n_terms; i++)
    needs = needs || task->terms[i] == MO_OBJECTIVE_EFFICIENT ||
            task->terms[i] == MO_TERM_MEASURE + MO_MEASURE_WORK;
  return needs;
}

uint32_t mo_task_measures(const struct mo_task *task)
{
  uint32_t set = 0;
  for (uint32_t i = 0; i < task->n_terms; i++)
    if (task->terms[i] >= MO_TERM_MEASURE)
      set |= UINT32_C(1) << (task->terms[i] - MO_TERM_MEASURE);
  return set & ~SMOOTH;
}

int mo_task_check_gradient(const struct mo_task *task, struct mo_message *message)
{
  const uint32_t set = mo_task_measures(task);
  char list[512];
  size_t used = 0;
  if (set == 0)
    return MO_OK;
  for (uint32_t term = 0; term < MO_TERM_MEASURE + MO_MEASURES; term++)
    if (term < OBJECTIVES ||
        (term >= MO_TERM_MEASURE && (SMOOTH >> (term - MO_TERM_MEASURE) & 1) != 0))
      used += (size_t)snprintf(list + used, sizeof(list) - used, "%s%s", used > 0 ? ", " : "",
                               mo_term_name(term));
  return mo_fail(message, MO_ERR_UNSUPPORTED,
                 "%s has no derivative; for learning, the terms of an objective may be %s",
                 mo_measure_info[__builtin_ctz(set)].name, list);
}

static int check_terms(const struct mo_task *task, struct mo_message *message)
{
  const uint32_t n = task->n_terms;
  if (task->objective == MO_OBJECTIVE_SUM ? n < 1 || n > MO_TERMS_MAX : n != 0)
    return mo_fail(message, MO_ERR_RANGE, "a sum must have at least 1 and at most %d terms, got %u",
                   MO_TERMS_MAX, n);
  for (uint32_t i = 0; i < MO_TERMS_MAX; i++) {
    const uint32_t term = task->terms[i];
    const double weight = task->weights[i];
    if (i >= n) {
      if (term != 0 || weight != 0)
        return mo_fail(message, MO_ERR_INVALID, "members that a sum does not use must be 0");
      continue;
    }
    const char *name = mo_term_name(term);
    if (name == NULL || (i > 0 && term <= task->terms[i - 1]))
      return mo_fail(message, MO_ERR_INVALID, "the terms of a sum must be known and ascending");
    if (!isfinite(weight) || weight == 0)
      return mo_fail(message, MO_ERR_INVALID,
                     "the weight of %s must be a finite number other than 0", name);
    if (fabs(weight) > MO_TERM_WEIGHT_MAX)
      return mo_fail(message, MO_ERR_RANGE,
                     "the weight of %s must be at least %g and at most %g, got %g", name,
                     -MO_TERM_WEIGHT_MAX, MO_TERM_WEIGHT_MAX, weight);
  }
  return MO_OK;
}

/* ---- guides ---- */

bool mo_guide_has_light(const struct mo_guide *guide)
{
  return (DRIVEN >> guide->kind & 1) != 0;
}

static int check_number(const char *name, double value, double min, double max,
                        struct mo_message *message)
{
  if (!isfinite(value))
    return mo_fail(message, MO_ERR_INVALID, "%s must be a finite number", name);
  if (value < min || value > max)
    return mo_fail(message, MO_ERR_RANGE, "%s must be at least %g and at most %g, got %g", name,
                   min, max, value);
  return MO_OK;
}

static int check_pair(const char *name, const double pair[2], double limit,
                      struct mo_message *message)
{
  const int error = check_number(name, pair[0], -limit, limit, message);
  return error != MO_OK ? error : check_number(name, pair[1], -limit, limit, message);
}

static int check_turn(const struct mo_guide *guide, struct mo_message *message)
{
  return check_number("turn_rad_per_s", guide->turn_rad_per_s, -MO_GUIDE_TURN_MAX_RAD_PER_S,
                      MO_GUIDE_TURN_MAX_RAD_PER_S, message);
}

static int check_distance(const struct mo_guide *guide, struct mo_message *message)
{
  return check_number("distance_m", guide->distance_m, MO_GUIDE_DISTANCE_MIN_M,
                      MO_GUIDE_DISTANCE_MAX_M, message);
}

static int check_heading(const struct mo_guide *guide, struct mo_message *message)
{
  const int error = check_number("heading_rad", guide->heading_rad, -MO_GUIDE_HEADING_MAX_RAD,
                                 MO_GUIDE_HEADING_MAX_RAD, message);
  return error != MO_OK ? error : check_distance(guide, message);
}

static int check_path(const struct mo_guide *guide, struct mo_message *message)
{
  if (guide->n_points < 1 || guide->n_points > MO_GUIDE_POINTS_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "points_m must have at least 1 and at most %d points, got %u",
                   MO_GUIDE_POINTS_MAX, guide->n_points);
  int error = check_distance(guide, message);
  for (uint32_t i = 0; i < guide->n_points && error == MO_OK; i++)
    error =
        check_pair("each coordinate in points_m", guide->points_m[i], MO_LIGHT_LIMIT_M, message);
  return error;
}

static int check_moving(const struct mo_guide *guide, struct mo_message *message)
{
  int error = check_pair("each component of velocity_m_per_s", guide->velocity_m_per_s,
                         MO_GUIDE_SPEED_MAX_M_PER_S, message);
  if (error == MO_OK)
    error = check_pair("each coordinate of center_m", guide->center_m, MO_LIGHT_LIMIT_M, message);
  return error != MO_OK ? error : check_turn(guide, message);
}

/* Returns a guide with only the fields that its kind uses. */
static struct mo_guide used_of(const struct mo_guide *guide)
{
  struct mo_guide used = {.kind = guide->kind};
  switch (guide->kind) {
  case MO_GUIDE_FIXED: break;
  case MO_GUIDE_TURNING: used.turn_rad_per_s = guide->turn_rad_per_s; /* fallthrough */
  case MO_GUIDE_AHEAD:
    used.heading_rad = guide->heading_rad;
    used.distance_m = guide->distance_m;
    break;
  case MO_GUIDE_PATH:
    used.distance_m = guide->distance_m;
    used.n_points = guide->n_points;
    memcpy(used.points_m, guide->points_m, guide->n_points * sizeof(used.points_m[0]));
    break;
  case MO_GUIDE_MOVING:
    used.turn_rad_per_s = guide->turn_rad_per_s;
    memcpy(used.velocity_m_per_s, guide->velocity_m_per_s, sizeof(used.velocity_m_per_s));
    if (guide->turn_rad_per_s != 0)
      memcpy(used.center_m, guide->center_m, sizeof(used.center_m));
    break;
  }
  return used;
}

static bool pairs_are_equal(const double (*a)[2], const double (*b)[2], size_t n)
{
  for (size_t i = 0; i < n; i++)
    if (a[i][0] != b[i][0] || a[i][1] != b[i][1])
      return false;
  return true;
}

static bool guides_are_equal(const struct mo_guide *a, const struct mo_guide *b)
{
  return a->kind == b->kind && a->n_points == b->n_points && a->heading_rad == b->heading_rad &&
         a->turn_rad_per_s == b->turn_rad_per_s && a->distance_m == b->distance_m &&
         pairs_are_equal(a->points_m, b->points_m, MO_GUIDE_POINTS_MAX) &&
         pairs_are_equal(&a->velocity_m_per_s, &b->velocity_m_per_s, 1) &&
         pairs_are_equal(&a->center_m, &b->center_m, 1);
}

static int check_kind(const struct mo_guide *guide, struct mo_message *message)
{
  int error = MO_OK;
  switch (guide->kind) {
  case MO_GUIDE_FIXED: break;
  case MO_GUIDE_AHEAD: return check_heading(guide, message);
  case MO_GUIDE_TURNING:
    error = check_heading(guide, message);
    return error != MO_OK ? error : check_turn(guide, message);
  case MO_GUIDE_PATH: return check_path(guide, message);
  case MO_GUIDE_MOVING: return check_moving(guide, message);
  }
  return error;
}

static int check_fit(const struct mo_guide *guide, uint32_t objective, struct mo_message *message)
{
  if ((objectives[objective].guides >> guide->kind & 1) == 0)
    return mo_fail(message, MO_ERR_INVALID, "objective %s needs a guide that is %s, got %s",
                   mo_objective_words[objective], objectives[objective].words,
                   mo_guide_words[guide->kind]);
  return MO_OK;
}

int mo_task_check(const struct mo_task *task, struct mo_message *message)
{
  const struct mo_guide *guide = &task->guide;
  if ((unsigned)guide->kind > MO_GUIDE_MOVING)
    return mo_fail(message, MO_ERR_INVALID, "unknown kind of guide %d", (int)guide->kind);
  if ((unsigned)task->objective >= OBJECTIVES && task->objective != MO_OBJECTIVE_SUM)
    return mo_fail(message, MO_ERR_INVALID, "unknown objective %d", (int)task->objective);
  int error = check_terms(task, message);
  if (error == MO_OK && task->objective != MO_OBJECTIVE_SUM)
    error = check_fit(guide, task->objective, message);
  for (uint32_t i = 0; i < task->n_terms && error == MO_OK; i++)
    if (task->terms[i] < OBJECTIVES)
      error = check_fit(guide, task->terms[i], message);
  if (error == MO_OK)
    error = check_kind(guide, message);
  if (error != MO_OK)
    return error;
  /* Unused fields must be 0, so that equal tasks have equal hashes. */
  const struct mo_guide used = used_of(guide);
  if (!guides_are_equal(&used, guide))
    return mo_fail(message, MO_ERR_INVALID,
                   "members that a guide of kind %s does not use must be 0",
                   mo_guide_words[guide->kind]);
  return MO_OK;
}
