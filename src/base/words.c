/* words.c: see words.h. */
#include "base/words.h"

#include <stdint.h>
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

const char *mo_words_join(const char *const *words, const char *quote, char text[MO_WORDS_BYTES])
{
  size_t size = 0;
  text[0] = '\0';
  for (size_t i = 0; words[i] != NULL && size < MO_WORDS_BYTES; i++) {
    const char *before = i == 0 ? "" : words[i + 1] == NULL ? " or " : ", ";
    const int n =
        snprintf(text + size, MO_WORDS_BYTES - size, "%s%s%s%s", before, quote, words[i], quote);
    size += n > 0 ? (size_t)n : 0;
  }
  return text;
}

/* Returns how many characters must be inserted, removed or replaced to turn `a` into `b`. */
static size_t distance(const char *a, const char *b)
{
  size_t row[64];
  size_t m = strlen(b);
  if (m >= sizeof(row) / sizeof(row[0]))
    return SIZE_MAX;
  for (size_t j = 0; j <= m; j++)
    row[j] = j;
  for (size_t i = 1; a[i - 1] != 0; i++) {
    size_t diagonal = row[0];
    row[0] = i;
    for (size_t j = 1; j <= m; j++) {
      size_t best = diagonal + (a[i - 1] != b[j - 1]);
      if (row[j] + 1 < best)
        best = row[j] + 1;
      if (row[j - 1] + 1 < best)
        best = row[j - 1] + 1;
      diagonal = row[j];
      row[j] = best;
    }
  }
  return row[m];
}

int mo_word_nearest(const char *name, const char *const *first, size_t n, size_t stride)
{
  size_t least = strlen(name) / 3 + 2;
  int nearest = MO_ERR_NOT_FOUND;
  for (size_t i = 0; i < n; i++) {
    const size_t d = distance(name, *(const char *const *)((const char *)first + i * stride));
    if (d < least) {
      least = d;
      nearest = (int)i;
    }
  }
  return nearest;
}

void mo_words_wrap(FILE *file, int indent, const char *text)
{
  int column = 0;
  for (const char *c = text; *c != 0;) {
    int length = (int)strcspn(c, " \n");
    if (column == 0) {
      fprintf(file, "%*s", indent, "");
      column = indent;
    } else if (column + 1 + length > 78) {
      fprintf(file, "\n%*s", indent, "");
      column = indent;
    } else if (column > indent) {
      fputc(' ', file);
      column++;
    }
    fprintf(file, "%.*s", length, c);
    column += length;
    c += length;
    if (*c == '\n') {
      fputc('\n', file);
      column = 0;
      c++;
    } else {
      c += strspn(c, " ");
    }
  }
  fputc('\n', file);
}
