/* task.c: the words, units and bounds of tasks. */
#include <morpho/world.h>

#include <math.h>
#include <stddef.h>
#include <string.h>

const char *const mo_guide_words[] = {"fixed", "ahead", "turning", "path", "moving", NULL};
const char *const mo_objective_words[] = {"reach", "approach", "travel", "follow",
                                          "climb", "pursue",   NULL};

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
};
#define OBJECTIVES (sizeof(objectives) / sizeof(*objectives))

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
  return objectives[objective].scale;
}

double mo_objective_value(enum mo_objective objective, double loss)
{
  const double scale = objectives[objective].scale;
  if (!isfinite(loss))
    return -(double)INFINITY;
  return scale > 0 ? -scale * log(loss) : 1 - loss;
}

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

int mo_task_check(const struct mo_task *task, struct mo_message *message)
{
  const struct mo_guide *guide = &task->guide;
  if ((unsigned)guide->kind > MO_GUIDE_MOVING)
    return mo_fail(message, MO_ERR_INVALID, "unknown kind of guide %d", (int)guide->kind);
  if ((unsigned)task->objective >= OBJECTIVES)
    return mo_fail(message, MO_ERR_INVALID, "unknown objective %d", (int)task->objective);
  if ((objectives[task->objective].guides >> guide->kind & 1) == 0)
    return mo_fail(message, MO_ERR_INVALID, "objective %s needs a guide that is %s, got %s",
                   mo_objective_words[task->objective], objectives[task->objective].words,
                   mo_guide_words[guide->kind]);
  const int error = check_kind(guide, message);
  if (error != MO_OK)
    return error;
  /* So that equal tasks have equal hashes. */
  const struct mo_guide used = used_of(guide);
  if (!guides_are_equal(&used, guide))
    return mo_fail(message, MO_ERR_INVALID, "what a guide of kind %s does not use must be 0",
                   mo_guide_words[guide->kind]);
  return MO_OK;
}
