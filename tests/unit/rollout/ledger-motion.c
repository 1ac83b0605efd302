/* ledger-motion.c: the reference against closed forms, for both integrators: falls, vibrations,
 * friction, slopes, impacts, bending. */
#include "ledger.h"

/* ---- motion in the air ---- */

/* From rest with drag 1/s for 8 s: v = −g (1 − exp(−t)), z = z0 − g (t − 1 + exp(−t)). The force is
 * constant, so `split` has the velocity in the middle of a step exactly. */
static double fall(enum mo_integrator integrator, double dt_s, bool is_speed)
{
  struct mo_physics physics = scheme_of(integrator, dt_s);
  physics.constants.drag_per_s = 1;
  struct scene *s = make_flight(one, physics);
  const double start = mean_of(s, s->r.position_m, 2), t = 8;
  advance_for(s, t);
  const double middle = mean_of(s, s->r.velocity_m_per_s, 2);
  if (integrator == MO_INTEGRATOR_SPLIT)
    CHECK_NEAR(middle, GRAVITY_M_PER_S2 * expm1(dt_s / 2 - t), 1e-11);
  const double place = mean_of(s, s->r.position_m, 2);
  advance(s); /* gives the velocity at t */
  if (is_speed)
    return fabs(mean_of(s, s->start_m_per_s, 2) - GRAVITY_M_PER_S2 * expm1(-t));
  return fabs(place - start + GRAVITY_M_PER_S2 * (t + expm1(-t)));
}

static double fall_place(enum mo_integrator integrator, double dt_s)
{
  return fall(integrator, dt_s, false);
}

static double fall_speed(enum mo_integrator integrator, double dt_s)
{
  return fall(integrator, dt_s, true);
}

static void free_fall(void)
{
  compare("fall with drag: place (m)", fall_place, 4e-3, 0.1, (struct expected){1, 0.2},
          (struct expected){2, 1e-5});
  compare("fall with drag: speed (m/s)", fall_speed, 4e-3, 0.1, (struct expected){1, 0.03},
          (struct expected){2, 1e-8});
}

/* A breathing voxel: each corner moves as q'' = −6 k/m q along each axis. Returns the relative
 * error of the period over 40 periods, or the largest error of q over 5 periods, relative to its
 * amplitude. */
static double breathe(enum mo_integrator integrator, double dt_s, bool is_period)
{
  struct mo_physics physics = scheme_of(integrator, dt_s);
  physics.constants.gravity_m_per_s2 = 0;
  struct scene *s = make_flight(one, physics);
  const double q0 = 1e-4, omega = sqrt(6 * 15000.0), period = 2 * M_PI / omega;
  const double rest = s->r.position_m[21];
  inflate(s, q0);
  double last = q0, error = 0, first_s = 0, last_s = 0;
  int crossings = 0;
  while (is_period ? crossings < 41 : s->step * dt_s < 5 * period) {
    advance(s);
    const double q = s->r.position_m[21] - rest, t = s->step * dt_s;
    error = fmax(error, fabs(q / q0 - cos(omega * t)));
    if (last < 0 && q >= 0) {
      last_s = t - dt_s * q / (q - last);
      first_s = crossings++ == 0 ? last_s : first_s;
    }
    last = q;
  }
  return is_period ? fabs((last_s - first_s) / 40 / period - 1) : error;
}

static double breathe_period(enum mo_integrator integrator, double dt_s)
{
  return breathe(integrator, dt_s, true);
}

static double breathe_phase(enum mo_integrator integrator, double dt_s)
{
  return breathe(integrator, dt_s, false);
}

/* Both have the same period, because without drag they differ only in their start. */
static void vibration(void)
{
  compare("breathing voxel: period", breathe_period, 1e-3, 0.1, (struct expected){2, 5e-3},
          (struct expected){2, 5e-3});
  compare("breathing voxel: place", breathe_phase, 2.5e-4, 0.1, (struct expected){1, 0.06},
          (struct expected){2, 0.01});
}

/* ---- friction ---- */

/* Masses on flat ground stop after v²/(2 μ g). */
static double slide_points(enum mo_integrator integrator, double dt_s)
{
  struct mo_physics physics = scheme_of(integrator, dt_s);
  physics.constants.friction = 0.3;
  struct scene *s = make_points(0, physics);
  double error = 0;
  for (int i = 0; i < POINTS; i++) {
    s->r.position_m[3 * i] = 2;
    s->r.position_m[3 * i + 2] = 0;
    s->r.velocity_m_per_s[3 * i] = 1 + 0.037 * i;
  }
  advance_for(s, 1);
  for (int i = 0; i < POINTS; i++) {
    const double v = 1 + 0.037 * i;
    error = fmax(error, fabs(s->r.position_m[3 * i] - 2 - v * v / (2 * 0.3 * GRAVITY_M_PER_S2)));
  }
  return error;
}

/* A voxel at rest on flat ground. It came to rest without friction, which would leave tension
 * behind. */
static struct scene *make_block(enum mo_integrator integrator, double dt_s)
{
  struct mo_physics physics = scheme_of(integrator, dt_s);
  physics.constants.drag_per_s = 15;
  physics.constants.friction = 0;
  struct scene *s = make_scene(make_full_body(make_lattice(one)), plane_of(0), physics);
  advance_for(s, 3);
  s->physics.constants.friction = 0.3;
  return s;
}

/* Pushes it to 1 m/s, without drag. Returns how far it slides until shortly before it stops, in
 * 0.32 s of 0.34 s. */
static double slide_block(enum mo_integrator integrator, double dt_s)
{
  struct scene *s = make_block(integrator, dt_s);
  const double start = mean_of(s, s->r.position_m, 0);
  s->physics.constants.drag_per_s = 0;
  for (int i = 0; i < POINTS; i++)
    s->r.velocity_m_per_s[3 * i] += 1;
  advance_for(s, 0.32);
  return mean_of(s, s->r.position_m, 0) - start;
}

static double block_limit_m;

static double slide_block_error(enum mo_integrator integrator, double dt_s)
{
  return fabs(slide_block(integrator, dt_s) - block_limit_m);
}

/* The same with drag, until it has stopped and no longer vibrates. `split` has the velocity half a
 * step before. Returns the difference from a single mass: v/γ − μ g/γ² ln(1 + γ v/(μ g)). */
static double stop_block(enum mo_integrator integrator, double dt_s)
{
  const double v = 1, drag = 15, slow = 0.3 * GRAVITY_M_PER_S2;
  struct scene *s = make_block(integrator, dt_s);
  const double start = mean_of(s, s->r.position_m, 0);
  for (int i = 0; i < POINTS; i++)
    s->r.velocity_m_per_s[3 * i] +=
        integrator == MO_INTEGRATOR_SPLIT ? v * exp(drag * dt_s / 2) : v;
  advance_for(s, 1.5);
  const double slid = mean_of(s, s->r.position_m, 0) - start;
  return slid - (v / drag - slow / (drag * drag) * log1p(drag * v / slow));
}

static double stop_limit_m;

static double stop_block_error(enum mo_integrator integrator, double dt_s)
{
  return fabs(stop_block(integrator, dt_s) - stop_limit_m);
}

/* The voxel bends as friction pulls at its feet, so it does not slide exactly like one mass. Both
 * integrators must have the same limit. */
static void sliding(void)
{
  compare("masses that slide and stop (m)", slide_points, 4e-3, 0.5, (struct expected){1, 4e-3},
          (struct expected){2, 1e-5});
  block_limit_m = slide_block(MO_INTEGRATOR_SPLIT, 6.25e-5);
  compare("a voxel that slides (m)", slide_block_error, 2e-3, 0.5, (struct expected){1, 2e-3},
          (struct expected){2, 2e-5});
  const double rigid = 0.32 - 0.3 * GRAVITY_M_PER_S2 * 0.32 * 0.32 / 2;
  printf("# the voxel slides %.6f m in the limit, a single mass %.6f m\n", block_limit_m, rigid);
  CHECK_NEAR(block_limit_m / rigid, 1, 0.01);
  stop_limit_m = stop_block(MO_INTEGRATOR_SPLIT, 6.25e-5);
  compare("a voxel that stops, with drag (m)", stop_block_error, 2e-3, 0.5,
          (struct expected){1, 2e-3}, (struct expected){2, 2e-5});
  printf("# with drag it stops %.6f m from where a single mass does\n", stop_limit_m);
  CHECK(fabs(stop_limit_m) < 1e-3);
}

/* ---- slopes ---- */

/* A body that drag has brought to rest on a slope of 0.3, with friction 0.9. Returns how far it
 * then moves in 2 s. */
static double creep(enum mo_integrator integrator, double dt_s)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = integrator;
  physics.scheme.dt_s = dt_s;
  struct scene *s = make_scene(make_full_body(make_lattice((struct mo_workspace){2, 2, 1})),
                               plane_of(0.3), physics);
  advance_for(s, 5);
  double start_m[3 * 18], moved = 0;
  memcpy(start_m, s->r.position_m, sizeof(start_m));
  advance_for(s, 2);
  for (int k = 0; k < 3 * 18; k++)
    moved = fmax(moved, fabs(s->r.position_m[k] - start_m[k]));
  return moved;
}

/* With `split`, a mass that does not slip stays where it is, also with drag. With `paper`, friction
 * leaves 5 % (`friction_cap`) of the speed g sin a dt that a mass gains in a step: it creeps. The
 * feet carry two layers of masses, which doubles that. */
static void rest_on_slope(void)
{
  const double pull = GRAVITY_M_PER_S2 * 0.3 / sqrt(1 + 0.3 * 0.3);
  double paper[3], split = 0;
  for (int k = 0; k < 3; k++) {
    const double dt_s = ldexp(4e-3, -k);
    split = fmax(split, creep(MO_INTEGRATOR_SPLIT, dt_s));
    paper[k] = creep(MO_INTEGRATOR_PAPER, dt_s);
    CHECK(paper[k] < 1.2 * 2 * 0.05 * pull * dt_s * 2);
  }
  CHECK_NEAR(measure_order("creep on a slope in 2 s (m)", "paper", paper, 4e-3), 1, 0.3);
  printf("# split: at most %.1e m\n", split);
  CHECK(split < 1e-9);
}

/* Masses that slide down a slope of 0.6 from rest, friction 0.3: v' = A − γ v with
 * A = g (sin a − μ cos a). */
static double slide_down(enum mo_integrator integrator, double dt_s, double drag_per_s)
{
  struct mo_physics physics = scheme_of(integrator, dt_s);
  physics.constants.friction = 0.3;
  physics.constants.drag_per_s = drag_per_s;
  struct scene *s = make_points(0.6, physics);
  for (int i = 0; i < POINTS; i++) {
    double *x = s->r.position_m + 3 * i;
    x[0] = 2 + 0.1 * i;
    x[2] = mo_terrain_height(&s->environment, x[0], x[1]);
  }
  const double t = 0.6, y = drag_per_s * t, c = 1 / sqrt(1 + 0.6 * 0.6);
  const double a = GRAVITY_M_PER_S2 * (0.6 - 0.3) * c;
  const double expected = a * t * t * (y > 0 ? (y + expm1(-y)) / (y * y) : 0.5);
  advance_for(s, t);
  double error = 0;
  for (int i = 0; i < POINTS; i++)
    error = fmax(error, fabs((2 + 0.1 * i - s->r.position_m[3 * i]) / c - expected));
  return error;
}

static double slide_down_drag(enum mo_integrator integrator, double dt_s)
{
  return slide_down(integrator, dt_s, 3);
}

/* A voxel on the same slope. Returns its acceleration divided by g (sin a − μ cos a). */
static double slide_down_block(enum mo_integrator integrator, double dt_s)
{
  struct mo_physics physics = scheme_of(integrator, dt_s);
  physics.constants.friction = 0.3;
  struct scene *s = make_scene(make_full_body(make_lattice(one)), plane_of(0.6), physics);
  const double c = 1 / sqrt(1 + 0.6 * 0.6), a = GRAVITY_M_PER_S2 * (0.6 - 0.3) * c, t = 0.8;
  for (int i = 0; i < POINTS; i++) { /* turned, so that it stands on the slope */
    const double u = 0.1 * s->body->mass_xyz[3 * i], w = 0.1 * s->body->mass_xyz[3 * i + 2];
    s->r.position_m[3 * i] = 2.6 + c * (u - 0.6 * w);
    s->r.position_m[3 * i + 2] = 0.06 + c * (0.6 * u + w);
  }
  const double start = mean_of(s, s->r.position_m, 0);
  advance_for(s, t);
  return (start - mean_of(s, s->r.position_m, 0)) / c / (a * t * t / 2);
}

/* Without drag, `split` moves a mass with a constant force exactly. */
static void sliding_down(void)
{
  double paper[3];
  for (int k = 0; k < 3; k++) {
    const double dt_s = ldexp(4e-3, -k);
    paper[k] = slide_down(MO_INTEGRATOR_PAPER, dt_s, 0);
    CHECK(slide_down(MO_INTEGRATOR_SPLIT, dt_s, 0) < 1e-11);
  }
  CHECK_NEAR(measure_order("masses that slide down (m)", "paper", paper, 4e-3), 1, 0.3);
  compare("the same with drag (m)", slide_down_drag, 4e-3, 0.5, (struct expected){1, 6e-3},
          (struct expected){2, 2e-5});
  for (int i = 0; i < 2; i++) {
    const double share = slide_down_block((enum mo_integrator)i, 1e-3);
    printf("# %s: a voxel slides down with %.4f of the closed form's acceleration\n",
           i ? "split" : "paper", share);
    CHECK_NEAR(share, 1, 0.01);
  }
}

/* ---- impacts ---- */

struct flight {
  double height_m, speed_m_per_s; /* at the start: above the ground, along x */
};

/* Where along a slope (m, from below the start) a mass is after t: it flies, hits the ground, loses
 * its normal velocity and μ times this of its tangential one, and slides upward. */
static double after_impact(struct flight f, double slope, double friction, double t_s)
{
  const double c = 1 / sqrt(1 + slope * slope), s = slope * c, g = GRAVITY_M_PER_S2;
  const double gap = f.height_m * c, vn = -f.speed_m_per_s * s, vt = f.speed_m_per_s * c;
  const double impact = (vn + sqrt(vn * vn + 2 * g * c * gap)) / (g * c), r = t_s - impact;
  const double hit = f.height_m * s + vt * impact - g * s * impact * impact / 2;
  const double slid = vt - g * s * impact - friction * (g * c * impact - vn);
  return hit + slid * r - g * (s + friction * c) * r * r / 2;
}

static double impact(enum mo_integrator integrator, double dt_s, double slope)
{
  struct mo_physics physics = scheme_of(integrator, dt_s);
  physics.constants.friction = 0.3;
  struct scene *s = make_points(slope, physics);
  for (int i = 0; i < POINTS; i++) {
    const double start[] = {MO_WORLD_CENTER_M, MO_WORLD_CENTER_M, 0.1 + 0.0137 * i};
    memcpy(s->r.position_m + 3 * i, start, sizeof(start));
    s->r.velocity_m_per_s[3 * i] = 3;
  }
  advance_for(s, 0.4);
  double error = 0;
  for (int i = 0; i < POINTS; i++) {
    const double along = after_impact((struct flight){0.1 + 0.0137 * i, 3}, slope, 0.3, 0.4);
    const double x = MO_WORLD_CENTER_M + along / sqrt(1 + slope * slope);
    error = fmax(error, fabs(s->r.position_m[3 * i] - x));
    CHECK_NEAR(s->r.position_m[3 * i + 2], slope * (s->r.position_m[3 * i] - MO_WORLD_CENTER_M),
               1e-13);
  }
  return error;
}

static double impact_on_flat(enum mo_integrator integrator, double dt_s)
{
  return impact(integrator, dt_s, 0);
}

static double impact_on_slope(enum mo_integrator integrator, double dt_s)
{
  return impact(integrator, dt_s, 0.2);
}

static void impacts(void)
{
  compare("place after an impact, flat (m)", impact_on_flat, 4e-3, 0.5, (struct expected){1, 4e-3},
          (struct expected){2, 1e-5});
  compare("place after an impact, slope (m)", impact_on_slope, 4e-3, 0.5,
          (struct expected){1, 6e-3}, (struct expected){2, 2e-5});
}

/* ---- a beam ---- */

#define BEAM_VOXELS 16

/* Puts the masses of a frame of the beam back to where they started along an axis. */
static void hold(struct scene *s, const double *start_m, uint32_t frame, int axis, double shift_m)
{
  for (uint32_t i = 0; i < s->body->n_masses; i++)
    if (s->body->mass_xyz[3 * i] == frame) {
      s->r.position_m[3 * i + axis] = start_m[3 * i + axis] + shift_m;
      s->r.velocity_m_per_s[3 * i + axis] = 0;
    }
}

static struct scene *make_beam(enum mo_integrator integrator, double gravity_m_per_s2,
                               double drag_per_s)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = integrator;
  physics.constants.gravity_m_per_s2 = gravity_m_per_s2;
  physics.constants.drag_per_s = drag_per_s;
  return make_flight((struct mo_workspace){BEAM_VOXELS, 1, 1}, physics);
}

/* Returns the force per strain that stretches the beam. */
static double stretch_n(enum mo_integrator integrator)
{
  struct scene *s = make_beam(integrator, 0, 15);
  double start_m[12 * (BEAM_VOXELS + 1)], force = 0;
  memcpy(start_m, s->r.position_m, sizeof(start_m));
  for (int n = 0; n < 1500; n++) {
    hold(s, start_m, 0, 0, 0);
    hold(s, start_m, BEAM_VOXELS, 0, 1e-4 * BEAM_VOXELS * MO_VOXEL_M);
    advance(s);
  }
  for (uint32_t i = 0; i < s->body->n_masses; i++)
    if (s->body->mass_xyz[3 * i] == 0)
      force += s->r.impulse_n_s[3 * i] / s->physics.scheme.dt_s;
  return force / 1e-4;
}

/* Returns how far the tip sinks of a beam that is held at one end. */
static double sag_m(enum mo_integrator integrator, double gravity_m_per_s2)
{
  struct scene *s = make_beam(integrator, gravity_m_per_s2, 2);
  double start_m[12 * (BEAM_VOXELS + 1)], sag = 0;
  memcpy(start_m, s->r.position_m, sizeof(start_m));
  for (int n = 0; n < 4000; n++) {
    advance(s);
    hold(s, start_m, 0, 0, 0);
    hold(s, start_m, 0, 2, 0);
  }
  for (uint32_t i = 0; i < s->body->n_masses; i++)
    if (s->body->mass_xyz[3 * i] == BEAM_VOXELS)
      sag += (start_m[3 * i + 2] - s->r.position_m[3 * i + 2]) / 4;
  return sag;
}

/* What the springs of a beam of one voxel's section give, per length a of a voxel, k: stiffness.
 * Strain e along the beam, −e/3 across it (which costs least): 4 edges along it, 4 edges and 2
 * diagonals across it, 8 diagonals between: EA = k a (4 + 8/9 + 16/9) = 20/3 k a.
 * Bending, with strains ±e of the two faces that lengthen and shorten and ∓e/2 across them: the
 * other faces' diagonals keep their length, so EI = k a³/4 (4 + 1/2 + 1/2) = 5/4 k a³. For a
 * section that is one voxel wide, E of the stretch times the I of a solid square would be far from
 * this.
 *
 * The tip sinks by the sum of F x² (3 L − x)/(6 EI) over the loads, but for the shear and the ends.
 */
static void beam(void)
{
  const double k = 15000, a = MO_VOXEL_M, g = 0.005, length = a * BEAM_VOXELS;
  const double tension = 20.0 / 3 * k * a, bending = 1.25 * k * a * a * a;
  double expected = 0;
  for (int n = 1; n <= BEAM_VOXELS; n++)
    expected += 4 * g * (n * a) * (n * a) * (3 * length - n * a) / (6 * bending);
  for (int i = 0; i < 2; i++) {
    const double force = stretch_n((enum mo_integrator)i), sag = sag_m((enum mo_integrator)i, g);
    printf("# %s: EA = %.0f N, closed form %.0f N; tip sinks %.3f mm, Euler-Bernoulli %.3f mm\n",
           i ? "split" : "paper", force, tension, 1e3 * sag, 1e3 * expected);
    CHECK_NEAR(force / tension, 1, 0.01);
    CHECK_NEAR(sag / expected, 1, 0.03);
  }
}

static const struct check_case cases[] = {
    {"free fall", free_fall},
    {"vibration", vibration},
    {"sliding on flat ground", sliding},
    {"rest on a slope", rest_on_slope},
    {"sliding down", sliding_down},
    {"impacts", impacts},
    {"a beam", beam},
};
CHECK_MAIN(cases)
