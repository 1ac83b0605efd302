/* peer.c: finds the user at the other end of a connection over loopback TCP.
 *
 * The kernel reports the user of any socket by its addresses and ports (NETLINK_SOCK_DIAG). One
 * exact query asks for the peer's end of the connection; sendto itself produces the answer. So
 * limits count per user on loopback, too, and one user cannot take all places. */
#include <arpa/inet.h>
#include <linux/inet_diag.h>
#include <linux/netlink.h>
#include <linux/sock_diag.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "http/server.h"

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

void mo_peers_open(struct mo_http *http)
{
  http->peers_fd = socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC, NETLINK_SOCK_DIAG);
}

bool mo_peer_uid(struct mo_http *http, int fd, const struct sockaddr_storage *peer, uid_t *uid)
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
  /* No inode: the peer has closed its end. Its user is unknown then, and the uid reads 0. */
  if (n < (ssize_t)NLMSG_LENGTH(sizeof(*found)) || answer.head.nlmsg_type != SOCK_DIAG_BY_FAMILY ||
      found->idiag_inode == 0)
    return false;
  *uid = found->idiag_uid;
  return true;
}
