/* core.c: the tag of the calling thread, and waiting for blocks. */
#include "compute/internal.h"

/* The tag of the innermost block on this thread. Read by a fault handler, so volatile. */
static _Thread_local volatile int64_t current_tag = -1;

int64_t mo_compute_current_tag(void)
{
  return current_tag;
}

void mo_compute_set_tag(int64_t tag)
{
  current_tag = tag;
}

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
