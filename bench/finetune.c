/* finetune.c: what finetuning on given bodies gains; `morpho-bench learning --finetune`.
 *
 * The bodies are held-out designs of the seed, so random ones that no pretraining of this program
 * has seen; the environments in which they are scored before and after are held out, too. A
 * design's score is its mean loss over them; designs are the samples of the paired confidence
 * interval. */
#include "learning.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

struct scene {
  struct mo_lattice *lattice;
  uint64_t *designs;
  struct mo_environment *environments;
  uint32_t n_designs, n_environments;
};

/* scores: (n_designs); NaN where a rollout diverged. */
static void score(struct mo_compute *compute, const struct scene *scene,
                  const struct mo_controller *controller, const struct mo_physics *physics,
                  double *scores)
{
  const uint32_t per_design = (scene->n_environments + MO_BLOCK_LANES - 1) / MO_BLOCK_LANES;
  const size_t n = (size_t)scene->n_designs * per_design;
  struct mo_block *blocks = bench_zeros(n, sizeof(*blocks));
  struct mo_compute_controller *prepared = NULL;
  bench_check(mo_compute_controller_create(compute, controller, &prepared), "controller");
  for (size_t b = 0; b < n; b++) {
    struct mo_block *block = &blocks[b];
    const uint32_t first = (uint32_t)(b % per_design) * MO_BLOCK_LANES;
    block->lattice = scene->lattice;
    block->genotype = scene->designs + MO_DEFAULT_WORDS * (b / per_design);
    block->controller = prepared;
    block->physics = *physics;
    for (uint32_t e = first; e < scene->n_environments && block->n_environments < MO_BLOCK_LANES;
         e++)
      block->environments[block->n_environments++] = &scene->environments[e];
  }
  bench_check(mo_compute_run(compute, blocks, n), "scores");
  memset(scores, 0, scene->n_designs * sizeof(double));
  for (size_t b = 0; b < n; b++)
    for (uint32_t e = 0; e < blocks[b].n_environments; e++)
      scores[b / per_design] += blocks[b].outcomes[e].diverged_step != 0
                                    ? NAN
                                    : blocks[b].outcomes[e].loss / scene->n_environments;
  mo_compute_controller_free(prepared);
  free(blocks);
}

/* Two-sided 95 % quantile of Student's t with n degrees of freedom (Fisher's expansion about the
 * normal one; error below 1e-3 from n = 8 on). */
static double student(double n)
{
  const double z = 1.959963984540054, z3 = z * z * z, z5 = z3 * z * z, z7 = z5 * z * z;
  return z + (z3 + z) / (4 * n) + (5 * z5 + 16 * z3 + 3 * z) / (96 * n * n) +
         (3 * z7 + 19 * z5 + 17 * z3 - 15 * z) / (384 * n * n * n);
}

static void report(const struct scene *scene, const double *before, const double *after)
{
  double sum = 0.0, square = 0.0, sum_before = 0.0, sum_after = 0.0;
  uint32_t n = 0, better = 0;
  for (uint32_t i = 0; i < scene->n_designs; i++) {
    const double gain = before[i] - after[i];
    if (isnan(gain))
      continue;
    n++;
    better += gain > 0.0;
    sum += gain;
    square += gain * gain;
    sum_before += before[i];
    sum_after += after[i];
  }
  if (n < 2) {
    printf("only %u of %u designs can be compared\n", n, scene->n_designs);
    return;
  }
  if (n < scene->n_designs)
    printf("%u designs left out: a rollout of theirs diverged, before or after\n",
           scene->n_designs - n);
  const double mean = sum / n, deviation = sqrt((square - n * mean * mean) / (n - 1)),
               half = student(n - 1) * deviation / sqrt(n);
  printf("%u designs x %u held-out environments\nmean score before %.4f, after %.4f\n"
         "mean gain %.4f, 95 %% confidence interval %.4f to %.4f (paired, over designs)\n%u of %u "
         "designs improved\n",
         n, scene->n_environments, sum_before / n, sum_after / n, mean, mean - half, mean + half,
         better, n);
}

int bench_finetune(const struct bench_options *options, const struct mo_training_settings *settings,
                   uint32_t n_designs, uint32_t n_environments)
{
  struct mo_message message = {""};
  struct mo_controller *parent = NULL;
  struct mo_training *training = NULL;
  struct learning_machine machine;
  struct scene scene = {.n_designs = n_designs, .n_environments = n_environments};
  if (mo_controller_read(options->controller, &parent, &message) != MO_OK) {
    fprintf(stderr, "morpho-bench: %s: %s\n", options->controller, message.text);
    return EXIT_FAILURE;
  }
  scene.designs = bench_zeros(n_designs, MO_DEFAULT_WORDS * sizeof(uint64_t));
  scene.environments = bench_zeros(n_environments, sizeof(struct mo_environment));
  double *before = bench_zeros(n_designs, sizeof(double)),
         *after = bench_zeros(n_designs, sizeof(double));
  bench_check(mo_lattice_create(MO_DEFAULT_WORKSPACE, &scene.lattice), "lattice");
  bench_check(mo_held_out_designs(settings->seed, n_designs, scene.designs), "designs");
  mo_held_out_environments(settings->seed, n_environments, scene.environments);
  if (mo_training_create(settings, parent, scene.designs, n_designs, &training, &message) !=
      MO_OK) {
    fprintf(stderr, "morpho-bench: %s\n", message.text);
    return EXIT_FAILURE;
  }
  learning_machine_create(&machine, options, settings->batch);
  score(machine.compute, &scene, parent, &settings->physics, before);
  const double start = bench_now_s();
  for (uint32_t step = 1; step <= settings->n_steps; step++) {
    const struct mo_training_report made = learning_step(&machine, training);
    if (step % 10 == 0 || step == 1 || step == settings->n_steps)
      printf("  step %3u  loss %.4f  norm %.3f  rate %.2e  %.0f s\n", step, made.mean_loss,
             made.gradient_norm, made.rate, bench_now_s() - start);
  }
  score(machine.compute, &scene, mo_training_controller(training), &settings->physics, after);
  report(&scene, before, after);
  learning_machine_free(&machine);
  mo_training_free(training);
  mo_lattice_free(scene.lattice);
  mo_controller_free(parent);
  free(scene.designs);
  free(scene.environments);
  free(before);
  free(after);
  return EXIT_SUCCESS;
}
