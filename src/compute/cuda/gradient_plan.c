/* gradient_plan.c: divides robots into groups, and groups into tables. Several threads form the
 * groups, one shard each; when all groups and their places are known, the threads fill them. */
#include "compute/cuda/gradient_plan.h"

#include "compute/cuda/course_back.cuh"
#include "compute/cuda/plan.h"

#include "base/thread.h"
#include "rollout/course.h"
#include "rollout/damage.h"
#include "rollout/scene.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { HALF = MO_GP_ROWS_MAX / 2, PAIR_MASSES = 512, MASS_SPRINGS = 18, LARGE_LEAST = 4 };

/* The tables, then memory that is used only while they are made. */
enum {
  GROUPS,
  ROWS,
  POSITION,
  INPUT,
  SPRINGS,
  COURSES,
  CUTS,
  TABLES,
  STARTS = TABLES,
  ORDER,
  FORMED,
  SHARDS
};

/* A group without a place yet, and the robots of its rows. */
struct formed {
  struct mo_gp_group group;
  uint32_t robot[MO_GP_ROWS_MAX];
};

/* A shard under construction. */
struct shard {
  const struct mo_robot *robots; /* of the whole batch */
  const struct mo_gp_options *options;
  uint32_t number, first, n; /* robots */
  uint32_t *order;           /* larger bodies first */
  uint32_t at, end;          /* robots that are not placed yet */
  uint32_t from_back;    /* for the group being formed: how many robots come from the end of that
                          * range, not its start */
  struct formed *formed; /* (n_groups) */
  uint32_t n_groups, first_group;
  bool is_special, has_damage, works; /* some robot's environment, or task */
  const struct mo_physics *physics;
  struct mo_gradient_plan *plan;
  int status;
};

/* Reserves at least `bytes`, with undefined content; for tables, from the plan's allocator. Returns
 * NULL if memory runs out. */
static void *reserve(struct mo_gradient_plan *plan, int which, uint64_t bytes)
{
  struct mo_gp_memory *m = &plan->memory[which];
  const bool is_own = which < TABLES && plan->allocate != NULL;
  if (m->bytes < bytes) {
    (is_own ? plan->release : free)(m->at);
    const uint64_t wanted = bytes + bytes / 8 + 64; /* batches vary in size */
    m->at = is_own ? plan->allocate(plan->context, wanted) : malloc(wanted);
    m->bytes = m->at != NULL ? wanted : 0;
  }
  return m->at;
}

/* ---- groups ---- */

uint32_t mo_gp_shared_bytes(uint32_t n_rows, uint32_t n_masses, uint32_t n_outputs)
{
  const uint32_t rows =
      n_rows * (2 * (n_outputs * MO_GP_TILE + 8) /* activations, or ∂loss/∂activations */
                + 2 * (MO_HIDDEN + 8)            /* the inputs of a layer */
                + 8 * (MO_GP_WARPS + 2)          /* partial sums */
                + 4 * (4 + MO_TERRAIN_HEIGHTS)   /* light and terrain */
                + 4 + 32);                       /* flags and counters */
  const uint32_t forward = n_masses * 29 + 4 * MO_HIDDEN * 3 * MO_HIDDEN_LAYERS,
                 back = n_masses * 36;
  /* For the numbers of the tiles, and for the rows' constants, which are not counted above: more
   * bytes per row would form different groups of large bodies, and gradients with different
   * bits. */
  _Static_assert(MO_GP_ROWS_MAX * sizeof(struct lane_constants) + 144 <= 1024, "they fit");
  return rows + (forward > back ? forward : back) + 1024;
}

/* Returns the i-th robot of a group of n, among the shard's robots. */
static uint32_t member(const struct shard *s, uint32_t n, uint32_t i)
{
  return s->order[i + s->from_back < n ? s->at + i : s->end - n + i];
}

static const struct mo_body *body_of(const struct shard *s, uint32_t n, uint32_t i)
{
  return s->robots[s->first + member(s, n, i)].body;
}

/* Counts the tiles and masses of a group of n robots. */
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

/* A pair's masses in descending order of their number of springs. */
struct by_springs {
  uint16_t n[PAIR_MASSES];     /* springs of a mass */
  uint16_t mass[PAIR_MASSES];  /* masses in that order */
  uint16_t place[PAIR_MASSES]; /* place of a mass in that order */
  uint32_t n_masses, n_chunks;
  uint32_t chunk[PAIR_MASSES / MO_GP_LANES + 1]; /* the first chunk of each 32 masses */
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

/* Returns the number of a pair's chunks for the first of two warps: half, but the springs of a mass
 * stay together. */
static uint32_t split_of(const struct by_springs *order)
{
  const uint32_t n = order->n_chunks;
  uint32_t split = n;
  for (uint32_t i = 0; i * MO_GP_LANES < order->n_masses; i++) {
    const uint32_t before = order->chunk[i], after = n - before;
    const uint32_t longer = split > n - split ? split : n - split;
    if (before < longer && after < longer)
      split = before;
  }
  return split;
}

/* A pair's bodies and their environments; NULL: an empty row. */
struct couple {
  const struct mo_body *bodies[2];
  const struct mo_environment *environments[2];
};

/* Fills in the chunks of the masses of a pair's bodies. cuts: as in struct mo_gradient_plan. */
static void fill_springs(const struct mo_gp_group *g, const struct mo_gp_pair *pair,
                         const struct couple *of, uint32_t *chunks, uint32_t *cuts)
{
  const struct mo_body *const *bodies = of->bodies;
  struct by_springs order;
  uint8_t used[PAIR_MASSES] = {0}, cut[MO_DEFAULT_SPRINGS];
  sort_masses(bodies, &order);
  if (cuts != NULL)
    memset(cuts, 0, pair->n_chunks * sizeof(*cuts));
  uint32_t from = 0;
  for (uint32_t k = 0; k < 2 && bodies[k] != NULL; from += bodies[k++]->n_masses) {
    if (cuts != NULL)
      mo_damage_mark(of->environments[k], bodies[k], cut);
    for (uint32_t i = 0; i < bodies[k]->n_springs; i++) {
      const uint32_t at = bodies[k]->spring_lattice[i];
      const uint32_t output =
          (uint32_t)g->output_place[at / MO_GP_TILE] * MO_GP_TILE + at % MO_GP_TILE;
      const bool diagonal = bodies[k]->spring_rest_m[i] > MO_VOXEL_M;
      const uint32_t ends[2] = {from + bodies[k]->spring_a[i], from + bodies[k]->spring_b[i]};
      for (int e = 0; e < 2; e++) {
        const uint32_t place = order.place[ends[e]],
                       chunk = order.chunk[place / MO_GP_LANES] + used[place]++;
        chunks[chunk * MO_GP_LANES + place % MO_GP_LANES] =
            MO_GP_SPRING(ends[e], ends[1 - e], output, k, diagonal);
        if (cuts != NULL)
          cuts[chunk] |= (uint32_t)cut[i] << place % MO_GP_LANES;
      }
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
}

/* ---- forming ---- */

/* Puts n robots into a group's rows; rows beyond them stay empty. The second half is in reverse
 * order, so that all warps' pairs of bodies have about the same total size. */
static void form(const struct shard *s, struct formed *f, uint32_t n)
{
  struct mo_gp_group *g = &f->group;
  uint32_t n_masses = 0;
  for (uint32_t w = 0; w < MO_GP_WARPS; w++) {
    struct mo_gp_pair *pair = &g->pair[w];
    const struct mo_body *bodies[2] = {NULL, NULL};
    struct by_springs order;
    *pair = (struct mo_gp_pair){.first_mass = n_masses, .first_chunk = g->n_chunks};
    for (uint32_t k = 0; k < 2 && w + k * HALF < g->n_rows; k++) {
      const uint32_t i = k == 0 ? w : MO_GP_ROWS_MAX - 1 - w;
      f->robot[w + k * HALF] = i < n ? s->first + member(s, n, i) : MO_GP_NO_ROBOT;
      bodies[k] = i < n ? body_of(s, n, i) : NULL;
      pair->n_masses[k] = i < n ? bodies[k]->n_masses : 0;
    }
    sort_masses(bodies, &order);
    pair->n_chunks = order.n_chunks;
    pair->split = split_of(&order);
    n_masses += order.n_masses;
    g->n_chunks += order.n_chunks;
  }
}

static bool fits(const struct shard *s, const struct mo_gp_group *g)
{
  return mo_gp_shared_bytes(g->n_rows, g->n_masses, g->n_outputs) <= s->options->shared_bytes;
}

/* Returns whether 32 of the largest remaining bodies fit if some of them are replaced by the
 * smallest. s->from_back: the number replaced, at least sixteen, so that no pair has two large
 * bodies, because all others would wait for it. */
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

/* Returns how many robots form the next group, and measures it. 32 if possible, because the weights
 * that a group loads serve all its rows: the largest remaining robots or, if these do not fit, some
 * of them and some of the smallest. Otherwise 16, or fewer in sixteen rows if the shared memory is
 * too small for sixteen large bodies. Returns 0 if not even one fits. */
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

/* Returns an upper bound of the groups of a shard: every group except the last has at least as many
 * robots as bodies of the largest size fit in sixteen rows. */
static size_t groups_at_most(const struct mo_gp_options *options)
{
  uint32_t fewest = HALF;
  while (fewest > 1 && mo_gp_shared_bytes(HALF, fewest * MO_DEFAULT_MASSES, MO_GP_OUTPUT_TILES) >
                           options->shared_bytes)
    fewest--;
  return options->shard / fewest + (size_t)2;
}

static bool has_gradient(const struct mo_task *task)
{
  bool has = task->objective == MO_OBJECTIVE_SUM || course_has_case((uint32_t)task->objective);
  for (uint32_t i = 0; i < task->n_terms; i++)
    has = has && course_has_case(task->terms[i]);
  return has;
}

static void form_shards(void *context, size_t first, size_t end)
{
  for (struct shard *s = (struct shard *)context + first; s < (struct shard *)context + end; s++) {
    s->status = mo_gradient_arrange(s->robots + s->first, s->n, s->order);
    s->end = s->n;
    for (uint32_t i = 0; i < s->n; i++) {
      const struct mo_environment *environment = s->robots[s->first + i].environment;
      if (s->status == MO_OK && (environment->grid != NULL || !has_gradient(&environment->task)))
        s->status = MO_ERR_UNSUPPORTED;
      s->is_special |= mo_environment_is_special(environment);
      s->has_damage |= environment->damage.cut != 0;
      s->works |= mo_task_needs_work(&environment->task);
    }
    while (s->status == MO_OK && s->at < s->end) {
      struct formed *f = &s->formed[s->n_groups++];
      f->group = (struct mo_gp_group){.shard = s->number};
      const uint32_t n = next_group(s, &f->group);
      s->status = n > 0 ? MO_OK : MO_ERR_UNSUPPORTED;
      form(s, f, n);
      s->at += n - s->from_back;
      s->end -= s->from_back;
    }
  }
}

/* ---- filling ---- */

/* Fills in what a special row has; com_start_m: of its robot. */
static void fill_course(const struct shard *s, struct mo_gp_row *row, const double com_start_m[3])
{
  const struct mo_environment *environment = s->robots[row->robot].environment;
  struct mo_gp_course *course = s->plan->courses + (row - s->plan->rows);
  course->special = mo_plan_special_of(environment, s->physics);
  if (mo_task_is_plain(&environment->task))
    return;
  course->is_plain = false;
  course->environment = *environment;
  mo_course_begin(&course->course, environment, &s->physics->scheme, com_start_m, &course->start);
  course->course.environment = NULL;
  course->works = mo_task_needs_work(&environment->task);
  course->stiffness_n_per_m = mo_scene_constants(environment, s->physics).stiffness_n_per_m;
  row->goal.scale_m = course->course.scale_m;
}

/* Fills in a row with a robot, and its masses, starting at `at`. */
static void fill_row(const struct shard *s, struct mo_gp_row *row, uint64_t at)
{
  const struct mo_body *body = s->robots[row->robot].body;
  const struct mo_environment *environment = s->robots[row->robot].environment;
  struct mo_outcome *start = s->plan->starts + row->robot;
  float *position = s->plan->position + 3 * at;
  double position_m[3 * MO_DEFAULT_MASSES], light[3];
  mo_scene_start(body, environment, s->physics, position_m);
  mo_scene_com(position_m, body->n_masses, start->com_start_m);
  mo_scene_light(environment, light);
  for (int axis = 0; axis < 2; axis++)
    row->light_m[axis] = light[axis] - MO_WORLD_CENTER_M;
  row->goal = mo_goal_of(environment, start->com_start_m);
  if (s->plan->courses != NULL)
    fill_course(s, row, start->com_start_m);
  row->scene = mo_plan_scene_of(environment, s->physics);
  row->split = mo_plan_split_of(environment, s->physics);
  for (size_t i = 0; i < body->n_masses; i++) {
    s->plan->input[at + i] = (uint8_t)body->mass_lattice[i];
    for (size_t axis = 0; axis < 3; axis++)
      position[3 * i + axis] =
          (float)(position_m[3 * i + axis] - (axis < 2 ? MO_WORLD_CENTER_M : 0));
  }
  row->n_masses = body->n_masses;
}

static void fill_group(const struct shard *s, const struct mo_gp_group *g, const uint32_t *robot)
{
  uint64_t mass = g->first_mass;
  for (uint32_t w = 0; w < MO_GP_WARPS; w++) {
    struct couple of = {{NULL, NULL}, {NULL, NULL}};
    for (uint32_t i = w, k = 0; i < g->n_rows && k < 2; i += HALF, k++) {
      struct mo_gp_row *row = s->plan->rows + g->first_row + i;
      *row = (struct mo_gp_row){.robot = robot[i]};
      if (s->plan->courses != NULL)
        s->plan->courses[g->first_row + i] =
            (struct mo_gp_course){.special.cut_step = UINT32_MAX, .is_plain = true};
      if (robot[i] == MO_GP_NO_ROBOT)
        continue;
      of.bodies[k] = s->robots[robot[i]].body;
      of.environments[k] = s->robots[robot[i]].environment;
      fill_row(s, row, mass);
      mass += row->n_masses;
    }
    const uint64_t chunk = g->first_chunk + g->pair[w].first_chunk;
    fill_springs(g, &g->pair[w], &of, s->plan->springs + chunk * MO_GP_LANES,
                 s->plan->cuts != NULL ? s->plan->cuts + chunk : NULL);
  }
}

static void fill_shards(void *context, size_t first, size_t end)
{
  for (struct shard *s = (struct shard *)context + first; s < (struct shard *)context + end; s++)
    for (uint32_t k = 0; k < s->n_groups; k++)
      fill_group(s, s->plan->groups + s->first_group + k, s->formed[k].robot);
}

/* ---- the plan ---- */

/* Determines the place of each group, and reserves memory for all of them. */
static int place(struct mo_gradient_plan *plan, struct shard *shards)
{
  bool is_special = false, has_damage = false;
  plan->n_groups = plan->n_rows = 0;
  plan->n_masses = plan->n_chunks = 0;
  plan->works = false;
  for (uint32_t i = 0; i < plan->n_shards; i++) {
    if (shards[i].status < 0)
      return shards[i].status;
    is_special |= shards[i].is_special;
    has_damage |= shards[i].has_damage;
    plan->works |= shards[i].works;
    shards[i].first_group = plan->n_groups;
    plan->n_groups += shards[i].n_groups;
  }
  plan->groups = reserve(plan, GROUPS, plan->n_groups * sizeof(*plan->groups));
  if (plan->groups == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < plan->n_shards; i++)
    for (uint32_t k = 0; k < shards[i].n_groups; k++) {
      struct mo_gp_group *g = &plan->groups[shards[i].first_group + k];
      *g = shards[i].formed[k].group;
      g->first_row = plan->n_rows;
      g->first_mass = plan->n_masses;
      g->first_chunk = plan->n_chunks;
      plan->n_rows += g->n_rows;
      plan->n_masses += g->n_masses;
      plan->n_chunks += g->n_chunks;
    }
  plan->rows = reserve(plan, ROWS, plan->n_rows * sizeof(*plan->rows));
  plan->position = reserve(plan, POSITION, plan->n_masses * 3 * sizeof(*plan->position));
  plan->input = reserve(plan, INPUT, plan->n_masses);
  plan->springs = reserve(plan, SPRINGS, plan->n_chunks * MO_GP_LANES * sizeof(*plan->springs));
  plan->courses = is_special ? reserve(plan, COURSES, plan->n_rows * sizeof(*plan->courses)) : NULL;
  plan->cuts = has_damage ? reserve(plan, CUTS, plan->n_chunks * sizeof(*plan->cuts)) : NULL;
  const bool all = plan->rows != NULL && plan->position != NULL && plan->input != NULL &&
                   plan->springs != NULL && (plan->courses != NULL) == is_special &&
                   (plan->cuts != NULL) == has_damage;
  return all ? MO_OK : MO_ERR_NO_MEMORY;
}

int mo_gradient_plan_make(const struct mo_robot *robots, uint32_t n,
                          const struct mo_physics *physics, const struct mo_gp_options *options,
                          struct mo_gradient_plan *plan)
{
  for (uint32_t i = 0; i < n; i++)
    if (!mo_workspace_equal(robots[i].body->workspace, MO_DEFAULT_WORKSPACE))
      return MO_ERR_UNSUPPORTED;
  const size_t most_groups = groups_at_most(options);
  plan->n = n;
  plan->n_shards = (n + options->shard - 1) / options->shard;
  plan->starts = reserve(plan, STARTS, n * sizeof(*plan->starts));
  uint32_t *order = reserve(plan, ORDER, n * sizeof(*order));
  struct formed *formed = reserve(plan, FORMED, plan->n_shards * most_groups * sizeof(*formed));
  struct shard *shards = reserve(plan, SHARDS, plan->n_shards * sizeof(*shards));
  if (plan->starts == NULL || order == NULL || formed == NULL || shards == NULL)
    return MO_ERR_NO_MEMORY;
  memset(plan->starts, 0, n * sizeof(*plan->starts));
  for (uint32_t i = 0; i < plan->n_shards; i++) {
    const uint32_t first = i * options->shard, left = n - first;
    shards[i] = (struct shard){.robots = robots,
                               .options = options,
                               .number = i,
                               .first = first,
                               .n = left < options->shard ? left : options->shard,
                               .order = order + first,
                               .formed = formed + i * most_groups,
                               .physics = physics,
                               .plan = plan};
  }
  mo_parallel(options->workers, plan->n_shards, form_shards, shards);
  const int status = place(plan, shards);
  if (status == MO_OK)
    mo_parallel(options->workers, plan->n_shards, fill_shards, shards);
  return status;
}

void mo_gradient_plan_free(struct mo_gradient_plan *plan)
{
  for (int m = 0; m < MO_GP_MEMORIES; m++)
    (plan->release != NULL && m < TABLES ? plan->release : free)(plan->memory[m].at);
  *plan = (struct mo_gradient_plan){0};
}
