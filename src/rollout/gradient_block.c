/* gradient_block.c: the scratch memory of one worker, and the code between mo_gradient_block and
 * the kernels. */
#include "rollout/carve.h"
#include "rollout/fast.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

#define HUGE_PAGE ((size_t)2 << 20)

/* ---- scratch ---- */

int mo_gradient_memory_create(size_t budget_bytes, struct mo_gradient_memory **memory)
{
  struct mo_gradient_memory *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->budget_bytes = budget_bytes;
  *memory = made;
  return MO_OK;
}

static void release(struct mo_gradient_buffer *buffer)
{
  if (buffer->mapped)
    munmap(buffer->base, buffer->size);
  else
    free(buffer->base);
  *buffer = (struct mo_gradient_buffer){0};
}

/* Reserves huge pages, because a tape is long. When the buffer grows, its pages are moved, so they
 * are not cleared again. */
static int reserve_pages(struct mo_gradient_buffer *buffer, size_t bytes)
{
  const size_t size = (bytes + HUGE_PAGE - 1) / HUGE_PAGE * HUGE_PAGE;
  void *base;
  if (buffer->mapped) {
    base = mremap(buffer->base, buffer->size, size, MREMAP_MAYMOVE);
  } else {
    release(buffer);
    base = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  }
  if (base == MAP_FAILED)
    return MO_ERR_NO_MEMORY;
  (void)madvise(base, size, MADV_HUGEPAGE); /* only a hint */
  *buffer = (struct mo_gradient_buffer){base, size, true};
  return MO_OK;
}

int mo_gradient_reserve(struct mo_gradient_buffer *buffer, size_t bytes)
{
  if (bytes <= buffer->size)
    return MO_OK;
  if (bytes >= HUGE_PAGE)
    return reserve_pages(buffer, bytes);
  release(buffer);
  const size_t size = mo_aligned(bytes);
  char *base = aligned_alloc(MO_ALIGNMENT, size);
  if (base == NULL)
    return MO_ERR_NO_MEMORY;
  *buffer = (struct mo_gradient_buffer){base, size, false};
  return MO_OK;
}

void mo_gradient_memory_free(struct mo_gradient_memory *memory)
{
  if (memory == NULL)
    return;
  release(&memory->block);
  release(&memory->tiling);
  release(&memory->work);
  free(memory);
}

size_t mo_gradient_memory_bytes(const struct mo_gradient_memory *memory)
{
  return sizeof(*memory) + memory->block.size + memory->tiling.size + memory->work.size;
}

/* ---- blocks ---- */

int mo_gradient_block(struct mo_gradient_memory *memory, const struct mo_pack *pack,
                      const struct mo_robot *robots, uint32_t n, const struct mo_physics *physics,
                      const struct mo_gradient_options *options, const struct mo_pause_point *pause,
                      struct mo_outcome *outcomes, float *d_parameters,
                      struct mo_gradient_counts *counts)
{
  if (n < 1 || n > MO_GRADIENT_ROBOTS || pack->backward_weight[0] == NULL ||
      mo_gradient_options_check(options) != MO_OK)
    return MO_ERR_INVALID;
  for (uint32_t i = 0; i < n; i++)
    if (!mo_workspace_equal(robots[i].body->workspace, pack->workspace))
      return MO_ERR_INVALID;
  for (uint32_t i = 0; i < n; i++)
    if (mo_task_check_gradient(&robots[i].environment->task, NULL) != MO_OK)
      return MO_ERR_UNSUPPORTED;
  struct mo_gradient_counts block = {0};
  struct mo_gradient_run run = {.memory = memory,
                                .pack = pack,
                                .robots = robots,
                                .n = n,
                                .physics = physics,
                                .control_steps = mo_control_steps(&physics->scheme),
                                .options = options,
                                .pause = pause,
                                .outcomes = outcomes,
                                .d_parameters = d_parameters,
                                .counts = &block};
  if (run.control_steps == 0 || run.control_steps > MO_GRADIENT_PERIOD_MAX)
    return MO_ERR_INVALID;
  const int status = mo_gradient_find(pack->isa)(&run);
  if (status == MO_OK && counts != NULL)
    mo_gradient_counts_add(counts, &block);
  return status;
}

/* ---- arrangement ---- */

struct place {
  uint32_t n_springs, robot;
};

/* Sorts robots with more springs first. */
static int by_size(const void *a, const void *b)
{
  const struct place *x = a, *y = b;
  if (x->n_springs != y->n_springs)
    return x->n_springs > y->n_springs ? -1 : 1;
  return x->robot < y->robot ? -1 : 1;
}

/* Groups bodies of similar size: small bodies share the few springs that all of them have, instead
 * of adding their own springs to the blocks of large bodies. For 256 random bodies, this gave 108
 * tiles per block instead of 172. Searching for the pairs with the largest overlap gains almost
 * nothing beyond that. The largest bodies come first, so that no worker is still computing one at
 * the end. */
int mo_gradient_arrange(const struct mo_robot *robots, size_t n, uint32_t *order)
{
  struct place *places = malloc((n > 0 ? n : 1) * sizeof(*places));
  if (places == NULL)
    return MO_ERR_NO_MEMORY;
  for (size_t i = 0; i < n; i++)
    places[i] = (struct place){robots[i].body->n_springs, (uint32_t)i};
  qsort(places, n, sizeof(*places), by_size);
  for (size_t i = 0; i < n; i++)
    order[i] = places[i].robot;
  free(places);
  return MO_OK;
}
