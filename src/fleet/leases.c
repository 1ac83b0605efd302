/* leases.c: see leases.h. */
#include "fleet/leases.h"

#include <stdlib.h>

/* Multiple of the expected time after which another session gets the lease. */
#define LATE    5
#define LATE_NS (2 * MO_S_NS)
/* Multiple of the expected time after which the session loses the lease. */
#define HUNG                20
#define HUNG_NS             (60 * MO_S_NS)
#define UNKNOWN_STEPS_PER_S 1e5  /* per thread, for a session that was not measured */
#define GRADIENT_COST       27   /* cost of a gradient step, in rollout steps */
#define MEAN_PART           0.05 /* weight of a new lease in the mean block size */

static uint64_t later(uint64_t now_ns, double seconds, uint64_t least_ns)
{
  const uint64_t ns = seconds < 1e6 ? (uint64_t)(seconds * 1e9) : 1000000 * MO_S_NS;
  return now_ns + (ns > least_ns ? ns : least_ns);
}

/* ---- the table ---- */

struct mo_lease *mo_lease_create(struct mo_taken *taken, struct mo_wire_lease *content)
{
  struct mo_lease *lease = calloc(1, sizeof(*lease));
  struct mo_parcel *parcel = calloc(1, sizeof(*parcel));
  if (lease == NULL || parcel == NULL) {
    free(lease);
    free(parcel);
    return NULL;
  }
  parcel->taken = taken;
  lease->parcel = parcel;
  lease->content = *content;
  lease->steps = (uint64_t)content->n_rows * content->physics.scheme.n_steps;
  if (content->n_parameters > 0)
    lease->steps *= GRADIENT_COST;
  return lease;
}

static void give_number(struct mo_fleet *fleet, struct mo_lease *lease)
{
  lease->number = fleet->next_lease++;
  lease->content.id = (struct mo_lease_id){fleet->config.epoch, lease->number};
  LIST_INSERT_HEAD(&fleet->leases_by_number[lease->number % MO_LEASE_BUCKETS], lease, by_number);
}

void mo_lease_insert(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_weights *weights)
{
  struct mo_class *class = &fleet->classes[lease->content.back_end];
  const double block_steps = (double)lease->steps / lease->content.n_blocks;
  class->block_steps += MEAN_PART * (block_steps - class->block_steps);
  lease->weights = weights;
  if (weights != NULL) {
    weights->n_parcels++;
    lease->content.controller = weights->hash;
  }
  give_number(fleet, lease);
  TAILQ_INSERT_TAIL(&fleet->leases, lease, all);
}

struct mo_lease *mo_lease_find(struct mo_fleet *fleet, uint64_t number)
{
  struct mo_lease *lease = LIST_FIRST(&fleet->leases_by_number[number % MO_LEASE_BUCKETS]);
  while (lease != NULL && lease->number != number)
    lease = LIST_NEXT(lease, by_number);
  return lease;
}

void mo_lease_renumber(struct mo_fleet *fleet, struct mo_lease *lease)
{
  LIST_REMOVE(lease, by_number);
  give_number(fleet, lease);
}

/* ---- who holds it ---- */

int mo_lease_held_by(const struct mo_lease *lease, const struct mo_session *session)
{
  for (uint32_t i = 0; i < lease->n_holds; i++)
    if (lease->holds[i].session == session)
      return (int)i;
  return MO_ERR_NOT_FOUND;
}

double mo_session_rate(const struct mo_session *session, enum mo_back_end back_end)
{
  const struct mo_pace *pace = &session->pace[back_end];
  return pace->s > 0 ? pace->steps / pace->s : 0;
}

bool mo_session_is_free(const struct mo_session *session)
{
  return session->n_held[0] + session->n_taking[0] + session->n_held[1] + session->n_taking[1] == 0;
}

void mo_lease_hold(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                   uint64_t now_ns)
{
  const enum mo_back_end back_end = lease->content.back_end;
  const double rate = mo_session_rate(session, back_end);
  uint64_t steps = lease->steps;
  for (uint32_t i = 0; i < session->n_held[back_end]; i++)
    steps += session->held[back_end][i]->steps;
  double expected_s = (double)steps / rate;
  if (rate <= 0) {
    expected_s = back_end == MO_ON_CPU && session->offer.n_threads > 0
                     ? (double)steps / (UNKNOWN_STEPS_PER_S * session->offer.n_threads)
                     : 0;
    if (expected_s < MO_FLEET_LEASE_S)
      expected_s = MO_FLEET_LEASE_S;
  }
  mo_lease_unlist(fleet, lease);
  lease->holds[lease->n_holds++] =
      (struct mo_hold){.session = session,
                       .given_ns = now_ns,
                       .due_ns = later(now_ns, expected_s, MO_S_NS / 10),
                       .late_ns = later(now_ns, LATE * expected_s, LATE_NS),
                       .end_ns = later(now_ns, HUNG * expected_s, HUNG_NS)};
  session->held[back_end][session->n_held[back_end]++] = lease;
}

void mo_lease_unhold(struct mo_lease *lease, uint32_t place)
{
  struct mo_session *session = lease->holds[place].session;
  const enum mo_back_end back_end = lease->content.back_end;
  struct mo_lease **held = session->held[back_end];
  uint32_t i = 0;
  while (held[i] != lease)
    i++;
  for (session->n_held[back_end]--; i < session->n_held[back_end]; i++)
    held[i] = held[i + 1];
  lease->holds[place] = lease->holds[--lease->n_holds];
}

void mo_lease_drop(const struct mo_lease *lease, struct mo_session *session, struct mo_after *after)
{
  if (session->n_dropped < MO_DROPPED_MAX)
    session->dropped[session->n_dropped++] = lease->content.id;
  mo_after_wake(after, session->id);
}

void mo_class_wake(struct mo_fleet *fleet, enum mo_back_end back_end, struct mo_after *after)
{
  struct mo_class *class = &fleet->classes[back_end];
  struct mo_session *session = TAILQ_FIRST(&class->idle);
  if (session == NULL && (session = TAILQ_FIRST(&class->busy)) == NULL)
    return;
  mo_session_wait(session, back_end, NULL);
  mo_after_wake(after, session->id);
}

void mo_session_wait(struct mo_session *session, enum mo_back_end back_end, struct mo_class *class)
{
  struct mo_session_list *list = NULL;
  if (class != NULL)
    list = session->n_held[back_end] > 0 ? &class->busy : &class->idle;
  if (session->waits_in[back_end] != NULL)
    TAILQ_REMOVE(session->waits_in[back_end], session, waiting[back_end]);
  if (list != NULL)
    TAILQ_INSERT_TAIL(list, session, waiting[back_end]);
  session->waits_in[back_end] = list;
}

void mo_lease_list(struct mo_fleet *fleet, struct mo_lease *lease, uint64_t now_ns,
                   struct mo_after *after)
{
  if (lease->is_listed)
    return;
  lease->is_listed = true;
  lease->listed_ns = now_ns;
  if (lease->is_disputed) {
    TAILQ_INSERT_TAIL(&fleet->disputed, lease, listed);
    return;
  }
  TAILQ_INSERT_TAIL(&fleet->classes[lease->content.back_end].listed, lease, listed);
  mo_class_wake(fleet, lease->content.back_end, after);
}

void mo_lease_unlist(struct mo_fleet *fleet, struct mo_lease *lease)
{
  if (!lease->is_listed)
    return;
  lease->is_listed = false;
  TAILQ_REMOVE(lease->is_disputed ? &fleet->disputed
                                  : &fleet->classes[lease->content.back_end].listed,
               lease, listed);
}

/* ---- ends ---- */

static void free_lease(struct mo_fleet *fleet, struct mo_lease *lease)
{
  mo_lease_unlist(fleet, lease);
  LIST_REMOVE(lease, by_number);
  TAILQ_REMOVE(&fleet->leases, lease, all);
  fleet->n_checks -= lease->is_audit;
  for (uint32_t i = 0; i < lease->n_votes; i++) {
    free(lease->votes[i].losses);
    free(lease->votes[i].diverged_steps);
    free(lease->votes[i].measures);
  }
  mo_weights_release(fleet, lease->weights);
  mo_wire_free_lease(&lease->content);
  free(lease);
}

/* Wakes a session that may take a lease with a suspect. Other sessions would only put it back and
 * wake the next one. They look for work anyway once they hold nothing. */
static void wake_free(struct mo_fleet *fleet, enum mo_back_end back_end, struct mo_after *after)
{
  struct mo_session *session;
  TAILQ_FOREACH(session, &fleet->classes[back_end].idle, waiting[back_end])
  {
    if (!mo_session_is_free(session))
      continue;
    mo_session_wait(session, back_end, NULL);
    mo_after_wake(after, session->id);
    return;
  }
}

static void put_back(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_after *after)
{
  mo_weights_end_parcel(lease->weights);
  lease->parcel->is_kept = lease->is_kept;
  mo_after_put_back(after, lease->parcel);
  lease->parcel = NULL;
  if (lease->is_only) {
    wake_free(fleet, lease->content.back_end, after);
    return;
  }
  fleet->classes[lease->content.back_end].may_have_work = true;
  mo_class_wake(fleet, lease->content.back_end, after);
}

void mo_lease_deliver(struct mo_lease *lease, const struct mo_remote_result *result,
                      struct mo_after *after)
{
  mo_weights_end_parcel(lease->weights);
  mo_after_deliver(after, lease->parcel, result);
  lease->parcel = NULL;
}

void mo_lease_end(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_after *after)
{
  while (lease->n_holds > 0) {
    mo_lease_drop(lease, lease->holds[0].session, after);
    mo_lease_unhold(lease, 0);
  }
  if (lease->parcel != NULL)
    put_back(fleet, lease, after);
  free_lease(fleet, lease);
}

bool mo_lease_release(struct mo_fleet *fleet, struct mo_lease *lease, uint32_t place, bool is_lost,
                      uint64_t now_ns, struct mo_after *after)
{
  struct mo_session *session = lease->holds[place].session;
  bool is_proven = false, is_stubborn = false;
  session->leases_lost += is_lost;
  if (is_lost && lease->parcel != NULL && lease->content.n_parameters == 0)
    is_proven = mo_suspects_add(&fleet->suspects, &lease->content, session->id, session->worker,
                                lease->is_only, &is_stubborn);
  lease->is_kept |= is_stubborn;
  mo_lease_unhold(lease, place);
  if (lease->n_holds > 0 && !is_proven && !is_stubborn)
    return true;
  if (lease->parcel == NULL && lease->is_audit) {
    mo_lease_list(fleet, lease, now_ns, after);
    return true;
  }
  if (is_proven) {
    mo_suspects_clear(&fleet->suspects, &lease->content);
    mo_lease_deliver(lease, &(struct mo_remote_result){.status = MO_ERR_EXHAUSTED}, after);
  } else if (lease->parcel != NULL) {
    fleet->counts.leases_again++;
  }
  mo_lease_end(fleet, lease, after);
  return false;
}
