/* internal.h: shared by the files of this room. */
#ifndef MORPHO_COMPUTE_INTERNAL_H
#define MORPHO_COMPUTE_INTERNAL_H

#include <morpho/compute.h>

/* Part of every fingerprint: raise it by one whenever a change to the fast path changes any bit of any result.
 * tests/unit/rollout/bits.c notices such a change. */
#define MO_KERNEL_VERSION 1

/* The pack of one precision, made at first use; waits while another thread makes it. MO_ERR_NO_MEMORY, MO_ERR_UNSUPPORTED. */
int mo_compute_controller_pack(struct mo_compute_controller *controller, enum mo_precision precision,
                               const struct mo_pack **pack);
enum mo_isa mo_compute_isa(const struct mo_compute *compute);

#endif
