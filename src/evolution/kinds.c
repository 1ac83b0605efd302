/* kinds.c: see kinds.h. */
#include "evolution/kinds.h"

#include <stdio.h>
#include <string.h>

static unsigned kind_of(const struct mo_kinds *kinds, const void *value)
{
  int kind;
  memcpy(&kind, (const char *)value + kinds->fields.rows[0].offset, sizeof(kind));
  return (unsigned)kind;
}

static bool has_row(const struct mo_kinds *kinds, unsigned kind, size_t row)
{
  const struct mo_kind_rows *own = &kinds->own[kind];
  return row == 0 || (row >= own->from && row < own->from + own->n);
}

static bool read_object(struct mo_json *json, const struct mo_kinds *kinds, void *value)
{
  const struct mo_field *rows = kinds->fields.rows;
  bool given[MO_KIND_ROWS_MAX] = {false};
  const unsigned depth = json->depth, before = json->faults->n;
  struct mo_json_slice key;
  char list[MO_WORDS_BYTES], below[32];
  mo_json_object(json);
  while (mo_json_member(json, &key)) {
    for (size_t i = 0; i < kinds->fields.n; i++)
      given[i] |= mo_json_is(key, rows[i].name);
    if (!mo_fields_read_member(json, key, &kinds->fields, value))
      mo_fields_unknown(json, NULL, &kinds->fields);
  }
  if (json->stop)
    return false;
  if (!given[0])
    mo_json_fault_at(json, depth, "", "kind is missing: %s", mo_words_list(kinds->words, list));
  if (!given[0] || json->faults->n > before)
    return false;
  const unsigned kind = kind_of(kinds, value);
  for (size_t i = 1; i < kinds->fields.n; i++)
    if (given[i] && !has_row(kinds, kind, i)) {
      snprintf(below, sizeof(below), "/%s", rows[i].name);
      mo_json_fault_at(json, depth, below, "%s %s has no %s", kinds->noun, kinds->words[kind],
                       rows[i].name);
    }
  return json->faults->n == before;
}

bool mo_kinds_read(struct mo_json *json, const struct mo_kinds *kinds, void *value)
{
  const enum mo_json_kind next = mo_json_peek(json);
  const unsigned depth = json->depth;
  struct mo_json_slice word;
  char list[MO_WORDS_BYTES];
  if (next == MO_JSON_OBJECT)
    return read_object(json, kinds, value);
  if (next == MO_JSON_STRING && mo_json_string(json, &word))
    for (int i = 0; kinds->words[i] != NULL; i++)
      if (mo_json_is(word, kinds->words[i])) {
        memcpy((char *)value + kinds->fields.rows[0].offset, &i, sizeof(i));
        return true;
      }
  if (next == MO_JSON_NONE)
    return false;
  mo_json_fault_at(json, depth, "", "must be %s, or an object with kind and its settings",
                   mo_words_list(kinds->words, list));
  if (next != MO_JSON_STRING)
    mo_json_skip(json);
  return false;
}

void mo_kinds_write(struct mo_text *text, const struct mo_kinds *kinds, const void *value)
{
  struct mo_field rows[MO_KIND_ROWS_MAX];
  size_t n = 0;
  for (size_t i = 0; i < kinds->fields.n; i++)
    if (has_row(kinds, kind_of(kinds, value), i))
      rows[n++] = kinds->fields.rows[i];
  const struct mo_fields own = {rows, n};
  mo_fields_write_object(text, &own, value);
}
