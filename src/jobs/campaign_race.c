/* campaign_race.c: scores the children of a generation in waves of environments, and cuts short
 * those that cannot survive (src/evolution/racing.c explains the reason and the plan).
 *
 * At first, the cells of the children are closed. The race begins when the scores of all parents
 * are known: at once if they keep their scores, or after they are rescored because the controller
 * has learned. Then each child proceeds independently, and no worker waits for a wave to end. In a
 * generation that does not race, children are scored together with parents that have learned. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "jobs/campaign_run.h"

_Static_assert(MO_RACE_ENVIRONMENTS_MAX == MO_ENVIRONMENTS_MAX, "a plan holds every environment");

static uint32_t n_parents_scored(const struct mo_campaign_run *run)
{
  return run->n_parents - run->scores.first;
}

int mo_race_close(struct mo_campaign_run *run)
{
  struct mo_campaign_race *race = &run->race;
  race->is_possible = mo_race_is_possible(run->settings) && run->n_parents > 0;
  return race->is_possible && (race->pays || n_parents_scored(run) == 0)
             ? mo_grid_close(&run->scores.scoring.grid, n_parents_scored(run))
             : MO_OK;
}

/* Opens the next wave of a candidate, or all waves. */
static void open_wave(struct mo_campaign_run *run, uint32_t place, uint32_t wave)
{
  const struct mo_race *race = &run->race.plan;
  const uint32_t first = wave > 0 ? race->ends[wave - 1] : 0;
  const uint32_t end = race->is_whole ? race->n_environments : race->ends[wave];
  mo_grid_open(&run->scores.scoring.grid, place, race->order + first, end - first);
}

static void plan(struct mo_campaign_run *run)
{
  const uint32_t n = run->n_environments, n_scored = n_parents_scored(run);
  struct mo_campaign_rows *rows = run->rows;
  /* The controller has learned, so the parents get new losses. */
  for (uint32_t i = 0; i < n_scored; i++) {
    memcpy(rows->parent_losses + (size_t)i * n, run->scores.losses[i].losses, n * sizeof(double));
    rows->scores[i] =
        mo_aggregate_score(&run->settings->aggregate, run->scores.losses[i].losses, n);
  }
  mo_race_plan(run->settings, rows->parent_losses, rows->scores, run->n_parents, n, run->race.pays,
               &run->race.plan);
}

/* Returns the wave that a child must begin, or n_waves if the child is within a wave. */
static uint32_t next_wave(const struct mo_campaign_run *run, uint32_t place)
{
  const struct mo_race *race = &run->race.plan;
  uint32_t wave = 0;
  for (uint32_t i = 0; i < race->n_environments; i++) {
    const uint8_t cell = *mo_grid_cell(&run->scores.scoring.grid, place, race->order[i]);
    while (i >= race->ends[wave])
      wave++;
    if (cell != MO_CELL_DONE)
      return cell == MO_CELL_LATER ? wave : race->n_waves;
  }
  return race->n_waves;
}

/* Begins the next wave of a child that is not within one, or cuts the child short. Returns whether
 * it is done. */
static bool advance_child(struct mo_campaign_run *run, uint32_t place)
{
  const uint32_t wave = next_wave(run, place);
  if (wave == run->race.plan.n_waves)
    return false;
  if (mo_race_is_lost(&run->race.plan, run->scores.losses[place].losses)) {
    mo_grid_finish_design(&run->scores.scoring.grid, place);
    return true;
  }
  open_wave(run, place, wave);
  return false;
}

/* A child with stored losses may be cut at once. This is not saved, because the losses will be
 * found again. */
static void start(struct mo_campaign_run *run)
{
  plan(run);
  for (uint32_t i = n_parents_scored(run); i < run->scores.n; i++)
    run->scores.n_done += advance_child(run, i);
}

void mo_race_begin(struct mo_campaign_run *run)
{
  struct mo_campaign_race *race = &run->race;
  race->parents_left = 0;
  for (uint32_t i = 0; i < n_parents_scored(run); i++)
    race->parents_left += run->scores.scoring.grid.left[i] > 0;
  if (race->is_possible && race->parents_left == 0)
    start(run);
}

bool mo_race_take(struct mo_campaign_run *run, uint32_t place, bool is_done)
{
  struct mo_campaign_race *race = &run->race;
  if (!race->is_possible)
    return is_done;
  if (place < n_parents_scored(run)) {
    race->parents_left -= is_done;
    if (is_done && race->parents_left == 0)
      start(run);
    return is_done;
  }
  return is_done || (race->parents_left == 0 && advance_child(run, place));
}

bool mo_race_pays(const struct mo_campaign_run *run)
{
  const struct mo_campaign_race *race = &run->race;
  const bool on_device = run->status.job.back_end == MO_ON_DEVICE;
  int64_t saved = 0;
  if (!race->is_possible || isinf(race->plan.bound))
    return race->pays;
  for (uint32_t i = n_parents_scored(run); i < run->scores.n; i++)
    saved += mo_race_saved(&race->plan, run->scores.losses[i].losses, on_device);
  return saved > mo_race_lost(&race->plan, on_device, n_parents_scored(run) > 0);
}

void mo_race_keep(const struct mo_campaign_run *run, struct mo_campaign_rows *to)
{
  const size_t n = run->n_environments;
  if (!mo_race_is_possible(run->settings) || run->mode->learns)
    return;
  for (uint32_t i = 0; i < run->n_survivors; i++) {
    const uint32_t place = run->rows->survivors[i];
    memcpy(to->parent_losses + i * n,
           place < run->n_parents ? run->rows->parent_losses + place * n
                                  : run->scores.losses[place - run->n_parents].losses,
           n * sizeof(double));
  }
}

/* Also reads losses that workers computed for a campaign on devices: mo_race_keep keeps them, and
 * the order of the environments must not depend on a restart. */
int mo_race_read(struct mo_campaign_run *run)
{
  const size_t n = run->n_environments;
  struct mo_campaign_loss *known;
  int64_t found;
  for (size_t i = 0; i < run->n_parents * n; i++)
    run->rows->parent_losses[i] = NAN;
  if (!mo_race_is_possible(run->settings) || run->mode->learns)
    return MO_OK;
  known = calloc((size_t)run->n_parents + 1, sizeof(*known));
  if (known == NULL)
    return MO_ERR_NO_MEMORY;
  found = mo_store_campaign_known(
      run->jobs->store, run->id, mo_back_end_fingerprint(run->jobs, run->status.job.back_end),
      mo_back_end_fingerprint(run->jobs, MO_ON_CPU), run->rows->bits, run->n_parents, known);
  for (int64_t i = 0; i < found; i++)
    memcpy(run->rows->parent_losses + known[i].place * n, known[i].losses, n * sizeof(double));
  free(known);
  return found < 0 ? (int)found : MO_OK;
}
