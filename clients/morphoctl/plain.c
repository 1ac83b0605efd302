/* plain.c: shows text from elsewhere on a terminal. Labels, names and messages come from other
 * users through the server, or from files. An escape sequence in them must not move the cursor,
 * change the title or hide other text. */
#include <stdlib.h>
#include <string.h>

#include "base/text.h"
#include "commands.h"

static bool is_control(unsigned long c) /* some terminals also interpret U+0080 to U+009F */
{
  return c < 0x20 || (c >= 0x7F && c < 0xA0);
}

/* Returns true for characters that show nothing themselves and change how their neighbors are
 * shown: order of letters, joins, hidden tags. */
static bool is_format_control(unsigned long c)
{
  return c == 0xAD || c == 0x61C || c == 0x180E || (c >= 0x200B && c <= 0x200F) ||
         (c >= 0x2028 && c <= 0x202E) || (c >= 0x2060 && c <= 0x206F) || c == 0xFEFF ||
         (c >= 0xFFF9 && c <= 0xFFFB) || (c >= 0xE0000 && c <= 0xE007F);
}

/* Returns the next character and its length in bytes. An invalid byte counts as a character. */
static unsigned long character_at(const char *begin, size_t *bytes)
{
  const unsigned char *text = (const unsigned char *)begin;
  const unsigned n = mo_utf8_sequence(text, strnlen(begin, 4));
  unsigned long c = n < 2 ? *text : *text & (0xFFu >> (n + 1));
  for (unsigned i = 1; i < n; i++)
    c = c << 6 | (text[i] & 0x3F);
  *bytes = n > 0 ? n : 1;
  return c;
}

char *plain_text(const char *text)
{
  char *plain = malloc(3 * strlen(text) + 1), *out = plain; /* 2 bytes become at most 6 */
  size_t bytes;
  if (plain == NULL)
    return NULL;
  for (const char *at = text; *at != 0; at += bytes) {
    const unsigned long c = character_at(at, &bytes);
    if (is_control(c)) {
      *out++ = '?';
    } else if (is_format_control(c) && bytes > 1) {
      out += sprintf(out, c > 0xFFFF ? "\\U%08lx" : "\\u%04lx", c);
    } else {
      memcpy(out, at, bytes);
      out += bytes;
    }
  }
  *out = 0;
  return plain;
}

void print_plain_list(FILE *file, const char *format, va_list arguments)
{
  char *text = NULL;
  if (vasprintf(&text, format, arguments) < 0)
    return;
  char *plain = plain_text(text);
  if (plain != NULL)
    fputs(plain, file);
  free(plain);
  free(text);
}

void print_plain(FILE *file, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  print_plain_list(file, format, arguments);
  va_end(arguments);
}

void print_plain_line(FILE *file, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  print_plain_list(file, format, arguments);
  va_end(arguments);
  fputc('\n', file);
}

/* ---- JSON as text. Numbers get the fewest digits that read back, as in the server's replies: 0.9
 * stays 0.9, not the 0.90000000000000002 of 17 digits. Characters that a terminal would interpret
 * or not show are escaped ---- */

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
  if (!made.failed)
    return made.data;
  mo_text_free(&made);
  return NULL;
}
