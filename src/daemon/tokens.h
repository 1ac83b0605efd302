/* tokens.h: the file of bearer tokens. */
#ifndef MORPHOD_TOKENS_H
#define MORPHOD_TOKENS_H

#include <stddef.h>

#include <morpho/error.h>

struct tokens {
  char *text; /* the contents of the file, split in place */
  const char **items;
  size_t n;
};

/* Reads one token per line; skips blank lines and lines that start with #. path NULL: no tokens. A
 * file without a token, or with a token that the HTTP room rejects, is MO_ERR_INVALID. On failure
 * there is nothing to free. */
int tokens_read(const char *path, struct tokens *tokens, struct mo_message *message);
/* Wipes and frees the tokens. */
void tokens_free(struct tokens *tokens);

#endif
