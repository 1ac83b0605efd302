/* png.c: see png.h. */
#include "png.h"

#include "../morphoctl/ctl.h"

#include <stdlib.h>
#include <string.h>

#include <zlib.h>

static void put_u32(unsigned char *at, uint32_t value)
{
  for (int i = 0; i < 4; i++)
    at[i] = (unsigned char)(value >> (24 - 8 * i));
}

/* Appends a chunk: its length, its name, `n` bytes and their checksum. */
static size_t put_chunk(unsigned char *at, const char *name, const unsigned char *bytes, size_t n)
{
  put_u32(at, (uint32_t)n);
  memcpy(at + 4, name, 4);
  if (n > 0)
    memmove(at + 8, bytes, n);
  put_u32(at + 8 + n, (uint32_t)crc32(crc32(0, at + 4, 4), at + 8, (uInt)n));
  return n + 12;
}

/* Subtracts from each byte the one above it: smooth pictures then compress well. */
static unsigned char *filter(const uint8_t *rgb, uint32_t width, uint32_t height)
{
  const size_t row = (size_t)width * 3;
  unsigned char *lines = need(malloc((row + 1) * height));
  for (uint32_t y = 0; y < height; y++) {
    unsigned char *line = lines + (row + 1) * y;
    line[0] = 2; /* the filter "up" */
    for (size_t i = 0; i < row; i++)
      line[1 + i] = (unsigned char)(rgb[row * y + i] - (y > 0 ? rgb[row * (y - 1) + i] : 0));
  }
  return lines;
}

unsigned char *png_encode(const uint8_t *rgb, uint32_t width, uint32_t height, size_t *size)
{
  static const unsigned char signature[8] = {0x89, 'P', 'N', 'G', '\r', '\n', 0x1A, '\n'};
  const uLong raw = ((uLong)width * 3 + 1) * height;
  uLongf packed = compressBound(raw);
  unsigned char *lines = filter(rgb, width, height);
  unsigned char *pixels = need(malloc(packed));
  unsigned char *file = need(malloc(packed + 80));
  unsigned char header[13] = {[8] = 8, [9] = 2}; /* 8 bits a color, RGB */
  size_t n = sizeof(signature);
  put_u32(header, width);
  put_u32(header + 4, height);
  need(compress2(pixels, &packed, lines, raw, 6) == Z_OK ? pixels : NULL);
  memcpy(file, signature, n);
  n += put_chunk(file + n, "IHDR", header, sizeof(header));
  n += put_chunk(file + n, "IDAT", pixels, packed);
  n += put_chunk(file + n, "IEND", NULL, 0);
  free(lines);
  free(pixels);
  *size = n;
  return file;
}
