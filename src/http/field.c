/* field.c: see field.h. */
#include "http/field.h"

#include <arpa/inet.h>
#include <ctype.h>
#include <string.h>
#include <strings.h>

#include "base/text.h"

bool mo_percent_decode(const char *text, size_t n, bool plus, char *out, size_t capacity)
{
  size_t at = 0;
  for (size_t i = 0; i < n; i++) {
    unsigned char c = (unsigned char)text[i];
    if (c == '%') {
      if (n - i < 3 || mo_hex_digit(text[i + 1]) < 0 || mo_hex_digit(text[i + 2]) < 0)
        return false;
      c = (unsigned char)(mo_hex_digit(text[i + 1]) << 4 | mo_hex_digit(text[i + 2]));
      i += 2;
    } else if (c == '+' && plus) {
      c = ' ';
    }
    if (c < 0x20 || c == 0x7F || at + 1 >= capacity)
      return false;
    out[at++] = (char)c;
  }
  out[at] = '\0';
  return mo_utf8_is_valid(out);
}

bool mo_query_next(const char **query, struct mo_query_item *item)
{
  const char *at = *query;
  while (*at == '&')
    at++;
  if (*at == '\0')
    return false;
  size_t n = strcspn(at, "&");
  const char *equals = memchr(at, '=', n);
  item->name = at;
  item->name_size = equals != NULL ? (size_t)(equals - at) : n;
  item->value = equals != NULL ? equals + 1 : at + n;
  item->value_size = equals != NULL ? n - item->name_size - 1 : 0;
  *query = at + n;
  return true;
}

bool mo_decimal(const char *text, size_t n, int64_t min, int64_t max, int64_t *value)
{
  int64_t number = 0;
  if (n == 0 || n > 18)
    return false;
  for (size_t i = 0; i < n; i++) {
    if (text[i] < '0' || text[i] > '9')
      return false;
    number = number * 10 + (text[i] - '0');
  }
  if (number < min || number > max)
    return false;
  *value = number;
  return true;
}

bool mo_id(const char *text, int64_t *id)
{
  return text[0] != '0' && mo_decimal(text, strlen(text), 1, INT64_MAX, id);
}

static const char *skip_blank(const char *at)
{
  while (*at == ' ' || *at == '\t')
    at++;
  return at;
}

/* Returns the length of a text without trailing blanks. */
static size_t trimmed(const char *at, size_t n)
{
  while (n > 0 && (at[n - 1] == ' ' || at[n - 1] == '\t'))
    n--;
  return n;
}

/* Takes the next part of a list, without the blanks around it, and moves past its separator.
 * Returns false at the end. */
static bool next_part(const char **at, const char *separator, const char **part, size_t *n)
{
  const char *start = skip_blank(*at);
  const size_t size = strcspn(start, separator);
  if (**at == '\0')
    return false;
  *part = start;
  *n = trimmed(start, size);
  *at = start + size + (start[size] != '\0');
  return true;
}

/* Removes the quotes around a value, if any. */
static void unquote(const char **value, size_t *n)
{
  if (*n < 2 || (*value)[0] != '"' || (*value)[*n - 1] != '"')
    return;
  (*value)++;
  *n -= 2;
}

int mo_prefer_wait(const char *field, int max)
{
  const char *part, *value;
  size_t n, size;
  int64_t seconds;
  while (field != NULL && next_part(&field, ",", &part, &n)) {
    const size_t name = strcspn(part, ",;=");
    if (trimmed(part, name) != 4 || strncasecmp(part, "wait", 4) != 0)
      continue;
    if (part[name] != '=')
      continue;
    part += name + 1;
    value = skip_blank(part);
    size = trimmed(value, strcspn(value, ",;"));
    unquote(&value, &size);
    if (mo_decimal(value, size, 0, INT64_MAX, &seconds))
      return seconds > max ? max : (int)seconds;
  }
  return -1;
}

/* Returns the quality of one element of Accept, which is its parameter q in thousandths, or −1 if
 * it is malformed. */
static int quality(const char *at, size_t n)
{
  const char *end = at + n;
  while ((at = memchr(at, ';', (size_t)(end - at))) != NULL) {
    at = skip_blank(at + 1);
    if (end - at >= 2 && (at[0] == 'q' || at[0] == 'Q') && at[1] == '=') {
      const char *digits = at + 2;
      if (digits >= end || (*digits != '0' && *digits != '1'))
        return -1;
      int q = (*digits++ - '0') * 1000;
      if (digits < end && *digits == '.') {
        digits++;
        for (int unit = 100; unit > 0 && digits < end && isdigit((unsigned char)*digits);
             unit /= 10)
          q += (*digits++ - '0') * unit;
      }
      return q > 1000 ? -1 : q;
    }
  }
  return 1000;
}

int mo_accept_choose(const char *field, const char *const *types, size_t n)
{
  if (field == NULL || *skip_blank(field) == '\0')
    return 0;
  int best = -1, best_q = 0;
  for (size_t t = 0; t < n; t++) {
    const char *type = types[t], *at = field, *part;
    size_t major = strcspn(type, "/"), size;
    int q = 0, specific = -1; /* q: from the most specific element that matches this type */
    while (next_part(&at, ",", &part, &size)) {
      size_t name = trimmed(part, strcspn(part, ",;"));
      int rank =
          name == strlen(type) && strncasecmp(part, type, name) == 0 ? 2
          : name == major + 2 && strncasecmp(part, type, major + 1) == 0 && part[major + 1] == '*'
              ? 1
          : name == 3 && strncmp(part, "*/*", 3) == 0 ? 0
                                                      : -1;
      if (rank > specific) {
        specific = rank;
        q = quality(part, size);
      }
    }
    if (q > best_q) {
      best_q = q;
      best = (int)t;
    }
  }
  return best;
}

bool mo_accept_coding(const char *field, const char *coding)
{
  const char *part;
  size_t n;
  int q = 0;
  bool named = false;
  while (field != NULL && next_part(&field, ",", &part, &n)) {
    const size_t name = trimmed(part, strcspn(part, ",;"));
    const bool is_it = name == strlen(coding) && strncasecmp(part, coding, name) == 0;
    if (is_it || (!named && name == 1 && *part == '*'))
      q = quality(part, n);
    named = named || is_it;
  }
  return q > 0;
}

bool mo_etag_matches(const char *field, const char *etag)
{
  if (field == NULL)
    return false;
  for (const char *at = skip_blank(field); *at != '\0';) {
    if (*at == '*')
      return true;
    if (at[0] == 'W' && at[1] == '/')
      at += 2;
    if (*at == '"') {
      size_t n = strcspn(at + 1, "\"") + 2;
      if (n == strlen(etag) && memcmp(at, etag, n) == 0)
        return true;
      if (strlen(at) < n)
        return false;
      at += n;
    }
    at += strcspn(at, ",");
    at = *at == ',' ? skip_blank(at + 1) : at;
  }
  return false;
}

static void copy_lower(char *out, const char *text, size_t n)
{
  for (size_t i = 0; i < n; i++)
    out[i] = (char)tolower((unsigned char)text[i]);
  out[n] = '\0';
}

bool mo_content_type(const char *field, char type[64], char charset[32])
{
  const char *part;
  size_t n;
  charset[0] = '\0';
  if (!next_part(&field, ";", &part, &n) || n == 0 || n >= 64 || memchr(part, '/', n) == NULL)
    return false;
  copy_lower(type, part, n);
  while (next_part(&field, ";", &part, &n))
    if (n > 8 && strncasecmp(part, "charset=", 8) == 0) {
      part += 8;
      n -= 8;
      unquote(&part, &n);
      if (n >= 32)
        return false;
      copy_lower(charset, part, n);
    }
  return true;
}

bool mo_idempotency_key(const char *field, char out[256])
{
  const char *at = skip_blank(field);
  size_t n = trimmed(at, strlen(at)), size = 0;
  bool quoted = n >= 2 && at[0] == '"' && at[n - 1] == '"';
  for (size_t i = quoted; i < n - quoted; i++) {
    char c = at[i];
    if (quoted && c == '\\' && i + 1 < n - 1 && (at[i + 1] == '"' || at[i + 1] == '\\'))
      c = at[++i];
    else if (quoted && (c == '\\' || c == '"'))
      return false;
    if (c < 0x20 || c > 0x7E || size == 255)
      return false;
    out[size++] = c;
  }
  out[size] = '\0';
  return size > 0;
}

bool mo_host_is_loopback(const char *host)
{
  struct in_addr v4;
  struct in6_addr v6;
  if (inet_pton(AF_INET, host, &v4) == 1)
    return ntohl(v4.s_addr) >> 24 == 127;
  if (inet_pton(AF_INET6, host, &v6) == 1)
    return IN6_IS_ADDR_LOOPBACK(&v6);
  return strcmp(host, "localhost") == 0;
}

bool mo_authority_split(const char *text, size_t n, char host[256], unsigned *port, bool *literal)
{
  size_t size;
  *port = 0;
  if (n > 0 && text[0] == '[') {
    const char *end = memchr(text, ']', n);
    if (end == NULL)
      return false;
    size = (size_t)(end - text) + 1;
    if (size - 2 >= 256)
      return false;
    memcpy(host, text + 1, size - 2);
    host[size - 2] = '\0';
    struct in6_addr address;
    if (inet_pton(AF_INET6, host, &address) != 1)
      return false;
    *literal = true;
  } else {
    const char *colon = memchr(text, ':', n);
    size = colon != NULL ? (size_t)(colon - text) : n;
    if (size == 0 || size >= 256)
      return false;
    for (size_t i = 0; i < size; i++)
      if (!isalnum((unsigned char)text[i]) && strchr("-._", text[i]) == NULL)
        return false;
    copy_lower(host, text, size);
    struct in_addr address;
    *literal = inet_pton(AF_INET, host, &address) == 1;
  }
  if (size < n) {
    int64_t number;
    if (text[size] != ':' || !mo_decimal(text + size + 1, n - size - 1, 1, 65535, &number))
      return false;
    *port = (unsigned)number;
  }
  return true;
}
