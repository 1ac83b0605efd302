/* guard.c: see guard.h. */
#include "http/guard.h"

#include <ctype.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include "http/field.h"

static bool refuse(struct mo_refusal *refusal, unsigned status, bool close, const char *header,
                   const char *detail)
{
  *refusal = (struct mo_refusal){status, close, header, detail};
  return false;
}

static bool is_token(const char *text, size_t n)
{
  for (size_t i = 0; i < n; i++)
    if (!isalnum((unsigned char)text[i]) &&
        (text[i] == '\0' || strchr("!#$%&'*+-.^_`|~", text[i]) == NULL))
      return false;
  return n > 0;
}

/* libmicrohttpd appends the continuation lines of a folded field to its name. */
static bool is_folded(const struct mo_header *header, const char *name)
{
  size_t size = strlen(name);
  return header->name_size > size && strncasecmp(header->name, name, size) == 0;
}

bool mo_guard_headers(const struct mo_header *headers, size_t n, bool http10,
                      struct mo_framing *framing, struct mo_refusal *refusal)
{
  *framing = (struct mo_framing){0};
  const char *length = NULL, *coding = NULL, *expect = NULL;
  /* Fields that must not be repeated, even with equal values. */
  const struct {
    const char *name;
    const char **value;
  } single[] = {
      {"Content-Length", &length},
      {"Transfer-Encoding", &coding},
      {"Expect", &expect},
      {"Host", &framing->host},
      {"Origin", &framing->origin},
      {"Authorization", &framing->authorization},
      {"Content-Type", &framing->content_type},
      {"Content-Encoding", &framing->content_encoding},
      {"Content-Digest", &framing->content_digest},
      {"Idempotency-Key", &framing->idempotency_key},
      {"Last-Event-ID", &framing->last_event_id},
      {"Sec-Fetch-Site", &framing->fetch_site},
      {"Prefer", &framing->prefer},
      {"Accept", &framing->accept},
      {"Accept-Encoding", &framing->accept_encoding},
      {"If-None-Match", &framing->if_none_match},
  };
  if (n > MO_HEADERS_MAX)
    return refuse(refusal, 431, true, NULL, "there may be at most 100 header fields");
  for (size_t i = 0; i < n; i++) {
    const struct mo_header *header = &headers[i];
    if (!is_token(header->name, header->name_size))
      return refuse(refusal, 400, true, NULL, "a field name has invalid characters");
    if (is_folded(header, "Content-Length") || is_folded(header, "Transfer-Encoding"))
      return refuse(refusal, 400, true, NULL,
                    "a field that frames the body is folded, or has an unknown name");
    for (size_t k = 0; k < header->value_size; k++) {
      unsigned char c = (unsigned char)header->value[k];
      if ((c < 0x20 && c != '\t') || c == 0x7F)
        return refuse(refusal, 400, true, NULL, "a field value has control characters");
    }
    for (size_t k = 0; k < sizeof(single) / sizeof(single[0]); k++)
      if (strcasecmp(header->name, single[k].name) == 0) {
        if (*single[k].value != NULL)
          return refuse(refusal, 400, true, single[k].name, "duplicate field; send it once");
        *single[k].value = header->value;
      }
  }
  if (length != NULL && coding != NULL)
    return refuse(refusal, 400, true, "Content-Length",
                  "Content-Length and Transfer-Encoding must not be given together");
  if (coding != NULL) {
    if (coding[0] == '\0')
      return refuse(refusal, 400, true, "Transfer-Encoding", "the transfer coding is missing");
    if (http10)
      return refuse(refusal, 400, true, "Transfer-Encoding",
                    "HTTP/1.0 does not support transfer codings");
    if (strcasecmp(coding, "chunked") != 0)
      return refuse(refusal, 501, true, "Transfer-Encoding",
                    "the only supported transfer coding is chunked");
    framing->chunked = true;
  }
  if (length != NULL) {
    int64_t number;
    if (!mo_decimal(length, strlen(length), 0, INT64_MAX, &number))
      return refuse(refusal, 400, true, "Content-Length", "the length must be decimal digits");
    framing->has_length = true;
    framing->length = (uint64_t)number;
  }
  if (expect != NULL) {
    if (strcasecmp(expect, "100-continue") != 0)
      return refuse(refusal, 417, true, "Expect", "the only supported expectation is 100-continue");
    framing->expects_continue = !http10;
  }
  if (framing->host == NULL && !http10)
    return refuse(refusal, 400, true, "Host", "the Host field is missing");
  return true;
}

bool mo_guard_target(const char *target, struct mo_target *parts, struct mo_refusal *refusal)
{
  *parts = (struct mo_target){0};
  for (const char *c = target; *c != '\0'; c++)
    if ((unsigned char)*c <= 0x20 || *c == 0x7F || (unsigned char)*c >= 0x80 || *c == '#' ||
        *c == '\\')
      return refuse(refusal, 400, true, NULL,
                    "the request target has characters that must be escaped");
  if (strstr(target, "%00") != NULL)
    return refuse(refusal, 400, true, NULL, "the request target has an escaped NUL");
  const char *path = target;
  if (strncasecmp(target, "http://", 7) == 0) {
    parts->authority = target + 7;
    parts->authority_size = strcspn(parts->authority, "/?");
    path = parts->authority + parts->authority_size;
  } else if (strcmp(target, "*") != 0 && *target != '/') {
    return refuse(refusal, 400, true, NULL, "the request target must be a path");
  }
  parts->path = path;
  parts->path_size = strcspn(path, "?");
  if (parts->path_size == 0) {
    parts->path = "/";
    parts->path_size = 1;
  }
  path += strcspn(path, "?");
  parts->query = *path == '?' ? path + 1 : path;
  return true;
}

/* Returns whether host and port are one of the configured names. A name without a port matches
 * every port. */
static bool is_named(const char *host, unsigned port, const struct mo_names *names)
{
  for (size_t i = 0; i < names->n; i++) {
    char name[256];
    unsigned name_port;
    bool literal;
    if (mo_authority_split(names->items[i], strlen(names->items[i]), name, &name_port, &literal) &&
        strcmp(name, host) == 0 && (name_port == 0 || name_port == port))
      return true;
  }
  return false;
}

bool mo_guard_host(const char *host, size_t n, bool local, const struct mo_names *names)
{
  char name[256];
  unsigned port;
  bool literal;
  if (!mo_authority_split(host, n, name, &port, &literal))
    return false;
  for (size_t i = 0; i < names->n; i++)
    if (strcmp(names->items[i], "*") == 0)
      return true;
  /* DNS rebinding cannot fake a numeric address: the page itself would have to come from that
   * address. */
  return (literal && !local) || mo_host_is_loopback(name) || is_named(name, port, names);
}

bool mo_guard_origin(const char *origin, const char *host, const struct mo_names *names)
{
  size_t scheme = strncasecmp(origin, "http://", 7) == 0    ? 7
                  : strncasecmp(origin, "https://", 8) == 0 ? 8
                                                            : 0;
  char name[256], own[256];
  unsigned port, own_port;
  bool literal;
  if (scheme == 0 ||
      !mo_authority_split(origin + scheme, strlen(origin + scheme), name, &port, &literal))
    return false;
  if (is_named(name, port, names))
    return true;
  if (host == NULL || !mo_authority_split(host, strlen(host), own, &own_port, &literal))
    return false;
  unsigned usual = scheme == 7 ? 80 : 443;
  return strcmp(name, own) == 0 && (port == 0 ? usual : port) == (own_port == 0 ? usual : own_port);
}

bool mo_guard_fetch_site(const char *site)
{
  return site == NULL ||
         (strcasecmp(site, "cross-site") != 0 && strcasecmp(site, "same-site") != 0);
}

/* ---- tokens ---- */

const char *const mo_right_words[] = {"worker", "read", "submit", "admin", NULL};

static void free_items(struct mo_token *items, size_t n)
{
  for (size_t i = 0; i < n; i++) {
    char *text = (char *)items[i].text;
    if (text != NULL)
      explicit_bzero(text, strlen(text));
    free(text);
    free((char *)items[i].name);
  }
  free(items);
}

void mo_tokens_free(struct mo_tokens *tokens)
{
  free_items(tokens->items, tokens->n);
}

static bool is_printable(const char *text)
{
  while (*text > 0x20 && *text < 0x7F)
    text++;
  return *text == '\0';
}

int mo_token_check(const struct mo_token *token, struct mo_message *message)
{
  const size_t name_size = strlen(token->name), size = strlen(token->text);
  if (name_size < 1 || name_size > MO_TOKEN_NAME_MAX)
    return mo_fail(message, MO_ERR_INVALID, "the name must have 1 to %d characters, got %zu",
                   MO_TOKEN_NAME_MAX, name_size);
  if (!is_printable(token->name))
    return mo_fail(message, MO_ERR_INVALID,
                   "the name may have only printable ASCII characters, and no spaces");
  if (size < 16 || size > 512)
    return mo_fail(message, MO_ERR_INVALID, "the token must have 16 to 512 characters, got %zu",
                   size);
  if (!is_printable(token->text))
    return mo_fail(message, MO_ERR_INVALID,
                   "the token may have only printable ASCII characters, and no spaces; create a "
                   "different one");
  return MO_OK;
}

int mo_tokens_set(struct mo_tokens *tokens, const struct mo_token *items, size_t n,
                  struct mo_message *message)
{
  if (n > MO_TOKENS_MAX)
    return mo_fail(message, MO_ERR_LIMIT, "there may be at most %d tokens", MO_TOKENS_MAX);
  for (size_t i = 0; i < n; i++) {
    const int error = mo_token_check(&items[i], message);
    if (error != MO_OK)
      return error;
  }
  struct mo_token *copy = calloc(n > 0 ? n : 1, sizeof(*copy));
  bool copied = copy != NULL;
  for (size_t i = 0; i < n && copied; i++) {
    copy[i] = (struct mo_token){strdup(items[i].name), items[i].right, strdup(items[i].text)};
    copied = copy[i].name != NULL && copy[i].text != NULL;
  }
  if (!copied) {
    if (copy != NULL)
      free_items(copy, n);
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory for the tokens");
  }
  pthread_rwlock_wrlock(&tokens->lock);
  struct mo_token *old = tokens->items;
  size_t old_n = tokens->n;
  tokens->items = copy;
  tokens->n = n;
  atomic_fetch_add(&tokens->version, 1);
  pthread_rwlock_unlock(&tokens->lock);
  free_items(old, old_n);
  return MO_OK;
}

/* Compares for equality. Examines every byte of `given`, so that the time reveals nothing. */
static unsigned equals(const char *secret, const char *given, size_t given_size)
{
  size_t secret_size = strlen(secret);
  unsigned difference = secret_size != given_size;
  for (size_t i = 0; i < given_size; i++)
    difference |= (unsigned)((unsigned char)secret[secret_size == 0 ? 0 : i % secret_size] ^
                             (unsigned char)given[i]);
  return difference == 0;
}

int mo_tokens_check(struct mo_tokens *tokens, const char *authorization, struct mo_caller *caller)
{
  const char *given = "";
  if (authorization != NULL && strncasecmp(authorization, "Bearer ", 7) == 0) {
    given = authorization + 7;
    while (*given == ' ' || *given == '\t')
      given++;
  }
  size_t size = strlen(given), found = 0; /* found: number of the matching token, from 1 */
  while (size > 0 && (given[size - 1] == ' ' || given[size - 1] == '\t'))
    size--;
  pthread_rwlock_rdlock(&tokens->lock);
  size_t n = tokens->n;
  for (size_t i = 0; i < n; i++)
    found |= (i + 1) * equals(tokens->items[i].text, given, size);
  if (found > 0) {
    const struct mo_token *token = &tokens->items[found - 1];
    caller->right = token->right;
    memcpy(caller->name, token->name, strlen(token->name) + 1);
  }
  pthread_rwlock_unlock(&tokens->lock);
  return n == 0 ? -1 : found > 0;
}
