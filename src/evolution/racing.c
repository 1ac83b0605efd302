/* racing.c: finds the children of a generation that cannot survive before all their losses are
 * known.
 *
 * The plan depends only on the parents: their worst score is the bound, and the spread of their
 * losses shows which environments distinguish designs best. Waves are used only if they would have
 * saved time in the previous generation. A child is therefore cut at the same wave regardless of
 * other jobs, and an interrupted generation repeats with the same bits. Lowering the bound with the
 * scores of children would save only one more rollout in a hundred. */
#include "evolution/internal.h"

#include <math.h>

/* Overhead in units of rollouts (docs/performance.md): for a CPU, per block; for a device, per call
 * that waits for another one. */
#define BLOCK_LANES    16
#define BLOCK_ROLLOUTS 2
#define WAIT_ROLLOUTS  2000

bool mo_race_is_possible(const struct mo_campaign_settings *settings)
{
  return settings->racing == MO_RACING_LOSSLESS && mo_modes[settings->mode].makes_children &&
         settings->selection.kind == MO_SELECT_TRUNCATION &&
         mo_aggregate_is_monotone(&settings->aggregate);
}

bool mo_race_is_lost(const struct mo_race *race, const double *losses)
{
  return mo_aggregate_score(&race->aggregate, losses, race->n_environments) > race->bound;
}

/* Returns the variance of the parents' losses in an environment. Diverged and unknown losses are
 * ignored. */
static double spread_of(const double *losses, uint32_t n_parents, uint32_t n_environments)
{
  double sum = 0, squares = 0;
  uint32_t n = 0;
  for (uint32_t i = 0; i < n_parents; i++) {
    const double loss = losses[(size_t)i * n_environments];
    if (isfinite(loss)) {
      sum += loss;
      n++;
    }
  }
  for (uint32_t i = 0; i < n_parents; i++) {
    const double off = losses[(size_t)i * n_environments] - sum / n;
    if (isfinite(off))
      squares += off * off;
  }
  return n > 0 ? squares / n : 0;
}

static void rank_environments(const double *losses, uint32_t n_parents, struct mo_race *race)
{
  struct mo_rank ranks[MO_RACE_ENVIRONMENTS_MAX];
  for (uint32_t k = 0; k < race->n_environments; k++)
    ranks[k] = (struct mo_rank){.score = -spread_of(losses + k, n_parents, race->n_environments),
                                .number = k};
  mo_rank_sort(ranks, race->n_environments);
  for (uint32_t k = 0; k < race->n_environments; k++)
    race->order[k] = (uint8_t)ranks[k].number;
}

void mo_race_cut_waves(struct mo_race *race, const uint8_t sizes[MO_RACE_WAVES_MAX])
{
  uint32_t end = 0;
  for (race->n_waves = 0; end < race->n_environments && race->n_waves < MO_RACE_WAVES_MAX;
       race->n_waves++) {
    const uint32_t left = race->n_environments - end, size = sizes[race->n_waves];
    end += left < size + 2 ? left : size;
    race->ends[race->n_waves] = (uint8_t)end;
  }
}

void mo_race_plan(const struct mo_campaign_settings *settings, const double *losses,
                  const double *scores, uint32_t n_parents, uint32_t n_environments, bool pays,
                  struct mo_race *race)
{
  /* More waves would cost more time in blocks than they save in rollouts: of all divisions of ten
   * environments, 2 + 8 takes the least time (docs/performance.md). */
  static const uint8_t sizes[MO_RACE_WAVES_MAX] = {2, 8, 16, 16, 16, 16};
  *race = (struct mo_race){.bound = INFINITY,
                           .aggregate = settings->aggregate,
                           .n_environments = n_environments,
                           .is_whole = !pays};
  if (n_parents >= settings->population) {
    race->bound = -INFINITY;
    for (uint32_t i = 0; i < n_parents; i++)
      race->bound = scores[i] > race->bound ? scores[i] : race->bound;
  }
  if (race->bound < INFINITY) {
    rank_environments(losses, n_parents, race);
    mo_race_cut_waves(race, sizes);
    return;
  }
  for (uint32_t k = 0; k < n_environments; k++)
    race->order[k] = (uint8_t)k;
  race->n_waves = 1;
  race->ends[0] = (uint8_t)n_environments;
}

static int time_of(uint32_t n, bool on_device)
{
  return (int)(n + (on_device ? 0 : BLOCK_ROLLOUTS * ((n + BLOCK_LANES - 1) / BLOCK_LANES)));
}

int mo_race_saved(const struct mo_race *race, const double *losses, bool on_device)
{
  double known[MO_RACE_ENVIRONMENTS_MAX];
  int raced = 0;
  uint32_t n = 0;
  for (uint32_t k = 0; k < race->n_environments; k++)
    known[k] = NAN;
  for (uint32_t wave = 0; wave < race->n_waves; wave++) {
    const uint32_t first = n;
    bool is_cut = false; /* cut before this wave because of stored losses */
    for (; n < race->ends[wave]; n++) {
      known[race->order[n]] = losses[race->order[n]];
      is_cut = is_cut || isnan(losses[race->order[n]]);
    }
    raced += is_cut ? 0 : time_of(n - first, on_device);
    if (is_cut || mo_race_is_lost(race, known))
      break;
  }
  return time_of(race->n_environments, on_device) - raced;
}

uint32_t mo_race_lost(const struct mo_race *race, bool on_device, bool parents_first)
{
  return on_device ? WAIT_ROLLOUTS * (race->n_waves - 1 + parents_first) : 0;
}
