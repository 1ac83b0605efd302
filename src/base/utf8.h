/* utf8.h: checks UTF-8: no overlong forms, no surrogates, nothing past U+10FFFF. */
#ifndef MORPHO_BASE_UTF8_H
#define MORPHO_BASE_UTF8_H

#include <stdbool.h>
#include <stddef.h>

/* Returns the length of the UTF-8 sequence at `words` (n ≥ 1 bytes long), 0 if it is invalid. */
unsigned mo_utf8_sequence(const unsigned char *words, size_t n);
/* Says whether the whole text is UTF-8. */
bool mo_utf8_is_valid(const char *text);
/* Returns the number of characters in n bytes of UTF-8. */
size_t mo_utf8_length(const char *text, size_t n);

#endif
