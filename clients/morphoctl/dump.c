/* dump.c: writes JSON as text. Numbers get the fewest digits that read back, as in the server's
 * replies: 0.9 stays 0.9, not the 0.90000000000000002 of 17 digits. Characters that a terminal
 * would obey or not show are escaped. */
#include <stdlib.h>
#include <string.h>

#include "commands.h"

/* Writes the number at `text`; returns its length. */
static size_t put_number(FILE *file, const char *text)
{
  const size_t n = strspn(text, "+-.0123456789eE");
  const double value = strtod(text, NULL);
  char digits[32];
  if (strcspn(text, ".eE") >= n) {
    fprintf(file, "%.*s", (int)n, text);
    return n;
  }
  for (int precision = 15; precision <= 17; precision++) {
    snprintf(digits, sizeof(digits), "%.*g", precision, value);
    if (strtod(digits, NULL) == value)
      break;
  }
  fputs(digits, file);
  return n;
}

/* Writes the next character of a string; returns its bytes. */
static size_t put_character(FILE *file, const char *text)
{
  size_t n;
  const unsigned long c = character_at(text, &n);
  if (*text == '\\')
    fwrite(text, 1, n = 2, file);
  else if (!is_control(c) && !is_format_control(c))
    fwrite(text, 1, n, file);
  else if (c > 0xFFFF)
    fprintf(file, "\\u%04lx\\u%04lx", 0xD800 + ((c - 0x10000) >> 10), 0xDC00 + (c & 0x3FF));
  else
    fprintf(file, "\\u%04lx", c);
  return n;
}

char *dump_json(const json_t *json, size_t flags)
{
  char *text = json_dumps(json, flags | JSON_REAL_PRECISION(17)), *made = NULL;
  size_t size = 0;
  bool quoted = false;
  FILE *file = text != NULL ? open_memstream(&made, &size) : NULL;
  for (const char *at = text; file != NULL && *at != 0;) {
    if (quoted && *at != '"') {
      at += put_character(file, at);
    } else if (!quoted && (*at == '-' || (*at >= '0' && *at <= '9'))) {
      at += put_number(file, at);
    } else {
      quoted ^= *at == '"';
      fputc(*at++, file);
    }
  }
  free(text);
  if (file == NULL || fclose(file) == 0)
    return made;
  free(made);
  return NULL;
}

void put_json(const json_t *json, size_t flags)
{
  char *text = dump_json(json, flags);
  if (text != NULL)
    puts(text);
  free(text);
}
