/* re_evaluation.c: see re_evaluation.h. */
#include "store/re_evaluation.h"

#include <math.h>

#include <morpho/evolution.h>

#include "certificate/statistics.h"

/* ---- settings ---- */

struct mo_re_evaluation mo_re_evaluation_defaults(void)
{
  return (struct mo_re_evaluation){.every = 10, .environments = 64, .designs = 10};
}

#define AT(member) offsetof(struct mo_re_evaluation, member)
static const struct mo_field rows[] = {
    {"every", MO_FIELD_COUNT, 0, AT(every), .min = 1, .max = MO_GENERATIONS_MAX,
     .unit = "generations", .help = "generations from one re-evaluation to the next"},
    {"environments", MO_FIELD_COUNT, 0, AT(environments), .min = 2,
     .max = MO_CERTIFICATE_HELD_OUT_MAX, .unit = "environments",
     .help = "number of fresh worlds, drawn for each re-evaluation; for a task of the suite, its "
             "held-out ones"},
    {"designs", MO_FIELD_COUNT, 0, AT(designs), .min = 1, .max = MO_ELITE_BEST_MAX,
     .unit = "designs", .help = "best designs that are re-evaluated, in addition to the champions"},
};
#undef AT
const struct mo_fields mo_re_evaluation_fields = MO_FIELDS(rows);

static void read_re_evaluation(struct mo_json *json, void *value)
{
  const unsigned before = json->faults->n;
  struct mo_re_evaluation read = mo_re_evaluation_defaults();
  if (mo_json_peek(json) == MO_JSON_NULL) {
    mo_json_skip(json);
    read.every = 0;
  } else {
    mo_fields_read(json, &mo_re_evaluation_fields, &read);
  }
  if (!json->stop && json->faults->n == before)
    *(struct mo_re_evaluation *)value = read;
}

static void write_re_evaluation(struct mo_text *text, const void *value)
{
  if (((const struct mo_re_evaluation *)value)->every > 0)
    mo_fields_write_object(text, &mo_re_evaluation_fields, value);
  else
    mo_text_add(text, "null");
}

const struct mo_field_own mo_re_evaluation_field = {.read = read_re_evaluation,
                                                    .write = write_re_evaluation};

/* ---- results ---- */

struct mo_interval mo_held_out_interval(const struct mo_re_evaluated *held_out)
{
  const double error = held_out->standard_error;
  if (held_out->worlds < 2 || !isfinite(held_out->mean) || !isfinite(error))
    return MO_UNKNOWN_INTERVAL;
  return mo_mean_interval(&(struct mo_mean){held_out->mean, error * error, held_out->worlds}, 1);
}

static const struct mo_re_evaluated *find(const struct mo_re_evaluated *results, uint32_t n,
                                          uint32_t number)
{
  for (uint32_t i = 0; i < n; i++)
    if (results[i].number == number)
      return &results[i];
  return NULL;
}

struct mo_held_out_summary mo_held_out_summary(const struct mo_re_evaluation *settings,
                                               const struct mo_re_evaluated *results, uint32_t n,
                                               const uint32_t *numbers, const double *scores,
                                               uint32_t n_best)
{
  struct mo_held_out_summary summary = {.designs = n,
                                        .champion = {.mean = NAN, .standard_error = NAN},
                                        .champion_interval = MO_UNKNOWN_INTERVAL,
                                        .top_mean = NAN,
                                        .top_score = NAN};
  double sum = 0, sum_of_scores = 0;
  uint32_t counted = 0;
  for (uint32_t i = 0; i < n; i++) {
    summary.worlds = results[i].worlds;
    summary.rollouts += results[i].worlds;
    summary.diverged += results[i].diverged;
  }
  for (uint32_t i = 0; i < n_best && i < settings->designs; i++) {
    const struct mo_re_evaluated *one = find(results, n, numbers[i]);
    if (one == NULL)
      continue;
    if (i == 0) {
      summary.champion = *one;
      summary.champion_interval = mo_held_out_interval(one);
    }
    if (!isfinite(one->mean) || !isfinite(scores[i]))
      continue;
    sum += one->mean;
    sum_of_scores += scores[i];
    counted++;
  }
  if (counted > 0) {
    summary.top_mean = sum / counted;
    summary.top_score = sum_of_scores / counted;
  }
  return summary;
}
