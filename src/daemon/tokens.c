/* tokens.c: see tokens.h. */
#include "tokens.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "http/guard.h"

#define TOKEN_FILE_MAX 65536

void tokens_free(struct tokens *tokens)
{
  if (tokens->text != NULL)
    explicit_bzero(tokens->text, TOKEN_FILE_MAX);
  free(tokens->text);
  free(tokens->items);
  *tokens = (struct tokens){0};
}

/* Checks the tokens by the rules of the HTTP room. */
static int check(const struct tokens *tokens, const char *path, struct mo_message *message)
{
  struct mo_tokens taken;
  struct mo_message why = {{0}};
  if (mo_tokens_init(&taken) != MO_OK)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  int status = mo_tokens_set(&taken, tokens->items, tokens->n, &why);
  mo_tokens_free(&taken);
  return status == MO_OK ? MO_OK : mo_fail(message, status, "token_file: %s: %s", path, why.text);
}

int tokens_read(const char *path, struct tokens *tokens, struct mo_message *message)
{
  *tokens = (struct tokens){0};
  if (path == NULL)
    return MO_OK;
  FILE *file = fopen(path, "re");
  if (file == NULL)
    return mo_fail(message, MO_ERR_IO, "token_file: %s: %s", path, strerror(errno));
  tokens->text = calloc(1, TOKEN_FILE_MAX + 1);
  size_t n = tokens->text != NULL ? fread(tokens->text, 1, TOKEN_FILE_MAX + 1, file) : 0;
  fclose(file);
  tokens->items = calloc(TOKEN_FILE_MAX / 2, sizeof(*tokens->items));
  if (tokens->text == NULL || tokens->items == NULL) {
    tokens_free(tokens);
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  }
  if (n > TOKEN_FILE_MAX) {
    tokens_free(tokens);
    return mo_fail(message, MO_ERR_LIMIT, "token_file: %s is larger than %d bytes", path,
                   TOKEN_FILE_MAX);
  }
  char *rest = tokens->text, *line;
  while ((line = strsep(&rest, "\n")) != NULL) {
    line += strspn(line, " \t");
    line[strcspn(line, " \t\r")] = 0;
    if (*line != 0 && *line != '#')
      tokens->items[tokens->n++] = line;
  }
  if (tokens->n == 0) {
    tokens_free(tokens);
    return mo_fail(message, MO_ERR_INVALID, "token_file: %s holds no token", path);
  }
  int status = check(tokens, path, message);
  if (status != MO_OK)
    tokens_free(tokens);
  return status;
}
