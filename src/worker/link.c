/* link.c: see link.h. libcurl keeps connections open, and closes that of an aborted request. */
#include "worker/link.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <curl/curl.h>

#include "base/sha256.h"
#include "base/text.h"

#define CONNECT_LIMIT_MS 3000

struct place {
  CURL *curl;
  struct curl_slist *headers;
  bool is_busy, has_digest, is_too_long;
  size_t limit;
  struct mo_text body;
  char error[CURL_ERROR_SIZE];
};

struct mo_link {
  CURLM *multi;
  struct mo_link_config config;
  char *base; /* the server, without a trailing slash */
  bool is_loopback;
  struct place places[MO_CALLS];
};

/* ---- configuration ---- */

static bool is_loopback(const char *host)
{
  return strcmp(host, "localhost") == 0 || strcmp(host, "[::1]") == 0 ||
         (strncmp(host, "127.", 4) == 0 && strspn(host, "0123456789.") == strlen(host));
}

static char *part_of(CURLU *url, CURLUPart part)
{
  char *text = NULL;
  return curl_url_get(url, part, &text, 0) == CURLUE_OK ? text : NULL;
}

/* Reads "https://host:port", without anything after it. */
static int read_server(struct mo_link *link, struct mo_message *message)
{
  const char *server = link->config.server;
  CURLU *url = curl_url();
  int error = MO_ERR_INVALID;
  char *scheme = NULL, *host = NULL, *path = NULL;
  if (url != NULL && curl_url_set(url, CURLUPART_URL, server, 0) == CURLUE_OK) {
    scheme = part_of(url, CURLUPART_SCHEME);
    host = part_of(url, CURLUPART_HOST);
    path = part_of(url, CURLUPART_PATH);
    char *more[] = {part_of(url, CURLUPART_QUERY), part_of(url, CURLUPART_FRAGMENT),
                    part_of(url, CURLUPART_USER)};
    const bool is_plain = scheme != NULL && strcmp(scheme, "http") == 0;
    if (host != NULL && path != NULL && strcmp(path, "/") == 0 && more[0] == NULL &&
        more[1] == NULL && more[2] == NULL &&
        (is_plain || (scheme != NULL && strcmp(scheme, "https") == 0))) {
      link->is_loopback = is_loopback(host);
      error = MO_OK;
      if (is_plain && !link->is_loopback && link->config.token != NULL)
        error = mo_fail(message, MO_ERR_INVALID,
                        "server: the token would be sent in clear text; use https://");
      else if (is_plain && link->config.pin != NULL)
        error = mo_fail(message, MO_ERR_INVALID, "pin: http:// has no key to pin; use https://");
      else if ((link->base = strdup(server)) == NULL)
        error = MO_ERR_NO_MEMORY;
      else if (link->base[strlen(link->base) - 1] == '/')
        link->base[strlen(link->base) - 1] = '\0';
    }
    for (size_t i = 0; i < sizeof(more) / sizeof(more[0]); i++)
      curl_free(more[i]);
  }
  curl_free(scheme);
  curl_free(host);
  curl_free(path);
  curl_url_cleanup(url);
  if (error == MO_ERR_INVALID && message != NULL && message->text[0] == '\0')
    mo_fail(message, error, "server: \"%.100s\" must be http://host:port or https://host:port",
            server);
  return error;
}

int mo_link_create(const struct mo_link_config *config, struct mo_link **ret,
                   struct mo_message *message)
{
  struct mo_link *link = calloc(1, sizeof(*link));
  int error = link != NULL && curl_global_init(CURL_GLOBAL_DEFAULT) == 0 ? MO_OK : MO_ERR_NO_MEMORY;
  if (error != MO_OK) {
    free(link);
    return error;
  }
  link->config = *config;
  link->multi = curl_multi_init();
  if (link->multi == NULL)
    error = MO_ERR_NO_MEMORY;
  for (int call = 0; call < MO_CALLS && error == MO_OK; call++)
    if ((link->places[call].curl = curl_easy_init()) == NULL)
      error = MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = read_server(link, message);
  if (error == MO_OK && config->pin != NULL && strncmp(config->pin, "sha256//", 8) != 0)
    error =
        mo_fail(message, MO_ERR_INVALID, "pin: \"%.80s\" must begin with sha256//", config->pin);
  if (error == MO_OK && config->ca != NULL && access(config->ca, R_OK) != 0)
    error = mo_fail(message, MO_ERR_INVALID, "ca: cannot read %.200s", config->ca);
  if (error != MO_OK) {
    mo_link_free(link);
    return error;
  }
  *ret = link;
  return MO_OK;
}

/* ---- requests ---- */

static void clear(struct place *place)
{
  curl_slist_free_all(place->headers);
  mo_text_free(&place->body);
  *place = (struct place){.curl = place->curl};
}

void mo_link_free(struct mo_link *link)
{
  if (link == NULL)
    return;
  for (int call = 0; call < MO_CALLS; call++) {
    mo_link_abort(link, (enum mo_call)call);
    curl_easy_cleanup(link->places[call].curl);
  }
  curl_multi_cleanup(link->multi);
  free(link->base);
  free(link);
  curl_global_cleanup();
}

static size_t take(char *bytes, size_t size, size_t count, void *context)
{
  struct place *place = context;
  const size_t n = size * count;
  place->is_too_long = place->body.size + n > place->limit;
  if (place->is_too_long)
    return 0;
  mo_text_bytes(&place->body, bytes, n);
  return place->body.failed ? 0 : n;
}

static bool add_header(struct place *place, const char *name, const char *value)
{
  char line[160];
  snprintf(line, sizeof(line), "%s: %s", name, value);
  struct curl_slist *headers = curl_slist_append(place->headers, line);
  if (headers != NULL)
    place->headers = headers;
  return headers != NULL;
}

static bool make_headers(struct place *place, const struct mo_link_request *request)
{
  char digest[MO_CONTENT_DIGEST_BYTES], wait[24];
  struct mo_sha256 hash;
  mo_sha256_of(request->body, request->size, &hash);
  mo_sha256_to_content_digest(&hash, digest);
  snprintf(wait, sizeof(wait), "wait=%u", request->wait_s);
  return (request->body == NULL || (add_header(place, "Content-Type", request->type) &&
                                    add_header(place, "Content-Digest", digest))) &&
         (request->wait_s == 0 || add_header(place, "Prefer", wait)) &&
         add_header(place, "Expect", ""); /* saves a round trip before a body */
}

/* Sets the trusted keys: with a pin, only its key; with a file, its authorities; otherwise the
 * system's. */
static void set_trust(const struct mo_link *link, CURL *curl)
{
  const struct mo_link_config *config = &link->config;
  const bool pin_only = config->pin != NULL && config->ca == NULL;
  curl_easy_setopt(curl, CURLOPT_SSLVERSION, (long)CURL_SSLVERSION_TLSv1_3);
  curl_easy_setopt(curl, CURLOPT_SSL_VERIFYPEER, pin_only ? 0L : 1L);
  curl_easy_setopt(curl, CURLOPT_SSL_VERIFYHOST, pin_only ? 0L : 2L);
  if (config->pin != NULL)
    curl_easy_setopt(curl, CURLOPT_PINNEDPUBLICKEY, config->pin);
  if (config->ca != NULL)
    curl_easy_setopt(curl, CURLOPT_CAINFO, config->ca);
  if (config->proxy != NULL)
    curl_easy_setopt(curl, CURLOPT_PROXY, config->proxy);
  else if (link->is_loopback) /* a proxy from the environment would be on another machine */
    curl_easy_setopt(curl, CURLOPT_PROXY, "");
}

int mo_link_start(struct mo_link *link, enum mo_call call, const struct mo_link_request *request)
{
  struct place *place = &link->places[call];
  CURL *curl = place->curl;
  char *url = NULL;
  curl_easy_reset(curl);
  clear(place);
  if (!make_headers(place, request) || asprintf(&url, "%s%s", link->base, request->path) < 0) {
    clear(place);
    return MO_ERR_NO_MEMORY;
  }
  place->limit = request->limit;
  place->has_digest = request->has_digest;
  curl_easy_setopt(curl, CURLOPT_URL, url);
  curl_easy_setopt(curl, CURLOPT_NOSIGNAL, 1L);
  curl_easy_setopt(curl, CURLOPT_PROTOCOLS_STR, "http,https");
  curl_easy_setopt(curl, CURLOPT_HTTP_VERSION, (long)CURL_HTTP_VERSION_1_1);
  curl_easy_setopt(curl, CURLOPT_USERAGENT, link->config.user_agent);
  curl_easy_setopt(curl, CURLOPT_ERRORBUFFER, place->error);
  curl_easy_setopt(curl, CURLOPT_PRIVATE, place);
  set_trust(link, curl);
  if (link->config.token != NULL) {
    curl_easy_setopt(curl, CURLOPT_HTTPAUTH, CURLAUTH_BEARER);
    curl_easy_setopt(curl, CURLOPT_XOAUTH2_BEARER, link->config.token);
  }
  if (request->body != NULL) {
    curl_easy_setopt(curl, CURLOPT_POSTFIELDSIZE_LARGE, (curl_off_t)request->size);
    curl_easy_setopt(curl, CURLOPT_COPYPOSTFIELDS, request->body);
  }
  curl_easy_setopt(curl, CURLOPT_CUSTOMREQUEST, request->method);
  curl_easy_setopt(curl, CURLOPT_HTTPHEADER, place->headers);
  curl_easy_setopt(curl, CURLOPT_CONNECTTIMEOUT_MS, (long)CONNECT_LIMIT_MS);
  curl_easy_setopt(curl, CURLOPT_TIMEOUT_MS, (long)request->timeout_ms);
  curl_easy_setopt(curl, CURLOPT_WRITEFUNCTION, take);
  CURLcode code = curl_easy_setopt(curl, CURLOPT_WRITEDATA, place);
  free(url);
  place->is_busy = code == CURLE_OK && curl_multi_add_handle(link->multi, curl) == CURLM_OK;
  return place->is_busy ? MO_OK : MO_ERR_NO_MEMORY;
}

bool mo_link_is_busy(const struct mo_link *link, enum mo_call call)
{
  return link->places[call].is_busy;
}

void mo_link_abort(struct mo_link *link, enum mo_call call)
{
  struct place *place = &link->places[call];
  if (place->is_busy)
    curl_multi_remove_handle(link->multi, place->curl);
  clear(place);
}

/* ---- replies ---- */

static int error_of(CURLcode code, const struct place *place)
{
  switch (code) {
  case CURLE_OK: return MO_OK;
  case CURLE_PEER_FAILED_VERIFICATION:
  case CURLE_SSL_PINNEDPUBKEYNOTMATCH:
  case CURLE_SSL_CACERT_BADFILE:
  case CURLE_SSL_ISSUER_ERROR:
  case CURLE_SSL_CERTPROBLEM: return MO_ERR_INVALID;
  default: return place->is_too_long ? MO_ERR_CORRUPT : MO_ERR_IO;
  }
}

static const char *header_of(CURL *curl, const char *name)
{
  struct curl_header *header;
  return curl_easy_header(curl, name, 0, CURLH_HEADER, -1, &header) == CURLHE_OK ? header->value
                                                                                 : NULL;
}

static void finish(struct mo_link *link, struct place *place, CURLcode code,
                   struct mo_link_reply *reply)
{
  long status = 0;
  *reply = (struct mo_link_reply){.error = error_of(code, place)};
  curl_easy_getinfo(place->curl, CURLINFO_RESPONSE_CODE, &status);
  const char *later = header_of(place->curl, "Retry-After");
  reply->status = (int)status;
  if (later != NULL && *later >= '0' && *later <= '9')
    reply->retry_after_s = (uint32_t)strtoul(later, NULL, 10);
  if (place->is_too_long)
    snprintf(reply->why, sizeof(reply->why), "the reply is longer than %zu bytes", place->limit);
  else
    snprintf(reply->why, sizeof(reply->why), "%s",
             place->error[0] != '\0' ? place->error : curl_easy_strerror(code));
  if (reply->error == MO_OK && place->has_digest && status == 200 &&
      !mo_content_digest_matches(header_of(place->curl, "Content-Digest"), place->body.data,
                                 place->body.size)) {
    reply->error = MO_ERR_CORRUPT;
    snprintf(reply->why, sizeof(reply->why), "the reply does not match its digest");
  }
  if (reply->error == MO_OK) {
    reply->body = (uint8_t *)place->body.data;
    reply->size = place->body.size;
    place->body = (struct mo_text){0};
  }
  curl_multi_remove_handle(link->multi, place->curl);
  clear(place);
}

int mo_link_next(struct mo_link *link, uint32_t timeout_ms, struct mo_link_reply *reply)
{
  for (int round = 0;; round++) {
    int running = 0, left = 0;
    curl_multi_perform(link->multi, &running);
    for (const CURLMsg *done; (done = curl_multi_info_read(link->multi, &left)) != NULL;)
      if (done->msg == CURLMSG_DONE) {
        struct place *place = NULL;
        curl_easy_getinfo(done->easy_handle, CURLINFO_PRIVATE, (char **)&place);
        finish(link, place, done->data.result, reply);
        return (int)(place - link->places);
      }
    if (round == 1)
      return -1;
    curl_multi_poll(link->multi, NULL, 0, (int)timeout_ms, NULL);
  }
}

void mo_link_wake(struct mo_link *link)
{
  curl_multi_wakeup(link->multi);
}
