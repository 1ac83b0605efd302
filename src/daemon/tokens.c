/* tokens.c: see tokens.h. */
#include "tokens.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/words.h"
#include "daemon/memory.h"
#include "http/guard.h"

#define TOKEN_FILE_MAX 65536
#define WORDS_MAX      4 /* one more than a line may contain */

void tokens_free(struct tokens *tokens)
{
  if (tokens->text != NULL)
    explicit_bzero(tokens->text, TOKEN_FILE_MAX);
  free(tokens->text);
  *tokens = (struct tokens){0};
}

/* Splits a line into at most WORDS_MAX words, up to one that begins with #. */
static size_t split(char *line, char *words[WORDS_MAX])
{
  size_t n = 0;
  char *word;
  while (n < WORDS_MAX && (word = strsep(&line, " \t\r")) != NULL && *word != '#')
    if (*word != '\0')
      words[n++] = word;
  return n;
}

/* Reads the words of a line, and checks them by the rules of the HTTP room. */
static int read_line(char *const *words, size_t n, struct mo_token *token,
                     struct mo_message *message)
{
  int right = MO_RIGHT_ADMIN;
  if (n != 1 && n != 3)
    return mo_fail(message, MO_ERR_INVALID, "%s words; write NAME RIGHT TOKEN, or only a token",
                   n == 2 ? "two" : "more than three");
  if (n == 3 && (right = mo_word_index(mo_right_words, words[1])) < 0)
    return mo_fail(message, MO_ERR_INVALID,
                   "the second word must be a right: read, submit, admin or worker");
  *token = (struct mo_token){n == 3 ? words[0] : "admin", (enum mo_right)right, words[n - 1]};
  return mo_token_check(token, message);
}

static int compare_rights(const void *one, const void *other)
{
  return (int)((const struct mo_token *)one)->right - (int)((const struct mo_token *)other)->right;
}

/* Compares a token with the tokens of the lines before it. */
static int compare(const struct tokens *tokens, const struct mo_token *token,
                   struct mo_message *message)
{
  for (const struct mo_token *other = tokens->items; other < tokens->items + tokens->n; other++) {
    if (strcmp(other->text, token->text) == 0)
      return mo_fail(message, MO_ERR_INVALID,
                     "duplicate token of \"%s\"; give each line its own token", other->name);
    if (strcmp(other->name, token->name) == 0 && other->right != token->right)
      return mo_fail(message, MO_ERR_INVALID,
                     "\"%s\" already has the right %s; a name can have only one right", token->name,
                     mo_right_words[other->right]);
  }
  return MO_OK;
}

static int read_lines(char *text, const char *path, struct tokens *tokens,
                      struct mo_message *message)
{
  char *line;
  for (size_t number = 1; (line = strsep(&text, "\n")) != NULL; number++) {
    char *words[WORDS_MAX];
    struct mo_token token = {"", MO_RIGHT_READ, ""};
    struct mo_message why = {{0}};
    const size_t n = split(line, words);
    if (n == 0)
      continue;
    if (tokens->n == MO_TOKENS_MAX)
      return mo_fail(message, MO_ERR_LIMIT,
                     "token_file: %s, line %zu: more than %d tokens; remove unused ones", path,
                     number, MO_TOKENS_MAX);
    int error = read_line(words, n, &token, &why);
    if (error == MO_OK)
      error = compare(tokens, &token, &why);
    if (error != MO_OK)
      return mo_fail(message, error, "token_file: %s, line %zu: %s", path, number, why.text);
    tokens->items[tokens->n++] = token;
  }
  qsort(tokens->items, tokens->n, sizeof(tokens->items[0]), compare_rights);
  while (tokens->n_workers < tokens->n && tokens->items[tokens->n_workers].right == MO_RIGHT_WORKER)
    tokens->n_workers++;
  return tokens->n > 0
             ? MO_OK
             : mo_fail(message, MO_ERR_INVALID,
                       "token_file: %s has no tokens; add a line: NAME RIGHT TOKEN", path);
}

int tokens_read(const char *path, struct tokens *tokens, struct mo_message *message)
{
  *tokens = (struct tokens){0};
  if (path == NULL)
    return MO_OK;
  FILE *file = fopen(path, "re");
  if (file == NULL)
    return mo_fail(message, MO_ERR_IO, "token_file: %s: %s", path, strerror(errno));
  tokens->text = enough(calloc(1, TOKEN_FILE_MAX + 1));
  const size_t n = fread(tokens->text, 1, TOKEN_FILE_MAX + 1, file);
  fclose(file);
  int error;
  if (n > TOKEN_FILE_MAX)
    error = mo_fail(message, MO_ERR_LIMIT, "token_file: %s is larger than %d bytes", path,
                    TOKEN_FILE_MAX);
  else
    error = read_lines(tokens->text, path, tokens, message);
  if (error != MO_OK)
    tokens_free(tokens);
  return error;
}
