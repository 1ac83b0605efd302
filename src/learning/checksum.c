/* checksum.c: CRC-64 with the polynomial of ECMA-182, reflected, as in the XZ format; eight bytes
 * at a time. */
#include "learning/internal.h"

#include <string.h>

#define POLYNOMIAL UINT64_C(0xC96C5795D7870F42)
#define SLICES     8

uint64_t mo_checksum(const uint8_t *bytes, size_t n)
{
  uint64_t table[SLICES][256]; /* table[k][b]: byte b, then k zero bytes */
  for (uint32_t b = 0; b < 256; b++) {
    uint64_t crc = b;
    for (int bit = 0; bit < 8; bit++)
      crc = crc >> 1 ^ (crc & 1 ? POLYNOMIAL : 0);
    table[0][b] = crc;
  }
  for (int k = 1; k < SLICES; k++)
    for (uint32_t b = 0; b < 256; b++)
      table[k][b] = table[k - 1][b] >> 8 ^ table[0][table[k - 1][b] & 255];
  uint64_t crc = ~UINT64_C(0);
  for (; n >= SLICES; n -= SLICES, bytes += SLICES) {
    uint64_t word;
    memcpy(&word, bytes, sizeof(word));
    crc ^= word;
    uint64_t next = 0;
    for (int k = 0; k < SLICES; k++)
      next ^= table[SLICES - 1 - k][crc >> 8 * k & 255];
    crc = next;
  }
  for (; n > 0; n--, bytes++)
    crc = crc >> 8 ^ table[0][(crc ^ *bytes) & 255];
  return ~crc;
}
