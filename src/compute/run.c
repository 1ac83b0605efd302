/* run.c: waits for blocks, or submits some and waits for them. */
#include "compute/internal.h"

void mo_waiter_done(struct mo_block *block, void *context)
{
  struct mo_waiter *waiter = context;
  MO_GUARD(&waiter->mutex);
  if (block->status != MO_OK)
    atomic_store(&waiter->failed, true);
  if (--waiter->left == 0)
    pthread_cond_signal(&waiter->all_done);
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

int mo_compute_run(struct mo_compute *compute, struct mo_block *blocks, size_t n)
{
  struct mo_waiter waiter = MO_WAITER(n);
  mo_compute_begin_blocks(compute);
  for (size_t i = 0; i < n; i++) {
    blocks[i].done = mo_waiter_done;
    blocks[i].context = &waiter;
    const int status = mo_compute_submit(compute, blocks + i);
    if (status != MO_OK) {
      blocks[i].status = status;
      mo_waiter_done(blocks + i, &waiter);
    }
  }
  mo_compute_end_blocks(compute);
  mo_waiter_wait(&waiter);
  for (size_t i = 0; i < n; i++)
    if (blocks[i].status != MO_OK)
      return blocks[i].status;
  return MO_OK;
}
