/* fixture.h: trainings whose gradients are made up: a training takes any gradient, and these tests
 * are about the rest. */
#ifndef MORPHO_TESTS_LEARNING_FIXTURE_H
#define MORPHO_TESTS_LEARNING_FIXTURE_H

#include "../check.h"

#include <morpho/learning.h>

struct made_up {
  size_t n;
  double *gradient;            /* (n) */
  struct mo_outcome *outcomes; /* (batch) */
  struct mo_gradient_counts counts;
};

static inline struct mo_training_settings small_settings(enum mo_training_kind kind)
{
  struct mo_training_settings settings = mo_training_defaults(kind);
  settings.n_steps = 9;
  settings.batch = 5;
  settings.learning.schedule.warmup_steps = 2;
  return settings;
}

static inline void made_up_free(struct made_up *made_up)
{
  free(made_up->gradient);
  free(made_up->outcomes);
}

static inline int made_up_create(struct made_up *made_up, const struct mo_training *training)
{
  made_up->counts = (struct mo_gradient_counts){0};
  made_up->n = mo_training_controller(training)->n_parameters;
  made_up->gradient = calloc(made_up->n, sizeof(double));
  made_up->outcomes = calloc(mo_training_settings_of(training)->batch, sizeof(struct mo_outcome));
  if (made_up->gradient != NULL && made_up->outcomes != NULL)
    return 0;
  made_up_free(made_up);
  return -1;
}

/* A gradient that depends on the weights, the robots and the step: what is lost of any of them
 * shows. */
static inline void make_up(struct made_up *made_up, const struct mo_training *training,
                           const struct mo_robot *robots)
{
  const struct mo_training_settings *settings = mo_training_settings_of(training);
  double of_robots = 0.0;
  made_up->counts = (struct mo_gradient_counts){0};
  for (uint32_t i = 0; i < settings->batch; i++) {
    of_robots += robots[i].environment->light_xy_m[0] * robots[i].body->n_masses +
                 robots[i].environment->terrain_heights_m[9] * robots[i].body->spring_lattice[0];
    made_up->outcomes[i] = (struct mo_outcome){.loss = 0.5 + 0.1 * i};
    made_up->counts.robots++;
    made_up->counts.steps += 1000;
    made_up->counts.clipped_steps += 10 * (i % 2);
    made_up->counts.clipped_robots += i % 2;
  }
  struct mo_random random;
  mo_random_init(&random, 5, MO_PURPOSE_CHECK, mo_training_step(training), 0);
  const float *weights = mo_training_controller(training)->parameters;
  for (size_t i = 0; i < made_up->n; i++)
    made_up->gradient[i] =
        1e-3 * (mo_random_uniform(&random) - 0.5) + 1e-2 * weights[i] + 1e-6 * of_robots;
}

static inline int advance(struct mo_training *training, struct made_up *made_up,
                          struct mo_training_report *report)
{
  const struct mo_robot *robots = NULL;
  const int r = mo_training_draw(training, NULL, NULL, &robots);
  if (r < 0)
    return r;
  make_up(made_up, training, robots);
  return mo_training_apply(training, made_up->gradient, made_up->outcomes, &made_up->counts,
                           report);
}

/* A finetuning on the first n held-out designs, from random weights times `factor`. NULL: failed.
 */
static inline struct mo_training *finetuning(const struct mo_training_settings *settings,
                                             uint32_t n, float factor)
{
  struct mo_controller *parent = NULL;
  struct mo_training *training = NULL;
  uint64_t *designs = calloc(n, MO_DEFAULT_WORDS * sizeof(uint64_t));
  if (designs != NULL && mo_held_out_designs(1, n, designs) == MO_OK &&
      mo_controller_create(MO_DEFAULT_WORKSPACE, settings->sensor, &parent) == MO_OK) {
    mo_controller_randomize(parent, 7);
    for (size_t i = 0; i < parent->n_parameters; i++)
      parent->parameters[i] *= factor;
    if (mo_training_create(settings, parent, designs, n, &training, NULL) < 0)
      training = NULL;
  }
  mo_controller_free(parent);
  free(designs);
  return training;
}

#endif
