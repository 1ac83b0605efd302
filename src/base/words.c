/* words.c: see words.h. */
#include "base/words.h"

#include <stdio.h>
#include <string.h>

#include <morpho/error.h>

size_t mo_words_count(const char *const *words)
{
  size_t n = 0;
  while (words[n] != NULL)
    n++;
  return n;
}

const char *mo_word(const char *const *words, unsigned i)
{
  return i < mo_words_count(words) ? words[i] : "unknown";
}

int mo_word_index(const char *const *words, const char *name)
{
  for (int i = 0; words[i] != NULL; i++)
    if (strcmp(words[i], name) == 0)
      return i;
  return MO_ERR_NOT_FOUND;
}

int mo_word_find(const char *const *words, const char *name, void *value)
{
  const int i = mo_word_index(words, name);
  if (i < 0)
    return i;
  memcpy(value, &i, sizeof(i));
  return MO_OK;
}

const char *mo_words_list(const char *const *words, char text[MO_WORDS_BYTES])
{
  size_t size = 0;
  text[0] = '\0';
  for (size_t i = 0; words[i] != NULL && size < MO_WORDS_BYTES; i++) {
    const char *before = i == 0 ? "" : words[i + 1] == NULL ? " or " : ", ";
    const int n = snprintf(text + size, MO_WORDS_BYTES - size, "%s\"%s\"", before, words[i]);
    size += n > 0 ? (size_t)n : 0;
  }
  return text;
}
