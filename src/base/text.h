/* text.h: characters, numbers, and a growing text, for JSON and other replies. Different numbers
 * always have different texts, so that no message contradicts itself. */
#ifndef MORPHO_BASE_TEXT_H
#define MORPHO_BASE_TEXT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* ---- characters and numbers ---- */

/* Returns the length of the UTF-8 sequence at `words` (n ≥ 1 bytes long), or 0 if it is invalid.
 * Overlong forms, surrogates, and anything past U+10FFFF are invalid. */
unsigned mo_utf8_sequence(const unsigned char *words, size_t n);
/* Returns whether the whole text is UTF-8. */
bool mo_utf8_is_valid(const char *text);
/* Returns the number of characters in n bytes of UTF-8. */
size_t mo_utf8_length(const char *text, size_t n);

#define MO_NUMBER_BYTES 32

/* Writes a number as a short text that reads back as the same number, with at least six digits if
 * the number has them. The decimal point does not depend on the locale. */
const char *mo_number_text(double value, char text[MO_NUMBER_BYTES]);
/* Produces the same text as an argument for "%s"; valid until the end of the enclosing block. */
#define MO_NUMBER(value) mo_number_text((value), (char[MO_NUMBER_BYTES]){0})

#define MO_COUNTED_BYTES 64

/* Writes a count with its noun, "1 voxel" or "3 voxels", for nouns with a regular plural. */
const char *mo_counted_text(uint64_t n, const char *thing, char text[MO_COUNTED_BYTES]);
/* Produces the same text as an argument for "%s"; valid until the end of the enclosing block. */
#define MO_COUNTED(n, thing) mo_counted_text((n), (thing), (char[MO_COUNTED_BYTES]){0})

/* Returns text for a message: if it is longer than `max` bytes, its beginning, cut between two
 * characters, and "…". text: space for max + 4 bytes. */
const char *mo_cut_text(const char *words, size_t max, char *text);
/* Does the same with a name as an argument for "%s"; valid until the end of the enclosing block. */
#define MO_NAME_SHOWN   80
#define MO_SHOWN(words) mo_cut_text((words), MO_NAME_SHOWN, (char[MO_NAME_SHOWN + 4]){0})

/* Returns the value of a hexadecimal digit, or −1 for other characters. */
int mo_hex_digit(char c);

/* ---- the growing text ---- */

/* After a failed allocation, `failed` is set and later calls do nothing. Writers therefore check it
 * only once, at the end. */
struct mo_text {
  char *data; /* malloc; a NUL follows the last byte if size > 0; ownership may be transferred */
  size_t size, capacity;
  bool failed;
  bool is_fixed; /* `data` belongs to the caller, and cannot grow */
};

void mo_text_free(struct mo_text *text); /* NULL-safe; empties it */

void mo_text_bytes(struct mo_text *text, const void *bytes, size_t n);
void mo_text_add(struct mo_text *text, const char *words);
void mo_text_format(struct mo_text *text, const char *format, ...)
    __attribute__((format(printf, 2, 3)));

/* Appends a JSON string with its quotes. Invalid UTF-8 becomes U+FFFD. */
void mo_text_json_string(struct mo_text *text, const char *words, size_t n);
/* Does the same for a terminal: also escapes characters that would control it (U+0080 to U+009F,
 * and characters that change the direction of text). */
void mo_text_shown_string(struct mo_text *text, const char *words, size_t n);
/* Appends a stored JSON text on one line. Invalid UTF-8 in its strings becomes U+FFFD. */
void mo_text_json_stored(struct mo_text *text, const char *json);
/* Appends a number with the fewest of 15, 16 or 17 significant digits that read back as the same
 * float64; null if it is not finite. */
void mo_text_json_number(struct mo_text *text, double value);
void mo_text_json_float(struct mo_text *text,
                        float value); /* the same for float32 with 6 to 9 digits */
/* Appends an array of counts. */
void mo_text_counts(struct mo_text *text, const uint32_t *counts, size_t n);

/* Appends a comma, unless the text ends with an opening bracket or a colon: before the next item of
 * an array. The functions below do so themselves. */
void mo_text_next(struct mo_text *text);
/* Opens an object. */
void mo_text_object(struct mo_text *text);
/* Appends "name": before a value. */
void mo_text_name(struct mo_text *text, const char *name);
/* Opens a member that is an object or an array, with this bracket. */
void mo_text_open(struct mo_text *text, const char *name, const char *bracket);
/* Append a member: "name":value. */
void mo_text_member(struct mo_text *text, const char *name, const char *words); /* NULL: null */
void mo_text_member_number(struct mo_text *text, const char *name,
                           double value); /* null if it is not finite */
void mo_text_member_count(struct mo_text *text, const char *name, uint64_t value);
/* Writes digits in quotes; null for a negative id. */
void mo_text_member_id(struct mo_text *text, const char *name, int64_t id);
void mo_text_member_bool(struct mo_text *text, const char *name, bool value);
/* Writes "2026-11-21T11:34:04.123Z" in quotes; null for 0. */
void mo_text_member_time(struct mo_text *text, const char *name, int64_t time_us);

#endif
