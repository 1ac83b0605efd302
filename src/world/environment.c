/* environment.c: see environment.h. */
#include "world/environment.h"
#include "world/factors.h"

#include <math.h>

#define AT(member) offsetof(struct mo_environment, member)
static const struct mo_field place_rows[] = {
    [MO_PLACE_LIGHT] = {"light_xy_m", MO_FIELD_NUMBERS, 0, AT(light_xy_m), .n = 2,
                        .min = -MO_LIGHT_LIMIT_M, .max = MO_LIGHT_LIMIT_M, .unit = "m",
                        .help = "position of the light"},
    [MO_PLACE_HEIGHTS] = {"terrain_heights_m", MO_FIELD_NUMBERS, 0, AT(terrain_heights_m),
                          .n = MO_TERRAIN_HEIGHTS, .side = MO_TERRAIN_SIDE,
                          .min = -MO_HEIGHT_LIMIT_M, .max = MO_HEIGHT_LIMIT_M, .unit = "m",
                          .help = "heights of the terrain, row by row"},
};
const struct mo_fields mo_place_fields = MO_FIELDS(place_rows);

bool mo_place_has(const struct mo_environment *environment, size_t row)
{
  return row == MO_PLACE_LIGHT     ? environment->task.guide.kind == MO_GUIDE_FIXED
         : row == MO_PLACE_HEIGHTS ? environment->n_profile == 0 && environment->grid == NULL
                                   : true;
}

/* Only for the packed form; task_json.c has the members of tasks in JSON. */
#define NUMBER(member)       #member, MO_FIELD_NUMBER, 0, AT(task.guide.member)
#define PAIRS(member, count) #member, MO_FIELD_NUMBERS, 0, AT(task.guide.member), .n = 2 * (count)
static const struct mo_field task_rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(task.guide.kind), .words = mo_guide_words, .since = 2},
    {"n_points", MO_FIELD_COUNT, 0, AT(task.guide.n_points), .since = 2},
    {NUMBER(heading_rad), .since = 2},
    {NUMBER(turn_rad_per_s), .since = 2},
    {NUMBER(distance_m), .since = 2},
    {PAIRS(points_m, MO_GUIDE_POINTS_MAX), .since = 2},
    {PAIRS(velocity_m_per_s, 1), .since = 2},
    {PAIRS(center_m, 1), .since = 2},
    {"objective", MO_FIELD_COUNT, 0, AT(task.objective), .since = 2},
};
#undef NUMBER
#undef PAIRS
/* Also only for the packed form; terrain_json.c has the members of profiles in JSON, and
 * task_json.c those of damage. */
static const struct mo_field profile_rows[] = {
    {"n_profile", MO_FIELD_COUNT, 0, AT(n_profile), .since = 3},
    {"profile_spacing_m", MO_FIELD_NUMBER, 0, AT(profile_spacing_m), .since = 3},
};
static const struct mo_field damage_rows[] = {
    {"cut", MO_FIELD_COUNT, 0, AT(damage.cut), .since = 4},
    {"cut_at_s", MO_FIELD_NUMBER, 0, AT(damage.time_s), .since = 4},
};
/* The same for sums. */
#define TERM(i)                                                                                    \
  {                                                                                                \
    "term_" #i, MO_FIELD_COUNT, 0, AT(task.terms[i]), .since = 5                                   \
  }
static const struct mo_field sum_rows[] = {
    {"n_terms", MO_FIELD_COUNT, 0, AT(task.n_terms), .since = 5},
    TERM(0),
    TERM(1),
    TERM(2),
    TERM(3),
    TERM(4),
    TERM(5),
    TERM(6),
    TERM(7),
    {"weights", MO_FIELD_NUMBERS, 0, AT(task.weights), .n = MO_TERMS_MAX, .since = 5},
};
_Static_assert(MO_TERMS_MAX == 8, "each term has a row");
#undef TERM
static const struct mo_field given_rows[] = {
    {"factors_given", MO_FIELD_COUNT, 0, AT(factors.given), .since = 7},
};
static const struct mo_field drop_rows[] = {
    {"drop_m", MO_FIELD_NUMBER, 0, AT(drop_m), .max = MO_DROP_MAX_M, .since = 8, .unit = "m",
     .help = "extra lift of the robot at the start"},
};
#undef AT
const struct mo_fields mo_drop_fields = MO_FIELDS(drop_rows);
static const struct mo_fields given_fields = MO_FIELDS(given_rows);
static const struct mo_fields sum_fields = MO_FIELDS(sum_rows);
static const struct mo_fields damage_fields = MO_FIELDS(damage_rows);
static const struct mo_fields profile_fields = MO_FIELDS(profile_rows);
static const struct mo_fields task_fields = MO_FIELDS(task_rows);
static const struct mo_field rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &mo_place_fields},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &task_fields, .since = 2},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &profile_fields, .since = 3},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &damage_fields, .since = 4},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &sum_fields, .since = 5},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &given_fields, .since = 7},
    {NULL, MO_FIELD_INLINE, 0, offsetof(struct mo_environment, factors), .group = &mo_factor_fields,
     .since = 7},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &mo_drop_fields, .since = 8},
};
const struct mo_fields mo_environment_fields = MO_FIELDS(rows);

const struct mo_environment mo_environment_defaults = {0};

unsigned mo_environment_version(const struct mo_environment *environment)
{
  /* Objectives that versions before 5 lack are packed in version 5. */
  const unsigned least = environment->grid != NULL ? MO_ENVIRONMENT_GRID_VERSION
                         : environment->task.objective > MO_OBJECTIVE_PURSUE ? 5
                                                                             : 1;
  const unsigned version =
      mo_fields_version(&mo_environment_fields, environment, &mo_environment_defaults);
  return version > least ? version : least;
}

/* Checks that heights n and above, which only the 8 × 8 grid has, are 0. */
static int check_zeros(const struct mo_environment *environment, uint32_t n, uint32_t *where)
{
  for (uint32_t k = n; k < MO_TERRAIN_HEIGHTS; k++)
    if (environment->terrain_heights_m[k] != 0) {
      *where = 2 + k;
      return MO_ERR_INVALID;
    }
  return MO_OK;
}

/* Checks the shape of the terrain; *where: the number of the invalid part. */
static int check_profile(const struct mo_environment *environment, uint32_t *where)
{
  const uint32_t n = environment->n_profile;
  const double spacing_m = environment->profile_spacing_m;
  *where = MO_ENVIRONMENT_PROFILE;
  if (!isfinite(spacing_m))
    return MO_ERR_INVALID;
  if (n == 0 && spacing_m != 0)
    return MO_ERR_RANGE;
  if (environment->grid != NULL && n != 0)
    return MO_ERR_INVALID;
  if (n == 0)
    return environment->grid != NULL ? check_zeros(environment, 0, where) : MO_OK;
  if (n < MO_PROFILE_HEIGHTS_MIN || n > MO_TERRAIN_HEIGHTS ||
      spacing_m < MO_PROFILE_SPACING_MIN_M || spacing_m > MO_PROFILE_SPACING_MAX_M)
    return MO_ERR_RANGE;
  return check_zeros(environment, n, where);
}

static int check_damage(const struct mo_damage *damage)
{
  if (!isfinite(damage->time_s) || (damage->cut == 0 && damage->time_s != 0))
    return MO_ERR_INVALID;
  return damage->cut <= MO_OCTANTS && damage->time_s >= 0 && damage->time_s <= MO_DAMAGE_TIME_MAX_S
             ? MO_OK
             : MO_ERR_RANGE;
}

int mo_environment_check(const struct mo_environment *environment, uint32_t *where)
{
  uint32_t k = 0, wrong;
  for (const struct mo_field *row = place_rows; row < place_rows + mo_place_fields.n; row++) {
    const double *values = mo_environment_numbers(environment, row);
    for (uint32_t i = 0; i < row->n; i++, k++) {
      if (values[i] >= row->min && values[i] <= row->max)
        continue;
      if (where != NULL)
        *where = k;
      return isfinite(values[i]) ? MO_ERR_RANGE : MO_ERR_INVALID;
    }
  }
  int error = check_profile(environment, &wrong);
  if (error == MO_OK) {
    wrong = MO_ENVIRONMENT_TASK;
    error = mo_task_check(&environment->task, NULL);
    const bool has_light = mo_guide_has_light(&environment->task.guide);
    if (!has_light && (environment->light_xy_m[0] != 0 || environment->light_xy_m[1] != 0))
      error = MO_ERR_INVALID;
  }
  if (error == MO_OK) {
    wrong = MO_ENVIRONMENT_DAMAGE;
    error = check_damage(&environment->damage);
  }
  if (error == MO_OK) {
    wrong = MO_ENVIRONMENT_FACTORS;
    error = mo_factors_check(&environment->factors);
  }
  if (error == MO_OK) {
    wrong = MO_ENVIRONMENT_DROP;
    error = mo_fields_check(&mo_drop_fields, "", environment, NULL);
  }
  if (error != MO_OK && where != NULL)
    *where = wrong;
  return error;
}
