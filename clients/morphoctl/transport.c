/* transport.c: see transport.h. */
#include "transport.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/random.h>
#include <time.h>

#include <curl/curl.h>

#include "table.h"

/* Limits on what this program holds for a server: of JSON, and of a requested file. */
#define JSON_BYTES_MAX (UINT64_C(256) << 20)
#define FILE_BYTES_MAX (UINT64_C(2) << 30)
#define WAIT_PAUSE_S   0.25 /* minimum time between two requests that wait for the same thing */

struct transport {
  CURL *curl;
  CURL *aside;       /* for requests during a stream; created on demand */
  bool streaming;    /* curl is inside a stream's callback */
  char *base;        /* "http://127.0.0.1:8765" */
  char *socket;      /* path of a unix socket, or NULL */
  bool has_answered; /* the server replied once, so retrying is worthwhile */
  char *waited_for;  /* path of the last request that waited */
  double waited_s;   /* when it was sent */
};

void pause_s(double seconds)
{
  struct timespec rest = {(time_t)seconds, (long)((seconds - (double)(time_t)seconds) * 1e9)};
  nanosleep(&rest, NULL); /* a signal ends the pause early, as intended */
}

void random_key(char key[33])
{
  unsigned char bytes[16];
  if (getrandom(bytes, sizeof(bytes), 0) != (ssize_t)sizeof(bytes))
    fail(STATUS_ERROR, "cannot get random numbers: %s", strerror(errno));
  for (size_t i = 0; i < sizeof(bytes); i++)
    snprintf(key + 2 * i, 3, "%02x", bytes[i]);
}

char *escape(const char *text)
{
  return keep(curl_easy_escape(NULL, text, 0));
}

void transport_open(struct ctl *ctl)
{
  const char *server = ctl->server;
  struct transport *transport = ctl->transport = keep(calloc(1, sizeof(*transport)));
  if (strncmp(server, "unix:", 5) == 0) {
    if (server[5] != '/')
      fail(STATUS_USAGE, "server \"%s\": the path of a unix socket starts with /", server);
    transport->socket = need(strdup(server + 5));
    transport->base = need(strdup("http://localhost"));
  } else if (strncmp(server, "http://", 7) == 0 || strncmp(server, "https://", 8) == 0) {
    transport->base = need(strdup(server));
    for (size_t end = strlen(server); end > 0 && server[end - 1] == '/'; end--)
      transport->base[end - 1] = 0;
  } else if (*server != 0 && strstr(server, "://") == NULL) {
    transport->base = format_text("http://%s", server);
  } else {
    fail(STATUS_USAGE, "server \"%s\" is not http://host:port or unix:/path", server);
  }
  if (curl_global_init(CURL_GLOBAL_DEFAULT) == 0)
    transport->curl = curl_easy_init();
  need(transport->curl);
}

void reply_free(struct reply *reply)
{
  free(reply->body);
  *reply = (struct reply){.retry_after_s = -1};
}

static size_t take_body(char *bytes, size_t size, size_t count, void *context)
{
  struct reply *reply = context;
  if (reply->file == NULL)
    reply->file = open_memstream(&reply->body, &reply->body_bytes);
  reply->is_too_long =
      reply->file != NULL && (size_t)ftello(reply->file) + size * count >
                                 (reply->is_file ? FILE_BYTES_MAX : JSON_BYTES_MAX);
  if (reply->file == NULL || reply->is_too_long)
    return 0;
  return fwrite(bytes, 1, size * count, reply->file);
}

static void copy_header(CURL *curl, const char *name, char *value, size_t capacity)
{
  struct curl_header *header;
  if (curl_easy_header(curl, name, 0, CURLH_HEADER, -1, &header) == CURLHE_OK)
    snprintf(value, capacity, "%s", header->value);
}

static void read_headers(CURL *curl, struct reply *reply)
{
  char retry[16] = "";
  copy_header(curl, "Content-Type", reply->content_type, sizeof(reply->content_type));
  copy_header(curl, "Morphod-Shape", reply->shape, sizeof(reply->shape));
  copy_header(curl, "Morphod-Step", reply->step, sizeof(reply->step));
  copy_header(curl, "X-Request-Id", reply->request_id, sizeof(reply->request_id));
  copy_header(curl, "Retry-After", retry, sizeof(retry));
  if (*retry >= '0' && *retry <= '9')
    reply->retry_after_s = strtol(retry, NULL, 10);
}

static int stop_when_interrupted(void *context, curl_off_t a, curl_off_t b, curl_off_t c,
                                 curl_off_t d)
{
  (void)context, (void)a, (void)b, (void)c, (void)d;
  return interrupted();
}

static struct curl_slist *make_headers(const struct request *request)
{
  char wait[24];
  snprintf(wait, sizeof(wait), "wait=%u", request->wait_s);
  const struct {
    const char *name, *value; /* NULL if there is no body */
  } all[] = {{"Accept", request->accept != NULL ? request->accept : "application/json"},
             {"Content-Type", request->content_type},
             {"Prefer", request->wait_s > 0 ? wait : NULL},
             {"Idempotency-Key", request->key},
             {"Last-Event-ID", request->last_event},
             {"Expect", ""}}; /* saves a round trip before a body */
  struct curl_slist *headers = NULL;
  for (size_t i = 0; i < sizeof(all) / sizeof(all[0]); i++) {
    char *line = all[i].value != NULL ? format_text("%s: %s", all[i].name, all[i].value) : NULL;
    if (line != NULL)
      headers = need(curl_slist_append(headers, line));
    free(line);
  }
  return headers;
}

static bool is_loopback(const char *base)
{
  const char *host = strstr(base, "://");
  host = host != NULL ? host + 3 : base;
  size_t n = strcspn(host, ":/");
  return strncmp(host, "[::1]", 5) == 0 || (n == 9 && strncasecmp(host, "localhost", n) == 0) ||
         (strncmp(host, "127.", 4) == 0 && strspn(host, "0123456789.") == n);
}

/* Makes one attempt. data NULL: the body is stored in the reply. */
static CURLcode perform(struct ctl *ctl, const struct request *request, struct reply *reply,
                        curl_write_callback data, void *context)
{
  struct transport *transport = ctl->transport;
  if (transport->streaming && transport->aside == NULL)
    transport->aside = curl_easy_init();
  CURL *curl = need(transport->streaming ? transport->aside : transport->curl);
  reply->is_file = request->accept != NULL && strcmp(request->accept, "application/json") != 0;
  struct curl_slist *headers = make_headers(request);
  char *url = format_text("%s%s", transport->base, request->path);
  curl_easy_reset(curl);
  curl_easy_setopt(curl, CURLOPT_URL, url);
  curl_easy_setopt(curl, CURLOPT_NOSIGNAL, 1L);
  curl_easy_setopt(curl, CURLOPT_USERAGENT, "morphoctl/" MORPHOD_VERSION);
  curl_easy_setopt(curl, CURLOPT_PROTOCOLS_STR, "http,https");
  if (transport->socket != NULL)
    curl_easy_setopt(curl, CURLOPT_UNIX_SOCKET_PATH, transport->socket);
  if (is_loopback(transport->base)) /* a proxy from the environment is another machine, which must
                                       not get the token */
    curl_easy_setopt(curl, CURLOPT_PROXY, "");
  if (ctl->token != NULL) {
    curl_easy_setopt(curl, CURLOPT_HTTPAUTH, CURLAUTH_BEARER);
    curl_easy_setopt(curl, CURLOPT_XOAUTH2_BEARER, ctl->token);
  }
  curl_easy_setopt(curl, CURLOPT_HTTPHEADER, headers);
  if (strcmp(request->method, "GET") != 0) {
    curl_easy_setopt(curl, CURLOPT_POSTFIELDS, request->body != NULL ? request->body : "");
    curl_easy_setopt(curl, CURLOPT_POSTFIELDSIZE_LARGE, (curl_off_t)request->body_bytes);
  }
  curl_easy_setopt(curl, CURLOPT_CUSTOMREQUEST, request->method);
  curl_easy_setopt(curl, CURLOPT_CONNECTTIMEOUT, 10L);
  /* A server that sends nothing for this long is gone; streams have a heartbeat every 15 s. */
  curl_easy_setopt(curl, CURLOPT_LOW_SPEED_LIMIT, 1L);
  curl_easy_setopt(curl, CURLOPT_LOW_SPEED_TIME, 45L + (long)request->wait_s);
  curl_easy_setopt(curl, CURLOPT_WRITEFUNCTION, data != NULL ? data : take_body);
  curl_easy_setopt(curl, CURLOPT_WRITEDATA, data != NULL ? context : reply);
  curl_easy_setopt(curl, CURLOPT_NOPROGRESS, 0L);
  curl_easy_setopt(curl, CURLOPT_XFERINFOFUNCTION, stop_when_interrupted);
  CURLcode code = curl_easy_perform(curl);
  curl_easy_getinfo(curl, CURLINFO_RESPONSE_CODE, &reply->status);
  read_headers(curl, reply);
  if (reply->file != NULL && fclose(reply->file) != 0)
    code = CURLE_OUT_OF_MEMORY;
  reply->file = NULL;
  curl_slist_free_all(headers);
  free(url);
  return code;
}

static bool is_passing(CURLcode code)
{
  switch (code) {
  case CURLE_COULDNT_CONNECT:
  case CURLE_COULDNT_RESOLVE_HOST:
  case CURLE_SEND_ERROR:
  case CURLE_RECV_ERROR:
  case CURLE_GOT_NOTHING:
  case CURLE_PARTIAL_FILE:
  case CURLE_OPERATION_TIMEDOUT: return true;
  default: return false;
  }
}

int complain_about_server(const struct ctl *ctl, const char *words)
{
  const char *variable = getenv("MORPHOD_SERVER");
  complain(0, "%s: %s", ctl->server, words);
  print_plain_line(stderr,
                   "  This address is %s. Is morphod running there? If it listens elsewhere, give "
                   "its address with --server or MORPHOD_SERVER: http://host:port or unix:/path.",
                   option_is_set(ctl, "server")         ? "that of --server"
                   : variable != NULL && *variable != 0 ? "that of MORPHOD_SERVER"
                                                        : "the default");
  return STATUS_CONNECTION;
}

/* Pauses before a request that waits for the same thing as the previous one if that one got its
 * reply at once, as from a proxy that drops Prefer. */
static void pace(struct transport *transport, const struct request *request)
{
  if (request->wait_s == 0)
    return;
  const double left_s = transport->waited_s + WAIT_PAUSE_S - monotonic_s();
  if (transport->waited_for != NULL && strcmp(transport->waited_for, request->path) == 0) {
    if (left_s > 0)
      pause_s(left_s);
  } else {
    free(transport->waited_for);
    transport->waited_for = need(strdup(request->path));
  }
  transport->waited_s = monotonic_s();
}

int transport_try(struct ctl *ctl, const struct request *request, struct reply *reply)
{
  pace(ctl->transport, request);
  *reply = (struct reply){.retry_after_s = -1};
  double begin = monotonic_s(), pause = 0.1;
  for (;;) {
    reply_free(reply);
    CURLcode code = perform(ctl, request, reply, NULL, NULL);
    if (code == CURLE_ABORTED_BY_CALLBACK && interrupted())
      return STATUS_INTERRUPTED;
    double limit_s = ctl->retry_s >= 0 ? ctl->retry_s : ctl->transport->has_answered ? 60 : 2;
    double left_s = limit_s - (monotonic_s() - begin);
    if (code == CURLE_OK) {
      ctl->transport->has_answered = true;
      bool later = reply->status == 429 || (reply->status == 503 && reply->retry_after_s >= 0);
      double asked_s = reply->retry_after_s > 0 ? (double)reply->retry_after_s : 0.2;
      if (!later || request->once || asked_s > left_s)
        return STATUS_OK;
      pause_s(asked_s);
    } else {
      if (reply->is_too_long)
        return complain(STATUS_ERROR, "%s: the reply does not end; is morphod running there?",
                        ctl->server);
      if (!is_passing(code))
        return complain(STATUS_ERROR, "%s: %s", ctl->server, curl_easy_strerror(code));
      if (request->once || pause > left_s)
        return complain_about_server(ctl, curl_easy_strerror(code));
      pause_s(pause);
      pause = pause * 2 > 5 ? 5 : pause * 2;
    }
    if (interrupted())
      return STATUS_INTERRUPTED;
  }
}

int complain_about_reply(const struct ctl *ctl, const struct reply *reply)
{
  json_t *problem =
      reply->body != NULL && strncmp(reply->content_type, "application/problem+json", 24) == 0
          ? json_loads(reply->body, 0, NULL)
          : NULL;
  const char *title = json_string_value(json_object_get(problem, "title"));
  const char *detail = json_string_value(json_object_get(problem, "detail"));
  if (title != NULL && detail != NULL && strcmp(title, detail) != 0)
    complain(0, "%s: %s (%ld)", title, detail, reply->status);
  else if (title != NULL || detail != NULL)
    complain(0, "%s (%ld)", title != NULL ? title : detail, reply->status);
  else
    complain(0, "%s replied with status %ld", ctl->server, reply->status);
  size_t i;
  json_t *fault;
  const json_t *faults = json_object_get(problem, "errors");
  const json_t *first = json_array_size(faults) == 1 ? json_array_get(faults, 0) : NULL;
  const char *only = json_string_value(json_object_get(first, "detail"));
  if (detail == NULL || only == NULL || strstr(detail, only) == NULL) /* each fault only once */
    json_array_foreach(faults, i, fault)
    {
      print_from(stderr, fault, "  [{pointer}: |{parameter}: |{header}: ]{detail}");
    }
  if (reply->status >= 500 && *reply->request_id != 0)
    print_plain_line(stderr, "  request %s", reply->request_id);
  json_decref(problem);
  switch (reply->status) {
  case 401:
    if (ctl->token == NULL)
      fputs("  give a token with --token-file or MORPHOD_TOKEN\n", stderr);
    return STATUS_DENIED;
  case 403: return STATUS_DENIED;
  case 404: return STATUS_NEGATIVE;
  case 409: return STATUS_NEGATIVE;
  case 429:
  case 503:
  case 507: return STATUS_BUSY;
  default: return reply->status < 500 ? STATUS_REJECTED : STATUS_ERROR;
  }
}

/* Sends a request, and reports a reply with a status of 400 or above. */
static int exchange(struct ctl *ctl, const struct request *request, struct reply *reply)
{
  const int status = transport_try(ctl, request, reply);
  return status == STATUS_OK && reply->status >= 400 ? complain_about_reply(ctl, reply) : status;
}

void transport_send(struct ctl *ctl, const struct request *request, struct reply *reply)
{
  const int status = exchange(ctl, request, reply);
  if (status != STATUS_OK)
    leave(status);
}

const char *path_to(const char *format, ...)
{
  static char *paths[4];
  static size_t n;
  char **path = &paths[n++ % 4];
  va_list arguments;
  free(*path);
  va_start(arguments, format);
  need(vasprintf(path, format, arguments) >= 0 ? *path : NULL);
  va_end(arguments);
  return *path;
}

void transport_get(struct ctl *ctl, const char *path, const char *accept, struct reply *reply)
{
  transport_send(ctl, &(struct request){.method = "GET", .path = path, .accept = accept}, reply);
}

int try_json(struct ctl *ctl, const struct request *request, long *code, json_t **json)
{
  struct reply reply;
  json_error_t error;
  *json = NULL;
  int status = exchange(ctl, request, &reply);
  if (status == STATUS_OK) {
    *json = json_loadb(reply.body != NULL ? reply.body : "", reply.body_bytes, 0, &error);
    if (*json == NULL)
      status = complain(STATUS_ERROR, "the server's reply is not JSON: %s", error.text);
  }
  if (code != NULL)
    *code = reply.status;
  reply_free(&reply);
  return status;
}

json_t *send_json(struct ctl *ctl, const struct request *request, long *code)
{
  json_t *json;
  const int status = try_json(ctl, request, code, &json);
  if (status != STATUS_OK)
    leave(status);
  return json;
}

json_t *get_json(struct ctl *ctl, const char *format, ...)
{
  char *path = NULL;
  va_list arguments;
  va_start(arguments, format);
  keep(vasprintf(&path, format, arguments) >= 0 ? path : NULL);
  va_end(arguments);
  return keep(send_json(ctl, &(struct request){.method = "GET", .path = path}, NULL));
}

/* ---- streams ---- */

struct stream {
  struct ctl *ctl;
  struct reply reply;
  int (*data)(void *context, const char *bytes, size_t n);
  void *context;
  bool ended;
};

static size_t take_stream(char *bytes, size_t size, size_t count, void *context)
{
  struct stream *stream = context;
  size_t n = size * count;
  long status = 0;
  curl_easy_getinfo(stream->ctl->transport->curl, CURLINFO_RESPONSE_CODE, &status);
  if (status != 200)
    return take_body(bytes, size, count, &stream->reply); /* a problem document, reported later */
  stream->ctl->transport->has_answered = true;
  stream->ctl->transport->streaming = true;
  int end = stream->data(stream->context, bytes, n);
  stream->ctl->transport->streaming = false;
  if (end != 0) {
    stream->ended = true;
    return 0;
  }
  return n;
}

bool transport_stream(struct ctl *ctl, const char *path, const char *last_event,
                      int (*data)(void *context, const char *bytes, size_t n), void *context)
{
  struct stream stream = {
      .ctl = ctl, .reply = {.retry_after_s = -1}, .data = data, .context = context};
  struct request request = {
      .method = "GET", .path = path, .accept = "text/event-stream", .last_event = last_event};
  const CURLcode code = perform(ctl, &request, &stream.reply, take_stream, &stream);
  const long status = stream.reply.status;
  if (interrupted())
    leave(STATUS_INTERRUPTED);
  if (!stream.ended && status >= 400 && status != 429 && status != 503)
    leave(complain_about_reply(ctl, &stream.reply));
  if (!stream.ended && code != CURLE_OK && !is_passing(code))
    fail(STATUS_ERROR, "%s: %s", ctl->server, curl_easy_strerror(code));
  reply_free(&stream.reply);
  return stream.ended;
}

void transport_download(struct ctl *ctl, const char *path, const char *accept,
                        int (*data)(void *context, const char *bytes, size_t n), void *context)
{
  struct stream stream = {
      .ctl = ctl, .reply = {.retry_after_s = -1}, .data = data, .context = context};
  struct request request = {.method = "GET", .path = path, .accept = accept};
  const CURLcode code = perform(ctl, &request, &stream.reply, take_stream, &stream);
  if (interrupted())
    leave(STATUS_INTERRUPTED);
  if (code == CURLE_OK && stream.reply.status >= 400)
    leave(complain_about_reply(ctl, &stream.reply));
  if (code != CURLE_OK && is_passing(code) && !ctl->transport->has_answered)
    leave(complain_about_server(ctl, curl_easy_strerror(code)));
  if (code != CURLE_OK)
    fail(STATUS_CONNECTION, "%s: the reply broke off: %s", ctl->server, curl_easy_strerror(code));
  reply_free(&stream.reply);
}
