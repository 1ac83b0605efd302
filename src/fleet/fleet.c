/* fleet.c: creates and frees the fleet, opens and closes sessions, and advances its clock. */
#include <stdlib.h>
#include <string.h>

#include <sys/random.h>

#include "fleet/decide.h"
#include "fleet/give.h"

#define BLOCK_STEPS 16000.0 /* assumed until some blocks have been seen */
#define REFUSED_NS  MO_S_NS /* shortest time between two events about refusals */

/* ---- life ---- */

int mo_fleet_create(const struct mo_fleet_config *config, struct mo_fleet **ret)
{
  struct mo_fleet *fleet = calloc(1, sizeof(*fleet));
  if (fleet == NULL)
    return MO_ERR_NO_MEMORY;
  fleet->config = *config;
  fleet->silence_ns =
      UINT64_C(1000000) * (config->silence_ms > 0 ? config->silence_ms : MO_FLEET_SILENCE_MS);
  fleet->next_lease = 1;
  pthread_mutex_init(&fleet->mutex, NULL);
  TAILQ_INIT(&fleet->sessions);
  TAILQ_INIT(&fleet->ended);
  TAILQ_INIT(&fleet->leases);
  TAILQ_INIT(&fleet->disputed);
  for (uint32_t b = 0; b < 2; b++) {
    fleet->classes[b].block_steps = BLOCK_STEPS;
    TAILQ_INIT(&fleet->classes[b].listed);
    TAILQ_INIT(&fleet->classes[b].idle);
    TAILQ_INIT(&fleet->classes[b].busy);
  }
  *ret = fleet;
  return MO_OK;
}

static void free_sessions(struct mo_session_list *list)
{
  struct mo_session *session;
  while ((session = TAILQ_FIRST(list)) != NULL) {
    TAILQ_REMOVE(list, session, all);
    free(session);
  }
}

void mo_fleet_free(struct mo_fleet *fleet)
{
  if (fleet == NULL)
    return;
  struct mo_after after = {0};
  struct mo_lease *lease;
  mo_decide_end(fleet);
  fleet->config.wake = NULL;
  while ((lease = TAILQ_FIRST(&fleet->leases)) != NULL)
    mo_lease_end(fleet, lease, &after);
  mo_after_run(fleet, &after);
  while (!LIST_EMPTY(&fleet->weights))
    mo_weights_forget(LIST_FIRST(&fleet->weights));
  free_sessions(&fleet->sessions);
  free_sessions(&fleet->ended);
  pthread_mutex_destroy(&fleet->mutex);
  free(fleet);
}

/* ---- joining ---- */

/* Call it with the lock held. Returns whether no worker of an absent class has joined yet. */
static bool lacks_canary(const struct mo_fleet *fleet, uint32_t back_end)
{
  static const struct mo_sha256 none;
  return fleet->config.classes[back_end].is_absent &&
         mo_sha256_equal(&fleet->config.classes[back_end].canary, &none);
}

/* Call it with the lock held. Chooses the classes that a session serves. */
static int choose_classes(const struct mo_fleet *fleet, const struct mo_fleet_offer *offer,
                          bool serves[2], struct mo_message *message)
{
  const struct mo_fleet_config *config = &fleet->config;
  char got[MO_SHA256_DIGITS + 1], wanted[MO_SHA256_DIGITS + 1];
  for (uint32_t b = 0; b < 2; b++) {
    serves[b] = config->classes[b].scores != NULL &&
                strcmp(offer->classes[b].scores, config->classes[b].scores) == 0 &&
                (config->classes[b].gradients == NULL ||
                 strcmp(offer->classes[b].gradients, config->classes[b].gradients) == 0);
    if (!serves[b] || lacks_canary(fleet, b) ||
        mo_sha256_equal(&offer->classes[b].canary, &config->classes[b].canary))
      continue;
    mo_sha256_to_hex(&offer->classes[b].canary, got);
    mo_sha256_to_hex(&config->classes[b].canary, wanted);
    return mo_fail(message, MO_ERR_CONFLICT,
                   "the canary of class \"%.60s\" must have the hash %s, got %s",
                   config->classes[b].scores, wanted, got);
  }
  if (serves[MO_ON_CPU] || serves[MO_ON_DEVICE])
    return MO_OK;
  const char *const device = config->classes[MO_ON_DEVICE].scores;
  return mo_fail(
      message, MO_ERR_UNSUPPORTED,
      "the worker must be version %s with class \"%.60s\"%s%.60s%s, got version %s with \"%.60s\"",
      config->version, config->classes[MO_ON_CPU].scores, device != NULL ? " or \"" : "",
      device != NULL ? device : "", device != NULL ? "\"" : "", offer->version,
      offer->classes[MO_ON_CPU].scores);
}

static void note_refusal(struct mo_fleet *fleet, const struct mo_fleet_offer *offer,
                         uint64_t now_ns, const struct mo_message *why, struct mo_after *after)
{
  struct mo_text text = {0};
  if (fleet->refused_ns != 0 && now_ns < fleet->refused_ns + REFUSED_NS)
    return;
  fleet->refused_ns = now_ns;
  mo_event_session(&text, offer->name, offer->host, why->text);
  mo_after_event(after, "fleet.refused", &text);
}

/* Draws a random id that cannot be guessed and that no session has. Returns 0 if the system has no
 * random numbers. */
static uint64_t draw_id(struct mo_fleet *fleet)
{
  uint64_t id = 0;
  do {
    if (getrandom(&id, sizeof(id), 0) != (ssize_t)sizeof(id))
      return 0;
    id >>= 5; /* below 10^18, like all ids of the API */
  } while (id == 0 || mo_session_find(fleet, id) != NULL);
  return id;
}

static uint64_t hash_of(const char *user, const char *origin)
{
  struct mo_sha256 hashes[2], hash;
  uint64_t start;
  mo_sha256_of(user, strlen(user), &hashes[0]);
  mo_sha256_of(origin, strlen(origin), &hashes[1]);
  mo_sha256_of(hashes, sizeof(hashes), &hash);
  memcpy(&start, hash.bytes, sizeof(start));
  return start;
}

/* Call it with the lock held. */
static int admit(const struct mo_fleet *fleet, const struct mo_fleet_offer *offer,
                 struct mo_message *message)
{
  if (fleet->n_sessions == MO_FLEET_SESSIONS_MAX)
    return mo_fail(message, MO_ERR_LIMIT, "%d sessions are open, which is the limit",
                   MO_FLEET_SESSIONS_MAX);
  if (offer->user[0] == '\0' || fleet->n_sessions < MO_FLEET_TOKEN_MAX)
    return MO_OK;
  uint32_t n = 0;
  const struct mo_session *session;
  TAILQ_FOREACH(session, &fleet->sessions, all) n += strcmp(session->offer.user, offer->user) == 0;
  return n < MO_FLEET_TOKEN_MAX ? MO_OK
                                : mo_fail(message, MO_ERR_LIMIT,
                                          "the token has %d open sessions, which is the limit; "
                                          "give some workers another token",
                                          MO_FLEET_TOKEN_MAX);
}

/* Call it with the lock held; releases the lock while it calls the configured function. Names the
 * absent classes that an offer has. */
static int name_classes(struct mo_fleet *fleet, const struct mo_fleet_offer *offer,
                        struct mo_message *message)
{
  struct mo_fleet_config *config = &fleet->config;
  int error = MO_OK;
  for (uint32_t b = 0; b < 2 && error == MO_OK; b++) {
    const char *names[2] = {NULL, NULL};
    if (!config->classes[b].is_absent || config->classes[b].scores != NULL ||
        offer->classes[b].scores[0] == '\0')
      continue;
    pthread_mutex_unlock(&fleet->mutex);
    error = config->name_class(config->context, (enum mo_back_end)b, offer->classes[b].scores,
                               offer->classes[b].gradients, names);
    pthread_mutex_lock(&fleet->mutex);
    if (error == MO_OK) {
      config->classes[b].scores = names[0];
      config->classes[b].gradients = names[1];
    } else if (error == MO_ERR_LIMIT) {
      error = mo_fail(message, MO_ERR_UNSUPPORTED, "the fingerprints of a class are too long");
    }
  }
  return error;
}

/* Call it with the lock held. Opens the session. The first session of an absent class sets the
 * canary that later ones must have. */
static void open_session(struct mo_fleet *fleet, struct mo_session *session, struct mo_after *after)
{
  for (uint32_t b = 0; b < 2; b++)
    if (session->serves[b] && lacks_canary(fleet, b))
      fleet->config.classes[b].canary = session->offer.classes[b].canary;
  mo_session_insert(fleet, session, after);
}

int64_t mo_fleet_join(struct mo_fleet *fleet, const struct mo_fleet_offer *offer, uint64_t now_ns,
                      struct mo_message *ret_message)
{
  struct mo_after after = {0};
  struct mo_message message = {""};
  struct mo_session *session = calloc(1, sizeof(*session));
  char origin[2 * MO_FLEET_NAME_BYTES + 2];
  if (session == NULL)
    return MO_ERR_NO_MEMORY;
  *session = (struct mo_session){.offer = *offer, .joined_ns = now_ns, .heard_ns = now_ns};
  session->is_older = strverscmp(offer->version, fleet->config.version) < 0;
  snprintf(origin, sizeof(origin), "%s@%s", offer->name, offer->host);
  session->worker = hash_of(offer->user, origin);
  pthread_mutex_lock(&fleet->mutex);
  int error = MO_OK;
  if (admit(fleet, offer, NULL) == MO_OK)
    error = name_classes(fleet, offer, &message);
  if (error == MO_OK)
    error = choose_classes(fleet, offer, session->serves, &message);
  if (error == MO_OK)
    error = admit(fleet, offer, &message);
  if (error == MO_OK && (session->id = draw_id(fleet)) == 0)
    error = mo_fail(&message, MO_ERR_IO, "the system could not provide random numbers; try again");
  if (error == MO_ERR_CONFLICT || error == MO_ERR_UNSUPPORTED)
    note_refusal(fleet, offer, now_ns, &message, &after);
  const int64_t id = error == MO_OK ? (int64_t)session->id : error;
  if (error == MO_OK)
    open_session(fleet, session, &after);
  else
    free(session);
  pthread_mutex_unlock(&fleet->mutex);
  mo_after_run(fleet, &after);
  if (ret_message != NULL)
    *ret_message = message;
  return id;
}

/* ---- leaving, and what operators do ---- */

bool mo_fleet_is_of(struct mo_fleet *fleet, uint64_t id, const char *user)
{
  MO_GUARD(&fleet->mutex);
  const struct mo_session *session = mo_session_find(fleet, id);
  return session != NULL && strcmp(session->offer.user, user) == 0;
}

int mo_fleet_leave(struct mo_fleet *fleet, uint64_t id, bool is_lost, uint64_t now_ns)
{
  struct mo_after after = {0};
  pthread_mutex_lock(&fleet->mutex);
  struct mo_session *session = mo_session_find(fleet, id);
  if (session != NULL)
    mo_session_end(fleet, session, is_lost ? MO_SESSION_LOST : MO_SESSION_LEFT,
                   is_lost ? "its connection ended" : "left", now_ns, &after);
  pthread_mutex_unlock(&fleet->mutex);
  mo_after_run(fleet, &after);
  return session != NULL ? MO_OK : MO_ERR_NOT_FOUND;
}

int mo_fleet_drain(struct mo_fleet *fleet, uint64_t id, bool for_upgrade)
{
  struct mo_after after = {0};
  char why[64] = "an operator requested it";
  if (for_upgrade)
    snprintf(why, sizeof(why), "to upgrade to version %s", fleet->config.version);
  pthread_mutex_lock(&fleet->mutex);
  struct mo_session *session = mo_session_find(fleet, id);
  if (session != NULL && session->state == MO_SESSION_ACTIVE)
    session->for_upgrade = for_upgrade;
  if (session != NULL)
    mo_session_drain(fleet, session, why, &after);
  pthread_mutex_unlock(&fleet->mutex);
  mo_after_run(fleet, &after);
  return session != NULL ? MO_OK : MO_ERR_NOT_FOUND;
}
