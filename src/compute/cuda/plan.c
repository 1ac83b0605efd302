/* plan.c: lays out rows, bodies and environments for the device.
 *
 * mo_plan_create and mo_plan_cut do the cheap part, which depends on all rows: they find the
 * bodies, form groups of rows, and assign offsets. mo_plan_measure and mo_plan_fill do the rest of
 * the work, for each body and group independently of the others. */
#include "compute/cuda/plan.h"

#include "base/thread.h"
#include "rollout/carve.h"
#include "rollout/damage.h"
#include "rollout/scene.h"
#include "world/task.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
  PATTERNS = 1 << MO_PLAN_COLUMNS_MAX,
  SIZES_ALIKE = 16, /* masses */
  SIDE_X = 7,
  SIDE_Y = 7,
  SIDE_Z = 5
};

/* ---- distinct pointers ---- */

struct distinct {
  const void **key;
  uint32_t *value;
  uint32_t mask, n;
};

/* Takes memory for n keys; with c->base NULL, only counts it. */
static void carve_distinct(struct distinct *set, struct carver *c, uint32_t n)
{
  uint32_t size = 64;
  while (size < 2 * (uint64_t)n)
    size *= 2;
  *set = (struct distinct){carve(c, size, sizeof(*set->key)), carve(c, size, sizeof(*set->value)),
                           size - 1, 0};
  if (c->base != NULL)
    memset(set->key, 0, size * sizeof(*set->key));
}

/* Returns the number of `key`, in order of first appearance. */
static uint32_t distinct_add(struct distinct *set, const void *key)
{
  uint64_t hash = (uint64_t)(uintptr_t)key * UINT64_C(0x9e3779b97f4a7c15);
  for (uint32_t i = (uint32_t)(hash >> 32) & set->mask;; i = (i + 1) & set->mask) {
    if (set->key[i] == key)
      return set->value[i];
    if (set->key[i] == NULL) {
      set->key[i] = key;
      set->value[i] = set->n;
      return set->n++;
    }
  }
}

/* ---- groups ---- */

/* Returns a group with `rows` more rows of a body. */
static struct mo_plan_group with_rows(const struct mo_plan_group *group,
                                      const struct mo_plan_body *body, uint32_t rows)
{
  struct mo_plan_group more = *group;
  more.n_rows += rows;
  more.n_parts++;
  more.n_places += rows * body->n_masses;
  more.n_lengths += rows * body->n_slots;
  return more;
}

static int fits(const struct mo_plan_options *options, const struct mo_plan_group *group)
{
  return (group->n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN * options->column_bytes +
             group->n_parts * options->part_bytes + group->n_places * options->place_bytes +
             group->n_lengths * options->length_bytes <=
         options->group_bytes;
}

/* Returns the largest number of rows of a body, up to `wanted`, that fit in the group. */
static uint32_t rows_that_fit(const struct mo_plan_options *options,
                              const struct mo_plan_group *group, const struct mo_plan_body *body,
                              uint32_t wanted)
{
  const uint32_t room = options->rows - group->n_rows;
  uint32_t take = wanted < room ? wanted : room;
  for (; take > 0; take--) {
    const struct mo_plan_group more = with_rows(group, body, take);
    if (fits(options, &more))
      break;
  }
  /* A column that would stay nearly empty for lack of memory is not begun. */
  if (take < wanted && take < room) {
    const uint32_t rows = group->n_rows + take, full = rows / MO_PLAN_COLUMN * MO_PLAN_COLUMN;
    if (full > group->n_rows && rows - full < MO_PLAN_COLUMN / 2)
      take = full - group->n_rows;
  }
  return take;
}

/* Cuts the rows, which plan->rows lists body by body, into groups. */
static int cut_groups(struct mo_plan *plan, const struct mo_plan_options *options)
{
  struct mo_plan_group *group = plan->groups;
  uint32_t next_row = 0;
  *group = (struct mo_plan_group){0};
  for (uint32_t b = 0; b < plan->n_bodies; b++) {
    const struct mo_plan_body *body = plan->headers + b;
    for (uint32_t left = plan->rows_of_body[b]; left > 0;) {
      const uint32_t take = rows_that_fit(options, group, body, left);
      if (take == 0) {
        if (group->n_rows == 0)
          return MO_ERR_UNSUPPORTED;
        *++group = (struct mo_plan_group){.first_row = next_row, .first_part = plan->n_parts};
        continue;
      }
      plan->parts[plan->n_parts++] = (struct mo_plan_part){.body = b,
                                                           .first_row = (uint16_t)group->n_rows,
                                                           .n_rows = (uint16_t)take,
                                                           .first_place = group->n_places,
                                                           .first_length = group->n_lengths};
      *group = with_rows(group, body, take);
      next_row += take;
      left -= take;
    }
  }
  plan->n_groups = (uint32_t)(group - plan->groups) + 1;
  for (uint32_t g = 0; g < plan->n_groups; g++)
    plan->groups[g].first_tile = g * MO_PLAN_TILES_MAX;
  return MO_OK;
}

/* ---- creation ---- */

static size_t place(size_t *used, size_t n, size_t size)
{
  const size_t at = *used;
  *used += (n * size + 255) / 256 * 256;
  return at;
}

/* Assumes that every mass leaves all but one of its last links unused. */
static uint32_t quads_at_most(const struct mo_body *body)
{
  return (2 * body->n_springs + (MO_PLAN_LINKS - 1) * body->n_masses) / MO_PLAN_LINKS;
}

/* Returns the space that a body needs in the block, and finds its pairs. */
static struct mo_plan_body measure(const struct mo_plan *plan, const struct mo_body *body,
                                   struct mo_plan_pairs *pairs)
{
  struct mo_plan_body header = {.n_masses = body->n_masses, .n_springs = body->n_springs};
  uint32_t n = 0, n_edges = 0;
  *pairs = (struct mo_plan_pairs){0};
  for (uint32_t s = 0; s < body->n_springs; s++) {
    const uint32_t pair = plan->slots[body->spring_lattice[s]] / 2U;
    pairs->has[pair / 32] |= UINT32_C(1) << pair % 32;
  }
  for (uint32_t w = 0; w < MO_PLAN_PAIR_WORDS; w++) {
    const uint32_t first = 32 * w, edges = MO_PLAN_EDGES / 2;
    const uint32_t edge_bits = first + 32 <= edges ? UINT32_MAX
                               : first < edges     ? (UINT32_C(1) << (edges - first)) - 1
                                                   : 0;
    pairs->before[w] = (uint16_t)n;
    n += (uint32_t)__builtin_popcount(pairs->has[w]);
    n_edges += (uint32_t)__builtin_popcount(pairs->has[w] & edge_bits);
  }
  header.n_slots = 2 * n;
  header.n_edges = 2 * n_edges;
  return header;
}

static void lay_out(struct mo_plan *plan)
{
  uint32_t n_quads = 0, n_masses = 0, n_voxels = 0;
  for (uint32_t b = 0; b < plan->n_bodies; b++) {
    plan->headers[b].first_quad = n_quads;
    plan->headers[b].first_mass = n_masses;
    n_quads += quads_at_most(plan->bodies[b]);
    n_masses += plan->bodies[b]->n_masses;
    n_voxels += plan->bodies[b]->n_voxels;
  }
  struct mo_plan_block *block = &plan->block;
  size_t used = 0;
  block->environments = place(&used, plan->n_environments, sizeof(struct mo_plan_environment));
  block->bodies = place(&used, plan->n_bodies, sizeof(struct mo_plan_body));
  block->pairs = place(&used, plan->n_bodies, sizeof(struct mo_plan_pairs));
  block->links = place(&used, n_quads, MO_PLAN_LINKS * sizeof(uint32_t));
  block->masses = place(&used, n_masses, sizeof(uint32_t));
  block->ranks = place(&used, n_masses, 1);
  block->inputs = place(&used, plan->n_bodies, MO_PLAN_INPUTS);
  block->groups = place(&used, plan->n_groups, sizeof(struct mo_plan_group));
  block->parts = place(&used, plan->n_parts, sizeof(struct mo_plan_part));
  block->rows = place(&used, plan->n, sizeof(struct mo_plan_row));
  block->tiles =
      place(&used, (size_t)plan->n_groups * MO_PLAN_TILES_MAX, sizeof(struct mo_plan_tile));
  block->columns = place(&used, (size_t)plan->n_groups * MO_PLAN_TILES_MAX, sizeof(uint16_t));
  block->tasks =
      place(&used, plan->is_special ? plan->n_environments : 0, sizeof(struct mo_environment));
  const uint32_t some = plan->observes ? 1 : 0;
  block->rest = place(&used, (size_t)some * n_masses, sizeof(struct mo_plan_rest));
  block->voxels = place(&used, (size_t)some * plan->n_bodies, sizeof(struct mo_plan_voxels));
  block->corners = place(&used, (size_t)some * n_voxels, sizeof(struct mo_plan_corners));
  block->bytes = used;
}

/* Bodies of nearly the same size with similar boxes share most of their springs, so they are
 * adjacent in the order, the largest first, so that the last groups to start are short. Along each
 * axis the order alternates in direction, so that neighbors in the order differ little. */
static uint32_t body_key(const struct mo_body *body)
{
  uint32_t low[3] = {UINT16_MAX, UINT16_MAX, UINT16_MAX}, high[3] = {0, 0, 0}, key;
  for (uint32_t m = 0; m < body->n_masses; m++)
    for (int axis = 0; axis < 3; axis++) {
      const uint32_t at = body->mass_xyz[3 * (size_t)m + (size_t)axis];
      low[axis] = at < low[axis] ? at : low[axis];
      high[axis] = at > high[axis] ? at : high[axis];
    }
  key = high[2] - low[2];
  key = key * 8 + (key % 2 != 0 ? 7 - (high[0] - low[0]) : high[0] - low[0]);
  key = key * 8 + (key % 2 != 0 ? 7 - (high[1] - low[1]) : high[1] - low[1]);
  return (MO_DEFAULT_MASSES - body->n_masses) / SIZES_ALIKE << 16 | key;
}

static int ascending(const void *a, const void *b)
{
  const uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;
  return (x > y) - (x < y);
}

/* Sorts bodies and their measurements by body_key, then by appearance; then sorts the rows by body.
 */
static void arrange(struct mo_plan *plan)
{
  const uint32_t n = plan->n_bodies;
  uint32_t *number = plan->number, *next = number + n;
  qsort(plan->keys, n, sizeof(*plan->keys), ascending);
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t b = (uint32_t)plan->keys[i];
    number[b] = i;
    plan->bodies[i] = plan->found[b];
    plan->headers[i] = plan->measured[b];
    plan->pairs[i] = plan->measured_pairs[b];
  }
  memset(plan->rows_of_body, 0, n * sizeof(*plan->rows_of_body));
  for (uint32_t r = 0; r < plan->n; r++)
    plan->rows_of_body[number[plan->body_of[r]]]++;
  for (uint32_t b = 0, first = 0; b < n; first += plan->rows_of_body[b++])
    next[b] = first;
  for (uint32_t r = 0; r < plan->n; r++)
    plan->rows[next[number[plan->body_of[r]]]++] =
        (struct mo_plan_row){.row = r, .environment = plan->environment_of[r]};
}

/* Numbers bodies and environments by appearance. */
static int find(struct mo_plan *plan, struct distinct *bodies, struct distinct *environments)
{
  for (uint32_t r = 0; r < plan->n; r++) {
    const struct mo_robot *robot = plan->robots + r;
    const int again = r > 0 && robot->body == robot[-1].body;
    if (!again && !mo_workspace_equal(robot->body->workspace, MO_DEFAULT_WORKSPACE))
      return MO_ERR_UNSUPPORTED;
    plan->body_of[r] = again ? plan->body_of[r - 1] : distinct_add(bodies, robot->body);
    plan->found[plan->body_of[r]] = robot->body;
    plan->environment_of[r] = distinct_add(environments, robot->environment);
    plan->environments[plan->environment_of[r]] = robot->environment;
  }
  plan->n_bodies = bodies->n;
  plan->n_environments = environments->n;
  for (uint32_t e = 0; e < plan->n_environments; e++) {
    if (plan->environments[e]->grid != NULL)
      return MO_ERR_UNSUPPORTED;
    const struct mo_task *task = &plan->environments[e]->task;
    plan->has_tally |= mo_task_has_tally(task);
    plan->observes |= mo_task_needs_work(task) || mo_task_measures(task) != 0;
    plan->is_special |= mo_environment_is_special(plan->environments[e]);
    plan->has_damage |= plan->environments[e]->damage.cut != 0;
  }
  return MO_OK;
}

/* Lays out the plan's own memory, most of which is touched only in proportion to the number of
 * bodies; with base NULL, only counts it. */
static size_t carve_plan(struct mo_plan *plan, struct distinct *bodies,
                         struct distinct *environments, char *base)
{
  struct carver c = {base, 0};
  const uint32_t n = plan->n;
  plan->bodies = carve(&c, n, sizeof(struct mo_body *));
  plan->found = carve(&c, n, sizeof(struct mo_body *));
  plan->environments = carve(&c, n, sizeof(struct mo_environment *));
  plan->headers = carve(&c, n, sizeof(*plan->headers));
  plan->measured = carve(&c, n, sizeof(*plan->measured));
  plan->pairs = carve(&c, n, sizeof(*plan->pairs));
  plan->measured_pairs = carve(&c, n, sizeof(*plan->measured_pairs));
  plan->slots = carve(&c, MO_DEFAULT_SPRINGS, sizeof(*plan->slots));
  plan->groups = carve(&c, n, sizeof(*plan->groups));
  plan->parts = carve(&c, 2 * (size_t)n, sizeof(*plan->parts));
  plan->rows = carve(&c, n, sizeof(*plan->rows));
  plan->body_of = carve(&c, n, sizeof(*plan->body_of));
  plan->environment_of = carve(&c, n, sizeof(*plan->environment_of));
  plan->rows_of_body = carve(&c, n, sizeof(*plan->rows_of_body));
  plan->number = carve(&c, 2 * (size_t)n, sizeof(*plan->number));
  plan->keys = carve(&c, n, sizeof(*plan->keys));
  carve_distinct(bodies, &c, n);
  carve_distinct(environments, &c, n);
  return c.used;
}

int mo_plan_create(struct mo_plan *plan, const struct mo_robot *robots, uint32_t n,
                   const struct mo_physics *physics, bool observes)
{
  struct distinct bodies, environments;
  *plan = (struct mo_plan){
      .robots = robots, .n = n, .physics = physics, .is_special = observes, .observes = observes};
  plan->memory = malloc(carve_plan(plan, &bodies, &environments, NULL));
  if (plan->memory == NULL)
    return MO_ERR_NO_MEMORY;
  carve_plan(plan, &bodies, &environments, plan->memory);
  const int status = mo_plan_slots(plan->slots);
  return status == MO_OK ? find(plan, &bodies, &environments) : status;
}

static void measure_some(void *context, size_t first, size_t end)
{
  struct mo_plan *plan = context;
  for (size_t b = first; b < end; b++) {
    plan->measured[b] = measure(plan, plan->found[b], plan->measured_pairs + b);
    plan->keys[b] = (uint64_t)body_key(plan->found[b]) << 32 | b;
  }
}

void mo_plan_measure(struct mo_plan *plan, uint32_t n_threads)
{
  mo_parallel(n_threads, plan->n_bodies, measure_some, plan);
}

int mo_plan_cut(struct mo_plan *plan, const struct mo_plan_options *options)
{
  arrange(plan);
  const int status = cut_groups(plan, options);
  if (status == MO_OK)
    lay_out(plan);
  return status;
}

void mo_plan_free(struct mo_plan *plan)
{
  free(plan->memory);
  *plan = (struct mo_plan){0};
}

/* ---- the first layer's inputs ---- */

/* Returns a sort key: twice the horizontal distance of a lattice column from the middle, by the
 * larger axis, then by the other; the floor first. */
static int input_key(int mass)
{
  const int x = mass / (SIDE_Y * SIDE_Z) - SIDE_X / 2, y = mass / SIDE_Z % SIDE_Y - SIDE_Y / 2,
            z = mass % SIDE_Z;
  return x * x + y * y + z * z;
}

struct input_order {
  int16_t mass[MO_PLAN_INPUTS];
  uint8_t input[MO_DEFAULT_MASSES];
};

static void order_inputs(struct input_order *order)
{
  int n = 0;
  for (int key = 0; n < MO_DEFAULT_MASSES; key++)
    for (int mass = 0; mass < MO_DEFAULT_MASSES; mass++)
      if (input_key(mass) == key) {
        order->input[mass] = (uint8_t)n;
        order->mass[n++] = (int16_t)mass;
      }
  while (n < MO_PLAN_INPUTS)
    order->mass[n++] = -1;
}

int mo_plan_input_mass(uint32_t input)
{
  struct input_order order;
  order_inputs(&order);
  return input < MO_PLAN_INPUTS ? order.mass[input] : -1;
}

/* ---- pairs of springs ---- */

/* Returns a sort key that the springs of a pair share: edges first, by direction and line, then
 * diagonals, by the middle of their face. */
static uint32_t pair_key(uint32_t a, uint32_t b)
{
  const uint32_t xyz_a[3] = {a / (SIDE_Y * SIDE_Z), a / SIDE_Z % SIDE_Y, a % SIDE_Z};
  const uint32_t xyz_b[3] = {b / (SIDE_Y * SIDE_Z), b / SIDE_Z % SIDE_Y, b % SIDE_Z};
  uint32_t sum[3]; /* twice the middle */
  for (int axis = 0; axis < 3; axis++)
    sum[axis] = xyz_a[axis] + xyz_b[axis];
  const uint32_t middle = (sum[0] * 16 + sum[1]) * 16 + sum[2];
  const uint32_t direction = sum[0] % 2 != 0 ? 0 : sum[1] % 2 != 0 ? 1 : 2;
  const bool diagonal = sum[0] % 2 + sum[1] % 2 + sum[2] % 2 > 1;
  return diagonal ? 1U << 16 | middle : direction << 14 | middle;
}

struct keyed {
  uint32_t key, spring;
};

static int by_key(const void *a, const void *b)
{
  const struct keyed *x = a, *y = b;
  if (x->key != y->key)
    return x->key < y->key ? -1 : 1;
  return (x->spring > y->spring) - (x->spring < y->spring);
}

int mo_plan_slots(uint16_t *slots)
{
  struct mo_lattice *lattice = NULL;
  struct keyed keyed[MO_DEFAULT_SPRINGS];
  const int status = mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice);
  if (status != MO_OK)
    return status;
  for (uint32_t s = 0; s < MO_DEFAULT_SPRINGS; s++)
    keyed[s] = (struct keyed){pair_key(lattice->spring_a[s], lattice->spring_b[s]), s};
  mo_lattice_free(lattice);
  qsort(keyed, MO_DEFAULT_SPRINGS, sizeof(*keyed), by_key);
  for (uint32_t slot = 0; slot < MO_DEFAULT_SPRINGS; slot++)
    slots[keyed[slot].spring] = (uint16_t)slot;
  return MO_OK;
}

/* ---- filling ---- */

struct mo_plan_scene mo_plan_scene_of(const struct mo_environment *environment,
                                      const struct mo_physics *physics)
{
  struct mo_plan_scene scene;
  double light[3];
  mo_scene_light(environment, light);
  for (int axis = 0; axis < 3; axis++)
    scene.light[axis] = (float)(light[axis] - (axis < 2 ? MO_WORLD_CENTER_M : 0));
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    scene.heights[k] = (float)environment->terrain_heights_m[k];
  const double top = mo_terrain_highest(environment);
  scene.highest = (float)(top + 1e-6 * (1 + fabs(top)));
  const struct mo_constants constants = mo_scene_constants(environment, physics);
  scene.constants = lane_both_of(&physics->scheme, &constants, false).physics;
  return scene;
}

struct mo_plan_split mo_plan_split_of(const struct mo_environment *environment,
                                      const struct mo_physics *physics)
{
  const struct mo_constants constants = mo_scene_constants(environment, physics);
  const struct lane_both_constants other = lane_both_of(&physics->scheme, &constants, false),
                                   first = lane_both_of(&physics->scheme, &constants, true);
  return (struct mo_plan_split){other.split, first.physics.pull, first.physics.fall,
                                first.split.per_push};
}

struct mo_plan_special mo_plan_special_of(const struct mo_environment *environment,
                                          const struct mo_physics *physics)
{
  return (struct mo_plan_special){lane_cells_of(environment), environment->damage.cut,
                                  mo_damage_step(environment, &physics->scheme)};
}

bool mo_environment_is_special(const struct mo_environment *environment)
{
  return environment->n_profile != 0 || environment->damage.cut != 0 ||
         !mo_task_is_plain(&environment->task);
}

/* Returns a body's own slot for a slot of the lattice. */
static uint32_t own_slot(const struct mo_plan_pairs *pairs, uint32_t slot)
{
  const uint32_t pair = slot / 2, before = pairs->has[pair / 32] & ((UINT32_C(1) << pair % 32) - 1);
  return 2 * (pairs->before[pair / 32] + (uint32_t)__builtin_popcount(before)) + slot % 2;
}

/* Finds the octant of each of a body's springs (rollout/damage.h). */
static void find_octants(const struct mo_body *body, uint8_t *octant)
{
  uint8_t cut[MO_DEFAULT_SPRINGS];
  for (uint8_t o = 0; o < MO_OCTANTS; o++) {
    const struct mo_environment environment = {.damage.cut = 1U + o};
    mo_damage_mark(&environment, body, cut);
    for (uint32_t s = 0; s < body->n_springs; s++)
      if (cut[s] != 0)
        octant[s] = o;
  }
}

static void fill_body(const struct mo_body *body, bool has_damage, const struct input_order *order,
                      const uint16_t *slots, const struct mo_plan_pairs *pairs, uint32_t *links,
                      uint32_t *masses, uint8_t *ranks, uint8_t *inputs)
{
  const uint32_t n = body->n_masses;
  uint8_t degree[MO_DEFAULT_MASSES] = {0}, used[MO_DEFAULT_MASSES] = {0};
  uint16_t begin[MO_PLAN_DEGREES_MAX + 1] = {0}, quad_of[MO_DEFAULT_MASSES];
  for (uint32_t s = 0; s < body->n_springs; s++) {
    degree[body->spring_a[s]]++;
    degree[body->spring_b[s]]++;
  }
  for (uint32_t m = 0; m < n; m++)
    begin[degree[m]]++;
  uint16_t more = 0;
  for (int d = MO_PLAN_DEGREES_MAX; d >= 0; d--) {
    const uint16_t with = begin[d];
    begin[d] = more;
    more = (uint16_t)(more + with);
  }
  uint8_t listed[MO_DEFAULT_MASSES], octant[MO_DEFAULT_SPRINGS];
  memset(inputs, 0, MO_PLAN_INPUTS);
  for (uint32_t m = 0; m < n; m++) {
    ranks[m] = (uint8_t)begin[degree[m]]++;
    listed[ranks[m]] = (uint8_t)m;
    inputs[MO_PLAN_INPUT_OF(ranks[m])] = order->input[body->mass_lattice[m]];
  }
  uint32_t quad = 0;
  for (uint32_t rank = 0; rank < n; rank++) {
    const uint32_t m = listed[rank], quads = (degree[m] + MO_PLAN_LINKS - 1U) / MO_PLAN_LINKS;
    const uint16_t *xyz = body->mass_xyz + 3 * (size_t)m;
    masses[rank] = MO_PLAN_MASS(xyz[0], xyz[1], xyz[2], quads, quad);
    quad_of[m] = (uint16_t)quad;
    quad += quads;
  }
  if (has_damage)
    find_octants(body, octant);
  for (uint32_t s = 0; s < body->n_springs; s++) {
    const uint32_t a = body->spring_a[s], b = body->spring_b[s];
    const uint32_t slot = own_slot(pairs, slots[body->spring_lattice[s]]);
    const uint32_t part = has_damage ? MO_PLAN_LINK_PART(octant[s]) : 0;
    links[MO_PLAN_LINKS * quad_of[a] + used[a]++] = MO_PLAN_LINK(slot, ranks[b]) | part;
    links[MO_PLAN_LINKS * quad_of[b] + used[b]++] = MO_PLAN_LINK(slot, ranks[a]) | part;
  }
  for (uint32_t m = 0; m < n; m++) /* of length 0: such a link has no force, no matter which of the
                                    * mass's springs it refers to */
    for (uint32_t *first = links + MO_PLAN_LINKS * quad_of[m]; used[m] % MO_PLAN_LINKS != 0;
         used[m]++)
      first[used[m]] = MO_PLAN_LINK(MO_PLAN_LINK_SLOT_OF(first[0]), ranks[m]);
}

/* Fills in the pairs of a group, sorted by the columns that have them, in Gray-code order of these
 * patterns, so that a tile with the end of one pattern and the start of the next wastes little. */
static uint32_t fill_tiles(const struct mo_plan *plan, const struct mo_plan_group *group,
                           struct mo_plan_tile *tiles, uint16_t *columns)
{
  uint32_t has[MO_PLAN_COLUMNS_MAX][MO_PLAN_PAIR_WORDS] = {{0}};
  for (uint32_t p = 0; p < group->n_parts; p++) {
    const struct mo_plan_part *part = plan->parts + group->first_part + p;
    const uint32_t last = (part->first_row + part->n_rows - 1U) / MO_PLAN_COLUMN;
    for (uint32_t c = part->first_row / MO_PLAN_COLUMN; c <= last; c++)
      for (int w = 0; w < MO_PLAN_PAIR_WORDS; w++)
        has[c][w] |= plan->pairs[part->body].has[w];
  }
  uint16_t list[MO_PLAN_PAIRS];
  uint16_t pattern_of[MO_PLAN_PAIRS];
  uint32_t n = 0, count[PATTERNS] = {0}, next[PATTERNS];
  for (uint32_t w = 0; w < MO_PLAN_PAIR_WORDS; w++) {
    uint32_t any = 0;
    for (int c = 0; c < MO_PLAN_COLUMNS_MAX; c++)
      any |= has[c][w];
    for (; any != 0; any &= any - 1) {
      const int bit = __builtin_ctz(any);
      uint32_t pattern = 0;
      for (int c = 0; c < MO_PLAN_COLUMNS_MAX; c++)
        pattern |= (uint32_t)(has[c][w] >> bit & 1) << c;
      list[n] = (uint16_t)(w * 32 + (uint32_t)bit);
      pattern_of[n++] = (uint16_t)pattern;
      count[pattern]++;
    }
  }
  for (uint32_t i = 0, first = 0; i < PATTERNS; i++) {
    const uint32_t pattern = i ^ i >> 1;
    next[pattern] = first;
    first += count[pattern];
  }
  const uint32_t n_tiles = (n + MO_PLAN_TILE - 1) / MO_PLAN_TILE;
  memset(columns, 0, MO_PLAN_TILES_MAX * sizeof(*columns));
  memset(tiles, 0xff, MO_PLAN_TILES_MAX * sizeof(*tiles));
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t at = next[pattern_of[i]]++;
    tiles[at / MO_PLAN_TILE].pair[at % MO_PLAN_TILE] = list[i];
    columns[at / MO_PLAN_TILE] |= pattern_of[i];
  }
  return n_tiles;
}

static uint32_t input_tiles_of(const struct mo_plan *plan, const struct mo_plan_group *group,
                               const struct input_order *order)
{
  uint32_t tiles = 0;
  for (uint32_t p = 0; p < group->n_parts; p++) {
    const struct mo_body *body = plan->bodies[plan->parts[group->first_part + p].body];
    for (uint32_t m = 0; m < body->n_masses; m++)
      tiles |= UINT32_C(1) << order->input[body->mass_lattice[m]] / 16;
  }
  return tiles;
}

/* Fills the tables of observe.h for a share of the bodies. */
static void fill_tables(const struct mo_plan *plan, char *base, uint32_t share, uint32_t n_shares)
{
  const struct mo_plan_block *block = &plan->block;
  struct mo_plan_rest *rest = (struct mo_plan_rest *)(void *)(base + block->rest);
  struct mo_plan_voxels *voxels = (struct mo_plan_voxels *)(void *)(base + block->voxels);
  struct mo_plan_corners *corners = (struct mo_plan_corners *)(void *)(base + block->corners);
  uint32_t first = 0;
  for (uint32_t b = 0; b < plan->n_bodies; first += plan->bodies[b++]->n_voxels) {
    const uint32_t first_mass = plan->headers[b].first_mass;
    if (b % n_shares != share)
      continue;
    voxels[b] = (struct mo_plan_voxels){first, plan->bodies[b]->n_voxels};
    mo_observe_tables(plan->bodies[b], (const uint8_t *)(base + block->ranks) + first_mass,
                      rest + first_mass, corners + first);
  }
}

/* Fills share `share` of n: every n-th body, environment and group, starting with that number,
 * because the first ones are larger. */
static void fill_share(const struct mo_plan *plan, void *memory, uint32_t share, uint32_t n_shares)
{
  const struct mo_plan_block *block = &plan->block;
  char *base = memory;
  struct input_order order;
  order_inputs(&order);
  struct mo_plan_environment *environments = (void *)(base + block->environments);
  struct mo_environment *tasks = (void *)(base + block->tasks);
  struct mo_plan_body *bodies = (struct mo_plan_body *)(void *)(base + block->bodies);
  uint32_t *links = (uint32_t *)(void *)(base + block->links),
           *masses = (uint32_t *)(void *)(base + block->masses);
  uint8_t *ranks = (uint8_t *)(base + block->ranks), *inputs = (uint8_t *)(base + block->inputs);
  for (uint32_t b = share; b < plan->n_bodies; b += n_shares) {
    const struct mo_plan_body header = plan->headers[b];
    fill_body(plan->bodies[b], plan->has_damage, &order, plan->slots, plan->pairs + b,
              links + (size_t)MO_PLAN_LINKS * header.first_quad, masses + header.first_mass,
              ranks + header.first_mass, inputs + (size_t)b * MO_PLAN_INPUTS);
    bodies[b] = header;
  }
  if (plan->observes)
    fill_tables(plan, base, share, n_shares);
  for (uint32_t e = share; e < plan->n_environments; e += n_shares) {
    memcpy(environments[e].heights_m, plan->environments[e]->terrain_heights_m,
           sizeof(environments[e].heights_m));
    environments[e].scene = mo_plan_scene_of(plan->environments[e], plan->physics);
    environments[e].split = mo_plan_split_of(plan->environments[e], plan->physics);
    environments[e].special = mo_plan_special_of(plan->environments[e], plan->physics);
    environments[e].drop_m = mo_scene_drop_m(plan->environments[e], plan->physics);
    if (plan->is_special)
      tasks[e] = *plan->environments[e];
  }
  struct mo_plan_group *groups = (struct mo_plan_group *)(void *)(base + block->groups);
  for (uint32_t g = share; g < plan->n_groups; g += n_shares) {
    struct mo_plan_group group = plan->groups[g];
    group.n_tiles = fill_tiles(
        plan, &group, (struct mo_plan_tile *)(void *)(base + block->tiles) + group.first_tile,
        (uint16_t *)(void *)(base + block->columns) + group.first_tile);
    group.input_tiles = input_tiles_of(plan, &group, &order);
    groups[g] = group;
  }
  if (share == 0) {
    memcpy(base + block->pairs, plan->pairs, plan->n_bodies * sizeof(*plan->pairs));
    memcpy(base + block->parts, plan->parts, plan->n_parts * sizeof(*plan->parts));
    memcpy(base + block->rows, plan->rows, plan->n * sizeof(*plan->rows));
  }
}

struct filling {
  const struct mo_plan *plan;
  void *block;
  uint32_t n_shares;
};

static void fill_shares(void *context, size_t first, size_t end)
{
  const struct filling *f = context;
  for (size_t share = first; share < end; share++)
    fill_share(f->plan, f->block, (uint32_t)share, f->n_shares);
}

void mo_plan_fill(const struct mo_plan *plan, void *block, uint32_t n_threads)
{
  struct filling filling = {plan, block, n_threads};
  mo_parallel(n_threads, n_threads, fill_shares, &filling);
}
