/* download.h: long replies, produced and sent piece by piece. */
#ifndef MORPHO_HTTP_DOWNLOAD_H
#define MORPHO_HTTP_DOWNLOAD_H

#include "base/text.h"
#include "http/request.h"

/* Appends the next part of the reply to `text`, about 100 KB in at most 50 ms, on an API thread.
 * Returns 1 if there may be more, 0 at the end, or an error. */
typedef int (*mo_download_more)(void *context, struct mo_text *text);
/* Makes a reply (200, 304 or a problem) in any number of pieces, and takes ownership of `context`.
 * tag: the ETag of the reply; NULL: the hash if the body is one piece, else a tag that is never
 * used again. held: bytes that `context` takes in addition to a piece. */
void mo_download_open(struct mo_request *request, const char *type, const char *tag, uint64_t held,
                      mo_download_more more, void *context, void (*free_context)(void *context));
void mo_download_free(struct mo_request *request); /* no-op without a download */

#endif
