/* gradient_plan.c: robots to groups, groups to tables. Shards are laid out by several threads, each in memory of its own, and then put together
 * in their order. */
#include "compute/cuda/gradient_plan.h"

#include "rollout/scene.h"

#include <math.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { HALF = MO_GP_ROWS_MAX / 2, PAIR_MASSES = 512, WORDS = 2, CLASSES = 18, WORKERS_MAX = 64 };

/* A shard under construction: as mo_gradient_plan, with numbers that count from the shard's start. */
struct shard {
  const struct mo_robot *robots; /* of the whole batch */
  const struct mo_physics *physics;
  const struct mo_gp_options *options;
  uint32_t number, first, n; /* robots */
  uint32_t *order;
  uint32_t at; /* robots placed so far */
  uint32_t n_groups, n_rows;
  uint64_t n_masses, n_chunks, chunks_room;
  struct mo_gp_group *groups;
  struct mo_gp_row *rows;
  float *position;
  uint8_t *input;
  uint32_t *springs;
  struct mo_outcome *starts; /* of the whole batch */
  double *scratch;
  uint32_t class_at[2][CLASSES + 1];
  uint16_t by_class[2][MO_DEFAULT_SPRINGS];
  int status;
};

/* ---- groups ---- */

static const struct mo_body *body_at(const struct shard *s, uint32_t at)
{
  return s->robots[s->first + s->order[at]].body;
}

/* What the next n robots have together: their tiles and their masses. */
static void measure(const struct shard *s, uint32_t n, struct mo_gp_group *g)
{
  bool outputs[MO_GP_OUTPUT_TILES] = {false};
  g->n_masses = g->n_outputs = 0;
  for (uint32_t i = s->at; i < s->at + n && i < s->n; i++) {
    const struct mo_body *body = body_at(s, i);
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

/* Which of a pair's chunks have a spring of a mass. */
struct taken {
  uint64_t word[WORDS];
};

/* A spring's direction and, along it, whether it starts at an even or an odd place: springs of one class have no mass in common. So chunks are
 * nearly of one class, and their masses follow one another in memory. */
static int class_of(const struct mo_body *body, uint32_t spring)
{
  const uint16_t *a = body->mass_xyz + 3 * (size_t)body->spring_a[spring],
                 *b = body->mass_xyz + 3 * (size_t)body->spring_b[spring];
  const int x = b[0] - a[0], y = b[1] - a[1], z = b[2] - a[2]; /* −1, 0 or 1 each */
  const int direction = x == 0 ? (y == 0 ? 0 : 2 + z) : y == 0 ? 5 + z : 7 + (y > 0);
  return 2 * direction + ((x != 0 ? a[0] : y != 0 ? a[1] : a[2]) & 1);
}

/* list: the body's springs by class, each class in order, from at[class] on. */
static void sort_springs(const struct mo_body *body, uint16_t *list, uint32_t at[CLASSES + 1])
{
  uint32_t next[CLASSES];
  memset(at, 0, (CLASSES + 1) * sizeof(*at));
  for (uint32_t i = 0; i < body->n_springs; i++)
    at[class_of(body, i) + 1]++;
  for (int k = 0; k < CLASSES; k++) {
    at[k + 1] += at[k];
    next[k] = at[k];
  }
  for (uint32_t i = 0; i < body->n_springs; i++)
    list[next[class_of(body, i)]++] = (uint16_t)i;
}

/* Each spring goes to the first chunk that has room and neither of its masses. Rows of `pair` from the group's row w on. */
static int fill_springs(struct shard *s, const struct mo_gp_group *g, const struct mo_gp_row *rows,
                        struct mo_gp_pair *pair)
{
  struct taken taken[PAIR_MASSES] = {{{0}}}, full = {{0}};
  uint32_t used[64 * WORDS] = {0}, springs = 0;
  for (uint32_t k = 0; k < 2; k++)
    if (pair->n_masses[k] > 0) {
      const struct mo_body *body = s->robots[rows[k * HALF].robot].body;
      sort_springs(body, s->by_class[k], s->class_at[k]);
      springs += body->n_springs;
    }
  /* A spring is kept from at most 34 chunks by its masses, and from those that are full. */
  const uint64_t most = springs / MO_GP_LANES + 35;
  if (most > 64 * WORDS)
    return MO_ERR_UNSUPPORTED;
  if (s->n_chunks + most > s->chunks_room) {
    const uint64_t room = s->chunks_room + s->chunks_room / 2 + most + 1024;
    uint32_t *more = realloc(s->springs, room * MO_GP_LANES * sizeof(*more));
    if (more == NULL)
      return MO_ERR_NO_MEMORY;
    s->springs = more;
    s->chunks_room = room;
  }
  uint32_t *chunks = s->springs + s->n_chunks * MO_GP_LANES;
  memset(chunks, 0, most * MO_GP_LANES * sizeof(*chunks));
  for (int kind = 0; kind < CLASSES; kind++) {
    uint32_t from = 0;
    for (uint32_t k = 0; k < 2; from += pair->n_masses[k++]) {
      if (pair->n_masses[k] == 0)
        continue;
      const struct mo_body *body = s->robots[rows[k * HALF].robot].body;
      const uint16_t *list = s->by_class[k];
      for (uint32_t i = s->class_at[k][kind]; i < s->class_at[k][kind + 1]; i++) {
        const uint32_t spring = list[i], at = body->spring_lattice[spring];
        const uint32_t a = from + body->spring_a[spring], b = from + body->spring_b[spring];
        uint32_t chunk = 0;
        for (int word = 0; word < WORDS; word++) {
          const uint64_t room = ~(taken[a].word[word] | taken[b].word[word] | full.word[word]);
          if (room == 0)
            continue;
          const uint64_t bit = room & -room;
          chunk = (uint32_t)(64 * word + __builtin_ctzll(room));
          taken[a].word[word] |= bit;
          taken[b].word[word] |= bit;
          if (used[chunk] == MO_GP_LANES - 1)
            full.word[word] |= bit;
          break;
        }
        const uint32_t output = (uint32_t)g->output_place[at / MO_GP_TILE] * MO_GP_TILE + at % MO_GP_TILE;
        chunks[chunk * MO_GP_LANES + used[chunk]++] = MO_GP_SPRING(a, b, output, k, body->spring_diagonal[spring]);
        if (chunk >= pair->n_chunks)
          pair->n_chunks = chunk + 1;
      }
    }
  }
  s->n_chunks += pair->n_chunks;
  return MO_OK;
}

/* ---- rows ---- */

static void fill_row(struct shard *s, struct mo_gp_row *row)
{
  const struct mo_robot *robot = s->robots + row->robot;
  const struct mo_body *body = robot->body;
  const struct mo_environment *environment = robot->environment;
  struct mo_outcome *start = s->starts + row->robot;
  float *position = s->position + 3 * s->n_masses;
  uint8_t *input = s->input + s->n_masses;
  double light[3];
  mo_scene_start(body, environment, s->physics, s->scratch);
  mo_scene_com(s->scratch, body->n_masses, start->com_start_m);
  mo_scene_light(environment, light);
  for (int axis = 0; axis < 2; axis++) {
    row->light_m[axis] = light[axis] - MO_WORLD_CENTRE_M;
    row->light[axis] = (float)row->light_m[axis];
  }
  row->light[2] = (float)light[2];
  row->start_m =
      mo_scene_distance(start->com_start_m[0] - light[0], start->com_start_m[1] - light[1]) + MO_LOSS_GUARD_M;
  row->highest = (float)environment->terrain_heights_m[0];
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++) {
    row->heights[k] = (float)environment->terrain_heights_m[k];
    row->highest = fmaxf(row->highest, row->heights[k]);
  }
  for (size_t i = 0; i < body->n_masses; i++) {
    input[i] = (uint8_t)body->mass_lattice[i];
    for (size_t axis = 0; axis < 3; axis++)
      position[3 * i + axis] = (float)(s->scratch[3 * i + axis] - (axis < 2 ? MO_WORLD_CENTRE_M : 0));
  }
  row->n_masses = body->n_masses;
  s->n_masses += body->n_masses;
}

/* The next `n` robots; rows beyond them stay empty. */
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
      row->robot = w + k * HALF < n ? s->first + s->order[s->at + w + k * HALF] : MO_GP_NO_ROBOT;
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

/* How many of the next robots form a group, which is measured: as many as 32 rows hold, else 16; where the shared memory is too small for sixteen
 * large bodies, fewer in sixteen rows. 0: not even one fits. */
static uint32_t next_group(const struct shard *s, struct mo_gp_group *g)
{
  const uint32_t left = s->n - s->at;
  uint32_t n = left < MO_GP_ROWS_MAX ? left : MO_GP_ROWS_MAX;
  g->n_rows = n > HALF ? MO_GP_ROWS_MAX : HALF;
  measure(s, n, g);
  if (n > HALF && !fits(s, g)) {
    g->n_rows = n = HALF;
    measure(s, n, g);
  }
  while (n > 0 && !fits(s, g))
    measure(s, --n, g);
  return n;
}

/* Of n robots: every group but the last has as many as of the largest bodies fit in sixteen rows. */
static size_t groups_at_most(const struct shard *s)
{
  uint32_t fewest = HALF;
  while (fewest > 1 &&
         mo_gp_shared_bytes(HALF, fewest * MO_DEFAULT_MASSES, MO_GP_OUTPUT_TILES) > s->options->shared_bytes)
    fewest--;
  return s->n / fewest + (size_t)2;
}

static int lay_out(struct shard *s)
{
  const size_t most_groups = groups_at_most(s);
  size_t most_masses = 0;
  for (uint32_t i = 0; i < s->n; i++)
    most_masses += s->robots[s->first + i].body->n_masses;
  s->order = malloc((s->n + (size_t)1) * sizeof(*s->order));
  s->groups = calloc(most_groups, sizeof(*s->groups));
  s->rows = calloc(most_groups * MO_GP_ROWS_MAX, sizeof(*s->rows));
  s->position = malloc(3 * (most_masses + 1) * sizeof(*s->position));
  s->input = malloc(most_masses + 1);
  s->scratch = malloc(3 * MO_DEFAULT_MASSES * sizeof(*s->scratch));
  if (s->order == NULL || s->groups == NULL || s->rows == NULL || s->position == NULL || s->input == NULL ||
      s->scratch == NULL)
    return MO_ERR_NO_MEMORY;
  int status = mo_gradient_arrange(s->robots + s->first, s->n, s->order);
  while (status == MO_OK && s->at < s->n) {
    struct mo_gp_group *g = s->groups + s->n_groups;
    *g = (struct mo_gp_group){.first_row = s->n_rows, .shard = s->number};
    const uint32_t n = next_group(s, g);
    if (n == 0)
      return MO_ERR_UNSUPPORTED;
    status = fill_group(s, g, n);
    s->n_groups++;
    s->n_rows += g->n_rows;
    s->at += n;
  }
  return status;
}

static void release(struct shard *s)
{
  free(s->order);
  free(s->groups);
  free(s->rows);
  free(s->position);
  free(s->input);
  free(s->springs);
  free(s->scratch);
}

/* ---- threads ---- */

struct team {
  struct shard *shards;
  uint32_t n_shards, n_workers;
};

struct worker {
  struct team *team;
  uint32_t number;
  pthread_t thread;
};

static void *work(void *context)
{
  const struct worker *worker = context;
  const struct team *team = worker->team;
  for (uint32_t i = worker->number; i < team->n_shards; i += team->n_workers)
    team->shards[i].status = lay_out(&team->shards[i]);
  return NULL;
}

/* The calling thread is one of the workers; what threads cannot be had for, it does itself. */
static void lay_out_all(struct team *team)
{
  struct worker workers[WORKERS_MAX];
  bool started[WORKERS_MAX] = {false};
  for (uint32_t i = 0; i < team->n_workers; i++) {
    workers[i] = (struct worker){.team = team, .number = i};
    if (i > 0)
      started[i] = pthread_create(&workers[i].thread, NULL, work, &workers[i]) == 0;
  }
  for (uint32_t i = 0; i < team->n_workers; i++)
    if (!started[i])
      work(&workers[i]);
  for (uint32_t i = 1; i < team->n_workers; i++)
    if (started[i])
      pthread_join(workers[i].thread, NULL);
}

/* ---- the whole ---- */

static int join(struct mo_gradient_plan *plan, const struct shard *shards)
{
  for (uint32_t i = 0; i < plan->n_shards; i++) {
    if (shards[i].status < 0)
      return shards[i].status;
    plan->n_groups += shards[i].n_groups;
    plan->n_rows += shards[i].n_rows;
    plan->n_masses += shards[i].n_masses;
    plan->n_chunks += shards[i].n_chunks;
  }
  plan->groups = malloc((plan->n_groups + (size_t)1) * sizeof(*plan->groups));
  plan->rows = malloc((plan->n_rows + (size_t)1) * sizeof(*plan->rows));
  plan->position = malloc((plan->n_masses + 1) * 3 * sizeof(*plan->position));
  plan->input = malloc(plan->n_masses + 1);
  plan->springs = malloc((plan->n_chunks + 1) * MO_GP_LANES * sizeof(*plan->springs));
  if (plan->groups == NULL || plan->rows == NULL || plan->position == NULL || plan->input == NULL ||
      plan->springs == NULL)
    return MO_ERR_NO_MEMORY;
  uint32_t group = 0, row = 0;
  uint64_t mass = 0, chunk = 0;
  for (uint32_t i = 0; i < plan->n_shards; i++) {
    const struct shard *s = &shards[i];
    for (uint32_t k = 0; k < s->n_groups; k++) {
      struct mo_gp_group *g = plan->groups + group + k;
      *g = s->groups[k];
      g->first_row += row;
      g->first_mass += mass;
      g->first_chunk += chunk;
    }
    memcpy(plan->rows + row, s->rows, s->n_rows * sizeof(*s->rows));
    memcpy(plan->position + 3 * mass, s->position, s->n_masses * 3 * sizeof(*s->position));
    memcpy(plan->input + mass, s->input, s->n_masses);
    if (s->springs != NULL)
      memcpy(plan->springs + chunk * MO_GP_LANES, s->springs, s->n_chunks * MO_GP_LANES * sizeof(*s->springs));
    group += s->n_groups;
    row += s->n_rows;
    mass += s->n_masses;
    chunk += s->n_chunks;
  }
  return MO_OK;
}

static bool is_default(struct mo_workspace w)
{
  const struct mo_workspace d = MO_DEFAULT_WORKSPACE;
  return w.nx == d.nx && w.ny == d.ny && w.nz == d.nz;
}

int mo_gradient_plan_create(const struct mo_robot *robots, uint32_t n, const struct mo_physics *physics,
                            const struct mo_gp_options *options, struct mo_gradient_plan *plan)
{
  for (uint32_t i = 0; i < n; i++)
    if (!is_default(robots[i].body->workspace))
      return MO_ERR_UNSUPPORTED;
  *plan = (struct mo_gradient_plan){.n = n, .n_shards = (n + options->shard - 1) / options->shard};
  plan->starts = calloc(n + (size_t)1, sizeof(*plan->starts));
  struct shard *shards = calloc(plan->n_shards + (size_t)1, sizeof(*shards));
  int status = plan->starts != NULL && shards != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (status == MO_OK) {
    struct team team = {shards, plan->n_shards, options->workers};
    if (team.n_workers > plan->n_shards)
      team.n_workers = plan->n_shards;
    if (team.n_workers < 1)
      team.n_workers = 1;
    if (team.n_workers > WORKERS_MAX)
      team.n_workers = WORKERS_MAX;
    for (uint32_t i = 0; i < plan->n_shards; i++) {
      const uint32_t first = i * options->shard;
      shards[i] = (struct shard){.robots = robots,
                                 .physics = physics,
                                 .options = options,
                                 .number = i,
                                 .first = first,
                                 .n = n - first < options->shard ? n - first : options->shard,
                                 .starts = plan->starts};
    }
    lay_out_all(&team);
    status = join(plan, shards);
  }
  for (uint32_t i = 0; shards != NULL && i < plan->n_shards; i++)
    release(&shards[i]);
  free(shards);
  if (status < 0)
    mo_gradient_plan_free(plan);
  return status;
}

void mo_gradient_plan_free(struct mo_gradient_plan *plan)
{
  free(plan->groups);
  free(plan->rows);
  free(plan->position);
  free(plan->input);
  free(plan->springs);
  free(plan->starts);
  *plan = (struct mo_gradient_plan){0};
}
