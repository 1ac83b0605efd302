/* dispatch.c: libmicrohttpd's callbacks: the handling of a request from its first line to its
 * reply. See request.h for its lifecycle. */
#include "http/server.h"

#include <fcntl.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/sha256.h"
#include "http/query.h"

#define DEFAULT_BODY_BYTES (UINT64_C(64) << 10) /* for routes without large bodies */
#define PROGRESS_BYTES     16384                /* fewer bytes of a body count as no progress */
#define DRAIN_BYTES                                                                                \
  (UINT64_C(64) << 20) /* read of a refused body, so that the client gets the reply */

/* ---- start of a request ---- */

static void *on_target(void *context, const char *target, struct MHD_Connection *mhd)
{
  struct mo_http *http = context;
  const union MHD_ConnectionInfo *info =
      MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_SOCKET_CONTEXT);
  struct mo_connection *connection = info != NULL ? info->socket_context : NULL;
  if (connection == NULL)
    return NULL;
  mo_request_end(connection, false);
  struct mo_request *request = mo_request_begin(connection, mhd, target);
  /* The library would store the query parameters in the connection's memory, which can run out; it
   * would then not report the end of this request. No code here uses these parameters, so cut off
   * the query: `target` is the library's own buffer, whose query it parses next. */
  char *query = strchr(target, '?');
  if (query != NULL)
    query[1] = '\0';
  /* The request line has arrived: the rest of the header must follow. */
  int64_t now_us = mo_clock_us();
  atomic_store(&connection->deadline_us, now_us + (int64_t)http->config.header_timeout_ms * 1000);
  atomic_store(&connection->receiving, true);
  mo_connection_spare(connection, now_us);
  return request;
}

struct header_list {
  struct mo_header items[MO_HEADERS_MAX + 1];
  size_t n;
};

static enum MHD_Result collect(void *context, enum MHD_ValueKind kind, const char *name,
                               size_t name_size, const char *value, size_t value_size)
{
  (void)kind;
  struct header_list *list = context;
  if (list->n <= MO_HEADERS_MAX)
    list->items[list->n++] = (struct mo_header){name, value != NULL ? value : "", name_size,
                                                value != NULL ? value_size : 0};
  return MHD_YES;
}

static void refuse(struct mo_request *request, const struct mo_refusal *refusal)
{
  struct mo_faults faults = {0};
  if (refusal->header != NULL)
    mo_faults_add(&faults, MO_FAULT_HEADER, refusal->header, "%s", refusal->detail);
  mo_reply_problem(request, refusal->status, &faults, "The request is not acceptable: %s.",
                   refusal->detail);
  request->reply.close = refusal->close;
}

static uint64_t body_limit(const struct mo_request *request)
{
  const struct mo_http_config *config = &request->http->config;
  const uint64_t limits[] = {[MO_BODY_SMALL] = DEFAULT_BODY_BYTES,
                             [MO_BODY_LARGE] = config->max_body_bytes,
                             [MO_BODY_FILE] = config->max_file_bytes,
                             [MO_BODY_BUNDLE] = config->max_bundle_bytes};
  return limits[request->route->body];
}

/* Checks tokens and origins. */
static bool admitted(struct mo_request *request)
{
  struct mo_http *http = request->http;
  const struct mo_framing *framing = &request->framing;
  bool is_unix = request->connection->transport == MO_TRANSPORT_UNIX;
  const char *host = request->target.authority != NULL ? request->target.authority : framing->host;
  size_t host_size = request->target.authority != NULL ? request->target.authority_size
                     : host != NULL                    ? strlen(host)
                                                       : 0;
  struct mo_refusal refusal = {403, false, NULL, NULL};
  /* A unix socket has no name, so Host may be empty. Other hosts are checked even here: the socket
   * may be forwarded to a port that web pages can reach. */
  bool hosted = request->target.authority != NULL || (host != NULL && (host_size > 0 || !is_unix));
  const struct mo_route *route = request->route;
  const bool is_open =
      (route != NULL && (route->flags & MO_ROUTE_OPEN)) || request->method == MO_OPTIONS;
  /* Workers use the service's name in their cluster, so any Host is accepted. A web page that uses
   * DNS rebinding does not have their token, and a wrong token is rejected below. */
  const int known = http->config.token_if_any
                        ? mo_tokens_check(&http->tokens, framing->authorization, &request->caller)
                        : -1;
  const bool is_proven = known == 1 || (known == 0 && !is_open);
  if (hosted && !is_proven && !mo_guard_host(host, host_size, is_unix, &http->names)) {
    refusal.header = "Host";
    refusal.detail = "the service does not serve the host in the Host field";
  } else if (framing->origin != NULL &&
             !mo_guard_origin(framing->origin, framing->host, &http->names)) {
    refusal.header = "Origin";
    refusal.detail = "pages from this origin may not use the service";
  } else if (route != NULL && strncmp(route->path, "/v1/", 4) == 0 &&
             !mo_guard_fetch_site(framing->fetch_site)) {
    refusal.header = "Sec-Fetch-Site";
    refusal.detail = "pages from other sites may not use the service";
  }
  if (refusal.detail != NULL) {
    refuse(request, &refusal);
    return false;
  }
  if (route != NULL && is_open)
    return true;
  /* A client that needs no token has all rights. A client that sends a token has the token's name
   * and right. */
  request->caller.right = MO_RIGHT_ADMIN;
  bool needed = request->connection->transport == MO_TRANSPORT_TCP ||
                ((http->config.token_on_loopback || http->config.token_if_any) && !is_unix);
  int token = needed || framing->authorization != NULL
                  ? mo_tokens_check(&http->tokens, framing->authorization, &request->caller)
                  : -1;
  if (token == 1 || is_unix || (token == -1 && (!needed || http->config.token_if_any)))
    return true;
  atomic_fetch_add(&http->metrics.unauthorized, 1);
  mo_reply_problem(request, 401, NULL,
                   framing->authorization == NULL
                       ? "A bearer token is required: Authorization: Bearer <token>."
                       : "The Authorization field does not have a valid bearer token.");
  return false;
}

/* Checks that the caller has the right that the route needs. */
static bool permitted(struct mo_request *request)
{
  const struct mo_route *route = request->route;
  const struct mo_caller *caller = &request->caller;
  if ((route->flags & MO_ROUTE_OPEN) || caller->right >= route->right)
    return true;
  mo_reply_problem(request, 403, NULL,
                   "This requires the right \"%s\", but the token \"%s\" has only the right "
                   "\"%s\". The service's operator can issue a token with more rights.",
                   mo_right_words[route->right], caller->name, mo_right_words[caller->right]);
  return false;
}

/* Makes all decisions that depend only on the header. A refusal is in request->reply. */
static void begin(struct mo_request *request, struct MHD_Connection *mhd, const char *method,
                  const char *version)
{
  struct mo_refusal refusal = {431, true, NULL, "the header is too large; " MO_HEADER_WORDS};
  const union MHD_ConnectionInfo *info =
      MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_REQUEST_HEADER_SIZE);
  struct header_list list = {.n = 0};
  size_t n = 0;
  for (; method[n] != '\0' && n < sizeof(request->method_text) - 1; n++)
    request->method_text[n] =
        (unsigned char)method[n] > 0x20 && (unsigned char)method[n] < 0x7F ? method[n] : '?';
  request->method = mo_method_of(method);
  if (request->raw_target == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    request->reply.close = true;
    return;
  }
  MHD_get_connection_values_n(mhd, MHD_HEADER_KIND, collect, &list);
  bool good = info != NULL && info->header_size <= MO_HEADER_BYTES &&
              mo_guard_headers(list.items, list.n, strcmp(version, "HTTP/1.0") == 0,
                               &request->framing, &refusal) &&
              mo_guard_target(request->raw_target, &request->target, &refusal);
  if (!good) {
    refuse(request, &refusal);
    return;
  }
  const struct mo_routes *routes = &request->http->service.routes;
  const struct mo_route *path =
      mo_route_find(routes, request->target.path, request->target.path_size, request->parameters);
  const struct mo_route *route = mo_route_of_method(routes, path, request->method);
  request->route = route != NULL ? route : path;
  if (!admitted(request))
    return;
  bool star = request->method == MO_OPTIONS && strcmp(request->raw_target, "*") == 0;
  if (path == NULL && !star) {
    mo_reply_problem(request, 404, NULL,
                     "This path does not exist; /openapi.json lists all paths.");
    return;
  }
  if (request->connection->place == MO_PLACE_HEALTH &&
      (path == NULL || !(path->flags & MO_ROUTE_HEALTH))) {
    mo_reply_problem(request, 503, NULL,
                     "All connections of the service are in use; try again later.");
    request->reply.close = true;
    return;
  }
  if (request->method == MO_OPTIONS) {
    mo_reply_static(request, 204, NULL, "", 0);
    if (!star)
      mo_route_allow(routes, path, request->reply.allow);
    return;
  }
  if (route == NULL) {
    mo_reply_problem(request, 405, NULL, "This path does not support the method %s.",
                     request->method_text);
    mo_route_allow(routes, path, request->reply.allow);
    return;
  }
  request->body_limit = body_limit(request);
  if (!permitted(request))
    return;
  if (route->body != MO_BODY_SMALL && !request->framing.has_length && !request->framing.chunked)
    mo_reply_problem(
        request, 411, NULL,
        "The length of the body is missing; send Content-Length, or use chunked coding.");
  else if (request->framing.has_length && request->framing.length > request->body_limit)
    mo_reply_problem(request, 413, NULL, "The body has %llu bytes; this path accepts at most %llu.",
                     (unsigned long long)request->framing.length,
                     (unsigned long long)request->body_limit);
}

/* ---- the body ---- */

static enum MHD_Result receive(struct mo_request *request, const char *bytes, size_t n)
{
  if (request->body_seen / PROGRESS_BYTES != (request->body_seen + n) / PROGRESS_BYTES)
    mo_connection_spare(request->connection, mo_clock_us());
  request->body_seen += n;
  atomic_fetch_add(&request->http->metrics.body_in, n);
  if (request->reply.status == 0) {
    int error =
        request->body_seen > request->body_limit ? MO_ERR_RANGE : mo_body_add(request, bytes, n);
    if (error == MO_ERR_CANCELLED) {
      return MHD_NO;
    } else if (error == MO_ERR_RANGE) {
      mo_reply_problem(request, 413, NULL,
                       "The body is too large; this path accepts at most %llu bytes.",
                       (unsigned long long)request->body_limit);
    } else if (error == MO_ERR_LIMIT) {
      mo_reply_problem(
          request, 429, NULL,
          "The bodies of this client's requests in flight already use half of the memory for "
          "all clients, which is the limit.");
    } else if (error != MO_OK) {
      mo_reply_error(request, error, "request");
    }
    if (error != MO_OK)
      mo_request_drop_body(request);
  }
  if (request->body_seen <= request->body_limit + DRAIN_BYTES)
    return MHD_YES;
  mo_reply_last(request);
  return MHD_NO;
}

/* ---- dispatch ---- */

/* Sets the key of the client for places and turns: the connection's client and the token. */
static void name_client(struct mo_request *request)
{
  unsigned char whole[16 + sizeof(request->caller.name)];
  struct mo_sha256 hash;
  memcpy(whole, request->connection->client_key, 16);
  memcpy(whole + 16, request->caller.name, sizeof(request->caller.name));
  mo_sha256_of(whole, sizeof(whole), &hash);
  memcpy(request->client_key, &hash, sizeof(request->client_key));
}

/* Dispatches a complete request: takes a place of its client, then queues it for the API pool. */
static enum MHD_Result dispatch(struct mo_request *request)
{
  struct mo_http *http = request->http;
  bool refused = false;
  if (request->route->flags & MO_ROUTE_DIRECT) {
    if (mo_query_begin(request))
      request->route->handler(request);
    return mo_reply_send(request);
  }
  if (request->body == NULL && (request->body = calloc(1, 1)) == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    return mo_reply_send(request);
  }
  name_client(request);
  request->client =
      mo_client_enter(&http->clients, request->client_key, http->config.max_in_flight, &refused);
  if (request->client == NULL) {
    if (refused)
      mo_reply_problem(request, 429, NULL,
                       "This client already has %s in flight, which is the limit.",
                       MO_COUNTED(http->config.max_in_flight, "request"));
    else
      mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    return mo_reply_send(request);
  }
  if ((request->route->flags & MO_ROUTE_RATED) &&
      !mo_client_spend(&http->clients, request->client, http->config.client_rate_per_s,
                       mo_clock_us())) {
    mo_reply_problem(request, 429, NULL,
                     "This client has sent more than %u submissions and uploads in one second, "
                     "which is the limit; try again later.",
                     http->config.client_rate_per_s);
    return mo_reply_send(request);
  }
  int error = mo_pool_give(http, request);
  if (error == MO_OK)
    return MHD_YES;
  mo_reply_error(request, error, "request");
  return mo_reply_send(request);
}

static enum MHD_Result on_request(void *context, struct MHD_Connection *mhd, const char *url,
                                  const char *method, const char *version, const char *bytes,
                                  size_t *size, void **state)
{
  (void)context;
  (void)url;
  struct mo_request *request = *state;
  if (request == NULL)
    return MHD_NO; /* out of memory for the request */
  switch (request->stage) {
  case MO_STAGE_TARGET:
    request->started_us = mo_clock_us();
    atomic_store(&request->connection->deadline_us,
                 request->started_us + (int64_t)request->http->config.body_timeout_ms * 1000);
    mo_connection_spare(request->connection, request->started_us);
    begin(request, mhd, method, version);
    request->stage = MO_STAGE_BODY;
    if (request->reply.close) {
      mo_reply_last(request);
      return MHD_NO;
    }
    /* Reply before the body only if the client waits for that (100-continue) or the body is too
     * long to read and discard. */
    if (request->reply.status == 0 ||
        (!request->framing.expects_continue && request->framing.length <= DRAIN_BYTES))
      return MHD_YES;
    request->reply.close = true;
    request->stage = MO_STAGE_REPLY;
    return mo_connection_spare(request->connection, MO_NEVER) ? mo_reply_send(request) : MHD_NO;
  case MO_STAGE_BODY:
    if (*size > 0) {
      enum MHD_Result result = receive(request, bytes, *size);
      *size = 0;
      return result;
    }
    atomic_store(&request->connection->deadline_us, MO_NEVER);
    if (!mo_body_end(request) ||
        !mo_connection_spare(request->connection, MO_NEVER)) /* already cut: no reply */
      return MHD_NO;
    if (request->reply.status != 0) {
      request->stage = MO_STAGE_REPLY;
      return mo_reply_send(request);
    }
    return dispatch(request);
  case MO_STAGE_HANDLING: return MHD_YES; /* not called while suspended */
  case MO_STAGE_REPLY:
    if (*size > 0) {
      *size = 0;
      return MHD_YES;
    }
    return mo_reply_send(request);
  }
  return MHD_NO;
}

/* ---- ends of requests and connections ---- */

static void on_completed(void *context, struct MHD_Connection *mhd, void **state,
                         enum MHD_RequestTerminationCode why)
{
  (void)context;
  (void)mhd;
  struct mo_request *request = *state;
  *state = NULL;
  if (request != NULL)
    mo_request_end(request->connection, why == MHD_REQUEST_TERMINATED_COMPLETED_OK);
}

static void on_connection(void *context, struct MHD_Connection *mhd, void **socket_context,
                          enum MHD_ConnectionNotificationCode what)
{
  struct mo_http *http = context;
  struct mo_connection *connection = *socket_context;
  if (what == MHD_CONNECTION_NOTIFY_STARTED) {
    const union MHD_ConnectionInfo *info =
        MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_CONNECTION_FD);
    *socket_context = connection = info != NULL ? mo_connection_find(http, info->connect_fd) : NULL;
    if (connection != NULL)
      connection->http = http;
  } else if (connection != NULL) {
    mo_request_end(connection, false); /* after some errors the library does not report the end of a
                                          request */
    int fd = connection->lingers ? fcntl(connection->fd, F_DUPFD_CLOEXEC, 0) : -1;
    if (fd >= 0)
      mo_linger_add(&http->lingering, fd);
    mo_connection_forget(http, connection); /* before the library closes the descriptor */
    *socket_context = NULL;
  }
}

/* Discards the library's own messages, which its replies repeat. */
static void on_log(void *context, const char *format, va_list arguments)
{
  (void)context;
  (void)format;
  (void)arguments;
}

/* Leaves percent escapes in place: they are decoded later, per segment. */
static size_t on_unescape(void *context, struct MHD_Connection *mhd, char *text)
{
  (void)context;
  (void)mhd;
  return strlen(text);
}

/* ---- start ---- */

int mo_daemon_start(struct mo_http *http, struct mo_message *message)
{
  /* The library's limit on connections is too high to be reached: the acceptor enforces the limit,
   * because it replies. */
  struct MHD_OptionItem tls[] = {
      {MHD_OPTION_HTTPS_MEM_CERT, 0, (void *)http->config.certificate},
      {MHD_OPTION_HTTPS_MEM_KEY, 0, (void *)http->config.key},
      {MHD_OPTION_HTTPS_PRIORITIES, 0, (void *)"NORMAL:-VERS-ALL:+VERS-TLS1.3"},
      {MHD_OPTION_END, 0, NULL}};
  http->daemon = MHD_start_daemon(
      MHD_USE_EPOLL_INTERNAL_THREAD | MHD_ALLOW_SUSPEND_RESUME | MHD_USE_NO_LISTEN_SOCKET |
          MHD_USE_ERROR_LOG | (http->is_tls ? MHD_USE_TLS : 0),
      0, NULL, NULL, on_request, http, MHD_OPTION_EXTERNAL_LOGGER, on_log, NULL,
      MHD_OPTION_THREAD_POOL_SIZE, (unsigned)http->config.n_io_threads, MHD_OPTION_CONNECTION_LIMIT,
      (unsigned)(http->config.max_connections + 64) * http->config.n_io_threads,
      MHD_OPTION_CONNECTION_TIMEOUT, (unsigned)(http->config.idle_timeout_ms / 1000 + 60),
      MHD_OPTION_CONNECTION_MEMORY_LIMIT, (size_t)32768, MHD_OPTION_URI_LOG_CALLBACK, on_target,
      http, MHD_OPTION_UNESCAPE_CALLBACK, on_unescape, NULL, MHD_OPTION_STRICT_FOR_CLIENT, 1,
      MHD_OPTION_NOTIFY_COMPLETED, on_completed, http, MHD_OPTION_NOTIFY_CONNECTION, on_connection,
      http, MHD_OPTION_ARRAY, http->is_tls ? tls : &tls[3], MHD_OPTION_END);
  return http->daemon != NULL ? MO_OK
                              : mo_fail(message, MO_ERR_NO_MEMORY, "cannot start the HTTP threads");
}
