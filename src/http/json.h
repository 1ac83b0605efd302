/* json.h: a strict reader of JSON (RFC 8259) that walks over the text and keeps nothing but its
 * place.
 *
 * A request of 32 MiB is read in one pass, without a tree in memory: the caller asks for what it
 * expects, and what is not as expected becomes a fault with the JSON pointer of its place. Syntax
 * errors end the reading (400); values of the wrong kind or range are faults (422), are skipped,
 * and reading goes on, so that a client learns of many at once.
 *
 * Strict: UTF-8 only, no byte-order mark, no NaN or Infinity, no leading zeros, no lone surrogates,
 * no key twice in an object, nothing behind the value, no more than MO_JSON_DEPTH_MAX levels and
 * MO_JSON_KEYS_MAX keys of an object. */
#ifndef MORPHO_HTTP_JSON_H
#define MORPHO_HTTP_JSON_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "http/fault.h"

#define MO_JSON_DEPTH_MAX  64
#define MO_JSON_KEYS_MAX   64   /* of one object */
#define MO_JSON_KEY_BYTES  256  /* of one key, as written */
#define MO_JSON_STRING_MAX 1024 /* bytes of a decoded string that the reader hands out */

enum mo_json_kind {
  MO_JSON_NONE, /* the text ends, or a syntax error was found */
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
  uint32_t index;           /* of the current item; number of items so far */
  struct mo_json_slice key; /* of the current member, as written; index 0: none yet */
  uint32_t first_key;       /* place of the object's keys in the reader's list */
};

struct mo_json {
  const char *text;
  size_t size, at;
  struct mo_faults *faults;
  bool stop; /* syntax error, or too many faults: every call fails from now on */
  unsigned depth;
  struct mo_json_level levels[MO_JSON_DEPTH_MAX];
  uint32_t n_keys;
  struct mo_json_slice
      keys[MO_JSON_DEPTH_MAX * MO_JSON_KEYS_MAX]; /* of all open objects, innermost last */
  char decoded[MO_JSON_STRING_MAX + 4];
};

/* Starts on `size` bytes, of which text[size] must be readable and NUL. The reader is large (70
 * kB): not for small stacks. */
void mo_json_start(struct mo_json *json, const char *text, size_t size, struct mo_faults *faults);
/* True if all of the text was read without a syntax error and nothing follows. Faults of the other
 * sort may still be there. */
bool mo_json_finish(struct mo_json *json);

/* What comes next. */
enum mo_json_kind mo_json_peek(struct mo_json *json);

/* Each of the following reads one value. If it is not of that kind: a fault that names what was
 * expected, the value is skipped, false. */
bool mo_json_string(struct mo_json *json,
                    struct mo_json_slice *value); /* valid until the next string; the fault includes
                                                     "longer than MO_JSON_STRING_MAX" */
bool mo_json_bool(struct mo_json *json, bool *value);
bool mo_json_number(struct mo_json *json, double *value); /* finite */
/* A number without fraction in min … max; 3.0 and 3e0 count as 3. */
bool mo_json_integer(struct mo_json *json, int64_t min, int64_t max, int64_t *value);
/* A finite number in min … max. */
bool mo_json_bounded(struct mo_json *json, double min, double max, double *value);

/* Arrays: if (mo_json_array(json)) while (mo_json_item(json)) read one value;   Objects likewise,
 * with the key. Every value must be read or skipped before the next item. */
bool mo_json_array(struct mo_json *json);
bool mo_json_item(struct mo_json *json);
bool mo_json_object(struct mo_json *json);
bool mo_json_member(struct mo_json *json,
                    struct mo_json_slice *key); /* the key as written: escapes are not resolved */
/* Index of the current item of the innermost array; number of items after the last. */
uint32_t mo_json_index(const struct mo_json *json);

void mo_json_skip(struct mo_json *json);

/* A fault at the place of the value that is being read (or, between values, of the item before). */
void mo_json_fault(struct mo_json *json, const char *format, ...)
    __attribute__((format(printf, 2, 3)));
/* A fault at `below` ("" or "/cells/7") under the value that was begun when `depth` levels were
 * open. */
void mo_json_fault_at(struct mo_json *json, unsigned depth, const char *below, const char *format,
                      ...) __attribute__((format(printf, 4, 5)));
/* The pointer of the value that was begun when `depth` levels were open. */
void mo_json_pointer(const struct mo_json *json, unsigned depth, char *pointer, size_t size);

bool mo_json_is(struct mo_json_slice slice, const char *words);

#endif
