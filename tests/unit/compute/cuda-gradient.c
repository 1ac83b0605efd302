/* cuda-gradient.c: how gradient batches are laid out for the device. */
#include "../make.h"
#include "../rollout/objective-cases.h"
#include "../rollout/task-cases.h"

#include "compute/cuda/gradient_pass.h"
#include "compute/cuda/gradient_plan.h"
#include "compute/cuda/gradient_tape.h"
#include "rollout/damage.h"
#include "rollout/scene.h"

#include <stdbool.h>

enum { ROBOTS = 150, SHARD = 64 };

/* Makes robots; one of them has all voxels. */
static struct mo_robot *make_batch(void)
{
  struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  struct mo_robot *robots = make_robots(lattice, 3, 5, ROBOTS);
  robots[70].body = make_full_body(lattice);
  return robots;
}

static const struct mo_gp_options options = {
    .shard = SHARD, .shared_bytes = 227 << 10, .workers = 1};

/* Returns which of the body's springs connects these two masses. */
static uint32_t spring_between(const struct mo_body *body, uint32_t a, uint32_t b)
{
  for (uint32_t i = 0; i < body->n_springs; i++)
    if (body->spring_a[i] == a && body->spring_b[i] == b)
      return i;
  return UINT32_MAX;
}

/* Checks a spring of mass `own` in its chunk: counted by mass and by row. */
static void check_spring(const struct mo_robot *robots, const struct mo_gp_group *g,
                         const struct mo_gp_pair *pair, const struct mo_gp_row *rows, uint32_t s,
                         uint32_t *ends, uint32_t found[2])
{
  const uint32_t row = MO_GP_SPRING_ROW(s), from = row == 0 ? 0 : pair->n_masses[0];
  const uint32_t own = MO_GP_SPRING_OWN(s), other = MO_GP_SPRING_OTHER(s),
                 output = MO_GP_SPRING_OUTPUT(s);
  CHECK(own >= from && own - from < pair->n_masses[row] && other >= from &&
        other - from < pair->n_masses[row]);
  if (own == other)
    return;
  const struct mo_body *body = robots[rows[row * 16].robot].body;
  const uint32_t low = own < other ? own : other, high = own < other ? other : own;
  const uint32_t spring = spring_between(body, low - from, high - from);
  REQUIRE(spring != UINT32_MAX);
  CHECK(g->output_tile[output / MO_GP_TILE] * MO_GP_TILE + output % MO_GP_TILE ==
        body->spring_lattice[spring]);
  CHECK(MO_GP_SPRING_DIAGONAL(s) == (body->spring_rest_m[spring] == MO_DIAGONAL_M));
  ends[own]++;
  found[row]++;
}

/* Checks how two warps divide the pair's chunks: whole sets of masses, and no other split is more
 * even. */
static void check_split(const struct mo_gp_pair *pair, const uint32_t *springs)
{
  const uint32_t n = pair->n_chunks,
                 longer = pair->split > n - pair->split ? pair->split : n - pair->split;
  REQUIRE(pair->split <= n);
  CHECK(pair->split == 0 || (springs[(pair->split - 1) * MO_GP_LANES] & MO_GP_SPRING_LAST) != 0);
  for (uint32_t c = 0; c < n; c++)
    if (springs[c * MO_GP_LANES] & MO_GP_SPRING_LAST)
      CHECK((c + 1 > n - c - 1 ? c + 1 : n - c - 1) >= longer);
}

static void check_pair(const struct mo_robot *robots, const struct mo_gradient_plan *plan,
                       const struct mo_gp_group *g, uint32_t w, uint8_t *seen)
{
  const struct mo_gp_pair *pair = &g->pair[w];
  const struct mo_gp_row *rows = plan->rows + g->first_row + w;
  const uint32_t *springs = plan->springs + (g->first_chunk + pair->first_chunk) * MO_GP_LANES;
  uint32_t found[2] = {0, 0}, ends[512] = {0}, n_masses = 0;
  bool taken[512] = {false};
  for (uint32_t c = 0, first = 0; c < pair->n_chunks; c++) {
    const uint32_t last = springs[c * MO_GP_LANES] & MO_GP_SPRING_LAST;
    for (uint32_t l = 0; l < MO_GP_LANES; l++) {
      const uint32_t s = springs[c * MO_GP_LANES + l], own = MO_GP_SPRING_OWN(s);
      CHECK((s & MO_GP_SPRING_LAST) == last);
      CHECK(own == MO_GP_SPRING_OWN(springs[first * MO_GP_LANES + l]));
      if (own == MO_GP_NO_MASS) {
        CHECK(MO_GP_SPRING_OTHER(s) == 0 && MO_GP_SPRING_OUTPUT(s) == 0);
        continue;
      }
      if (c == first) {
        CHECK(!taken[own]);
        taken[own] = true;
        n_masses++;
      }
      check_spring(robots, g, pair, rows, s, ends, found);
    }
    if (last)
      first = c + 1;
  }
  CHECK(n_masses == pair->n_masses[0] + pair->n_masses[1]);
  check_split(pair, springs);
  uint64_t mass = g->first_mass + pair->first_mass;
  for (uint32_t k = 0; k < 2 && w + 16 * k < g->n_rows; k++) {
    const struct mo_gp_row *row = rows + (size_t)16 * k;
    if (row->robot == MO_GP_NO_ROBOT) {
      CHECK(pair->n_masses[k] == 0);
      continue;
    }
    const struct mo_body *body = robots[row->robot].body;
    CHECK(!seen[row->robot] && row->robot / SHARD == g->shard);
    seen[row->robot] = 1;
    CHECK(found[k] == 2 * body->n_springs && pair->n_masses[k] == body->n_masses);
    for (uint32_t i = 0; i < body->n_springs; i++)
      ends[(k == 0 ? 0 : pair->n_masses[0]) + body->spring_a[i]]--;
    for (uint32_t i = 0; i < body->n_springs; i++)
      ends[(k == 0 ? 0 : pair->n_masses[0]) + body->spring_b[i]]--;
    for (uint32_t m = 0; m < body->n_masses; m++, mass++)
      CHECK(plan->input[mass] == body->mass_lattice[m]);
  }
  for (int m = 0; m < 512; m++)
    CHECK(ends[m] == 0);
}

/* wide: groups of 32 rows; short_ones: groups with empty rows, except the last of each shard. */
static void check_all(const struct mo_robot *robots, uint32_t shared_bytes, uint32_t *wide,
                      uint32_t *short_ones)
{
  struct mo_gradient_plan plan = {0};
  struct mo_gp_options own = options;
  uint8_t seen[ROBOTS] = {0};
  const struct mo_physics physics = mo_paper_physics();
  own.shared_bytes = shared_bytes;
  *wide = *short_ones = 0;
  REQUIRE(mo_gradient_plan_make(robots, ROBOTS, &physics, &own, &plan) == MO_OK);
  CHECK(plan.n_shards == 3);
  for (uint32_t i = 0; i < plan.n_groups; i++) {
    const struct mo_gp_group *g = plan.groups + i;
    CHECK(mo_gp_shared_bytes(g->n_rows, g->n_masses, g->n_outputs) <= shared_bytes);
    *wide += g->n_rows == MO_GP_ROWS_MAX;
    *short_ones += plan.rows[g->first_row + g->n_rows - 1].robot == MO_GP_NO_ROBOT &&
                   i + 1 < plan.n_groups && g[1].shard == g->shard;
    for (uint32_t w = 0; w < MO_GP_WARPS; w++)
      check_pair(robots, &plan, g, w, seen);
  }
  for (uint32_t i = 0; i < ROBOTS; i++)
    CHECK(seen[i]);
  mo_gradient_plan_free(&plan);
}

static void everything_is_there_once(void)
{
  struct mo_robot *robots = make_batch();
  uint32_t wide, short_ones;
  check_all(robots, options.shared_bytes, &wide, &short_ones);
  CHECK(wide > 0 && short_ones == 0);
}

/* If 32 of the largest bodies do not fit together, the smallest bodies join some of them. A warp's
 * two bodies are one from the larger half and one from the smaller half. */
static void large_with_small(void)
{
  struct mo_robot *robots = make_batch();
  struct mo_gradient_plan plan = {0};
  uint32_t wide, short_ones, least = UINT32_MAX, first_least = UINT32_MAX, most = 0;
  const struct mo_physics physics = mo_paper_physics();
  check_all(robots, options.shared_bytes, &wide, &short_ones);
  CHECK(wide == 5 && short_ones == 0);
  REQUIRE(mo_gradient_plan_make(robots + SHARD, SHARD, &physics, &options, &plan) == MO_OK);
  CHECK(plan.n_groups == 2 && plan.groups[0].n_rows == MO_GP_ROWS_MAX);
  for (uint32_t i = 0; i < SHARD; i++) {
    const struct mo_body *body = robots[SHARD + plan.rows[i].robot].body;
    least = body->n_springs < least ? body->n_springs : least;
    if (i >= MO_GP_ROWS_MAX)
      continue;
    first_least = body->n_springs < first_least ? body->n_springs : first_least;
    most = body->n_masses > most ? body->n_masses : most;
    if (i >= MO_GP_ROWS_MAX / 2)
      CHECK(body->n_springs <=
            robots[SHARD + plan.rows[i - MO_GP_ROWS_MAX / 2].robot].body->n_springs);
  }
  CHECK(most == MO_DEFAULT_MASSES && first_least == least);
  for (uint32_t i = MO_GP_ROWS_MAX / 2; i < MO_GP_ROWS_MAX;
       i++) /* at least sixteen small bodies: no pair consists of two large ones */
    for (uint32_t j = MO_GP_ROWS_MAX; j < SHARD; j++)
      CHECK(robots[SHARD + plan.rows[i].robot].body->n_springs <=
            robots[SHARD + plan.rows[j].robot].body->n_springs);
  mo_gradient_plan_free(&plan);
}

/* If shared memory is too small for sixteen of the largest bodies, a group has fewer; with almost
 * no shared memory there is no layout. */
static void small_shared_memory(void)
{
  struct mo_robot *robots = make_batch();
  struct mo_gradient_plan plan = {0};
  uint32_t wide, short_ones;
  struct mo_gp_options least = options;
  const struct mo_physics physics = mo_paper_physics();
  for (int i = 64; i < 90; i++)
    robots[i].body = robots[70].body;
  check_all(robots, 163 << 10, &wide, &short_ones);
  CHECK(short_ones > 1);
  least.shared_bytes = mo_gp_shared_bytes(16, MO_DEFAULT_MASSES, MO_GP_OUTPUT_TILES);
  check_all(robots, least.shared_bytes, &wide, &short_ones);
  CHECK(short_ones > 26);
  least.shared_bytes--;
  CHECK(mo_gradient_plan_make(robots, ROBOTS, &physics, &least, &plan) == MO_ERR_UNSUPPORTED);
  mo_gradient_plan_free(&plan);
}

/* A shard's tables do not depend on other shards, and no table depends on the number of threads. */
static void a_shard_is_its_own(void)
{
  struct mo_robot *robots = make_batch();
  struct mo_gradient_plan all = {0}, threads = {0}, second = {0};
  struct mo_gp_options several = options;
  const struct mo_physics physics = mo_paper_physics();
  several.workers = 3;
  REQUIRE(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &all) == MO_OK);
  REQUIRE(mo_gradient_plan_make(robots, ROBOTS, &physics, &several, &threads) == MO_OK);
  REQUIRE(mo_gradient_plan_make(robots + SHARD, SHARD, &physics, &options, &second) == MO_OK);
  CHECK(all.n_groups == threads.n_groups && all.n_chunks == threads.n_chunks);
  CHECK(memcmp(all.springs, threads.springs, all.n_chunks * MO_GP_LANES * sizeof(*all.springs)) ==
        0);
  CHECK(memcmp(all.position, threads.position, all.n_masses * 3 * sizeof(*all.position)) == 0);
  CHECK(memcmp(all.input, threads.input, all.n_masses) == 0);
  uint32_t at = 0;
  while (all.groups[at].shard == 0)
    at++;
  for (uint32_t i = 0; i < second.n_groups; i++) {
    const struct mo_gp_group *x = all.groups + at + i, *y = second.groups + i;
    CHECK(x->shard == 1 && x->n_rows == y->n_rows && x->n_masses == y->n_masses &&
          x->n_chunks == y->n_chunks);
    CHECK(memcmp(x->output_tile, y->output_tile, y->n_outputs) == 0);
    CHECK(memcmp(all.springs + x->first_chunk * MO_GP_LANES,
                 second.springs + y->first_chunk * MO_GP_LANES,
                 (size_t)y->n_chunks * MO_GP_LANES * sizeof(*all.springs)) == 0);
    CHECK(memcmp(all.position + 3 * x->first_mass, second.position + 3 * y->first_mass,
                 (size_t)y->n_masses * 3 * sizeof(float)) == 0);
  }
  mo_gradient_plan_free(&all);
  mo_gradient_plan_free(&threads);
  mo_gradient_plan_free(&second);
}

static struct mo_gp_time in_steps(uint32_t n_steps, uint32_t control_steps, bool splits)
{
  return (struct mo_gp_time){n_steps, control_steps, splits};
}

/* A pass has as many whole shards as fit. Existing memory is reused for a smaller batch. */
static void passes(void)
{
  struct mo_robot *robots = make_batch();
  struct mo_gradient_plan plan = {0};
  struct mo_gradient_pass all, pass;
  const struct mo_physics physics = mo_paper_physics();
  REQUIRE(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &plan) == MO_OK);
  REQUIRE(mo_gradient_pass_next(&plan, 0, 0, in_steps(1000, 1, false), UINT64_MAX, &all) == MO_OK);
  CHECK(all.first == 0 && all.end == plan.n_groups && all.end_shard == 3 &&
        all.shared <= options.shared_bytes);
  CHECK(mo_gradient_can_be_held(&plan, in_steps(1000, 1, false), UINT64_MAX) &&
        !mo_gradient_can_be_held(&plan, in_steps(100000, 1, false), UINT64_MAX));
  CHECK(mo_gradient_can_be_held(&plan, in_steps(1000, 1, false), all.tape / 2) &&
        !mo_gradient_can_be_held(&plan, in_steps(1000, 1, false), all.tape / 8));
  uint32_t shard = 0;
  uint64_t tape = 0;
  for (uint32_t group = 0; group < plan.n_groups; group = pass.end, shard = pass.end_shard) {
    REQUIRE(mo_gradient_pass_next(&plan, shard, group, in_steps(1000, 1, false), all.tape / 2,
                                  &pass) == MO_OK);
    CHECK(pass.first == group && pass.end_shard > shard && plan.groups[group].tape_at == 0);
    tape += pass.tape;
  }
  CHECK(shard == 3 && tape == all.tape);
  CHECK(mo_gradient_pass_next(&plan, 0, 0, in_steps(1000, 1, false), all.tape / 8, &pass) ==
        MO_ERR_NO_MEMORY);
  const uint32_t *springs = plan.springs;
  REQUIRE(mo_gradient_plan_make(robots, SHARD, &physics, &options, &plan) == MO_OK);
  CHECK(plan.springs == springs && plan.n_shards == 1);
  mo_gradient_plan_free(&plan);
}

/* Returns whether the lane's spring is one that damage cuts: that of these ends, in its row's body.
 */
static bool is_cut(const struct mo_robot *robots, const struct mo_gp_pair *pair,
                   const struct mo_gp_row *rows, uint32_t spring)
{
  uint8_t cut[MO_DEFAULT_SPRINGS];
  const uint32_t own = MO_GP_SPRING_OWN(spring), k = MO_GP_SPRING_ROW(spring),
                 from = k > 0 ? pair->n_masses[0] : 0;
  if (own == MO_GP_NO_MASS || own == MO_GP_SPRING_OTHER(spring))
    return false;
  const struct mo_robot *robot = robots + rows[k * MO_GP_HALF_ROWS].robot;
  const uint32_t a = own - from, b = MO_GP_SPRING_OTHER(spring) - from;
  mo_damage_mark(robot->environment, robot->body, cut);
  for (uint32_t s = 0; s < robot->body->n_springs; s++)
    if ((robot->body->spring_a[s] == a && robot->body->spring_b[s] == b) ||
        (robot->body->spring_a[s] == b && robot->body->spring_b[s] == a))
      return cut[s] != 0;
  CHECK(false);
  return false;
}

/* The springs that damage cuts, in the first groups. */
static void check_cuts(const struct mo_robot *robots, const struct mo_gradient_plan *plan)
{
  uint32_t n_cut = 0;
  for (const struct mo_gp_group *g = plan->groups; g < plan->groups + 3; g++)
    for (uint32_t w = 0; w < MO_GP_WARPS; w++) {
      const struct mo_gp_pair *pair = &g->pair[w];
      const struct mo_gp_row *rows = plan->rows + g->first_row + w;
      for (uint32_t c = 0; c < pair->n_chunks; c++)
        for (uint32_t l = 0; l < MO_GP_LANES; l++) {
          const uint64_t at = g->first_chunk + pair->first_chunk + c;
          const bool cut = plan->cuts[at] >> l & 1;
          CHECK(cut == is_cut(robots, pair, rows, plan->springs[at * MO_GP_LANES + l]));
          n_cut += cut;
        }
    }
  CHECK(n_cut > 100);
}

/* Rows with tasks get a course from the same start as on a processor; without tasks, profiles and
 * damage there are no courses and no tracks. */
static void special_rows(void)
{
  struct mo_robot *robots = make_batch(), *guided = make_zeros(ROBOTS, sizeof(*guided));
  struct mo_environment *environments = make_zeros(ROBOTS, sizeof(*environments));
  struct mo_gradient_plan plan = {0}, plain = {0};
  struct mo_gradient_pass with, without;
  const struct mo_physics physics = mo_paper_physics();
  uint32_t n_plain = 0;
  for (uint32_t i = 0; i < ROBOTS; i++) {
    environments[i] = *robots[i].environment;
    if (i % 3 != 0)
      environments[i].task = task_case(i % TASK_CASES);
    if (i % 5 == 2)
      environments[i].damage = (struct mo_damage){1 + i % MO_OCTANTS, 0.1 * (i % 7)};
    if (i % 7 == 3) {
      environments[i].n_profile = MO_TERRAIN_HEIGHTS;
      environments[i].profile_spacing_m = 0.1;
    }
    guided[i] = (struct mo_robot){robots[i].body, &environments[i]};
  }
  REQUIRE_OK(mo_gradient_plan_make(guided, ROBOTS, &physics, &options, &plan));
  REQUIRE_OK(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &plain));
  REQUIRE(plan.courses != NULL && plain.courses == NULL && plan.n_rows == plain.n_rows);
  REQUIRE(plan.cuts != NULL && plain.cuts == NULL);
  check_cuts(guided, &plan);
  for (uint32_t j = 0; j < plan.n_rows; j++) {
    const struct mo_gp_course *course = plan.courses + j;
    const struct mo_gp_row *row = plan.rows + j;
    struct mo_course expected;
    struct mo_track start;
    CHECK(row->robot == plain.rows[j].robot);
    if (row->robot != MO_GP_NO_ROBOT) {
      const struct mo_environment *environment = &environments[row->robot];
      CHECK(course->special.cells.columns == (environment->n_profile > 0 ? 64 : 8));
      CHECK(course->special.cells.rows == (environment->n_profile > 0 ? 1 : 8));
      CHECK(course->special.cut == environment->damage.cut);
      CHECK(course->special.cut_step == mo_damage_step(environment, &physics.scheme));
    }
    if (row->robot == MO_GP_NO_ROBOT || row->robot % 3 == 0) {
      CHECK(course->is_plain);
      CHECK(row->robot == MO_GP_NO_ROBOT || row->goal.scale_m == plain.rows[j].goal.scale_m);
      n_plain++;
      continue;
    }
    mo_course_begin(&expected, &environments[row->robot], &physics.scheme,
                    plan.starts[row->robot].com_start_m, &start);
    CHECK(!course->is_plain && course->course.environment == NULL);
    CHECK(memcmp(&course->environment, &environments[row->robot], sizeof(course->environment)) ==
          0);
    CHECK(memcmp(&course->start, &start, sizeof(start)) == 0);
    CHECK(memcmp(course->course.start_m, expected.start_m, sizeof(expected.start_m)) == 0);
    CHECK(course->course.scale_m == expected.scale_m && row->goal.scale_m == expected.scale_m);
    CHECK(course->course.end_s == expected.end_s && course->course.n_periods == 1000);
  }
  CHECK(n_plain >= ROBOTS / 3 && n_plain < plan.n_rows / 2);
  struct mo_gp_time time = in_steps(1000, 4, true);
  REQUIRE_OK(mo_gradient_pass_next(&plain, 0, 0, time, UINT64_MAX, &without));
  time.is_special = true;
  REQUIRE_OK(mo_gradient_pass_next(&plan, 0, 0, time, UINT64_MAX, &with));
  uint64_t tracks = 0;
  for (uint32_t i = 0; i < plan.n_groups; i++) {
    const struct mo_gp_group *g = plan.groups + i;
    tracks += MO_GP_ALIGN(251 * g->n_rows * sizeof(struct mo_track));
    CHECK(i == 0 || g->tape_at == g[-1].tape_at + mo_gp_tape_of(g - 1, time).bytes +
                                      MO_GP_ALIGN(251 * g[-1].n_rows * sizeof(struct mo_track)));
  }
  CHECK(with.tape == without.tape + tracks && with.sums == without.sums &&
        with.shared == without.shared);
  REQUIRE_OK(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &plan));
  CHECK(plan.courses == NULL);
  mo_gradient_plan_free(&plan);
  mo_gradient_plan_free(&plain);
}

/* Tasks with a tally: those that need the work of the springs, and those without a gradient. */
static void tallies(void)
{
  struct mo_robot *robots = make_batch();
  struct mo_environment *environments = make_zeros(ROBOTS, sizeof(*environments));
  struct mo_gradient_plan plan = {0};
  const struct mo_physics physics = mo_paper_physics();
  uint32_t works = 0;
  for (uint32_t i = 0; i < ROBOTS; i++) {
    environments[i] = *robots[i].environment;
    if (i % 3 == 1)
      set_objective(&environments[i], i % SMOOTH_CASES);
    environments[i].factors = mo_factors_ones();
    environments[i].factors.stiffness = 1 + 0.1 * (i % 4);
    robots[i].environment = &environments[i];
  }
  REQUIRE_OK(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &plan));
  CHECK(plan.works);
  for (uint32_t j = 0; j < plan.n_rows; j++) {
    const struct mo_gp_course *course = plan.courses + j;
    const uint32_t robot = plan.rows[j].robot;
    CHECK(course->is_plain == (robot == MO_GP_NO_ROBOT || robot % 3 != 1));
    CHECK(course->works == (!course->is_plain && mo_task_needs_work(&environments[robot].task)));
    if (course->works)
      CHECK(course->stiffness_n_per_m ==
            mo_scene_constants(&environments[robot], &physics).stiffness_n_per_m);
    works += course->works;
  }
  CHECK(works > 10 && works < ROBOTS / 3);
  for (uint32_t i = 0; i < ROBOTS; i++)
    if (mo_task_needs_work(&environments[i].task))
      environments[i].task = (struct mo_task){0};
  REQUIRE_OK(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &plan));
  CHECK(!plan.works && plan.courses != NULL);
  set_objective(&environments[40], SMOOTH_CASES);
  CHECK(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &plan) == MO_ERR_UNSUPPORTED);
  environments[40].task = (struct mo_task){.objective = (enum mo_objective)77}; /* of the future */
  CHECK(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &plan) == MO_ERR_UNSUPPORTED);
  mo_gradient_plan_free(&plan);
}

/* With the work, every tape has sums of activations; it moves nothing else. */
static void tape_of_work(void)
{
  const struct mo_gp_group g = {.n_rows = 32, .n_masses = 3001, .n_chunks = 700, .n_outputs = 20};
  for (uint32_t k = 0; k < 4; k++) {
    struct mo_gp_time time = in_steps(1000, k % 2 == 0 ? 1 : 4, k >= 2);
    const struct mo_gp_tape without = mo_gp_tape_of(&g, time);
    time.works = true;
    const struct mo_gp_tape with = mo_gp_tape_of(&g, time);
    if (k > 0) {
      CHECK(memcmp(&with, &without, sizeof(with)) == 0);
      continue;
    }
    CHECK(with.input == without.input && with.d_output == without.d_output);
    CHECK(with.d_activation == without.bytes);
    CHECK(with.bytes - without.bytes == MO_GP_ALIGN(700 * MO_GP_LANES * sizeof(float)));
  }
}

/* Push and sums of activations are on the tape of `split` alone, whatever its control period. */
static void tape_of_split(void)
{
  const struct mo_gp_group g = {.n_rows = 32, .n_masses = 3001, .n_chunks = 700, .n_outputs = 20};
  for (uint32_t control_steps = 1; control_steps <= 4; control_steps += 3) {
    const struct mo_gp_tape paper = mo_gp_tape_of(&g, in_steps(1000, control_steps, false)),
                            split = mo_gp_tape_of(&g, in_steps(1000, control_steps, true));
    CHECK(paper.activation == paper.push && split.push == paper.push);
    CHECK(split.activation - split.push == MO_GP_ALIGN(1000 * 3001 * UINT64_C(12)));
    CHECK(split.input - split.d_activation == MO_GP_ALIGN(700 * MO_GP_LANES * sizeof(float)));
    CHECK(split.bytes - split.input == paper.bytes - paper.input);
  }
}

/* With control periods of several steps the network's part of the tape has as many passes as
 * periods; positions and velocities stay; a sum per spring and lane is added. */
static void passes_of_periods(void)
{
  struct mo_robot *robots = make_batch();
  struct mo_gradient_plan plan = {0};
  struct mo_gradient_pass each, held;
  const struct mo_physics physics = mo_paper_physics();
  CHECK(mo_gp_passes(1000, 1) == 1000 && mo_gp_passes(1000, 4) == 250 &&
        mo_gp_passes(1000, 3) == 334 && mo_gp_passes(1000, 1000) == 1);
  REQUIRE(mo_gradient_plan_make(robots, ROBOTS, &physics, &options, &plan) == MO_OK);
  for (uint32_t i = 0; i < plan.n_groups; i++) {
    const struct mo_gp_group *g = plan.groups + i;
    const struct mo_gp_tape steps = mo_gp_tape_of(g, in_steps(1000, 1, false)),
                            periods = mo_gp_tape_of(g, in_steps(1000, 3, false)),
                            network = mo_gp_tape_of(g, in_steps(334, 1, false));
    CHECK(steps.d_activation == steps.input);
    CHECK(periods.velocity == steps.velocity && periods.activation == steps.activation);
    CHECK(periods.d_activation - periods.activation == network.input - network.activation);
    CHECK(periods.input - periods.d_activation ==
          MO_GP_ALIGN(g->n_chunks * MO_GP_LANES * sizeof(float)));
    CHECK(periods.normal[0] - periods.input == network.normal[0] - network.input);
    CHECK(periods.normal[2] - periods.normal[1] == network.normal[2] - network.normal[1]);
    CHECK(periods.bytes - periods.d_output == network.bytes - network.d_output);
  }
  REQUIRE(mo_gradient_pass_next(&plan, 0, 0, in_steps(1000, 1, false), UINT64_MAX, &each) == MO_OK);
  REQUIRE(mo_gradient_pass_next(&plan, 0, 0, in_steps(1000, 4, false), UINT64_MAX, &held) == MO_OK);
  CHECK(held.end == each.end && held.sums == each.sums && held.shared == each.shared);
  CHECK(held.tape < each.tape / 2 && held.tape > each.tape / 4);
  CHECK(!mo_gradient_can_be_held(&plan, in_steps(20000, 1, false), UINT64_MAX) &&
        mo_gradient_can_be_held(&plan, in_steps(20000, 8, false), UINT64_MAX));
  CHECK(!mo_gradient_can_be_held(&plan, in_steps(1000, 1, false), each.tape / 4) &&
        mo_gradient_can_be_held(&plan, in_steps(1000, 8, false), each.tape / 4));
  mo_gradient_plan_free(&plan);
}

/* What all wait for: the pair that has most, not what all have together. */
static void cost_of_a_group(void)
{
  struct mo_gp_group even = {
      .n_rows = MO_GP_ROWS_MAX, .n_masses = 2000, .n_chunks = 800, .n_outputs = 100};
  for (uint32_t w = 0; w < MO_GP_WARPS; w++)
    even.pair[w] = (struct mo_gp_pair){.n_masses = {100, 25}, .n_chunks = 50};
  struct mo_gp_group chunks = even, masses = even, tiles = even;
  chunks.pair[3].n_chunks += 20;
  chunks.pair[4].n_chunks -= 20;
  masses.pair[3].n_masses[0] += 50;
  masses.pair[4].n_masses[0] -= 50;
  tiles.n_outputs++;
  CHECK(mo_gradient_cost(&even) == 62000 + 580 * 100 + 6 * 2000 + 360 * 50 + 80 * 125);
  CHECK(mo_gradient_cost(&chunks) - mo_gradient_cost(&even) == 360 * 20);
  CHECK(mo_gradient_cost(&masses) - mo_gradient_cost(&even) == 80 * 50);
  CHECK(mo_gradient_cost(&tiles) - mo_gradient_cost(&even) == 580);
}

enum { MULTIPROCESSORS = 132, LOADS = 400 };

static void same_cost(struct mo_gradient_load loads[LOADS], uint64_t cost, bool wide)
{
  for (uint32_t i = 0; i < LOADS; i++)
    loads[i] = (struct mo_gradient_load){cost, i, wide};
}

/* All groups are split if there are enough multiprocessors, none if there are too few, and
 * otherwise those that everything would wait for. */
static void halves(void)
{
  struct mo_gradient_load loads[LOADS];
  same_cost(loads, 100000, true);
  CHECK(mo_gradient_halved(loads, 0, MULTIPROCESSORS) == 0);
  CHECK(mo_gradient_halved(loads, 1, MULTIPROCESSORS) == 1);
  CHECK(mo_gradient_halved(loads, 64, MULTIPROCESSORS) == 64);
  CHECK(mo_gradient_halved(loads, 96, MULTIPROCESSORS) == 96);
  CHECK(mo_gradient_halved(loads, 128, MULTIPROCESSORS) == 0);
  CHECK(mo_gradient_halved(loads, 256, MULTIPROCESSORS) == 0);
  CHECK(mo_gradient_halved(loads, LOADS, MULTIPROCESSORS) == 0);
  CHECK(mo_gradient_halved(loads, 64, 108) == 64 && mo_gradient_halved(loads, 96, 108) == 0);
  for (uint32_t i = 0; i < 8; i++)
    loads[i].cost = 130000;
  CHECK(mo_gradient_halved(loads, 128, MULTIPROCESSORS) == 8);
  CHECK(mo_gradient_halved(loads, 256, MULTIPROCESSORS) == 0);
  /* Split, the sixteen take 0.98 next to the others' 1; if all were split, the multiprocessors
   * would need 1.01. */
  for (uint32_t i = 0; i < 16; i++)
    loads[i].cost = 140000;
  CHECK(mo_gradient_halved(loads, 96, MULTIPROCESSORS) == 16);
}

/* Groups of 16 rows are not split, whatever they cost. */
static void no_halves_of_small_groups(void)
{
  struct mo_gradient_load loads[LOADS];
  same_cost(loads, 100000, false);
  CHECK(mo_gradient_halved(loads, 64, MULTIPROCESSORS) == 0);
  for (uint32_t i = 0; i < 8; i++)
    loads[i].cost = 130000;
  CHECK(mo_gradient_halved(loads, 100, MULTIPROCESSORS) == 0);
  for (uint32_t i = 0; i < 100; i++)
    loads[i].wide = i >= 2 && i < 10;
  CHECK(mo_gradient_halved(loads, 100, MULTIPROCESSORS) == 0); /* the first two decide */
  loads[0].cost = loads[1].cost = 100000;
  struct mo_gradient_load sorted[LOADS];
  memcpy(sorted, loads + 2, 98 * sizeof(*sorted));
  memcpy(sorted + 98, loads, 2 * sizeof(*sorted));
  CHECK(mo_gradient_halved(sorted, 100, MULTIPROCESSORS) == 6);
}

static void another_workspace(void)
{
  const uint64_t bits[1] = {1};
  struct mo_environment environment;
  struct mo_gradient_plan plan = {0};
  const struct mo_physics physics = mo_paper_physics();
  mo_environment_training(1, 0, 0, &environment);
  const struct mo_robot robot = {make_body(make_lattice((struct mo_workspace){3, 3, 3}), bits),
                                 &environment};
  CHECK(mo_gradient_plan_make(&robot, 1, &physics, &options, &plan) == MO_ERR_UNSUPPORTED);
}

static const struct check_case cases[] = {
    {"every robot, mass and spring occurs once", everything_is_there_once},
    {"large bodies share groups with small ones", large_with_small},
    {"little shared memory: fewer robots in a group", small_shared_memory},
    {"a shard's layout does not depend on other shards or threads", a_shard_is_its_own},
    {"passes of whole shards", passes},
    {"the tape of control periods", passes_of_periods},
    {"the tape of the integrator split", tape_of_split},
    {"tasks, profiles and damage", special_rows},
    {"efficient, jump and sums", tallies},
    {"the tape with the work of the springs", tape_of_work},
    {"what a group costs", cost_of_a_group},
    {"groups in halves", halves},
    {"small groups stay whole", no_halves_of_small_groups},
    {"another workspace is left to the processor", another_workspace}};
CHECK_MAIN(cases)
