/* facts.c: see facts.h. */
#include <stdlib.h>
#include <string.h>

#include "fleet/leases.h"

static double rows_per_s(const struct mo_session *session)
{
  double rate = 0;
  for (uint32_t b = 0; b < 2; b++)
    if (session->pace[b].s > 0)
      rate += session->pace[b].rows / session->pace[b].s;
  return rate;
}

static uint32_t rows_out(const struct mo_session *session)
{
  uint32_t rows = 0;
  for (uint32_t b = 0; b < 2; b++)
    for (uint32_t i = 0; i < session->n_held[b]; i++)
      rows += session->held[b][i]->content.n_rows;
  return rows;
}

void mo_fleet_status(struct mo_fleet *fleet, struct mo_fleet_status *status)
{
  const struct mo_session *session;
  MO_GUARD(&fleet->mutex);
  *status = fleet->counts;
  for (uint32_t b = 0; b < 2; b++)
    status->n_serving[b] = fleet->classes[b].n_sessions;
  TAILQ_FOREACH(session, &fleet->sessions, all)
  {
    if (session->state == MO_SESSION_REFUSED)
      continue;
    const uint32_t held = session->n_held[0] + session->n_held[1];
    status->n_sessions++;
    status->n_older += session->is_older;
    status->n_threads += session->offer.n_threads;
    status->n_devices += session->offer.n_devices;
    status->leases += held;
    status->rows_out += rows_out(session);
    status->rows_per_s += held > 0 ? rows_per_s(session) : 0;
  }
}

static struct mo_session_status status_of(const struct mo_session *session)
{
  struct mo_session_status status = {.id = session->id,
                                     .offer = session->offer,
                                     .state = session->state,
                                     .is_older = session->is_older,
                                     .joined_ns = session->joined_ns,
                                     .heard_ns = session->heard_ns,
                                     .ended_ns = session->ended_ns,
                                     .leases = session->n_held[0] + session->n_held[1],
                                     .rows_out = rows_out(session),
                                     .rows_per_s = rows_per_s(session),
                                     .busy_s = session->busy_s,
                                     .leases_done = session->leases_done,
                                     .leases_lost = session->leases_lost,
                                     .rows_done = session->rows_done,
                                     .audits = session->audits,
                                     .audits_failed = session->audits_failed};
  snprintf(status.why, sizeof(status.why), "%s", session->why);
  return status;
}

int mo_fleet_sessions(struct mo_fleet *fleet, struct mo_session_status **ret, size_t *ret_n)
{
  const struct mo_session *session;
  size_t n = 0;
  MO_GUARD(&fleet->mutex);
  struct mo_session_status *items =
      malloc((fleet->n_sessions + fleet->n_ended + 1) * sizeof(*items));
  if (items != NULL) {
    TAILQ_FOREACH(session, &fleet->sessions, all)
    items[n++] = status_of(session);
    TAILQ_FOREACH(session, &fleet->ended, all)
    items[n++] = status_of(session);
    *ret = items;
    *ret_n = n;
  }
  return items != NULL ? MO_OK : MO_ERR_NO_MEMORY;
}
