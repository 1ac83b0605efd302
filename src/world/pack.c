/* pack.c: the packed form of environments. */
#include <stdlib.h>
#include <string.h>

#include "world/environment.h"

/* The data after the fields, since version MO_ENVIRONMENT_GRID_VERSION. */
struct tail {
  uint32_t columns, rows;
  double spacing_m;
};

static size_t head_bytes(unsigned version)
{
  return mo_fields_packed_bytes(&mo_environment_fields, version) +
         (version >= MO_ENVIRONMENT_GRID_VERSION ? sizeof(struct tail) : 0);
}

static size_t heights_bytes(const struct mo_terrain_grid *grid)
{
  return grid != NULL ? (size_t)grid->columns * grid->rows * sizeof(double) : 0;
}

size_t mo_environment_packed_bytes(const struct mo_environment *environment, unsigned version)
{
  return head_bytes(version) +
         (version >= MO_ENVIRONMENT_GRID_VERSION ? heights_bytes(environment->grid) : 0);
}

static void pack_head(const struct mo_environment *environment, unsigned version, uint8_t *bytes)
{
  const struct mo_terrain_grid *grid = environment->grid;
  const struct tail tail = grid != NULL ? (struct tail){grid->columns, grid->rows, grid->spacing_m}
                                        : (struct tail){0, 0, 0};
  _Static_assert(sizeof(tail) == 16, "no gaps");
  mo_fields_pack(&mo_environment_fields, version, environment, bytes);
  if (version >= MO_ENVIRONMENT_GRID_VERSION)
    memcpy(bytes + head_bytes(version) - sizeof(tail), &tail, sizeof(tail));
}

void mo_environment_pack(const struct mo_environment *environment, unsigned version, uint8_t *bytes)
{
  pack_head(environment, version, bytes);
  if (version >= MO_ENVIRONMENT_GRID_VERSION && environment->grid != NULL)
    memcpy(bytes + head_bytes(version), environment->grid->heights_m,
           heights_bytes(environment->grid));
}

/* bytes: where the heights begin. A height of −0, which no grid has, counts as invalid. */
static int unpack_grid(const struct tail *tail, const uint8_t *bytes, size_t size,
                       struct mo_environment *environment, size_t *used)
{
  if (tail->columns > MO_GRID_SIDE_MAX || tail->rows > MO_GRID_SIDE_MAX)
    return MO_ERR_FORMAT;
  const size_t n = (size_t)tail->columns * tail->rows;
  double *heights_m = NULL;
  if (n == 0)
    return tail->columns == 0 && tail->rows == 0 && tail->spacing_m == 0 ? MO_OK : MO_ERR_FORMAT;
  if (n * sizeof(double) > size) {
    *used = 0;
    return MO_ERR_FORMAT;
  }
  heights_m = malloc(n * sizeof(double)); /* the bytes may not be aligned */
  if (heights_m == NULL)
    return MO_ERR_NO_MEMORY;
  memcpy(heights_m, bytes, n * sizeof(double));
  const struct mo_terrain_grid *grid = NULL;
  int error = mo_terrain_grid_create(tail->columns, tail->rows, tail->spacing_m, heights_m, &grid);
  if (error == MO_OK && memcmp(grid->heights_m, heights_m, n * sizeof(double)) != 0)
    error = MO_ERR_FORMAT;
  free(heights_m);
  if (error != MO_OK) {
    mo_terrain_grid_drop(grid);
    return error == MO_ERR_NO_MEMORY ? error : MO_ERR_FORMAT;
  }
  environment->grid = grid;
  *used += n * sizeof(double);
  return MO_OK;
}

int mo_environment_unpack(unsigned version, const uint8_t *bytes, size_t size,
                          struct mo_environment *environment, size_t *used)
{
  const size_t head = head_bytes(version);
  struct tail tail;
  *environment = mo_environment_defaults;
  *used = 0;
  if (version > MO_ENVIRONMENT_VERSION || head > size)
    return MO_ERR_FORMAT;
  *used = head;
  if (!mo_fields_unpack(&mo_environment_fields, version, bytes, environment))
    return MO_ERR_FORMAT;
  if (version < MO_ENVIRONMENT_GRID_VERSION)
    return MO_OK;
  memcpy(&tail, bytes + head - sizeof(tail), sizeof(tail));
  return unpack_grid(&tail, bytes + head, size - head, environment, used);
}

void mo_environment_digest(const struct mo_environment *environment, struct mo_sha256 *hash)
{
  const unsigned version = mo_environment_version(environment);
  struct mo_environment clear = *environment;
  uint8_t bytes[MO_ENVIRONMENT_HEAD_BYTES];
  mo_fields_clear_minus(&mo_environment_fields, &clear);
  pack_head(&clear, version, bytes);
  mo_sha256_of_both(bytes, head_bytes(version), clear.grid != NULL ? clear.grid->heights_m : NULL,
                    heights_bytes(clear.grid), hash);
}
