/* tokens.h: the file of bearer tokens. */
#ifndef MORPHOD_TOKENS_H
#define MORPHOD_TOKENS_H

#include <stddef.h>

#include <morpho/error.h>

struct tokens {
  char *text; /* the file, cut into pieces */
  const char **items;
  size_t n;
};

/* One token per line; blank lines and lines that start with # are left out. path NULL: none. A file
 * without a token, or with one that the HTTP room would not take, is MO_ERR_INVALID. On failure
 * there is nothing to free. */
int tokens_read(const char *path, struct tokens *tokens, struct mo_message *message);
/* Wipes and frees. */
void tokens_free(struct tokens *tokens);

#endif
