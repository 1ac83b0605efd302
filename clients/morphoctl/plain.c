/* plain.c: text from elsewhere on a terminal. Labels, names and messages come from other people
 * through the server, or from files: an escape sequence in one must not move the cursor, change the
 * title or hide what stands there. */
#include <stdlib.h>

#include "ctl.h"

void make_plain(char *text)
{
  char *out = text;
  for (const unsigned char *c = (const unsigned char *)text; *c != 0; c++) {
    if (*c == 0xC2 && c[1] >= 0x80 &&
        c[1] < 0xA0) { /* U+0080 to U+009F: some terminals obey them */
      *out++ = '?';
      c++;
    } else {
      *out++ = *c < 0x20 || *c == 0x7F ? '?' : (char)*c;
    }
  }
  *out = 0;
}

void print_plain_list(FILE *file, const char *format, va_list arguments)
{
  char *text = NULL;
  if (vasprintf(&text, format, arguments) < 0)
    return;
  make_plain(text);
  fputs(text, file);
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
