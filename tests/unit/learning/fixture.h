/* fixture.h: training runs with made-up gradients: a training run accepts any gradient, and these
 * tests are about everything else. */
#ifndef MORPHO_TESTS_LEARNING_FIXTURE_H
#define MORPHO_TESTS_LEARNING_FIXTURE_H

#include "../make.h"

#include <stdbool.h>

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

static inline struct made_up *make_made_up(const struct mo_training *training)
{
  struct made_up *made_up = make_zeros(1, sizeof(*made_up));
  made_up->n = mo_training_controller(training)->n_parameters;
  made_up->gradient = make_zeros(made_up->n, sizeof(double));
  made_up->outcomes =
      make_zeros(mo_training_settings_of(training)->batch, sizeof(struct mo_outcome));
  return made_up;
}

/* Makes up a gradient that depends on the weights, the robots and the step: if any of them is lost,
 * the result differs. */
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

static inline const struct mo_robot *draw(struct mo_training *training)
{
  const struct mo_robot *robots = NULL;
  make_check(mo_training_draw(training, NULL, NULL, &robots), "draw");
  return robots;
}

static inline int apply(struct mo_training *training, const struct made_up *made_up,
                        struct mo_training_report *report)
{
  return mo_training_apply(training, made_up->gradient, made_up->outcomes, &made_up->counts,
                           report);
}

static inline int advance(struct mo_training *training, struct made_up *made_up,
                          struct mo_training_report *report)
{
  const struct mo_robot *robots = NULL;
  const int r = mo_training_draw(training, NULL, NULL, &robots);
  if (r < 0)
    return r;
  make_up(made_up, training, robots);
  return apply(training, made_up, report);
}

/* Returns a finetuning run on the first n held-out designs, from random weights times `factor`. */
static inline struct mo_training *finetuning(const struct mo_training_settings *settings,
                                             uint32_t n, float factor)
{
  struct mo_controller *parent = make_random_controller(settings->sensor, 7);
  uint64_t *designs = make_zeros(n, MO_DEFAULT_WORDS * sizeof(uint64_t));
  make_check(mo_held_out_designs(1, n, designs), "designs");
  for (size_t i = 0; i < parent->n_parameters; i++)
    parent->parameters[i] *= factor;
  return make_training(settings, parent, designs, n);
}

/* ---- checkpoints ---- */

struct blob {
  uint8_t *bytes;
  size_t size;
};

static inline struct blob encoded(const struct mo_training *training)
{
  struct blob blob = {NULL, 0};
  make_check(mo_training_encode(training, &blob.bytes, &blob.size), "encode");
  check_keep(blob.bytes, free);
  return blob;
}

static inline bool same_blob(struct blob a, struct blob b)
{
  return a.size == b.size && memcmp(a.bytes, b.bytes, a.size) == 0;
}

static inline struct mo_training *decoded(struct blob blob)
{
  struct mo_training *training = NULL;
  make_check(mo_training_decode(blob.bytes, blob.size, &training, NULL), "decode");
  return check_keep(training, drop_training);
}

static inline bool same_state(const struct mo_training *a, const struct mo_training *b)
{
  return same_blob(encoded(a), encoded(b));
}

/* ---- bodies ---- */

static inline bool is_body_of(const struct mo_body *body, const struct mo_lattice *lattice,
                              const uint64_t *design)
{
  struct mo_body *made = NULL;
  make_check(mo_body_create(lattice, design, &made), "a body");
  const bool same = body->n_springs == made->n_springs && body->n_masses == made->n_masses &&
                    SAME(body->spring_lattice, made->spring_lattice, made->n_springs);
  mo_body_free(made);
  return same;
}

#endif
