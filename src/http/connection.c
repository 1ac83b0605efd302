/* connection.c: the table of open connections, their deadlines, and how they are closed and
 * linger. */
#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <unistd.h>

#include "base/clock.h"
#include "base/thread.h"
#include "http/server.h"

/* Descriptors for the database, files, devices, and connections that are ending. */
#define OTHER_FILES 512

#define WATCHED_MAX 64 /* clients that leave, per poll */

#define LINGER_US    2000000
#define LINGER_READS 16 /* per call: a client that keeps sending must not block the thread */

void mo_write_refusal(const struct mo_http *http, int fd, unsigned status, const char *id,
                      const char *detail)
{
  if (http->is_tls)
    return;
  struct mo_text body = {0}, head = {0};
  mo_problem_write(&body, status, detail, "", id, NULL);
  mo_text_format(&head,
                 "HTTP/1.1 %u %s\r\nContent-Type: application/problem+json\r\nContent-Length: "
                 "%zu\r\nX-Request-Id: %s\r\n"
                 "Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\n"
                 "Content-Security-Policy: frame-ancestors 'none'\r\n"
                 "Cross-Origin-Opener-Policy: same-origin\r\n"
                 "Cross-Origin-Resource-Policy: same-origin\r\n%sConnection: close\r\n\r\n",
                 status, MHD_get_reason_phrase_for(status), body.size, id,
                 status == 503 ? "Retry-After: 1\r\n" : "");
  mo_text_bytes(&head, body.data, body.size);
  if (!head.failed && !body.failed)
    (void)!send(fd, head.data, head.size, MSG_NOSIGNAL | MSG_DONTWAIT);
  mo_text_free(&head);
  mo_text_free(&body);
}

bool mo_connection_spare(struct mo_connection *connection, int64_t since_us)
{
  int64_t seen = atomic_load(&connection->spare_us);
  while (seen != MO_GAVE_WAY &&
         !atomic_compare_exchange_weak(&connection->spare_us, &seen, since_us))
    ;
  return seen != MO_GAVE_WAY;
}

struct mo_connection *mo_connection_find(struct mo_http *http, int fd)
{
  MO_GUARD(&http->connections_lock);
  return fd >= 0 && (size_t)fd < http->connections_size ? http->connections[fd] : NULL;
}

void mo_connection_add(struct mo_http *http, struct mo_connection *connection)
{
  MO_GUARD(&http->connections_lock);
  http->connections[connection->fd] = connection;
  if (http->connections_top <= (size_t)connection->fd)
    http->connections_top = (size_t)connection->fd + 1;
  struct epoll_event left = {.events = EPOLLRDHUP | EPOLLET, .data.fd = connection->fd};
  epoll_ctl(http->watch_fd, EPOLL_CTL_ADD, connection->fd, &left);
  atomic_fetch_add(&http->n_connections, 1);
}

void mo_connection_forget(struct mo_http *http, struct mo_connection *connection)
{
  MO_GUARD(&http->connections_lock);
  if (http->connections[connection->fd] == connection)
    http->connections[connection->fd] = NULL;
  if (atomic_load(&connection->spare_us) == MO_GAVE_WAY)
    atomic_fetch_sub(&http->n_leaving, 1);
  free(connection);
  atomic_fetch_sub(&http->n_connections, 1);
}

void mo_connection_cut(struct mo_http *http, const struct mo_connection *connection, const char *id,
                       const char *detail)
{
  MO_GUARD(&http->connections_lock);
  if (http->connections[connection->fd] == connection) {
    if (detail != NULL)
      mo_write_refusal(http, connection->fd, 503, id, detail);
    shutdown(connection->fd, SHUT_RDWR);
  }
}

bool mo_connections_watch(struct mo_http *http, int timeout_ms)
{
  struct epoll_event events[WATCHED_MAX];
  const int n = epoll_wait(http->watch_fd, events, WATCHED_MAX, timeout_ms);
  bool some = false;
  MO_GUARD(&http->connections_lock);
  for (int i = 0; i < n; i++) {
    struct mo_connection *connection = http->connections[events[i].data.fd];
    struct pollfd now = {.fd = events[i].data.fd, .events = POLLRDHUP};
    /* Check again: the descriptor may belong to a newer connection. */
    if (connection != NULL && poll(&now, 1, 0) == 1) {
      atomic_store(&connection->left, true);
      some = true;
    }
  }
  return some;
}

bool mo_connection_has_left(const struct mo_connection *connection)
{
  return atomic_load(&connection->left);
}

void mo_connections_expire(struct mo_http *http, int64_t now_us)
{
  /* The lock keeps the descriptors open until after the shutdown, so that none of them can be
   * reused. */
  MO_GUARD(&http->connections_lock);
  for (size_t fd = 0; fd < http->connections_top; fd++) {
    struct mo_connection *connection = http->connections[fd];
    if (connection != NULL && atomic_load(&connection->deadline_us) <= now_us) {
      atomic_store(&connection->deadline_us, MO_NEVER);
      atomic_fetch_add(&http->metrics.timed_out, 1);
      shutdown(connection->fd, SHUT_RDWR);
    }
  }
}

int mo_connections_init(struct mo_http *http, struct mo_message *message)
{
  struct rlimit limit;
  const rlim_t other_files = (rlim_t)OTHER_FILES + http->config.other_files;
  rlim_t wanted = (rlim_t)http->config.max_connections + other_files;
  if (getrlimit(RLIMIT_NOFILE, &limit) == 0 && limit.rlim_cur < wanted) {
    limit.rlim_cur = limit.rlim_max < wanted ? limit.rlim_max : wanted;
    setrlimit(RLIMIT_NOFILE, &limit);
  }
  if (getrlimit(RLIMIT_NOFILE, &limit) != 0)
    limit.rlim_cur = 1024;
  if (limit.rlim_cur <
      wanted) { /* accept fewer connections, because everything else needs descriptors, too */
    rlim_t others = limit.rlim_cur / 2 < other_files ? limit.rlim_cur / 2 : other_files;
    const rlim_t most = limit.rlim_cur > others ? limit.rlim_cur - others : 1;
    if (most < http->config.max_connections)
      http->config.max_connections = (uint32_t)most;
  }
  http->connections_size = limit.rlim_cur < (1 << 20) ? (size_t)limit.rlim_cur : (1 << 20);
  http->connections =
      calloc(http->connections_size,
             sizeof(*http->connections)); /* NOLINT(bugprone-sizeof-expression): of pointers */
  http->stop_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
  http->watch_fd = epoll_create1(EPOLL_CLOEXEC);
  http->tick_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
  /* Edge-triggered: each write is an event, and nothing needs to be read. */
  struct epoll_event tick = {.events = EPOLLIN | EPOLLET, .data.fd = http->tick_fd};
  if (http->connections == NULL || http->stop_fd < 0 || http->watch_fd < 0 || http->tick_fd < 0 ||
      epoll_ctl(http->watch_fd, EPOLL_CTL_ADD, http->tick_fd, &tick) != 0)
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory for the table of connections");
  return MO_OK;
}

/* ---- lingering ---- */

void mo_linger_add(struct mo_lingering *lingering, int fd)
{
  MO_GUARD(&lingering->lock);
  if (lingering->n == MO_LINGER_MAX) {
    close(fd);
    return;
  }
  lingering->fd[lingering->n] = fd;
  lingering->until_us[lingering->n++] = mo_clock_us() + LINGER_US;
}

void mo_linger_on(struct mo_lingering *lingering, int64_t now_us)
{
  char waste[16384];
  MO_GUARD(&lingering->lock);
  for (size_t i = 0; i < lingering->n;) {
    ssize_t n = 1;
    for (int k = 0; k < LINGER_READS && n > 0; k++)
      n = recv(lingering->fd[i], waste, sizeof(waste), MSG_DONTWAIT);
    if (n == 0 || (n < 0 && errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR) ||
        now_us >= lingering->until_us[i]) {
      close(lingering->fd[i]);
      lingering->n--;
      lingering->fd[i] = lingering->fd[lingering->n];
      lingering->until_us[i] = lingering->until_us[lingering->n];
    } else {
      i++;
    }
  }
}

void mo_linger_end(struct mo_lingering *lingering)
{
  for (size_t i = 0; i < lingering->n; i++)
    close(lingering->fd[i]);
  lingering->n = 0;
}
