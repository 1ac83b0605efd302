/* deletion.h: deletes jobs: on request, and by age. Threads and errors as in store.h. */
#ifndef MORPHO_STORE_DELETION_H
#define MORPHO_STORE_DELETION_H

#include "store/records.h"

struct mo_store;

struct mo_deleted {
  uint64_t recorded_bytes;                  /* of deleted recordings */
  uint64_t n_checkpoints, checkpoint_bytes; /* that were deleted */
};
/* Deletes a job that has ended. It disappears for readers at once; its rows are deleted later, in
 * steps of bounded size that continue after a restart. May use the reserve. Designs, scores and
 * controllers are kept. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: the job has not ended (`message` is
 * empty), or another job needs it (`message` says which). */
int mo_store_delete_job(struct mo_store *store, int64_t id, struct mo_deleted *deleted,
                        struct mo_message *message);

#endif
