/* terrain_json.c: see terrain_json.h. */
#include "world/terrain_json.h"

#include <stdlib.h>
#include <string.h>

#include "base/fields.h"
#include "world/terrain.h"

enum { PROFILE = MO_TERRAIN_STEPS + 1, GRID }; /* the last kinds */
static const char *const kinds[] = {MO_TERRAIN_FAMILY_WORDS, "profile", "grid", NULL};
_Static_assert(sizeof(kinds) / sizeof(*kinds) == GRID + 2, "every family has a word");

#define KIND(family) (1U << MO_TERRAIN_##family)
#define STAIRS       (KIND(STAIRS_UP) | KIND(STAIRS_DOWN))
#define GIVEN        (1U << PROFILE | 1U << GRID)
#define RANDOM       (KIND(HURDLES) | KIND(GAPS) | KIND(STEPS)) /* except `rough` */

/* A terrain in a request. */
struct asked {
  int kind; /* of `kinds` */
  struct mo_terrain_recipe recipe;
  uint32_t n;       /* heights of a profile */
  uint32_t columns; /* of a grid, whose rows are n_rows; 0: heights_m has no rows */
  uint32_t n_rows;
  double heights_m[MO_TERRAIN_HEIGHTS];
  double *grid_m; /* (n_rows, columns), room for the largest; NULL: no rows */
};

static void read_heights(struct mo_json *json, void *value);
static const struct mo_field_own heights = {.read = read_heights};

/* The offset of the heights is the start of the struct. Lengths are checked further when the
 * terrain is drawn. */
#define AT(member) offsetof(struct asked, member)
#define LENGTH(member, most)                                                                       \
#member, MO_FIELD_NUMBER, MO_FIELD_ABOVE_MIN, AT(recipe.member), .max = (most), .unit = "m"
#define RISE  MO_PROFILE_SPACING_MAX_M
#define REACH (MO_PROFILE_SPACING_MAX_M * (MO_TERRAIN_HEIGHTS - 1))
static const struct mo_field rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(kind), .words = kinds, .unit = "", .help = "the family"},
    {"heights_m", MO_FIELD_OWN, 0, 0, .own = &heights, .unit = "m",
     .help = "heights along x, from x = 0 on; of a grid, rows of them along y"},
    {"spacing_m", MO_FIELD_NUMBER, 0, AT(recipe.spacing_m), .min = MO_PROFILE_SPACING_MIN_M,
     .max = MO_GRID_SPACING_MAX_M, .unit = "m", .help = "between two heights"},
    {"seed", MO_FIELD_SEED, 0, AT(recipe.seed), .unit = "", .help = "of the random numbers"},
    {"sigma_m", MO_FIELD_NUMBER, 0, AT(recipe.sigma_m), .max = MO_TERRAIN_SIGMA_MAX_M, .unit = "m",
     .help = "standard deviation of the heights"},
    {"degrees", MO_FIELD_NUMBER, 0, AT(recipe.degrees), .min = -MO_TERRAIN_DEGREES_MAX,
     .max = MO_TERRAIN_DEGREES_MAX, .unit = "°", .help = "above the horizontal"},
    {"toward_rad", MO_FIELD_NUMBER, 0, AT(recipe.toward_rad), .min = -MO_TERRAIN_TOWARD_MAX_RAD,
     .max = MO_TERRAIN_TOWARD_MAX_RAD, .unit = "rad",
     .help = "direction in which the ground rises; 0: +x"},
    {LENGTH(rise_m, RISE), .help = "of a step"},
    {LENGTH(run_m, REACH), .help = "from one step to the next"},
    {LENGTH(height_m, RISE),
     .help = "of the highest hurdle, or between the highest and lowest step"},
    {LENGTH(every_m, REACH), .help = "mean distance between hurdles"},
    {LENGTH(depth_m, RISE), .help = "of a gap"},
    {LENGTH(gap_m, REACH), .help = "width of a gap"},
    {LENGTH(platform_m, REACH), .help = "mean length of a platform"},
};
#undef AT
static const struct mo_fields members = MO_FIELDS(rows);

enum {
  IS_KIND,
  HEIGHTS,
  SPACING,
  SEED,
  SIGMA,
  DEGREES,
  TOWARD,
  RISE_OF_STEP,
  RUN,
  HEIGHT,
  EVERY,
  DEPTH,
  GAP,
  PLATFORM,
  MEMBERS
};
_Static_assert(sizeof(rows) / sizeof(*rows) == MEMBERS, "the members are in the order of the rows");

/* Which kinds have a member, and which of them must have it. */
static const struct {
  unsigned has, needs;
} uses[MEMBERS] = {
    [IS_KIND] = {~0U, ~0U},
    [HEIGHTS] = {GIVEN, GIVEN},
    [SPACING] = {GIVEN | KIND(SLOPE) | STAIRS | RANDOM, GIVEN},
    [SEED] = {KIND(ROUGH) | RANDOM, KIND(ROUGH) | RANDOM},
    [SIGMA] = {KIND(ROUGH), 0},
    [DEGREES] = {KIND(SLOPE) | KIND(ROUGH) | KIND(FLAT), 0},
    [TOWARD] = {KIND(ROUGH) | KIND(FLAT), 0},
    [RISE_OF_STEP] = {STAIRS, 0},
    [RUN] = {STAIRS | KIND(STEPS), 0},
    [HEIGHT] = {KIND(HURDLES) | KIND(STEPS), 0},
    [EVERY] = {KIND(HURDLES), 0},
    [DEPTH] = {KIND(GAPS), 0},
    [GAP] = {KIND(GAPS), 0},
    [PLATFORM] = {KIND(GAPS), 0},
};

/* ---- reading ---- */

#define NO_MEMORY "there is not enough memory for this terrain; try again later"

/* Reads an array of at most `most` heights, and counts all of them. Returns whether it is one. */
static bool read_row(struct mo_json *json, uint32_t most, double *heights_m, uint32_t *n)
{
  *n = 0;
  if (!mo_json_array(json))
    return false;
  for (; mo_json_item(json); ++*n)
    if (*n < most)
      mo_json_bounded(json, -MO_HEIGHT_LIMIT_M, MO_HEIGHT_LIMIT_M, &heights_m[*n]);
    else
      mo_json_skip(json);
  return !json->stop;
}

/* Reads the next row of a grid. Adds a fault if it is not as long as the first. */
static void read_grid_row(struct mo_json *json, struct asked *asked)
{
  const unsigned depth = json->depth;
  const bool is_first = asked->n_rows == 0;
  double *heights_m = asked->grid_m + (size_t)asked->n_rows * asked->columns;
  uint32_t n;
  if (!read_row(json, is_first ? MO_GRID_SIDE_MAX : asked->columns, heights_m, &n))
    return;
  if (is_first && (n < MO_GRID_SIDE_MIN || n > MO_GRID_SIDE_MAX))
    mo_json_fault_at(json, depth, "", "must have %d to %d heights, got %u", MO_GRID_SIDE_MIN,
                     MO_GRID_SIDE_MAX, n);
  else if (!is_first && n != asked->columns)
    mo_json_fault_at(json, depth, "", "must have %u heights, as many as the first row, got %u",
                     asked->columns, n);
  if (is_first)
    asked->columns = n < MO_GRID_SIDE_MAX ? n : MO_GRID_SIDE_MAX;
}

/* Reads the rows of a grid or the heights of a profile: the first item determines which. */
static void read_heights(struct mo_json *json, void *value)
{
  struct asked *asked = value;
  const unsigned depth = json->depth;
  uint32_t n = 0;
  bool has_rows = false;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); n++) {
    if (n == 0 && mo_json_peek(json) == MO_JSON_ARRAY) {
      has_rows = true;
      asked->grid_m = calloc((size_t)MO_GRID_SIDE_MAX * MO_GRID_SIDE_MAX, sizeof(double));
      if (asked->grid_m == NULL)
        mo_json_fault_at(json, depth, "", NO_MEMORY);
    }
    if (n >= (has_rows ? MO_GRID_SIDE_MAX : MO_TERRAIN_HEIGHTS) ||
        (has_rows && asked->grid_m == NULL)) {
      mo_json_skip(json);
    } else if (has_rows) {
      read_grid_row(json, asked);
      asked->n_rows++;
    } else {
      mo_json_bounded(json, -MO_HEIGHT_LIMIT_M, MO_HEIGHT_LIMIT_M, &asked->heights_m[n]);
    }
  }
  if (json->stop)
    return;
  if (has_rows && (n < MO_GRID_SIDE_MIN || n > MO_GRID_SIDE_MAX))
    mo_json_fault_at(json, depth, "", "must have %d to %d rows, got %u", MO_GRID_SIDE_MIN,
                     MO_GRID_SIDE_MAX, n);
  else if (!has_rows && (n < MO_PROFILE_HEIGHTS_MIN || n > MO_TERRAIN_HEIGHTS))
    mo_json_fault_at(json, depth, "", "must have %d to %d heights, got %u", MO_PROFILE_HEIGHTS_MIN,
                     MO_TERRAIN_HEIGHTS, n);
  asked->n = has_rows ? 0 : n;
}

/* Adds a fault for a member that the kind needs but lacks, or has but does not use. */
static void check_members(struct mo_json *json, unsigned depth, const struct asked *asked,
                          unsigned given)
{
  char list[MO_WORDS_BYTES];
  if ((given >> IS_KIND & 1) == 0) {
    mo_json_fault_at(json, depth, "", "kind is missing; it must be %s", mo_words_list(kinds, list));
    return;
  }
  for (unsigned i = 0; i < MEMBERS; i++) {
    const bool is_given = (given >> i & 1) != 0;
    if ((uses[i].needs >> asked->kind & 1) != 0 && !is_given)
      mo_json_fault_at(json, depth, "", "%s is missing; a terrain of kind \"%s\" needs it",
                       rows[i].name, kinds[asked->kind]);
    else if ((uses[i].has >> asked->kind & 1) == 0 && is_given)
      mo_json_fault_at(json, depth, "", "a terrain of kind \"%s\" has no %s; remove it",
                       kinds[asked->kind], rows[i].name);
  }
}

/* Adds a fault for values that only a different kind may have. */
static void check_kind(struct mo_json *json, unsigned depth, const struct asked *asked,
                       unsigned given)
{
  if ((given >> SPACING & 1) != 0 && asked->kind != GRID &&
      asked->recipe.spacing_m > MO_PROFILE_SPACING_MAX_M)
    mo_json_fault_at(json, depth, "/spacing_m", "must be a number from %s to %s, got %s",
                     MO_NUMBER(MO_PROFILE_SPACING_MIN_M), MO_NUMBER(MO_PROFILE_SPACING_MAX_M),
                     MO_NUMBER(asked->recipe.spacing_m));
  if (asked->kind == GRID && asked->grid_m == NULL)
    mo_json_fault_at(
        json, depth, "/heights_m",
        "must be rows of heights, [[…], […], …], for a terrain of kind \"grid\"; for a "
        "list of heights along x, use \"profile\"");
  if (asked->kind == PROFILE && asked->grid_m != NULL)
    mo_json_fault_at(json, depth, "/heights_m",
                     "must be one list of heights for a terrain of kind \"profile\"; for rows of "
                     "heights, use \"grid\"");
}

/* Sets the members of a family that were not given. */
static void complete(struct asked *asked, unsigned given)
{
  const enum mo_terrain_family family = (enum mo_terrain_family)asked->kind;
  const struct asked usual = {.recipe = mo_terrain_recipe_default(family)};
  asked->recipe.family = family;
  for (unsigned i = 0; i < MEMBERS; i++)
    if (rows[i].type == MO_FIELD_NUMBER && (given >> i & 1) == 0)
      memcpy((char *)asked + rows[i].offset, (const char *)&usual + rows[i].offset, sizeof(double));
}

static void set_profile(const struct asked *asked, struct mo_environment *environment)
{
  environment->n_profile = asked->n;
  environment->profile_spacing_m = asked->recipe.spacing_m;
  memcpy(environment->terrain_heights_m, asked->heights_m, sizeof(asked->heights_m));
}

/* Sets the environment's terrain. */
static void set_terrain(struct mo_json *json, unsigned depth, struct asked *asked, unsigned given,
                        struct mo_environment *environment)
{
  struct mo_message message = {""};
  if (asked->kind == PROFILE) {
    set_profile(asked, environment);
    return;
  }
  if (asked->kind == GRID) {
    /* Sizes and heights have been checked. */
    if (mo_terrain_grid_create(asked->columns, asked->n_rows, asked->recipe.spacing_m,
                               asked->grid_m, &environment->grid) != MO_OK)
      mo_json_fault_at(json, depth, "", NO_MEMORY);
    return;
  }
  complete(asked, given);
  if (mo_terrain_draw(&asked->recipe, environment, &message) != MO_OK)
    mo_json_fault_at(json, depth, "", "%s", message.text);
}

void mo_terrain_read(struct mo_json *json, struct mo_environment *environment)
{
  const unsigned depth = json->depth, faults = json->faults->n;
  struct asked asked = {0};
  struct mo_json_slice key;
  unsigned given = 0;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    for (unsigned i = 0; i < MEMBERS; i++)
      if (mo_json_is(key, rows[i].name))
        given |= 1U << i;
    if (!mo_fields_read_member(json, key, &members, &asked))
      mo_fields_unknown(json, NULL, &members);
  }
  if (!json->stop && json->faults->n == faults)
    check_members(json, depth, &asked, given);
  if (!json->stop && json->faults->n == faults)
    check_kind(json, depth, &asked, given);
  if (!json->stop && json->faults->n == faults)
    set_terrain(json, depth, &asked, given, environment);
  free(asked.grid_m);
}

/* ---- writing ---- */

static void write_grid(struct mo_text *text, const struct mo_terrain_grid *grid)
{
  mo_text_object(text);
  mo_text_member(text, "kind", kinds[GRID]);
  mo_text_open(text, rows[HEIGHTS].name, "[");
  for (uint32_t j = 0; j < grid->rows; j++) {
    mo_text_next(text);
    mo_text_add(text, "[");
    for (uint32_t i = 0; i < grid->columns; i++) {
      mo_text_next(text);
      mo_text_json_number(text, grid->heights_m[(size_t)j * grid->columns + i]);
    }
    mo_text_add(text, "]");
  }
  mo_text_add(text, "]");
  mo_text_member_number(text, rows[SPACING].name, grid->spacing_m);
  mo_text_add(text, "}");
}

void mo_terrain_write(struct mo_text *text, const struct mo_environment *environment)
{
  if (environment->grid != NULL) {
    write_grid(text, environment->grid);
    return;
  }
  mo_text_object(text);
  mo_text_member(text, "kind", kinds[PROFILE]);
  mo_text_open(text, rows[HEIGHTS].name, "[");
  for (uint32_t k = 0; k < environment->n_profile; k++) {
    mo_text_next(text);
    mo_text_json_number(text, environment->terrain_heights_m[k]);
  }
  mo_text_add(text, "]");
  mo_text_member_number(text, rows[SPACING].name, environment->profile_spacing_m);
  mo_text_add(text, "}");
}
