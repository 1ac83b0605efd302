/* gradient_pass.c: chooses the part of a plan that fits the device's memory at a time, and the
 * groups that two blocks compute. */
#include "compute/cuda/gradient_pass.h"

#include "compute/cuda/gradient_tape.h"

enum { N_PARAMETERS = 620912 };

/* The effect of computing groups in halves, fitted to the times of 1024 to 8192 robots on an H200:
 * the time of half a group, in hundredths of the group's (more if the kernel also has code for
 * whole groups), and the time of all multiprocessors, including waiting, in hundredths of the time
 * without waiting. */
struct measured {
  uint64_t half, packing;
};
static const struct measured whole = {100, 102}, halves = {64, 102}, mixed = {70, 104};

static uint64_t bytes_of(const struct mo_gradient_plan *plan, const struct mo_gradient_pass *p)
{
  return p->tape + 4 * p->sums + (uint64_t)(p->end_shard - p->first_shard) * N_PARAMETERS * 4 +
         plan->n_masses * 25 + plan->n_chunks * 128 +
         (plan->courses != NULL ? plan->n_rows * sizeof(*plan->courses) : 0) +
         (plan->cuts != NULL ? plan->n_chunks * sizeof(*plan->cuts) : 0) + ((uint64_t)16 << 20);
}

static void add_group(struct mo_gradient_pass *p, const struct mo_gp_group *g,
                      struct mo_gp_time time)
{
  const uint32_t shared = mo_gp_shared_bytes(g->n_rows, g->n_masses, g->n_outputs);
  p->tape += mo_gp_tape_bytes(g, time);
  p->sums += (mo_gp_sum_of(g).floats + 63) / 64 * 64;
  p->shared = p->shared > shared ? p->shared : shared;
}

bool mo_gradient_can_be_held(const struct mo_gradient_plan *plan, struct mo_gp_time time,
                             uint64_t most)
{
  struct mo_gradient_pass p = {0};
  for (uint32_t i = 0; i < plan->n_groups; i++) {
    const struct mo_gp_group *g = &plan->groups[i];
    if (i == 0 || g->shard != plan->groups[i - 1].shard)
      p = (struct mo_gradient_pass){
          .first = i, .end = i, .first_shard = g->shard, .end_shard = g->shard + 1};
    add_group(&p, g, time);
    if (mo_gp_tape_bytes(g, time) > UINT32_MAX || p.tape + 4 * p.sums > most)
      return false;
  }
  return plan->n_shards > 1 || bytes_of(plan, &p) <= most;
}

int mo_gradient_pass_next(struct mo_gradient_plan *plan, uint32_t first_shard, uint32_t first,
                          struct mo_gp_time time, uint64_t budget, struct mo_gradient_pass *ret)
{
  struct mo_gradient_pass p = {
      .first = first, .end = first, .first_shard = first_shard, .end_shard = first_shard};
  *ret = p;
  while (p.end < plan->n_groups) {
    const uint32_t shard = plan->groups[p.end].shard;
    for (; p.end < plan->n_groups && plan->groups[p.end].shard == shard; p.end++) {
      struct mo_gp_group *g = &plan->groups[p.end];
      g->tape_at = p.tape;
      g->sum_at = p.sums;
      add_group(&p, g, time);
    }
    p.end_shard = shard + 1;
    if (bytes_of(plan, &p) > budget)
      break;
    *ret = p;
  }
  return ret->end > first ? MO_OK : MO_ERR_NO_MEMORY;
}

/* In clocks per step, forward and backward, fitted to the times of 128 groups of random bodies (to
 * one hundredth, root mean square). All warps wait for the pair with the most springs and
 * masses. */
uint64_t mo_gradient_cost(const struct mo_gp_group *g)
{
  uint32_t most_chunks = 0, most_masses = 0;
  for (uint32_t w = 0; w < MO_GP_WARPS; w++) {
    const struct mo_gp_pair *pair = &g->pair[w];
    const uint32_t masses = pair->n_masses[0] + pair->n_masses[1];
    most_chunks = pair->n_chunks > most_chunks ? pair->n_chunks : most_chunks;
    most_masses = masses > most_masses ? masses : most_masses;
  }
  return 62000 + 580 * (uint64_t)g->n_outputs + 6 * (uint64_t)g->n_masses +
         360 * (uint64_t)most_chunks + 80 * (uint64_t)most_masses;
}

/* Returns when all groups are finished, in hundredths of a clock, if n_halved of the wide groups
 * are computed in halves. */
static uint64_t ends(const struct mo_gradient_load *loads, uint32_t n, uint32_t n_halved,
                     const struct measured *m, uint32_t multiprocessors)
{
  uint64_t longest = 0, sum = 0;
  for (uint32_t i = 0, halved = 0; i < n; i++) {
    const bool is_halved = loads[i].wide && halved < n_halved;
    const uint64_t walk = (is_halved ? m->half : 100) * loads[i].cost;
    longest = longest > walk ? longest : walk;
    sum += is_halved ? 2 * walk : walk;
    halved += is_halved;
  }
  const uint64_t all = sum / multiprocessors * m->packing / 100;
  return longest > all ? longest : all;
}

uint32_t mo_gradient_halved(const struct mo_gradient_load *loads, uint32_t n,
                            uint32_t multiprocessors)
{
  uint64_t soonest = UINT64_MAX;
  uint32_t n_wide = 0, ret = 0;
  if (n > 2 * multiprocessors) /* enough groups to keep all multiprocessors busy */
    return 0;
  for (uint32_t i = 0; i < n; i++)
    n_wide += loads[i].wide;
  for (uint32_t i = 0; i <= n_wide; i++) {
    const struct measured *m = i == 0 ? &whole : i == n_wide ? &halves : &mixed;
    const uint64_t end = ends(loads, n, i, m, multiprocessors);
    if (end < soonest) {
      soonest = end;
      ret = i;
    }
  }
  return ret;
}
