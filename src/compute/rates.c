/* rates.c: see rates.h. */
#include "compute/rates.h"
#include "compute/internal.h"

#include <string.h>

static bool is_same_kind(const struct mo_rate *a, const struct mo_rate *b)
{
  return a->is_gradient == b->is_gradient && a->back_end == b->back_end &&
         a->precision == b->precision && a->integrator == b->integrator && a->dt_s == b->dt_s &&
         a->control_period_s == b->control_period_s;
}

/* Returns the position of the row for this kind of work. Creates the row if it does not exist. */
static uint32_t row_for(struct mo_rates *rates, const struct mo_rate *work)
{
  uint32_t oldest = 0;
  for (uint32_t i = 0; i < rates->n; i++) {
    if (is_same_kind(rates->rows + i, work))
      return i;
    if (rates->newest[i] < rates->newest[oldest])
      oldest = i;
  }
  const uint32_t i = rates->n < MO_RATES_MAX ? rates->n++ : oldest;
  rates->rows[i] = mo_rate_of(work->is_gradient, work->back_end, work->precision,
                              &(struct mo_scheme){.dt_s = work->dt_s,
                                                  .control_period_s = work->control_period_s,
                                                  .integrator = work->integrator});
  return i;
}

void mo_rates_add(struct mo_rates *rates, const struct mo_rate *work)
{
  MO_GUARD(&rates->mutex);
  const uint32_t i = row_for(rates, work);
  struct mo_rate *row = rates->rows + i;
  rates->newest[i] = ++rates->n_added;
  row->blocks += work->blocks;
  row->rollouts += work->rollouts;
  row->steps += work->steps;
  row->spring_steps += work->spring_steps;
  row->busy_s += work->busy_s;
}

struct mo_rate mo_rate_of(bool is_gradient, enum mo_back_end back_end, enum mo_precision precision,
                          const struct mo_scheme *scheme)
{
  return (struct mo_rate){.is_gradient = is_gradient,
                          .back_end = back_end,
                          .precision = precision,
                          .integrator = scheme->integrator,
                          .dt_s = scheme->dt_s,
                          .control_period_s = scheme->control_period_s};
}

uint32_t mo_compute_get_rates(struct mo_compute *compute, struct mo_rate list[MO_RATES_MAX])
{
  struct mo_rates *rates = mo_core(compute)->rates;
  MO_GUARD(&rates->mutex);
  memcpy(list, rates->rows, rates->n * sizeof(*list));
  return rates->n;
}
