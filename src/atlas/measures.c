/* measures.c: measures of bodies, and where they stand among those of the same size. */
#include "atlas/file.h"

#include <math.h>

int mo_atlas_column_of(const struct mo_atlas *atlas, enum mo_measure measure)
{
  const uint32_t set = atlas->source.measures, before = (UINT32_C(1) << measure) - 1;
  return (set >> measure & 1) != 0 ? __builtin_popcount(set & before) : -1;
}

float mo_atlas_measure(const struct mo_atlas *atlas, uint64_t position, enum mo_measure measure)
{
  const int column = mo_atlas_column_of(atlas, measure);
  return column >= 0 ? mo_atlas_in_column(atlas, position, (uint32_t)column) : NAN;
}

/* Counts the values that are lower than a number, and that are equal to it, and all values. The
 * compiler makes vectors of it. */
static void count_values(const float *values, uint32_t n, float number, uint64_t counts[3])
{
  uint32_t lower = 0, equal = 0, known = 0;
  for (uint32_t i = 0; i < n; i++) {
    lower += values[i] < number;
    equal += values[i] == number;
    known += values[i] == values[i];
  }
  counts[0] += lower;
  counts[1] += equal;
  counts[2] += known;
}

double mo_atlas_measure_percentile(const struct mo_atlas *atlas, uint64_t position,
                                   enum mo_measure measure)
{
  const int column = mo_atlas_column_of(atlas, measure);
  const float value = mo_atlas_measure(atlas, position, measure);
  const struct mo_atlas_layout *layout = &atlas->layout;
  uint64_t counts[3] = {0}, key;
  if (isnan(value))
    return NAN;
  const uint32_t n_voxels = mo_atlas_key_at(atlas, position, &key);
  for (uint64_t i = layout->blocks[n_voxels - 1]; i < layout->blocks[n_voxels]; i++)
    count_values(mo_atlas_column(atlas, &atlas->blocks[i], (uint32_t)column), atlas->blocks[i].n,
                 value, counts);
  const double others = (double)(counts[2] - 1);
  return others > 0 ? 100 * ((double)counts[0] + (double)(counts[1] - 1) / 2) / others : 100;
}
