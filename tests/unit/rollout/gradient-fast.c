/* The float32 gradient of blocks compared with the float64 reference, and conditions that must not
 * change it. */
#include "../make.h"

#include <float.h>
#include <stdbool.h>

enum { ROBOTS = MO_GRADIENT_ROBOTS };

static struct mo_lattice *lattice;
static struct mo_controller *shipped, *fresh;
static struct mo_environment environments[ROBOTS];
static struct mo_robot *robots; /* random; the first has one voxel, the last all of them */

static void setup(void)
{
  struct mo_random random = dice(9, 0, 0);
  uint64_t one[MO_DEFAULT_WORDS] = {1};
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  shipped = make_shipped_controller("bootstrap");
  fresh = make_random_controller(MO_SENSOR_INVERSE_SQUARE, 8);
  /* LayerNorm parameters other than 1 and 0, and nonzero biases. */
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    for (uint32_t i = 0; i < (l < MO_HIDDEN_LAYERS ? MO_HIDDEN : fresh->n_springs); i++)
      fresh->bias[l][i] = (float)(0.2 * mo_random_uniform(&random) - 0.1);
    for (uint32_t i = 0; l < MO_HIDDEN_LAYERS && i < MO_HIDDEN; i++) {
      fresh->norm_gain[l][i] = (float)(0.5 + mo_random_uniform(&random));
      fresh->norm_shift[l][i] = (float)(0.4 * mo_random_uniform(&random) - 0.2);
    }
  }
  robots = make_robots(lattice, 4, 6, ROBOTS);
  mo_genotype_place(MO_DEFAULT_WORKSPACE, one);
  for (uint32_t i = ROBOTS - 2; i > 0; i--)
    robots[i].body = robots[i - 1].body;
  robots[0].body = make_body(lattice, one);
  robots[ROBOTS - 1].body = make_full_body(lattice);
  for (uint32_t i = 0; i < ROBOTS; i++) {
    environments[i] = *robots[i].environment;
    robots[i].environment = environments + i;
  }
}

/* One call with everything that it needs. */
struct result {
  float *d;
  struct mo_outcome outcomes[ROBOTS];
  struct mo_gradient_counts counts;
  int status;
};

static struct result block(const struct mo_controller *controller, int isa,
                           const struct mo_robot *list, uint32_t n,
                           const struct mo_physics *physics,
                           const struct mo_gradient_options *options, size_t budget,
                           const struct mo_pause_point *pause)
{
  struct result result = {.d = make_zeros(controller->n_parameters, sizeof(float))};
  const size_t kept = check_n_kept;
  result.status = mo_gradient_block(
      make_gradient_memory(budget), make_gradient_pack(controller, (enum mo_isa)isa), list, n,
      physics, options, pause, result.outcomes, result.d, &result.counts);
  check_drop_to(kept);
  return result;
}

/* With the usual budget, and without a pause. */
static struct result plain(const struct mo_controller *controller, int isa,
                           const struct mo_robot *list, uint32_t n,
                           const struct mo_physics *physics,
                           const struct mo_gradient_options *options)
{
  return block(controller, isa, list, n, physics, options, MO_GRADIENT_DEFAULT_BYTES, NULL);
}

/* Over all numbers; NaN if one of them is not finite. */
static double largest(const float *d, size_t n)
{
  double size = 0;
  for (size_t i = 0; i < n; i++)
    size = isfinite(d[i]) ? fmax(size, fabs((double)d[i])) : (double)NAN;
  return size;
}

struct stop {
  uint32_t after, calls;
};

static int count_down(void *context)
{
  struct stop *stop = context;
  return ++stop->calls >= stop->after;
}

struct tensor {
  size_t first, count;
};

/* In file order. */
static void tensors(const struct mo_controller *c, struct tensor *list)
{
  struct tensor *t = list;
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    const size_t rows = l < MO_HIDDEN_LAYERS ? MO_HIDDEN : c->n_springs,
                 width = l == 0 ? c->n_inputs : MO_HIDDEN;
    *t++ = (struct tensor){(size_t)(c->weight[l] - c->parameters), rows * width};
    *t++ = (struct tensor){(size_t)(c->bias[l] - c->parameters), rows};
    if (l == MO_HIDDEN_LAYERS)
      break;
    *t++ = (struct tensor){(size_t)(c->norm_gain[l] - c->parameters), rows};
    *t++ = (struct tensor){(size_t)(c->norm_shift[l] - c->parameters), rows};
  }
}

/* Returns |a − b| / |b| of one tensor. */
static double difference(const float *a, const double *b, struct tensor t)
{
  double error = 0, size = 0;
  for (size_t i = t.first; i < t.first + t.count; i++) {
    error += (a[i] - b[i]) * (a[i] - b[i]);
    size += b[i] * b[i];
  }
  return sqrt(error / size);
}

/* Rollouts with a reference gradient. */
struct comparison {
  const char *name;
  const struct mo_controller *controller;
  const struct mo_robot *robots;
  uint32_t n;
  const struct mo_physics *physics;
  double bound, tolerance;
  int rule; /* enum mo_adjoint_rule */
  /* From the reference. */
  double *d;
  struct mo_outcome outcomes[ROBOTS];
  struct mo_gradient_counts counts;
};

/* Compares each tensor of the block's gradient with the sum of the robots' references. */
static void compare_on(int isa, const struct comparison *c)
{
  const struct mo_gradient_options options = {.adjoint_bound = c->bound,
                                              .weight = 0.25,
                                              .adjoint_rule = (enum mo_adjoint_rule)c->rule,
                                              .restart_weight = MO_RESTART_WEIGHT};
  struct tensor list_of[MO_CONTROLLER_TENSORS];
  struct result fast = plain(c->controller, isa, c->robots, c->n, c->physics, &options);
  CHECK_INT(fast.status, MO_OK);
  for (uint32_t i = 0; i < c->n; i++) {
    CHECK_INT(fast.outcomes[i].diverged_step, c->outcomes[i].diverged_step);
    CHECK_NEAR(fast.outcomes[i].loss, c->outcomes[i].loss, c->tolerance);
  }
  tensors(c->controller, list_of);
  double worst = 0;
  for (int t = 0; t < MO_CONTROLLER_TENSORS; t++) {
    const double error = difference(fast.d, c->d, list_of[t]);
    if (!(error <= c->tolerance))
      printf("# %s, tensor %d: %.3g\n", c->name, t, error);
    CHECK(error <= c->tolerance);
    worst = fmax(worst, error);
  }
  printf("# %-40s %-7s worst tensor's relative error %.2e\n", c->name,
         mo_isa_name((enum mo_isa)isa), worst);
  CHECK_INT(fast.counts.robots, c->counts.robots);
  CHECK_INT(fast.counts.steps, c->counts.steps);
  if (c->rule == MO_ADJOINT_RESTART) {
    CHECK(c->counts.clipped_steps > 0);
    CHECK_INT(fast.counts.clipped_steps, c->counts.clipped_steps);
    CHECK_INT(fast.counts.clipped_robots, c->counts.clipped_robots);
  }
  CHECK_INT(fast.counts.diverged_robots, c->counts.diverged_robots);
  CHECK_INT(fast.counts.zeroed_robots, c->counts.zeroed_robots);
}

/* Runs the test with the instruction sets from `first` on. */
static void compare(enum mo_isa first, struct comparison c)
{
  const struct mo_gradient_options options = {.adjoint_bound = c.bound,
                                              .weight = 0.25,
                                              .adjoint_rule = (enum mo_adjoint_rule)c.rule,
                                              .restart_weight = MO_RESTART_WEIGHT};
  c.d = make_zeros(c.controller->n_parameters, sizeof(double));
  for (uint32_t i = 0; i < c.n; i++)
    REQUIRE(mo_gradient_reference(c.robots[i].body, c.controller, c.robots[i].environment,
                                  c.physics, &options, &c.outcomes[i], c.d, &c.counts) == MO_OK);
  for (int isa = (int)first; isa <= (int)mo_isa_best(); isa++)
    compare_on(isa, &c);
}

static void agrees_on_few_steps(void)
{
  struct mo_physics chunk_and_part = physics_of(13), one_step = physics_of(1),
                    bisection = physics_of(40), forty_steps = physics_of(40), held = physics_of(45),
                    held_for_long = physics_of(13), split = physics_of(13),
                    split_bisection = physics_of(13), split_and_held = physics_of(45);
  held.scheme.control_period_s = 3 * held.scheme.dt_s;
  held_for_long.scheme.control_period_s = 10 * held.scheme.dt_s;
  bisection.scheme.impact = MO_IMPACT_BISECTION;
  split.scheme.integrator = MO_INTEGRATOR_SPLIT;
  split_bisection.scheme = split.scheme;
  split_bisection.scheme.impact = MO_IMPACT_BISECTION;
  split_and_held.scheme = held.scheme;
  split_and_held.scheme.integrator = MO_INTEGRATOR_SPLIT;
  enum { CLIP = MO_ADJOINT_CLIP, RESTART = MO_ADJOINT_RESTART };
  const double bound = MO_ADJOINT_BOUND;
  const struct mo_physics *short_life = &chunk_and_part;
  const struct comparison list[] = {
      {"32 robots, random weights", fresh, robots, ROBOTS, short_life, bound, 2e-4, CLIP},
      {"32 robots, trained", shipped, robots, ROBOTS, short_life, 0, 2e-4, CLIP},
      {"one voxel", fresh, robots, 1, short_life, bound, 2e-4, CLIP},
      {"all voxels", fresh, robots + ROBOTS - 1, 1, short_life, bound, 2e-4, CLIP},
      {"5 robots", shipped, robots + 7, 5, short_life, bound, 2e-4, CLIP},
      {"1 step", fresh, robots, 17, &one_step, bound, 2e-4, CLIP},
      {"bisection", shipped, robots + 3, 4, &bisection, bound, 2e-2, CLIP},
      {"restarts at each step", shipped, robots, ROBOTS, short_life, 0.01, 2e-4, RESTART},
      {"restarts now and then", fresh, robots + 5, 9, short_life, 0.5, 2e-4, RESTART},
      {"restarts, 40 steps", shipped, robots + 3, 4, &forty_steps, 0.7, 2e-3, RESTART},
      {"held outputs, 32 robots", fresh, robots, ROBOTS, &held_for_long, bound, 2e-4, CLIP},
      {"held outputs, 45 steps", shipped, robots + 3, 9, &held, 0, 2e-3, CLIP},
      {"held outputs, restarts", fresh, robots + 3, 4, &held, 0.5, 2e-3, RESTART},
      {"split, 32 robots", shipped, robots, ROBOTS, &split, 0, 2e-4, CLIP},
      {"split, random weights", fresh, robots, 17, &split, bound, 2e-4, CLIP},
      {"split, bisection", shipped, robots + 3, 9, &split_bisection, bound, 2e-3, CLIP},
      {"split, held outputs", shipped, robots + 3, 9, &split_and_held, 0, 2e-3, CLIP}};
  for (size_t i = 0; i < COUNT(list); i++)
    compare(CHECK_SANITIZED && i >= 4 ? mo_isa_best() : MO_ISA_BASELINE, list[i]);
}

#ifndef __SANITIZE_ADDRESS__ /* slow there, and the other cases run the same code */
static double cosine(const float *a, const double *b, size_t n)
{
  double ab = 0, aa = 0, bb = 0;
  for (size_t i = 0; i < n; i++) {
    ab += a[i] * b[i];
    aa += (double)a[i] * a[i];
    bb += b[i] * b[i];
  }
  return ab / sqrt(aa * bb);
}

/* In a longer float32 rollout, masses touch the ground a step earlier or later, and the adjoint
 * then differs. For most robots, and for the batch, the direction stays the same. */
static void agree_over_hundreds(enum mo_integrator integrator)
{
  enum { N = 12, FIRST = 8 };
  struct mo_physics physics = physics_of(200);
  const struct mo_gradient_options options = mo_default_gradient_options();
  const size_t n = shipped->n_parameters;
  physics.scheme.integrator = integrator;
  double *one = make_zeros(n, sizeof(double)), *sum = make_zeros(n, sizeof(double));
  uint32_t alike = 0;
  for (uint32_t i = FIRST; i < FIRST + N; i++) {
    struct mo_outcome outcome;
    memset(one, 0, n * sizeof(double));
    REQUIRE(mo_gradient_reference(robots[i].body, shipped, robots[i].environment, &physics,
                                  &options, &outcome, one, NULL) == MO_OK);
    struct result fast = plain(shipped, mo_isa_best(), robots + i, 1, &physics, &options);
    CHECK_INT(fast.status, MO_OK);
    CHECK_NEAR(fast.outcomes[0].loss, outcome.loss, 1e-3);
    alike += cosine(fast.d, one, n) > 0.9999;
    for (size_t k = 0; k < n; k++)
      sum[k] += one[k];
  }
  struct result fast = plain(shipped, mo_isa_best(), robots + FIRST, N, &physics, &options);
  const double together = cosine(fast.d, sum, n);
  printf("# 200 steps: %u of %d robots agree, the batch: 1 - cosine %.2g\n", alike, N,
         1 - together);
  CHECK(alike >= N * 3 / 4);
  CHECK(together > 0.999);
}

static void agrees_over_hundreds_of_steps(void)
{
  agree_over_hundreds(MO_INTEGRATOR_PAPER);
  agree_over_hundreds(MO_INTEGRATOR_SPLIT);
}
#endif

static bool same_outcome(const struct mo_outcome *a, const struct mo_outcome *b)
{
  return SAME(&a->loss, &b->loss, 1) && a->diverged_step == b->diverged_step &&
         SAME(a->com_start_m, b->com_start_m, 3) && SAME(a->com_end_m, b->com_end_m, 3);
}

static void neighbors_do_not_matter(void)
{
  const struct mo_physics physics = physics_of(60);
  const struct mo_gradient_options options = mo_default_gradient_options();
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct mo_robot reversed[ROBOTS];
    for (uint32_t i = 0; i < ROBOTS; i++)
      reversed[i] = robots[ROBOTS - 1 - i];
    struct result all = plain(shipped, isa, robots, ROBOTS, &physics, &options);
    struct result back = plain(shipped, isa, reversed, ROBOTS, &physics, &options);
    for (uint32_t i = 0; i < ROBOTS; i++) {
      CHECK(same_outcome(all.outcomes + i, back.outcomes + ROBOTS - 1 - i));
      if (i % 7 != 0)
        continue;
      struct result alone = plain(shipped, isa, robots + i, 1, &physics, &options);
      CHECK(same_outcome(all.outcomes + i, alone.outcomes));
    }
  }
}

static bool same_bits(const struct result *a, const struct result *b, uint32_t n,
                      size_t n_parameters)
{
  bool same = SAME(a->d, b->d, n_parameters) && a->counts.steps == b->counts.steps &&
              a->counts.clipped_steps == b->counts.clipped_steps &&
              a->counts.clipped_robots == b->counts.clipped_robots &&
              SAME(&a->counts.largest, &b->counts.largest, 1);
  for (uint32_t i = 0; i < n; i++)
    same = same && same_outcome(a->outcomes + i, b->outcomes + i);
  return same;
}

static void budgets_do_not_matter(void)
{
  static const size_t budgets[] = {0, 600000, 1500000, 4000000};
  const struct mo_gradient_options options = {.adjoint_bound = 1e-3, .weight = 1};
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (uint32_t n_steps = 30; n_steps <= 171; n_steps += 47) {
      struct mo_physics physics = physics_of(n_steps);
      if (n_steps > 77) /* a period divides neither the rollout nor a segment without it */
        physics.scheme.control_period_s = 3 * physics.scheme.dt_s;
      if (n_steps % 2 != 0) /* 77 and 171 steps */
        physics.scheme.integrator = MO_INTEGRATOR_SPLIT;
      /* A pause after every step, forwards, backwards and again. */
      struct stop whole_stop = {.after = UINT32_MAX};
      struct mo_pause_point pause = {1, count_down, &whole_stop};
      struct result whole = block(shipped, isa, robots + 20, 9, &physics, &options,
                                  MO_GRADIENT_DEFAULT_BYTES, &pause);
      CHECK_INT(whole_stop.calls, 2 * n_steps);
      CHECK(whole.counts.clipped_steps > 0);
      for (size_t k = 0; k < COUNT(budgets); k++) {
        struct stop part_stop = {.after = UINT32_MAX};
        pause.context = &part_stop;
        struct result part =
            block(shipped, isa, robots + 20, 9, &physics, &options, budgets[k], &pause);
        CHECK(same_bits(&whole, &part, 9, shipped->n_parameters));
        CHECK(part_stop.calls > 2 * n_steps || budgets[k] > 2000000);
      }
    }
}

/* A period of one step counts as no period. */
static void periods_of_a_step_change_nothing(void)
{
  struct mo_physics physics = physics_of(40);
  const struct mo_gradient_options options = mo_default_gradient_options();
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    physics.scheme.control_period_s = 0;
    struct result absent = plain(shipped, isa, robots + 20, 9, &physics, &options);
    physics.scheme.control_period_s = physics.scheme.dt_s;
    struct result step = plain(shipped, isa, robots + 20, 9, &physics, &options);
    physics.scheme.control_period_s = 4 * physics.scheme.dt_s;
    struct result held = plain(shipped, isa, robots + 20, 9, &physics, &options);
    CHECK(same_bits(&absent, &step, 9, shipped->n_parameters));
    CHECK(!same_bits(&absent, &held, 9, shipped->n_parameters));
    physics.scheme.control_period_s = 1.5 * physics.scheme.dt_s;
    CHECK_INT(plain(shipped, isa, robots + 20, 9, &physics, &options).status, MO_ERR_INVALID);
  }
}

static void budgets_are_kept(void)
{
  struct mo_physics physics = physics_of(1000);
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_outcome outcomes[ROBOTS];
  float *d = make_zeros(shipped->n_parameters, sizeof(float));
  struct mo_robot large[ROBOTS];
  for (uint32_t i = 0; i < ROBOTS; i++)
    large[i] = (struct mo_robot){robots[ROBOTS - 1].body, environments + i};
  struct mo_pack *pack = make_gradient_pack(shipped, mo_isa_best());
  struct mo_gradient_memory *memory = make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES);
  /* The largest bodies, stopped once the tape has been laid out. */
  struct stop stop = {.after = 1};
  const struct mo_pause_point pause = {.interval = 1, .reached = count_down, .context = &stop};
  CHECK_INT(
      mo_gradient_block(memory, pack, large, ROBOTS, &physics, &options, &pause, outcomes, d, NULL),
      MO_ERR_CANCELLED);
  printf("# 32 robots of 144 voxels, 1000 steps: %.1f MiB\n",
         (double)mo_gradient_memory_bytes(memory) / (1 << 20));
  CHECK(mo_gradient_memory_bytes(memory) > MO_GRADIENT_DEFAULT_BYTES / 2);
  CHECK(mo_gradient_memory_bytes(memory) < MO_GRADIENT_DEFAULT_BYTES + ((size_t)32 << 20));
  /* A tape has whole chunks of control periods, of any number of steps. */
  physics = physics_of(100000);
  physics.scheme.control_period_s = MO_GRADIENT_PERIOD_MAX * physics.scheme.dt_s;
  stop.calls = 0;
  CHECK_INT(
      mo_gradient_block(memory, pack, large, ROBOTS, &physics, &options, &pause, outcomes, d, NULL),
      MO_ERR_CANCELLED);
  CHECK(mo_gradient_memory_bytes(memory) < MO_GRADIENT_DEFAULT_BYTES + ((size_t)32 << 20));
  physics.scheme.control_period_s += physics.scheme.dt_s;
  CHECK_INT(
      mo_gradient_block(memory, pack, large, ROBOTS, &physics, &options, &pause, outcomes, d, NULL),
      MO_ERR_INVALID);
}

/* With springs 2.5 times as stiff as usual, a single voxel is stable, and everything larger blows
 * up. */
static void diverged_robots_contribute_nothing(void)
{
  enum { N = 10 };
  struct mo_physics physics = physics_of(50);
  physics.constants.stiffness_n_per_m *= 2.5;
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_robot list[2][N];
  for (uint32_t i = 0; i < N; i++)
    for (uint32_t k = 0; k < 2; k++) /* every other robot diverges, each in another environment */
      list[k][i] = (struct mo_robot){robots[i % 2 == 0 ? 0 : 12 + i].body,
                                     environments + i + (i % 2 == 0 ? 0 : N * k)};
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct result a = plain(shipped, isa, list[0], N, &physics, &options);
    struct result b = block(shipped, isa, list[1], N, &physics, &options, 100000, NULL);
    CHECK_INT(a.counts.diverged_robots, N / 2);
    CHECK_INT(b.counts.diverged_robots, N / 2);
    CHECK_INT(a.counts.steps, N / 2 * physics.scheme.n_steps);
    CHECK_INT(a.counts.zeroed_robots, 0);
    bool other = false;
    for (uint32_t i = 0; i < N; i++) {
      CHECK((a.outcomes[i].diverged_step > 0) == (i % 2 == 1));
      CHECK(i % 2 == 0 || (isinf(a.outcomes[i].loss) && isfinite(a.outcomes[i].com_end_m[0])));
      other |= a.outcomes[i].diverged_step != b.outcomes[i].diverged_step;
    }
    CHECK(other);
    CHECK(largest(a.d, shipped->n_parameters) > 0);
    CHECK(SAME(a.d, b.d, shipped->n_parameters));
    struct result none = plain(shipped, isa, robots + 12, N, &physics, &options);
    CHECK_INT(none.counts.diverged_robots, N);
    CHECK_INT(none.counts.steps, 0);
    CHECK(largest(none.d, shipped->n_parameters) == 0);
  }
}

/* One body in several environments. Without a bound, its adjoint grows to 1e8 and more in one or
 * two of them, and at most to a few hundred in others; any changed bit of the rollout may change
 * which ones. */
enum { CANDIDATES = 8 };
static const uint32_t candidates[CANDIDATES] = {26, 18, 0, 1, 7, 23, 25, 29};

struct explosion {
  struct mo_robot all[CANDIDATES], calm[CANDIDATES];
  uint32_t n_all, n_calm;
  double largest;
};

/* The environment with the largest adjoint, among the calm ones. */
static struct explosion find_explosion(enum mo_isa isa)
{
  const struct mo_physics physics = physics_of(1000);
  const struct mo_gradient_options options = {.adjoint_bound = 0, .weight = 1};
  struct explosion e = {0};
  struct mo_robot worst = {0};
  for (uint32_t i = 0; i < CANDIDATES; i++) {
    const struct mo_robot robot = {robots[27].body, environments + candidates[i]};
    struct result r = plain(shipped, isa, &robot, 1, &physics, &options);
    if (r.counts.largest < 300 && e.n_calm < 3)
      e.calm[e.n_calm++] = robot;
    if (r.counts.largest > e.largest) {
      e.largest = r.counts.largest;
      worst = robot;
    }
  }
  for (uint32_t i = 0; i < e.n_calm; i++) {
    if (i == 1)
      e.all[e.n_all++] = worst;
    e.all[e.n_all++] = e.calm[i];
  }
  printf("# %s: explodes to %.2g, %u are calm\n", mo_isa_name(isa), e.largest, e.n_calm);
  return e;
}

/* Checks that the block with the exploding robot has the same gradient as the block without it, to
 * the bit. */
static void explosion_is_zeroed(const struct explosion *e, const struct mo_controller *controller,
                                enum mo_isa isa, double weight)
{
  const struct mo_physics physics = physics_of(1000);
  const struct mo_gradient_options options = {.adjoint_bound = 0, .weight = weight};
  struct result a = plain(controller, isa, e->all, e->n_all, &physics, &options);
  struct result b = block(controller, isa, e->calm, e->n_calm, &physics, &options, 20000000, NULL);
  CHECK_INT(a.counts.zeroed_robots, 1);
  CHECK_INT(b.counts.zeroed_robots, 0);
  CHECK_INT(a.counts.robots, e->n_all);
  CHECK(a.counts.steps > e->n_calm * physics.scheme.n_steps);
  CHECK_INT(b.counts.steps, e->n_calm * physics.scheme.n_steps);
  CHECK(largest(b.d, controller->n_parameters) > 0);
  CHECK(SAME(a.d, b.d, controller->n_parameters));
  for (uint32_t i = 0; i < e->n_all; i++)
    CHECK(isfinite(a.outcomes[i].loss));
}

/* Returns the shipped controller with the last layer's weights times 2^exponent and its inputs
 * divided by 2^exponent: the same rollouts to the bit, but with larger intermediate numbers in the
 * backward pass. */
static struct mo_controller *steep(int exponent)
{
  struct mo_controller *controller = make_controller(MO_DEFAULT_WORKSPACE, shipped->sensor);
  memcpy(controller->parameters, shipped->parameters, shipped->n_parameters * sizeof(float));
  float *last = controller->weight[MO_HIDDEN_LAYERS];
  for (size_t i = 0; i < (size_t)controller->n_springs * MO_HIDDEN; i++)
    last[i] = ldexpf(last[i], exponent);
  float *gain = controller->norm_gain[MO_HIDDEN_LAYERS - 1],
        *shift = controller->norm_shift[MO_HIDDEN_LAYERS - 1];
  for (int i = 0; i < MO_HIDDEN; i++) {
    gain[i] = ldexpf(gain[i], -exponent);
    shift[i] = ldexpf(shift[i], -exponent);
  }
  return controller;
}

/* First an adjoint exceeds float32's range; then every adjoint is in range, but the gradient times
 * the weight is not. */
static void explosions_are_zeroed(void)
{
  for (int isa = CHECK_SANITIZED ? (int)mo_isa_best() : 0; isa <= (int)mo_isa_best(); isa++) {
    const struct explosion e = find_explosion((enum mo_isa)isa);
    REQUIRE(e.largest > 1e9 && e.n_calm >= 2);
    explosion_is_zeroed(&e, steep(ilogb((double)FLT_MAX / (e.largest / 1e4))), (enum mo_isa)isa, 1);
    explosion_is_zeroed(&e, shipped, (enum mo_isa)isa, (double)FLT_MAX / (e.largest / 1e4));
  }
}

/* A weight so large that every gradient overflows. */
static void gradients_out_of_range_are_zeroed(void)
{
  const struct mo_physics physics = physics_of(60); /* all of them have touched the ground */
  const struct mo_gradient_options options = {.adjoint_bound = MO_ADJOINT_BOUND, .weight = 1e300};
  struct result none = plain(fresh, mo_isa_best(), robots, 12, &physics, &options);
  CHECK_INT(none.counts.zeroed_robots, 12);
  CHECK(largest(none.d, fresh->n_parameters) == 0);
}

static void pauses_and_ends(void)
{
  enum { N = 3 };
  const struct mo_physics physics = physics_of(50);
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_outcome outcomes[N];
  struct mo_gradient_counts counts = {0};
  float *d[2] = {make_zeros(shipped->n_parameters, sizeof(float)),
                 make_zeros(shipped->n_parameters, sizeof(float))};
  struct mo_pack *pack = make_gradient_pack(shipped, mo_isa_best());
  struct mo_gradient_memory *memory = make_gradient_memory(1000000);
  struct stop stop = {.after = UINT32_MAX};
  struct mo_pause_point pause = {.interval = 7, .reached = count_down, .context = &stop};
  CHECK_INT(mo_gradient_block(memory, pack, robots, N, &physics, &options, &pause, outcomes, d[0],
                              &counts),
            MO_OK);
  const uint32_t calls = stop.calls;
  CHECK(calls >=
        2 * physics.scheme.n_steps / pause.interval); /* forward and backward, and segments again */
  for (uint32_t after = 1; after <= calls; after += 3) {
    stop = (struct stop){.after = after};
    counts = (struct mo_gradient_counts){0};
    CHECK_INT(mo_gradient_block(memory, pack, robots, N, &physics, &options, &pause, outcomes, d[1],
                                &counts),
              MO_ERR_CANCELLED);
    CHECK_INT(stop.calls, after);
    CHECK_INT(counts.robots, 0);
  }
  stop = (struct stop){.after = UINT32_MAX};
  pause.interval = 0; /* never */
  CHECK_INT(mo_gradient_block(memory, pack, robots, N, &physics, &options, &pause, outcomes, d[1],
                              &counts),
            MO_OK);
  CHECK_INT(stop.calls, 0);
  CHECK(SAME(d[0], d[1], shipped->n_parameters));
}

static void packs_can_be_updated(void)
{
  const struct mo_physics physics = physics_of(20);
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_pack *pack =
      make_gradient_pack(make_random_controller(shipped->sensor, 99), mo_isa_best());
  struct mo_gradient_memory *memory = make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES);
  struct mo_outcome outcomes[ROBOTS];
  float *d = make_zeros(shipped->n_parameters, sizeof(float));
  CHECK_INT(mo_pack_update(pack, shipped), MO_OK);
  /* The memory was used for other blocks before. */
  for (uint32_t n = 1; n <= ROBOTS; n += 9)
    CHECK_INT(
        mo_gradient_block(memory, pack, robots, n, &physics, &options, NULL, outcomes, d, NULL),
        MO_OK);
  struct result again = plain(shipped, mo_isa_best(), robots, 28, &physics, &options);
  CHECK(SAME(d, again.d, shipped->n_parameters));
}

static void faults_are_refused(void)
{
  const struct mo_physics physics = physics_of(20);
  const struct mo_controller *other =
      make_controller((struct mo_workspace){6, 6, 3}, shipped->sensor);
  struct mo_pack *pack = make_gradient_pack(shipped, mo_isa_best());
  struct mo_gradient_memory *memory = make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES);
  struct mo_outcome outcomes[ROBOTS];
  float *d = make_zeros(shipped->n_parameters, sizeof(float));
  CHECK_INT(mo_pack_update(pack, fresh), MO_ERR_UNSUPPORTED); /* another sensor */
  CHECK_INT(mo_pack_update(pack, other), MO_ERR_UNSUPPORTED);
  const struct {
    const struct mo_pack *pack;
    uint32_t n;
    struct mo_gradient_options options;
  } bad[] = {{pack, 0, mo_default_gradient_options()},
             {pack, ROBOTS + 1, mo_default_gradient_options()},
             {pack, 1, {-1, 1}},
             {pack, 1, {(double)NAN, 1}},
             {pack, 1, {2, (double)INFINITY}},
             {make_gradient_pack(other, mo_isa_best()), 1, mo_default_gradient_options()}};
  for (size_t i = 0; i < COUNT(bad); i++)
    CHECK_INT(mo_gradient_block(memory, bad[i].pack, robots, bad[i].n, &physics, &bad[i].options,
                                NULL, outcomes, d, NULL),
              MO_ERR_INVALID);
  CHECK_INT(mo_pack_create_for_gradients(shipped, MO_ISA_COUNT, &pack), MO_ERR_INVALID);
  mo_pack_free(NULL);
  mo_gradient_memory_free(NULL);
}

/* 46,000 springs and 4913 masses: more than the windows in which tiles are made. */
static void large_bodies(void)
{
  const struct mo_workspace workspace = {16, 16, 16};
  const struct mo_lattice *large = make_lattice(workspace);
  struct mo_controller *controller = make_controller(workspace, MO_SENSOR_INVERSE_SQRT);
  uint64_t bits[64] = {0};
  for (uint32_t v = 0; v < 4096; v += 16) /* a plate with a post */
    bits[v >> 6] |= UINT64_C(1) << (v & 63);
  bits[32] |= 0xff;
  mo_controller_randomize(controller, 3);
  const struct mo_robot list[] = {{make_full_body(large), environments},
                                  {make_body(large, bits), environments + 1}};
  const struct mo_physics physics = physics_of(5);
  compare(mo_isa_best(), (struct comparison){"large bodies", controller, list, 2, &physics,
                                             MO_ADJOINT_BOUND, 2e-4, .d = NULL});
}

static void arrangement(void)
{
  uint32_t order[ROBOTS], seen = 0;
  CHECK_INT(mo_gradient_arrange(robots, ROBOTS, order), MO_OK);
  for (uint32_t i = 0; i < ROBOTS; i++) {
    seen |= UINT32_C(1) << order[i];
    CHECK(i == 0 || robots[order[i]].body->n_springs <= robots[order[i - 1]].body->n_springs);
  }
  CHECK(seen == UINT32_MAX);
  CHECK_INT(order[0], ROBOTS - 1);
  CHECK_INT(mo_gradient_arrange(robots, 0, order), MO_OK);
}

static const struct check_case cases[] = {
    {"a few steps agree with the reference, tensor by tensor", agrees_on_few_steps},
#ifndef __SANITIZE_ADDRESS__
    {"hundreds of steps agree in direction", agrees_over_hundreds_of_steps},
#endif
    {"neighbors do not change an outcome", neighbors_do_not_matter},
    {"budgets do not change a bit", budgets_do_not_matter},
    {"periods of a step change nothing", periods_of_a_step_change_nothing},
    {"budgets are kept", budgets_are_kept},
    {"diverged robots contribute nothing", diverged_robots_contribute_nothing},
    {"explosions are zeroed", explosions_are_zeroed},
    {"gradients out of range are zeroed", gradients_out_of_range_are_zeroed},
    {"pauses and cancellation", pauses_and_ends},
    {"packs can be updated", packs_can_be_updated},
    {"invalid arguments are refused", faults_are_refused},
    {"large bodies", large_bodies},
    {"arrangement", arrangement},
};
CHECK_MAIN_WITH(setup, cases)
