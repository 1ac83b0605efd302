/* download.c: long replies, sent piece by piece.
 *
 * A reply of hundreds of megabytes (all designs of a campaign) is never in memory as a whole. An
 * API thread makes a piece and libmicrohttpd sends it; then the connection is suspended until an
 * API thread has made the next piece. No I/O thread therefore waits for the store, and a slow
 * reader occupies memory for only one piece. A reply that fits into its first piece is an ordinary
 * reply with a Content-Length.
 *
 * The thread that owns the request also owns the download: the I/O thread while the connection is
 * active, one API thread while it is suspended. */
#include "http/download.h"

#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "http/server.h"

#define STALL_US    60000000            /* a client that reads nothing for this long is cut off */
#define PIECE_BYTES ((uint64_t)1 << 20) /* size of a piece, as counted in the limit on memory */

struct mo_download {
  mo_download_more more;
  void *context;
  void (*free_context)(void *context);
  struct mo_packer *packer; /* of a compressed reply; else NULL */
  struct mo_text made;      /* the piece before it is compressed */
  struct mo_text piece;
  size_t read; /* number of bytes of the piece that were sent */
  bool last;   /* the piece is the last one */
  bool failed; /* the rest cannot be produced: the reply breaks off, so that the client notices */
};

/* Makes the next piece. */
static int make_piece(struct mo_download *download)
{
  struct mo_packer *packer = download->packer;
  int more = 1, error = MO_OK;
  download->piece.size = download->read = 0;
  while (more > 0 && download->piece.size == 0 && error == MO_OK) {
    download->made.size = 0;
    more = download->more(download->context, packer != NULL ? &download->made : &download->piece);
    if (packer != NULL && more >= 0)
      error = mo_packer_add(packer, &download->made, more == 0, &download->piece);
  }
  download->last = more == 0;
  return more < 0 ? more : download->piece.failed ? MO_ERR_NO_MEMORY : error;
}

/* Starts to compress a reply of several pieces; the first already exists. */
static int begin_packing(struct mo_request *request, struct mo_download *download)
{
  download->packer = mo_packer_create(request);
  if (download->packer == NULL)
    return MO_OK;
  download->made = download->piece;
  download->piece = (struct mo_text){0};
  const int error = mo_packer_add(download->packer, &download->made, false, &download->piece);
  return error != MO_OK || download->piece.size > 0 ? error : make_piece(download);
}

static void discard(struct mo_download *download)
{
  download->free_context(download->context);
  mo_packer_free(download->packer);
  mo_text_free(&download->made);
  mo_text_free(&download->piece);
  free(download);
}

/* Makes the next piece, on an API thread. */
static void refill(struct mo_request *request)
{
  struct mo_download *download = request->download;
  struct MHD_Connection *mhd = request->mhd;
  const int error = make_piece(download);
  download->failed = error != MO_OK;
  if (download->failed)
    mo_request_note(request, "the reply broke off: %s", mo_error_text(error));
  MHD_resume_connection(mhd); /* from now on the I/O thread owns the request */
}

/* Passes libmicrohttpd the next bytes. */
static ssize_t reader(void *context, uint64_t position, char *out, size_t capacity)
{
  (void)position;
  struct mo_request *request = context;
  struct mo_download *download = request->download;
  size_t ready = download->failed ? 0 : download->piece.size - download->read;
  atomic_store(&request->connection->deadline_us, mo_clock_us() + STALL_US);
  if (ready > 0) {
    size_t n = ready < capacity ? ready : capacity;
    memcpy(out, download->piece.data + download->read, n);
    download->read += n;
    request->sent += n;
    return (ssize_t)n;
  }
  if (download->failed)
    return MHD_CONTENT_READER_END_WITH_ERROR;
  if (download->last)
    return MHD_CONTENT_READER_END_OF_STREAM;
  struct MHD_Connection *mhd = request->mhd;
  MHD_suspend_connection(mhd);
  if (mo_pool_give(request->http, request) != MO_OK) { /* the server is stopping */
    download->failed = true;
    MHD_resume_connection(mhd);
  }
  return 0;
}

void mo_download_open(struct mo_request *request, const char *type, const char *tag, uint64_t held,
                      mo_download_more more, void *context, void (*free_context)(void *context))
{
  mo_reply_static(request, 200, type, "", 0);
  if (tag != NULL)
    mo_reply_etag(request, "%s", tag);
  struct mo_download *download = request->reply.status == 200 ? calloc(1, sizeof(*download)) : NULL;
  if (download == NULL) {
    free_context(context);
    if (request->reply.status == 200)
      mo_reply_error(request, MO_ERR_NO_MEMORY, "reply");
    return;
  }
  *download = (struct mo_download){.more = more, .context = context, .free_context = free_context};
  if (!mo_reply_reserve(request, held + PIECE_BYTES + MO_PACKER_BYTES)) {
    discard(download);
    return;
  }
  int code = make_piece(download);
  if (code == MO_OK && download->last) {
    mo_reply_bytes(request, 200, type, download->piece.data, download->piece.size);
    download->piece = (struct mo_text){0};
    if (tag != NULL)
      mo_reply_etag(request, "%s", tag);
    else
      mo_reply_etag_of_body(request);
  } else if (code == MO_OK) {
    if (tag == NULL)
      mo_reply_etag(request, "once-%s", request->id);
    code = request->reply.status == 200 ? begin_packing(request, download) : MO_OK;
    if (code == MO_OK && request->reply.status == 200) {
      request->download = download;
      request->refill = refill;
      request->reader = reader;
      return;
    }
  }
  if (code != MO_OK)
    mo_reply_error(request, code, "reply");
  discard(download);
}

void mo_download_free(struct mo_request *request)
{
  if (request->download != NULL)
    discard(request->download);
  request->download = NULL;
}
