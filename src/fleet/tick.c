/* tick.c: handles everything that depends on time: silence, late leases, cancellation, and waking
 * sessions. */
#include "fleet/decide.h"
#include "fleet/give.h"

#define STALE_NS    (30 * MO_S_NS)  /* an audit that no session has computed by then is dropped */
#define DISPUTED_NS (600 * MO_S_NS) /* the same for a disputed audit */
#define WAKES       4               /* sessions woken per tick and back end; each wakes others */

/* ---- sessions ---- */

static void end_silent(struct mo_fleet *fleet, uint64_t now_ns, struct mo_after *after)
{
  double rates[2] = {0, 0};
  struct mo_session *next;
  for (struct mo_session *session = TAILQ_FIRST(&fleet->sessions); session != NULL;
       session = next) {
    next = TAILQ_NEXT(session, all);
    if (now_ns > session->heard_ns && now_ns - session->heard_ns > fleet->silence_ns) {
      mo_session_end(fleet, session, MO_SESSION_LOST, "it stopped responding", now_ns, after);
      continue;
    }
    if (session->state != MO_SESSION_ACTIVE)
      continue;
    if (session->rest_ns != 0 && now_ns >= session->rest_ns) {
      session->rest_ns = 0;
      mo_after_wake(after, session->id);
    }
    for (uint32_t b = 0; b < 2; b++)
      if (session->serves[b])
        rates[b] += mo_session_rate(session, (enum mo_back_end)b);
  }
  for (uint32_t b = 0; b < 2; b++)
    fleet->classes[b].steps_per_s = rates[b];
}

/* ---- leases ---- */

/* Ends the holds of sessions that have kept a lease, or a check, for far too long. Returns false if
 * the lease was freed. */
static bool check_holds(struct mo_fleet *fleet, struct mo_lease *lease, uint64_t now_ns,
                        struct mo_after *after)
{
  for (uint32_t i = lease->n_holds; i-- > 0;) {
    struct mo_hold *hold = &lease->holds[i];
    if (now_ns >= hold->end_ns || (lease->parcel == NULL && now_ns >= hold->late_ns)) {
      mo_lease_drop(lease, hold->session, after);
      if (!mo_lease_release(fleet, lease, i, true, now_ns, after))
        return false;
    } else if (!hold->is_late && now_ns >= hold->late_ns) {
      hold->is_late = true;
      mo_lease_list(fleet, lease, now_ns, after);
    }
  }
  return true;
}

static void check_leases(struct mo_fleet *fleet, uint64_t now_ns, struct mo_after *after)
{
  const struct mo_fleet_source *source = &fleet->config.source;
  struct mo_lease *next;
  for (struct mo_lease *lease = TAILQ_FIRST(&fleet->leases); lease != NULL; lease = next) {
    next = TAILQ_NEXT(lease, all);
    if (lease->is_deciding)
      continue;
    if (lease->parcel != NULL && source->is_cancelled(lease->parcel->taken)) {
      mo_lease_deliver(lease, &(struct mo_remote_result){.status = MO_ERR_CANCELLED}, after);
      mo_lease_end(fleet, lease, after);
    } else if (check_holds(fleet, lease, now_ns, after) && lease->parcel == NULL &&
               lease->is_listed &&
               now_ns > lease->listed_ns + (lease->is_disputed ? DISPUTED_NS : STALE_NS)) {
      mo_lease_end(fleet, lease, after);
    }
  }
}

/* ---- waking ---- */

static void wake_waiting(struct mo_fleet *fleet, uint64_t now_ns, struct mo_after *after)
{
  const bool arrived = atomic_exchange(&fleet->arrived, false);
  for (uint32_t b = 0; b < 2; b++) {
    struct mo_class *class = &fleet->classes[b];
    const enum mo_back_end back_end = (enum mo_back_end)b;
    class->may_have_work |= arrived;
    for (uint32_t i = 0; i < WAKES && class->may_have_work; i++)
      mo_class_wake(fleet, back_end, after);
    if (!class->may_have_work &&
        (!TAILQ_EMPTY(&class->listed) ||
         (!TAILQ_EMPTY(&class->idle) && mo_give_overdue(fleet, NULL, back_end, now_ns) != NULL)))
      mo_class_wake(fleet, back_end, after);
  }
}

/* ---- tick ---- */

void mo_fleet_arrived(struct mo_fleet *fleet)
{
  atomic_store(&fleet->arrived, true);
}

void mo_fleet_tick(struct mo_fleet *fleet, uint64_t now_ns)
{
  const struct mo_fleet_source *source = &fleet->config.source;
  struct mo_after after = {0};
  uint32_t wanted[2];
  bool has_changed[2];
  pthread_mutex_lock(&fleet->mutex);
  end_silent(fleet, now_ns, &after);
  check_leases(fleet, now_ns, &after);
  wake_waiting(fleet, now_ns, &after);
  mo_decide_tick(fleet, now_ns, &after);
  for (uint32_t b = 0; b < 2; b++) {
    struct mo_class *class = &fleet->classes[b];
    wanted[b] = mo_give_wanted(fleet, (enum mo_back_end)b);
    const uint32_t change =
        wanted[b] > class->wanted ? wanted[b] - class->wanted : class->wanted - wanted[b];
    has_changed[b] = change > class->wanted / 10 || (wanted[b] == 0 && change > 0);
    if (has_changed[b])
      class->wanted = wanted[b];
  }
  pthread_mutex_unlock(&fleet->mutex);
  for (uint32_t b = 0; b < 2; b++)
    if (has_changed[b])
      source->want(source->compute, (enum mo_back_end)b, wanted[b]);
  mo_after_run(fleet, &after);
}
