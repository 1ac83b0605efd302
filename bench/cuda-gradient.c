/* cuda-gradient.c: compares the device's gradient with float64, and measures its time. Needs a
 * device to run; built with the module (src/compute/cuda/meson.build).
 *
 * cuda-gradient reference FILE WEIGHTS [WORKERS]
 *     writes the float64 gradient of 256 robots, computed on the processor, into FILE
 * cuda-gradient check [WEIGHTS FILE]…
 *     compares with these files, and with float64 where outputs are held through control periods
 *     and with the integrator split; guides and objectives; the bits of two runs, of one shard, of
 *     little memory and of groups in halves; robots that diverge or whose adjoints do; cancelled
 *     calls
 * cuda-gradient like [paper | split ROBOTS STEPS PERIOD]…
 *     prints how close the gradient is to float64, with control periods of PERIOD steps
 * cuda-gradient alone [WORKERS]
 *     robots whose adjoints restart, one by one, against float64 with the same weight and with
 *     another
 * cuda-gradient time [ROBOTS]…
 *     learning steps of this many robots (default 1024 and 8192), with whole groups, with some in
 *     halves, and with all in halves; by default also of 8192 with control periods
 * cuda-gradient short [ROBOTS STEPS]
 *     a few steps of everything, in the same three ways, for compute-sanitizer and profilers
 *
 * WEIGHTS is the seed of random weights, or a controller's file. With "restart:" before it adjoints
 * restart above the bound with the usual weight ("restart=2:": with 2). Robots are distinct random
 * bodies, each in a training environment; 1000 steps, bound 2. Prints one line per measurement;
 * exit status 1 if a bound is missed, 77 without a device. */
#include "cuda-gradient.h"

#include "device.h"

#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { MOST = 8192, REPEATS = 5 };
#define COSINE_BOUND 0.99
#define NORM_BOUND   0.1 /* relative */
#define STEP_BOUND_S 0.25

static const char *error_of_device(void)
{
  return device != NULL ? mo_device_module()->error(device) : "no device";
}

/* ---- against the reference ---- */

static int make_reference(const char *path, const char *weights, uint32_t workers)
{
  static struct reference r;
  struct mo_controller *controller = weights_of(weights);
  struct scene scene;
  make_scene(&scene, LIKE);
  r = (struct reference){.scene = &scene,
                         .n = LIKE,
                         .controller = controller,
                         .physics = mo_paper_physics(),
                         .options = options_of(weights)};
  compute_reference(&r, (long)workers);
  FILE *file = fopen(path, "wb");
  int written =
      file != NULL && fwrite(&r.counts[0], sizeof(r.counts[0]), 1, file) == 1 &&
      fwrite(r.outcomes, sizeof(r.outcomes), 1, file) == 1 &&
      fwrite(r.sums[0], sizeof(double), controller->n_parameters, file) == controller->n_parameters;
  written = file != NULL && fclose(file) == 0 && written;
  drop_reference(&r);
  drop_scene(&scene);
  mo_controller_free(controller);
  return written ? 0 : 1;
}

static void check_likeness(const char *weights, const char *path, const struct scene *s)
{
  static struct mo_outcome outcomes[LIKE];
  struct mo_controller *controller = weights_of(weights);
  double *reference = must_have(malloc(controller->n_parameters * sizeof(double))), differ[LIKE];
  struct mo_gradient_counts counts;
  FILE *file = fopen(path, "rb");
  const int read =
      file != NULL && fread(&counts, sizeof(counts), 1, file) == 1 &&
      fread(outcomes, sizeof(outcomes), 1, file) == 1 &&
      fread(reference, sizeof(double), controller->n_parameters, file) == controller->n_parameters;
  must(read ? MO_OK : MO_ERR_FORMAT, path);
  fclose(file);
  struct result r;
  const struct mo_physics physics = mo_paper_physics();
  const struct mo_gradient_options options = options_of(weights);
  run_with(&r, controller, s, 0, LIKE, &physics, &options, 0);
  for (int i = 0; i < LIKE; i++)
    differ[i] = fabs(r.call.outcomes[i].loss - outcomes[i].loss);
  const struct likeness like =
      likeness_of(r.call.d_parameters, reference, controller->n_parameters);
  printf("weights %s: cosine %.6f, relative error %.3g, norms %.6g and %.6g; |difference in loss| "
         "median %.1e, p90 %.1e, most %.1e\n",
         weights, like.cosine, like.error, like.norm, like.norm_reference,
         quantile(differ, LIKE, 0.5), quantile(differ, LIKE, 0.9), differ[LIKE - 1]);
  print_counts("device", &r.call.counts);
  print_counts("float64", &counts);
  char *end;
  (void)strtoull(after_rule(weights), &end, 10);
  /* With a trained controller, 1000 steps are chaotic for some robots. A restart is a jump, and
   * with different rounding it happens at a different step. With a large weight, these few robots
   * dominate the batch (docs/numerics.md). check_alone compares them one by one. */
  if (*end == 0 && (options.adjoint_rule == MO_ADJOINT_CLIP || options.restart_weight <= 1))
    expect(like.cosine >= COSINE_BOUND, "cosine for random weights at least 0.99");
  drop_result(&r);
  free(reference);
  mo_controller_free(controller);
}

/* A comparison of the first n robots with the reference. */
struct period_case {
  const char *weights;
  uint32_t n, n_steps, control_steps;
  enum mo_integrator integrator;
};

static struct likeness check_period(const struct scene *s, const struct period_case *c,
                                    double cosine, double norm)
{
  static struct reference r;
  struct mo_controller *controller = weights_of(c->weights);
  struct result own;
  r = (struct reference){.scene = s,
                         .n = c->n,
                         .controller = controller,
                         .physics = physics_of(c->n_steps, c->control_steps),
                         .options = options_of(c->weights)};
  r.physics.scheme.integrator = c->integrator;
  compute_reference(&r, sysconf(_SC_NPROCESSORS_ONLN));
  run_with(&own, controller, s, 0, c->n, &r.physics, &r.options, 0);
  const struct likeness like =
      likeness_of(own.call.d_parameters, r.sums[0], controller->n_parameters);
  double apart = 0;
  for (uint32_t i = 0; i < c->n; i++)
    for (int axis = 0; axis < 3; axis++)
      apart =
          fmax(apart, fabs(own.call.outcomes[i].com_end_m[axis] - r.outcomes[i].com_end_m[axis]));
  print_counts("device", &own.call.counts);
  print_counts("float64", &r.counts[0]);
  printf("  centers of mass end at most %.1e m apart\n", apart);
  expect(like.cosine >= cosine && fabs(like.norm / like.norm_reference - 1) <= norm,
         "weights %s, %s, %u steps, periods of %u: cosine %.6f, relative error %.3g, norms %.6g "
         "and %.6g",
         c->weights, c->integrator == MO_INTEGRATOR_SPLIT ? "split" : "paper", c->n_steps,
         c->control_steps, like.cosine, like.error, like.norm, like.norm_reference);
  drop_result(&own);
  drop_reference(&r);
  mo_controller_free(controller);
  return like;
}

/* Outputs held through control periods: a period that divides the rollout, periods that its end
 * cuts short, one longer than a task of 50 steps, and one longer than the rollout. */
static void check_periods(const struct scene *s)
{
  static const struct period_case cases[] = {{"1", LIKE, 1000, 4, MO_INTEGRATOR_PAPER},
                                             {"1", 64, 200, 3, MO_INTEGRATOR_PAPER},
                                             {"1", 64, 300, 64, MO_INTEGRATOR_PAPER},
                                             {"1", 64, 200, 150, MO_INTEGRATOR_PAPER},
                                             {"restart=1:1", 64, 200, 4, MO_INTEGRATOR_PAPER}};
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++)
    check_period(s, &cases[i], COSINE_BOUND, NORM_BOUND);
}

static int by_size(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

/* With `split`, contact branches (stick or slip, rest or strike). Where float16 takes another
 * branch than float64, the robot's gradient differs. Every batch has a few of these robots, and
 * they dominate its sum, so the robots are compared one by one. */
static void check_split(const struct scene *s)
{
  static const struct period_case cases[] = {{"1", 1, 25, 1, MO_INTEGRATOR_SPLIT},
                                             {"1", 1, 60, 4, MO_INTEGRATOR_SPLIT},
                                             {"1", 1, 120, 64, MO_INTEGRATOR_SPLIT},
                                             {"restart=1:1", 1, 50, 3, MO_INTEGRATOR_SPLIT}};
  static const struct period_case batch = {"1", 64, 10, 2, MO_INTEGRATOR_SPLIT};
  enum { ROBOTS = 64 };
  check_period(s, &batch, COSINE_BOUND, NORM_BOUND); /* too short for another branch */
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
    double apart[ROBOTS];
    for (uint32_t k = 0; k < ROBOTS; k++) {
      const struct scene alone = {s->lattice, 1, s->bodies + k, s->environments + k, s->robots + k};
      apart[k] = check_period(&alone, &cases[i], -1, INFINITY).error;
    }
    qsort(apart, ROBOTS, sizeof(*apart), by_size);
    expect(apart[ROBOTS / 2] <= 0.05 && apart[ROBOTS * 3 / 4] <= 0.2,
           "split, %u steps, periods of %u: relative error of a robot: median %.3g, 75 %% %.3g, "
           "90 %% %.3g",
           cases[i].n_steps, cases[i].control_steps, apart[ROBOTS / 2], apart[ROBOTS * 3 / 4],
           apart[ROBOTS * 9 / 10]);
  }
}

/* ---- single robots ---- */

/* Where adjoints restart, a few robots dominate the gradient of a batch, and float16 changes their
 * rollouts most. Therefore each of them is compared separately: the device's gradient with one
 * weight, against the float64 gradient with that weight and with another. */
struct alone {
  const struct scene *scene;
  const struct mo_controller *controller;
  double *gradients[LIKE][2]; /* with each weight; NULL if the adjoint stays within the bound */
  uint64_t clipped[LIKE];     /* steps */
  uint32_t next;
};

static const double alone_weights[2] = {MO_RESTART_WEIGHT, 1};

static void *alone_work(void *context)
{
  struct alone *a = context;
  const struct mo_physics physics = mo_paper_physics();
  for (;;) {
    const uint32_t i = __atomic_fetch_add(&a->next, 1, __ATOMIC_RELAXED);
    if (i >= LIKE)
      return NULL;
    for (int w = 0; w < 2; w++) {
      struct mo_gradient_options options = options_of("restart:");
      struct mo_gradient_counts counts = {0};
      struct mo_outcome outcome;
      options.restart_weight = alone_weights[w];
      a->gradients[i][w] = must_have(calloc(a->controller->n_parameters, sizeof(double)));
      must(mo_gradient_reference(a->scene->bodies[i], a->controller, &a->scene->environments[i],
                                 &physics, &options, &outcome, a->gradients[i][w], &counts),
           "reference");
      a->clipped[i] = counts.clipped_steps;
      if (counts.clipped_steps == 0) {
        free(a->gradients[i][w]);
        a->gradients[i][w] = NULL;
        break;
      }
    }
  }
}

static void check_alone(const struct scene *s, uint32_t workers)
{
  static struct alone a;
  struct mo_controller *controller = weights_of("1");
  const struct mo_physics physics = mo_paper_physics();
  const struct mo_gradient_options options = options_of("restart:");
  double differ[LIKE];
  uint32_t n = 0, nearer = 0;
  a.scene = s;
  a.controller = controller;
  on_threads((long)workers, alone_work, &a);
  for (uint32_t i = 0; i < LIKE; i++) {
    struct result r;
    struct likeness like[2];
    if (a.gradients[i][0] == NULL)
      continue;
    run_with(&r, controller, s, i, 1, &physics, &options, 0);
    for (int w = 0; w < 2; w++) {
      like[w] = likeness_of(r.call.d_parameters, a.gradients[i][w], controller->n_parameters);
      free(a.gradients[i][w]);
    }
    printf("  robot %u: restarts %llu times, in float64 %llu; cosine %.6f, error %.3g; against "
           "weight %g %.6f, %.3g\n",
           i, (unsigned long long)r.call.counts.clipped_steps, (unsigned long long)a.clipped[i],
           like[0].cosine, like[0].error, alone_weights[1], like[1].cosine, like[1].error);
    differ[n++] = like[0].error;
    nearer += like[0].error < like[1].error;
    drop_result(&r);
  }
  printf("%u robots restart: relative error of single robots, median %.3g, p90 %.3g; %u of them "
         "are closer to float64 with their weight than with another\n",
         n, n > 0 ? quantile(differ, n, 0.5) : 0, n > 0 ? quantile(differ, n, 0.9) : 0, nearer);
  expect(n > 0 && nearer * 4 >= n * 3, "at least three in four are closer to the right reference");
  mo_controller_free(controller);
}

/* ---- bits ---- */

int same_result(const struct result *a, const struct result *b)
{
  const size_t shards = (a->call.n + MO_DEVICE_SHARD - 1) / MO_DEVICE_SHARD;
  return memcmp(a->call.d_parameters, b->call.d_parameters,
                shards * a->call.controller->n_parameters * sizeof(float)) == 0 &&
         memcmp(a->call.outcomes, b->call.outcomes, a->call.n * sizeof(*a->call.outcomes)) == 0 &&
         memcmp(&a->call.counts, &b->call.counts, sizeof(a->call.counts)) == 0;
}

static void check_bits(const struct scene *s, uint32_t n_steps)
{
  const uint32_t n = MO_DEVICE_SHARD, all = 2 * n;
  struct mo_controller *controller = weights_of("1");
  struct result a, b;
  run_steps(&a, controller, s, 0, all, n_steps, 0);
  run_steps(&b, controller, s, 0, all, n_steps, 0);
  expect(same_result(&a, &b), "two runs produce the same bits");
  drop_result(&b);
  run_steps(&b, controller, s, n, n, n_steps, 0);
  const float *with = a.call.d_parameters + controller->n_parameters;
  int same = 1;
  for (size_t k = 0; k < controller->n_parameters; k++)
    same &= b.call.d_parameters[k] == 2 * with[k]; /* its weight is 1/1024, not 1/2048 */
  expect(same, "a shard has the same bits when computed separately");
  drop_result(&b);
  mo_cuda_gradient_trim(device);
  run_steps(&b, controller, s, 0, all, n_steps, UINT64_C(3) << 30);
  expect(mo_cuda_gradient_times(device)->passes == 2 && same_result(&a, &b),
         "with memory for one shard, one after the other, the same bits");
  drop_result(&b);
  drop_result(&a);
  mo_controller_free(controller);
}

/* A period of one step changes nothing; one that is not a whole number of steps is refused. */
static void check_short_periods(const struct scene *s)
{
  enum { FEW = 50, STEPS = 120 };
  struct mo_controller *controller = weights_of("1");
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_physics physics = physics_of(STEPS, 0), step = physics_of(STEPS, 1),
                    held = physics_of(STEPS, 7);
  struct result a, b;
  run_with(&a, controller, s, 0, FEW, &physics, &options, 0);
  run_with(&b, controller, s, 0, FEW, &step, &options, 0);
  expect(same_result(&a, &b), "a period of one step changes no bit");
  drop_result(&b);
  run_with(&b, controller, s, 0, FEW, &held, &options, 0);
  expect(!same_result(&a, &b), "one of seven steps does");
  struct mo_device_gradient call = b.call;
  call.physics.scheme.control_period_s *= 1.1;
  expect(mo_cuda_gradient_run(device, &call, 0) == MO_ERR_INVALID, "7.7 steps are refused");
  drop_result(&a);
  drop_result(&b);
  mo_controller_free(controller);
}

/* Groups computed by one block, by two, and some by each: where the last group has 16 robots, where
 * some of a group's 32 rows are empty, where adjoints restart, where some robots diverge, and where
 * some are left out; and the same where outputs are held. */
static void check_halves(const struct scene *s)
{
  const struct {
    const char *name;
    const char *options;
    uint32_t n;
    double stiffness, bound, last_layer; /* relative to the usual */
    uint32_t control_steps;
    enum mo_integrator integrator;
  } cases[] = {{"clipped", "", 300, 1, 1, 1, 0},
               {"empty rows", "", 50, 1, 1, 1, 0},
               {"restarts", "restart:", 256, 1, 1, 1, 0},
               {"springs 1.7 times as stiff", "", 200, 1.7, 1, 1, 0},
               {"no bound", "", 200, 1, 0, 81, 0},
               {"clipped, periods of 4", "", 300, 1, 1, 1, 4},
               {"empty rows, periods of 3", "", 50, 1, 1, 1, 3},
               {"restarts, periods of 4", "restart:", 256, 1, 1, 1, 4},
               {"springs 1.7 times as stiff, periods of 64", "", 200, 1.7, 1, 1, 64},
               {"no bound, periods of 4", "", 200, 1, 0, 81, 4},
               {"split, periods of 4", "", 300, 1, 1, 1, 4, MO_INTEGRATOR_SPLIT},
               {"split, empty rows", "", 50, 1, 1, 1, 0, MO_INTEGRATOR_SPLIT},
               {"split, restarts, periods of 4", "restart:", 256, 1, 1, 1, 4, MO_INTEGRATOR_SPLIT},
               {"split, springs 1.7 times as stiff", "", 200, 1.7, 1, 1, 4, MO_INTEGRATOR_SPLIT},
               {"split, no bound, periods of 4", "", 200, 1, 0, 81, 4, MO_INTEGRATOR_SPLIT}};
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
    struct mo_controller *controller = weights_of("1");
    struct mo_physics physics = physics_of(1000, cases[i].control_steps);
    struct mo_gradient_options options = options_of(cases[i].options);
    struct result ways[3];
    uint32_t halved[3];
    physics.constants.stiffness_n_per_m *= cases[i].stiffness;
    physics.scheme.integrator = cases[i].integrator;
    options.adjoint_bound *= cases[i].bound;
    for (size_t k = 0; k < (size_t)controller->n_springs * MO_HIDDEN; k++)
      controller->weight[MO_HIDDEN_LAYERS][k] *= (float)cases[i].last_layer;
    for (int way = 0; way < 3; way++) {
      mo_cuda_gradient_set_halves(device, (enum mo_cuda_halves)(MO_CUDA_HALVES_NEVER + way));
      run_with(&ways[way], controller, s, 0, cases[i].n, &physics, &options, 0);
      halved[way] = mo_cuda_gradient_times(device)->halved;
    }
    mo_cuda_gradient_set_halves(device, MO_CUDA_HALVES_IF_FASTER);
    expect(halved[0] == 0 && halved[1] > 0 && halved[1] < halved[2],
           "whole groups, some in halves, all in halves");
    expect(same_result(&ways[0], &ways[2]), "whole groups and halves have the same bits: %s",
           cases[i].name);
    expect(same_result(&ways[0], &ways[1]), "some of both have the same bits: %s", cases[i].name);
    print_counts(cases[i].name, &ways[0].call.counts);
    for (int way = 0; way < 3; way++)
      drop_result(&ways[way]);
    mo_controller_free(controller);
  }
}

static int is_finite(const struct result *r)
{
  for (size_t k = 0; k < r->call.controller->n_parameters; k++)
    if (!isfinite(r->call.d_parameters[k]))
      return 0;
  return 1;
}

/* Bodies with springs too stiff for the step diverge. Without a bound, and with large weights,
 * adjoints leave the range of float32. */
static void check_rare(const struct scene *s)
{
  enum { FEW = 200 };
  struct mo_controller *controller = weights_of("1");
  struct mo_physics physics = mo_paper_physics();
  struct mo_gradient_options options = mo_default_gradient_options();
  struct result a, b;
  physics.scheme.n_steps = 300;
  physics.constants.stiffness_n_per_m *= 1.7;
  run_with(&a, controller, s, 0, FEW, &physics, &options, 0);
  run_with(&b, controller, s, 0, FEW, &physics, &options, 0);
  print_counts("springs 1.7 times as stiff", &a.call.counts);
  expect(a.call.counts.diverged_robots > 0 && a.call.counts.diverged_robots < FEW && is_finite(&a),
         "some diverge, the others' gradient is finite");
  expect(same_result(&a, &b), "two runs are the same");
  drop_result(&a);
  drop_result(&b);
  physics = mo_paper_physics();
  options.adjoint_bound = 0;
  unsigned long long zeroed = 0;
  for (float factor = 3; factor < 300 && zeroed == 0; factor *= 3) {
    for (size_t k = 0; k < (size_t)controller->n_springs * MO_HIDDEN; k++)
      controller->weight[MO_HIDDEN_LAYERS][k] *= 3;
    run_with(&a, controller, s, 0, FEW, &physics, &options, 0);
    const uint32_t walks = mo_cuda_gradient_times(device)->walks;
    zeroed = a.call.counts.zeroed_robots;
    print_counts("no bound", &a.call.counts);
    expect(is_finite(&a) && (walks > 1) == (zeroed > 0),
           "the gradient is finite, and recomputed without robots that are left out");
    if (zeroed > 0) {
      run_with(&b, controller, s, 0, FEW, &physics, &options, 0);
      expect(same_result(&a, &b), "two runs are the same");
      drop_result(&b);
    }
    drop_result(&a);
  }
  expect(zeroed > 0, "a robot was left out");
  mo_controller_free(controller);
}

static volatile int cancel_flag;

static void *cancel_soon(void *context)
{
  const struct timespec pause = {0, 30000000};
  nanosleep(&pause, NULL);
  cancel_flag = 1;
  return context;
}

static void check_cancel(const struct scene *s)
{
  struct mo_controller *controller = weights_of("1");
  struct result before, after;
  pthread_t thread;
  const uint32_t n = MO_DEVICE_SHARD;
  run_steps(&before, controller, s, 0, n, 1000, 0);
  struct mo_device_gradient call = before.call;
  call.d_parameters = must_have(malloc(controller->n_parameters * sizeof(float)));
  call.outcomes = must_have(calloc(n, sizeof(*call.outcomes)));
  call.cancel = &cancel_flag;
  must(pthread_create(&thread, NULL, cancel_soon, NULL) == 0 ? MO_OK : MO_ERR_NO_MEMORY, "thread");
  const double start = now_s();
  const int status = mo_cuda_gradient_run(device, &call, 0);
  const double took = now_s() - start;
  expect(status == MO_ERR_CANCELLED && took < 0.1, "cancelled after 0.030 s: returned after %.3f s",
         took);
  pthread_join(thread, NULL);
  run_steps(&after, controller, s, 0, n, 1000, 0);
  expect(same_result(&before, &after), "the next call returns what the previous one returned");
  free(call.d_parameters);
  free(call.outcomes);
  drop_result(&before);
  drop_result(&after);
  mo_controller_free(controller);
}

void time_steps(const struct scene *s, uint32_t n, const struct mo_physics *physics,
                enum mo_cuda_halves halves, double bound_s)
{
  static const char *const names[] = {
      "", " as whole groups", " as groups some of which are in halves", " as groups in halves"};
  struct mo_controller *controller = weights_of("1");
  const struct mo_gradient_options options = mo_default_gradient_options();
  double total[REPEATS], device_s[REPEATS];
  mo_cuda_gradient_set_halves(device, halves);
  for (int i = -1; i < REPEATS; i++) {
    struct result r;
    run_with(&r, controller, s, 0, n, physics, &options, 0);
    if (i >= 0) {
      total[i] = r.total_s;
      device_s[i] = r.call.device_s;
    }
    drop_result(&r);
  }
  mo_cuda_gradient_set_halves(device, MO_CUDA_HALVES_IF_FASTER);
  printf("%u robots%s, %s, %u steps of %g ms, control periods of %g ms: median %.3f s, of the "
         "device %.3f s\n",
         n, names[halves], physics->scheme.integrator == MO_INTEGRATOR_SPLIT ? "split" : "paper",
         physics->scheme.n_steps, 1e3 * physics->scheme.dt_s,
         1e3 * physics->scheme.control_period_s, quantile(total, REPEATS, 0.5),
         quantile(device_s, REPEATS, 0.5));
  if (bound_s > 0)
    expect(quantile(device_s, REPEATS, 0.5) <= bound_s,
           "a learning step of 8192 within 0.25 s of device time");
  mo_controller_free(controller);
}

int main(int argc, char **argv)
{
  const char *what = argc > 1 ? argv[1] : "check";
  if (strcmp(what, "reference") == 0 && argc > 3)
    return make_reference(argv[2], argv[3], argc > 4 ? (uint32_t)atoi(argv[4]) : 1);
  uint32_t n_devices = 0;
  must(mo_device_module()->count(&n_devices), "count");
  if (n_devices == 0) {
    printf("no device\n");
    return 77;
  }
  device_error = error_of_device;
  must(mo_device_module()->open(0, &device), "open");
  struct scene s;
  if (strcmp(what, "time") == 0) {
    const struct mo_physics physics = physics_of(1000, 0), held = physics_of(1000, 4);
    struct mo_physics fine = held; /* half the step, the same periods */
    fine.scheme.dt_s /= 2;
    fine.scheme.n_steps *= 2;
    struct mo_physics split = fine;
    split.scheme.integrator = MO_INTEGRATOR_SPLIT;
    make_scene(&s, MOST);
    for (int i = 2; i < argc; i++) {
      const uint32_t n = (uint32_t)atoi(argv[i]);
      if (n < 1 || n > MOST) {
        fprintf(stderr, "cuda-gradient: 1 to %d robots\n", MOST);
        return 2;
      }
      for (int halves = MO_CUDA_HALVES_IF_FASTER; halves <= MO_CUDA_HALVES_ALWAYS; halves++)
        time_steps(&s, n, &physics, (enum mo_cuda_halves)halves, 0);
    }
    if (argc <= 2) {
      time_steps(&s, 1024, &physics, MO_CUDA_HALVES_IF_FASTER, 0);
      time_steps(&s, MOST, &physics, MO_CUDA_HALVES_IF_FASTER, STEP_BOUND_S);
      time_steps(&s, MOST, &held, MO_CUDA_HALVES_IF_FASTER, 0);
      time_steps(&s, MOST, &fine, MO_CUDA_HALVES_IF_FASTER, 0);
      time_steps(&s, MOST, &split, MO_CUDA_HALVES_IF_FASTER, 0);
      time_tasks(MOST, &split);
    }
  } else if (strcmp(what, "alone") == 0) {
    make_scene(&s, LIKE);
    check_alone(&s, argc > 2 ? (uint32_t)atoi(argv[2]) : 1);
  } else if (strcmp(what, "like") == 0 && argc > 5) {
    make_scene(&s, LIKE);
    for (int i = 2; i + 3 < argc; i += 4) {
      const struct period_case c = {"1", (uint32_t)atoi(argv[i + 1]), (uint32_t)atoi(argv[i + 2]),
                                    (uint32_t)atoi(argv[i + 3]),
                                    strcmp(argv[i], "split") == 0 ? MO_INTEGRATOR_SPLIT
                                                                  : MO_INTEGRATOR_PAPER};
      check_period(&s, &c, -1, INFINITY);
    }
  } else if (strcmp(what, "short") == 0) {
    const uint32_t n = argc > 2 ? (uint32_t)atoi(argv[2]) : 40,
                   n_steps = argc > 3 ? (uint32_t)atoi(argv[3]) : 2;
    make_scene(&s, n);
    struct mo_controller *controller = weights_of("1");
    for (int halves = MO_CUDA_HALVES_NEVER; halves <= MO_CUDA_HALVES_ALWAYS; halves++) {
      struct result r;
      mo_cuda_gradient_set_halves(device, (enum mo_cuda_halves)halves);
      run_steps(&r, controller, &s, 0, n, n_steps, 0);
      drop_result(&r);
      const struct mo_physics held = physics_of(n_steps, 2);
      const struct mo_gradient_options options = mo_default_gradient_options();
      run_with(&r, controller, &s, 0, n, &held, &options, 0);
      drop_result(&r);
    }
    mo_controller_free(controller);
    short_tasks(n, n_steps);
  } else {
    make_scene(&s, 2 * MO_DEVICE_SHARD);
    for (int i = 2; i + 1 < argc; i += 2)
      check_likeness(argv[i], argv[i + 1], &s);
    check_periods(&s);
    check_split(&s);
    check_short_periods(&s);
    check_tasks();
    check_bits(&s, 250);
    check_halves(&s);
    check_rare(&s);
    check_cancel(&s);
  }
  drop_scene(&s);
  mo_device_module()->close(device);
  return missed();
}
