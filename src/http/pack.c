/* pack.c: see reply.h.
 *
 * Level 1 takes an API thread 6 to 9 ms per megabyte, and saves two thirds of a phylogeny and four
 * fifths of JSON. Only API threads compress. Small replies, which are polled, stay plain. A
 * complete reply is compressed into a buffer of three quarters of its size; if it does not fit, the
 * plain reply is sent. */
#include "http/reply.h"

#include <stdlib.h>
#include <zlib.h>

#define OUT_BYTES 65536

struct mo_packer {
  z_stream stream;
};

/* Prepares a stream for gzip at level 1. */
static bool begin(z_stream *stream)
{
  *stream = (z_stream){0};
  return deflateInit2(stream, 1, Z_DEFLATED, 15 + 16, 8, Z_DEFAULT_STRATEGY) == Z_OK;
}

void mo_pack_reply(struct mo_request *request)
{
  struct mo_reply *reply = &request->reply;
  const size_t most = reply->size - reply->size / 4;
  z_stream stream;
  if (reply->status != 200 || reply->body == NULL || request->reader != NULL ||
      reply->size < MO_PACK_BYTES || reply->size > UINT32_MAX || !mo_reply_may_pack(request) ||
      !mo_accepts_gzip(request) || !begin(&stream))
    return;
  char *packed = malloc(most);
  stream.next_in = (Bytef *)reply->body;
  stream.avail_in = (uInt)reply->size;
  stream.next_out = (Bytef *)packed;
  stream.avail_out = (uInt)most;
  if (packed != NULL && deflate(&stream, Z_FINISH) == Z_STREAM_END) {
    free(reply->body);
    reply->size = most - stream.avail_out;
    reply->body = realloc(packed, reply->size);
    reply->body = reply->body != NULL ? reply->body : packed;
    mo_reply_mark_gzip(request);
  } else {
    free(packed);
  }
  deflateEnd(&stream);
}

struct mo_packer *mo_packer_create(struct mo_request *request)
{
  if (!mo_reply_may_pack(request) || !mo_accepts_gzip(request))
    return NULL;
  struct mo_packer *packer = calloc(1, sizeof(*packer));
  if (packer == NULL || !begin(&packer->stream)) {
    free(packer);
    return NULL;
  }
  mo_reply_mark_gzip(request);
  return packer;
}

int mo_packer_add(struct mo_packer *packer, const struct mo_text *piece, bool last,
                  struct mo_text *out)
{
  z_stream *stream = &packer->stream;
  char bytes[OUT_BYTES];
  stream->next_in = (Bytef *)piece->data;
  stream->avail_in = (uInt)piece->size;
  do {
    stream->next_out = (Bytef *)bytes;
    stream->avail_out = sizeof(bytes);
    deflate(stream, last ? Z_FINISH : Z_NO_FLUSH);
    mo_text_bytes(out, bytes, sizeof(bytes) - stream->avail_out);
  } while (stream->avail_out == 0);
  return piece->failed || out->failed ? MO_ERR_NO_MEMORY : MO_OK;
}

void mo_packer_free(struct mo_packer *packer)
{
  if (packer != NULL)
    deflateEnd(&packer->stream);
  free(packer);
}
