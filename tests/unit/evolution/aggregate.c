/* aggregate.c: scores from losses: values by hand and by definition, and bounds to the last bit. */
#include "../make.h"

#include <morpho/evolution.h>

enum { MOST = MO_RACE_ENVIRONMENTS_MAX, ROUNDS = 200000 };

static struct mo_aggregate quantile(double level)
{
  return (struct mo_aggregate){.kind = MO_AGGREGATE_QUANTILE, .level = level};
}

static struct mo_aggregate cvar(double level)
{
  return (struct mo_aggregate){.kind = MO_AGGREGATE_CVAR, .level = level};
}

static struct mo_aggregate mean_sd(double weight)
{
  return (struct mo_aggregate){.kind = MO_AGGREGATE_MEAN_SD, .weight = weight};
}

static double score(struct mo_aggregate aggregate, const double *losses, uint32_t n)
{
  return mo_aggregate_score(&aggregate, losses, n);
}

static double draw(struct mo_random *random, uint32_t sort)
{
  const double u = mo_random_uniform(random);
  return sort % 3 == 1 ? 0.125 * floor(4 * u) : sort % 3 == 2 ? (float)u : exp(8 * u - 6);
}

/* ---- values ---- */

static void by_hand(void)
{
  static const double five[] = {0.5, 0.125, 1, 0.25, 4};      /* ascending: 1/8, 1/4, 1/2, 1, 4 */
  static const double ten[] = {3, 1, 4, 1, 5, 9, 2, 6, 5, 3}; /* 1 1 2 3 3 4 5 5 6 9 */
  CHECK(score(quantile(0), five, 5) == 0.125 && score(quantile(1), five, 5) == 4);
  CHECK(score(quantile(0.5), five, 5) == 0.5 && score(quantile(0.25), five, 5) == 0.25);
  CHECK(score(quantile(0.875), five, 5) == 2.5); /* halfway from 1 to 4 */
  CHECK(score(quantile(0.5), ten, 10) == 3.5);
  CHECK_NEAR(score(quantile(0.9), ten, 10), 6.3, 1e-14); /* a tenth of the way from 6 to 9 */
  CHECK(score(cvar(0), five, 5) == 1.175 && score(cvar(1), five, 5) == 4);
  CHECK(score(cvar(0.5), five, 5) == 2.1); /* (4 + 1 + 0.5 · 0.5) / 2.5 */
  CHECK(score(cvar(0.8), five, 5) == 4 && score(cvar(0.9), five, 5) == 4);
  CHECK(score(cvar(0.9), ten, 10) == 9 && score(cvar(0.8), ten, 10) == 7.5);
  CHECK_NEAR(score(cvar(0.75), ten, 10), 7, 1e-14); /* (9 + 6 + 5 / 2) / 2.5 */
  CHECK_NEAR(score(mean_sd(0), ten, 10), 3.9, 1e-14);
  CHECK_NEAR(score(mean_sd(1), ten, 10), 3.9 + sqrt(54.9 / 9), 1e-14);
  CHECK_NEAR(score(mean_sd(2), (const double[]){1, 3}, 2), 2 + 2 * sqrt(2), 1e-14);
}

static void one_loss(void)
{
  const double one[] = {0.3};
  for (int i = 0; i <= 10; i++)
    CHECK(score(quantile(0.1 * i), one, 1) == 0.3 && score(cvar(0.1 * i), one, 1) == 0.3);
  CHECK(score(mean_sd(3), one, 1) == 0.3);
}

/* The sum in the order of the environments, divided by their number, as it always was. */
static void mean_bits(void)
{
  static const double losses[] = {0.1, 0.7, 1e-9, 0.3, 123.456, 0.2, 0.3};
  const struct mo_aggregate mean = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO).aggregate;
  double sum = 0;
  CHECK_INT(mean.kind, MO_AGGREGATE_MEAN);
  for (uint32_t n = 1; n <= 7; n++) {
    sum += losses[n - 1];
    CHECK(score(mean, losses, n) == sum / n && mo_race_score(losses, n) == sum / n);
  }
  CHECK(score(mean, losses, 7) == 0x1.1dd7a009668ffp+4);
  CHECK(score(mean, (const double[]){NAN, 1, NAN, 2}, 4) == 0.75);
}

static void diverged(void)
{
  static const double losses[] = {0.1, INFINITY, 0.2, NAN};
  for (int i = 0; i <= 4; i++) {
    CHECK(score(quantile(0.25 * i), losses, 4) == INFINITY);
    CHECK(score(cvar(0.25 * i), losses, 4) == INFINITY);
    CHECK(score(mean_sd(i), losses, 4) == INFINITY);
  }
  CHECK(score((struct mo_aggregate){0}, losses, 4) == INFINITY);
}

/* Draws losses with equal bits in every order of the environments. */
static uint32_t draw_losses(struct mo_random *random, uint32_t round, double losses[MOST])
{
  const uint32_t n = 1 + mo_random_below(random, MOST);
  for (uint32_t k = 0; k < n; k++)
    losses[k] = draw(random, round);
  return n;
}

/* Rockafellar and Uryasev's definition: cvar is the minimum over c of c + mean(max(x − c, 0)) /
 * (1 − level), which one of the losses attains. The value at risk, a quantile, is not above it. */
static void by_definition(void)
{
  for (uint32_t round = 0; round < 3000; round++) {
    struct mo_random random;
    double losses[MOST], least = INFINITY;
    mo_random_init(&random, 6, MO_PURPOSE_CHECK, round, 0);
    const uint32_t n = draw_losses(&random, round, losses);
    const double level = round % 5 == 0 ? 0.9 : mo_random_uniform(&random);
    for (uint32_t i = 0; i < n; i++) {
      double above = 0;
      for (uint32_t k = 0; k < n; k++)
        above += fmax(losses[k] - losses[i], 0);
      least = fmin(least, losses[i] + above / n / (1 - level));
    }
    CHECK_NEAR(score(cvar(level), losses, n), least, 1e-9 * least);
    CHECK(score(quantile(level), losses, n) <= score(cvar(level), losses, n) * (1 + 1e-12));
    CHECK_NEAR(score(cvar(0), losses, n), mo_race_score(losses, n), 1e-12 * least);
  }
}

static void no_order(void)
{
  for (uint32_t round = 0; round < 3000; round++) {
    struct mo_random random;
    double losses[MOST], turned[MOST];
    mo_random_init(&random, 7, MO_PURPOSE_CHECK, round, 0);
    const uint32_t n = draw_losses(&random, round, losses);
    const uint32_t by = mo_random_below(&random, n);
    const double level = mo_random_uniform(&random);
    for (uint32_t k = 0; k < n; k++)
      turned[k] = losses[(k + by) % n];
    CHECK(score(quantile(level), losses, n) == score(quantile(level), turned, n));
    CHECK(score(cvar(level), losses, n) == score(cvar(level), turned, n));
  }
}

/* ---- bounds ---- */

/* Raises some losses, often by the least step. */
static void raise_some(struct mo_random *random, uint32_t n, const double *losses, double *raised)
{
  const double share = mo_random_uniform(random);
  for (uint32_t k = 0; k < n; k++) {
    const double u = mo_random_uniform(random);
    raised[k] = u > share          ? losses[k]
                : u < 0.8 * share  ? nextafter(losses[k], INFINITY)
                : u < 0.95 * share ? losses[k] + draw(random, n)
                                   : INFINITY;
  }
}

/* No score falls when losses rise, down to the last bit, and missing losses give a lower bound. */
static void monotone(void)
{
  uint32_t n_equal = 0, n_greater = 0;
  for (uint32_t round = 0; round < ROUNDS; round++) {
    struct mo_random random;
    double losses[MOST], raised[MOST], known[MOST];
    mo_random_init(&random, 8, MO_PURPOSE_CHECK, round, 0);
    const uint32_t n = draw_losses(&random, round, losses);
    const double level = round % 4 == 0 ? 0.9 : mo_random_uniform(&random);
    const struct mo_aggregate all[] = {{0}, quantile(level), cvar(level)};
    raise_some(&random, n, losses, raised);
    for (uint32_t k = 0; k < n; k++)
      known[k] = mo_random_below(&random, 2) ? losses[k] : NAN;
    for (int i = 0; i < 3; i++) {
      const double before = score(all[i], losses, n), after = score(all[i], raised, n);
      CHECK(mo_aggregate_is_monotone(&all[i]));
      CHECK(before <= after);
      CHECK(score(all[i], known, n) <= before);
      n_equal += before == after;
      n_greater += before < after;
    }
  }
  printf("# %u equal, %u greater\n", n_equal, n_greater);
  CHECK(n_equal > ROUNDS / 10 && n_greater > ROUNDS / 10);
}

static void not_monotone(void)
{
  const struct mo_aggregate deviates = mean_sd(1);
  struct mo_campaign_settings settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO);
  CHECK(!mo_aggregate_is_monotone(&deviates));
  CHECK(score(deviates, (const double[]){0, 1}, 2) > score(deviates, (const double[]){1, 1}, 2));
  CHECK(mo_race_is_possible(&settings));
  for (int kind = 0; mo_aggregate_words[kind] != NULL; kind++) {
    settings.aggregate.kind = (enum mo_aggregate_kind)kind;
    CHECK(mo_race_is_possible(&settings) == (kind != MO_AGGREGATE_MEAN_SD));
  }
}

/* ---- settings ---- */

static void bounds(void)
{
  struct mo_campaign_settings settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO);
  struct mo_message message;
  CHECK(settings.aggregate.level == 0.9 && settings.aggregate.weight == 1);
  settings.aggregate = (struct mo_aggregate){MO_AGGREGATE_CVAR, 1, 0};
  CHECK_OK(mo_campaign_settings_check(&settings, &message));
  settings.aggregate.level = 1.5;
  CHECK_INT(mo_campaign_settings_check(&settings, &message), MO_ERR_RANGE);
  CHECK_SAYS(message, "aggregate.level must be at least 0 and at most 1, got 1.5");
  settings.aggregate = (struct mo_aggregate){MO_AGGREGATE_MEAN_SD, 0.9, -1};
  CHECK_INT(mo_campaign_settings_check(&settings, &message), MO_ERR_RANGE);
  CHECK_SAYS(message, "aggregate.weight must be at least 0");
  settings.aggregate = (struct mo_aggregate){(enum mo_aggregate_kind)4, 0.9, 1};
  CHECK_INT(mo_campaign_settings_check(&settings, &message), MO_ERR_INVALID);
  CHECK_SAYS(message, "\"mean\", \"quantile\", \"cvar\" or \"mean-sd\"");
}

static const struct check_case cases[] = {
    {"values by hand", by_hand},
    {"one loss", one_loss},
    {"the mean has the bits that it always had", mean_bits},
    {"diverged rollouts", diverged},
    {"cvar by its definition", by_definition},
    {"the order of the environments", no_order},
    {"monotone to the last bit", monotone},
    {"a mean with a deviation is not monotone", not_monotone},
    {"bounds of the settings", bounds},
};
CHECK_MAIN(cases)
