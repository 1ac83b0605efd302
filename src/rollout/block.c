/* block.c: the scratch memory of one worker, and the code between mo_rollout_block and the kernels.
 *
 * The scratch memory is one allocation that grows to the size of the largest body so far. A block
 * with a body that fits allocates nothing. */
#include "rollout/carve.h"
#include "rollout/fast.h"
#include "rollout/measuring.h"
#include "rollout/scene.h"

#include <stdlib.h>

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

/* Places the scratch arrays of `run`, starting at `base` (NULL: only computes the size). Returns
 * their size in bytes. */
static size_t lay_out(struct mo_fast_run *run, char *base)
{
  const struct mo_pack *pack = run->pack;
  const size_t real = pack->real_bytes, panel = pack->panel, n_masses = run->body->n_masses;
  const size_t n_springs = run->body->n_springs,
               springs_padded = (n_springs + panel - 1) / panel * panel;
  struct carver carver = {base, 0};
  for (int i = 0; i < 2; i++)
    run->position[i] = carve(&carver, n_masses * 3 * MO_LANES, real);
  const bool splits = run->physics->scheme.integrator == MO_INTEGRATOR_SPLIT;
  run->velocity = carve(&carver, n_masses * 3 * MO_LANES, real);
  run->coasted = carve(&carver, splits ? n_masses * 3 * MO_LANES : 0, real);
  run->blends = splits || (run->observations & MO_OBSERVE_SPRINGS) != 0;
  run->keeps = run->blends || run->control_steps > 1;
  run->start = carve(&carver, n_masses * 3, sizeof(double));
  run->spring_ends = carve(&carver, n_springs * 2, sizeof(uint32_t));
  run->spring_rest = carve(&carver, n_springs, real);
  run->intact = carve(&carver, run->breaks ? n_springs * MO_LANES : 0, real);
  run->cut = carve(&carver, run->breaks ? n_springs : 0, 1);
  run->activation = carve(&carver, MO_LANES * panel, real);
  run->held = carve(&carver, MO_LANES * (run->keeps ? springs_padded : panel), real);
  run->blended = carve(&carver, run->blends ? MO_LANES * panel : 0, real);
  run->contacts = carve(&carver, n_masses, sizeof(uint32_t));
  run->terrain = carve(&carver, (size_t)MO_LANES * MO_CELLS * 4, real);
  if (run->observations != 0) {
    run->rows = carve(&carver, n_masses, sizeof(*run->rows));
    run->turn_rows = carve(&carver, n_masses * 2, real);
    run->halves = carve(&carver, n_masses, sizeof(*run->halves));
    run->inverse_rest = carve(&carver, n_springs, real);
    run->inverted = carve(&carver, run->body->n_voxels, sizeof(uint32_t));
    run->corners = carve(&carver, (size_t)run->body->n_voxels * 8, sizeof(uint32_t));
  }
  if (!pack->passive) {
    run->sensor = carve(&carver, n_masses * MO_LANES, real);
    run->hidden = carve(&carver, (size_t)2 * MO_LANES * MO_HIDDEN, real);
    run->input_weight = carve(&carver, n_masses * MO_HIDDEN, real);
    run->output_weight = carve(&carver, springs_padded * MO_HIDDEN, real);
    run->output_bias = carve(&carver, springs_padded, real);
  }
  return carver.used;
}

static int reserve(struct mo_workspace_memory *memory, size_t bytes)
{
  if (bytes <= memory->size)
    return MO_OK;
  char *larger = aligned_alloc(MO_ALIGNMENT, bytes);
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
                     const struct mo_recording *recordings, const struct mo_measuring *measuring,
                     const struct mo_pause_point *pause, struct mo_outcome *outcomes)
{
  if (n_environments < 1 || n_environments > MO_BLOCK_LANES)
    return MO_ERR_RANGE;
  if (!pack->passive && !mo_workspace_equal(pack->workspace, body->workspace))
    return MO_ERR_INVALID;
  struct mo_fast_run run = {.pack = pack,
                            .body = body,
                            .environments = environments,
                            .n_environments = n_environments,
                            .physics = physics,
                            .control_steps = mo_control_steps(&physics->scheme),
                            .recordings = recordings,
                            .measuring = measuring,
                            .observations = measuring != NULL ? mo_observations(measuring->set) : 0,
                            .pause = pause,
                            .outcomes = outcomes};
  if (run.control_steps == 0)
    return MO_ERR_INVALID;
  for (uint32_t e = 0; e < n_environments; e++) {
    run.constants[e] = mo_scene_constants(environments[e], physics);
    run.breaks |= environments[e]->damage.cut != 0;
    if (mo_task_needs_work(&environments[e]->task))
      run.observations |= MO_OBSERVE_SPRINGS;
    run.observations |= mo_observations(mo_task_measures(&environments[e]->task));
  }
  const int status = reserve(memory, lay_out(&run, NULL));
  if (status < 0)
    return status;
  lay_out(&run, memory->base);
  return mo_fast_find(pack->isa, pack->precision)(&run);
}
