/* cuda-gradient-tasks.c: checks gradients of robots with guides and objectives, profiles and
 * damage. */
#include "../tests/unit/rollout/objective-cases.h"
#include "../tests/unit/rollout/task-cases.h"
#include "cuda-gradient.h"

#include "device.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define CONTROLLER "data/controllers/phototaxis.safetensors"

/* Kinds of robots: with each task; without one: plain, with a profile, with damage; and with tasks
 * that have a tally: efficient, jump, weighted sums. */
enum { PLAIN = TASK_CASES, PROFILE, DAMAGE, TALLIES, KINDS = TALLIES + SMOOTH_CASES };

/* Robots of each kind that are compared one by one, and how close the median must be. Where float16
 * takes another branch of contact than float64, a robot's gradient differs. */
enum { EACH = 6, SINGLE = EACH * KINDS };
#define MEDIAN_ERROR 0.1
#define MEDIAN_NORM  0.05 /* relative, of the norm */
#define LOSS_ERROR   5e-3 /* relative, of the median */
#define NO_GRADIENT  1e-5 /* of a norm */
#define TALLY_SLACK                                                                                \
  3 /* times these for tasks with a tally: restarts are more frequent, and the                     \
       ground of `efficient` is steep */

/* Returns the task of robots of a kind; of those without one, it is plain. */
static struct mo_task task_of(uint32_t kind)
{
  struct mo_environment environment = {.n_profile = 1}; /* its ground is not needed */
  if (kind < TASK_CASES)
    return task_case(kind);
  if (kind >= TALLIES)
    set_objective(&environment, kind - TALLIES);
  return environment.task;
}

/* Random robots in training environments, each of the next of n_kinds kinds. Of those with a task,
 * a third have a profile, and a third have damage. */
static void make_guided_scene(struct scene *s, uint32_t n, uint32_t n_kinds)
{
  make_scene(s, n);
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t kind = i % n_kinds, turn = i / n_kinds;
    struct mo_environment *environment = &s->environments[i];
    const bool has_task = kind < TASK_CASES || kind >= TALLIES;
    environment->task = task_of(kind);
    if (environment->task.objective == MO_OBJECTIVE_EFFICIENT) {
      environment->factors = mo_factors_ones(); /* it slides, soon farther than the floor */
      environment->factors.gravity = 7;
      environment->factors.friction = 0.1;
    } else if (kind == PROFILE || (has_task && turn % 3 == 1)) {
      environment->n_profile = MO_TERRAIN_HEIGHTS; /* the grid's heights as a profile */
      environment->profile_spacing_m = 0.2;
    }
    if (kind >= TALLIES)
      set_objective(environment, kind - TALLIES); /* with ground that falls, on a grid */
    if (kind == DAMAGE || (has_task && turn % 3 == 2))
      environment->damage = (struct mo_damage){1 + (turn + kind) % MO_OCTANTS, 0.05 * (turn % 5)};
  }
}

static const char *name_of(uint32_t k)
{
  static char name[64];
  static const char *const others[] = {"plain", "profile", "damage"};
  if (k >= TASK_CASES && k < TALLIES)
    return others[k - TASK_CASES];
  const struct mo_task task = task_of(k);
  const bool is_sum = task.objective == MO_OBJECTIVE_SUM;
  snprintf(name, sizeof(name), "%s, %s%s", mo_guide_words[task.guide.kind], is_sum ? "sum of " : "",
           is_sum ? mo_term_name(task.terms[0]) : mo_objective_words[task.objective]);
  return name;
}

/* The float64 gradient of each robot by itself. */
struct singles {
  const struct scene *scene;
  const struct mo_controller *controller;
  struct mo_physics physics;
  struct mo_gradient_options options;
  uint32_t robots[SINGLE];
  double *gradients[SINGLE];
  struct mo_outcome outcomes[SINGLE];
  uint32_t next;
};

static void *compute_singles(void *context)
{
  struct singles *s = context;
  for (;;) {
    const uint32_t i = __atomic_fetch_add(&s->next, 1, __ATOMIC_RELAXED);
    if (i >= SINGLE)
      return NULL;
    const struct mo_robot *robot = s->scene->robots + s->robots[i];
    s->gradients[i] = must_have(calloc(s->controller->n_parameters, sizeof(double)));
    must(mo_gradient_reference(robot->body, s->controller, robot->environment, &s->physics,
                               &s->options, &s->outcomes[i], s->gradients[i], NULL),
         "reference");
  }
}

/* Short rollouts of every kind, robot by robot: the gradient, the loss and the value. In the
 * longest ones, several heights of a jump count. */
static void check_singles(const struct scene *scene)
{
  static const struct {
    uint32_t n_steps, control_steps;
    enum mo_integrator integrator;
    double bound, restart_weight; /* 0: no bound; clipped */
    double looser;                /* times the bounds of errors */
  } kinds[] = {{60, 4, MO_INTEGRATOR_PAPER, 0, 0, 1},   {60, 0, MO_INTEGRATOR_PAPER, 0, 0, 1},
               {60, 7, MO_INTEGRATOR_SPLIT, 0, 0, 2},   {60, 100, MO_INTEGRATOR_SPLIT, 0, 0, 2},
               {60, 4, MO_INTEGRATOR_PAPER, 0.1, 0, 1}, {60, 4, MO_INTEGRATOR_PAPER, 0.1, 2, 1},
               {60, 7, MO_INTEGRATOR_SPLIT, 0.1, 2, 1}, {120, 4, MO_INTEGRATOR_PAPER, 0, 0, 4}};
  struct mo_controller *controller = weights_of(CONTROLLER);
  for (size_t kind = 0; kind < sizeof(kinds) / sizeof(kinds[0]); kind++) {
    static struct singles s;
    s = (struct singles){.scene = scene,
                         .controller = controller,
                         .physics = physics_of(kinds[kind].n_steps, kinds[kind].control_steps),
                         .options = {.weight = 1,
                                     .adjoint_bound = kinds[kind].bound,
                                     .adjoint_rule = kinds[kind].restart_weight > 0
                                                         ? MO_ADJOINT_RESTART
                                                         : MO_ADJOINT_CLIP,
                                     .restart_weight = kinds[kind].restart_weight}};
    s.physics.scheme.integrator = kinds[kind].integrator;
    for (uint32_t i = 0; i < SINGLE; i++)
      s.robots[i] = i;
    on_threads(sysconf(_SC_NPROCESSORS_ONLN), compute_singles, &s);
    double worst = 0, worst_cosine = 1, worst_norm = 0, worst_loss = 0, worst_value = 0;
    uint32_t worst_task = 0;
    int close = 1;
    for (uint32_t k = 0; k < KINDS; k++) {
      double error[EACH], cosine[EACH], norm[EACH], loss[EACH], value[EACH];
      for (uint32_t e = 0; e < EACH; e++) {
        const uint32_t i = e * KINDS + k;
        struct result r;
        run_with(&r, controller, scene, s.robots[i], 1, &s.physics, &s.options, 0);
        const struct likeness like =
            likeness_of(r.call.d_parameters, s.gradients[i], controller->n_parameters);
        error[e] = like.error;
        cosine[e] = like.cosine;
        norm[e] = fabs(like.norm / like.norm_reference - 1);
        loss[e] = fabs(r.call.outcomes[0].loss / s.outcomes[i].loss - 1);
        value[e] = fabs(r.call.outcomes[0].value - s.outcomes[i].value) /
                   fmax(1, fabs(s.outcomes[i].value));
        /* 0 within the floor of `efficient`; rounding where a path of one period is straight. */
        if (like.norm_reference < NO_GRADIENT) {
          error[e] = like.norm < NO_GRADIENT ? 0 : INFINITY;
          cosine[e] = 1;
          norm[e] = 0;
        }
        error[e] = isnan(error[e]) ? INFINITY : error[e];
        drop_result(&r);
        free(s.gradients[i]);
      }
      const double median = quantile(error, EACH, 0.5);
      printf(
          "  %-18s relative error of a robot: median %.3g, most %.3g; medians: cosine %.6f, norm "
          "%.1e, loss %.1e, value %.1e\n",
          name_of(k), median, error[EACH - 1], quantile(cosine, EACH, 0.5),
          quantile(norm, EACH, 0.5), quantile(loss, EACH, 0.5), quantile(value, EACH, 0.5));
      const double slack = kinds[kind].looser * (k < TALLIES ? 1 : TALLY_SLACK),
                   of_norm = norm[EACH / 2 - 1], of_loss = loss[EACH / 2 - 1],
                   of_value = value[EACH / 2 - 1];
      close &= median <= MEDIAN_ERROR * slack && of_norm <= MEDIAN_NORM * slack &&
               of_loss <= LOSS_ERROR * slack && of_value <= LOSS_ERROR * slack;
      worst_cosine = fmin(worst_cosine, cosine[EACH / 2]);
      worst_norm = fmax(worst_norm, of_norm);
      worst_loss = fmax(worst_loss, of_loss);
      worst_value = fmax(worst_value, of_value);
      if (median > worst) {
        worst = median;
        worst_task = k;
      }
    }
    expect(close,
           "every kind, %s, %u steps, periods of %u, bound %g, restart weight %g: the largest "
           "median error %.3g (%s), the smallest cosine %.6f, of a norm %.1e, of a loss %.1e, of a "
           "value %.1e",
           mo_integrator_words[kinds[kind].integrator], kinds[kind].n_steps,
           kinds[kind].control_steps, kinds[kind].bound, kinds[kind].restart_weight, worst,
           name_of(worst_task), worst_cosine, worst_norm, worst_loss, worst_value);
  }
  mo_controller_free(controller);
}

/* Batches with tasks as whole groups, with some of them in halves, and all in halves; and the
 * outcomes of single robots, which do not depend on the batch. */
static void check_same_bits(const struct scene *scene)
{
  static const struct {
    const char *name;
    uint32_t n, control_steps;
    enum mo_integrator integrator;
    double stiffness, bound, restart_weight;
  } cases[] = {{"periods of 4", 300, 4, MO_INTEGRATOR_PAPER, 1, 2, 0},
               {"every step, empty rows", 50, 0, MO_INTEGRATOR_PAPER, 1, 2, 0},
               {"split, restarts, periods of 7", 256, 7, MO_INTEGRATOR_SPLIT, 1, 2, 3},
               {"springs 1.7 times as stiff", 200, 4, MO_INTEGRATOR_PAPER, 1.7, 2, 0}};
  struct mo_controller *controller = weights_of(CONTROLLER);
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
    struct mo_physics physics = physics_of(300, cases[i].control_steps);
    struct mo_gradient_options options = mo_default_gradient_options();
    struct result ways[3];
    uint32_t halved[3];
    int same = 1;
    physics.scheme.integrator = cases[i].integrator;
    physics.constants.stiffness_n_per_m *= cases[i].stiffness;
    options.adjoint_bound = cases[i].bound;
    if (cases[i].restart_weight > 0) {
      options.adjoint_rule = MO_ADJOINT_RESTART;
      options.restart_weight = cases[i].restart_weight;
    }
    for (int way = 0; way < 3; way++) {
      mo_cuda_gradient_set_halves(device, (enum mo_cuda_halves)(MO_CUDA_HALVES_NEVER + way));
      run_with(&ways[way], controller, scene, 0, cases[i].n, &physics, &options, 0);
      halved[way] = mo_cuda_gradient_times(device)->halved;
    }
    mo_cuda_gradient_set_halves(device, MO_CUDA_HALVES_IF_FASTER);
    expect(halved[0] == 0 && halved[1] > 0 && halved[2] >= halved[1] &&
               same_result(&ways[0], &ways[1]) && same_result(&ways[0], &ways[2]),
           "tasks, %s: whole groups, %u and %u groups in halves have the same bits", cases[i].name,
           halved[1], halved[2]);
    for (uint32_t k = 0; k < cases[i].n; k += 23) {
      struct result r;
      run_with(&r, controller, scene, k, 1, &physics, &options, 0);
      same &= memcmp(r.call.outcomes, &ways[0].call.outcomes[k], sizeof(*r.call.outcomes)) == 0;
      drop_result(&r);
    }
    expect(same, "tasks, %s: robots by themselves have the same outcomes", cases[i].name);
    print_counts(cases[i].name, &ways[0].call.counts);
    for (int way = 0; way < 3; way++)
      drop_result(&ways[way]);
  }
  mo_controller_free(controller);
}

/* Plain robots have the same outcomes in a batch with tasks as in one without. */
static void check_beside(const struct scene *scene)
{
  enum { N = 8 * KINDS };
  struct scene plain;
  struct mo_controller *controller = weights_of(CONTROLLER);
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_physics physics = physics_of(300, 4);
  int same = 1;
  make_scene(&plain, N);
  for (int integrator = MO_INTEGRATOR_PAPER; integrator <= MO_INTEGRATOR_SPLIT; integrator++) {
    struct result mixed, alone;
    physics.scheme.integrator = (enum mo_integrator)integrator;
    run_with(&mixed, controller, scene, 0, N, &physics, &options, 0);
    run_with(&alone, controller, &plain, 0, N, &physics, &options, 0);
    for (uint32_t i = PLAIN; i < N; i += KINDS)
      same &= memcmp(&mixed.call.outcomes[i], &alone.call.outcomes[i],
                     sizeof(*mixed.call.outcomes)) == 0;
    drop_result(&mixed);
    drop_result(&alone);
  }
  expect(same, "plain robots have the same outcomes with and without special ones beside them");
  drop_scene(&plain);
  mo_controller_free(controller);
}

void check_tasks(void)
{
  struct scene scene;
  make_guided_scene(&scene, 300, KINDS);
  check_singles(&scene);
  check_same_bits(&scene);
  check_beside(&scene);
  drop_scene(&scene);
}

void short_tasks(uint32_t n, uint32_t n_steps)
{
  struct scene scene;
  struct mo_controller *controller = weights_of("1");
  const struct mo_gradient_options options = mo_default_gradient_options();
  make_guided_scene(&scene, n, KINDS);
  for (int halves = MO_CUDA_HALVES_NEVER; halves <= MO_CUDA_HALVES_ALWAYS; halves += 2)
    for (int integrator = MO_INTEGRATOR_PAPER; integrator <= MO_INTEGRATOR_SPLIT; integrator++) {
      struct result r;
      struct mo_physics physics = physics_of(n_steps, 2);
      physics.scheme.integrator = (enum mo_integrator)integrator;
      mo_cuda_gradient_set_halves(device, (enum mo_cuda_halves)halves);
      run_with(&r, controller, &scene, 0, n, &physics, &options, 0);
      drop_result(&r);
    }
  mo_cuda_gradient_set_halves(device, MO_CUDA_HALVES_IF_FASTER);
  mo_controller_free(controller);
  drop_scene(&scene);
}

void time_tasks(uint32_t n, const struct mo_physics *physics)
{
  struct scene scene;
  make_guided_scene(&scene, n, KINDS);
  printf("with tasks, also efficient, jump and sums, profiles and damage: ");
  time_steps(&scene, n, physics, MO_CUDA_HALVES_IF_FASTER, 0);
  drop_scene(&scene);
  make_guided_scene(&scene, n, TALLIES);
  printf("with tasks, profiles and damage: ");
  time_steps(&scene, n, physics, MO_CUDA_HALVES_IF_FASTER, 0);
  for (uint32_t i = 0; i < n; i++) {
    scene.environments[i].n_profile = 0;
    scene.environments[i].profile_spacing_m = 0;
    scene.environments[i].damage = (struct mo_damage){0};
  }
  printf("with tasks: ");
  time_steps(&scene, n, physics, MO_CUDA_HALVES_IF_FASTER, 0);
  drop_scene(&scene);
}
