/* golden.c: reads tests/golden/rollouts.json. */
#include "golden.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <jansson.h>

char *golden_path(const char *relative)
{
  const char *root = getenv("MORPHO_SOURCE_DIR");
  char *path = NULL;
  return asprintf(&path, "%s/%s", root != NULL ? root : ".", relative) < 0 ? NULL : path;
}

static int read_case(struct golden *golden, const json_t *item, struct golden_case *out)
{
  static const char *const modes[GOLDEN_MODES] = {"exact", "bisection8"};
  const char *voxels = json_string_value(json_object_get(item, "voxels"));
  const json_t *heights = json_object_get(item, "terrain_heights_m"),
               *light = json_object_get(item, "light_xy_m");
  uint64_t bits[MO_DEFAULT_WORDS];
  if (voxels == NULL || json_array_size(heights) != MO_TERRAIN_HEIGHTS ||
      json_array_size(light) != 2 ||
      mo_genotype_from_text(MO_DEFAULT_WORKSPACE, voxels, strlen(voxels), bits, NULL) < 0 ||
      mo_body_create(golden->lattice, bits, &out->body) < 0)
    return -1;
  for (size_t k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    out->environment.terrain_heights_m[k] = json_number_value(json_array_get(heights, k));
  for (size_t k = 0; k < 2; k++)
    out->environment.light_xy_m[k] = json_number_value(json_array_get(light, k));
  for (int m = 0; m < GOLDEN_MODES; m++) {
    const json_t *mode = json_object_get(item, modes[m]), *coms = json_object_get(mode, "com_m");
    out->loss[m] = json_real_value(json_object_get(mode, "loss"));
    for (int s = 0; s < GOLDEN_STEPS; s++) {
      char key[16];
      snprintf(key, sizeof(key), "%d", golden_steps[s]);
      const json_t *com = json_object_get(coms, key);
      if (json_array_size(com) != 3)
        return -1;
      for (size_t axis = 0; axis < 3; axis++)
        out->com_m[m][s][axis] = json_number_value(json_array_get(com, axis));
    }
  }
  return 0;
}

static int load_cases(struct golden *golden, const json_t *root)
{
  const json_t *cases = json_object_get(root, "cases");
  golden->cases = calloc(json_array_size(cases) + 1, sizeof(*golden->cases));
  if (golden->cases == NULL || json_array_size(cases) == 0)
    return -1;
  for (golden->n = 0; golden->n < json_array_size(cases); golden->n++)
    if (read_case(golden, json_array_get(cases, golden->n), &golden->cases[golden->n]) < 0)
      return -1;
  return 0;
}

int golden_load(struct golden *golden)
{
  memset(golden, 0, sizeof(*golden));
  struct mo_message message = {""};
  char *cases = golden_path("tests/golden/rollouts.json"),
       *weights = golden_path("data/controllers/bootstrap.safetensors");
  json_error_t error = {.text = ""};
  json_t *root = cases != NULL ? json_load_file(cases, JSON_REJECT_DUPLICATES, &error) : NULL;
  int r = -1;
  if (root != NULL && weights != NULL &&
      mo_lattice_create(MO_DEFAULT_WORKSPACE, &golden->lattice) == 0 &&
      mo_controller_read(weights, &golden->controller, &message) == 0)
    r = load_cases(golden, root);
  if (r < 0) {
    printf("# the golden rollouts cannot be read: %s%s\n", error.text, message.text);
    golden_free(golden);
  }
  json_decref(root);
  free(cases);
  free(weights);
  return r;
}

void golden_free(struct golden *golden)
{
  for (size_t i = 0; golden->cases != NULL && i < golden->n; i++)
    mo_body_free(golden->cases[i].body);
  free(golden->cases);
  mo_controller_free(golden->controller);
  mo_lattice_free(golden->lattice);
  memset(golden, 0, sizeof(*golden));
}
