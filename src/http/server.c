/* server.c: libmicrohttpd's callbacks, and start and stop. See http.h for the threads and server.h
 * for the life of a request. */
#include "http/server.h"

#include <fcntl.h>
#include <malloc.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <time.h>
#include <unistd.h>

#include "base/clock.h"
#include "base/processors.h"
#include "http/download.h"
#include "http/query.h"

#define DEFAULT_BODY_BYTES (UINT64_C(64) << 10) /* of routes that need no large body */
#define MANY_CONNECTIONS   64    /* from so many on, freed memory is returned to the system */
#define PROGRESS_BYTES     16384 /* fewer bytes of a body count as no progress */
#define DRAIN_BYTES                                                                                \
  (UINT64_C(64) << 20) /* of a refused body are read, so that the refusal reaches the client */

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
  /* The library would list the query parameters in the connection's memory, could run out of it,
   * and would then not report the end of this request. No code here uses that list, so cut off the
   * query: `target` is the library's own buffer, whose query it parses next. */
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
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  if (faults != NULL && refusal->header != NULL)
    mo_faults_add(faults, MO_FAULT_HEADER, refusal->header, "%s", refusal->detail);
  mo_reply_problem(request, refusal->status, faults, "The request is not acceptable: %s.",
                   refusal->detail);
  request->reply.close = refusal->close;
  free(faults);
}

static uint64_t body_limit(const struct mo_request *request)
{
  const struct mo_http_config *config = &request->http->config;
  switch (request->route->body) {
  case MO_BODY_LARGE: return config->max_body_bytes;
  case MO_BODY_FILE: return config->max_file_bytes;
  default: return DEFAULT_BODY_BYTES;
  }
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
  if (hosted && !mo_guard_host(host, host_size, is_unix, &http->names)) {
    refusal.header = "Host";
    refusal.detail = "the Host field names a host that this service does not serve";
  } else if (framing->origin != NULL &&
             !mo_guard_origin(framing->origin, framing->host, &http->names)) {
    refusal.header = "Origin";
    refusal.detail = "pages of this origin may not use the service";
  } else if (request->route != NULL && strncmp(request->route->path, "/v1/", 4) == 0 &&
             !mo_guard_fetch_site(framing->fetch_site)) {
    refusal.header = "Sec-Fetch-Site";
    refusal.detail = "pages of other sites may not use the service";
  }
  if (refusal.detail != NULL) {
    refuse(request, &refusal);
    return false;
  }
  const struct mo_route *route = request->route;
  if (is_unix || (route != NULL && (route->flags & MO_ROUTE_OPEN)) ||
      (route != NULL && request->method == MO_OPTIONS))
    return true;
  bool needed =
      request->connection->transport == MO_TRANSPORT_TCP || http->config.token_on_loopback;
  int token = needed || framing->authorization != NULL
                  ? mo_tokens_check(&http->tokens, framing->authorization)
                  : -1;
  if (token == 1 || (token == -1 && !needed))
    return true;
  atomic_fetch_add(&http->metrics.unauthorized, 1);
  mo_reply_problem(request, 401, NULL,
                   framing->authorization == NULL
                       ? "A bearer token is needed: Authorization: Bearer <token>."
                       : "The Authorization field has no valid bearer token.");
  return false;
}

/* Decides everything that the complete header allows. A refusal is in request->reply. */
static void begin(struct mo_request *request, struct MHD_Connection *mhd, const char *method,
                  const char *version)
{
  struct mo_refusal refusal = {431, true, NULL, "the header is too large; " MO_HEADER_WORDS};
  const union MHD_ConnectionInfo *info =
      MHD_get_connection_info(mhd, MHD_CONNECTION_INFO_REQUEST_HEADER_SIZE);
  struct header_list *list = malloc(sizeof(*list));
  size_t n = 0;
  for (; method[n] != '\0' && n < sizeof(request->method_text) - 1; n++)
    request->method_text[n] =
        (unsigned char)method[n] > 0x20 && (unsigned char)method[n] < 0x7F ? method[n] : '?';
  request->method = mo_method_of(method);
  if (list == NULL || request->raw_target == NULL) {
    free(list);
    mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    request->reply.close = true;
    return;
  }
  list->n = 0;
  MHD_get_connection_values_n(mhd, MHD_HEADER_KIND, collect, list);
  bool good = info != NULL && info->header_size <= MO_HEADER_BYTES &&
              mo_guard_headers(list->items, list->n, strcmp(version, "HTTP/1.0") == 0,
                               &request->framing, &refusal) &&
              mo_guard_target(request->raw_target, &request->target, &refusal);
  free(list);
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
                     "There is nothing at this path; /openapi.json lists what there is.");
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
    mo_reply_problem(request, 405, NULL, "The method %s is not for this path.",
                     request->method_text);
    mo_route_allow(routes, path, request->reply.allow);
    return;
  }
  request->body_limit = body_limit(request);
  if (route->body != MO_BODY_SMALL && !request->framing.has_length && !request->framing.chunked)
    mo_reply_problem(
        request, 411, NULL,
        "The length of the body is missing: Content-Length or chunked coding is expected.");
  else if (request->framing.has_length && request->framing.length > request->body_limit)
    mo_reply_problem(request, 413, NULL, "The body has %llu bytes; this path takes at most %llu.",
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
                       "The body has more bytes than this path takes, which is %llu.",
                       (unsigned long long)request->body_limit);
    } else if (error == MO_ERR_LIMIT) {
      mo_reply_problem(
          request, 429, NULL,
          "The bodies of this client's requests that are under way take half of the memory for all "
          "clients, which is as much as is allowed.");
      request->reply.retry_after_s = 1;
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

/* Dispatches a complete request: takes a place of its client, then queues it for the API pool. */
static enum MHD_Result dispatch(struct mo_request *request)
{
  struct mo_http *http = request->http;
  bool refused = false, closed = false;
  if (request->route->flags & MO_ROUTE_DIRECT) {
    if (mo_query_begin(request))
      request->route->handler(request);
    return mo_reply_send(request);
  }
  if (request->body == NULL && (request->body = calloc(1, 1)) == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    return mo_reply_send(request);
  }
  request->client = mo_client_enter(&http->clients, request->connection->client_key,
                                    http->config.max_in_flight, &refused);
  if (request->client == NULL) {
    if (refused)
      mo_reply_problem(request, 429, NULL,
                       "This client has %u requests under way, which is as many as are allowed.",
                       http->config.max_in_flight);
    else
      mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    request->reply.retry_after_s = 1;
    return mo_reply_send(request);
  }
  if ((request->route->flags & MO_ROUTE_RATED) &&
      !mo_client_spend(&http->clients, request->client, http->config.client_rate_per_s,
                       mo_clock_us())) {
    mo_reply_problem(request, 429, NULL,
                     "This client has sent more than %u submissions and uploads in a second.",
                     http->config.client_rate_per_s);
    request->reply.retry_after_s = 1;
    return mo_reply_send(request);
  }
  if (mo_pool_give(http, request, &closed))
    return MHD_YES;
  mo_reply_error(request, closed ? MO_ERR_CANCELLED : MO_ERR_BUSY, "request");
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
    return MHD_NO; /* there was no memory for it */
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
    if (request->reply.status != 0) {
      /* Reply before the body only if the client waits for that (100-continue) or the body is too
       * long to read and discard. */
      if (request->framing.expects_continue || request->framing.length > DRAIN_BYTES) {
        request->reply.close = true;
        request->stage = MO_STAGE_REPLY;
        return mo_connection_spare(request->connection, MO_NEVER) ? mo_reply_send(request) : MHD_NO;
      }
    }
    return MHD_YES;
  case MO_STAGE_BODY:
    if (*size > 0) {
      enum MHD_Result result = receive(request, bytes, *size);
      *size = 0;
      return result;
    }
    atomic_store(&request->connection->deadline_us, MO_NEVER);
    if (!mo_body_end(request) ||
        !mo_connection_spare(request->connection, MO_NEVER)) /* no reply: nothing is done */
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
    return request->stream != NULL     ? mo_stream_send(request)
           : request->download != NULL ? mo_download_send(request)
                                       : mo_reply_send(request);
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
    mo_request_end(connection, false); /* after some errors the library does not report its end */
    int fd = connection->lingers ? fcntl(connection->fd, F_DUPFD_CLOEXEC, 0) : -1;
    if (fd >= 0)
      mo_linger_add(&http->lingering, fd);
    mo_connection_forget(http, connection); /* before the library closes the descriptor */
    *socket_context = NULL;
  }
}

/* Discards the library's own messages: its replies say the same. */
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

/* ---- the clock ---- */

/* Returns memory to the system when most of many connections have ended; malloc would keep it. */
static void trim_memory(uint32_t n_connections, uint32_t *peak)
{
  if (n_connections > *peak)
    *peak = n_connections;
  if (*peak < MANY_CONNECTIONS || n_connections > *peak / 4)
    return;
  malloc_trim(0);
  *peak = n_connections;
}

static void *clock_thread(void *context)
{
  struct mo_http *http = context;
  int64_t second_us = 0;
  uint32_t peak = 0;
  while (!atomic_load(&http->clock_stop)) {
    struct timespec pause = {.tv_nsec = 100000000};
    nanosleep(&pause, NULL);
    int64_t now_us = mo_clock_us();
    mo_connections_expire(http, now_us);
    mo_waits_expire(http, now_us);
    mo_linger_on(&http->lingering, now_us);
    trim_memory(atomic_load(&http->n_connections), &peak);
    if (now_us - second_us >= 1000000) {
      second_us = now_us;
      mo_streams_tick(http, now_us);
      mo_waits_tick(http);
      mo_clients_sweep(&http->clients, now_us);
      if (http->service.tick != NULL)
        http->service.tick(http->service.context);
    }
    atomic_store(&http->clock_us, now_us);
  }
  return NULL;
}

/* ---- start and stop ---- */

static uint32_t or_default(uint32_t value, uint32_t usual)
{
  return value != 0 ? value : usual;
}

static void fill_defaults(struct mo_http_config *config)
{
  const uint32_t processors = mo_processors();
  config->n_io_threads = or_default(config->n_io_threads, processors >= 4   ? 4
                                                          : processors >= 2 ? processors
                                                                            : 2);
  config->n_api_threads = or_default(config->n_api_threads, 4);
  config->max_connections = or_default(config->max_connections, 1024);
  config->max_streams = or_default(config->max_streams, 256);
  config->max_in_flight = or_default(config->max_in_flight, 64);
  config->max_queued = or_default(config->max_queued, 256);
  config->header_timeout_ms = or_default(config->header_timeout_ms, 10000);
  config->body_timeout_ms = or_default(config->body_timeout_ms, 60000);
  config->idle_timeout_ms = or_default(config->idle_timeout_ms, 60000);
  config->heartbeat_ms = or_default(config->heartbeat_ms, 15000);
  if (config->max_body_bytes == 0)
    config->max_body_bytes = UINT64_C(32) << 20;
  if (config->max_file_bytes == 0)
    config->max_file_bytes = UINT64_C(16) << 20;
  uint64_t larger = config->max_body_bytes > config->max_file_bytes ? config->max_body_bytes
                                                                    : config->max_file_bytes;
  if (config->max_body_memory == 0)
    config->max_body_memory = 8 * larger;
}

/* Takes over the listening sockets, and finds out whether one is beyond loopback. */
static int adopt_listeners(struct mo_http *http, const struct mo_http_config *config,
                           struct mo_message *message)
{
  http->listeners = calloc(config->n_listeners + 1, sizeof(int));
  http->listener_transports = calloc(config->n_listeners + 1, sizeof(enum mo_transport));
  if (http->listeners == NULL || http->listener_transports == NULL) {
    for (size_t i = 0; i < config->n_listeners; i++)
      close(config->listeners[i]);
    return mo_fail(message, MO_ERR_NO_MEMORY, "no memory for the server");
  }
  int code = MO_OK;
  for (size_t i = 0; i < config->n_listeners; i++) {
    char address[128] = "";
    bool beyond = false;
    int described =
        mo_http_describe(config->listeners[i], address, &beyond, code == MO_OK ? message : NULL);
    if (code == MO_OK)
      code = described;
    http->beyond_loopback |= beyond;
    http->listeners[i] = config->listeners[i];
    http->listener_transports[i] = strncmp(address, "unix:", 5) == 0 ? MO_TRANSPORT_UNIX
                                   : beyond                          ? MO_TRANSPORT_TCP
                                                                     : MO_TRANSPORT_LOOPBACK;
    http->n_listeners = i + 1;
  }
  if (code == MO_OK && config->n_listeners == 0)
    code = mo_fail(message, MO_ERR_INVALID, "there is no address to serve");
  return code;
}

static int start_daemon(struct mo_http *http, struct mo_message *message)
{
  /* The library's limit on connections is set too high to be reached: the acceptor keeps the limit,
   * because it replies. */
  http->daemon = MHD_start_daemon(
      MHD_USE_EPOLL_INTERNAL_THREAD | MHD_ALLOW_SUSPEND_RESUME | MHD_USE_NO_LISTEN_SOCKET |
          MHD_USE_ERROR_LOG,
      0, NULL, NULL, on_request, http, MHD_OPTION_EXTERNAL_LOGGER, on_log, NULL,
      MHD_OPTION_THREAD_POOL_SIZE, (unsigned)http->config.n_io_threads, MHD_OPTION_CONNECTION_LIMIT,
      (unsigned)(http->config.max_connections + 64) * http->config.n_io_threads,
      MHD_OPTION_CONNECTION_TIMEOUT, (unsigned)(http->config.idle_timeout_ms / 1000 + 60),
      MHD_OPTION_CONNECTION_MEMORY_LIMIT, (size_t)32768, MHD_OPTION_URI_LOG_CALLBACK, on_target,
      http, MHD_OPTION_UNESCAPE_CALLBACK, on_unescape, NULL, MHD_OPTION_STRICT_FOR_CLIENT, 1,
      MHD_OPTION_NOTIFY_COMPLETED, on_completed, http, MHD_OPTION_NOTIFY_CONNECTION, on_connection,
      http, MHD_OPTION_END);
  return http->daemon != NULL ? MO_OK
                              : mo_fail(message, MO_ERR_NO_MEMORY, "cannot start the HTTP threads");
}

static void destroy(struct mo_http *http)
{
  mo_tokens_free(&http->tokens);
  mo_names_free(&http->names);
  mo_clients_free(&http->clients);
  mo_linger_end(&http->lingering);
  pthread_mutex_destroy(&http->connections_lock);
  pthread_mutex_destroy(&http->bodies_lock);
  if (http->stop_fd >= 0)
    close(http->stop_fd);
  if (http->peers_fd >= 0)
    close(http->peers_fd);
  free(http->connections);
  free(http->listeners);
  free(http->listener_transports);
  free(http->unix_groups);
  free(http);
}

static int prepare(struct mo_http *http, const struct mo_http_config *config,
                   struct mo_message *message)
{
  http->stop_fd = -1;
  mo_peers_open(http);
  pthread_mutex_init(&http->connections_lock, NULL);
  pthread_mutex_init(&http->bodies_lock, NULL);
  pthread_mutex_init(&http->lingering.lock, NULL);
  if (!mo_last_replies_init())
    return mo_fail(message, MO_ERR_INVALID,
                   "libmicrohttpd has no MHD_queue_response: it cannot be used");
  if (mo_tokens_init(&http->tokens) != MO_OK || mo_clients_init(&http->clients) != MO_OK)
    return mo_fail(message, MO_ERR_NO_MEMORY, "no memory for the server");
  http->config = *config;
  fill_defaults(&http->config);
  if (getrandom(&http->id_key, sizeof(http->id_key), 0) != (ssize_t)sizeof(http->id_key))
    http->id_key = (uint64_t)mo_clock_us() << 20;
  http->id_key &= ~UINT64_C(0xFFFFFFFF); /* ids count up after a random prefix */
  int code = adopt_listeners(http, config, message);
  if (code == MO_OK)
    code = mo_connections_init(http, message);
  if (code == MO_OK &&
      (code = mo_names_copy(&http->names, config->allowed_hosts, config->n_allowed_hosts)) != MO_OK)
    mo_fail(message, code, "no memory for the server");
  if (code == MO_OK)
    code = mo_tokens_set(&http->tokens, config->tokens, config->n_tokens, message);
  if (code == MO_OK && config->n_tokens == 0 &&
      (http->beyond_loopback || config->token_on_loopback))
    code = mo_fail(message, MO_ERR_INVALID,
                   "an address beyond loopback is served: at least one bearer token is needed");
  if (code == MO_OK && config->n_unix_groups > 0) {
    http->unix_groups = calloc(config->n_unix_groups, sizeof(gid_t));
    if (http->unix_groups == NULL)
      return mo_fail(message, MO_ERR_NO_MEMORY, "no memory for the server");
    memcpy(http->unix_groups, config->unix_groups, config->n_unix_groups * sizeof(gid_t));
    http->n_unix_groups = config->n_unix_groups;
  }
  return code;
}

void mo_http_refuse_listeners(const struct mo_http_config *config)
{
  for (size_t i = 0; i < config->n_listeners; i++)
    close(config->listeners[i]);
}

int mo_http_start(const struct mo_http_config *config, const struct mo_http_service *service,
                  struct mo_http **ret, struct mo_message *message)
{
  struct mo_http *http = calloc(1, sizeof(*http));
  if (http == NULL) {
    mo_http_refuse_listeners(config);
    return mo_fail(message, MO_ERR_NO_MEMORY, "no memory for the server");
  }
  http->service = *service;
  int code = prepare(http, config, message);
  if (code != MO_OK) {
    mo_acceptor_stop(http);
    destroy(http);
    return code;
  }
  code = mo_pool_start(http);
  if (code != MO_OK)
    mo_fail(message, code, "cannot start the API threads");
  mo_streams_start(http);
  if (code == MO_OK && service->start != NULL) {
    code = service->start(service->context, http);
    if (code != MO_OK)
      mo_fail(message, code, "cannot start the service: %s", mo_error_text(code));
  }
  if (code == MO_OK)
    code = start_daemon(http, message);
  atomic_store(&http->clock_us, mo_clock_us());
  if (code == MO_OK && pthread_create(&http->clock, NULL, clock_thread, http) != 0)
    code = mo_fail(message, MO_ERR_NO_MEMORY, "cannot start the clock's thread");
  else
    http->clock_started = code == MO_OK;
  if (code == MO_OK)
    code = mo_acceptor_start(http, message);
  if (code != MO_OK) {
    mo_http_stop(http, 0);
    return code;
  }
  *ret = http;
  return MO_OK;
}

void mo_http_set_ready(struct mo_http *http, bool ready)
{
  atomic_store(&http->ready, ready);
}

bool mo_http_is_ready(const struct mo_http *http)
{
  return atomic_load(&http->ready);
}

void *mo_http_context(const struct mo_request *request)
{
  return request->http->service.context;
}

int mo_http_set_tokens(struct mo_http *http, const char *const *tokens, size_t n,
                       struct mo_message *message)
{
  if (n == 0 && (http->beyond_loopback || http->config.token_on_loopback))
    return mo_fail(message, MO_ERR_INVALID,
                   "at least one bearer token is needed; the old ones stay");
  return mo_tokens_set(&http->tokens, tokens, n, message);
}

void mo_http_stop(struct mo_http *http, uint32_t grace_ms)
{
  if (http == NULL)
    return;
  atomic_store(&http->ready, false);
  atomic_store(&http->stopping, true); /* from now on replies end their connections */
  mo_acceptor_stop(http);
  mo_streams_close(http);
  mo_pool_close(
      http); /* from here on no connection is suspended: the library could not stop otherwise */
  int64_t until_us = mo_clock_us() + (int64_t)grace_ms * 1000;
  while (atomic_load(&http->n_in_flight) > 0 && mo_clock_us() < until_us) {
    struct timespec pause = {.tv_nsec = 5000000};
    nanosleep(&pause, NULL);
  }
  /* Do not call MHD_quiesce_daemon: with several threads it can abort the process. */
  if (http->daemon != NULL)
    MHD_stop_daemon(http->daemon);
  if (http->clock_started) {
    atomic_store(&http->clock_stop, true);
    pthread_join(http->clock, NULL);
  }
  if (http->service.stop != NULL)
    http->service.stop(http->service.context); /* from here on no event arrives */
  mo_streams_stop(http);
  mo_pool_stop(http);
  destroy(http);
}
