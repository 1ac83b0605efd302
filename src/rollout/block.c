/* block.c: the scratch memory of one worker, and the code between mo_rollout_block and the kernels.
 *
 * The scratch memory is one allocation that grows to the size of the largest body so far. A block
 * whose body fits allocates nothing. */
#include "rollout/carve.h"
#include "rollout/fast.h"
#include "rollout/measuring.h"
#include "rollout/scene.h"
#include "rollout/window.h"

#include <stdlib.h>
#include <string.h>

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
  run->keeps = run->blends || run->control_steps > 1 || run->from != NULL || run->to != NULL;
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

/* Checks the states that a block starts from. */
static int check_states(const struct mo_fast_run *run)
{
  const struct mo_state *from = run->from;
  for (uint32_t e = 0; from != NULL && e < run->n_environments; e++) {
    const int status = mo_window_check(&from[e], run->body, run->environments[e], run->physics,
                                       run->pack->precision, run->needs[e], NULL);
    if (status != MO_OK || from[e].step != from[0].step)
      return status != MO_OK ? status : MO_ERR_INVALID;
  }
  return MO_OK;
}

static bool is_cut(const struct mo_state *state)
{
  return memchr(state->cut, 1, state->n_springs) != NULL;
}

int mo_rollout_block_window(struct mo_workspace_memory *memory, const struct mo_pack *pack,
                            const struct mo_body *body,
                            const struct mo_environment *const *environments,
                            uint32_t n_environments, const struct mo_physics *physics,
                            const struct mo_states *states, const struct mo_recording *recordings,
                            const struct mo_measuring *measuring,
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
                            .from = states != NULL ? states->from : NULL,
                            .to = states != NULL ? states->to : NULL,
                            .recordings = recordings,
                            .measuring = measuring,
                            .pause = pause,
                            .outcomes = outcomes};
  const struct mo_window window = mo_window_of(&physics->scheme, run.from);
  run.first_step = window.first_step;
  run.control_steps = window.control_steps;
  if (run.control_steps == 0)
    return MO_ERR_INVALID;
  for (uint32_t e = 0; e < n_environments; e++) {
    run.constants[e] = mo_scene_constants(environments[e], physics);
    run.breaks |= environments[e]->damage.cut != 0 || (run.from != NULL && is_cut(&run.from[e]));
    run.needs[e] = mo_observations_for(&environments[e]->task, measuring);
    run.observations |= run.needs[e];
  }
  int status = check_states(&run);
  if (status != MO_OK)
    return status;
  status = reserve(memory, lay_out(&run, NULL));
  if (status < 0)
    return status;
  lay_out(&run, memory->base);
  return mo_fast_find(pack->isa, pack->precision)(&run);
}

int mo_rollout_block(struct mo_workspace_memory *memory, const struct mo_pack *pack,
                     const struct mo_body *body, const struct mo_environment *const *environments,
                     uint32_t n_environments, const struct mo_physics *physics,
                     const struct mo_recording *recordings, const struct mo_measuring *measuring,
                     const struct mo_pause_point *pause, struct mo_outcome *outcomes)
{
  return mo_rollout_block_window(memory, pack, body, environments, n_environments, physics, NULL,
                                 recordings, measuring, pause, outcomes);
}
