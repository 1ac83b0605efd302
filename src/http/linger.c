/* linger.c: see linger.h. */
#include "http/linger.h"

#include <errno.h>
#include <sys/socket.h>
#include <unistd.h>

#include "base/clock.h"

#define LINGER_US    2000000
#define LINGER_READS 16 /* per call: a client that keeps sending must not block the thread */

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
  pthread_mutex_destroy(&lingering->lock);
}
