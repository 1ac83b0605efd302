/* check.h: reads and checks everything that is stored, for `morphod store check`. */
#ifndef MORPHO_STORE_CHECK_H
#define MORPHO_STORE_CHECK_H

#include "store/store.h"

struct mo_check_counts {
  uint64_t rows, files, findings;
};
/* Reads every row that has a checksum, a hash or a second copy, and every file, and calls `report`
 * with a line for each mismatch. Returns an error if it could not continue. */
int mo_store_check_contents(struct mo_store *store,
                            void (*report)(void *context, const char *finding), void *context,
                            struct mo_check_counts *counts);

/* A stored loss, and everything needed to recompute it. */
struct mo_score_sample {
  struct mo_genotype genotype;
  struct mo_sha256 controller_sha256;
  struct mo_environment environment;
  struct mo_physics physics;
  enum mo_precision precision;
  double loss;
  int32_t diverged_step;
};
/* Draws about n stored losses of a class, spread over all bodies. Returns their number or an
 * error. */
int64_t mo_store_sample(struct mo_store *store, const char *fingerprint, uint64_t seed,
                        struct mo_score_sample *samples, size_t n);

#endif
