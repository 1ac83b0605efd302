/* gather.c: columns that are gathered row by row, and sent as arrays behind a JSON header. See
 * tables.h. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/scene.h"
#include "api/tables.h"
#include "http/reply.h"

static size_t width_of(const char *type)
{
  return strcmp(type, "uint8") == 0 ? 1 : strcmp(type, "uint32") == 0 ? 4 : 8;
}

struct mo_gathered *mo_gather_column(struct mo_gather *gather, const char *path, size_t size,
                                     const char *type)
{
  struct mo_gathered *column = &gather->columns[gather->n++];
  *column = (struct mo_gathered){.type = type};
  for (size_t i = 0; i < size && i < sizeof(column->name) - 1; i++)
    column->name[i] = (char)(path[i] == '.' ? '_' : path[i]);
  return column;
}

void mo_gather_number(struct mo_gathered *column, double value)
{
  const uint64_t count = (uint64_t)(value >= 0 ? value : 0); /* its first bytes are the number */
  const bool is_whole = column->type[0] == 'u';
  mo_text_bytes(&column->values, is_whole ? (const void *)&count : (const void *)&value,
                width_of(column->type));
}

void mo_gather_json(struct mo_gathered *column, const char *json, size_t size)
{
  mo_text_add(&column->values, column->values.size > 0 ? "," : "");
  mo_text_bytes(&column->values, json, size);
}

void mo_gather_columns(struct mo_gather *gather, const struct mo_columns *columns)
{
  static const char *const types[] = {[MO_COLUMN_COUNT] = "uint32",
                                      [MO_COLUMN_LONG] = "uint64",
                                      [MO_COLUMN_NUMBER] = "float64",
                                      [MO_COLUMN_FLAG] = "uint8",
                                      [MO_COLUMN_WORD] = NULL};
  for (size_t i = 0; i < columns->n; i++)
    mo_gather_column(gather, columns->items[i].path, strlen(columns->items[i].path),
                     types[columns->items[i].type]);
}

void mo_gather_row(struct mo_gather *gather, unsigned first, const struct mo_columns *columns,
                   const void *row)
{
  for (size_t i = 0; i < columns->n; i++) {
    struct mo_gathered *column = &gather->columns[first + i];
    const void *value = (const char *)row + columns->items[i].offset;
    const char *word;
    switch (columns->items[i].type) {
    case MO_COLUMN_COUNT: mo_gather_number(column, *(const uint32_t *)value); break;
    case MO_COLUMN_LONG: mo_gather_number(column, (double)*(const uint64_t *)value); break;
    case MO_COLUMN_NUMBER: {
      const double number = *(const double *)value;
      mo_gather_number(column, isfinite(number) ? number : (double)NAN);
      break;
    }
    case MO_COLUMN_FLAG: mo_gather_number(column, *(const bool *)value); break;
    case MO_COLUMN_WORD:
      word = columns->items[i].words[*(const bool *)value];
      mo_text_add(&column->values, column->values.size > 0 ? "," : "");
      mo_text_json_string(&column->values, word, strlen(word));
      break;
    case MO_COLUMN_TIME: break;
    }
  }
}

int mo_gather_check(const struct mo_gather *gather)
{
  size_t bytes = 0;
  for (unsigned i = 0; i < gather->n; i++) {
    bytes += gather->columns[i].values.size;
    if (gather->columns[i].values.failed)
      return MO_ERR_NO_MEMORY;
  }
  return bytes > MO_GATHER_BYTES ? MO_ERR_LIMIT : MO_OK;
}

static char *join(struct mo_gather *gather, size_t *size)
{
  struct mo_text header = {0}, arrays = {0};
  mo_text_object(&header);
  mo_text_member_count(&header, "rows", gather->n_rows);
  mo_text_open(&header, "columns", "{");
  for (unsigned i = 0; i < gather->n; i++) {
    struct mo_gathered *column = &gather->columns[i];
    if (column->type != NULL) {
      mo_scene_write_array(&header, &arrays,
                           &(struct mo_scene_array){column->name,
                                                    column->type,
                                                    column->values.data,
                                                    width_of(column->type),
                                                    {gather->n_rows},
                                                    1});
    } else {
      mo_text_name(&header, column->name);
      mo_text_add(&header, "[");
      mo_text_bytes(&header, column->values.data, column->values.size);
      mo_text_add(&header, "]");
    }
    mo_text_free(&column->values);
  }
  mo_text_add(&header, "}}");
  return mo_scene_join(&header, &arrays, size);
}

void mo_gather_reply(struct mo_request *request, int error, struct mo_gather *gather)
{
  size_t size = 0;
  char *joined = error == MO_OK ? join(gather, &size) : NULL;
  for (unsigned i = 0; i < gather->n; i++)
    mo_text_free(&gather->columns[i].values);
  if (error == MO_ERR_LIMIT) {
    mo_reply_bad_parameter(request, "format", MO_GATHER_WORDS);
  } else if (joined == NULL) {
    mo_reply_error(request, error != MO_OK ? error : MO_ERR_NO_MEMORY, "reply");
  } else {
    mo_reply_bytes(request, 200, MO_SCENE_TYPE, joined, size);
    request->reply.packs = true;
    mo_reply_etag_of_body(request);
  }
}
