/* Reading and drawing scenes: whatever a server sends, either the reader refuses it or the picture
 * is drawn within its arrays. */
#include "../check.h"

#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

#include "../../../clients/film/raster.h"
#include "ctl.h"

/* One voxel that lies on flat ground and rises by 0.1 m in its second frame. */
static const char header[] =
    "{\"frame_s\":0.04,\"environments\":[{\"light_xy_m\":[4,3],\"terrain_heights_m\":"
    "{\"offset\":0,\"type\":\"float32\",\"shape\":[8,8]}}],\"designs\":[{\"id\":\"x\",\"genotype\":"
    "\"1\",\"masses\":{\"offset\":256,\"type\":\"uint16\",\"shape\":[8,3]},\"springs\":{\"offset\":"
    "304,\"type\":\"uint16\",\"shape\":[1,2]},\"voxels\":{\"offset\":312,\"type\":\"uint16\","
    "\"shape\":[1,8]},\"faces\":{\"offset\":328,\"type\":\"uint16\",\"shape\":[1,5]}}],"
    "\"rollouts\":"
    "[{\"design\":0,\"environment\":0,\"loss\":0.5,\"masses_m\":{\"offset\":344,\"type\":"
    "\"float32\",\"shape\":[2,8,3]}}]}";
#define HEADER_BYTES ((sizeof(header) - 1 + 7) / 8 * 8 + 4) /* plus 4: a multiple of 8 */
#define ARRAY_BYTES  (344 + 2 * 8 * 3 * 4)

static size_t make(unsigned char *bytes, const char *text)
{
  const size_t length = strlen(text) + (8 - (4 + strlen(text)) % 8) % 8;
  const uint16_t springs[2] = {0, 1}, faces[5] = {1, 5, 7, 3, 0};
  float heights[64] = {0}, masses[2][8][3];
  uint16_t voxel[8], lattice[8][3];
  for (uint16_t c = 0; c < 8; c++) {
    const uint16_t at[3] = {c >> 2, c >> 1 & 1, c & 1};
    voxel[c] = c;
    memcpy(lattice[c], at, sizeof(at));
    for (int frame = 0; frame < 2; frame++)
      for (int axis = 0; axis < 3; axis++)
        masses[frame][c][axis] = 0.1F * (float)at[axis] + (axis < 2 ? 2.5F : 0.1F * (float)frame);
  }
  for (int i = 0; i < 4; i++)
    bytes[i] = (unsigned char)(length >> (8 * i));
  memset(bytes + 4, ' ', length);
  memcpy(bytes + 4, text, strlen(text));
  unsigned char *arrays = bytes + 4 + length;
  memset(arrays, 0, ARRAY_BYTES);
  memcpy(arrays, heights, sizeof(heights));
  memcpy(arrays + 256, lattice, sizeof(lattice));
  memcpy(arrays + 304, springs, sizeof(springs));
  memcpy(arrays + 312, voxel, sizeof(voxel));
  memcpy(arrays + 328, faces, sizeof(faces));
  memcpy(arrays + 344, masses, sizeof(masses));
  return 4 + length + ARRAY_BYTES;
}

static _Alignas(8) unsigned char bytes[4096];

/* Returns whether the process exits with the status of an error for a truncated scene, or for two
 * scenes in a row. */
static bool refuses(size_t size, const struct scene *other)
{
  int status = 0;
  fflush(stdout);
  const pid_t process = fork();
  if (process == 0) {
    dup2(open("/dev/null", O_WRONLY), STDERR_FILENO);
    struct scene scene = scene_read(bytes, size);
    if (other != NULL)
      scene_append(&scene, other);
    _exit(0);
  }
  return waitpid(process, &status, 0) == process && WIFEXITED(status) &&
         WEXITSTATUS(status) == STATUS_ERROR;
}

static void reads(void)
{
  double center[3];
  const struct scene scene = scene_read(bytes, make(bytes, header));
  CHECK_INT(scene.n_rollouts, 1);
  CHECK_INT(scene.bodies[0].n_masses, 8);
  raster_center(&scene, 0, 0.02, center);
  CHECK_NEAR(center[0], 2.55, 1e-6);
  CHECK_NEAR(center[2], 0.1, 1e-6);
  raster_center(&scene, 0, 99, center);
  CHECK_NEAR(center[2], 0.15, 1e-6);
}

/* Two scenes as one: the second rollout keeps its body and environment. */
static void appends(void)
{
  struct scene both = {0};
  double center[3];
  const size_t size = make(bytes, header);
  for (uint32_t i = 0; i < 2; i++) {
    const struct scene one = scene_read(bytes, size);
    scene_append(&both, &one);
    CHECK_INT(both.n_rollouts, i + 1);
  }
  CHECK(both.n_bodies == 2 && both.n_worlds == 2 && both.frame_s == 0.04);
  CHECK(both.rollouts[1].body == 1 && both.rollouts[1].world == 1);
  raster_center(&both, 1, 99, center);
  CHECK_NEAR(center[2], 0.15, 1e-6);
  both.frame_s = 0.02;
  CHECK(refuses(size, &both));
}

/* A part of a scene ends before its header says. */
static void refuses_what_is_cut(void)
{
  const size_t size = make(bytes, header);
  CHECK(refuses(0, NULL) && refuses(3, NULL) && refuses(size - 1, NULL) && !refuses(size, NULL));
  for (size_t n = 4; n < size; n += 13)
    CHECK(refuses(n, NULL));
}

static void refuses_what_does_not_fit(void)
{
  static const struct {
    const char *from, *to;
  } cases[] = {
      {"\"offset\":344", "\"offset\":352"},
      {"\"offset\":344", "\"offset\":-44"},
      {"\"offset\":256", "\"offset\":999999"},
      {"[2,8,3]", "[2,9,3]"},
      {"[2,8,3]", "[0,8,3]"},
      {"[2,8,3]", "[-1,8,3]"},
      {"[2,8,3]", "[99999999,8,3]"},
      {"[1,5]", "[9,5]"},
      {"[1,5]", "[1,4]"},
      {"[8,8]", "[8]"},
      {"\"design\":0", "\"design\":1"},
      {"\"environment\":0", "\"environment\":-1"},
      {"\"frame_s\":0.04", "\"frame_s\":0"},
      {"\"uint16\",\"shape\":[8,3]", "7"},
      {"\"rollouts\":[", "\"rollouts\":3,\"x\":["},
      {"{\"frame_s\"", "[\"frame_s\""},
      {"\"shape\":[8,3]", "\"shape\":[4,3]"},
  };
  for (size_t i = 0; i < COUNT(cases); i++) {
    char text[sizeof(header) + 64];
    const char *at = strstr(header, cases[i].from);
    REQUIRE(at != NULL);
    snprintf(text, sizeof(text), "%.*s%s%s", (int)(at - header), header, cases[i].to,
             at + strlen(cases[i].from));
    const bool is_refused = refuses(make(bytes, text), NULL);
    CHECK(is_refused);
    if (!is_refused)
      printf("# not refused: %s\n", cases[i].to);
  }
}

static void refuses_indices_out_of_range(void)
{
  static const size_t offsets[] = {304, 312, 328, 336};
  for (size_t i = 0; i < COUNT(offsets); i++) {
    const size_t size = make(bytes, header);
    bytes[size - ARRAY_BYTES + offsets[i]] = 8;
    CHECK(refuses(size, NULL));
  }
}

static void refuses_places_that_are_none(void)
{
  static const float odd[] = {NAN, INFINITY, -1e30F};
  for (size_t i = 0; i < 2 * COUNT(odd); i++) {
    const size_t size = make(bytes, header);
    memcpy(bytes + size - ARRAY_BYTES + (i % 2 == 0 ? 0 : 400), &odd[i / 2], sizeof(float));
    CHECK(refuses(size, NULL));
  }
}

static uint8_t rgb[96 * 64 * 3];

/* The scene with a profile instead of the grid. */
static size_t make_profile(const char *members)
{
  static const char grid[] =
      "\"terrain_heights_m\":{\"offset\":0,\"type\":\"float32\",\"shape\":[8,8]}";
  char text[sizeof(header) + 128];
  const char *at = strstr(header, grid);
  snprintf(text, sizeof(text), "%.*s\"terrain\":{%s}%s", (int)(at - header), header, members,
           at + strlen(grid));
  return make(bytes, text);
}

/* A wall of 0.5 m behind the voxel: it hides what a flat ground shows, and stands in the light. */
static void draws_profiles(void)
{
  static const char *const odd[] = {"\"heights_m\":[0],\"spacing_m\":1",
                                    "\"heights_m\":[0,0],\"spacing_m\":0",
                                    "\"heights_m\":[0,0]",
                                    "\"heights_m\":[0,1e30],\"spacing_m\":1",
                                    "\"spacing_m\":1",
                                    "\"heights_m\":3,\"spacing_m\":1"};
  static const struct raster_camera camera = {{3, 2.55, 0.1}, 0, 0.6, 4};
  static const char flat[] = "\"heights_m\":[0,0],\"spacing_m\":0.9",
                    wall[] = "\"heights_m\":[0,0,0,0,0.5],\"spacing_m\":0.9";
  static uint8_t seen[3][sizeof(rgb)];
  struct raster *raster = raster_create(96, 64);
  for (int i = 0; i < 3; i++) {
    const size_t size = i == 0 ? make(bytes, header) : make_profile(i == 1 ? flat : wall);
    const struct scene scene = scene_read(bytes, size);
    CHECK_INT(scene.worlds[0].n_profile, i == 0 ? 0 : i == 1 ? 2 : 5);
    raster_draw(raster, &scene, 0, 0, &camera, true, seen[i]);
  }
  int same = 0, changed = 0;
  for (size_t k = 0; k < sizeof(rgb); k++) {
    same += abs(seen[0][k] - seen[1][k]) <= 8;
    changed += abs(seen[1][k] - seen[2][k]) > 8;
  }
  CHECK(same > (int)sizeof(rgb) * 95 / 100); /* a level profile is a level grid */
  CHECK(changed > (int)sizeof(rgb) / 20);
  for (size_t i = 0; i < COUNT(odd); i++)
    CHECK(refuses(make_profile(odd[i]), NULL));
}

/* The same wall as rows of a grid around the start, which a level grid does not have. */
static void draws_grids(void)
{
  static const char *const odd[] = {
      "\"heights_m\":[[0,0],[0]],\"spacing_m\":1", "\"heights_m\":[[0,0]],\"spacing_m\":1",
      "\"heights_m\":[[0],[0]],\"spacing_m\":1",   "\"heights_m\":[[0,0],[0,1e30]],\"spacing_m\":1",
      "\"heights_m\":[[0,0],3],\"spacing_m\":1",   "\"heights_m\":[[0,0],[0,0]]"};
  static const struct raster_camera camera = {{3, 2.55, 0.1}, 0, 0.6, 4};
  static const char flat[] = "\"heights_m\":[[0,0,0],[0,0,0]],\"spacing_m\":1.8",
                    wall[] = "\"heights_m\":[[0,0,0,0,0.5],[0,0,0,0,0.5]],\"spacing_m\":0.9";
  static uint8_t seen[3][sizeof(rgb)];
  struct raster *raster = raster_create(96, 64);
  for (int i = 0; i < 3; i++) {
    const size_t size = i == 0 ? make(bytes, header) : make_profile(i == 1 ? flat : wall);
    const struct scene scene = scene_read(bytes, size);
    CHECK_INT(scene.worlds[0].columns, i == 0 ? 0 : i == 1 ? 3 : 5);
    CHECK_INT(scene.worlds[0].rows, i == 0 ? 0 : 2);
    raster_draw(raster, &scene, 0, 0, &camera, true, seen[i]);
  }
  int same = 0, changed = 0;
  for (size_t k = 0; k < sizeof(rgb); k++) {
    same += abs(seen[0][k] - seen[1][k]) <= 8;
    changed += abs(seen[1][k] - seen[2][k]) > 8;
  }
  CHECK(same > (int)sizeof(rgb) * 95 / 100);
  CHECK(changed > (int)sizeof(rgb) / 20);
  for (size_t i = 0; i < COUNT(odd); i++)
    CHECK(refuses(make_profile(odd[i]), NULL));
}

static void draws(void)
{
  const struct raster_camera camera = {{2.55, 2.55, 0.1}, 0.5, 1.2, 0.6};
  struct raster *raster = raster_create(96, 64);
  const struct scene scene = scene_read(bytes, make(bytes, header));
  raster_draw(raster, &scene, 0, 0.02, &camera, false, rgb);
  /* The face at rest is bright, and the ground around it is not. */
  CHECK(rgb[(32 * 96 + 48) * 3] > 110);
  CHECK(rgb[(32 * 96 + 4) * 3] < 110);
  /* Seen from inside the body, and from below. */
  static const struct raster_camera odd[] = {
      {{2.55, 2.55, 0.1}, 0, 0.1, 0.01}, {{2.55, 2.55, -5}, 3, -1.5, 4}, {{0, 0, 0}, 0, 0, 0}};
  for (size_t i = 0; i < COUNT(odd); i++)
    raster_draw(raster, &scene, 0, 0, &odd[i], true, rgb);
}

static void encodes(void)
{
  size_t size;
  unsigned char *file = png_encode(rgb, 96, 64, &size);
  REQUIRE(file != NULL);
  CHECK(memcmp(file, "\x89PNG\r\n\x1a\n", 8) == 0 && size > 60);
  CHECK(memcmp(file + size - 8, "IEND", 4) == 0);
  free(file);
}

static const struct check_case cases[] = {
    {"reads a scene", reads},
    {"joins two scenes", appends},
    {"refuses a truncated scene", refuses_what_is_cut},
    {"refuses arrays that do not fit", refuses_what_does_not_fit},
    {"refuses indices out of range", refuses_indices_out_of_range},
    {"refuses invalid positions", refuses_places_that_are_none},
    {"draws", draws},
    {"draws profiles, and refuses odd ones", draws_profiles},
    {"draws grids of other sizes", draws_grids},
    {"encodes a picture", encodes},
};
CHECK_MAIN(cases)
