/* dump.c: writes JSON as text. Numbers get the fewest digits that read back, as in the server's
 * replies: 0.9 stays 0.9, not the 0.90000000000000002 of 17 digits. Characters that a terminal
 * would obey or not show are escaped. */
#include <stdlib.h>
#include <string.h>

#include "base/text.h"
#include "commands.h"

/* Writes the number at `text`; returns its length. */
static size_t put_number(struct mo_text *made, const char *text)
{
  const size_t n = strspn(text, "+-.0123456789eE");
  if (strcspn(text, ".eE") >= n)
    mo_text_bytes(made, text, n);
  else
    mo_text_json_number(made, strtod(text, NULL));
  return n;
}

/* Writes the next character of a string; returns its bytes. */
static size_t put_character(struct mo_text *made, const char *text)
{
  size_t n;
  const unsigned long c = character_at(text, &n);
  if (*text == '\\')
    mo_text_bytes(made, text, n = 2);
  else if (!is_control(c) && !is_format_control(c))
    mo_text_bytes(made, text, n);
  else if (c > 0xFFFF)
    mo_text_format(made, "\\u%04lx\\u%04lx", 0xD800 + ((c - 0x10000) >> 10), 0xDC00 + (c & 0x3FF));
  else
    mo_text_format(made, "\\u%04lx", c);
  return n;
}

char *dump_json(const json_t *json, size_t flags)
{
  char *text = json_dumps(json, flags | JSON_REAL_PRECISION(17));
  struct mo_text made = {.failed = text == NULL};
  bool quoted = false;
  for (const char *at = text; !made.failed && *at != 0;) {
    if (quoted && *at != '"') {
      at += put_character(&made, at);
    } else if (!quoted && (*at == '-' || (*at >= '0' && *at <= '9'))) {
      at += put_number(&made, at);
    } else {
      quoted ^= *at == '"';
      mo_text_bytes(&made, at++, 1);
    }
  }
  free(text);
  return need(made.failed ? NULL : made.data);
}

void put_json(const json_t *json, size_t flags)
{
  char *text = dump_json(json, flags);
  puts(text);
  free(text);
}
