/* gradient_block.c: the gradient of a block of robots, one after the other in float64 by mo_gradient_reference, rounded to
 * float32 at the end. */
#include <morpho/gradient.h>

#include "rollout/reference.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

struct mo_gradient_pack {
  struct mo_controller *controller;
  enum mo_isa isa;
};

struct mo_gradient_memory {
  size_t budget_bytes;
  size_t n;
  double *sum; /* (n) */
};

static bool same_workspace(struct mo_workspace a, struct mo_workspace b)
{
  return a.nx == b.nx && a.ny == b.ny && a.nz == b.nz;
}

int mo_gradient_pack_create(const struct mo_controller *controller, enum mo_isa isa, struct mo_gradient_pack **ret)
{
  if ((unsigned)isa >= MO_ISA_COUNT || isa > mo_isa_best())
    return MO_ERR_UNSUPPORTED;
  struct mo_gradient_pack *pack = calloc(1, sizeof(*pack));
  if (pack == NULL)
    return MO_ERR_NO_MEMORY;
  pack->isa = isa;
  int status = mo_controller_create(controller->workspace, controller->sensor, &pack->controller);
  if (status == MO_OK)
    status = mo_gradient_pack_update(pack, controller);
  if (status != MO_OK) {
    mo_gradient_pack_free(pack);
    return status;
  }
  *ret = pack;
  return MO_OK;
}

int mo_gradient_pack_update(struct mo_gradient_pack *pack, const struct mo_controller *controller)
{
  if (!same_workspace(pack->controller->workspace, controller->workspace) ||
      pack->controller->sensor != controller->sensor)
    return MO_ERR_UNSUPPORTED;
  memcpy(pack->controller->parameters, controller->parameters, controller->n_parameters * sizeof(float));
  return MO_OK;
}

void mo_gradient_pack_free(struct mo_gradient_pack *pack)
{
  if (pack == NULL)
    return;
  mo_controller_free(pack->controller);
  free(pack);
}

size_t mo_gradient_pack_bytes(const struct mo_gradient_pack *pack)
{
  return sizeof(*pack) + pack->controller->n_parameters * sizeof(float);
}

int mo_gradient_memory_create(size_t budget_bytes, struct mo_gradient_memory **memory)
{
  struct mo_gradient_memory *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->budget_bytes = budget_bytes;
  *memory = made;
  return MO_OK;
}

void mo_gradient_memory_free(struct mo_gradient_memory *memory)
{
  if (memory == NULL)
    return;
  free(memory->sum);
  free(memory);
}

size_t mo_gradient_memory_bytes(const struct mo_gradient_memory *memory)
{
  return sizeof(*memory) + memory->n * sizeof(double);
}

int mo_gradient_arrange(const struct mo_robot *robots, size_t n, uint32_t *order)
{
  (void)robots;
  for (size_t i = 0; i < n; i++)
    order[i] = (uint32_t)i;
  return MO_OK;
}

static double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

int mo_gradient_block(struct mo_gradient_memory *memory, const struct mo_gradient_pack *pack,
                      const struct mo_robot *robots, uint32_t n, const struct mo_physics *physics,
                      const struct mo_gradient_options *options, const struct mo_pause_point *pause,
                      struct mo_gradient_profile *profile, struct mo_outcome *outcomes, float *d_parameters,
                      struct mo_gradient_counts *counts)
{
  const size_t n_parameters = pack->controller->n_parameters;
  if (n < 1 || n > MO_GRADIENT_ROBOTS)
    return MO_ERR_INVALID;
  for (uint32_t i = 0; i < n; i++)
    if (!same_workspace(robots[i].body->workspace, pack->controller->workspace))
      return MO_ERR_INVALID;
  if (memory->n < n_parameters) {
    double *larger = realloc(memory->sum, n_parameters * sizeof(double));
    if (larger == NULL)
      return MO_ERR_NO_MEMORY;
    memory->sum = larger;
    memory->n = n_parameters;
  }
  memset(memory->sum, 0, n_parameters * sizeof(double));
  const double start_s = now_s();
  for (uint32_t i = 0; i < n; i++) {
    const int status = mo_gradient_reference(robots[i].body, pack->controller, robots[i].environment, physics, options,
                                             outcomes + i, memory->sum, counts);
    if (status != MO_OK)
      return status;
    if (pause != NULL && pause->interval > 0 && pause->reached(pause->context) != 0)
      return MO_ERR_CANCELLED;
  }
  for (size_t i = 0; i < n_parameters; i++)
    d_parameters[i] = (float)memory->sum[i];
  if (profile != NULL) {
    profile->parameters_s += now_s() - start_s;
    profile->robot_steps += (uint64_t)n * physics->n_steps;
  }
  return MO_OK;
}
