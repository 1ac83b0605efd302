/* fleet_status.c: reports the workers on other machines to clients, and lets operators manage them.
 */
#include "api/fleet.h"

#include <stdlib.h>

#include "api/submission.h"
#include "base/clock.h"
#include "fleet/facts.h"

/* ---- the status ---- */

/* Writes a class as a member. sessions (nullable): the number of sessions that serve it. */
static void write_class(struct mo_text *text, const char *name, const char *scores,
                        const char *gradients, const uint32_t *sessions)
{
  mo_text_name(text, name);
  if (scores == NULL || scores[0] == '\0') {
    mo_text_add(text, "null");
    return;
  }
  mo_text_object(text);
  mo_text_member(text, "scores", scores);
  mo_text_member(text, "gradients", gradients);
  if (sessions != NULL)
    mo_text_member_count(text, "sessions", *sessions);
  mo_text_add(text, "}");
}

/* Writes a time of the monotonic clock; null for 0. */
static void write_moment(struct mo_text *text, const char *name, uint64_t then_ns)
{
  const int64_t ago_us = mo_clock_us() - (int64_t)(then_ns / 1000);
  mo_text_member_time(text, name, then_ns > 0 ? mo_clock_wall_us() - ago_us : 0);
}

/* has_id: the client may see the id, which is needed to drain a session. */
static void write_session(struct mo_text *text, const struct mo_session_status *session,
                          bool has_id)
{
  static const char *const names[] = {"cpu", "device"};
  const struct mo_fleet_offer *offer = &session->offer;
  mo_text_object(text);
  mo_text_member_id(text, "id", has_id ? (int64_t)session->id : -1);
  mo_text_member(text, "name", offer->name);
  mo_text_member(text, "host", offer->host);
  mo_text_member(text, "user", offer->user[0] != '\0' ? offer->user : NULL);
  mo_text_member(text, "version", offer->version);
  mo_text_member_bool(text, "older", session->is_older);
  mo_text_member(text, "state", mo_session_state_words[session->state]);
  mo_text_member(text, "why", session->why[0] != '\0' ? session->why : NULL);
  mo_text_member_count(text, "n_threads", offer->n_threads);
  mo_text_member_count(text, "n_devices", offer->n_devices);
  mo_text_add(text, ",\"classes\":{");
  for (size_t i = 0; i < 2; i++)
    write_class(text, names[i], offer->classes[i].scores, offer->classes[i].gradients, NULL);
  mo_text_add(text, "}");
  write_moment(text, "joined_at", session->joined_ns);
  write_moment(text, "heard_at", session->heard_ns);
  write_moment(text, "ended_at", session->ended_ns);
  mo_text_member_count(text, "leases", session->leases);
  mo_text_member_count(text, "rollouts_out", session->rows_out);
  mo_text_member_number(text, "rollouts_per_s", session->rows_per_s);
  mo_text_member_number(text, "busy_s", session->busy_s);
  mo_text_member_count(text, "leases_done", session->leases_done);
  mo_text_member_count(text, "leases_lost", session->leases_lost);
  mo_text_member_count(text, "rollouts_done", session->rows_done);
  mo_text_member_count(text, "audits", session->audits);
  mo_text_member_count(text, "audits_failed", session->audits_failed);
  mo_text_add(text, "}");
}

/* Writes the classes of this daemon, with the number of sessions that serve each. */
static void write_classes(struct mo_text *text, const struct mo_api *api,
                          const struct mo_fleet_status *status)
{
  const char *const names[2][3] = {
      [MO_ON_CPU] = {"cpu", mo_compute_fingerprint(api->compute, MO_FLOAT32),
                     mo_compute_gradient_fingerprint(api->compute)},
      [MO_ON_DEVICE] = {"device", mo_compute_device_fingerprint(api->compute),
                        mo_compute_device_gradient_fingerprint(api->compute)}};
  mo_text_add(text, ",\"classes\":{");
  for (size_t i = 0; i < 2; i++)
    write_class(text, names[i][0], names[i][1], names[i][2], &status->n_serving[i]);
  mo_text_add(text, "}");
}

static void write_counts(struct mo_text *text, const struct mo_fleet_status *status)
{
  mo_text_member_count(text, "n_sessions", status->n_sessions);
  mo_text_member_count(text, "n_threads", status->n_threads);
  mo_text_member_count(text, "n_devices", status->n_devices);
  mo_text_member_count(text, "n_older", status->n_older);
  mo_text_member_count(text, "leases", status->leases);
  mo_text_member_count(text, "rollouts_out", status->rows_out);
  mo_text_member_number(text, "rollouts_per_s", status->rows_per_s);
  mo_text_member_count(text, "joined", status->joined);
  mo_text_member_count(text, "lost", status->lost);
  mo_text_member_count(text, "leases_done", status->leases_done);
  mo_text_member_count(text, "leases_again", status->leases_again);
  mo_text_member_count(text, "rollouts_done", status->rows_done);
  mo_text_member_count(text, "rollouts_twice", status->rows_twice);
  mo_text_member_count(text, "audits", status->audits);
  mo_text_member_count(text, "audits_failed", status->audits_failed);
}

void mo_api_get_fleet(struct mo_request *request)
{
  const struct mo_api *api = mo_api_of(request);
  struct mo_fleet *fleet = atomic_load(&api->fleet);
  struct mo_fleet_status status = {0};
  struct mo_session_status *sessions = NULL;
  size_t n = 0;
  struct mo_text text = {0};
  int error = MO_OK;
  if (fleet != NULL) {
    mo_fleet_status(fleet, &status);
    error = mo_fleet_sessions(fleet, &sessions, &n);
  }
  mo_text_object(&text);
  mo_text_member_bool(&text, "listening", fleet != NULL);
  mo_text_member(&text, "version", api->version);
  mo_text_member(&text, "compute", fleet != NULL ? api->fleet_compute : "local");
  write_classes(&text, api, &status);
  write_counts(&text, &status);
  mo_text_add(&text, ",\"sessions\":[");
  for (size_t i = 0; i < n; i++)
    write_session(&text, &sessions[i], request->caller.right == MO_RIGHT_ADMIN);
  mo_text_add(&text, "]}");
  free(sessions);
  mo_reply_text(request, error, &text, "fleet");
}

/* ---- actions of operators ---- */

static void reply_done(struct mo_request *request, int error, const char *what)
{
  if (error != MO_OK)
    mo_reply_error(request, error, what);
  else
    mo_reply_static(request, 204, NULL, "", 0);
}

void mo_api_drain_session(struct mo_request *request)
{
  static const char *const flags[] = {"false", "true", NULL};
  int for_upgrade = 0;
  uint64_t session;
  struct mo_fleet *fleet = mo_path_session(request, &session);
  if (fleet != NULL && mo_query_word(request, "upgrade", flags, &for_upgrade))
    reply_done(request, mo_fleet_drain(fleet, session, for_upgrade), "session");
}
