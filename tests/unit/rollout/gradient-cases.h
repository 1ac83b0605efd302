/* gradient-cases.h: bodies, worlds and controllers on which gradients are tested. */
#ifndef MORPHO_TESTS_GRADIENT_CASES_H
#define MORPHO_TESTS_GRADIENT_CASES_H

#include <morpho/gradient.h>

#include "second.h"

#define GRADIENT_CASES 20

struct gradient_case {
  struct mo_lattice *lattice;
  struct mo_body *body;
  struct mo_controller *controller;
  struct mo_environment environment;
  struct mo_physics physics;
  double sigma_m;
  double *theta; /* (n_parameters) the controller's parameters as doubles */
};

/* Case k: a random body (one of them all 144 voxels) of one of several workspaces, mostly the
 * default one, a random controller or the shipped one, terrain from flat to 1 m, both sensors, both
 * impact modes. 0, or −1 with a diagnostic. */
int gradient_case_create(uint32_t k, struct gradient_case *out);
void gradient_case_free(struct gradient_case *c);

/* First parameter and number of parameters of each tensor, in file order. */
void gradient_tensors(const struct mo_controller *controller, size_t first[MO_CONTROLLER_TENSORS],
                      size_t count[MO_CONTROLLER_TENSORS]);

#endif
