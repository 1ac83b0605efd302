/* store_check.h: `morphod store check`: reads all that is stored, and computes a sample again. */
#ifndef MORPHOD_DAEMON_STORE_CHECK_H
#define MORPHOD_DAEMON_STORE_CHECK_H

#include "store/store.h"

/* Prints what does not agree, and a summary. `n`: stored losses of each class to compute again.
 * MO_ERR_CORRUPT: something does not agree. */
int store_check(struct mo_store *store, size_t n, struct mo_message *message);

#endif
