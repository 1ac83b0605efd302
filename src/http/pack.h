/* pack.h: compresses replies with gzip, at the fastest level, where the client takes it. */
#ifndef MORPHO_HTTP_PACK_H
#define MORPHO_HTTP_PACK_H

#include "base/text.h"
#include "http/request.h"

/* Compresses a whole reply of at least MO_PACK_BYTES if that saves a quarter of it. Call on an API
 * thread, when the reply is complete. The reply's ETag gets a suffix: it names the bytes. */
#define MO_PACK_BYTES 32768
void mo_pack_reply(struct mo_request *request);

/* Compresses a reply that is made piece by piece. */
struct mo_packer;
#define MO_PACKER_BYTES 300000 /* memory of a packer */
/* Begins: marks the reply as compressed. NULL: the reply stays plain. */
struct mo_packer *mo_packer_create(struct mo_request *request);
/* Appends what is ready of a piece, perhaps nothing; of the last piece, all. */
int mo_packer_add(struct mo_packer *packer, const struct mo_text *piece, bool last,
                  struct mo_text *out);
void mo_packer_free(struct mo_packer *packer); /* NULL-safe */

#endif
