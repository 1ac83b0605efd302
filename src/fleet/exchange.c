/* exchange.c: serves the requests of a session: an exchange, its orders, a controller. */
#include <string.h>

#include "fleet/give.h"
#include "fleet/results.h"

/* ---- exchange ---- */

/* Encodes the leases that the session still holds. If memory runs out, puts them back. */
static int encode(struct mo_fleet *fleet, struct mo_session *session, const uint64_t *numbers,
                  uint32_t n, uint64_t now_ns, struct mo_after *after, uint8_t **down,
                  size_t *down_size, uint32_t *n_leases)
{
  struct mo_wire_leases message = {0};
  struct mo_lease *leases[MO_WIRE_LEASES_MAX];
  for (uint32_t i = 0; i < n; i++) {
    struct mo_lease *lease = mo_lease_find(fleet, numbers[i]);
    if (lease == NULL || mo_lease_held_by(lease, session) < 0)
      continue;
    leases[message.n] = lease;
    message.items[message.n++] = lease->content;
  }
  int error = mo_wire_put_leases(&message, fleet->config.workspace, down, down_size);
  for (uint32_t i = 0; i < message.n && error != MO_OK; i++)
    (void)mo_lease_release(fleet, leases[i], (uint32_t)mo_lease_held_by(leases[i], session), false,
                           now_ns, after);
  *n_leases = message.n;
  return error;
}

/* Lets the session wait for work of each back end where it could hold more leases. */
static void wait_for_more(struct mo_fleet *fleet, struct mo_session *session)
{
  for (uint32_t b = 0; b < 2; b++)
    if (session->serves[b] && session->n_held[b] + session->n_taking[b] < MO_FLEET_LEASES)
      mo_session_wait(session, (enum mo_back_end)b, &fleet->classes[b]);
}

static int give(struct mo_fleet *fleet, struct mo_session *session, uint64_t now_ns,
                struct mo_after *after, uint8_t **down, size_t *down_size, uint32_t *n_leases)
{
  uint64_t numbers[MO_WIRE_LEASES_MAX];
  uint32_t n = 0;
  if (session->state == MO_SESSION_ACTIVE && now_ns >= session->rest_ns) {
    for (uint32_t b = 2; b-- > 0;)
      if (session != NULL && session->serves[b])
        session = mo_give(fleet, session, (enum mo_back_end)b, now_ns, after, numbers, &n);
    if (session == NULL)
      return MO_ERR_NOT_FOUND;
    if (session->state == MO_SESSION_ACTIVE)
      wait_for_more(fleet, session);
  }
  return encode(fleet, session, numbers, n, now_ns, after, down, down_size, n_leases);
}

/* Call it with the lock held; releases the lock while it calls the configured function. Assigns an
 * origin, a permanent row in the store, to the session just before its first result is delivered.
 * Returns the session. NULL: the session ended while the lock was free, or *error says why its
 * results are refused. */
static struct mo_session *name_origin(struct mo_fleet *fleet, struct mo_session *session,
                                      const struct mo_wire_results *results, int *error)
{
  const struct mo_fleet_config *config = &fleet->config;
  char origin[2 * MO_FLEET_NAME_BYTES + 2];
  const uint64_t id = session->id;
  int64_t number = 1;
  if (session->origin != 0 || !mo_results_count(fleet, session, results))
    return session;
  snprintf(origin, sizeof(origin), "%s@%s", session->offer.name, session->offer.host);
  if (config->origin != NULL) {
    pthread_mutex_unlock(&fleet->mutex);
    *error = config->origin(config->context, origin, &number);
    pthread_mutex_lock(&fleet->mutex);
  }
  session = *error == MO_OK ? mo_session_find(fleet, id) : NULL;
  if (session != NULL)
    session->origin = number;
  return session;
}

int mo_fleet_exchange(struct mo_fleet *fleet, uint64_t id, const uint8_t *up, size_t up_size,
                      uint64_t now_ns, uint8_t **down, size_t *down_size, uint32_t *n_leases,
                      struct mo_message *message)
{
  struct mo_after after = {0};
  struct mo_wire_results results = {0};
  int error = up_size > 0 ? mo_wire_get_results(up, up_size, &results, message) : MO_OK;
  if (error != MO_OK)
    return error;
  pthread_mutex_lock(&fleet->mutex);
  struct mo_session *session = mo_session_find(fleet, id);
  if (session != NULL && session->state != MO_SESSION_REFUSED)
    session = name_origin(fleet, session, &results, &error);
  if (error != MO_OK) {
    session = mo_session_find(fleet, id);
    if (session != NULL) /* the worker may end now, and its bodies must not be blamed */
      mo_session_release(fleet, session, false, now_ns, &after);
    mo_fail(message, error, "the service could not store the origin of the results; try again");
  } else if (session == NULL) {
    error = mo_fail(message, MO_ERR_NOT_FOUND, "the session is not open; join again");
  } else if (session->state == MO_SESSION_REFUSED) {
    error = mo_fail(message, MO_ERR_CONFLICT, "session \"%s\" was refused because it %s",
                    session->offer.name, session->why);
  } else {
    session->heard_ns = now_ns;
    for (uint32_t b = 0; b < 2; b++)
      mo_session_wait(session, (enum mo_back_end)b, NULL);
    error = mo_results_take(fleet, session, &results, now_ns, &after, message);
    if (error == MO_OK)
      error = give(fleet, session, now_ns, &after, down, down_size, n_leases);
  }
  pthread_mutex_unlock(&fleet->mutex);
  mo_after_run(fleet, &after);
  mo_wire_free_results(&results);
  return error;
}

/* ---- orders and weights ---- */

/* A session with an order to drop a lease has room for another one. */
static void end_told(struct mo_fleet *fleet, struct mo_session *session,
                     const struct mo_fleet_orders *orders, uint64_t now_ns, struct mo_after *after)
{
  for (uint32_t i = 0; i < orders->n_dropped; i++) {
    struct mo_lease *lease = mo_lease_find(fleet, orders->dropped[i].number);
    const int place = lease != NULL ? mo_lease_held_by(lease, session) : MO_ERR_NOT_FOUND;
    if (place < 0)
      continue;
    (void)mo_lease_release(fleet, lease, (uint32_t)place, false, now_ns, after);
    if (session->state == MO_SESSION_ACTIVE)
      wait_for_more(fleet, session);
    mo_after_wake(after, session->id);
  }
}

int mo_fleet_orders(struct mo_fleet *fleet, uint64_t id, uint64_t now_ns,
                    struct mo_fleet_orders *orders)
{
  struct mo_after after = {0};
  memset(orders, 0, sizeof(*orders));
  pthread_mutex_lock(&fleet->mutex);
  struct mo_session *session = mo_session_find(fleet, id);
  if (session == NULL) {
    pthread_mutex_unlock(&fleet->mutex);
    return MO_ERR_NOT_FOUND;
  }
  const int has_orders = session->n_dropped > 0 || session->state != session->told;
  session->heard_ns = now_ns;
  session->told = session->state;
  orders->state = session->state;
  if (session->for_upgrade)
    snprintf(orders->wanted, sizeof(orders->wanted), "%s", fleet->config.version);
  orders->n_dropped = session->n_dropped;
  memcpy(orders->dropped, session->dropped, session->n_dropped * sizeof(*orders->dropped));
  session->n_dropped = 0;
  end_told(fleet, session, orders, now_ns, &after);
  pthread_mutex_unlock(&fleet->mutex);
  mo_after_run(fleet, &after);
  return has_orders;
}

int mo_fleet_controller(struct mo_fleet *fleet, const struct mo_sha256 *hash,
                        struct mo_fleet_file **file)
{
  struct mo_weights *weights = NULL;
  MO_GUARD(&fleet->mutex);
  const int error = mo_weights_read(fleet, hash, &weights);
  if (error == MO_OK)
    *file = &weights->file;
  return error;
}

void mo_fleet_file_release(void *file)
{
  struct mo_weights *weights = file; /* the file is its first member */
  struct mo_fleet *fleet = weights->file.fleet;
  MO_GUARD(&fleet->mutex);
  weights->n_readers--;
  mo_weights_release(fleet, weights);
}
