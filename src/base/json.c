/* json.c: see json.h. */
#include "base/json.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <morpho/error.h>

#include "base/text.h"

/* ---- places ---- */

/* Reads four hexadecimal digits. Returns −1 if there are not four digits. */
static long four_digits(const char *bytes, size_t n)
{
  long code = 0;
  for (size_t k = 0; k < 4; k++) {
    const int digit = k < n ? mo_hex_digit(bytes[k]) : -1;
    if (digit < 0)
      return -1;
    code = code << 4 | digit;
  }
  return code;
}

/* Reads the escape at the start of `bytes`. Returns the character, or −1 with the reason in
 * *words. */
static long read_escape(const char *bytes, size_t n, size_t *size, const char **words)
{
  static const char names[] = "\"\\/bfnrt", values[] = "\"\\/\b\f\n\r\t";
  const char *name = n > 1 && bytes[1] != '\0' ? strchr(names, bytes[1]) : NULL;
  *size = 2;
  if (name != NULL)
    return values[name - names];
  *size = 6;
  const long code = n > 1 && bytes[1] == 'u' ? four_digits(bytes + 2, n - 2) : 0;
  const bool is_high = code >= 0xD800 && code < 0xDC00;
  const long low =
      is_high && n > 8 && bytes[6] == '\\' && bytes[7] == 'u' ? four_digits(bytes + 8, n - 8) : -1;
  if (n < 2 || bytes[1] != 'u')
    *words = "unknown escape in a string";
  else if (code < 0)
    *words = "\\u needs four hexadecimal digits";
  else if (code == 0)
    *words = "\\u0000 is not allowed";
  else if (code >= 0xDC00 && code < 0xE000)
    *words = "invalid \\u escape: a low surrogate without a high surrogate";
  else if (!is_high)
    return code;
  else if (low < 0xDC00 || low >= 0xE000)
    *words = "invalid \\u escape: a high surrogate without a low surrogate";
  else {
    *size = 12;
    return 0x10000 + ((code - 0xD800) << 10) + (low - 0xDC00);
  }
  return -1;
}

/* Writes a character as UTF-8; returns its length. */
static unsigned encode(unsigned long code, char bytes[4])
{
  const unsigned length = code < 0x80 ? 1 : code < 0x800 ? 2 : code < 0x10000 ? 3 : 4;
  for (unsigned k = length; k-- > 1; code >>= 6)
    bytes[k] = (char)(0x80 | (code & 0x3F));
  bytes[0] = (char)(length == 1 ? code : 0xF00UL >> length | code);
  return length;
}

/* Decodes the escapes of a checked string. Writes at most `capacity` bytes; returns the full
 * length. */
static size_t decode(struct mo_json_slice raw, char *out, size_t capacity)
{
  size_t n = 0;
  for (size_t i = 0, size; i < raw.size; i += size) {
    const char *words = NULL;
    char bytes[4] = {raw.bytes[i]};
    unsigned length = 1;
    size = 1;
    if (raw.bytes[i] == '\\')
      length =
          encode((unsigned long)read_escape(raw.bytes + i, raw.size - i, &size, &words), bytes);
    for (unsigned k = 0; k < length; k++, n++)
      if (n < capacity)
        out[n] = bytes[k];
  }
  return n;
}

/* Writes the pointer of the value that began when `depth` levels were open. */
static void write_pointer(const struct mo_json *json, unsigned depth, char *pointer, size_t size)
{
  size_t at = 0;
  for (unsigned d = 0; d < depth && d < json->depth; d++) {
    const struct mo_json_level *level = &json->levels[d];
    char step[MO_JSON_KEY_BYTES * 2 + 16];
    size_t n = 0;
    if (level->index == 0)
      break;
    step[n++] = '/';
    if (level->object) {
      char key[MO_JSON_KEY_BYTES];
      size_t key_size = decode(level->key, key, sizeof(key));
      for (size_t i = 0; i < key_size && i < sizeof(key); i++) {
        if (key[i] == '~' || key[i] == '/') {
          step[n++] = '~';
          step[n++] = key[i] == '~' ? '0' : '1';
        } else {
          step[n++] = key[i];
        }
      }
    } else {
      n += (size_t)snprintf(step + n, sizeof(step) - n, "%u", level->index - 1);
    }
    if (at + n >= size)
      break; /* too long: use the place of an outer value */
    memcpy(pointer + at, step, n);
    at += n;
  }
  pointer[at] = '\0';
}

void mo_json_fault_at(struct mo_json *json, unsigned depth, const char *below, const char *format,
                      ...)
{
  char words[sizeof(json->faults->items[0].detail)], pointer[sizeof(json->faults->items[0].where)];
  va_list arguments;
  if (json->stop)
    return;
  va_start(arguments, format);
  vsnprintf(words, sizeof(words), format, arguments);
  va_end(arguments);
  write_pointer(json, depth, pointer, sizeof(pointer));
  size_t n = strlen(pointer);
  if (n + strlen(below) < sizeof(pointer))
    memcpy(pointer + n, below, strlen(below) + 1);
  mo_faults_add(json->faults, MO_FAULT_BODY, pointer, "%s", words);
  json->stop = mo_faults_full(json->faults);
}

/* Reports where the text stops being JSON, and ends reading. */
static bool syntax(struct mo_json *json, const char *words)
{
  if (json->stop)
    return false;
  size_t line = 1, column = 1;
  for (size_t i = 0; i < json->at && i < json->size; i++) {
    column = json->text[i] == '\n' ? 1 : column + 1;
    line += json->text[i] == '\n';
  }
  json->faults->n = 0; /* earlier faults in a text that is not JSON are meaningless */
  json->faults->malformed = true;
  mo_json_fault(json, "line %zu, column %zu: %s", line, column, words);
  json->stop = true;
  return false;
}

/* ---- the text ---- */

void mo_json_start(struct mo_json *json, const char *text, size_t size, struct mo_faults *faults)
{
  json->text = text;
  json->size = size;
  json->faults = faults;
  json->at = json->depth = json->n_keys = 0;
  json->stop = false;
}

static void skip_space(struct mo_json *json)
{
  while (json->at < json->size) {
    char c = json->text[json->at];
    if (c != ' ' && c != '\t' && c != '\n' && c != '\r')
      break;
    json->at++;
  }
}

static char next_byte(struct mo_json *json)
{
  skip_space(json);
  return json->at < json->size ? json->text[json->at] : '\0';
}

bool mo_json_finish(struct mo_json *json)
{
  if (json->stop)
    return false;
  skip_space(json);
  return json->at == json->size || syntax(json, "trailing data after the JSON value");
}

static bool literal(struct mo_json *json, const char *words)
{
  size_t n = strlen(words);
  return json->size - json->at >= n && memcmp(json->text + json->at, words, n) == 0;
}

enum mo_json_kind mo_json_peek(struct mo_json *json)
{
  static const struct {
    const char *words;
    enum mo_json_kind kind;
  } starts[] = {{"[", MO_JSON_ARRAY},   {"{", MO_JSON_OBJECT},    {"\"", MO_JSON_STRING},
                {"true", MO_JSON_TRUE}, {"false", MO_JSON_FALSE}, {"null", MO_JSON_NULL}};
  if (json->stop)
    return MO_JSON_NONE;
  const char c = next_byte(json);
  if (c == '-' || (c >= '0' && c <= '9'))
    return MO_JSON_NUMBER;
  for (size_t i = 0; i < sizeof(starts) / sizeof(starts[0]); i++)
    if (literal(json, starts[i].words))
      return starts[i].kind;
  if (json->at >= json->size)
    syntax(json, "the text ends where a value must follow");
  else if (literal(json, "NaN") || literal(json, "Infinity") || literal(json, "-Infinity"))
    syntax(json, "not a JSON value; numbers must be finite");
  else if ((unsigned char)c == 0xEF)
    syntax(json, "not a JSON value; a byte-order mark is not allowed");
  else
    syntax(json, "not a JSON value");
  return MO_JSON_NONE;
}

/* Reads a string between its quotes, without decoding. *plain: whether it has no escapes. */
static bool raw_string(struct mo_json *json, struct mo_json_slice *raw, bool *plain)
{
  const unsigned char *text = (const unsigned char *)json->text;
  size_t at = json->at + 1;
  *plain = true;
  while (at < json->size && text[at] != '"') {
    if (text[at] >= 0x20 && text[at] < 0x80 && text[at] != '\\') {
      at++;
      continue;
    }
    size_t start = at;
    const char *words = NULL;
    if (text[at] == '\\') {
      *plain = false;
      size_t length;
      (void)read_escape(json->text + at, json->size - at, &length, &words);
      at += length;
    } else if (text[at] < 0x20) {
      words = "control character in a string; write it as an escape";
    } else {
      unsigned length = mo_utf8_sequence(text + at, json->size - at);
      if (length == 0)
        words = "a string must be valid UTF-8";
      at += length;
    }
    if (words != NULL) {
      json->at = start;
      return syntax(json, words);
    }
  }
  if (at >= json->size) {
    json->at = json->size;
    return syntax(json, "the text ends inside a string");
  }
  raw->bytes = json->text + json->at + 1;
  raw->size = at - json->at - 1;
  json->at = at + 1;
  return true;
}

/* Checks the syntax of a number and moves past it. */
static bool raw_number(struct mo_json *json, struct mo_json_slice *raw)
{
  const char *text = json->text; /* text[size] is NUL, which is not a digit */
  size_t at = json->at;
  if (text[at] == '-')
    at++;
  size_t digits = at;
  while (text[at] >= '0' && text[at] <= '9')
    at++;
  bool good = at > digits && (text[digits] != '0' || at == digits + 1);
  if (good && text[at] == '.') {
    digits = ++at;
    while (text[at] >= '0' && text[at] <= '9')
      at++;
    good = at > digits;
  }
  if (good && (text[at] == 'e' || text[at] == 'E')) {
    at++;
    if (text[at] == '+' || text[at] == '-')
      at++;
    digits = at;
    while (text[at] >= '0' && text[at] <= '9')
      at++;
    good = at > digits;
  }
  /* Only these characters may follow a number. A NUL within the text does not end it. */
  char c = text[at];
  if (at < json->size && c != ' ' && c != '\t' && c != '\n' && c != '\r' && c != ',' && c != ']' &&
      c != '}')
    good = false;
  if (!good) {
    syntax(json, "not a number in JSON's notation");
    return false;
  }
  *raw = (struct mo_json_slice){text + json->at, at - json->at};
  json->at = at;
  return true;
}

/* ---- values ---- */

/* Returns whether the next value is of this kind; otherwise adds a fault and skips the value. */
static bool expect(struct mo_json *json, enum mo_json_kind kind, const char *expected)
{
  static const char *const words[] = {"nothing",  "an object", "an array", "a string",
                                      "a number", "true",      "false",    "null"};
  const enum mo_json_kind found = mo_json_peek(json);
  if (found != kind && found != MO_JSON_NONE) {
    mo_json_fault(json, "must be %s, got %s", expected, words[found]);
    mo_json_skip(json);
  }
  return found == kind;
}

bool mo_json_string(struct mo_json *json, struct mo_json_slice *value)
{
  bool plain;
  struct mo_json_slice raw;
  if (!expect(json, MO_JSON_STRING, "a string") || !raw_string(json, &raw, &plain))
    return false;
  if (plain && raw.size <= MO_JSON_STRING_MAX) {
    *value = raw;
    return true;
  }
  size_t n = plain ? raw.size : decode(raw, json->decoded, MO_JSON_STRING_MAX);
  if (n > MO_JSON_STRING_MAX) {
    mo_json_fault(json, "the string must have at most %d bytes, got %zu", MO_JSON_STRING_MAX, n);
    return false;
  }
  *value = (struct mo_json_slice){json->decoded, n};
  return true;
}

bool mo_json_text(struct mo_json *json, struct mo_json_slice *value)
{
  bool plain;
  if (!expect(json, MO_JSON_STRING, "a string") || !raw_string(json, value, &plain))
    return false;
  if (!plain)
    mo_json_fault(json, "must be a string without escapes");
  return plain;
}

bool mo_json_bool(struct mo_json *json, bool *value)
{
  const bool is_true = mo_json_peek(json) == MO_JSON_TRUE;
  if (!is_true && !expect(json, MO_JSON_FALSE, "true or false"))
    return false;
  *value = is_true;
  json->at += *value ? 4 : 5;
  return true;
}

bool mo_json_number(struct mo_json *json, double *value)
{
  struct mo_json_slice raw;
  if (!expect(json, MO_JSON_NUMBER, "a number") || !raw_number(json, &raw))
    return false;
  double number = strtod(raw.bytes, NULL); /* strtod stops at the end of the checked number */
  if (!isfinite(number)) {
    mo_json_fault(json, "must be a finite number; this one is too large for a float64");
    return false;
  }
  *value = number;
  return true;
}

bool mo_json_bounded(struct mo_json *json, double min, double max, double *value)
{
  double number;
  if (!mo_json_number(json, &number))
    return false;
  if (number < min || number > max) {
    mo_json_fault(json, "must be a number from %s to %s, got %s", MO_NUMBER(min), MO_NUMBER(max),
                  MO_NUMBER(number));
    return false;
  }
  *value = number;
  return true;
}

#define WHOLE_DIGITS_MAX 18 /* digits of a number that always fits in 63 bits */

/* Reads a whole number by its digits, not as a rounded float64: 3.0 and 3e0 are whole,
 * 3.00000000000000000001 is not. MO_ERR_RANGE: too many digits; MO_ERR_INVALID: it has a
 * fraction. */
static int whole_number(struct mo_json_slice raw, int64_t *number)
{
  const bool negative = raw.bytes[0] == '-';
  size_t i = negative, n_digits = 0, zeros = 0; /* zeros: after the last significant digit */
  int64_t value = 0, exponent = 0, fraction = 0;
  for (bool after_point = false; i < raw.size && (raw.bytes[i] | 0x20) != 'e'; i++) {
    const char c = raw.bytes[i];
    after_point |= c == '.';
    if (c == '.')
      continue;
    fraction += after_point;
    zeros += c == '0' && n_digits > 0;
    if (c == '0')
      continue;
    for (n_digits += zeros + 1; n_digits <= WHOLE_DIGITS_MAX && zeros > 0; zeros--)
      value *= 10;
    zeros = 0;
    if (n_digits <= WHOLE_DIGITS_MAX)
      value = value * 10 + (c - '0');
  }
  const bool shrinks = i + 1 < raw.size && raw.bytes[i + 1] == '-';
  for (i++; i < raw.size; i++)
    if (raw.bytes[i] >= '0' && raw.bytes[i] <= '9' && exponent < INT32_MAX)
      exponent = exponent * 10 + (raw.bytes[i] - '0');
  exponent = (shrinks ? -exponent : exponent) + (int64_t)zeros - fraction;
  *number = 0;
  if (n_digits == 0)
    return MO_OK;
  if (exponent < 0)
    return MO_ERR_INVALID;
  if (exponent + (int64_t)n_digits > WHOLE_DIGITS_MAX)
    return MO_ERR_RANGE;
  for (; exponent > 0; exponent--)
    value *= 10;
  *number = negative ? -value : value;
  return MO_OK;
}

bool mo_json_integer(struct mo_json *json, int64_t min, int64_t max, int64_t *value)
{
  struct mo_json_slice raw;
  int64_t number;
  if (!expect(json, MO_JSON_NUMBER, "an integer") || !raw_number(json, &raw))
    return false;
  const int code = whole_number(raw, &number);
  if (code == MO_ERR_RANGE)
    mo_json_fault(json, "must be an integer from %lld to %lld; this number is too large",
                  (long long)min, (long long)max);
  else if (code != MO_OK)
    mo_json_fault(json, "must be an integer, got %.*s", raw.size > 32 ? 32 : (int)raw.size,
                  raw.bytes);
  else if (number < min || number > max)
    mo_json_fault(json, "must be an integer from %lld to %lld, got %lld", (long long)min,
                  (long long)max, (long long)number);
  if (code != MO_OK || number < min || number > max)
    return false;
  *value = number;
  return true;
}

static bool open_level(struct mo_json *json, bool object)
{
  if (json->depth == MO_JSON_DEPTH_MAX)
    return syntax(json, "arrays and objects may be nested at most 64 levels deep");
  json->levels[json->depth++] = (struct mo_json_level){.object = object, .first_key = json->n_keys};
  json->at++;
  return true;
}

bool mo_json_array(struct mo_json *json)
{
  return expect(json, MO_JSON_ARRAY, "an array") && open_level(json, false);
}

bool mo_json_object(struct mo_json *json)
{
  return expect(json, MO_JSON_OBJECT, "an object") && open_level(json, true);
}

/* Moves to the next item or member. Returns false at the closing bracket (the level is closed), or
 * after an error. */
static bool advance(struct mo_json *json, char closing)
{
  if (json->stop)
    return false;
  struct mo_json_level *level = &json->levels[json->depth - 1];
  char c = next_byte(json);
  if (c == closing && json->at < json->size) {
    json->at++;
    json->n_keys = level->first_key;
    json->depth--;
    return false;
  }
  if (level->index > 0) {
    if (c != ',')
      return syntax(json, json->at >= json->size ? "the text ends inside an array or object"
                          : closing == ']'       ? "a comma or ] is missing"
                                                 : "a comma or } is missing");
    json->at++;
    skip_space(json);
  }
  return true;
}

bool mo_json_item(struct mo_json *json)
{
  if (!advance(json, ']'))
    return false;
  json->levels[json->depth - 1].index++;
  return true;
}

static bool same_key(struct mo_json_slice a, struct mo_json_slice b)
{
  if (memchr(a.bytes, '\\', a.size) == NULL && memchr(b.bytes, '\\', b.size) == NULL)
    return a.size == b.size && memcmp(a.bytes, b.bytes, a.size) == 0;
  char left[MO_JSON_KEY_BYTES], right[MO_JSON_KEY_BYTES];
  size_t n = decode(a, left, sizeof(left));
  return n == decode(b, right, sizeof(right)) && memcmp(left, right, n) == 0;
}

bool mo_json_member(struct mo_json *json, struct mo_json_slice *key)
{
  if (!advance(json, '}'))
    return false;
  struct mo_json_level *level = &json->levels[json->depth - 1];
  if (next_byte(json) != '"')
    return syntax(json, json->at >= json->size ? "the text ends inside an object"
                                               : "a key must be a string in quotes");
  bool plain;
  struct mo_json_slice raw = {"", 0};
  if (!raw_string(json, &raw, &plain))
    return false;
  if (raw.size > MO_JSON_KEY_BYTES)
    return syntax(json, "a key may have at most 256 bytes");
  for (uint32_t i = level->first_key; i < json->n_keys; i++)
    if (same_key(json->keys[i], raw)) {
      level->key = raw;
      return syntax(json, "duplicate key in an object");
    }
  if (json->n_keys - level->first_key == MO_JSON_KEYS_MAX)
    return syntax(json, "an object may have at most 64 keys");
  json->keys[json->n_keys++] = raw;
  level->key = raw;
  level->index++;
  if (next_byte(json) != ':')
    return syntax(json, "a colon must follow the key");
  json->at++;
  skip_space(json);
  *key = plain ? raw : (struct mo_json_slice){json->key, decode(raw, json->key, sizeof(json->key))};
  return true;
}

/* Skips a value without recursion, by closing the levels that it opens. */
void mo_json_skip(struct mo_json *json)
{
  unsigned outer = json->depth;
  do {
    if (json->depth > outer) {
      struct mo_json_slice key;
      bool object = json->levels[json->depth - 1].object;
      if (!(object ? mo_json_member(json, &key) : mo_json_item(json)))
        continue; /* the level was closed, or reading has ended */
    }
    bool plain;
    struct mo_json_slice raw;
    enum mo_json_kind kind = mo_json_peek(json);
    switch (kind) {
    case MO_JSON_OBJECT:
    case MO_JSON_ARRAY: open_level(json, kind == MO_JSON_OBJECT); break;
    case MO_JSON_STRING: raw_string(json, &raw, &plain); break;
    case MO_JSON_NUMBER: raw_number(json, &raw); break;
    case MO_JSON_TRUE:
    case MO_JSON_NULL: json->at += 4; break;
    case MO_JSON_FALSE: json->at += 5; break;
    default: break;
    }
  } while (!json->stop && json->depth > outer);
}

bool mo_json_is(struct mo_json_slice slice, const char *words)
{
  return slice.size == strlen(words) && memcmp(slice.bytes, words, slice.size) == 0;
}

void mo_json_counts(struct mo_json *json, uint32_t max, uint32_t *counts, uint32_t room,
                    uint32_t *n)
{
  int64_t count = 0;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); (*n)++)
    if (*n >= room)
      mo_json_skip(json);
    else if (mo_json_integer(json, 0, max, &count))
      counts[*n] = (uint32_t)count;
}
