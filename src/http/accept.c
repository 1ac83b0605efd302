/* accept.c: the acceptor, and the table of open connections with their deadlines.
 *
 * libmicrohttpd gets connections from here and never listens itself: this is where the limit on
 * connections is kept, with an answer (its own limit leaves clients in the backlog, and hangs when
 * reached this way), and where peers of the unix socket are checked. */
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <sys/un.h>
#include <unistd.h>

#include "http/server.h"

#define LINGER_MAX 64
#define LINGER_US  2000000
#define LINGER_READS                                                                               \
  16                     /* at a time: a client that sends without end must not hold the acceptor  \
                          */
#define UNACKED_MS 30000 /* a peer that acknowledges nothing for so long is gone */

/* Connections that were answered with a refusal: what they still send is read and thrown away for a
 * moment, since closing at once would take the answer back. */
struct lingering {
  int fd[LINGER_MAX];
  int64_t until_us[LINGER_MAX];
  size_t n;
};

static void refuse(struct mo_http *http, struct lingering *linger, int fd, unsigned status,
                   const char *detail)
{
  struct mo_text body = {0}, head = {0};
  char id[17];
  snprintf(id, sizeof(id), "%016llx",
           (unsigned long long)(http->id_key ^ atomic_fetch_add(&http->next_id, 1)));
  mo_problem_write(&body, status, "about:blank", detail, "", id, NULL);
  mo_text_format(&head,
                 "HTTP/1.1 %u %s\r\nContent-Type: application/problem+json\r\nContent-Length: "
                 "%zu\r\nX-Request-Id: %s\r\n"
                 "Cache-Control: no-store\r\n%sConnection: close\r\n\r\n",
                 status, mo_status_title(status), body.size, id,
                 status == 503 ? "Retry-After: 1\r\n" : "");
  mo_text_bytes(&head, body.data, body.size);
  if (!head.failed && !body.failed)
    (void)!send(fd, head.data, head.size, MSG_NOSIGNAL | MSG_DONTWAIT);
  mo_text_free(&head);
  mo_text_free(&body);
  shutdown(fd, SHUT_WR);
  if (linger->n < LINGER_MAX) {
    linger->fd[linger->n] = fd;
    linger->until_us[linger->n++] = mo_http_clock_us() + LINGER_US;
  } else {
    close(fd);
  }
  atomic_fetch_add(&http->metrics.refused, 1);
}

/* Reads what came; forgets those that are done. */
static void linger_on(struct lingering *linger, int64_t now_us)
{
  char waste[4096];
  for (size_t i = 0; i < linger->n;) {
    ssize_t n = 1;
    for (int k = 0; k < LINGER_READS && n > 0; k++)
      n = recv(linger->fd[i], waste, sizeof(waste), MSG_DONTWAIT);
    if (n == 0 || (n < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR) ||
        now_us >= linger->until_us[i]) {
      close(linger->fd[i]);
      linger->n--;
      linger->fd[i] = linger->fd[linger->n];
      linger->until_us[i] = linger->until_us[linger->n];
    } else {
      i++;
    }
  }
}

/* May this process use the unix socket? */
static bool peer_allowed(const struct mo_http *http, int fd, struct mo_connection *connection)
{
  struct ucred peer;
  socklen_t size = sizeof(peer);
  if (getsockopt(fd, SOL_SOCKET, SO_PEERCRED, &peer, &size) != 0)
    return false;
  connection->client_key[0] = 'u';
  memcpy(connection->client_key + 4, &peer.uid, sizeof(peer.uid));
  snprintf(connection->client, sizeof(connection->client), "unix uid %u", (unsigned)peer.uid);
  if (peer.uid == 0 || peer.uid == geteuid())
    return true;
  gid_t groups[256];
  size = sizeof(groups);
  size_t n = 0;
  if (getsockopt(fd, SOL_SOCKET, SO_PEERGROUPS, groups, &size) == 0)
    n = size / sizeof(gid_t);
  for (size_t i = 0; i < http->n_unix_groups; i++) {
    if (peer.gid == http->unix_groups[i])
      return true;
    for (size_t k = 0; k < n; k++)
      if (groups[k] == http->unix_groups[i])
        return true;
  }
  return false;
}

static void describe_tcp(const struct sockaddr_storage *name, struct mo_connection *connection)
{
  char host[INET6_ADDRSTRLEN] = "";
  if (name->ss_family == AF_INET) {
    struct sockaddr_in v4;
    memcpy(&v4, name, sizeof(v4));
    connection->client_key[0] = '4';
    memcpy(connection->client_key + 4, &v4.sin_addr, 4);
    inet_ntop(AF_INET, &v4.sin_addr, host, sizeof(host));
    snprintf(connection->client, sizeof(connection->client), "%s:%u", host,
             (unsigned)ntohs(v4.sin_port));
  } else {
    struct sockaddr_in6 v6;
    memcpy(&v6, name, sizeof(v6));
    memcpy(connection->client_key, &v6.sin6_addr, 8); /* a /64 is one client */
    connection->client_key[15] = '6';
    inet_ntop(AF_INET6, &v6.sin6_addr, host, sizeof(host));
    snprintf(connection->client, sizeof(connection->client), "[%s]:%u", host,
             (unsigned)ntohs(v6.sin6_port));
  }
}

static void take(struct mo_http *http, struct lingering *linger, size_t listener, int fd,
                 struct sockaddr_storage *name, socklen_t size)
{
  atomic_fetch_add(&http->metrics.accepted, 1);
  /* An entry of a descriptor that is new: the library closed that connection before it told of it
   * (no memory). */
  struct mo_connection *lost = mo_connection_find(http, fd);
  if (lost != NULL)
    mo_connection_forget(http, lost);
  if (atomic_load(&http->n_connections) >= http->config.max_connections ||
      (size_t)fd >= http->connections_size) {
    refuse(http, linger, fd, 503, "All connections of the service are in use; try again later.");
    return;
  }
  struct mo_connection *connection = calloc(1, sizeof(*connection));
  if (connection == NULL) {
    refuse(http, linger, fd, 503, "The service is too busy; try again later.");
    return;
  }
  connection->fd = fd;
  connection->transport = http->listener_transports[listener];
  if (connection->transport == MO_TRANSPORT_UNIX) {
    if (!peer_allowed(http, fd, connection)) {
      free(connection);
      refuse(http, linger, fd, 403, "Your user may not use this socket.");
      return;
    }
  } else {
    int one = 1;
    unsigned unacked_ms = UNACKED_MS;
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof(one));
    setsockopt(fd, SOL_SOCKET, SO_KEEPALIVE, &one, sizeof(one));
    setsockopt(fd, IPPROTO_TCP, TCP_USER_TIMEOUT, &unacked_ms, sizeof(unacked_ms));
    describe_tcp(name, connection);
  }
  atomic_store(&connection->deadline_us,
               mo_http_clock_us() + (int64_t)http->config.header_timeout_ms * 1000);
  pthread_mutex_lock(&http->connections_lock);
  http->connections[fd] = connection;
  pthread_mutex_unlock(&http->connections_lock);
  atomic_fetch_add(&http->n_connections, 1);
  /* The library compares no addresses of its own: a fixed one serves for unix sockets. Fails: it
   * has closed the descriptor. */
  struct sockaddr_in fixed = {.sin_family = AF_INET};
  bool is_unix = connection->transport == MO_TRANSPORT_UNIX;
  if (MHD_add_connection(http->daemon, fd,
                         is_unix ? (struct sockaddr *)&fixed : (struct sockaddr *)name,
                         is_unix ? sizeof(fixed) : size) != MHD_YES) {
    connection = mo_connection_find(http, fd);
    if (connection != NULL)
      mo_connection_forget(http, connection);
  }
}

static void *acceptor(void *context)
{
  struct mo_http *http = context;
  struct lingering linger = {.n = 0};
  struct pollfd *polled = calloc(http->n_listeners + 1, sizeof(*polled));
  if (polled == NULL)
    return NULL; /* its heartbeat goes stale: the watchdog ends the process */
  polled[0] = (struct pollfd){.fd = http->stop_fd, .events = POLLIN};
  for (size_t i = 0; i < http->n_listeners; i++)
    polled[i + 1] = (struct pollfd){.fd = http->listeners[i], .events = POLLIN};
  while (!(polled[0].revents & POLLIN)) {
    atomic_store(&http->acceptor_us, mo_http_clock_us());
    if (poll(polled, http->n_listeners + 1, linger.n > 0 ? 20 : 1000) < 0)
      for (size_t i = 0; i <= http->n_listeners; i++)
        polled[i].revents = 0;
    linger_on(&linger, mo_http_clock_us());
    for (size_t i = 0; i < http->n_listeners; i++) {
      for (int burst = 0; (polled[i + 1].revents & POLLIN) && burst < 64; burst++) {
        struct sockaddr_storage name = {0};
        socklen_t size = sizeof(name);
        int fd = accept4(http->listeners[i], (struct sockaddr *)&name, &size,
                         SOCK_CLOEXEC | SOCK_NONBLOCK);
        if (fd >= 0) {
          take(http, &linger, i, fd, &name, size);
          continue;
        }
        if (errno == EMFILE || errno == ENFILE || errno == ENOBUFS || errno == ENOMEM)
          poll(polled, 1, 50); /* a descriptor may come free; the backlog waits */
        break;
      }
    }
  }
  for (size_t i = 0; i < linger.n; i++)
    close(linger.fd[i]);
  free(polled);
  return NULL;
}

struct mo_connection *mo_connection_find(struct mo_http *http, int fd)
{
  struct mo_connection *connection = NULL;
  pthread_mutex_lock(&http->connections_lock);
  if (fd >= 0 && (size_t)fd < http->connections_size)
    connection = http->connections[fd];
  pthread_mutex_unlock(&http->connections_lock);
  return connection;
}

void mo_connection_forget(struct mo_http *http, struct mo_connection *connection)
{
  pthread_mutex_lock(&http->connections_lock);
  if (http->connections[connection->fd] == connection)
    http->connections[connection->fd] = NULL;
  pthread_mutex_unlock(&http->connections_lock);
  free(connection);
  atomic_fetch_sub(&http->n_connections, 1);
}

void mo_connection_cut(struct mo_http *http, const struct mo_connection *connection)
{
  pthread_mutex_lock(&http->connections_lock);
  if (http->connections[connection->fd] == connection)
    shutdown(connection->fd, SHUT_RDWR);
  pthread_mutex_unlock(&http->connections_lock);
}

bool mo_connection_has_left(const struct mo_connection *connection)
{
  char byte;
  ssize_t n = recv(connection->fd, &byte, 1, MSG_PEEK | MSG_DONTWAIT);
  return n == 0 || (n < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR);
}

void mo_connections_expire(struct mo_http *http, int64_t now_us)
{
  /* The lock keeps descriptors from being closed, and so from being another connection's, until
   * shutdown is through. */
  pthread_mutex_lock(&http->connections_lock);
  for (size_t fd = 0; fd < http->connections_size; fd++) {
    struct mo_connection *connection = http->connections[fd];
    if (connection != NULL && atomic_load(&connection->deadline_us) <= now_us) {
      atomic_store(&connection->deadline_us, MO_NEVER);
      atomic_fetch_add(&http->metrics.timed_out, 1);
      shutdown(connection->fd, SHUT_RDWR);
    }
  }
  pthread_mutex_unlock(&http->connections_lock);
}

int mo_connections_init(struct mo_http *http, struct mo_message *message)
{
  struct rlimit limit;
  rlim_t wanted = (rlim_t)http->config.max_connections + 512;
  if (getrlimit(RLIMIT_NOFILE, &limit) == 0 && limit.rlim_cur < wanted) {
    limit.rlim_cur = limit.rlim_max < wanted ? limit.rlim_max : wanted;
    setrlimit(RLIMIT_NOFILE, &limit);
  }
  if (getrlimit(RLIMIT_NOFILE, &limit) != 0)
    limit.rlim_cur = 1024;
  http->connections_size = limit.rlim_cur < (1 << 20) ? (size_t)limit.rlim_cur : (1 << 20);
  http->connections =
      calloc(http->connections_size,
             sizeof(*http->connections)); /* NOLINT(bugprone-sizeof-expression): of pointers */
  http->stop_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
  if (http->connections == NULL || http->stop_fd < 0)
    return mo_fail(message, MO_ERR_NO_MEMORY, "no memory for the table of connections");
  return MO_OK;
}

int mo_acceptor_start(struct mo_http *http, struct mo_message *message)
{
  for (size_t i = 0; i < http->n_listeners; i++)
    fcntl(http->listeners[i], F_SETFL, fcntl(http->listeners[i], F_GETFL) | O_NONBLOCK);
  atomic_store(&http->acceptor_us, mo_http_clock_us());
  if (pthread_create(&http->acceptor, NULL, acceptor, http) != 0)
    return mo_fail(message, MO_ERR_NO_MEMORY, "cannot start the thread that accepts connections");
  http->acceptor_started = true;
  return MO_OK;
}

void mo_acceptor_stop(struct mo_http *http)
{
  if (http->acceptor_started) {
    uint64_t one = 1;
    (void)!write(http->stop_fd, &one, sizeof(one));
    pthread_join(http->acceptor, NULL);
    http->acceptor_started = false;
  }
  for (size_t i = 0; i < http->n_listeners; i++) {
    close(http->listeners[i]);
    http->listeners[i] = -1;
  }
  http->n_listeners = 0;
}
