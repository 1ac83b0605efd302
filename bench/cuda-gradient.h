/* cuda-gradient.h: what the checks of cuda-gradient.c are made of: robots, the float64 reference,
 * and calls of the device. */
#ifndef MORPHO_BENCH_CUDA_GRADIENT_H
#define MORPHO_BENCH_CUDA_GRADIENT_H

#include "compute/cuda/gradient.h"

enum { LIKE = 256, BLOCKS = 16 }; /* robots that are compared; sums of the reference */

extern struct mo_device *device; /* opened by main */

/* ---- robots ---- */

struct scene {
  struct mo_lattice *lattice;
  uint32_t n;
  struct mo_body **bodies;
  struct mo_environment *environments;
  struct mo_robot *robots;
};
/* Makes n distinct random bodies, each in a training environment. */
void make_scene(struct scene *s, uint32_t n);
void drop_scene(struct scene *s);

/* WEIGHTS of cuda-gradient.c: what follows the rule; the rule; the controller, which the caller
 * frees. */
const char *after_rule(const char *weights);
struct mo_gradient_options options_of(const char *weights);
struct mo_controller *weights_of(const char *weights);
/* Physics of n_steps with control periods of that many steps; 0: none. */
struct mo_physics physics_of(uint32_t n_steps, uint32_t control_steps);

/* ---- the reference ---- */

/* Robots i, i + 16, … form one sum; the sums are added in order. */
struct reference {
  const struct scene *scene;
  uint32_t n; /* at most LIKE */
  const struct mo_controller *controller;
  struct mo_physics physics;
  struct mo_gradient_options options;
  struct mo_gradient_counts counts[BLOCKS];
  double *sums[BLOCKS];
  struct mo_outcome outcomes[LIKE];
  uint32_t next;
};
/* Computes the mean gradient of the scene's first n robots: sums[0], counts[0]; and outcomes. */
void compute_reference(struct reference *r, long workers);
void drop_reference(struct reference *r);

/* ---- the device ---- */

struct result {
  struct mo_device_gradient call;
  double total_s;
};
/* Compute the gradient of robots first … first + n − 1 and print its times and a hash of its bits.
 * memory_bytes: as in mo_cuda_gradient_run. */
void run_with(struct result *r, const struct mo_controller *controller, const struct scene *s,
              uint32_t first, uint32_t n, const struct mo_physics *physics,
              const struct mo_gradient_options *options, uint64_t memory_bytes);
void run_steps(struct result *r, const struct mo_controller *controller, const struct scene *s,
               uint32_t first, uint32_t n, uint32_t n_steps, uint64_t memory_bytes);
void drop_result(struct result *r);
void print_counts(const char *name, const struct mo_gradient_counts *c);

struct likeness {
  double cosine, error, norm, norm_reference; /* error: relative */
};
struct likeness likeness_of(const float *gradient, const double *reference, size_t n);
/* Whether two calls have the same bits: gradients, outcomes and counts. */
int same_result(const struct result *a, const struct result *b);
/* Prints the median time of a learning step of the scene's first n robots. bound_s: of the device's
 * time; 0: none. */
void time_steps(const struct scene *s, uint32_t n, const struct mo_physics *physics,
                enum mo_cuda_halves halves, double bound_s);

/* ---- cuda-gradient-tasks.c: guides and objectives, profiles, damage ---- */
void check_tasks(void);
void short_tasks(uint32_t n, uint32_t n_steps);
void time_tasks(uint32_t n, const struct mo_physics *physics);

#endif
