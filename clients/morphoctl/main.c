/* main.c: morphoctl, the command line of morphod. It reaches the server only over HTTP. */
#include <errno.h>
#include <langinfo.h>
#include <locale.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "transport.h"

/* Reads the token: the first line that is not blank. */
static int read_token(struct ctl *ctl)
{
  const char *path = option_text(ctl, "token-file", NULL), *variable = getenv("MORPHOD_TOKEN");
  char line[1024];
  if (path == NULL) {
    if (variable != NULL && *variable != 0 && (ctl->token = strdup(variable)) == NULL)
      return complain(STATUS_ERROR, "out of memory");
  } else {
    FILE *file = fopen(path, "re");
    if (file == NULL)
      return complain(STATUS_USAGE, "%s: %s", path, strerror(errno));
    while (ctl->token == NULL && fgets(line, sizeof(line), file) != NULL) {
      char *text = line + strspn(line, " \t");
      text[strcspn(text, " \t\r\n")] = 0;
      if (*text != 0 && *text != '#')
        ctl->token = strdup(text);
    }
    fclose(file);
    if (ctl->token == NULL)
      return complain(STATUS_USAGE, "%s holds no token", path);
  }
  for (const unsigned char *c = (const unsigned char *)ctl->token; c != NULL && *c != 0; c++)
    if (*c <= ' ' || *c >= 0x7f)
      return complain(STATUS_USAGE, "the token holds a character that is not printable ASCII");
  return STATUS_OK;
}

static int surroundings(struct ctl *ctl)
{
  const char *server = getenv("MORPHOD_SERVER"), *no_color = getenv("NO_COLOR"),
             *terminal = getenv("TERM");
  ctl->server =
      option_text(ctl, "server", server != NULL && *server != 0 ? server : "http://127.0.0.1:8765");
  ctl->json = option_is_set(ctl, "json");
  ctl->quiet = option_is_set(ctl, "quiet");
  bool dumb = terminal == NULL || strcmp(terminal, "dumb") == 0;
  ctl->color = isatty(STDOUT_FILENO) && !dumb && (no_color == NULL || *no_color == 0);
  ctl->progress = isatty(STDERR_FILENO) && !dumb;
  ctl->utf8 = strcmp(nl_langinfo(CODESET), "UTF-8") == 0;
  int64_t retry = -1;
  if (!option_number(ctl, "retry", 0, 86400, &retry))
    return STATUS_USAGE;
  ctl->retry_s = (double)retry;
  return read_token(ctl);
}

int main(int argc, char **argv)
{
  struct ctl ctl = {0};
  setlocale(LC_CTYPE, "");
  int status = options_parse(&ctl, argc, (const char *const *)argv);
  if (status < 0) { /* a command to run */
    status = surroundings(&ctl);
    if (status == STATUS_OK)
      status = transport_open(&ctl);
    if (status == STATUS_OK)
      status = ctl.command->run(&ctl);
    transport_close(&ctl);
  }
  if (fflush(stdout) != 0 || ferror(stdout))
    status = complain(STATUS_ERROR, "standard output: %s", strerror(errno));
  free(ctl.token);
  options_free(&ctl);
  return status;
}
