/* field.h: parses the values of header fields, paths and queries. Pure functions over text. */
#ifndef MORPHO_HTTP_FIELD_H
#define MORPHO_HTTP_FIELD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Decodes percent escapes of a path segment or query value into `out` (NUL-terminated). Returns
 * false if an escape is malformed, if the result contains a control byte (including %00) or invalid
 * UTF-8, or if `out` is too small. plus: '+' means a space (queries). */
bool mo_percent_decode(const char *text, size_t n, bool plus, char *out, size_t capacity);

/* Reads the next query parameter and advances *query. Returns false at the end. Name and value are
 * still escaped. */
struct mo_query_item {
  const char *name, *value;
  size_t name_size, value_size;
};
bool mo_query_next(const char **query, struct mo_query_item *item);

/* Reads decimal digits only; the value must be in min … max. */
bool mo_decimal(const char *text, size_t n, int64_t min, int64_t max, int64_t *value);
/* Reads the id of a job or row: 1 to 18 digits, the first digit not 0. */
bool mo_id(const char *text, int64_t *id);

/* Reads Prefer (RFC 7240). Returns the seconds of wait=N, at most `max`. Returns −1 if it is absent
 * or not a whole number of seconds, because a server ignores preferences that it does not
 * understand. */
int mo_prefer_wait(const char *field, int max);

/* Chooses by Accept (RFC 9110, 12.5.1) among `types` ("application/json", in the server's order of
 * preference). Returns the index, −1 if none is acceptable, or 0 if the field is NULL or empty. */
int mo_accept_choose(const char *field, const char *const *types, size_t n);

/* Returns whether Accept-Encoding allows a coding ("gzip"). Returns false if the field is NULL or
 * empty. */
bool mo_accept_coding(const char *field, const char *coding);

/* Returns whether the list in If-None-Match includes this strong tag (with its quotes). Comparison
 * is weak; "*" matches. */
bool mo_etag_matches(const char *field, const char *etag);

/* Reads a Content-Type field: the media type without parameters, and the charset parameter ("" if
 * absent), both in lower case. Returns false if it is malformed or too long. */
bool mo_content_type(const char *field, char type[64], char charset[32]);

/* Reads an Idempotency-Key, bare or as a quoted structured string, into out (≥ 256 bytes). Returns
 * false if it is empty, too long, or not printable ASCII. */
bool mo_idempotency_key(const char *field, char out[256]);

/* Returns whether a host is loopback, by number or name. */
bool mo_host_is_loopback(const char *host);

/* Splits "host", "host:port", "[v6]:port" into host (lower case, brackets removed; NUL-terminated)
 * and port (0: none). */
bool mo_authority_split(const char *text, size_t n, char host[256], unsigned *port, bool *literal);

#endif
