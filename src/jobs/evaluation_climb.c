/* evaluation_climb.c: an evaluation that requested a tolerance (score_ladder.h).
 *
 * The cells of the grid are closed, except the cells of the first rung. When a design has all
 * losses of a rung, whether computed or found in the store, and misses the tolerance, the cells of
 * its next rung are opened; otherwise the cells of its further rungs are not needed. Climbs depend
 * only on losses, so the result does not depend on the number of workers or on the contents of the
 * store, and the store repeats them when results are read. After a crash, they restart from the
 * first rung and find the saved losses. */
#include <stdlib.h>

#include <morpho/score_ladder.h>

#include "jobs/evaluation_climb.h"

/* The climbs of n designs. */
struct mo_climbs {
  uint32_t n, n_environments, n_runs; /* n_runs: of a rung */
  struct climb {
    uint32_t rung, n_left; /* n_left: losses of the rung that are missing */
  } * climbs;              /* (n) */
  double *losses;          /* (n, n_runs, n_environments) of the current rungs */
  uint32_t *complete;      /* (n_complete) designs with all losses of their rungs */
  uint32_t n_complete;
};

void mo_climbs_free(struct mo_climbs *climbs)
{
  if (climbs == NULL)
    return;
  free(climbs->climbs);
  free(climbs->losses);
  free(climbs->complete);
  free(climbs);
}

static uint32_t cells_of_rung(const struct mo_climbs *climbs)
{
  return climbs->n_runs * climbs->n_environments;
}

static struct mo_climbs *create(const struct mo_work *work)
{
  struct mo_climbs *climbs = calloc(1, sizeof(*climbs));
  if (climbs == NULL)
    return NULL;
  climbs->n = work->n_designs / work->n_runs;
  climbs->n_environments = work->n_environments;
  climbs->n_runs = mo_error_runs(work->job.n_displaced);
  climbs->climbs = calloc(climbs->n, sizeof(*climbs->climbs));
  climbs->losses = calloc((size_t)climbs->n * cells_of_rung(climbs), sizeof(*climbs->losses));
  climbs->complete = calloc(climbs->n, sizeof(*climbs->complete));
  if (climbs->climbs == NULL || climbs->losses == NULL || climbs->complete == NULL) {
    mo_climbs_free(climbs);
    return NULL;
  }
  for (uint32_t i = 0; i < climbs->n; i++)
    climbs->climbs[i].n_left = cells_of_rung(climbs);
  return climbs;
}

int mo_active_climb(struct mo_active *active)
{
  if (!(active->work->job.tolerance > 0) || active->work->n_designs == 0)
    return MO_OK;
  active->climbs = create(active->work);
  return active->climbs == NULL
             ? MO_ERR_NO_MEMORY
             : mo_grid_close(&active->grid, active->climbs->n * active->climbs->n_runs);
}

void mo_active_climb_give(struct mo_active *active, uint32_t row, uint32_t k, double loss)
{
  struct mo_climbs *climbs = active->climbs;
  const uint32_t design = row % climbs->n, run = row / climbs->n % climbs->n_runs;
  struct climb *climb = &climbs->climbs[design];
  climbs->losses[((size_t)design * climbs->n_runs + run) * climbs->n_environments + k] = loss;
  if (--climb->n_left == 0)
    climbs->complete[climbs->n_complete++] = design;
}

static bool reaches(const struct mo_active *active, uint32_t design)
{
  const struct mo_climbs *climbs = active->climbs;
  const struct mo_job *job = &active->work->job;
  const struct mo_score_error error =
      mo_score_error_of(&climbs->losses[(size_t)design * cells_of_rung(climbs)], job->n_displaced,
                        climbs->n_environments, job->physics.scheme.integrator);
  return mo_ladder_climb(&error, 1, job->tolerance).reached;
}

static void open_rung(struct mo_active *active, uint32_t design, uint32_t rung)
{
  const struct mo_climbs *climbs = active->climbs;
  uint8_t cells[MO_ENVIRONMENTS_MAX];
  for (uint32_t k = 0; k < climbs->n_environments; k++)
    cells[k] = (uint8_t)k;
  for (uint32_t run = 0; run < climbs->n_runs; run++)
    mo_grid_open(&active->grid, (rung * climbs->n_runs + run) * climbs->n + design, cells,
                 climbs->n_environments);
}

bool mo_active_climb_on(struct mo_active *active)
{
  struct mo_climbs *climbs = active->climbs;
  bool any = false;
  if (climbs == NULL || climbs->n_complete == 0)
    return false;
  for (uint32_t i = 0; i < climbs->n_complete; i++) {
    const uint32_t design = climbs->complete[i];
    struct climb *climb = &climbs->climbs[design];
    if (climb->rung + 1 < MO_LADDER_RUNGS && !reaches(active, design)) {
      climb->n_left = cells_of_rung(climbs);
      open_rung(active, design, ++climb->rung);
      any = true;
    } else {
      const uint64_t cut = (uint64_t)(MO_LADDER_RUNGS - 1 - climb->rung) * cells_of_rung(climbs);
      active->cut += cut;
      active->done += cut;
    }
  }
  climbs->n_complete = 0;
  active->changed = true;
  mo_pending_touch(active->all);
  return any;
}
