/* listen.c: opens listening sockets, and describes sockets that were passed to the process. */
#include <arpa/inet.h>
#include <ctype.h>
#include <errno.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include "http/field.h"
#include "http/server.h"

#define BACKLOG 1024

bool mo_address_is_loopback(const struct sockaddr_storage *address)
{
  if (address->ss_family == AF_INET)
    return ntohl(((const struct sockaddr_in *)address)->sin_addr.s_addr) >> 24 == 127;
  if (address->ss_family != AF_INET6)
    return false;
  const struct in6_addr *v6 = &((const struct sockaddr_in6 *)address)->sin6_addr;
  return IN6_IS_ADDR_LOOPBACK(v6) || (IN6_IS_ADDR_V4MAPPED(v6) && v6->s6_addr[12] == 127);
}

int mo_http_describe(int fd, char *address, bool *beyond_loopback, struct mo_message *message)
{
  struct sockaddr_storage name = {0};
  socklen_t size = sizeof(name), option_size = sizeof(int);
  int listening = 0, type = 0;
  if (getsockname(fd, (struct sockaddr *)&name, &size) != 0 ||
      getsockopt(fd, SOL_SOCKET, SO_ACCEPTCONN, &listening, &option_size) != 0 ||
      getsockopt(fd, SOL_SOCKET, SO_TYPE, &type, &option_size) != 0 || !listening ||
      type != SOCK_STREAM ||
      (name.ss_family != AF_INET && name.ss_family != AF_INET6 && name.ss_family != AF_UNIX))
    return mo_fail(message, MO_ERR_INVALID, "descriptor %d is not a listening TCP or unix socket",
                   fd);
  if (name.ss_family == AF_UNIX) {
    const struct sockaddr_un *path = (const struct sockaddr_un *)&name;
    *beyond_loopback = false;
    int n = (int)(size - offsetof(struct sockaddr_un, sun_path));
    if (n > 0 && path->sun_path[0] == '\0')
      snprintf(address, 128, "unix:@%.*s", n - 1, path->sun_path + 1);
    else
      snprintf(address, 128, "unix:%.*s", n, path->sun_path);
    return MO_OK;
  }
  *beyond_loopback = !mo_address_is_loopback(&name);
  char host[64], port[16];
  if (getnameinfo((struct sockaddr *)&name, size, host, sizeof(host), port, sizeof(port),
                  NI_NUMERICHOST | NI_NUMERICSERV) != 0)
    return mo_fail(message, MO_ERR_INVALID, "descriptor %d has no printable address", fd);
  snprintf(address, 128, name.ss_family == AF_INET6 ? "http://[%s]:%s" : "http://%s:%s", host,
           port);
  return MO_OK;
}

int mo_http_parse_address(const char *text, struct mo_listen_address *address,
                          struct mo_message *message)
{
  struct mo_listen_address result = {0};
  if (strncmp(text, "unix:", 5) == 0) {
    const char *path = text + 5;
    if (*path != '/')
      return mo_fail(message, MO_ERR_INVALID,
                     "\"%.100s\": the path of a unix socket must start with /", text);
    if (strlen(path) >= sizeof(((struct sockaddr_un *)0)->sun_path))
      return mo_fail(message, MO_ERR_INVALID,
                     "\"%.100s…\": the path of a unix socket may have at most %zu bytes", text,
                     sizeof(((struct sockaddr_un *)0)->sun_path) - 1);
    result.is_unix = result.is_loopback = true;
    snprintf(result.host, sizeof(result.host), "%s", path);
    *address = result;
    return MO_OK;
  }
  const char *colon = strrchr(text, ':');
  if (colon == NULL || !isdigit((unsigned char)colon[1]))
    return mo_fail(message, MO_ERR_INVALID,
                   "\"%.100s\" must be host:port, [ipv6]:port or unix:/path", text);
  char *end;
  errno = 0;
  unsigned long port = strtoul(colon + 1, &end, 10);
  if (*end != 0)
    return mo_fail(message, MO_ERR_INVALID, "\"%.100s\" must end with a port number", text);
  if (errno != 0 || port > 65535)
    return mo_fail(message, MO_ERR_INVALID, "\"%.100s\": a port must be at most 65535", text);
  size_t length = (size_t)(colon - text);
  const char *host = text;
  if (length >= 2 && host[0] == '[' && host[length - 1] == ']') {
    host++;
    length -= 2;
  } else if (memchr(host, ':', length) != NULL) {
    return mo_fail(message, MO_ERR_INVALID,
                   "\"%.100s\": an IPv6 address must be in brackets: [::1]:8765", text);
  }
  if (length == 0 || length >= sizeof(result.host))
    return mo_fail(message, MO_ERR_INVALID, "\"%.100s\" has no host; use 0.0.0.0 for all addresses",
                   text);
  memcpy(result.host, host, length);
  result.port = (uint16_t)port;
  result.is_loopback = mo_host_is_loopback(result.host);
  *address = result;
  return MO_OK;
}

static int listen_unix(const char *path, struct mo_message *message)
{
  struct sockaddr_un name = {.sun_family = AF_UNIX};
  memcpy(name.sun_path, path, strlen(path) + 1);
  struct stat status;
  if (lstat(path, &status) == 0) {
    if (!S_ISSOCK(status.st_mode))
      return mo_fail(message, MO_ERR_CONFLICT, "%s exists and is not a socket", path);
    int probe = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    bool alive = probe >= 0 &&
                 (connect(probe, (struct sockaddr *)&name, sizeof(name)) == 0 || errno == EAGAIN);
    if (probe >= 0)
      close(probe);
    if (alive)
      return mo_fail(message, MO_ERR_CONFLICT, "another process already listens on %s", path);
    if (unlink(path) != 0)
      return mo_fail(message, MO_ERR_IO, "cannot replace %s: %s", path, strerror(errno));
  }
  int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
  if (fd < 0)
    return mo_fail(message, MO_ERR_IO, "cannot create a socket: %s", strerror(errno));
  if (bind(fd, (struct sockaddr *)&name, sizeof(name)) != 0 || chmod(path, 0666) != 0 ||
      listen(fd, BACKLOG) != 0) {
    int code = mo_fail(message, MO_ERR_IO, "cannot serve %s: %s", path, strerror(errno));
    close(fd);
    return code;
  }
  return fd;
}

static int listen_tcp(const char *text, const struct mo_listen_address *where,
                      struct mo_message *message)
{
  char port[8];
  snprintf(port, sizeof(port), "%u", where->port);
  struct addrinfo hints = {.ai_socktype = SOCK_STREAM, .ai_flags = AI_PASSIVE | AI_ADDRCONFIG},
                  *found = NULL;
  struct in6_addr v6;
  struct in_addr v4;
  if (inet_pton(AF_INET, where->host, &v4) == 1 || inet_pton(AF_INET6, where->host, &v6) == 1)
    hints.ai_flags = AI_PASSIVE | AI_NUMERICHOST;
  int status = getaddrinfo(where->host, port, &hints, &found);
  if (status != 0)
    return mo_fail(message, MO_ERR_NOT_FOUND, "cannot resolve the name %s: %s", where->host,
                   gai_strerror(status));
  int one = 1, code = MO_OK;
  int fd = socket(found->ai_family, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
  if (fd < 0) {
    code = mo_fail(message, MO_ERR_IO, "cannot create a socket: %s", strerror(errno));
  } else {
    setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &one, sizeof(one));
    if (found->ai_family == AF_INET6)
      setsockopt(fd, IPPROTO_IPV6, IPV6_V6ONLY, &one, sizeof(one));
    if (bind(fd, found->ai_addr, found->ai_addrlen) != 0 || listen(fd, BACKLOG) != 0) {
      code = mo_fail(message, errno == EADDRINUSE ? MO_ERR_CONFLICT : MO_ERR_IO,
                     "cannot serve %s: %s", text, strerror(errno));
      close(fd);
    }
  }
  freeaddrinfo(found);
  return code == MO_OK ? fd : code;
}

int mo_http_listen(const char *where, int *fd, char *address, struct mo_message *message)
{
  struct mo_listen_address parts = {0};
  int result = mo_http_parse_address(where, &parts, message);
  if (result == MO_OK)
    result = parts.is_unix ? listen_unix(parts.host, message) : listen_tcp(where, &parts, message);
  if (result < 0)
    return result;
  bool beyond;
  int code = mo_http_describe(result, address, &beyond, message);
  if (code != MO_OK) {
    close(result);
    return code;
  }
  *fd = result;
  return MO_OK;
}
