/* decide.c: see decide.h. The thread reads the lease and never takes the mutex. This is safe
 * because a lease that is being decided is in no list, and no other code frees it. */
#include "fleet/decide.h"

#define RETRY_NS (2 * MO_S_NS) /* wait after an error */

static void *compute(void *context)
{
  struct mo_fleet *fleet = context;
  const struct mo_fleet_source *source = &fleet->config.source;
  struct mo_decision *decision = &fleet->decision;
  const struct mo_weights *weights = decision->lease->weights;
  decision->error = source->recompute(
      source->compute, fleet->config.workspace, &decision->lease->content,
      weights != NULL ? weights->file.bytes : NULL, weights != NULL ? weights->file.size : 0,
      &decision->cancel, decision->losses, decision->diverged_steps, decision->measures);
  atomic_store(&decision->is_done, true);
  return NULL;
}

/* Takes the lease out of its list. */
static int begin(struct mo_fleet *fleet, struct mo_lease *lease)
{
  struct mo_decision *decision = &fleet->decision;
  mo_lease_unlist(fleet, lease);
  lease->is_deciding = true;
  decision->lease = lease;
  atomic_store(&decision->is_done, false);
  return mo_thread_create(&decision->thread, "decide", compute, fleet) == 0 ? MO_OK
                                                                            : MO_ERR_NO_MEMORY;
}

static void end(struct mo_fleet *fleet, int error, uint64_t now_ns, struct mo_after *after)
{
  struct mo_decision *decision = &fleet->decision;
  struct mo_lease *lease = decision->lease;
  const uint64_t listed_ns = lease->listed_ns;
  decision->lease = NULL;
  lease->is_deciding = false;
  if (error == MO_OK) {
    mo_check_decide(fleet, lease, decision->losses, decision->diverged_steps, decision->measures,
                    now_ns, after);
    return;
  }
  decision->retry_ns = now_ns + RETRY_NS;
  mo_lease_list(fleet, lease, now_ns, after);
  lease->listed_ns = listed_ns; /* the lease keeps its age, so it is eventually given up */
}

void mo_decide_tick(struct mo_fleet *fleet, uint64_t now_ns, struct mo_after *after)
{
  struct mo_decision *decision = &fleet->decision;
  if (decision->lease != NULL && atomic_load(&decision->is_done)) {
    pthread_join(decision->thread, NULL);
    end(fleet, decision->error, now_ns, after);
  }
  struct mo_lease *next = TAILQ_FIRST(&fleet->disputed);
  if (decision->lease != NULL || next == NULL || now_ns < decision->retry_ns)
    return;
  const int error = begin(fleet, next);
  if (error != MO_OK)
    end(fleet, error, now_ns, after);
}

void mo_decide_end(struct mo_fleet *fleet)
{
  struct mo_decision *decision = &fleet->decision;
  if (decision->lease == NULL)
    return;
  __atomic_store_n(&decision->cancel, 1, __ATOMIC_RELAXED);
  pthread_join(decision->thread, NULL);
  decision->lease->is_deciding = false;
  decision->lease = NULL;
}
