/* linger.h: for a moment, reads and discards what clients still send after their last reply.
 * Closing at once would reset the connection and lose the reply. */
#ifndef MORPHO_HTTP_LINGER_H
#define MORPHO_HTTP_LINGER_H

#include <pthread.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define MO_LINGER_MAX 128
struct mo_lingering {
  pthread_mutex_t lock;
  int fd[MO_LINGER_MAX];
  int64_t until_us[MO_LINGER_MAX];
  size_t n;
};
/* Takes over the descriptor, already shut down for writing. */
void mo_linger_add(struct mo_lingering *lingering, int fd);
void mo_linger_on(struct mo_lingering *lingering, int64_t now_us);
void mo_linger_end(struct mo_lingering *lingering);

#endif
