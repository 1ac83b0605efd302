/* gradient-physics-rollouts.c: whole rollouts of the fast gradient's float32 physics, and the way
 * back, against the float64 reference; what each function costs. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include <morpho/random.h>

#include "../check.h"
#include "bodies.h"
#include "gradient-physics-both.h"

/* ---- whole rollouts ---- */

/* Both ways along rollouts whose activations do not depend on the state: the weights of the sensors
 * are 0, so that the reference's gradient has nothing that the physics does not. The adjoints of
 * all velocities, at every 10th step, are one long vector. */
#define KEPT_EVERY 10

struct walk {
  const struct gradient_case *c;
  double *kept; /* (n_steps / KEPT_EVERY, n_masses, 3) */
};

static void keep(void *context, uint32_t step, double *dx, double *dv)
{
  const struct walk *w = context;
  const size_t n = 3 * (size_t)w->c->body->n_masses;
  (void)dx;
  if (step % KEPT_EVERY == 0)
    memcpy(w->kept + (step / KEPT_EVERY - 1) * n, dv, n * sizeof(double));
}

static bool open_loop(const struct gradient_case *c, float *activation)
{
  const struct mo_controller *controller = c->controller;
  const uint32_t n_springs = c->body->n_springs;
  double *memory = calloc(mo_controller_tape_doubles(controller, n_springs), sizeof(double));
  if (memory == NULL)
    return false;
  struct mo_controller_tape tape = mo_controller_tape_place(controller, n_springs, memory);
  for (uint32_t o = 0; o < MO_HIDDEN; o++)
    memset(controller->weight[0] + (size_t)o * controller->n_inputs, 0,
           controller->n_masses * sizeof(float));
  for (uint32_t step = 0; step < c->physics.n_steps; step++) {
    for (int i = 0; i < MO_CPG_INPUTS; i++)
      tape.input[controller->n_masses + (uint32_t)i] =
          sin(MO_CPG_RAD_PER_S * step * c->physics.dt_s + 2.0 * M_PI * i / MO_CPG_INPUTS);
    mo_controller_forward(controller, c->body->spring_lattice, n_springs, &tape);
    for (uint32_t s = 0; s < n_springs; s++)
      activation[(size_t)step * n_springs + s] = (float)tape.output[s];
  }
  free(memory);
  return true;
}

static int whole_rollout(struct gradient_case *c, double bound, const struct physics_functions *f,
                         double sums[3])
{
  int result = -1;
  const size_t kept = c->physics.n_steps / KEPT_EVERY * 3 * (size_t)c->body->n_masses;
  float *activation = malloc((size_t)c->physics.n_steps * c->body->n_springs * sizeof(float));
  double *memory = calloc(2 * kept + c->controller->n_parameters, sizeof(double));
  if (activation == NULL || memory == NULL || !open_loop(c, activation))
    goto done;
  struct walk reference = {c, memory}, fast = {c, memory + kept};
  const struct mo_gradient_options options = {.adjoint_bound = bound, .weight = 1};
  const struct mo_gradient_probe probe = {.before = keep, .context = &reference};
  struct mo_outcome outcome;
  struct mo_gradient_counts counts = {0};
  struct physics_life life = {
      .activation = activation, .bound = bound, .adjoint = keep, .context = &fast};
  const struct physics_scene scene = {c->body, &c->environment, &c->physics, c->controller->sensor};
  if (mo_gradient_probed(c->body, c->controller, &c->environment, &c->physics, &options, &probe,
                         &outcome, memory + 2 * kept, &counts) < 0 ||
      !f->live(&scene, &life))
    goto done;
  double dot = 0, a = 0, b = 0;
  for (size_t i = 0; i < kept; i++) {
    dot += reference.kept[i] * fast.kept[i];
    a += reference.kept[i] * reference.kept[i];
    b += fast.kept[i] * fast.kept[i];
  }
  sums[0] += dot;
  sums[1] += a;
  sums[2] += b;
  printf(
      "#   %u masses: cosine %.6f, size %.4f, losses %.6f %.6f, largest %.3g %.3g, clipped %u %u\n",
      c->body->n_masses, dot / sqrt(a * b), sqrt(b / a), outcome.loss, life.outcome.loss,
      counts.largest, life.largest, (unsigned)counts.clipped_steps, life.clipped);
  result = life.finite ? 0 : 1;
done:
  free(activation);
  free(memory);
  return result;
}

/* Most rollouts agree closely; one that came by a kink on the other side does not. */
static void rollouts(uint32_t n_steps, uint32_t least_close, double least_cosine)
{
  const enum mo_isa isa = mo_isa_best();
  double sums[3] = {0, 0, 0};
  uint32_t close = 0;
  for (uint32_t k = 0; k < GRADIENT_CASES; k++) {
    struct gradient_case c;
    double own[3] = {0, 0, 0};
    REQUIRE(gradient_case_create(k, &c) == 0);
    c.physics.n_steps = n_steps;
    CHECK_INT(whole_rollout(&c, MO_ADJOINT_BOUND, functions[isa], own), 0);
    close += own[0] >= 0.9999 * sqrt(own[1] * own[2]);
    for (int i = 0; i < 3; i++)
      sums[i] += own[i];
    gradient_case_free(&c);
  }
  const double cosine = sums[0] / sqrt(sums[1] * sums[2]);
  printf("# %s, %u steps: cosine of all %.6f; %u of %d are above 0.9999\n", mo_isa_name(isa),
         n_steps, cosine, close, GRADIENT_CASES);
  CHECK(close >= least_close);
  CHECK(cosine >= least_cosine);
}

static void rollouts_100(void)
{
  rollouts(100, 20, 0.99999);
}

static void rollouts_1000(void)
{
  rollouts(1000, 17, 0.97);
}

/* ---- times ---- */

static void times(void)
{
  enum { BODIES = 64 };
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  struct mo_lattice *lattice = NULL;
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 100;
  REQUIRE(mo_lattice_create(workspace, &lattice) == 0);
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct mo_body_stream *stream = NULL;
    double sum[5] = {0}, masses = 0, springs = 0, counts[4] = {0};
    REQUIRE(mo_body_stream_create(workspace, 1, &stream) == 0);
    for (int k = 0; k < BODIES; k++) {
      uint64_t bits[MO_DEFAULT_WORDS];
      struct mo_body *body = NULL;
      struct mo_environment environment;
      do { /* small bodies soon run out: a long stream has few */
        REQUIRE(mo_body_stream_next(stream, bits) == 0);
      } while (mo_genotype_count(workspace, bits) < 10);
      REQUIRE(mo_body_create(lattice, bits, &body) == 0);
      mo_environment_training(1, 0, (uint64_t)k, &environment);
      float *activation = malloc((size_t)physics.n_steps * body->n_springs * sizeof(float));
      REQUIRE(activation != NULL);
      for (uint32_t i = 0; i < physics.n_steps; i++)
        for (uint32_t s = 0; s < body->n_springs; s++)
          activation[(size_t)i * body->n_springs + s] = (float)sin(0.04 * i + s);
      const struct physics_scene scene = {body, &environment, &physics, MO_SENSOR_INVERSE_SQRT};
      struct physics_times t;
      uint32_t n[4];
      REQUIRE(functions[isa]->time(&scene, activation, &t, n));
      const double each[5] = {t.sense, t.step, t.clip, t.step_back, t.sense_back};
      for (int i = 0; i < 5; i++)
        sum[i] += each[i] / BODIES;
      for (int i = 0; i < 4; i++)
        counts[i] += (double)n[i] / BODIES;
      masses += (double)body->n_masses / BODIES;
      springs += (double)body->n_springs / BODIES;
      free(activation);
      mo_body_free(body);
    }
    printf("# %s: %.0f masses, %.0f springs in %.1f vectors, %.1f tiles, %.1f arrivals; a record "
           "has %.0f bytes\n",
           mo_isa_name((enum mo_isa)isa), masses, springs, counts[0], counts[1], counts[2],
           4 * counts[3]);
    printf(
        "#   ticks per step: sense %.0f, step %.0f; clip %.0f, step back %.0f, sense back %.0f\n",
        sum[0], sum[1], sum[2], sum[3], sum[4]);
    mo_body_stream_free(stream);
  }
  mo_lattice_free(lattice);
}

static const struct check_case cases[] = {{"rollouts of 100 steps", rollouts_100},
                                          {"rollouts of 1000 steps", rollouts_1000},
                                          {"times", times}};
CHECK_MAIN(cases)
