/* sockets.c: see sockets.h. */
#include "sockets.h"

#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "http/http.h"

int sockets_add(struct sockets *sockets, int fd, const char *address, struct mo_message *message)
{
  const size_t place = sockets->n;
  bool beyond;
  if (place == SOCKETS_MAX)
    return mo_fail(message, MO_ERR_LIMIT, "there may be at most %d sockets", SOCKETS_MAX);
  const int status = address != NULL ? mo_http_listen(address, &fd, sockets->text[place], message)
                                     : mo_http_describe(fd, sockets->text[place], &beyond, message);
  if (status != MO_OK)
    return status;
  sockets->addresses[place] = sockets->text[place];
  sockets->fd[sockets->n++] = fd;
  if (address != NULL && strncmp(address, "unix:", 5) == 0)
    sockets->unix_paths[place] = strdup(address + 5);
  return MO_OK;
}

void sockets_use_tls(struct sockets *sockets)
{
  for (size_t i = 0; i < sockets->n; i++)
    if (strncmp(sockets->text[i], "http:", 5) == 0) {
      memmove(sockets->text[i] + 5, sockets->text[i] + 4, strlen(sockets->text[i] + 4) + 1);
      sockets->text[i][4] = 's';
    }
}

void sockets_hand_over(struct sockets *sockets)
{
  for (size_t i = 0; i < sockets->n; i++)
    sockets->fd[i] = -1;
}

void sockets_close(struct sockets *sockets)
{
  for (size_t i = 0; i < sockets->n; i++) {
    if (sockets->unix_paths[i] != NULL)
      unlink(sockets->unix_paths[i]);
    free(sockets->unix_paths[i]);
    sockets->unix_paths[i] = NULL;
    if (sockets->fd[i] >= 0)
      close(sockets->fd[i]);
    sockets->fd[i] = -1;
  }
}
