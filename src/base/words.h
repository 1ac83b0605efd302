/* words.h: closed lists of words, such as the names of an enumeration, and text for people. A list
 * is an array that ends with NULL. */
#ifndef MORPHO_BASE_WORDS_H
#define MORPHO_BASE_WORDS_H

#include <stddef.h>
#include <stdio.h>

#define MO_WORDS_BYTES 1024

size_t mo_words_count(const char *const *words);
/* Returns word i, or "unknown" beyond the last. */
const char *mo_word(const char *const *words, unsigned i);
/* Returns the index of a word, or MO_ERR_NOT_FOUND. */
int mo_word_index(const char *const *words, const char *name);
/* Lists all words as in a sentence, each enclosed in `quote`: red, green or blue. Returns text. */
const char *mo_words_join(const char *const *words, const char *quote, char text[MO_WORDS_BYTES]);
#define mo_words_list(words, text) mo_words_join(words, "\"", text)

/* Returns the index of the word most similar to a mistyped one, or MO_ERR_NOT_FOUND if none is
 * similar. first: the first of n pointers to words, each `stride` bytes after the previous one. */
int mo_word_nearest(const char *name, const char *const *first, size_t n, size_t stride);
/* Writes help text in lines of at most 78 columns, each after `indent` spaces. */
void mo_words_wrap(FILE *file, int indent, const char *text);

#endif
