/* core.c: what all files of this room read of a back end, and the tag of the calling thread. */
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

static const struct mo_compute_core *core_of(const struct mo_compute *compute)
{
  return (const struct mo_compute_core *)compute;
}

enum mo_isa mo_compute_isa(const struct mo_compute *compute)
{
  return core_of(compute)->isa;
}

uint32_t mo_compute_workers(const struct mo_compute *compute)
{
  return core_of(compute)->n_workers;
}

struct mo_devices *mo_compute_get_devices(const struct mo_compute *compute)
{
  return core_of(compute)->devices;
}

void mo_compute_set_devices(struct mo_compute *compute, struct mo_devices *devices)
{
  ((struct mo_compute_core *)compute)->devices = devices;
}

int mo_compute_submit_to_workers(struct mo_compute *compute, struct mo_block *block)
{
  return core_of(compute)->submit_to_workers(compute, block);
}
