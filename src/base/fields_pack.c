/* fields_pack.c: the packed form of a struct that a table of fields describes, and comparing two
 * structs by their table; see fields.h. */
#include "base/fields.h"

#include <string.h>

_Static_assert(sizeof(uint64_t) == sizeof(double) && sizeof(enum mo_field_type) == sizeof(uint32_t),
               "values have the width that width_of returns");

/* Returns the bytes of a packed value, or of each of several values. Returns 0 if the row has
 * members, or no packed form. */
static size_t width_of(const struct mo_field *row)
{
  switch (row->type) {
  case MO_FIELD_NUMBER:
  case MO_FIELD_NUMBERS:
  case MO_FIELD_SEED: return sizeof(double);
  case MO_FIELD_COUNT:
  case MO_FIELD_WORD: return sizeof(uint32_t);
  case MO_FIELD_FLAG: return sizeof(bool);
  default: return 0;
  }
}

static size_t bytes_of(const struct mo_field *row)
{
  return width_of(row) * (row->type == MO_FIELD_NUMBERS ? row->n : 1);
}

static const size_t widths[] = {sizeof(double), sizeof(uint32_t), sizeof(bool)}; /* in this order */
enum { WIDTHS = sizeof(widths) / sizeof(widths[0]) };

size_t mo_fields_packed_bytes(const struct mo_fields *fields, unsigned version)
{
  size_t size = 0;
  for (const struct mo_field *row = fields->rows; row < fields->rows + fields->n; row++)
    if (row->since <= version)
      size += row->group != NULL ? mo_fields_packed_bytes(row->group, version) : bytes_of(row);
  return size;
}

/* ---- packing ---- */

/* Packs the values of one width. Returns the end of what it wrote. */
static uint8_t *pack_width(const struct mo_fields *fields, unsigned version, size_t width,
                           const char *settings, uint8_t *to)
{
  for (const struct mo_field *row = fields->rows; row < fields->rows + fields->n; row++) {
    if (row->since > version)
      continue;
    if (row->group != NULL) {
      to = pack_width(row->group, version, width, settings + row->offset, to);
    } else if (width_of(row) == width) {
      memcpy(to, settings + row->offset, bytes_of(row));
      to += bytes_of(row);
    }
  }
  return to;
}

void mo_fields_pack(const struct mo_fields *fields, unsigned version, const void *settings,
                    uint8_t *bytes)
{
  for (int i = 0; i < WIDTHS; i++)
    bytes = pack_width(fields, version, widths[i], settings, bytes);
}

/* Returns whether the bytes are a value of the row's type. */
static bool is_value(const struct mo_field *row, const uint8_t *bytes)
{
  uint32_t word;
  if (row->type == MO_FIELD_FLAG)
    return *bytes <= 1;
  if (row->type != MO_FIELD_WORD)
    return true;
  memcpy(&word, bytes, sizeof(word));
  return word < mo_words_count(row->words);
}

/* Unpacks the values of one width. Returns the end of what it read, or NULL after an invalid
 * value. */
static const uint8_t *unpack_width(const struct mo_fields *fields, unsigned version, size_t width,
                                   const uint8_t *from, char *settings)
{
  for (const struct mo_field *row = fields->rows; row < fields->rows + fields->n && from != NULL;
       row++) {
    if (row->since > version)
      continue;
    if (row->group != NULL) {
      from = unpack_width(row->group, version, width, from, settings + row->offset);
    } else if (width_of(row) == width) {
      if (!is_value(row, from))
        return NULL;
      memcpy(settings + row->offset, from, bytes_of(row));
      from += bytes_of(row);
    }
  }
  return from;
}

bool mo_fields_unpack(const struct mo_fields *fields, unsigned version, const uint8_t *bytes,
                      void *settings)
{
  for (int i = 0; i < WIDTHS && bytes != NULL; i++)
    bytes = unpack_width(fields, version, widths[i], bytes, settings);
  return bytes != NULL;
}

void mo_fields_clear_minus(const struct mo_fields *fields, void *settings)
{
  for (const struct mo_field *row = fields->rows; row < fields->rows + fields->n; row++) {
    void *value = (char *)settings + row->offset;
    const uint32_t n = row->type == MO_FIELD_NUMBER    ? 1
                       : row->type == MO_FIELD_NUMBERS ? row->n
                                                       : 0;
    if (row->group != NULL)
      mo_fields_clear_minus(row->group, value);
    for (uint32_t i = 0; i < n; i++)
      ((double *)value)[i] += 0.0; /* −0 + 0 is 0 */
  }
}

/* ---- comparing ---- */

static bool are_equal(const double *a, const double *b, uint32_t n)
{
  for (uint32_t i = 0; i < n; i++)
    if (a[i] != b[i])
      return false;
  return true;
}

static bool is_equal(const struct mo_field *row, const void *first, const void *second)
{
  const void *a = (const char *)first + row->offset, *b = (const char *)second + row->offset;
  switch (row->type) {
  case MO_FIELD_NUMBER: return *(const double *)a == *(const double *)b;
  case MO_FIELD_NUMBERS: return are_equal(a, b, row->n);
  case MO_FIELD_SEED: return *(const uint64_t *)a == *(const uint64_t *)b;
  case MO_FIELD_COUNT:
  case MO_FIELD_WORD: return *(const uint32_t *)a == *(const uint32_t *)b;
  case MO_FIELD_FLAG: return *(const bool *)a == *(const bool *)b;
  default: return row->group == NULL || mo_fields_equal(row->group, a, b);
  }
}

bool mo_fields_equal(const struct mo_fields *fields, const void *first, const void *second)
{
  for (size_t i = 0; i < fields->n; i++)
    if (!is_equal(&fields->rows[i], first, second))
      return false;
  return true;
}

unsigned mo_fields_version(const struct mo_fields *fields, const void *settings,
                           const void *defaults)
{
  unsigned version = 1;
  for (const struct mo_field *row = fields->rows; row < fields->rows + fields->n; row++) {
    unsigned needed = row->since;
    if ((row->group == NULL && needed <= version) || is_equal(row, settings, defaults))
      continue;
    if (row->group != NULL) {
      const unsigned within = mo_fields_version(row->group, (const char *)settings + row->offset,
                                                (const char *)defaults + row->offset);
      needed = within > needed ? within : needed;
    }
    version = needed > version ? needed : version;
  }
  return version;
}
