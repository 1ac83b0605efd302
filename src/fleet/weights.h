/* weights.h: the files of the controllers of leases, which workers ask for by their hashes. A file
 * is made once while leases of its controller are out, and some are kept longer: between two
 * generations of a campaign nothing may be out. */
#ifndef MORPHO_FLEET_WEIGHTS_H
#define MORPHO_FLEET_WEIGHTS_H

#include "fleet/state.h"

#define MO_WEIGHTS_UNUSED 4  /* kept */
#define MO_WEIGHTS_READ   16 /* kept for readers only: 2.5 MB each, in most services */

struct mo_weights {
  struct mo_fleet_file file; /* first */
  const void *identity;      /* of mo_taken; NULL: nothing of it is taken any more */
  struct mo_sha256 hash;
  enum mo_sensor sensor;
  uint32_t n_users, n_readers; /* leases and readers */
  uint32_t n_parcels;          /* of the leases, those with a parcel */
  LIST_ENTRY(mo_weights) next;
};

/* Makes the file; 10 ms. Without the lock. MO_ERR_NO_MEMORY. */
int mo_weights_create(const struct mo_taken *taken, struct mo_weights **weights);

/* Locked. find: the weights of taken blocks, NULL: not made yet. add: puts new weights into the
 * table, or frees them if they are there already, and returns those of the table. Both
 * count a use of what they return. read: by hash, for mo_fleet_controller. */
struct mo_weights *mo_weights_find(struct mo_fleet *fleet, const struct mo_taken *taken);
struct mo_weights *mo_weights_add(struct mo_fleet *fleet, struct mo_weights *weights);
int mo_weights_read(struct mo_fleet *fleet, const struct mo_sha256 *hash,
                    struct mo_weights **weights);
/* Locked. Ends of a parcel and of a use; weights NULL: nothing to do. */
void mo_weights_end_parcel(struct mo_weights *weights);
void mo_weights_release(struct mo_fleet *fleet, struct mo_weights *weights);
void mo_weights_forget(struct mo_weights *weights); /* frees unused weights */

#endif
