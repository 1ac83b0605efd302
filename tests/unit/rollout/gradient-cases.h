/* gradient-cases.h: bodies, environments and controllers on which gradients are tested. */
#ifndef MORPHO_TESTS_GRADIENT_CASES_H
#define MORPHO_TESTS_GRADIENT_CASES_H

#include "../make.h"
#include "second.h"

#define GRADIENT_CASES 20

struct gradient_case {
  struct mo_body *body;
  struct mo_controller *controller;
  struct mo_environment environment;
  struct mo_physics physics;
  double sigma_m;
  double *theta; /* (n_parameters) the controller's parameters as doubles */
};

/* First parameter and number of parameters of each tensor, in file order. */
static inline void gradient_tensors(const struct mo_controller *controller,
                                    size_t first[MO_CONTROLLER_TENSORS],
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

static inline struct mo_body *gradient_case_body(uint32_t k, struct mo_workspace workspace)
{
  const struct mo_lattice *lattice = make_lattice(workspace);
  struct mo_random random = dice(77, 1, k);
  uint64_t bits[MO_DEFAULT_WORDS] = {0};
  uint32_t voxels = 0; /* in larger workspaces, skip the smallest draws */
  if (k == 0)
    return make_full_body(lattice);
  for (int tries = 0; tries < 50 && (voxels == 0 || voxels < mo_workspace_voxels(workspace) / 6);
       tries++) {
    make_check(mo_genotype_random(workspace, &random, bits), "a body");
    voxels = mo_genotype_count(workspace, bits);
  }
  return make_body(lattice, bits);
}

/* Xavier weights; biases, gains and shifts are moved off their initial values as well. */
static inline struct mo_controller *
gradient_case_controller(uint32_t k, struct mo_workspace workspace, enum mo_sensor sensor)
{
  if (k % 5 == 2)
    return make_shipped_controller("bootstrap");
  struct mo_controller *controller = make_controller(workspace, sensor);
  size_t first[MO_CONTROLLER_TENSORS], count[MO_CONTROLLER_TENSORS];
  struct mo_random random = dice(77, 2, k);
  mo_controller_randomize(controller, 1000 + k);
  gradient_tensors(controller, first, count);
  for (int t = 0; t < MO_CONTROLLER_TENSORS; t++)
    for (size_t i = 0; t % 4 != 0 && i < count[t]; i++)
      controller->parameters[first[t] + i] += (float)(0.1 * mo_random_normal(&random));
  return controller;
}

/* Makes case k: a random body (one of them with all 144 voxels) in one of several workspaces,
 * mostly the default one, a random controller or the shipped one, terrain from flat to 1 m, both
 * sensors, both impact modes. */
static inline struct gradient_case make_gradient_case(uint32_t k)
{
  static const struct mo_workspace others[] = {{3, 3, 2}, {2, 2, 2}, {1, 1, 1}, {4, 2, 3}};
  static const double sigmas[] = {0.05, 0.0, 0.1, 0.02, 0.3, 0.08, 1.0};
  const struct mo_workspace workspace =
      k % 5 == 1 || k % 5 == 3 ? others[k / 2 % 4] : MO_DEFAULT_WORKSPACE;
  const enum mo_sensor sensor = k % 2 == 0 ? MO_SENSOR_INVERSE_SQRT : MO_SENSOR_INVERSE_SQUARE;
  struct gradient_case c = {.body = gradient_case_body(k, workspace),
                            .controller = gradient_case_controller(k, workspace, sensor),
                            .physics = mo_paper_physics(),
                            .sigma_m = sigmas[k % 7]};
  mo_environment_training(77, 3, k, &c.environment); /* for its light */
  mo_terrain_random(77, 4, k, c.sigma_m, c.environment.terrain_heights_m);
  c.physics.scheme.impact = k / 2 % 2 == 0 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
  c.theta = make_zeros(c.controller->n_parameters, sizeof(double));
  for (size_t i = 0; i < c.controller->n_parameters; i++)
    c.theta[i] = (double)c.controller->parameters[i];
  return c;
}

#endif
