/* measuring.c: see measuring.h. */
#include "rollout/measuring.h"

#include "rollout/distance.h"
#include "rollout/scene.h"
#include "world/measures.h"

#include <math.h>
#include <string.h>

#define BIT(name) (UINT32_C(1) << MO_MEASURE_##name)

/* Below this distance, a quotient by it, or a direction along it, is noise. */
#define LEAST_WAY_M 0.01

unsigned mo_observations(uint32_t set)
{
  static const struct {
    unsigned observation;
    uint32_t measures;
  } needs[] = {
      {MO_OBSERVE_MOTION, BIT(DISPLACEMENT) | BIT(PATH_LENGTH) | BIT(MEAN_SPEED) |
                              BIT(STRAIGHTNESS) | BIT(HEADING_ERROR) | BIT(SIDEWAYS) |
                              BIT(PEAK_HEIGHT) | BIT(MEAN_HEIGHT) | BIT(TILT) | BIT(YAW_RATE) |
                              BIT(COST_OF_TRANSPORT)},
      {MO_OBSERVE_AIR, BIT(AIR_SHARE) | BIT(HOPS)},
      {MO_OBSERVE_CONTACTS,
       BIT(CONTACT_FRONT) | BIT(CONTACT_BACK) | BIT(CONTACT_LEFT) | BIT(CONTACT_RIGHT)},
      {MO_OBSERVE_SPRINGS, BIT(WORK) | BIT(COST_OF_TRANSPORT) | BIT(PEAK_STRAIN)},
      {MO_OBSERVE_VOXELS, BIT(INVERTED_VOXELS)},
  };
  unsigned observations = 0;
  for (size_t i = 0; i < sizeof(needs) / sizeof(needs[0]); i++)
    if ((needs[i].measures & set) != 0)
      observations |= needs[i].observation;
  return observations;
}

unsigned mo_observations_for(const struct mo_task *task, const struct mo_measuring *measuring)
{
  const unsigned work = mo_task_needs_work(task) ? MO_OBSERVE_SPRINGS : 0;
  return work | mo_observations(mo_task_measures(task)) |
         (measuring != NULL ? mo_observations(measuring->set) : 0);
}

static double height_above(const struct mo_observer *o, const double com_m[3])
{
  return com_m[2] - mo_terrain_height(o->environment, com_m[0], com_m[1]);
}

void mo_observer_begin(struct mo_observer *observer, const struct mo_body *body,
                       const struct mo_environment *environment, const struct mo_physics *physics,
                       const double com_start_m[3], const double light_xy_m[2])
{
  const struct mo_scheme *scheme = &physics->scheme;
  const uint32_t control_steps = mo_control_steps(scheme);
  *observer = (struct mo_observer){.body = body,
                                   .environment = environment,
                                   .constants = mo_scene_constants(environment, physics),
                                   .duration_s = scheme->n_steps * scheme->dt_s,
                                   .n_steps = scheme->n_steps,
                                   .n_periods = (scheme->n_steps - 1) / control_steps + 1,
                                   .start_turn = {2, 0},
                                   .last.turn = {2, 0}};
  memcpy(observer->light_xy_m, light_xy_m, sizeof(observer->light_xy_m));
  memcpy(observer->start_m, com_start_m, sizeof(observer->start_m));
  memcpy(observer->last.com_m, com_start_m, sizeof(observer->last.com_m));
  observer->peak_height_m = height_above(observer, com_start_m);
}

void mo_observer_pose(struct mo_observer *observer, const struct mo_pose *pose)
{
  memcpy(observer->start_turn, pose->turn, sizeof(observer->start_turn));
  observer->last = *pose;
}

/* The yaw passes π where the second component of `turn` changes its sign and the first is below 0:
 * between two instants the body rotates by less than half a turn, so the sign of the cross product
 * is the direction of its turn. */
static int turns_between(const double from[2], const double to[2])
{
  if ((from[1] < 0) == (to[1] < 0))
    return 0;
  const double cross = from[0] * to[1] - from[1] * to[0];
  if (from[1] < 0)
    return cross < 0 ? -1 : 0;
  return cross > 0 ? 1 : 0;
}

void mo_observe(struct mo_observer *observer, const struct mo_pose *pose)
{
  struct mo_observer *o = observer;
  const double dx = pose->com_m[0] - o->last.com_m[0], dy = pose->com_m[1] - o->last.com_m[1];
  const double height = height_above(o, pose->com_m);
  o->path_m += sqrt(dx * dx + dy * dy);
  o->height_sum_m += height;
  if (height > o->peak_height_m)
    o->peak_height_m = height;
  o->turns += turns_between(o->last.turn, pose->turn);
  o->last = *pose;
}

/* ---- the values ---- */

static double yaw_of(const double turn[2])
{
  return atan2(turn[1] + 0.0, turn[0]);
}

static void finish_motion(const struct mo_observer *o, const double up[3], double *values)
{
  const double *end = o->last.com_m, *turn = o->last.turn;
  const double dx = end[0] - o->start_m[0], dy = end[1] - o->start_m[1];
  const double to_light[2] = {o->light_xy_m[0] - o->start_m[0], o->light_xy_m[1] - o->start_m[1]};
  const double displacement = mo_distance(dx, dy), away = mo_distance(to_light[0], to_light[1]);
  const double along = to_light[0] * dx + to_light[1] * dy,
               across = to_light[0] * dy - to_light[1] * dx;
  values[MO_MEASURE_DISPLACEMENT] = displacement;
  values[MO_MEASURE_PATH_LENGTH] = o->path_m;
  values[MO_MEASURE_MEAN_SPEED] = o->path_m / o->duration_s;
  values[MO_MEASURE_STRAIGHTNESS] = o->path_m > 0 ? displacement / o->path_m : 0;
  if (away > 0 && displacement >= LEAST_WAY_M)
    values[MO_MEASURE_HEADING_ERROR] = atan2(fabs(across), along);
  if (away > 0)
    values[MO_MEASURE_SIDEWAYS] = across / away;
  values[MO_MEASURE_PEAK_HEIGHT] = o->peak_height_m;
  values[MO_MEASURE_MEAN_HEIGHT] = o->height_sum_m / o->n_periods;
  values[MO_MEASURE_TILT] = atan2(mo_distance(up[0], up[1]), up[2]);
  values[MO_MEASURE_YAW_RATE] =
      (yaw_of(turn) + 2 * M_PI * (double)o->turns - yaw_of(o->start_turn)) / o->duration_s;
}

static void finish_contacts(const struct mo_observer *o, double *values)
{
  const double both = o->contacts > 0 ? 2.0 * (double)o->contacts : 1;
  values[MO_MEASURE_AIR_SHARE] = (double)o->air_steps / o->n_steps;
  values[MO_MEASURE_HOPS] = (double)o->hops / o->duration_s;
  values[MO_MEASURE_CONTACT_FRONT] = (double)o->front_2 / both;
  values[MO_MEASURE_CONTACT_BACK] = (double)(2 * o->contacts - o->front_2) / both;
  values[MO_MEASURE_CONTACT_LEFT] = (double)o->left_2 / both;
  values[MO_MEASURE_CONTACT_RIGHT] = (double)(2 * o->contacts - o->left_2) / both;
}

static void finish_springs(const struct mo_observer *o, double *values)
{
  const struct mo_constants *c = &o->constants;
  const double weight_n = o->body->n_masses * c->mass_kg * c->gravity_m_per_s2;
  values[MO_MEASURE_WORK] = o->work_j;
  if (o->path_m >= LEAST_WAY_M && weight_n > 0)
    values[MO_MEASURE_COST_OF_TRANSPORT] = o->work_j / (weight_n * o->path_m);
  values[MO_MEASURE_PEAK_STRAIN] = o->strain;
  values[MO_MEASURE_INVERTED_VOXELS] = o->inverted;
}

void mo_observer_finish(const struct mo_observer *observer, bool diverged, const double up[3],
                        double observed[MO_MEASURES])
{
  for (int k = 0; k < MO_MEASURES; k++)
    observed[k] = NAN;
  if (diverged)
    return;
  finish_motion(observer, up, observed);
  finish_contacts(observer, observed);
  finish_springs(observer, observed);
}

void mo_measures_round(uint32_t set, const double observed[MO_MEASURES], double values[MO_MEASURES])
{
  for (int k = 0; k < MO_MEASURES; k++) {
    const bool wanted = (set >> k & 1) != 0;
    values[k] = wanted ? mo_measure_round((unsigned)k, observed[k]) : NAN;
  }
}

/* ---- the body at rest ---- */

/* Computes the sums of the masses' lattice coordinates. */
static void sum_lattice(const struct mo_body *body, int64_t sum[3])
{
  memset(sum, 0, 3 * sizeof(*sum));
  for (uint32_t m = 0; m < body->n_masses; m++)
    for (int axis = 0; axis < 3; axis++)
      sum[axis] += body->mass_xyz[3 * (size_t)m + (size_t)axis];
}

/* Computes a mass's place at rest, relative to the center of mass. */
static void rest_offset(const struct mo_body *body, const int64_t sum[3], uint32_t mass,
                        double offset_m[3])
{
  const uint16_t *xyz = body->mass_xyz + 3 * (size_t)mass;
  for (int axis = 0; axis < 3; axis++)
    offset_m[axis] =
        MO_VOXEL_M * (double)((int64_t)body->n_masses * xyz[axis] - sum[axis]) / body->n_masses;
}

/* Inverts a symmetric matrix. The matrix of a body is regular, because a body has a voxel, which
 * spans all axes. */
static void invert(const double m[3][3], double inverse[3][3])
{
  double cofactor[3][3];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++)
      cofactor[i][j] = m[(i + 1) % 3][(j + 1) % 3] * m[(i + 2) % 3][(j + 2) % 3] -
                       m[(i + 1) % 3][(j + 2) % 3] * m[(i + 2) % 3][(j + 1) % 3];
  const double determinant =
      m[0][0] * cofactor[0][0] + m[0][1] * cofactor[0][1] + m[0][2] * cofactor[0][2];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++)
      inverse[i][j] = cofactor[i][j] / determinant;
}

void mo_measuring_frame(const struct mo_body *body, double (*rows)[3])
{
  int64_t sum[3];
  double spread[3][3] = {{0}}, inverse[3][3];
  sum_lattice(body, sum);
  for (uint32_t m = 0; m < body->n_masses; m++) {
    double offset[3];
    rest_offset(body, sum, m, offset);
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++)
        spread[i][j] += offset[i] * offset[j];
  }
  invert(spread, inverse);
  for (uint32_t m = 0; m < body->n_masses; m++) {
    double offset[3];
    rest_offset(body, sum, m, offset);
    for (int i = 0; i < 3; i++)
      rows[m][i] =
          inverse[i][0] * offset[0] + inverse[i][1] * offset[1] + inverse[i][2] * offset[2];
  }
}

void mo_measuring_halves(const struct mo_body *body, uint8_t (*halves)[2])
{
  int64_t sum[3];
  sum_lattice(body, sum);
  for (uint32_t m = 0; m < body->n_masses; m++)
    for (int axis = 0; axis < 2; axis++) {
      const int64_t from =
          (int64_t)body->n_masses * body->mass_xyz[3 * (size_t)m + (size_t)axis] - sum[axis];
      halves[m][axis] = (uint8_t)(from > 0 ? 2 : from == 0 ? 1 : 0);
    }
}
