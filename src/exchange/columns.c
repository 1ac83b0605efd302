/* columns.c: see columns.h. */
#include "exchange/columns.h"

#include <inttypes.h>
#include <string.h>

static void write_value(struct mo_text *text, const struct mo_column *column, const void *row)
{
  const void *value = (const char *)row + column->offset;
  switch (column->type) {
  case MO_COLUMN_COUNT: mo_text_format(text, "%" PRIu32, *(const uint32_t *)value); break;
  case MO_COLUMN_LONG: mo_text_format(text, "%" PRIu64, *(const uint64_t *)value); break;
  case MO_COLUMN_NUMBER: mo_text_json_number(text, *(const double *)value); break;
  case MO_COLUMN_FLAG: mo_text_add(text, *(const bool *)value ? "true" : "false"); break;
  case MO_COLUMN_WORD: mo_text_format(text, "\"%s\"", column->words[*(const bool *)value]); break;
  case MO_COLUMN_TIME: break; /* not written */
  }
}

/* Returns the length of the common prefix of two paths, up to and including its last dot. */
static size_t shared_part(const char *one, const char *other)
{
  size_t shared = 0;
  for (size_t i = 0; one[i] != '\0' && one[i] == other[i]; i++)
    if (one[i] == '.')
      shared = i + 1;
  return shared;
}

static void close_objects(struct mo_text *text, const char *path)
{
  for (; *path != '\0'; path++)
    if (*path == '.')
      mo_text_add(text, "}");
}

void mo_columns_members(struct mo_text *text, const struct mo_columns *columns, const void *row)
{
  const char *open = "";
  for (size_t i = 0; i < columns->n; i++) {
    const char *path = columns->items[i].path;
    size_t shared = shared_part(open, path);
    close_objects(text, open + shared);
    path += shared;
    for (size_t n; path[n = strcspn(path, ".")] == '.'; path += n + 1) {
      mo_text_next(text);
      mo_text_format(text, "\"%.*s\":{", (int)n, path);
    }
    mo_text_name(text, path);
    write_value(text, &columns->items[i], row);
    open = columns->items[i].path;
  }
  close_objects(text, open);
}

void mo_columns_json(struct mo_text *text, const struct mo_columns *columns, const void *row)
{
  if (row == NULL) {
    mo_text_add(text, "null");
    return;
  }
  mo_text_object(text);
  mo_columns_members(text, columns, row);
  mo_text_add(text, "}");
}
