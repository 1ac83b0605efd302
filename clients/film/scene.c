/* scene.c: reads a scene. Every offset and size comes from the network and is checked. */
#include "scene.h"

#include "../morphoctl/ctl.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define FAR_M 1e4F

/* The bytes after the header. */
struct reader {
  const unsigned char *arrays;
  size_t size;
};

static _Noreturn void refuse(const char *what)
{
  fail(STATUS_ERROR, "the server's scene is damaged: %s", what);
}

/* Finds an array: {"offset", "type", "shape"}. sizes: (n_sizes), written; the last must be
 * `last`. */
static const void *array(const struct reader *reader, const json_t *described, const char *type,
                         size_t width, uint32_t *sizes, size_t n_sizes, uint32_t last)
{
  const json_t *shape = json_object_get(described, "shape");
  const char *given = json_string_value(json_object_get(described, "type"));
  const json_int_t offset = json_integer_value(json_object_get(described, "offset"));
  size_t bytes = width;
  if (given == NULL || strcmp(given, type) != 0 || json_array_size(shape) != n_sizes)
    refuse("an array is missing, or has the wrong type or shape");
  for (size_t i = 0; i < n_sizes; i++) {
    const json_int_t n = json_integer_value(json_array_get(shape, i));
    if (n < 0 || n > 1 << 24 || (n > 0 && bytes > ((size_t)1 << 40) / (size_t)n))
      refuse("an array is too large");
    sizes[i] = (uint32_t)n;
    bytes *= (size_t)n;
  }
  if (sizes[n_sizes - 1] != last)
    refuse("an array has the wrong shape");
  if (offset < 0 || offset % 4 != 0 || (size_t)offset > reader->size ||
      bytes > reader->size - (size_t)offset)
    refuse("an array lies outside the scene");
  return reader->arrays + offset;
}

static void *list(const json_t *items, size_t width, uint32_t *n)
{
  const size_t size = json_array_size(items);
  if (size == 0 || size > 4096)
    refuse("it has no rollouts, or too many");
  *n = (uint32_t)size;
  return keep(calloc(size, width));
}

static void check_indices(const uint16_t *indices, size_t n, size_t stride, size_t used,
                          uint32_t limit)
{
  for (size_t i = 0; i < n; i++)
    for (size_t k = 0; k < used; k++)
      if (indices[i * stride + k] >= limit)
        refuse("an index is out of range");
}

/* Refuses numbers that are not positions within FAR_M: the drawing code relies on that. */
static void check_places(const float *places_m, size_t n)
{
  for (size_t i = 0; i < n; i++)
    if (!(fabsf(places_m[i]) <= FAR_M))
      refuse("a position is not finite, or far outside the world");
}

/* Finds an array of `columns` indices in each of *n rows. */
static const uint16_t *rows(const struct reader *reader, const json_t *item, const char *key,
                            uint32_t columns, uint32_t *n)
{
  uint32_t sizes[2] = {0, 0};
  const void *found = array(reader, json_object_get(item, key), "uint16", 2, sizes, 2, columns);
  *n = sizes[0];
  return found;
}

static void read_body(const struct reader *reader, const json_t *item, struct scene_body *body)
{
  uint32_t n_springs;
  rows(reader, item, "masses", 3, &body->n_masses);
  const uint16_t *springs = rows(reader, item, "springs", 2, &n_springs);
  body->faces = rows(reader, item, "faces", 5, &body->n_faces);
  body->voxels = rows(reader, item, "voxels", 8, &body->n_voxels);
  check_indices(springs, n_springs, 2, 2, body->n_masses);
  check_indices(body->faces, body->n_faces, 5, 4, body->n_masses);
  check_indices(body->faces + 4, body->n_faces, 5, 1, body->n_voxels);
  check_indices(body->voxels, body->n_voxels, 8, 8, body->n_masses);
}

/* A custom grid: rows of heights. */
static void read_grid(const json_t *list, struct scene_world *world)
{
  const size_t rows = json_array_size(list), columns = json_array_size(json_array_get(list, 0));
  if (rows < 2 || rows > 128 || columns < 2 || columns > 128 ||
      !(world->spacing_m > 1e-3 && world->spacing_m < 1e3))
    refuse("a grid must have 2 to 128 rows of 2 to 128 heights, and a valid spacing");
  float *heights_m = keep(calloc(rows * columns, sizeof(*heights_m)));
  for (size_t j = 0; j < rows; j++) {
    const json_t *row = json_array_get(list, j);
    if (json_array_size(row) != columns)
      refuse("a row of a grid is not as long as the first");
    for (size_t i = 0; i < columns; i++)
      heights_m[j * columns + i] = (float)json_number_value(json_array_get(row, i));
  }
  world->heights_m = heights_m;
  world->columns = (uint32_t)columns;
  world->rows = (uint32_t)rows;
  check_places(heights_m, rows * columns);
}

/* A terrain other than 8 × 8 heights is JSON, not an array after the header. */
static void read_terrain(const json_t *terrain, struct scene_world *world)
{
  const json_t *heights = json_object_get(terrain, "heights_m");
  const size_t n = json_array_size(heights);
  world->spacing_m = json_number_value(json_object_get(terrain, "spacing_m"));
  if (json_is_array(json_array_get(heights, 0))) {
    read_grid(heights, world);
    return;
  }
  if (n < 2 || n > 64 || !(world->spacing_m > 1e-3 && world->spacing_m < 1e3))
    refuse("a profile must have 2 to 64 heights, and a valid spacing");
  float *heights_m = keep(calloc(n, sizeof(*heights_m)));
  for (size_t k = 0; k < n; k++)
    heights_m[k] = (float)json_number_value(json_array_get(heights, k));
  world->heights_m = heights_m;
  world->n_profile = (uint32_t)n;
  check_places(heights_m, n);
}

static void read_world(const struct reader *reader, const json_t *item, struct scene_world *world)
{
  uint32_t sizes[2] = {0, 0};
  const json_t *light = json_object_get(item, "light_xy_m");
  for (size_t axis = 0; axis < 2; axis++)
    world->light_xy_m[axis] = json_number_value(json_array_get(light, axis));
  if (json_object_get(item, "terrain") != NULL) {
    read_terrain(json_object_get(item, "terrain"), world);
  } else {
    world->heights_m =
        array(reader, json_object_get(item, "terrain_heights_m"), "float32", 4, sizes, 2, 8);
    if (sizes[0] != 8)
      refuse("a terrain does not have 8 by 8 heights");
    check_places(world->heights_m, 64);
  }
  if (!(fabs(world->light_xy_m[0]) <= FAR_M && fabs(world->light_xy_m[1]) <= FAR_M))
    refuse("a light is far outside the world");
}

static void read_rollout(const struct reader *reader, const struct scene *scene, const json_t *item,
                         struct scene_rollout *rollout)
{
  uint32_t sizes[3] = {0, 0, 0};
  const json_int_t body = json_integer_value(json_object_get(item, "design"));
  const json_int_t world = json_integer_value(json_object_get(item, "environment"));
  if (body < 0 || body >= scene->n_bodies || world < 0 || world >= scene->n_worlds)
    refuse("a rollout refers to a design or environment that does not exist");
  rollout->body = (uint32_t)body;
  rollout->world = (uint32_t)world;
  rollout->masses_m = array(reader, json_object_get(item, "masses_m"), "float32", 4, sizes, 3, 3);
  rollout->n_frames = sizes[0];
  if (sizes[0] == 0 || sizes[1] != scene->bodies[body].n_masses)
    refuse("a recording does not fit its body");
  check_places(rollout->masses_m, (size_t)sizes[0] * sizes[1] * 3);
  const json_t *lights = json_object_get(item, "lights_m");
  if (lights == NULL)
    return;
  rollout->lights_m = array(reader, lights, "float32", 4, sizes, 2, 3);
  if (sizes[0] != rollout->n_frames)
    refuse("a light is not recorded in every frame");
  check_places(rollout->lights_m, (size_t)sizes[0] * 3);
}

struct scene scene_read(const void *bytes, size_t size)
{
  const unsigned char *b = bytes;
  if (size < 4)
    refuse("it ends before its header");
  const size_t length = b[0] | (size_t)b[1] << 8 | (size_t)b[2] << 16 | (size_t)b[3] << 24;
  const size_t start = (4 + length + 3) / 4 * 4;
  if (start > size)
    refuse("it ends within its header");
  json_t *header = json_loadb((const char *)b + 4, length, 0, NULL);
  if (header == NULL)
    refuse("its header is not JSON");
  const struct reader reader = {b + start, size - start};
  const json_t *designs = json_object_get(keep(header), "designs"),
               *environments = json_object_get(header, "environments"),
               *rollouts = json_object_get(header, "rollouts");
  struct scene scene = {.frame_s = json_number_value(json_object_get(header, "frame_s")),
                        .designs = designs};
  if (!(scene.frame_s > 0))
    refuse("it lacks the time between its frames");
  scene.bodies = list(designs, sizeof(*scene.bodies), &scene.n_bodies);
  scene.worlds = list(environments, sizeof(*scene.worlds), &scene.n_worlds);
  scene.rollouts = list(rollouts, sizeof(*scene.rollouts), &scene.n_rollouts);
  for (uint32_t i = 0; i < scene.n_bodies; i++)
    read_body(&reader, json_array_get(designs, i), &scene.bodies[i]);
  for (uint32_t i = 0; i < scene.n_worlds; i++)
    read_world(&reader, json_array_get(environments, i), &scene.worlds[i]);
  for (uint32_t i = 0; i < scene.n_rollouts; i++)
    read_rollout(&reader, &scene, json_array_get(rollouts, i), &scene.rollouts[i]);
  return scene;
}

/* Returns a list of n items and then n_more others. */
static void *joined(const void *list, uint32_t n, const void *more, uint32_t n_more, size_t width)
{
  char *both = keep(malloc(((size_t)n + n_more) * width + 1));
  if (n > 0)
    memcpy(both, list, n * width);
  memcpy(both + n * width, more, n_more * width);
  return both;
}

void scene_append(struct scene *scene, const struct scene *other)
{
  if (scene->n_rollouts > 0 && scene->frame_s != other->frame_s)
    refuse("scenes have different times between frames");
  for (uint32_t i = 0; i < other->n_rollouts; i++) {
    other->rollouts[i].body += scene->n_bodies;
    other->rollouts[i].world += scene->n_worlds;
  }
  *scene = (struct scene){.frame_s = other->frame_s,
                          .n_bodies = scene->n_bodies + other->n_bodies,
                          .n_worlds = scene->n_worlds + other->n_worlds,
                          .n_rollouts = scene->n_rollouts + other->n_rollouts,
                          .bodies = joined(scene->bodies, scene->n_bodies, other->bodies,
                                           other->n_bodies, sizeof(*scene->bodies)),
                          .worlds = joined(scene->worlds, scene->n_worlds, other->worlds,
                                           other->n_worlds, sizeof(*scene->worlds)),
                          .rollouts = joined(scene->rollouts, scene->n_rollouts, other->rollouts,
                                             other->n_rollouts, sizeof(*scene->rollouts))};
}
