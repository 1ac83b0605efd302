/* utf8.c: see utf8.h. */
#include "base/utf8.h"

#include <string.h>

unsigned mo_utf8_sequence(const unsigned char *words, size_t n)
{
  unsigned char first = words[0];
  if (first < 0x80)
    return 1;
  unsigned length = first >= 0xC2 && first <= 0xDF   ? 2
                    : first >= 0xE0 && first <= 0xEF ? 3
                    : first >= 0xF0 && first <= 0xF4 ? 4
                                                     : 0;
  if (length == 0 || n < length)
    return 0;
  unsigned char second_min = first == 0xE0   ? 0xA0
                             : first == 0xF0 ? 0x90
                                             : 0x80; /* no overlong forms */
  unsigned char second_max = first == 0xED   ? 0x9F
                             : first == 0xF4 ? 0x8F
                                             : 0xBF; /* no surrogates, none past U+10FFFF */
  if (words[1] < second_min || words[1] > second_max)
    return 0;
  for (unsigned i = 2; i < length; i++)
    if ((words[i] & 0xC0) != 0x80)
      return 0;
  return length;
}

size_t mo_utf8_length(const char *text, size_t n)
{
  size_t characters = 0;
  for (size_t i = 0; i < n; i++)
    characters += ((unsigned char)text[i] & 0xC0) != 0x80;
  return characters;
}

bool mo_utf8_is_valid(const char *text)
{
  for (size_t n = strlen(text), length; n > 0; text += length, n -= length)
    if ((length = mo_utf8_sequence((const unsigned char *)text, n)) == 0)
      return false;
  return true;
}
