/* text.h: a growing text, for JSON and other replies.
 *
 * A failed allocation is remembered and every later call does nothing: writers check `failed` once,
 * at the end. */
#ifndef MORPHO_HTTP_TEXT_H
#define MORPHO_HTTP_TEXT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct mo_text {
  char *data; /* NUL behind the last byte when size > 0; malloc, so that it can be handed on */
  size_t size, capacity;
  bool failed;
};

void mo_text_free(struct mo_text *text); /* NULL-safe; empties it */

void mo_text_bytes(struct mo_text *text, const void *bytes, size_t n);
void mo_text_add(struct mo_text *text, const char *words);
void mo_text_format(struct mo_text *text, const char *format, ...)
    __attribute__((format(printf, 2, 3)));

/* A JSON string with its quotes. Bytes that are not UTF-8 become U+FFFD. */
void mo_text_json_string(struct mo_text *text, const char *words, size_t n);
/* A JSON text as it is stored, in one line. Bytes in its strings that are not UTF-8 become U+FFFD.
 */
void mo_text_json_stored(struct mo_text *text, const char *json);
/* The shortest of 15, 16 or 17 significant digits that reads back as the same float64; null if it
 * is not finite. */
void mo_text_json_number(struct mo_text *text, double value);
void mo_text_json_float(struct mo_text *text,
                        float value); /* the same for float32 with 6 to 9 digits */
void mo_text_json_integer(struct mo_text *text, int64_t value);
/* "2026-11-21T11:34:04.123Z" in quotes; null for 0. */
void mo_text_json_time(struct mo_text *text, int64_t time_us);
/* Members of an object that has one already: ,"name":value. */
void mo_text_member(struct mo_text *text, const char *name, const char *words);
void mo_text_member_number(struct mo_text *text, const char *name,
                           double value); /* null if it is not finite */
void mo_text_member_count(struct mo_text *text, const char *name, uint64_t value);
void mo_text_member_bool(struct mo_text *text, const char *name, bool value);
void mo_text_member_time(struct mo_text *text, const char *name, int64_t time_us);
/* Lower-case hexadecimal digits, without quotes. */
void mo_text_hex(struct mo_text *text, const uint8_t *bytes, size_t n);

/* The length of the UTF-8 sequence that starts at `words` (n ≥ 1 bytes are there), 0 if it is not
 * valid. */
unsigned mo_utf8_sequence(const unsigned char *words, size_t n);

#endif
