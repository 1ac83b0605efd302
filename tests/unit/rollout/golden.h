/* golden.h: the stored reference rollouts of tests/golden/rollouts.json. */
#ifndef MORPHO_TESTS_GOLDEN_H
#define MORPHO_TESTS_GOLDEN_H

#include <morpho/rollout.h>

#define GOLDEN_MODES 2 /* MO_IMPACT_EXACT, MO_IMPACT_BISECTION */
#define GOLDEN_STEPS 6
static const int golden_steps[GOLDEN_STEPS] = {1, 10, 50, 100, 200, 1000};

struct golden_case {
  struct mo_body *body;
  struct mo_environment environment;
  double loss[GOLDEN_MODES];
  double com_m[GOLDEN_MODES][GOLDEN_STEPS][3];
};

struct golden {
  struct mo_lattice *lattice;
  struct mo_controller *controller;
  struct golden_case *cases;
  size_t n;
};

/* Returns 0, or −1 after printing a diagnostic. */
int golden_load(struct golden *golden);
void golden_free(struct golden *golden);
/* Reads a file of the source tree; free the result. */
char *golden_path(const char *relative);

#endif
