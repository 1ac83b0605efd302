/* reference-physics.c: the reference's mechanics compared with closed forms of the discrete step v
 * ← e v + J/m − g dt,  x ← x + dt v,  e = exp(−drag · dt). */
#include "../make.h"

#include "rollout/reference.h"

static const struct mo_workspace one = {1, 1, 1};

static struct mo_environment flat_environment(double height_m, double light_x_m, double light_y_m)
{
  struct mo_environment environment = {.light_xy_m = {light_x_m, light_y_m}};
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    environment.terrain_heights_m[k] = height_m;
  return environment;
}

struct scene {
  const struct mo_body *body;
  struct mo_environment environment;
  struct mo_physics physics;
  struct mo_reference r;
};

static void drop_reference(void *reference)
{
  mo_reference_done(reference);
}

/* A full workspace high above flat ground, passive or with a controller. Most of the physics can be
 * changed afterward. */
static struct scene *make_scene(struct mo_workspace workspace, struct mo_physics physics,
                                const struct mo_controller *controller)
{
  struct scene *s = make_zeros(1, sizeof(*s));
  s->body = make_full_body(make_lattice(workspace));
  s->environment = flat_environment(0.1, 1, 1);
  s->physics = physics;
  s->physics.drop_height_m = 100;
  make_check(mo_reference_init(&s->r, s->body, controller, &s->environment, &s->physics),
             "reference");
  check_keep(&s->r, drop_reference);
  return s;
}

/* Without drag: z = z0 − g dt² n (n + 1) / 2. */
static void free_fall(void)
{
  struct scene *s = make_scene(MO_DEFAULT_WORKSPACE, mo_paper_physics(), NULL);
  s->physics.constants.drag_per_s = 0;
  CHECK_INT(s->body->n_masses, 245);
  CHECK_INT(s->body->n_springs, 1648);
  double start[245][3];
  memcpy(start, s->r.position_m, sizeof(start));
  CHECK_NEAR(start[0][0], 2.2, 1e-15);
  CHECK_NEAR(start[244][1], 2.8, 1e-15);
  CHECK_NEAR(start[0][2], 100.1, 1e-13);
  CHECK_NEAR(start[244][2], 100.5, 1e-13);
  for (uint32_t n = 0; n < 900; n++)
    REQUIRE(mo_reference_step(&s->r, n));
  const double fallen = 9.8 * 0.004 * 0.004 * 900 * 901 / 2;
  for (int i = 0; i < 245; i++) {
    CHECK_NEAR(s->r.position_m[3 * i], start[i][0], 1e-11);
    CHECK_NEAR(s->r.position_m[3 * i + 2], start[i][2] - fallen, 1e-10);
    CHECK_NEAR(s->r.velocity_m_per_s[3 * i + 2], -9.8 * 0.004 * 900, 1e-10);
  }
}

/* Without gravity: v = eⁿ v0, x = x0 + dt v0 (e − eⁿ⁺¹)/(1 − e). With it, the speed converges to −g
 * dt/(1 − e). */
static void drag_decay(void)
{
  struct scene *s = make_scene(one, mo_paper_physics(), NULL);
  s->physics.constants.gravity_m_per_s2 = 0;
  const double v0[3] = {1, -2, 3}, e = exp(-15 * 0.004);
  double start[24];
  memcpy(start, s->r.position_m, sizeof(start));
  for (int k = 0; k < 24; k++)
    s->r.velocity_m_per_s[k] = v0[k % 3];
  for (uint32_t n = 1; n <= 200; n++) {
    REQUIRE(mo_reference_step(&s->r, n - 1));
    for (int k = 0; k < 24; k++) {
      CHECK_NEAR(s->r.velocity_m_per_s[k], pow(e, n) * v0[k % 3], 1e-11);
      CHECK_NEAR(s->r.position_m[k], start[k] + 0.004 * v0[k % 3] * (e - pow(e, n + 1)) / (1 - e),
                 1e-12);
    }
  }
  s->physics.constants.gravity_m_per_s2 = 9.8;
  for (uint32_t n = 0; n < 800; n++)
    REQUIRE(mo_reference_step(&s->r, n));
  for (int i = 0; i < 8; i++)
    CHECK_NEAR(s->r.velocity_m_per_s[3 * i + 2], -9.8 * 0.004 / (1 - e), 1e-11);
}

/* One voxel that expands and contracts: each corner is displaced by q along all three axes. Edge
 * and two face diagonals add up, along each axis, to −6 k q; with the guard of the step's d/(L +
 * 1e-8) to −w q/dt²,  w = dt² k/m (2 (1 − 1e-8/0.1) + 4 (1 − 1e-8/(0.1 √2))). The step is then q''
 * = (1 + e − w) q' − e q: two complex roots of modulus sqrt(e), so q_n = e^{n/2} q0 (cos nφ + b sin
 * nφ),  cos φ = (1 + e − w)/(2 sqrt(e)), with b from q_1 = (1 − w) q0. */
static void breathing(double drag_per_s, double stiffness_n_per_m)
{
  struct scene *s = make_scene(one, mo_paper_physics(), NULL);
  s->physics.constants.gravity_m_per_s2 = 0;
  s->physics.constants.drag_per_s = drag_per_s;
  s->physics.constants.stiffness_n_per_m = stiffness_n_per_m;
  const double dt = s->physics.scheme.dt_s, e = exp(-drag_per_s * dt), q0 = 1e-3, guard = 1e-8;
  const double w =
      dt * dt * stiffness_n_per_m * (2 * (1 - guard / 0.1) + 4 * (1 - guard / (0.1 * sqrt(2))));
  const double phi = acos((1 + e - w) / (2 * sqrt(e)));
  const double b = ((1 - w) / sqrt(e) - cos(phi)) / sin(phi);
  double start[24], side[24];
  memcpy(start, s->r.position_m, sizeof(start));
  for (int i = 0; i < 8; i++)
    for (int axis = 0; axis < 3; axis++) {
      side[3 * i + axis] = s->body->mass_xyz[3 * i + axis] ? 1 : -1;
      s->r.position_m[3 * i + axis] += q0 * side[3 * i + axis];
    }
  double worst = 0, largest = 0;
  for (uint32_t n = 1; n <= 400; n++) {
    REQUIRE(mo_reference_step(&s->r, n - 1));
    const double q = pow(e, 0.5 * n) * q0 * (cos(n * phi) + b * sin(n * phi));
    for (int k = 0; k < 24; k++)
      worst = fmax(worst, fabs(s->r.position_m[k] - start[k] - q * side[k]));
    largest = fmax(largest, fabs(q));
  }
  printf("# drag %g /s, stiffness %g N/m: w = %.4f, largest error %.1e m of %.1e m\n", drag_per_s,
         stiffness_n_per_m, w, worst, largest);
  CHECK(worst < 2e-9 * largest / q0);
  CHECK(largest > 0.1 * q0);
}

static void breathing_spring(void)
{
  breathing(0, 15000);
  breathing(15, 15000);
  breathing(0, 1000);
  breathing(3, 30000);
}

/* Springs and the controller's actuation act in pairs: in the air, without gravity and drag,
 * momentum and angular momentum are conserved. */
static void momentum(void)
{
  const struct mo_workspace workspace = {3, 2, 2};
  struct mo_controller *controller = make_controller(workspace, MO_SENSOR_INVERSE_SQRT);
  struct mo_physics physics = mo_paper_physics();
  mo_controller_randomize(controller, 1);
  for (uint32_t i = 0; i < controller->n_springs; i++)
    controller->bias[3][i] = i % 3 ? 1.0F : -1.0F;
  physics.constants.gravity_m_per_s2 = 0;
  physics.constants.drag_per_s = 0;
  physics.scheme.dt_s = 0.002;
  physics.constants.mass_kg = 1.7;
  struct scene *s = make_scene(workspace, physics, controller);
  struct mo_random random = dice(2, 0, 0);
  const uint32_t n = s->body->n_masses;
  for (uint32_t k = 0; k < 3 * n; k++)
    s->r.velocity_m_per_s[k] = 0.5 * mo_random_normal(&random);
  double before[6] = {0}, moved = 0;
  for (int pass = 0; pass < 2; pass++) {
    double sum[6] = {0};
    for (uint32_t i = 0; i < n; i++) {
      const double *x = s->r.position_m + 3 * i, *v = s->r.velocity_m_per_s + 3 * i;
      const double arm[3] = {x[0] - 2.5, x[1] - 2.5, x[2] - 100};
      for (int a = 0; a < 3; a++) {
        sum[a] += v[a];
        sum[3 + a] += arm[(a + 1) % 3] * v[(a + 2) % 3] - arm[(a + 2) % 3] * v[(a + 1) % 3];
      }
    }
    for (int a = 0; a < 6; a++) {
      if (pass == 1)
        CHECK_NEAR(sum[a], before[a], 1e-10);
      before[a] = sum[a];
    }
    for (uint32_t step = 0; pass == 0 && step < 500; step++)
      REQUIRE(mo_reference_step(&s->r, step));
    for (uint32_t k = 0; k < s->body->n_springs && pass == 0; k++)
      moved = fmax(moved, fabs(s->r.tape->control.output[k]));
  }
  CHECK(moved > 0.5); /* the controller did pull */
}

/* Returns the largest deviation from a rigid lattice at rest after 2000 steps, starting from a tiny
 * disturbance. */
static double disturbance_after(struct mo_workspace workspace, struct mo_physics physics)
{
  struct scene *s = make_scene(workspace, physics, NULL);
  double *start = make_zeros(3 * (size_t)s->body->n_masses, sizeof(double));
  struct mo_random random = dice(3, 0, 0);
  double largest = 0;
  for (uint32_t k = 0; k < 3 * s->body->n_masses; k++) {
    start[k] = s->r.position_m[k];
    s->r.position_m[k] += 1e-7 * mo_random_normal(&random);
  }
  double drift[3] = {0}; /* the mean of the disturbance stays, because the body is free */
  for (uint32_t n = 0; n < 2000; n++)
    if (!mo_reference_step(&s->r, n))
      break;
  for (uint32_t k = 0; k < 3 * s->body->n_masses; k++)
    drift[k % 3] += (s->r.position_m[k] - start[k]) / s->body->n_masses;
  for (uint32_t k = 0; k < 3 * s->body->n_masses; k++)
    largest = fmax(largest, fabs(s->r.position_m[k] - start[k] - drift[k % 3]));
  return largest;
}

/* The largest eigenvalue is 6 for one voxel and 10.900 for the full lattice (tools/bench
 * stability). */
static void stability(void)
{
  static const struct {
    struct mo_workspace workspace;
    double eigenvalue;
  } bodies[] = {{{1, 1, 1}, 6}, {{6, 6, 4}, 10.900}};
  static const double drags_per_s[] = {0, 15, 40};
  for (int i = 0; i < 12; i++) {
    const int b = i % 2, integrator = i / 2 % 2;
    struct mo_physics physics = mo_paper_physics();
    physics.scheme.integrator = (enum mo_integrator)integrator;
    physics.constants.gravity_m_per_s2 = 0;
    physics.constants.drag_per_s = drags_per_s[i / 4];
    physics.constants.mass_kg = 1 + i;
    const double bound = mo_stable_step_s(&physics, bodies[b].eigenvalue);
    physics.scheme.dt_s = 0.998 * bound;
    CHECK(mo_step_is_stable(&physics, bodies[b].eigenvalue));
    const double below = disturbance_after(bodies[b].workspace, physics);
    physics.scheme.dt_s = 1.002 * bound;
    CHECK(!mo_step_is_stable(&physics, bodies[b].eigenvalue));
    const double above = disturbance_after(bodies[b].workspace, physics);
    printf("# %s, drag %g /s, mass %g kg, eigenvalue %g: bound %.4f ms, disturbance of 1e-7 m "
           "becomes %.1e m 0.2 %% below it, %.1e m above\n",
           mo_integrator_words[integrator], physics.constants.drag_per_s, physics.constants.mass_kg,
           bodies[b].eigenvalue, 1e3 * bound, below, above);
    CHECK(below < 1e-5);
    CHECK(above > 1e-3);
    CHECK(mo_stable_step_s(&physics, MO_EIGENVALUE_MAX) < bound);
  }
  struct mo_physics physics = mo_paper_physics();
  CHECK_NEAR(mo_stable_step_s(&physics, 6), 0.00651, 5e-6);
  CHECK_NEAR(mo_stable_step_s(&physics, 10.900), 0.00486, 5e-6);
  physics.constants.drag_per_s = 0; /* leapfrog: w dt < 2 */
  CHECK_NEAR(mo_stable_step_s(&physics, 6), 2 / sqrt(6 * 15000.0), 1e-12);
  physics.constants.stiffness_n_per_m = 0;
  CHECK(isinf(mo_stable_step_s(&physics, MO_EIGENVALUE_MAX)));
}

/* A body at rest in the air without gravity stays at rest. */
static void rest(void)
{
  struct scene *s = make_scene((struct mo_workspace){2, 2, 2}, mo_paper_physics(), NULL);
  s->physics.constants.gravity_m_per_s2 = 0;
  double start[81];
  memcpy(start, s->r.position_m, sizeof(start));
  for (uint32_t n = 0; n < 1000; n++)
    REQUIRE(mo_reference_step(&s->r, n));
  for (int k = 0; k < 81; k++)
    CHECK_NEAR(s->r.position_m[k], start[k], 1e-11);
}

/* The inputs of the controller: light minus its mean at the body's masses, 0 elsewhere, and five
 * phases of one clock. */
static void inputs(void)
{
  uint64_t bits[MO_DEFAULT_WORDS] = {0};
  const uint32_t voxel = (2 * 6 + 3) * 4;
  bits[voxel >> 6] |= UINT64_C(1) << (voxel & 63);
  const struct mo_body *body = make_body(make_lattice(MO_DEFAULT_WORKSPACE), bits);
  const struct mo_environment environment = flat_environment(0.3, 1.25, 3.5);
  const struct mo_physics physics = mo_paper_physics();
  for (int sensor = 0; sensor < 2; sensor++) {
    struct mo_reference r;
    REQUIRE(mo_reference_init(&r, body,
                              make_controller(MO_DEFAULT_WORKSPACE, (enum mo_sensor)sensor),
                              &environment, &physics) == MO_OK);
    CHECK_NEAR(r.light_m[2], 0.3, 1e-15);
    double light[8], mean = 0, expected[250] = {0};
    for (int i = 0; i < 8; i++) {
      const double x = 2.2 + 0.1 * (2 + (i >> 2)) - 1.25, y = 2.2 + 0.1 * (3 + (i >> 1 & 1)) - 3.5,
                   z = 0.1 * (i & 1);
      const double d2 = x * x + y * y + z * z;
      light[i] = sensor == 0 ? 1 / (sqrt(sqrt(d2) + 1e-8) + 1e-8) : 1 / (d2 + 1e-4);
      mean += light[i] / 8;
    }
    for (int i = 0; i < 8; i++)
      expected[((2 + (i >> 2)) * 7 + 3 + (i >> 1 & 1)) * 5 + (i & 1)] = light[i] - mean;
    for (int k = 0; k < 5; k++)
      expected[245 + k] = sin(10 * 17 * 0.004 + 2 * M_PI * k / 5);
    REQUIRE(mo_reference_step(&r, 17));
    for (int j = 0; j < 250; j++)
      CHECK_NEAR(r.tape->control.input[j], expected[j], 1e-13);
    mo_reference_done(&r);
  }
}

/* One spring shortened by its activation: rest length L0 (1 + 0.2 a). */
static void actuation(void)
{
  struct mo_controller *controller = make_controller(one, MO_SENSOR_INVERSE_SQRT);
  struct mo_physics physics = mo_paper_physics();
  physics.constants.gravity_m_per_s2 = 0;
  for (uint32_t k = 0; k < controller->n_springs; k++) {
    struct scene *s = make_scene(one, physics, controller);
    const double a = k % 2 ? tanh(0.5) : -tanh(0.25), length = s->body->spring_rest_m[k];
    memset(controller->bias[3], 0, 24 * sizeof(float));
    controller->bias[3][k] = k % 2 ? 0.5F : -0.25F;
    REQUIRE(mo_reference_step(&s->r, 0));
    const double expected =
        15000 * 0.2 * a * length * 0.004 / (1 + 1e-8 / length); /* pushes its ends apart */
    double push = 0, others = 0;
    const uint32_t i = s->body->spring_a[k], j = s->body->spring_b[k];
    for (int axis = 0; axis < 3; axis++) {
      const double d =
          (double)s->body->mass_xyz[3 * j + axis] - (double)s->body->mass_xyz[3 * i + axis];
      push += s->r.velocity_m_per_s[3 * j + axis] * d / (length * 10);
      for (uint32_t m = 0; m < 8; m++)
        if (m != i && m != j)
          others = fmax(others, fabs(s->r.velocity_m_per_s[3 * m + axis]));
    }
    CHECK_NEAR(push, expected, 1e-9);
    CHECK(others < 1e-9);
  }
}

static void settings(void)
{
  struct mo_message message;
  static struct mo_physics p;
  p = mo_paper_physics();
  CHECK_INT(mo_physics_check(&p, &message), MO_OK);
  CHECK_INT(mo_recording_frames(&p, 1), 1001);
  CHECK_INT(mo_recording_frames(&p, 3), 334);
  CHECK_INT(mo_recording_frames(&p, 1000), 2);
  CHECK_INT(mo_recording_frames(&p, 1001), 1);
  CHECK_INT(mo_recording_frames(&p, 0), 0);
  static const struct field_case fields[] = {
      {FIELD(p.scheme.dt_s), 0, MO_ERR_RANGE, "dt_s must be"},
      {FIELD(p.scheme.dt_s), 0.2, MO_ERR_RANGE, "dt_s must be"},
      {FIELD(p.constants.stiffness_n_per_m), -1, MO_ERR_RANGE, "stiffness_n_per_m must be"},
      {FIELD(p.constants.mass_kg), 0, MO_ERR_RANGE, "mass_kg must be"},
      {FIELD(p.constants.drag_per_s), -1e-9, MO_ERR_RANGE, "drag_per_s must be"},
      {FIELD(p.constants.gravity_m_per_s2), 1001, MO_ERR_RANGE, "gravity_m_per_s2 must be"},
      {FIELD(p.constants.actuation), 1, MO_ERR_RANGE, "actuation must be"},
      {FIELD(p.constants.friction), -0.1, MO_ERR_RANGE, "friction must be"},
      {FIELD(p.constants.friction_cap), 1.01, MO_ERR_RANGE, "friction_cap must be"},
      {FIELD(p.drop_height_m), -1, MO_ERR_RANGE, "drop_height_m must be"},
      {FIELD(p.scheme.n_steps), 0, MO_ERR_RANGE, "n_steps"},
      {FIELD(p.scheme.n_steps), MO_STEPS_MAX + 1, MO_ERR_RANGE, "n_steps"},
      {FIELD(p.scheme.bisections), 0, MO_ERR_RANGE, "bisections"},
      {FIELD(p.scheme.bisections), 53, MO_ERR_RANGE, "bisections"},
      {FIELD(p.scheme.impact), 2, MO_ERR_INVALID, "impact"},
  };
  for (size_t i = 0; i < COUNT(fields); i++) {
    const double values[] = {fields[i].value, NAN, INFINITY};
    for (int k = 0; k < (fields[i].size == sizeof(double) ? 3 : 1); k++) {
      p = mo_paper_physics();
      set_field(fields[i].field, fields[i].size, values[k]);
      CHECK_INT(mo_physics_check(&p, &message), k == 0 ? fields[i].code : MO_ERR_INVALID);
      CHECK_SAYS(message, fields[i].says);
      CHECK_INT(mo_physics_check(&p, NULL), k == 0 ? fields[i].code : MO_ERR_INVALID);
    }
  }
  p = mo_paper_physics();
  p.scheme.integrator = MO_INTEGRATOR_SPLIT;
  p.constants.drag_per_s = 1 / p.scheme.dt_s;
  CHECK_INT(mo_physics_check(&p, &message), MO_OK);
  p.constants.drag_per_s *= 1.001;
  CHECK_INT(mo_physics_check(&p, &message), MO_ERR_RANGE);
  CHECK_SAYS(message, "drag_per_s times dt_s");
}

static const struct check_case cases[] = {{"free fall", free_fall},
                                          {"drag", drag_decay},
                                          {"a voxel as a spring", breathing_spring},
                                          {"momentum in the air", momentum},
                                          {"limits of stability", stability},
                                          {"rest", rest},
                                          {"inputs of the controller", inputs},
                                          {"actuation of one spring", actuation},
                                          {"bounds of the settings", settings}};
CHECK_MAIN(cases)
