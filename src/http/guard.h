/* guard.h: checks that every request must pass before a route sees it.
 *
 * libmicrohttpd 0.9.75 accepts framing that two parsers may interpret differently (repeated, spaced
 * or folded Content-Length, unknown transfer codings, control bytes in names). Such requests are
 * rejected and their connection is closed. Host and Origin are checked so that no web page can
 * reach the service by DNS rebinding. Tokens are compared in constant time. */
#ifndef MORPHO_HTTP_GUARD_H
#define MORPHO_HTTP_GUARD_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>

#include "http/http.h"

#define MO_HEADERS_MAX 100

struct mo_header {
  const char *name, *value; /* NUL-terminated */
  size_t name_size, value_size;
};

struct mo_refusal {
  unsigned status;
  bool close;         /* the framing is ambiguous: read nothing more from the connection */
  const char *header; /* the invalid field, or NULL */
  const char *detail;
};

/* The framing of the body according to the header, and the fields that routes use (NULL:
 * absent). */
struct mo_framing {
  bool has_length, chunked;
  uint64_t length;
  bool expects_continue;
  const char *host, *origin, *authorization, *accept, *accept_encoding, *content_type,
      *content_encoding, *content_digest, *prefer, *idempotency_key, *if_none_match, *last_event_id,
      *fetch_site;
};

/* Checks the header. Returns false after filling in *refusal. http10: the request is HTTP/1.0. */
bool mo_guard_headers(const struct mo_header *headers, size_t n, bool http10,
                      struct mo_framing *framing, struct mo_refusal *refusal);

/* Splits a request target in origin or absolute form. path: path_size bytes; query: NUL-terminated,
 * "" if none; authority: NULL unless the form is absolute. `target` is as received. */
struct mo_target {
  const char *path, *query, *authority;
  size_t path_size, authority_size;
};
bool mo_guard_target(const char *target, struct mo_target *parts, struct mo_refusal *refusal);

struct mo_names {
  const char *const *items; /* "host" or "host:port"; "*": any */
  size_t n;
};

/* Accepts a Host that is a numeric address, a loopback name, or one of `names`. local: accepts only
 * loopback among numeric addresses. */
bool mo_guard_host(const char *host, size_t n, bool local, const struct mo_names *names);
/* Accepts an Origin that has the host and port of `host`, or is one of `names`. */
bool mo_guard_origin(const char *origin, const char *host, const struct mo_names *names);
/* Returns false if Sec-Fetch-Site (nullable) says that the request comes from a page of a different
 * site, or of a different name of this site. */
bool mo_guard_fetch_site(const char *site);

/* ---- tokens ---- */

struct mo_tokens {
  pthread_rwlock_t lock;
  atomic_uint version; /* incremented by each change; at least 1 once tokens are set */
  struct mo_token *items;
  size_t n;
};
/* The sender of a request, and its rights. */
struct mo_caller {
  char name[MO_TOKEN_NAME_MAX + 1]; /* the token's name; "": no token was required or sent */
  enum mo_right right;
};
void mo_tokens_free(struct mo_tokens *tokens);
/* Checks name and text of a token. MO_ERR_INVALID: the message says what a valid one looks like,
 * but never quotes the token. */
int mo_token_check(const struct mo_token *token, struct mo_message *message);
/* Replaces the tokens. MO_ERR_INVALID; MO_ERR_LIMIT: too many; MO_ERR_NO_MEMORY. On an error, the
 * old tokens stay. */
int mo_tokens_set(struct mo_tokens *tokens, const struct mo_token *items, size_t n,
                  struct mo_message *message);
/* Checks "Bearer <token>". Returns 1 and fills in *caller if the token matches, 0 if it does not,
 * and −1 if no tokens are set. The time that this takes does not reveal which token matched, or how
 * many of its characters. */
int mo_tokens_check(struct mo_tokens *tokens, const char *authorization, struct mo_caller *caller);

#endif
