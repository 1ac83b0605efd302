/* field.h: the values of header fields, paths and queries. Pure functions over text. */
#ifndef MORPHO_HTTP_FIELD_H
#define MORPHO_HTTP_FIELD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "http/fault.h"

/* Resolves percent escapes of a path segment or query value into `out` (NUL-terminated). False: a
 * malformed escape, a control byte (so also %00), bytes that are not UTF-8, or no room. plus: '+'
 * stands for a space (queries). */
bool mo_percent_decode(const char *text, size_t n, bool plus, char *out, size_t capacity);

/* One query parameter after the other: *query moves on. False at the end. Name and value are as
 * written. */
struct mo_query_item {
  const char *name, *value;
  size_t name_size, value_size;
};
bool mo_query_next(const char **query, struct mo_query_item *item);

/* Decimal digits only, in min … max. */
bool mo_decimal(const char *text, size_t n, int64_t min, int64_t max, int64_t *value);

/* Prefer (RFC 7240): seconds of wait=N, at most `max`; −1: not asked for; −2: malformed. */
int mo_prefer_wait(const char *field, int max);

/* Accept (RFC 9110, 12.5.1): the index of the best of `types` ("application/json", in the server's
 * order of preference), −1 if none is acceptable. NULL or empty field: 0. */
int mo_accept_choose(const char *field, const char *const *types, size_t n);

/* If-None-Match: does the list name this strong tag (with its quotes)? Weak tags compare as weak.
 * "*" matches. */
bool mo_etag_matches(const char *field, const char *etag);

/* The media type of a Content-Type field without its parameters, in lower case. False: malformed or
 * too long. *charset: "" or the charset parameter in lower case. */
bool mo_content_type(const char *field, char type[64], char charset[32]);

/* An Idempotency-Key, bare or as a structured string in quotes, resolved into out (≥ 256 bytes).
 * False: empty, too long, not printable ASCII. */
bool mo_idempotency_key(const char *field, char out[256]);

/* Splits "host", "host:port", "[v6]:port" into host (lower case, brackets removed; NUL-terminated)
 * and port (0: none). */
bool mo_authority_split(const char *text, size_t n, char host[256], unsigned *port, bool *literal);

#endif
