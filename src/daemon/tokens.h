/* tokens.h: the file of bearer tokens. */
#ifndef MORPHOD_TOKENS_H
#define MORPHOD_TOKENS_H

#include "http/http.h"

struct tokens {
  char *text;                           /* the contents of the file, split in place */
  struct mo_token items[MO_TOKENS_MAX]; /* worker tokens first */
  size_t n, n_workers;
};

/* Reads lines of name, right and token. A line with only a token gets the name "admin" and the
 * right admin. Skips blank lines and comments, which begin with a # at the start of a word. A name
 * may have several lines with the same right, so that a token can be replaced. path NULL: no
 * tokens. MO_ERR_INVALID: the message states the line number, but never quotes a token;
 * MO_ERR_LIMIT, MO_ERR_IO, MO_ERR_NO_MEMORY. On failure there is nothing to free. */
int tokens_read(const char *path, struct tokens *tokens, struct mo_message *message);
/* Wipes and frees the tokens. */
void tokens_free(struct tokens *tokens);

#endif
