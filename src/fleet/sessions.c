/* sessions.c: see sessions.h. */
#include "fleet/sessions.h"

#include <stdlib.h>
#include <string.h>

const char *const mo_session_state_words[] = {"active", "draining", "refused",
                                              "left",   "lost",     NULL};

/* ---- the table ---- */

struct mo_session *mo_session_find(struct mo_fleet *fleet, uint64_t id)
{
  struct mo_session *session = LIST_FIRST(&fleet->sessions_by_id[id % MO_SESSION_BUCKETS]);
  while (session != NULL && session->id != id)
    session = LIST_NEXT(session, by_id);
  return session;
}

/* Creates an event for the first older worker only, not for each worker of an older fleet. */
static void note_older(const struct mo_fleet *fleet, const struct mo_session *session,
                       struct mo_after *after)
{
  const struct mo_session *other;
  struct mo_text text = {0};
  TAILQ_FOREACH(other, &fleet->sessions, all)
  if (other->is_older && other != session)
    return;
  mo_event_session(&text, session->offer.name, session->offer.host, "");
  mo_text_member(&text, "version", session->offer.version);
  mo_text_member(&text, "wanted", fleet->config.version);
  mo_after_event(after, "fleet.older", &text);
}

void mo_session_insert(struct mo_fleet *fleet, struct mo_session *session, struct mo_after *after)
{
  struct mo_text text = {0};
  LIST_INSERT_HEAD(&fleet->sessions_by_id[session->id % MO_SESSION_BUCKETS], session, by_id);
  TAILQ_INSERT_TAIL(&fleet->sessions, session, all);
  fleet->n_sessions++;
  fleet->counts.joined++;
  for (uint32_t b = 0; b < 2; b++)
    fleet->classes[b].n_sessions += session->serves[b];
  mo_event_session(&text, session->offer.name, session->offer.host, "");
  mo_text_member_count(&text, "n_threads", session->offer.n_threads);
  mo_text_member_count(&text, "n_devices", session->offer.n_devices);
  mo_after_event(after, "fleet.joined", &text);
  if (session->is_older)
    note_older(fleet, session, after);
}

/* ---- ends ---- */

/* Changes the state of an active session, which then gets no more leases. */
static void deactivate(struct mo_fleet *fleet, struct mo_session *session,
                       enum mo_session_state state, const char *why, struct mo_after *after)
{
  for (uint32_t b = 0; b < 2; b++) {
    if (session->state == MO_SESSION_ACTIVE && session->serves[b])
      after->is_emptied[b] |= --fleet->classes[b].n_sessions == 0;
    mo_session_wait(session, (enum mo_back_end)b, NULL);
  }
  session->state = state;
  snprintf(session->why, sizeof(session->why), "%s", why);
}

void mo_session_drain(struct mo_fleet *fleet, struct mo_session *session, const char *why,
                      struct mo_after *after)
{
  if (session->state != MO_SESSION_ACTIVE)
    return;
  deactivate(fleet, session, MO_SESSION_DRAINING, why, after);
  mo_after_wake(after, session->id);
}

/* The oldest lease comes first here, so mo_after_run puts it back last, in front of the others. */
void mo_session_release(struct mo_fleet *fleet, struct mo_session *session, bool is_lost,
                        uint64_t now_ns, struct mo_after *after)
{
  for (uint32_t b = 0; b < 2; b++) {
    while (session->n_held[b] > 0) {
      struct mo_lease *lease = session->held[b][0];
      (void)mo_lease_release(fleet, lease, (uint32_t)mo_lease_held_by(lease, session), is_lost,
                             now_ns, after);
    }
  }
}

void mo_session_end(struct mo_fleet *fleet, struct mo_session *session, enum mo_session_state state,
                    const char *why, uint64_t now_ns, struct mo_after *after)
{
  if (session->state != MO_SESSION_REFUSED) {
    struct mo_text text = {0};
    fleet->counts.lost += state == MO_SESSION_LOST;
    mo_event_session(&text, session->offer.name, session->offer.host, why);
    mo_text_member_count(&text, "leases", session->n_held[0] + session->n_held[1]);
    mo_after_event(after, state == MO_SESSION_LOST ? "fleet.lost" : "fleet.left", &text);
    deactivate(fleet, session, state, why, after);
    mo_session_release(fleet, session, state == MO_SESSION_LOST, now_ns, after);
  }
  session->ended_ns = now_ns;
  LIST_REMOVE(session, by_id);
  TAILQ_REMOVE(&fleet->sessions, session, all);
  TAILQ_INSERT_HEAD(&fleet->ended, session, all);
  fleet->n_sessions--;
  if (++fleet->n_ended <= MO_ENDED_MAX)
    return;
  struct mo_session *oldest = TAILQ_LAST(&fleet->ended, mo_session_list);
  TAILQ_REMOVE(&fleet->ended, oldest, all);
  fleet->n_ended--;
  free(oldest);
}

/* ---- refusal ---- */

/* Finds a session that has ended, among those that are still in memory. */
static struct mo_session *find_ended(const struct mo_fleet *fleet, uint64_t id)
{
  struct mo_session *session;
  TAILQ_FOREACH(session, &fleet->ended, all)
  {
    if (session->id == id)
      break;
  }
  return session;
}

void mo_session_refuse(struct mo_fleet *fleet, uint64_t id, const char *name, const char *host,
                       const char *why, uint64_t now_ns, struct mo_after *after)
{
  struct mo_session *session = mo_session_find(fleet, id);
  struct mo_session *ended = session == NULL ? find_ended(fleet, id) : NULL;
  const struct mo_session *known = session != NULL ? session : ended;
  struct mo_text text = {0};
  if (known != NULL && known->state == MO_SESSION_REFUSED)
    return;
  mo_event_session(&text, name, host, why);
  mo_after_event(after, "fleet.refused", &text);
  if (ended != NULL) { /* one event, even if several of its results are still to be checked */
    ended->state = MO_SESSION_REFUSED;
    snprintf(ended->why, sizeof(ended->why), "%s", why);
  }
  if (session == NULL)
    return;
  deactivate(fleet, session, MO_SESSION_REFUSED, why, after);
  mo_session_release(fleet, session, false, now_ns, after);
  mo_after_wake(after, session->id);
}
