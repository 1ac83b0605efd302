/* png.h: writes pictures as PNG. */
#ifndef MORPHOCTL_FILM_PNG_H
#define MORPHOCTL_FILM_PNG_H

#include <stddef.h>
#include <stdint.h>

/* Encodes (height, width, 3) bytes; *size bytes, malloc. */
unsigned char *png_encode(const uint8_t *rgb, uint32_t width, uint32_t height, size_t *size);

#endif
