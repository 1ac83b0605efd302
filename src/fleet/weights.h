/* weights.h: the controller files of leases, which workers request by hash. A file is made once and
 * kept while leases use its controller. Some files are kept longer, because between two generations
 * of a campaign there may be no leases. */
#ifndef MORPHO_FLEET_WEIGHTS_H
#define MORPHO_FLEET_WEIGHTS_H

#include "fleet/state.h"

#define MO_WEIGHTS_UNUSED 4  /* unused files that are kept */
#define MO_WEIGHTS_READ   16 /* kept only for readers: 2.5 MB each in most services */

struct mo_weights {
  struct mo_fleet_file file; /* first */
  const void *identity;      /* from mo_taken; NULL: no blocks of it are taken now */
  struct mo_sha256 hash;
  enum mo_sensor sensor;
  uint32_t n_users, n_readers; /* leases and readers */
  uint32_t n_parcels;          /* leases that have a parcel */
  LIST_ENTRY(mo_weights) next;
};

/* Makes the file, which takes 10 ms. Call it without the lock. MO_ERR_NO_MEMORY. */
int mo_weights_create(const struct mo_taken *taken, struct mo_weights **weights);

/* Call these with the lock held. find: returns the weights of taken blocks, or NULL if they were
 * not made yet. add: puts new weights into the table, or frees them if the table already has them,
 * and returns the weights in the table. Both add a use to the weights that they return. read: finds
 * weights by hash, for mo_fleet_controller. */
struct mo_weights *mo_weights_find(struct mo_fleet *fleet, const struct mo_taken *taken);
struct mo_weights *mo_weights_add(struct mo_fleet *fleet, struct mo_weights *weights);
int mo_weights_read(struct mo_fleet *fleet, const struct mo_sha256 *hash,
                    struct mo_weights **weights);
/* Call these with the lock held. End a parcel or a use. weights NULL: no-op. */
void mo_weights_end_parcel(struct mo_weights *weights);
void mo_weights_release(struct mo_fleet *fleet, struct mo_weights *weights);
void mo_weights_forget(struct mo_weights *weights); /* frees unused weights */

#endif
