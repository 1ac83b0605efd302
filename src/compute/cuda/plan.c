/* plan.c: rows, bodies and environments laid out for the device.
 *
 * mo_plan_create does what depends on all rows and is cheap: which bodies there are, which rows form a group, where everything will lie.
 * mo_plan_fill does the work, body by body and group by group, each independent of the others. */
#include "compute/cuda/plan.h"

#include <stdlib.h>
#include <string.h>

enum {
  PAIR_WORDS = (MO_PLAN_PAIRS + 63) / 64,
  PATTERNS = 1 << MO_PLAN_COLUMNS_MAX,
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

static int distinct_create(struct distinct *set, uint32_t n)
{
  uint32_t size = 64;
  while (size < 2 * (uint64_t)n)
    size *= 2;
  *set = (struct distinct){calloc(size, sizeof(*set->key)), malloc(size * sizeof(*set->value)), size - 1, 0};
  return set->key == NULL || set->value == NULL ? MO_ERR_NO_MEMORY : MO_OK;
}

static void distinct_free(struct distinct *set)
{
  free(set->key);
  free(set->value);
}

/* The number of `key`, in order of first appearance. */
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

static size_t group_bytes(const struct mo_plan_options *options, uint32_t rows, uint32_t places)
{
  return (rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN * options->column_bytes + places * options->place_bytes;
}

/* Most rows of a body with n_masses, up to `wanted`, that fit beside what the group has. */
static uint32_t rows_that_fit(const struct mo_plan_options *options, const struct mo_plan_group *group,
                              uint32_t n_masses, uint32_t wanted)
{
  const uint32_t room = options->rows - group->n_rows;
  uint32_t take = wanted < room ? wanted : room;
  while (take > 0 &&
         group_bytes(options, group->n_rows + take, group->n_places + take * n_masses) > options->group_bytes)
    take--;
  /* A column that would stay nearly empty for want of memory is not begun. */
  if (take < wanted && take < room) {
    const uint32_t rows = group->n_rows + take, full = rows / MO_PLAN_COLUMN * MO_PLAN_COLUMN;
    if (full > group->n_rows && rows - full < MO_PLAN_COLUMN / 2)
      take = full - group->n_rows;
  }
  return take;
}

/* Cuts the rows, which stand body by body in plan->rows, into groups. */
static int cut_groups(struct mo_plan *plan, const struct mo_plan_options *options, const uint32_t *rows_of_body)
{
  struct mo_plan_group *group = plan->groups;
  uint32_t next_row = 0;
  *group = (struct mo_plan_group){0};
  for (uint32_t b = 0; b < plan->n_bodies; b++) {
    const uint32_t n_masses = plan->bodies[b]->n_masses;
    for (uint32_t left = rows_of_body[b]; left > 0;) {
      const uint32_t take = rows_that_fit(options, group, n_masses, left);
      if (take == 0) {
        if (group->n_rows == 0)
          return MO_ERR_UNSUPPORTED;
        *++group = (struct mo_plan_group){.first_row = next_row, .first_part = plan->n_parts};
        continue;
      }
      plan->parts[plan->n_parts++] = (struct mo_plan_part){
          .body = b, .first_row = (uint16_t)group->n_rows, .n_rows = (uint16_t)take, .first_place = group->n_places};
      group->n_rows += take;
      group->n_parts++;
      group->n_places += take * n_masses;
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

/* Every mass may leave all but one of its last links unused. */
static uint32_t quads_at_most(const struct mo_body *body)
{
  return (2 * body->n_springs + (MO_PLAN_LINKS - 1) * body->n_masses) / MO_PLAN_LINKS;
}

static void lay_out(struct mo_plan *plan)
{
  uint32_t n_quads = 0, n_masses = 0;
  for (uint32_t b = 0; b < plan->n_bodies; b++) {
    const struct mo_body *body = plan->bodies[b];
    plan->headers[b] = (struct mo_plan_body){
        .n_masses = body->n_masses, .n_springs = body->n_springs, .first_quad = n_quads, .first_mass = n_masses};
    n_quads += quads_at_most(body);
    n_masses += body->n_masses;
  }
  struct mo_plan_block *block = &plan->block;
  size_t used = 0;
  block->environments = place(&used, plan->n_environments, MO_PLAN_ENVIRONMENT_DOUBLES * sizeof(double));
  block->bodies = place(&used, plan->n_bodies, sizeof(struct mo_plan_body));
  block->links = place(&used, n_quads, MO_PLAN_LINKS * sizeof(uint32_t));
  block->masses = place(&used, n_masses, sizeof(uint32_t));
  block->ranks = place(&used, n_masses, 1);
  block->inputs = place(&used, plan->n_bodies, MO_PLAN_INPUTS);
  block->groups = place(&used, plan->n_groups, sizeof(struct mo_plan_group));
  block->parts = place(&used, plan->n_parts, sizeof(struct mo_plan_part));
  block->rows = place(&used, plan->n, sizeof(struct mo_plan_row));
  block->tiles = place(&used, (size_t)plan->n_groups * MO_PLAN_TILES_MAX, sizeof(struct mo_plan_tile));
  block->columns = place(&used, (size_t)plan->n_groups * MO_PLAN_TILES_MAX, 1);
  block->bytes = used;
}

/* Orders bodies by falling size (then by appearance) and the rows by body. found: body of each row by appearance. */
static int arrange(struct mo_plan *plan, const uint32_t *found, const struct mo_body *const *bodies,
                   const uint32_t *environment_of, uint32_t *rows_of_body)
{
  uint32_t begin[MO_DEFAULT_MASSES + 2] = {0};
  uint32_t *number = malloc(2 * (size_t)plan->n * sizeof(*number));
  if (number == NULL)
    return MO_ERR_NO_MEMORY;
  uint32_t *next = number + plan->n_bodies;
  for (uint32_t b = 0; b < plan->n_bodies; b++)
    begin[MO_DEFAULT_MASSES - bodies[b]->n_masses + 1]++;
  for (int i = 1; i <= MO_DEFAULT_MASSES; i++)
    begin[i] += begin[i - 1];
  for (uint32_t b = 0; b < plan->n_bodies; b++) {
    number[b] = begin[MO_DEFAULT_MASSES - bodies[b]->n_masses]++;
    plan->bodies[number[b]] = bodies[b];
  }
  memset(rows_of_body, 0, plan->n_bodies * sizeof(*rows_of_body));
  for (uint32_t r = 0; r < plan->n; r++)
    rows_of_body[number[found[r]]]++;
  for (uint32_t b = 0, first = 0; b < plan->n_bodies; first += rows_of_body[b++])
    next[b] = first;
  for (uint32_t r = 0; r < plan->n; r++)
    plan->rows[next[number[found[r]]]++] = (struct mo_plan_row){.row = r, .environment = environment_of[r]};
  free(number);
  return MO_OK;
}

static int is_default(const struct mo_body *body)
{
  return body->workspace.nx == SIDE_X - 1 && body->workspace.ny == SIDE_Y - 1 && body->workspace.nz == SIDE_Z - 1;
}

/* Numbers bodies and environments by appearance; then everything that is sized by their number. */
static int find(struct mo_plan *plan, struct distinct *bodies, struct distinct *environments, uint32_t *found,
                const struct mo_plan_options *options)
{
  const uint32_t n = plan->n;
  uint32_t *environment_of = found + n, *rows_of_body = found + 2 * (size_t)n;
  const struct mo_body **by_appearance = malloc(n * sizeof(const struct mo_body *));
  plan->environments = malloc(n * sizeof(const struct mo_environment *));
  plan->rows = malloc(n * sizeof(*plan->rows));
  plan->parts = malloc(2 * (size_t)n * sizeof(*plan->parts));
  plan->groups = malloc((size_t)n * sizeof(*plan->groups));
  int status = by_appearance == NULL || plan->environments == NULL || plan->rows == NULL || plan->parts == NULL ||
                       plan->groups == NULL
                   ? MO_ERR_NO_MEMORY
                   : MO_OK;
  for (uint32_t r = 0; status == MO_OK && r < n; r++) {
    const struct mo_robot *robot = plan->robots + r;
    const int again = r > 0 && robot->body == robot[-1].body;
    if (!again && !is_default(robot->body)) {
      status = MO_ERR_UNSUPPORTED;
      break;
    }
    found[r] = again ? found[r - 1] : distinct_add(bodies, robot->body);
    by_appearance[found[r]] = robot->body;
    environment_of[r] = distinct_add(environments, robot->environment);
    plan->environments[environment_of[r]] = robot->environment;
  }
  if (status == MO_OK) {
    plan->n_bodies = bodies->n;
    plan->n_environments = environments->n;
    plan->bodies = malloc(n * sizeof(const struct mo_body *));
    plan->headers = malloc(n * sizeof(*plan->headers));
    status = plan->bodies == NULL || plan->headers == NULL
                 ? MO_ERR_NO_MEMORY
                 : arrange(plan, found, by_appearance, environment_of, rows_of_body);
  }
  if (status == MO_OK)
    status = cut_groups(plan, options, rows_of_body);
  if (status == MO_OK)
    lay_out(plan);
  free(by_appearance);
  return status;
}

int mo_plan_create(struct mo_plan *plan, const struct mo_robot *robots, uint32_t n,
                   const struct mo_plan_options *options)
{
  *plan = (struct mo_plan){.robots = robots, .n = n};
  if (n == 0 || options->rows < 1 || options->rows > MO_PLAN_ROWS_MAX)
    return MO_ERR_INVALID;
  struct distinct bodies = {0}, environments = {0};
  uint32_t *found = malloc(3 * (size_t)n * sizeof(*found));
  plan->slots = malloc(MO_DEFAULT_SPRINGS * sizeof(*plan->slots));
  int status = found == NULL || plan->slots == NULL ? MO_ERR_NO_MEMORY : mo_plan_slots(plan->slots);
  if (status == MO_OK)
    status = distinct_create(&bodies, n);
  if (status == MO_OK)
    status = distinct_create(&environments, n);
  if (status == MO_OK)
    status = find(plan, &bodies, &environments, found, options);
  distinct_free(&bodies);
  distinct_free(&environments);
  free(found);
  return status;
}

void mo_plan_free(struct mo_plan *plan)
{
  free((void *)plan->bodies);
  free((void *)plan->environments);
  free(plan->headers);
  free(plan->slots);
  free(plan->groups);
  free(plan->parts);
  free(plan->rows);
  *plan = (struct mo_plan){0};
}

/* ---- the first layer's inputs ---- */

/* Twice the horizontal distance of a lattice column from the middle, by the larger axis, then by the other; the floor first. */
static int input_key(int mass)
{
  const int x = mass / (SIDE_Y * SIDE_Z) - SIDE_X / 2, y = mass / SIDE_Z % SIDE_Y - SIDE_Y / 2, z = mass % SIDE_Z;
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

/* What the springs of a pair have in common, and what comes first: edges by direction and line, then diagonals by the middle of their
 * face. */
static uint32_t pair_key(uint32_t a, uint32_t b, int diagonal)
{
  const uint32_t xyz_a[3] = {a / (SIDE_Y * SIDE_Z), a / SIDE_Z % SIDE_Y, a % SIDE_Z};
  const uint32_t xyz_b[3] = {b / (SIDE_Y * SIDE_Z), b / SIDE_Z % SIDE_Y, b % SIDE_Z};
  uint32_t sum[3]; /* twice the middle */
  for (int axis = 0; axis < 3; axis++)
    sum[axis] = xyz_a[axis] + xyz_b[axis];
  const uint32_t middle = (sum[0] * 16 + sum[1]) * 16 + sum[2];
  const uint32_t direction = sum[0] % 2 != 0 ? 0 : sum[1] % 2 != 0 ? 1 : 2;
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
    keyed[s] =
        (struct keyed){pair_key(lattice->spring_a[s], lattice->spring_b[s], lattice->spring_diagonal[s] != 0), s};
  mo_lattice_free(lattice);
  qsort(keyed, MO_DEFAULT_SPRINGS, sizeof(*keyed), by_key);
  for (uint32_t slot = 0; slot < MO_DEFAULT_SPRINGS; slot++)
    slots[keyed[slot].spring] = (uint16_t)slot;
  return MO_OK;
}

/* ---- filling ---- */

static void fill_body(const struct mo_body *body, const struct input_order *order, const uint16_t *slots,
                      uint32_t *links, uint32_t *masses, uint8_t *ranks, uint8_t *inputs)
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
  uint8_t listed[MO_DEFAULT_MASSES], place_of[MO_PLAN_INPUTS];
  memset(inputs, MO_PLAN_NONE, MO_PLAN_INPUTS);
  for (uint32_t k = 0; k < MO_PLAN_INPUTS; k++)
    place_of[MO_PLAN_INPUT_PLACE(k)] = (uint8_t)k;
  for (uint32_t m = 0; m < n; m++) {
    ranks[m] = (uint8_t)begin[degree[m]]++;
    listed[ranks[m]] = (uint8_t)m;
    inputs[place_of[order->input[body->mass_lattice[m]]]] = ranks[m];
  }
  uint32_t quad = 0;
  for (uint32_t rank = 0; rank < n; rank++) {
    const uint32_t m = listed[rank], quads = (degree[m] + MO_PLAN_LINKS - 1U) / MO_PLAN_LINKS;
    const uint16_t *xyz = body->mass_xyz + 3 * (size_t)m;
    masses[rank] = MO_PLAN_MASS(xyz[0], xyz[1], xyz[2], quads, quad);
    quad_of[m] = (uint16_t)quad;
    quad += quads;
  }
  for (uint32_t s = 0; s < body->n_springs; s++) {
    const uint32_t a = body->spring_a[s], b = body->spring_b[s], slot = slots[body->spring_lattice[s]];
    links[MO_PLAN_LINKS * quad_of[a] + used[a]++] = MO_PLAN_LINK(slot, ranks[b]);
    links[MO_PLAN_LINKS * quad_of[b] + used[b]++] = MO_PLAN_LINK(slot, ranks[a]);
  }
  for (uint32_t m = 0; m < n;
       m++) /* of no length: such a link pulls nowhere, whatever its spring, which is one of the mass's */
    for (uint32_t *first = links + MO_PLAN_LINKS * quad_of[m]; used[m] % MO_PLAN_LINKS != 0; used[m]++)
      first[used[m]] = MO_PLAN_LINK(MO_PLAN_LINK_SLOT(first[0]), ranks[m]);
}

/* The pairs of a group, by the columns that have them: patterns in the order of a Gray code, so that a tile that holds the end of one and
 * the start of the next wastes little. */
static uint32_t fill_tiles(const struct mo_plan *plan, const struct mo_plan_group *group, struct mo_plan_tile *tiles,
                           uint8_t *columns)
{
  uint64_t has[MO_PLAN_COLUMNS_MAX][PAIR_WORDS] = {{0}};
  for (uint32_t p = 0; p < group->n_parts; p++) {
    const struct mo_plan_part *part = plan->parts + group->first_part + p;
    const struct mo_body *body = plan->bodies[part->body];
    uint64_t pairs[PAIR_WORDS] = {0};
    for (uint32_t s = 0; s < body->n_springs; s++) {
      const uint32_t pair = plan->slots[body->spring_lattice[s]] / 2;
      pairs[pair >> 6] |= UINT64_C(1) << (pair & 63);
    }
    const uint32_t last = (part->first_row + part->n_rows - 1U) / MO_PLAN_COLUMN;
    for (uint32_t c = part->first_row / MO_PLAN_COLUMN; c <= last; c++)
      for (int w = 0; w < PAIR_WORDS; w++)
        has[c][w] |= pairs[w];
  }
  uint16_t list[MO_PLAN_PAIRS];
  uint8_t pattern_of[MO_PLAN_PAIRS];
  uint32_t n = 0, count[PATTERNS] = {0}, next[PATTERNS];
  for (uint32_t w = 0; w < PAIR_WORDS; w++) {
    uint64_t any = 0;
    for (int c = 0; c < MO_PLAN_COLUMNS_MAX; c++)
      any |= has[c][w];
    for (; any != 0; any &= any - 1) {
      const int bit = __builtin_ctzll(any);
      uint32_t pattern = 0;
      for (int c = 0; c < MO_PLAN_COLUMNS_MAX; c++)
        pattern |= (uint32_t)(has[c][w] >> bit & 1) << c;
      list[n] = (uint16_t)(w * 64 + (uint32_t)bit);
      pattern_of[n++] = (uint8_t)pattern;
      count[pattern]++;
    }
  }
  for (uint32_t i = 0, first = 0; i < PATTERNS; i++) {
    const uint32_t pattern = i ^ i >> 1;
    next[pattern] = first;
    first += count[pattern];
  }
  const uint32_t n_tiles = (n + MO_PLAN_TILE - 1) / MO_PLAN_TILE;
  memset(columns, 0, MO_PLAN_TILES_MAX);
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

void mo_plan_fill(const struct mo_plan *plan, void *memory, uint32_t share, uint32_t n_shares)
{
  const struct mo_plan_block *block = &plan->block;
  char *base = memory;
  struct input_order order;
  order_inputs(&order);
  double *environments = (double *)(void *)(base + block->environments);
  struct mo_plan_body *bodies = (struct mo_plan_body *)(void *)(base + block->bodies);
  uint32_t *links = (uint32_t *)(void *)(base + block->links), *masses = (uint32_t *)(void *)(base + block->masses);
  uint8_t *ranks = (uint8_t *)(base + block->ranks), *inputs = (uint8_t *)(base + block->inputs);
  for (uint32_t b = share; b < plan->n_bodies; b += n_shares) {
    const struct mo_plan_body header = plan->headers[b];
    fill_body(plan->bodies[b], &order, plan->slots, links + (size_t)MO_PLAN_LINKS * header.first_quad,
              masses + header.first_mass, ranks + header.first_mass, inputs + (size_t)b * MO_PLAN_INPUTS);
    bodies[b] = header;
  }
  for (uint32_t e = share; e < plan->n_environments; e += n_shares) {
    double *out = environments + (size_t)e * MO_PLAN_ENVIRONMENT_DOUBLES;
    memcpy(out, plan->environments[e]->light_xy_m, 2 * sizeof(double));
    memcpy(out + 2, plan->environments[e]->terrain_heights_m, MO_TERRAIN_HEIGHTS * sizeof(double));
  }
  struct mo_plan_group *groups = (struct mo_plan_group *)(void *)(base + block->groups);
  for (uint32_t g = share; g < plan->n_groups; g += n_shares) {
    struct mo_plan_group group = plan->groups[g];
    group.n_tiles = fill_tiles(plan, &group, (struct mo_plan_tile *)(void *)(base + block->tiles) + group.first_tile,
                               (uint8_t *)(base + block->columns) + group.first_tile);
    group.input_tiles = input_tiles_of(plan, &group, &order);
    groups[g] = group;
  }
  if (share == 0) {
    memcpy(base + block->parts, plan->parts, plan->n_parts * sizeof(*plan->parts));
    memcpy(base + block->rows, plan->rows, plan->n * sizeof(*plan->rows));
  }
}
