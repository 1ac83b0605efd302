/* check.h: reads all that is stored and checks it, for `morphod store check`. */
#ifndef MORPHO_STORE_CHECK_H
#define MORPHO_STORE_CHECK_H

#include "store/store.h"

struct mo_check_counts {
  uint64_t rows, files, findings;
};
/* Reads every row that has a checksum, a hash or a second copy, and every file, and reports what
 * does not agree to `tell`, a line each. An error: the reading could not go on. */
int mo_store_check_contents(struct mo_store *store,
                            void (*tell)(void *context, const char *finding), void *context,
                            struct mo_check_counts *counts);

/* A stored loss, and all that computes it again. */
struct mo_score_sample {
  struct mo_bits genotype;
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
