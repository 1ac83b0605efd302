/* cuda.h: what the parts of cuda-bench share: the module, its device, and rows of rollouts. */
#ifndef MORPHO_BENCH_CUDA_H
#define MORPHO_BENCH_CUDA_H

#include "../tests/unit/rollout/golden.h"
#include "device.h"

/* Loaded and opened by main. */
extern const struct mo_device_module *module;
extern struct mo_device *device;
extern struct golden golden;

/* The caller frees the body. */
struct mo_body *body_of(const uint64_t *bits);
/* control_steps: 0: no control period. */
struct mo_physics physics_with(enum mo_integrator integrator, uint32_t control_steps);
struct mo_physics physics_with_period(uint32_t control_steps); /* of the integrator paper */

struct rows {
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_robot *robots;
  struct mo_outcome *outcomes;
  uint32_t n;
};
/* Makes rows: each body in `each` environments of the paper's test set, one after the other. */
struct rows *make_rows(struct mo_body *const *bodies, uint32_t n_bodies, uint32_t each);
void free_rows(struct rows *rows);

/* Rows of n distinct bodies, each in an environment of its own with the next of all tasks. Of four
 * rows with one task, one has a profile, one damage, and one both. */
struct guided {
  uint32_t n;
  struct mo_body **bodies;
  struct mo_environment *environments;
  struct mo_robot *robots;
  struct mo_outcome *outcomes, *truth;
};
struct guided make_guided(uint32_t n, uint64_t seed);
void drop_guided(struct guided *g);

/* Scores n robots. controller: NULL: passive bodies. */
struct mo_device_score run(struct mo_device_controller *controller, const struct mo_robot *robots,
                           uint32_t n, const struct mo_physics *physics,
                           struct mo_outcome *outcomes);
/* The same with measures, (n). */
struct mo_device_score run_measured(struct mo_device_controller *controller,
                                    const struct mo_robot *robots, uint32_t n,
                                    const struct mo_physics *physics, struct mo_outcome *outcomes,
                                    double (*measures)[MO_MEASURES]);

/* Computes outcomes in float64, on all processors. controller: NULL: passive bodies. measures: NULL
 * or (n). */
void compute_references(const struct mo_controller *controller, const struct mo_robot *robots,
                        uint32_t n, const struct mo_physics *physics, struct mo_outcome *outcomes,
                        double (*measures)[MO_MEASURES]);

/* ---- cuda-check.c ---- */
/* references: the file of float64 losses that is read, or written; NULL: none. */
void check_all(struct mo_device_controller *controller, const char *references);
void check_short(struct mo_device_controller *controller); /* a few steps of everything */

/* ---- cuda-tasks.c: guides and objectives, profiles, damage ---- */
void check_tasks(struct mo_device_controller *controller);
void check_tasks_short(struct mo_device_controller *controller, uint32_t n_steps);

/* ---- cuda-measures.c ---- */
void check_measures(struct mo_device_controller *controller);
void check_measures_short(struct mo_device_controller *controller, uint32_t n_steps);

#endif
