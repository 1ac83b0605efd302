/* score_error.c: how good the estimated errors of scores are (include/morpho/score_error.h).
 *
 * Random bodies are scored as in an evaluation that estimates errors: with the default settings, in
 * float32, each in four environments of the paper's test set. The limit of a score is computed in
 * float64 with steps of 1/64 ms and the same control period. The environments reported as
 * bifurcating are compared with three other sets, in which losses are apart: those of rollouts as
 * requested, in float32, that start 1.5e-7, 2.5e-7 or 3.5e-7 m higher, starts that the estimate did
 * not use; those from the estimate's starts, in float64 with the same step; and the limit and the
 * loss of a rollout with its settings that starts 1e-7 m higher. Losses are apart if they differ by
 * more than MO_ERROR_BIFURCATION. */
#include "bench.h"

#include <math.h>
#include <stdlib.h>

#include <morpho/score_error.h>

#define LIMIT_DT_S (0.001 / 64)

enum { ENVIRONMENTS = 4, RUNS = 2 + MO_ERROR_DISPLACED };

struct bench {
  struct bench_scene scene;
  struct mo_compute *compute;
  struct mo_compute_controller *controller;
  uint32_t n; /* bodies */
};

/* Scores all bodies. Returns their blocks, which have the outcomes (malloc). */
static struct mo_block *simulate(const struct bench *b, const struct mo_physics *physics,
                                 enum mo_precision precision)
{
  struct mo_block *blocks = bench_zeros(b->n, sizeof(*blocks));
  for (uint32_t i = 0; i < b->n; i++) {
    blocks[i] = (struct mo_block){.body = b->scene.bodies[i],
                                  .controller = b->controller,
                                  .n_environments = ENVIRONMENTS,
                                  .physics = *physics,
                                  .precision = precision};
    for (uint32_t k = 0; k < ENVIRONMENTS; k++)
      blocks[i].environments[k] = b->scene.list[(ENVIRONMENTS * i + k) % MO_PAPER_TEST_COUNT];
  }
  bench_check(mo_compute_run(b->compute, blocks, b->n), "rollouts");
  return blocks;
}

/* Returns the environments in which the ends of a body's n rollouts are apart, as bits. */
static uint64_t bifurcations(struct mo_block *const *runs, uint32_t n, uint32_t body)
{
  uint64_t found = 0;
  for (uint32_t k = 0; k < ENVIRONMENTS; k++)
    for (uint32_t i = 0; i < n; i++)
      for (uint32_t j = 0; j < i; j++)
        if (fabs(runs[i][body].outcomes[k].loss - runs[j][body].outcomes[k].loss) >
            MO_ERROR_BIFURCATION)
          found |= UINT64_C(1) << k;
  return found;
}

static double mean_loss(const struct mo_block *block)
{
  double sum = 0;
  for (uint32_t k = 0; k < ENVIRONMENTS; k++)
    sum += block->outcomes[k].loss;
  return sum / ENVIRONMENTS;
}

/* Counts of the rollouts that were reported as bifurcating, that really bifurcate, and both. */
struct agreement {
  uint32_t found, real, both;
};

static void add(struct agreement *agreement, uint64_t found, uint64_t real)
{
  agreement->found += (uint32_t)__builtin_popcountll(found);
  agreement->real += (uint32_t)__builtin_popcountll(real);
  agreement->both += (uint32_t)__builtin_popcountll(found & real);
}

static void print_agreement(const struct bench *b, const char *where,
                            const struct agreement *agreement)
{
  fprintf(stderr, "bifurcations %s: %u of %u rollouts, %u found: precision %.2f, recall %.2f\n",
          where, agreement->real, b->n * ENVIRONMENTS, agreement->found,
          (double)agreement->both / agreement->found, (double)agreement->both / agreement->real);
}

/* The rollouts of all bodies. */
struct runs {
  struct mo_block *estimate[RUNS];                      /* float32 */
  struct mo_block *as_computed[1 + MO_ERROR_DISPLACED]; /* float32: as requested, other starts */
  struct mo_block *same_step[1 + MO_ERROR_DISPLACED];   /* float64: as requested, displaced */
  struct mo_block *limit[2];                            /* float64: the limit, displaced */
};

static void compare(const struct bench *b, const struct runs *runs)
{
  double *widths = bench_zeros(b->n, sizeof(*widths));
  struct agreement as_computed = {0}, same_step = {0}, at_limit = {0};
  uint32_t covered = 0;
  printf("body,score,limit,low,high,discretization,rounding,standard_error,bifurcates,as_computed,"
         "same_step,at_limit\n");
  for (uint32_t i = 0; i < b->n; i++) {
    double losses[RUNS][ENVIRONMENTS];
    for (uint32_t run = 0; run < RUNS; run++)
      for (uint32_t k = 0; k < ENVIRONMENTS; k++)
        losses[run][k] = runs->estimate[run][i].outcomes[k].loss;
    const struct mo_score_error error = mo_score_error_of(
        losses[0], MO_ERROR_DISPLACED, ENVIRONMENTS, runs->estimate[0]->physics.scheme.integrator);
    const double limit = mean_loss(&runs->limit[0][i]);
    const uint64_t computed = bifurcations(runs->as_computed, 1 + MO_ERROR_DISPLACED, i),
                   same = bifurcations(runs->same_step, 1 + MO_ERROR_DISPLACED, i),
                   fine = bifurcations(runs->limit, 2, i);
    covered += error.low <= limit && limit <= error.high;
    widths[i] = (error.high - error.low) / 2;
    add(&as_computed, error.bifurcates, computed);
    add(&same_step, error.bifurcates, same);
    add(&at_limit, error.bifurcates, fine);
    printf("%u,%.6f,%.6f,%.6f,%.6f,%.3e,%.3e,%.3e,%llu,%llu,%llu,%llu\n", i,
           mean_loss(&runs->estimate[0][i]), limit, error.low, error.high, error.discretization,
           error.rounding, error.standard_error, (unsigned long long)error.bifurcates,
           (unsigned long long)computed, (unsigned long long)same, (unsigned long long)fine);
  }
  fprintf(stderr, "limit within the interval: %.1f %% of %u; half-width: median %.4f, 90 %% %.4f\n",
          100.0 * covered / b->n, b->n, bench_median(widths, b->n),
          bench_quantile(widths, b->n, 0.9));
  print_agreement(b, "as computed, from other starts", &as_computed);
  print_agreement(b, "with the same step in float64", &same_step);
  print_agreement(b, "at the limit", &at_limit);
}

int bench_score_error(const struct bench_options *options)
{
  struct bench b = {.n = options->bodies > 0 ? options->bodies : options->quick ? 50 : 500};
  struct mo_physics physics = bench_physics(options), fine = physics;
  struct runs runs;
  bench_scene_create(&b.scene, options, b.n);
  b.compute = bench_compute(options->workers, options->isa);
  bench_check(mo_compute_controller_create(b.compute, b.scene.controller, &b.controller),
              "controller");
  for (uint32_t run = 0; run < RUNS; run++) {
    const struct mo_physics of_run = mo_error_physics(&physics, run);
    runs.estimate[run] = simulate(&b, &of_run, MO_FLOAT32);
    if (run != 1)
      runs.same_step[run > 0 ? run - 1 : 0] = simulate(&b, &of_run, MO_FLOAT64);
  }
  runs.as_computed[0] = runs.estimate[0];
  for (uint32_t i = 1; i <= MO_ERROR_DISPLACED; i++) {
    struct mo_physics higher = physics;
    higher.drop_height_m += (i + 0.5) * MO_ERROR_DISPLACEMENT_M;
    runs.as_computed[i] = simulate(&b, &higher, MO_FLOAT32);
  }
  fprintf(stderr, "estimates: done\n");
  if (fine.scheme.control_period_s == 0)
    fine.scheme.control_period_s = fine.scheme.dt_s;
  fine.scheme.n_steps = (uint32_t)lround(fine.scheme.n_steps * fine.scheme.dt_s / LIMIT_DT_S);
  fine.scheme.dt_s = LIMIT_DT_S;
  for (uint32_t i = 0; i < 2; i++) {
    const struct mo_physics of_run = mo_error_physics(&fine, 2 * i);
    runs.limit[i] = simulate(&b, &of_run, MO_FLOAT64);
  }
  compare(&b, &runs);
  return 0;
}
