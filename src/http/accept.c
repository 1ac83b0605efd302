/* accept.c: the acceptor.
 *
 * libmicrohttpd never listens itself; it receives connections from here. This file therefore
 * enforces the limit on connections, and replies to clients beyond it. (The library's own limit
 * leaves clients in the backlog, and hangs when connections are added in this way.) It also checks
 * the peers of the unix socket. */
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/inet_diag.h>
#include <linux/netlink.h>
#include <linux/sock_diag.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/un.h>
#include <unistd.h>

#include "base/clock.h"
#include "base/thread.h"
#include "http/server.h"

#define UNACKED_MS  30000 /* a peer that acknowledges nothing for this long counts as gone */
#define KEPT_MAX    16
#define LEAVING_MAX 32

static void refuse(struct mo_http *http, int fd, unsigned status, const char *detail)
{
  char id[17];
  snprintf(id, sizeof(id), "%016llx",
           (unsigned long long)(http->id_key ^ atomic_fetch_add(&http->next_id, 1)));
  mo_write_refusal(http, fd, status, id, detail);
  shutdown(fd, SHUT_WR);
  mo_linger_add(&http->lingering, fd);
  atomic_fetch_add(&http->metrics.refused, 1);
}

/* Identifies the client by its user on this machine, so that limits count all of the user's
 * connections, of any kind. */
static void set_user(struct mo_connection *connection, uid_t uid)
{
  memset(connection->client_key, 0, sizeof(connection->client_key));
  connection->client_key[0] = 'u';
  memcpy(connection->client_key + 4, &uid, sizeof(uid));
}

/* Returns whether the peer may use the unix socket. */
static bool peer_allowed(const struct mo_http *http, int fd, struct mo_connection *connection)
{
  struct ucred peer;
  socklen_t size = sizeof(peer);
  if (getsockopt(fd, SOL_SOCKET, SO_PEERCRED, &peer, &size) != 0)
    return false;
  set_user(connection, peer.uid);
  snprintf(connection->client, sizeof(connection->client), "unix uid %u", (unsigned)peer.uid);
  if (peer.uid == 0 || peer.uid == geteuid())
    return true;
  gid_t groups[256];
  size = sizeof(groups);
  size_t n = 0;
  if (getsockopt(fd, SOL_SOCKET, SO_PEERGROUPS, groups, &size) == 0)
    n = size / sizeof(gid_t);
  for (size_t i = 0; i < http->config.n_unix_groups; i++) {
    if (peer.gid == http->config.unix_groups[i])
      return true;
    for (size_t k = 0; k < n; k++)
      if (groups[k] == http->config.unix_groups[i])
        return true;
  }
  return false;
}

/* Reads one end of the connection in the form of the query: address and port in network order. */
static bool read_end(const struct sockaddr_storage *name, __be32 address[4], __be16 *port)
{
  struct sockaddr_in v4;
  struct sockaddr_in6 v6;
  if (name->ss_family == AF_INET) {
    memcpy(&v4, name, sizeof(v4));
    memcpy(address, &v4.sin_addr, sizeof(v4.sin_addr));
    *port = v4.sin_port;
  } else {
    memcpy(&v6, name, sizeof(v6));
    memcpy(address, &v6.sin6_addr, sizeof(v6.sin6_addr));
    *port = v6.sin6_port;
  }
  return name->ss_family == AF_INET || name->ss_family == AF_INET6;
}

/* Finds the user at the other end of a connection from a loopback address: the kernel reports the
 * user of any socket by its addresses and ports (NETLINK_SOCK_DIAG). One exact query selects the
 * peer's end of the connection; the kernel prepares the answer within sendto. Limits therefore
 * count per user on loopback as well, and one user cannot take all places. Returns false if the
 * user cannot be found. */
static bool find_uid(struct mo_http *http, int fd, const struct sockaddr_storage *peer, uid_t *uid)
{
  struct sockaddr_storage own = {0};
  socklen_t size = sizeof(own);
  struct sockaddr_nl kernel = {.nl_family = AF_NETLINK};
  struct {
    struct nlmsghdr head;
    struct inet_diag_req_v2 query;
  } ask = {.head = {.nlmsg_len = sizeof(ask),
                    .nlmsg_type = SOCK_DIAG_BY_FAMILY,
                    .nlmsg_flags = NLM_F_REQUEST}};
  if (http->peers_fd < 0 || !mo_address_is_loopback(peer) ||
      getsockname(fd, (struct sockaddr *)&own, &size) != 0)
    return false;
  ask.head.nlmsg_seq = ++http->peers_sequence;
  ask.query.sdiag_family = (__u8)peer->ss_family;
  ask.query.sdiag_protocol = IPPROTO_TCP;
  ask.query.idiag_states = ~0U;
  ask.query.id.idiag_cookie[0] = ask.query.id.idiag_cookie[1] = INET_DIAG_NOCOOKIE;
  if (!read_end(peer, ask.query.id.idiag_src, &ask.query.id.idiag_sport) ||
      !read_end(&own, ask.query.id.idiag_dst, &ask.query.id.idiag_dport) ||
      sendto(http->peers_fd, &ask, sizeof(ask), 0, (struct sockaddr *)&kernel, sizeof(kernel)) < 0)
    return false;
  union {
    struct nlmsghdr head;
    char bytes[1024];
  } answer;
  ssize_t n;
  do /* skip answers to earlier queries */
    n = recv(http->peers_fd, &answer, sizeof(answer), MSG_DONTWAIT);
  while (n >= (ssize_t)sizeof(answer.head) && answer.head.nlmsg_seq != ask.head.nlmsg_seq);
  const struct inet_diag_msg *found = NLMSG_DATA(&answer.head);
  /* No inode: the peer has closed its end. Its user is then unknown, and the uid reads 0. */
  if (n < (ssize_t)NLMSG_LENGTH(sizeof(*found)) || answer.head.nlmsg_type != SOCK_DIAG_BY_FAMILY ||
      found->idiag_inode == 0)
    return false;
  *uid = found->idiag_uid;
  return true;
}

static void describe_tcp(struct mo_http *http, int fd, const struct sockaddr_storage *name,
                         struct mo_connection *connection)
{
  const bool is_v4 = name->ss_family == AF_INET;
  char host[INET6_ADDRSTRLEN] = "";
  __be32 address[4] = {0};
  __be16 port = 0;
  read_end(name, address, &port);
  memcpy(connection->client_key + (is_v4 ? 4 : 0), address,
         is_v4 ? 4 : 8); /* a /64 is one client */
  connection->client_key[is_v4 ? 0 : 15] = is_v4 ? '4' : '6';
  inet_ntop(name->ss_family, address, host, sizeof(host));
  snprintf(connection->client, sizeof(connection->client), is_v4 ? "%s:%u" : "[%s]:%u", host,
           (unsigned)ntohs(port));
  uid_t uid;
  if (find_uid(http, fd, name, &uid)) {
    size_t n = strlen(connection->client);
    snprintf(connection->client + n, sizeof(connection->client) - n, " uid %u", (unsigned)uid);
    set_user(connection, uid);
  }
}

/* ---- places ---- */

static bool is_of(const struct mo_connection *connection, const unsigned char key[16])
{
  return memcmp(connection->client_key, key, sizeof(connection->client_key)) == 0;
}

/* Returns whether `one` gives way before `other`: idle connections give way before connections that
 * are receiving a request, and older connections before newer ones. */
static bool goes_before(const struct mo_connection *one, const struct mo_connection *other)
{
  bool receiving = atomic_load(&one->receiving);
  if (other == NULL || receiving != atomic_load(&other->receiving))
    return other == NULL || !receiving;
  return atomic_load(&one->spare_us) < atomic_load(&other->spare_us);
}

/* Returns the client that owns more than half of the connections, or NULL. Call it with the
 * connections' lock held. */
static const unsigned char *find_majority(const struct mo_http *http)
{
  const struct mo_connection *majority = NULL;
  size_t votes = 0, n = 0, own = 0;
  for (size_t fd = 0; fd < http->connections_top; fd++) {
    const struct mo_connection *connection = http->connections[fd];
    if (connection == NULL)
      continue;
    n++;
    if (votes == 0)
      majority = connection;
    votes += majority == connection || is_of(connection, majority->client_key) ? 1 : -(size_t)1;
  }
  for (size_t fd = 0; fd < http->connections_top && majority != NULL; fd++)
    own += http->connections[fd] != NULL && is_of(http->connections[fd], majority->client_key);
  return 2 * own > n ? majority->client_key : NULL;
}

/* Counts the connections of each place, and finds the connection that gives way first: one that has
 * been spare for MO_STALL_US, or any spare connection of a client that has more than half of all
 * connections. Call it with the connections' lock held. */
static void survey(struct mo_http *http, int64_t now_us, uint32_t n[MO_PLACES],
                   struct mo_connection *first[MO_PLACES])
{
  const unsigned char *majority = find_majority(http);
  for (size_t fd = 0; fd < http->connections_top; fd++) {
    struct mo_connection *connection = http->connections[fd];
    int64_t since_us = connection != NULL ? atomic_load(&connection->spare_us) : MO_GAVE_WAY;
    if (since_us == MO_GAVE_WAY)
      continue;
    n[connection->place]++;
    bool spare = since_us <= now_us - MO_STALL_US ||
                 (since_us != MO_NEVER && majority != NULL && is_of(connection, majority));
    if (spare && goes_before(connection, first[connection->place]))
      first[connection->place] = connection;
  }
}

/* Closes a connection, unless a complete request has arrived in the meantime. Call it with the
 * connections' lock held, which keeps the descriptor open. */
static bool give_way(struct mo_http *http, struct mo_connection *connection)
{
  int64_t seen = connection != NULL ? atomic_load(&connection->spare_us) : MO_NEVER;
  if (seen == MO_NEVER ||
      !atomic_compare_exchange_strong(&connection->spare_us, &seen, MO_GAVE_WAY))
    return false;
  atomic_fetch_add(&http->n_leaving, 1);
  atomic_fetch_add(&http->metrics.gave_way, 1);
  shutdown(connection->fd, SHUT_RDWR);
  return true;
}

/* Finds a place for a new connection: a free place, or the place of a connection that it closes.
 * Returns MO_PLACES if there is none. */
static enum mo_place find_place(struct mo_http *http, bool is_unix)
{
  uint32_t max = http->config.max_connections, kept = max / 8 < KEPT_MAX ? max / 8 : KEPT_MAX;
  const uint32_t places[MO_PLACES] = {[MO_PLACE_ORDINARY] = max - kept,
                                      [MO_PLACE_UNIX] = kept / 2,
                                      [MO_PLACE_HEALTH] = kept - kept / 2};
  if (atomic_load(&http->n_connections) < places[MO_PLACE_ORDINARY])
    return MO_PLACE_ORDINARY;
  uint32_t n[MO_PLACES] = {0};
  struct mo_connection *first[MO_PLACES] = {NULL};
  MO_GUARD(&http->connections_lock);
  survey(http, mo_clock_us(), n, first);
  enum mo_place place = MO_PLACE_ORDINARY;
  while (place < MO_PLACES && ((place == MO_PLACE_UNIX && !is_unix) ||
                               (n[place] >= places[place] && !give_way(http, first[place]))))
    place++;
  return place;
}

static void take(struct mo_http *http, size_t listener, int fd, struct sockaddr_storage *name,
                 socklen_t size)
{
  atomic_fetch_add(&http->metrics.accepted, 1);
  /* An old entry for a new descriptor: the library ran out of memory and closed that connection
   * without a callback. */
  struct mo_connection *lost = mo_connection_find(http, fd);
  if (lost != NULL)
    mo_connection_forget(http, lost);
  enum mo_transport transport = http->listeners[listener].transport;
  enum mo_place place = (size_t)fd < http->connections_size
                            ? find_place(http, transport == MO_TRANSPORT_UNIX)
                            : MO_PLACES;
  if (place == MO_PLACES) {
    refuse(http, fd, 503, "All connections of the service are in use; try again later.");
    return;
  }
  struct mo_connection *connection = calloc(1, sizeof(*connection));
  if (connection == NULL) {
    refuse(http, fd, 503, "The service is too busy; try again later.");
    return;
  }
  connection->fd = fd;
  connection->place = place;
  connection->transport = transport;
  if (connection->transport == MO_TRANSPORT_UNIX) {
    if (!peer_allowed(http, fd, connection)) {
      free(connection);
      refuse(http, fd, 403, "Your user may not use this socket.");
      return;
    }
  } else {
    int one = 1;
    unsigned unacked_ms = UNACKED_MS;
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof(one));
    setsockopt(fd, SOL_SOCKET, SO_KEEPALIVE, &one, sizeof(one));
    setsockopt(fd, IPPROTO_TCP, TCP_USER_TIMEOUT, &unacked_ms, sizeof(unacked_ms));
    describe_tcp(http, fd, name, connection);
  }
  int64_t now_us = mo_clock_us();
  atomic_store(&connection->spare_us, now_us);
  atomic_store(&connection->deadline_us, now_us + (int64_t)http->config.header_timeout_ms * 1000);
  mo_connection_add(http, connection);
  /* The library does not compare addresses here, so unix sockets share a fixed one. On failure it
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
  struct pollfd *polled = calloc(http->n_listeners + 1, sizeof(*polled));
  if (polled == NULL)
    return NULL; /* the heartbeat goes stale, and the watchdog stops the process */
  polled[0] = (struct pollfd){.fd = http->stop_fd, .events = POLLIN};
  for (size_t i = 0; i < http->n_listeners; i++)
    polled[i + 1] = (struct pollfd){.fd = http->listeners[i].fd, .events = POLLIN};
  while (!(polled[0].revents & POLLIN)) {
    atomic_store(&http->acceptor_us, mo_clock_us());
    if (poll(polled, http->n_listeners + 1, 1000) < 0)
      for (size_t i = 0; i <= http->n_listeners; i++)
        polled[i].revents = 0;
    for (size_t i = 0; i < http->n_listeners; i++) {
      for (int burst = 0; (polled[i + 1].revents & POLLIN) && burst < 64; burst++) {
        if (atomic_load(&http->n_leaving) >= LEAVING_MAX) {
          poll(polled, 1, 1); /* wait for the I/O threads to close connections */
          break;
        }
        struct sockaddr_storage name = {0};
        socklen_t size = sizeof(name);
        int fd = accept4(http->listeners[i].fd, (struct sockaddr *)&name, &size,
                         SOCK_CLOEXEC | SOCK_NONBLOCK);
        if (fd >= 0) {
          take(http, i, fd, &name, size);
          continue;
        }
        if (errno == EMFILE || errno == ENFILE || errno == ENOBUFS || errno == ENOMEM)
          poll(polled, 1, 50); /* wait for a free descriptor; new connections stay in the backlog */
        break;
      }
    }
  }
  free(polled);
  return NULL;
}

int mo_acceptor_start(struct mo_http *http, struct mo_message *message)
{
  for (size_t i = 0; i < http->n_listeners; i++)
    fcntl(http->listeners[i].fd, F_SETFL, fcntl(http->listeners[i].fd, F_GETFL) | O_NONBLOCK);
  atomic_store(&http->acceptor_us, mo_clock_us());
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
  for (size_t i = 0; i < http->n_listeners; i++)
    close(http->listeners[i].fd);
  http->n_listeners = 0;
}
