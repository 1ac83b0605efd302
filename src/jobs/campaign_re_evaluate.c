/* campaign_re_evaluate.c: scores the elite of a generation in fresh worlds.
 *
 * A design is among the best partly because it was lucky in the campaign's worlds. Its scores in
 * worlds that were not used for selection show how good it is without that luck. The results are
 * committed with the generation and change nothing else: a generation that is interrupted before
 * its commit is re-evaluated again, with the same bits. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include <morpho/random.h>

#include "base/words.h"
#include "certificate/held_out.h"
#include "certificate/statistics.h"
#include "jobs/campaign_run.h"

/* The elite, and the part of its worlds in which it is being scored. */
struct elite {
  struct mo_campaign_run *run;
  uint32_t places[MO_ELITE_MAX]; /* (n) in the new population, ascending */
  uint32_t n, n_worlds;
  struct mo_environment *worlds; /* (n_worlds) grids are borrowed from the campaign's */
  double *values;                /* (n, n_worlds) losses, or values of the measure to select by */
  struct mo_bits *genotypes;     /* (sets of the grid, n) */
  struct mo_scoring scoring;
  uint32_t first, width; /* the first world of the grid; number of worlds in a set */
};

/* ---- who, and where ---- */

static bool is_due(const struct mo_campaign_run *run)
{
  const uint32_t every = run->status.record.re_evaluate.every;
  return every > 0 && (run->generation % every == 0 ||
                       run->generation >= run->settings->generations || run->variation.exhausted);
}

static int ascending(const void *a, const void *b)
{
  const uint32_t x = *(const uint32_t *)a, y = *(const uint32_t *)b;
  return x < y ? -1 : x > y;
}

/* Chooses the best of the new population and its champions, each once. Designs that diverged have
 * no score to compare. */
static int choose(struct elite *elite)
{
  const struct mo_campaign_run *run = elite->run;
  const struct mo_campaign_rows *population = run->other_rows;
  const uint32_t n = run->n_survivors, wanted = run->status.record.re_evaluate.designs;
  const uint32_t n_best = wanted < n ? wanted : n;
  const uint32_t n_champions = n < MO_CHAMPIONS_USUAL ? n : MO_CHAMPIONS_USUAL;
  uint32_t places[MO_ELITE_MAX], champions[MO_CHAMPIONS_USUAL] = {0};
  const int error = mo_champions(run->settings->workspace, population->genotypes,
                                 population->scores, n, n_champions, champions, NULL);
  for (uint32_t i = 0; i < n_best; i++)
    places[i] = i;
  for (uint32_t i = 0; i < n_champions; i++)
    places[n_best + i] = champions[i];
  qsort(places, n_best + n_champions, sizeof(*places), ascending);
  for (uint32_t i = 0; i < n_best + n_champions; i++)
    if ((i == 0 || places[i] != places[i - 1]) && isfinite(population->scores[places[i]]))
      elite->places[elite->n++] = places[i];
  return error;
}

/* Draws the worlds of this generation. Their seed is below 2^53, as all seeds are. */
static int draw_worlds(struct elite *elite)
{
  const struct mo_campaign_run *run = elite->run;
  const struct mo_campaign_record *record = &run->status.record;
  const int set = mo_word_index(mo_set_words, record->environment_set);
  const struct mo_certificate_base base = {.physics = run->settings->physics,
                                           .precision = MO_FLOAT32,
                                           .environments = run->environments,
                                           .n_environments = run->n_environments,
                                           .set = set >= 0 ? mo_set_words[set] : NULL};
  struct mo_random random;
  mo_random_init(&random, run->settings->seed, MO_PURPOSE_RE_EVALUATION, run->generation, 0);
  return mo_fresh_worlds(&base, mo_random_u64(&random) >> 11, elite->n_worlds, elite->worlds);
}

/* ---- scores ---- */

static void take(void *context, const struct mo_flight *flight, bool is_done)
{
  struct elite *elite = context;
  const struct mo_block *block = &flight->block;
  const struct mo_select_by *by = &elite->run->status.record.select_by;
  const uint32_t set = flight->design / elite->n;
  double *values = elite->values + (size_t)elite->n_worlds * (flight->design % elite->n) +
                   elite->first + (size_t)elite->width * set;
  (void)is_done;
  for (uint32_t i = 0; i < block->n_environments; i++)
    values[flight->places[i]] =
        by->is_set ? mo_select_by_score(by, block->measuring->values[i][by->measure])
                   : block->outcomes[i].loss;
  atomic_fetch_add(&elite->run->jobs->campaign_rollouts, block->n_environments);
}

static void show(void *context, double rollouts_per_s)
{
  const struct elite *elite = context;
  const struct mo_grid *grid = &elite->scoring.grid;
  uint32_t done = 0;
  for (uint32_t i = 0; i < grid->n_designs; i++)
    done += grid->left[i] == 0;
  if (grid->n_sets > 0)
    mo_campaign_advance(elite->run, done / grid->n_sets, rollouts_per_s);
}

/* Scores the elite in `n_sets` sets of the next worlds. */
static int score_part(struct elite *elite, uint32_t n_sets)
{
  struct mo_campaign_run *run = elite->run;
  struct mo_grid *grid = &elite->scoring.grid;
  const bool selects = run->status.record.select_by.is_set;
  elite->scoring = (struct mo_scoring){
      .runner = run->runner, .context = elite, .take = take, .show = show, .measures = selects};
  *grid = (struct mo_grid){.block = mo_block_of(run->jobs, &run->status.job),
                           .genotypes = elite->genotypes,
                           .environments = elite->worlds + elite->first,
                           .n_designs = n_sets * elite->n,
                           .n_environments = elite->width,
                           .n_sets = n_sets};
  grid->block.controller = run->scores.weights;
  int error = mo_grid_create(grid);
  if (error == MO_OK)
    error = mo_score(&elite->scoring);
  mo_grid_free(grid);
  elite->first += n_sets * elite->width;
  return error;
}

/* A set has at most MO_ENVIRONMENTS_MAX worlds, and all sets of a grid have the same number: full
 * sets are scored first, then the rest. */
static int score(struct elite *elite)
{
  const uint32_t n_full = elite->n_worlds / MO_ENVIRONMENTS_MAX;
  const uint32_t rest = elite->n_worlds % MO_ENVIRONMENTS_MAX;
  int error = MO_OK;
  elite->width = MO_ENVIRONMENTS_MAX;
  if (n_full > 0)
    error = score_part(elite, n_full);
  elite->width = rest;
  return error == MO_OK && rest > 0 ? score_part(elite, 1) : error;
}

/* ---- results ---- */

static struct mo_re_evaluated result_of(const struct elite *elite, uint32_t i, double *scratch)
{
  const double *values = elite->values + (size_t)elite->n_worlds * i;
  struct mo_re_evaluated result = {.number = elite->run->other_rows->numbers[elite->places[i]],
                                   .generation = elite->run->generation,
                                   .worlds = elite->n_worlds,
                                   .mean = NAN,
                                   .standard_error = NAN};
  for (uint32_t k = 0; k < elite->n_worlds; k++)
    result.diverged += !isfinite(values[k]);
  if (result.diverged > 0)
    return result;
  const struct mo_mean mean = mo_mean_of_units(values, elite->n_worlds, elite->n_worlds, scratch);
  result.mean = mean.mean;
  result.standard_error = sqrt(mean.variance);
  return result;
}

/* Allocates everything for the elite, which is not empty. */
static int allocate(struct elite *elite)
{
  const size_t n_sets = (elite->n_worlds + MO_ENVIRONMENTS_MAX - 1) / MO_ENVIRONMENTS_MAX;
  elite->worlds = calloc(elite->n_worlds, sizeof(*elite->worlds));
  elite->values = calloc((size_t)(elite->n + 1) * elite->n_worlds, sizeof(*elite->values));
  elite->genotypes = calloc(n_sets * elite->n, sizeof(*elite->genotypes));
  if (elite->worlds == NULL || elite->values == NULL || elite->genotypes == NULL)
    return MO_ERR_NO_MEMORY;
  for (size_t i = 0; i < n_sets * elite->n; i++)
    elite->genotypes[i] = elite->run->other_rows->bits[elite->places[i % elite->n]];
  return MO_OK;
}

/* Scores the elite and keeps the results. */
static int evaluate(struct elite *elite)
{
  struct mo_campaign_run *run = elite->run;
  int error = allocate(elite);
  if (error == MO_OK)
    error = draw_worlds(elite);
  mo_campaign_enter(run, MO_PHASE_SCORE, elite->n);
  if (error == MO_OK)
    error = score(elite);
  for (uint32_t i = 0; i < elite->n && error == MO_OK; i++)
    run->held_out[run->n_held_out++] =
        result_of(elite, i, elite->values + (size_t)elite->n * elite->n_worlds);
  return error;
}

int mo_campaign_re_evaluate(struct mo_campaign_run *run)
{
  struct elite elite = {.run = run, .n_worlds = run->status.record.re_evaluate.environments};
  run->n_held_out = 0;
  if (!is_due(run))
    return MO_OK;
  int error = choose(&elite);
  if (error == MO_OK && elite.n > 0)
    error = evaluate(&elite);
  free(elite.worlds);
  free(elite.values);
  free(elite.genotypes);
  return error;
}
