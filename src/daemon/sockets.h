/* sockets.h: the listening sockets of a server. */
#ifndef MORPHOD_SOCKETS_H
#define MORPHOD_SOCKETS_H

#include <stddef.h>

#include <morpho/error.h>

#define SOCKETS_MAX          64
#define SOCKET_ADDRESS_BYTES 256

struct sockets {
  int fd[SOCKETS_MAX]; /* −1: closed */
  size_t n;
  char text[SOCKETS_MAX][SOCKET_ADDRESS_BYTES];
  const char *addresses[SOCKETS_MAX]; /* point into `text` */
  char *unix_paths[SOCKETS_MAX];      /* sockets created here, to be removed; else NULL */
};

/* Adds a passed socket (address NULL), or listens on an address. Returns the errors of
 * mo_http_listen, or MO_ERR_LIMIT. */
int sockets_add(struct sockets *sockets, int fd, const char *address, struct mo_message *message);
/* Changes http to https in the addresses. */
void sockets_use_tls(struct sockets *sockets);
/* Gives up the sockets, because their new owner has closed them or will do so. */
void sockets_hand_over(struct sockets *sockets);
/* Closes the sockets that were not handed over, and removes unix sockets. Call it while they still
 * listen: after that, the next process may find a unix socket without a server and take over its
 * path. */
void sockets_close(struct sockets *sockets);

#endif
