/* gradient_pass.c: what of a plan fits the device's memory at a time. */
#include "compute/cuda/gradient_pass.h"

enum { N_PARAMETERS = 620912 };

static uint64_t bytes_of(const struct mo_gradient_plan *plan, const struct mo_gradient_pass *p)
{
  return p->tape + 4 * p->sums + (uint64_t)(p->end_shard - p->first_shard) * N_PARAMETERS * 4 + plan->n_masses * 25 +
         plan->n_chunks * 128 + ((uint64_t)16 << 20);
}

static void add_group(struct mo_gradient_pass *p, const struct mo_gp_group *g, uint32_t n_steps)
{
  const uint32_t shared = mo_gp_shared_bytes(g->n_rows, g->n_masses, g->n_outputs);
  p->tape += mo_gp_tape_of(g, n_steps).bytes;
  p->sums += (mo_gp_sum_of(g).floats + 63) / 64 * 64;
  p->shared = p->shared > shared ? p->shared : shared;
}

bool mo_gradient_can_be_held(const struct mo_gradient_plan *plan, uint32_t n_steps, uint64_t most)
{
  struct mo_gradient_pass p = {0};
  for (uint32_t i = 0; i < plan->n_groups; i++) {
    const struct mo_gp_group *g = &plan->groups[i];
    if (i == 0 || g->shard != plan->groups[i - 1].shard)
      p = (struct mo_gradient_pass){.first = i, .end = i, .first_shard = g->shard, .end_shard = g->shard + 1};
    add_group(&p, g, n_steps);
    if (mo_gp_tape_of(g, n_steps).bytes > UINT32_MAX || p.tape + 4 * p.sums > most)
      return false;
  }
  return plan->n_shards > 1 || bytes_of(plan, &p) <= most;
}

int mo_gradient_pass_next(struct mo_gradient_plan *plan, uint32_t first_shard, uint32_t first, uint32_t n_steps,
                          uint64_t budget, struct mo_gradient_pass *ret)
{
  struct mo_gradient_pass p = {.first = first, .end = first, .first_shard = first_shard, .end_shard = first_shard};
  *ret = p;
  while (p.end < plan->n_groups) {
    const uint32_t shard = plan->groups[p.end].shard;
    for (; p.end < plan->n_groups && plan->groups[p.end].shard == shard; p.end++) {
      struct mo_gp_group *g = &plan->groups[p.end];
      g->tape_at = p.tape;
      g->sum_at = p.sums;
      add_group(&p, g, n_steps);
    }
    p.end_shard = shard + 1;
    if (bytes_of(plan, &p) > budget)
      break;
    *ret = p;
  }
  return ret->end > first ? MO_OK : MO_ERR_NO_MEMORY;
}

uint64_t mo_gradient_cost(const struct mo_gp_group *g)
{
  return 16 * ((uint64_t)g->n_outputs + 48) + g->n_chunks;
}
