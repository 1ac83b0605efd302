/* figures.c: scores, changes, ranks and regret by hand, and the coverage of intervals of means. */
#include "fixture.h"

#include "certificate/statistics.h"

enum { TRIALS_MAX = 8, DESIGNS_MAX = 32 };

/* Trials, their losses and figures. */
struct made {
  struct mo_certificate_settings settings;
  struct mo_trial trials[TRIALS_MAX];
  const float *losses[TRIALS_MAX];
  struct mo_trial_score scores[TRIALS_MAX * DESIGNS_MAX];
  struct mo_trial_list lists[TRIALS_MAX];
  uint32_t n_trials, n_designs;
};

static void add_trial(struct made *made, enum mo_axis axis, uint32_t n, const float *losses)
{
  made->losses[made->n_trials] = losses;
  made->trials[made->n_trials++] = (struct mo_trial){
      .axis = axis, .level = NAN, .n_environments = n, .is_paired = axis != MO_AXIS_HELD_OUT};
}

static void compute(struct made *made, uint32_t n_designs)
{
  made->n_designs = n_designs;
  make_check(mo_certificate_figures(&made->settings, made->trials, made->n_trials, made->losses,
                                    n_designs, made->scores, made->lists),
             "figures");
}

static const struct mo_trial_score *score_of(const struct made *made, uint32_t t, uint32_t design)
{
  return &made->scores[t * made->n_designs + design];
}

/* Checks an interval by its middle and half width. */
#define CHECK_INTERVAL(interval, middle, half)                                                     \
  do {                                                                                             \
    CHECK_NEAR(((interval).lo + (interval).hi) / 2, middle, 1e-7);                                 \
    CHECK_NEAR(((interval).hi - (interval).lo) / 2, half, 1e-6);                                   \
  } while (0)

/* ---- statistics ---- */

/* From scipy.stats.t.ppf(0.975, …). */
static void student(void)
{
  CHECK_NEAR(mo_student_t(1), 12.706204736174705, 1e-9);
  CHECK_NEAR(mo_student_t(2), 4.302652729749464, 1e-9);
  CHECK_NEAR(mo_student_t(9), 2.2621571627982053, 1e-9);
  CHECK_NEAR(mo_student_t(10), 2.2281388519862744, 1e-9);
  CHECK_NEAR(mo_student_t(11), 2.200985160091640, 1e-5);
  CHECK_NEAR(mo_student_t(30), 2.0422724563012378, 1e-7);
  CHECK_NEAR(mo_student_t(255), 1.9693105698498763, 1e-7);
  for (uint32_t n = 1; n < 2000; n++)
    CHECK(mo_student_t(n + 1) < mo_student_t(n));
  CHECK_NEAR(mo_student_t(UINT32_MAX), 1.959963984540054, 1e-9);
}

static void sums(void)
{
  double *values = make_zeros(1 << 20, sizeof(double));
  for (int k = 0; k < 1 << 20; k++)
    values[k] = 0.1;
  CHECK_NEAR(mo_pairwise_sum(values, 1 << 20), 104857.6, 1e-10);
  CHECK(mo_pairwise_sum(values, 3) == 0.1 + 0.1 + 0.1 && mo_pairwise_sum(values, 0) == 0);
}

/* ---- figures by hand ---- */

static void paired(void)
{
  static const float base[] = {1, 2, 3, 4}, here[] = {2, 2, 4, 8};
  struct made made = {.settings = mo_certificate_defaults()};
  add_trial(&made, MO_AXIS_BASE, 4, base);
  add_trial(&made, MO_AXIS_FRICTION, 4, here);
  compute(&made, 1);
  /* Standard deviations: sqrt(5/3), sqrt(8), and sqrt(3) of the differences 1, 0, 1, 4. */
  const double t = 3.182446305284263;
  CHECK(score_of(&made, 0, 0)->score == 2.5 && score_of(&made, 1, 0)->score == 4);
  CHECK_INTERVAL(score_of(&made, 0, 0)->interval, 2.5, t * sqrt(5.0 / 3 / 4));
  CHECK_INTERVAL(score_of(&made, 1, 0)->interval, 4, t * sqrt(8.0 / 4));
  CHECK(score_of(&made, 1, 0)->change == 1.5);
  CHECK_INTERVAL(score_of(&made, 1, 0)->of_change, 1.5, t * sqrt(3.0 / 4));
  CHECK(isnan(score_of(&made, 0, 0)->change) && isnan(score_of(&made, 0, 0)->of_change.lo));
  CHECK(score_of(&made, 1, 0)->rank == 1);
}

/* Variances 5/3 and 2.5, of means 5/12 and 0.5; 6.99 degrees of freedom are 6. */
static void unpaired(void)
{
  static const float base[] = {1, 2, 3, 4}, here[] = {2, 3, 4, 5, 6};
  struct made made = {.settings = mo_certificate_defaults()};
  add_trial(&made, MO_AXIS_BASE, 4, base);
  add_trial(&made, MO_AXIS_HELD_OUT, 5, here);
  compute(&made, 1);
  CHECK(score_of(&made, 1, 0)->change == 1.5);
  CHECK_INTERVAL(score_of(&made, 1, 0)->of_change, 1.5, 2.4469118511449692 * sqrt(11.0 / 12));
}

/* The base's two worlds in turn: units (1, 5, 3) − 2.8 and (2, 3) − 2.8. */
static void in_turn(void)
{
  static const float base[] = {1, 2}, here[] = {1, 2, 5, 3, 3};
  struct made made = {.settings = mo_certificate_defaults()};
  add_trial(&made, MO_AXIS_BASE, 2, base);
  add_trial(&made, MO_AXIS_WORLDS, 5, here);
  compute(&made, 1);
  const double variance = 2.0 / 1 * (0.6 * 0.6 + 0.6 * 0.6) / 25;
  CHECK_NEAR(score_of(&made, 1, 0)->score, 2.8, 1e-15);
  CHECK_INTERVAL(score_of(&made, 1, 0)->interval, 2.8, 12.706204736174705 * sqrt(variance));
  /* Differences 0, 0, 4, 1, 2 with the mean 1.4: units 6 − 4.2 and 1 − 2.8. */
  CHECK_NEAR(score_of(&made, 1, 0)->change, 1.4, 1e-15);
  CHECK_INTERVAL(score_of(&made, 1, 0)->of_change, 1.4,
                 12.706204736174705 * sqrt(2.0 * (1.8 * 1.8 * 2) / 25));
}

static void one_world(void)
{
  static const float base[] = {1}, here[] = {2}, drawn[] = {1, 2, 3, 4};
  struct made made = {.settings = mo_certificate_defaults()};
  add_trial(&made, MO_AXIS_BASE, 1, base);
  add_trial(&made, MO_AXIS_DRAG, 1, here);
  add_trial(&made, MO_AXIS_HELD_OUT, 4, drawn);
  add_trial(&made, MO_AXIS_WORLDS, 4, drawn);
  compute(&made, 1);
  CHECK(isnan(score_of(&made, 0, 0)->interval.lo) && isnan(score_of(&made, 1, 0)->interval.lo));
  CHECK(score_of(&made, 1, 0)->change == 1 && isnan(score_of(&made, 1, 0)->of_change.hi));
  CHECK(score_of(&made, 2, 0)->change == 1.5 && isnan(score_of(&made, 2, 0)->of_change.lo));
  CHECK_INTERVAL(score_of(&made, 2, 0)->interval, 2.5, 3.182446305284263 * sqrt(5.0 / 3 / 4));
  CHECK_INTERVAL(score_of(&made, 3, 0)->of_change, 1.5, 3.182446305284263 * sqrt(5.0 / 3 / 4));
}

/* Three copies with the scores 1, 2 and 6: one more lies within 3 ± t · sqrt(7 · 4/3). */
static void copies(void)
{
  static const float base[] = {1, 2}, here[] = {0, 2, 1, 3, 5, 7};
  struct made made = {.settings = mo_certificate_defaults()};
  add_trial(&made, MO_AXIS_BASE, 2, base);
  add_trial(&made, MO_AXIS_CHANCE, 6, here);
  compute(&made, 1);
  CHECK(score_of(&made, 1, 0)->score == 3 && score_of(&made, 1, 0)->change == 1.5);
  const double half = 4.302652729749464 * sqrt(7 * 4.0 / 3);
  CHECK_INTERVAL(score_of(&made, 1, 0)->interval, 3, half);
  CHECK_INTERVAL(score_of(&made, 1, 0)->of_change, 1.5, half);
}

static void lists(void)
{
  const float inf = INFINITY;
  /* five designs, two worlds */
  const float base[] = {1, 1, 2, 2, 3, 3, 4, 4, inf, 1};
  const float here[] = {3, 3, 1, 1, 2, inf, 4, 4, 0, 0};
  const float worse[] = {inf, 1, 1, 1, 5, 5, 5, 5, 6, 6};
  struct made made = {.settings = mo_certificate_defaults()};
  made.settings.top = 2;
  add_trial(&made, MO_AXIS_BASE, 2, base);
  add_trial(&made, MO_AXIS_MASS, 2, here);
  add_trial(&made, MO_AXIS_DRAG, 2, worse);
  compute(&made, 5);
  CHECK(made.lists[0].mean_score == 2.5 && made.lists[0].n_diverged_designs == 1);
  CHECK(made.lists[0].top_score == 1.5 && isnan(made.lists[0].tau) && isnan(made.lists[0].regret));
  CHECK(score_of(&made, 0, 4)->rank == 5 && score_of(&made, 0, 4)->diverged == 1 &&
        isnan(score_of(&made, 0, 4)->score) && isnan(score_of(&made, 0, 4)->interval.lo));
  /* Scores 3, 1, unknown, 4, 0. Tau of (1, 3), (2, 1), (4, 4): one of three pairs disagrees. */
  CHECK(made.lists[1].mean_score == 2 && made.lists[1].n_diverged_designs == 1);
  CHECK_NEAR(made.lists[1].tau, 1.0 / 3, 1e-15);
  CHECK(isnan(made.lists[1].of_tau.lo)); /* of three designs */
  CHECK(made.lists[1].top_score == 2 && made.lists[1].regret == 2 - 0.5);
  const uint32_t ranks[] = {3, 2, 5, 4, 1};
  for (uint32_t i = 0; i < 5; i++)
    CHECK_INT(score_of(&made, 1, i)->rank, ranks[i]);
  CHECK(isnan(score_of(&made, 1, 4)->change) && score_of(&made, 1, 4)->score == 0 &&
        !isnan(score_of(&made, 1, 4)->interval.lo));
  /* The best of the base diverged. Designs 2 and 3 share a rank. */
  CHECK(isnan(made.lists[2].top_score) && isnan(made.lists[2].regret));
  CHECK(score_of(&made, 2, 2)->rank == 2 && score_of(&made, 2, 3)->rank == 2 &&
        score_of(&made, 2, 4)->rank == 4 && score_of(&made, 2, 0)->rank == 5);
  CHECK_NEAR(made.lists[2].tau, 2 / sqrt(6), 1e-15);
}

/* Means over copies: tau 1 and 0, regret 0 and 1, and not those of the mean scores. */
static void lists_of_copies(void)
{
  static const float base[] = {1, 2, 3, 4}, here[] = {1, 2, 2, 1, 3, 4, 4, 3};
  struct made made = {.settings = mo_certificate_defaults()};
  add_trial(&made, MO_AXIS_BASE, 1, base);
  add_trial(&made, MO_AXIS_CHANCE, 2, here);
  compute(&made, 4);
  CHECK_NEAR(made.lists[1].tau, (1 + 1.0 / 3) / 2, 1e-15);
  CHECK(made.lists[1].top_score == 1.5 && made.lists[1].regret == 0.5);
}

static void tops(void)
{
  struct mo_certificate_settings settings = mo_certificate_defaults();
  static const uint32_t expected[][2] = {{1, 1}, {9, 1}, {19, 1}, {20, 2}, {256, 25}};
  for (size_t i = 0; i < COUNT(expected); i++)
    CHECK_INT(mo_certificate_top(&settings, expected[i][0]), expected[i][1]);
  settings.top = 7;
  CHECK(mo_certificate_top(&settings, 5) == 5 && mo_certificate_top(&settings, 50) == 7);
}

static void all_diverged(void)
{
  const float base[] = {INFINITY, INFINITY}, here[] = {1, 2};
  struct made made = {.settings = mo_certificate_defaults()};
  add_trial(&made, MO_AXIS_BASE, 1, base);
  add_trial(&made, MO_AXIS_MASS, 1, here);
  compute(&made, 2);
  CHECK(isnan(made.lists[0].mean_score) && isnan(made.lists[0].top_score));
  CHECK(isnan(made.lists[1].tau) && isnan(made.lists[1].of_tau.lo) && isnan(made.lists[1].regret) &&
        made.lists[1].mean_score == 1.5);
  CHECK(score_of(&made, 0, 0)->rank == 1 && score_of(&made, 0, 1)->rank == 1);
}

/* ---- coverage ---- */

/* Rollouts of one body in fresh worlds: losses of a pool of worlds, the mean of which the intervals
 * of small samples of it should contain. */
enum { POOL = CHECK_SANITIZED ? 256 : 2048 };
static void roll(float losses[POOL])
{
  const struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  const struct mo_controller *controller = make_shipped_controller("phototaxis");
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  const struct mo_robot *robots = make_robots(lattice, 5, 1, 1);
  struct mo_workspace_memory *memory = make_workspace_memory();
  struct mo_environment *worlds = make_zeros(POOL, sizeof(*worlds));
  const struct mo_physics physics = physics_of(500);
  for (uint32_t first = 0; first < POOL; first += MO_BLOCK_LANES) {
    const struct mo_environment *block[MO_BLOCK_LANES];
    struct mo_outcome outcomes[MO_BLOCK_LANES];
    for (uint32_t k = 0; k < MO_BLOCK_LANES; k++) {
      mo_environment_held_out(1, first + k, &worlds[first + k]);
      block[k] = &worlds[first + k];
    }
    make_check(mo_rollout_block(memory, pack, robots[0].body, block, MO_BLOCK_LANES, &physics, NULL,
                                NULL, NULL, outcomes),
               "rollouts");
    for (uint32_t k = 0; k < MO_BLOCK_LANES; k++)
      losses[first + k] = (float)outcomes[k].loss;
  }
}

static void coverage_of_rollouts(void)
{
  enum { N = 10, FRESH = 64, REPEATS = 2000 };
  float *losses = make_zeros(POOL, sizeof(float)), few[N], fresh[FRESH];
  double mean = 0;
  uint32_t hits = 0, of_change = 0;
  roll(losses);
  for (uint32_t k = 0; k < POOL; k++)
    mean += (double)losses[k] / POOL;
  for (uint32_t r = 0; r < REPEATS; r++) {
    struct mo_random random = dice(86, 0, r);
    struct made made = {.settings = mo_certificate_defaults()};
    for (uint32_t k = 0; k < N; k++)
      few[k] = losses[mo_random_below(&random, POOL)];
    for (uint32_t k = 0; k < FRESH; k++)
      fresh[k] = losses[mo_random_below(&random, POOL)];
    add_trial(&made, MO_AXIS_BASE, N, few);
    add_trial(&made, MO_AXIS_HELD_OUT, FRESH, fresh);
    compute(&made, 1);
    const struct mo_interval interval = score_of(&made, 1, 0)->interval;
    const struct mo_interval change = score_of(&made, 1, 0)->of_change;
    hits += interval.lo <= mean && mean <= interval.hi;
    of_change += change.lo <= 0 && 0 <= change.hi;
  }
  printf("# rollouts: mean loss %g, coverage of means %g, of changes %g\n", mean,
         (double)hits / REPEATS, (double)of_change / REPEATS);
  CHECK(hits >= 0.92 * REPEATS && of_change >= 0.9 * REPEATS);
  CHECK(hits <= 0.98 * REPEATS && of_change <= 0.99 * REPEATS);
}

/* Losses with an effect of the world, one of the constants and one of both together. The change
 * from the base has the mean 0.3; intervals that take each of the 64 worlds as independent would be
 * too narrow where the effect of the constants depends on the world. */
static void coverage_of_worlds(void)
{
  enum { N = 10, WORLDS = 64, REPEATS = 2000 };
  uint32_t of_score = 0, of_change = 0, too_narrow = 0;
  for (uint32_t r = 0; r < REPEATS; r++) {
    struct mo_random random = dice(84, 0, r);
    struct made made = {.settings = mo_certificate_defaults()};
    float base[N], here[WORLDS];
    double tendency[N], differences[WORLDS], scratch[WORLDS];
    for (uint32_t k = 0; k < N; k++) {
      base[k] = (float)(1 + 0.2 * mo_random_normal(&random));
      tendency[k] = 0.3 + 0.1 * mo_random_normal(&random);
    }
    for (uint32_t k = 0; k < WORLDS; k++) {
      here[k] = base[k % N] + (float)(tendency[k % N] + 0.1 * mo_random_normal(&random));
      differences[k] = (double)here[k] - (double)base[k % N];
    }
    add_trial(&made, MO_AXIS_BASE, N, base);
    add_trial(&made, MO_AXIS_WORLDS, WORLDS, here);
    compute(&made, 1);
    const struct mo_trial_score *score = score_of(&made, 1, 0);
    const struct mo_mean each = mo_mean_of_units(differences, WORLDS, WORLDS, scratch);
    const struct mo_interval narrow = mo_mean_interval(&each, 1);
    of_score += score->interval.lo <= 1.3 && 1.3 <= score->interval.hi;
    of_change += score->of_change.lo <= 0.3 && 0.3 <= score->of_change.hi;
    too_narrow += narrow.lo <= 0.3 && 0.3 <= narrow.hi;
  }
  printf("# worlds in turn: coverage of scores %g, of changes %g; as if independent %g\n",
         (double)of_score / REPEATS, (double)of_change / REPEATS, (double)too_narrow / REPEATS);
  CHECK(of_score >= 0.93 * REPEATS && of_change >= 0.93 * REPEATS);
  CHECK(of_score <= 0.97 * REPEATS && of_change <= 0.97 * REPEATS);
  CHECK(too_narrow < 0.8 * REPEATS);
}

/* One more copy lies within the interval of `chance`. */
static void coverage_of_copies(void)
{
  enum { COPIES = 16, REPEATS = 2000 };
  uint32_t hits = 0;
  for (uint32_t r = 0; r < REPEATS; r++) {
    struct mo_random random = dice(85, 0, r);
    struct made made = {.settings = mo_certificate_defaults()};
    float base[1] = {1}, here[COPIES];
    for (uint32_t k = 0; k < COPIES; k++)
      here[k] = (float)(1 + 0.1 * mo_random_normal(&random));
    add_trial(&made, MO_AXIS_BASE, 1, base);
    add_trial(&made, MO_AXIS_CHANCE, COPIES, here);
    compute(&made, 1);
    const double next = 1 + 0.1 * mo_random_normal(&random);
    hits +=
        score_of(&made, 1, 0)->interval.lo <= next && next <= score_of(&made, 1, 0)->interval.hi;
  }
  printf("# chance: coverage %g\n", (double)hits / REPEATS);
  CHECK(hits >= 0.93 * REPEATS && hits <= 0.97 * REPEATS);
}

static const struct check_case cases[] = {
    {"Student's t", student},
    {"pairwise sums", sums},
    {"paired trials", paired},
    {"unpaired trials", unpaired},
    {"the base's worlds in turn", in_turn},
    {"a single world", one_world},
    {"copies of the worlds", copies},
    {"lists: tau, regret, ranks", lists},
    {"lists of copies", lists_of_copies},
    {"number of top designs", tops},
    {"all designs diverged", all_diverged},
    {"coverage: real rollouts", coverage_of_rollouts},
    {"coverage: the base's worlds in turn", coverage_of_worlds},
    {"coverage: one more copy", coverage_of_copies},
};
CHECK_MAIN(cases)
