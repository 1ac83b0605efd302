/* run.c: submits blocks and waits for them. */
#include "compute/internal.h"

struct waiter {
  pthread_mutex_t mutex;
  pthread_cond_t all_done;
  size_t left;
};

static void one_done(struct mo_block *block, void *context)
{
  struct waiter *waiter = context;
  (void)block;
  pthread_mutex_lock(&waiter->mutex);
  if (--waiter->left == 0)
    pthread_cond_signal(&waiter->all_done);
  pthread_mutex_unlock(&waiter->mutex);
}

int mo_compute_run(struct mo_compute *compute, struct mo_block *blocks, size_t n)
{
  struct waiter waiter = {
      .mutex = PTHREAD_MUTEX_INITIALIZER, .all_done = PTHREAD_COND_INITIALIZER, .left = n};
  mo_compute_begin_blocks(compute);
  for (size_t i = 0; i < n; i++) {
    blocks[i].done = one_done;
    blocks[i].context = &waiter;
    const int status = mo_compute_submit(compute, blocks + i);
    if (status != MO_OK) {
      blocks[i].status = status;
      one_done(blocks + i, &waiter);
    }
  }
  mo_compute_end_blocks(compute);
  pthread_mutex_lock(&waiter.mutex);
  while (waiter.left > 0)
    pthread_cond_wait(&waiter.all_done, &waiter.mutex);
  pthread_mutex_unlock(&waiter.mutex);
  pthread_cond_destroy(&waiter.all_done);
  pthread_mutex_destroy(&waiter.mutex);
  for (size_t i = 0; i < n; i++)
    if (blocks[i].status != MO_OK)
      return blocks[i].status;
  return MO_OK;
}
