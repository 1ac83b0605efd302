/* text.c: see text.h. */
#include "base/text.h"

#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* ---- characters and numbers ---- */

unsigned mo_utf8_sequence(const unsigned char *words, size_t n)
{
  unsigned char first = words[0];
  if (first < 0x80)
    return 1;
  unsigned length = first >= 0xC2 && first <= 0xDF   ? 2
                    : first >= 0xE0 && first <= 0xEF ? 3
                    : first >= 0xF0 && first <= 0xF4 ? 4
                                                     : 0;
  if (length == 0 || n < length)
    return 0;
  unsigned char second_min = first == 0xE0   ? 0xA0
                             : first == 0xF0 ? 0x90
                                             : 0x80; /* no overlong forms */
  unsigned char second_max = first == 0xED   ? 0x9F
                             : first == 0xF4 ? 0x8F
                                             : 0xBF; /* no surrogates, none past U+10FFFF */
  if (words[1] < second_min || words[1] > second_max)
    return 0;
  for (unsigned i = 2; i < length; i++)
    if ((words[i] & 0xC0) != 0x80)
      return 0;
  return length;
}

size_t mo_utf8_length(const char *text, size_t n)
{
  size_t characters = 0;
  for (size_t i = 0; i < n; i++)
    characters += ((unsigned char)text[i] & 0xC0) != 0x80;
  return characters;
}

bool mo_utf8_is_valid(const char *text)
{
  for (size_t n = strlen(text), length; n > 0; text += length, n -= length)
    if ((length = mo_utf8_sequence((const unsigned char *)text, n)) == 0)
      return false;
  return true;
}

/* Writes a number with the fewest digits, starting at `least`, that read back as the same float64.
 * Returns its length. */
static size_t write_number(double value, int least, char text[MO_NUMBER_BYTES])
{
  int n = 0;
  for (int digits = least; digits <= 17; digits++) {
    n = snprintf(text, MO_NUMBER_BYTES, "%.*g", digits, value);
    if (digits < 17 && strtod(text, NULL) == value)
      break;
  }
  return (size_t)n;
}

const char *mo_number_text(double value, char text[MO_NUMBER_BYTES])
{
  write_number(value, 6, text);
  for (char *c = text; *c != '\0'; c++)
    if (*c == ',')
      *c = '.';
  return text;
}

const char *mo_counted_text(uint64_t n, const char *thing, char text[MO_COUNTED_BYTES])
{
  snprintf(text, MO_COUNTED_BYTES, "%" PRIu64 " %s%s", n, thing, n == 1 ? "" : "s");
  return text;
}

const char *mo_cut_text(const char *words, size_t max, char *text)
{
  size_t n = strlen(words);
  if (n <= max)
    return words;
  for (n = max; n > 0 && ((unsigned char)words[n] & 0xc0) == 0x80;)
    n--;
  snprintf(text, max + 4, "%.*s…", (int)n, words);
  return text;
}

int mo_hex_digit(char c)
{
  return c >= '0' && c <= '9'   ? c - '0'
         : c >= 'a' && c <= 'f' ? c - 'a' + 10
         : c >= 'A' && c <= 'F' ? c - 'A' + 10
                                : -1;
}

/* ---- the growing text ---- */

void mo_text_free(struct mo_text *text)
{
  if (text == NULL)
    return;
  free(text->data);
  *text = (struct mo_text){0};
}

/* Reserves space for n more bytes and a NUL. */
static bool reserve(struct mo_text *text, size_t n)
{
  if (text->failed)
    return false;
  if (n < text->capacity - text->size)
    return true;
  size_t capacity = text->capacity < 256 ? 256 : text->capacity;
  while (capacity - text->size <= n && capacity <= SIZE_MAX / 2)
    capacity *= 2;
  char *data = !text->is_fixed && capacity - text->size > n ? realloc(text->data, capacity) : NULL;
  if (data == NULL) {
    text->failed = true;
    return false;
  }
  text->data = data;
  text->capacity = capacity;
  return true;
}

void mo_text_bytes(struct mo_text *text, const void *bytes, size_t n)
{
  if (!reserve(text, n))
    return;
  if (n > 0)
    memcpy(text->data + text->size, bytes, n);
  text->size += n;
  text->data[text->size] = '\0';
}

void mo_text_add(struct mo_text *text, const char *words)
{
  mo_text_bytes(text, words, strlen(words));
}

void mo_text_format(struct mo_text *text, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  va_list again;
  va_copy(again, arguments);
  char small[256];
  int n = vsnprintf(small, sizeof(small), format, arguments);
  va_end(arguments);
  if (n < 0) {
    text->failed = true;
  } else if ((size_t)n < sizeof(small)) {
    mo_text_bytes(text, small, (size_t)n);
  } else if (reserve(text, (size_t)n)) {
    vsnprintf(text->data + text->size, (size_t)n + 1, format, again);
    text->size += (size_t)n;
  }
  va_end(again);
}

/* Returns the character (at most U+FFFF) of a sequence of 2 or 3 bytes if it controls a terminal,
 * else 0. */
static unsigned terminal_control(const unsigned char *bytes, unsigned length)
{
  const unsigned code = length == 2 ? (bytes[0] & 0x1Fu) << 6 | (bytes[1] & 0x3Fu)
                        : length == 3
                            ? (bytes[0] & 0xFu) << 12 | (bytes[1] & 0x3Fu) << 6 | (bytes[2] & 0x3Fu)
                            : 0;
  const bool controls = (code >= 0x80 && code <= 0x9F) || code == 0x61C || code == 0x200E ||
                        code == 0x200F || (code >= 0x2028 && code <= 0x202E) ||
                        (code >= 0x2066 && code <= 0x2069);
  return controls ? code : 0;
}

static void add_string(struct mo_text *text, const char *words, size_t n, bool is_shown)
{
  const unsigned char *bytes = (const unsigned char *)words;
  mo_text_bytes(text, "\"", 1);
  size_t plain = 0; /* start of the current run without escapes */
  for (size_t i = 0; i < n;) {
    unsigned length = mo_utf8_sequence(bytes + i, n - i);
    const unsigned control = is_shown ? terminal_control(bytes + i, length) : 0;
    if (control == 0 && length > 0 && bytes[i] >= 0x20 && bytes[i] != '"' && bytes[i] != '\\' &&
        bytes[i] != 0x7F) {
      i += length;
      continue;
    }
    mo_text_bytes(text, words + plain, i - plain);
    if (length == 0)
      mo_text_add(text, "\xEF\xBF\xBD");
    else if (control != 0)
      mo_text_format(text, "\\u%04x", control);
    else if (bytes[i] == '"' || bytes[i] == '\\')
      mo_text_format(text, "\\%c", bytes[i]);
    else if (bytes[i] == '\n')
      mo_text_add(text, "\\n");
    else
      mo_text_format(text, "\\u%04x", bytes[i]);
    plain = i += control != 0 ? length : 1;
  }
  mo_text_bytes(text, words + plain, n - plain);
  mo_text_bytes(text, "\"", 1);
}

void mo_text_json_string(struct mo_text *text, const char *words, size_t n)
{
  add_string(text, words, n, false);
}

void mo_text_shown_string(struct mo_text *text, const char *words, size_t n)
{
  add_string(text, words, n, true);
}

void mo_text_json_stored(struct mo_text *text, const char *json)
{
  const size_t n = strlen(json);
  size_t whole = 0; /* start of the current run of valid UTF-8 */
  for (size_t i = 0; i < n;) {
    const bool is_break =
        json[i] == '\n' || json[i] == '\r'; /* dropped, because an event is one line */
    unsigned length = mo_utf8_sequence((const unsigned char *)json + i, n - i);
    if (length > 0 && !is_break) {
      i += length;
      continue;
    }
    mo_text_bytes(text, json + whole, i - whole);
    mo_text_add(text, is_break ? " " : "\xEF\xBF\xBD");
    whole = ++i;
  }
  mo_text_bytes(text, json + whole, n - whole);
}

/* Writes number / 10^places, without trailing zeros, backward from the end of the buffer. */
static size_t write_places(bool is_negative, uint64_t number, int places,
                           char text[MO_NUMBER_BYTES])
{
  int n = MO_NUMBER_BYTES;
  for (; places > 0 && number % 10 == 0; places--)
    number /= 10;
  for (int place = 0; place <= places || number > 0; place++) {
    if (place == places && places > 0)
      text[--n] = '.';
    text[--n] = (char)('0' + number % 10);
    number /= 10;
  }
  if (is_negative)
    text[--n] = '-';
  memmove(text, text + n, (size_t)(MO_NUMBER_BYTES - n));
  return (size_t)(MO_NUMBER_BYTES - n);
}

/* Writes the same text as write_number(value, 15, text), eight times as fast, for magnitudes that
 * need no exponent. With m of 53 bits the value is m · 2^(e − 53), and its 17 digits, k of them
 * after the point, are m · 5^k · 2^−shift: integers of up to 103 bits, and exact. Returns 0 if
 * nothing was written. */
static size_t write_plain(double value, char text[MO_NUMBER_BYTES])
{
  typedef unsigned __int128 wide;
  const double size = fabs(value);
  uint64_t five = 1, rounded = 0; /* five: 5^k, and the distance to the next float64 */
  int e;
  if (!(size >= 1e-4 && size < 1e15))
    return 0;
  const uint64_t m = (uint64_t)ldexp(frexp(size, &e), 53);
  int k = 16 - (int)floor((e - 1) * 0.30103);
  for (int i = 0; i < k; i++)
    five *= 5;
  if ((wide)m * five >> (53 - e - k) >= UINT64_C(100000000000000000)) {
    five /= 5;
    k--;
  }
  const int shift = 53 - e - k;
  const wide exact = (wide)m * five;
  for (uint64_t unit = 100; unit >= 1; unit /= 10) {
    const wide step = (wide)unit << shift;
    const uint64_t whole = (uint64_t)(exact >> shift) / unit;
    const wide twice = 2 * (exact - whole * step);
    rounded = (whole + (twice > step || (twice == step && whole % 2 == 1))) * unit;
    const wide found = (wide)rounded << shift;
    /* It reads back correctly if no other float64 is nearer; just below a power of two, float64
     * values are closer together. */
    const wide off = found > exact            ? 2 * (found - exact)
                     : m == UINT64_C(1) << 52 ? 4 * (exact - found)
                                              : 2 * (exact - found);
    if (off < five)
      break;
  }
  return write_places(value < 0, rounded, k, text);
}

void mo_text_json_number(struct mo_text *text, double value)
{
  if (!isfinite(value)) {
    mo_text_add(text, "null");
    return;
  }
  char digits[MO_NUMBER_BYTES];
  /* Fast path with the same text as below: half of the numbers on a page are whole. */
  if (fabs(value) < 1e15 && value == trunc(value) && (value != 0 || !signbit(value))) {
    mo_text_format(text, "%lld", (long long)value);
    return;
  }
  const size_t n = write_plain(value, digits);
  mo_text_bytes(text, digits, n > 0 ? n : write_number(value, 15, digits));
}

/* Writes the same text as "%.*g" with the fewest of 6 to 9 digits that read back, for magnitudes
 * that need no exponent. printf takes microseconds per number, and recordings have millions. Every
 * product is exact: 24 bits of the value and 28 of 5^12. Returns 0 if nothing was written. */
static int write_plain_float(float value, char digits[MO_NUMBER_BYTES])
{
  static const double powers[] = {1e0, 1e1, 1e2, 1e3,  1e4,  1e5, 1e6,
                                  1e7, 1e8, 1e9, 1e10, 1e11, 1e12};
  double size = fabs((double)value), whole = 0;
  int exponent = 5, places = 0;
  if (!(size >= 1e-4 && size < 1e6))
    return 0;
  while (exponent >= 0 ? size < powers[exponent] : size * powers[-exponent] < 1)
    exponent--;
  for (int precision = 6; precision <= 9; precision++) {
    places = precision - 1 - exponent;
    whole = nearbyint(size * powers[places]);
    if ((float)(whole / powers[places]) == (float)size)
      break;
  }
  return (int)write_places(value < 0, (uint64_t)whole, places, digits);
}

void mo_text_json_float(struct mo_text *text, float value)
{
  if (!isfinite(value)) {
    mo_text_add(text, "null");
    return;
  }
  char digits[MO_NUMBER_BYTES];
  int n = write_plain_float(value, digits);
  for (int precision = 6; n == 0 && precision <= 9; precision++) {
    n = snprintf(digits, sizeof(digits), "%.*g", precision, (double)value);
    if (precision < 9 && strtof(digits, NULL) != value)
      n = 0;
  }
  mo_text_bytes(text, digits, (size_t)n);
}

void mo_text_next(struct mo_text *text)
{
  const char last = text->size > 0 ? text->data[text->size - 1] : '{';
  if (last != '{' && last != '[' && last != ':')
    mo_text_bytes(text, ",", 1);
}

void mo_text_counts(struct mo_text *text, const uint32_t *counts, size_t n)
{
  mo_text_add(text, "[");
  for (size_t i = 0; i < n; i++)
    mo_text_format(text, i > 0 ? ",%u" : "%u", counts[i]);
  mo_text_add(text, "]");
}

void mo_text_object(struct mo_text *text)
{
  mo_text_next(text);
  mo_text_bytes(text, "{", 1);
}

void mo_text_name(struct mo_text *text, const char *name)
{
  mo_text_next(text);
  mo_text_bytes(text, "\"", 1);
  mo_text_add(text, name);
  mo_text_bytes(text, "\":", 2);
}

void mo_text_open(struct mo_text *text, const char *name, const char *bracket)
{
  mo_text_name(text, name);
  mo_text_add(text, bracket);
}

void mo_text_member(struct mo_text *text, const char *name, const char *words)
{
  mo_text_name(text, name);
  if (words != NULL)
    mo_text_json_string(text, words, strlen(words));
  else
    mo_text_add(text, "null");
}

void mo_text_member_number(struct mo_text *text, const char *name, double value)
{
  mo_text_name(text, name);
  mo_text_json_number(text, value);
}

void mo_text_member_count(struct mo_text *text, const char *name, uint64_t value)
{
  mo_text_name(text, name);
  mo_text_format(text, "%" PRIu64, value);
}

void mo_text_member_id(struct mo_text *text, const char *name, int64_t id)
{
  mo_text_name(text, name);
  mo_text_format(text, id >= 0 ? "\"%" PRId64 "\"" : "null", id);
}

void mo_text_member_bool(struct mo_text *text, const char *name, bool value)
{
  mo_text_name(text, name);
  mo_text_add(text, value ? "true" : "false");
}

void mo_text_member_time(struct mo_text *text, const char *name, int64_t time_us)
{
  time_t seconds = (time_t)(time_us / 1000000);
  struct tm parts;
  mo_text_name(text, name);
  if (time_us <= 0 || gmtime_r(&seconds, &parts) == NULL) {
    mo_text_add(text, "null");
    return;
  }
  mo_text_format(text, "\"%04d-%02d-%02dT%02d:%02d:%02d.%03dZ\"", parts.tm_year + 1900,
                 parts.tm_mon + 1, parts.tm_mday, parts.tm_hour, parts.tm_min, parts.tm_sec,
                 (int)(time_us / 1000 % 1000));
}
