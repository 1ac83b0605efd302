/* outcasts.h: the workers of other machines in quarantine. Threads and errors as in store.h. */
#ifndef MORPHO_STORE_OUTCASTS_H
#define MORPHO_STORE_OUTCASTS_H

#include <stddef.h>
#include <stdint.h>

struct mo_store;

struct mo_outcast {
  char user[65], name[65]; /* user: of its token; "": none */
  char host[65], why[128];
  int64_t since_us; /* of the wall clock */
};
/* Reads them, oldest first. Returns their number, at most `limit`, or an error. */
int64_t mo_store_outcasts(struct mo_store *store, struct mo_outcast *items, size_t limit);
/* Replaces all of them. They are kept when this returns. */
int mo_store_set_outcasts(struct mo_store *store, const struct mo_outcast *items, size_t n);

#endif
