/* checkpoints.h: the kept checkpoints of training runs and campaigns. The files are
 * trainings/<job>/<step>.checkpoint and campaigns/<job>/<generation>-<step>.checkpoint. */
#ifndef MORPHO_STORE_CHECKPOINTS_H
#define MORPHO_STORE_CHECKPOINTS_H

#include "store/store.h"

#define MO_CHECKPOINTS_KEPT_MAX   100   /* of a training run */
#define MO_CHECKPOINT_SECONDS_MAX 86400 /* between two checkpoints */
#define MO_CHECKPOINTS_MAX        128   /* of any job */

struct mo_checkpoint_place {
  uint32_t generation, step; /* generation: 0 in a training run */
};
struct mo_checkpoint_row {
  uint32_t generation, step;
  struct mo_sha256 sha256;
  uint64_t size;
  int64_t stored_us;
};
/* Reads the checkpoints of a job, newest first. */
int64_t mo_store_checkpoints(struct mo_store *store, int64_t id, struct mo_checkpoint_row *rows,
                             size_t limit);

struct mo_checkpoints_removed {
  struct mo_checkpoint_place places[MO_CHECKPOINTS_MAX]; /* (n) newest first */
  size_t n;
  uint64_t bytes; /* of the removed files */
};
/* Removes the checkpoints that are not needed, or (step > 0) one checkpoint of a training run. A
 * job that has ended does not need any. An unfinished training run needs the newest one, to resume
 * from; an unfinished campaign needs all of them. May use the reserve. MO_ERR_NOT_FOUND: no such
 * job of this kind, or no such checkpoint; MO_ERR_CONFLICT: the run has not ended and resumes from
 * this checkpoint. */
int mo_store_checkpoints_remove(struct mo_store *store, int64_t id, enum mo_job_kind kind,
                                uint32_t step, struct mo_checkpoints_removed *removed);

#endif
