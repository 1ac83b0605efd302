/* readers.h: the pool of connections that read. Only for this room. */
#ifndef MORPHO_STORE_READERS_H
#define MORPHO_STORE_READERS_H

#include "store/sql.h"

/* Wait for a free reader, and for the scheduler's. It reads in one transaction until its release.
 * If that cannot start, all its statements return the error. */
struct mo_connection *mo_reader_acquire(struct mo_store *store);
struct mo_connection *mo_runner_acquire(struct mo_store *store);
void mo_reader_release(struct mo_store *store, struct mo_connection *connection);
static inline void mo_reader_leave(struct mo_connection *const *reader)
{
  mo_reader_release((*reader)->store, *reader);
}
/* Releases the reader at the end of the block, however the block is left. */
#define MO_SCOPED __attribute__((cleanup(mo_reader_leave)))
int mo_readers_open(struct mo_store *store);

#endif
