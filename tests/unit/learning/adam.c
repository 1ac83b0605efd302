/* adam.c: the optimizer compared with a plain one in float64, its guards, and the report of a
 * step. */
#include "fixture.h"

#include "learning/internal.h"

#include <float.h>

/* Adam as its paper states it, with the norm clip, in float64 throughout. */
struct plain {
  size_t n;
  uint32_t t;
  double *m, *v, *w;
};

static double plain_step(struct plain *plain, const double *gradient, double rate, double limit)
{
  long double sum = 0;
  for (size_t i = 0; i < plain->n; i++)
    sum += (long double)gradient[i] * gradient[i];
  const double norm = (double)sqrtl(sum);
  plain->t++;
  for (size_t i = 0; i < plain->n; i++) {
    const double g = norm > limit ? gradient[i] * limit / norm : gradient[i];
    plain->m[i] = 0.9 * plain->m[i] + 0.1 * g;
    plain->v[i] = 0.999 * plain->v[i] + 0.001 * g * g;
    const double m_hat = plain->m[i] / (1.0 - pow(0.9, plain->t));
    const double v_hat = plain->v[i] / (1.0 - pow(0.999, plain->t));
    plain->w[i] -= rate * m_hat / (sqrt(v_hat) + 1e-8);
  }
  return norm;
}

static void against_plain(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_PRETRAIN);
  settings.n_steps = 20;
  struct mo_training *training = make_training(&settings, NULL, NULL, 0);
  struct made_up *made_up = make_made_up(training);
  const struct mo_controller *controller = mo_training_controller(training);
  struct plain plain = {made_up->n, 0, make_zeros(made_up->n, sizeof(double)),
                        make_zeros(made_up->n, sizeof(double)),
                        make_zeros(made_up->n, sizeof(double))};
  for (size_t i = 0; i < plain.n; i++)
    plain.w[i] = controller->parameters[i];
  uint32_t clipped = 0;
  double worst = 0.0, moved = 0.0;
  for (uint32_t step = 0; step < settings.n_steps; step++) {
    struct mo_training_report report;
    REQUIRE(advance(training, made_up, &report) == MO_OK);
    const double norm = plain_step(&plain, made_up->gradient, report.rate, 1.0);
    clipped += norm > 1.0;
    CHECK_NEAR(report.gradient_norm, norm, 1e-12 * norm);
    CHECK_INT(report.step, step + 1);
    CHECK(!report.skipped && report.bounded == 0);
    CHECK(report.rate == mo_schedule_rate(&settings.learning.schedule, step, settings.n_steps));
  }
  for (size_t i = 0; i < plain.n; i++) {
    worst = fmax(worst, fabs(controller->parameters[i] - plain.w[i]));
    moved = fmax(moved, fabs(plain.m[i]));
  }
  /* Weights are rounded to float32 at every step. */
  printf("# largest difference after 20 steps %g; %u steps clipped\n", worst, clipped);
  CHECK(worst < 20 * FLT_EPSILON && moved > 1e-4);
  CHECK(clipped > 0 && clipped < 20);
  CHECK_INT(training->skipped, 0);
}

static void norms(void)
{
  double g[4] = {3.0, 0.0, -4.0, 0.0};
  CHECK(mo_gradient_norm(g, 4) == 5.0);
  CHECK(mo_gradient_norm(g, 0) == 0.0);
  g[0] = 3e200, g[2] = 4e200; /* squares overflow */
  CHECK_NEAR(mo_gradient_norm(g, 4) / 5e200, 1.0, 1e-15);
  g[0] = 3e-200, g[2] = 4e-200; /* squares underflow */
  CHECK_NEAR(mo_gradient_norm(g, 4) / 5e-200, 1.0, 1e-15);
  g[0] = g[2] = DBL_MAX;
  CHECK(isinf(mo_gradient_norm(g, 4)));
  g[0] = NAN;
  CHECK(isnan(mo_gradient_norm(g, 4)));
  g[0] = -INFINITY;
  CHECK(!isfinite(mo_gradient_norm(g, 4)));
}

static void clip(void)
{
  for (int limited = 0; limited < 2; limited++) {
    struct mo_training_settings settings = small_settings(MO_TRAINING_PRETRAIN);
    settings.learning.norm_limit = limited ? 1.0 : 0.0;
    struct mo_training *training = make_training(&settings, NULL, NULL, 0);
    struct made_up *made_up = make_made_up(training);
    struct mo_training_report report;
    make_up(made_up, training, draw(training));
    memset(made_up->gradient, 0, made_up->n * sizeof(double));
    made_up->gradient[3] = 6.0;
    made_up->gradient[made_up->n - 1] = -8.0;
    REQUIRE(apply(training, made_up, &report) == MO_OK);
    CHECK(report.gradient_norm == 10.0); /* unchanged */
    CHECK_NEAR(training->adam.first[3], limited ? 0.06 : 0.6, 1e-15);
    CHECK_NEAR(training->adam.second[made_up->n - 1], limited ? 0.00064 : 0.064, 1e-16);
  }
}

/* Returns whether weights and moments equal those of `copy`. */
static bool same_weights(const struct mo_training *a, const struct mo_training *copy)
{
  const size_t n = a->controller->n_parameters;
  return SAME(a->controller->parameters, copy->controller->parameters, n) &&
         SAME(a->adam.first, copy->adam.first, n) && SAME(a->adam.second, copy->adam.second, n) &&
         a->adam.beta2_power == copy->adam.beta2_power;
}

/* Gradients that must not reach the weights: the step counts, but nothing else changes. */
static void skipped(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_PRETRAIN);
  settings.learning.norm_limit = 0.0; /* otherwise the clip would save the huge ones */
  struct mo_training *training = make_training(&settings, NULL, NULL, 0);
  struct made_up *made_up = make_made_up(training);
  struct mo_training_report report;
  REQUIRE(advance(training, made_up, &report) == MO_OK);
  const struct mo_training *before = decoded(encoded(training));
  for (int kind = 0; kind < 6; kind++) {
    make_up(made_up, training, draw(training));
    if (kind < 4)
      made_up->gradient[kind == 3 ? 0 : made_up->n - 1] =
          (const double[]){NAN, INFINITY, -INFINITY, 1e300}[kind];
    for (int i = 0; i < 5; i++)
      if (kind == 4 || (kind == 5 && i < 2))
        made_up->outcomes[i] = (struct mo_outcome){.loss = INFINITY, .diverged_step = 3};
    if (kind == 5)
      made_up->counts.zeroed_robots = 3;
    REQUIRE(apply(training, made_up, &report) == MO_OK);
    CHECK(report.skipped && report.gradient_norm == 0.0 && report.bounded == 0);
    CHECK_INT(report.step, kind + 2);
    CHECK_INT(training->skipped, kind + 1);
    CHECK(same_weights(training, before));
    CHECK_INT(report.diverged, kind == 4 ? 5 : kind == 5 ? 2 : 0);
    CHECK(kind == 4   ? isnan(report.mean_loss)
          : kind == 5 ? fabs(report.mean_loss - 0.8) < 1e-15
                      : true);
  }
  REQUIRE(advance(training, made_up, &report) == MO_OK); /* and the training run continues */
  CHECK(!report.skipped && !same_weights(training, before));
}

static void reported(void)
{
  const struct mo_training_settings settings = small_settings(MO_TRAINING_PRETRAIN);
  struct mo_training *training = make_training(&settings, NULL, NULL, 0);
  struct made_up *made_up = make_made_up(training);
  struct mo_training_report report;
  CHECK_INT(apply(training, made_up, &report), MO_ERR_CONFLICT);
  REQUIRE(advance(training, made_up, &report) == MO_OK);
  CHECK_NEAR(report.mean_loss, 0.7, 1e-15);
  CHECK_NEAR(report.clipped_share, 20.0 / 5000.0, 1e-18);
  CHECK_NEAR(report.clipped_robots_share, 0.4, 1e-15);
  CHECK_INT(apply(training, made_up, &report), MO_ERR_CONFLICT);
  while (mo_training_step(training) < settings.n_steps)
    REQUIRE(advance(training, made_up, NULL) == MO_OK);
  const struct mo_robot *robots;
  CHECK_INT(mo_training_draw(training, NULL, NULL, &robots), MO_ERR_CONFLICT);
  CHECK_INT(apply(training, made_up, &report), MO_ERR_CONFLICT);
}

/* The highest rate, with weights near their limit pushed outward. */
static void bounded(void)
{
  struct mo_training_settings settings = small_settings(MO_TRAINING_FINETUNE);
  settings.learning.schedule = (struct mo_schedule){MO_SCHEDULE_CONSTANT, 1, 1, 1, 1, 1, 0};
  struct mo_training *training = finetuning(&settings, 3, 1.0F);
  struct made_up *made_up = make_made_up(training);
  float *weights = training->controller->parameters;
  weights[0] = MO_WEIGHT_LIMIT;
  weights[1] = -MO_WEIGHT_LIMIT;
  weights[2] = MO_WEIGHT_LIMIT;
  struct mo_training_report report;
  draw(training);
  memset(made_up->gradient, 0, made_up->n * sizeof(double));
  made_up->gradient[0] = -1e-3; /* up */
  made_up->gradient[1] = 1e-3;  /* down */
  made_up->gradient[2] = 1e-3;  /* down, into the bounds */
  REQUIRE(apply(training, made_up, &report) == MO_OK);
  CHECK(!report.skipped);
  CHECK_INT(report.bounded, 2);
  CHECK(weights[0] == MO_WEIGHT_LIMIT && weights[1] == -MO_WEIGHT_LIMIT &&
        weights[2] < MO_WEIGHT_LIMIT);
}

static const struct check_case cases[] = {
    {"20 steps agree with plain Adam in float64", against_plain},
    {"norms without overflow", norms},
    {"the norm clip", clip},
    {"a step with an invalid gradient is skipped", skipped},
    {"the report of a step, and the order of calls", reported},
    {"weights stay within their limit", bounded},
};
CHECK_MAIN(cases)
