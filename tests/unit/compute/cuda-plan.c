/* Rows laid out for a device: everything in the rows occurs once, where the device looks for it. */
#include "../make.h"

#include "compute/cuda/plan.h"
#include "rollout/damage.h"
#include "rollout/measuring.h"

enum { BODIES = 60, PLACES = 7, N = BODIES * PLACES };

static struct mo_lattice *lattice;
static struct mo_physics physics;
static struct mo_environment environments[PLACES];
static struct mo_robot robots[N];
static bool measures;

/* Random bodies of 1 to 144 voxels; the rows of a body are adjacent, with a few exceptions. */
static void setup(void)
{
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, 3);
  physics = mo_paper_physics();
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  physics.drop_height_m = 0.125;
  for (uint32_t e = 0; e < PLACES; e++) {
    mo_environment_training(4, 0, e, environments + e);
    environments[e].drop_m = 0.01 * e;
  }
  for (int b = 0; b < BODIES; b++) {
    uint64_t bits[MO_DEFAULT_WORDS] = {1};
    if (b > 1)
      make_check(mo_body_stream_next(stream, bits, NULL), "a body");
    struct mo_body *body = b == 1 ? make_full_body(lattice) : make_body(lattice, bits);
    for (int e = 0; e < PLACES; e++)
      robots[b * PLACES + e] = (struct mo_robot){body, environments + e};
  }
  const struct mo_robot first = robots[0];
  robots[0] = robots[N / 2];
  robots[N / 2] = first;
}

struct filled {
  struct mo_plan plan;
  char *block;
  const struct mo_plan_body *bodies;
  const struct mo_plan_pairs *pairs;
  const uint32_t *links, *masses;
  const uint8_t *ranks, *inputs;
  const uint16_t *columns;
  const struct mo_plan_group *groups;
  const struct mo_plan_part *parts;
  const struct mo_plan_row *rows;
  const struct mo_plan_tile *tiles;
};

static const struct mo_plan_options options = {.rows = 40,
                                               .group_bytes = 100000,
                                               .column_bytes = 8192,
                                               .part_bytes = 156,
                                               .place_bytes = 12,
                                               .length_bytes = 4};

static int cut(struct mo_plan *plan, const struct mo_robot *rows, uint32_t n, uint32_t n_threads,
               const struct mo_plan_options *wanted)
{
  const int status = mo_plan_create(plan, rows, n, &physics, measures);
  if (status != MO_OK)
    return status;
  mo_plan_measure(plan, n_threads);
  return mo_plan_cut(plan, wanted);
}

static int fill(struct filled *filled, const struct mo_robot *rows, uint32_t n, uint32_t n_threads)
{
  if (cut(&filled->plan, rows, n, n_threads, &options) < 0)
    return 0;
  const struct mo_plan_block *block = &filled->plan.block;
  char *base = filled->block = aligned_alloc(256, block->bytes);
  if (base == NULL)
    return 0;
  memset(base, 0x5a, block->bytes);
  mo_plan_fill(&filled->plan, base, n_threads);
  filled->bodies = (const void *)(base + block->bodies);
  filled->pairs = (const void *)(base + block->pairs);
  filled->links = (const void *)(base + block->links);
  filled->masses = (const void *)(base + block->masses);
  filled->ranks = (const void *)(base + block->ranks);
  filled->inputs = (const void *)(base + block->inputs);
  filled->columns = (const void *)(base + block->columns);
  filled->groups = (const void *)(base + block->groups);
  filled->parts = (const void *)(base + block->parts);
  filled->rows = (const void *)(base + block->rows);
  filled->tiles = (const void *)(base + block->tiles);
  return 1;
}

static void release(struct filled *filled)
{
  mo_plan_free(&filled->plan);
  free(filled->block);
}

static void rows_once(void)
{
  struct filled f;
  REQUIRE(fill(&f, robots, N, 3));
  CHECK_INT(f.plan.n_bodies, BODIES);
  CHECK_INT(f.plan.n_environments, PLACES);
  static int seen[N];
  memset(seen, 0, sizeof(seen));
  uint32_t rows = 0, parts = 0;
  for (uint32_t g = 0; g < f.plan.n_groups; g++) {
    const struct mo_plan_group *group = f.groups + g;
    CHECK_INT(group->first_row, rows);
    CHECK_INT(group->first_part, parts);
    CHECK(group->n_rows >= 1 && group->n_rows <= MO_PLAN_ROWS_MAX);
    CHECK((group->n_rows + 7) / 8 * options.column_bytes + group->n_parts * options.part_bytes +
              group->n_places * options.place_bytes + group->n_lengths * options.length_bytes <=
          options.group_bytes);
    uint32_t row = 0, place = 0, length = 0;
    for (uint32_t p = 0; p < group->n_parts; p++) {
      const struct mo_plan_part *part = f.parts + group->first_part + p;
      CHECK_INT(part->first_row, row);
      CHECK_INT(part->first_place, place);
      CHECK_INT(part->first_length, length);
      for (uint32_t r = 0; r < part->n_rows; r++) {
        const struct mo_plan_row *plan_row = f.rows + group->first_row + row + r;
        REQUIRE(plan_row->row < N);
        seen[plan_row->row]++;
        CHECK(f.plan.bodies[part->body] == robots[plan_row->row].body);
        CHECK(f.plan.environments[plan_row->environment] == robots[plan_row->row].environment);
      }
      row += part->n_rows;
      place += part->n_rows * f.bodies[part->body].n_masses;
      length += part->n_rows * f.bodies[part->body].n_slots;
    }
    CHECK_INT(row, group->n_rows);
    CHECK_INT(place, group->n_places);
    CHECK_INT(length, group->n_lengths);
    rows += group->n_rows;
    parts += group->n_parts;
  }
  for (int r = 0; r < N; r++)
    CHECK_INT(seen[r], 1);
  const struct mo_plan_environment *laid = (const void *)(f.block + f.plan.block.environments);
  for (uint32_t e = 0; e < PLACES; e++) {
    const struct mo_environment *environment = f.plan.environments[e];
    CHECK(memcmp(laid[e].heights_m, environment->terrain_heights_m, sizeof(laid[e].heights_m)) ==
          0);
    CHECK(laid[e].drop_m == 0.125 + environment->drop_m);
    CHECK_NEAR(laid[e].scene.light[0] + MO_WORLD_CENTER_M, environment->light_xy_m[0], 1e-6);
    CHECK_NEAR(laid[e].scene.heights[9], environment->terrain_heights_m[9], 1e-7);
    CHECK(laid[e].scene.constants.pull == 60.0F && laid[e].scene.constants.friction == 0.9F);
    CHECK(laid[e].scene.highest > mo_terrain_highest(environment));
  }
  release(&f);
}

/* Environments are laid out a second time if some row has a task, and only then. */
static void tasks(void)
{
  struct filled f;
  REQUIRE(fill(&f, robots, N, 2));
  CHECK(!f.plan.is_special);
  CHECK_INT(f.plan.block.tasks, f.plan.block.bytes);
  const size_t plain_bytes = f.plan.block.bytes;
  release(&f);
  struct mo_environment climb = environments[3];
  struct mo_robot mixed[N];
  climb.task.objective = MO_OBJECTIVE_CLIMB;
  memcpy(mixed, robots, sizeof(mixed));
  mixed[N - 1].environment = &climb;
  REQUIRE(fill(&f, mixed, N, 2));
  CHECK(f.plan.is_special);
  CHECK_INT(f.plan.n_environments, PLACES + 1);
  CHECK_INT(f.plan.block.bytes - f.plan.block.tasks,
            (f.plan.n_environments * sizeof(climb) + 255) / 256 * 256);
  CHECK(f.plan.block.bytes > plain_bytes);
  const struct mo_environment *laid = (const void *)(f.block + f.plan.block.tasks);
  for (uint32_t e = 0; e < f.plan.n_environments; e++)
    CHECK(memcmp(laid + e, f.plan.environments[e], sizeof(*laid)) == 0);
  release(&f);
}

/* The tables that measures need, if there are any: each mass and voxel at its place. */
static void tables_of_measures(void)
{
  struct filled f;
  REQUIRE(fill(&f, robots, N, 2));
  CHECK_INT(f.plan.block.rest, f.plan.block.bytes);
  CHECK_INT(f.plan.block.corners, f.plan.block.bytes);
  release(&f);
  measures = true;
  REQUIRE(fill(&f, robots, N, 3));
  measures = false;
  CHECK(f.plan.is_special && f.plan.observes && !f.plan.has_damage);
  const struct mo_plan_rest *rest = (const void *)(f.block + f.plan.block.rest);
  const struct mo_plan_voxels *voxels = (const void *)(f.block + f.plan.block.voxels);
  const struct mo_plan_corners *corners = (const void *)(f.block + f.plan.block.corners);
  uint32_t next = 0;
  for (uint32_t b = 0; b < f.plan.n_bodies; b++) {
    const struct mo_body *body = f.plan.bodies[b];
    const uint8_t *ranks = f.ranks + f.bodies[b].first_mass;
    double rows[MO_DEFAULT_MASSES][3];
    uint8_t halves[MO_DEFAULT_MASSES][2];
    mo_measuring_frame(body, rows);
    mo_measuring_halves(body, halves);
    CHECK_INT(voxels[b].first, next);
    CHECK_INT(voxels[b].n, body->n_voxels);
    for (uint32_t m = 0; m < body->n_masses; m++) {
      const struct mo_plan_rest *of = rest + f.bodies[b].first_mass + ranks[m];
      for (int axis = 0; axis < 3; axis++)
        CHECK(of->row[axis] == (float)rows[m][axis]);
      CHECK_INT(of->halves, halves[m][0] + 4 * halves[m][1]);
    }
    for (uint32_t v = 0; v < body->n_voxels; v++)
      for (uint32_t k = 0; k < 8; k++)
        CHECK_INT(corners[next + v].mass[k], ranks[body->voxel_mass[8 * (size_t)v + k]]);
    next += body->n_voxels;
  }
  release(&f);
}

/* What the kernels for special rows read: the cells of a profile, and damage, with the octants of
 * springs in their links. */
static void profiles_and_damage(void)
{
  struct filled f, plain;
  struct mo_environment odd[2] = {environments[0], environments[1]};
  struct mo_robot mixed[N];
  odd[0].n_profile = 40;
  odd[0].profile_spacing_m = 0.25;
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    odd[0].terrain_heights_m[k] = k < 40 ? -1 - 0.1 * k : 0;
  odd[1].damage = (struct mo_damage){4, 0.02};
  memcpy(mixed, robots, sizeof(mixed));
  mixed[0].environment = &odd[0];
  REQUIRE(fill(&f, mixed, N, 1));
  CHECK(f.plan.is_special && !f.plan.has_damage);
  release(&f);
  mixed[1].environment = &odd[1];
  REQUIRE(fill(&f, mixed, N, 1));
  REQUIRE(fill(&plain, robots, N, 1));
  CHECK(f.plan.is_special && f.plan.has_damage && !plain.plan.is_special);
  const struct mo_plan_environment *laid = (const void *)(f.block + f.plan.block.environments);
  for (uint32_t e = 0; e < f.plan.n_environments; e++) {
    const struct mo_plan_special *special = &laid[e].special;
    const bool is_profile = f.plan.environments[e] == &odd[0];
    CHECK_INT(special->cells.columns, is_profile ? 40 : 8);
    CHECK_INT(special->cells.row, is_profile ? 0 : 8);
    CHECK(special->cells.scale[0] == (is_profile ? 4.0F : 1.4F));
    CHECK_INT(special->cut, f.plan.environments[e] == &odd[1] ? 4 : 0);
    CHECK_INT(special->cut_step, f.plan.environments[e] == &odd[1] ? 5 : UINT32_MAX);
    if (is_profile)
      CHECK_NEAR(laid[e].scene.highest, -1, 1e-5);
  }
  for (uint32_t b = 0; b < f.plan.n_bodies; b++) {
    const struct mo_body *body = f.plan.bodies[b];
    const size_t first = (size_t)MO_PLAN_LINKS * f.bodies[b].first_quad;
    uint32_t next[MO_DEFAULT_MASSES] = {0};
    REQUIRE(body == plain.plan.bodies[b]);
    for (uint32_t s = 0; s < body->n_springs; s++)
      for (int end = 0; end < 2; end++) {
        const uint32_t m = end == 0 ? body->spring_a[s] : body->spring_b[s];
        const uint32_t mass =
            f.masses[f.bodies[b].first_mass + f.ranks[f.bodies[b].first_mass + m]];
        const size_t at = first + MO_PLAN_LINKS * MO_PLAN_MASS_QUAD(mass) + next[m]++;
        const struct mo_environment broken = {.damage.cut = MO_PLAN_LINK_PART_OF(f.links[at])};
        uint8_t is_cut[MO_DEFAULT_SPRINGS];
        mo_damage_mark(&broken, body, is_cut);
        CHECK_INT(is_cut[s], 1);
        CHECK_INT(MO_PLAN_LINK_SLOT_OF(f.links[at]), MO_PLAN_LINK_SLOT(plain.links[at]));
        CHECK_INT(MO_PLAN_LINK_MASS(f.links[at]), MO_PLAN_LINK_MASS(plain.links[at]));
      }
  }
  release(&f);
  release(&plain);
}

/* Returns a body's own slots: those of its pairs, from the lattice's slots. */
static void own_slots(const struct filled *f, uint32_t b, uint32_t *own)
{
  const struct mo_body *body = f->plan.bodies[b];
  uint8_t has[MO_PLAN_PAIRS] = {0};
  uint32_t n = 0, n_edges = 0;
  for (uint32_t s = 0; s < body->n_springs; s++)
    has[f->plan.slots[body->spring_lattice[s]] / 2] = 1;
  for (uint32_t pair = 0; pair < MO_PLAN_PAIRS; pair++) {
    CHECK_INT(f->pairs[b].has[pair / 32] >> pair % 32 & 1, has[pair]);
    if (pair % 32 == 0)
      CHECK_INT(f->pairs[b].before[pair / 32], n);
    own[2 * pair] = 2 * n;
    own[2 * pair + 1] = 2 * n + 1;
    n += has[pair];
    n_edges += has[pair] && 2 * pair < MO_PLAN_EDGES;
  }
  CHECK_INT(f->bodies[b].n_slots, 2 * n);
  CHECK_INT(f->bodies[b].n_edges, 2 * n_edges);
}

/* Every spring is a link at both of its ends, in the order of the body's springs; the links that
 * pad the last quad have no length. */
static void links(void)
{
  struct filled f;
  REQUIRE(fill(&f, robots, N, 1));
  for (uint32_t b = 0; b < f.plan.n_bodies; b++) {
    const struct mo_plan_body *header = f.bodies + b;
    const struct mo_body *body = f.plan.bodies[b];
    const uint8_t *ranks = f.ranks + header->first_mass;
    const uint32_t *masses = f.masses + header->first_mass;
    const uint32_t *list = f.links + (size_t)MO_PLAN_LINKS * header->first_quad;
    uint32_t next[MO_DEFAULT_MASSES] = {0}, slot_of_first[MO_DEFAULT_MASSES] = {0},
             own[2 * MO_PLAN_PAIRS];
    own_slots(&f, b, own);
    CHECK_INT(header->n_masses, body->n_masses);
    for (uint32_t s = 0; s < body->n_springs; s++)
      for (int end = 0; end < 2; end++) {
        const uint32_t mass = end == 0 ? body->spring_a[s] : body->spring_b[s];
        const uint32_t other = end == 0 ? body->spring_b[s] : body->spring_a[s];
        const uint32_t slot = own[f.plan.slots[body->spring_lattice[s]]];
        if (next[mass] == 0)
          slot_of_first[mass] = slot;
        const uint32_t link =
            list[MO_PLAN_LINKS * MO_PLAN_MASS_QUAD(masses[ranks[mass]]) + next[mass]++];
        CHECK_INT(MO_PLAN_LINK_MASS(link), ranks[other]);
        CHECK_INT(MO_PLAN_LINK_SLOT(link), slot);
      }
    for (uint32_t m = 0; m < body->n_masses; m++) {
      const uint32_t mass = masses[ranks[m]], end = MO_PLAN_LINKS * MO_PLAN_MASS_QUADS(mass);
      CHECK_INT(end, (next[m] + MO_PLAN_LINKS - 1) / MO_PLAN_LINKS * MO_PLAN_LINKS);
      for (uint32_t e = next[m]; e < end; e++)
        CHECK_INT(list[MO_PLAN_LINKS * MO_PLAN_MASS_QUAD(mass) + e],
                  MO_PLAN_LINK(slot_of_first[m], ranks[m]));
      CHECK_INT(MO_PLAN_MASS_X(mass), body->mass_xyz[3 * m]);
      CHECK_INT(MO_PLAN_MASS_Y(mass), body->mass_xyz[3 * m + 1]);
      CHECK_INT(MO_PLAN_MASS_Z(mass), body->mass_xyz[3 * m + 2]);
      CHECK(ranks[m] == 0 || MO_PLAN_MASS_QUADS(masses[ranks[m] - 1]) >= MO_PLAN_MASS_QUADS(mass));
      CHECK_INT(mo_plan_input_mass(f.inputs[b * MO_PLAN_INPUTS + MO_PLAN_INPUT_OF(ranks[m])]),
                body->mass_lattice[m]);
    }
  }
  release(&f);
}

/* Every spring has its own slot: edges first, and the two diagonals of a face next to each
 * other. */
static void slots(void)
{
  static uint16_t slots[MO_DEFAULT_SPRINGS];
  static uint32_t spring_at[MO_DEFAULT_SPRINGS];
  REQUIRE(mo_plan_slots(slots) == MO_OK);
  memset(spring_at, 0xff, sizeof(spring_at));
  for (uint32_t s = 0; s < MO_DEFAULT_SPRINGS; s++) {
    REQUIRE(slots[s] < MO_DEFAULT_SPRINGS);
    CHECK_INT(spring_at[slots[s]], UINT32_MAX);
    spring_at[slots[s]] = s;
    CHECK_INT(slots[s] >= MO_PLAN_EDGES, lattice->spring_rest_m[s] == MO_DIAGONAL_M);
  }
  for (uint32_t slot = MO_PLAN_EDGES; slot < MO_DEFAULT_SPRINGS; slot += 2) {
    uint32_t middle[2][3];
    for (uint32_t i = 0; i < 2; i++) {
      const uint32_t a = lattice->spring_a[spring_at[slot + i]],
                     b = lattice->spring_b[spring_at[slot + i]];
      middle[i][0] = a / 35 + b / 35;
      middle[i][1] = a / 5 % 7 + b / 5 % 7;
      middle[i][2] = a % 5 + b % 5;
    }
    CHECK(memcmp(middle[0], middle[1], sizeof(middle[0])) == 0);
  }
}

/* The pair of a spring in the bodies of a column is in one tile, and the tile's bit for that column
 * is set. */
static void tiles(void)
{
  struct filled f;
  REQUIRE(fill(&f, robots, N, 2));
  for (uint32_t g = 0; g < f.plan.n_groups; g++) {
    const struct mo_plan_group *group = f.groups + g;
    int tile_of[MO_PLAN_PAIRS];
    memset(tile_of, 0xff, sizeof(tile_of));
    REQUIRE(group->n_tiles <= MO_PLAN_TILES_MAX);
    uint32_t listed = 0, needed = 0;
    for (uint32_t t = 0; t < group->n_tiles * MO_PLAN_TILE; t++) {
      const uint16_t pair = f.tiles[group->first_tile + t / MO_PLAN_TILE].pair[t % MO_PLAN_TILE];
      if (pair == MO_PLAN_NO_PAIR)
        continue;
      REQUIRE(pair < MO_PLAN_PAIRS);
      CHECK_INT(tile_of[pair], -1);
      tile_of[pair] = (int)(t / MO_PLAN_TILE);
      listed++;
    }
    uint8_t counted[MO_PLAN_PAIRS] = {0};
    uint32_t inputs = 0;
    for (uint32_t p = 0; p < group->n_parts; p++) {
      const struct mo_plan_part *part = f.parts + group->first_part + p;
      const struct mo_body *body = f.plan.bodies[part->body];
      for (uint32_t s = 0; s < body->n_springs; s++) {
        const uint32_t pair = f.plan.slots[body->spring_lattice[s]] / 2;
        REQUIRE(tile_of[pair] >= 0);
        needed += counted[pair] == 0;
        counted[pair] = 1;
        for (uint32_t r = part->first_row; r < part->first_row + (uint32_t)part->n_rows; r++)
          CHECK(f.columns[group->first_tile + (uint32_t)tile_of[pair]] >> r / MO_PLAN_COLUMN & 1);
      }
      for (uint32_t m = 0; m < body->n_masses; m++)
        inputs |= UINT32_C(1) << f.inputs[part->body * MO_PLAN_INPUTS + MO_PLAN_INPUT_OF(m)] / 16;
    }
    CHECK_INT(listed, needed);
    CHECK_INT(group->input_tiles, inputs);
    for (uint32_t t = 0; t < group->n_tiles; t++)
      CHECK(f.columns[group->first_tile + t] != 0 &&
            f.columns[group->first_tile + t] >>
                    (group->n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN ==
                0);
  }
  release(&f);
}

static void threads_do_not_matter(void)
{
  struct filled one, many;
  REQUIRE(fill(&one, robots, N, 1) && fill(&many, robots, N, 5));
  CHECK_INT(one.plan.block.bytes, many.plan.block.bytes);
  CHECK(memcmp(one.block, many.block, one.plan.block.bytes) == 0);
  release(&many);
  release(&one);
}

static void refusals(void)
{
  struct mo_plan plan;
  struct mo_plan_options bad = options;
  bad.group_bytes =
      options.column_bytes + options.part_bytes + 244 * options.place_bytes +
      MO_DEFAULT_SPRINGS * options.length_bytes; /* 245 masses in one row need more memory */
  CHECK_INT(cut(&plan, robots, N, 1, &bad), MO_ERR_UNSUPPORTED);
  mo_plan_free(&plan);
  bad.group_bytes += options.place_bytes;
  CHECK_INT(cut(&plan, robots, N, 1, &bad), MO_OK);
  mo_plan_free(&plan);
  const uint64_t bits[1] = {1};
  const struct mo_robot robot = {make_body(make_lattice((struct mo_workspace){3, 3, 3}), bits),
                                 environments};
  CHECK_INT(cut(&plan, &robot, 1, 1, &options), MO_ERR_UNSUPPORTED);
  mo_plan_free(&plan);
}

static const struct check_case cases[] = {{"every row once", rows_once},
                                          {"environments with tasks", tasks},
                                          {"profiles and damage", profiles_and_damage},
                                          {"tables for measures", tables_of_measures},
                                          {"links", links},
                                          {"slots", slots},
                                          {"tiles", tiles},
                                          {"any number of threads", threads_do_not_matter},
                                          {"refusals", refusals}};
CHECK_MAIN_WITH(setup, cases)
