/* run.c: submits blocks and waits for them. */
#include "compute/internal.h"

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
