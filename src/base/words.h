/* words.h: closed lists of words, such as the names of an enumeration. A list is an array that ends
 * with NULL. */
#ifndef MORPHO_BASE_WORDS_H
#define MORPHO_BASE_WORDS_H

#include <stddef.h>

#define MO_WORDS_BYTES 256

size_t mo_words_count(const char *const *words);
/* Returns word i, "unknown" beyond the last. */
const char *mo_word(const char *const *words, unsigned i);
/* Returns the index of a word, or MO_ERR_NOT_FOUND. */
int mo_word_index(const char *const *words, const char *name);
/* Sets an enumeration, whose names the words are, by name. MO_ERR_NOT_FOUND: it is unchanged. */
int mo_word_find(const char *const *words, const char *name, void *value);
/* Lists all words as in a sentence, with quotes: "red", "green" or "blue". Returns text. */
const char *mo_words_list(const char *const *words, char text[MO_WORDS_BYTES]);

#endif
