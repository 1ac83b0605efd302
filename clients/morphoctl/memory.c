/* memory.c: memory, without which this program ends: it has nothing to lose. */
#include <stdlib.h>

#include "ctl.h"

void *need(void *memory)
{
  if (memory == NULL)
    exit(complain(STATUS_ERROR, "out of memory"));
  return memory;
}

char *format_text(const char *format, ...)
{
  char *text = NULL;
  va_list arguments;
  va_start(arguments, format);
  const int n = vasprintf(&text, format, arguments);
  va_end(arguments);
  return need(n < 0 ? NULL : text);
}

void close_text(FILE *file)
{
  need(fclose(file) == 0 ? file : NULL);
}
