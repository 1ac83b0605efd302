/* base64.h: bytes as text (RFC 4648, with padding). */
#ifndef MORPHO_BASE_BASE64_H
#define MORPHO_BASE_BASE64_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define MO_BASE64_BYTES(n) (((n) + 2) / 3 * 4 + 1) /* size of the text, with its NUL */
void mo_base64_encode(const void *bytes, size_t n, char text[]);
/* Decodes `size` characters; bytes: space for size / 4 · 3. *n: bytes written. Returns false if the
 * text is not Base64, contains blanks, lacks padding, or has non-zero bits after the last byte. */
bool mo_base64_decode(const char *text, size_t size, uint8_t *bytes, size_t *n);

#endif
