/* block.c: the scratch of one worker, and the code between mo_rollout_block and the kernels.
 *
 * The scratch is one allocation that grows to the largest body seen; a block of a body that fits
 * allocates nothing. */
#include "rollout/fast.h"

#include <stdlib.h>

enum { ALIGNMENT = 64 };

struct mo_workspace_memory {
  char *base;
  size_t size;
};

int mo_workspace_memory_create(struct mo_workspace_memory **memory)
{
  struct mo_workspace_memory *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  *memory = made;
  return MO_OK;
}

void mo_workspace_memory_free(struct mo_workspace_memory *memory)
{
  if (memory == NULL)
    return;
  free(memory->base);
  free(memory);
}

size_t mo_workspace_memory_bytes(const struct mo_workspace_memory *memory)
{
  return memory->size + sizeof(*memory);
}

static void *carve(char *base, size_t *used, size_t n, size_t size)
{
  void *piece = base != NULL ? base + *used : NULL;
  *used += (n * size + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
  return piece;
}

/* Places the scratch arrays of `run` from `base` on (NULL: only counts). Returns their size in
 * bytes. */
static size_t lay_out(struct mo_fast_run *run, char *base)
{
  const struct mo_pack *pack = run->pack;
  const size_t real = pack->real_bytes, panel = pack->panel, n_masses = run->body->n_masses;
  const size_t n_springs = run->body->n_springs,
               springs_padded = (n_springs + panel - 1) / panel * panel;
  size_t used = 0;
  for (int i = 0; i < 2; i++)
    run->position[i] = carve(base, &used, n_masses * 3 * MO_LANES, real);
  run->velocity = carve(base, &used, n_masses * 3 * MO_LANES, real);
  run->start = carve(base, &used, n_masses * 3, sizeof(double));
  run->spring_ends = carve(base, &used, n_springs * 2, sizeof(uint32_t));
  run->spring_rest = carve(base, &used, n_springs, real);
  run->activation = carve(base, &used, 2 * MO_LANES * panel, real);
  run->terrain = carve(base, &used, (size_t)MO_LANES * MO_CELLS * 4, real);
  if (!pack->passive) {
    run->sensor = carve(base, &used, n_masses * MO_LANES, real);
    run->hidden = carve(base, &used, (size_t)2 * MO_LANES * MO_HIDDEN, real);
    run->input_weight = carve(base, &used, n_masses * MO_HIDDEN, real);
    run->output_weight = carve(base, &used, springs_padded * MO_HIDDEN, real);
    run->output_bias = carve(base, &used, springs_padded, real);
  }
  return used;
}

static int reserve(struct mo_workspace_memory *memory, size_t bytes)
{
  if (bytes <= memory->size)
    return MO_OK;
  char *larger = aligned_alloc(ALIGNMENT, bytes);
  if (larger == NULL)
    return MO_ERR_NO_MEMORY;
  free(memory->base);
  memory->base = larger;
  memory->size = bytes;
  return MO_OK;
}

int mo_rollout_block(struct mo_workspace_memory *memory, const struct mo_pack *pack,
                     const struct mo_body *body, const struct mo_environment *const *environments,
                     uint32_t n_environments, const struct mo_physics *physics,
                     const struct mo_recording *recordings, const struct mo_pause_point *pause,
                     struct mo_outcome *outcomes)
{
  if (n_environments < 1 || n_environments > MO_BLOCK_LANES)
    return MO_ERR_RANGE;
  if (!pack->passive &&
      (pack->workspace.nx != body->workspace.nx || pack->workspace.ny != body->workspace.ny ||
       pack->workspace.nz != body->workspace.nz))
    return MO_ERR_INVALID;
  struct mo_fast_run run = {.pack = pack,
                            .body = body,
                            .environments = environments,
                            .n_environments = n_environments,
                            .physics = physics,
                            .recordings = recordings,
                            .pause = pause,
                            .outcomes = outcomes};
  const int status = reserve(memory, lay_out(&run, NULL));
  if (status < 0)
    return status;
  lay_out(&run, memory->base);
  return mo_fast_find(pack->isa, pack->precision)(&run);
}
