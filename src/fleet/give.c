/* give.c: see give.h. */
#include "fleet/give.h"

#include "fleet/checks.h"
#include "fleet/content.h"

#define FIRST_STEPS        16000   /* rollout steps per thread in the first lease: about 40 ms */
#define FIRST_DEVICE_STEPS 2000000 /* per device */
#define GROWTH             8       /* factor by which a lease may exceed the previous one */
#define LEAST_S            0.05    /* duration of a lease near the end of a queue */
/* Time that a late lease waits for a session of suitable size. */
#define PATIENCE_NS      (10 * MO_S_NS)
#define SCANNED          64
#define READY_S          4.0
#define READY_BLOCKS_MAX (1u << 17)
#define OFFERED_MAX      256 /* threads and devices counted before a session is measured */

/* ---- sizes ---- */

/* The rollout steps of a session's next lease: `most`, or fewer if less work is waiting. `share` is
 * this session's share of the waiting work. */
struct size {
  uint64_t most, least;
  double share;
};

/* The threads and devices that a session reports are not verified, so they are capped. */
static uint64_t first_steps(const struct mo_session *session, enum mo_back_end back_end)
{
  const uint64_t steps = back_end == MO_ON_DEVICE ? FIRST_DEVICE_STEPS : FIRST_STEPS;
  const uint32_t n = back_end == MO_ON_DEVICE ? session->offer.n_devices : session->offer.n_threads;
  return steps * (n < OFFERED_MAX ? n : OFFERED_MAX);
}

static struct size size_of(const struct mo_fleet *fleet, const struct mo_session *session,
                           enum mo_back_end back_end)
{
  const struct mo_class *class = &fleet->classes[back_end];
  const double rate = mo_session_rate(session, back_end);
  if (rate <= 0)
    return (struct size){first_steps(session, back_end), 1, 1.0 / class->n_sessions};
  const double steps = rate * MO_FLEET_LEASE_S;
  const uint64_t grown = GROWTH * session->pace[back_end].lease_steps;
  return (struct size){steps < (double)grown ? (uint64_t)steps : grown, (uint64_t)(rate * LEAST_S),
                       rate < class->steps_per_s ? rate / class->steps_per_s : 1.0};
}

/* Returns half of the session's share of the waiting work. Leases become smaller toward the end of
 * a queue, so that all sessions finish at about the same time. */
static uint64_t spread(const struct mo_fleet_source *source, enum mo_back_end back_end,
                       const struct size *size)
{
  const double part = 0.5 * size->share * (double)source->waiting(source->compute, back_end);
  uint64_t steps = part < (double)size->most ? (uint64_t)part : size->most;
  return steps > size->least ? steps : size->least;
}

uint32_t mo_give_wanted(const struct mo_fleet *fleet, enum mo_back_end back_end)
{
  const struct mo_class *class = &fleet->classes[back_end];
  const struct mo_session *session;
  double steps = 0;
  TAILQ_FOREACH(session, &fleet->sessions, all)
  {
    if (session->state != MO_SESSION_ACTIVE || !session->serves[back_end])
      continue;
    const double rate = mo_session_rate(session, back_end);
    steps += rate > 0 ? READY_S * rate : (double)(4 * first_steps(session, back_end));
  }
  const double blocks = steps / class->block_steps;
  return blocks < READY_BLOCKS_MAX ? (uint32_t)blocks + (steps > 0) : READY_BLOCKS_MAX;
}

/* ---- existing leases ---- */

static bool fits(const struct mo_fleet *fleet, const struct mo_lease *lease,
                 const struct mo_session *session, uint64_t now_ns)
{
  const struct size size = size_of(fleet, session, lease->content.back_end);
  return lease->steps <= GROWTH * size.most ||
         (lease->is_listed && now_ns > lease->listed_ns + PATIENCE_NS);
}

/* A lease with suspects is not repeated: its blocks are put back first, and then leased among fewer
 * bodies. It often takes a long time to detect that a session is lost, so if such leases were
 * repeated, some session would always hold the lease. */
static bool may_repeat(const struct mo_fleet *fleet, const struct mo_lease *lease,
                       const struct mo_session *session)
{
  bool is_suspect = false;
  if (lease->content.n_parameters > 0)
    return true;
  if (lease->is_only && lease->content.n_blocks == 1)
    return session == NULL || mo_session_is_free(session);
  return mo_suspects_limit(&fleet->suspects, &lease->content, &is_suspect) == UINT32_MAX;
}

static struct mo_lease *find_listed(struct mo_fleet *fleet, const struct mo_session *session,
                                    enum mo_back_end back_end, uint64_t now_ns)
{
  struct mo_lease *lease;
  TAILQ_FOREACH(lease, &fleet->classes[back_end].listed, listed)
  {
    if (mo_lease_held_by(lease, session) >= 0 || lease->n_holds == MO_HOLDS)
      continue;
    if (lease->parcel != NULL
            ? fits(fleet, lease, session, now_ns) && may_repeat(fleet, lease, session)
            : mo_check_suits(lease, session, now_ns))
      return lease;
  }
  return NULL;
}

struct mo_lease *mo_give_overdue(struct mo_fleet *fleet, const struct mo_session *session,
                                 enum mo_back_end back_end, uint64_t now_ns)
{
  uint32_t seen = 0;
  struct mo_lease *lease;
  TAILQ_FOREACH(lease, &fleet->leases, all)
  {
    if (seen++ == SCANNED)
      return NULL;
    if (lease->content.back_end == back_end && lease->parcel != NULL && lease->n_holds == 1 &&
        !lease->is_listed && now_ns >= lease->holds[0].due_ns &&
        may_repeat(fleet, lease, session) &&
        (session == NULL ||
         (lease->holds[0].session != session && fits(fleet, lease, session, now_ns))))
      return lease;
  }
  return NULL;
}

/* ---- new leases ---- */

/* Splits taken blocks until there are at most n. Returns false if memory runs out. */
static bool trim(const struct mo_fleet_source *source, struct mo_taken *taken, uint32_t n)
{
  while (taken->n_blocks > n) {
    struct mo_taken *rest = source->split(source->compute, taken);
    if (rest == NULL)
      return false;
    source->put_back(source->compute, rest);
  }
  return true;
}

/* Copies the blocks that fit into a lease, and puts the rest back. */
static int copy(struct mo_fleet *fleet, struct mo_taken *taken, struct mo_wire_lease *content)
{
  const struct mo_fleet_source *source = &fleet->config.source;
  int error = mo_content_of(taken, content);
  while (error == MO_ERR_LIMIT && taken->n_blocks > 1 && trim(source, taken, taken->n_blocks / 2))
    error = mo_content_of(taken, content);
  return error;
}

/* Takes blocks and makes a lease from them. Called without the lock; returns with it. Returns NULL
 * if there are no blocks that workers can compute, or no memory. */
static struct mo_lease *take_lease(struct mo_fleet *fleet, enum mo_back_end back_end,
                                   uint64_t steps, struct mo_weights **weights)
{
  const struct mo_fleet_source *source = &fleet->config.source;
  struct mo_taken *taken = source->take(source->compute, back_end, steps);
  struct mo_wire_lease content = {0};
  struct mo_lease *lease = NULL;
  bool is_suspect = false, is_only = false;
  int error = taken == NULL ? MO_ERR_EXHAUSTED : copy(fleet, taken, &content);
  pthread_mutex_lock(&fleet->mutex);
  while (error == MO_OK && taken->shard == NULL) {
    const uint32_t limit = mo_suspects_limit(&fleet->suspects, &content, &is_suspect);
    is_only = limit != UINT32_MAX;
    if (limit >= content.n_blocks)
      break;
    pthread_mutex_unlock(&fleet->mutex);
    mo_wire_free_lease(&content);
    error = trim(source, taken, limit) ? copy(fleet, taken, &content) : MO_ERR_NO_MEMORY;
    pthread_mutex_lock(&fleet->mutex);
  }
  *weights = NULL;
  if (error == MO_OK && taken->controller != NULL &&
      (*weights = mo_weights_find(fleet, taken)) == NULL) {
    pthread_mutex_unlock(&fleet->mutex);
    error = mo_weights_create(taken, weights);
    pthread_mutex_lock(&fleet->mutex);
    *weights = error == MO_OK ? mo_weights_add(fleet, *weights) : NULL;
  }
  if (error == MO_OK && (lease = mo_lease_create(taken, &content)) != NULL) {
    lease->is_suspect = is_suspect;
    lease->is_only = is_only;
    return lease;
  }
  if (*weights != NULL && (*weights)->n_parcels == 0)
    (*weights)->identity = NULL; /* the address may be reused for another controller */
  mo_weights_release(fleet, *weights);
  if (taken == NULL)
    return NULL;
  mo_wire_free_lease(&content);
  pthread_mutex_unlock(&fleet->mutex);
  source->put_back(source->compute, taken);
  pthread_mutex_lock(&fleet->mutex);
  return NULL;
}

/* A session that holds a lease with a suspect gets no other lease. */
static bool has_room(const struct mo_session *session, enum mo_back_end back_end)
{
  for (uint32_t b = 0; b < 2; b++)
    if (session->n_held[b] > 0 && session->held[b][0]->is_only)
      return false;
  return session->state == MO_SESSION_ACTIVE &&
         session->n_held[back_end] + session->n_taking[back_end] < MO_FLEET_LEASES;
}

/* Returns the session, or NULL if it ended. *number: the number of the new lease, or 0 if there is
 * none. */
static struct mo_session *give_new(struct mo_fleet *fleet, struct mo_session *session,
                                   enum mo_back_end back_end, uint64_t now_ns,
                                   struct mo_after *after, uint64_t *number)
{
  const struct size size = size_of(fleet, session, back_end);
  const uint64_t id = session->id;
  struct mo_weights *weights = NULL;
  session->n_taking[back_end]++;
  fleet->classes[back_end].may_have_work = false; /* set again when more work arrives */
  pthread_mutex_unlock(&fleet->mutex);
  const uint64_t steps = spread(&fleet->config.source, back_end, &size);
  struct mo_lease *lease = take_lease(fleet, back_end, steps, &weights);
  *number = 0;
  session = mo_session_find(fleet, id);
  if (session != NULL)
    session->n_taking[back_end]--;
  if (lease == NULL)
    return session;
  fleet->classes[back_end].may_have_work = true;
  mo_lease_insert(fleet, lease, weights);
  if (session == NULL || session->state != MO_SESSION_ACTIVE ||
      (lease->is_only && !mo_session_is_free(session))) {
    mo_lease_end(fleet, lease, after); /* its blocks are put back */
    return session;
  }
  mo_lease_hold(fleet, lease, session, now_ns);
  *number = lease->number;
  return session;
}

static bool is_second(const struct mo_session *session, enum mo_back_end back_end)
{
  return session->n_held[back_end] + session->n_taking[back_end] > 0;
}

struct mo_session *mo_give(struct mo_fleet *fleet, struct mo_session *session,
                           enum mo_back_end back_end, uint64_t now_ns, struct mo_after *after,
                           uint64_t *numbers, uint32_t *n)
{
  struct mo_class *class = &fleet->classes[back_end];
  while (session != NULL && has_room(session, back_end)) {
    struct mo_lease *lease = find_listed(fleet, session, back_end, now_ns);
    uint64_t number = 0;
    if (lease == NULL && is_second(session, back_end) && !TAILQ_EMPTY(&class->idle))
      break; /* a session that holds nothing has precedence */
    if (lease == NULL) {
      session = give_new(fleet, session, back_end, now_ns, after, &number);
      if (session == NULL)
        return NULL;
      /* It may have been refused or drained in the meantime. */
      if (number == 0 && session->state == MO_SESSION_ACTIVE && session->n_held[back_end] == 0)
        lease = mo_give_overdue(fleet, session, back_end, now_ns);
    }
    if (lease != NULL) {
      if (lease->parcel == NULL)
        mo_check_fit(fleet, lease, size_of(fleet, session, back_end).most);
      fleet->counts.leases_again += lease->parcel != NULL;
      mo_lease_hold(fleet, lease, session, now_ns);
      number = lease->number;
    }
    if (number == 0)
      break;
    numbers[(*n)++] = number;
  }
  /* If more work may be left, two other sessions are woken, which then wake the next ones. */
  if (session != NULL && *n > 0 && class->may_have_work)
    for (uint32_t i = 0; i < 2; i++)
      mo_class_wake(fleet, back_end, after);
  return session;
}
