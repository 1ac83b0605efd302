/* wire_results.c: encodes and decodes results. Values are checked here as far as possible without
 * the lease that they belong to. */
#include "fleet/wire.h"

#include <math.h>

#include "fleet/wire_codec.h"
#include "world/measures.h"

struct result {
  struct mo_lease_id id;
  uint32_t state, n_rows;
  double busy_s, wall_s;
};
_Static_assert(sizeof(struct result) == 40 && sizeof(struct mo_gradient_counts) == 56,
               "without padding");

#define DONE_WITH_GRADIENT 3u /* states */
#define DONE_WITH_MEASURES 5u
#define ROW_BYTES          (sizeof(double) + sizeof(uint32_t))

/* Precedes the measures of a result. */
struct measures {
  uint32_t n, zero;
};

/* MO_RESULT_DONE needs at least one row; other states have none. */
static bool rows_fit(enum mo_wire_state state, uint32_t n_rows, uint32_t n_parameters,
                     bool has_measures)
{
  if (has_measures &&
      (state != MO_RESULT_DONE || n_rows > MO_WIRE_MEASURED_MAX || n_parameters > 0))
    return false;
  if (n_parameters > 0)
    return state == MO_RESULT_DONE && n_rows >= 1 && n_rows <= MO_GRADIENT_SHARD &&
           n_parameters <= MO_WIRE_PARAMETERS_MAX;
  return state == MO_RESULT_DONE ? n_rows >= 1 && n_rows <= MO_WIRE_ROWS_MAX : n_rows == 0;
}

/* All measures without a value have the same bits. */
static void put_measures(struct codec *codec, const struct mo_wire_result *result)
{
  for (uint32_t row = 0; row < result->n_rows; row++)
    for (unsigned m = 0; m < MO_MEASURES; m++) {
      const double value = result->measures[row][m], none = NAN;
      put(codec, isnan(value) ? &none : &value, sizeof(value));
    }
}

int mo_wire_put_results(const struct mo_wire_results *results, uint8_t **bytes, size_t *size)
{
  struct codec codec = {.size = sizeof(struct header)};
  if (results->n > MO_WIRE_RESULTS_MAX)
    return MO_ERR_LIMIT;
  for (uint32_t i = 0; i < results->n; i++) {
    const struct mo_wire_result *result = &results->items[i];
    const bool has_measures = result->n_rows > 0 && result->measures != NULL;
    if (!rows_fit(result->state, result->n_rows, result->n_parameters, has_measures))
      return MO_ERR_LIMIT;
    codec.size += sizeof(struct result) + result->n_rows * ROW_BYTES;
    if (result->n_parameters > 0)
      codec.size += sizeof(uint64_t) + sizeof(result->counts) +
                    result->n_parameters * sizeof(*result->d_parameters);
    if (has_measures)
      codec.size += sizeof(struct measures) + result->n_rows * sizeof(*result->measures);
  }
  int error = open_message(WIRE_RESULTS, results->n, &codec);
  if (error != MO_OK)
    return error;
  for (uint32_t i = 0; i < results->n; i++) {
    const struct mo_wire_result *result = &results->items[i];
    const bool has_measures = result->n_rows > 0 && result->measures != NULL;
    const struct measures measures = {.n = MO_MEASURES};
    const struct result head = {.id = result->id,
                                .state = result->n_parameters > 0 ? DONE_WITH_GRADIENT
                                         : has_measures           ? DONE_WITH_MEASURES
                                                                  : (uint32_t)result->state,
                                .n_rows = result->n_rows,
                                .busy_s = result->busy_s,
                                .wall_s = result->wall_s};
    put(&codec, &head, sizeof(head));
    if (result->n_rows > 0) {
      put(&codec, result->losses, result->n_rows * sizeof(double));
      put(&codec, result->diverged_steps, result->n_rows * sizeof(uint32_t));
    }
    if (result->n_parameters > 0) {
      const uint64_t n = result->n_parameters;
      put(&codec, &n, sizeof(n));
      put(&codec, &result->counts, sizeof(result->counts));
      put(&codec, result->d_parameters, n * sizeof(double));
    }
    if (has_measures) {
      put(&codec, &measures, sizeof(measures));
      put_measures(&codec, result);
    }
  }
  *bytes = codec.to;
  *size = codec.at;
  return MO_OK;
}

/* A rollout either has a finite loss, or diverged at some step. */
static bool is_row(double loss, uint32_t diverged_step)
{
  return diverged_step == 0 ? isfinite(loss) && !signbit(loss)
                            : isinf(loss) && loss > 0 && diverged_step <= MO_STEPS_MAX;
}

static bool is_time(double seconds)
{
  return isfinite(seconds) && !signbit(seconds);
}

static bool counts_are_possible(const struct mo_gradient_counts *counts, uint32_t n_rows)
{
  return counts->robots == n_rows && counts->steps <= (uint64_t)n_rows * MO_STEPS_MAX &&
         counts->clipped_steps <= counts->steps && counts->clipped_robots <= n_rows &&
         counts->zeroed_robots <= n_rows && counts->diverged_robots <= n_rows &&
         isfinite(counts->largest) && !signbit(counts->largest);
}

static int get_sum(struct codec *codec, struct mo_wire_result *result, uint32_t i,
                   struct mo_message *message)
{
  uint64_t n = 0;
  if (!get(codec, &n, sizeof(n)) || !get(codec, &result->counts, sizeof(result->counts)))
    return cut_off(message, "result", i);
  if (n < 1 || n > MO_WIRE_PARAMETERS_MAX || result->n_rows > MO_GRADIENT_SHARD ||
      !counts_are_possible(&result->counts, result->n_rows))
    return mo_fail(message, MO_ERR_FORMAT,
                   "result %u: a gradient of %u robots and %llu parameters has impossible counts",
                   i, result->n_rows, (unsigned long long)n);
  result->d_parameters = malloc(n * sizeof(*result->d_parameters));
  if (result->d_parameters == NULL)
    return MO_ERR_NO_MEMORY;
  result->n_parameters = (uint32_t)n;
  if (!get(codec, result->d_parameters, n * sizeof(*result->d_parameters)))
    return cut_off(message, "result", i);
  for (uint32_t k = 0; k < n; k++)
    if (!isfinite(result->d_parameters[k]))
      return mo_fail(message, MO_ERR_FORMAT, "result %u: number %u of its sum is not finite", i, k);
  return MO_OK;
}

/* Returns whether a measure is a whole number of its steps, as the store keeps it, or has no
 * value. */
static bool is_measure(unsigned m, double value)
{
  const double none = NAN;
  uint64_t bits[2];
  memcpy(&bits[0], &value, sizeof(value));
  memcpy(&bits[1], &none, sizeof(none));
  return isnan(value) ? bits[0] == bits[1] : mo_measure_is_round(m, value);
}

static int get_measures(struct codec *codec, struct mo_wire_result *result, uint32_t i,
                        struct mo_message *message)
{
  struct measures head;
  if (!get(codec, &head, sizeof(head)))
    return cut_off(message, "result", i);
  if (head.n != MO_MEASURES || head.zero != 0)
    return mo_fail(message, MO_ERR_FORMAT, "result %u: must have %d measures for each row, got %u",
                   i, MO_MEASURES, head.n);
  result->measures = malloc(result->n_rows * sizeof(*result->measures));
  if (result->measures == NULL)
    return MO_ERR_NO_MEMORY;
  if (!get(codec, result->measures, result->n_rows * sizeof(*result->measures)))
    return cut_off(message, "result", i);
  for (uint32_t row = 0; row < result->n_rows; row++)
    for (unsigned m = 0; m < MO_MEASURES; m++) {
      const double value = result->measures[row][m];
      if (!is_measure(m, value))
        return mo_fail(message, MO_ERR_FORMAT, "result %u, row %u: %s is %g, which is not rounded",
                       i, row, mo_measure_info[m].name, value);
      if (!isnan(value) && result->diverged_steps[row] > 0)
        return mo_fail(message, MO_ERR_FORMAT,
                       "result %u, row %u: a rollout that diverged has no measures", i, row);
    }
  return MO_OK;
}

static int get_result(struct codec *codec, struct mo_wire_result *result, uint32_t i,
                      struct mo_message *message)
{
  struct result head;
  if (!get(codec, &head, sizeof(head)))
    return cut_off(message, "result", i);
  const bool has_gradient = head.state == DONE_WITH_GRADIENT;
  const bool has_measures = head.state == DONE_WITH_MEASURES;
  if (has_gradient || has_measures)
    head.state = MO_RESULT_DONE;
  if (head.state > MO_RESULT_UNSUPPORTED)
    return mo_fail(message, MO_ERR_FORMAT, "result %u: unknown state %u", i, head.state);
  if (!rows_fit((enum mo_wire_state)head.state, head.n_rows, 0, has_measures))
    return mo_fail(message, MO_ERR_FORMAT, "result %u: state %u cannot have %u rows", i, head.state,
                   head.n_rows);
  if (!is_time(head.busy_s) || !is_time(head.wall_s))
    return mo_fail(message, MO_ERR_FORMAT, "result %u: times must be finite and at least 0", i);
  result->id = head.id;
  result->state = (enum mo_wire_state)head.state;
  result->n_rows = head.n_rows;
  result->busy_s = head.busy_s;
  result->wall_s = head.wall_s;
  if (head.n_rows == 0)
    return MO_OK;
  result->losses = malloc(head.n_rows * sizeof(*result->losses));
  result->diverged_steps = malloc(head.n_rows * sizeof(*result->diverged_steps));
  if (result->losses == NULL || result->diverged_steps == NULL)
    return MO_ERR_NO_MEMORY;
  if (!get(codec, result->losses, head.n_rows * sizeof(double)) ||
      !get(codec, result->diverged_steps, head.n_rows * sizeof(uint32_t)))
    return cut_off(message, "result", i);
  for (uint32_t row = 0; row < head.n_rows; row++)
    if (!is_row(result->losses[row], result->diverged_steps[row]))
      return mo_fail(message, MO_ERR_FORMAT,
                     "result %u, row %u: loss %g contradicts divergence step %u", i, row,
                     result->losses[row], result->diverged_steps[row]);
  return has_gradient   ? get_sum(codec, result, i, message)
         : has_measures ? get_measures(codec, result, i, message)
                        : MO_OK;
}

int mo_wire_get_results(const uint8_t *bytes, size_t size, struct mo_wire_results *results,
                        struct mo_message *message)
{
  struct codec codec = {.from = bytes, .size = size};
  uint32_t n = 0;
  memset(results, 0, sizeof(*results));
  int error = read_header(WIRE_RESULTS, MO_WIRE_RESULTS_MAX, &codec, &n, message);
  while (error == MO_OK && results->n < n) {
    const uint32_t i = results->n++;
    error = get_result(&codec, &results->items[i], i, message);
  }
  if (error == MO_OK)
    error = read_end(&codec, message);
  if (error != MO_OK)
    mo_wire_free_results(results);
  return error;
}

void mo_wire_free_results(struct mo_wire_results *results)
{
  for (uint32_t i = 0; i < results->n; i++) {
    free(results->items[i].losses);
    free(results->items[i].diverged_steps);
    free(results->items[i].measures);
    free(results->items[i].d_parameters);
  }
  memset(results, 0, sizeof(*results));
}
