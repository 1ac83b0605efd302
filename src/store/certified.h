/* certified.h: which designs have a certificate, and its verdict. Only certificates that succeeded
 * count. */
#ifndef MORPHO_STORE_CERTIFIED_H
#define MORPHO_STORE_CERTIFIED_H

#include <morpho/certificate.h>
#include <morpho/morphospace.h>

#include "base/sha256.h"

struct mo_store;

struct mo_certified {
  int64_t id;  /* of the certificate; 0: none */
  int verdict; /* enum mo_verdict_class; −1: not known, because an earlier version made it */
};
/* Finds the newest certificate of a genotype under a controller; NULL: under any. */
int mo_store_certified(struct mo_store *store, const struct mo_sha256 *controller,
                       const struct mo_genotype *genotype, struct mo_certified *certified);

#endif
