/* cmd_dashboard.c: "dashboard": where the pages of the server are. */
#include <pwd.h>
#include <string.h>
#include <unistd.h>

#include "commands.h"
#include "transport.h"

/* Prints the address. The token is handed over in the part of it that is never sent. */
static void print_address(const char *server, const char *token)
{
  size_t length = strlen(server);
  while (length > 0 && server[length - 1] == '/')
    length--;
  print_plain_line(stdout, "%.*s/%s%s", (int)length, server, token != NULL ? "#token=" : "",
                   token != NULL ? escape(token) : "");
}

void run_dashboard(struct ctl *ctl)
{
  char host[256] = "this-machine";
  get_json(ctl, "/readyz");
  if (strncmp(ctl->server, "unix:", 5) != 0) {
    print_address(ctl->server, ctl->token);
    return;
  }
  gethostname(host, sizeof(host) - 1);
  const struct passwd *user = getpwuid(getuid());
  printf("A browser cannot open a unix socket. On the machine with the browser, type\n\n"
         "  ssh -N -L 8765:%s %s@%s\n\nand open\n\n  ",
         ctl->server + 5, user != NULL ? user->pw_name : "you", host);
  print_address("http://127.0.0.1:8765", ctl->token);
}
