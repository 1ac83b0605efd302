/* cuda-gradient.c: what the device's gradient is made of, without a device: its float32 arithmetic
 * against the float64 reference, and the layout of batches. */
#include "../check.h"

#include "compute/cuda/adjoint.cuh"
#include "compute/cuda/gradient_pass.h"
#include "compute/cuda/gradient_plan.h"
#include "rollout/contact.h"

#include <morpho/random.h>

#include <stdbool.h>

static struct mo_random random_numbers;

static double uniform(double low, double high)
{
  return low + (high - low) * mo_random_uniform(&random_numbers);
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static struct mo_lane_physics lane_physics(const struct mo_physics *p)
{
  return (struct mo_lane_physics){.dt = (float)p->dt_s,
                                  .friction = (float)p->friction,
                                  .friction_cap = (float)p->friction_cap,
                                  .bisections =
                                      p->impact == MO_IMPACT_BISECTION ? (int)p->bisections : 0,
                                  .keep = (float)exp(-p->drag_per_s * p->dt_s),
                                  .fall = (float)(p->gravity_m_per_s2 * p->dt_s),
                                  .pull = (float)(p->dt_s * p->stiffness_n_per_m / p->mass_kg),
                                  .actuation = (float)p->actuation};
}

/* ---- contact ---- */

enum { STRIKES = 20000 };

/* Masses that meet the ground: near it and above it, some across borders of cells and beyond the
 * map. */
static void contact(enum mo_impact impact)
{
  static double moved[STRIKES], differ[STRIKES];
  struct mo_physics physics = mo_default_physics();
  physics.impact = impact;
  const struct mo_lane_physics lane = lane_physics(&physics);
  int n = 0, crossing = 0;
  mo_random_init(&random_numbers, 11, MO_PURPOSE_CHECK, 0, impact);
  while (n < STRIKES) {
    double heights[MO_TERRAIN_HEIGHTS];
    float heights32[MO_TERRAIN_HEIGHTS];
    for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
      heights[k] = heights32[k] = (float)uniform(0, n % 2 == 0 ? 0.1 : 0.5);
    const double reach = n % 8 == 0 ? 60 : 2;
    const float x = (float)uniform(-2.7, 2.7), y = (float)uniform(-2.7, 2.7);
    const float z =
        (float)(mo_terrain_height(heights, x + MO_WORLD_CENTRE_M, y + MO_WORLD_CENTRE_M) +
                uniform(1e-4, 0.004) * reach / 2);
    const float v[3] = {(float)uniform(-reach, reach), (float)uniform(-reach, reach),
                        (float)uniform(-reach, 0)};
    float p[3] = {x, y, z}, w[3] = {v[0], v[1], v[2]}, dp[3], dv[3];
    double position[3] = {x + MO_WORLD_CENTRE_M, y + MO_WORLD_CENTRE_M, z},
           speed[3] = {v[0], v[1], v[2]}, d_position[3], d_velocity[3];
    const double from[3] = {position[0], position[1], position[2]}, with[3] = {v[0], v[1], v[2]};
    if (!mo_move(&lane, heights32, 1e9f, p, w))
      continue;
    mo_contact_move(&physics, heights, INFINITY, position, speed);
    for (int k = 0; k < 3; k++) {
      d_position[k] = dp[k] = (float)uniform(-1, 1);
      d_velocity[k] = dv[k] = (float)uniform(-0.05, 0.05);
    }
    const float start[3] = {x, y, z};
    mo_move_back(&lane, heights32, 1e9f, start, v, dp, dv);
    mo_contact_move_adjoint(&physics, heights, INFINITY, from, with, d_position, d_velocity);
    double distance = 0, error = 0, size = 0;
    for (int k = 0; k < 3; k++) {
      const double center = k < 2 ? MO_WORLD_CENTRE_M : 0;
      distance =
          fmax(distance, fmax(fabs(p[k] + center - position[k]), 0.004 * fabs(w[k] - speed[k])));
      error += pow(dp[k] - d_position[k], 2) + pow(15 * (dv[k] - d_velocity[k]), 2);
      size += pow(d_position[k], 2) + pow(15 * d_velocity[k], 2);
    }
    crossing += floor(from[0] * 1.4) != floor((from[0] + 0.004 * v[0]) * 1.4);
    moved[n] = distance;
    differ[n++] = sqrt(error / size);
  }
  qsort(moved, STRIKES, sizeof(*moved), ascending);
  qsort(differ, STRIKES, sizeof(*differ), ascending);
  printf("# %d strikes, %d across a border: moved apart median %.1e m, 99 %% %.1e; derivative "
         "differs by median %.1e, "
         "99 %% %.1e\n",
         STRIKES, crossing, moved[STRIKES / 2], moved[STRIKES * 99 / 100], differ[STRIKES / 2],
         differ[STRIKES * 99 / 100]);
  CHECK(crossing > 500);
  CHECK(moved[STRIKES / 2] < 1e-6 &&
        moved[STRIKES * 99 / 100] < (impact == MO_IMPACT_EXACT ? 1e-5 : 1e-2));
  CHECK(differ[STRIKES / 2] < 1e-5 &&
        differ[STRIKES * 99 / 100] < (impact == MO_IMPACT_EXACT ? 1e-2 : 1e-1));
}

static void exact_contact(void)
{
  contact(MO_IMPACT_EXACT);
}

static void halved_contact(void)
{
  contact(MO_IMPACT_BISECTION);
}

/* A mass in the air only flies; what strikes at the next step lies on the ground, for float32 as
 * for float64. */
static void lying(void)
{
  const struct mo_physics physics = mo_default_physics();
  const struct mo_lane_physics lane = lane_physics(&physics);
  float heights[MO_TERRAIN_HEIGHTS];
  mo_random_init(&random_numbers, 12, MO_PURPOSE_CHECK, 0, 0);
  int below = 0;
  for (int n = 0; n < 2000; n++) {
    for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
      heights[k] = (float)uniform(0, 0.3);
    float p[3] = {(float)uniform(-2, 2), (float)uniform(-2, 2), 0.31f},
          v[3] = {(float)uniform(-1, 1), (float)uniform(-1, 1), 0};
    for (int step = 0; step < 60; step++) {
      struct mo_ground g;
      v[2] -= 0.04f;
      mo_move(&lane, heights, 0.3f, p, v);
      below += p[2] < mo_ground_find(heights, p[0], p[1], &g);
    }
  }
  CHECK(below == 0);
  float p[3] = {0, 0, 2}, v[3] = {1, 2, 3}, dp[3] = {1, 2, 3}, dv[3] = {0.5f, 0, 0};
  mo_move_back(&lane, heights, 0.3f, p, v, dp, dv);
  CHECK_NEAR(dv[0], 0.504, 1e-6);
  CHECK_NEAR(dv[2], 0.012, 1e-6);
  CHECK(dp[0] == 1 && dp[1] == 2 && dp[2] == 3);
}

/* ---- springs and sensors, against differences in float64 ---- */

static double pull64(const struct mo_physics *p, double rest, double a, const double *d)
{
  const double length = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  return p->dt_s * p->stiffness_n_per_m / p->mass_kg * (length - rest * (1 + p->actuation * a)) /
         (length + 1e-8);
}

/* ∂loss/∂ what the spring gives the velocity of the end that d points from is −across, in effect:
 * loss = across · pull · d. */
static double loss64(const struct mo_physics *p, double rest, double a, const double *d,
                     const double *across)
{
  return pull64(p, rest, a, d) * (across[0] * d[0] + across[1] * d[1] + across[2] * d[2]);
}

static void springs(void)
{
  const struct mo_physics physics = mo_default_physics();
  const struct mo_lane_physics lane = lane_physics(&physics);
  double worst = 0;
  mo_random_init(&random_numbers, 13, MO_PURPOSE_CHECK, 0, 0);
  for (int n = 0; n < 3000; n++) {
    const float rest = n % 2 == 0 ? 0.1f : 0.14142136f, a = (float)uniform(-1, 1);
    const float d[3] = {(float)uniform(-0.1, 0.1), (float)uniform(-0.1, 0.1),
                        (float)uniform(0.02, 0.1)};
    const float across[3] = {(float)uniform(-1, 1), (float)uniform(-1, 1), (float)uniform(-1, 1)};
    double d64[3] = {d[0], d[1], d[2]};
    const double across64[3] = {across[0], across[1], across[2]}, h = 1e-6;
    float dd[3];
    const float da = mo_spring_pull_back(&lane, rest, a, d, across, dd);
    CHECK_NEAR(mo_spring_pull(&lane, rest, a, d), pull64(&physics, rest, a, d64), 1e-3);
    double size = 0, error = 0;
    for (int k = 0; k < 3; k++) {
      const double at = d64[k];
      d64[k] = at + h;
      const double up = loss64(&physics, rest, a, d64, across64);
      d64[k] = at - h;
      const double down = loss64(&physics, rest, a, d64, across64);
      d64[k] = at;
      size += pow((up - down) / (2 * h), 2);
      error += pow((up - down) / (2 * h) - dd[k], 2);
    }
    const double slope = (loss64(&physics, rest, a + h, d64, across64) -
                          loss64(&physics, rest, a - h, d64, across64)) /
                         (2 * h);
    worst = fmax(worst, sqrt(error / size));
    CHECK_NEAR(da, slope, 1e-5);
  }
  CHECK(worst < 1e-4);
}

static void sensors(void)
{
  struct mo_lane_physics lane = {0};
  mo_random_init(&random_numbers, 14, MO_PURPOSE_CHECK, 0, 0);
  for (int n = 0; n < 2000; n++) {
    lane.inverse_square = n % 2;
    const float d[3] = {(float)uniform(0.1, 2), (float)uniform(-2, 2), (float)uniform(-0.3, 0.3)};
    const double squared = (double)d[0] * d[0] + (double)d[1] * d[1] + (double)d[2] * d[2];
    const double light =
        lane.inverse_square ? 1 / (squared + 1e-4) : 1 / (sqrt(sqrt(squared) + 1e-8) + 1e-8);
    const double h = 1e-4 * sqrt(squared);
    const double near_m = sqrt(squared) - h, far_m = sqrt(squared) + h;
    const double up =
        lane.inverse_square ? 1 / (far_m * far_m + 1e-4) : 1 / (sqrt(far_m + 1e-8) + 1e-8);
    const double down =
        lane.inverse_square ? 1 / (near_m * near_m + 1e-4) : 1 / (sqrt(near_m + 1e-8) + 1e-8);
    const double slope = (up - down) / (2 * h) / sqrt(squared);
    CHECK_NEAR(mo_light(&lane, d) / light, 1, 1e-6);
    CHECK_NEAR(mo_light_slope(&lane, d) / slope, 1, 1e-5);
  }
  const float nowhere[3] = {0, 0, 0};
  lane.inverse_square = 0;
  CHECK(mo_light_slope(&lane, nowhere) == 0);
}

/* ---- layouts ---- */

enum { ROBOTS = 150, SHARD = 64 };

struct batch {
  struct mo_lattice *lattice;
  struct mo_body *bodies[ROBOTS];
  struct mo_environment environments[ROBOTS];
  struct mo_robot robots[ROBOTS];
};

static int make_batch(struct batch *b)
{
  struct mo_body_stream *stream = NULL;
  memset(b, 0, sizeof(*b));
  int status = mo_lattice_create(MO_DEFAULT_WORKSPACE, &b->lattice);
  if (status == MO_OK)
    status = mo_body_stream_create(MO_DEFAULT_WORKSPACE, 3, &stream);
  for (uint32_t i = 0; i < ROBOTS && status == MO_OK; i++) {
    uint64_t bits[MO_DEFAULT_WORDS] = {UINT64_MAX, UINT64_MAX, 0xffff}; /* one of all voxels */
    if (i != 70)
      status = mo_body_stream_next(stream, bits);
    if (status == MO_OK)
      status = mo_body_create(b->lattice, bits, &b->bodies[i]);
    mo_environment_training(5, 0, i, &b->environments[i]);
    b->robots[i] = (struct mo_robot){b->bodies[i], &b->environments[i]};
  }
  mo_body_stream_free(stream);
  return status;
}

static void drop_batch(struct batch *b)
{
  for (uint32_t i = 0; i < ROBOTS; i++)
    mo_body_free(b->bodies[i]);
  mo_lattice_free(b->lattice);
}

static const struct mo_gp_options options = {
    .shard = SHARD, .shared_bytes = 227 << 10, .workers = 1};

/* Which of the body's springs has these two masses. */
static uint32_t spring_between(const struct mo_body *body, uint32_t a, uint32_t b)
{
  for (uint32_t i = 0; i < body->n_springs; i++)
    if (body->spring_a[i] == a && body->spring_b[i] == b)
      return i;
  return UINT32_MAX;
}

/* A spring of mass `own` in its chunk: counted, by mass and by row. */
static void check_spring(const struct batch *b, const struct mo_gp_group *g,
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
  const struct mo_body *body = b->robots[rows[row * 16].robot].body;
  const uint32_t low = own < other ? own : other, high = own < other ? other : own;
  const uint32_t spring = spring_between(body, low - from, high - from);
  REQUIRE(spring != UINT32_MAX);
  CHECK(g->output_tile[output / MO_GP_TILE] * MO_GP_TILE + output % MO_GP_TILE ==
        body->spring_lattice[spring]);
  CHECK(MO_GP_SPRING_DIAGONAL(s) == body->spring_diagonal[spring]);
  ends[own]++;
  found[row]++;
}

/* What two warps would have of the pair's chunks: whole sets of masses, and no other place to part
 * them is more even. */
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

static void check_pair(const struct batch *b, const struct mo_gradient_plan *plan,
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
      check_spring(b, g, pair, rows, s, ends, found);
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
    const struct mo_body *body = b->robots[row->robot].body;
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

/* wide: groups of 32 rows; short_ones: those with empty rows that are not their shard's last. */
static void check_all(const struct batch *b, uint32_t shared_bytes, uint32_t *wide,
                      uint32_t *short_ones)
{
  struct mo_gradient_plan plan = {0};
  struct mo_gp_options own = options;
  uint8_t seen[ROBOTS] = {0};
  const struct mo_physics physics = mo_default_physics();
  own.shared_bytes = shared_bytes;
  *wide = *short_ones = 0;
  REQUIRE(mo_gradient_plan_make(b->robots, ROBOTS, &physics, &own, &plan) == MO_OK);
  CHECK(plan.n_shards == 3);
  for (uint32_t i = 0; i < plan.n_groups; i++) {
    const struct mo_gp_group *g = plan.groups + i;
    CHECK(mo_gp_shared_bytes(g->n_rows, g->n_masses, g->n_outputs) <= shared_bytes);
    *wide += g->n_rows == MO_GP_ROWS_MAX;
    *short_ones += plan.rows[g->first_row + g->n_rows - 1].robot == MO_GP_NO_ROBOT &&
                   i + 1 < plan.n_groups && g[1].shard == g->shard;
    for (uint32_t w = 0; w < MO_GP_WARPS; w++)
      check_pair(b, &plan, g, w, seen);
  }
  for (uint32_t i = 0; i < ROBOTS; i++)
    CHECK(seen[i]);
  mo_gradient_plan_free(&plan);
}

static void everything_is_there_once(void)
{
  static struct batch b;
  uint32_t wide, short_ones;
  REQUIRE(make_batch(&b) == MO_OK);
  check_all(&b, options.shared_bytes, &wide, &short_ones);
  CHECK(wide > 0 && short_ones == 0);
  drop_batch(&b);
}

/* Where 32 of the largest bodies are too large together, the smallest join some of them; a warp's
 * two bodies are one of the larger and one of the smaller half. */
static void large_with_small(void)
{
  static struct batch b;
  struct mo_gradient_plan plan = {0};
  uint32_t wide, short_ones, least = UINT32_MAX, first_least = UINT32_MAX, most = 0;
  const struct mo_physics physics = mo_default_physics();
  REQUIRE(make_batch(&b) == MO_OK);
  check_all(&b, options.shared_bytes, &wide, &short_ones);
  CHECK(wide == 5 && short_ones == 0);
  REQUIRE(mo_gradient_plan_make(b.robots + SHARD, SHARD, &physics, &options, &plan) == MO_OK);
  CHECK(plan.n_groups == 2 && plan.groups[0].n_rows == MO_GP_ROWS_MAX);
  for (uint32_t i = 0; i < SHARD; i++) {
    const struct mo_body *body = b.robots[SHARD + plan.rows[i].robot].body;
    least = body->n_springs < least ? body->n_springs : least;
    if (i >= MO_GP_ROWS_MAX)
      continue;
    first_least = body->n_springs < first_least ? body->n_springs : first_least;
    most = body->n_masses > most ? body->n_masses : most;
    if (i >= MO_GP_ROWS_MAX / 2)
      CHECK(body->n_springs <=
            b.robots[SHARD + plan.rows[i - MO_GP_ROWS_MAX / 2].robot].body->n_springs);
  }
  CHECK(most == MO_DEFAULT_MASSES && first_least == least);
  for (uint32_t i = MO_GP_ROWS_MAX / 2; i < MO_GP_ROWS_MAX;
       i++) /* at least sixteen small ones: no pair has two large ones */
    for (uint32_t j = MO_GP_ROWS_MAX; j < SHARD; j++)
      CHECK(b.robots[SHARD + plan.rows[i].robot].body->n_springs <=
            b.robots[SHARD + plan.rows[j].robot].body->n_springs);
  mo_gradient_plan_free(&plan);
  drop_batch(&b);
}

/* Where the shared memory is too small for sixteen of the largest bodies, a group has fewer; with
 * next to none there is no layout. */
static void small_shared_memory(void)
{
  static struct batch b;
  struct mo_gradient_plan plan = {0};
  uint32_t wide, short_ones;
  struct mo_gp_options least = options;
  const struct mo_physics physics = mo_default_physics();
  REQUIRE(make_batch(&b) == MO_OK);
  for (int i = 64; i < 90; i++)
    b.robots[i].body = b.bodies[70];
  check_all(&b, 163 << 10, &wide, &short_ones);
  CHECK(short_ones > 1);
  least.shared_bytes = mo_gp_shared_bytes(16, MO_DEFAULT_MASSES, MO_GP_OUTPUT_TILES);
  check_all(&b, least.shared_bytes, &wide, &short_ones);
  CHECK(short_ones > 26);
  least.shared_bytes--;
  CHECK(mo_gradient_plan_make(b.robots, ROBOTS, &physics, &least, &plan) == MO_ERR_UNSUPPORTED);
  mo_gradient_plan_free(&plan);
  drop_batch(&b);
}

/* A shard's tables do not depend on the other shards, nor any on the number of threads. */
static void a_shard_is_its_own(void)
{
  static struct batch b;
  struct mo_gradient_plan all = {0}, threads = {0}, second = {0};
  struct mo_gp_options several = options;
  const struct mo_physics physics = mo_default_physics();
  several.workers = 3;
  REQUIRE(make_batch(&b) == MO_OK);
  REQUIRE(mo_gradient_plan_make(b.robots, ROBOTS, &physics, &options, &all) == MO_OK);
  REQUIRE(mo_gradient_plan_make(b.robots, ROBOTS, &physics, &several, &threads) == MO_OK);
  REQUIRE(mo_gradient_plan_make(b.robots + SHARD, SHARD, &physics, &options, &second) == MO_OK);
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
  drop_batch(&b);
}

/* As many whole shards at a time as fit; memory that is there already serves a smaller batch. */
static void passes(void)
{
  static struct batch b;
  struct mo_gradient_plan plan = {0};
  struct mo_gradient_pass all, pass;
  const struct mo_physics physics = mo_default_physics();
  REQUIRE(make_batch(&b) == MO_OK);
  REQUIRE(mo_gradient_plan_make(b.robots, ROBOTS, &physics, &options, &plan) == MO_OK);
  REQUIRE(mo_gradient_pass_next(&plan, 0, 0, 1000, UINT64_MAX, &all) == MO_OK);
  CHECK(all.first == 0 && all.end == plan.n_groups && all.end_shard == 3 &&
        all.shared <= options.shared_bytes);
  CHECK(mo_gradient_can_be_held(&plan, 1000, UINT64_MAX) &&
        !mo_gradient_can_be_held(&plan, 100000, UINT64_MAX));
  CHECK(mo_gradient_can_be_held(&plan, 1000, all.tape / 2) &&
        !mo_gradient_can_be_held(&plan, 1000, all.tape / 8));
  uint32_t shard = 0;
  uint64_t tape = 0;
  for (uint32_t group = 0; group < plan.n_groups; group = pass.end, shard = pass.end_shard) {
    REQUIRE(mo_gradient_pass_next(&plan, shard, group, 1000, all.tape / 2, &pass) == MO_OK);
    CHECK(pass.first == group && pass.end_shard > shard && plan.groups[group].tape_at == 0);
    tape += pass.tape;
  }
  CHECK(shard == 3 && tape == all.tape);
  CHECK(mo_gradient_pass_next(&plan, 0, 0, 1000, all.tape / 8, &pass) == MO_ERR_NO_MEMORY);
  const uint32_t *springs = plan.springs;
  REQUIRE(mo_gradient_plan_make(b.robots, SHARD, &physics, &options, &plan) == MO_OK);
  CHECK(plan.springs == springs && plan.n_shards == 1);
  mo_gradient_plan_free(&plan);
  drop_batch(&b);
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

/* All groups in halves where there are multiprocessors for them, none where there are too few, and
 * otherwise those that all would wait for. */
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
  /* In halves the sixteen take 0.98, beside the others' 1; were all in halves, the multiprocessors
   * would need 1.01. */
  for (uint32_t i = 0; i < 16; i++)
    loads[i].cost = 140000;
  CHECK(mo_gradient_halved(loads, 96, MULTIPROCESSORS) == 16);
}

/* Groups of 16 rows are not walked in halves, whatever they cost. */
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
  CHECK(mo_gradient_halved(loads, 100, MULTIPROCESSORS) ==
        0); /* the first two are waited for all the same */
  loads[0].cost = loads[1].cost = 100000;
  struct mo_gradient_load sorted[LOADS];
  memcpy(sorted, loads + 2, 98 * sizeof(*sorted));
  memcpy(sorted + 98, loads, 2 * sizeof(*sorted));
  CHECK(mo_gradient_halved(sorted, 100, MULTIPROCESSORS) == 6);
}

static void another_workspace(void)
{
  struct mo_lattice *lattice = NULL;
  struct mo_body *body = NULL;
  const uint64_t bits[1] = {1};
  struct mo_environment environment;
  struct mo_gradient_plan plan = {0};
  const struct mo_physics physics = mo_default_physics();
  mo_environment_training(1, 0, 0, &environment);
  REQUIRE(mo_lattice_create((struct mo_workspace){3, 3, 3}, &lattice) == MO_OK);
  REQUIRE(mo_body_create(lattice, bits, &body) == MO_OK);
  const struct mo_robot robot = {body, &environment};
  CHECK(mo_gradient_plan_make(&robot, 1, &physics, &options, &plan) == MO_ERR_UNSUPPORTED);
  mo_body_free(body);
  mo_lattice_free(lattice);
}

static const struct check_case cases[] = {
    {"contact, closed form", exact_contact},
    {"contact, halvings", halved_contact},
    {"masses that lie on the ground", lying},
    {"springs", springs},
    {"sensors", sensors},
    {"every robot, mass and spring is there once", everything_is_there_once},
    {"large bodies share groups with small ones", large_with_small},
    {"little shared memory: fewer robots in a group", small_shared_memory},
    {"a shard is laid out alike alone and by several threads", a_shard_is_its_own},
    {"passes of whole shards", passes},
    {"what a group costs", cost_of_a_group},
    {"groups in halves", halves},
    {"small groups stay whole", no_halves_of_small_groups},
    {"another workspace is left to the processor", another_workspace}};
CHECK_MAIN(cases)
