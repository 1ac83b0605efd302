/* neighbors.h: the neighbors of a body by one voxel, as keys. */
#ifndef MORPHO_ATLAS_NEIGHBORS_H
#define MORPHO_ATLAS_NEIGHBORS_H

#include "atlas/file.h"

struct mo_atlas_change {
  uint64_t key;
  uint32_t n_voxels;
  enum mo_atlas_step step;
};

/* Finds the distinct bodies that fit the workspace and differ by one of these steps, in no
 * particular order; they may have more voxels than the scope. Returns their number. */
uint32_t mo_atlas_changes(const struct mo_atlas *atlas, uint64_t position, unsigned steps,
                          struct mo_atlas_change changes[MO_ATLAS_NEIGHBORS_MAX]);

/* Returns whether a body comes before another: by score, then by position. */
static inline bool mo_atlas_is_before(float score, uint64_t position, float other_score,
                                      uint64_t other_position)
{
  return score != other_score ? score < other_score : position < other_position;
}

#endif
