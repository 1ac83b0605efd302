/* gradient.c: how fast one core differentiates rollouts, and how much memory it needs.
 *
 * The sample: the first distinct bodies of the seed's stream, each in one training environment,
 * with a trained controller and with random weights. The reference: the time that OpenBLAS sgemm on
 * one core, at its best rate in the same run, would need for three times the arithmetic of the
 * controller restricted to each body's masses and springs: once for the forward pass, and in the
 * backward pass once for the gradient of the inputs and once for that of the weights. Blocks and
 * products alternate, so that both run under the same conditions. Both are counted in processor
 * time of the thread that runs them. */
#include "bench.h"

#include <math.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { SAMPLE = 256, BUDGETS = 5 };

#define RATIO_BOUND       1.7
#define WORKER_MIB_BOUND  512.0
#define URGENT_WAIT_BOUND 0.1

struct sample {
  const struct bench_scene *scene;
  uint32_t n, n_blocks;
  struct mo_robot *ordered; /* (n) those of the scene, rearranged */
  float *d_parameters;
  struct mo_outcome outcomes[MO_GRADIENT_ROBOTS];
  struct mo_gradient_options options;
  struct mo_physics physics;
};

static void sample_create(struct sample *s, const struct bench_scene *scene,
                          const struct bench_options *options)
{
  *s = (struct sample){.scene = scene, .n = scene->n_bodies, .physics = bench_physics(options)};
  s->n_blocks = (s->n + MO_GRADIENT_ROBOTS - 1) / MO_GRADIENT_ROBOTS;
  s->options = (struct mo_gradient_options){MO_ADJOINT_BOUND, 1.0 / s->n};
  s->ordered = bench_zeros(s->n, sizeof(*s->ordered));
  uint32_t *order = bench_zeros(s->n, sizeof(*order));
  s->d_parameters = bench_zeros(scene->controller->n_parameters, sizeof(float));
  bench_check(mo_gradient_arrange(scene->robots, s->n, order), "order");
  for (uint32_t i = 0; i < s->n; i++)
    s->ordered[i] = scene->robots[order[i]];
  free(order);
}

static uint32_t block_size(const struct sample *s, uint32_t block)
{
  const uint32_t left = s->n - block * MO_GRADIENT_ROBOTS;
  return left < MO_GRADIENT_ROBOTS ? left : MO_GRADIENT_ROBOTS;
}

/* Returns the FLOP of three times the controller for one block. */
static double block_flop(const struct sample *s, uint32_t block)
{
  double flop = 0;
  for (uint32_t i = 0; i < block_size(s, block); i++)
    flop += 3 * bench_controller_flop(s->ordered[block * MO_GRADIENT_ROBOTS + i].body) *
            bench_passes(&s->physics);
  return flop;
}

static double run_block_s(struct sample *s, struct mo_gradient_memory *memory,
                          const struct mo_pack *pack, uint32_t block,
                          struct mo_gradient_counts *counts)
{
  const double start = bench_thread_s();
  bench_check(mo_gradient_block(memory, pack, s->ordered + block * MO_GRADIENT_ROBOTS,
                                block_size(s, block), &s->physics, &s->options, NULL, s->outcomes,
                                s->d_parameters, counts),
              "gradient");
  return bench_thread_s() - start;
}

struct report {
  double ratio, ratio_median, ratio_worst, ms_per_robot, sgemm_best, mib;
  struct mo_gradient_counts counts;
};

static void measure(struct report *report, struct sample *s, const struct mo_controller *controller,
                    enum mo_isa isa, const struct bench_sgemm *sgemm)
{
  struct mo_pack *pack = NULL;
  struct mo_gradient_memory *memory = NULL;
  *report = (struct report){0};
  bench_check(mo_pack_create_for_gradients(controller, isa, &pack), "pack");
  bench_check(mo_gradient_memory_create(MO_GRADIENT_DEFAULT_BYTES, &memory), "scratch");
  double *ratio = bench_zeros(s->n_blocks, sizeof(*ratio));
  (void)run_block_s(s, memory, pack, 0, NULL); /* warm-up: touches the scratch */
  double total_s = 0, total_flop = 0, before = bench_sgemm_best(sgemm);
  report->sgemm_best = before;
  for (uint32_t block = 0; block < s->n_blocks; block++) {
    const double block_s = run_block_s(s, memory, pack, block, &report->counts);
    const double after = bench_sgemm_best(sgemm), flop = block_flop(s, block);
    ratio[block] = block_s / (flop / fmax(before, after));
    before = after;
    report->sgemm_best = fmax(report->sgemm_best, after);
    total_s += block_s;
    total_flop += flop;
  }
  report->ms_per_robot = 1e3 * total_s / s->n;
  report->ratio = total_s / (total_flop / report->sgemm_best);
  report->ratio_median = bench_median(ratio, s->n_blocks);
  report->ratio_worst = bench_quantile(ratio, s->n_blocks, 1.0);
  report->mib = (double)mo_gradient_memory_bytes(memory) / (1 << 20);
  mo_gradient_memory_free(memory);
}

static void print_report(const struct report *r, const char *name)
{
  const double clipped = (double)r->counts.clipped_steps / (double)r->counts.steps;
  printf("\n%s\n", name);
  printf("time per rollout with gradient, one core: %.2f ms\n", r->ms_per_robot);
  printf("best sgemm rate of one core: %.1f GFLOP/s\n", 1e-9 * r->sgemm_best);
  printf("ratio to three times the controller's arithmetic at that rate: %.3f (by block: median "
         "%.3f, worst %.3f)\n",
         r->ratio, r->ratio_median, r->ratio_worst);
  printf("scratch: %.1f MiB\n", r->mib);
  printf("steps of the backward pass that were clipped: %.2f %%, in %llu robots; zeroed %llu, "
         "diverged %llu\n",
         100 * clipped, (unsigned long long)r->counts.clipped_robots,
         (unsigned long long)r->counts.zeroed_robots,
         (unsigned long long)r->counts.diverged_robots);
}

/* Smaller budgets: more is computed twice, but no bit may change. Measures two blocks, the better
 * of two times each. Returns false if a bit changed. */
static bool print_budgets(struct sample *s, const struct mo_controller *controller, enum mo_isa isa,
                          const struct bench_sgemm *sgemm)
{
  static const uint32_t budgets_mib[BUDGETS] = {384, 192, 96, 48, 24};
  const size_t n = controller->n_parameters;
  const uint32_t blocks = s->n_blocks < 2 ? s->n_blocks : 2;
  struct mo_pack *pack = NULL;
  float *first = bench_zeros(blocks * n, sizeof(float));
  bool same = true;
  bench_check(mo_pack_create_for_gradients(controller, isa, &pack), "pack");
  printf("\nbudget, MiB   scratch, MiB   ratio\n");
  for (int k = 0; k < BUDGETS; k++) {
    struct mo_gradient_memory *memory = NULL;
    double total_s = 0, total_flop = 0;
    bench_check(mo_gradient_memory_create((size_t)budgets_mib[k] << 20, &memory), "scratch");
    (void)run_block_s(s, memory, pack, 0, NULL);
    const double before = bench_sgemm_best(sgemm);
    for (uint32_t i = 0; i < blocks; i++) {
      const uint32_t block = i * (s->n_blocks / 2); /* a large one and a common one */
      const double once_s = run_block_s(s, memory, pack, block, NULL);
      total_s += fmin(once_s, run_block_s(s, memory, pack, block, NULL));
      total_flop += block_flop(s, block);
      if (k == 0)
        memcpy(first + i * n, s->d_parameters, n * sizeof(float));
      same = same && memcmp(first + i * n, s->d_parameters, n * sizeof(float)) == 0;
    }
    const double rate = fmax(before, bench_sgemm_best(sgemm));
    printf("%11u %14.1f %7.3f\n", budgets_mib[k],
           (double)mo_gradient_memory_bytes(memory) / (1 << 20), total_s / (total_flop / rate));
    mo_gradient_memory_free(memory);
  }
  printf("same bits for any budget: %s\n", same ? "yes" : "NO");
  return same;
}

/* Measures how long an urgent block of one step takes while the workers differentiate, including
 * its wait. */
struct urgent {
  const struct sample *sample;
  struct mo_compute *compute;
  struct mo_compute_controller *controller;
  atomic_bool stop;
  uint32_t n;
  double worst_s;
};

static void *submit_urgent(void *argument)
{
  struct urgent *urgent = argument;
  for (; !atomic_load(&urgent->stop); urgent->n++) {
    struct mo_block block = {.body = urgent->sample->scene->bodies[urgent->n % urgent->sample->n],
                             .controller = urgent->controller,
                             .environments = {urgent->sample->scene->list[0]},
                             .n_environments = 1,
                             .physics = urgent->sample->physics,
                             .urgency = MO_INTERACTIVE};
    block.physics.scheme.n_steps = 1;
    const double start_s = bench_now_s();
    bench_check(mo_compute_run(urgent->compute, &block, 1), "urgent block");
    urgent->worst_s = fmax(urgent->worst_s, bench_now_s() - start_s);
    usleep(13700);
  }
  return NULL;
}

/* Computes the whole sample as one batch, with n workers; with `urgent`, while urgent blocks
 * arrive. Returns seconds. */
static double run_batch_s(const struct sample *s, enum mo_isa isa, uint32_t workers,
                          struct urgent *urgent, double *d_parameters, double *worker_mib)
{
  struct mo_compute *compute = bench_compute(workers, isa);
  struct mo_gradient_state *state = NULL;
  struct mo_outcome *outcomes = bench_zeros(s->n, sizeof(*outcomes));
  pthread_t thread;
  bench_check(mo_gradient_state_create(compute, &state), "state");
  struct mo_gradient_batch batch = {.controller = s->scene->controller,
                                    .robots = s->scene->robots,
                                    .n = s->n,
                                    .physics = s->physics,
                                    .options.adjoint_bound = MO_ADJOINT_BOUND,
                                    .d_parameters = d_parameters,
                                    .outcomes = outcomes};
  if (urgent != NULL) {
    *urgent = (struct urgent){.sample = s, .compute = compute};
    bench_check(mo_compute_controller_create(compute, s->scene->controller, &urgent->controller),
                "controller");
    bench_check(pthread_create(&thread, NULL, submit_urgent, urgent) == 0 ? MO_OK
                                                                          : MO_ERR_NO_MEMORY,
                "thread");
  }
  const double start_s = bench_now_s();
  bench_check(mo_compute_gradient(state, &batch), "gradient");
  const double seconds = bench_now_s() - start_s;
  if (urgent != NULL) {
    atomic_store(&urgent->stop, true);
    pthread_join(thread, NULL);
    mo_compute_controller_free(urgent->controller);
  }
  struct mo_compute_stats stats;
  mo_compute_get_stats(compute, &stats);
  *worker_mib = (double)stats.worker_bytes_max / (1 << 20);
  mo_gradient_state_free(state);
  mo_compute_free(compute);
  free(outcomes);
  return seconds;
}

struct back_end {
  double one_s, two_s, disturbed_s, worker_mib, urgent_worst_s;
  uint32_t urgent;
  bool same;
};

static void measure_back_end(struct back_end *b, const struct sample *s, enum mo_isa isa)
{
  const size_t n = s->scene->controller->n_parameters;
  double *gradient[3];
  struct urgent urgent;
  for (int k = 0; k < 3; k++)
    gradient[k] = bench_zeros(n, sizeof(double));
  b->one_s = run_batch_s(s, isa, 1, NULL, gradient[0], &b->worker_mib);
  b->two_s = run_batch_s(s, isa, 2, NULL, gradient[1], &b->worker_mib);
  b->disturbed_s = run_batch_s(s, isa, 2, &urgent, gradient[2], &b->worker_mib);
  b->urgent = urgent.n;
  b->urgent_worst_s = urgent.worst_s;
  b->same = memcmp(gradient[0], gradient[1], n * sizeof(double)) == 0 &&
            memcmp(gradient[0], gradient[2], n * sizeof(double)) == 0;
}

static void print_back_end(const struct back_end *b, const struct sample *s)
{
  printf("\nback end, all %u robots at once: %.1f robots/s with one worker, %.1f with two, the "
         "same bits: %s\n%u urgent blocks of one step at the same time: the slowest took %.1f ms; "
         "%.1f "
         "robots/s with them\na worker's scratch: %.1f MiB\n",
         s->n, s->n / b->one_s, s->n / b->two_s, b->same ? "yes" : "NO", b->urgent,
         1e3 * b->urgent_worst_s, s->n / b->disturbed_s, b->worker_mib);
}

int bench_gradient(const struct bench_options *options)
{
  const uint32_t n = options->bodies > 0 ? options->bodies : options->quick ? 64 : SAMPLE;
  struct bench_scene scene;
  struct bench_sgemm sgemm;
  struct sample sample;
  struct report shipped, random;
  struct back_end back_end = {0};
  double masses = 0, springs = 0;
  bench_scene_create(&scene, options, n);
  sample_create(&sample, &scene, options);
  bench_sgemm_create(&sgemm);
  (void)bench_sgemm_best(&sgemm); /* warm-up */
  for (uint32_t i = 0; i < n; i++) {
    masses += scene.bodies[i]->n_masses / (double)n;
    springs += scene.bodies[i]->n_springs / (double)n;
  }
  printf("instruction set: %s\nsample: %u distinct random bodies, each in one training "
         "environment, 1000 steps; on average %.1f masses, %.1f springs\n",
         mo_isa_name(options->isa), n, masses, springs);
  measure(&shipped, &sample, scene.controller, options->isa, &sgemm);
  print_report(&shipped, "trained controller");
  measure(&random, &sample, scene.random, options->isa, &sgemm);
  print_report(&random, "random weights");
  const bool same = print_budgets(&sample, scene.controller, options->isa, &sgemm);
  measure_back_end(&back_end, &sample, options->isa);
  print_back_end(&back_end, &sample);
  const double ratio = fmax(shipped.ratio, random.ratio);
  const bool kept = ratio <= RATIO_BOUND && back_end.worker_mib <= WORKER_MIB_BOUND &&
                    back_end.urgent_worst_s <= URGENT_WAIT_BOUND && same && back_end.same;
  printf("\nbounds: ratio %.3f ≤ 1.7 %s; a worker's scratch %.1f MiB ≤ 512 %s; urgent block %.1f "
         "ms ≤ 100 %s; same bits %s\n",
         ratio, ratio <= RATIO_BOUND ? "ok" : "MISSED", back_end.worker_mib,
         back_end.worker_mib <= WORKER_MIB_BOUND ? "ok" : "MISSED", 1e3 * back_end.urgent_worst_s,
         back_end.urgent_worst_s <= URGENT_WAIT_BOUND ? "ok" : "MISSED",
         same && back_end.same ? "ok" : "MISSED");
  return kept ? 0 : 1;
}
