/* connection.c: the table of open connections, their deadlines, how one of them is cut, and how it
 * lingers. */
#include <errno.h>
#include <stdlib.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <unistd.h>

#include "base/clock.h"
#include "http/problem.h"
#include "http/server.h"

/* Descriptors for the database, files, devices, and connections that are ending. */
#define OTHER_FILES 512

#define LINGER_US    2000000
#define LINGER_READS 16 /* per call: a client that keeps sending must not block the thread */

void mo_write_refusal(int fd, unsigned status, const char *id, const char *detail)
{
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
  struct mo_connection *connection = NULL;
  pthread_mutex_lock(&http->connections_lock);
  if (fd >= 0 && (size_t)fd < http->connections_size)
    connection = http->connections[fd];
  pthread_mutex_unlock(&http->connections_lock);
  return connection;
}

void mo_connection_add(struct mo_http *http, struct mo_connection *connection)
{
  pthread_mutex_lock(&http->connections_lock);
  http->connections[connection->fd] = connection;
  if (http->connections_top <= (size_t)connection->fd)
    http->connections_top = (size_t)connection->fd + 1;
  pthread_mutex_unlock(&http->connections_lock);
  atomic_fetch_add(&http->n_connections, 1);
}

void mo_connection_forget(struct mo_http *http, struct mo_connection *connection)
{
  pthread_mutex_lock(&http->connections_lock);
  if (http->connections[connection->fd] == connection)
    http->connections[connection->fd] = NULL;
  pthread_mutex_unlock(&http->connections_lock);
  if (atomic_load(&connection->spare_us) == MO_GAVE_WAY)
    atomic_fetch_sub(&http->n_leaving, 1);
  free(connection);
  atomic_fetch_sub(&http->n_connections, 1);
}

void mo_connection_cut(struct mo_http *http, const struct mo_connection *connection, const char *id,
                       const char *detail)
{
  pthread_mutex_lock(&http->connections_lock);
  if (http->connections[connection->fd] == connection) {
    if (detail != NULL)
      mo_write_refusal(connection->fd, 503, id, detail);
    shutdown(connection->fd, SHUT_RDWR);
  }
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
  /* The lock keeps the descriptors open until after the shutdown, so that none can be another
   * connection's. */
  pthread_mutex_lock(&http->connections_lock);
  for (size_t fd = 0; fd < http->connections_top; fd++) {
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
  rlim_t wanted = (rlim_t)http->config.max_connections + OTHER_FILES;
  if (getrlimit(RLIMIT_NOFILE, &limit) == 0 && limit.rlim_cur < wanted) {
    limit.rlim_cur = limit.rlim_max < wanted ? limit.rlim_max : wanted;
    setrlimit(RLIMIT_NOFILE, &limit);
  }
  if (getrlimit(RLIMIT_NOFILE, &limit) != 0)
    limit.rlim_cur = 1024;
  if (limit.rlim_cur <
      wanted) { /* accept fewer connections: everything else needs descriptors, too */
    rlim_t others = limit.rlim_cur / 2 < OTHER_FILES ? limit.rlim_cur / 2 : OTHER_FILES;
    http->config.max_connections =
        limit.rlim_cur > others ? (uint32_t)(limit.rlim_cur - others) : 1;
  }
  http->connections_size = limit.rlim_cur < (1 << 20) ? (size_t)limit.rlim_cur : (1 << 20);
  http->connections =
      calloc(http->connections_size,
             sizeof(*http->connections)); /* NOLINT(bugprone-sizeof-expression): of pointers */
  http->stop_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
  if (http->connections == NULL || http->stop_fd < 0)
    return mo_fail(message, MO_ERR_NO_MEMORY, "no memory for the table of connections");
  return MO_OK;
}

/* ---- lingering ---- */

void mo_linger_add(struct mo_lingering *lingering, int fd)
{
  pthread_mutex_lock(&lingering->lock);
  bool room = lingering->n < MO_LINGER_MAX;
  if (room) {
    lingering->fd[lingering->n] = fd;
    lingering->until_us[lingering->n++] = mo_clock_us() + LINGER_US;
  }
  pthread_mutex_unlock(&lingering->lock);
  if (!room)
    close(fd);
}

void mo_linger_on(struct mo_lingering *lingering, int64_t now_us)
{
  char waste[16384];
  pthread_mutex_lock(&lingering->lock);
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
  pthread_mutex_unlock(&lingering->lock);
}

void mo_linger_end(struct mo_lingering *lingering)
{
  for (size_t i = 0; i < lingering->n; i++)
    close(lingering->fd[i]);
  lingering->n = 0;
}
