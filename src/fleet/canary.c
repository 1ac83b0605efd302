/* canary.c: rollouts and gradients that never change. Every machine of a class must compute the
 * same bits for them. A machine that computes different bits is refused before it computes any
 * results.
 *
 * Half of the bodies use the usual physics. The others fall from a height onto slippery ground, so
 * that masses leave their terrain cells: the reference, not the kernels, computes these moves. Some
 * hold the controller's outputs through control periods, and some use the integrator `split`. The
 * robots of the gradients stand on the ground, so that few steps have contacts. They fill one CPU
 * block and part of another. Environments have an objective of each kind, and some a terrain
 * profile or damage. The hash includes all measures of the rollouts. */
#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/words.h"
#include "fleet/fleet.h"
#include "world/task_json.h"

#define SEED   UINT64_C(0x6d6f72706866)
#define BODIES 8
#define ROBOTS (MO_GRADIENT_ROBOTS + 8)
#define STEPS  50 /* for the gradients */
#define KINDS  4  /* of gradients */

#define NO_GRADIENT 6 /* the lane with a sum that has no gradient */

struct canary {
  struct mo_lattice *lattice;
  struct mo_controller *controller;
  struct mo_compute_controller *prepared;
  uint64_t genotypes[BODIES][MO_DEFAULT_WORDS];
  struct mo_environment environments[BODIES][MO_BLOCK_LANES];
  struct mo_block blocks[BODIES];
  double measures[BODIES][MO_BLOCK_LANES][MO_MEASURES];
  struct mo_measuring measuring[BODIES];
  struct mo_body *bodies[ROBOTS];
  struct mo_robot robots[ROBOTS];
  struct mo_outcome outcomes[ROBOTS];
};

static struct mo_physics physics_of(uint32_t body)
{
  struct mo_physics physics = mo_paper_physics();
  if (body < BODIES / 2)
    return physics;
  physics.scheme.n_steps = 500;
  physics.constants.gravity_m_per_s2 = 30;
  physics.constants.drag_per_s = 1;
  physics.constants.friction = 0.1;
  physics.drop_height_m = 1;
  physics.scheme.impact = body % 2 == 0 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
  physics.scheme.control_period_s = body % 2 == 0 ? 0 : 4 * physics.scheme.dt_s;
  physics.scheme.integrator = body < BODIES - 2 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
  return physics;
}

/* Gives an environment an objective that needs a tally. In each body, each of these objectives has
 * one lane, and sums have two. */
static void set_objective(uint32_t lane, struct mo_task *task)
{
  if (lane == 2)
    *task = (struct mo_task){.objective = MO_OBJECTIVE_SUM,
                             .n_terms = 4,
                             .terms = {MO_OBJECTIVE_EFFICIENT, MO_OBJECTIVE_JUMP,
                                       MO_TERM_MEASURE + MO_MEASURE_PATH_LENGTH,
                                       MO_TERM_MEASURE + MO_MEASURE_WORK},
                             .weights = {1, 0.5, 0.1, -1e-5}};
  if (lane == NO_GRADIENT)
    *task = (struct mo_task){.objective = MO_OBJECTIVE_SUM,
                             .n_terms = 3,
                             .terms = {MO_OBJECTIVE_REACH, MO_TERM_MEASURE + MO_MEASURE_TILT,
                                       MO_TERM_MEASURE + MO_MEASURE_PEAK_STRAIN},
                             .weights = {1, -0.1, -1}};
  if (lane == 4 || lane == 8)
    task->objective = lane == 4 ? MO_OBJECTIVE_EFFICIENT : MO_OBJECTIVE_JUMP;
}

/* Gives an environment a task. In each body, the last lanes have each kind of guide once. Every
 * fourth lane has a profile, every fourth has damage, every fifth has factors, and every third has
 * a drop. */
static void set_task(uint32_t lane, struct mo_environment *environment)
{
  static const char *const words[] = {"photo-auc", "walk", "circle", "path", "pursue", "climb"};
  const uint32_t first = MO_BLOCK_LANES - (uint32_t)(sizeof(words) / sizeof(*words));
  if (lane >= first)
    mo_task_named(mo_word_index(mo_task_words, words[lane - first]), environment);
  if (lane % 4 == 1) { /* the grid's heights as a profile */
    environment->n_profile = MO_TERRAIN_HEIGHTS;
    environment->profile_spacing_m = 0.1;
  }
  if (lane % 4 == 3)
    environment->damage = (struct mo_damage){1 + lane % MO_OCTANTS, 0.1};
  if (lane % 5 == 2)
    environment->factors = (struct mo_factors){1, 0.8, 1.25, 1.5, 0.9, 1.1, 0.5};
  if (lane % 3 == 1)
    environment->drop_m = 0.05;
  set_objective(lane, &environment->task);
}

/* Turns a grid of 8 × 8 heights into one of 16 × 4. */
static int set_grid(struct mo_environment *environment)
{
  const int error = mo_terrain_grid_create(16, MO_TERRAIN_HEIGHTS / 16, 0.15,
                                           environment->terrain_heights_m, &environment->grid);
  memset(environment->terrain_heights_m, 0, sizeof(environment->terrain_heights_m));
  return error;
}

static int prepare(struct canary *canary, struct mo_compute *compute, enum mo_back_end back_end)
{
  int error = mo_lattice_create(MO_DEFAULT_WORKSPACE, &canary->lattice);
  if (error == MO_OK)
    error = mo_controller_create(canary->lattice->workspace, MO_SENSOR_INVERSE_SQRT,
                                 &canary->controller);
  if (error == MO_OK) {
    mo_controller_randomize(canary->controller, SEED);
    error = mo_compute_controller_create(compute, canary->controller, &canary->prepared);
  }
  for (uint32_t b = 0; b < BODIES && error == MO_OK; b++) {
    struct mo_random random;
    struct mo_block *block = &canary->blocks[b];
    mo_random_init(&random, SEED, MO_PURPOSE_CHECK, 0, b);
    error = mo_genotype_random(canary->lattice->workspace, &random, canary->genotypes[b]);
    *block = (struct mo_block){.lattice = canary->lattice,
                               .genotype = canary->genotypes[b],
                               .controller = canary->prepared,
                               .n_environments = MO_BLOCK_LANES,
                               .physics = physics_of(b),
                               .precision = MO_FLOAT32,
                               .urgency = MO_INTERACTIVE, /* not given to remote takers */
                               .back_end = back_end};
    canary->measuring[b] = (struct mo_measuring){MO_MEASURES_ALL, canary->measures[b]};
    block->measuring = &canary->measuring[b];
    for (uint32_t e = 0; e < MO_BLOCK_LANES && error == MO_OK; e++) {
      mo_environment_training(SEED, b, e, &canary->environments[b][e]);
      set_task(e, &canary->environments[b][e]);
      if (e % 4 == 2 && back_end == MO_ON_CPU) /* devices do not compute custom grids */
        error = set_grid(&canary->environments[b][e]);
      block->environments[e] = &canary->environments[b][e];
    }
  }
  return error;
}

/* ---- the gradient ---- */

/* The robots use all lanes, and therefore all objectives. */
static uint32_t lane_of(uint32_t robot)
{
  const uint32_t lane = (robot + robot / BODIES) % MO_BLOCK_LANES;
  return lane == NO_GRADIENT ? 2 : lane;
}

static int make_robots(struct canary *canary)
{
  int error = MO_OK;
  for (uint32_t i = 0; i < ROBOTS && error == MO_OK; i++) {
    error = mo_body_create(canary->lattice, canary->genotypes[i % BODIES], &canary->bodies[i]);
    canary->robots[i].body = canary->bodies[i];
    canary->robots[i].environment = &canary->environments[i % BODIES][lane_of(i)];
  }
  return error;
}

static int differentiate(struct canary *canary, struct mo_compute *compute,
                         enum mo_back_end back_end, struct mo_sha256 *hash)
{
  struct mo_gradient_state *state = NULL;
  struct mo_gradient_batch batch = {.controller = canary->controller,
                                    .robots = canary->robots,
                                    .n = ROBOTS,
                                    .physics = mo_paper_physics(),
                                    .options.adjoint_bound = 10,
                                    .tag = -1,
                                    .urgency = MO_INTERACTIVE,
                                    .back_end = back_end,
                                    .outcomes = canary->outcomes};
  const size_t n = canary->controller->n_parameters;
  struct {
    struct mo_sha256 sum;
    double losses[ROBOTS];
  } bits[KINDS] = {{.losses = {0}}};
  batch.physics.scheme.n_steps = STEPS;
  batch.physics.drop_height_m = 0;
  batch.d_parameters = calloc(n, sizeof(*batch.d_parameters));
  int error = batch.d_parameters != NULL ? make_robots(canary) : MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = mo_gradient_state_create(compute, &state);
  /* A device has separate kernels for periods of several steps. */
  for (uint32_t p = 0; p < KINDS && error == MO_OK; p++) {
    batch.physics.scheme.control_period_s = (p % 2 == 0 ? 0 : 3) * batch.physics.scheme.dt_s;
    batch.physics.scheme.integrator = p < 2 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
    memset(batch.d_parameters, 0, n * sizeof(*batch.d_parameters));
    error = mo_compute_gradient(state, &batch);
    if (error != MO_OK)
      break;
    mo_sha256_of(batch.d_parameters, n * sizeof(*batch.d_parameters), &bits[p].sum);
    for (uint32_t i = 0; i < ROBOTS; i++)
      bits[p].losses[i] = canary->outcomes[i].loss;
  }
  if (error == MO_OK)
    mo_sha256_of(bits, sizeof(bits), hash);
  mo_gradient_state_free(state);
  for (uint32_t i = 0; i < ROBOTS; i++)
    mo_body_free(canary->bodies[i]);
  free(batch.d_parameters);
  mo_compute_trim(compute); /* a worker may never compute a gradient again */
  return error;
}

/* ---- both ---- */

/* The canary's version is part of the protocol (MO_FLEET_PROTOCOL): increment it with each change,
 * so that workers with a different canary are refused because of their version, not because of
 * wrong bits. */
static void read_bits(struct canary *canary, struct mo_sha256 *hash)
{
  struct mo_sha256 parts[2];
  struct {
    double loss;
    uint64_t diverged;
  } rows[BODIES][MO_BLOCK_LANES];
  for (uint32_t b = 0; b < BODIES; b++)
    for (uint32_t e = 0; e < MO_BLOCK_LANES; e++) {
      double *measures = canary->measures[b][e];
      rows[b][e].loss = canary->blocks[b].outcomes[e].loss;
      rows[b][e].diverged = (uint64_t)canary->blocks[b].outcomes[e].diverged_step;
      for (unsigned m = 0; m < MO_MEASURES; m++)
        measures[m] = isnan(measures[m]) ? -DBL_MAX : measures[m]; /* NaN has many bit patterns */
    }
  mo_sha256_of(rows, sizeof(rows), &parts[0]);
  mo_sha256_of(canary->measures, sizeof(canary->measures), &parts[1]);
  mo_sha256_of(parts, sizeof(parts), hash);
}

int mo_fleet_canary(struct mo_compute *compute, enum mo_back_end back_end, struct mo_sha256 *hash)
{
  struct canary *canary = calloc(1, sizeof(*canary));
  if (canary == NULL)
    return MO_ERR_NO_MEMORY;
  struct mo_sha256 parts[2];
  int error = prepare(canary, compute, back_end);
  if (error == MO_OK)
    error = mo_compute_run(compute, canary->blocks, BODIES);
  if (error == MO_OK)
    error = differentiate(canary, compute, back_end, &parts[1]);
  if (error == MO_OK) {
    read_bits(canary, &parts[0]);
    mo_sha256_of(parts, sizeof(parts), hash);
  }
  mo_compute_controller_free(canary->prepared);
  mo_controller_free(canary->controller);
  mo_lattice_free(canary->lattice);
  mo_environments_drop(canary->environments[0], (size_t)BODIES * MO_BLOCK_LANES);
  free(canary);
  return error;
}
