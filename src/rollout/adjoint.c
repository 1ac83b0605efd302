/* adjoint.c: the derivative of reference.c, one step at a time. Each function quotes the forward
 * lines that it differentiates; dx is ∂loss/∂x, and contributions are added, never assigned. */
#include "rollout/adjoint.h"

#include "rollout/contact.h"
#include "rollout/damage.h"
#include "rollout/scene.h"

#include <math.h>
#include <string.h>

/* Returns the factor f in ∂light/∂p = f · (p − light), which is (dI/dd)/d. Returns 0 at the light
 * itself, where inverse_sqrt has no derivative. */
static double sense_slope(enum mo_sensor sensor, double distance_m)
{
  if (sensor == MO_SENSOR_INVERSE_SQUARE) { /* 1 / (d² + 1e-4) */
    const double light = 1.0 / (distance_m * distance_m + 1e-4);
    return -2.0 * light * light;
  }
  if (!(distance_m > 0))
    return 0;
  const double root = sqrt(distance_m + 1e-8),
               light = 1.0 / (root + 1e-8); /* 1 / (sqrt(d + 1e-8) + 1e-8) */
  return -light * light / (2.0 * root * distance_m);
}

/* com = sum of positions / n */
static void add_com(const struct mo_reference *r, const double d_com[3], struct mo_adjoint *adjoint)
{
  const size_t n = r->body->n_masses;
  for (size_t i = 0; i < 3 * n; i++)
    adjoint->d_position[i] += d_com[i % 3] / (double)n;
}

/* Differentiates the instant at the start of step number `step`. */
static void guide_adjoint(const struct mo_reference *r, uint32_t step, const double d_light[3],
                          struct mo_adjoint *adjoint)
{
  const struct mo_track *track = r->tracks + step / r->control_steps;
  double d_com[3];
  mo_course_back(&r->course, step * r->physics->scheme.dt_s, step > 0 ? track - 1 : NULL, track,
                 d_light, &adjoint->course, d_com);
  add_com(r, d_com, adjoint);
}

/* input[lattice place of mass i] = light(i) − mean */
static void sense_light_adjoint(const struct mo_reference *r, const double *position_m,
                                const double light_m[3], struct mo_adjoint *adjoint,
                                double d_light_m[3])
{
  const struct mo_body *body = r->body;
  double mean = 0;
  for (uint32_t i = 0; i < body->n_masses; i++)
    mean += adjoint->d_input[body->mass_lattice[i]];
  mean /= body->n_masses;
  for (uint32_t i = 0; i < body->n_masses; i++) {
    const double *p = position_m + 3 * (size_t)i;
    double *dp = adjoint->d_position + 3 * (size_t)i;
    const double d[3] = {p[0] - light_m[0], p[1] - light_m[1], p[2] - light_m[2]};
    const double slope =
        sense_slope(r->controller->sensor, sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]));
    const double d_light = adjoint->d_input[body->mass_lattice[i]] - mean;
    for (int axis = 0; axis < 3; axis++) {
      dp[axis] += d_light * slope * d[axis];
      d_light_m[axis] -= d_light * slope * d[axis];
    }
  }
}

static void pull_springs_adjoint(const struct mo_reference *r, uint32_t step,
                                 const struct mo_step_tape *tape, struct mo_adjoint *adjoint)
{
  const struct mo_body *body = r->body;
  const struct mo_scheme *scheme = &r->physics->scheme;
  const struct mo_constants constants = mo_scene_constants(r->environment, r->physics);
  const bool blends = mo_reference_blends(r, step);
  for (uint32_t s = 0; s < body->n_springs; s++) {
    if (mo_damage_lasts(r->cut, r->cut_step, step, s)) {
      adjoint->d_previous[s] = 0;
      continue;
    }
    const size_t a = 3 * (size_t)body->spring_a[s], b = 3 * (size_t)body->spring_b[s];
    double d[3], across[3];
    for (int axis = 0; axis < 3; axis++) {
      d[axis] = tape->position_m[a + axis] - tape->position_m[b + axis];
      /* impulse[a] −= pull · d,   impulse[b] += pull · d */
      across[axis] = adjoint->d_impulse[b + axis] - adjoint->d_impulse[a + axis];
    }
    const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]), guarded = length + 1e-8;
    const double free_rest = body->spring_rest_m[s];
    const double rest = free_rest * (1.0 + constants.actuation * tape->activation[s]);
    const double stiffness = scheme->dt_s * constants.stiffness_n_per_m;
    const double pull = stiffness * (length - rest) / guarded;
    const double d_pull = across[0] * d[0] + across[1] * d[1] + across[2] * d[2];
    /* pull = dt · k · (length − rest) / (length + 1e-8) */
    const double d_length = d_pull * stiffness * (rest + 1e-8) / (guarded * guarded);
    const double d_rest = -d_pull * stiffness / guarded;
    /* rest = free_rest · (1 + actuation · activation) */
    const double d_activation = d_rest * free_rest * constants.actuation;
    /* activation = the output, or 0.5 · (previous output + output) */
    adjoint->d_output[s] += blends ? 0.5 * d_activation : d_activation;
    adjoint->d_previous[s] = blends ? 0.5 * d_activation : 0;
    /* length = |d|,   d = position[a] − position[b] */
    for (int axis = 0; axis < 3; axis++) {
      const double dd = pull * across[axis] + (length > 0 ? d_length * d[axis] / length : 0);
      adjoint->d_position[a + axis] += dd;
      adjoint->d_position[b + axis] -= dd;
    }
  }
}

/* Differentiates the work at the start of a control period: work += k / 2 · max(after² − before²,
 * 0) over the springs, which depends on the new outputs, on the previous ones, and on the
 * positions. */
static void work_adjoint(const struct mo_reference *r, uint32_t step,
                         const struct mo_step_tape *tape, struct mo_adjoint *adjoint)
{
  const struct mo_body *body = r->body;
  const struct mo_constants constants = mo_scene_constants(r->environment, r->physics);
  const double d_work = adjoint->course.d_work * constants.stiffness_n_per_m;
  for (uint32_t s = 0; s < body->n_springs; s++) {
    if (mo_damage_lasts(r->cut, r->cut_step, step, s))
      continue;
    const size_t a = 3 * (size_t)body->spring_a[s], b = 3 * (size_t)body->spring_b[s];
    double d[3];
    for (int axis = 0; axis < 3; axis++)
      d[axis] = tape->position_m[a + axis] - tape->position_m[b + axis];
    const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]),
                 rest = body->spring_rest_m[s], reach = rest * constants.actuation;
    const double before = length - rest * (1 + constants.actuation * tape->previous[s]),
                 after = length - rest * (1 + constants.actuation * tape->control.output[s]);
    if (!(after * after > before * before))
      continue;
    adjoint->d_output[s] -= d_work * after * reach;
    adjoint->d_previous[s] += d_work * before * reach;
    const double d_length = d_work * (after - before);
    for (int axis = 0; axis < 3 && length > 0; axis++) {
      adjoint->d_position[a + axis] += d_length * d[axis] / length;
      adjoint->d_position[b + axis] -= d_length * d[axis] / length;
    }
  }
}

static void move_masses_adjoint(const struct mo_reference *r, uint32_t step,
                                const struct mo_step_tape *tape, struct mo_adjoint *adjoint)
{
  const struct mo_scheme *scheme = &r->physics->scheme;
  const struct mo_constants constants = mo_scene_constants(r->environment, r->physics);
  const struct mo_kick kick = mo_reference_kick(r, &constants, step);
  memset(adjoint->d_impulse, 0, (size_t)r->body->n_masses * 3 * sizeof(double));
  for (uint32_t i = 0; i < r->body->n_masses; i++) {
    const size_t at = 3 * (size_t)i;
    double da[3] = {0, 0, 0};
    if (scheme->integrator == MO_INTEGRATOR_SPLIT)
      mo_contact_split_adjoint(scheme, &constants, r->environment, r->highest_m,
                               tape->acceleration + at, tape->position_m + at,
                               tape->velocity_m_per_s + at, adjoint->d_position + at,
                               adjoint->d_velocity + at, da);
    else
      mo_contact_move_adjoint(scheme, &constants, r->environment, r->highest_m,
                              tape->position_m + at, tape->velocity_m_per_s + at,
                              adjoint->d_position + at, adjoint->d_velocity + at);
    /* v = keep · v + push · impulse / mass,   v[2] −= fall
     * acceleration = impulse / (mass · dt),   acceleration[2] −= gravity */
    for (int axis = 0; axis < 3; axis++) {
      adjoint->d_impulse[at + axis] +=
          kick.push * adjoint->d_velocity[at + axis] / constants.mass_kg;
      if (scheme->integrator == MO_INTEGRATOR_SPLIT)
        adjoint->d_impulse[at + axis] += da[axis] / (constants.mass_kg * scheme->dt_s);
      adjoint->d_velocity[at + axis] *= kick.keep;
    }
  }
}

void mo_adjoint_step(const struct mo_reference *r, uint32_t step, struct mo_step_tape *tape,
                     struct mo_adjoint *adjoint)
{
  const size_t bytes = r->body->n_springs * sizeof(double);
  move_masses_adjoint(r, step, tape, adjoint);
  if (step + 1 == r->physics->scheme.n_steps)
    memset(adjoint->d_output, 0, bytes);
  else if ((step + 1) % r->control_steps == 0)
    memcpy(adjoint->d_output, adjoint->d_previous, bytes);
  pull_springs_adjoint(r, step, tape, adjoint);
  if (step % r->control_steps != 0)
    return;
  if (r->works && step > 0)
    work_adjoint(r, step, tape, adjoint);
  memset(adjoint->d_input, 0, r->controller->n_inputs * sizeof(double));
  mo_controller_backward(r->controller, r->body->spring_lattice, r->body->n_springs,
                         adjoint->d_output, &tape->control, adjoint->d_input);
  double light_m[3], d_light_m[3] = {0, 0, 0};
  mo_reference_light(r, step, light_m);
  sense_light_adjoint(r, tape->position_m, light_m, adjoint, d_light_m);
  if (r->tracks != NULL)
    guide_adjoint(r, step, d_light_m, adjoint);
}

void mo_adjoint_start(const struct mo_reference *r, const double *com_m, const struct mo_goal *goal,
                      double weight, struct mo_adjoint *adjoint)
{
  const size_t n = r->body->n_masses;
  memset(adjoint->d_position, 0, n * 3 * sizeof(double));
  memset(adjoint->d_velocity, 0, n * 3 * sizeof(double));
  const struct mo_seed seed = mo_goal_seed(goal, mo_away_of(r->environment->light_xy_m, com_m));
  /* com = sum of positions / n */
  for (int axis = 0; axis < 2 && seed.length > 0; axis++) {
    const double toward = axis == 0 ? seed.toward.x : seed.toward.y;
    const double d_com = weight * toward / seed.length / seed.scale;
    for (size_t i = 0; i < n; i++)
      adjoint->d_position[3 * i + axis] += d_com / (double)n;
  }
}

void mo_adjoint_start_at(const struct mo_reference *r, const double d_com[3],
                         struct mo_adjoint *adjoint)
{
  const size_t bytes = (size_t)r->body->n_masses * 3 * sizeof(double);
  memset(adjoint->d_position, 0, bytes);
  memset(adjoint->d_velocity, 0, bytes);
  add_com(r, d_com, adjoint);
}
