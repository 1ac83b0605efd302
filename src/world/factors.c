/* factors.c: see factors.h. */
#include "world/factors.h"

#include <stdlib.h>

#include <morpho/random.h>

/* name in JSON and in both structs, lower bound, what it multiplies */
#define FACTORS(ROW)                                                                               \
  ROW(stiffness, MO_FACTOR_MIN, "stiffness_n_per_m")                                               \
  ROW(mass, MO_FACTOR_MIN, "mass_kg")                                                              \
  ROW(drag, 0, "drag_per_s")                                                                       \
  ROW(gravity, 0, "gravity_m_per_s2")                                                              \
  ROW(actuation, 0, "actuation")                                                                   \
  ROW(friction, 0, "friction")

#define ONE(name, least, constant)                                                                 \
  {#name,                                                                                          \
   MO_FIELD_NUMBER,                                                                                \
   0,                                                                                              \
   offsetof(struct mo_factors, name),                                                              \
   .min = (least),                                                                                 \
   .max = MO_FACTOR_MAX,                                                                           \
   .since = 7,                                                                                     \
   .unit = "",                                                                                     \
   .help = "times " constant},
#define RANGE(name, least, constant)                                                               \
  {#name,                                                                                          \
   MO_FIELD_NUMBERS,                                                                               \
   0,                                                                                              \
   offsetof(struct mo_factor_ranges, name),                                                        \
   .n = 2,                                                                                         \
   .min = (least),                                                                                 \
   .max = MO_FACTOR_MAX,                                                                           \
   .unit = "",                                                                                     \
   .help = "lowest and highest factor of " constant},
static const struct mo_field factor_rows[] = {FACTORS(ONE)};
static const struct mo_field range_rows[] = {FACTORS(RANGE)};
#undef ONE
#undef RANGE
const struct mo_fields mo_factor_fields = MO_FIELDS(factor_rows);
const struct mo_fields mo_factor_range_fields = MO_FIELDS(range_rows);

static double *factor_at(struct mo_factors *factors, size_t k)
{
  return (double *)(void *)((char *)factors + factor_rows[k].offset);
}

static const double *range_at(const struct mo_factor_ranges *ranges, size_t k)
{
  return (const double *)(const void *)((const char *)ranges + range_rows[k].offset);
}

struct mo_factors mo_factors_ones(void)
{
  return (struct mo_factors){1, 1, 1, 1, 1, 1, 1};
}

struct mo_factor_ranges mo_factors_constant(void)
{
  return (struct mo_factor_ranges){false, {1, 1}, {1, 1}, {1, 1}, {1, 1}, {1, 1}, {1, 1}};
}

struct mo_factors mo_factors_simplest(const struct mo_factors *factors)
{
  const struct mo_factors ones = mo_factors_ones(), none = {0};
  return mo_fields_equal(&mo_factor_fields, factors, &ones) ? none : *factors;
}

int mo_factors_check(const struct mo_factors *factors)
{
  const struct mo_factors zeros = {0};
  if (factors->given == 0)
    return mo_fields_equal(&mo_factor_fields, factors, &zeros) ? MO_OK : MO_ERR_INVALID;
  if (factors->given != 1 || mo_factors_simplest(factors).given == 0)
    return MO_ERR_INVALID;
  return mo_fields_check(&mo_factor_fields, "factors", factors, NULL);
}

struct mo_factors mo_factors_times(const struct mo_factors *a, const struct mo_factors *b)
{
  struct mo_factors product = *a, by = *b;
  if (a->given == 0)
    return *b;
  if (b->given == 0)
    return *a;
  for (size_t k = 0; k < mo_factor_fields.n; k++)
    *factor_at(&product, k) *= *factor_at(&by, k);
  return mo_factors_simplest(&product);
}

/* ---- ranges ---- */

bool mo_factors_vary(const struct mo_factor_ranges *ranges)
{
  const struct mo_factor_ranges constant = mo_factors_constant();
  return ranges->given && !mo_fields_equal(&mo_factor_range_fields, ranges, &constant);
}

void mo_factors_ends(const struct mo_factor_ranges *ranges, struct mo_factors ends[2])
{
  for (int end = 0; end < 2; end++) {
    ends[end] = mo_factors_ones();
    for (size_t k = 0; k < mo_factor_fields.n && ranges->given; k++)
      *factor_at(&ends[end], k) = range_at(ranges, k)[end];
    ends[end] = mo_factors_simplest(&ends[end]);
  }
}

int mo_factor_ranges_check(const char *above, const struct mo_factor_ranges *ranges,
                           struct mo_message *message)
{
  const int error =
      ranges->given ? mo_fields_check(&mo_factor_range_fields, above, ranges, message) : MO_OK;
  for (size_t k = 0; k < mo_factor_range_fields.n && error == MO_OK && ranges->given; k++) {
    const double *range = range_at(ranges, k);
    if (range[0] > range[1])
      return mo_fail(message, MO_ERR_RANGE, "%s.%s must be [lowest, highest], got [%.9g, %.9g]",
                     above, range_rows[k].name, range[0], range[1]);
  }
  return error;
}

/* Draws factor k of all n. part: (n) memory for a permutation. */
static void draw_one(const double range[2], struct mo_random *random, size_t k, uint32_t n,
                     uint32_t *part, struct mo_factors *factors)
{
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t at = mo_random_below(random, i + 1);
    if (at < i)
      part[i] = part[at];
    part[at] = i;
  }
  for (uint32_t i = 0; i < n; i++) {
    const double share = (part[i] + mo_random_uniform(random)) / n;
    *factor_at(&factors[i], k) = range[0] + (range[1] - range[0]) * share;
  }
}

int mo_factors_draw(const struct mo_factor_ranges *ranges, uint64_t seed, uint32_t step, uint32_t n,
                    struct mo_factors *factors)
{
  uint32_t *part = malloc((n > 0 ? n : 1) * sizeof(*part));
  if (part == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n; i++)
    factors[i] = mo_factors_ones();
  for (size_t k = 0; k < mo_factor_range_fields.n && ranges->given; k++) {
    const double *range = range_at(ranges, k);
    struct mo_random random;
    mo_random_init(&random, seed, MO_PURPOSE_FACTORS, step, k);
    if (range[0] != 1 || range[1] != 1)
      draw_one(range, &random, k, n, part, factors);
  }
  for (uint32_t i = 0; i < n; i++)
    factors[i] = mo_factors_simplest(&factors[i]);
  free(part);
  return MO_OK;
}
