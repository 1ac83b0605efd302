/* faults.c: see faults.h. */
#include "base/faults.h"

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "base/text.h"

/* Removes an incomplete UTF-8 sequence from the end of a truncated text. */
static void trim_utf8(char *text)
{
  size_t n = strlen(text), at = 0;
  while (at < n) {
    unsigned length = mo_utf8_sequence((const unsigned char *)text + at, n - at);
    if (length == 0 && n - at < 4)
      break;
    at += length == 0 ? 1 : length;
  }
  text[at] = '\0';
}

void mo_faults_add(struct mo_faults *faults, enum mo_fault_place place, const char *where,
                   const char *format, ...)
{
  if (mo_faults_full(faults) || (faults->first_only && faults->n > 0))
    return;
  struct mo_fault *fault = &faults->items[faults->n++];
  fault->place = place;
  snprintf(fault->where, sizeof(fault->where), "%s", where);
  trim_utf8(fault->where);
  va_list arguments;
  va_start(arguments, format);
  vsnprintf(fault->detail, sizeof(fault->detail), format, arguments);
  va_end(arguments);
  trim_utf8(fault->detail);
}
