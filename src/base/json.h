/* json.h: a strict JSON reader (RFC 8259) that reads the text in place, without building a tree.
 *
 * It reads a request of 32 MiB in one pass: the caller asks for the values that it expects.
 * Anything else becomes a fault with the JSON pointer of its location. A syntax error ends reading
 * (400). A value of the wrong kind or range adds a fault (422) and is skipped, and reading
 * continues, so that a client receives many faults at once.
 *
 * Strict means: UTF-8 only, no byte-order mark, no NaN or Infinity, no leading zeros, no lone
 * surrogates, no repeated key in an object, no trailing data, at most MO_JSON_DEPTH_MAX levels and
 * MO_JSON_KEYS_MAX keys per object. */
#ifndef MORPHO_BASE_JSON_H
#define MORPHO_BASE_JSON_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "base/faults.h"

#define MO_JSON_DEPTH_MAX  64
#define MO_JSON_KEYS_MAX   64   /* of one object */
#define MO_JSON_KEY_BYTES  256  /* of one key, as written */
#define MO_JSON_STRING_MAX 1024 /* longest decoded string, in bytes */

enum mo_json_kind {
  MO_JSON_NONE, /* end of the text, or a syntax error */
  MO_JSON_OBJECT,
  MO_JSON_ARRAY,
  MO_JSON_STRING,
  MO_JSON_NUMBER,
  MO_JSON_TRUE,
  MO_JSON_FALSE,
  MO_JSON_NULL
};

struct mo_json_slice {
  const char *bytes; /* not terminated */
  size_t size;
};

struct mo_json_level {
  bool object;
  uint32_t index;           /* index of the current item; after the last, the number of items */
  struct mo_json_slice key; /* of the current member, as written; index 0: none yet */
  uint32_t first_key;       /* index of the object's first key in the reader's list */
};

struct mo_json {
  const char *text;
  size_t size, at;
  struct mo_faults *faults;
  bool stop; /* after a syntax error or too many faults: every call fails */
  unsigned depth;
  struct mo_json_level levels[MO_JSON_DEPTH_MAX];
  uint32_t n_keys;
  struct mo_json_slice
      keys[MO_JSON_DEPTH_MAX * MO_JSON_KEYS_MAX]; /* keys of all open objects, innermost last */
  char decoded[MO_JSON_STRING_MAX + 4];
  char key[MO_JSON_KEY_BYTES]; /* decoded; never longer than in the text */
};

/* Starts reading `size` bytes; text[size] must be readable and NUL. A reader takes 70 kB, so do not
 * put one on a small stack. */
void mo_json_start(struct mo_json *json, const char *text, size_t size, struct mo_faults *faults);
/* Ends reading. Returns whether the whole text was read without a syntax error; there may be other
 * faults. */
bool mo_json_finish(struct mo_json *json);

/* Returns the kind of the next value. */
enum mo_json_kind mo_json_peek(struct mo_json *json);

/* The following functions read one value each. They return false for a value of a different kind,
 * which is skipped and adds a fault that gives the expected kind. */
bool mo_json_string(struct mo_json *json,
                    struct mo_json_slice *value); /* valid until the next string; a string longer
                                                     than MO_JSON_STRING_MAX is also a fault */
/* Reads a string of any length without escapes; `value` points into the text. */
bool mo_json_text(struct mo_json *json, struct mo_json_slice *value);
bool mo_json_bool(struct mo_json *json, bool *value);
bool mo_json_number(struct mo_json *json, double *value); /* finite */
/* Reads a whole number in min … max, judged by its digits: 3.0 and 3e0 count as 3, but
 * 3.00000000000000000001 is not whole. */
bool mo_json_integer(struct mo_json *json, int64_t min, int64_t max, int64_t *value);
/* Reads a finite number in min … max. */
bool mo_json_bounded(struct mo_json *json, double min, double max, double *value);

/* Read arrays: if (mo_json_array(json)) while (mo_json_item(json)) read one value. Objects work the
 * same way, with a key. Each value must be read or skipped before the next item. */
bool mo_json_array(struct mo_json *json);
bool mo_json_item(struct mo_json *json);
bool mo_json_object(struct mo_json *json);
/* Moves to the next member. Escapes in the key are decoded; the key is valid until the next member
 * with an escaped key, in any object. */
bool mo_json_member(struct mo_json *json, struct mo_json_slice *key);

/* Reads an array of whole numbers from 0 to max into `counts`, up to `room` of them. *n is
 * incremented for each item, including items beyond `room`. A rejected count leaves its element
 * unchanged. */
void mo_json_counts(struct mo_json *json, uint32_t max, uint32_t *counts, uint32_t room,
                    uint32_t *n);

void mo_json_skip(struct mo_json *json);

/* Adds a fault at `below` ("" or "/cells/7") under the value that began when `depth` levels were
 * open. */
void mo_json_fault_at(struct mo_json *json, unsigned depth, const char *below, const char *format,
                      ...) __attribute__((format(printf, 4, 5)));
/* Adds a fault at the value that is being read (between values: at the previous item). */
#define mo_json_fault(json, ...) mo_json_fault_at(json, (json)->depth, "", __VA_ARGS__)
bool mo_json_is(struct mo_json_slice slice, const char *words);

#endif
