/* stress.c: training runs with settings far outside the physics' intended range. Whatever the
 * robots do, weights, moments and scores stay finite, and every robot that diverged is reported. */
#include <morpho/compute.h>
#include <morpho/learning.h>

#include "../make.h"
#include "controller/tape.h"
#include "learning/internal.h"

#include <stdbool.h>

#define PI 3.14159265358979323846

enum { ROBOTS = 32, SCORED = 4, PHASES_MAX = MO_HIDDEN, SPRINGS_SHOWN = 16 };

/* ---- a controller that reverses every spring at every step ---- */

/* The generator's phase θ = 10 t dt advances by one of n equal parts per step. Neuron i of the
 * first layer is above 0 only while θ is within 0.8 of a part of the middle of its own part: its
 * input is cos(θ − ψ_i). The ψ_i are spread evenly, so the LayerNorm's mean and deviation over the
 * neurons are the same at every θ: it is an affine map, undone by its gain and shift. The second
 * layer distinguishes even parts from odd ones, and its LayerNorm turns that into a sign. The third
 * passes it on, and each spring gets tanh(±3.84), which is almost an end of its range but still has
 * a gradient. */
static void make_reverser(struct mo_controller *c, double dt_s)
{
  const uint32_t parts = 2 * (uint32_t)lround(PI / (MO_CPG_RAD_PER_S * dt_s));
  const double part = 2 * PI / parts, threshold = cos(0.8 * part);
  memset(c->parameters, 0, c->n_parameters * sizeof(float));
  for (uint32_t i = 0; i < parts && i < PHASES_MAX; i++)
    for (uint32_t k = 0; k < MO_CPG_INPUTS;
         k++) { /* cos(θ − ψ) = 2/5 Σ sin(θ + 2πk/5) sin(ψ + 2πk/5) */
      const double shift = 2 * PI * k / MO_CPG_INPUTS;
      c->weight[0][(size_t)i * c->n_inputs + c->n_masses + k] =
          (float)(0.4 * sin(part * i + shift));
    }
  /* Over 256 neurons, `parts` of them cosines: mean 0, mean square parts/512. */
  const double deviation = sqrt(parts / 512.0 + MO_LAYERNORM_EPSILON);
  for (uint32_t i = 0; i < parts && i < PHASES_MAX; i++) {
    c->norm_gain[0][i] = (float)(deviation / (1 - threshold));
    c->norm_shift[0][i] = (float)(-threshold / (1 - threshold));
    for (uint32_t j = 0; j < MO_HIDDEN; j++)
      c->weight[1][(size_t)j * MO_HIDDEN + i] = (i % 2 == 0) == (j % 2 == 0) ? 1.0f : -1.0f;
  }
  for (int layer = 1; layer < MO_HIDDEN_LAYERS; layer++)
    for (uint32_t j = 0; j < MO_HIDDEN; j++)
      c->norm_gain[layer][j] = 1;
  for (uint32_t j = 0; j < MO_HIDDEN; j++)
    for (uint32_t i = 0; i < MO_HIDDEN; i++)
      c->weight[2][(size_t)j * MO_HIDDEN + i] = i % 2 == j % 2 ? 1.0f : -1.0f;
  for (uint32_t s = 0; s < c->n_springs; s++)
    for (uint32_t i = 0; i < MO_HIDDEN; i++)
      c->weight[3][(size_t)s * MO_HIDDEN + i] = (i % 2 == 0) == (s % 2 == 0) ? 0.03f : -0.03f;
}

/* Returns a time step close to the given one, such that an even number of steps makes one turn of
 * the generator. */
static double whole_parts(double dt_s)
{
  return PI / (MO_CPG_RAD_PER_S * (double)lround(PI / (MO_CPG_RAD_PER_S * dt_s)));
}

static void the_reverser_reverses(void)
{
  static const double dts_s[] = {0.004, 0.005};
  for (int d = 0; d < 2; d++) {
    struct mo_controller *c = make_controller(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT);
    const double dt_s = whole_parts(dts_s[d]);
    make_reverser(c, dt_s);
    double memory[5000] = {0}, before[SPRINGS_SHOWN] = {0}, least = 1;
    REQUIRE(mo_controller_tape_doubles(c, SPRINGS_SHOWN) <= 5000);
    struct mo_controller_tape tape = mo_controller_tape_place(c, SPRINGS_SHOWN, memory);
    const double *outputs = tape.output;
    uint32_t springs[SPRINGS_SHOWN], kept = 0;
    for (uint32_t s = 0; s < SPRINGS_SHOWN; s++)
      springs[s] = 101 * s;
    for (uint32_t step = 0; step < 1000; step++) {
      for (uint32_t k = 0; k < MO_CPG_INPUTS; k++)
        tape.input[MO_DEFAULT_MASSES + k] =
            sin(MO_CPG_RAD_PER_S * step * dt_s + 2 * PI * k / MO_CPG_INPUTS);
      mo_controller_forward(c, springs, SPRINGS_SHOWN, &tape);
      for (int s = 0; s < SPRINGS_SHOWN; s++) {
        least = fmin(least, fabs(outputs[s]));
        kept += step > 0 && outputs[s] * before[s] >= 0;
        before[s] = outputs[s];
      }
    }
    printf("# dt %.5f ms: least |activation| %.6f, %u of %d not reversed\n", 1e3 * dt_s, least,
           kept, 999 * SPRINGS_SHOWN);
    CHECK(least > 0.999);
    CHECK_INT(kept, 0);
  }
}

/* ---- conditions ---- */

struct stress {
  const char *name;
  double stiffness_factor, dt_s, weight_factor, drop_m,
      sigma_m; /* sigma 0 = as training runs draw it */
  bool light_inside, full, reverser;
};

static const struct stress stresses[] = {
    {"as it is", 1, 0.004, 1, 0, 0, false, false, false},
    {"reversal at every step", 1, 0.004, 1, 0, 0, false, false, true},
    {"stiffness x4", 4, 0.004, 1, 0, 0, false, false, false},
    {"dt 5 ms", 1, 0.005, 1, 0, 0, false, false, false},
    {"terrain of 1 m", 1, 0.004, 1, 0, 1, false, false, false},
    {"light inside the body", 1, 0.004, 1, 0, 0, true, false, false},
    {"drop from 10 m", 1, 0.004, 1, 10, 0, false, false, false},
    {"all 144 voxels", 1, 0.004, 1, 0, 0, false, true, false},
    {"weights x100", 1, 0.004, 100, 0, 0, false, false, false},
    {"except stiffness and dt", 1, 0.004, 100, 0.2, 1, true, true, false},
    {"reversal, terrain, light, drop", 1, 0.004, 1, 0.2, 1, true, false, true},
    {"everything", 4, 0.005, 100, 10, 1, true, true, false},
    {"everything, reversal", 4, 0.005, 1, 10, 1, true, true, true},
};
enum { STRESSES = COUNT(stresses) };

struct training_run {
  struct mo_training *training;
  struct mo_controller *start;
  uint64_t designs[ROBOTS][MO_DEFAULT_WORDS];
  struct mo_environment environments[ROBOTS];
  struct mo_robot robots[ROBOTS];
  struct mo_outcome outcomes[ROBOTS];
  double *gradient;
};

static void draw_designs(const struct stress *s, uint64_t (*designs)[MO_DEFAULT_WORDS])
{
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, 31);
  for (uint32_t i = 0; i < ROBOTS; i++)
    if (s->full || i == 0) {
      designs[i][0] = designs[i][1] = UINT64_MAX;
      designs[i][2] = 0xffff;
    } else {
      make_check(mo_body_stream_next(stream, designs[i], NULL), "a body");
    }
}

static void start(const struct stress *s, enum mo_sensor sensor, double bound, uint32_t n_steps,
                  struct training_run *run)
{
  memset(run, 0, sizeof(*run));
  draw_designs(s, run->designs);
  run->start = make_random_controller(sensor, 31);
  struct mo_training_settings settings = mo_training_defaults(MO_TRAINING_FINETUNE);
  settings.batch = ROBOTS;
  settings.held_out_designs = 0;
  settings.learning.gradient.adjoint_bound = bound;
  settings.learning.schedule = (struct mo_schedule){MO_SCHEDULE_CONSTANT, 1e-2, 1e-2, 1, 1, 1, 0};
  settings.physics.scheme.n_steps = n_steps;
  settings.physics.constants.stiffness_n_per_m *= s->stiffness_factor;
  settings.physics.scheme.dt_s = s->reverser ? whole_parts(s->dt_s) : s->dt_s;
  settings.physics.drop_height_m = s->drop_m;
  for (size_t i = 0; i < run->start->n_parameters; i++)
    run->start->parameters[i] *= (float)s->weight_factor;
  if (s->reverser)
    make_reverser(run->start, settings.physics.scheme.dt_s);
  run->gradient = make_zeros(run->start->n_parameters, sizeof(double));
  run->training = make_training(&settings, run->start, run->designs[0], ROBOTS);
}

/* The robots that the training run drew, in the environments of the condition. */
static void move_house(const struct stress *s, const struct mo_robot *drawn, uint32_t step,
                       struct training_run *run)
{
  for (uint32_t i = 0; i < ROBOTS; i++) {
    const struct mo_body *body = drawn[i].body;
    run->environments[i] = *drawn[i].environment;
    if (s->sigma_m > 0)
      mo_terrain_random(31, step, i, s->sigma_m, run->environments[i].terrain_heights_m);
    if (s->light_inside) { /* at the center of mass, where the loss itself has a pole */
      double com[2] = {0, 0};
      for (uint32_t m = 0; m < body->n_masses; m++)
        for (int axis = 0; axis < 2; axis++)
          com[axis] += MO_VOXEL_M * body->mass_xyz[3 * m + (uint32_t)axis] / body->n_masses;
      run->environments[i].light_xy_m[0] =
          MO_WORLD_CENTER_M - 0.5 * MO_VOXEL_M * body->workspace.nx + com[0];
      run->environments[i].light_xy_m[1] =
          MO_WORLD_CENTER_M - 0.5 * MO_VOXEL_M * body->workspace.ny + com[1];
    }
    run->robots[i] = (struct mo_robot){body, run->environments + i};
  }
}

static size_t not_finite(const double *x, size_t n)
{
  size_t bad = 0;
  for (size_t i = 0; i < n; i++)
    bad += !isfinite(x[i]);
  return bad;
}

/* Checks that an outcome is a finite loss, or a divergence with its step; never NaN. */
static bool is_told_truly(const struct mo_outcome *outcome, uint32_t n_steps)
{
  const bool diverged = outcome->diverged_step > 0;
  for (int axis = 0; axis < 3; axis++)
    if (!isfinite(outcome->com_start_m[axis]) || !isfinite(outcome->com_end_m[axis]))
      return false;
  return diverged ? isinf(outcome->loss) && outcome->loss > 0 &&
                        outcome->diverged_step <= (int32_t)n_steps
                  : isfinite(outcome->loss) && outcome->loss >= 0;
}

struct tally {
  uint64_t robots, diverged, zeroed, clipped_steps, steps, skipped, scores, scores_diverged;
  double largest_m, largest_weight, largest_norm;
};

static void one_step(const struct stress *s, struct mo_gradient_state *state,
                     struct training_run *run, struct tally *tally)
{
  const struct mo_robot *drawn = NULL;
  const struct mo_training_settings *settings = mo_training_settings_of(run->training);
  const size_t n = run->start->n_parameters;
  REQUIRE(mo_training_draw(run->training, NULL, NULL, &drawn) == MO_OK);
  move_house(s, drawn, mo_training_step(run->training), run);
  struct mo_gradient_batch batch = {.controller = mo_training_controller(run->training),
                                    .robots = run->robots,
                                    .n = ROBOTS,
                                    .physics = settings->physics,
                                    .options = settings->learning.gradient,
                                    .d_parameters = run->gradient,
                                    .outcomes = run->outcomes};
  REQUIRE(mo_compute_gradient(state, &batch) == MO_OK);
  uint64_t diverged = 0;
  for (uint32_t i = 0; i < ROBOTS; i++) {
    CHECK(is_told_truly(run->outcomes + i, settings->physics.scheme.n_steps));
    diverged += run->outcomes[i].diverged_step > 0;
  }
  CHECK_INT(batch.counts.robots, ROBOTS);
  CHECK_INT(batch.counts.diverged_robots, diverged);
  CHECK(batch.counts.diverged_robots + batch.counts.zeroed_robots <= ROBOTS);
  CHECK_INT(not_finite(run->gradient, n), 0);
  CHECK(isfinite(batch.counts.largest));
  struct mo_training_report report;
  REQUIRE(mo_training_apply(run->training, run->gradient, run->outcomes, &batch.counts, &report) ==
          MO_OK);
  CHECK_INT(report.diverged, diverged);
  CHECK_INT(report.zeroed, batch.counts.zeroed_robots);
  CHECK(diverged == ROBOTS ? isnan(report.mean_loss) : isfinite(report.mean_loss));
  CHECK(isfinite(report.gradient_norm) && isfinite(report.rate));
  const struct mo_controller *now = mo_training_controller(run->training);
  size_t bad = 0;
  for (size_t i = 0; i < n; i++) {
    bad += !(fabsf(now->parameters[i]) <= MO_WEIGHT_LIMIT);
    tally->largest_weight = fmax(tally->largest_weight, fabs((double)now->parameters[i]));
  }
  CHECK_INT(bad, 0);
  CHECK_INT(not_finite(run->training->adam.first, n) + not_finite(run->training->adam.second, n),
            0);
  if (diverged + batch.counts.zeroed_robots == ROBOTS)
    CHECK(report.skipped);
  tally->robots += ROBOTS;
  tally->diverged += diverged;
  tally->zeroed += batch.counts.zeroed_robots;
  tally->steps += batch.counts.steps;
  tally->clipped_steps += batch.counts.clipped_steps;
  tally->skipped += report.skipped;
  tally->largest_m = fmax(tally->largest_m, batch.counts.largest);
  tally->largest_norm = fmax(tally->largest_norm, report.gradient_norm);
}

/* Scores the last robots with the learned controller, with the scoring kernels. */
static void score(struct mo_compute *compute, struct training_run *run, struct tally *tally)
{
  struct mo_block blocks[SCORED];
  const struct mo_training_settings *settings = mo_training_settings_of(run->training);
  struct mo_compute_controller *brain =
      make_compute_controller(compute, mo_training_controller(run->training));
  struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  for (uint32_t i = 0; i < SCORED; i++) {
    blocks[i] = (struct mo_block){
        .lattice = lattice,
        .genotype = run->designs[i],
        .controller = brain,
        .n_environments = 2,
        .environments = {run->environments + i, run->environments + ROBOTS - 1 - i},
        .physics = settings->physics};
  }
  CHECK_INT(mo_compute_run(compute, blocks, SCORED), MO_OK);
  for (uint32_t i = 0; i < SCORED; i++)
    for (uint32_t e = 0; e < 2; e++) {
      CHECK(is_told_truly(blocks[i].outcomes + e, settings->physics.scheme.n_steps));
      tally->scores++;
      tally->scores_diverged += blocks[i].outcomes[e].diverged_step > 0;
    }
}

static void run_all(uint32_t n_steps, uint32_t training_steps, bool thorough)
{
  struct mo_compute *compute = make_compute(2);
  struct mo_gradient_state *state = make_gradient_state(compute);
  static struct training_run run;
  uint64_t diverged = 0, contributed = 0;
  printf("# %u steps of training on %d robots of %u steps, each with both sensors%s\n",
         training_steps, ROBOTS, n_steps,
         thorough ? ", bound 2 and off" : "; bound off with inverse_square");
  printf("# %-31s robots diverged zeroed clipped%%  largest m  largest norm  largest weight  "
         "skipped  scores diverged\n",
         "");
  for (int k = 0; k < STRESSES; k++) {
    struct tally tally = {0};
    for (int variant = 0; variant < 4; variant++) {
      const enum mo_sensor sensor =
          variant % 2 == 0 ? MO_SENSOR_INVERSE_SQRT : MO_SENSOR_INVERSE_SQUARE;
      const bool off = variant == 1 || variant == 2;
      if (!thorough && variant > 1)
        continue;
      const int failures = check_failures;
      const size_t kept = check_n_kept;
      start(&stresses[k], sensor, off ? 0 : MO_ADJOINT_BOUND, n_steps, &run);
      for (uint32_t step = 0; step < training_steps; step++)
        one_step(&stresses[k], state, &run, &tally);
      score(compute, &run, &tally);
      if (check_failures > failures)
        printf("# in \"%s\", %s, bound %s\n", stresses[k].name, mo_sensor_name(sensor),
               off ? "off" : "2");
      check_drop_to(kept);
    }
    printf("# %-31s %6llu %8llu %6llu %7.2f %11.1e %13.1e %15.1e %8llu %7llu/%llu\n",
           stresses[k].name, (unsigned long long)tally.robots, (unsigned long long)tally.diverged,
           (unsigned long long)tally.zeroed,
           tally.steps > 0 ? 100.0 * (double)tally.clipped_steps / (double)tally.steps : 0.0,
           tally.largest_m, tally.largest_norm, tally.largest_weight,
           (unsigned long long)tally.skipped, (unsigned long long)tally.scores_diverged,
           (unsigned long long)tally.scores);
    diverged += tally.diverged;
    contributed += tally.robots - tally.diverged - tally.zeroed;
  }
  CHECK(diverged > 0 && contributed > 0); /* both sides of the border occurred */
}

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
#define SHORT_STEPS 15
#else
#define SHORT_STEPS 80
#endif

static void short_runs(void)
{
  run_all(SHORT_STEPS, 2, false);
}

static void long_runs(void)
{
  run_all(1000, 2, true);
}

static const struct check_case cases[] = {
    {"short: a controller at the Nyquist rate", the_reverser_reverses},
    {"short: every result is finite or reported", short_runs},
    {"every result is finite or reported: 1000 steps", long_runs},
};
CHECK_MAIN(cases)
