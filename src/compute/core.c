/* core.c: waiting for blocks. */
#include "compute/internal.h"

void mo_waiter_done(struct mo_block *block, void *context)
{
  struct mo_waiter *waiter = context;
  pthread_mutex_lock(&waiter->mutex);
  if (block->status != MO_OK)
    atomic_store(&waiter->failed, true);
  if (--waiter->left == 0)
    pthread_cond_signal(&waiter->all_done);
  pthread_mutex_unlock(&waiter->mutex);
}

void mo_waiter_wait(struct mo_waiter *waiter)
{
  pthread_mutex_lock(&waiter->mutex);
  while (waiter->left > 0)
    pthread_cond_wait(&waiter->all_done, &waiter->mutex);
  pthread_mutex_unlock(&waiter->mutex);
  pthread_cond_destroy(&waiter->all_done);
  pthread_mutex_destroy(&waiter->mutex);
}
