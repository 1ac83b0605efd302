/* fields.c: see fields.h. */
#include "base/fields.h"

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

static const void *at_const(const void *settings, const struct mo_field *field)
{
  return (const char *)settings + field->offset;
}

/* Finds a row by its name. *offset: the offset of the row's struct within the struct of
 * `fields`. */
static const struct mo_field *find(const struct mo_fields *fields, const char *name, size_t size,
                                   size_t *offset)
{
  for (size_t i = 0; i < fields->n; i++) {
    const struct mo_field *field = &fields->rows[i];
    if (field->type == MO_FIELD_INLINE) {
      size_t below = *offset + field->offset;
      const struct mo_field *found = find(field->group, name, size, &below);
      if (found != NULL) {
        *offset = below;
        return found;
      }
    } else if (strlen(field->name) == size && memcmp(field->name, name, size) == 0) {
      return field;
    }
  }
  return NULL;
}

/* ---- bounds ---- */

static bool is_within(const struct mo_field *field, double value)
{
  if (!(value >= field->min && value <= field->max))
    return false;
  return !((field->flags & MO_FIELD_ABOVE_MIN) && value == field->min) &&
         !((field->flags & MO_FIELD_BELOW_MAX) && value == field->max);
}

#define BOUNDS_BYTES 128
#define PATH_BYTES   64

/* Formats a number for a message; counts are written without an exponent. */
static const char *number_of(const struct mo_field *field, double value, char text[MO_NUMBER_BYTES])
{
  if (field->type != MO_FIELD_COUNT)
    return mo_number_text(value, text);
  snprintf(text, MO_NUMBER_BYTES, "%.0f", value);
  return text;
}

/* Writes the bounds in words: "must be above 0 and at most 1". */
static const char *bounds_of(const struct mo_field *field, char text[BOUNDS_BYTES])
{
  char min[MO_NUMBER_BYTES], max[MO_NUMBER_BYTES];
  snprintf(text, BOUNDS_BYTES, "must be %s %s and %s %s%s",
           field->flags & MO_FIELD_ABOVE_MIN ? "above" : "at least",
           number_of(field, field->min, min),
           field->flags & MO_FIELD_BELOW_MAX ? "below" : "at most",
           number_of(field, field->max, max), field->flags & MO_FIELD_NULL ? ", or null" : "");
  return text;
}

/* ---- reading ---- */

static void read_count(struct mo_json *json, const struct mo_field *field, void *value)
{
  int64_t number;
  const int64_t max = field->type == MO_FIELD_SEED ? MO_SEED_MAX : (int64_t)field->max;
  if (!mo_json_integer(json, (int64_t)field->min, max, &number))
    return;
  if (field->type == MO_FIELD_SEED)
    *(uint64_t *)value = (uint64_t)number;
  else
    *(uint32_t *)value = (uint32_t)number;
}

static void read_number(struct mo_json *json, const struct mo_field *field, void *value)
{
  double number;
  char bounds[BOUNDS_BYTES];
  if (!mo_json_number(json, &number))
    return;
  if (is_within(field, number))
    *(double *)value = number;
  else
    mo_json_fault(json, "%s, got %s", bounds_of(field, bounds), MO_NUMBER(number));
}

static void read_word(struct mo_json *json, const struct mo_field *field, void *value)
{
  struct mo_json_slice word;
  const unsigned depth = json->depth;
  if (!mo_json_string(json, &word))
    return;
  for (int i = 0; field->words[i] != NULL; i++)
    if (mo_json_is(word, field->words[i])) {
      *(int *)value = i;
      return;
    }
  char list[MO_WORDS_BYTES];
  mo_json_fault_at(json, depth, "", "must be %s, got \"%.*s\"", mo_words_list(field->words, list),
                   word.size > 64 ? 64 : (int)word.size, word.bytes);
}

static void read_text(struct mo_json *json, const struct mo_field *field, char *value)
{
  const bool is_ascii = (field->flags & MO_FIELD_UTF8) == 0;
  const unsigned depth = json->depth;
  struct mo_json_slice text;
  if (!mo_json_string(json, &text))
    return;
  const double n = (double)mo_utf8_length(text.bytes, text.size);
  bool is_good = n >= field->min && n <= field->max;
  for (size_t i = 0; i < text.size && is_ascii; i++)
    is_good = is_good && text.bytes[i] >= ' ' && text.bytes[i] <= '~';
  if (is_good) {
    memcpy(value, text.bytes, text.size);
    value[text.size] = '\0';
  } else {
    mo_json_fault_at(json, depth, "", "must have %.0f to %.0f %scharacters", field->min, field->max,
                     is_ascii ? "printable ASCII " : "");
  }
}

static void read_array(struct mo_json *json, const struct mo_field *field, uint32_t n,
                       double *numbers)
{
  const unsigned depth = json->depth;
  uint32_t given = 0;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); given++)
    if (given < n)
      mo_json_bounded(json, field->min, field->max, &numbers[given]);
    else
      mo_json_skip(json);
  if (!json->stop && given != n)
    mo_json_fault_at(json, depth, "", "must be an array of %u numbers, got %u", n, given);
}

/* Returns whether the next array begins with an array. */
static bool is_nested(const struct mo_json *json)
{
  struct mo_faults faults = {0}; /* discarded: reading the value reports them */
  struct mo_json ahead = *json;
  ahead.faults = &faults;
  return mo_json_peek(&ahead) == MO_JSON_ARRAY && mo_json_array(&ahead) && mo_json_item(&ahead) &&
         mo_json_peek(&ahead) == MO_JSON_ARRAY;
}

static void read_numbers(struct mo_json *json, const struct mo_field *field, double *numbers)
{
  const unsigned depth = json->depth;
  uint32_t n = 0;
  if (field->side == 0 || !is_nested(json)) {
    read_array(json, field, field->n, numbers);
    return;
  }
  const uint32_t rows = field->n / field->side;
  mo_json_array(json);
  for (; mo_json_item(json); n++)
    if (n < rows)
      read_array(json, field, field->side, numbers + (size_t)field->side * n);
    else
      mo_json_skip(json);
  if (!json->stop && n != rows)
    mo_json_fault_at(json, depth, "", "must have %u rows, got %u", rows, n);
}

static bool read_null(struct mo_json *json, const struct mo_field *field, void *value)
{
  if (!(field->flags & MO_FIELD_NULL) || field->type == MO_FIELD_WORD ||
      mo_json_peek(json) != MO_JSON_NULL)
    return false;
  memset(value, 0,
         field->type == MO_FIELD_TEXT || field->type == MO_FIELD_GROUP ? 1
         : field->type == MO_FIELD_COUNT                               ? sizeof(uint32_t)
                                                                       : sizeof(double));
  mo_json_skip(json);
  return true;
}

static void read_value(struct mo_json *json, const struct mo_field *field, void *value)
{
  if (read_null(json, field, value))
    return;
  switch (field->type) {
  case MO_FIELD_COUNT:
  case MO_FIELD_SEED: read_count(json, field, value); break;
  case MO_FIELD_NUMBER: read_number(json, field, value); break;
  case MO_FIELD_FLAG: mo_json_bool(json, value); break;
  case MO_FIELD_WORD: read_word(json, field, value); break;
  case MO_FIELD_NUMBERS: read_numbers(json, field, value); break;
  case MO_FIELD_TEXT: read_text(json, field, value); break;
  case MO_FIELD_GROUP:
    if (field->flags & MO_FIELD_NULL)
      *(bool *)value = true;
    mo_fields_read(json, field->group, value);
    break;
  case MO_FIELD_OWN: field->own->read(json, value); break;
  case MO_FIELD_INLINE: break; /* it has no value of its own */
  }
}

bool mo_fields_read_member(struct mo_json *json, struct mo_json_slice key,
                           const struct mo_fields *fields, void *settings)
{
  size_t offset = 0;
  const struct mo_field *field = find(fields, key.bytes, key.size, &offset);
  if (field == NULL)
    return false;
  read_value(json, field, (char *)settings + offset + field->offset);
  return true;
}

static void add_names(struct mo_text *text, const struct mo_fields *fields)
{
  for (size_t i = 0; i < fields->n; i++)
    if (fields->rows[i].type == MO_FIELD_INLINE)
      add_names(text, fields->rows[i].group);
    else
      mo_text_format(text, "%s%s", text->size > 0 ? ", " : "", fields->rows[i].name);
}

void mo_fields_unknown(struct mo_json *json, const char *known, const struct mo_fields *fields)
{
  struct mo_text text = {0};
  if (known != NULL)
    mo_text_add(&text, known);
  if (fields != NULL)
    add_names(&text, fields);
  mo_json_fault(json, "unknown field; the fields are %s",
                text.failed || text.size == 0 ? "others" : text.data);
  mo_text_free(&text);
  mo_json_skip(json);
}

static void read_word_of_table(struct mo_json *json, const struct mo_fields_words *words,
                               void *settings)
{
  struct mo_json_slice given;
  char list[MO_WORDS_BYTES];
  const unsigned depth = json->depth;
  if (!mo_json_string(json, &given))
    return;
  for (int i = 0; words->words[i] != NULL; i++)
    if (mo_json_is(given, words->words[i])) {
      words->set(settings, i);
      return;
    }
  mo_json_fault_at(json, depth, "", "must be an object or %s, got \"%.*s\"",
                   mo_words_list(words->words, list), given.size > 64 ? 64 : (int)given.size,
                   given.bytes);
}

void mo_fields_read(struct mo_json *json, const struct mo_fields *fields, void *settings)
{
  struct mo_json_slice key;
  if (fields->words != NULL && mo_json_peek(json) == MO_JSON_STRING) {
    read_word_of_table(json, fields->words, settings);
    return;
  }
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key))
    if (!mo_fields_read_member(json, key, fields, settings))
      mo_fields_unknown(json, NULL, fields);
}

int mo_fields_parse(const char *text, size_t size, const struct mo_fields *fields, void *settings,
                    struct mo_message *message)
{
  struct mo_faults faults = {0};
  struct mo_json json;
  mo_json_start(&json, text, size, &faults);
  mo_fields_read(&json, fields, settings);
  if (mo_json_finish(&json) && faults.n == 0)
    return MO_OK;
  return mo_fail(message, MO_ERR_FORMAT, "%s: %s", faults.items[0].where, faults.items[0].detail);
}

/* ---- writing ---- */

static uint64_t count_at(const struct mo_field *field, const void *value)
{
  return field->type == MO_FIELD_SEED ? *(const uint64_t *)value : *(const uint32_t *)value;
}

/* Returns whether null stands for the value. */
static bool is_null(const struct mo_field *field, const void *value)
{
  if (!(field->flags & MO_FIELD_NULL))
    return false;
  switch (field->type) {
  case MO_FIELD_COUNT:
  case MO_FIELD_SEED: return count_at(field, value) == 0;
  case MO_FIELD_NUMBER: return *(const double *)value == 0;
  case MO_FIELD_WORD: return *(const int *)value < 0;
  case MO_FIELD_TEXT: return *(const char *)value == '\0';
  case MO_FIELD_GROUP: return !*(const bool *)value;
  default: return false;
  }
}

static void write_numbers(struct mo_text *text, const struct mo_field *field, const double *numbers)
{
  mo_text_add(text, "[");
  for (uint32_t i = 0; i < field->n; i++) {
    mo_text_next(text);
    mo_text_json_number(text, numbers[i]);
  }
  mo_text_add(text, "]");
}

static void write_value(struct mo_text *text, const struct mo_field *field, const void *value)
{
  if (is_null(field, value)) {
    mo_text_add(text, "null");
    return;
  }
  switch (field->type) {
  case MO_FIELD_COUNT:
  case MO_FIELD_SEED: mo_text_format(text, "%" PRIu64, count_at(field, value)); break;
  case MO_FIELD_NUMBER:
    mo_text_add(text,
                isfinite(*(const double *)value) ? MO_NUMBER(*(const double *)value) : "null");
    break;
  case MO_FIELD_FLAG: mo_text_add(text, *(const bool *)value ? "true" : "false"); break;
  case MO_FIELD_WORD:
    mo_text_format(text, "\"%s\"", mo_word(field->words, *(const unsigned *)value));
    break;
  case MO_FIELD_NUMBERS: write_numbers(text, field, value); break;
  case MO_FIELD_TEXT: mo_text_json_string(text, value, strlen(value)); break;
  case MO_FIELD_GROUP: mo_fields_write_object(text, field->group, value); break;
  case MO_FIELD_OWN: field->own->write(text, value); break;
  case MO_FIELD_INLINE: mo_fields_write(text, field->group, value); break;
  }
}

void mo_fields_write(struct mo_text *text, const struct mo_fields *fields, const void *settings)
{
  for (size_t i = 0; i < fields->n; i++) {
    const struct mo_field *field = &fields->rows[i];
    if (field->type != MO_FIELD_INLINE)
      mo_text_name(text, field->name);
    write_value(text, field, at_const(settings, field));
  }
}

void mo_fields_write_object(struct mo_text *text, const struct mo_fields *fields,
                            const void *settings)
{
  mo_text_add(text, "{");
  mo_fields_write(text, fields, settings);
  mo_text_add(text, "}");
}

/* ---- comparing ---- */

void mo_fields_compare(const struct mo_fields *fields, const char *above, const void *first,
                       const void *second,
                       void (*differs)(void *context, const char *pointer, const char *first,
                                       const char *second),
                       void *context)
{
  for (size_t i = 0; i < fields->n; i++) {
    const struct mo_field *field = &fields->rows[i];
    const void *a = at_const(first, field), *b = at_const(second, field);
    char pointer[2 * PATH_BYTES];
    struct mo_text values[2] = {{0}, {0}};
    const bool is_inline = field->type == MO_FIELD_INLINE;
    snprintf(pointer, sizeof(pointer), "%s%s%s", above, is_inline ? "" : "/",
             is_inline ? "" : field->name);
    if (is_inline || (field->type == MO_FIELD_GROUP && !is_null(field, a) && !is_null(field, b))) {
      mo_fields_compare(field->group, pointer, a, b, differs, context);
      continue;
    }
    write_value(&values[0], field, a);
    write_value(&values[1], field, b);
    if (values[0].failed || values[1].failed)
      differs(context, pointer, NULL, NULL);
    else if (strcmp(values[0].data, values[1].data) != 0)
      differs(context, pointer, values[0].data, values[1].data);
    mo_text_free(&values[0]);
    mo_text_free(&values[1]);
  }
}

/* ---- checking ---- */

static int check_number(const struct mo_field *field, const char *path, double value,
                        struct mo_message *message)
{
  char bounds[BOUNDS_BYTES], number[MO_NUMBER_BYTES];
  if ((field->flags & MO_FIELD_NULL) && value == 0)
    return MO_OK;
  if (!isfinite(value))
    return mo_fail(message, MO_ERR_INVALID, "%s %s, got a number that is not finite", path,
                   bounds_of(field, bounds));
  if (!is_within(field, value))
    return mo_fail(message, MO_ERR_RANGE, "%s %s, got %s", path, bounds_of(field, bounds),
                   number_of(field, value, number));
  return MO_OK;
}

static int check_numbers(const struct mo_field *field, const char *path, const double *numbers,
                         struct mo_message *message)
{
  int error = MO_OK;
  for (uint32_t i = 0; i < field->n && error == MO_OK; i++) {
    char place[2 * PATH_BYTES];
    snprintf(place, sizeof(place), "%s[%u]", path, i);
    error = check_number(field, place, numbers[i], message);
  }
  return error;
}

static int check_word(const struct mo_field *field, const char *path, int value,
                      struct mo_message *message)
{
  char list[MO_WORDS_BYTES];
  if (value >= 0 && (size_t)value < mo_words_count(field->words))
    return MO_OK;
  return mo_fail(message, MO_ERR_INVALID, "%s must be %s, got number %d", path,
                 mo_words_list(field->words, list), value);
}

int mo_fields_check(const struct mo_fields *fields, const char *above, const void *settings,
                    struct mo_message *message)
{
  int error = MO_OK;
  for (size_t i = 0; i < fields->n && error == MO_OK; i++) {
    const struct mo_field *field = &fields->rows[i];
    const void *value = at_const(settings, field);
    char path[PATH_BYTES];
    snprintf(path, sizeof(path), "%s%s%s", above,
             above[0] != '\0' && field->name != NULL ? "." : "",
             field->name != NULL ? field->name : "");
    switch (field->type) {
    case MO_FIELD_COUNT:
      error = check_number(field, path, (double)count_at(field, value), message);
      break;
    case MO_FIELD_NUMBER: error = check_number(field, path, *(const double *)value, message); break;
    case MO_FIELD_NUMBERS: error = check_numbers(field, path, value, message); break;
    case MO_FIELD_WORD: error = check_word(field, path, *(const int *)value, message); break;
    case MO_FIELD_INLINE:
    case MO_FIELD_GROUP: error = mo_fields_check(field->group, path, value, message); break;
    case MO_FIELD_OWN:
      if (field->own->check != NULL)
        error = field->own->check(path, value, message);
      break;
    case MO_FIELD_TEXT:
    case MO_FIELD_SEED: /* only requests are bounded; the library accepts any seed */
    case MO_FIELD_FLAG: break;
    }
  }
  return error;
}
