/* fields.h: settings as tables. Each setting is one row: its name in JSON, its offset in a struct,
 * its bounds, its unit and one line of help. Requests, replies, the database, checkpoints, the
 * metadata of controllers and the command line use these rows.
 *
 * Numbers are written with enough digits to be read back bit for bit. */
#ifndef MORPHO_BASE_FIELDS_H
#define MORPHO_BASE_FIELDS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>

#include "base/json.h"
#include "base/text.h"
#include "base/words.h"

#define MO_SEED_MAX INT64_C(9007199254740991) /* 2^53 − 1: exact in every JSON reader */

enum mo_field_type {
  MO_FIELD_COUNT,   /* uint32_t */
  MO_FIELD_SEED,    /* uint64_t, at most MO_SEED_MAX */
  MO_FIELD_NUMBER,  /* double, finite */
  MO_FIELD_FLAG,    /* bool */
  MO_FIELD_WORD,    /* an enumeration: one of `words`, by its index */
  MO_FIELD_NUMBERS, /* double[n], finite: an array of exactly n; with `side`, or one of rows */
  MO_FIELD_TEXT,    /* char[max + 1]: min to max printable ASCII characters */
  MO_FIELD_GROUP,   /* an object: the rows of `group`, for the struct at `offset` */
  MO_FIELD_INLINE,  /* the rows of `group` without an object around them; this row has no name */
  MO_FIELD_OWN      /* anything else, by the functions of `own` */
};

enum mo_field_flag {
  MO_FIELD_ABOVE_MIN = 1, /* the lower bound itself is not allowed */
  MO_FIELD_BELOW_MAX = 2, /* the upper bound itself is not allowed */
  MO_FIELD_NULL = 4,      /* null stands for 0 or the empty text; for a group with a bool first in
                             its struct, for false; for a word, when writing, for an index below
                             0 */
  MO_FIELD_UTF8 = 8       /* char[4 · max + 1]: a text of any characters except NUL */
};

struct mo_fields;

/* Functions for a field with its own type. value: the field in its struct. read: reads one JSON
 * value of any kind; an invalid one adds a fault at its place and leaves `value` unchanged. check:
 * MO_OK, MO_ERR_INVALID or MO_ERR_RANGE, with a message that begins with `name`, the path of the
 * setting; NULL: nothing to check. */
struct mo_field_own {
  void (*read)(struct mo_json *json, void *value);
  void (*write)(struct mo_text *text, const void *value);
  int (*check)(const char *name, const void *value, struct mo_message *message);
};

struct mo_field {
  const char *name;
  enum mo_field_type type;
  unsigned flags; /* from enum mo_field_flag */
  size_t offset;
  double min, max;               /* of counts, numbers, and characters of a text */
  uint32_t n, side;              /* of several numbers; side: of a row of a table, or 0 */
  const char *const *words;      /* of a word; NULL after the last */
  const struct mo_fields *group; /* of a group, inline or not; of a field with its own type: its
                                    members */
  const struct mo_field_own *own;
  unsigned since;   /* the first version of the packed form that has the row; 0: every version */
  const char *unit; /* "m", "s"; "": none */
  const char *help; /* one line without a period */
};

/* Words that JSON may contain instead of an object. set: sets every row to the values of
 * words[i]. */
struct mo_fields_words {
  const char *const *words; /* NULL after the last */
  void (*set)(void *settings, int i);
};

struct mo_fields {
  const struct mo_field *rows;
  size_t n;
  const struct mo_fields_words *words; /* nullable */
};
/* The initializer for an array of rows. */
#define MO_FIELDS(rows)                                                                            \
  {                                                                                                \
    rows, sizeof(rows) / sizeof((rows)[0]), NULL                                                   \
  }

/* Reads the value of member `key` into `settings`. Returns false if no row has this name. An
 * invalid value adds a fault and leaves the setting unchanged; in an array, only the invalid
 * numbers stay unchanged. */
bool mo_fields_read_member(struct mo_json *json, struct mo_json_slice key,
                           const struct mo_fields *fields, void *settings);
/* Reads one object, or a word of the table. An unknown member adds a fault that lists the rows. */
void mo_fields_read(struct mo_json *json, const struct mo_fields *fields, void *settings);
/* Adds a fault at the current member and skips its value. The fault lists the allowed members:
 * `known`, then the rows' names. known, fields: nullable. */
void mo_fields_unknown(struct mo_json *json, const char *known, const struct mo_fields *fields);

/* Parses a complete text from mo_fields_write_object. Missing members stay unchanged.
 * MO_ERR_FORMAT, with the first fault in `message`. */
int mo_fields_parse(const char *text, size_t size, const struct mo_fields *fields, void *settings,
                    struct mo_message *message);

/* Writes all rows as "name":value, with commas between them. */
void mo_fields_write(struct mo_text *text, const struct mo_fields *fields, const void *settings);
/* Writes all rows as an object, with braces. */
void mo_fields_write_object(struct mo_text *text, const struct mo_fields *fields,
                            const void *settings);

/* Calls `differs` for each row that differs between two structs, with its JSON pointer below
 * `above` and both values as JSON (NULL: out of memory). */
void mo_fields_compare(const struct mo_fields *fields, const char *above, const void *first,
                       const void *second,
                       void (*differs)(void *context, const char *pointer, const char *first,
                                       const char *second),
                       void *context);

/* Checks all settings against their bounds. MO_ERR_INVALID (not finite, not one of the words) or
 * MO_ERR_RANGE for the first invalid one; `message` states its name, value and bounds. above: the
 * struct's name in messages, as in "schedule.peak …"; "": none. */
int mo_fields_check(const struct mo_fields *fields, const char *above, const void *settings,
                    struct mo_message *message);

/* ---- the packed form ----
 *
 * For tables of numbers, seeds, counts, words, flags and groups of these. Values of eight bytes
 * (numbers, seeds) come first, then values of four (counts, words), then values of one (flags),
 * each in the order of the rows, without gaps, in the byte order of memory. It is never larger than
 * the struct.
 *
 * A row that is added later has the next version in `since`. If the added rows of a struct have
 * their defaults, it is packed in the older version, so that its bytes and their hashes do not
 * change. For this reason, the default of an added row must never change. */
size_t mo_fields_packed_bytes(const struct mo_fields *fields, unsigned version);
void mo_fields_pack(const struct mo_fields *fields, unsigned version, const void *settings,
                    uint8_t *bytes);
/* Leaves rows that are newer than `version` unchanged. Returns false if a word or flag has an
 * invalid value. */
bool mo_fields_unpack(const struct mo_fields *fields, unsigned version, const uint8_t *bytes,
                      void *settings);
/* Returns the first version, at least 1, that includes all rows whose values differ from their
 * defaults. */
unsigned mo_fields_version(const struct mo_fields *fields, const void *settings,
                           const void *defaults);
/* Replaces each −0 with 0, so that equal structs have equal packed forms. */
void mo_fields_clear_minus(const struct mo_fields *fields, void *settings);
bool mo_fields_equal(const struct mo_fields *fields, const void *first, const void *second);

#endif
