/* reply.h: creates and sends replies and problems. */
#ifndef MORPHO_HTTP_REPLY_H
#define MORPHO_HTTP_REPLY_H

#include "base/faults.h"
#include "base/text.h"
#include "http/request.h"

/* Writes a problem document (RFC 9457), which describes the faults of a request. Its type is the
 * path of a page that explains it: docs/problems.md has a section about each. faults nullable. */
void mo_problem_write(struct mo_text *text, unsigned status, const char *detail,
                      const char *instance, const char *request_id, const struct mo_faults *faults);

/* Adds a note to the log line of the request, which becomes a warning. */
void mo_request_note(struct mo_request *request, const char *format, ...)
    __attribute__((format(printf, 2, 3)));

void mo_reply_json(struct mo_request *request, unsigned status,
                   struct mo_text *text); /* takes over the text's data */
void mo_reply_static(struct mo_request *request, unsigned status, const char *type,
                     const char *body, size_t size);
void mo_reply_bytes(struct mo_request *request, unsigned status, const char *type, char *body,
                    size_t size);
/* Replies with bytes that are not copied: `release` is called on any thread once they are sent or
 * no longer needed. */
void mo_reply_borrowed(struct mo_request *request, const char *type, const void *body, size_t size,
                       void (*release)(void *owner), void *owner);
/* Replies with a problem document. faults: nullable. detail: if NULL, the detail of the first
 * fault, or the title of the status. */
void mo_reply_problem(struct mo_request *request, unsigned status, const struct mo_faults *faults,
                      const char *detail, ...) __attribute__((format(printf, 4, 5)));
/* Reply with a problem about one query parameter, or one header field (400). */
void mo_reply_bad_parameter(struct mo_request *request, const char *name, const char *words);
void mo_reply_bad_header(struct mo_request *request, const char *name, const char *words);
/* Replies with the usual problem of an error (500, 503, 507, 404 …). MO_ERR_NOT_FOUND: what is
 * missing is named by the first parameter of the path, if the path has any. */
void mo_reply_error(struct mo_request *request, int error, const char *what);
/* Replies that something with this name does not exist (404). */
void mo_reply_missing(struct mo_request *request, const char *what, const char *name);
/* Replies with JSON and its ETag, or with the problem of an error. */
void mo_reply_text(struct mo_request *request, int error, struct mo_text *text, const char *what);
/* Sets a strong ETag from parts, and status 304 if the client has that version, compressed or not.
 * Call it after making a reply of status 200. */
void mo_reply_etag(struct mo_request *request, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
/* Sets the ETag to the hash of the body, for status 200 and 201. */
void mo_reply_etag_of_body(struct mo_request *request);
/* Returns whether replies of this kind are compressed (pack.c). */
bool mo_reply_may_pack(const struct mo_request *request);
/* Returns whether the client accepts a compressed reply. */
bool mo_accepts_gzip(const struct mo_request *request);
/* Replies with embedded bytes, which the build has also compressed, and their ETag. */
struct mo_embedded {
  const void *plain;
  size_t size;
  const void *gzip;
  size_t gzip_size;
};
void mo_reply_embedded(struct mo_request *request, const char *type,
                       const struct mo_embedded *bytes, const char *tag, ...)
    __attribute__((format(printf, 4, 5)));
/* Marks a reply as compressed: the coding, and the ETag, which identifies the bytes. */
void mo_reply_mark_gzip(struct mo_request *request);
void mo_reply_extra(struct mo_request *request, const char *name, const char *format, ...)
    __attribute__((format(printf, 3, 4)));
void mo_reply_clear(struct mo_reply *reply);
/* Frees the request's body, and counts a large reply against the total and the client's memory
 * limit until it is sent: slow readers could otherwise hold any amount. A reply is always allowed
 * if nothing else is counted. Returns false if the reply is now a problem. */
bool mo_reply_reserve(struct mo_request *request, uint64_t bytes);
bool mo_reply_headers(struct mo_request *request, struct MHD_Response *response);
enum MHD_Result mo_reply_send(struct mo_request *request);

/* ---- pack.c: compresses replies with gzip, at the fastest level, if the client accepts it ----
 */

/* Compresses a complete reply of at least MO_PACK_BYTES if that saves a quarter of it. Call it on
 * an API thread. The reply's ETag gets a suffix, because it identifies the bytes. */
#define MO_PACK_BYTES 32768
void mo_pack_reply(struct mo_request *request);

/* Compresses a reply that is produced piece by piece. */
struct mo_packer;
#define MO_PACKER_BYTES 300000 /* memory of a packer */
/* Begins: marks the reply as compressed. Returns NULL if the reply stays plain. */
struct mo_packer *mo_packer_create(struct mo_request *request);
/* Compresses a piece and appends the output that is ready, possibly nothing; after the last piece,
 * all of it. */
int mo_packer_add(struct mo_packer *packer, const struct mo_text *piece, bool last,
                  struct mo_text *out);
void mo_packer_free(struct mo_packer *packer); /* NULL-safe */

/* last_reply.c: replies that bypass libmicrohttpd and end their connection. */
#define MO_HEADER_BYTES 16384
#define MO_HEADER_WORDS "the request line and header may have at most 16384 bytes together."
/* Sends request->reply. Call it on the I/O thread before any reply is queued; libmicrohttpd must
 * close the connection afterward. */
void mo_reply_last(struct mo_request *request);
bool mo_last_replies_init(void); /* false: libmicrohttpd's function is not found */
enum MHD_Result mo_queue_response(struct MHD_Connection *mhd, unsigned status,
                                  struct MHD_Response *response);

#endif
