/* main.c: morphoctl, the command line of morphod. It reaches the server only over HTTP. */
#include <errno.h>
#include <fcntl.h>
#include <langinfo.h>
#include <locale.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"

#define TOKEN_LINE 1024

/* Reads the token in a line: either the line is just the token, which is that of "admin", or the
 * token is the third word. wanted: the name to look for; NULL: the first, which must be the only
 * one. */
static void take_line(struct ctl *ctl, const char *path, char *line, const char *wanted,
                      char first[TOKEN_LINE])
{
  char *rest = NULL, *words[3] = {strtok_r(line, " \t\r\n", &rest)};
  if (words[0] == NULL || words[0][0] == '#')
    return;
  for (int i = 1; i < 3 && words[i - 1] != NULL; i++)
    words[i] = strtok_r(NULL, " \t\r\n", &rest);
  const bool named = words[1] != NULL && words[1][0] != '#';
  const char *name = named ? words[0] : "admin", *token = named ? words[2] : words[0];
  if (token == NULL || token[0] == '#')
    fail(STATUS_USAGE, "%s: a line must be NAME RIGHT TOKEN or only a token", path);
  if (wanted != NULL ? strcmp(name, wanted) != 0 : first[0] != 0 && strcmp(name, first) == 0)
    return;
  if (wanted == NULL && first[0] != 0)
    fail(STATUS_USAGE, "%s has tokens for \"%s\" and \"%s\": choose one with --token-name", path,
         first, name);
  snprintf(first, TOKEN_LINE, "%s", name);
  if (ctl->token == NULL)
    ctl->token = keep(strdup(token));
}

static void read_token(struct ctl *ctl)
{
  const char *path = option_text(ctl, "token-file", NULL), *variable = getenv("MORPHOD_TOKEN");
  const char *wanted = option_text(ctl, "token-name", NULL);
  char line[TOKEN_LINE], first[TOKEN_LINE] = "";
  if (path == NULL) {
    if (wanted != NULL)
      fail(STATUS_USAGE, "--token-name needs --token-file");
    if (variable != NULL && *variable != 0)
      ctl->token = variable;
  } else {
    FILE *file = fopen(path, "re");
    if (file == NULL)
      fail(STATUS_USAGE, "%s: %s", path, strerror(errno));
    while (fgets(line, sizeof(line), file) != NULL)
      take_line(ctl, path, line, wanted, first);
    fclose(file);
    if (ctl->token == NULL && wanted != NULL)
      fail(STATUS_USAGE, "%s has no token for \"%s\"", path, wanted);
    if (ctl->token == NULL)
      fail(STATUS_USAGE, "%s contains no token", path);
  }
  for (const unsigned char *c = (const unsigned char *)ctl->token; c != NULL && *c != 0; c++)
    if (*c <= ' ' || *c >= 0x7f)
      fail(STATUS_USAGE, "the token contains a character that is not printable ASCII");
}

static void read_surroundings(struct ctl *ctl)
{
  const char *server = getenv("MORPHOD_SERVER"), *no_color = getenv("NO_COLOR"),
             *terminal = getenv("TERM");
  ctl->server =
      option_text(ctl, "server", server != NULL && *server != 0 ? server : "http://127.0.0.1:8765");
  ctl->json = option_is_set(ctl, "json");
  ctl->quiet = option_is_set(ctl, "quiet");
  bool dumb = terminal == NULL || strcmp(terminal, "dumb") == 0;
  ctl->terminal = isatty(STDOUT_FILENO) && !dumb;
  ctl->color = ctl->terminal && (no_color == NULL || *no_color == 0);
  ctl->progress = isatty(STDERR_FILENO) && !dumb;
  ctl->utf8 = strcmp(nl_langinfo(CODESET), "UTF-8") == 0;
  ctl->retry_s = (double)option_number(ctl, "retry", 0, 86400, -1);
  read_token(ctl);
}

/* Opens standard descriptors that the caller closed, so that a socket cannot get one of their
 * numbers. They are opened for reading, so that writing fails. */
static void fill_standard_descriptors(void)
{
  for (int fd = 0; fd <= STDERR_FILENO; fd++)
    if (fcntl(fd, F_GETFD) == -1)
      (void)open("/dev/null", O_RDONLY | O_CLOEXEC); /* takes the lowest number, fd */
}

int main(int argc, char **argv)
{
  struct ctl ctl = {.commands = commands, .n_commands = n_commands};
  fill_standard_descriptors();
  setlocale(LC_CTYPE, "");
  options_parse(&ctl, argc, (const char *const *)argv);
  read_surroundings(&ctl);
  transport_open(&ctl);
  ctl.command->run(&ctl);
  leave(STATUS_OK);
}
