/* statistics.c: sizes of designs, and statistics of a population.
 *
 * Hamming distances are sums over voxels, so all pairs at once need only the column sums c_v, the
 * number of the n genotypes that have voxel v:
 *   over all pairs          Σ_v c_v (n − c_v)
 *   of one to all others    Σ_v (n − c_v where it holds v, c_v where it does not)
 * Both are integers below 2^53, so they are also exact as doubles. Columns are summed 64 at a time,
 * which needs no extra memory. */
#include "evolution/internal.h"

#include "morphospace/bits.h"
#include "morphospace/grid.h"

#include <math.h>

/* ---- ranks ---- */

static int compare_ranks(const void *a, const void *b)
{
  const struct mo_rank *one = a, *other = b;
  if (one->score != other->score)
    return one->score < other->score ? -1 : 1;
  if (one->number != other->number)
    return one->number < other->number ? -1 : 1;
  return one->place < other->place ? -1 : one->place > other->place;
}

void mo_rank_sort(struct mo_rank *ranks, uint32_t n)
{
  if (n > 1)
    qsort(ranks, n, sizeof(*ranks), compare_ranks);
}

/* ---- distances ---- */

/* Computes the column sums of word w of the genotypes. */
static void sum_columns(const uint64_t *genotypes, size_t words, size_t w, uint32_t n,
                        uint32_t counts[64])
{
  memset(counts, 0, 64 * sizeof(*counts));
  for (size_t i = 0; i < n; i++)
    for (uint64_t rest = genotypes[words * i + w]; rest != 0; rest &= rest - 1)
      counts[__builtin_ctzll(rest)]++;
}

double mo_diversity(struct mo_workspace workspace, const uint64_t *genotypes, uint32_t n)
{
  const size_t words = mo_workspace_words(workspace);
  uint64_t sum = 0;
  if (n < 2)
    return 0.0;
  for (size_t w = 0; w < words; w++) {
    uint32_t counts[64];
    sum_columns(genotypes, words, w, n, counts);
    for (int v = 0; v < 64; v++)
      sum += (uint64_t)counts[v] * (n - counts[v]);
  }
  const uint64_t pairs = (uint64_t)n * (n - 1) / 2;
  return (double)sum / ((double)pairs * mo_workspace_voxels(workspace));
}

/* The sums are divided by the same number, so they keep their order. */
void mo_distinctiveness(struct mo_workspace workspace, const uint64_t *genotypes, uint32_t n,
                        double *distances)
{
  const size_t words = mo_workspace_words(workspace);
  const double others = n < 2 ? 1.0 : (double)(n - 1);
  for (size_t i = 0; i < n; i++)
    distances[i] = 0.0;
  for (size_t w = 0; w < words; w++) {
    uint32_t counts[64];
    int64_t all = 0;
    sum_columns(genotypes, words, w, n, counts);
    for (int v = 0; v < 64; v++)
      all += counts[v];
    for (size_t i = 0; i < n; i++) {
      int64_t sum = all;
      for (uint64_t rest = genotypes[words * i + w]; rest != 0; rest &= rest - 1)
        sum += (int64_t)n - 2 * (int64_t)counts[__builtin_ctzll(rest)];
      distances[i] += (double)sum;
    }
  }
  for (size_t i = 0; i < n; i++)
    distances[i] /= others * mo_workspace_voxels(workspace);
}

/* ---- sizes ---- */

int mo_design_size(const struct mo_lattice *lattice, const uint64_t *bits,
                   struct mo_design_size *size)
{
  const uint32_t words = mo_workspace_words(lattice->workspace);
  const uint32_t mass_words = (lattice->n_masses + 63) / 64,
                 spring_words = (lattice->n_springs + 63) / 64;
  struct mo_scratch masses;
  if (mo_scratch_open(&masses, mass_words + spring_words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  uint64_t *springs = masses.bits + mass_words;
  struct mo_design_size found = {.voxels = mo_bits_count(bits, words)};
  uint32_t column = UINT32_MAX;
  for (uint32_t w = 0; w < words; w++)
    for (uint64_t rest = bits[w]; rest != 0; rest &= rest - 1) {
      const size_t voxel = (size_t)w * 64 + (size_t)__builtin_ctzll(rest);
      const uint32_t its_column = (uint32_t)(voxel / lattice->workspace.nz); /* ascending */
      found.footprint += its_column != column;
      column = its_column;
    }
  mo_body_mark(lattice, bits, masses.bits, springs);
  found.masses = mo_bits_count(masses.bits, mass_words);
  found.springs = mo_bits_count(springs, spring_words);
  mo_scratch_close(&masses);
  *size = found;
  return MO_OK;
}

/* ---- populations ---- */

/* Writes the finite scores, ascending, to `sound`. Returns their number. */
static uint32_t sort_scores(const double *scores, uint32_t n, struct mo_rank *sound)
{
  uint32_t found = 0;
  for (uint32_t i = 0; i < n; i++)
    if (isfinite(scores[i]))
      sound[found++] = (struct mo_rank){.score = scores[i], .number = i};
  mo_rank_sort(sound, found);
  return found;
}

static void describe_scores(const struct mo_rank *sound, uint32_t n,
                            struct mo_population_stats *stats)
{
  static const double shares[MO_QUANTILES] = {0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0};
  double sum = 0.0;
  for (uint32_t i = 0; i < n; i++)
    sum += sound[i].score;
  stats->mean_score = n > 0 ? sum / n : NAN;
  for (int q = 0; q < MO_QUANTILES; q++) {
    stats->quantiles[q] = NAN;
    if (n == 0)
      continue;
    const double at = shares[q] * (double)(n - 1);
    const uint32_t low = (uint32_t)at;
    const uint32_t high = low + 1 < n ? low + 1 : low;
    stats->quantiles[q] = sound[low].score + (at - low) * (sound[high].score - sound[low].score);
  }
}

/* Computes the spread of one field. `first`: the field in the first of n sizes. */
static struct mo_spread spread_of(const uint32_t *first, uint32_t n)
{
  const size_t stride = sizeof(struct mo_design_size) / sizeof(uint32_t);
  if (n == 0)
    return (struct mo_spread){0};
  uint32_t least = *first, most = *first;
  uint64_t sum = 0;
  for (size_t i = 0; i < n; i++) {
    const uint32_t value = first[stride * i];
    least = value < least ? value : least;
    most = value > most ? value : most;
    sum += value;
  }
  return (struct mo_spread){least, (double)sum / n, most};
}

static int count_species(struct mo_workspace workspace, const uint64_t *genotypes, uint32_t n,
                         uint32_t *species)
{
  struct mo_seen *seen = NULL;
  int r = mo_seen_create(workspace, NULL, &seen);
  for (size_t i = 0; i < n && r >= 0; i++)
    r = mo_seen_add(seen, genotypes + mo_workspace_words(workspace) * i);
  if (r >= 0)
    *species = (uint32_t)mo_seen_count(seen);
  mo_seen_free(seen);
  return r < 0 ? r : MO_OK;
}

int mo_population_stats(struct mo_workspace workspace, const uint64_t *genotypes,
                        const double *scores, const struct mo_design_size *sizes, uint32_t n,
                        struct mo_population_stats *stats)
{
  struct mo_population_stats made = {.n = n};
  int r = count_species(workspace, genotypes, n, &made.species);
  if (r < 0)
    return r;
  struct mo_rank *sound = malloc((n > 0 ? n : 1) * sizeof(*sound));
  if (sound == NULL)
    return MO_ERR_NO_MEMORY;
  const uint32_t n_sound = sort_scores(scores, n, sound);
  made.n_diverged = n - n_sound;
  describe_scores(sound, n_sound, &made);
  free(sound);
  made.diversity = mo_diversity(workspace, genotypes, n);
  made.voxels = spread_of(&sizes->voxels, n);
  made.footprint = spread_of(&sizes->footprint, n);
  made.masses = spread_of(&sizes->masses, n);
  made.springs = spread_of(&sizes->springs, n);
  *stats = made;
  return MO_OK;
}
