/* factors.c: see factors.h. */
#include "world/factors.h"

#include <math.h>
#include <stdlib.h>

#include <morpho/random.h>

/* name in JSON and in both structs, lower bound, what the factor multiplies */
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
#define AT(member) offsetof(struct mo_factor_ranges, member)
static const struct mo_field range_rows[] = {
    FACTORS(RANGE) /* then the ranges of what is added */
    {"drop_m", MO_FIELD_NUMBERS, 0, AT(drop_m), .n = 2, .max = MO_DROP_MAX_M, .unit = "m",
     .help = "lowest and highest extra lift at the start"},
    {"slope_degrees", MO_FIELD_NUMBERS, 0, AT(slope_degrees), .n = 2, .max = MO_VARY_DEGREES_MAX,
     .unit = "degrees", .help = "lowest and highest slope of the ground, in any direction"},
};
#undef ONE
#undef RANGE
#undef AT
enum { N_FACTORS = sizeof(factor_rows) / sizeof(*factor_rows), DROP = N_FACTORS, SLOPE, DIRECTION };
const struct mo_fields mo_factor_fields = MO_FIELDS(factor_rows);
const struct mo_fields mo_factor_range_fields = {range_rows, N_FACTORS, NULL};
const struct mo_fields mo_vary_fields = MO_FIELDS(range_rows);

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
  return (struct mo_factor_ranges){false,  {1, 1}, {1, 1}, {1, 1}, {1, 1},
                                   {1, 1}, {1, 1}, {0, 0}, {0, 0}};
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
  return ranges->given && !mo_fields_equal(&mo_vary_fields, ranges, &constant);
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
      ranges->given ? mo_fields_check(&mo_vary_fields, above, ranges, message) : MO_OK;
  for (size_t k = 0; k < mo_vary_fields.n && error == MO_OK && ranges->given; k++) {
    const double *range = range_at(ranges, k);
    if (range[0] > range[1])
      return mo_fail(message, MO_ERR_RANGE, "%s.%s must be [lowest, highest], got [%.9g, %.9g]",
                     above, range_rows[k].name, range[0], range[1]);
  }
  return error;
}

static void read_vary(struct mo_json *json, void *value)
{
  struct mo_factor_ranges *ranges = value;
  if (mo_json_peek(json) == MO_JSON_NULL) {
    *ranges = mo_factors_constant();
    mo_json_skip(json);
    return;
  }
  ranges->given = true;
  mo_fields_read(json, &mo_vary_fields, ranges);
}

static void write_vary(struct mo_text *text, const void *value)
{
  const struct mo_factor_ranges *ranges = value;
  if (!ranges->given) {
    mo_text_add(text, "null");
    return;
  }
  mo_text_object(text);
  mo_fields_write(text, &mo_factor_range_fields, ranges);
  for (size_t k = DROP; k <= SLOPE; k++) {
    const struct mo_fields one = {&range_rows[k], 1, NULL};
    if (range_at(ranges, k)[0] != 0 || range_at(ranges, k)[1] != 0)
      mo_fields_write(text, &one, ranges);
  }
  mo_text_add(text, "}");
}

static int check_vary(const char *name, const void *value, struct mo_message *message)
{
  return mo_factor_ranges_check(name, value, message);
}

const struct mo_field_own mo_vary_own = {read_vary, write_vary, check_vary};

/* ---- drawing ---- */

/* The destination of drawn numbers: one in each of n structs of `stride` bytes. */
struct column {
  double *first;
  size_t stride;
  uint32_t n;
};

static double *at(const struct column *to, uint32_t i)
{
  return (double *)(void *)((char *)to->first + i * to->stride);
}

/* part: (n) memory for a permutation. */
static void draw_one(const double range[2], struct mo_random random, uint32_t *part,
                     const struct column *to)
{
  for (uint32_t i = 0; i < to->n; i++) {
    const uint32_t other = mo_random_below(&random, i + 1);
    if (other < i)
      part[i] = part[other];
    part[other] = i;
  }
  for (uint32_t i = 0; i < to->n; i++) {
    const double share = (part[i] + mo_random_uniform(&random)) / to->n;
    *at(to, i) = range[0] + (range[1] - range[0]) * share;
  }
}

static struct mo_random stream_of(uint64_t seed, uint32_t step, size_t k)
{
  struct mo_random random;
  mo_random_init(&random, seed, MO_PURPOSE_FACTORS, step, k);
  return random;
}

/* Draws n factors, each in a struct of `stride` bytes. */
static void draw_factors(const struct mo_factor_ranges *ranges, uint64_t seed, uint32_t step,
                         uint32_t n, uint32_t *part, struct mo_factors *factors, size_t stride)
{
  const struct column to = {(double *)(void *)factors, stride, n};
  for (uint32_t i = 0; i < n; i++)
    *(struct mo_factors *)(void *)at(&to, i) = mo_factors_ones();
  for (size_t k = 0; k < N_FACTORS && ranges->given; k++) {
    const double *range = range_at(ranges, k);
    const struct column of = {factor_at(factors, k), stride, n};
    if (range[0] != 1 || range[1] != 1)
      draw_one(range, stream_of(seed, step, k), part, &of);
  }
  for (uint32_t i = 0; i < n; i++) {
    struct mo_factors *drawn = (struct mo_factors *)(void *)at(&to, i);
    *drawn = mo_factors_simplest(drawn);
  }
}

int mo_factors_draw(const struct mo_factor_ranges *ranges, uint64_t seed, uint32_t step, uint32_t n,
                    struct mo_factors *factors)
{
  uint32_t *part = malloc((n > 0 ? n : 1) * sizeof(*part));
  if (part == NULL)
    return MO_ERR_NO_MEMORY;
  draw_factors(ranges, seed, step, n, part, factors, sizeof(*factors));
  free(part);
  return MO_OK;
}

int mo_variations_draw(const struct mo_factor_ranges *ranges, uint64_t seed, uint32_t step,
                       uint32_t n, struct mo_variation *variations)
{
  static const double circle[2] = {0, 2 * M_PI};
  const size_t stride = sizeof(*variations);
  const bool drops = ranges->given && ranges->drop_m[1] > 0;
  const bool slopes = ranges->given && ranges->slope_degrees[1] > 0;
  uint32_t *part = malloc((n > 0 ? n : 1) * sizeof(*part));
  if (part == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n; i++)
    variations[i] = (struct mo_variation){.drop_m = 0};
  draw_factors(ranges, seed, step, n, part, &variations->factors, stride);
  if (drops)
    draw_one(ranges->drop_m, stream_of(seed, step, DROP), part,
             &(struct column){&variations->drop_m, stride, n});
  if (slopes) {
    draw_one(ranges->slope_degrees, stream_of(seed, step, SLOPE), part,
             &(struct column){&variations->slope_degrees, stride, n});
    draw_one(circle, stream_of(seed, step, DIRECTION), part,
             &(struct column){&variations->toward_rad, stride, n});
  }
  free(part);
  return MO_OK;
}
