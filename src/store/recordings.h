/* recordings.h: the room that recordings take, and their removal. Only for this room. */
#ifndef MORPHO_STORE_RECORDINGS_H
#define MORPHO_STORE_RECORDINGS_H

#include "store/internal.h"

/* Stores trajectories and counts their bytes; only inside an operation. */
int mo_trajectories_insert(struct mo_connection *writer,
                           const struct mo_saved_trajectory *trajectories, size_t n);
/* Deletes those of a job; only inside an operation. *bytes: what they took. */
int mo_recordings_drop(struct mo_connection *writer, int64_t job, int64_t *bytes);

/* Returns whether the recordings take more than max_recordings: evaluations that have not ended
 * keep theirs. */
bool mo_recordings_are_many(const struct mo_store *store);
/* Removes, later and one evaluation after the other, the oldest recordings of evaluations that have
 * ended, as long as all recordings take more than max_recordings, or are older than
 * keep_recordings. Call it after what may have changed that. */
void mo_recordings_check(struct mo_store *store);

#endif
