/* evaluation_race.c: an evaluation that requests only its k best designs (src/evolution/best.c).
 *
 * The cells of the grid are closed, except the cells of the race's current round. The next round
 * begins when all losses of the current one are known, whether computed or found in the store.
 * Rounds depend only on losses, so the result does not depend on the number of workers or on the
 * contents of the store. After a crash, the race restarts from the beginning and finds the saved
 * losses. */
#include <math.h>

#include "jobs/evaluation.h"

static void open_cells(struct mo_active *active, uint32_t design)
{
  uint8_t cells[MO_RACE_ENVIRONMENTS_MAX];
  uint32_t n = 0;
  for (uint64_t left = active->race->asked[design]; left != 0; left &= left - 1)
    cells[n++] = (uint8_t)__builtin_ctzll(left);
  mo_grid_open(&active->grid, design, cells, n);
}

bool mo_active_race_on(struct mo_active *active)
{
  struct mo_best *race = active->race;
  if (race == NULL || active->n_asked > 0 || active->done == active->total)
    return false;
  active->n_asked = mo_best_ask(race);
  active->done += race->n_cut - active->cut;
  active->cut = race->n_cut;
  active->changed = true;
  mo_pending_touch(active->all);
  for (uint32_t i = 0; i < race->n_designs && active->n_asked > 0; i++)
    open_cells(active, i);
  return active->n_asked > 0;
}

int mo_active_race(struct mo_active *active)
{
  const struct mo_job *job = &active->work->job;
  struct mo_grid *grid = &active->grid;
  if (job->best == 0 || grid->n_designs == 0)
    return MO_OK;
  const int error =
      mo_best_create(grid->n_designs, grid->n_environments,
                     job->best < grid->n_designs ? job->best : grid->n_designs, &active->race);
  return error == MO_OK ? mo_grid_close(grid, 0) : error;
}

double mo_active_left(const struct mo_active *active, uint64_t done)
{
  const double left = (double)(active->total - done);
  if (active->climbs != NULL && active->work->n_designs > 0 && left > 0)
    return -1; /* depends on how far the designs climb */
  if (active->race == NULL)
    return left;
  const double later = mo_best_left(active->race);
  return later < 0 ? -1 : fmin(left, (double)active->n_asked + later);
}
