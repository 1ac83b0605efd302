/* gradient-physics.c: the float32 physics of the fast gradient, function by function, against the float64 reference.
 *
 * The two may disagree about a comparison whose sides differ by less than float32 resolves: whether a mass strikes, in which
 * cell, which friction applies, whether an impact comes at once. Float64 alone decides whether a mass is at such a kink: the reference's
 * own contact, from a state that is off by no more than NEAR_M and NEAR_M_PER_S, must come to what float32 came to, both ways. There must be few
 * such masses; all others, and all that hangs on their branch, must agree without exception. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include <morpho/random.h>

#include "../check.h"
#include "bodies.h"
#include "gradient-cases.h"
#include "gradient-physics.h"
#include "rollout/adjoint.h"
#include "rollout/contact.h"
#include "rollout/scene.h"

static const struct physics_functions *const functions[MO_ISA_COUNT] = {&physics_baseline, &physics_avx2,
                                                                        &physics_avx512};

/* Some digits of float32 at the edge of the map, and what the springs' rounding makes of velocities. */
#define NEAR_M           5e-7
#define NEAR_M_PER_S     1e-4
#define NEAR_TRIES       4000
#define POSITION_M       2e-6 /* tolerances of a step: of positions and velocities; of adjoints, by the robot's largest */
#define VELOCITY_M_PER_S 5e-5
#define D_VELOCITY       2e-4
#define D_POSITION       2e-4

/* ---- one step ---- */

/* Reference and fast path side by side. All arrays are (n_masses, 3) but the last three. */
struct both {
  const struct gradient_case *c;
  struct physics_scene scene;
  struct mo_reference reference;
  struct mo_step_tape tape;
  struct mo_adjoint adjoint;
  double *position, *velocity, *d_position, *d_velocity;
  struct physics_step fast;
  double *d_sensors, *fast_sensors, *fast_d_activation;
  bool *at_kink; /* (n_masses) */
  double *shift_m,
      *shift_m_per_s; /* where the reference's contact takes the branch that float32 took; 0 but at kinks */
  double *memory;
};

static void both_free(struct both *b)
{
  mo_reference_done(&b->reference);
  free(b->memory);
  free(b->at_kink);
}

static bool both_create(const struct gradient_case *c, struct both *b)
{
  const size_t n = 3 * (size_t)c->body->n_masses, springs = c->body->n_springs;
  *b = (struct both){.c = c};
  b->scene = (struct physics_scene){c->body, &c->environment, &c->physics, c->controller->sensor};
  if (mo_reference_init(&b->reference, c->body, c->controller, &c->environment, &c->physics) < 0)
    return false;
  const size_t tape = mo_controller_tape_doubles(c->controller, c->body->n_springs);
  b->memory = calloc(19 * n + tape + 3 * springs + c->controller->n_inputs, sizeof(double));
  b->at_kink = calloc(c->body->n_masses, sizeof(bool));
  if (b->memory == NULL || b->at_kink == NULL) {
    both_free(b);
    return false;
  }
  double *at = b->memory;
  double **vectors[] = {&b->position,          &b->velocity,           &b->d_position,
                        &b->d_velocity,        &b->adjoint.d_position, &b->adjoint.d_velocity,
                        &b->adjoint.d_impulse, &b->tape.position_m,    &b->tape.velocity_m_per_s,
                        &b->fast.next_m,       &b->fast.next_m_per_s,  &b->fast.d_position,
                        &b->fast.d_velocity,   &b->d_sensors,          &b->fast_sensors,
                        &b->shift_m,           &b->shift_m_per_s};
  for (size_t i = 0; i < sizeof(vectors) / sizeof(vectors[0]); i++, at += n)
    *vectors[i] = at;
  b->adjoint.d_activation = at;
  b->fast_d_activation = at + springs;
  b->adjoint.d_input = at + 2 * springs;
  b->tape.control =
      mo_controller_tape_place(c->controller, c->body->n_springs, at + 2 * springs + c->controller->n_inputs);
  b->reference.tape = &b->tape;
  return true;
}

/* What float32 can hold. */
static double rounded(double x)
{
  return (double)(float)x;
}

/* A state near the ground anywhere on the map and beyond it, in which some masses strike. */
static void make_state(struct both *b, struct mo_random *random)
{
  const struct gradient_case *c = b->c;
  const uint32_t n = c->body->n_masses;
  const bool far = mo_random_below(random, 3) == 0;
  const double shift[2] = {(far ? 6 : 0.5) * (mo_random_uniform(random) - 0.5),
                           (far ? 6 : 0.5) * (mo_random_uniform(random) - 0.5)};
  const double speed = mo_random_below(random, 2) == 0 ? 0.1 : 1.0,
               noise = mo_random_below(random, 2) == 0 ? 0.002 : 0.02;
  double lowest = INFINITY;
  mo_scene_start(c->body, &c->environment, &c->physics, b->position);
  for (uint32_t m = 0; m < n; m++) {
    double *p = b->position + 3 * m;
    for (int axis = 0; axis < 3; axis++)
      p[axis] += noise * (mo_random_uniform(random) - 0.5) + (axis < 2 ? shift[axis] : 0);
    lowest = fmin(lowest, p[2] - mo_terrain_height(c->environment.terrain_heights_m, p[0], p[1]));
  }
  const double sink = lowest + 0.03 * mo_random_uniform(random) - 0.003;
  for (uint32_t m = 0; m < n; m++)
    for (int axis = 0; axis < 3; axis++) {
      const uint32_t i = 3 * m + (uint32_t)axis;
      const double centre = axis < 2 ? MO_WORLD_CENTRE_M : 0;
      b->position[i] = rounded(b->position[i] - (axis == 2 ? sink : centre)) + centre;
      b->velocity[i] = rounded(speed * mo_random_normal(random));
      b->d_position[i] = rounded(mo_random_normal(random));
      b->d_velocity[i] = rounded(0.1 * mo_random_normal(random));
    }
}

/* The reference's contact of a mass again, from its shifted state. */
static void shift(struct both *b, uint32_t m)
{
  struct mo_reference *r = &b->reference;
  const size_t at = 3 * (size_t)m;
  for (size_t i = at; i < at + 3; i++) {
    b->tape.position_m[i] += b->shift_m[i];
    b->tape.velocity_m_per_s[i] += b->shift_m_per_s[i];
    r->position_m[i] = b->tape.position_m[i];
    r->velocity_m_per_s[i] = b->tape.velocity_m_per_s[i];
  }
  mo_contact_move(r->physics, r->environment->terrain_heights_m, r->highest_m, r->position_m + at,
                  r->velocity_m_per_s + at);
}

/* Moves masses by as little as springs bear to where float32 hardly tells sides apart, or where contact is rare: one in four each on the
 * edge of a cell and on the ground; where it will end on the ground; sliding fast; falling
 * beside an edge, which the slope pushes it over. */
static void go_to_kinks(struct both *b, struct mo_random *random, uint32_t step)
{
  const struct gradient_case *c = b->c;
  const double *heights_m = c->environment.terrain_heights_m, dt = c->physics.dt_s, bear_m = 0.04;
  const double cell_m = MO_TERRAIN_SIZE_M / (MO_TERRAIN_SIDE - 1);
  const uint32_t n = c->body->n_masses;
  for (uint32_t m = 0; m < n; m++) {
    double *p = b->position + 3 * (size_t)m, *v = b->velocity + 3 * (size_t)m;
    const uint32_t axis = mo_random_below(random, 2);
    const double edge = cell_m * round(p[axis] / cell_m), beside = m % 4 == 3 ? 0.001 * mo_random_normal(random) : 0;
    if ((m % 4 == 0 || m % 4 == 3) && fabs(edge - p[axis]) < bear_m)
      p[axis] = rounded(edge + beside - MO_WORLD_CENTRE_M) + MO_WORLD_CENTRE_M;
    const double ground = mo_terrain_height(heights_m, p[0], p[1]);
    if (m % 4 != 1 && fabs(ground - p[2]) < bear_m)
      p[2] = rounded(ground);
    for (int i = 0; i < 2 && m % 4 >= 2; i++)
      v[i] = m % 4 == 2 ? rounded(4 * mo_random_normal(random)) : 0;
    if (m % 4 == 3)
      v[2] = rounded(-8 * mo_random_uniform(random));
  }
  /* Where the springs take them: their velocity before contact is on the tape. Moving them changes it a little. */
  for (int round = 0; round < 4; round++) {
    memcpy(b->reference.position_m, b->position, 3 * n * sizeof(double));
    memcpy(b->reference.velocity_m_per_s, b->velocity, 3 * n * sizeof(double));
    if (!mo_reference_step(&b->reference, step))
      return;
    for (uint32_t m = 1; m < n; m += 4) {
      double *p = b->position + 3 * (size_t)m;
      const double *v = b->tape.velocity_m_per_s + 3 * (size_t)m;
      const double lift = mo_terrain_height(heights_m, p[0] + dt * v[0], p[1] + dt * v[1]) - (p[2] + dt * v[2]);
      if (fabs(lift) < 0.004)
        p[2] = rounded(p[2] + lift);
    }
  }
}

static bool run_both(struct both *b, const struct physics_functions *f, uint32_t step)
{
  const struct gradient_case *c = b->c;
  const size_t bytes = 3 * (size_t)c->body->n_masses * sizeof(double);
  struct mo_reference *r = &b->reference;
  memcpy(r->position_m, b->position, bytes);
  memcpy(r->velocity_m_per_s, b->velocity, bytes);
  if (!mo_reference_step(r, step))
    return false;
  for (uint32_t m = 0; m < c->body->n_masses; m++)
    if (b->at_kink[m])
      shift(b, m);
  memcpy(b->adjoint.d_position, b->d_position, bytes);
  memcpy(b->adjoint.d_velocity, b->d_velocity, bytes);
  memcpy(b->fast.d_position, b->d_position, bytes);
  memcpy(b->fast.d_velocity, b->d_velocity, bytes);
  mo_adjoint_step(r, &b->tape, &b->adjoint);
  for (uint32_t m = 0; m < c->body->n_masses; m++)
    b->d_sensors[m] = b->adjoint.d_input[c->body->mass_lattice[m]];
  b->fast.position_m = b->position;
  b->fast.velocity_m_per_s = b->velocity;
  b->fast.activation = b->tape.control.output;
  b->fast.sensors = b->fast_sensors;
  b->fast.d_sensors = b->d_sensors;
  b->fast.d_activation = b->fast_d_activation;
  return f->step(&b->scene, &b->fast);
}

/* Largest magnitude. */
static double size_of(const double *x, size_t n)
{
  double most = 0;
  for (size_t i = 0; i < n; i++)
    most = fmax(most, fabs(x[i]));
  return most;
}

struct tally {
  uint32_t steps, masses, hits, kinks, faults;
  double sensor, velocity, position, d_velocity, d_position, d_activation; /* largest errors */
};

static double distance(const double *a, const double *b)
{
  return fmax(fmax(fabs(a[0] - b[0]), fabs(a[1] - b[1])), fabs(a[2] - b[2]));
}

/* Where the reference's contact of mass m, a little off, comes to what the fast path made of it: state, ∂loss/∂ velocity and, with `rest`,
 * ∂loss/∂ position, of which `rest` is missing. Sets the shift; false: nowhere near. */
static bool find_kink(struct both *b, uint32_t m, const double *rest, double d_velocity, double d_position,
                      struct mo_random *random)
{
  const struct mo_reference *r = &b->reference;
  const double *heights_m = r->environment->terrain_heights_m;
  const double keep = exp(-r->physics->drag_per_s * r->physics->dt_s);
  const size_t at = 3 * (size_t)m;
  double here[3];
  for (int n = -1; n < NEAR_TRIES; n++) { /* the first time at the state itself */
    double p[3], v[3], next[3], speed[3], dp[3], dv[3], wanted[3];
    for (size_t i = 0; i < 3; i++) {
      p[i] = next[i] = b->tape.position_m[at + i] + (n < 0 ? 0 : NEAR_M * (2 * mo_random_uniform(random) - 1));
      v[i] = speed[i] =
          b->tape.velocity_m_per_s[at + i] + (n < 0 ? 0 : NEAR_M_PER_S * (2 * mo_random_uniform(random) - 1));
      dp[i] = b->d_position[at + i];
      dv[i] = b->d_velocity[at + i];
    }
    mo_contact_move(r->physics, heights_m, r->highest_m, next, speed);
    mo_contact_move_adjoint(r->physics, heights_m, r->highest_m, p, v, dp, dv);
    for (size_t i = 0; i < 3; i++) {
      dv[i] *= keep;
      if (n < 0)
        here[i] = dp[i];
      wanted[i] = rest != NULL ? here[i] + rest[i] : dp[i];
    }
    if (distance(next, b->fast.next_m + at) < POSITION_M &&
        distance(speed, b->fast.next_m_per_s + at) < VELOCITY_M_PER_S &&
        distance(dv, b->fast.d_velocity + at) < D_VELOCITY * d_velocity &&
        distance(dp, wanted) < D_POSITION * d_position) {
      for (size_t i = 0; i < 3; i++) {
        b->shift_m[at + i] += p[i] - b->tape.position_m[at + i];
        b->shift_m_per_s[at + i] += v[i] - b->tape.velocity_m_per_s[at + i];
      }
      return true;
    }
  }
  return false;
}

/* What is off in the robot's largest adjoints, after the fast path has run with the reference's branches. */
struct scales {
  double d_velocity, d_position, d_activation;
};

static struct scales scales_of(const struct both *b)
{
  const size_t n = 3 * (size_t)b->c->body->n_masses;
  return (struct scales){size_of(b->adjoint.d_velocity, n), size_of(b->adjoint.d_position, n),
                         size_of(b->adjoint.d_activation, b->c->body->n_springs)};
}

static bool agrees(const struct both *b, uint32_t m, const struct scales *size, bool with_positions)
{
  const size_t at = 3 * (size_t)m;
  return distance(b->fast.next_m + at, b->reference.position_m + at) < POSITION_M &&
         distance(b->fast.next_m_per_s + at, b->reference.velocity_m_per_s + at) < VELOCITY_M_PER_S &&
         distance(b->fast.d_velocity + at, b->adjoint.d_velocity + at) < D_VELOCITY * size->d_velocity &&
         (!with_positions ||
          distance(b->fast.d_position + at, b->adjoint.d_position + at) < D_POSITION * size->d_position);
}

/* Runs both; then again with the reference on the other side of the kinks that masses are at. First those that velocities tell of: springs
 * carry their adjoints on to the positions of others. Then those that positions alone tell of: impacts at time 0, or just after it. */
static bool run_to_agreement(struct both *b, const struct physics_functions *f, uint32_t step, struct mo_random *random)
{
  const uint32_t n = b->c->body->n_masses;
  memset(b->at_kink, 0, n * sizeof(bool));
  memset(b->shift_m, 0, 3 * n * sizeof(double));
  memset(b->shift_m_per_s, 0, 3 * n * sizeof(double));
  if (!run_both(b, f, step))
    return false;
  for (int pass = 0; pass < 2; pass++) {
    const struct scales size = scales_of(b);
    bool again = false;
    for (uint32_t m = 0; m < n; m++) {
      const size_t at = 3 * (size_t)m;
      double rest[3];
      for (size_t i = 0; i < 3; i++)
        rest[i] = b->fast.d_position[at + i] - b->adjoint.d_position[at + i];
      if (!agrees(b, m, &size, pass > 0) &&
          find_kink(b, m, pass > 0 ? rest : NULL, size.d_velocity, size.d_position, random))
        again = b->at_kink[m] = true;
    }
    if (again && !run_both(b, f, step))
      return false;
  }
  return true;
}

static void compare(struct both *b, const char *where, struct tally *t)
{
  const struct mo_body *body = b->c->body;
  const struct mo_reference *r = &b->reference;
  const struct scales size = scales_of(b);
  t->steps++;
  t->masses += body->n_masses;
  t->hits += b->fast.hits;
  CHECK(b->fast.sane);
  for (uint32_t m = 0; m < body->n_masses; m++) {
    const size_t at = 3 * (size_t)m;
    const double sensor = b->tape.control.input[body->mass_lattice[m]];
    const double moved = distance(b->fast.next_m + at, r->position_m + at);
    const double turned = distance(b->fast.next_m_per_s + at, r->velocity_m_per_s + at);
    const double pulled = distance(b->fast.d_velocity + at, b->adjoint.d_velocity + at) / size.d_velocity;
    const double pushed = distance(b->fast.d_position + at, b->adjoint.d_position + at) / size.d_position;
    t->kinks += b->at_kink[m];
    t->sensor = fmax(t->sensor, fabs(b->fast_sensors[m] - sensor) / fmax(1, fabs(sensor)));
    t->position = fmax(t->position, moved);
    t->velocity = fmax(t->velocity, turned);
    t->d_velocity = fmax(t->d_velocity, pulled);
    t->d_position = fmax(t->d_position, pushed);
    if (!agrees(b, m, &size, true) && t->faults++ < 10)
      printf("# %s, mass %u: off by %.1e m, %.1e m/s; adjoints %.1e, %.1e%s\n", where, m, moved, turned, pulled, pushed,
             b->at_kink[m] ? ", at a kink" : "");
  }
  for (uint32_t s = 0; s < body->n_springs; s++)
    t->d_activation =
        fmax(t->d_activation, fabs(b->fast_d_activation[s] - b->adjoint.d_activation[s]) / size.d_activation);
}

static void one_step(void)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct tally t = {0};
    for (uint32_t k = 0; k < GRADIENT_CASES; k++) {
      struct gradient_case c;
      struct both b;
      struct mo_random random, near;
      REQUIRE(gradient_case_create(k, &c) == 0);
      mo_random_init(&random, 5, MO_PURPOSE_CHECK, 1, k);
      REQUIRE(both_create(&c, &b));
      mo_random_init(&near, 5, MO_PURPOSE_CHECK, 2, k);
      for (uint32_t i = 0; i < 40; i++) {
        make_state(&b, &random);
        if (i % 2 == 1)
          go_to_kinks(&b, &random, i);
        if (!run_to_agreement(&b, functions[isa], i, &near)) {
          printf("# case %u, state %u: the reference diverged\n", k, i);
          continue;
        }
        char where[64];
        snprintf(where, sizeof(where), "%s, case %u, state %u", mo_isa_name((enum mo_isa)isa), k, i);
        compare(&b, where, &t);
      }
      both_free(&b);
      gradient_case_free(&c);
    }
    printf("# %s: %u steps, %u masses, %u of them struck, %u of those at a kink\n", mo_isa_name((enum mo_isa)isa),
           t.steps, t.masses, t.hits, t.kinks);
    printf("#   largest errors: sensors %.1e, velocities %.1e m/s, positions %.1e m\n", t.sensor, t.velocity,
           t.position);
    printf("#   adjoints, of the robot's largest: velocities %.1e, positions %.1e, activations %.1e\n", t.d_velocity,
           t.d_position, t.d_activation);
    CHECK(t.hits > t.masses / 50);
    CHECK_INT(t.faults, 0);
    CHECK(t.kinks > t.hits / 100 && t.kinks < t.hits / 8);
    CHECK(t.sensor < 1e-5);
    CHECK(t.velocity < VELOCITY_M_PER_S);
    CHECK(t.position < POSITION_M);
    CHECK(t.d_velocity < D_VELOCITY);
    CHECK(t.d_position < D_POSITION);
    CHECK(t.d_activation < 1e-4);
  }
}

/* ---- many bodies ---- */

/* A step and the sensors of one body without actuation. Returns the number of masses that took another branch, or −1. */
static int passive_step(const struct mo_body *body, const struct mo_environment *environment, uint64_t seed,
                        const struct physics_functions *f)
{
  const struct mo_physics physics = mo_default_physics();
  const struct physics_scene scene = {body, environment, &physics, MO_SENSOR_INVERSE_SQRT};
  const size_t n = 3 * (size_t)body->n_masses;
  struct mo_reference reference;
  struct mo_random random;
  int astray = 0;
  double *memory = calloc(8 * n + 2 * (size_t)body->n_springs, sizeof(double));
  if (memory == NULL || mo_reference_init(&reference, body, NULL, environment, &physics) < 0) {
    free(memory);
    return -1;
  }
  struct physics_step step = {.position_m = memory,
                              .velocity_m_per_s = memory + n,
                              .activation = memory + 8 * n,
                              .sensors = memory + 2 * n,
                              .next_m = memory + 3 * n,
                              .next_m_per_s = memory + 4 * n,
                              .d_position = memory + 5 * n,
                              .d_velocity = memory + 6 * n,
                              .d_sensors = memory + 7 * n,
                              .d_activation = memory + 8 * n + body->n_springs};
  mo_random_init(&random, seed, MO_PURPOSE_CHECK, 2, 0);
  for (size_t i = 0; i < n; i++) {
    const double centre = i % 3 < 2 ? MO_WORLD_CENTRE_M : 0;
    reference.position_m[i] =
        rounded(reference.position_m[i] - centre + 0.002 * (mo_random_uniform(&random) - 0.5)) + centre;
    reference.velocity_m_per_s[i] = rounded(0.1 * mo_random_normal(&random));
    memory[i] = reference.position_m[i];
    memory[n + i] = reference.velocity_m_per_s[i];
    step.d_position[i] = 0;
    step.d_velocity[i] = i % 3 == 0 ? 1 : 0;
  }
  double mean = 0, light_m[3];
  mo_scene_light(environment, light_m);
  for (uint32_t pass = 0; pass < 2; pass++)
    for (uint32_t m = 0; m < body->n_masses; m++) {
      const double *p = memory + 3 * (size_t)m;
      const double d = hypot(hypot(p[0] - light_m[0], p[1] - light_m[1]), p[2] - light_m[2]);
      const double light = 1 / (sqrt(d + 1e-8) + 1e-8);
      if (pass == 0)
        mean += light / body->n_masses;
      else
        reference.impulse_n_s[m] = light - mean;
    }
  bool good = f->step(&scene, &step) && step.sane;
  for (uint32_t m = 0; m < body->n_masses; m++)
    good &= fabs(step.sensors[m] - reference.impulse_n_s[m]) < 1e-5;
  good &= mo_reference_step(&reference, 0);
  for (uint32_t m = 0; m < body->n_masses; m++) {
    const size_t at = 3 * (size_t)m;
    astray += !(distance(step.next_m + at, reference.position_m + at) < 2e-6 &&
                distance(step.next_m_per_s + at, reference.velocity_m_per_s + at) < 2e-4);
  }
  for (uint32_t s = 0; s < body->n_springs; s++)
    good &= isfinite(step.d_activation[s]);
  mo_reference_done(&reference);
  free(memory);
  return good ? astray : -1;
}

static void many_bodies(void)
{
  static const struct mo_workspace workspaces[] = {{6, 6, 4}, {6, 6, 4}, {1, 5, 2}, {9, 2, 3}, {2, 7, 5}};
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    int astray = 0, masses = 0;
    for (size_t w = 0; w < sizeof(workspaces) / sizeof(workspaces[0]); w++) {
      struct mo_lattice *lattice = NULL;
      struct mo_random random;
      REQUIRE(mo_lattice_create(workspaces[w], &lattice) == 0);
      mo_random_init(&random, 8, MO_PURPOSE_CHECK, 1, w);
      for (uint32_t k = 0; k < 150; k++) {
        uint64_t bits[4] = {0};
        struct mo_body *body = NULL;
        struct mo_environment environment;
        REQUIRE(mo_genotype_random(workspaces[w], &random, bits) == 0);
        REQUIRE(mo_body_create(lattice, bits, &body) == 0);
        mo_environment_training(8, 0, k, &environment);
        const int result = passive_step(body, &environment, k, functions[isa]);
        CHECK(result >= 0);
        astray += result;
        masses += (int)body->n_masses;
        mo_body_free(body);
      }
      mo_lattice_free(lattice);
    }
    /* More springs than the layout is chosen for. */
    struct mo_lattice *lattice = NULL;
    struct mo_body *body = full_body((struct mo_workspace){14, 14, 12}, &lattice);
    struct mo_environment environment;
    REQUIRE(body != NULL);
    mo_environment_training(8, 0, 0, &environment);
    const int result = passive_step(body, &environment, 1, functions[isa]);
    CHECK(result >= 0);
    astray += result;
    printf("# %s: %d of %d masses at a kink, and of a body of %u springs\n", mo_isa_name((enum mo_isa)isa), astray,
           masses, body->n_springs);
    CHECK(body->n_springs > 20000);
    CHECK(astray <= masses / 1000);
    mo_body_free(body);
    mo_lattice_free(lattice);
  }
}

/* ---- start and clip ---- */

static void start_and_clip(void)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (uint32_t k = 0; k < GRADIENT_CASES; k++) {
      struct gradient_case c;
      struct both b;
      struct mo_random random;
      REQUIRE(gradient_case_create(k, &c) == 0);
      REQUIRE(both_create(&c, &b));
      const uint32_t n = c.body->n_masses;
      struct mo_outcome outcome;
      REQUIRE(functions[isa]->start(&b.scene, &outcome, b.fast.next_m, b.fast.d_position));
      mo_adjoint_start(&b.reference, &outcome, &b.adjoint);
      double com[3];
      mo_scene_com(b.reference.position_m, n, com);
      const double size = size_of(b.adjoint.d_position, 3 * n);
      CHECK_NEAR(outcome.loss, 1, 1e-5);
      for (uint32_t i = 0; i < 3 * n; i++) {
        CHECK_NEAR(b.fast.next_m[i], b.reference.position_m[i], 3e-7);
        CHECK_NEAR(b.fast.d_position[i], b.adjoint.d_position[i], 1e-6 * size);
      }
      for (int axis = 0; axis < 3; axis++)
        CHECK(outcome.com_start_m[axis] == com[axis]);

      const double scale_m = hypot(com[0] - c.environment.light_xy_m[0], com[1] - c.environment.light_xy_m[1]) + 1e-8;
      mo_random_init(&random, 6, MO_PURPOSE_CHECK, 1, k);
      for (uint32_t round = 0; round < 8; round++) {
        static const double sizes[] = {1e-3, 1, 1e3, 1e25, 1e-25};
        const double bound = round == 0 ? 0 : 2;
        double x = 0, v = 0, m;
        bool clipped, finite;
        for (uint32_t i = 0; i < 3 * n; i++) {
          b.fast.d_position[i] = b.d_position[i] = rounded(sizes[round % 5] * mo_random_normal(&random));
          b.fast.d_velocity[i] = b.d_velocity[i] = rounded(sizes[round * 2 % 5] * mo_random_normal(&random));
          x += b.d_position[i] * b.d_position[i];
          v += b.d_velocity[i] * b.d_velocity[i];
        }
        const double expected = scale_m * fmax(sqrt(x), MO_ADJOINT_RATE_PER_S * sqrt(v));
        REQUIRE(functions[isa]->clip(&b.scene, bound, b.fast.d_position, b.fast.d_velocity, &m, &clipped, &finite));
        CHECK(finite);
        CHECK_NEAR(m, expected, 1e-5 * expected);
        CHECK(clipped == (bound > 0 && expected > bound));
        const double factor = clipped ? bound / expected : 1;
        for (uint32_t i = 0; i < 3 * n; i++) {
          CHECK_NEAR(b.fast.d_position[i], factor * b.d_position[i], 1e-5 * fabs(factor * b.d_position[i]) + 1e-37);
          CHECK_NEAR(b.fast.d_velocity[i], factor * b.d_velocity[i], 1e-5 * fabs(factor * b.d_velocity[i]) + 1e-37);
        }
        b.fast.d_velocity[round % n] = round % 2 == 0 ? (double)NAN : (double)INFINITY;
        REQUIRE(functions[isa]->clip(&b.scene, bound, b.fast.d_position, b.fast.d_velocity, &m, &clipped, &finite));
        CHECK(!finite);
      }
      both_free(&b);
      gradient_case_free(&c);
    }
}

/* ---- divergence ---- */

static void divergence(void)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct gradient_case c;
    struct both b;
    REQUIRE(gradient_case_create(4, &c) == 0);
    REQUIRE(both_create(&c, &b));
    const struct {
      double value, up_m;
      bool position, sane;
    } cases[] = {{900, 10, false, true},
                 {1200, 10, false, false},
                 {(double)NAN, 10, false, false},
                 {900, 0, false, true},
                 {(double)INFINITY, 0, false, false},
                 {(double)NAN, 0, true, false},
                 {(double)INFINITY, 0, true, false}};
    for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++)
      for (uint32_t m = 0; m < c.body->n_masses; m += 7)
        for (int axis = 0; axis < 3; axis++) {
          mo_scene_start(c.body, &c.environment, &c.physics, b.position);
          for (uint32_t j = 0; j < 3 * c.body->n_masses; j++) {
            b.position[j] += j % 3 == 2 ? cases[i].up_m : 0;
            b.velocity[j] = 0;
          }
          (cases[i].position ? b.position : b.velocity)[3 * m + (uint32_t)axis] = cases[i].value;
          b.fast.position_m = b.position;
          b.fast.velocity_m_per_s = b.velocity;
          b.fast.activation = b.tape.control.output;
          b.fast.sensors = b.fast_sensors;
          b.fast.d_sensors = b.d_sensors;
          b.fast.d_activation = b.fast_d_activation;
          memset(b.fast.d_position, 0, 3 * c.body->n_masses * sizeof(double));
          memset(b.fast.d_velocity, 0, 3 * c.body->n_masses * sizeof(double));
          REQUIRE(functions[isa]->step(&b.scene, &b.fast));
          if (cases[i].sane != b.fast.sane)
            printf("# %s: case %zu, mass %u, axis %d\n", mo_isa_name((enum mo_isa)isa), i, m, axis);
          CHECK(b.fast.sane == cases[i].sane);
        }
    both_free(&b);
    gradient_case_free(&c);
  }
}

/* ---- whole rollouts ---- */

/* Both ways along rollouts whose activations do not depend on the state: the weights of the sensors are 0, so that the reference's
 * gradient has nothing that the physics does not. The adjoints of all velocities, at every 10th step, are one long vector. */
#define KEPT_EVERY 10

struct walk {
  const struct gradient_case *c;
  double *kept; /* (n_steps / KEPT_EVERY, n_masses, 3) */
};

static void keep(void *context, uint32_t step, double *dx, double *dv)
{
  const struct walk *w = context;
  const size_t n = 3 * (size_t)w->c->body->n_masses;
  (void)dx;
  if (step % KEPT_EVERY == 0)
    memcpy(w->kept + (step / KEPT_EVERY - 1) * n, dv, n * sizeof(double));
}

static bool open_loop(const struct gradient_case *c, float *activation)
{
  const struct mo_controller *controller = c->controller;
  double *input = calloc(controller->n_inputs + 2 * MO_HIDDEN + c->body->n_springs, sizeof(double));
  if (input == NULL)
    return false;
  double *output = input + controller->n_inputs + 2 * MO_HIDDEN;
  for (uint32_t o = 0; o < MO_HIDDEN; o++)
    memset(controller->weight[0] + (size_t)o * controller->n_inputs, 0, controller->n_masses * sizeof(float));
  for (uint32_t step = 0; step < c->physics.n_steps; step++) {
    for (int i = 0; i < MO_CPG_INPUTS; i++)
      input[controller->n_masses + (uint32_t)i] =
          sin(MO_CPG_RAD_PER_S * step * c->physics.dt_s + 2.0 * M_PI * i / MO_CPG_INPUTS);
    mo_controller_forward(controller, input, c->body->spring_lattice, c->body->n_springs, output,
                          input + controller->n_inputs);
    for (uint32_t s = 0; s < c->body->n_springs; s++)
      activation[(size_t)step * c->body->n_springs + s] = (float)output[s];
  }
  free(input);
  return true;
}

static int whole_rollout(struct gradient_case *c, double bound, const struct physics_functions *f, double sums[3])
{
  int result = -1;
  const size_t kept = c->physics.n_steps / KEPT_EVERY * 3 * (size_t)c->body->n_masses;
  float *activation = malloc((size_t)c->physics.n_steps * c->body->n_springs * sizeof(float));
  double *memory = calloc(2 * kept + c->controller->n_parameters, sizeof(double));
  if (activation == NULL || memory == NULL || !open_loop(c, activation))
    goto done;
  struct walk reference = {c, memory}, fast = {c, memory + kept};
  const struct mo_gradient_options options = {.adjoint_bound = bound, .weight = 1};
  const struct mo_gradient_probe probe = {.before = keep, .context = &reference};
  struct mo_outcome outcome;
  struct mo_gradient_counts counts = {0};
  struct physics_life life = {.activation = activation, .bound = bound, .adjoint = keep, .context = &fast};
  const struct physics_scene scene = {c->body, &c->environment, &c->physics, c->controller->sensor};
  if (mo_gradient_probed(c->body, c->controller, &c->environment, &c->physics, &options, &probe, &outcome,
                         memory + 2 * kept, &counts) < 0 ||
      !f->live(&scene, &life))
    goto done;
  double dot = 0, a = 0, b = 0;
  for (size_t i = 0; i < kept; i++) {
    dot += reference.kept[i] * fast.kept[i];
    a += reference.kept[i] * reference.kept[i];
    b += fast.kept[i] * fast.kept[i];
  }
  sums[0] += dot;
  sums[1] += a;
  sums[2] += b;
  printf("#   %u masses: cosine %.6f, size %.4f, losses %.6f %.6f, largest %.3g %.3g, clipped %u %u\n",
         c->body->n_masses, dot / sqrt(a * b), sqrt(b / a), outcome.loss, life.outcome.loss, counts.largest,
         life.largest, (unsigned)counts.clipped_steps, life.clipped);
  result = life.finite ? 0 : 1;
done:
  free(activation);
  free(memory);
  return result;
}

/* Most rollouts agree closely; one that came by a kink on the other side does not. */
static void rollouts(uint32_t n_steps, uint32_t least_close, double least_cosine)
{
  const enum mo_isa isa = mo_isa_best();
  double sums[3] = {0, 0, 0};
  uint32_t close = 0;
  for (uint32_t k = 0; k < GRADIENT_CASES; k++) {
    struct gradient_case c;
    double own[3] = {0, 0, 0};
    REQUIRE(gradient_case_create(k, &c) == 0);
    c.physics.n_steps = n_steps;
    CHECK_INT(whole_rollout(&c, MO_ADJOINT_BOUND, functions[isa], own), 0);
    close += own[0] >= 0.9999 * sqrt(own[1] * own[2]);
    for (int i = 0; i < 3; i++)
      sums[i] += own[i];
    gradient_case_free(&c);
  }
  const double cosine = sums[0] / sqrt(sums[1] * sums[2]);
  printf("# %s, %u steps: cosine of all %.6f; %u of %d are above 0.9999\n", mo_isa_name(isa), n_steps, cosine, close,
         GRADIENT_CASES);
  CHECK(close >= least_close);
  CHECK(cosine >= least_cosine);
}

static void rollouts_100(void)
{
  rollouts(100, 20, 0.99999);
}

static void rollouts_1000(void)
{
  rollouts(1000, 17, 0.97);
}

/* ---- times ---- */

static void times(void)
{
  enum { BODIES = 64 };
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  struct mo_lattice *lattice = NULL;
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 100;
  REQUIRE(mo_lattice_create(workspace, &lattice) == 0);
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct mo_body_stream *stream = NULL;
    double sum[5] = {0}, masses = 0, springs = 0, counts[4] = {0};
    REQUIRE(mo_body_stream_create(workspace, 1, &stream) == 0);
    for (int k = 0; k < BODIES; k++) {
      uint64_t bits[MO_DEFAULT_WORDS];
      struct mo_body *body = NULL;
      struct mo_environment environment;
      do { /* small bodies soon run out: a long stream has few */
        REQUIRE(mo_body_stream_next(stream, bits) == 0);
      } while (mo_genotype_count(workspace, bits) < 10);
      REQUIRE(mo_body_create(lattice, bits, &body) == 0);
      mo_environment_training(1, 0, (uint64_t)k, &environment);
      float *activation = malloc((size_t)physics.n_steps * body->n_springs * sizeof(float));
      REQUIRE(activation != NULL);
      for (uint32_t i = 0; i < physics.n_steps; i++)
        for (uint32_t s = 0; s < body->n_springs; s++)
          activation[(size_t)i * body->n_springs + s] = (float)sin(0.04 * i + s);
      const struct physics_scene scene = {body, &environment, &physics, MO_SENSOR_INVERSE_SQRT};
      struct physics_times t;
      uint32_t n[4];
      REQUIRE(functions[isa]->time(&scene, activation, &t, n));
      const double each[5] = {t.sense, t.step, t.clip, t.step_back, t.sense_back};
      for (int i = 0; i < 5; i++)
        sum[i] += each[i] / BODIES;
      for (int i = 0; i < 4; i++)
        counts[i] += (double)n[i] / BODIES;
      masses += (double)body->n_masses / BODIES;
      springs += (double)body->n_springs / BODIES;
      free(activation);
      mo_body_free(body);
    }
    printf("# %s: %.0f masses, %.0f springs in %.1f vectors, %.1f tiles, %.1f arrivals; a record has %.0f bytes\n",
           mo_isa_name((enum mo_isa)isa), masses, springs, counts[0], counts[1], counts[2], 4 * counts[3]);
    printf("#   ticks per step: sense %.0f, step %.0f; clip %.0f, step back %.0f, sense back %.0f\n", sum[0], sum[1],
           sum[2], sum[3], sum[4]);
    mo_body_stream_free(stream);
  }
  mo_lattice_free(lattice);
}

static const struct check_case cases[] = {{"one step and back", one_step},
                                          {"many bodies", many_bodies},
                                          {"the start, its derivative and the bound", start_and_clip},
                                          {"divergence", divergence},
                                          {"rollouts of 100 steps", rollouts_100},
                                          {"rollouts of 1000 steps", rollouts_1000},
                                          {"times", times}};
CHECK_MAIN(cases)
