/* gradient-physics-kernel.c: see gradient-physics.h. MO_FAST_ISA is the instruction set. */
#define MO_FAST_DOUBLE    0
#define MO_JOIN3(a, b, c) a##b##c
#define MO_JOIN(a, b, c)  MO_JOIN3(a, b, c)
#include "rollout/gradient_physics.inc"

#include <stdlib.h>

#include "gradient-physics.h"

struct machine {
  struct phys_robot robot;
  void *memory;
  REAL *arrays; /* one allocation */
  REAL *sensors, *slots, *d_slots, *state, *adjoint, *scratch;
  REAL *records; /* (n_records, n_record_reals) */
};

static REAL *take(REAL **at, size_t n)
{
  REAL *piece = *at;
  *at += n;
  return piece;
}

static bool create(struct machine *k, const struct physics_scene *scene, size_t n_records)
{
  *k = (struct machine){0};
  k->memory = aligned_alloc(64, phys_bytes(scene->body));
  if (k->memory == NULL)
    return false;
  struct phys_robot *r = &k->robot;
  phys_prepare(r, scene->body, scene->environment, scene->physics, scene->sensor, k->memory);
  const size_t reals = r->n_sensor_reals + 2 * (size_t)r->n_slot_reals + 2 * r->n_state_reals +
                       r->n_scratch_reals + n_records * r->n_record_reals;
  k->arrays = aligned_alloc(64, (reals * sizeof(REAL) + 63) / 64 * 64);
  if (k->arrays == NULL) {
    free(k->memory);
    return false;
  }
  for (size_t i = 0; i < reals; i++) /* the result must not depend on the previous contents */
    k->arrays[i] = i % 3 == 0 ? (REAL)NAN : i % 3 == 1 ? (REAL)INFINITY : (REAL)-1e30;
  REAL *at = k->arrays;
  k->sensors = take(&at, r->n_sensor_reals);
  k->slots = take(&at, r->n_slot_reals);
  k->d_slots = take(&at, r->n_slot_reals);
  k->state = take(&at, r->n_state_reals);
  k->adjoint = take(&at, r->n_state_reals);
  k->scratch = take(&at, r->n_scratch_reals);
  k->records = take(&at, n_records * r->n_record_reals);
  return true;
}

static void destroy(struct machine *k)
{
  free(k->memory);
  free(k->arrays);
}

/* Between (n_masses, 3) and (3, sites). */
static void put(const struct machine *k, const double *from, double center, REAL *to)
{
  for (uint32_t m = 0; m < k->robot.n_masses; m++)
    for (uint32_t axis = 0; axis < 3; axis++)
      to[axis * k->robot.n_sites + k->robot.mass_site[m]] =
          (REAL)(from[3 * m + axis] - (axis < 2 ? center : 0));
}

static void get(const struct machine *k, const REAL *from, double center, double *to)
{
  for (uint32_t m = 0; m < k->robot.n_masses; m++)
    for (uint32_t axis = 0; axis < 3; axis++)
      to[3 * m + axis] =
          from[axis * k->robot.n_sites + k->robot.mass_site[m]] + (axis < 2 ? center : 0);
}

static bool step(const struct physics_scene *scene, struct physics_step *s)
{
  struct machine k;
  if (!create(&k, scene, 1))
    return false;
  struct phys_robot *r = &k.robot;
  struct mo_outcome outcome;
  REAL *velocity = k.state + 3 * (size_t)r->n_sites;
  phys_start(r, k.state, &outcome);
  phys_fetch(r);
  put(&k, s->position_m, MO_WORLD_CENTER_M, k.state);
  put(&k, s->velocity_m_per_s, 0, velocity);
  for (uint32_t i = 0; i < r->n_springs; i++)
    k.slots[i] = (REAL)s->activation[r->slot_spring[i]];
  phys_keep(r, k.state, k.records);
  phys_sense(r, k.records, k.sensors);
  s->sane = phys_step(r, k.records, k.slots, k.state, k.scratch);
  for (uint32_t i = 0; i < r->n_masses; i++)
    s->sensors[r->sensor_mass[i]] = k.sensors[i];
  for (uint32_t i = r->n_masses; i < r->n_sensor_reals; i++)
    s->sane &= k.sensors[i] == 0; /* as documented */
  get(&k, k.state, MO_WORLD_CENTER_M, s->next_m);
  get(&k, velocity, 0, s->next_m_per_s);
  s->hits = 0;
  for (uint32_t v = 0; v < r->n_vectors; v++)
    s->hits += (uint32_t)__builtin_popcount(record_hits(r, k.records)[v]);

  phys_back_start(r, outcome.com_end_m, 1.0, k.adjoint); /* 0 if there is no mass */
  put(&k, s->d_position, 0, k.adjoint);
  put(&k, s->d_velocity, 0, k.adjoint + 3 * (size_t)r->n_sites);
  phys_step_back(r, k.records, k.slots, k.adjoint, k.d_slots, k.scratch);
  for (uint32_t i = 0; i < r->n_springs; i++)
    s->d_activation[r->slot_spring[i]] = k.d_slots[i];
  for (uint32_t i = r->n_springs; i < r->n_slot_reals; i++)
    s->sane &= k.d_slots[i] == 0;
  for (uint32_t i = 0; i < r->n_sensor_reals; i++)
    k.sensors[i] = i < r->n_masses ? (REAL)s->d_sensors[r->sensor_mass[i]] : (REAL)NAN;
  phys_sense_back(r, k.records, k.sensors, k.adjoint);
  get(&k, k.adjoint, 0, s->d_position);
  get(&k, k.adjoint + 3 * (size_t)r->n_sites, 0, s->d_velocity);
  /* Sites without a mass must stay unchanged. */
  for (uint32_t i = 0; i < 3 * r->n_sites; i++)
    if ((r->present[i % r->n_sites / MO_VL].mask >> i % MO_VL & 1) == 0)
      s->sane &= k.adjoint[i] == 0 && k.adjoint[i + 3 * r->n_sites] == 0 && velocity[i] == 0 &&
                 k.state[i] == r->start[i];
  destroy(&k);
  return true;
}

static bool clip(const struct physics_scene *scene, double bound, double *d_position,
                 double *d_velocity, double *m, bool *clipped, bool *finite)
{
  struct machine k;
  if (!create(&k, scene, 1))
    return false;
  memset(k.adjoint, 0, k.robot.n_state_reals * sizeof(REAL));
  put(&k, d_position, 0, k.adjoint);
  put(&k, d_velocity, 0, k.adjoint + 3 * (size_t)k.robot.n_sites);
  const struct mo_gradient_options options = {.adjoint_bound = bound};
  *finite = phys_limit(&k.robot, &options, k.records, k.adjoint, m, clipped);
  get(&k, k.adjoint, 0, d_position);
  get(&k, k.adjoint + 3 * (size_t)k.robot.n_sites, 0, d_velocity);
  destroy(&k);
  return true;
}

static bool start(const struct physics_scene *scene, struct mo_outcome *outcome, double *position_m,
                  double *d_position)
{
  struct machine k;
  if (!create(&k, scene, 1))
    return false;
  phys_start(&k.robot, k.state, outcome);
  get(&k, k.state, MO_WORLD_CENTER_M, position_m);
  phys_finish(&k.robot, k.state, outcome);
  phys_back_start(&k.robot, outcome->com_end_m, 1.0, k.adjoint);
  get(&k, k.adjoint, 0, d_position);
  destroy(&k);
  return true;
}

const struct physics_functions MO_JOIN(physics_, MO_FAST_ISA, ) = {step, clip, start};
