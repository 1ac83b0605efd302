/* reply.c: creates replies and problems, and passes them to libmicrohttpd. */
#include <dlfcn.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/sha256.h"
#include "http/field.h"
#include "http/server.h"

#define ETAG_GZIP   "-gzip"              /* ends the tag of a compressed reply */
#define SMALL_BYTES ((uint64_t)64 << 10) /* smaller replies ignore the memory limit */

void mo_reply_clear(struct mo_reply *reply)
{
  free(reply->body);
  if (reply->release != NULL)
    reply->release(reply->owner);
  *reply = (struct mo_reply){0};
}

void mo_reply_bytes(struct mo_request *request, unsigned status, const char *type, char *body,
                    size_t size)
{
  mo_reply_clear(&request->reply);
  request->reply.status = status;
  request->reply.type = type;
  request->reply.body = body;
  request->reply.size = size;
}

void mo_reply_static(struct mo_request *request, unsigned status, const char *type,
                     const char *body, size_t size)
{
  mo_reply_bytes(request, status, type, NULL, size);
  request->reply.fixed = body;
}

void mo_reply_borrowed(struct mo_request *request, const char *type, const void *body, size_t size,
                       void (*release)(void *owner), void *owner)
{
  mo_reply_static(request, 200, type, body, size);
  request->reply.release = release;
  request->reply.owner = owner;
}

void mo_reply_json(struct mo_request *request, unsigned status, struct mo_text *text)
{
  if (text->failed) {
    mo_text_free(text);
    mo_reply_problem(request, 503, NULL, "Not enough memory for the reply; try again later.");
    request->reply.retry_after_s = 5;
    return;
  }
  mo_text_bytes(text, "\n", 1);
  mo_reply_bytes(request, status, "application/json", text->data, text->size);
  *text = (struct mo_text){0};
}

void mo_request_note(struct mo_request *request, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(request->reason, sizeof(request->reason), format, arguments);
  va_end(arguments);
}

void mo_reply_problem(struct mo_request *request, unsigned status, const struct mo_faults *faults,
                      const char *detail, ...)
{
  char words[MO_REASON_BYTES];
  if (detail != NULL) {
    va_list arguments;
    va_start(arguments, detail);
    vsnprintf(words, sizeof(words), detail, arguments);
    va_end(arguments);
  } else if (faults != NULL && faults->n > 0) {
    snprintf(words, sizeof(words), "%s%s%s", faults->items[0].where,
             faults->items[0].where[0] != '\0' ? ": " : "", faults->items[0].detail);
  } else {
    snprintf(words, sizeof(words), "%s.", MHD_get_reason_phrase_for(status));
  }
  if (status >= 500)
    mo_request_note(request, "%s", words);
  struct mo_text text = {0};
  mo_problem_write(&text, status, words, request->path, request->id, faults);
  mo_text_bytes(&text, "\n", 1);
  static const char bare[] =
      "{\"type\":\"/problems/unavailable\",\"title\":\"Service Unavailable\",\"status\":503,"
      "\"detail\":\"Out of memory.\",\"instance\":\"\",\"request_id\":\"0000000000000000\"}\n";
  if (text.failed) {
    mo_text_free(&text);
    mo_reply_static(request, 503, "application/problem+json", bare, sizeof(bare) - 1);
  } else {
    mo_reply_bytes(request, status, "application/problem+json", text.data, text.size);
  }
  if (request->reply.status == 503 || status == 507 || status == 429)
    request->reply.retry_after_s = status == 507 ? 30 : 1;
}

static void reply_fault(struct mo_request *request, enum mo_fault_place place, const char *name,
                        const char *words)
{
  struct mo_faults faults = {0};
  mo_faults_add(&faults, place, name, "%s", words);
  mo_reply_problem(request, 400, &faults, NULL);
}

void mo_reply_bad_parameter(struct mo_request *request, const char *name, const char *words)
{
  reply_fault(request, MO_FAULT_PARAMETER, name, words);
}

void mo_reply_bad_header(struct mo_request *request, const char *name, const char *words)
{
  reply_fault(request, MO_FAULT_HEADER, name, words);
}

void mo_reply_missing(struct mo_request *request, const char *what, const char *name)
{
  mo_reply_problem(request, 404, NULL, "There is no %s \"%s\".", what, MO_SHOWN(name));
}

void mo_reply_error(struct mo_request *request, int code, const char *what)
{
  static const struct {
    int code;
    unsigned status, retry_after_s; /* 0: the default of the status */
    const char *words;
  } errors[] = {
      {MO_ERR_NOT_FOUND, 404, 0, "This %s does not exist."},
      {MO_ERR_CONFLICT, 409, 0, "The state of the %s does not allow this."},
      {MO_ERR_NO_SPACE, 507, 0,
       "The disk of the service is full. Nothing was stored; try again when there is space."},
      {MO_ERR_BUSY, 503, 5, "The service is too busy; try again later."},
      {MO_ERR_NO_MEMORY, 503, 5, "The service is too busy; try again later."},
      {MO_ERR_CANCELLED, 503, 10, "The service is stopping; try again when it is back."},
      {MO_ERR_IO, 503, 30,
       "The service cannot read or write its store; its operator has been notified."},
      {0, 500, 0, "The service failed to handle the %s: %s. Its log has the request's id."}};
  if (code == MO_ERR_NOT_FOUND && request->route != NULL &&
      strchr(request->route->path, '{') != NULL) {
    mo_reply_missing(request, what, request->parameters[0]);
    return;
  }
  size_t i = 0;
  while (errors[i].code != code && errors[i].code != 0)
    i++;
  mo_reply_problem(request, errors[i].status, NULL, errors[i].words, what, mo_error_text(code));
  if (errors[i].retry_after_s > 0)
    request->reply.retry_after_s = errors[i].retry_after_s;
}

static void set_etag(struct mo_request *request, const char *format, va_list arguments)
{
  struct mo_reply *reply = &request->reply;
  char tag[sizeof(reply->etag) - sizeof(ETAG_GZIP) - 1], packed[sizeof(reply->etag)];
  vsnprintf(tag, sizeof(tag), format, arguments);
  snprintf(reply->etag, sizeof(reply->etag), "\"%s\"", tag);
  snprintf(packed, sizeof(packed), "\"%s" ETAG_GZIP "\"", tag);
  if (reply->status != 200 || (request->method != MO_GET && request->method != MO_HEAD))
    return;
  /* The client may have the plain or the compressed form. */
  if (mo_etag_matches(request->framing.if_none_match, reply->etag)) {
    reply->status = 304;
  } else if (mo_etag_matches(request->framing.if_none_match, packed)) {
    reply->status = 304;
    memcpy(reply->etag, packed, sizeof(packed));
  }
}

void mo_reply_etag(struct mo_request *request, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  set_etag(request, format, arguments);
  va_end(arguments);
}

void mo_reply_etag_of_body(struct mo_request *request)
{
  struct mo_sha256 hash;
  if (request->reply.status != 200 && request->reply.status != 201)
    return;
  mo_sha256_of(request->reply.body, request->reply.size, &hash);
  mo_reply_etag(request, "%.32s", MO_SHA256_HEX(&hash));
}

void mo_reply_text(struct mo_request *request, int error, struct mo_text *text, const char *what)
{
  if (error != MO_OK) {
    mo_text_free(text);
    mo_reply_error(request, error, what);
    return;
  }
  mo_reply_json(request, 200, text);
  mo_reply_etag_of_body(request);
}

void mo_reply_extra(struct mo_request *request, const char *name, const char *format, ...)
{
  struct mo_reply *reply = &request->reply;
  if (reply->n_extra == sizeof(reply->extra) / sizeof(reply->extra[0]))
    return;
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(reply->extra[reply->n_extra].value, sizeof(reply->extra[0].value), format, arguments);
  va_end(arguments);
  reply->extra[reply->n_extra++].name = name;
}

bool mo_accepts_gzip(const struct mo_request *request)
{
  return mo_accept_coding(request->framing.accept_encoding, "gzip");
}

void mo_reply_mark_gzip(struct mo_request *request)
{
  struct mo_reply *reply = &request->reply;
  const size_t size = strlen(reply->etag);
  if (size > 0)
    snprintf(reply->etag + size - 1, sizeof(reply->etag) - size + 1, ETAG_GZIP "\"");
  mo_reply_extra(request, "Content-Encoding", "gzip");
}

void mo_reply_embedded(struct mo_request *request, const char *type,
                       const struct mo_embedded *bytes, const char *tag, ...)
{
  const bool packed = mo_accepts_gzip(request);
  va_list arguments;
  mo_reply_static(request, 200, type, packed ? bytes->gzip : bytes->plain,
                  packed ? bytes->gzip_size : bytes->size);
  va_start(arguments, tag);
  set_etag(request, tag, arguments);
  va_end(arguments);
  if (packed && request->reply.status == 200)
    mo_reply_mark_gzip(request);
  mo_reply_extra(request, "Vary", "Accept-Encoding");
}

bool mo_reply_may_pack(const struct mo_request *request)
{
  static const char *const types[] = {"application/json", "application/x-ndjson", "text/csv",
                                      "text/x-nh"};
  const char *type = request->reply.type;
  bool suits = request->reply.packs;
  for (size_t i = 0; type != NULL && i < sizeof(types) / sizeof(types[0]); i++)
    suits = suits || strncmp(type, types[i], strlen(types[i])) == 0;
  return suits && request->route != NULL && !(request->route->flags & MO_ROUTE_DIRECT);
}

static bool add(struct MHD_Response *response, const char *name, const char *value)
{
  return value[0] == '\0' || MHD_add_response_header(response, name, value) == MHD_YES;
}

bool mo_reply_headers(struct mo_request *request, struct MHD_Response *response)
{
  const struct mo_reply *reply = &request->reply;
  char retry[16] = "";
  if (reply->retry_after_s > 0)
    snprintf(retry, sizeof(retry), "%u", reply->retry_after_s);
  bool has_type = reply->status != 204 && reply->status != 304;
  bool good =
      add(response, "X-Request-Id", request->id) &&
      add(response, "X-Content-Type-Options", "nosniff") &&
      add(response, "Content-Type", has_type && reply->type != NULL ? reply->type : "") &&
      add(response, "Cache-Control",
          reply->keep              ? "private, max-age=31536000, immutable"
          : reply->etag[0] != '\0' ? "no-cache"
                                   : "no-store") &&
      add(response, "Content-Security-Policy",
          reply->policy != NULL ? reply->policy : "frame-ancestors 'none'") &&
      add(response, "Cross-Origin-Opener-Policy", "same-origin") &&
      add(response, "Cross-Origin-Resource-Policy", "same-origin") &&
      add(response, "ETag", reply->etag) && add(response, "Location", reply->location) &&
      add(response, "Retry-After", retry) && add(response, "Allow", reply->allow) &&
      add(response, "Preference-Applied", reply->applied) &&
      add(response, "WWW-Authenticate", reply->status == 401 ? "Bearer realm=\"morphod\"" : "") &&
      add(response, "Connection", reply->close ? "close" : "");
  const bool by_type = request->route != NULL && (request->route->flags & MO_ROUTE_VARY);
  const bool by_coding =
      (reply->status == 200 || reply->status == 304) && mo_reply_may_pack(request);
  good = good && add(response, "Vary",
                     by_type && by_coding ? "Accept, Accept-Encoding"
                     : by_type            ? "Accept"
                     : by_coding          ? "Accept-Encoding"
                                          : "");
  for (unsigned i = 0; i < reply->n_extra; i++)
    good = good && add(response, reply->extra[i].name, reply->extra[i].value);
  return good;
}

/* ---- sending ---- */

/* libmicrohttpd's own MHD_queue_response, which last_reply.c replaces in this program. */
static enum MHD_Result (*library_queue)(struct MHD_Connection *mhd, unsigned status,
                                        struct MHD_Response *response);

static void find_library_queue(void)
{
  void *found = dlsym(RTLD_NEXT, "MHD_queue_response");
  memcpy(&library_queue, &found, sizeof(library_queue));
}

bool mo_last_replies_init(void)
{
  static pthread_once_t once = PTHREAD_ONCE_INIT;
  return pthread_once(&once, find_library_queue) == 0 && library_queue != NULL;
}

enum MHD_Result mo_queue_response(struct MHD_Connection *mhd, unsigned status,
                                  struct MHD_Response *response)
{
  return library_queue(mhd, status, response);
}

bool mo_reply_reserve(struct mo_request *request, uint64_t bytes)
{
  struct mo_http *http = request->http;
  mo_request_drop_body(request);
  struct mo_client *client = mo_client_hold(&http->clients, request->connection->client_key, 0,
                                            bytes, mo_body_memory_of_client(request));
  if (client != NULL && mo_body_memory_take(http, 0, bytes, false)) {
    request->body_client = client;
    request->body_reserved = bytes;
    return true;
  }
  if (client != NULL)
    mo_client_give_back(&http->clients, client, bytes, mo_clock_us());
  if (client == NULL && !(request->route->flags & MO_ROUTE_DIRECT))
    mo_reply_problem(
        request, 429, NULL,
        "The replies that this client has not read yet, and its requests' bodies, would take more "
        "than half of the memory for all clients, which is the limit; read them first.");
  else
    mo_reply_problem(request, 503, NULL, "Too many large replies are being read; try again later.");
  request->reply.retry_after_s = 5;
  return false;
}

enum MHD_Result mo_reply_send(struct mo_request *request)
{
  struct mo_reply *reply = &request->reply;
  struct MHD_Response *response;
  if (request->reader == NULL)
    mo_request_drop_body(request);
  if (request->reader == NULL && reply->body != NULL && reply->size > SMALL_BYTES)
    (void)mo_reply_reserve(request, reply->size);
  bool empty = reply->status == 204;
  if (request->reader != NULL)
    response = MHD_create_response_from_callback(MHD_SIZE_UNKNOWN,
                                                 request->stream != NULL ? 16 * 1024 : 64 * 1024,
                                                 request->reader, request, NULL);
  else if (reply->release != NULL)
    response = MHD_create_response_from_buffer_with_free_callback_cls(
        reply->size, (void *)reply->fixed, reply->release, reply->owner);
  else if (empty || reply->body == NULL)
    response = MHD_create_response_from_buffer(
        empty ? 0 : reply->size, (void *)(empty ? "" : reply->fixed), MHD_RESPMEM_PERSISTENT);
  else
    response = MHD_create_response_from_buffer(reply->size, reply->body, MHD_RESPMEM_MUST_FREE);
  if (response == NULL)
    return MHD_NO;
  if (!empty)
    reply->body = NULL; /* the response owns it now */
  reply->release = NULL;
  /* For these, the library sends only the length of the body. */
  request->sent = request->method == MO_HEAD || reply->status == 304 || empty ? 0 : reply->size;
  /* Slow readers are cut off after a minute, plus a second for every 64 KiB. Streams and downloads
   * are timed piece by piece. */
  atomic_store(&request->connection->deadline_us,
               request->stream != NULL
                   ? MO_NEVER
                   : mo_clock_us() + 60000000 + (int64_t)(reply->size >> 16) * 1000000);
  if (atomic_load(&request->http->stopping))
    reply->close = true;
  request->connection->lingers |= reply->close;
  enum MHD_Result result = mo_reply_headers(request, response)
                               ? mo_queue_response(request->mhd, reply->status, response)
                               : MHD_NO;
  MHD_destroy_response(response);
  return result;
}
