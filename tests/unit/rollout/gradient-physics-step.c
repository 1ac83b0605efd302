/* gradient-physics-step.c: a step of the fast gradient's float32 physics and its backward pass,
 * compared with the float64 reference.
 *
 * The two may disagree about a comparison whose sides differ by less than float32 resolves: whether
 * a mass strikes, in which cell, which friction applies, whether an impact comes at once. Only
 * float64 decides whether a mass is at such a kink: the reference's own contact, from a state that
 * differs by at most NEAR_M and NEAR_M_PER_S, must agree with float32, forward and backward. There
 * must be few such masses; all others, and everything that depends on their branch, must agree. On
 * fine grids, a few steps are left out in which a mass grazes the ground (GRAZES_M_PER_S). */

#include "gradient-physics-both.h"
#include "rollout/contact.h"
#include "world/terrain.h"

/* A few float32 rounding units at the edge of the map, and the effect of the springs' rounding on
 * velocities. */
#define NEAR_M       5e-7
#define NEAR_M_PER_S 1e-4
#define NEAR_TRIES   20000
#define PASSES       6
/* On bent ground, the rounding of a mass's coordinates changes the speed at which its gap closes:
 * on fine grids, by less than 1.5e-6 m/s for 99 in 100 masses that strike. Adjoints are in
 * proportion to 1 / that speed: where it is less than this, they are off by more than D_VELOCITY of
 * themselves, and from time 0 to just after it they change by more than any search resolves. */
#define GRAZES_M_PER_S 0.005
#define POSITION_M                                                                                 \
  2e-6 /* tolerances of a step: of positions and velocities; of adjoints, by the robot's largest   \
        */
#define VELOCITY_M_PER_S 5e-5
#define D_VELOCITY       2e-4
#define D_POSITION       2e-4

/* Draws a state near the ground anywhere on the map and beyond it, in which some masses strike. */
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
    lowest = fmin(lowest, p[2] - mo_terrain_height(&c->environment, p[0], p[1]));
  }
  const double sink = lowest + 0.03 * mo_random_uniform(random) - 0.003;
  for (uint32_t m = 0; m < n; m++)
    for (int axis = 0; axis < 3; axis++) {
      const uint32_t i = 3 * m + (uint32_t)axis;
      const double center = axis < 2 ? MO_WORLD_CENTER_M : 0;
      b->position[i] = rounded(b->position[i] - (axis == 2 ? sink : center)) + center;
      b->velocity[i] = rounded(speed * mo_random_normal(random));
      b->d_position[i] = rounded(mo_random_normal(random));
      b->d_velocity[i] = rounded(0.1 * mo_random_normal(random));
    }
}

/* Recomputes the reference's contact of a mass from its shifted state. */
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
  mo_contact_move(&r->physics->scheme, &r->physics->constants, r->environment, r->highest_m,
                  r->position_m + at, r->velocity_m_per_s + at);
}

/* Moves masses by no more than springs tolerate to places where float32 can barely distinguish the
 * sides, or where contact is rare. One in four each: on the edge of a cell and on the ground; where
 * it will end on the ground; sliding fast; falling next to an edge, over which the slope pushes
 * it. */
static void go_to_kinks(struct both *b, struct mo_random *random, uint32_t step)
{
  const struct gradient_case *c = b->c;
  const double dt = c->physics.scheme.dt_s, bear_m = 0.04;
  const struct mo_terrain_map map = mo_terrain_map_of(&c->environment);
  const double cell_m = 1 / map.axis[0].cells_per_m;
  const uint32_t n = c->body->n_masses;
  for (uint32_t m = 0; m < n; m++) {
    double *p = b->position + 3 * (size_t)m, *v = b->velocity + 3 * (size_t)m;
    const uint32_t axis = mo_random_below(random, 2);
    const double from = map.axis[axis].from_m,
                 edge = from + cell_m * round((p[axis] - from) / cell_m),
                 beside = m % 4 == 3 ? 0.001 * mo_random_normal(random) : 0;
    if ((m % 4 == 0 || m % 4 == 3) && fabs(edge - p[axis]) < bear_m)
      p[axis] = rounded(edge + beside - MO_WORLD_CENTER_M) + MO_WORLD_CENTER_M;
    const double ground = mo_terrain_height(&c->environment, p[0], p[1]);
    if (m % 4 != 1 && fabs(ground - p[2]) < bear_m)
      p[2] = rounded(ground);
    for (int i = 0; i < 2 && m % 4 >= 2; i++)
      v[i] = m % 4 == 2 ? rounded(4 * mo_random_normal(random)) : 0;
    if (m % 4 == 3)
      v[2] = rounded(-8 * mo_random_uniform(random));
  }
  /* Moves them where the springs take them: their velocity before contact is on the tape, and
   * moving them changes it a little. */
  for (int round = 0; round < 4; round++) {
    memcpy(b->reference.position_m, b->position, 3 * n * sizeof(double));
    memcpy(b->reference.velocity_m_per_s, b->velocity, 3 * n * sizeof(double));
    if (!mo_reference_step(&b->reference, step))
      return;
    for (uint32_t m = 1; m < n; m += 4) {
      double *p = b->position + 3 * (size_t)m;
      const double *v = b->tape.velocity_m_per_s + 3 * (size_t)m;
      const double lift = mo_terrain_height(&c->environment, p[0] + dt * v[0], p[1] + dt * v[1]) -
                          (p[2] + dt * v[2]);
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
  mo_adjoint_step(r, 0, &b->tape, &b->adjoint);
  for (uint32_t m = 0; m < c->body->n_masses; m++)
    b->d_sensors[m] = b->adjoint.d_input[c->body->mass_lattice[m]];
  return f->step(&b->scene, &b->fast);
}

struct tally {
  uint32_t steps, masses, hits, kinks, faults, grazing;
  double sensor, velocity, position, d_velocity, d_position, d_activation; /* largest errors */
};

/* What a mass is compared by. rest: what the springs add to ∂loss/∂ position from contact, and by
 * how much float32 differs; NULL if positions' adjoints do not count. */
struct near {
  const double *rest;
  double here[3];                /* the reference's ∂loss/∂ position from its present state */
  double d_velocity, d_position; /* tolerances */
};

/* How far the reference's contact of mass m from (p, v) is from float32's, of the tolerances. */
static double misfit(const struct both *b, uint32_t m, const struct near *near, const double p[3],
                     const double v[3], double dp[3])
{
  const struct mo_reference *r = &b->reference;
  const struct mo_scheme *scheme = &r->physics->scheme;
  const struct mo_constants *constants = &r->physics->constants;
  const double keep = exp(-constants->drag_per_s * scheme->dt_s);
  const size_t at = 3 * (size_t)m;
  double next[3], speed[3], dv[3], wanted[3];
  memcpy(next, p, sizeof(next));
  memcpy(speed, v, sizeof(speed));
  memcpy(dp, b->d_position + at, 3 * sizeof(double));
  memcpy(dv, b->d_velocity + at, sizeof(dv));
  mo_contact_move(scheme, constants, r->environment, r->highest_m, next, speed);
  mo_contact_move_adjoint(scheme, constants, r->environment, r->highest_m, p, v, dp, dv);
  for (size_t i = 0; i < 3; i++) {
    dv[i] *= keep;
    wanted[i] = near->rest != NULL ? near->here[i] + near->rest[i] : dp[i];
  }
  return fmax(fmax(distance(next, b->fast.next_m + at) / POSITION_M,
                   distance(speed, b->fast.next_m_per_s + at) / VELOCITY_M_PER_S),
              fmax(distance(dv, b->fast.d_velocity + at) / near->d_velocity,
                   distance(dp, wanted) / near->d_position));
}

/* Searches near mass m's state for one at which the reference's contact agrees with the fast path
 * in the state, ∂loss/∂ velocity and, with near->rest, ∂loss/∂ position. Sets the shift; returns
 * false if no state nearby agrees.
 *
 * The first half of the tries goes anywhere nearby, and so to both sides of a kink. The others go
 * ever closer to the best one: just after a kink, adjoints change a lot within what float32
 * resolves, and few places nearby have the right ones. */
static bool find_kink(struct both *b, uint32_t m, struct near *near, struct mo_random *random)
{
  const size_t at = 3 * (size_t)m;
  const double *p0 = b->tape.position_m + at, *v0 = b->tape.velocity_m_per_s + at;
  double best[6], least = INFINITY, dp[3], p[3], v[3];
  for (size_t i = 0; i < 3; i++) {
    best[i] = b->shift_m[at + i];
    best[3 + i] = b->shift_m_per_s[at + i];
  }
  misfit(b, m, &(struct near){.d_velocity = 1, .d_position = 1}, p0, v0, near->here);
  for (int n = -1; n < NEAR_TRIES && least > 0.5; n++) { /* the first time at the state itself */
    const double width = n < NEAR_TRIES / 2 ? 1 : pow(2, 19 - 40.0 * n / NEAR_TRIES);
    double to[6];
    for (size_t i = 0; i < 6; i++) {
      const double most = i < 3 ? NEAR_M : NEAR_M_PER_S,
                   by = n < 0 ? 0 : most * width * (2 * mo_random_uniform(random) - 1);
      to[i] = fmin(fmax((n < 0 || width < 1 ? best[i] : 0) + by, -most), most);
    }
    for (size_t i = 0; i < 3; i++) {
      p[i] = p0[i] - b->shift_m[at + i] + to[i];
      v[i] = v0[i] - b->shift_m_per_s[at + i] + to[3 + i];
    }
    const double here = misfit(b, m, near, p, v, dp);
    if (here < least) {
      least = here;
      memcpy(best, to, sizeof(best));
    }
  }
  if (!(least < 1))
    return false;
  memcpy(b->shift_m + at, best, 3 * sizeof(double));
  memcpy(b->shift_m_per_s + at, best + 3, 3 * sizeof(double));
  return true;
}

/* Returns the error relative to the robot's largest adjoints, after the fast path has run with the
 * reference's branches. */
struct scales {
  double d_velocity, d_position, d_activation;
};

static struct scales scales_of(const struct both *b)
{
  const size_t n = 3 * (size_t)b->c->body->n_masses;
  return (struct scales){size_of(b->adjoint.d_velocity, n), size_of(b->adjoint.d_position, n),
                         size_of(b->adjoint.d_output, b->c->body->n_springs)};
}

static bool agrees(const struct both *b, uint32_t m, const struct scales *size, bool with_positions)
{
  const size_t at = 3 * (size_t)m;
  return distance(b->fast.next_m + at, b->reference.position_m + at) < POSITION_M &&
         distance(b->fast.next_m_per_s + at, b->reference.velocity_m_per_s + at) <
             VELOCITY_M_PER_S &&
         distance(b->fast.d_velocity + at, b->adjoint.d_velocity + at) <
             D_VELOCITY * size->d_velocity &&
         (!with_positions || distance(b->fast.d_position + at, b->adjoint.d_position + at) <
                                 D_POSITION * size->d_position);
}

/* Runs both; then again with the reference on the other side of the kinks at which masses are.
 * First the kinks that show in velocities, because springs carry their adjoints to other masses'
 * positions. Then those that show only in positions: impacts at time 0, or right after it. Often
 * the largest adjoints are those of a mass at a kink, and without it more show. */
static bool run_to_agreement(struct both *b, const struct physics_functions *f, uint32_t step,
                             struct mo_random *random)
{
  const uint32_t n = b->c->body->n_masses;
  memset(b->at_kink, 0, n * sizeof(bool));
  memset(b->shift_m, 0, 3 * n * sizeof(double));
  memset(b->shift_m_per_s, 0, 3 * n * sizeof(double));
  if (!run_both(b, f, step))
    return false;
  bool again = true;
  for (int pass = 0; pass < PASSES && (again || pass < 2); pass++) {
    const struct scales size = scales_of(b);
    again = false;
    for (uint32_t m = 0; m < n; m++) {
      const size_t at = 3 * (size_t)m;
      double rest[3];
      for (size_t i = 0; i < 3; i++)
        rest[i] = b->fast.d_position[at + i] - b->adjoint.d_position[at + i];
      struct near near = {.rest = pass > 0 ? rest : NULL,
                          .d_velocity = D_VELOCITY * size.d_velocity,
                          .d_position = D_POSITION * size.d_position};
      if (!agrees(b, m, &size, pass > 0) && find_kink(b, m, &near, random))
        again = b->at_kink[m] = true;
    }
    if (again && !run_both(b, f, step))
      return false;
  }
  return true;
}

/* Whether mass m grazes the ground within the step. */
static bool grazes(const struct both *b, uint32_t m)
{
  const struct mo_reference *r = &b->reference;
  const double dt = r->physics->scheme.dt_s, *p = b->tape.position_m + 3 * (size_t)m,
               *v = b->tape.velocity_m_per_s + 3 * (size_t)m;
  const double impact = mo_impact_exact(r->environment, p, v, dt);
  double g[2];
  mo_terrain_gradient(r->environment, p[0] + impact * v[0], p[1] + impact * v[1], g);
  return r->physics->scheme.impact == MO_IMPACT_EXACT && impact > 0 && impact < dt &&
         fabs(v[2] - g[0] * v[0] - g[1] * v[1]) < GRAZES_M_PER_S;
}

/* Whether they disagree about a mass that grazes the ground: then its springs do as well. */
static bool grazing_disagrees(const struct both *b)
{
  const struct scales size = scales_of(b);
  for (uint32_t m = 0; m < b->c->body->n_masses; m++)
    if (!agrees(b, m, &size, true) && grazes(b, m))
      return true;
  return false;
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
    const double pulled =
        distance(b->fast.d_velocity + at, b->adjoint.d_velocity + at) / size.d_velocity;
    const double pushed =
        distance(b->fast.d_position + at, b->adjoint.d_position + at) / size.d_position;
    t->kinks += b->at_kink[m];
    t->sensor = fmax(t->sensor, fabs(b->fast_sensors[m] - sensor) / fmax(1, fabs(sensor)));
    t->position = fmax(t->position, moved);
    t->velocity = fmax(t->velocity, turned);
    t->d_velocity = fmax(t->d_velocity, pulled);
    t->d_position = fmax(t->d_position, pushed);
    if (!agrees(b, m, &size, true) && t->faults++ < 10)
      printf("# %s, mass %u: off by %.1e m, %.1e m/s; adjoints %.1e, %.1e%s\n", where, m, moved,
             turned, pulled, pushed, b->at_kink[m] ? ", at a kink" : "");
  }
  for (uint32_t s = 0; s < body->n_springs; s++)
    t->d_activation = fmax(t->d_activation, fabs(b->fast_d_activation[s] - b->adjoint.d_output[s]) /
                                                size.d_activation);
}

enum shape { GRID, PROFILE, FINE_GRID };

static void step_on(enum shape shape)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct tally t = {0};
    for (uint32_t k = 0; k < GRADIENT_CASES; k++) {
      struct gradient_case c = make_gradient_case(k);
      if (shape == PROFILE)
        set_profile(&c.environment, k, c.sigma_m / 4);
      else if (shape == FINE_GRID)
        set_grid(&c.environment, k, c.sigma_m / 5);
      struct mo_random random = dice(5, 1, k), near = dice(5, 2, k);
      struct both *b = make_both(&c);
      for (uint32_t i = 0; i < 40; i++) {
        make_state(b, &random);
        if (i % 2 == 1)
          go_to_kinks(b, &random, i);
        if (!run_to_agreement(b, functions[isa], i, &near)) {
          printf("# case %u, state %u: the reference diverged\n", k, i);
          continue;
        }
        if (grazing_disagrees(b)) {
          t.grazing++;
          continue;
        }
        char where[64];
        snprintf(where, sizeof(where), "%s, case %u, state %u", mo_isa_name((enum mo_isa)isa), k,
                 i);
        compare(b, where, &t);
      }
      check_drop_to(0);
    }
    printf("# %s: %u steps, %u masses, %u of them struck, %u of those at a kink\n",
           mo_isa_name((enum mo_isa)isa), t.steps, t.masses, t.hits, t.kinks);
    printf("#   left out: %u steps in which a mass grazes the ground\n", t.grazing);
    printf("#   largest errors: sensors %.1e, velocities %.1e m/s, positions %.1e m\n", t.sensor,
           t.velocity, t.position);
    printf(
        "#   adjoints, of the robot's largest: velocities %.1e, positions %.1e, activations %.1e\n",
        t.d_velocity, t.d_position, t.d_activation);
    CHECK(t.hits > t.masses / 50);
    CHECK_INT(t.faults, 0);
    CHECK(t.grazing <= (shape == FINE_GRID ? t.steps / 200 : 0));
    CHECK(t.kinks > t.hits / 100 && t.kinks < t.hits / 8);
    CHECK(t.sensor < 1e-5);
    CHECK(t.velocity < VELOCITY_M_PER_S);
    CHECK(t.position < POSITION_M);
    CHECK(t.d_velocity < D_VELOCITY);
    CHECK(t.d_position < D_POSITION);
    CHECK(t.d_activation < 1e-4);
  }
}

static void on_grids(void)
{
  step_on(GRID);
}

static void on_profiles(void)
{
  step_on(PROFILE);
}

static void on_fine_grids(void)
{
  step_on(FINE_GRID);
}

static const struct check_case cases[] = {
    {"one step forward and backward", on_grids},
    {"one step forward and backward on a profile", on_profiles},
    {"one step forward and backward on a fine grid", on_fine_grids},
};
CHECK_MAIN(cases)
