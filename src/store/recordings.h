/* recordings.h: the space that recordings take, and their removal. Only for this room. */
#ifndef MORPHO_STORE_RECORDINGS_H
#define MORPHO_STORE_RECORDINGS_H

#include "store/internal.h"

/* Stores trajectories and counts their bytes; only inside an operation. */
int mo_trajectories_insert(struct mo_connection *writer,
                           const struct mo_saved_trajectory *trajectories, size_t n);
/* Deletes the recordings of a job; only inside an operation. *bytes: the space that they used. */
int mo_recordings_drop(struct mo_connection *writer, int64_t job, int64_t *bytes);

/* Returns whether the recordings take more than max_recordings, which is possible because
 * unfinished evaluations keep theirs. */
bool mo_recordings_are_many(const struct mo_store *store);
/* Queues the removal of the oldest recordings of evaluations that have ended, one evaluation after
 * another, while all recordings take more than max_recordings or the oldest are older than
 * keep_recordings. Call it after every change that may affect this. */
void mo_recordings_check(struct mo_store *store);

#endif
