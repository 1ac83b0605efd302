/* fleet.h: the workers of other machines that compute for this daemon.
 *
 * A worker opens a session. It takes leases, which are blocks off the fair queue of its class, and
 * returns their rows. A lease is memory: after a restart of the daemon it is computed again. A
 * session that leaves, is silent, or is too slow with a lease loses it, and the lease is given out
 * again. The first result counts; later ones are compared with it.
 *
 * This room knows neither HTTP nor SQL. Time is the argument `now_ns` (of mo_clock_ns), so that
 * tests turn the clock. All functions may be called from any thread. */
#ifndef MORPHO_FLEET_FLEET_H
#define MORPHO_FLEET_FLEET_H

#include "fleet/source.h"

#define MO_FLEET_SESSIONS_MAX 4096
#define MO_FLEET_TOKEN_MAX    2048 /* of these, by one token */
#define MO_FLEET_NAME_BYTES   64   /* of a session or host, without NUL */
#define MO_FLEET_SILENCE_MS   6000
#define MO_FLEET_LEASE_S      1.0 /* time that a lease should take */
#define MO_FLEET_LEASES       2   /* of a session and back end at one time */

enum mo_session_state {
  MO_SESSION_ACTIVE,
  MO_SESSION_DRAINING, /* gets no further leases */
  MO_SESSION_REFUSED,  /* gave wrong bits; its later results are not taken */
  MO_SESSION_LEFT,     /* it said so */
  MO_SESSION_LOST      /* its connection ended, or it was silent */
};
extern const char *const mo_session_state_words[]; /* "active", …; NULL */

struct mo_fleet_config {
  struct mo_fleet_source source;
  struct mo_workspace workspace; /* of all bodies and controllers */
  uint64_t epoch;
  uint64_t seed;       /* of the choice of audits; the same in tests */
  const char *version; /* of the program; workers of any may join whose class is one of these */
  /* By enum mo_back_end: the class, and the hash that its canary must have; class NULL: not served.
   * is_absent: only workers have it, and the first one's canary counts; `name_class` names it. */
  struct {
    const char *scores, *gradients;
    struct mo_sha256 canary;
    bool is_absent;
  } classes[2];
  uint32_t silence_ms; /* 0: MO_FLEET_SILENCE_MS */
  /* Called without locks. name_class: a worker has an absent class, which has no name yet; returns
   * the names that it has from now on, which last; an error refuses the session. origin: the number
   * of "name@host" under which results are delivered, asked for before the first; an error refuses
   * them. wake: the session may have
   * orders or work for a request that waits. event: type such as "fleet.joined", data: a JSON
   * object. Each nullable. */
  int (*name_class)(void *context, enum mo_back_end back_end, const char *scores,
                    const char *gradients, const char *names[2]);
  int (*origin)(void *context, const char *text, int64_t *number);
  void (*wake)(void *context, uint64_t session);
  void (*event)(void *context, const char *type, const char *data);
  void *context;
};

struct mo_fleet;
int mo_fleet_create(const struct mo_fleet_config *config, struct mo_fleet **fleet);
/* Puts all leases back. NULL-safe. Before mo_compute_free. */
void mo_fleet_free(struct mo_fleet *fleet);

/* ---- canary: frozen rollouts and a gradient, which have the same bits in one class ---- */
/* Computes the canary of a class by the workers or the devices of a back end: half a second of one
 * processor. MO_ERR_DEVICE, MO_ERR_NO_MEMORY. */
int mo_fleet_canary(struct mo_compute *compute, enum mo_back_end back_end, struct mo_sha256 *hash);

/* ---- sessions ---- */
struct mo_fleet_offer {
  char name[MO_FLEET_NAME_BYTES + 1], host[MO_FLEET_NAME_BYTES + 1], version[32];
  char user[MO_FLEET_NAME_BYTES + 1]; /* of its token; "": none */
  uint32_t n_threads, n_devices;
  struct {
    char scores[128], gradients[128]; /* "": does not serve this back end */
    struct mo_sha256 canary;
  } classes[2]; /* by enum mo_back_end */
};
/* Opens a session. Returns its id, unguessable, 1 to 10^18. MO_ERR_UNSUPPORTED: no class that this
 * daemon has; MO_ERR_CONFLICT: a wrong canary (with both hashes in the message); MO_ERR_LIMIT. */
int64_t mo_fleet_join(struct mo_fleet *fleet, const struct mo_fleet_offer *offer, uint64_t now_ns,
                      struct mo_message *message);
/* Says whether a session is open and was opened with this user's token. */
bool mo_fleet_is_of(struct mo_fleet *fleet, uint64_t session, const char *user);
/* Closes a session and puts its leases back. why: "left", "connection ended". MO_ERR_NOT_FOUND. */
int mo_fleet_leave(struct mo_fleet *fleet, uint64_t session, bool is_lost, uint64_t now_ns);
/* Takes results, and gives leases while the session holds fewer than MO_FLEET_LEASES. `up`: a
 * message of results, or size 0; results of leases that the session does not hold are ignored.
 * `down` (malloc): a message of leases. *n_leases: how many; 0: call again after `wake`.
 * MO_ERR_NOT_FOUND: no such session (any more): the worker joins again; MO_ERR_FORMAT: nothing was
 * taken; MO_ERR_CONFLICT: refused. */
int mo_fleet_exchange(struct mo_fleet *fleet, uint64_t session, const uint8_t *up, size_t up_size,
                      uint64_t now_ns, uint8_t **down, size_t *down_size, uint32_t *n_leases,
                      struct mo_message *message);

/* What a session is told on its watch: leases to drop, and whether to go on. */
struct mo_fleet_orders {
  enum mo_session_state state;
  char
      wanted[32]; /* draining: the version that its worker should be started again with; "": none */
  uint32_t n_dropped;
  struct mo_lease_id dropped[16];
};
/* Reads the orders since the last call; counts as a sign of life. Returns 1: there are some; 0;
 * MO_ERR_NOT_FOUND. */
int mo_fleet_orders(struct mo_fleet *fleet, uint64_t session, uint64_t now_ns,
                    struct mo_fleet_orders *orders);
/* Gives the weights of a lease that is out: the file with this SHA-256, until it is released.
 * MO_ERR_NOT_FOUND; MO_ERR_BUSY: no lease has it now, and slow readers keep too many files. */
struct mo_fleet_file {
  struct mo_fleet *fleet;
  const uint8_t *bytes;
  size_t size;
};
int mo_fleet_controller(struct mo_fleet *fleet, const struct mo_sha256 *hash,
                        struct mo_fleet_file **file);
void mo_fleet_file_release(void *file); /* before mo_fleet_free */

/* About every 20 ms: gives out again what is late, ends silent sessions, drops cancelled leases,
 * wakes sessions for which there is work. */
void mo_fleet_tick(struct mo_fleet *fleet, uint64_t now_ns);
/* Says that work was queued while none was: the next tick wakes sessions. Takes no lock. */
void mo_fleet_arrived(struct mo_fleet *fleet);

/* For operators. MO_ERR_NOT_FOUND. */
int mo_fleet_drain(struct mo_fleet *fleet, uint64_t session, bool for_upgrade);

#endif
