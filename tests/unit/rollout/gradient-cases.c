/* gradient-cases.c: see gradient-cases.h. */
#include "gradient-cases.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "golden.h"

void gradient_tensors(const struct mo_controller *controller, size_t first[MO_CONTROLLER_TENSORS],
                      size_t count[MO_CONTROLLER_TENSORS])
{
  size_t at = 0;
  for (int t = 0; t < MO_CONTROLLER_TENSORS; t++) {
    const int layer = t / 4, part = t % 4;
    const size_t rows = layer < MO_HIDDEN_LAYERS ? MO_HIDDEN : controller->n_springs;
    const size_t width = layer == 0 ? controller->n_inputs : MO_HIDDEN;
    first[t] = at;
    count[t] = part == 0 ? rows * width : rows;
    at += count[t];
  }
}

static int make_body(uint32_t k, struct mo_workspace workspace, struct gradient_case *c)
{
  uint64_t bits[MO_DEFAULT_WORDS] = {0};
  if (mo_lattice_create(workspace, &c->lattice) < 0)
    return -1;
  if (k == 0) {
    for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++)
      bits[v >> 6] |= UINT64_C(1) << (v & 63);
  } else {
    struct mo_random random;
    mo_random_init(&random, 77, MO_PURPOSE_CHECK, 1, k);
    uint32_t voxels = 0; /* the smallest draws are uninteresting where there is room */
    for (int tries = 0; tries < 50 && (voxels == 0 || voxels < mo_workspace_voxels(workspace) / 6);
         tries++) {
      if (mo_genotype_random(workspace, &random, bits) < 0)
        return -1;
      voxels = mo_genotype_count(workspace, bits);
    }
  }
  return mo_body_create(c->lattice, bits, &c->body) < 0 ? -1 : 0;
}

/* Xavier weights; biases, gains and shifts off their initial values too. */
static int make_controller(uint32_t k, struct mo_workspace workspace, enum mo_sensor sensor,
                           struct gradient_case *c)
{
  if (k % 5 == 2) {
    struct mo_message message;
    char *path = golden_path("data/controllers/bootstrap.safetensors");
    const int r =
        path != NULL ? mo_controller_read(path, &c->controller, &message) : MO_ERR_NO_MEMORY;
    if (r < 0)
      printf("# %s: %s\n", path != NULL ? path : "(no memory)", mo_error_text(r));
    free(path);
    return r < 0 ? -1 : 0;
  }
  if (mo_controller_create(workspace, sensor, &c->controller) < 0)
    return -1;
  mo_controller_randomize(c->controller, 1000 + k);
  size_t first[MO_CONTROLLER_TENSORS], count[MO_CONTROLLER_TENSORS];
  gradient_tensors(c->controller, first, count);
  struct mo_random random;
  mo_random_init(&random, 77, MO_PURPOSE_CHECK, 2, k);
  for (int t = 0; t < MO_CONTROLLER_TENSORS; t++)
    for (size_t i = 0; t % 4 != 0 && i < count[t]; i++)
      c->controller->parameters[first[t] + i] += (float)(0.1 * mo_random_normal(&random));
  return 0;
}

int gradient_case_create(uint32_t k, struct gradient_case *c)
{
  static const struct mo_workspace others[] = {{3, 3, 2}, {2, 2, 2}, {1, 1, 1}, {4, 2, 3}};
  static const double sigmas[] = {0.05, 0.0, 0.1, 0.02, 0.3, 0.08, 1.0};
  *c = (struct gradient_case){.sigma_m = sigmas[k % 7], .physics = mo_default_physics()};
  const struct mo_workspace workspace =
      k % 5 == 1 || k % 5 == 3 ? others[k / 2 % 4] : MO_DEFAULT_WORKSPACE;
  const enum mo_sensor sensor = k % 2 == 0 ? MO_SENSOR_INVERSE_SQRT : MO_SENSOR_INVERSE_SQUARE;
  if (make_body(k, workspace, c) < 0 || make_controller(k, workspace, sensor, c) < 0) {
    gradient_case_free(c);
    return -1;
  }
  mo_environment_training(77, 3, k, &c->environment); /* for its light */
  mo_terrain_random(77, 4, k, c->sigma_m, c->environment.terrain_heights_m);
  c->physics.impact = k / 2 % 2 == 0 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
  c->theta = malloc(c->controller->n_parameters * sizeof(double));
  if (c->theta == NULL) {
    gradient_case_free(c);
    return -1;
  }
  for (size_t i = 0; i < c->controller->n_parameters; i++)
    c->theta[i] = (double)c->controller->parameters[i];
  return 0;
}

void gradient_case_free(struct gradient_case *c)
{
  free(c->theta);
  mo_controller_free(c->controller);
  mo_body_free(c->body);
  mo_lattice_free(c->lattice);
  *c = (struct gradient_case){0};
}
