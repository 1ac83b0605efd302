/* terrain_json.c: see terrain_json.h. */
#include "world/terrain_json.h"

#include <string.h>

#include "base/fields.h"
#include "world/terrain.h"

enum { PROFILE = MO_TERRAIN_STEPS + 1 }; /* the last kind */
static const char *const kinds[] = {MO_TERRAIN_FAMILY_WORDS, "profile", NULL};
_Static_assert(sizeof(kinds) / sizeof(*kinds) == PROFILE + 2, "every family has a word");

#define KIND(family) (1U << MO_TERRAIN_##family)
#define STAIRS       (KIND(STAIRS_UP) | KIND(STAIRS_DOWN))
#define RANDOM       (KIND(HURDLES) | KIND(GAPS) | KIND(STEPS)) /* but `rough` */

/* A terrain in a request. */
struct asked {
  int kind; /* of `kinds` */
  struct mo_terrain_recipe recipe;
  uint32_t n;
  double heights_m[MO_TERRAIN_HEIGHTS];
};

static void read_heights(struct mo_json *json, void *value);
static const struct mo_field_own heights = {.read = read_heights};

/* The row of the heights is at the start of the struct. Lengths are checked further when the
 * terrain is drawn. */
#define AT(member) offsetof(struct asked, member)
#define LENGTH(member, most)                                                                       \
#member, MO_FIELD_NUMBER, MO_FIELD_ABOVE_MIN, AT(recipe.member), .max = (most), .unit = "m"
#define RISE  MO_PROFILE_SPACING_MAX_M
#define REACH (MO_PROFILE_SPACING_MAX_M * (MO_TERRAIN_HEIGHTS - 1))
static const struct mo_field rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(kind), .words = kinds, .unit = "", .help = "the family"},
    {"heights_m", MO_FIELD_OWN, 0, 0, .own = &heights, .unit = "m",
     .help = "heights along x, from x = 0 on"},
    {"spacing_m", MO_FIELD_NUMBER, 0, AT(recipe.spacing_m), .min = MO_PROFILE_SPACING_MIN_M,
     .max = MO_PROFILE_SPACING_MAX_M, .unit = "m", .help = "between two heights"},
    {"seed", MO_FIELD_SEED, 0, AT(recipe.seed), .unit = "", .help = "of the random numbers"},
    {"sigma_m", MO_FIELD_NUMBER, 0, AT(recipe.sigma_m), .max = MO_TERRAIN_SIGMA_MAX_M, .unit = "m",
     .help = "standard deviation of the heights"},
    {"degrees", MO_FIELD_NUMBER, 0, AT(recipe.degrees), .min = -MO_TERRAIN_DEGREES_MAX,
     .max = MO_TERRAIN_DEGREES_MAX, .unit = "°", .help = "above the horizontal"},
    {LENGTH(rise_m, RISE), .help = "of a step"},
    {LENGTH(run_m, REACH), .help = "from one step to the next"},
    {LENGTH(height_m, RISE), .help = "of the highest hurdle; between the highest and lowest step"},
    {LENGTH(every_m, REACH), .help = "mean distance of two hurdles"},
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
    [HEIGHTS] = {1U << PROFILE, 1U << PROFILE},
    [SPACING] = {1U << PROFILE | KIND(SLOPE) | STAIRS | RANDOM, 1U << PROFILE},
    [SEED] = {KIND(ROUGH) | RANDOM, KIND(ROUGH) | RANDOM},
    [SIGMA] = {KIND(ROUGH), 0},
    [DEGREES] = {KIND(SLOPE), 0},
    [RISE_OF_STEP] = {STAIRS, 0},
    [RUN] = {STAIRS | KIND(STEPS), 0},
    [HEIGHT] = {KIND(HURDLES) | KIND(STEPS), 0},
    [EVERY] = {KIND(HURDLES), 0},
    [DEPTH] = {KIND(GAPS), 0},
    [GAP] = {KIND(GAPS), 0},
    [PLATFORM] = {KIND(GAPS), 0},
};

/* ---- reading ---- */

static void read_heights(struct mo_json *json, void *value)
{
  struct asked *asked = value;
  const unsigned depth = json->depth;
  uint32_t n = 0;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); n++)
    if (n < MO_TERRAIN_HEIGHTS)
      mo_json_bounded(json, -MO_HEIGHT_LIMIT_M, MO_HEIGHT_LIMIT_M, &asked->heights_m[n]);
    else
      mo_json_skip(json);
  if (!json->stop && (n < MO_PROFILE_HEIGHTS_MIN || n > MO_TERRAIN_HEIGHTS))
    mo_json_fault_at(json, depth, "", "must have %d to %d heights, got %u", MO_PROFILE_HEIGHTS_MIN,
                     MO_TERRAIN_HEIGHTS, n);
  asked->n = n;
}

/* Adds a fault for a member that the kind lacks, or has in vain. */
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

/* Sets what a family was not given. */
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

void mo_terrain_read(struct mo_json *json, struct mo_environment *environment)
{
  const unsigned depth = json->depth, faults = json->faults->n;
  struct asked asked = {0};
  struct mo_message message = {""};
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
  if (json->stop || json->faults->n > faults)
    return;
  check_members(json, depth, &asked, given);
  if (json->faults->n > faults)
    return;
  if (asked.kind == PROFILE) {
    set_profile(&asked, environment);
    return;
  }
  complete(&asked, given);
  if (mo_terrain_draw(&asked.recipe, environment, &message) != MO_OK)
    mo_json_fault_at(json, depth, "", "%s", message.text);
}

/* ---- writing ---- */

void mo_terrain_write(struct mo_text *text, const struct mo_environment *environment)
{
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
