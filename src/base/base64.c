/* base64.c: see base64.h. */
#include "base/base64.h"

#include <string.h>

static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

static int value_of(char c)
{
  const char *digit = c != '\0' ? strchr(digits, c) : NULL;
  return digit != NULL ? (int)(digit - digits) : -1;
}

void mo_base64_encode(const void *bytes, size_t n, char text[])
{
  const uint8_t *from = bytes;
  for (size_t i = 0; i < n; i += 3) {
    const size_t left = n - i;
    const uint32_t bits = (uint32_t)from[i] << 16 | (left > 1 ? (uint32_t)from[i + 1] << 8 : 0) |
                          (left > 2 ? from[i + 2] : 0);
    for (size_t k = 0; k < 4; k++)
      *text++ = k <= left ? digits[bits >> (18 - 6 * k) & 63] : '=';
  }
  *text = '\0';
}

bool mo_base64_decode(const char *text, size_t size, uint8_t *bytes, size_t *n)
{
  *n = 0;
  if (size % 4 != 0)
    return false;
  const size_t padding = size == 0 ? 0 : text[size - 1] != '=' ? 0 : text[size - 2] != '=' ? 1 : 2;
  for (size_t i = 0; i < size; i += 4) {
    const size_t given = i + 4 < size ? 4 : 4 - padding;
    uint32_t bits = 0;
    for (size_t k = 0; k < 4; k++) {
      const int value = k < given ? value_of(text[i + k]) : 0;
      if (value < 0)
        return false;
      bits = bits << 6 | (uint32_t)value;
    }
    for (size_t k = 0; k + 1 < given; k++)
      bytes[(*n)++] = (uint8_t)(bits >> (16 - 8 * k));
    if (given < 4 && (bits & (given == 3 ? 0xff : 0xffff)) != 0)
      return false;
  }
  return true;
}
