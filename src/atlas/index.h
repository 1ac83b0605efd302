/* index.h: positions sorted by score or by a measure. */
#ifndef MORPHO_ATLAS_INDEX_H
#define MORPHO_ATLAS_INDEX_H

#include "atlas/file.h"

struct mo_atlas_index {
  const struct mo_atlas *atlas;
  int column;       /* of a measure; −1: scores */
  bool is_negative; /* by its negative values */
  uint64_t n;
  uint32_t *all;     /* (n) positions, the best first */
  uint32_t *by_size; /* (n) the same for each size, where its positions are in the atlas */
};

#endif
