/* environment.c: see environment.h. */
#include "world/environment.h"

#include <math.h>

#define AT(member) offsetof(struct mo_environment, member)
static const struct mo_field rows[] = {
    {"light_xy_m", MO_FIELD_NUMBERS, 0, AT(light_xy_m), .n = 2, .min = -MO_LIGHT_LIMIT_M,
     .max = MO_LIGHT_LIMIT_M, .unit = "m", .help = "where the light stands"},
    {"terrain_heights_m", MO_FIELD_NUMBERS, 0, AT(terrain_heights_m), .n = MO_TERRAIN_HEIGHTS,
     .side = MO_TERRAIN_SIDE, .min = -MO_HEIGHT_LIMIT_M, .max = MO_HEIGHT_LIMIT_M, .unit = "m",
     .help = "heights of the terrain, row by row"},
};
#undef AT
const struct mo_fields mo_environment_fields = MO_FIELDS(rows);

const struct mo_environment mo_environment_defaults = {0};

unsigned mo_environment_version(const struct mo_environment *environment)
{
  return mo_fields_version(&mo_environment_fields, environment, &mo_environment_defaults);
}

int mo_environment_check(const struct mo_environment *environment, uint32_t *where)
{
  uint32_t k = 0;
  for (size_t r = 0; r < mo_environment_fields.n; r++) {
    const double *values = mo_environment_numbers(environment, &rows[r]);
    const uint32_t n = rows[r].type == MO_FIELD_NUMBERS ? rows[r].n : 1;
    for (uint32_t i = 0; i < n; i++, k++) {
      if (values[i] >= rows[r].min && values[i] <= rows[r].max)
        continue;
      if (where != NULL)
        *where = k;
      return isfinite(values[i]) ? MO_ERR_RANGE : MO_ERR_INVALID;
    }
  }
  const int error = mo_task_check(&environment->task, NULL);
  if (error != MO_OK && where != NULL)
    *where = MO_ENVIRONMENT_TASK;
  return error;
}
