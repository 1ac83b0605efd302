/* gradient_plan.c: robots to groups, groups to tables. Shards are laid out by several threads, each
 * in memory of its own, and then put together in their order. */
#include "compute/cuda/gradient_plan.h"

#include "compute/cuda/plan.h"

#include "base/thread.h"
#include "rollout/scene.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { HALF = MO_GP_ROWS_MAX / 2, PAIR_MASSES = 512, MASS_SPRINGS = 18, LARGE_LEAST = 4 };

enum { GROUPS, ROWS, POSITION, INPUT, SPRINGS, STARTS, ORDER = STARTS, SCRATCH, MEMORIES };

/* A shard under construction: as mo_gradient_plan, with numbers that count from the shard's start.
 */
struct shard {
  const struct mo_robot *robots; /* of the whole batch */
  const struct mo_physics *physics;
  const struct mo_gp_options *options;
  uint32_t number, first, n; /* robots */
  uint32_t *order;           /* larger bodies first */
  uint32_t at, end;          /* those not placed yet */
  uint32_t from_back; /* of the group being formed: how many are the last of them, not the first */
  uint32_t n_groups, n_rows;
  uint64_t n_masses, n_chunks;
  uint64_t mass, chunk; /* before this shard's, like the two that follow */
  uint32_t group, row;
  struct mo_gp_group *groups;
  struct mo_gp_row *rows;
  float *position;
  uint8_t *input;
  uint32_t *springs;
  struct mo_gradient_plan *plan;
  double *scratch;
  struct mo_gp_memory memory[MEMORIES];
  int status;
};

/* At least `bytes`, of any content, from where a plan's tables have their memory or, without a
 * plan, from malloc; NULL: none to be had. */
static void *reserve(const struct mo_gradient_plan *plan, struct mo_gp_memory *m, uint64_t bytes)
{
  const bool is_own = plan != NULL && plan->allocate != NULL;
  if (m->bytes < bytes) {
    (is_own ? plan->release : free)(m->at);
    const uint64_t wanted = bytes + bytes / 8 + 64; /* batches differ */
    m->at = is_own ? plan->allocate(plan->context, wanted) : malloc(wanted);
    m->bytes = m->at != NULL ? wanted : 0;
  }
  return m->at;
}

/* ---- groups ---- */

uint32_t mo_gp_shared_bytes(uint32_t n_rows, uint32_t n_masses, uint32_t n_outputs)
{
  const uint32_t rows =
      n_rows * (2 * (n_outputs * MO_GP_TILE + 8) /* activations, or ∂loss/∂ them */
                + 2 * (MO_HIDDEN + 8)            /* what a layer is given */
                + 8 * (MO_GP_WARPS + 2)          /* partial sums */
                + 4 * (4 + MO_TERRAIN_HEIGHTS)   /* light and terrain */
                + 4 + 32);                       /* flags; what is counted */
  const uint32_t forward = n_masses * 29 + 4 * MO_HIDDEN * 3 * MO_HIDDEN_LAYERS,
                 back = n_masses * 36;
  return rows + (forward > back ? forward : back) + 1024;
}

/* The i-th of a group of n, of the shard's robots. */
static uint32_t member(const struct shard *s, uint32_t n, uint32_t i)
{
  return s->order[i + s->from_back < n ? s->at + i : s->end - n + i];
}

static const struct mo_body *body_of(const struct shard *s, uint32_t n, uint32_t i)
{
  return s->robots[s->first + member(s, n, i)].body;
}

/* What a group of n robots has together: its tiles and its masses. */
static void measure(const struct shard *s, uint32_t n, struct mo_gp_group *g)
{
  bool outputs[MO_GP_OUTPUT_TILES] = {false};
  g->n_masses = g->n_outputs = 0;
  for (uint32_t i = 0; i < n; i++) {
    const struct mo_body *body = body_of(s, n, i);
    g->n_masses += body->n_masses;
    for (uint32_t k = 0; k < body->n_springs; k++)
      outputs[body->spring_lattice[k] / MO_GP_TILE] = true;
  }
  memset(g->output_place, MO_GP_NONE, sizeof(g->output_place));
  for (uint32_t t = 0; t < MO_GP_OUTPUT_TILES; t++)
    if (outputs[t]) {
      g->output_place[t] = (uint8_t)g->n_outputs;
      g->output_tile[g->n_outputs++] = (uint8_t)t;
    }
}

/* ---- springs ---- */

/* A pair's masses by falling number of springs. */
struct by_springs {
  uint16_t n[PAIR_MASSES];     /* springs of a mass */
  uint16_t mass[PAIR_MASSES];  /* in that order */
  uint16_t place[PAIR_MASSES]; /* of a mass in it */
  uint32_t n_masses, n_chunks;
  uint32_t chunk[PAIR_MASSES / MO_GP_LANES + 1]; /* the first of each 32 masses */
};

static void sort_masses(const struct mo_body *const bodies[2], struct by_springs *s)
{
  uint32_t at[MASS_SPRINGS + 2] = {0}, from = 0;
  memset(s->n, 0, sizeof(s->n));
  for (int k = 0; k < 2 && bodies[k] != NULL; from += bodies[k++]->n_masses)
    for (uint32_t i = 0; i < bodies[k]->n_springs; i++) {
      s->n[from + bodies[k]->spring_a[i]]++;
      s->n[from + bodies[k]->spring_b[i]]++;
    }
  s->n_masses = from;
  for (uint32_t m = 0; m < from; m++)
    at[MASS_SPRINGS - s->n[m] + 1]++;
  for (int i = 0; i < MASS_SPRINGS; i++)
    at[i + 1] += at[i];
  for (uint32_t m = 0; m < from; m++) {
    const uint32_t place = at[MASS_SPRINGS - s->n[m]]++;
    s->mass[place] = (uint16_t)m;
    s->place[m] = (uint16_t)place;
  }
  s->n_chunks = 0;
  for (uint32_t i = 0; i < from; i += MO_GP_LANES) {
    s->chunk[i / MO_GP_LANES] = s->n_chunks;
    s->n_chunks += s->n[s->mass[i]];
  }
  s->chunk[(from + MO_GP_LANES - 1) / MO_GP_LANES] = s->n_chunks;
}

static int make_room(struct shard *s, uint64_t chunks)
{
  struct mo_gp_memory *m = &s->memory[SPRINGS];
  const uint64_t wanted = (s->n_chunks + chunks) * MO_GP_LANES * sizeof(*s->springs);
  if (m->bytes < wanted) {
    const uint64_t bytes = wanted + wanted / 2 + 131072;
    void *more = realloc(m->at, bytes);
    if (more == NULL)
      return MO_ERR_NO_MEMORY;
    *m = (struct mo_gp_memory){more, bytes};
  }
  s->springs = m->at;
  return MO_OK;
}

/* The chunks of the masses of two rows, the group's w-th and the one after half of them. */
static int fill_springs(struct shard *s, const struct mo_gp_group *g, const struct mo_gp_row *rows,
                        struct mo_gp_pair *pair)
{
  const struct mo_body *bodies[2] = {NULL, NULL};
  struct by_springs order;
  uint8_t used[PAIR_MASSES] = {0};
  for (uint32_t k = 0; k < 2 && pair->n_masses[k] > 0; k++)
    bodies[k] = s->robots[rows[k * HALF].robot].body;
  sort_masses(bodies, &order);
  const int status = make_room(s, order.n_chunks);
  if (status < 0)
    return status;
  uint32_t *chunks = s->springs + s->n_chunks * MO_GP_LANES;
  uint32_t from = 0;
  for (uint32_t k = 0; k < 2 && bodies[k] != NULL; from += bodies[k++]->n_masses)
    for (uint32_t i = 0; i < bodies[k]->n_springs; i++) {
      const uint32_t at = bodies[k]->spring_lattice[i];
      const uint32_t output =
          (uint32_t)g->output_place[at / MO_GP_TILE] * MO_GP_TILE + at % MO_GP_TILE;
      const uint32_t ends[2] = {from + bodies[k]->spring_a[i], from + bodies[k]->spring_b[i]};
      for (int e = 0; e < 2; e++) {
        const uint32_t place = order.place[ends[e]],
                       chunk = order.chunk[place / MO_GP_LANES] + used[place]++;
        chunks[chunk * MO_GP_LANES + place % MO_GP_LANES] =
            MO_GP_SPRING(ends[e], ends[1 - e], output, k, bodies[k]->spring_diagonal[i]);
      }
    }
  for (uint32_t place = 0; place < (order.n_masses + MO_GP_LANES - 1) / MO_GP_LANES * MO_GP_LANES;
       place++) {
    const bool there = place < order.n_masses;
    const uint32_t m = there ? order.mass[place] : 0, end = order.chunk[place / MO_GP_LANES + 1];
    uint32_t *own = chunks + order.chunk[place / MO_GP_LANES] * MO_GP_LANES + place % MO_GP_LANES;
    for (uint32_t c = used[place]; order.chunk[place / MO_GP_LANES] + c < end; c++)
      own[c * MO_GP_LANES] =
          MO_GP_SPRING(there ? m : MO_GP_NO_MASS, m, 0, m >= pair->n_masses[0], 0);
    chunks[(end - 1) * MO_GP_LANES + place % MO_GP_LANES] |= MO_GP_SPRING_LAST;
  }
  pair->n_chunks = pair->split = order.n_chunks;
  for (uint32_t i = 0; i * MO_GP_LANES < order.n_masses; i++) { /* a mass's springs stay together */
    const uint32_t before = order.chunk[i], after = order.n_chunks - before;
    const uint32_t longer =
        pair->split > order.n_chunks - pair->split ? pair->split : order.n_chunks - pair->split;
    if (before < longer && after < longer)
      pair->split = before;
  }
  s->n_chunks += order.n_chunks;
  return MO_OK;
}

/* ---- rows ---- */

static void fill_row(struct shard *s, struct mo_gp_row *row)
{
  const struct mo_robot *robot = s->robots + row->robot;
  const struct mo_body *body = robot->body;
  const struct mo_environment *environment = robot->environment;
  struct mo_outcome *start = s->plan->starts + row->robot;
  float *position = s->position + 3 * s->n_masses;
  uint8_t *input = s->input + s->n_masses;
  double light[3];
  mo_scene_start(body, environment, s->physics, s->scratch);
  mo_scene_com(s->scratch, body->n_masses, start->com_start_m);
  mo_scene_light(environment, light);
  for (int axis = 0; axis < 2; axis++)
    row->light_m[axis] = light[axis] - MO_WORLD_CENTRE_M;
  row->start_m =
      mo_scene_distance(start->com_start_m[0] - light[0], start->com_start_m[1] - light[1]) +
      MO_LOSS_GUARD_M;
  row->scene = mo_plan_scene_of(environment);
  for (size_t i = 0; i < body->n_masses; i++) {
    input[i] = (uint8_t)body->mass_lattice[i];
    for (size_t axis = 0; axis < 3; axis++)
      position[3 * i + axis] =
          (float)(s->scratch[3 * i + axis] - (axis < 2 ? MO_WORLD_CENTRE_M : 0));
  }
  row->n_masses = body->n_masses;
  s->n_masses += body->n_masses;
}

/* A group of n robots; rows beyond them stay empty. The second half goes the other way round, so
 * that a warp's two bodies are together about as large as another's. */
static int fill_group(struct shard *s, struct mo_gp_group *g, uint32_t n)
{
  struct mo_gp_row *rows = s->rows + g->first_row;
  g->first_mass = s->n_masses;
  g->first_chunk = s->n_chunks;
  for (uint32_t w = 0; w < MO_GP_WARPS; w++) {
    struct mo_gp_pair *pair = &g->pair[w];
    *pair = (struct mo_gp_pair){.first_mass = (uint32_t)(s->n_masses - g->first_mass),
                                .first_chunk = (uint32_t)(s->n_chunks - g->first_chunk)};
    for (uint32_t k = 0; k < 2 && w + k * HALF < g->n_rows; k++) {
      struct mo_gp_row *row = rows + w + (size_t)k * HALF;
      *row = (struct mo_gp_row){0};
      const uint32_t i = k == 0 ? w : MO_GP_ROWS_MAX - 1 - w;
      row->robot = i < n ? s->first + member(s, n, i) : MO_GP_NO_ROBOT;
      if (row->robot != MO_GP_NO_ROBOT)
        fill_row(s, row);
      pair->n_masses[k] = row->n_masses;
    }
    const int status = fill_springs(s, g, rows + w, pair);
    if (status < 0)
      return status;
  }
  g->n_chunks = (uint32_t)(s->n_chunks - g->first_chunk);
  return MO_OK;
}

static bool fits(const struct shard *s, const struct mo_gp_group *g)
{
  return mo_gp_shared_bytes(g->n_rows, g->n_masses, g->n_outputs) <= s->options->shared_bytes;
}

/* Whether 32 of the largest bodies that are left fit if the smallest take the place of some of
 * them; s->from_back says of how many: of sixteen at least, so that no pair has two large ones,
 * which all would wait for. */
static bool mixes(struct shard *s)
{
  uint32_t masses = 0;
  s->from_back = HALF;
  for (uint32_t i = 0; i < MO_GP_ROWS_MAX; i++)
    masses += body_of(s, MO_GP_ROWS_MAX, i)->n_masses;
  while (mo_gp_shared_bytes(MO_GP_ROWS_MAX, masses, MO_GP_OUTPUT_TILES) >
         s->options->shared_bytes) {
    if (++s->from_back > (uint32_t)MO_GP_ROWS_MAX - LARGE_LEAST)
      return false;
    masses -= s->robots[s->first + s->order[s->at + MO_GP_ROWS_MAX - s->from_back]].body->n_masses;
    masses += s->robots[s->first + s->order[s->end - s->from_back]].body->n_masses;
  }
  return true;
}

/* How many robots form the next group, which is measured: 32, the largest that are left or, where
 * they do not fit, some of them and some of the smallest: the weights that a group loads are for
 * all its rows. Else 16; where the shared memory is too small for sixteen large bodies, fewer in
 * sixteen rows. 0: not even one fits. */
static uint32_t next_group(struct shard *s, struct mo_gp_group *g)
{
  const uint32_t left = s->end - s->at;
  uint32_t n = left < MO_GP_ROWS_MAX ? left : MO_GP_ROWS_MAX;
  g->n_rows = n > HALF ? MO_GP_ROWS_MAX : HALF;
  s->from_back = 0;
  measure(s, n, g);
  if (n > HALF && !fits(s, g)) {
    if (n == MO_GP_ROWS_MAX && mixes(s)) {
      measure(s, n, g);
      return n;
    }
    s->from_back = 0;
    g->n_rows = n = HALF;
    measure(s, n, g);
  }
  while (n > 0 && !fits(s, g))
    measure(s, --n, g);
  return n;
}

/* Of n robots: every group but the last has as many as of the largest bodies fit in sixteen rows.
 */
static size_t groups_at_most(const struct shard *s)
{
  uint32_t fewest = HALF;
  while (fewest > 1 && mo_gp_shared_bytes(HALF, fewest * MO_DEFAULT_MASSES, MO_GP_OUTPUT_TILES) >
                           s->options->shared_bytes)
    fewest--;
  return s->n / fewest + (size_t)2;
}

static int lay_out(struct shard *s)
{
  const size_t most_groups = groups_at_most(s);
  size_t most_masses = 0;
  for (uint32_t i = 0; i < s->n; i++)
    most_masses += s->robots[s->first + i].body->n_masses;
  s->order = reserve(NULL, &s->memory[ORDER], s->n * sizeof(*s->order));
  s->groups = reserve(NULL, &s->memory[GROUPS], most_groups * sizeof(*s->groups));
  s->rows = reserve(NULL, &s->memory[ROWS], most_groups * MO_GP_ROWS_MAX * sizeof(*s->rows));
  s->position = reserve(NULL, &s->memory[POSITION], 3 * most_masses * sizeof(*s->position));
  s->input = reserve(NULL, &s->memory[INPUT], most_masses);
  s->scratch = reserve(NULL, &s->memory[SCRATCH], 3 * MO_DEFAULT_MASSES * sizeof(*s->scratch));
  if (s->order == NULL || s->groups == NULL || s->rows == NULL || s->position == NULL ||
      s->input == NULL || s->scratch == NULL)
    return MO_ERR_NO_MEMORY;
  int status = mo_gradient_arrange(s->robots + s->first, s->n, s->order);
  s->end = s->n;
  while (status == MO_OK && s->at < s->end) {
    struct mo_gp_group *g = s->groups + s->n_groups;
    *g = (struct mo_gp_group){.first_row = s->n_rows, .shard = s->number};
    const uint32_t n = next_group(s, g);
    if (n == 0)
      return MO_ERR_UNSUPPORTED;
    status = fill_group(s, g, n);
    s->n_groups++;
    s->n_rows += g->n_rows;
    s->at += n - s->from_back;
    s->end -= s->from_back;
  }
  return status;
}

/* To its place in the plan. */
static void put(const struct shard *s, struct mo_gradient_plan *plan)
{
  for (uint32_t k = 0; k < s->n_groups; k++) {
    struct mo_gp_group *g = plan->groups + s->group + k;
    *g = s->groups[k];
    g->first_row += s->row;
    g->first_mass += s->mass;
    g->first_chunk += s->chunk;
  }
  memcpy(plan->rows + s->row, s->rows, s->n_rows * sizeof(*s->rows));
  memcpy(plan->position + 3 * s->mass, s->position, s->n_masses * 3 * sizeof(*s->position));
  memcpy(plan->input + s->mass, s->input, s->n_masses);
  if (s->n_chunks > 0)
    memcpy(plan->springs + s->chunk * MO_GP_LANES, s->springs,
           s->n_chunks * MO_GP_LANES * sizeof(*s->springs));
}

/* ---- the whole ---- */

static void lay_out_shards(void *context, size_t first, size_t end)
{
  struct shard *shards = context;
  for (; first < end; first++)
    shards[first].status = lay_out(&shards[first]);
}

static void put_shards(void *context, size_t first, size_t end)
{
  const struct shard *shards = context;
  for (; first < end; first++)
    put(&shards[first], shards[first].plan);
}

/* Says where each shard goes, and has the memory for all of them. */
static int place(struct mo_gradient_plan *plan, struct shard *shards)
{
  for (uint32_t i = 0; i < plan->n_shards; i++) {
    struct shard *s = &shards[i];
    if (s->status < 0)
      return s->status;
    s->group = plan->n_groups;
    s->row = plan->n_rows;
    s->mass = plan->n_masses;
    s->chunk = plan->n_chunks;
    plan->n_groups += s->n_groups;
    plan->n_rows += s->n_rows;
    plan->n_masses += s->n_masses;
    plan->n_chunks += s->n_chunks;
  }
  plan->groups = reserve(plan, &plan->memory[GROUPS], plan->n_groups * sizeof(*plan->groups));
  plan->rows = reserve(plan, &plan->memory[ROWS], plan->n_rows * sizeof(*plan->rows));
  plan->position =
      reserve(plan, &plan->memory[POSITION], plan->n_masses * 3 * sizeof(*plan->position));
  plan->input = reserve(plan, &plan->memory[INPUT], plan->n_masses);
  plan->springs =
      reserve(plan, &plan->memory[SPRINGS], plan->n_chunks * MO_GP_LANES * sizeof(*plan->springs));
  const bool all = plan->groups != NULL && plan->rows != NULL && plan->position != NULL &&
                   plan->input != NULL && plan->springs != NULL;
  return all ? MO_OK : MO_ERR_NO_MEMORY;
}

/* n shards that keep the memory of those before. */
static struct shard *shards_of(struct mo_gradient_plan *plan, uint32_t n)
{
  const size_t before = plan->shards.bytes / sizeof(struct shard);
  if (before < n) {
    struct shard *more = realloc(plan->shards.at, n * sizeof(*more));
    if (more == NULL)
      return NULL;
    memset(more + before, 0, (n - before) * sizeof(*more));
    plan->shards = (struct mo_gp_memory){more, n * sizeof(*more)};
  }
  return plan->shards.at;
}

int mo_gradient_plan_make(const struct mo_robot *robots, uint32_t n,
                          const struct mo_physics *physics, const struct mo_gp_options *options,
                          struct mo_gradient_plan *plan)
{
  for (uint32_t i = 0; i < n; i++)
    if (!mo_workspace_equal(robots[i].body->workspace, MO_DEFAULT_WORKSPACE))
      return MO_ERR_UNSUPPORTED;
  plan->n = n;
  plan->n_shards = (n + options->shard - 1) / options->shard;
  plan->n_groups = plan->n_rows = 0;
  plan->n_masses = plan->n_chunks = 0;
  plan->starts = reserve(NULL, &plan->memory[STARTS], n * sizeof(*plan->starts));
  struct shard *shards = shards_of(plan, plan->n_shards);
  if (plan->starts == NULL || shards == NULL)
    return MO_ERR_NO_MEMORY;
  memset(plan->starts, 0, n * sizeof(*plan->starts));
  for (uint32_t i = 0; i < plan->n_shards; i++) {
    const uint32_t first = i * options->shard;
    struct shard s = {.robots = robots,
                      .physics = physics,
                      .options = options,
                      .number = i,
                      .first = first,
                      .n = n - first < options->shard ? n - first : options->shard,
                      .plan = plan};
    memcpy(s.memory, shards[i].memory, sizeof(s.memory));
    shards[i] = s;
  }
  mo_parallel(options->workers, plan->n_shards, lay_out_shards, shards);
  const int status = place(plan, shards);
  if (status == MO_OK)
    mo_parallel(options->workers, plan->n_shards, put_shards, shards);
  return status;
}

void mo_gradient_plan_free(struct mo_gradient_plan *plan)
{
  struct shard *shards = plan->shards.at;
  for (size_t i = 0; i < plan->shards.bytes / sizeof(*shards); i++)
    for (int m = 0; m < MEMORIES; m++)
      free(shards[i].memory[m].at);
  free(shards);
  for (size_t m = 0; m < sizeof(plan->memory) / sizeof(*plan->memory); m++)
    (plan->release != NULL && m != STARTS ? plan->release : free)(plan->memory[m].at);
  *plan = (struct mo_gradient_plan){0};
}
