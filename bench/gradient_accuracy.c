/* gradient_accuracy.c: the float32 gradient of a batch against the float64 reference, at full size:
 * distinct random bodies, each in one training environment, 1000 steps, trained and random
 * controller, with clipping, where adjoints restart, and without a bound. The bound is for
 * random weights, where learning starts. What a trained controller makes of 1000 steps is chaos for
 * part of the robots: float64 does not agree with itself there once the lights are moved by 1e-7 m,
 * which is printed beside. */
#include "bench.h"

#include "../tests/unit/compute/gradient-compare.h"

#include <unistd.h>

#define COSINE_BOUND 0.999

static bool compare(const struct bench_scene *scene, const struct mo_controller *controller,
                    const char *name, const struct bench_options *options,
                    struct mo_gradient_options gradient)
{
  const struct mo_physics physics = mo_default_physics();
  const long online = sysconf(_SC_NPROCESSORS_ONLN);
  const uint32_t workers = options->workers > 0 ? options->workers
                           : online > 0         ? (uint32_t)online
                                                : 1;
  struct gradient_comparison c;
  bench_check(gradient_compare(controller, scene->robots, scene->n_bodies, &physics, &gradient,
                               options->isa, workers < 64 ? workers : 64,
                               gradient.adjoint_bound > 0, &c),
              "gradient");
  printf("\n%s, adjoint bound %g", name, gradient.adjoint_bound);
  if (gradient.adjoint_rule == MO_ADJOINT_RESTART)
    printf(", restart with weight %g", gradient.restart_weight);
  printf(": cosine %.6f (1 - cosine %.2e), norm %.6g against %.6g\n", c.all.cosine,
         1 - c.all.cosine, c.all.norm_fast, c.all.norm_reference);
  printf("  float32: steps clipped %.2f %% in %llu robots, zeroed %llu, diverged %llu, largest m "
         "%.2g; %.1f s\n"
         "  float64: steps clipped %.2f %% in %llu robots, zeroed %llu, diverged %llu, largest m "
         "%.2g; %.1f s\n",
         100 * (double)c.fast.clipped_steps / (double)c.fast.steps,
         (unsigned long long)c.fast.clipped_robots, (unsigned long long)c.fast.zeroed_robots,
         (unsigned long long)c.fast.diverged_robots, c.fast.largest, c.fast_s,
         100 * (double)c.reference.clipped_steps / (double)c.reference.steps,
         (unsigned long long)c.reference.clipped_robots,
         (unsigned long long)c.reference.zeroed_robots,
         (unsigned long long)c.reference.diverged_robots, c.reference.largest, c.reference_s);
  printf("  robot by robot: 1 - cosine median %.1e, p90 %.1e; below 1e-3 in %.1f %%\n",
         c.robots.median, c.robots.p90, 100 * c.robots.share_alike);
  if (gradient.adjoint_bound > 0)
    printf("  float64 against itself with the lights moved by 1e-7 m: cosine %.6f; robot by robot "
           "median %.1e, p90 %.1e; below 1e-3 in %.1f %%\n",
           c.moved_all.cosine, c.moved_robots.median, c.moved_robots.p90,
           100 * c.moved_robots.share_alike);
  printf("  difference in loss: median %.1e, p90 %.1e, most %.1e\n", c.loss_median, c.loss_p90,
         c.loss_most);
  printf("  tensor          1 - cosine   norm float32   norm float64\n");
  for (int t = 0; t < MO_CONTROLLER_TENSORS; t++)
    printf("  %-14s %11.2e %14.6g %14.6g\n", gradient_tensor_names[t], 1 - c.tensor[t].cosine,
           c.tensor[t].norm_fast, c.tensor[t].norm_reference);
  return c.all.cosine >= COSINE_BOUND;
}

int bench_gradient_accuracy(const struct bench_options *options)
{
  const uint32_t n = options->bodies > 0 ? options->bodies : options->quick ? 26 : 256;
  struct bench_scene scene;
  bench_scene_create(&scene, options, n);
  printf("instruction set: %s; %u robots, 1000 steps\n", mo_isa_name(options->isa), n);
  const struct mo_gradient_options clip = mo_default_gradient_options();
  struct mo_gradient_options restart = clip, off = clip;
  restart.adjoint_rule = MO_ADJOINT_RESTART;
  off.adjoint_bound = 0;
  const bool random = compare(&scene, scene.random, "random weights", options, clip);
  (void)compare(&scene, scene.controller, "trained controller", options, clip);
  (void)compare(&scene, scene.random, "random weights", options, off);
  (void)compare(&scene, scene.controller, "trained controller", options, off);
  bool restarted = true;
  for (int i = 0; i < 2; i++) {
    restart.restart_weight = i == 0 ? 1 : MO_RESTART_WEIGHT;
    restarted = compare(&scene, scene.random, "random weights", options, restart) && restarted;
  }
  restart.adjoint_bound = 8; /* of the shipped controller's recipe */
  (void)compare(&scene, scene.random, "random weights", options, restart);
  (void)compare(&scene, scene.controller, "trained controller", options, restart);
  printf("\nbound: cosine with clipping, random weights ≥ %.3f %s\n", COSINE_BOUND,
         random ? "ok" : "MISSED");
  printf("bound: the same where adjoints restart above 2 %s\n", restarted ? "ok" : "MISSED");
  return random && restarted ? 0 : 1;
}
