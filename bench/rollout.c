/* rollout.c: how fast one core scores bodies, compared with the speed of its matrix products.
 *
 * The reference: the time that OpenBLAS sgemm on one core, at its best rate in the same run, would
 * need for the arithmetic of the controller restricted to the body's masses and springs, 2 ·
 * [(masses + 5) · 256 + 2 · 256 · 256 + 256 · springs] per step. Rollouts and products alternate,
 * so that both run under the same conditions. Both are counted in processor time of the thread that
 * runs them. */
#include "bench.h"

#include <stdlib.h>
#include <string.h>

enum { ROUNDS = 10, PAPER = MO_PAPER_TEST_COUNT };

/* ---- rollouts ---- */

struct runner {
  struct mo_pack *pack, *passive;
  struct mo_workspace_memory *memory;
};

static void runner_create(struct runner *runner, const struct bench_scene *scene, enum mo_isa isa,
                          enum mo_precision precision)
{
  bench_check(mo_pack_create(scene->controller, isa, precision, &runner->pack), "pack");
  bench_check(mo_pack_create(NULL, isa, precision, &runner->passive), "pack");
  bench_check(mo_workspace_memory_create(&runner->memory), "scratch");
}

/* Returns the seconds for one body in the first n environments of the paper test set. */
static double run_s(const struct runner *runner, const struct mo_pack *pack,
                    const struct bench_scene *scene, const struct mo_body *body, uint32_t n,
                    const struct mo_physics *physics)
{
  struct mo_outcome outcomes[MO_BLOCK_LANES];
  const double start = bench_thread_s();
  bench_check(mo_rollout_block(runner->memory, pack, body, scene->list, n, physics, NULL, NULL,
                               NULL, outcomes),
              "rollout");
  return bench_thread_s() - start;
}

static double best_run_s(const struct runner *runner, const struct mo_pack *pack,
                         const struct bench_scene *scene, const struct mo_body *body, uint32_t n,
                         const struct mo_physics *physics)
{
  double best = run_s(runner, pack, scene, body, n, physics);
  for (int repeat = 0; repeat < 4; repeat++) {
    const double again = run_s(runner, pack, scene, body, n, physics);
    best = again < best ? again : best;
  }
  return best;
}

/* ---- the report ---- */

struct report {
  uint32_t n_bodies;
  double masses, springs, voxels;             /* means */
  double rollouts_per_s, rollouts_per_s_best; /* median and best round */
  double sgemm_median, sgemm_best;            /* FLOP/s over the rounds */
  double ratio, ratio_median,
      ratio_worst; /* whole sample against the best sgemm; per round against that of the round */
  double active_share;
};

/* Measures the sample in ROUNDS parts, with a measurement of sgemm before and after each. */
static void measure_sample(struct report *report, const struct runner *runner,
                           const struct bench_scene *scene, const struct mo_physics *physics)
{
  struct bench_sgemm sgemm;
  bench_sgemm_create(&sgemm);
  (void)bench_sgemm_best(&sgemm); /* warm-up */
  (void)run_s(runner, runner->pack, scene, scene->bodies[0], PAPER, physics);
  const uint32_t rounds = scene->n_bodies < ROUNDS ? scene->n_bodies : ROUNDS;
  double rate[ROUNDS], sgemm_rate[ROUNDS], ratio[ROUNDS], total_s = 0, total_flop = 0, all_flop = 0;
  double before = bench_sgemm_best(&sgemm);
  report->sgemm_best = before;
  for (uint32_t round = 0; round < rounds; round++) {
    double round_s = 0, flop = 0;
    uint32_t n = 0;
    for (uint32_t i = round; i < scene->n_bodies; i += rounds, n++) {
      const struct mo_body *body = scene->bodies[i];
      round_s += run_s(runner, runner->pack, scene, body, PAPER, physics);
      flop += bench_controller_flop(body) * PAPER * bench_passes(physics);
      all_flop += 2.0 * (double)scene->controller->n_parameters * PAPER * bench_passes(physics);
      report->masses += body->n_masses / (double)scene->n_bodies;
      report->springs += body->n_springs / (double)scene->n_bodies;
      report->voxels += body->n_voxels / (double)scene->n_bodies;
    }
    const double after = bench_sgemm_best(&sgemm);
    sgemm_rate[round] = before > after ? before : after;
    rate[round] = n * PAPER / round_s;
    ratio[round] = round_s / (flop / sgemm_rate[round]);
    before = after;
    report->sgemm_best =
        sgemm_rate[round] > report->sgemm_best ? sgemm_rate[round] : report->sgemm_best;
    total_s += round_s;
    total_flop += flop;
  }
  report->n_bodies = scene->n_bodies;
  report->rollouts_per_s = scene->n_bodies * PAPER / total_s;
  report->ratio = total_s / (total_flop / report->sgemm_best);
  report->ratio_median = bench_median(ratio, rounds);
  report->ratio_worst = bench_quantile(ratio, rounds, 1.0);
  report->rollouts_per_s_best = bench_quantile(rate, rounds, 1.0);
  report->sgemm_median = bench_median(sgemm_rate, rounds);
  report->active_share = total_flop / all_flop;
}

static void print_sample(const struct report *r)
{
  printf("sample: %u distinct random bodies × %d environments × 1000 steps; on average %.1f "
         "voxels, %.1f masses, %.1f springs\n",
         r->n_bodies, PAPER, r->voxels, r->masses, r->springs);
  printf("rollouts per second and core: %.1f (best round %.1f)\n", r->rollouts_per_s,
         r->rollouts_per_s_best);
  printf("best sgemm rate of one core:  %.1f GFLOP/s (median of the rounds %.1f)\n",
         1e-9 * r->sgemm_best, 1e-9 * r->sgemm_median);
  printf("ratio of time per rollout to the controller's arithmetic at that rate: %.3f (by round: "
         "median %.3f, worst %.3f)\n",
         r->ratio, r->ratio_median, r->ratio_worst);
  printf("controller arithmetic left after dropping absent masses and springs: %.1f %%\n",
         100 * r->active_share);
}

/* Measures the time against the size of the body. Returns largest over smallest. */
static double print_sizes(const struct runner *runner, const struct bench_scene *scene,
                          const struct mo_physics *physics)
{
  static const int boxes[][3] = {{1, 1, 1}, {2, 1, 1}, {2, 2, 1}, {2, 2, 2}, {3, 3, 2},
                                 {4, 4, 2}, {4, 4, 4}, {6, 6, 3}, {6, 6, 4}};
  const int n = (int)(sizeof(boxes) / sizeof(boxes[0]));
  double first_s = 0, last_s = 0;
  printf("\n   voxels   masses  springs   µs per rollout step   rollouts/s\n");
  for (int i = 0; i < n; i++) {
    struct mo_body *body = bench_box(scene, boxes[i][0], boxes[i][1], boxes[i][2]);
    last_s = best_run_s(runner, runner->pack, scene, body, PAPER, physics) / PAPER;
    first_s = i == 0 ? last_s : first_s;
    printf("%9u %8u %8u %21.3f %12.1f\n", body->n_voxels, body->n_masses, body->n_springs,
           1e6 * last_s / physics->scheme.n_steps, 1 / last_s);
    mo_body_free(body);
  }
  printf("144 voxels cost %.1f times as much as one\n", last_s / first_s);
  return last_s / first_s;
}

/* Measures the cost of the same body when parts of the scene are missing. */
static void print_skipping(const struct runner *runner, const struct bench_scene *scene,
                           const struct mo_physics *physics)
{
  struct mo_body *body = bench_box(scene, 4, 4, 4);
  struct mo_physics air = *physics;
  air.drop_height_m = 1000;
  const double with = best_run_s(runner, runner->pack, scene, body, PAPER, physics);
  const double falling = best_run_s(runner, runner->pack, scene, body, PAPER, &air);
  const double without = best_run_s(runner, runner->passive, scene, body, PAPER, physics);
  const double alone = best_run_s(runner, runner->pack, scene, body, 1, physics);
  const double scale = 1e6 / (PAPER * (double)physics->scheme.n_steps);
  printf("\n64 voxels, µs per rollout step: %.3f, in the air %.3f, without a controller %.3f, in "
         "one environment instead of ten %.3f\n",
         scale * with, scale * falling, scale * without, scale * PAPER * alone);
  mo_body_free(body);
}

/* Returns rollouts per second of the whole back end with n workers. */
static double back_end_rate(const struct bench_scene *scene, const struct bench_options *options,
                            uint32_t workers, uint32_t n_bodies, const struct mo_physics *physics,
                            size_t *worker_bytes)
{
  struct mo_compute *compute = bench_compute(workers, options->isa);
  struct mo_compute_controller *controller = NULL;
  bench_check(mo_compute_controller_create(compute, scene->controller, &controller), "controller");
  struct mo_block *blocks = bench_zeros(n_bodies, sizeof(*blocks));
  for (uint32_t i = 0; i < n_bodies; i++) {
    blocks[i] = (struct mo_block){.body = scene->bodies[i],
                                  .controller = controller,
                                  .n_environments = PAPER,
                                  .physics = *physics};
    memcpy(blocks[i].environments, scene->list, sizeof(blocks[i].environments));
  }
  const double start = bench_now_s();
  bench_check(mo_compute_run(compute, blocks, n_bodies), "blocks");
  const double rate = n_bodies * PAPER / (bench_now_s() - start);
  struct mo_compute_stats stats;
  mo_compute_get_stats(compute, &stats);
  *worker_bytes = stats.worker_bytes_max;
  mo_compute_controller_free(controller);
  mo_compute_free(compute);
  free(blocks);
  return rate;
}

/* Returns the most memory that a worker can hold: the full lattice in float64, once as a batch
 * block and once as an urgent block that overtakes it. */
static double worker_mib(const struct bench_scene *scene, enum mo_isa isa,
                         enum mo_precision precision)
{
  struct runner runner;
  runner_create(&runner, scene, isa, precision);
  struct mo_body *body = bench_box(scene, 6, 6, 4);
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.n_steps = 1;
  (void)run_s(&runner, runner.pack, scene, body, MO_BLOCK_LANES, &physics);
  return 2.0 * (double)mo_workspace_memory_bytes(runner.memory) / (1 << 20);
}

int bench_rollout(const struct bench_options *options)
{
  const uint32_t n = options->bodies > 0 ? options->bodies : options->quick ? 20 : 200;
  const struct mo_physics physics = bench_physics(options);
  struct bench_scene scene;
  struct runner runner, runner64;
  struct report report = {0};
  bench_scene_create(&scene, options, n);
  runner_create(&runner, &scene, options->isa, MO_FLOAT32);
  runner_create(&runner64, &scene, options->isa, MO_FLOAT64);

  printf("instruction set: %s\n", mo_isa_name(options->isa));
  measure_sample(&report, &runner, &scene, &physics);
  print_sample(&report);
  const double growth = print_sizes(&runner, &scene, &physics);
  print_skipping(&runner, &scene, &physics);

  const uint32_t few = n < 40 ? n : 40;
  double time64 = 0, time32 = 0;
  for (uint32_t i = 0; i < few; i += 2) {
    time64 += run_s(&runner64, runner64.pack, &scene, scene.bodies[i], PAPER, &physics);
    time32 += run_s(&runner, runner.pack, &scene, scene.bodies[i], PAPER, &physics);
  }
  size_t bytes = 0;
  const double one = back_end_rate(&scene, options, 1, few, &physics, &bytes);
  const double two = back_end_rate(&scene, options, 2, few, &physics, &bytes);
  const double mib32 = worker_mib(&scene, options->isa, MO_FLOAT32),
               mib64 = worker_mib(&scene, options->isa, MO_FLOAT64);
  printf("float64 takes %.2f times as long as float32\n"
         "back end: %.1f rollouts/s with one worker, %.1f with two\n"
         "scratch per worker, largest body, urgent block inside a batch block: %.2f MiB (float32), "
         "%.2f MiB (float64)\n",
         time64 / time32, one, two, mib32, mib64);
  printf("\nbounds: ratio %.3f ≤ 1.6 %s; 144 voxels over one %.1f ≥ 3 %s; scratch %.2f MiB ≤ 16 "
         "%s\n",
         report.ratio, report.ratio <= 1.6 ? "ok" : "MISSED", growth, growth >= 3 ? "ok" : "MISSED",
         mib64, mib64 <= 16 ? "ok" : "MISSED");
  const bool kept = report.ratio <= 1.6 && growth >= 3 && mib64 <= 16;
  return kept ? 0 : 1;
}
